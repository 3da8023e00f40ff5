"""Courses of causes over prepared runs, by the formulas that the plant calls.

The columns of the search, the inputs of a replay and the extended model all take a cause's course from
here, so that they cannot drift apart.
"""

from functools import cache
from typing import Any

import numpy as np

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.generated import elementwise
from rollerrig.rig.identify.causes.table import BY_NAME, Shape
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.mechanisms import friction
from rollerrig.rig.mechanisms.mechanism import COVARIATES, arguments


@cache
def each(course: Any) -> Any:
    """Returns a kernel that fills an array, its last argument, with a course of arrays (n,)."""
    return elementwise(f"each_{course.__name__}", course, len(arguments(course, 0)))


def filled(course: Any, n: int, *values: Any) -> np.ndarray:
    """A course, shape (n,), of arrays (n,) or numbers."""
    out = np.empty(n)
    each(course)(*(np.ascontiguousarray(np.broadcast_to(v, n), dtype=float) for v in values), out)
    return out


def covariate(d: Design, name: str) -> np.ndarray:
    """A covariate of `mechanisms` at each sample, shape (n,)."""
    return np.repeat(d.axle, np.diff(d.start)) if name == "axle" else getattr(d, name)


def courses(d: Design, name: str, shape: Shape) -> list[np.ndarray]:
    """What one unit of each coefficient adds at each sample, shape (n,); with a phase cosine and sine of each run."""
    row, n = BY_NAME[name], d.time_s.size
    if name == "empirical":
        return _empirical(d, shape)
    if row.phase:
        swings = [
            filled(row.mechanism.courses[0], n, d.angle_rad, phase) for phase in (0.0, -0.5 * np.pi)
        ]
        return [swing * of_run(d, run) for run in range(d.mass_kg.size) for swing in swings]
    given = []
    for known in row.mechanism.formula_parameters[row.mechanism.free :]:
        own = [
            shape.get(f"{known.name} {run}", shape.get(known.name, known.default))
            for run in d.names
        ]
        given.append(
            own[0] if len(set(own)) == 1 else np.repeat(np.take(own, d.run), np.diff(d.start))
        )
    return [
        filled(course, n, *(covariate(d, c) for c in arguments(course, len(given))), *given)
        for course in row.mechanism.courses
    ]


def _empirical(d: Design, shape: Shape) -> list[np.ndarray]:
    x = covariate(d, COVARIATES[int(shape["covariate"]) - 1].name)
    place = [
        shape.get(key, default)
        for key, default in (("centre", 0.0), ("scale", 1.0), ("period", 0.0))
    ]
    return [
        filled(friction.empirical, x.size, x, *unit, *place) for unit in ((1.0, 0.0), (0.0, 1.0))
    ]


def of_axle(d: Design, axle: int) -> np.ndarray:
    """1 on the samples of an axle, or of all (0), shape (n,)."""
    return np.repeat(((d.axle == axle - 1) | (axle == 0)).astype(float), np.diff(d.start))


def of_run(d: Design, run: int) -> np.ndarray:
    """1 on the samples of a run, shape (n,)."""
    return np.repeat((d.run == run).astype(float), np.diff(d.start))


def of_vehicle(d: Design, values: np.ndarray) -> np.ndarray:
    """Those of the samples that belong to the first wheelset of each run, the vehicle's."""
    return np.concatenate([values[d.span(AXLES * run)] for run in range(d.mass_kg.size)])
