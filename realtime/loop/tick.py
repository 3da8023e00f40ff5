"""One tick of the rig: commands in, rig control, physics, what can be seen out.

The order is fixed: read the command mailbox, let the rig control ask its motors, advance the
physics, observe, publish a row of all signals, and put it into the ring when a sample is due.
`Ticks` runs ticks back to back (lockstep and free pacing), `loop` gives them their deadlines.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim import pole_wheel, rig_control
from rollerrig.firmware_sim.drive402 import axis
from rollerrig.firmware_sim.drive402 import control as drive_control
from rollerrig.firmware_sim.faults import effects
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.loop import appending
from rollerrig.realtime.loop import mailbox as box
from rollerrig.realtime.loop.mailbox import Mailbox
from rollerrig.rig import plant, vehicle
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.params import Params
from rollerrig.rig.state import AXLES, SLOTS, State
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import BITS_PER_AXLE, PAIR_MASK

# the command row: magnets of the axles, a brake demand from the bus (NaN: none), and the WSP's
# reference speed (NaN: it tells none); the first two are what io401 writes; then friction asked for
# under the axles (0: the scenario's), sanders asked to strew, what each drive is asked, as drive402.axis
# lays it out, and the faults that act, as faults.effects lays them out
MAGNETS, DEMAND, REFERENCE, FRICTION = 0, AXLES, AXLES + 1, AXLES + 2
SAND = FRICTION + AXLES
DRIVES = SAND + AXLES
FAULTS = DRIVES + AXLES * axis.COMMANDS
COMMANDS = FAULTS + effects.SIZE

# slots of the control array (int64)
(
    TICK,
    STOP,
    DONE,
    STANDING_TICKS,
    MISSED,
    WORST_NS,
    LATE_NS,
    BUSY_NS,
    HOLD,
    HELD,
    STALLED_NS,
    SLOTS_OF_CONTROL,
) = range(12)


class TickData(NamedTuple):
    """All that a tick touches. `gather` (n,) are the slots of the state that a row copies.

    `virtual` 1: the state is that of the virtual track, and the rollers have a plant of their own, whose slots
    `gather_rollers` (n,) a row copies. Else the rollers are the plant itself. `answer` (3,) int64 is how many ticks
    after its SYNC an answer of the unit acts where none is on a bus (`wire_delay`): in an ordinary cycle, in every n-th
    one, and n. `hold` (1,) is the speed in m/s at which a held rig rolls, `pulses` the memory of the sensors.
    """

    params: Params
    state: State
    buffer: np.ndarray
    delay: np.ndarray
    control: np.ndarray
    commands: Mailbox
    command: np.ndarray
    published: Mailbox
    row: np.ndarray
    gather: np.ndarray
    ring_header: np.ndarray
    ring_rows: np.ndarray
    virtual: int
    roller_params: Params
    roller_state: State
    roller_buffer: np.ndarray
    roller_delay: np.ndarray
    gather_rollers: np.ndarray
    record_ticks: int
    end_tick: int
    stand_ticks: int
    hold: np.ndarray
    answer: np.ndarray
    sensor: pole_wheel.Sensor
    pulses: np.ndarray


_MAGNETS, _TRACKING, _MOTOR_K = (
    signals.column(name) for name in ("magnets", "tracking_error", "motor_temperature")
)
_SAND = signals.column("sand_demand")
_LATENESS, _DURATION, _MISSED = (
    signals.column(name) for name in ("tick_lateness", "tick_duration", "ticks_missed")
)
# what the WSP unit sees and tells, and the scale of its counts on the bus
_OF_UNIT = ("measured_speed", "cylinder_pressure", "wsp_reference_speed")
_SPEED, _PRESSURE, _REFERENCE = (signals.column(name) for name in _OF_UNIT)
_SPEED_SCALE, _PRESSURE_SCALE, _REFERENCE_SCALE = (
    signals.BY_NAME[name].places[0].scale for name in _OF_UNIT
)
_LOW, _HIGH = (float(bound) for bound in signals.KINDS["I16"])

# what the real wheelsets and rollers tell where a virtual track runs beside them
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
    """The command row of a rig that nobody has asked for anything: drives enabled for the rig."""
    row = np.full(COMMANDS, np.nan)
    row[MAGNETS : MAGNETS + AXLES] = row[FRICTION:] = 0.0
    drives = row[DRIVES:FAULTS].reshape(AXLES, axis.COMMANDS)
    drives[:, axis.ENABLED] = 1.0
    drives[:, axis.LOOP] = axis.LOOP_RIG
    return row


def gather(names: Iterable[str] = tuple(SLOTS)) -> np.ndarray:
    """For each column of a row the slot of the state it copies, or -1 where it copies none."""
    wanted = frozenset(names)
    slots = np.full(len(signals.COLUMNS), -1, dtype=np.int64)
    for signal in signals.SIGNALS:
        if signal.name in SLOTS and signal.name in wanted - pole_wheel.COLUMNS:
            place = SLOTS[signal.name]
            slots[signals.span(signal.name)] = np.arange(place.start, place.stop)
    return slots


@kernel
def publish(m):
    """Copy the state into the row of all signals and post it."""
    for i in range(m.gather.size):
        if m.gather[i] >= 0:
            m.row[i] = m.buffer[m.gather[i]]
    for i in range(m.gather_rollers.size):
        if m.gather_rollers[i] >= 0:
            m.row[i] = m.roller_buffer[m.gather_rollers[i]]
    for j in range(AXLES):
        m.row[_MAGNETS + j] = m.command[MAGNETS + j]
        m.row[_SAND + j] = m.command[SAND + j]
        m.row[_TRACKING + j] = tracking_error(m, j)
    pole_wheel.sense(m.row, m.pulses, m.sensor, m.command[FAULTS:])
    if m.command[FAULTS + effects.ANY] != 0.0:
        heat = m.params.heat
        effects.heat(
            m.row[_MOTOR_K : _MOTOR_K + AXLES], m.command[FAULTS:], heat.air_K, heat.motor_rise_K
        )
    m.row[_REFERENCE] = m.command[REFERENCE]
    m.row[_LATENESS] = m.control[LATE_NS] * 1e-3
    m.row[_DURATION] = m.control[BUSY_NS] * 1e-3
    m.row[_MISSED] = m.control[MISSED]
    box.post(m.published, m.row)


@kernel
def tracking_error(m, axle):
    """How far the motors are from what they shall hold, in m/s: at the wheel's or roller's rim."""
    if m.virtual != 0:
        error = m.roller_state.wheel_speed[axle] - m.state.wheel_speed[axle]
        return m.params.wheels.table[vehicle.RADIUS_M + axle] * error
    if m.params.mode == 0:
        return 0.0
    return m.params.drive.roller_radius_m * m.state.roller_speed[axle] - m.state.vehicle_speed[0]


@kernel
def rollers_beside(m, tick):
    """Advance the real wheelsets on their dry rollers under the loads of the virtual vehicle."""
    real, virtual = m.roller_state, m.state
    real.vehicle_speed[0] = virtual.vehicle_speed[0]
    real.vehicle_acceleration[0] = virtual.vehicle_acceleration[0]
    real.felt_acceleration[0] = virtual.felt_acceleration[0]
    plant.advance(real, m.roller_delay, m.command[:AXLES], m.command[DEMAND], tick, m.roller_params)
    plant.observe(real, m.roller_params)


@kernel
def disturb(m, faults):
    """Let faults act on magnets, motors and cylinders for the coming tick."""
    effects.energise(m.command[:AXLES], faults)
    effects.ripple(m.roller_state, faults)
    effects.leak(m.state, faults, m.params.tick_s)
    effects.spill(m.state, faults)
    if m.virtual != 0:
        effects.leak(m.roller_state, faults, m.params.tick_s)


@kernel
def run_tick(m):
    """Run one tick and count it; sets DONE when the vehicle has stood long enough or time is up."""
    tick = m.control[TICK]
    begin(m, tick)
    plant.advance(m.state, m.delay, m.command[:AXLES], m.command[DEMAND], tick, m.params)
    if m.command[DRIVES + axis.LOOP] == axis.LOOP_STOP and (m.virtual != 0 or m.params.mode != 0):
        rig_control.stop_with_rollers(m.state, m.roller_state, m.roller_params.drive)
    plant.observe(m.state, m.params)
    if m.virtual != 0:
        rollers_beside(m, tick)
    end(m, tick)


@kernel_inlined
def begin(m, tick):
    """What precedes the physics of a tick: record, commands, drive control, faults."""
    if tick % m.record_ticks == 0:
        # all since the last sample, this tick's own lateness too
        m.row[_LATENESS] = m.control[LATE_NS] * 1e-3
        m.row[_DURATION] = m.control[BUSY_NS] * 1e-3
        appending.push(m.ring_header, m.ring_rows, m.row)
        m.control[LATE_NS] = 0
        m.control[BUSY_NS] = 0
    box.fetch(m.commands, m.command)
    faults = m.command[FAULTS:]
    if m.virtual != 0:
        table = m.params.wheels.table
        rig_control.follow_virtual_wheels(
            m.roller_state,
            m.state,
            m.roller_params.drive,
            table[vehicle.RADIUS_M : vehicle.RADIUS_M + AXLES],
            table[vehicle.INERTIA_KGM2 : vehicle.INERTIA_KGM2 + AXLES],
        )
    elif m.params.mode != 0:
        rig_control.hold_surface_speed(m.state, m.params.drive, m.params.tick_s)
    if m.virtual != 0 or m.params.mode != 0:
        drive_control.obey(
            m.roller_state, m.roller_params.drive, m.command[DRIVES:], m.params.tick_s
        )
    if faults[effects.ANY] != 0.0:
        disturb(m, faults)
    for j in range(AXLES):
        m.state.friction_command[j] = m.command[FRICTION + j]
        m.state.sand_command[j] = m.command[SAND + j]
        m.state.sand_rate_fault[j] = effects.value(faults, effects.SAND_FLAW, j)
        m.state.sand_delay_fault[j] = effects.value(faults, effects.SAND_LATE_s, j)


@kernel_inlined
def end(m, tick):
    """What follows the physics of a tick: publish and count it."""
    publish(m)
    m.control[TICK] = tick + 1
    if m.state.standing[0] != 0.0:
        m.control[STANDING_TICKS] += 1
    if m.control[STANDING_TICKS] > m.stand_ticks or tick + 1 >= m.end_tick:
        m.control[DONE] = 1


@kernel
def stepping(m, ticks):
    """With each `next` run ticks[0] ticks back to back, fewer if the run is done, and yield how many."""
    while True:
        ran = 0
        while ran < ticks[0] and m.control[DONE] == 0 and m.control[STOP] == 0:
            run_tick(m)
            ran += 1
        yield ran


class Ticks:
    """Runs ticks of `m` a few at a time: its hundreds of fields are handed to the kernel once, not with each call."""

    def __init__(self, m: TickData) -> None:
        # what the kernel looks at lives as long as this does
        self._m, self._asked = m, np.zeros(1, dtype=np.int64)
        self._stepping = stepping(m, self._asked)

    def run(self, ticks: int) -> int:
        """Run some ticks, fewer if the run is done; returns how many."""
        self._asked[0] = ticks
        return next(self._stepping)


def run_ticks(m: TickData, ticks: int) -> int:
    """Run some ticks once; returns how many."""
    return Ticks(m).run(ticks)


@kernel
def counts(value, scale):
    """A value as the 16-bit integer that stands on the bus: rounded half to even, saturated."""
    return min(max(np.rint(value / scale), _LOW), _HIGH)


@kernel
def run_ticks_with_unit(m, ticks, sync_ticks, unit, inputs):
    """As `run_ticks`, with the reference WSP unit called where its SYNC would come.

    `unit` is the unit's memory and parameters, `inputs` int64 scratch of shape (8,): it sees what
    the bus would tell it, speeds in 0.01 rad/s and pressures in mbar, and its answer takes effect
    with the next tick, as in lockstep, or when a wire would have carried it.
    """
    for i in range(ticks):
        if m.control[DONE] != 0 or m.control[STOP] != 0:
            return i
        cycle, phase = divmod(m.control[TICK], sync_ticks)
        if phase == 0:
            ask_unit(m, inputs)
        if phase == m.answer[1 if cycle > 0 and cycle % m.answer[2] == 0 else 0]:
            hear_unit(m, unit, inputs)
        run_tick(m)
    return ticks


@kernel_inlined
def ask_unit(m, inputs):
    """What the reference WSP unit sees with a SYNC, in counts."""
    for j in range(AXLES):
        inputs[j] = counts(m.row[_SPEED + j], _SPEED_SCALE)
        inputs[AXLES + j] = counts(m.row[_PRESSURE + j], _PRESSURE_SCALE)


@kernel_inlined
def hear_unit(m, unit, inputs):
    """One cycle of the reference WSP unit on what it saw: its answer as commands."""
    magnets_byte, reference = logic.cycle(unit, inputs)
    command = m.commands.values
    for j in range(AXLES):
        command[MAGNETS + j] = (magnets_byte >> (BITS_PER_AXLE * j)) & PAIR_MASK
    command[REFERENCE] = reference * _REFERENCE_SCALE
