"""One tick of the rig: commands in, rig control, physics, signals out.

The order is fixed: record a sample if one is due, read the command mailbox, let the rig control
command its motors, advance the physics, observe, and publish a row of all signals. `Ticks` runs
ticks back to back (lockstep and free pacing); `loop` gives them deadlines.
"""

import functools
from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np

from rollerrig.configs.vehicle import AXLES_OF_GROUP, MOST_AXLES, MOST_GROUPS, Kind
from rollerrig.firmware_sim import pole_wheel, rig_control
from rollerrig.firmware_sim.drive402 import axis
from rollerrig.firmware_sim.drive402 import control as drive_control
from rollerrig.firmware_sim.faults import effects
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.loop import appending
from rollerrig.realtime.loop import mailbox as box
from rollerrig.realtime.loop.mailbox import Mailbox
from rollerrig.rig import plant, vehicle
from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.dynamic_brake import NO_COMMAND
from rollerrig.rig.params import Params
from rollerrig.rig.state import NAMES, State, slots
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import BITS_PER_AXLE, PAIR_MASK

# places in the command row, float64, with room for the most axles and all equipment; io401 writes
# the first two
MAGNETS = 0  # pairs of magnets of the axles, as in wsp_interface.magnets
DEMAND = MAGNETS + MOST_AXLES  # brake demand in Pa; NaN: the programme of the scenario
REFERENCE = DEMAND + 1  # reference speed of each WSP unit in m/s; NaN: it sends none
FRICTION = REFERENCE + MOST_GROUPS  # kinematic friction under the axles; 0: as in the scenario
SAND = FRICTION + MOST_AXLES  # 1: the sander of the axle is on
DRIVES = SAND + MOST_AXLES  # commands of each drive, laid out as in drive402.axis
FAULTS = DRIVES + MOST_AXLES * axis.COMMANDS  # faults that act, laid out as in faults.effects
# of a dynamic brake: the permitted share of each motor, then the demand of traction
MOTORS = FAULTS + effects.SIZE
# of a magnetic track brake: 1: the magnets of the bogie of the axle are on
TRACK_BRAKE = MOTORS + MOST_AXLES + 1
COMMANDS = TRACK_BRAKE + MOST_AXLES

# slots of the control array, int64
TICK = 0  # ticks of the run so far
STOP = 1  # 1: run no further tick
DONE = 2  # 1: the vehicle has stood long enough, or the time is up
STANDING_TICKS = 3  # ticks at standstill
MISSED = 4  # ticks that began after the next one was due
WORST_NS = 5  # largest lateness of a tick
LATE_NS = 6  # largest lateness since the last sample
BUSY_NS = 7  # longest duration of a tick since the last sample
HOLD = 8  # whether the rig is held: see held_rig
HELD = 9  # ticks of the held rig
STALLED_NS = 10  # how far simulated time is behind the clock of the bus
SLOTS_OF_CONTROL = 11


class Units(NamedTuple):
    """The reference WSP units of all groups of axles."""

    memory: np.ndarray  # float64 (groups, logic.SIZE): the state of each unit
    params: logic.Params


record_type.register(Units)


class TickData(NamedTuple):
    """Everything that a tick reads or writes.

    With a virtual track there are two plants: `state` is that of the virtual vehicle, and the
    fields `roller_...` are those of the real wheelsets and rollers. Without it, the roller fields
    are those of the only plant.
    """

    params: Params
    state: State
    buffer: np.ndarray  # the memory of the state, float64
    delay: np.ndarray  # (dead time in ticks + 1, axles): the magnets of the last ticks
    control: np.ndarray  # int64; its slots are above
    commands: Mailbox  # rows of commands for the tick
    command: np.ndarray  # the command row that acts now; its places are above
    published: Mailbox  # rows of all signals from the tick
    row: np.ndarray  # the row of all signals
    kept: np.ndarray  # int64: the columns of the row that a sample has
    gather: (
        np.ndarray
    )  # int64 (n, 2): the columns to copy into the row, and their slots in `buffer`
    ring_header: np.ndarray  # of the ring of samples
    ring_rows: np.ndarray
    virtual: int  # 1 with a virtual track, else 0
    roller_params: Params
    roller_state: State
    roller_buffer: np.ndarray
    roller_delay: np.ndarray
    gather_rollers: np.ndarray  # like `gather`, for `roller_buffer`
    record_ticks: int  # ticks from one sample to the next
    end_tick: int  # the run is done at this tick
    stand_ticks: int  # the run is done after more ticks at standstill than these
    hold: np.ndarray  # (1,): the speed in m/s at which a held rig rolls
    # (3,) int64, for runs without a bus (`wire_delay`): ticks from a SYNC until the answer of the
    # unit acts in an ordinary cycle, the same in every n-th cycle, and n
    answer: np.ndarray
    sensor: pole_wheel.Sensor
    pulses: np.ndarray  # the memory of the sensors


