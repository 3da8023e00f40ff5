"""The comparison of two campaigns as tables, sentences and numbers for programs."""

import math
from collections.abc import Sequence
from typing import Any

from rollerrig.configs.number_text import rounded
from rollerrig.realtime.campaign import comparison
from rollerrig.realtime.campaign.comparison import Compared, Comparison
from rollerrig.realtime.campaign.outcome import QUANTILES
from rollerrig.realtime.campaign.statistics import differences
from rollerrig.realtime.record import figures
from rollerrig.realtime.record.run_folder import short_names

MEDIAN = QUANTILES.index(0.5)
HIGH = QUANTILES.index(0.95)
WORST = QUANTILES.index(1.0)

_CONFIDENCE = f"{100 * differences.CONFIDENCE:g} %"
# a table: its title, its head and its rows, as `commands.output` prints it
Table = tuple[str | None, tuple[str, ...], list[tuple[str, ...]]]


def names(found: Comparison) -> tuple[str, str]:
    """Return a short name for each campaign."""
    first, second = short_names([side.folder for side in found.sides])
    return first, second


def figure_table(found: Comparison) -> Table:
    """Return the figures of both campaigns, as the page of each campaign has them."""
    first, second = names(found)
    head: tuple[str, ...] = ("figure",)
    for what in ("median", "95 %", "worst"):
        head += (f"{what}: {first}", f"{what}: {second}")
    rows = []
    for figure in found.compared:
        cells = [_title(figure.name)]
        for place in (MEDIAN, HIGH):
            cells += [_quantile(figure, side, place) for side in (0, 1)]
        for side in (0, 1):
            run = figure.worst_runs[side]
            value = _quantile(figure, side, WORST)
            values = figure.quantiles[side]
            # if all runs have the same value, none of them is the worst one
            is_named = run is not None and values[0] < values[-1]
            cells.append(f"{value} (run {run})" if is_named else value)
        rows.append(tuple(cells))
    return None, head, rows


def run_table(found: Comparison) -> Table:
    """Return the numbers of runs of both campaigns."""
    outcomes = [side.found for side in found.sides]
    rows = [
        ("runs", *(str(one.runs) for one in outcomes)),
        ("did not stop within their time", *(str(one.not_stopped) for one in outcomes)),
        ("not valid, in no figure", *(str(one.not_valid) for one in outcomes)),
        ("failed, in no figure", *(str(one.failed) for one in outcomes)),
    ]
    return None, ("", *names(found)), rows


def difference_table(found: Comparison) -> Table:
    """Return by how much the second campaign differs from the first one in each figure."""
    first, second = names(found)
    change = "median change" if found.is_paired else "change of the median"
    head: tuple[str, ...] = (f"{second} against {first}", change, f"confidence {_CONFIDENCE}")
    if found.is_paired:
        head += ("worse", "better", "equal")
    head += ("more than chance?",)
    rows = []
    for figure in found.compared:
        difference = figure.difference
        if difference is None:
            continue
        cells = [_title(figure.name), _signed(figure.name, difference.median), _interval(figure)]
        if figure.counts is not None:
            cells += [str(count) for count in figure.counts]
        if difference.p_value is None:
            cells.append("-")
        else:
            significant = differences.is_significant(difference.p_value)
            cells.append(f"{'yes' if significant else 'no'}, {_p_value(difference.p_value)}")
        rows.append(tuple(cells))
    return None, head, rows


# --- sentences ---


def sentences(found: Comparison) -> list[str]:
    """Return what the comparison has found, for a brake engineer."""
    first, second = names(found)
    lines = [_what_differs(found)]
    if found.is_paired:
        lines.append(_pairing(found))
    else:
        lines.append(
            f"The runs are not compared in pairs: {found.unpaired_because}. The two campaigns are "
            "two samples."
        )
    if found.untested_because:
        lines.append(
            f"No intervals and no test: {found.untested_because}. The differences hold for these "
            "runs only."
        )
    elif found.is_even:
        lines.append(
            "The design fills its ranges more evenly than independent draws: use intervals and p for "
            'orientation, and design = "random" for a statement.'
        )
    lines.append(_verdict(found, first, second))
    if others := _others(found, second):
        lines.append(others)
    return lines


