"""The conditions under which the points of a creep curve were measured, as columns of a fit.

Adhesion is taken as a curve of creepage times one factor for each condition that varies:

    [K1] adhesion = f(creepage) exp(X beta)

A column of X is load, speed or pressure over its median, less 1, or the logarithm of that ratio,
whichever fits better; the temperature less its median in 10 K; or 1 for the points of a series, or
of traction where braking was measured, too.

A sensor has noise, so a column has it too. Of few levels it is the scatter within them. Else it is
what successive points of the file differ by:

    [K2] noise^2 = sum (x_(i+1) - x_i)^2 / (2 (n - 1))          von Neumann

Values that jump from point to point show no noise apart from their spread. Then only a declared
noise distinguishes both. Source of [K2]: von Neumann, Annals of Mathematical Statistics 12 (1941)
367-395.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.data.runs import Curve

SERIES = "series"
DIRECTION = "direction"
LOAD = "load"
SPEED = "speed"
TEMPERATURE = "temperature"
PRESSURE = "pressure"
# a partner of conditions that change together with the creepage
CREEPAGE = "creepage"

# Fewer points in braking, or in traction, are no second direction.
LEAST_DIRECTION_POINTS = 6

# A condition that varies by less is one value. Share of the median; for the temperature in K.
LEAST_SHARE = 0.02
LEAST_TEMPERATURE_K = 1.0
# K of temperature that are 1 in its column
TEMPERATURE_STEP_K = 10.0

# Values are levels if they have at most so many clusters, each narrower than a share of the range.
MOST_LEVELS = 8
WIDEST_LEVEL = 0.1

# part of the spread of a column that is no noise, below which the condition is not judged
LEAST_RELIABILITY = 0.5

# share of the variance of a column that other columns explain, above which they go together: a
# variance inflation of 10 (Kutner and others, Applied Linear Statistical Models (2005), section
# 10.5). Then a wrong form of the curve looks like an effect of the condition.
TOGETHER = 0.9


class Condition(NamedTuple):
    """A condition of the points: values (n,) in SI units, and its columns of X (n, columns)."""

    name: str
    unit: str
    values: np.ndarray
    columns: np.ndarray  # no columns where the condition does not vary
    is_levels: bool  # whether the values are few levels
    other_columns: np.ndarray | None = None  # another form of the columns; None: there is none
    noise: float = 0.0  # standard deviation of the sensor's noise in the column [K2]

    @property
    def varies(self) -> bool:
        """Whether the condition differs between points."""
        return self.columns.shape[1] > 0

    @property
    def may_be_noise(self) -> bool:
        """Whether the spread of the column is mostly the noise of its sensor."""
        if not self.varies or self.noise == 0.0:
            return False
        spread = float(np.var(self.columns[:, 0]))
        return self.noise**2 > (1.0 - LEAST_RELIABILITY) * spread

    def chosen(self, points: np.ndarray) -> "Condition":
        """Return the condition of some points, by a mask (n,)."""
        other = self.other_columns
        return self._replace(
            values=self.values[points],
            columns=self.columns[points],
            other_columns=None if other is None else other[points],
        )

    def in_other_form(self) -> "Condition":
        """Return the condition with its other columns, where there are any."""
        if self.other_columns is None:
            return self
        return self._replace(columns=self.other_columns, other_columns=self.columns)

    @property
    def low(self) -> float:
        """Smallest value."""
        return float(self.values.min())

    @property
    def high(self) -> float:
        """Largest value."""
        return float(self.values.max())


class Prepared(NamedTuple):
    """The points of a creep curve, sorted by creepage, all arrays (n,) or (n, columns)."""

    curve: Curve  # sorted
    creepage: np.ndarray  # without sign
    adhesion: np.ndarray  # positive where the force has the direction of the sliding
    file_order: np.ndarray  # place of each point in the file
    conditions: tuple[Condition, ...]
    group: np.ndarray  # number of the group of equal conditions of each point

    def columns(self, names: Sequence[str] | None = None) -> np.ndarray:
        """Return the columns of the conditions with these names, by default of all."""
        parts = [
            condition.columns
            for condition in self.conditions
            if names is None or condition.name in names
        ]
        return np.column_stack(parts) if parts else np.empty((self.creepage.size, 0))

    def chosen(self, points: np.ndarray) -> "Prepared":
        """Return some of the points, by a mask (n,). Medians stay those of all points."""
        return Prepared(
            curve=self.curve.chosen(points),
            creepage=self.creepage[points],
            adhesion=self.adhesion[points],
            file_order=self.file_order[points],
            conditions=tuple(condition.chosen(points) for condition in self.conditions),
            group=self.group[points],
        )


def prepare(curve: Curve, accuracy: Mapping[str, float] | None = None) -> Prepared:
    """Return the points sorted by creepage, with their conditions and groups.

    `accuracy` has the declared noise, by the names of `dataset.ACCURACY`; values below 0 are not
    declared.
    """
    order = np.argsort(np.abs(curve.creepage), kind="stable")
    points = curve.chosen(order)
    sign = np.where(points.creepage < 0.0, -1.0, 1.0)
    conditions = [
        _series(points.series),
        _direction(points.creepage),
        _ratio(LOAD, "N", points.load_N),
        _ratio(SPEED, "m/s", points.speed_m_s),
    ]
    if points.temperature_K is not None:
        conditions.append(_temperature(points.temperature_K))
    if points.pressure_Pa is not None:
        conditions.append(_ratio(PRESSURE, "Pa", points.pressure_Pa))
    declared = _declared_noise(points, accuracy or {})
    conditions = [_with_noise(one, order, declared.get(one.name)) for one in conditions]
    return Prepared(
        curve=points,
        creepage=np.abs(points.creepage),
        adhesion=points.adhesion * sign,
        file_order=order,
        conditions=tuple(conditions),
        group=_groups(conditions, order.size),
    )


def _declared_noise(points: Curve, accuracy: Mapping[str, float]) -> dict[str, float]:
    """Return the declared noise of the columns of load, speed and temperature, by their names."""
    declared = {}
    load = accuracy.get("load_fraction", -1.0)
    if load >= 0.0:
        declared[LOAD] = load
    speed_m_s = accuracy.get("speed_m_s", -1.0)
    middle_m_s = float(np.median(points.speed_m_s))
    if speed_m_s >= 0.0 and middle_m_s > 0.0:
        declared[SPEED] = speed_m_s / middle_m_s
    temperature_K = accuracy.get("temperature_K", -1.0)
    if temperature_K >= 0.0:
        declared[TEMPERATURE] = temperature_K / TEMPERATURE_STEP_K
    return declared


def _with_noise(condition: Condition, order: np.ndarray, declared: float | None) -> Condition:
    """Return a condition with the noise of its column; `order` (n,) are the places in the file."""
    if not condition.varies or condition.name in (SERIES, DIRECTION):
        return condition
    if declared is not None:
        return condition._replace(noise=declared)
    column = condition.columns[:, 0]
    number = levels(column)
    if number is not None:
        means = np.bincount(number, column) / np.bincount(number)
        freedom = max(column.size - means.size, 1)
        within = float(np.sum((column - means[number]) ** 2))
        return condition._replace(noise=float(np.sqrt(within / freedom)))
    in_file = column[np.argsort(order)]
    return condition._replace(noise=float(np.sqrt(0.5 * np.mean(np.diff(in_file) ** 2))))


def _series(values: np.ndarray) -> Condition:
    numbers = np.unique(values)
    dummies = (values[:, None] == numbers[None, 1:]).astype(float)
    return Condition(SERIES, "", values, dummies, is_levels=True)


def _direction(creepage: np.ndarray) -> Condition:
    """Return the condition of traction (-1) and braking (1)."""
    sign = np.where(creepage < 0.0, -1.0, 1.0)
    traction = int(np.sum(sign < 0.0))
    if min(traction, sign.size - traction) < LEAST_DIRECTION_POINTS:
        return Condition(DIRECTION, "", sign, np.empty((sign.size, 0)), is_levels=True)
    return Condition(DIRECTION, "", sign, (sign[:, None] < 0.0).astype(float), is_levels=True)


def _ratio(name: str, unit: str, values: np.ndarray) -> Condition:
    """Return a condition whose factor is a power of its value."""
    middle = float(np.median(values))
    positive = np.maximum(values, 1e-3 * max(middle, 1e-9))
    column = np.log(positive / max(middle, 1e-9))
    if np.ptp(column) < LEAST_SHARE:
        return Condition(name, unit, values, np.empty((values.size, 0)), is_levels=True)
    return Condition(
        name=name,
        unit=unit,
        values=values,
        columns=column[:, None],
        is_levels=levels(column) is not None,
        other_columns=(values / middle - 1.0)[:, None] if middle > 0.0 else None,
    )


def _temperature(values_K: np.ndarray) -> Condition:
    if np.ptp(values_K) < LEAST_TEMPERATURE_K:
        return Condition(TEMPERATURE, "K", values_K, np.empty((values_K.size, 0)), is_levels=True)
    column = (values_K - np.median(values_K)) / TEMPERATURE_STEP_K
    return Condition(TEMPERATURE, "K", values_K, column[:, None], levels(column) is not None)


def levels(values: np.ndarray) -> np.ndarray | None:
    """Return the number of the level of each value; None where values are not few levels."""
    order = np.argsort(values)
    jumps = np.diff(values[order]) > WIDEST_LEVEL * np.ptp(values)
    number_sorted = np.concatenate(([0], np.cumsum(jumps)))
    if number_sorted[-1] >= MOST_LEVELS:
        return None
    for k in range(number_sorted[-1] + 1):
        level = values[order][number_sorted == k]
        if np.ptp(level) > WIDEST_LEVEL * np.ptp(values):
            return None
    number = np.empty(values.size, dtype=int)
    number[order] = number_sorted
    return number


def _groups(conditions: Sequence[Condition], points: int) -> np.ndarray:
    """Return the number of the group of equal levels of all conditions, (n,)."""
    keys = []
    for condition in conditions:
        if not condition.varies:
            continue
        number = levels(condition.columns[:, 0])
        if condition.name in (SERIES, DIRECTION):
            _, number = np.unique(condition.values, return_inverse=True)
        if number is not None:
            keys.append(number)
    if not keys:
        return np.zeros(points, dtype=int)
    _, number = np.unique(np.column_stack(keys), axis=0, return_inverse=True)
    return number.reshape(-1)


def going_together(prepared: Prepared) -> dict[str, list[str]]:
    """Return for each condition that creepage or others explain: the names of these others.

    A condition is only compared with those before it, so the first of several is kept.
    """
    share = prepared.creepage / max(float(prepared.creepage.max()), 1e-12)
    of_creepage = np.column_stack([share, share**2, share**3])
    found: dict[str, list[str]] = {}
    kept: list[Condition] = []
    for condition in prepared.conditions:
        if not condition.varies:
            continue
        partners = [other.name for other in kept if _explained(condition, [other.columns])]
        if not partners and kept and _explained(condition, [other.columns for other in kept]):
            partners = [other.name for other in kept]
        if not partners and _explained(condition, [of_creepage]):
            partners = [CREEPAGE]
        if not partners and _explained(condition, [of_creepage, *(o.columns for o in kept)]):
            partners = [CREEPAGE, *(other.name for other in kept)]
        if partners:
            found[condition.name] = partners
        else:
            kept.append(condition)
    return found


def _explained(condition: Condition, others: Sequence[np.ndarray]) -> bool:
    """Whether columns explain nearly all of the columns of a condition."""
    points = condition.columns.shape[0]
    base = np.column_stack([np.ones(points), *others])
    fitted = base @ np.linalg.lstsq(base, condition.columns, rcond=None)[0]
    left = np.sum((condition.columns - fitted) ** 2, axis=0)
    centred = condition.columns - condition.columns.mean(axis=0)
    return bool(np.any(left < (1.0 - TOGETHER) * np.sum(centred**2, axis=0)))
