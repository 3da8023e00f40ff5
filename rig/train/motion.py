"""The motion of a train: a step of all cars together with the couplers between them.

Each car takes its step as a vehicle alone does (`plant.step`), with the force of its couplers
added [R1]. A coupler's force is constant within a step. It follows from a linearly implicit
midpoint rule, so a coupler may be as stiff as it likes [R2]. A rigid coupler gives both cars the
same acceleration at both stages of the step [R3]. All couplers of a train together are a
tridiagonal system, which is solved once for each stage. Each force acts on two cars with opposite
signs, so couplers change no momentum.

    [R1] M_i dv_i/dt = -T_i - F_i + F_(i-1), T_i contacts, resistance and magnets of car i, F_i the
         tension behind it
    [R2] F = F(x, w) + k h / 2 w + (k h^2 / 4 + c h / 2) dw/dt, w = v_i - v_(i+1), k and c the
         slopes of the force by x and w
    [R3] dw/dt = 0
    [R4] work that a coupler takes in: F h (w before + w after) / 2

No car rolls backwards. The cars of a train come to rest together, when the fastest hardly moves.
"""

from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from rollerrig.rig import dynamic_brake, plant, track_brake, vehicle, wheelset
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.record_type import part_of
from rollerrig.rig.compiled.state_type import rig_of
from rollerrig.rig.params import Params
from rollerrig.rig.state import MOST_LANES, State
from rollerrig.rig.train import coupler


class Car(NamedTuple):
    """A car: its place in a buffer of rigs, and its constants."""

    state: State
    params: Params


class Motion(NamedTuple):
    """What the couplers remember, and the memory of a step. Shapes: (couplers,) or (cars,)."""

    displacement_m: np.ndarray  # (couplers,), positive: stretched
    force_N: np.ndarray  # (couplers,), tension positive, mean of the last step
    work_J: np.ndarray  # (couplers,), taken in so far [R4]
    diagonal: np.ndarray  # (couplers,), of the system, as the next three
    lower: np.ndarray
    upper: np.ndarray
    right: np.ndarray
    retarding_N: np.ndarray  # (cars,), T of [R1]
    before_m_s: np.ndarray  # (cars,), speed at the beginning of the step


record_type.register(Car)
record_type.register(Motion)


def begin(cars: int) -> Motion:
    """Return the couplers of a train of so many cars, without displacement."""
    of_cars = ("retarding_N", "before_m_s")
    sizes = {name: cars if name in of_cars else cars - 1 for name in Motion._fields}
    return Motion(**{name: np.zeros(size) for name, size in sizes.items()})


def groups(axles: list[int], alone: Collection[int] = ()) -> np.ndarray:
    """Return the groups of cars that share a buffer, int64 (groups, 2): first car, and number.

    `axles` are those of each car. Cars of a group follow one another and have the same number of
    axles, and a buffer has room for all of them. The cars `alone`, counted from 0, share no buffer.
    """
    found: list[list[int]] = []
    for car, count in enumerate(axles):
        has_room = found and axles[found[-1][0]] == count
        shares = car - 1 not in alone and car not in alone
        if shares and has_room and (found[-1][1] + 1) * count <= MOST_LANES:
            found[-1][1] += 1
        else:
            found.append([car, 1])
    return np.array(found, dtype=np.int64)


@kernel
def of_group(cars, group):
    """Return the state of all cars of a group [first car, number]."""
    first = cars[group[0]]
    return rig_of(first.state, 0, first.params.axles * group[1])


@kernel
def step(cars, groups, couplers, motion):
    """Advance a train by one step of the physics.

    Parameters
    ----------
    cars : table of `Car` from the front to the rear
    groups : int64 (groups, 2), of `groups`
    couplers : `coupler.Couplers`
    motion : `Motion`
    """
    moving = 0
    for g in range(len(groups)):
        plants = part_of(cars, groups[g, 0], groups[g, 1]).params
        moving += plant.brake_and_drive(of_group(cars, groups[g]), plants)
    if moving == 0:
        return
    for g in range(len(groups)):
        plants = part_of(cars, groups[g, 0], groups[g, 1]).params
        wheelset.to_first_stage(of_group(cars, groups[g]), plants)
    couple(cars, couplers, motion, 0)
    for i in range(len(cars)):
        wheelset.predict(cars[i].state, cars[i].params)
    for g in range(len(groups)):
        plants = part_of(cars, groups[g, 0], groups[g, 1]).params
        wheelset.to_second_stage(of_group(cars, groups[g]), plants)
    couple(cars, couplers, motion, 1)
    for i in range(len(cars)):
        wheelset.move(cars[i].state, cars[i].params)
    stretch(cars, motion)
    settle(cars)