def _what_differs(found: Comparison) -> str:
    first, second = names(found)
    if found.differs:
        texts = [f"{what}: {one} and {other}" for what, one, other in found.differs]
        return f"{first} and {second} differ in {'; '.join(texts)}."
    if found.other_inputs:
        return f"{first} and {second} differ in the values of {', '.join(found.other_inputs)}."
    if found.sides[0].fingerprint == found.sides[1].fingerprint:
        return f"{first} and {second} are of the same plan, scenario and unit."
    return (
        f"The tops of the plans of {first} and {second} are the same; the inputs, the scenario or "
        "the parameters of the unit differ."
    )


def _pairing(found: Comparison) -> str:
    first, second = names(found)
    distance = found.compared[0] if found.compared else None
    text = f"Run n of {first} and run n of {second} are a pair: "
    if found.other_inputs:
        text += f"they have the same random numbers, and differ in {', '.join(found.other_inputs)}."
    else:
        text += "they have the same values of all inputs."
    if distance is not None and (distance.only_first or distance.only_second):
        text += (
            f" {distance.only_first} runs have a stopping distance in {first} only, and "
            f"{distance.only_second} in {second} only: these are in no difference."
        )
    return text


def _verdict(found: Comparison, first: str, second: str) -> str:
    """Return the sentence on the stopping distance."""
    distance = next((one for one in found.compared if one.name == comparison.DISTANCE), None)
    if distance is None or distance.difference is None:
        return "No stopping distance: a campaign has no run that counts."
    difference = distance.difference
    if not difference.median:
        text = f"{second} stops in the same distance as {first} (median)"
    else:
        longer = "longer" if difference.median > 0.0 else "shorter"
        text = f"{second} stops {longer} than {first}: by {_size(distance, first)}"
    if math.isfinite(difference.low) and math.isfinite(difference.high):
        text += f"; with a confidence of {_CONFIDENCE} the change is {_interval(distance)} m"
    text += "."
    counts = distance.counts
    if counts is not None:
        text += (
            f" {second} is worse in {counts.larger} of {counts.pairs} pairs, better in "
            f"{counts.smaller}, equal in {counts.equal}."
        )
    return text + _chance(found, distance)


def _others(found: Comparison, second: str) -> str:
    """Return the other figures whose change is more than chance, as a sentence; "" without any."""
    better: list[str] = []
    worse: list[str] = []
    for figure in found.compared:
        difference = figure.difference
        if figure.name == comparison.DISTANCE or difference is None:
            continue
        if not differences.is_significant(difference.p_value):
            continue
        change = difference.median
        if figure.counts is not None:
            change = figure.counts.larger - figure.counts.smaller
        if change:
            # of all compared figures less is better
            (worse if change > 0 else better).append(figures.BY_NAME[figure.name].title)
    parts = []
    if better:
        parts.append(f"better in {', '.join(better)}")
    if worse:
        parts.append(f"worse in {', '.join(worse)}")
    if not parts:
        return ""
    return f"Of the other figures, {second} is {' and '.join(parts)}: this is more than chance."


def _size(distance: Compared, first: str) -> str:
    """Return the median difference of the stopping distance without its sign, also as a share."""
    assert distance.difference is not None
    median_m = abs(distance.difference.median)
    if not math.isfinite(median_m):
        return "more than any distance (median; it does not stop)"
    text = f"{rounded(median_m, digits=3)} m (median)"
    if distance.quantiles[0]:
        text += f", {100 * median_m / distance.quantiles[0][MEDIAN]:.2g} % of the median of {first}"
    return text


def _chance(found: Comparison, distance: Compared) -> str:
    """Return whether the difference is more than chance."""
    assert distance.difference is not None
    p_value = distance.difference.p_value
    if found.untested_because:
        return ""
    if p_value is None:
        low, high = distance.difference.low, distance.difference.high
        if low > 0.0 or high < 0.0:
            return " This is more than chance: the interval does not contain 0."
        return " This may be chance: the interval contains 0."
    test = "Wilcoxon signed rank" if found.is_paired else "Mann-Whitney"
    if differences.is_significant(p_value):
        return f" This is more than chance ({_p_value(p_value)}, {test})."
    return (
        f" This may be chance ({_p_value(p_value)}, {test}): more runs would show a smaller "
        "difference."
    )


