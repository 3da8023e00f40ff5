"""The end of a tick of a rig that stays in its lanes: heat, locks, air.

Between two samples or two cycles of its unit nothing acts on a rig except its rig control. Such a
tick does in the lanes what `heat.advance`, `plant.watch_lock` and the count of the air do for a
state, by the same formulas.
"""

from rollerrig.rig import heat, wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.lanes import layout as row


@kernel
def end(w, first, axles):
    """Do what follows the physics of a tick of a rig: heat [H1], [H2], locks, air [B3].

    `first` is its first lane.
    """
    w[row.AIR_SUM_NL + first] = row.air_NL(w, first, axles)
    for j in range(first, first + axles):
        w[row.AIR_NL + j] = 0.0
        work_J = w[row.BRAKE_WORK + j]
        w[row.DISC_K + j] = heat.disc_K(
            w[row.DISC_K + j],
            work_J - w[row.HEATED_J + j],
            w[row.AIR_K + j],
            w[row.DISC_J_K + j],
            w[row.DISC_SHARE + j],
        )
        w[row.HEATED_J + j] = work_J
        w[row.MOTOR_K + j] = heat.motor_K(
            w[row.MOTOR_K + j],
            w[row.MOTOR + j],
            w[row.AIR_K + j],
            w[row.RATED_NM + j],
            w[row.MOTOR_RISE_K + j],
            w[row.MOTOR_HEAT_SHARE + j],
        )
        w[row.LOCKED_S + j], w[row.LONGEST_S + j] = wheelset.lock_s(
            w[row.LOCKED_S + j],
            w[row.LONGEST_S + j],
            w[row.WHEEL_M + j] * w[row.WHEEL + j],
            w[row.V + j],
            w[row.LOCK_ABOVE + j],
            w[row.TICK + j],
        )
