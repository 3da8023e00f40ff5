"""A held rig: it rolls at a set speed with released brakes until a Modbus client starts the run.

Wheels and rollers turn without sliding and approach the set speed at a constant rate. Time and
distance of the run stand still, and nothing is recorded. Bus, sensors and drives work as always, so
that a unit sees a running train. The run begins with a SYNC, at the speed of that moment.
"""

from rollerrig.realtime.loop import mailbox as box
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import HELD, HOLD
from rollerrig.rig import plant
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.state import AXLES

# values of the control slot HOLD
RUNNING = 0  # the run goes on
HOLDING = 1  # the rig is held
RELEASED = 2  # the rig is held until the next SYNC
# rate at which a held rig approaches its set speed (assumption)
RATE_M_S2 = 5.0


@kernel
def roll(m):
    """Let a held rig roll for one tick, and publish its signals."""
    box.fetch(m.commands, m.command)
    step = RATE_M_S2 * m.params.tick_s
    speed = m.state.vehicle_speed[0]
    speed += min(max(m.hold[0] - speed, -step), step)
    _turn(m.state, m.params.tick_s)
    plant.start(m.state, m.params, speed)
    if m.virtual != 0:
        _turn(m.roller_state, m.params.tick_s)
        plant.start(m.roller_state, m.roller_params, speed)
    tick.publish(m)
    m.control[HELD] += 1


@kernel
def _turn(state, tick_s):
    """Turn wheels and rollers for one tick."""
    for j in range(AXLES):
        state.wheel_angle[j] += tick_s * state.wheel_speed[j]
        state.roller_angle[j] += tick_s * state.roller_speed[j]


@kernel
def is_held(m, sync_ticks):
    """Return whether the rig is held in this tick; a released rig begins its run with a SYNC."""
    if m.control[HOLD] == RELEASED and m.control[HELD] % sync_ticks == 0:
        m.control[HOLD] = RUNNING
    return m.control[HOLD] != RUNNING
