"""A coach on a track in batch: a number of steps under constant brakes, as fast as possible.

It does what the bench does tick by tick, without valves, cylinders and bus: for benchmarks of the
contact models, for tests and for hunting.
"""

import numpy as np

from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig.compiled.kernel import kernel_with_memory
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.multibody import coach_state, motion
from rollerrig.rig.multibody.coach import Coach

STEP_S = 1e-4
# on a track there are no rollers; their inertia has no effect
_ROLLER_INERTIA_KGM2 = 1.0


def rolling(coach: Coach, speed_m_s: float) -> coach_state.Motion:
    """Return a coach in equilibrium that rolls freely at a speed in m/s."""
    state = coach_state.views(np.zeros(coach_state.SIZE))
    motion.start(state, coach, float(speed_m_s))
    return state


@kernel_with_memory
def _steps(
    state,
    coach,
    count,
    step_s,
    roller_rad_s,
    brake_Nm,
    acts_Nm,
    resistance_A_N,
    resistance_C_N_s2_m2,
    mu_cd,
    mu_cr,
    law,
    end_m_s,
):
    """Advance by `count` steps or to end_m_s; return the number of steps. Arrays are (4,)."""
    for i in range(count):
        speed = motion.mean_speed(state.v, coach)
        if speed < end_m_s:
            return i
        resistance_N = resistance_A_N + resistance_C_N_s2_m2 * speed * speed
        motion.step(
            state,
            coach,
            step_s,
            roller_rad_s,
            0.0 * roller_rad_s,  # torque of the roller motors
            _ROLLER_INERTIA_KGM2,
            brake_Nm,
            acts_Nm,
            resistance_N,
            mu_cd,
            mu_cr,
            law,
        )
    return count


def advance(
    state: coach_state.Motion,
    coach: Coach,
    law: Law,
    duration_s: float,
    brake_Nm: float | np.ndarray = 0.0,
    step_s: float = STEP_S,
    resistance: tuple[float, float] = (0.0, 0.0),
    end_m_s: float = -np.inf,
) -> float:
    """Advance by a duration, or to the speed end_m_s; return the time in s.

    brake_Nm is the torque of each wheelset, or one for all; resistance is (A in N, C in N s2/m2).
    """
    count = _steps(
        state,
        coach,
        round(duration_s / step_s),
        step_s,
        np.zeros(COACH_AXLES),
        np.broadcast_to(np.asarray(brake_Nm, dtype=float), COACH_AXLES).copy(),
        np.zeros(COACH_AXLES),
        float(resistance[0]),
        float(resistance[1]),
        np.full(COACH_AXLES, law.mu_cd),
        np.full(COACH_AXLES, law.mu_cr),
        law,
        float(end_m_s),
    )
    return count * step_s
