"""Makes the sentences on runs that differ from the others, and their entries in report.json."""

import math
from collections.abc import Sequence
from typing import Any

from rollerrig.configs.number_text import rounded
from rollerrig.realtime.reports.hints import sizes
from rollerrig.rig.identify.base import shared
from rollerrig.rig.identify.base.by_run import ByRun, Quantity
from rollerrig.rig.identify.decide.side_by_side import Apart, Difference, SideBySide
from rollerrig.rig.identify.statistics.interval import Estimate

_PERCENT = 100.0
# what differs, and what usually makes it differ
_WORDS = {
    Quantity.TORQUE: "the momentum for which brake_torque accounts",
    Quantity.LOAD: "the weight that all wheel_load carry",
    Quantity.LOAD_OF_AXLE: "the part of all loads in {channel}",
    Quantity.ROLLING: "the speed at which all wheelsets roll at one vehicle speed",
    Quantity.ROLLING_OF_AXLE: "{channel} of the rolling wheelset at one vehicle speed",
    Quantity.TO_FRONT: "the load that braking moves to the front",
    Quantity.FRICTION: "the friction of the sliding wheels",
    Quantity.NOISE: "the noise of {channel}",
}
_SUSPECTS = {
    Quantity.TORQUE: "torque sensors, mass or brake of another rig or day, or a gradient",
    Quantity.LOAD: "a payload that is not declared, or other load sensors",
    Quantity.LOAD_OF_AXLE: "another distribution of the payload, or another load sensor",
    Quantity.ROLLING: "other wheels, or another sensor of the vehicle's speed",
    Quantity.ROLLING_OF_AXLE: "a changed or turned wheel, or another speed sensor",
    Quantity.TO_FRONT: "a vehicle that runs in the other direction: number its wheelsets from the "
    "leading one in each run",
    Quantity.FRICTION: "a wetter or drier rail, or other rollers",
    Quantity.NOISE: "another sensor, or another filter",
}


def names(runs: Sequence[str]) -> str:
    """Return names of runs as words: "a", "a and b", "a, b and c"."""
    *others, last = runs
    return f"{', '.join(others)} and {last}" if others else last


def story(compared: SideBySide) -> list[str]:
    """Return a sentence on each group of runs that differ, and what to do about it."""
    lines = []
    for apart in compared.apart:
        head = "Run" if len(apart.runs) == 1 else "Runs"
        verb = "differs" if len(apart.runs) == 1 else "differ"
        what = "; ".join(_difference(one, compared) for one in apart.differences)
        line = f"{head} {names(apart.runs)} {verb} from {names(apart.others)}: {what}."
        of_all = shared.sentence(apart.runs, apart.shared)
        lines.append(f"{line} {of_all}".rstrip())
    return lines


def what_next(compared: SideBySide) -> str:
    """Return what to do about runs that differ; "" if none do."""
    if not compared.apart:
        return ""
    apart = compared.apart[0]
    quantities = [one.quantity for one in apart.differences if one.quantity is not None]
    suspects = [_SUSPECTS[quantity] for quantity in dict.fromkeys(quantities)]
    usual = f" Suspects: {'; '.join(suspects)}." if suspects else ""
    return (
        f"Measure next: find what is different in {names(apart.runs)}, and correct it or explain the "
        f"two groups of runs as two datasets.{usual}"
    )


def _difference(one: Difference, compared: SideBySide) -> str:
    """Return what differs and by how much, in words."""
    if one.quantity is None:
        return f"the size of {one.cause}, fitted to each run, differs by {_of_cause(one)}"
    text = _WORDS[one.quantity].format(channel=one.channel)
    by_run = quantity_of(one, compared)
    change = _relative(one.difference, _level(by_run), by_run.is_logarithm)
    value, low, high = (_PERCENT * share for share in change)
    is_less = value < 0.0
    if is_less:
        value, low, high = -value, -high, -low
    value_text, low_text, high_text = (rounded(share, 3) for share in (value, low, high))
    relation = "lower" if is_less else "higher"
    return f"{text} is {value_text} % {relation} ({low_text} to {high_text} %)"


def _of_cause(one: Difference) -> str:
    low, high = one.difference.interval()
    words = sizes.in_words(one.cause, one.difference.value)
    span = f"{rounded(low, 3)} to {rounded(high, 3)}"
    return f"{rounded(one.difference.value, 3)} ({span}), {words}"


def quantity_of(one: Difference, compared: SideBySide) -> ByRun:
    """Return the quantity of a difference in all runs."""
    for by_run in compared.quantities:
        if (by_run.quantity, by_run.channel) == (one.quantity, one.channel):
            return by_run
    raise KeyError(one.quantity)


def _level(by_run: ByRun) -> float:
    """Return the size that is 100 %: 1 of shares of a whole, else the mean of the runs."""
    if by_run.quantity is Quantity.LOAD_OF_AXLE:
        known = by_run.sizes[[math.isfinite(size) for size in by_run.sizes]]
        return float(known.mean())
    return 1.0


def _relative(difference: Estimate, level: float, is_logarithm: bool) -> tuple[float, float, float]:
    """Return a difference and its 95 % interval as shares."""
    low, high = difference.interval()
    if is_logarithm:
        return math.expm1(difference.value), math.expm1(low), math.expm1(high)
    return difference.value / level, low / level, high / level


# --- report.json ---


def as_json(compared: SideBySide) -> dict[str, Any]:
    """Return the entry `runs` of report.json."""
    return {
        "names": list(compared.runs),
        "quantities": [
            {
                "name": one.quantity.value,
                "channel": one.channel,
                "logarithm": one.is_logarithm,
                "by_run": _by_run(one.sizes, one.errors),
            }
            for one in compared.quantities
        ],
        "cause": _cause(compared),
        "differ": [_apart(one) for one in compared.apart],
    }


def _by_run(values: Any, errors: Any) -> list[dict[str, Any] | None]:
    """Return value and 95 % interval of each run, None for a run that does not show it."""
    found: list[dict[str, Any] | None] = []
    for value, error in zip(values.tolist(), errors.tolist(), strict=True):
        if math.isfinite(value) and math.isfinite(error):
            found.append({"value": value, "ci95": list(Estimate(value, error).interval())})
        else:
            found.append(None)
    return found


def _cause(compared: SideBySide) -> dict[str, Any] | None:
    if compared.cause is None:
        return None
    cause = compared.cause.cause
    by_run = _by_run(compared.cause.sizes, compared.cause.errors)
    return {"name": cause.name, "axle": cause.axle, "by_run": by_run}


def _apart(apart: Apart) -> dict[str, Any]:
    return {
        "runs": list(apart.runs),
        "others": list(apart.others),
        "common": {one.value: name for one, name in apart.shared.items()},
        "differences": [
            {
                "name": one.cause or str(one.quantity),
                "channel": one.channel,
                "difference": {
                    "value": one.difference.value,
                    "ci95": list(one.difference.interval()),
                },
            }
            for one in apart.differences
        ],
    }
