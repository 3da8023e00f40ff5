"""Writes what was found as a model: a TOML file with the tuned base and the causes' coefficients.

Every value passes the rows of `mechanisms` like one written by hand; `rollerrig run --model` and
`explain` load it. Delays of sensors live in the recording, not in the plant: they stand there as
comments, that of the wheel speeds with the fault that does the same on the bench's bus.
"""

import math
from typing import Any

from rollerrig.rig.identify.causes import table
from rollerrig.rig.identify.causes.columns import PLACE_BIN_M, TIME_BIN_S
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.decide.empirical import EmpiricalFormula
from rollerrig.rig.mechanisms.table import BY_NAME, IN_PLANT

_LEAST_S = 0.001  # what a frame may be late by on the bench's bus


def parameters(named: IdentifiedCause) -> dict[str, dict[str, Any]]:
    """Coefficients of a named cause: value, 95 % interval, unit."""
    if table.BY_NAME[named.cause.name].phase:
        return _swing(named)
    found: dict[str, dict[str, Any]] = {}
    rows = {row.name: row for row in BY_NAME[named.cause.name].parameters}
    for k, (row, middle) in enumerate(zip(rows.values(), named.unbiased.values, strict=False)):
        sd = named.deviation[min(k, len(named.deviation) - 1)]
        found[row.name] = {
            "value": middle,
            "ci95": [middle - 1.96 * sd, middle + 1.96 * sd],
            "unit": row.source,
        }
    for name, value in named.cause.shape.items():
        found[name] = {
            "value": value,
            "ci95": _width(named.cause.name, name, value),
            "unit": rows[name].source if name in rows else "s",
        }
    return found


def _width(cause: str, name: str, value: float) -> list[float]:
    """Interval of a shape: the grid on which it was searched."""
    if name in table.BY_NAME[cause].scales:
        return [value / 2.0, value * 2.0]
    edge = (
        PLACE_BIN_M
        if name in ("start_m", "length_m")
        else TIME_BIN_S
        if name.startswith(("start_s", "duration_s"))
        else 0.0
    )
    return [value - edge, value + edge]


def _swing(named: IdentifiedCause) -> dict[str, dict[str, Any]]:
    values, sd = named.cause.values, float(max(named.deviation))
    runs = max(len(values) // 2, 1)
    square = sum(v * v for v in values) / runs - 2.0 * sd * sd
    amplitude, wide = math.sqrt(max(square, 0.0)), 1.96 * sd / math.sqrt(runs)
    return {
        "amplitude": {
            "value": amplitude,
            "ci95": [max(amplitude - wide, 0.0), amplitude + wide],
            "unit": "-",
        },
        "phase_rad": {
            "value": math.atan2(-values[1], values[0]),
            "ci95": [-math.pi, math.pi],
            "unit": "rad",
        },
    }


def _empirical(formula: EmpiricalFormula) -> list[str]:
    lines = ["", f"# empirical, no physics: {formula.text}"]
    if "on_vehicle" in formula.cause.shape:
        return [*lines, "# a force on the vehicle: the plant has no such term"]
    entries = dict(zip(("linear", "quadratic"), formula.cause.values, strict=True))
    entries |= formula.cause.shape
    return [*lines, "[mechanisms]", *(f"empirical_{k} = {v:.6g}" for k, v in entries.items())]


def toml(account: Diagnosis) -> str:
    """The extended model."""
    law = account.data.sections["adhesion"]
    tau = law["tau_m_J"] * math.exp(account.final.base.get("ln_tau", 0.0))
    lines = [
        f"# extended model, found by rollerrig explain on {account.data.name}",
        f"# verdict: {account.verdict}",
        "",
        "[adhesion]",
        f"tau_m_J = {tau:.6g}",
    ]
    kept = [n for n in account.causes if BY_NAME[n.cause.name] in IN_PLANT]
    if kept:
        lines += ["", "[mechanisms]"]
    for named in kept:
        rows = {row.name: row for row in BY_NAME[named.cause.name].parameters}
        lines.append(f"# {BY_NAME[named.cause.name].text}: {BY_NAME[named.cause.name].formula}")
        for name, entry in parameters(named).items():
            if name in rows:
                value = min(max(entry["value"], rows[name].low), rows[name].high)
                lines.append(f"{named.cause.name}_{name} = {value:.6g}")
        if "axle" in rows:
            lines.append(f"{named.cause.name}_axle = {float(named.cause.axle)}")
    if account.unknown is not None:
        lines += _empirical(account.unknown)
    for named in account.causes:
        if named not in kept:
            lines += _of_recording(named)
    return "\n".join(lines) + "\n"


def _of_recording(named: IdentifiedCause) -> list[str]:
    """Comments on a cause that is a sensor's."""
    found = parameters(named)
    values = ", ".join(f"{k} = {v['value']:.4g}" for k, v in found.items())
    place = f" of axle {named.cause.axle}" if named.cause.axle else ""
    lines = [f"# in the recording, not in the plant: {named.cause.name}{place}, {values}"]
    if named.cause.name == "speed_sensor_delay":
        late_s = found["delay_s"]["value"]
        if named.cause.axle:
            lines.append(
                "# one frame carries the speeds of all axles: the bus cannot delay that of one alone"
            )
        elif late_s >= _LEAST_S:
            lines.append(
                "# the same on the bus of the bench (not in batch): "
                f"--fault 'frame_delayed delay_s={late_s:.4g}'"
            )
    return lines
