"""The reports of a creep-curve fit: of `rollerrig tune`, and of `rollerrig explain`.

A creep curve can only answer one question of `explain`: whether friction falls with sliding.
"""

import math
from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from rollerrig.realtime.reports import page
from rollerrig.realtime.reports.page import GREY, INK, RUNS, paragraph, table
from rollerrig.realtime.reports.study import Model, StudyReport, verdict_and_sentences
from rollerrig.realtime.reports.tuning import HEAD, interval_json, interval_words
from rollerrig.rig.identify.data.parameters import patch_of
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.paper.polach_fit import (
    NAMES,
    RECOMMENDED,
    PolachFit,
    falls,
    model,
)
from rollerrig.rig.mechanisms.table import TABLE

FALLING_FRICTION = "falling_friction"

# parameters of falling friction: A and gamma
_EXTRA_PARAMETERS = 2.0


class _Line(NamedTuple):
    """A curve of the picture: parameters in the order of NAMES."""

    style: str
    colour: str
    label: str
    parameters: tuple[float, ...]


def tune_report(data: Dataset, fitted: PolachFit) -> StudyReport:
    """Return the whole report of `rollerrig tune` on a creep curve."""
    result = tune_json(data, fitted)
    return StudyReport(
        result=result,
        page=tune_page(data, fitted),
        summary=((f"fitted to {data.name}", HEAD, tune_rows(result)),),
    )


def explain_report(data: Dataset, fitted: PolachFit) -> StudyReport:
    """Return the whole report of `rollerrig explain` on a creep curve."""
    result = explain_json(data, fitted)
    return StudyReport(
        result=result,
        page=tune_page(data, fitted),
        summary=verdict_and_sentences(result["verdict"], data.name, story(result)),
        model=Model(
            "extended.toml", f"# {data.name}: a creep curve has nothing that a scenario can load\n"
        ),
    )


# --- tune ---


def _points(data: Dataset) -> int:
    return data.curve.creepage.size if data.curve is not None else 0


def tune_json(data: Dataset, fitted: PolachFit) -> dict[str, Any]:
    """Return the content of tune.json."""
    points = _points(data)
    return {
        "dataset": data.name,
        "kind": data.kind,
        "points": points,
        "parameters": {name: interval_json(value) for name, value in fitted.values.items()},
        "rms": fitted.rms,
        "rms_without_falling_friction": fitted.rms_without_fall,
        "rms_without_falling_friction_k_s_below_k_a": fitted.rms_without_fall_ordered,
        "scatter_floor": fitted.scatter_floor,
        "falling_friction_supported": falls(fitted, points),
        "mean_error_of_recommended_sets": fitted.mean_error_of_recommended,
        "names": list(NAMES),
        "correlation": np.round(fitted.correlation, 3).tolist(),
        "warnings": data.warnings,
    }


def tune_rows(result: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the content of tune.json as rows under HEAD."""
    rows = [
        (f"Polach's {name}", interval_words(value)) for name, value in result["parameters"].items()
    ]
    for title, key in (
        ("rms error, five parameters", "rms"),
        (
            "rms error, friction does not fall (k_A, k_S free within 0 .. 1)",
            "rms_without_falling_friction",
        ),
        ("the same with k_S <= k_A", "rms_without_falling_friction_k_s_below_k_a"),
        ("scatter of the points about their neighbours", "scatter_floor"),
    ):
        rows.append((title, f"{result[key]:.4f}"))
    for name, error in result["mean_error_of_recommended_sets"].items():
        rows.append((f"mean error of Polach's {name} set", f"{error:+.3f}"))
    return rows


def tune_page(data: Dataset, fitted: PolachFit) -> str:
    """Return the page of a creep-curve fit."""
    result = tune_json(data, fitted)
    supported = "is" if result["falling_friction_supported"] else "is not"
    return page.page(
        f"Creep curve of {data.name}",
        *(paragraph(warning, kind="warn") for warning in data.warnings),
        table(HEAD, tune_rows(result)),
        paragraph(f"Falling friction {supported} supported."),
        page.picture(partial(_draw_curve, data=data, fitted=fitted), (11.0, 6.0)),
    )


def _draw_curve(figure: Figure, data: Dataset, fitted: PolachFit) -> None:
    """Draw points, fits and recommended sets against creepage."""
    assert data.curve is not None
    curve = data.curve
    patch = patch_of(data)
    axes = figure.subplots()
    axes.plot(
        100 * curve.creepage, curve.adhesion, ".", color=GREY, label="measured", rasterized=True
    )

    # the models at the median speed and load
    grid = np.linspace(0.0, float(curve.creepage.max()), 400)
    fine = curve._replace(
        creepage=grid,
        adhesion=grid,
        series=grid,
        speed_m_s=np.full(grid.size, np.median(curve.speed_m_s)),
        load_N=np.full(grid.size, np.median(curve.load_N)),
    )
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
        adhesion = model(np.array(line.parameters), fine, patch)
        axes.plot(100 * grid, adhesion, line.style, color=line.colour, label=line.label)
    axes.set(
        xlabel="creepage, %", ylabel="adhesion coefficient", xlim=(0.0, None), ylim=(0.0, None)
    )
    axes.legend()


# --- explain ---


def explain_json(data: Dataset, fitted: PolachFit) -> dict[str, Any]:
    """Return the content of report.json: the only cause is falling friction."""
    points = _points(data)
    is_supported = falls(fitted, points)
    likelihood_ratio = 2.0 * points * math.log(fitted.rms_without_fall / fitted.rms)
    cause: dict[str, Any] = {
        "name": FALLING_FRICTION,
        "axles": None,
        "parameters": {
            name: interval_json(value) | {"unit": ""} for name, value in fitted.values.items()
        },
        "evidence": {
            "delta_bic": likelihood_ratio - _EXTRA_PARAMETERS * math.log(points),
            "heldout_gain": None,
            "detectability": None,
        },
        "confusable_with": [],
        "separating_test": "",
    }
    screened = [
        {
            "name": mechanism.name,
            "delta_bic": 0.0,
            "rejected_because": "a creep curve at one speed, without time, place or axles, cannot show it",
        }
        for mechanism in TABLE
        if mechanism.name != FALLING_FRICTION
    ]
    return {
        "verdict": "explained" if is_supported else "consistent",
        "dataset": data.name,
        "misfit": {
            "metric": "adhesion_rmse",
            "before": fitted.rms_without_fall,
            "noise_floor": fitted.scatter_floor,
            # of a chi-square distribution with two degrees of freedom
            "p_value": math.exp(-0.5 * likelihood_ratio),
            "worst_against": ["sliding"],
        },
        "causes": [cause] if is_supported else [],
        "gain": None,
        "unknown": None,
        "screened": screened,
        "notes": [
            f"{points} points at one speed; scatter {fitted.scatter_floor:.4f}: apart from falling "
            f"friction (rms {fitted.rms_without_fall:.4f} to {fitted.rms:.4f}) they show little",
            "no points were held out: no gain is claimed",
        ],
    }


def story(result: Mapping[str, Any]) -> list[str]:
    """Return report.json in sentences."""
    if result["causes"]:
        first = "Falling friction is supported."
    else:
        first = "These points do not support friction that falls with sliding."
    return [first, *(f"Note: {note}." for note in result["notes"])]
