"""The border of the rig: what an outside unit or harness relies on.

Reading order:

    signals, magnets, events     tables: every signal, the byte of the magnets, every event
    bus                          CAN: frames, hub, kernel interfaces, python-can plugin
    rig_objects                  frames and objects that rig, unit and harness share
    descriptions                 EDS, DBC and the table of signals as files
    unit_map                     units with their own CAN messages, by a DBC and a mapping
    harness_client, own_bench    a test harness on the bus; a bench for a test
    sequences                    scripted tests: steps, conditions, measures, verdicts
    harness, fixture, robot      the harness for tests in Python, pytest and Robot Framework
"""
