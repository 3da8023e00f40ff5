"""The UIC-Z1 coach in three dimensions.

Signs: x forwards, y to the left, z up; roll, pitch and yaw about them (pitch positive nose down),
so a rolling wheelset turns with a positive pitch rate. Bodies: 0 car, 1 and 2 bogies, 3 to 6
wheelsets.

Reading order:

    coordinates        bodies and their coordinates
    coach              masses, inertias and links
    links              suspension
    wheel_rail_forces  contacts of the wheels
    eight_contacts     creep forces of the contacts, eight simultaneously
    motion             a time step
    coach_state        the state in one buffer
    compiled_coach     the coach behind three addresses
    on_rig             the coach as the vehicle of the plant
    stop, stability    a whole stop in batch; modes and hunting

The numbers are in the section [multibody] of `rig/parameters.toml`.
"""
