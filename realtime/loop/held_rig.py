"""A rig that is held: it rolls at a set speed, brakes released, until somebody starts the run.

Wheels and rollers turn without sliding and approach the set speed at a constant rate; time and
distance of the run stand still, and nothing is recorded. Bus, sensors and drives live as always, so
that a unit sees a train that runs. The run begins with a SYNC, from the speed of that moment.
"""

from rollerrig.realtime.loop import mailbox as box
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import HELD, HOLD
from rollerrig.rig import plant
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.state import AXLES

# values of the control slot HOLD: the run goes on; it is held; it is held until the next SYNC
RUNNING, HOLDING, RELEASED = 0, 1, 2
RATE_M_S2 = 5.0


@kernel
def roll(m):
    """Let a held rig roll for one tick, and publish what it does."""
    box.fetch(m.commands, m.command)
    step, speed = RATE_M_S2 * m.params.tick_s, m.state.vehicle_speed[0]
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
    for j in range(AXLES):
        state.wheel_angle[j] += tick_s * state.wheel_speed[j]
        state.roller_angle[j] += tick_s * state.roller_speed[j]


@kernel
def is_held(m, sync_ticks):
    """Whether this tick is one of a held rig; a released one begins its run with a SYNC."""
    if m.control[HOLD] == RELEASED and m.control[HELD] % sync_ticks == 0:
        m.control[HOLD] = RUNNING
    return m.control[HOLD] != RUNNING
