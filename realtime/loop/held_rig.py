"""A held rig: it rolls at a set speed with released brakes until a Modbus client starts the run.

Wheels and rollers turn without sliding and approach the set speed as a train does. Time and
distance of the run stand still, and nothing is recorded. Bus, sensors and drives work as always, so
that a unit sees a running train. The run begins with a SYNC, at the speed of that moment.

The reference speed of a unit may fall only as fast as a braking train, because all wheels may
slide. So the rollers change their speed no faster than a train. Only an emergency stop is faster:
the unit then believes that all wheels slide. After it the rig counts as settled when a train would
have reached the speed of the rollers, too.
"""

import numpy as np

from rollerrig.realtime.loop import mailbox as box
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.tick import HELD, HOLD, TickData
from rollerrig.rig import plant
from rollerrig.rig.compiled.kernel import kernel

# values of the control slot HOLD
RUNNING = 0  # the run goes on
HOLDING = 1  # the rig is held
RELEASED = 2  # the rig is held until the next SYNC
# rate at which a held rig approaches its set speed: less than the full brake of a coach (1.1 to
# 1.4 m/s2), and less than 1.3 m/s2, the lowest fall of a reference speed in `firmware_sim.wsp`
RATE_M_S2 = 1.0
# rate of an emergency stop while the rig is held (assumption)
EMERGENCY_RATE_M_S2 = 5.0
# the rig has settled after so long at its set speed (assumption): the reference unit counts as calm
# after 1 s without sliding
SETTLE_S = 2.0

# cells of `TickData.hold`
SET_M_S = 0  # the speed that the rollers approach
APPROACH_M_S2 = 1  # the rate at which they do
TRAIN_M_S = 2  # the speed of a train that follows the rollers at RATE_M_S2 at most
AT_SET_SPEED_S = 3  # for how long rollers and train have been at the set speed
_NEAR_M_S = 1e-6


def steady(speed_m_s: float) -> np.ndarray:
    """Return the cells of a held rig that has settled at a speed."""
    return np.array([speed_m_s, RATE_M_S2, speed_m_s, SETTLE_S])


def has_settled(m: TickData) -> bool:
    """Return whether a held rig has been at its set speed for `SETTLE_S`.

    A set speed that was written after the last tick counts already.
    """
    at_set_speed = abs(m.state.vehicle_speed[0] - m.hold[SET_M_S]) < _NEAR_M_S
    return bool(at_set_speed and m.hold[AT_SET_SPEED_S] >= SETTLE_S)


@kernel
def roll(m):
    """Let a held rig roll for one tick, and publish its signals."""
    box.fetch(m.commands, m.command)
    speed = _approach(m.state.vehicle_speed[0], m.hold[SET_M_S], m.hold[APPROACH_M_S2], m)
    _settle(m, speed)
    _turn(m.state, m.params.tick_s)
    plant.start(m.state, m.params, speed)
    if m.virtual != 0:
        _turn(m.roller_state, m.params.tick_s)
        plant.start(m.roller_state, m.roller_params, speed)
    tick.publish(m)
    m.control[HELD] += 1


@kernel
def _approach(speed, target, rate, m):
    """Return a speed one tick later, when it approaches a target at a rate."""
    step = rate * m.params.tick_s
    return speed + min(max(target - speed, -step), step)


@kernel
def _settle(m, speed):
    """Let a train follow the rollers for one tick, and count how long both have the set speed."""
    m.hold[TRAIN_M_S] = _approach(m.hold[TRAIN_M_S], speed, RATE_M_S2, m)
    rollers_off = abs(speed - m.hold[SET_M_S])
    train_off = abs(m.hold[TRAIN_M_S] - m.hold[SET_M_S])
    if max(rollers_off, train_off) < _NEAR_M_S:
        m.hold[AT_SET_SPEED_S] += m.params.tick_s
    else:
        m.hold[AT_SET_SPEED_S] = 0.0


@kernel
def _turn(state, tick_s):
    """Turn wheels and rollers for one tick."""
    for j in range(state.axles):
        state.wheel_angle[j] += tick_s * state.wheel_speed[j]
        state.roller_angle[j] += tick_s * state.roller_speed[j]


@kernel
def is_held(m, sync_ticks):
    """Return whether the rig is held in this tick; a released rig begins its run with a SYNC."""
    if m.control[HOLD] == RELEASED and m.control[HELD] % sync_ticks == 0:
        m.control[HOLD] = RUNNING
    return m.control[HOLD] != RUNNING