record_type.register(TickData)


# columns of the row of all signals
_MAGNETS = signals.column("magnets")
_TRACKING = signals.column("tracking_error")
_MOTOR_K = signals.column("motor_temperature")
_SAND = signals.column("sand_demand")
_LATENESS = signals.column("tick_lateness")
_DURATION = signals.column("tick_duration")
_MISSED = signals.column("ticks_missed")
# what the WSP unit receives and sends: columns, and the unit of a count on the bus
_SPEED = signals.column("measured_speed")
_PRESSURE = signals.column("cylinder_pressure")
_REFERENCE = signals.column("wsp_reference_speed")
# the first of the columns of further groups, which follow one another
_SECOND_REFERENCE = signals.column(signals.reference_speed_name(1))
_SPEED_SCALE = signals.first_place("measured_speed").scale
_PRESSURE_SCALE = signals.first_place("cylinder_pressure").scale
_REFERENCE_SCALE = signals.first_place("wsp_reference_speed").scale
_LOW, _HIGH = (float(bound) for bound in signals.KINDS["I16"])

# signals of the real wheelsets and rollers, where a virtual track runs in parallel
OF_ROLLERS = frozenset(
    (
        "wheel_speed",
        "wheel_circumferential_speed",
        "wheel_angle",
        "roller_speed",
        "roller_angle",
        "motor_torque",
        "motor_torque_demand",
        "motor_temperature",
    )
)


def first_command() -> np.ndarray:
    """Return the first command row: no magnet energised, drives enabled for the rig."""
    row = np.full(COMMANDS, np.nan)
    row[MAGNETS:DEMAND] = 0.0
    row[FRICTION:] = 0.0
    row[MOTORS : MOTORS + MOST_AXLES] = 1.0
    row[MOTORS + MOST_AXLES] = NO_COMMAND
    drives = row[DRIVES:FAULTS].reshape(MOST_AXLES, axis.COMMANDS)
    drives[:, axis.ENABLED] = 1.0
    drives[:, axis.LOOP] = axis.LOOP_RIG
    return row


def gather(kind: Kind, names: Iterable[str] = NAMES, rig: int = 0) -> np.ndarray:
    """Return what to copy from the state of a rig into the row of all signals.

    Shape (n, 2): a column of the row, and its slot in the buffer of the state. `names` are the
    signals to copy, `rig` is the number of the rig in the buffer.
    """
    return _gathered(kind, frozenset(names), rig).copy()


@functools.cache
def _gathered(kind: Kind, wanted: frozenset[str], rig: int) -> np.ndarray:
    """Return the pairs of `gather`, made once: a campaign needs them for each stop."""
    table = signals.table(kind)
    places = slots(kind.axles, rig)
    pairs: list[tuple[int, int]] = []
    for signal in table.signals:
        if signal.name in places and signal.name in wanted - pole_wheel.COLUMNS:
            columns = table.span(signal.name)
            slot = places[signal.name]
            pairs += zip(
                range(columns.start, columns.stop), range(slot.start, slot.stop), strict=True
            )
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


@kernel
def publish(m):
    """Write the row of all signals and post it."""
    write_row(m)
    box.post(m.published, m.row)


@kernel
def write_row(m):
    """Copy the state into the row of all signals."""
    for i in range(len(m.gather)):
        m.row[m.gather[i, 0]] = m.buffer[m.gather[i, 1]]
    for i in range(len(m.gather_rollers)):
        m.row[m.gather_rollers[i, 0]] = m.roller_buffer[m.gather_rollers[i, 1]]
    axles = m.params.axles
    for j in range(axles):
        m.row[_MAGNETS + j] = m.command[MAGNETS + j]
        m.row[_SAND + j] = m.command[SAND + j]
        m.row[_TRACKING + j] = tracking_error(m, j)
    pole_wheel.sense(m.row, m.pulses, m.sensor, m.command[FAULTS:])
    if m.command[FAULTS + effects.ANY] != 0.0:
        heat = m.params.heat
        effects.heat(
            m.row[_MOTOR_K : _MOTOR_K + axles], m.command[FAULTS:], heat.air_K, heat.motor_rise_K
        )
    m.row[_REFERENCE] = m.command[REFERENCE]
    for group in range(1, MOST_GROUPS):
        m.row[_SECOND_REFERENCE + group - 1] = m.command[REFERENCE + group]
    m.row[_LATENESS] = m.control[LATE_NS] * 1e-3
    m.row[_DURATION] = m.control[BUSY_NS] * 1e-3
    m.row[_MISSED] = m.control[MISSED]


