"""Courses of causes along prepared runs, by the same formulas that the plant calls.

A course is what one unit of a coefficient adds at each sample. The columns of the search, the
inputs of a replay and the extended model all take the course of a cause from here, so that they
cannot drift apart.
"""

from functools import cache
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.rig.compiled.generated import elementwise
from rollerrig.rig.identify.causes.table import BY_NAME, Shape
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.mechanisms import friction
from rollerrig.rig.mechanisms.mechanism import COVARIATES, arguments


@cache
def array_kernel(course: Any) -> Any:
    """Return a kernel that computes a course from arrays (n,) into its last argument."""
    return elementwise(f"each_{course.__name__}", course, len(arguments(course, 0)))


def filled(course: Any, n: int, *values: Any) -> np.ndarray:
    """Return a course, shape (n,); its arguments are arrays (n,) or numbers."""
    arrays = [np.ascontiguousarray(np.broadcast_to(value, n), dtype=float) for value in values]
    out = np.empty(n)
    array_kernel(course)(*arrays, out)
    return out


def covariate(design: Design, name: str) -> np.ndarray:
    """Return a covariate of `mechanisms` at each sample, shape (n,)."""
    if name == "axle":
        return np.repeat(design.axle, np.diff(design.start))
    return getattr(design, name)


def courses(design: Design, name: str, shape: Shape) -> list[np.ndarray]:
    """Return the course of each coefficient of a cause, shape (n,).

    A cause with a phase has two coefficients per run: cosine and sine.
    """
    row = BY_NAME[name]
    n = design.time_s.size
    if name == "empirical":
        return _empirical(design, shape)
    if row.phase:
        course = row.mechanism.courses[0]
        cosine = filled(course, n, design.angle_rad, 0.0)
        sine = filled(course, n, design.angle_rad, -0.5 * np.pi)
        swings = []
        for run in range(design.mass_kg.size):
            swings += [cosine * of_run(design, run), sine * of_run(design, run)]
        return swings

    shape_values = []
    for parameter in row.mechanism.formula_parameters[row.mechanism.free :]:
        shape_values.append(_shape_value(design, shape, parameter.name, parameter.default))
    of_coefficients = []
    for course in row.mechanism.courses:
        names = arguments(course, len(shape_values))
        covariates = [covariate(design, covariate_name) for covariate_name in names]
        of_coefficients.append(filled(course, n, *covariates, *shape_values))
    return of_coefficients


def _shape_value(design: Design, shape: Shape, name: str, default: float) -> float | np.ndarray:
    """Return the value of a shape parameter: a number, or (n,) where it differs between the runs.

    The value of a single run has the key "NAME RUN".
    """
    of_runs = [shape.get(f"{name} {run}", shape.get(name, default)) for run in design.names]
    if len(set(of_runs)) == 1:
        return of_runs[0]
    return np.repeat(np.take(of_runs, design.run), np.diff(design.start))


def _empirical(design: Design, shape: Shape) -> list[np.ndarray]:
    """Return the two courses of an empirical term along the covariate that its shape names."""
    x = covariate(design, COVARIATES[int(shape["covariate"]) - 1].name)
    place = (shape.get("centre", 0.0), shape.get("scale", 1.0), shape.get("period", 0.0))
    return [
        filled(friction.empirical, x.size, x, 1.0, 0.0, *place),
        filled(friction.empirical, x.size, x, 0.0, 1.0, *place),
    ]


def acts_on(design: Design, axle: int) -> np.ndarray:
    """Return for each segment whether it is of this wheelset, shape (segments,).

    0 means all wheelsets, -n those of bogie n (`configs.vehicle.wheelsets_of`).
    """
    if axle == 0:
        return np.ones(design.axle.shape, bool)
    if axle > 0:
        return np.asarray(design.axle == axle - 1)
    return np.isin(design.axle + 1, wheelsets_of(axle, design.axles))


def of_axle(design: Design, axle: int) -> np.ndarray:
    """Return 1 on the samples of the wheelsets of `acts_on` and 0 elsewhere, shape (n,)."""
    return np.repeat(acts_on(design, axle).astype(float), np.diff(design.start))


def of_run(design: Design, run: int) -> np.ndarray:
    """Return 1 on the samples of a run and 0 elsewhere, shape (n,)."""
    return np.repeat((design.run == run).astype(float), np.diff(design.start))


def vehicle_samples(design: Design, values: np.ndarray) -> np.ndarray:
    """Return the values of the first wheelset of each run, shape (vehicle samples,).

    A vehicle has as many samples as its first wheelset, at the same times.
    """
    firsts = range(0, design.segments, design.axles)
    return np.concatenate([values[design.span(first)] for first in firsts])
