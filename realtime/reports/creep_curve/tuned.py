"""The report of `rollerrig tune` on a creep curve: Polach's parameters with intervals.

Whether friction falls is not taken from these parameters: `rig.identify.creep_curves` judges the
points without a law.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.page import GREY, INK, RUNS, paragraph, table
from rollerrig.realtime.reports.study import StudyReport
from rollerrig.realtime.reports.tuning import HEAD, interval_words
from rollerrig.rig.identify.creep_curves.judgement import Shown
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Curve, Dataset
from rollerrig.rig.identify.paper.polach_fit import (
    NAMES,
    RECOMMENDED,
    PolachFit,
    bound_of,
    model,
)

# symbols in the paper, by the names of the parameters
_SYMBOLS = {"gamma_s_m": "B, s/m", "k_a": "k_A", "k_s": "k_S"}
# columns of the legend above a picture
_COLUMNS_OF_LEGEND = 3


class _Line(NamedTuple):
    """A curve of the picture: parameters in the order of NAMES."""

    style: str
    colour: str
    label: str
    parameters: tuple[float, ...]


def tune_report(data: Dataset, fitted: PolachFit, shown: Shown) -> StudyReport:
    """Return the whole report of `rollerrig tune` on a creep curve."""
    result = tune_json(data, fitted, shown)
    rows = tune_rows(result)
    if _about_the_patch(data, fitted):
        rows.append(
            ("k_A is at its bound 1", "check wheel_radius_m and lateral_radius_m: the patch")
        )
    return StudyReport(
        result=result,
        page=tune_page(data, fitted, shown),
        summary=((f"fitted to {data.name}", HEAD, rows),),
    )


def _points(data: Dataset) -> int:
    return data.curve.creepage.size if data.curve is not None else 0


def parameter_json(value: float, low: float, high: float, bound: str) -> dict[str, Any]:
    """Return a parameter as JSON; one at a bound of its range has no interval."""
    ci95 = None if bound else [low, high]
    return {"value": value, "ci95": ci95, "bound": bound or None}


def parameter_title(name: str) -> str:
    """Return the title of a parameter of Polach's law: the symbol of his paper, and its unit."""
    return f"Polach's {_SYMBOLS.get(name, name)}"


def parameter_words(parameter: Mapping[str, Any]) -> str:
    """Return a parameter of the JSON in words."""
    if parameter["bound"]:
        return f"at its bound {parameter['value']:.4g}, not determined"
    return interval_words(parameter)


def stiffness_words(data: Dataset, load_N: float, k_a: float) -> str:
    """Return why k_A is at or above 1, and what to check."""
    patch = patch_of(data)
    # both half axes grow with the cube root of the load
    grown = load_N ** (1.0 / 3.0)
    begin = f"k_A is {k_a:.3g}" if k_a > 1.001 else "k_A is at its bound 1, not determined"
    return (
        f"{begin}: at small creepage the points rise as steeply as the contact patch allows, or more "
        f"steeply. The patch has half axes of {1e3 * patch.a1 * grown:.2g} mm along and "
        f"{1e3 * patch.b1 * grown:.2g} mm across at {1e-3 * load_N:.3g} kN; it is computed from "
        "wheel_radius_m and lateral_radius_m of dataset.toml and not fitted. Check these radii first, "
        "then the zero of the creepage"
    )


def tune_json(data: Dataset, fitted: PolachFit, shown: Shown) -> dict[str, Any]:
    """Return the content of tune.json."""
    points = _points(data)
    return {
        "dataset": data.name,
        "kind": data.kind,
        "points": points,
        "parameters": {
            name: parameter_json(*value, bound_of(name, value.value))
            for name, value in fitted.values.items()
        },
        "rms": fitted.rms,
        "rms_without_falling_friction": fitted.rms_without_fall,
        "rms_without_falling_friction_k_s_below_k_a": fitted.rms_without_fall_ordered,
        "scatter_floor": fitted.scatter_floor,
        "falling_friction_supported": None if shown.fall_why_not else shown.falls,
        "mean_error_of_recommended_sets": fitted.mean_error_of_recommended,
        "names": list(NAMES),
        "correlation": np.round(fitted.correlation, 3).tolist(),
        "warnings": data.warnings,
    }


