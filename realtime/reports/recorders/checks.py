"""Words for what a train recording could show: judged or not, why not, and the smallest size.

`rig.identify.train_recorder.judged` decides. All its words are here.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from rollerrig.realtime.reports import page as html
from rollerrig.rig.identify.train_recorder import judged
from rollerrig.rig.identify.train_recorder.judged import Check

_HEAD = ("what", "judged", "smallest size", "remark")

# reason of a check that was not made -> its words. {0} .. are the values of the check.
_REASONS = {
    judged.ONE_SPEED: "a single speed has nothing to be compared with; add another speed or a "
    "reference",
    judged.ONE_SPEED_NO_POSITION: "a single speed without a position does not show its unit; add "
    "another speed, a reference or the position",
    judged.NO_REFERENCE: "there is no reference; add reference_speed_m_s",
    judged.FEW_SPEEDS: "there is no reference and there are fewer than three speeds; add "
    "reference_speed_m_s",
    judged.SHORT: "the recording is too short",
    judged.ON_CHANGE: "the recorder logs only changes, so missing samples and held values are normal",
    judged.FEW_CHANGES: "the speed changes too little, the wheel slips, or a factor or an offset of its "
    "speed fits as well; record starts, stops and steady rolling",
    judged.FEW_BLOCKS: "steady driving is missing: {0:.0f} s above {1:.2g} m/s without hard braking are "
    "needed, and {2:.0f} s of the recording are so",
    judged.UNSTEADY: "the ratio to the vehicle varies by {0:.1f} % between blocks: the wheel slips "
    "or the vehicle turns; add yaw_rate_rad_s, or record straight rolling",
    judged.NO_RANGE: "the speeds lie between {0:.1f} and {1:.1f} m/s; record several speeds",
    judged.FEW_VISITS: "low or high speed occurs once only, where a curve or a slope looks like an "
    "offset; record low and high speeds several times",
    judged.OFFSET_OR_DELAY: "a delay of {0:.2g} s looks like an offset of {1:.2g} m/s while the vehicle "
    "brakes at one rate; record steady driving",
    judged.ONE_DATE: "all runs have one date, or only one date has enough data",
    judged.NOT_BRAKED: "the vehicle brakes for {0:.1f} s only",
    judged.TURNS: "the speeds differ because the vehicle turns, and there is no reference; add "
    "yaw_rate_rad_s or reference_speed_m_s",
    judged.NO_HARDEST: "a single speed falls faster than 3 m/s²: it slides or the vehicle brakes hard; "
    "add hardest_m_s2",
    judged.NOT_DRIVEN: "the vehicle drives faster than {1:.2g} m/s for {0:.1f} s only",
    judged.NO_POSITION: "there is no position; add position_m",
    judged.FEW_RUNS: "{0:.0f} runs with a position are needed, there are {1:.0f}",
    judged.NO_SPEED: "no speed has enough samples",
    judged.NO_PLANTED: "slides that were planted into braking of this recording do not show; brake for "
    "longer, or from higher speeds",
    judged.SLOW: "speeds of {0:.2g} m/s and more are needed, and the recording reaches {1:.2g} m/s",
    judged.SLOW_FOR_UNIT: "more than {0:.2g} m/s in a quarter of the time is needed, the recording has "
    "{1:.2g} m/s",
}

# what a size means, where its unit does not show it
_SIZES = {
    "wrong_unit": "a ratio of {0:.2g}",
    "clock_rate": "{0:.4g} times",
    "old_messages": "a jump of {0:.2g} m/s after 0.5 s or more",
    "clock_step": "{0:.2g} s while the speed changes",
    "slippery_place": "{0:.0f} runs that slide",
}


def as_json(check: Check, title: str) -> dict[str, Any]:
    """Return a check as JSON: name, judged, the reason, and the smallest size with its unit."""
    smallest = None
    if check.judged:
        smallest = {"value": check.smallest, "unit": check.unit}
    return {
        "name": check.name,
        "judged": check.judged,
        "reason": _remark(check) or None,
        "smallest": smallest,
        "channels_not_judged": list(check.channels),
        "text": sentence(check, title),
    }


def sentence(check: Check, title: str) -> str:
    """Return whether one kind of finding was judged, in words, without a full stop."""
    if not check.judged:
        return f"{title}: not judged, because {_remark(check)}"
    text = f"{title}: judged, from {size(check)} on"
    if check.channels:
        text += f"; not {', '.join(check.channels)}, because {_remark(check)}"
    return text


def size(check: Check) -> str:
    """Return the smallest size that would have been seen, with its unit."""
    words = _SIZES.get(check.name, "{0:.2g} " + check.unit)
    text = words.format(check.smallest)
    if check.name in ("slide", "driving_slip"):
        shortest_s, judged_s = check.values
        text += f" for {shortest_s:.2g} s, in {judged_s:.0f} s"
    elif check.name == "sensor_stuck" and check.values:
        text += f" while the others change by {check.values[0]:.2g} m/s"
    return text


def _remark(check: Check) -> str:
    return _REASONS[check.reason].format(*check.values) if check.reason else ""


def story(checks: Sequence[Check], titles: Mapping[str, str]) -> list[str]:
    """Return one line for what was judged, and one for each reason why something was not."""
    of_wheels: list[str] = []
    of_file: list[str] = []
    for check in checks:
        if check.judged:
            sizes = of_wheels if check.name in judged.OF_MOTION else of_file
            sizes.append(f"{titles[check.name]} {size(check)}")
    lines = []
    if of_wheels:
        lines.append(f"Judged of the wheels, from these sizes on: {'; '.join(of_wheels)}.")
    if of_file:
        lines.append(f"Judged of the file, from these sizes on: {'; '.join(of_file)}.")

    names_by_reason: dict[str, list[str]] = {}
    for check in checks:
        if check.reason:
            name = titles[check.name]
            if check.channels:
                name += f" of {', '.join(check.channels)}"
            names_by_reason.setdefault(_remark(check), []).append(name)
    for reason, names in names_by_reason.items():
        lines.append(f"Not judged: {', '.join(names)}, because {reason}.")
    return lines


def table(checks: Sequence[Check], titles: Mapping[str, str]) -> list[html.Markup]:
    """Return the table of all checks with its heading."""
    rows = []
    for check in checks:
        remark = _remark(check)
        if check.judged and check.channels:
            remark = f"not {', '.join(check.channels)}: {remark}"
        rows.append(
            (
                titles[check.name],
                "yes" if check.judged else "no",
                size(check) if check.judged else "",
                remark,
            )
        )
    return [html.element("h2", "What could be judged"), html.table(_HEAD, rows)]
