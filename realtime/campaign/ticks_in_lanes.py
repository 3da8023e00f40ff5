"""The ticks of several stops, with their reference WSP units, in one compiled call.

Each stop does before and after its physics what `tick.run_tick` does. The physics in between runs
for all stops in lanes (`rig.lanes`). Most ticks are quiet: no sample, no cycle of a unit, no valve
and no demand that changes. Such a tick knows only the lanes. The other ticks are busy: they gather
the state from the lanes, and scatter it again. No bus, clock or Python code runs between two ticks.
The samples agree with those of `--pacing free` to rounding.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import MOST_AXLES, Kind
from rollerrig.firmware_sim import pole_wheel, rig_control
from rollerrig.firmware_sim.pole_wheel import Sensor
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.campaign import packed
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.mailbox import Mailbox
from rollerrig.realtime.loop.tick import DONE, STANDING_TICKS, TICK, TickData
from rollerrig.rig import brake, heat, plant
from rollerrig.rig.compiled.generated import tuple_builder
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.record_type import as_record
from rollerrig.rig.compiled.state_type import state_in
from rollerrig.rig.lanes import layout, quiet_tick, rail_cleaning, step
from rollerrig.rig.lanes.layout import rigs_of
from rollerrig.rig.state import PLACES, SIZE
from rollerrig.wsp_interface import signals

# columns of `Rows.clock`
RUNS = 0  # 0: the place is empty
RECORD_TICKS = 1  # ticks from one sample to the next
SYNC_TICKS = 2  # ticks between two cycles of a unit; 0: it does not run
END_TICK = 3  # the stop is done at this tick
STAND_TICKS = 4  # the stop is done after more ticks at standstill than these
IS_WATCHED = 5  # 1: the row of all signals acts in the next tick, so each tick is busy and makes it
SUBSTEPS = 6  # steps in a tick
BEGUN = 7  # 1: a tick has begun and not ended
LEFT = 8  # steps that are left in this tick
QUIET = 9  # quiet ticks that follow this tick
PASSED = 10  # quiet ticks since the last busy one
STOOD = 11  # those of them that ended at standstill
CLEANS = 12  # 1: the leading wheels clean the rail
COLUMNS_OF_CLOCK = 13

# a place at most this far ahead may be reached within a tick, beside the way at the present speed
_SPEED_MARGIN_M_S = 1.0


class Rows(NamedTuple):
    """The memory of all stops; the first axis has a row for each.

    All vehicles have the same number of axles. The stops do not wait for one another: each has its
    tick, and its number of steps in a tick.
    """

    tape: np.ndarray  # parameters of the plant, as in `packed`
    whole: np.ndarray
    unit_tape: np.ndarray  # parameters of the units
    units: np.ndarray  # (rigs, groups, n): memory of the unit of each group
    buffer: np.ndarray  # the state
    delay: np.ndarray  # (rigs, ticks, axles): the magnets of the last ticks
    control: np.ndarray  # int64, as in `tick`
    command: np.ndarray
    row: np.ndarray  # the row of all signals
    pulses: np.ndarray  # (rigs, n, axles): memory of the speed sensors
    sensor: np.ndarray  # parameters of the sensors
    samples: np.ndarray  # (rigs, columns, n): a sample has the columns `kept`
    written: np.ndarray  # int64, number of samples so far
    kept: np.ndarray  # int64, the columns of the row of all signals that a sample has
    clock: np.ndarray  # int64, with the columns above
    gather: np.ndarray  # int64 (n, 2): as in `TickData`
    inputs: np.ndarray  # int64 (2 MOST_AXLES,): scratch, what the units receive
    lanes: np.ndarray  # of `rig.lanes.layout`


# kernel: the state of a plant without a coach in 3D, in its buffer
see_state = state_in({**PLACES, "coach": None})
# kernel: the parameters of the speed sensors
_see_sensor = tuple_builder(
    Sensor,
    "row",
    [
        f"int(row[{at}])" if kind is int else f"row[{at}]"
        for at, kind in enumerate(Sensor.__annotations__.values())
    ],
)


def rows(
    kind: Kind,
    kept: Sequence[int],
    tape_size: int,
    whole_size: int,
    unit_size: int,
    delay_ticks: int,
    samples: int,
) -> Rows:
    """Return memory for stops, none of which runs.

    kind : that of the vehicles; the number of axles is the same for all, equipment may be less
    kept : the columns of the row of all signals that a sample has
    tape_size, whole_size, unit_size : the largest sizes of the tapes in `packed`
    delay_ticks : the most ticks of dead time, and one
    samples : the most samples of a stop
    """
    rigs = rigs_of(kind.axles)
    gather = tick.gather(kind)
    return Rows(
        tape=np.zeros((rigs, tape_size)),
        whole=np.zeros((rigs, whole_size), dtype=np.int64),
        unit_tape=np.zeros((rigs, unit_size)),
        units=np.zeros((rigs, kind.groups, logic.SIZE)),
        buffer=np.zeros((rigs, SIZE)),
        delay=np.zeros((rigs, delay_ticks, kind.axles)),
        control=np.zeros((rigs, tick.SLOTS_OF_CONTROL), dtype=np.int64),
        command=np.zeros((rigs, tick.COMMANDS)),
        row=np.zeros((rigs, signals.WIDTH)),
        pulses=np.zeros((rigs, pole_wheel.MEMORY, kind.axles)),
        sensor=np.zeros((rigs, len(Sensor._fields))),
        samples=np.zeros((rigs, len(kept), samples)),
        written=np.zeros(rigs, dtype=np.int64),
        kept=np.array(kept, dtype=np.int64),
        clock=np.zeros((rigs, COLUMNS_OF_CLOCK), dtype=np.int64),
        gather=gather,
        inputs=np.zeros(2 * MOST_AXLES, dtype=np.int64),
        lanes=np.zeros(layout.SIZE),
    )


@kernel
def run_ticks(rows, most):
    """Run ticks until one of the running stops is done, or `most` steps; `rows` is `Rows`."""
    clock = rows.clock
    rigs = len(clock)
    axles = rows.delay.shape[2]
    for _ in range(most):
        for rig in range(rigs):
            if clock[rig, RUNS] * clock[rig, CLEANS] != 0 and clock[rig, LEFT] == 0:
                rail_cleaning.write_energy(rows.lanes, rigs * axles)
                break
        done = 0
        for rig in range(rigs):
            if clock[rig, RUNS] == 0 or clock[rig, LEFT] > 0:
                continue
            if clock[rig, QUIET] > 0:
                quiet(rows.lanes, clock[rig], rig * axles, axles)
            else:
                done += busy(rows, rig)
        if done != 0:
            return
        step.step(rows.lanes, rigs, axles)
        for rig in range(rigs):
            clock[rig, LEFT] -= 1


@kernel
def quiet(lanes, clock, first, axles):
    """End the tick of a stop, and begin a quiet one, in which only the rig control acts.

    `clock` is that of the stop, `first` its first lane.
    """
    quiet_tick.end(lanes, first, axles)
    clock[STOOD] += lanes[layout.MOVING + first] == 0.0
    hold_surface_speed(lanes, first, axles)
    if clock[CLEANS] != 0:
        rail_cleaning.clean(lanes, first, axles)
    clock[PASSED] += 1
    clock[QUIET] -= 1
    clock[LEFT] = clock[SUBSTEPS]


@kernel
def hold_surface_speed(w, first, axles):
    """Do what `rig_control.hold_surface_speed` does, in lanes; nothing on a track."""
    for j in range(first, first + axles):
        demand_Nm, observer = rig_control.held(
            w[layout.ROLLER + j],
            w[layout.OBSERVER + j],
            w[layout.MOTOR + j],
            w[layout.V + j],
            w[layout.RATE + j],
            w[layout.ROLLER_KGM2 + j],
            w[layout.ROLLER_M + j],
            w[layout.SPEED_LOOP + j],
            w[layout.OBSERVER_LOOP + j],
            w[layout.TICK + j],
        )
        moves = w[layout.MOVING + j] > 0.0
        on_rollers = w[layout.ON_TRACK + j] == 0.0
        held_Nm = demand_Nm if moves else 0.0
        w[layout.MOTOR_DEMAND + j] = held_Nm if on_rollers else w[layout.MOTOR_DEMAND + j]
        w[layout.OBSERVER + j] = observer if moves & on_rollers else w[layout.OBSERVER + j]


@kernel_inlined
def data_of(rows, rig):
    """Return the tick data of a stop."""
    params = as_record(packed.params(rows.tape[rig], rows.whole[rig]))
    buffer = rows.buffer[rig]
    state = see_state(buffer, params.axles)
    delay = rows.delay[rig, : params.brake.dead_time_ticks + 1]
    nothing = rows.kept[:0]
    # commands act when they are written, and nobody else reads the row of all signals
    commands = Mailbox(nothing, rows.command[rig], rows.command[rig])
    published = Mailbox(nothing, rows.row[rig], rows.row[rig])
    clock = rows.clock[rig]
    return TickData(
        params,
        state,
        buffer,
        delay,
        rows.control[rig],
        commands,
        rows.command[rig],
        published,
        rows.row[rig],
        rows.kept,
        rows.gather,
        nothing,
        rows.samples[rig],
        0,
        params,
        state,
        buffer,
        delay,
        rows.gather[:0],
        clock[RECORD_TICKS],
        clock[END_TICK],
        clock[STAND_TICKS],
        rows.tape[rig],
        nothing,
        _see_sensor(rows.sensor[rig]),
        rows.pulses[rig],
    )


@kernel
def busy(rows, rig):
    """End the tick of a stop whose steps are done, and begin a busy one.

    Returns 1 if the stop is done now, else 0.
    """
    m = as_record(data_of(rows, rig))
    clock = rows.clock[rig]
    if clock[BEGUN] != 0:
        after(m, clock, rows.lanes, rig)
        clock[BEGUN] = 0
        if m.control[DONE] != 0:
            return 1
    target_Pa = before(m, rows, rig)
    layout.scatter(rows.lanes, rig, m.state, target_Pa)
    clock[QUIET] = quiet_ticks(m, clock, target_Pa)
    clock[BEGUN] = 1
    clock[LEFT] = clock[SUBSTEPS]
    return 0


@kernel_inlined
def before(m, rows, rig):
    """Do what precedes the physics of a tick; return the demanded pressure in Pa."""
    now = m.control[TICK]
    sync_ticks = rows.clock[rig, SYNC_TICKS]
    if sync_ticks != 0 and now % sync_ticks == 0:
        tick.write_unit_inputs(m, rows.inputs)
        params = packed.unit_params(rows.unit_tape[rig])
        tick.run_unit_cycles(m, rows.units[rig], params, rows.inputs)
    if now % m.record_ticks == 0:
        at = rows.written[rig]
        for i in range(rows.kept.size):
            rows.samples[rig, i, at] = m.row[rows.kept[i]]
        rows.written[rig] = at + 1
    tick.obey(m)
    magnets = m.command[tick.MAGNETS : tick.DEMAND]
    return plant.prepare(m.state, m.delay, magnets, m.command[tick.DEMAND], now, m.params)


@kernel_inlined
def after(m, clock, lanes, rig):
    """Gather the state of the stop, and do what follows the physics of a tick.

    The row of all signals is made only where somebody reads it: the next tick records a sample or
    runs the unit.
    """
    params = m.params
    layout.gather(lanes, rig, m.state)
    # the quiet ticks have passed with the same magnets
    begun = m.control[TICK]
    now = begun + clock[PASSED]
    for passed in range(max(begun + 1, now - m.delay.shape[0]), now + 1):
        for j in range(params.axles):
            m.delay[passed % m.delay.shape[0], j] = m.command[tick.MAGNETS + j]
    m.control[STANDING_TICKS] += clock[STOOD]
    clock[PASSED] = 0
    clock[STOOD] = 0

    m.state.time[0] = time_s(now, params)
    heat.advance(m.state, params.heat)
    following = now + 1
    sync_ticks = clock[SYNC_TICKS]
    is_read = clock[IS_WATCHED] != 0 or following % m.record_ticks == 0
    if is_read or (sync_ticks != 0 and following % sync_ticks == 0):
        plant.observe(m.state, params)
        tick.write_row(m)
    else:
        for axle in range(params.axles):
            plant.watch_lock(m.state, axle, params)
            if clock[CLEANS] != 0:
                # otherwise the observation has it
                m.state.dissipated_energy[axle] = lanes[layout.ENERGY + rig * params.axles + axle]
    tick.count(m, now)


@kernel_inlined
def time_s(now, params):
    """Return the time in s at the end of a tick."""
    return (now * params.substeps + params.substeps) * params.step_s


@kernel_inlined
def quiet_ticks(m, clock, target_Pa):
    """Return how many ticks after the present one are quiet; `target_Pa` is its brake demand."""
    now = m.control[TICK]
    if clock[IS_WATCHED] != 0 or friction_may_change(m):
        return 0
    # the stop ends only with a busy tick
    most = min(m.end_tick - 1 - now, m.stand_ticks - m.control[STANDING_TICKS])
    most = min(most, m.record_ticks - now % m.record_ticks - 1)
    if clock[SYNC_TICKS] != 0:
        most = min(most, clock[SYNC_TICKS] - now % clock[SYNC_TICKS] - 1)

    # no valve changes, and no demand
    depth = m.delay.shape[0]
    slot = (now + 1) % depth
    for ahead in range(1, most + 1):
        slot = 0 if slot + 1 == depth else slot + 1
        for j in range(m.params.axles):
            # magnets of this tick, or earlier ones that have not passed the dead time
            magnets = m.command[tick.MAGNETS + j] if ahead >= depth else m.delay[slot, j]
            if brake.valve_of(magnets) != m.state.valve[j]:
                return ahead - 1
        demand_Pa = brake.target(m.params.demand, time_s(now + ahead - 1, m.params))
        if demand_Pa * m.params.brake.weighed_share != target_Pa:
            return ahead - 1
    return max(most, 0)


@kernel_inlined
def friction_may_change(m):
    """Whether the programme of friction may change something before the next busy tick."""
    plan = m.params.friction
    # the foremost and the last place or time until then
    position_m = m.state.position[0]
    reach_m = (m.state.vehicle_speed[0] + _SPEED_MARGIN_M_S) * m.record_ticks * m.params.tick_s
    for i in range(plan.start.size):
        if plan.by_place[i] != 0:
            first = position_m - m.params.axle_position_m[-1]
            last = position_m - m.params.axle_position_m[0] + reach_m
        else:
            first = m.state.time[0]
            last = first + m.record_ticks * m.params.tick_s
        if first < plan.start[i] <= last:
            return True
    return False
