"""Proposed stops for people and for the bench: their sentences, report entries and sequences.

`rig.identify.next_stops` chooses the stops. `rollerrig sequence` runs the files made here.
"""

import math
from collections.abc import Sequence
from typing import Any

from rollerrig.rig.identify.causes.candidates import Explanation
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.next_stops.planning import DISTINGUISHED, FittedData, Proposal
from rollerrig.rig.identify.next_stops.prototype import RELEASED_S, Stop, is_on_rollers
from rollerrig.rig.params import PA_PER_BAR

# a sequence fails if a stop has not ended after this time
_TIMEOUT_S = 280
# a rig that holds the speed must not fall below this share of it
_HELD_SHARE = 0.99


# --- words ---


def title(stop: Stop) -> str:
    """Return a description of a stop."""
    where = f"on wheelset {stop.axle} only" if stop.axle else "on all wheelsets"
    speed = f"for {stop.held_s:g} s at a held" if stop.held_s else "from"
    return (
        f"{stop.pressure_Pa / PA_PER_BAR:g} bar {where} {speed} "
        f"{stop.initial_speed_m_s:g} m/s with {stop.mass_kg / 1e3:.3g} t"
    )


def reason(proposal: Proposal) -> str:
    """Return why a stop is proposed."""
    first, second = proposal.pair
    if proposal.before > DISTINGUISHED:
        return (
            f"the data distinguish {first} from {second} already: their separation is "
            f"{proposal.before:.3g}, and {DISTINGUISHED:g} is enough. The stop raises it to "
            f"{proposal.after:.3g}, so it confirms the cause"
        )
    return (
        f"distinguishes {first} from {second}: separation {proposal.before:.3g} before, "
        f"{proposal.after:.3g} with it (the data distinguish causes above {DISTINGUISHED:g})"
    )


def as_json(proposals: Sequence[Proposal], files: Sequence[str]) -> list[dict[str, Any]]:
    """Return the entries of proposals in a report; `files` are the names of their sequences."""
    entries = []
    for proposal, name in zip(proposals, files, strict=True):
        entry: dict[str, Any] = {
            "file": name,
            "title": title(proposal.stop),
            "reason": reason(proposal),
        }
        entry.update(proposal.stop._asdict())
        entry["parts"] = list(proposal.pair)
        entry["separation_before"] = proposal.before
        entry["separation_after"] = proposal.after
        entries.append(entry)
    return entries


# --- the sequence that runs a stop ---


def sequence(proposal: Proposal, fitted: FittedData) -> dict[str, Any]:
    """Return a proposal as a sequence on the fitted base model: plain data for a TOML file."""
    stop = proposal.stop
    return {
        "title": f"Proposed by explain: {title(stop)}",
        "criteria": "none",
        "notes": reason(proposal),
        "start": {
            "speed": f"{stop.initial_speed_m_s:g} m/s",
            "mass": f"{stop.mass_kg:.6g} kg",
            "adhesion": "soap",
            "tables": _tables(stop, fitted.data, fitted.explanation),
        },
        "step": [_step(stop, fitted.data.axles)],
    }


def _tables(stop: Stop, data: Dataset, explanation: Explanation) -> dict[str, Any]:
    """Return the tables of the scenario: those of the dataset with the fitted adhesion law."""
    sections = data.sections
    law = dict(sections["adhesion"])
    law["mu_cd"] = float(law["mu_cd"] * math.exp(explanation.level))
    law["tau_m_J"] = float(law["tau_m_J"] * math.exp(explanation.base.get("ln_tau", 0.0)))
    return {
        "adhesion": law,
        "contact": dict(sections["contact"]),
        "vehicle": dict(sections["vehicle"]),
        "brake": dict(sections["brake"]),
        "rig": {
            "mode": "contaminated_rollers" if is_on_rollers(data) else "track",
            "speed": "held" if stop.held_s else "vehicle",
        },
        "loop": {"record_hz": round(1.0 / data.sample_time_s)},
    }


def _step(stop: Stop, axles: int) -> dict[str, Any]:
    """Return the step of the sequence that brakes, on a vehicle with this number of axles."""
    step: dict[str, Any] = {
        "title": title(stop),
        "at": f"{RELEASED_S:g} s",
        "set": {"brake_demand": f"{stop.pressure_Pa / PA_PER_BAR:g} bar"},
    }
    if stop.held_s:
        step["for"] = f"{stop.held_s:g} s"
        step["expect"] = [f"vehicle_speed > {_HELD_SHARE * stop.initial_speed_m_s:.4g} m/s"]
    else:
        step["until"] = f"vehicle_speed < {stop.last_speed_m_s:g} m/s"
        step["timeout"] = f"{_TIMEOUT_S} s"
    if stop.axle:
        # The dump valves of the other wheelsets stay open. So one wheelset slides at a speed that
        # hardly decreases.
        others = [axle for axle in range(1, axles + 1) if axle != stop.axle]
        step["fault"] = [f"vent_magnet_stuck axle={axle}" for axle in others]
    return step