@kernel
def tracking_error(m, axle):
    """Return the control error of the motors in m/s, at the rim of the wheel or roller."""
    if m.virtual != 0:
        error = m.roller_state.wheel_speed[axle] - m.state.wheel_speed[axle]
        return m.params.wheels.table[vehicle.RADIUS_M, axle] * error
    if m.params.mode == 0:
        return 0.0
    return m.params.drive.roller_radius_m * m.state.roller_speed[axle] - m.state.vehicle_speed[0]


@kernel
def advance_real_rollers(m, tick):
    """Advance the real wheelsets on their dry rollers under the loads of the virtual vehicle."""
    real, virtual = m.roller_state, m.state
    real.vehicle_speed[0] = virtual.vehicle_speed[0]
    real.vehicle_acceleration[0] = virtual.vehicle_acceleration[0]
    real.felt_acceleration[0] = virtual.felt_acceleration[0]
    plant.advance(
        real, m.roller_delay, m.command[MAGNETS:DEMAND], m.command[DEMAND], tick, m.roller_params
    )
    plant.observe(real, m.roller_params)


@kernel
def disturb(m, faults):
    """Let faults act on magnets, motors and cylinders for the coming tick."""
    effects.energise(m.command[MAGNETS:DEMAND], faults)
    effects.ripple(m.roller_state, faults)
    effects.leak(m.state, faults, m.params.tick_s)
    effects.spill(m.state, faults)
    if m.virtual != 0:
        effects.leak(m.roller_state, faults, m.params.tick_s)


@kernel
def run_tick(m):
    """Run one tick and count it.

    Set DONE when the vehicle has stood long enough or the time is up.
    """
    tick = m.control[TICK]
    begin(m, tick)
    plant.advance(m.state, m.delay, m.command[MAGNETS:DEMAND], m.command[DEMAND], tick, m.params)
    if m.command[DRIVES + axis.LOOP] == axis.LOOP_STOP and (m.virtual != 0 or m.params.mode != 0):
        rig_control.stop_with_rollers(m.state, m.roller_state, m.roller_params.drive)
    plant.observe(m.state, m.params)
    if m.virtual != 0:
        advance_real_rollers(m, tick)
    end(m, tick)


@kernel
def begin(m, tick):
    """Do what precedes the physics of a tick: sample, commands, drive control, faults."""
    record(m, tick)
    box.fetch(m.commands, m.command)
    obey(m)


@kernel
def record(m, tick):
    """Push the row of all signals into the ring if a sample is due at this tick."""
    if tick % m.record_ticks == 0:
        # the largest values since the last sample, including the lateness of this tick
        m.row[_LATENESS] = m.control[LATE_NS] * 1e-3
        m.row[_DURATION] = m.control[BUSY_NS] * 1e-3
        appending.push_part(m.ring_header, m.ring_rows, m.row, m.kept)
        m.control[LATE_NS] = 0
        m.control[BUSY_NS] = 0


@kernel
def obey(m):
    """Let the command row act in the coming tick: drive control, faults, friction, sanders."""
    faults = m.command[FAULTS:]
    if m.virtual != 0:
        table = m.params.wheels.table
        rig_control.follow_virtual_wheels(
            m.roller_state,
            m.state,
            m.roller_params.drive,
            table[vehicle.RADIUS_M],
            table[vehicle.INERTIA_KGM2],
        )
    elif m.params.mode != 0:
        rig_control.hold_surface_speed(m.state, m.params.drive, m.params.tick_s)
    if m.virtual != 0 or m.params.mode != 0:
        drive_control.obey(
            m.roller_state, m.roller_params.drive, m.command[DRIVES:], m.params.tick_s
        )
    if faults[effects.ANY] != 0.0:
        disturb(m, faults)
    for j in range(m.params.axles):
        m.state.friction_command[j] = m.command[FRICTION + j]
        m.state.sand_command[j] = m.command[SAND + j]
        m.state.sand_rate_fault[j] = effects.value(faults, effects.SAND_FLAW, j)
        m.state.sand_delay_fault[j] = effects.value(faults, effects.SAND_LATE_s, j)
    command_track_brake(m, faults, m.params.track_brake)
    command_motors(m, faults, m.params.dynamic)


@kernel
def command_motors(m, faults, dynamic):
    """Pass commands and faults to the motors of a dynamic brake; nothing without one."""
    if dynamic.acts:
        for j in range(m.params.axles):
            m.state.dynamic_permitted[j] = m.command[MOTORS + j]
            m.state.dynamic_failed[j] = effects.value(faults, effects.MOTOR_LOST, j)
        m.state.traction_command[0] = m.command[MOTORS + MOST_AXLES]


