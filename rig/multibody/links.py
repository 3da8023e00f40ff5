"""Suspension: springs, dampers, bump-stops, traction rods and anti-roll bars as rows of one table.

[L1] d = c . q, force P - k d on the coordinates, each times its factor
[L2] damper: c v / sqrt(1 + (c v / F_max)^2), v = c . dq/dt
[L3] bump-stop: k_s e (1 + e / e_0) beyond its gap, e = |d| - gap, e_0 = 20 mm

Source: paper Tables 1 to 3 for linear stiffnesses; the curves [L2], [L3] are assumptions.
"""

import math

from rollerrig.rig.kernel import kernel

STOP_BEND_M = 0.02


@kernel
def elongation(i, q, links):
    """d of row i [L1], or its rate if q holds velocities."""
    at, by = links.at, links.by
    return (q[at[i, 0]] * by[i, 0] + q[at[i, 1]] * by[i, 1] + q[at[i, 2]] * by[i, 2]
            + q[at[i, 3]] * by[i, 3] + q[at[i, 4]] * by[i, 4] + q[at[i, 5]] * by[i, 5])


@kernel
def pull(i, f, force, links):
    """Add a row's generalised force f to `force` (42,)."""
    at, by = links.at, links.by
    for k in range(6):
        force[at[i, k]] += f * by[i, k]


@kernel
def springs(q, force, links):
    """Add the linear rows' forces [L1]."""
    for i in range(links.stiffness_N_m.size):
        d = elongation(i, q, links)
        pull(i, links.preload_N[i] - links.stiffness_N_m[i] * d, force, links)


@kernel
def curves(q, v, force, links):
    """Add the nonlinear rows' forces [L1 to L3]; returns the power in W that the dampers take."""
    power = 0.0
    for i in range(links.stiffness_N_m.size):
        rate = elongation(i, v, links)
        wanted = links.damping_N_s_m[i] * rate
        share = wanted / links.damping_max_N[i]
        damper = wanted / math.sqrt(1.0 + share * share)  # [L2]
        f = damper
        if links.stop_N_m[i] > 0.0:
            d = elongation(i, q, links)
            f += links.stiffness_N_m[i] * d
            e = abs(d) - links.stop_gap_m[i]
            if e > 0.0:
                f += math.copysign(links.stop_N_m[i] * e * (1.0 + e / STOP_BEND_M), d)  # [L3]
        power += damper * rate
        pull(i, -f, force, links)
    return power


@kernel
def stored(q, links):
    """Energy in J that springs and stops hold, preload included."""
    energy = 0.0
    for i in range(links.stiffness_N_m.size):
        d = elongation(i, q, links)
        energy += 0.5 * links.stiffness_N_m[i] * d * d - links.preload_N[i] * d
        e = abs(d) - links.stop_gap_m[i]
        if links.stop_N_m[i] > 0.0 and e > 0.0:
            energy += links.stop_N_m[i] * e * e * (0.5 + e / (3.0 * STOP_BEND_M))
    return energy
