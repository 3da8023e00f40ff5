"""Whether a run is valid: whether its figures mean anything about the stop and its WSP unit.

This is decided here alone, when a summary is made: by the bench, by the recorder of a bench that
was killed, or for a stop in memory. The record of a run that is not valid is kept, but its figures
count nowhere. A derailed coach makes a run not valid: from there on the physics computes wheels in
the air, and a stop that is cut short there looks good.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from rollerrig.wsp_interface import events as run_events
from rollerrig.wsp_interface.events import Code, Event

# a fault may still cause the loss of the unit for this time after it has been lifted
RECOVERY_S = 1.0
# a fault that begins within this time of the start begins with the run
_WITH_THE_RUN_S = 0.5
# events that make a run not valid; the first of each code counts
_SPOILS = (
    Code.COACH_DERAILED,
    Code.UNIT_ENDED,
    Code.UNIT_FAILED,
    Code.UNIT_TWO_SENDERS,
    Code.MAGNETS_FOREIGN,
    Code.NMT_FOREIGN,
    Code.RECORDER_ENDED,
    Code.RUN_INTERRUPTED,
    Code.BENCH_KILLED,
)
# events that say nothing about a run without a unit
_OF_A_UNIT = (Code.MAGNETS_FOREIGN, Code.NMT_FOREIGN, Code.LOOP_STALLED)
# assumption: a unit in real time has to bridge shorter pauses of the bench
LONG_STALL_S = 1.0
_FAULTS = (Code.FAULT_BEGINS, Code.FAULT_LIFTED)
_UNIT = (
    Code.UNIT_LOST,
    Code.UNIT_BACK,
    Code.UNIT_SILENT,
    Code.UNIT_ANSWERS,
    Code.UNIT_NO_COMMAND,
)
_EMERGENCY_STOP = (Code.EMERGENCY_STOP_SET, Code.EMERGENCY_STOP_RESET)
_RELEVANT = (
    *_SPOILS,
    *_FAULTS,
    *_UNIT,
    *_EMERGENCY_STOP,
    Code.LOOP_STALLED,
    Code.RUN_ENDED_BY_HARNESS,
    Code.FAULT_NEVER_BEGAN,
)
# how a run ended early, as its summary has it, by the event
ENDED_BY = {
    Code.RUN_FAILED: "error",
    Code.RUN_INTERRUPTED: "interrupted",
    Code.RUN_STOPPED: "stopped over Modbus",
    Code.RUN_DERAILED: "derailed",
    Code.RUN_BUS_LOST: "ended: its bus is lost",
}
# a run that lasted to within this time of duration_max_s has reached the limit
_LIMIT_TOLERANCE_S = 1.0


class Judgement(NamedTuple):
    """Sentences on a run: why it is not valid, and what was planned but did not happen."""

    invalid_because: list[str]
    warnings: list[str]


def judge(
    summary: Mapping[str, Any], scenario: Mapping[str, Any], events: Iterable[Event]
) -> Judgement:
    """Return the judgement on the run of a summary. A valid run has no reasons."""
    # keeps only the relevant events and the last error: a flood of events may exceed the memory
    relevant: list[Event] = []
    last_error = "see its events"
    for event in events:
        if event.level == run_events.ERROR:
            last_error = event.text
        if event.code in _RELEVANT:
            relevant.append(event)

    found: list[str] = []
    lost_s = losses(relevant)
    if lost_s:
        times = "time" if len(lost_s) == 1 else "times"
        found.append(
            f"the WSP unit was lost {len(lost_s)} {times} (no heartbeat), first at "
            f"{lost_s[0]:.2f} s, and no fault was aimed at it or its bus"
        )
    silent_s = silences(relevant, summary["stop_time_s"])
    if silent_s:
        times = "time" if len(silent_s) == 1 else "times"
        found.append(
            f"the WSP unit was silent {len(silent_s)} {times} (heartbeat, but no command of the "
            f"valves), first at {silent_s[0]:.2f} s, and no fault was aimed at it or its bus"
        )
    found += _without_command(relevant)
    if summary["wsp"]["unit"] == "none":
        relevant = [event for event in relevant if event.code not in _OF_A_UNIT]
    found += _spoiled_by(relevant)
    found += _stalls(relevant, summary["stop_time_s"])
    emergency_stop = _emergency_stop(summary, relevant)
    if emergency_stop:
        found.append(emergency_stop)
    lost_rows = summary["recorder"]["lost"]
    if lost_rows:
        found.append(f"the recorder lost {lost_rows} samples, frames or events")
    ending = _ending(summary, scenario, relevant, last_error, bool(found))
    if ending:
        found.append(ending)

    warnings = [event.text for event in relevant if event.code == Code.FAULT_NEVER_BEGAN]
    return Judgement(found, warnings)


def _spoiled_by(events: Iterable[Event]) -> list[str]:
    """Return one sentence for the first event of each code that makes a run not valid."""
    first: dict[Code, str] = {}
    for event in events:
        if event.code in _SPOILS and event.code not in first:
            sentence = run_events.text(event.code, event.fields, advice=False)
            first[event.code] = f"{sentence}, at {event.time_s:.2f} s"
    return list(first.values())


def _emergency_stop(summary: Mapping[str, Any], events: Iterable[Event]) -> str:
    """Return why an emergency stop makes a run not valid; empty if it does not.

    One that is set and reset before the start does not act on the run, and one after standstill
    does not change the stop.
    """
    set_s: float | None = None
    for event in events:
        if event.code == Code.EMERGENCY_STOP_SET and set_s is None:
            set_s = event.time_s
        elif event.code == Code.EMERGENCY_STOP_RESET and event.time_s == 0.0:
            set_s = None

    stop_time_s = summary["stop_time_s"]
    if set_s is None or (stop_time_s is not None and set_s >= stop_time_s):
        return ""
    return (
        f"the emergency stop was set over Modbus while the coach rolled, at {set_s:.2f} s: it also "
        "stops the rollers, so the stopping distance is not that of the brakes"
    )


def _ending(
    summary: Mapping[str, Any],
    scenario: Mapping[str, Any],
    events: Iterable[Event],
    last_error: str,
    has_reason: bool,
) -> str:
    """Return why the way in which a run ended makes it not valid; empty if it does not."""
    ended, stopped = summary["ended"], summary["stopped"]
    last_m_s = summary["final_speed_m_s"]
    rolling = "before it had begun" if last_m_s is None else f"at {last_m_s:.2f} m/s"

    if ended == "error":
        return f"the run ended with an error: {last_error}"
    if ended == "stopped over Modbus":
        return (
            "" if stopped else f"the run was stopped over Modbus while the coach rolled, {rolling}"
        )
    if ended != "finished":
        return "" if has_reason else f"the record ends early: {ended}"

    # a rig that holds its speed, or a vehicle that starts, runs for this time and stops nowhere
    held = scenario.get("rig", {}).get("speed") == "held"
    starts = bool(scenario.get("traction"))
    limit_s = math.inf if held or starts else scenario.get("duration_max_s", math.inf)
    reached_limit = (summary["duration_s"] or 0.0) > limit_s - _LIMIT_TOLERANCE_S
    by_harness = any(event.code == Code.RUN_ENDED_BY_HARNESS for event in events)
    if reached_limit and not stopped and not by_harness:
        return f"the coach did not stop within {limit_s:g} s (duration_max_s), it still rolled {rolling}"
    return ""


def losses(events: Iterable[Event]) -> list[float]:
    """Return when a WSP unit was lost although no fault aimed at it, in s.

    A loss before the start does not count if the unit is back while the rig is still held.
    """
    may_lose = [event for event in events if event.fields.get("reaches_unit", True)]
    return [event.time_s for event in _undisturbed(may_lose, Code.UNIT_LOST, Code.UNIT_BACK)]


def silences(events: Iterable[Event], stop_time_s: float | None) -> list[float]:
    """Return when a WSP unit was silent although no fault aimed at it, in s.

    A silence before the start does not count if the unit answers while the rig is still held. One
    that begins after standstill does not change the stop.
    """
    found = _undisturbed(events, Code.UNIT_SILENT, Code.UNIT_ANSWERS)
    end_s = math.inf if stop_time_s is None else stop_time_s
    return [event.time_s for event in found if event.time_s - event.fields["silent_s"] < end_s]


def _stalls(events: Iterable[Event], stop_time_s: float | None) -> list[str]:
    """Return a sentence if the bench stood still for long before standstill; empty if not."""
    end_s = math.inf if stop_time_s is None else stop_time_s
    for event in events:
        is_long = event.code == Code.LOOP_STALLED and event.fields["stalled_s"] >= LONG_STALL_S
        if is_long and event.time_s < end_s:
            return [
                f"the bench stood still for {event.fields['stalled_s']:.2f} s, at {event.time_s:.2f} s, "
                "while the WSP unit went on: what the unit did then is not its behaviour in a stop"
            ]
    return []


def _without_command(events: Iterable[Event]) -> list[str]:
    """Return a sentence for each unit that has given no valid command, without a fault.

    Only a fault that began with the run explains this.
    """
    early: set[str] = set()
    considered: list[Event] = []
    for event in events:
        if event.code == Code.FAULT_BEGINS and event.time_s <= _WITH_THE_RUN_S:
            early.add(event.fields["fault"])
        if event.code not in _FAULTS or event.fields["fault"] in early:
            considered.append(event)
    found = _undisturbed(considered, Code.UNIT_NO_COMMAND)
    return [run_events.text(Code.UNIT_NO_COMMAND, event.fields, advice=False) for event in found]


def _undisturbed(events: Iterable[Event], begins: Code, ends: Code | None = None) -> list[Event]:
    """Return the events of a unit with the code `begins` that no fault explains.

    An event of the same unit with the code `ends` before the start cancels those before it.
    """
    # the units that each fault reaches, and until when
    disturbed: dict[str, tuple[list[int] | None, float]] = {}
    found: list[Event] = []
    for event in events:
        if event.code == Code.NMT_FOREIGN:
            disturbed[event.code] = (None, math.inf)
        elif event.code in _FAULTS:
            fault_begins = event.code == Code.FAULT_BEGINS
            until_s = math.inf if fault_begins else event.time_s + RECOVERY_S
            # a record of an older version does not have the units: all of them
            disturbed[event.fields["fault"]] = (event.fields.get("units"), until_s)
        elif event.code == begins:
            node = event.fields["node"]
            reached = (
                until_s for units, until_s in disturbed.values() if units is None or node in units
            )
            if event.time_s > max(reached, default=-math.inf):
                found.append(event)
        elif ends is not None and event.code == ends and event.time_s == 0.0:
            found = [one for one in found if one.fields["node"] != event.fields["node"]]
    return found


def because(summary: Mapping[str, Any]) -> Sequence[str]:
    """Return why a run is not valid, by its summary.

    A summary without this field is treated as valid.
    """
    if not summary:
        return ("it has no summary: it still runs, or was killed",)
    return summary.get("invalid_because", ())
