"""A unit with its own plain CAN messages: a DBC file and a mapping connect it to the rig.

mapping   reads a mapping and its DBC, and refuses what cannot work
fields    values of the unit's messages: limited to their range, counters, checksums, constants
gateway   translates between the unit and the rig while a bench runs

An FMU has the same mapping without messages.
"""