@kernel
def couple(cars, couplers, motion, stage):
    """Solve for the force of each coupler at a stage (0 or 1), and let it act on the cars."""
    for i in range(len(cars)):
        state = cars[i].state
        if stage == 0:
            motion.before_m_s[i] = state.vehicle_speed[0]
        # at the second stage the predicted speed is that of all axles
        v = state.vehicle_speed[0] if stage == 0 else state.stage_vehicle_speed[0]
        motion.retarding_N[i] = retarding(state, v, cars[i].params)
    h = cars[0].params.step_s
    for i in range(motion.force_N.size):
        set_row(cars, couplers, motion, i, h, stage)
    solve(motion)
    for i in range(len(cars)):
        behind_N = motion.force_N[i] if i < motion.force_N.size else 0.0
        ahead_N = motion.force_N[i - 1] if i > 0 else 0.0
        cars[i].state.coupler_force[0] = behind_N - ahead_N  # [R1]


@kernel
def retarding(state, speed_m_s, params):
    """Return the force in N that holds a car back without its couplers, T of [R1]."""
    total_N = vehicle.resistance(speed_m_s, params.vehicle)
    total_N += track_brake.force_N(state, speed_m_s, params.track_brake)
    for j in range(state.axles):
        total_N += state.stage_force[j]
    return total_N


@kernel
def set_row(cars, couplers, motion, i, step_s, stage):
    """Set the row of coupler i in the system of all forces."""
    per_ahead = 1.0 / cars[i].params.vehicle.mass_kg
    per_behind = 1.0 / cars[i + 1].params.vehicle.mass_kg
    # dw/dt without couplers
    free_m_s2 = motion.retarding_N[i + 1] * per_behind - motion.retarding_N[i] * per_ahead
    if couplers.rigid[i] != 0.0:
        motion.diagonal[i] = per_ahead + per_behind  # [R3]
        motion.lower[i] = -per_ahead
        motion.upper[i] = -per_behind
        motion.right[i] = free_m_s2
        return
    compliance = 0.0
    F = motion.force_N[i]
    if stage == 0:
        w = motion.before_m_s[i] - motion.before_m_s[i + 1]
        F, k, c = coupler.force(motion.displacement_m[i], w, couplers, i)
        F += 0.5 * k * step_s * w
        compliance = 0.25 * k * step_s * step_s + 0.5 * c * step_s  # [R2]
    motion.diagonal[i] = 1.0 + compliance * (per_ahead + per_behind)
    motion.lower[i] = -compliance * per_ahead
    motion.upper[i] = -compliance * per_behind
    motion.right[i] = F + compliance * free_m_s2


@kernel
def solve(motion):
    """Solve the tridiagonal system for the forces of all couplers (Thomas)."""
    count = motion.force_N.size
    for i in range(1, count):
        ratio = motion.lower[i] / motion.diagonal[i - 1]
        motion.diagonal[i] -= ratio * motion.upper[i - 1]
        motion.right[i] -= ratio * motion.right[i - 1]
    following_N = 0.0
    for i in range(count - 1, -1, -1):
        following_N = (motion.right[i] - motion.upper[i] * following_N) / motion.diagonal[i]
        motion.force_N[i] = following_N


@kernel
def stretch(cars, motion):
    """Advance the displacement and the work of each coupler by a step."""
    h = cars[0].params.step_s
    for i in range(motion.force_N.size):
        before = motion.before_m_s[i] - motion.before_m_s[i + 1]
        after = cars[i].state.vehicle_speed[0] - cars[i + 1].state.vehicle_speed[0]
        way_m = 0.5 * h * (before + after)
        motion.displacement_m[i] += way_m
        motion.work_J[i] += motion.force_N[i] * way_m  # [R4]


@kernel
def settle(cars):
    """Bring a train that hardly moves to rest."""
    fastest = 0.0
    for i in range(len(cars)):
        fastest = max(fastest, cars[i].state.vehicle_speed[0])
    if fastest >= vehicle.STANDING_M_S:
        return
    for i in range(len(cars)):
        vehicle.settle(cars[i].state)
        dynamic_brake.settle(cars[i].state)