def worst_lines(found: Comparison) -> list[str]:
    """Return the runs that became worst, with the commands that repeat them."""
    first, second = names(found)
    if not found.is_paired:
        lines = [f"The longest stops of {second}:"]
        for case in found.became_worse:
            lines.append(f"  run {case.run}: {_metres(case.second_m)}: {case.commands[0]}")
        return lines
    if not found.became_worse:
        return [f"No run stops longer in {second}."]
    lines = [f"The runs that became worst in {second}:"]
    for case in found.became_worse:
        change = ""
        if case.first_m is not None and case.second_m is not None:
            change = f" ({case.second_m - case.first_m:+.1f} m)"
        lines.append(
            f"  run {case.run}: {_metres(case.first_m)} -> {_metres(case.second_m)}{change}"
        )
        for name, command in zip((first, second), case.commands, strict=True):
            lines.append(f"    {name}: {command}")
    return lines


# --- numbers for programs ---


def as_json(found: Comparison) -> dict[str, Any]:
    """Return the comparison as numbers, in the units of the names; None for a missing number."""
    campaigns = []
    for side in found.sides:
        campaigns.append(
            {
                "folder": str(side.folder),
                "runs": side.found.runs,
                "planned": side.planned,
                "not_stopped": side.found.not_stopped,
                "not_valid": side.found.not_valid,
                "failed": side.found.failed,
            }
        )
    return {
        "campaigns": campaigns,
        "differs": [{"what": what, "values": [one, other]} for what, one, other in found.differs],
        "paired": found.is_paired,
        "unpaired_because": found.unpaired_because or None,
        "other_inputs": found.other_inputs,
        "untested_because": found.untested_because or None,
        "confidence": differences.CONFIDENCE,
        "figures": [_figure_json(figure) for figure in found.compared],
        "became_worse": [case._asdict() for case in found.became_worse],
    }


def _figure_json(figure: Compared) -> dict[str, Any]:
    result: dict[str, Any] = {"name": figure.name}
    for key, place in (("median", MEDIAN), ("quantile_95", HIGH), ("worst", WORST)):
        result[key] = [values[place] if values else None for values in figure.quantiles]
    result["worst_run"] = list(figure.worst_runs)
    difference = figure.difference
    result["difference"] = None
    if difference is not None:
        result["difference"] = {
            "median": _finite(difference.median),
            "low": _finite(difference.low),
            "high": _finite(difference.high),
            "p_value": difference.p_value,
            "significant": (
                None
                if difference.p_value is None
                else differences.is_significant(difference.p_value)
            ),
        }
    result["pairs"] = None
    if figure.counts is not None:
        result["pairs"] = {
            "worse": figure.counts.larger,
            "better": figure.counts.smaller,
            "equal": figure.counts.equal,
            "only_first": figure.only_first,
            "only_second": figure.only_second,
        }
    return result


def warnings(found: Comparison) -> list[str]:
    """Return what limits the comparison: campaigns that are not finished, and lost runs."""
    texts = []
    for side in found.sides:
        if side.found.runs < side.planned:
            texts.append(
                f"{side.folder}: {side.found.runs} of {side.planned} runs are there; repeat its "
                "'rollerrig campaign' to finish it"
            )
        if side.found.failed:
            texts.append(f"{side.folder}: {side.found.failed} runs failed and are in no figure")
        if side.found.not_valid:
            texts.append(
                f"{side.folder}: {side.found.not_valid} runs are not valid and in no figure"
            )
    return texts


# --- cells ---


def _title(name: str) -> str:
    figure = figures.BY_NAME[name]
    return f"{figure.title}, {figure.unit}" if figure.unit else figure.title


def _quantile(figure: Compared, side: int, place: int) -> str:
    values: Sequence[float] = figure.quantiles[side]
    return rounded(figures.BY_NAME[figure.name].scale * values[place]) if values else "-"


def _signed(name: str, value: float) -> str:
    scaled = figures.BY_NAME[name].scale * value
    sign = "+" if scaled > 0.0 else ""
    return f"{sign}{rounded(scaled, digits=3)}"


def _interval(figure: Compared) -> str:
    difference = figure.difference
    if difference is None or not (math.isfinite(difference.low) and math.isfinite(difference.high)):
        return "-"
    return f"{_signed(figure.name, difference.low)} to {_signed(figure.name, difference.high)}"


def _p_value(value: float) -> str:
    return "p < 0.0001" if value < 1e-4 else f"p = {value:.2g}"


def _metres(value_m: float | None) -> str:
    return "not stopped" if value_m is None else f"{value_m:.1f} m"


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
