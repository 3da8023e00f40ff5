"""Whether a run is valid: whether its figures tell anything of the stop and of its WSP unit.

It is decided here alone, when a summary is made: by the bench, by the recorder of a bench that was killed, of a stop in
memory. The record of a run that is not valid is kept, its figures count nowhere. A derailed coach makes a run not
valid: from there on the physics computes wheels in the air, and a stop that is cut short there looks good.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rollerrig.firmware_sim.faults import catalogue
from rollerrig.wsp_interface.signals import WSP_NODE

Event = tuple[float, str, str]
# so long after a fault has been lifted a unit may still be lost by it
RECOVERY_S = 1.0
_FAULT = re.compile(r"fault (.+): (begins|lifted)")
_UNIT = f"the WSP unit (node {WSP_NODE})"
# how events begin that spoil a run; the first of each counts
_SPOILS = re.compile(
    "derailed: |the (reference WSP unit|WSP unit .+?|recorder) has ended|"
    "the (run is interrupted|bench was killed)"
)
_ENDS = "the harness ends the run"


def reasons(
    summary: Mapping[str, Any], scenario: Mapping[str, Any], events: Iterable[Event]
) -> list[str]:
    """Why the run of a summary is not valid, a sentence each; none where it is. `events`: (time_s, level, text)."""
    # kept are those that count, and of errors the last: a flood of others may be more than memory holds
    last_error, found, spoilt, kept = "see its events", [], dict[str, str](), []
    for event in events:
        last_error = event[2] if event[1] == "error" else last_error
        if (
            event[2] == _ENDS
            or event[2].startswith(_UNIT)
            or _SPOILS.match(event[2])
            or _FAULT.match(event[2])
        ):
            kept.append(event)
    events = kept
    ended, stopped, last_m_s = summary["ended"], summary["stopped"], summary["final_speed_m_s"]
    rolling = f"at {last_m_s:.2f} m/s" if last_m_s is not None else "before it had begun"
    if lost_s := losses(events):
        found.append(
            f"the WSP unit was lost {len(lost_s)} time{'s' * (len(lost_s) > 1)} (no heartbeat), first at "
            f"{lost_s[0]:.2f} s, and no fault was aimed at it or its bus"
        )
    for time_s, _, text in events:
        if told := _SPOILS.match(text):
            spoilt.setdefault(told[0], f"{re.split('; | [(]/', text)[0]}, at {time_s:.2f} s")
    found += spoilt.values()
    if lost := summary["recorder"]["lost"]:
        found.append(f"the recorder lost {lost} samples, frames or events")
    # a rig that holds its speed runs so long and stops nowhere
    held = scenario.get("rig", {}).get("speed") == "held"
    limit_s = math.inf if held else scenario.get("duration_max_s", math.inf)
    if ended == "error":
        found.append(f"the run ended with an error: {last_error}")
    elif ended == "stopped over Modbus" and not stopped:
        found.append(f"the run was stopped over Modbus while the coach rolled, {rolling}")
    elif (
        ended == "finished"
        and not stopped
        and (summary["duration_s"] or 0.0) > limit_s - 1.0
        and not any(text == _ENDS for _, _, text in events)
    ):
        found.append(
            f"the coach did not stop within {limit_s:g} s (duration_max_s), it still rolled {rolling}"
        )
    elif not found and ended not in ("finished", "stopped over Modbus"):
        found.append(f"the record ends early: {ended}")
    return found


def losses(events: Iterable[Event]) -> list[float]:
    """When the WSP unit was lost though no fault aimed at it, in s; a held rig may find it again before it starts."""
    disturbed_until_s: dict[str, float] = {}
    lost_s: list[float] = []
    for time_s, _, text in events:
        if (fault := _FAULT.match(text)) and catalogue.parse(fault[1]).reaches_unit:
            disturbed_until_s[fault[1]] = math.inf if fault[2] == "begins" else time_s + RECOVERY_S
        elif text.startswith(f"{_UNIT} lost") and time_s > max(
            disturbed_until_s.values(), default=-math.inf
        ):
            lost_s.append(time_s)
        elif text.startswith(f"{_UNIT} is back") and time_s == 0.0:
            lost_s.clear()
    return lost_s


def because(summary: Mapping[str, Any]) -> Sequence[str]:
    """Why a run is not valid, by its summary; one from before summaries told counts as valid."""
    return (
        summary.get("invalid_because", ())
        if summary
        else ("it has no summary: it still runs, or was killed",)
    )
