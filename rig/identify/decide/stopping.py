"""Translates what a cause changes into metres of stopping distance of the vehicle.

    [M1] d = v^2 / (2 a),  d' = d a / a'

d is the distance of a stop from speed v at the mean deceleration a of the runs, a and a' are those
that base and extended model give to the same runs. A friction cause changes what wheels and rail
transmit while they slide as in the runs. A cause of brake or vehicle changes the forces themselves.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.causes import columns
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.causes.courses import vehicle_samples
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import gain
from rollerrig.rig.identify.decide.thresholds import SLOWEST_M_S
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, TORQUE, VEHICLE
from rollerrig.rig.mechanisms.table import BY_NAME

LEAST_DECELERATION_M_S2 = 0.05
# along what a force on the vehicle may remain, as `columns` names it
TIME = "along vehicle time"
SPEED = "along vehicle speed"


class StoppingDistance(NamedTuple):
    """The distance of a stop from one speed, by base and extended model."""

    from_m_s: float
    base_m: float
    extended_m: float

    @property
    def longer_m(self) -> float:
        """How much longer the stop is than the base predicts; negative: shorter."""
        return self.extended_m - self.base_m


def costs(design: Design, base: Explanation, extended: Explanation) -> StoppingDistance | None:
    """Return the stopping distances of base and extended model, from the fastest initial speed.

    None where no cause acts on a force (a late sensor costs no metres), or where drives held the
    speed.
    """
    acts_on = {BY_NAME[cause.name].acts_on for cause in extended.causes}
    acting = acts_on & {FRICTION, CONTACT, TORQUE, VEHICLE}
    held = not np.all(np.isfinite(design.mass_kg))
    if held or not acting:
        return None

    share = 1.0
    if acting & {FRICTION, CONTACT}:
        of_causes = [c for c in extended.causes if BY_NAME[c.name].acts_on in (FRICTION, CONTACT)]
        of_friction = extended._replace(causes=tuple(of_causes))
        without = of_friction._replace(causes=())
        share *= _transmitted_N(design, of_friction) / _transmitted_N(design, without)
    if acting & {TORQUE, VEHICLE}:
        of_causes = [c for c in extended.causes if BY_NAME[c.name].acts_on in (TORQUE, VEHICLE)]
        of_forces = extended._replace(causes=tuple(of_causes))
        without = of_forces._replace(causes=())
        share *= _braking_m_s2(design, of_forces) / _braking_m_s2(design, without)

    from_m_s, deceleration_m_s2 = _fastest_stop(design)
    if deceleration_m_s2 < LEAST_DECELERATION_M_S2 or not share > 0.0:
        return None
    # the base expects the deceleration without the causes; the runs have it with them
    extended_m = from_m_s**2 / (2.0 * deceleration_m_s2)
    return StoppingDistance(from_m_s, extended_m * share, extended_m)


def _fastest_stop(design: Design) -> tuple[float, float]:
    """Return initial speed and mean deceleration of the run that begins fastest."""
    starts = [float(design.vehicle_m_s[design.vehicle_span(r)][:20].mean()) for r in _runs(design)]
    run = int(np.argmax(starts))
    speed_m_s = design.vehicle_m_s[design.vehicle_span(run)]
    moving_s = np.count_nonzero(speed_m_s > SLOWEST_M_S) * design.step_s
    end_m_s = max(float(speed_m_s[-20:].mean()), SLOWEST_M_S)
    return starts[run], (starts[run] - end_m_s) / max(moving_s, design.step_s)


def _runs(design: Design) -> range:
    return range(design.mass_kg.size)


def _transmitted_N(design: Design, explanation: Explanation) -> float:
    """Return the mean force between a wheelset and the rail by the adhesion law."""
    _, model, _ = gain.adhesion(design, explanation)
    counts = design.speed_m_s > SLOWEST_M_S
    return float(np.mean((model * design.load_N)[counts]))


def _braking_m_s2(design: Design, explanation: Explanation) -> float:
    """Return the mean deceleration by torques and resistance."""
    replay_inputs = inputs(design, explanation)
    forces = [sensitivity.vehicle_force(design, replay_inputs, run) for run in _runs(design)]
    fast = []
    for run in _runs(design):
        fast.append(design.speed_m_s[design.span(run * design.axles)] > SLOWEST_M_S)
    chosen = [force[counts] for force, counts in zip(forces, fast, strict=True)]
    return float(np.concatenate(chosen).mean())


def torque_share(design: Design, explanation: Explanation, place: int) -> float:
    """Return how much cause number `place` changes the torque, as a share of it (rms)."""
    causes = explanation.causes
    without = explanation._replace(causes=(*causes[:place], *causes[place + 1 :]))
    change_Nm = inputs(design, explanation).torque_Nm - inputs(design, without).torque_Nm
    return float(np.sqrt(np.mean(change_Nm**2) / np.mean(design.torque_Nm**2)))


def remaining_force_share(design: Design, along: str, coefficients: Sequence[float]) -> float:
    """Return a remaining force on the vehicle as a share of the braking force (rms).

    `along` is TIME or SPEED, `coefficients` are those of the bumps in m/s2. What is in proportion
    to the braking force of a run is left out: the scales of torque and mass take it up.
    """
    covariate = {TIME: design.time_s, SPEED: design.speed_m_s}[along]
    bumps = columns.bumps(vehicle_samples(design, covariate), len(coefficients))
    force_N = np.asarray(coefficients) @ bumps * columns.vehicle_mass(design)
    braking_N = _braking_N(design)
    for run in _runs(design):
        at = design.vehicle_span(run)
        gain_of_run = force_N[at] @ braking_N[at] / (braking_N[at] @ braking_N[at])
        force_N[at] -= gain_of_run * braking_N[at]
    return float(np.sqrt(np.mean(force_N**2) / np.mean(braking_N**2)))


def _braking_N(design: Design) -> np.ndarray:
    """Return the force of all brakes, shape (vehicle samples,)."""
    torque_Nm = columns.sum_of_wheelsets(design, design.torque_Nm)
    return torque_Nm / design.base[parameters.RADIUS]