@kernel
def command_track_brake(m, faults, magnets):
    """Pass commands and faults to the magnetic track brake; nothing without one."""
    if magnets.acts:
        for j in range(m.params.axles):
            m.state.track_brake_command[j] = m.command[TRACK_BRAKE + j]
            m.state.track_brake_failed[j] = effects.value(faults, effects.TRACK_BRAKE_DEAD, j)


@kernel
def end(m, tick):
    """Do what follows the physics of a tick: publish it and count it."""
    publish(m)
    count(m, tick)


@kernel
def count(m, tick):
    """Count a tick, and set DONE if it is the last one."""
    m.control[TICK] = tick + 1
    if m.state.standing[0] != 0.0:
        m.control[STANDING_TICKS] += 1
    if m.control[STANDING_TICKS] > m.stand_ticks or tick + 1 >= m.end_tick:
        m.control[DONE] = 1


@kernel
def run(data, ticks):
    """Run some ticks of the one record in a table, fewer if the run is done; return how many."""
    m = data[0]
    ran = 0
    while ran < ticks and m.control[DONE] == 0 and m.control[STOP] == 0:
        run_tick(m)
        ran += 1
    return ran


class RunsTicks(Protocol):
    """What runs ticks a few at a time."""

    def run(self, ticks: int, /) -> int:
        """Run some ticks, fewer if the run is done; return how many were run."""


class Ticks:
    """Runs ticks of `m` a few at a time; the fields of `m` are converted for kernels only once."""

    def __init__(self, m: TickData) -> None:
        self._data = record_type.table([m])

    def run(self, ticks: int) -> int:
        """Run some ticks, fewer if the run is done; return how many were run."""
        return int(run(self._data, ticks))


def run_ticks(m: TickData, ticks: int) -> int:
    """Run some ticks once; return how many were run."""
    return Ticks(m).run(ticks)


@kernel
def counts(value, scale):
    """Return a value as a 16-bit count on the bus: rounded half to even, saturated."""
    return min(max(np.rint(value / scale), _LOW), _HIGH)


@kernel
def run_ticks_with_units(m, ticks, sync_ticks, units, inputs):
    """Run ticks as `run_ticks` does, and call the reference WSP units where a SYNC would come.

    `units` are `Units`, `inputs` int64 scratch of shape (2 MOST_AXLES,): what the units would
    receive over the bus, speeds in 0.01 rad/s and pressures in mbar. Their answers act in the next
    tick, as in lockstep, or when a wire would have carried them.
    """
    for i in range(ticks):
        if m.control[DONE] != 0 or m.control[STOP] != 0:
            return i
        call_units(m, sync_ticks, units, inputs)
        run_tick(m)
    return ticks


@kernel
def call_units(m, sync_ticks, units, inputs):
    """Call the reference WSP units before a tick if it is due; arguments as above."""
    cycle, phase = divmod(m.control[TICK], sync_ticks)
    if phase == 0:
        write_unit_inputs(m, inputs)
    if phase == m.answer[1 if cycle > 0 and cycle % m.answer[2] == 0 else 0]:
        run_unit_cycles(m, units.memory, units.params, inputs)


@kernel
def write_unit_inputs(m, inputs):
    """Write what the reference WSP units receive with a SYNC, in counts."""
    for j in range(m.params.axles):
        inputs[j] = counts(m.row[_SPEED + j], _SPEED_SCALE)
        inputs[MOST_AXLES + j] = counts(m.row[_PRESSURE + j], _PRESSURE_SCALE)


@kernel
def run_unit_cycles(m, memory, params, inputs):
    """Run a cycle of the reference WSP unit of each group.

    `memory` float64 (groups, logic.SIZE) has the state of each unit; all have the same `params`.
    """
    for group in range(len(memory)):
        axles = min(m.params.axles - AXLES_OF_GROUP * group, AXLES_OF_GROUP)
        unit = logic.Unit(logic.state_at(memory[group], axles), params)
        run_unit_cycle(m, unit, group, inputs)


@kernel
def run_unit_cycle(m, unit, group, inputs):
    """Run a cycle of the reference WSP unit of a group on its inputs; command its answer."""
    first = AXLES_OF_GROUP * group
    magnets_byte, reference = logic.cycle(unit, inputs[first:])
    command = m.commands.values
    for j in range(unit.state.axles):
        command[MAGNETS + first + j] = (magnets_byte >> (BITS_PER_AXLE * j)) & PAIR_MASK
    permit_shares(unit, command, first, m.params.dynamic)
    command[REFERENCE + group] = reference * _REFERENCE_SCALE


@kernel
def permit_shares(unit, command, first, dynamic):
    """Pass the unit's shares of the dynamic brake as commands; nothing without such a brake."""
    if dynamic.acts:
        for j in range(unit.state.axles):
            command[MOTORS + first + j] = logic.permitted_share(unit, j)
