"""The physics of the rig, and the explanation of measured data. No clock, no bus.

Signs, for the whole package: sliding s = v - r omega, positive in braking; creepage e = s / v. The
contact force T >= 0 in braking drives the wheel on and holds the vehicle (or the roller) back:
J domega/dt = r T - C with C > 0 braking, M dv/dt = -sum T - resistance. Contact quantities are for
one wheel; a wheelset has two equal contacts.

Reading order: `compiled`, `params`, `state`, `contact`, `brake`, `motor`, `wheelset`, `vehicle`,
`plant`.
"""
