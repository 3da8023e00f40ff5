"""Suspension: springs, dampers, bump-stops, traction rods and anti-roll bars as rows of one table.

[L1] d = c . q, force P - k d on the coordinates, each times its factor
[L2] damper: c v / sqrt(1 + (c v / F_max)^2), v = c . dq/dt
[L3] bump-stop: k_s e (1 + e / e_0) beyond its gap, e = |d| - gap, e_0 = 20 mm

Source: paper Tables 1 to 3 for linear stiffnesses; the curves [L2], [L3] are assumptions.
"""

import math

from rollerrig.rig.compiled.kernel import kernel_inlined

STOP_BEND_M = 0.02
# columns of a row after its six factors
STIFFNESS_N_M, PRELOAD_N, DAMPING_N_S_M, DAMPING_MAX_N, STOP_GAP_M, STOP_N_M = range(6, 12)


@kernel_inlined
def elongation(i, q, links):
    """d of row i [L1], or its rate if q holds velocities."""
    at, by = links.at, links.row
    return (
        q[at[i, 0]] * by[i, 0]
        + q[at[i, 1]] * by[i, 1]
        + q[at[i, 2]] * by[i, 2]
        + q[at[i, 3]] * by[i, 3]
        + q[at[i, 4]] * by[i, 4]
        + q[at[i, 5]] * by[i, 5]
    )


@kernel_inlined
def pull(i, f, force, links):
    """Add a row's generalised force f to `force` (42,)."""
    at, by = links.at, links.row
    for k in range(6):
        force[at[i, k]] += f * by[i, k]


@kernel_inlined
def springs(q, force, links):
    """Add the linear rows' forces [L1]."""
    row = links.row
    for i in range(row.shape[0]):
        d = elongation(i, q, links)
        pull(i, row[i, PRELOAD_N] - row[i, STIFFNESS_N_M] * d, force, links)


@kernel_inlined
def curves(q, v, force, links):
    """Add the nonlinear rows' forces [L1 to L3]; returns the power in W that the dampers take."""
    power = 0.0
    row = links.row
    for i in range(row.shape[0]):
        rate = elongation(i, v, links)
        wanted = row[i, DAMPING_N_S_M] * rate
        share = wanted / row[i, DAMPING_MAX_N]
        damper = wanted / math.sqrt(1.0 + share * share)  # [L2]
        f = damper
        if row[i, STOP_N_M] > 0.0:
            d = elongation(i, q, links)
            f += row[i, STIFFNESS_N_M] * d
            e = abs(d) - row[i, STOP_GAP_M]
            if e > 0.0:
                f += math.copysign(row[i, STOP_N_M] * e * (1.0 + e / STOP_BEND_M), d)  # [L3]
        power += damper * rate
        pull(i, -f, force, links)
    return power
