"""Explains a measured creep curve: what Polach's law supports there, and what cannot be told.

Few scattered points and one speed: only whether friction falls with sliding is asked, by the fit
with and without it against the scatter of the points themselves.
"""

import math
from typing import Any

from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper import polach_fit
from rollerrig.rig.mechanisms.table import TABLE


def as_json(data: Dataset, seed: int) -> dict[str, Any]:
    """The content of report.json for a creep curve."""
    assert data.curve is not None
    found = polach_fit.fit(data, seed)
    n = data.curve.creepage.size
    ratio = 2.0 * n * math.log(found.rms_no_fall / found.rms)
    falls = polach_fit.falls(found, n)
    cause: dict[str, Any] = {
        "name": "falling_friction", "axles": None,
        "parameters": {name: {"value": v.value, "ci95": [v.low, v.high], "unit": ""}
                       for name, v in found.values.items()},
        "evidence": {"delta_bic": ratio - 2.0 * math.log(n), "heldout_gain": None,
                     "detectability": None},
        "confusable_with": [], "separating_test": ""}
    return {
        "verdict": "explained" if falls else "consistent", "dataset": data.name,
        "misfit": {"metric": "adhesion_rmse", "before": found.rms_no_fall,
                   "noise_floor": found.floor, "p_value": math.exp(-0.5 * ratio),
                   "worst_against": ["sliding"]},
        "causes": [cause] if falls else [], "gain": None, "unknown": None,
        "screened": [{"name": row.name, "delta_bic": 0.0, "rejected_because":
                      "a creep curve at one speed, without time, place or axles, cannot show it"}
                     for row in TABLE if row.name != "falling_friction"],
        "notes": [f"{n} points at one speed; scatter {found.floor:.4f}: beyond falling friction "
                  f"(rms {found.rms_no_fall:.4f} to {found.rms:.4f}) little can be told",
                  "no points were held out: no gain is claimed"]}


def story(report: dict[str, Any]) -> list[str]:
    """The short story of a creep curve."""
    first = ("Falling friction is supported." if report["causes"]
             else "Friction that falls with sliding is not supported by these points.")
    return [first, *(f"Note: {note}." for note in report["notes"])]
