"""The 42 coordinates of the coach: seven bodies, each with three displacements and three rotations.

Coordinates are displacements from the nominal place in m and small rotations in rad (linear
kinematics, no geometric stiffness of preloaded springs). A wheelset's pitch coordinate is the angle
it has turned.
"""

# bodies
CAR = 0
BOGIES = (1, 2)
WHEELSETS = (3, 4, 5, 6)
BODIES = 7
FIRST_WHEELSET = 3

# coordinates of a body; the first coordinate of a body is PER_BODY times its number
X, Y, Z, ROLL, PITCH, YAW = range(6)
PER_BODY = 6
COORDINATES = BODIES * PER_BODY
# all wheelsets come after all other bodies
BEFORE_WHEELSETS = PER_BODY * FIRST_WHEELSET
