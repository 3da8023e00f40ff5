"""Writes an extended model as a TOML file: the tuned base and the coefficients of the causes.

Every value obeys the bounds of the table of mechanisms, like a value written by hand. `rollerrig
run
--model` and `explain` load the file. Delays of sensors are in the recording, not in the plant: they
are written as comments. The comment on a delay of the wheel speeds names the fault with the same
effect on the bus of the bench.
"""

import math

from rollerrig.realtime.reports import cause_sentences
from rollerrig.realtime.reports.hints import sizes
from rollerrig.rig.identify.decide import estimates
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.decide.empirical import EmpiricalFormula
from rollerrig.rig.mechanisms.table import BY_NAME, IN_PLANT

# least delay in s that a fault can give to a frame on the bus of the bench
_LEAST_FRAME_DELAY_S = 0.001


def toml(diagnosis: Diagnosis) -> str:
    """Return the text of the extended model."""
    tau_of_base_m_J = diagnosis.data.sections["adhesion"]["tau_m_J"]
    tau_m_J = tau_of_base_m_J * math.exp(diagnosis.final.base.get("ln_tau", 0.0))
    lines = [
        f"# extended model, found by rollerrig explain on {diagnosis.data.name}",
        f"# verdict: {diagnosis.verdict}",
        "",
        "[adhesion]",
        f"tau_m_J = {tau_m_J:.6g}",
    ]

    in_plant = []
    in_recording = []
    for identified in diagnosis.causes:
        if BY_NAME[identified.cause.name] in IN_PLANT:
            in_plant.append(identified)
        else:
            in_recording.append(identified)

    if in_plant:
        lines += ["", "[mechanisms]"]
    for identified in in_plant:
        lines += _of_plant(identified)
    if diagnosis.formula is not None:
        lines += _of_formula(diagnosis.formula)
    for identified in in_recording:
        lines += _of_recording(identified)
    return "\n".join(lines) + "\n"


def _of_plant(identified: IdentifiedCause) -> list[str]:
    """Return the lines of a cause that the plant can simulate."""
    name = identified.cause.name
    mechanism = BY_NAME[name]
    rows = {row.name: row for row in mechanism.parameters}
    lines = [f"# {mechanism.text}: {mechanism.formula}"]
    for parameter, estimate in estimates.parameters(identified).items():
        if parameter in rows:
            row = rows[parameter]
            value = min(max(estimate.value, row.low), row.high)
            lines.append(f"{name}_{parameter} = {value:.6g}")
    if "axle" in rows:
        lines.append(f"{name}_axle = {float(identified.cause.axle)}")
    return lines


def _of_formula(formula: EmpiricalFormula) -> list[str]:
    """Return the lines of an empirical formula."""
    lines = ["", f"# empirical, no physics: {cause_sentences.formula_text(formula)}"]
    if formula.is_on_vehicle:
        return [*lines, "# a force on the vehicle: the plant has no such term"]
    linear, quadratic = formula.cause.values
    entries = {"linear": linear, "quadratic": quadratic} | formula.cause.shape
    lines.append("[mechanisms]")
    for key, value in entries.items():
        lines.append(f"empirical_{key} = {value:.6g}")
    return lines


def _of_recording(identified: IdentifiedCause) -> list[str]:
    """Return comments on a cause in a sensor, which the plant does not have."""
    cause = identified.cause
    parameters = estimates.parameters(identified)
    values = ", ".join(f"{name} = {found.value:.4g}" for name, found in parameters.items())
    place = f" of {sizes.place_in_words(cause.axle)}" if cause.axle else ""
    lines = [f"# in the recording, not in the plant: {cause.name}{place}, {values}"]
    if cause.name != "speed_sensor_delay":
        return lines

    delay_s = parameters["delay_s"].value
    if cause.axle:
        lines.append(
            "# one frame carries the speeds of all axles: the bus cannot delay that of one axle"
        )
    elif delay_s >= _LEAST_FRAME_DELAY_S:
        lines.append(
            "# the same on the bus of the bench (not in batch): "
            f"--fault 'frame_delayed delay_s={delay_s:.4g}'"
        )
    return lines
