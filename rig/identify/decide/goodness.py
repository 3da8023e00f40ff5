"""Refuses what must never be called consistent: numbers that are not finite, and a poor fit.

A score that is not finite is no small score. A model that misses its data by far leaves scores
that say little, because they are derivatives around a wrong place.
"""

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.decide import fitting, thresholds
from rollerrig.rig.identify.replay import sensitivity

REMEDY = (
    "check wheel_radius_m, the channels of speed and wheel speed, and [vehicle]; let the recordings "
    "end at a higher speed (for example 6 m/s), or leave out the run"
)


class NumericalFailureError(ConfigError):
    """The replay of the runs leaves the range of numbers, so nothing can be judged."""


class PoorFitError(ConfigError):
    """The fitted base misses the runs by far, and yet no cause is significant."""


def check_finite(design: Design, normal: fitting.NormalEquations) -> None:
    """Raise NumericalFailureError unless the normal equations of the base are finite."""
    base = fitting.base_columns(normal.matrix)
    A = normal.A[np.ix_(base, base)]
    b = normal.b[base]
    if np.all(np.isfinite(A)) and np.all(np.isfinite(b)):
        return
    finite = np.isfinite(A).all(axis=1) & np.isfinite(b)
    labels = [normal.matrix.columns[c].label for c in np.array(base)[~finite]]
    raise NumericalFailureError(
        f"{', '.join(design.names)}: the effect of a small change of the base ({labels[0]}) on the "
        "replay is not a finite number, so no score can be computed and nothing is judged: wheels "
        f"run where the model is unstable; {REMEDY}"
    )


def check_deviance(design: Design, value: float) -> None:
    """Raise NumericalFailureError unless a likelihood is finite."""
    if not np.isfinite(value):
        raise NumericalFailureError(
            f"{', '.join(design.names)}: the likelihood of the fitted base is not a finite number, so "
            f"nothing is judged; {REMEDY}"
        )


def mean_squares(design: Design, explanation: Explanation) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean squares of the normalised innovations; 1 is right.

    The first array is of wheelsets (runs, axles), the second of vehicles (runs,). The squares of
    outliers are bounded.
    """
    nu, variance, _, vehicle_nu, vehicle_variance = sensitivity.innovations(
        design, inputs(design, explanation)
    )
    most = thresholds.OUTLIER_DEVIATIONS**2
    squares = np.minimum(nu * nu / variance, most)
    vehicle_squares = np.minimum(vehicle_nu * vehicle_nu / vehicle_variance, most)
    wheels = [squares[design.span(s)].mean() for s in range(design.segments)]
    runs = range(design.mass_kg.size)
    vehicles = [vehicle_squares[design.vehicle_span(run)].mean() for run in runs]
    return np.reshape(wheels, (-1, design.axles)), np.array(vehicles)


def check_fit(design: Design, explanation: Explanation) -> None:
    """Raise PoorFitError if a wheelset or a vehicle is far from the fitted base.

    It is for a base that no score contradicts: then the scores cannot be trusted.
    """
    wheels, vehicles = mean_squares(design, explanation)
    worst_run, worst_axle = np.unravel_index(int(np.argmax(wheels)), wheels.shape)
    what = f"wheelset {worst_axle + 1} in run '{design.names[worst_run]}'"
    most = float(wheels.max())
    if vehicles.max() > most:
        what = f"the vehicle's speed in run '{design.names[int(np.argmax(vehicles))]}'"
        most = float(vehicles.max())
    # negated, so that a number that is not finite fails too
    if not most <= thresholds.MOST_MEAN_SQUARE:
        raise PoorFitError(
            f"the fitted base misses {what} by far: the errors of prediction have {most:.3g} times "
            f"the variance of the declared noise ({thresholds.MOST_MEAN_SQUARE:g} is allowed), and "
            "yet no score is significant, so nothing can be concluded; check [vehicle], the "
            "channels of that run, and [accuracy]"
        )
