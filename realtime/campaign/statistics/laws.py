"""Laws of inputs: distributions of `scipy.stats` by their names, correlated by a Gaussian copula.

[L1] A share s between 0 and 1 becomes the value at which the cumulative law is
     F(low) + s * (F(high) - F(low)). Without limits low and high it is the value at s.
[L2] Correlated inputs: standard normal numbers z with the correlation matrix R, and s = Phi(z). The
     law of each input stays as it is. For a rank correlation rho of two inputs (Spearman), the
     entry of R is 2 * sin(pi / 6 * rho).
[L3] An input of single units, such as discs, has an entry of R for two units of one car, and
     another one for two units of different cars.
[L4] The strength of a brake rises with the normal number z of an input by about
     e / 2 * log(x(1) / x(-1)), where x(z) is the value of the input and e the elasticity of the
     deceleration: its relative change over that of the input.

Sources: Nelsen 2006 [L2]; Kruskal 1958 for the entry of R.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError

# keys of an input that are no parameters of its distribution
DISTRIBUTION = "distribution"
SOURCE = "source"
LIMITS = ("low", "high")
# keys of an entry of [[correlation]]
CORRELATION_KEYS = ("inputs", "rank_correlation", "source")
# further keys of an input
ELASTICITY = table.number(
    "elasticity", 0.0, -10.0, 10.0, "relative change of the deceleration over that of the input"
)
IN_CAR = table.number("correlation_in_car", 0.0, 0.0, 0.999, "rank correlation of two units")
BETWEEN_CARS = table.number(
    "correlation_between_cars", 0.0, 0.0, 0.999, "rank correlation of two units of two cars"
)
PER = "per"
UNIT_KEYS = (PER, IN_CAR.name, BETWEEN_CARS.name)
# the elasticities of keys of which the mean deceleration of a dry stop is a product or a quotient
_ELASTICITIES = {
    "vehicle.mass_kg": -1.0,
    "brake.cylinder_area_m2": 1.0,
    "brake.lever_ratio": 1.0,
    "brake.efficiency": 1.0,
    "brake.pad_friction": 1.0,
    "brake.disc_radius_m": 1.0,
}
# the ends of the unit interval, where many laws are infinite
_LEAST_SHARE = 1e-12


class Law(NamedTuple):
    """The law of one input.

    name: the input, as in `adhesion.mu_cd`.
    frozen: the distribution with its parameters.
    low_share, high_share: F(low) and F(high) of [L1].
    text: the law in words.
    source: where the law is from.
    elasticity: of the deceleration [L4]; a wrong one costs precision and biases nothing.
    """

    name: str
    frozen: Any
    low_share: float
    high_share: float
    text: str
    source: str
    elasticity: float = 0.0

    @property
    def strength(self) -> float:
        """How the logarithm of the deceleration changes with the normal number z [L4]."""
        if not self.elasticity:
            return 0.0
        weak, strong = self.at(stats.norm.cdf([-1.0, 1.0]))
        if not 0.0 < weak < strong < math.inf:
            return 0.0
        return float(0.5 * self.elasticity * math.log(strong / weak))

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Return the values at shares between 0 and 1 [L1]."""
        inner = np.clip(shares, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
        return np.asarray(
            self.frozen.ppf(self.low_share + inner * (self.high_share - self.low_share))
        )


def names() -> list[str]:
    """Return the names of all continuous distributions of `scipy.stats`."""
    return sorted(
        name
        for name in dir(stats)
        if isinstance(getattr(stats, name), stats.rv_continuous) and not name.startswith("_")
    )


def read(name: str, given: Any, where: str) -> Law:
    """Return the law of an input from its table. Raises ConfigError with the place `where`."""
    if not isinstance(given, Mapping):
        raise ConfigError(
            f"{where} = {given!r}: must be a table, such as "
            '{ distribution = "norm", loc = 0.05, scale = 0.01, source = "..." }'
        )
    source = given.get(SOURCE)
    if not isinstance(source, str) or not source.strip():
        raise ConfigError(
            f"{where}: source is missing; write where this law is from, or that it is an assumption"
        )
    distribution = _distribution(given.get(DISTRIBUTION), where)
    parameters = _parameters(distribution, given, where)
    frozen = distribution(**parameters)
    if not np.isfinite(frozen.ppf(0.5)):
        texts = ", ".join(f"{key} = {value:g}" for key, value in parameters.items())
        raise ConfigError(
            f"{where}: {texts}: not allowed for the distribution {distribution.name}; "
            f"see scipy.stats.{distribution.name} for the ranges of its parameters"
        )

    low = _number(given, "low", where) if "low" in given else -math.inf
    high = _number(given, "high", where) if "high" in given else math.inf
    low_share, high_share = float(frozen.cdf(low)), float(frozen.cdf(high))
    if not low < high or not low_share < high_share:
        raise ConfigError(
            f"{where}: low = {low:g} and high = {high:g}: low must be less than high, and the law "
            f"must have values between them (it has {frozen.ppf(0.01):.4g} to "
            f"{frozen.ppf(0.99):.4g} in 98 % of the runs)"
        )
    keys = {key: given[key] for key in (*parameters, *LIMITS) if key in given}
    words = [distribution.name, *(f"{key} = {value:g}" for key, value in keys.items())]
    row = ELASTICITY._replace(default=_ELASTICITIES.get(name, 0.0))
    elasticity = table.check(row, given.get(row.name, row.default), where)
    return Law(name, frozen, low_share, high_share, ", ".join(words), source, elasticity)


def _distribution(name: Any, where: str) -> Any:
    """Return a continuous distribution by its name."""
    if not isinstance(name, str):
        raise ConfigError(
            f'{where}: distribution is missing; write the name of scipy.stats, such as "norm", '
            '"uniform", "lognorm", "triang", "beta" or "weibull_min"'
        )
    distribution = getattr(stats, name, None)
    if not isinstance(distribution, stats.rv_continuous):
        raise ConfigError(
            f"{where}: distribution = '{name}' is no continuous distribution of scipy.stats"
            f"{table.nearest(name, names())}"
        )
    return distribution


def _parameters(distribution: Any, given: Mapping[str, Any], where: str) -> dict[str, float]:
    """Return the parameters of a distribution by the names of `scipy.stats`."""
    shapes = distribution.shapes.split(", ") if distribution.shapes else []
    further = (ELASTICITY.name, *UNIT_KEYS)
    allowed = [DISTRIBUTION, SOURCE, *LIMITS, *shapes, "loc", "scale", *further]
    table.known(given, allowed, lambda key: where)
    missing = [shape for shape in shapes if shape not in given]
    if missing:
        raise ConfigError(
            f"{where}: {', '.join(missing)} is missing, a parameter of the shape of the "
            f"distribution {distribution.name}"
        )
    found = {}
    for key in (*shapes, "loc", "scale"):
        if key in given:
            found[key] = _number(given, key, where)
    if found.get("scale", 1.0) <= 0.0:
        raise ConfigError(f"{where}: scale = {found['scale']:g}: must be above 0")
    return found


def _number(given: Mapping[str, Any], key: str, where: str) -> float:
    return float(table.check(table.number(key, None, -1e300, 1e300, "-"), given[key], where))


def read_correlation(entries: Any, inputs: Sequence[str], where: str) -> np.ndarray:
    """Return the matrix R [L2] of all inputs, (n, n), from the entries of [[correlation]].

    An entry has two names, their rank correlation, and a source. Raises ConfigError.
    """
    matrix = np.eye(len(inputs))
    if not isinstance(entries, list):
        raise ConfigError(f"{where}: write [[correlation]] with double brackets, once per pair")
    for number, entry in enumerate(entries, start=1):
        at = f"{where} number {number}"
        table.known(entry, CORRELATION_KEYS, lambda key, at=at: at)
        first, second = _pair(entry.get("inputs"), inputs, at)
        source = entry.get("source")
        if not isinstance(source, str) or not source.strip():
            raise ConfigError(f"{at}: source is missing; write where this correlation is from")
        row = table.number("rank_correlation", None, -0.999, 0.999, "-")
        correlation = table.check(row, entry.get("rank_correlation"), at)
        if matrix[first, second] != 0.0:
            raise ConfigError(f"{at}: the pair {entry['inputs']} occurs twice; keep one entry")
        matrix[first, second] = matrix[second, first] = _entry(correlation)
    _check_possible(matrix, where)
    return matrix


def _entry(rank_correlation: float) -> float:
    """Return the entry of R for a rank correlation [L2]."""
    return 2.0 * math.sin(math.pi / 6.0 * rank_correlation)


def of_units(cars: Sequence[int], in_car: float, between_cars: float) -> np.ndarray:
    """Return the matrix R of the units of one input, (n, n); `cars` has the car of each [L3]."""
    car = np.asarray(cars)
    matrix = np.where(car[:, None] == car[None, :], _entry(in_car), _entry(between_cars))
    np.fill_diagonal(matrix, 1.0)
    return matrix


def _check_possible(matrix: np.ndarray, where: str) -> None:
    """Raise ConfigError unless a law has this matrix R."""
    least = float(np.linalg.eigvalsh(matrix)[0]) if len(matrix) else 1.0
    if least <= 1e-9:
        raise ConfigError(
            f"{where}: no law has all these correlations together (the least eigenvalue of their "
            f"matrix is {least:.3g}, it must be above 0); make them smaller, or state the "
            "correlations of the other pairs as well"
        )


def _pair(names_of_pair: Any, inputs: Collection[str], where: str) -> tuple[int, int]:
    """Return the places of the two inputs of a correlation."""
    order = list(inputs)
    if (
        not isinstance(names_of_pair, list)
        or len(names_of_pair) != 2
        or not all(isinstance(name, str) for name in names_of_pair)
        or names_of_pair[0] == names_of_pair[1]
    ):
        raise ConfigError(f"{where}: inputs = {names_of_pair!r}: must be two different names")
    for name in names_of_pair:
        if name not in order:
            raise ConfigError(
                f"{where}: '{name}' is no input with a distribution{table.nearest(name, order)}"
            )
    return order.index(names_of_pair[0]), order.index(names_of_pair[1])


def correlated(shares: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Return shares (runs, n) with the correlation matrix R [L2] from independent ones."""
    if np.array_equal(matrix, np.eye(len(matrix))):
        return shares
    inner = np.clip(shares, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
    normal = stats.norm.ppf(inner) @ np.linalg.cholesky(matrix).T
    return np.asarray(stats.norm.cdf(normal))
