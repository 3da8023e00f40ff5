"""The rail under a train: the work of all wheels so far on each metre, and the sand on it.

The rail is a row of cells that travels with the train. A wheelset that enters a cell meets the work
of all wheelsets before, of its own car and of the cars ahead [L1]. It leaves its own work when it
leaves the cell. Between two wheelsets the film comes back [L2]. What the work does to the friction
is the mechanism `rail_cleaning` of each car.

    [L1] W of a cell = sum of the specific work of the wheelsets that have passed, W_sp of [A3] in
         `contact.adhesion`, J/m of one wheel
    [L2] dW/dt = -W / T_recovery

Sand lies in the cells of the car above it, as for a vehicle alone (`surface`). What its last
wheelset leaves there lies on the rail of the train, until the next car has it below its front [L3].

    [L3] sand of a cell: of car n while it is above the cell, else of the rail

Doubt: [L2] is an assumption; the work of a wheel cleans the rail in the same form as it cleans the
wheel's contact.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.state import CELLS
from rollerrig.rig.surface import CELL_M, cell_at
from rollerrig.rig.train.motion import Car

# cells ahead of the first and behind the last wheelset, for couplers that stretch
_SPARE = 64


class Rail(NamedTuple):
    """The rail from the first to the last wheelset of a train."""

    acts: bool  # whether a car has the mechanism
    recovery_1_s: float  # 1 / T_recovery; 0: the film does not come back
    work_J_m: np.ndarray  # (cells,): a ring, cell n at n modulo its size
    written_s: np.ndarray  # (cells,): when the work was written last
    front: np.ndarray  # (1,): number of the foremost cell
    cell: np.ndarray  # (cars, MOST_AXLES): the cell under each wheelset
    own_J: np.ndarray  # (cars, MOST_AXLES): work of each wheelset in its cell so far
    laid_J: np.ndarray  # (1,): work laid on the rail so far
    has_sand: bool  # whether a car has sanders
    sand_kg: np.ndarray  # (cells,): sand between the cars, and behind the last one
    sand_front: np.ndarray  # (cars,): the foremost cell that each car has taken over
    sand_rear: np.ndarray  # (cars,): the cell under its last wheelset
    sand_left_kg: np.ndarray  # (1,): sand that the train has left behind


record_type.register(Rail)


def build(cars: Sequence[Car], acts: bool, recovery_s: float) -> Rail:
    """Return the rail, dirty, under cars at their places; recovery_s 0: the film stays away."""
    first_m = float(cars[0].state.position[0])
    last = cars[-1]
    last_m = float(last.state.position[0] - last.params.axle_position_m[-1])
    cell = np.zeros((len(cars), MOST_AXLES))
    for number, car in enumerate(cars):
        car.state.has_train_rail[0] = 1.0
        for axle, behind_m in enumerate(car.params.axle_position_m):
            cell[number, axle] = cell_at(car.state.position[0] - behind_m)
    cells = math.ceil((first_m - last_m) / CELL_M) + _SPARE
    rears = [cell[number, len(car.params.axle_position_m) - 1] for number, car in enumerate(cars)]
    return Rail(
        acts=acts,
        recovery_1_s=1.0 / recovery_s if recovery_s > 0.0 else 0.0,
        work_J_m=np.zeros(cells),
        written_s=np.zeros(cells),
        front=np.array([float(cell_at(first_m))]),
        cell=cell,
        own_J=np.zeros((len(cars), MOST_AXLES)),
        laid_J=np.zeros(1),
        has_sand=any(car.params.sanders.axles != 0 for car in cars),
        sand_kg=np.zeros(cells),
        sand_front=np.array([float(car.state.rail_front[0]) for car in cars]),
        sand_rear=np.array(rears),
        sand_left_kg=np.zeros(1),
    )


@kernel
def left_J_m(rail, cell, time_s):
    """Return the work on a cell that the film has not yet covered again [L2]."""
    at = int(cell) % rail.work_J_m.size
    work_J_m = rail.work_J_m[at]
    if rail.recovery_1_s > 0.0 and work_J_m > 0.0:
        work_J_m *= math.exp(-rail.recovery_1_s * (time_s - rail.written_s[at]))
    return work_J_m


@kernel
def roll(rail, cars, tick_s):
    """Let all wheelsets roll for a tick: they lay their work, and meet that of the others [L1].

    `cars` is a table of `motion.Car`, whose specific work is that of the tick before.
    """
    for number in range(len(cars)):
        state = cars[number].state
        way_m = tick_s * state.vehicle_speed[0]
        time_s = state.time[0]
        for j in range(state.axles):
            rail.own_J[number, j] += max(state.dissipated_energy[j], 0.0) * way_m
            cell = cell_at(state.position[0] - cars[number].params.axle_position_m[j])
            old = rail.cell[number, j]
            if cell > old:
                extend(rail, cell)
                at = int(old) % rail.work_J_m.size
                rail.work_J_m[at] = left_J_m(rail, old, time_s) + rail.own_J[number, j] / CELL_M
                rail.written_s[at] = time_s
                rail.laid_J[0] += rail.own_J[number, j]
                rail.own_J[number, j] = 0.0
                rail.cell[number, j] = cell
                state.rail_work[j] = left_J_m(rail, cell, time_s)


@kernel
def extend(rail, cell):
    """Add cells that no wheelset has entered, up to this one."""
    while rail.front[0] < cell:
        rail.front[0] += 1.0
        at = int(rail.front[0]) % rail.work_J_m.size
        rail.work_J_m[at] = 0.0
        rail.written_s[at] = 0.0
        rail.sand_left_kg[0] += rail.sand_kg[at]
        rail.sand_kg[at] = 0.0


@kernel
def pass_sand_on(rail, cars):
    """Pass the sand behind each car on to the rail, and that on the rail to the next car [L3]."""
    cells = rail.sand_kg.size
    for number in range(len(cars)):
        state = cars[number].state
        while rail.sand_front[number] < state.rail_front[0]:
            rail.sand_front[number] += 1.0
            cell = int(rail.sand_front[number])
            state.rail_sand[cell % CELLS] += rail.sand_kg[cell % cells]
            rail.sand_kg[cell % cells] = 0.0
        # a car whose last wheelset is in a cell may still sand or crush there
        while rail.sand_rear[number] < state.rail_cell[state.axles - 1]:
            cell = int(rail.sand_rear[number])
            rail.sand_kg[cell % cells] += state.rail_sand[cell % CELLS]
            state.rail_sand[cell % CELLS] = 0.0
            rail.sand_rear[number] += 1.0
