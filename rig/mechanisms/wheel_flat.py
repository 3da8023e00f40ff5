"""Wheel flats: the length of a flat by the sliding of a locked wheel, and the load when it passes.

[F1] the flat is a segment of the wheel's circle: depth L^2 / (8 r), volume w L^3 / (12 r) = k E,
     E the work of one lock
[F2] N = N_0 (1 + A sin(2 pi x / L)) while it passes, x: way from its middle. The load decreases as
     the wheel falls in, then follows a blow; the mean load of a turn does not change; A = a L, not
     above 1

Source: [F1] geometry, with a wear volume in proportion to the work (Archard 1953); k: assumption,
to be fitted to measured flats (Jergeus and others 1999 made full-scale ones). [F2] form:
assumption. Each lock makes a separate flat; the longest counts. A flat does not wear round again.
"""

import math

from rollerrig.rig.compiled.kernel import kernel


@kernel
def length_m(work_J, wear_m3_J, width_m, radius_m):
    """Return the length in m of the flat that a lock makes by its work on one wheel [F1]."""
    return math.pow(12.0 * radius_m * wear_m3_J * work_J / width_m, 1.0 / 3.0)


@kernel
def load_share(turned_rad, length_m, radius_m, load_1_m):
    """Return N / N_0 of a wheel; at turned_rad = 0 the middle of its flat is below [F2]."""
    if length_m == 0.0:
        return 1.0
    turns = math.floor(turned_rad / (2.0 * math.pi) + 0.5)
    x = radius_m * (turned_rad - 2.0 * math.pi * turns)
    if abs(x) >= 0.5 * length_m:
        return 1.0
    return 1.0 + min(load_1_m * length_m, 1.0) * math.sin(2.0 * math.pi * x / length_m)
