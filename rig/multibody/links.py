"""Suspension: springs, dampers, bump-stops, traction rods and anti-roll bars as rows of one table.

[L1] d = c . q, force P - k d on the coordinates, each times its factor
[L2] damper: c v / sqrt(1 + (c v / F_max)^2), v = c . dq/dt
[L3] bump-stop: k_s e (1 + e / e_0) beyond its gap, e = |d| - gap, e_0 = 20 mm

Source: paper Tables 1 to 3 for linear stiffnesses; the curves [L2], [L3] are assumptions.
"""

import math

from rollerrig.rig.compiled.kernel import kernel_inlined

STOP_BEND_M = 0.02  # e_0 of [L3]
# columns of a row after its six factors
STIFFNESS_N_M, PRELOAD_N, DAMPING_N_S_M, DAMPING_MAX_N, STOP_GAP_M, STOP_N_M = range(6, 12)


@kernel_inlined
def elongation(i, q, links):
    """Return d of row i [L1], or its rate if q holds velocities."""
    at = links.at
    factor = links.row
    return (
        q[at[i, 0]] * factor[i, 0]
        + q[at[i, 1]] * factor[i, 1]
        + q[at[i, 2]] * factor[i, 2]
        + q[at[i, 3]] * factor[i, 3]
        + q[at[i, 4]] * factor[i, 4]
        + q[at[i, 5]] * factor[i, 5]
    )


@kernel_inlined
def pull(i, f, force, links):
    """Add the generalised force f of row i to `force` (42,)."""
    at = links.at
    factor = links.row
    for k in range(6):
        force[at[i, k]] += f * factor[i, k]


@kernel_inlined
def springs(q, force, links):
    """Add the forces of the linear rows [L1]."""
    row = links.row
    for i in range(row.shape[0]):
        d = elongation(i, q, links)
        pull(i, row[i, PRELOAD_N] - row[i, STIFFNESS_N_M] * d, force, links)


@kernel_inlined
def curves(q, v, force, links):
    """Add the forces of the nonlinear rows [L1 to L3]; return the power of the dampers in W."""
    power_W = 0.0
    row = links.row
    for i in range(row.shape[0]):
        rate = elongation(i, v, links)
        unlimited = row[i, DAMPING_N_S_M] * rate
        share = unlimited / row[i, DAMPING_MAX_N]
        damper = unlimited / math.sqrt(1.0 + share * share)  # [L2]
        f = damper
        # only rows with a bump-stop have a stiffness
        if row[i, STOP_N_M] > 0.0:
            d = elongation(i, q, links)
            f += row[i, STIFFNESS_N_M] * d
            e = abs(d) - row[i, STOP_GAP_M]
            if e > 0.0:
                f += math.copysign(row[i, STOP_N_M] * e * (1.0 + e / STOP_BEND_M), d)  # [L3]
        power_W += damper * rate
        pull(i, -f, force, links)
    return power_W
