"""The brake pipe of a train: its pressure at each car, and the brake that the distributor demands.

The driver lowers the pressure at the head of the pipe. The change runs along the train at the speed
of propagation [Q1]. At each car the pressure follows with a lag that grows with the length of pipe
to the valve that changed it [Q2]: so the rear brakes later and more slowly. An emergency valve
empties the pipe at its car, and its wave runs to both ends. The distributor of each car demands a
cylinder pressure in proportion to the reduction, up to that of full service [Q3].

    [Q1] the level at a car at distance x from the valve changes at t + x / c
    [Q2] dp/dt = (level - p) / T, T = T_0 + T_1 x, times a factor while the pressure rises
    [Q3] p_demand = p_full min((p_0 - p) / dp_full, 1)

Source: [Q1] a speed of propagation, for which UIC 540 requires 250 m/s or more in an emergency
brake; [Q3] a pipe of 5 bar that full service reduces by 1.5 bar, UIC 540: both are recollection, to
be checked. [Q2] is the first-order form of such models (Pugi et al. 2007 and TrainDy solve the flow
along the pipe instead): its constants are assumptions.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.compiled import record_type
from rollerrig.rig.compiled.kernel import kernel


class Valve(NamedTuple):
    """A change at a valve on the pipe.

    level_Pa: the pressure to which the valve sets the pipe.
    is_emergency: the pipe stays empty from then on.
    """

    from_s: float
    place_m: float  # behind the head of the pipe
    level_Pa: float
    is_emergency: bool


class Form(NamedTuple):
    """Constants of the pipe, as in the keys of [train] with the same names."""

    speed_m_s: float
    time_constant_s: float
    time_constant_s_m: float
    release_factor: float
    pressure_Pa: float  # p_0
    full_reduction_Pa: float
    full_demand_Pa: float


class Pipe(NamedTuple):
    """The pipe at each car, with steps in the order in which they arrive."""

    pressure_Pa: np.ndarray  # (cars,), advances
    arrives_s: np.ndarray  # (cars, steps)
    level_Pa: np.ndarray  # (cars, steps)
    fall_share: np.ndarray  # (cars, steps): of the difference that a tick closes
    rise_share: np.ndarray  # (cars, steps)
    braked: np.ndarray  # (cars,): 0 where the brake is isolated
    form: Form


record_type.register(Form)
record_type.register(Pipe)


def build(
    form: Form,
    places_m: Sequence[float],
    valves: Sequence[Valve],
    isolated: Sequence[bool],
    tick_s: float,
) -> Pipe:
    """Return the charged pipe of a train.

    Parameters
    ----------
    places_m : distance of each car's distributor behind the head of the pipe
    valves : changes of the driver's valve (place 0) and of emergency valves
    isolated : for each car, whether its brake is isolated
    tick_s : length of a tick
    """
    cars = len(places_m)
    steps = max(len(valves), 1)
    pipe = Pipe(
        pressure_Pa=np.full(cars, form.pressure_Pa),
        arrives_s=np.full((cars, steps), math.inf),
        level_Pa=np.full((cars, steps), form.pressure_Pa),
        fall_share=np.ones((cars, steps)),
        rise_share=np.ones((cars, steps)),
        braked=np.array([float(not one) for one in isolated]),
        form=form,
    )
    for car, place_m in enumerate(places_m):
        arriving = sorted(
            (valve.from_s + abs(place_m - valve.place_m) / form.speed_m_s, order, valve)
            for order, valve in enumerate(valves)
        )
        is_empty = False
        for step, (arrives_s, _, valve) in enumerate(arriving):
            is_empty = is_empty or valve.is_emergency
            way_m = abs(place_m - valve.place_m)
            lag_s = form.time_constant_s + form.time_constant_s_m * way_m
            pipe.arrives_s[car, step] = arrives_s
            pipe.level_Pa[car, step] = 0.0 if is_empty else valve.level_Pa
            pipe.fall_share[car, step] = -math.expm1(-tick_s / lag_s)
            pipe.rise_share[car, step] = -math.expm1(-tick_s / (lag_s * form.release_factor))
    return pipe


@kernel
def advance(pipe, car, time_s):
    """Advance the pipe at a car by a tick; return the cylinder pressure in Pa that it demands."""
    step = -1
    for i in range(pipe.arrives_s.shape[1]):
        if time_s >= pipe.arrives_s[car, i]:
            step = i
    if step >= 0:
        missing_Pa = pipe.level_Pa[car, step] - pipe.pressure_Pa[car]
        falls = missing_Pa < 0.0
        share = pipe.fall_share[car, step] if falls else pipe.rise_share[car, step]
        pipe.pressure_Pa[car] += missing_Pa * share  # [Q2]
    form = pipe.form
    reduction = (form.pressure_Pa - pipe.pressure_Pa[car]) / form.full_reduction_Pa
    return pipe.braked[car] * form.full_demand_Pa * min(max(reduction, 0.0), 1.0)  # [Q3]
