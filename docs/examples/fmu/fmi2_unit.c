/* The functions of FMI 2.0 for co-simulation around the unit of unit.c.

   The value references of modelDescription.xml are 0 to 3 for the wheel speeds, 4 to 7 for the hold
   magnets, 8 to 11 for the vent magnets, and 12 for the reference speed. */

#include <stdlib.h>

#include "fmi2Functions.h"
#include "unit.h"

enum { HOLD = AXLES, VENT = 2 * AXLES, REFERENCE_SPEED = 3 * AXLES };

/* --- begin and end --- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid, fmi2String resources,
                              const fmi2CallbackFunctions *callbacks, fmi2Boolean visible,
                              fmi2Boolean logging)
{
    Unit *unit = type == fmi2CoSimulation ? malloc(sizeof *unit) : NULL;
    if (unit)
        unit_start(unit);
    return unit;
}

void fmi2FreeInstance(fmi2Component c) { free(c); }

fmi2Status fmi2Reset(fmi2Component c)
{
    unit_start(c);
    return fmi2OK;
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance, fmi2Real tolerance,
                               fmi2Real start_s, fmi2Boolean has_end, fmi2Real end_s)
{
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return fmi2OK; }
fmi2Status fmi2Terminate(fmi2Component c) { return fmi2OK; }

/* --- a cycle: the rig sets the inputs, calls fmi2DoStep, and gets the outputs --- */

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                       const fmi2Real value[])
{
    Unit *unit = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= AXLES)
            return fmi2Error;
        unit->wheel_speed_rad_s[vr[i]] = value[i];
    }
    return fmi2OK;
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time_s, fmi2Real cycle_s, fmi2Boolean no_set_state)
{
    unit_cycle(c, cycle_s);
    return fmi2OK;
}

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t n, fmi2Real value[])
{
    const Unit *unit = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] < AXLES)
            value[i] = unit->wheel_speed_rad_s[vr[i]];
        else if (vr[i] == REFERENCE_SPEED)
            value[i] = unit->reference_speed_m_s;
        else
            return fmi2Error;
    }
    return fmi2OK;
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t n,
                          fmi2Boolean value[])
{
    const Unit *unit = c;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= HOLD && vr[i] < VENT)
            value[i] = unit->hold[vr[i] - HOLD];
        else if (vr[i] >= VENT && vr[i] < REFERENCE_SPEED)
            value[i] = unit->vent[vr[i] - VENT];
        else
            return fmi2Error;
    }
    return fmi2OK;
}

/* --- what the standard wants to be there, and this unit does not have --- */

#define WITHOUT(NAME, ...) \
    fmi2Status NAME(fmi2Component c, __VA_ARGS__) { return fmi2Error; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n, const fmi2String names[])
{
    return fmi2OK;
}
fmi2Status fmi2CancelStep(fmi2Component c) { return fmi2Error; }

WITHOUT(fmi2GetInteger, const fmi2ValueReference vr[], size_t n, fmi2Integer value[])
WITHOUT(fmi2GetString, const fmi2ValueReference vr[], size_t n, fmi2String value[])
WITHOUT(fmi2SetInteger, const fmi2ValueReference vr[], size_t n, const fmi2Integer value[])
WITHOUT(fmi2SetBoolean, const fmi2ValueReference vr[], size_t n, const fmi2Boolean value[])
WITHOUT(fmi2SetString, const fmi2ValueReference vr[], size_t n, const fmi2String value[])

WITHOUT(fmi2GetFMUstate, fmi2FMUstate *state)
WITHOUT(fmi2SetFMUstate, fmi2FMUstate state)
WITHOUT(fmi2FreeFMUstate, fmi2FMUstate *state)
WITHOUT(fmi2SerializedFMUstateSize, fmi2FMUstate state, size_t *size)
WITHOUT(fmi2SerializeFMUstate, fmi2FMUstate state, fmi2Byte bytes[], size_t size)
WITHOUT(fmi2DeSerializeFMUstate, const fmi2Byte bytes[], size_t size, fmi2FMUstate *state)

WITHOUT(fmi2GetDirectionalDerivative, const fmi2ValueReference unknown[], size_t n,
        const fmi2ValueReference known[], size_t m, const fmi2Real change[], fmi2Real result[])
WITHOUT(fmi2SetRealInputDerivatives, const fmi2ValueReference vr[], size_t n,
        const fmi2Integer order[], const fmi2Real value[])
WITHOUT(fmi2GetRealOutputDerivatives, const fmi2ValueReference vr[], size_t n,
        const fmi2Integer order[], fmi2Real value[])

WITHOUT(fmi2GetStatus, const fmi2StatusKind kind, fmi2Status *value)
WITHOUT(fmi2GetRealStatus, const fmi2StatusKind kind, fmi2Real *value)
WITHOUT(fmi2GetIntegerStatus, const fmi2StatusKind kind, fmi2Integer *value)
WITHOUT(fmi2GetBooleanStatus, const fmi2StatusKind kind, fmi2Boolean *value)
WITHOUT(fmi2GetStringStatus, const fmi2StatusKind kind, fmi2String *value)
