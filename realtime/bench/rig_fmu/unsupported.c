/* The functions of FMI 3.0 whose features the FMU of a rig does not have: each returns fmi3Error.

An importing tool may look for all functions of the standard when it loads the library. */

#include "fmi3Functions.h"

fmi3Status rig_unsupported(void *instance, const char *function);

#define REFUSED(name, ...)                                  \
    fmi3Status name(fmi3Instance instance, ##__VA_ARGS__) { \
        return rig_unsupported(instance, #name);            \
    }

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String
    instantiationToken, fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage) {
    return 0;
}
fmi3Instance fmi3InstantiateScheduledExecution(fmi3String instanceName, fmi3String
    instantiationToken, fmi3String resourcePath, fmi3Boolean visible, fmi3Boolean loggingOn,
    fmi3InstanceEnvironment instanceEnvironment, fmi3LogMessageCallback logMessage,
    fmi3ClockUpdateCallback clockUpdate, fmi3LockPreemptionCallback lockPreemption,
    fmi3UnlockPreemptionCallback unlockPreemption) {
    return 0;
}
REFUSED(fmi3EnterEventMode)
REFUSED(fmi3GetFloat32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Float32 values[], size_t nValues)
REFUSED(fmi3GetInt8, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Int8 values[], size_t nValues)
REFUSED(fmi3GetUInt8, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3UInt8 values[], size_t nValues)
REFUSED(fmi3GetInt16, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Int16 values[], size_t nValues)
REFUSED(fmi3GetUInt16, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3UInt16 values[], size_t nValues)
REFUSED(fmi3GetInt32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Int32 values[], size_t nValues)
REFUSED(fmi3GetUInt32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3UInt32 values[], size_t nValues)
REFUSED(fmi3GetInt64, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Int64 values[], size_t nValues)
REFUSED(fmi3GetUInt64, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3UInt64 values[], size_t nValues)
REFUSED(fmi3GetString, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3String values[], size_t nValues)
REFUSED(fmi3GetBinary, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    size_t valueSizes[], fmi3Binary values[], size_t nValues)
REFUSED(fmi3GetClock, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    fmi3Clock values[])
REFUSED(fmi3SetFloat32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Float32 values[], size_t nValues)
REFUSED(fmi3SetInt8, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Int8 values[], size_t nValues)
REFUSED(fmi3SetUInt8, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3UInt8 values[], size_t nValues)
REFUSED(fmi3SetInt16, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Int16 values[], size_t nValues)
REFUSED(fmi3SetUInt16, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3UInt16 values[], size_t nValues)
REFUSED(fmi3SetInt32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Int32 values[], size_t nValues)
REFUSED(fmi3SetUInt32, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3UInt32 values[], size_t nValues)
REFUSED(fmi3SetInt64, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Int64 values[], size_t nValues)
REFUSED(fmi3SetUInt64, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3UInt64 values[], size_t nValues)
REFUSED(fmi3SetString, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3String values[], size_t nValues)
REFUSED(fmi3SetBinary, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const size_t valueSizes[], const fmi3Binary values[], size_t nValues)
REFUSED(fmi3SetClock, const fmi3ValueReference valueReferences[], size_t nValueReferences,
    const fmi3Clock values[])
REFUSED(fmi3GetNumberOfVariableDependencies, fmi3ValueReference valueReference, size_t*
    nDependencies)
REFUSED(fmi3GetVariableDependencies, fmi3ValueReference dependent, size_t
    elementIndicesOfDependent[], fmi3ValueReference independents[], size_t
    elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[], size_t nDependencies)
REFUSED(fmi3GetFMUState, fmi3FMUState* FMUState)
REFUSED(fmi3SetFMUState, fmi3FMUState FMUState)
REFUSED(fmi3FreeFMUState, fmi3FMUState* FMUState)
REFUSED(fmi3SerializedFMUStateSize, fmi3FMUState FMUState, size_t* size)
REFUSED(fmi3SerializeFMUState, fmi3FMUState FMUState, fmi3Byte serializedState[], size_t size)
REFUSED(fmi3DeserializeFMUState, const fmi3Byte serializedState[], size_t size, fmi3FMUState*
    FMUState)
REFUSED(fmi3GetDirectionalDerivative, const fmi3ValueReference unknowns[], size_t nUnknowns,
    const fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
    fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3GetAdjointDerivative, const fmi3ValueReference unknowns[], size_t nUnknowns, const
    fmi3ValueReference knowns[], size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
    fmi3Float64 sensitivity[], size_t nSensitivity)
REFUSED(fmi3EnterConfigurationMode)
REFUSED(fmi3ExitConfigurationMode)
REFUSED(fmi3GetIntervalDecimal, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[])
REFUSED(fmi3GetIntervalFraction, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[], fmi3IntervalQualifier
    qualifiers[])
REFUSED(fmi3GetShiftDecimal, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, fmi3Float64 shifts[])
REFUSED(fmi3GetShiftFraction, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[])
REFUSED(fmi3SetIntervalDecimal, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, const fmi3Float64 intervals[])
REFUSED(fmi3SetIntervalFraction, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3SetShiftDecimal, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, const fmi3Float64 shifts[])
REFUSED(fmi3SetShiftFraction, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[])
REFUSED(fmi3EvaluateDiscreteStates)
REFUSED(fmi3UpdateDiscreteStates, fmi3Boolean* discreteStatesNeedUpdate, fmi3Boolean*
    terminateSimulation, fmi3Boolean* nominalsOfContinuousStatesChanged, fmi3Boolean*
    valuesOfContinuousStatesChanged, fmi3Boolean* nextEventTimeDefined, fmi3Float64*
    nextEventTime)
REFUSED(fmi3EnterContinuousTimeMode)
REFUSED(fmi3CompletedIntegratorStep, fmi3Boolean noSetFMUStatePriorToCurrentPoint,
    fmi3Boolean* enterEventMode, fmi3Boolean* terminateSimulation)
REFUSED(fmi3SetTime, fmi3Float64 time)
REFUSED(fmi3SetContinuousStates, const fmi3Float64 continuousStates[], size_t
    nContinuousStates)
REFUSED(fmi3GetContinuousStateDerivatives, fmi3Float64 derivatives[], size_t
    nContinuousStates)
REFUSED(fmi3GetEventIndicators, fmi3Float64 eventIndicators[], size_t nEventIndicators)
REFUSED(fmi3GetContinuousStates, fmi3Float64 continuousStates[], size_t nContinuousStates)
REFUSED(fmi3GetNominalsOfContinuousStates, fmi3Float64 nominals[], size_t nContinuousStates)
REFUSED(fmi3GetNumberOfEventIndicators, size_t* nEventIndicators)
REFUSED(fmi3GetNumberOfContinuousStates, size_t* nContinuousStates)
REFUSED(fmi3EnterStepMode)
REFUSED(fmi3GetOutputDerivatives, const fmi3ValueReference valueReferences[], size_t
    nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues)
REFUSED(fmi3ActivateModelPartition, fmi3ValueReference clockReference, fmi3Float64
    activationTime)
