"""The ticks of a train: all cars begin a tick, take its steps together, and end it.

A car does before and after its steps what `tick.run_tick` does. The rail, the brake pipe and the
couplers belong to the train. The units of some cars are other programs, each on the bus of its car:
their commands come through the mailbox. The reference units of all other cars are called here,
where their SYNC would come.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.realtime.campaign.stops import ticks_in_lanes
from rollerrig.realtime.loop import appending, loop, tick
from rollerrig.realtime.loop.clock import now_ns, wake
from rollerrig.realtime.loop.tick import BUSY_NS, DONE, STOP, TICK, TickData, Units
from rollerrig.rig import plant, wheelset
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.record_type import part_of
from rollerrig.rig.train import motion, pipe, rail
from rollerrig.rig.train.coupler import Couplers
from rollerrig.rig.train.motion import Motion
from rollerrig.rig.train.pipe import Pipe
from rollerrig.rig.train.rail import Rail

# assumption: the lag with which a train measures its deceleration
DECELERATION_LAG_S = 0.1


class Car(NamedTuple):
    """A car as the ticks need it."""

    m: TickData
    units: Units
    inputs: np.ndarray  # int64 (2 MOST_AXLES,): scratch, what the units receive
    sync_ticks: int  # ticks between two cycles of its units; 0: no unit is called here
    is_observed: bool  # whether each tick needs the signals of the one before
    is_on_bus: bool  # whether its commands come from the bus


class Train(NamedTuple):
    """What belongs to the train.

    A sample has the force of each coupler, its displacement, the pressure of the pipe at each car,
    and the deceleration.
    """

    groups: np.ndarray  # int64 (groups, 2), of `motion.groups`
    couplers: Couplers
    motion: Motion
    rail: Rail
    has_pipe: bool
    pipe: Pipe
    extremes_N: np.ndarray  # (couplers, 2): largest tension, and largest compression, negative
    extremes_m: np.ndarray  # (couplers, 2): largest and least displacement
    header: np.ndarray  # of the samples, as of a ring
    rows: np.ndarray  # (samples, 2 couplers + cars + 1)
    row: np.ndarray  # the sample that is being made
    # (1,) m/s2, positive in braking: what the cars are told, with a lag of DECELERATION_LAG_S
    deceleration_m_s2: np.ndarray
    before_m_s: np.ndarray  # (1,): the speed of the centre of mass before the tick


record_type.register(Car)
record_type.register(Train)


@kernel
def run(cars, bodies, trains, most):
    """Run some ticks of a train, fewer if it is done; return how many were run.

    Parameters
    ----------
    cars, bodies : tables of `Car` and of `motion.Car`, from the front to the rear
    trains : table of the one `Train`
    most : number of ticks
    """
    train = trains[0]
    for ran in range(most):
        if is_over(cars):
            return ran
        run_tick(cars, bodies, train)
    return most


@kernel
def is_over(cars):
    """Return whether no further tick shall be run, because of any car."""
    ended = 0
    for i in range(len(cars)):
        ended += cars[i].m.control[DONE] + cars[i].m.control[STOP]
    return ended != 0


@kernel
def wall(
    cars,
    bodies,
    trains,
    tick_ns,
    sync_ticks,
    early_ns,
    descriptor,
    histogram,
    scratch,
    begin_ns,
):
    """Run the ticks of a train on their deadlines, as `loop.wall` does those of a vehicle.

    `cars`, `bodies` and `trains` as for `run`, all else as for `loop.wall`. The lateness of a tick
    is noted for each car.
    """
    spec = scratch[:2]
    one = scratch[2:]
    one[0] = 1
    deadline = begin_ns + tick_ns
    took = 0
    while not is_over(cars):
        began = loop.wait(deadline, tick_ns, early_ns, took, spec)
        late = began - deadline
        histogram[min(late // 1000, histogram.size - 1)] += 1
        for i in range(len(cars)):
            loop.note(cars[i].m.control, late, tick_ns)
        if loop.is_stall(late, tick_ns):
            deadline = began
        run_tick(cars, bodies, trains[0])
        if cars[0].m.control[TICK] % sync_ticks == 0:
            wake(descriptor, one)
        took = now_ns(spec) - began
        for i in range(len(cars)):
            cars[i].m.control[BUSY_NS] = max(cars[i].m.control[BUSY_NS], took)
        deadline += tick_ns
    wake(descriptor, one)


@kernel
def run_tick(cars, bodies, train):
    """Run one tick of all cars."""
    now = cars[0].m.control[TICK]
    params = cars[0].m.params
    if train.rail.has_sand:
        extend_for_sand(train, bodies)
    if train.rail.acts:
        for g in range(len(train.groups)):
            plants = part_of(bodies, train.groups[g, 0], train.groups[g, 1]).params
            wheelset.observe_work(motion.of_group(bodies, train.groups[g]), plants)
        rail.roll(train.rail, bodies, params.tick_s)
    if now % cars[0].m.record_ticks == 0:
        sample(train, len(cars))
    for i in range(len(cars)):
        begin(cars[i], train, i, now)
    for _ in range(params.substeps):
        motion.step(bodies, train.groups, train.couplers, train.motion)
    watch(train)
    measure(train, bodies)
    for i in range(len(cars)):
        end(cars[i], now)
    if train.rail.has_sand:
        rail.pass_sand_on(train.rail, bodies)


@kernel
def extend_for_sand(train, bodies):
    """Add cells up to the first wheelset, also where no wheel cleans the rail."""
    first = bodies[0].state
    rail.extend(train.rail, rail.cell_at(first.position[0]))


@kernel
def begin(car, train, number, now):
    """Do what precedes the steps of a tick of a car."""
    m = car.m
    if car.is_on_bus:
        tick.begin(m, now)
    else:
        # commands act when the units write them
        if car.sync_ticks != 0:
            tick.call_units(m, car.sync_ticks, car.units, car.inputs)
        tick.record(m, now)
        tick.obey(m)
    demand_Pa = m.command[tick.DEMAND]
    if train.has_pipe:
        demand_Pa = pipe.advance(train.pipe, number, m.state.time[0])
    magnets = m.command[tick.MAGNETS : tick.DEMAND]
    plant.prepare(m.state, m.delay, magnets, demand_Pa, now, m.params)


@kernel
def end(car, now):
    """Do what follows the steps of a tick of a car."""
    m = car.m
    if not car.is_on_bus:
        ticks_in_lanes.end(car, m, now)
        return
    plant.finish(m.state, now, m.params)
    plant.observe(m.state, m.params)
    tick.end(m, now)


@kernel
def sample(train, cars):
    """Append a sample of couplers and pipe."""
    couplers = train.motion.force_N.size
    for i in range(couplers):
        train.row[i] = train.motion.force_N[i]
        train.row[couplers + i] = train.motion.displacement_m[i]
    for i in range(cars):
        train.row[2 * couplers + i] = train.pipe.pressure_Pa[i]
    train.row[2 * couplers + cars] = train.deceleration_m_s2[0]
    appending.push(train.header, train.rows, train.row)


@kernel
def measure(train, bodies):
    """Measure how much the centre of mass has slowed down in this tick, with a first-order lag."""
    speed_m_s = speed(bodies)
    tick_s = bodies[0].params.tick_s
    slowed_m_s2 = (train.before_m_s[0] - speed_m_s) / tick_s
    share = tick_s / (DECELERATION_LAG_S + tick_s)
    train.deceleration_m_s2[0] += share * (slowed_m_s2 - train.deceleration_m_s2[0])
    train.before_m_s[0] = speed_m_s


@kernel
def speed(bodies):
    """Return the speed of the centre of mass in m/s."""
    mass_kg = 0.0
    momentum = 0.0
    for i in range(len(bodies)):
        of_car_kg = bodies[i].params.vehicle.mass_kg
        mass_kg += of_car_kg
        momentum += of_car_kg * bodies[i].state.vehicle_speed[0]
    return momentum / mass_kg


@kernel
def watch(train):
    """Keep the largest forces and displacements of the couplers, also between samples."""
    for i in range(train.motion.force_N.size):
        F = train.motion.force_N[i]
        x = train.motion.displacement_m[i]
        train.extremes_N[i, 0] = max(train.extremes_N[i, 0], F)
        train.extremes_N[i, 1] = min(train.extremes_N[i, 1], F)
        train.extremes_m[i, 0] = max(train.extremes_m[i, 0], x)
        train.extremes_m[i, 1] = min(train.extremes_m[i, 1], x)
