"""`rollerrig bench sensors`: what false speed sensors cost the reference WSP.

The coach brakes from 120 km/h with an emergency demand, on each rail without a fault and with every
set of one to three false sensors, for every kind of fault. A row states the distance over that of
the whole stop, what n unbraked axles of four and 12 % would allow [N1], and the longest lock of an
axle with a good sensor above `LOCKS_ABOVE_M_S`. `--set` changes a value of all stops.

    [N1] s / s_whole <= 1.12 * 4 / (4 - n)
"""

import argparse
import itertools
import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.wsp_interface.magnets import FILLING, VENTING

AXLES = (1, 2, 3, 4)
RAILS = ("low", "very_low", "dry")
SPEED_KM_H = 120
BEGINS_AT_S = 2.0
# by name: the fault of an axle
FAULTS: dict[str, str] = {
    "dropout": "speed_sensor_dropout axle={axle}",
    "stuck": "speed_sensor_stuck axle={axle}",
    "drift up": "speed_sensor_drift axle={axle} rate_percent_s=2",
    "drift down": "speed_sensor_drift axle={axle} rate_percent_s=-2",
    "jump up": "speed_sensor_drift axle={axle} step_percent=30 rate_percent_s=0",
    "jump down": "speed_sensor_drift axle={axle} step_percent=-30 rate_percent_s=0",
    "noise": "speed_noise_burst axle={axle} std_rad_s=3",
}
# every set of one to three axles
SETS = tuple(axles for n in (1, 2, 3) for axles in itertools.combinations(AXLES, n))
# requirements
OTHERS_COST = 1.12
LONGEST_LOCK_S = 0.4
# cut-off speeds of protections are at most this
LOCKS_ABOVE_M_S = 1.0

_PRESSURE_PA = 3.8e5
_RECORD_HZ = 100
_LOCKED_M_S = 0.1


class Stop(NamedTuple):
    """The figures of one stop, the last two for each axle.

    A stroke of a valve is the beginning of a vent or of a fill.
    """

    distance_m: float  # infinite for a vehicle that does not stop
    longest_lock_s: tuple[float, ...]
    strokes_per_s: tuple[float, ...]


class Row(NamedTuple):
    """A stop with false sensors against the whole one."""

    rail: str
    fault: str
    axles: tuple[int, ...]
    over_whole: float
    allowed: float
    longest_lock_s: float  # of an axle with a good sensor


def allowed_over_whole(false_sensors: int) -> float:
    """Return the distance over the whole one that n false sensors may cost [N1]."""
    return OTHERS_COST * len(AXLES) / (len(AXLES) - false_sensors)


def stop(
    rail: str, speed_km_h: float, faults: Iterable[str] = (), settings: Sequence[str] = ()
) -> Stop:
    """Run a stop with faults as in `--fault`, without their time."""
    plan = scenario.load(
        "velim_a1",
        settings=(
            f"adhesion={rail}",
            f"initial_speed_m_s={speed_km_h / 3.6!r}",
            "duration_max_s=900.0",
            f"loop.record_hz={_RECORD_HZ}",
            *settings,
        ),
        tables={"demand": [{"from_s": 0.0, "pressure_Pa": _PRESSURE_PA}]},
        faults=tuple(f"{fault} at={BEGINS_AT_S}" for fault in faults),
    )
    channels = free.channels(free.moving(free.simulate(plan)), plan.table)
    speed_m_s = channels["vehicle_speed_m_s"]
    stands = speed_m_s[-1] < LOCKS_ABOVE_M_S
    locks_s = []
    strokes_per_s = []
    for axle in AXLES:
        rim_m_s = channels[f"wheel_circumferential_speed_{axle}_m_s"]
        locked = (rim_m_s < _LOCKED_M_S) & (speed_m_s > LOCKS_ABOVE_M_S)
        locks_s.append(longest(locked) / _RECORD_HZ)
        pairs = channels[f"magnets_{axle}"]
        begins = np.diff(pairs) != 0.0
        strokes = begins & np.isin(pairs[1:], (FILLING, VENTING))
        strokes_per_s.append(float(strokes.sum()) * _RECORD_HZ / len(pairs))
    distance_m = float(channels["position_m"][-1]) if stands else math.inf
    return Stop(distance_m, tuple(locks_s), tuple(strokes_per_s))


def longest(is_true: np.ndarray) -> int:
    """Return the number of samples of the longest run of a condition, shape (n,)."""
    return max((len([*run]) for holds, run in itertools.groupby(is_true) if holds), default=0)


def compared(
    rail: str,
    fault: str,
    axles: tuple[int, ...],
    speed_km_h: float = SPEED_KM_H,
    whole: Stop | None = None,
    settings: Sequence[str] = (),
) -> Row:
    """Return a stop with a fault of some axles against the whole one, which runs if not given."""
    whole = whole or stop(rail, speed_km_h, settings=settings)
    texts = [FAULTS[fault].format(axle=axle) for axle in axles]
    faulty = stop(rail, speed_km_h, texts, settings)
    good = [axle for axle in AXLES if axle not in axles]
    return Row(
        rail,
        fault,
        axles,
        faulty.distance_m / whole.distance_m,
        allowed_over_whole(len(axles)),
        max(faulty.longest_lock_s[axle - 1] for axle in good),
    )


def rows(say: Say = lambda _: None, settings: Sequence[str] = ()) -> list[Row]:
    """Return all rows."""
    result = []
    for rail in RAILS:
        whole = stop(rail, SPEED_KM_H, settings=settings)
        for fault in FAULTS:
            say(f"{rail}, {fault} ...")
            for axles in SETS:
                result.append(compared(rail, fault, axles, whole=whole, settings=settings))
    return result


def run(given: argparse.Namespace, say: Say) -> Result:
    """Return all rows and whether they meet the requirements."""
    found = rows(say, given.set)
    return {
        "stops": [row._asdict() for row in found],
        "targets": [
            target(
                "distance over what the lost axles allow, worst case",
                max(row.over_whole / row.allowed for row in found),
                1.0,
            ),
            target(
                "longest lock of an axle with a good sensor, s",
                max(row.longest_lock_s for row in found),
                LONGEST_LOCK_S,
            ),
        ],
    }


def _line_of(row: Result) -> tuple[str, str, int]:
    """Return what a line of the table is about: rail, fault and number of false sensors."""
    return row["rail"], row["fault"], len(row["axles"])


def table(result: Result) -> Table:
    """Return the table: for each rail, fault and number of false sensors the worst set."""
    heads = ["rail", "fault", "false", "over whole, worst", "allowed", "axles", "longest lock, s"]
    lines = []
    for (rail, fault, false), group in itertools.groupby(result["stops"], _line_of):
        same = [*group]
        worst = max(same, key=lambda row: row["over_whole"])
        lines.append(
            (
                rail,
                fault,
                false,
                f"{worst['over_whole']:.2f}",
                f"{worst['allowed']:.2f}",
                "+".join(map(str, worst["axles"])),
                f"{max(row['longest_lock_s'] for row in same):.2f}",
            )
        )
    return figures.table("stops from 120 km/h with false speed sensors", heads, lines)
