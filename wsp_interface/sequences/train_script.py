"""The steps of a sequence whose scenario is a train: commands at times, judged after the run.

A train has no harness, because its brake demand reaches several cars. So the commands of the steps
become the demand and the faults of the train before it runs, and each of them needs a time that the
file states: only the last commands may precede an `until`. What the steps wait for and expect is
then judged by the record of the train.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import TRAIN
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.sequences.verdict import Result

# columns that a condition may compare
COLUMNS = ("vehicle_speed_m_s", "position_m", "time_s", "brake_demand_Pa")
# a ramp becomes steps of the demand, one each bus cycle of the rig
RAMP_STEP_S = 0.01


class Line(NamedTuple):
    """The result of what a step waits for, or of a condition, with what was wanted and found."""

    name: str
    wanted: str
    result: Result
    text: str


class Begun(NamedTuple):
    """A step that has begun."""

    title: str
    time_s: float


def check_start(start: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError for a key of [start] that a train does not have."""
    if "mass" in start:
        raise ConfigError(
            f"{where}: mass = {start['mass']!r}: the cars of a train have their loads in its file; "
            "remove mass"
        )


def check(steps: Sequence[Any], path: Any) -> None:
    """Raise ConfigError for what a step of a train cannot do. `steps` are of `sequence.Step`."""
    is_open = False
    for step in steps:
        where = f"{path}, line {step.line} [step]"
        for key, given in (
            ("sand", step.sand is not None),
            ("friction", step.friction is not None),
            ("lift", bool(step.lifts)),
        ):
            if given:
                raise ConfigError(
                    f"{where}: {key}: a train has no such command in a step; allowed are brake_demand "
                    "(set, ramp), fault with car=N and `for`, and [[friction]] of the sequence"
                )
        commands = step.brake_Pa is not None or step.ramp or step.faults
        if is_open and (commands or step.at_s is not None):
            raise ConfigError(
                f"{where}: a train gets its commands at times, and a step before waits `until`; give "
                "that step `for`, or let this one come first"
            )
        is_open = is_open or step.until is not None
        for condition in (*((step.until,) if step.until else ()), *step.expects):
            check_condition(condition, where)


def check_condition(condition: Condition, where: str) -> None:
    """Raise ConfigError for a condition on a signal that the whole train does not have."""
    if not set(condition.columns) <= set(COLUMNS):
        raise ConfigError(
            f"{where}: '{condition.text}': a condition of a train is on vehicle_speed, position, time "
            "or brake_demand; limit axles and couplers with [[measure]]"
        )


class _Commands(NamedTuple):
    demand: list[dict[str, float]]
    faults: list[str]


def commands(steps: Sequence[Any]) -> _Commands:
    """Return the [[demand]] of a train, and its faults as texts with their times."""
    demand: list[dict[str, float]] = []
    faults: list[str] = []
    now_s = 0.0
    pressure_Pa = 0.0
    for step in steps:
        now_s = max(now_s, step.at_s or 0.0)
        for text in step.faults:
            has_time = any(word.startswith(("at=", "at_s=")) for word in text.split())
            faults.append(text if has_time else f"{text} at={now_s:g}")
        if step.brake_Pa is not None:
            pressure_Pa = step.brake_Pa
            demand.append({"from_s": now_s, "pressure_Pa": pressure_Pa})
        if step.ramp:
            count = max(1, round(step.ramp.in_s / RAMP_STEP_S))
            for share in np.arange(1, count + 1) / count:
                to_Pa = pressure_Pa + float(share) * (step.ramp.to_Pa - pressure_Pa)
                from_s = now_s + float(share) * step.ramp.in_s
                demand.append({"from_s": round(from_s, 6), "pressure_Pa": to_Pa})
            pressure_Pa = step.ramp.to_Pa
        now_s += max(step.for_s or 0.0, step.ramp.in_s if step.ramp else 0.0)
    return _Commands(demand, faults)


def scenario_of(data: Mapping[str, Any], steps: Sequence[Any]) -> dict[str, Any]:
    """Return the file of a train with the demand of some steps. `data` has no demand."""
    return {**data, "demand": commands(steps).demand, TRAIN: data[TRAIN]}


def judged(
    steps: Sequence[Any], columns: Mapping[str, np.ndarray]
) -> tuple[list[Begun], list[Line], float]:
    """Return when each step began, what was found, and the time at which the last one ended.

    The time is infinite when a condition has not come true in time; then the sequence ends there.
    columns: those of COLUMNS, shape (n,) each.
    """
    begun: list[Begun] = []
    lines: list[Line] = []
    now_s = 0.0
    for number, step in enumerate(steps, start=1):
        now_s = max(now_s, step.at_s or 0.0)
        name = step.title or f"step {number}"
        if step.title:
            begun.append(Begun(step.title, now_s))
        if step.until:
            reached_s = _reached_s(step.until, columns, now_s, step.timeout_s, step.hold_s)
            if math.isinf(reached_s):
                wanted = f"{step.until.text} within {step.timeout_s:g} s"
                last = step.until.readings(_values(columns, columns["time_s"][-1]))
                why = f"not reached, last values {last}; the sequence ends here"
                return begun, [*lines, Line(name, wanted, Result.FAIL, why)], math.inf
            now_s = reached_s
            lines.append(Line(name, step.until.text, Result.PASS, f"at {now_s:.2f} s"))
        else:
            now_s += max(step.for_s or 0.0, step.ramp.in_s if step.ramp else 0.0)
        lines += [checked(name, condition, columns, now_s) for condition in step.expects]
    return begun, lines, now_s


def checked(
    name: str, condition: Condition, columns: Mapping[str, np.ndarray], time_s: float
) -> Line:
    """Return what was found of a condition at a time, or at the end of a shorter record."""
    values = _values(columns, time_s)
    result = Result.PASS if condition.holds(values) else Result.FAIL
    text = f"at {values['time_s']:.2f} s: {condition.readings(values)}"
    return Line(name, condition.text, result, text)


def _values(columns: Mapping[str, np.ndarray], time_s: float) -> dict[str, float]:
    """Return the last row that is not later than a time."""
    row = max(int(np.searchsorted(columns["time_s"], time_s, "right")) - 1, 0)
    return {name: float(columns[name][row]) for name in COLUMNS}


def _reached_s(
    until: Condition,
    columns: Mapping[str, np.ndarray],
    begin_s: float,
    timeout_s: float,
    hold_s: float,
) -> float:
    """Return when a condition has held for its time; infinite if not within the timeout."""
    time_s = columns["time_s"]
    since_s = math.inf
    for row in np.flatnonzero((time_s >= begin_s) & (time_s <= begin_s + timeout_s)):
        if until.holds({name: float(columns[name][row]) for name in COLUMNS}):
            since_s = min(since_s, float(time_s[row]))
            if time_s[row] - since_s >= hold_s:
                return float(time_s[row])
        else:
            since_s = math.inf
    return math.inf
