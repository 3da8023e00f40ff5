"""The rig of a scenario as an FMU for other simulation tools: FMI 3.0, co-simulation.

rig            a rig with its variables: inputs that are checked, and outputs
description    the description of the FMU as XML
export         writes the FMU: compiles its library, and puts all parts into the archive
server         the process that computes for the library
rig_fmu.c      the library: it starts the process, and translates the calls of FMI into requests
unsupported.c  the functions of FMI 3.0 that the library refuses
"""