def tune_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the content of tune.json as rows under HEAD."""
    rows = [
        (parameter_title(name), parameter_words(value))
        for name, value in result["parameters"].items()
    ]
    for title, key in (
        ("rms error, five parameters", "rms"),
        (
            "rms error, friction does not fall (k_A, k_S free within 0 .. 1)",
            "rms_without_falling_friction",
        ),
        ("the same with k_S <= k_A", "rms_without_falling_friction_k_s_below_k_a"),
        ("scatter of the points about straight lines through their neighbours", "scatter_floor"),
    ):
        rows.append((title, f"{result[key]:.4f}"))
    for name, error in result["mean_error_of_recommended_sets"].items():
        rows.append((f"mean error of Polach's {name} set", f"{error:+.3f}"))
    return rows


def _about_the_patch(data: Dataset, fitted: PolachFit) -> list[str]:
    """Return what the contact patch has to do with k_A at its bound 1."""
    k_a = fitted.values["k_a"].value
    if data.curve is None or bound_of("k_a", k_a) != "high":
        return []
    return [stiffness_words(data, float(np.median(data.curve.load_N)), k_a)]


def tune_page(data: Dataset, fitted: PolachFit, shown: Shown) -> str:
    """Return the page of a creep-curve fit."""
    result = tune_json(data, fitted, shown)
    if shown.fall_why_not:
        falling = f"Falling friction could not be judged: {shown.fall_why_not}."
    elif shown.falls:
        falling = "Falling friction is supported."
    else:
        falling = "Falling friction is not supported."
    return page.page(
        f"Creep curve of {data.name}",
        *(paragraph(warning, kind="warn") for warning in data.warnings),
        table(HEAD, tune_rows(result)),
        paragraph(falling),
        *(paragraph(f"{sentence}.") for sentence in _about_the_patch(data, fitted)),
        page.picture(partial(_draw_curve, data=data, fitted=fitted, shown=shown), (11.0, 6.0)),
    )


def fine_curve(points: Curve) -> Curve:
    """Return a fine grid of creepages from 0 to the largest, at the median speed and load."""
    grid = np.linspace(0.0, float(np.abs(points.creepage).max()), 400)
    return Curve(
        creepage=grid,
        adhesion=grid,
        speed_m_s=np.full(grid.size, np.median(points.speed_m_s)),
        load_N=np.full(grid.size, np.median(points.load_N)),
        series=np.full(grid.size, points.series[0]),
    )


def draw_maximum(axes: Axes, creepage: np.ndarray, adhesion: np.ndarray, colour: str) -> None:
    """Mark the maximum of a drawn law, with its numbers, if adhesion falls after it."""
    top = int(np.argmax(adhesion))
    if top == adhesion.size - 1:
        return
    label = f"maximum of the law: {adhesion[top]:.3f} at {100.0 * creepage[top]:.2g} %"
    axes.plot(100.0 * creepage[top], adhesion[top], "^", color=colour, ms=7, zorder=4, label=label)


def legend_above(axes: Axes) -> None:
    """Add a legend above a picture, where it covers no point."""
    axes.legend(ncols=_COLUMNS_OF_LEGEND, loc="lower left", bbox_to_anchor=(0.0, 1.0))


def _draw_curve(figure: Figure, data: Dataset, fitted: PolachFit, shown: Shown) -> None:
    """Draw points, fits and recommended sets against creepage.

    Each fit is drawn once for each group of equal conditions, at the speed and load of the group.
    """
    assert data.curve is not None
    curve = data.curve
    patch = patch_of(data)
    axes = figure.subplots()
    axes.plot(
        100 * curve.creepage, curve.adhesion, ".", color=GREY, label="measured", rasterized=True
    )

    prepared = shown.prepared
    fine_curves = [
        fine_curve(prepared.curve.chosen(np.flatnonzero(prepared.group == number)))
        for number in np.unique(prepared.group)
    ]
    lines = [
        _Line(
            "-",
            RUNS[0],
            f"Polach, five parameters, rms {fitted.rms:.4f}",
            tuple(fitted.values[name].value for name in NAMES),
        ),
        _Line(
            "-",
            RUNS[1],
            f"friction that does not fall, rms {fitted.rms_without_fall:.4f}",
            tuple(fitted.values_without_fall[name] for name in NAMES),
        ),
    ]
    for style, (name, parameters) in zip(("--", ":"), RECOMMENDED.items(), strict=True):
        error = fitted.mean_error_of_recommended[name]
        label = f"Polach's {name} set, mean error {error:+.3f}"
        lines.append(_Line(style, INK, label, parameters))
    for line in lines:
        for k, fine in enumerate(fine_curves):
            adhesion = model(np.array(line.parameters), fine, patch)
            shown_label = line.label if k == 0 else None
            axes.plot(
                100 * fine.creepage, adhesion, line.style, color=line.colour, label=shown_label
            )
            if line is lines[0]:
                draw_maximum(axes, fine.creepage, adhesion, line.colour)
    axes.set(
        xlabel="creepage, %", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    legend_above(axes)
