"""The UIC-Z1 coach in three dimensions.

Signs: x forwards, y to the left, z up; roll, pitch and yaw about them (pitch positive nose down), so
a rolling wheelset turns with a positive pitch rate. Bodies: 0 car, 1 and 2 bogies, 3 to 6 wheelsets.

Reading order: `coach` (bodies, degrees of freedom, links), `links` (suspension), `wheel_rail_forces` (contacts),
`eight_contacts` (their creep forces at once), `motion` (a time step), `stability` (modes, hunting), `stop` (a whole
stop in batch); `coach_state` and `compiled_coach` (state, and the coach behind one address), `on_rig` (the coach as the
plant's vehicle). Its numbers are the section [multibody] of `rig/parameters.toml`.
"""
