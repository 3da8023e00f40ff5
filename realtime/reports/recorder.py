"""The report of a train recording: JSON, sentences and the page.

`rig.identify.train_recorder` returns typed findings. All their words are here.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from rollerrig.realtime.reports import page as html
from rollerrig.realtime.reports.recorders import checks, pictures
from rollerrig.realtime.reports.study import StudyReport, verdict_and_sentences
from rollerrig.rig.identify.train_recorder import findings
from rollerrig.rig.identify.train_recorder.findings import (
    NAMES,
    ClockRate,
    ClockStep,
    CopyOfChannel,
    CopySource,
    Cycle,
    Delay,
    DropOut,
    Finding,
    OffsetOrDelay,
    ReferenceOff,
    RivalOffset,
    ScaleOrOffset,
    SharedPlace,
    Sliding,
    Slipping,
    SpeedDrop,
    SpeedFactor,
    SpeedLine,
    SpeedOffset,
    SpeedScatter,
    StuckValue,
    WheelRadius,
    WrongUnit,
)
from rollerrig.rig.identify.train_recorder.sliding.slides import Slide
from rollerrig.rig.identify.train_recorder.verdict import Account

# name of a finding -> its words
TITLES = {
    "wrong_unit": "wrong unit",
    "clock_step": "clock step",
    "clock_rate": "clock rate",
    "old_messages": "old messages at the start",
    "copy": "copy",
    "interpolated": "gap filled by a straight line",
    "sensor_dropout": "drop-out",
    "sensor_stuck": "stuck sensor",
    "speed_sensor_delay": "delay",
    "wheel_radius": "different wheel radius",
    "wheel_radius_step": "step of a wheel radius",
    "speed_scale": "scale of a speed",
    "speed_offset": "offset of a speed",
    "slide": "slide",
    "driving_slip": "driving slip",
    "slippery_place": "slippery place",
    "unknown": "unknown",
}
VERDICTS = {
    "consistent": "Nothing in the recording is statistically significant, from the sizes below on.",
    "not_judged": "The recording could not be judged.",
    "explained": "Everything that is statistically significant has a cause.",
    "partly": "Some of the findings have a cause. Others have none in this list.",
    "unexplained": "Something is statistically significant, and no cause in this list explains it.",
}
_DROP_OUT_REASONS = {
    findings.NO_SAMPLES: "no samples",
    findings.NO_VALUES: "no values",
    findings.ZEROS: "zeros",
}
_UNIT_EVIDENCE = {
    findings.POSITION: "shown by the position",
    findings.OTHER_CHANNELS: "shown by the other channels",
}

# findings of one kind in the sentences; the page has all of them
_MOST_SENTENCES = 4

# findings that are episodes of the motion and no causes
_EPISODES = ("slide", "driving_slip")

# findings that hold for whole runs; the picture of the wheels shows them
_WITHOUT_PICTURE = (
    "wheel_radius",
    "wheel_radius_step",
    "wrong_unit",
    "speed_scale",
    "speed_offset",
    "clock_rate",
)

# rows of the table of findings before the fold
_MOST_ROWS = 30
_HEAD = ("what", "channels", "where", "size (95 %)", "in words")


def report(account: Account) -> StudyReport:
    """Return the whole report."""
    return StudyReport(
        result=as_json(account),
        page=page(account),
        summary=verdict_and_sentences(account.verdict, account.recording.name, story(account)),
    )


# --- JSON ---


def as_json(account: Account) -> dict[str, Any]:
    """Return the content of report.json: causes, episodes of sliding, and findings without a
    cause.
    """
    axles = {
        channel.name: channel.axle
        for run in account.recording.runs
        for channel in run.channels.values()
        if channel.axle
    }
    causes = [finding for finding in account.findings if finding.name not in _EPISODES]
    slips = [finding for finding in account.findings if finding.name == "driving_slip"]
    episodes = [_episode_json(slide, axles) for slide in account.slides]
    episodes += [_slip_json(finding, axles) for finding in slips]
    return {
        "verdict": account.verdict,
        "kind": "recorder",
        "dataset": account.recording.name,
        "runs": len(account.recording.runs),
        "causes": [_finding_json(finding, axles) for finding in causes],
        "episodes": episodes,
        "checks": [checks.as_json(check, TITLES[check.name]) for check in account.checks],
        "unknown": [_finding_json(finding, axles) for finding in account.unknown],
        "notes": account.recording.warnings,
        "elapsed_s": round(account.elapsed_s, 1),
    }


def _finding_json(finding: Finding, axles: dict[str, int]) -> dict[str, Any]:
    """Return a finding as JSON; `axles`: number of the axle by channel."""
    result: dict[str, Any] = {
        "name": finding.name,
        "axles": [axles[name] for name in finding.channels if name in axles] or None,
        "channels": list(finding.channels),
    }
    if finding.date:
        result["date"] = finding.date
    if finding.run:
        result["run"] = finding.run
        result["start_s"] = round(finding.start_s, 3)
        result["end_s"] = round(finding.end_s, 3)
    if finding.place_m is not None:
        result["place_m"] = list(finding.place_m)
    result["text"] = sentence(finding)
    result["parameters"] = {
        "size": _parameter(finding.size, finding.low, finding.high, finding.unit)
    }
    if isinstance(finding.details, SpeedLine):
        result["parameters"]["scale"] = _parameter(*finding.details.scale_percent, "%")
        result["parameters"]["offset"] = _parameter(*finding.details.offset_m_s, "m/s")
    if isinstance(finding.details, WheelRadius) and finding.details.rival is not None:
        result["rival"] = {"name": "speed_offset", **finding.details.rival._asdict()}
    return result


def _parameter(value: float, low: float, high: float, unit: str) -> dict[str, Any]:
    """Return a value with its 95 % interval and its unit as JSON."""
    return {"value": value, "ci95": [low, high], "unit": unit}


def _episode_json(slide: Slide, axles: dict[str, int]) -> dict[str, Any]:
    """Return an episode of sliding: its finding, with the adhesion used."""
    details = slide.finding.details
    assert isinstance(details, Sliding)
    return _finding_json(slide.finding, axles) | {
        "adhesion_used": _not_negative(slide.adhesion.mean),
        "adhesion_used_at_least": _not_negative(slide.adhesion.low),
        "cycles": _cycles_json(details.cycles),
    }


def _slip_json(finding: Finding, axles: dict[str, int]) -> dict[str, Any]:
    """Return an episode of driving slip."""
    assert isinstance(finding.details, Slipping)
    return _finding_json(finding, axles) | {
        "slip_share": finding.details.most_share,
        "cycles": _cycles_json(finding.details.cycles),
    }


def _cycles_json(cycles: Sequence[Cycle]) -> list[dict[str, Any]]:
    """Return the cycles of an episode: each time that a wheel slides or slips and recovers."""
    return [
        {
            "channel": cycle.channel,
            "start_s": round(cycle.start_s, 3),
            "end_s": round(cycle.end_s, 3),
            "depth_m_s": cycle.depth_m_s,
        }
        for cycle in cycles
    ]


def _not_negative(adhesion: float) -> float | None:
    """Return an adhesion, at least 0; None where it is unknown."""
    return max(adhesion, 0.0) if np.isfinite(adhesion) else None


# --- sentences ---


def sentence(finding: Finding) -> str:
    """Return the words of a finding, without a full stop."""
    match finding.details:
        case WrongUnit() as unit:
            return _unit_sentence(finding.channels[0], unit)
        case ClockStep() as step:
            return _clock_sentence(finding.size, step)
        case ClockRate() as rate:
            return (
                f"the stamps of {rate.channel} run at {finding.size:.5g} times the rate of the wheels; "
                "they are corrected below"
            )
        case DropOut() as drop_out:
            return ", then ".join(_DROP_OUT_REASONS[reason] for reason in drop_out.reasons)
        case StuckValue() as stuck:
            return f"held at {stuck.speed_m_s:.2f} m/s"
        case CopySource() as source:
            return f"the same samples as {source.run} from {source.start_s:.1f} s on; they are left out"
        case CopyOfChannel() as copy:
            return (
                f"has the values of {copy.channel} in every sample: one sensor, or one column, counts "
                "twice; it is left out"
            )
        case Delay() as delay:
            return _delay_sentence(finding.size, delay)
        case WheelRadius() as radius:
            return _radius_sentence(finding, radius)
        case SpeedLine() as line:
            return _line_sentence(finding, line)
        case Sliding() as sliding:
            return _slide_sentence(finding.size, sliding)
        case Slipping() as slipping:
            return (
                f"slips in driving for {slipping.duration_s:.1f} s, up to "
                f"{100.0 * slipping.most_share:.0f} % faster than the vehicle"
            )
        case SharedPlace() as place:
            return _place_sentence(finding, place)
        case SpeedOffset() as offset:
            direction = "faster" if offset.faster else "slower"
            return f"{direction} than the vehicle, which is not braked hard there"
        case ReferenceOff() as off:
            direction = "faster" if off.faster else "slower"
            return (
                f"{direction} than all {off.wheels} wheels, which agree with each other: the reference "
                "is off, or all wheels slip by the same amount"
            )
        case SpeedDrop() as drop:
            return (
                f"drops by {finding.size:.2g} m/s for {drop.duration_s:.2g} s in braking, which is too "
                "short to be judged as a slide"
            )
        case SpeedFactor() as factor:
            return _factor_sentence(finding, factor)
        case OffsetOrDelay() as rivals:
            return _offset_or_delay_sentence(finding, rivals)
        case ScaleOrOffset() as rivals:
            return _scale_or_offset_sentence(rivals)
        case SpeedScatter() as scatter:
            return (
                f"scatters by {finding.size:.2f} m/s from sample to sample, "
                f"{scatter.times_usual:.0f} times as much as usual"
            )
    if finding.name == "old_messages":
        return "the values do not continue into the following samples; these are old messages"
    return "a straight line across a gap; it is left out"  # interpolated


def _unit_sentence(channel: str, unit: WrongUnit) -> str:
    return (
        f"{channel} is in {unit.true_unit} and declared as {unit.declared_unit}, "
        f"{_UNIT_EVIDENCE[unit.evidence]}; it is converted below"
    )


def _clock_sentence(size_s: float, step: ClockStep) -> str:
    text = f"the stamps jump by {size_s:+.3f} s while the motion continues"
    if step.whole_seconds:
        text += f", {step.whole_seconds:+d} s exactly"
    if step.returns:
        text += "; they jump back at the end"
    return text


def _delay_sentence(size_s: float, delay: Delay) -> str:
    against = delay.against
    if not against:
        against = "the wheels" if delay.of_reference else "the other speeds"
    return f"{'late' if size_s > 0 else 'early'} against {against}"


def _radius_sentence(finding: Finding, radius: WheelRadius) -> str:
    wheels = f"wheels of {radius.vehicle_id}" if radius.vehicle_id else "wheels"
    if finding.name == "wheel_radius":
        text = f"the radius of the {wheels} differs from the setting of the recorder"
        if radius.until is not None:
            text += f" until {radius.until}"
    else:
        date = finding.date or "an unknown date"
        text = (
            f"the radius of the {wheels} steps on {date}: turned wheels or a changed setting of the "
            "recorder"
        )
    if radius.ambiguous:
        text += "; the data cannot distinguish which of the two is wrong"
    if radius.rival is not None:
        text += _rival_offset_words(radius.rival)
    return text


def _rival_offset_words(rival: RivalOffset) -> str:
    """Return the words for an offset that looks like a radius."""
    lowest_m_s, highest_m_s = rival.speeds_m_s
    if not rival.radius_percent:
        return (
            f", or its speed has an offset of {rival.offset_m_s:+.2g} m/s: the speeds of "
            f"{lowest_m_s:.1f} to {highest_m_s:.1f} m/s do not distinguish the two"
        )
    return (
        f", or its speed has an offset of {rival.offset_m_s:+.2g} m/s beside a radius of "
        f"{rival.radius_percent:+.2g} %: low or high speed occurs once, which does not distinguish "
        "the two"
    )


def _line_sentence(finding: Finding, line: SpeedLine) -> str:
    scale, scale_low, scale_high = line.scale_percent
    offset, offset_low, offset_high = line.offset_m_s
    against = "all wheels" if line.of_reference else "the vehicle"
    text = (
        f"reads {1.0 + scale / 100.0:.4g} v {offset:+.2g} m/s against {against}: scale "
        f"{scale:+.2f} % ({scale_low:.2f} to {scale_high:.2f}), offset {offset:+.2f} m/s "
        f"({offset_low:.2f} to {offset_high:.2f})"
    )
    if line.of_reference:
        text += (
            "; the reference reads so, or the radius setting of all wheels is wrong, or all wheels "
            "slip steadily"
        )
    elif finding.name == "speed_scale":
        text += "; no wheel radius differs so much: a setting, a unit, or steady slip"
    return text


def _factor_sentence(finding: Finding, factor: SpeedFactor) -> str:
    of_what = f"the speed of {factor.rival}" if factor.rival else "the speed"
    causes = "another wheel radius, or the wheel slips"
    if factor.rival:
        causes = "another wheel radius of one of the two, or one of them slips"
    return (
        f"{finding.channels[0]} shows {factor.factor:.3f} times {of_what} while the speed changes: "
        f"{causes}; record steady rolling to distinguish them"
    )


def _offset_or_delay_sentence(finding: Finding, rivals: OffsetOrDelay) -> str:
    text = (
        f"{finding.channels[0]} has an offset of {rivals.offset_m_s:+.2g} m/s or a delay of "
        f"{rivals.delay_s:+.2g} s"
    )
    if rivals.rival:
        text += f", or {rivals.rival} has it with the other sign"
    return text + (
        ": while the vehicle brakes at one rate they look alike; record steady driving to "
        "distinguish them"
    )


def _scale_or_offset_sentence(rivals: ScaleOrOffset) -> str:
    lowest, highest = rivals.speeds_m_s
    return (
        f"reads {rivals.scale_percent:+.2g} % or {rivals.offset_m_s:+.2g} m/s against all wheels: a "
        f"factor and an offset look alike, because most speeds lie between {lowest:.0f} and "
        f"{highest:.0f} m/s; record low and high speeds to distinguish them"
    )


def _slide_sentence(size_m_s: float, sliding: Sliding) -> str:
    if np.isfinite(sliding.adhesion_at_least):
        adhesion = f"adhesion used at least {max(sliding.adhesion_at_least, 0.0):.3f}"
    else:
        adhesion = "the adhesion used is unknown without a reference"
    cycles = ""
    if len(sliding.cycles) > 1:
        cycles = f" in {len(sliding.cycles)} cycles"
    return (
        f"slides for {sliding.duration_s:.2g} s{cycles} from {sliding.initial_speed_m_s:.1f} m/s, up "
        f"to {size_m_s:.1f} m/s below the vehicle; {adhesion}"
    )


def _place_sentence(finding: Finding, place: SharedPlace) -> str:
    assert finding.place_m is not None
    start_m, end_m = finding.place_m
    return (
        f"{place.most_runs} runs slide between {start_m:.0f} and {end_m:.0f} m "
        f"({', '.join(place.runs)}); by chance in {100 * place.chance:.1g} % of such recordings or less"
    )


def size(finding: Finding) -> str:
    """Return the size of a finding with its interval and unit."""
    # a clock that is a little fast has a rate near 1
    digits = 5 if finding.name == "clock_rate" else 3
    value, low, high = (f"{x:.{digits}g}" for x in (finding.size, finding.low, finding.high))
    return f"{value} ({low} to {high}) {finding.unit}"


def channels(account: Account, finding: Finding) -> str:
    """Return the channels of a finding in words."""
    speeds = {
        channel.name for run in account.recording.runs for channel in run.of("speed", "reference")
    }
    if len(speeds) > 1 and speeds <= set(finding.channels):
        return "all channels"
    return ", ".join(finding.channels)


def story(account: Account) -> list[str]:
    """Return the verdict and the findings in sentences: of each kind the largest, and how many
    more.
    """
    lines = [VERDICTS[account.verdict]]
    for name in NAMES:
        of_kind = [f for f in (*account.findings, *account.unknown) if f.name == name]
        largest_first = sorted(of_kind, key=lambda finding: -abs(finding.size))
        for k, finding in enumerate(largest_first[:_MOST_SENTENCES]):
            place = _channels_and_place(account, finding)
            if k == 0:
                title = TITLES[name].capitalize()
                lines.append(f"{title}: {place}: {size(finding)}; {sentence(finding)}.")
            else:
                lines.append(f"  also {place}: {size(finding)}.")
        if len(of_kind) > _MOST_SENTENCES:
            lines.append(f"  and {len(of_kind) - _MOST_SENTENCES} more of this kind.")
    lines += checks.story(account.checks, TITLES)
    return lines + [f"Note: {note}." for note in account.recording.warnings]


def _channels_and_place(account: Account, finding: Finding) -> str:
    words = channels(account, finding)
    if finding.run:
        return f"{words} in {finding.run}, {finding.start_s:.1f} to {finding.end_s:.1f} s"
    return f"{words} {finding.date}" if finding.date else words


# --- page ---


def page(account: Account) -> str:
    """Return the HTML page, which needs no other files."""
    found = [*account.findings, *account.unknown]
    parts: list[str] = [
        html.paragraph(f"Verdict: {account.verdict}. {VERDICTS[account.verdict]}", kind="note")
    ]
    parts += [html.paragraph(line) for line in story(account)[1:]]
    for name in NAMES:
        parts += _picture(account, [finding for finding in found if finding.name == name])

    parts += [
        html.element("h2", "How far each wheel is from the vehicle"),
        html.paragraph("Medians of blocks in which nobody brakes hard; bars are 95 % intervals."),
        html.picture(partial(pictures.wheels, account=account), (10.0, 3.2)),
    ]
    parts += _table_of_findings(account, found)

    parts += checks.table(account.checks, TITLES)
    parts.append(
        html.paragraph(
            "Adhesion is the mean over all wheels, from the deceleration of the vehicle. It assumes "
            "level track (10 per mille uphill add 0.010), no other brake that acts on the rail, and a "
            "running resistance below 0.05 m/s². Times are those after the correction of clock steps."
        )
    )
    return html.page(f"What the recording shows: {account.recording.name}", *parts)


def _picture(account: Account, of_kind: Sequence[Finding]) -> list[html.Markup]:
    """Return the largest finding of one kind as a picture with its heading; none of radii and
    units.
    """
    if not of_kind:
        return []
    largest = max(of_kind, key=lambda finding: abs(finding.size))
    if largest.name in _WITHOUT_PICTURE:
        return []

    if largest.name == "slide":
        title = f"The largest slide: {largest.run}"
        draw, inches = pictures.slide, (10.0, 4.2)
    elif largest.name == "slippery_place":
        title = "Where runs slide"
        draw, inches = pictures.places, (10.0, 2.8)
    elif largest.name == "speed_sensor_delay":
        title = f"Delay: {largest.channels[0]}"
        draw, inches = pictures.delay, (10.0, 3.2)
    else:
        words = channels(account, largest)
        title = f"{TITLES[largest.name].capitalize()}: {words} in {largest.run}"
        draw, inches = pictures.stretch, (10.0, 3.2)

    drawn = partial(draw, account=account, finding=largest, title=sentence(largest))
    return [html.element("h2", title), html.picture(drawn, inches)]


def _table_of_findings(account: Account, found: Sequence[Finding]) -> list[html.Markup]:
    """Return the table of all findings; a long one is folded."""
    if not found:
        return []
    rows = [_row(account, finding) for finding in found]
    parts = [html.element("h2", "All findings"), html.table(_HEAD, rows[:_MOST_ROWS])]
    if len(rows) > _MOST_ROWS:
        rest = rows[_MOST_ROWS:]
        parts.append(html.folded(f"{len(rest)} more", html.table(_HEAD, rest)))
    return parts


def _row(account: Account, finding: Finding) -> tuple[str, ...]:
    if finding.run:
        where = f"{finding.run}, {finding.start_s:.1f} to {finding.end_s:.1f} s"
    elif finding.place_m is not None:
        where = f"{finding.place_m[0]:.0f} to {finding.place_m[1]:.0f} m"
    else:
        where = finding.date or "all runs"
    return (
        TITLES[finding.name],
        channels(account, finding),
        where,
        size(finding),
        sentence(finding),
    )


# --- Rerun ---


def remarks(account: Account) -> list[tuple[str, float, str]]:
    """Return (run, time s, sentence) of every finding; the run is "" where it holds for all."""
    return [
        (finding.run, finding.start_s, f"{finding.name}: {sentence(finding)}")
        for finding in (*account.findings, *account.unknown)
    ]


def courses(account: Account) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
    """Return Rerun path -> (time s, values by name): corrected speeds, and sliding."""
    found = {}
    for aligned, vehicle in zip(account.aligned, account.vehicle, strict=True):
        speeds = dict(zip(aligned.names, aligned.speed.T, strict=True))
        sliding = {name: vehicle - speed for name, speed in speeds.items()}
        run = aligned.run.name
        found[f"/{run}/speed"] = (aligned.time_s, speeds | {"vehicle": vehicle})
        found[f"/{run}/sliding"] = (aligned.time_s, sliding)
    return found
