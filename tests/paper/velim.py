"""The six stops of the paper at Velim in closed loop with the reference WSP: Table 6 and ours.

What the paper does not print (brake demand, WSP thresholds, the contaminant of each test) is found
on group A, where Table 6 prints mean and standard deviation of the sliding of wheelset 1. The
result is in `velim.toml` next to this file. Group B is predicted: the initial speed of Table 5 is
all that is known of a test, so its contaminant is the geometric mean of group A's. The stops run on
the track, with Table 4.

    [Q1] cost = sum over A1..A3 of (mean - measured)^2 + (deviation - measured)^2
    [Q2] mean and deviation over the whole stop, paper eqs. 23 and 24
    [Q3] band of the WSP: the minimum of a quadratic in both edges, through the costs of the bands
         that were tried; stick and slip scatter the cost of a band by about 0.02 m/s rms
    [Q4] mean of a test that has not been run: ours +- t s sqrt(1 + 1/3), with s the deviation of
    group
         A's measured means and t Student's for two degrees of freedom

Besides this blind prediction there is the paper's own task: mu_cd of each test is the one that
gives its measured mean, and the deviation is predicted. It is done with the law, and for the
classic model without recovery (tau = 0). The decelerations of the first and the second half of a
stop show the effect of recovery.

The speed of Table 5 is all that is printed of a test before it runs. So the prediction of any model
for group B is a function of speed that is found on the three tests of group A. `bounds` fits such
functions to the measured numbers, as a model without any error of its own would; no model of the
stop takes part. Least absolute values is the robust fit: it ignores A3, which was measured 1.3 m/s
below B1 at the same speed. The rules of the largest value are no fits: that they do better is only
visible on group B. Source: paper Tables 5 and 6.

Doubt: the recordings are not public. So E1 cannot be computed, and sliding is compared by two
numbers per test. The B rows of Table 6 are never used for fitting.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.stats import t

from rollerrig.configs import store
from rollerrig.configs.table import number, read
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.wsp_interface import signals

# the signals of the coach of the tests
TABLE = signals.table(COACH)

# what was found on group A
SETTINGS = Path(__file__).with_name("velim.toml")

GROUP_A = ("a1", "a2", "a3")
GROUP_B = ("b1", "b2", "b3")
TESTS = GROUP_A + GROUP_B


def _by_test(*values: float) -> dict[str, float]:
    """Return a row of a table of the paper, by test."""
    return dict(zip(TESTS, values, strict=True))


# paper Table 5: initial speeds
SPEEDS_M_S = _by_test(42.3, 40.4, 40.8, 40.8, 41.1, 41.8)
# paper Table 6, m/s: sliding of wheelset 1, measured and in the paper's model; the largest error
# of its velocity
MEASURED_MEAN = _by_test(5.00, 5.25, 4.23, 5.49, 5.41, 5.83)
MEASURED_STD = _by_test(1.72, 2.19, 1.59, 1.75, 1.77, 1.78)
PAPER_MEAN = _by_test(5.61, 4.96, 4.61, 5.14, 5.30, 5.73)
PAPER_STD = _by_test(1.49, 1.79, 1.59, 1.58, 1.45, 1.84)
PAPER_E1 = _by_test(2.05, 0.90, 1.84, 1.51, 0.91, 1.68)
# paper Table 4
TABLE_4_MU_CD = 0.06

SAMPLE_S = 0.01
# speeds between which the deceleration of the first and of the second half of a stop is taken
HALVES_M_S = ((40.0, 30.0), (20.0, 10.0))
# a setting that cleans at every creepage, as the law of the paper does
PAPERS_LAW = "adhesion.cleaning_creepage=inf"
# the packaged set whose cleaning at large sliding stands beside that of the paper
PACKAGED_SET = "soap"
# a setting that turns recovery off: the classic model
CLASSIC = "adhesion.tau_m_J=0.0"
# contaminants that `over_contaminants` tries, and number of points of its curves
SCAN = tuple(float(mu_cd) for mu_cd in np.geomspace(0.006, 0.06, 13))
_CURVE_POINTS = 500
# contaminants whose means are so close to the best one are equally good
_EQUAL_M_S = 0.02
# lower edge of the WSP's sliding band and its width in m/s, which `calibrate` tries
BANDS = tuple(
    (low, width) for low in (3.0, 3.4, 3.8, 4.2, 4.6, 5.0) for width in (1.4, 2.0, 2.6, 3.2)
)
# bands whose cost [Q1] is at most so many times the least one determine the best band [Q3]
_NEAR = 2.0

_FIT = "fitted on group A of Table 6"
# keys of SETTINGS
ROWS = (
    number("pressure_Pa", 3.8e5, 1e5, 5e5, _FIT),
    number("band_low_m_s", 5.2, 0.5, 15.0, _FIT),
    number("band_high_m_s", 6.2, 0.6, 16.0, _FIT),
    number("band_low_fraction", 0.5, 0.0, 0.9, "assumption"),
    number("band_high_fraction", 0.65, 0.0, 0.9, "assumption"),
    *(number(f"mu_cd_{test}", 0.03, 1e-3, 0.3, _FIT) for test in GROUP_A),
)


class Stop(NamedTuple):
    """Our numbers for Table 6; arrays have the shape (4,), one value per wheelset."""

    sliding_mean_m_s: np.ndarray
    sliding_std_m_s: np.ndarray
    stop_time_s: float
    stop_distance_m: float
    longest_lock_s: float
    decelerations_m_s2: tuple[float, ...]  # over HALVES_M_S


class FromMean(NamedTuple):
    """A test whose mu_cd gives the measured mean sliding of wheelset 1; the rest is predicted."""

    mu_cd: float
    mean_m_s: float
    std_m_s: float
    decelerations_m_s2: tuple[float, ...]


# --- the stops ---


def settings() -> dict[str, float]:
    """Return what was found on group A. Raises ConfigError."""
    return read(ROWS, store.parse(SETTINGS), str(SETTINGS))


def contaminant(found: dict[str, float], test: str) -> float:
    """Return mu_cd of a test: the one found for it in group A, their geometric mean in group B."""
    if test in GROUP_A:
        return found[f"mu_cd_{test}"]
    return float(np.exp(np.mean([np.log(found[f"mu_cd_{name}"]) for name in GROUP_A])))


def plan_of(test: str, found: dict[str, float], *law: str) -> scenario.Scenario:
    """Return the scenario of a test on the track, with what was found; `law`: further settings."""
    mu_cd = contaminant(found, test)
    return scenario.load(
        f"velim_{test}",
        settings=("rig.mode=track", f"adhesion.mu_cd={mu_cd!r}", PAPERS_LAW, *law),
        tables={"demand": [{"from_s": 0.0, "pressure_Pa": found["pressure_Pa"]}]},
    )


def packaged_law() -> tuple[str, ...]:
    """Return the settings that give cleaning the end that it has on the packaged soap [A6]."""
    packaged = store.load("adhesion", PACKAGED_SET)[0]["adhesion"]
    return tuple(
        f"adhesion.{name}={value!r}"
        for name, value in packaged.items()
        if name.startswith("cleaning_")
    )


def unit_of(plan: scenario.Scenario, found: dict[str, float]) -> logic.Params:
    """Return the parameters of the reference WSP unit, with the band that was found.

    The band is not narrowed where little deceleration is learned: what was found is the band.
    """
    band = {name: value for name, value in found.items() if name.startswith("band_")}
    changed = {"narrow_share": 1.0, **band}
    return logic.load(plan["wsp_config"])._replace(**changed)


def rows_of(test: str, found: dict[str, float], *law: str) -> np.ndarray:
    """Run a test; return the samples up to standstill. `law`: further settings as in `plan_of`."""
    plan = plan_of(test, found, *law)
    return free.moving(free.simulate(plan, unit_of(plan, found)))


def stop(test: str, found: dict[str, float], *law: str) -> Stop:
    """Run a test; return its numbers for Table 6 [Q2]. `law`: further settings."""
    return reduced(rows_of(test, found, *law))


def reduced(rows: np.ndarray) -> Stop:
    """Return the numbers for Table 6 [Q2] of a stop up to standstill; `rows`: of all signals."""
    sliding = rows[:, TABLE.span("sliding")]
    speed = rows[:, signals.column("vehicle_speed")]
    return Stop(
        sliding_mean_m_s=sliding.mean(axis=0),
        sliding_std_m_s=sliding.std(axis=0),
        stop_time_s=SAMPLE_S * len(rows),
        stop_distance_m=float(rows[-1, signals.column("position")]),
        longest_lock_s=float(rows[-1, TABLE.span("longest_lock")].max()),
        decelerations_m_s2=tuple(
            _deceleration_m_s2(speed, above, below) for above, below in HALVES_M_S
        ),
    )


def _deceleration_m_s2(speed: np.ndarray, above_m_s: float, below_m_s: float) -> float:
    """Return the mean deceleration between two speeds."""
    begin = int(np.argmax(speed < above_m_s))
    end = int(np.argmax(speed < below_m_s))
    return (above_m_s - below_m_s) / (SAMPLE_S * (end - begin))


def table6(found: dict[str, float], say: Callable[[str], None], *law: str) -> dict[str, Stop]:
    """Run all six stops; `law`: further settings."""
    stops = {}
    for test in TESTS:
        say(f"stop {' '.join((test.upper(), *law))} ...")
        stops[test] = stop(test, found, *law)
    return stops


# --- contaminants ---


def over_contaminants(
    test: str, found: dict[str, float], *law: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return a test as a function of its contaminant: mu_cd (n,), and figures (4, n).

    The figures are mean and deviation of the sliding of wheelset 1, and both decelerations. Stick
    and slip scatter a stop by about 0.1 m/s, so they are cubics in ln(mu_cd) through the stops of
    `SCAN`. `law`: further settings as in `plan_of`.
    """
    plans = []
    for mu_cd in SCAN:
        settings_of_stop = (f"adhesion.mu_cd={mu_cd!r}", "duration_max_s=1000.0", *law)
        plans.append((mu_cd, plan_of(test, found, *settings_of_stop)))
    unit = unit_of(plans[0][1], found)

    # the stops finish in any order
    stops = {}
    for finished in stops_in_lanes.together(plans, unit):
        recorded = np.column_stack([finished.channels[name] for name in TABLE.columns])
        rows = TABLE.rows_of_all(recorded)
        stops[finished.tag] = reduced(free.moving(rows))
    values = np.array([_figures(stops[mu_cd]) for mu_cd in SCAN])

    tried = np.log(SCAN)
    at = np.linspace(tried[0], tried[-1], _CURVE_POINTS)
    curves = [np.polyval(np.polyfit(tried, column, 3), at) for column in values.T]
    return np.exp(at), np.array(curves)


def _figures(one: Stop) -> tuple[float, ...]:
    return (one.sliding_mean_m_s[0], one.sliding_std_m_s[0], *one.decelerations_m_s2)


def from_measured_mean(test: str, found: dict[str, float], *law: str) -> FromMean:
    """Do the paper's own task for a test: mu_cd from its measured mean, all else predicted.

    Without recovery two contaminants give the same mean; the larger one counts, which is closer to
    the printed 0.06. If none gives the mean, the nearest counts. `law`: further settings.
    """
    mu_cd, figures = over_contaminants(test, found, *law)
    error = np.abs(figures[0] - MEASURED_MEAN[test])
    equally_good = np.flatnonzero(error <= error.min() + _EQUAL_M_S)
    best = int(equally_good[-1])
    mean, deviation, *halves = (float(figure) for figure in figures[:, best])
    return FromMean(float(mu_cd[best]), mean, deviation, tuple(halves))


def from_measured_means(
    found: dict[str, float], say: Callable[[str], None], *law: str
) -> dict[str, FromMean]:
    """Do the paper's own task for all six tests; `law`: further settings."""
    results = {}
    for test in TESTS:
        say(f"mu_cd of {test.upper()} from its mean {' '.join(law)} ...")
        results[test] = from_measured_mean(test, found, *law)
    return results


def calibrate(say: Callable[[str], None]) -> dict[str, float]:
    """Return what is not printed: contaminants of A1..A3 and the WSP's band, from group A [Q1, Q3].

    The bands that are tried are `BANDS`. The demand stays a full service brake: nearly everywhere
    there is less adhesion than brake, so Table 6 contains no information on it.
    """
    costs = [_fitted_to_group_a(low, round(low + width, 1), say)[1] for low, width in BANDS]
    low, high = least_of_surface(np.array(BANDS), np.array(costs))
    found, _ = _fitted_to_group_a(low, high, say)
    return found


def _fitted_to_group_a(
    low_m_s: float, high_m_s: float, say: Callable[[str], None]
) -> tuple[dict[str, float], float]:
    """Return the settings with a band and the contaminants that fit it best, and the cost [Q1]."""
    tried = settings() | {"band_low_m_s": low_m_s, "band_high_m_s": high_m_s}
    cost = 0.0
    for test in GROUP_A:
        mu_cd, (mean, deviation, *_) = over_contaminants(test, tried)
        # [Q1]
        off = (mean - MEASURED_MEAN[test]) ** 2 + (deviation - MEASURED_STD[test]) ** 2
        tried[f"mu_cd_{test}"] = float(mu_cd[off.argmin()])
        cost += float(off.min())
    values = "  ".join(f"{name} {value:.4g}" for name, value in tried.items())
    say(f"{values}   rms {np.sqrt(cost / 6.0):.3f} m/s")
    return tried, cost


def least_of_surface(bands: np.ndarray, costs: np.ndarray) -> tuple[float, float]:
    """Return both edges of the band with the least cost on a quadratic surface [Q3], to 0.1 m/s.

    bands: lower edges and widths, (n, 2); costs: (n,). Bands with a cost of more than `_NEAR` times
    the least one do not count: far from the minimum the cost is no quadratic.
    """
    near = costs <= _NEAR * costs.min()
    surface, *_ = np.linalg.lstsq(_quadratic(bands[near]), costs[near], rcond=None)
    lows, widths = (
        np.arange(10.0 * edges.min(), 10.0 * edges.max() + 0.5) / 10.0 for edges in bands.T
    )
    fine = np.array([(low, width) for low in lows for width in widths])
    low, width = fine[(_quadratic(fine) @ surface).argmin()]
    return round(float(low), 1), round(float(low + width), 1)


def _quadratic(bands: np.ndarray) -> np.ndarray:
    """Return the six terms of a quadratic in the lower edge and the width of a band, (n, 6)."""
    low, width = bands.T
    return np.column_stack([np.ones(len(bands)), low, width, low**2, low * width, width**2])


# --- results ---


def half_width_m_s() -> float:
    """Return half the 95 % prediction interval [Q4] of the mean sliding of a test not yet run."""
    means = [MEASURED_MEAN[test] for test in GROUP_A]
    students_t = t.ppf(0.975, len(means) - 1)
    return float(students_t * np.std(means, ddof=1) * np.sqrt(1.0 + 1.0 / len(means)))


def as_json(
    found: dict[str, float],
    ours: dict[str, Stop],
    packaged: dict[str, Stop],
    from_mean: dict[str, FromMean],
    classic: dict[str, FromMean],
) -> dict[str, Any]:
    """Return what was fitted, what was predicted, and the errors, as plain data."""
    mean, deviation = _first_wheelset(ours)
    # [Q1]
    off = [
        (mean[test] - MEASURED_MEAN[test], deviation[test] - MEASURED_STD[test]) for test in GROUP_A
    ]

    def plain(stops: dict[str, Stop]) -> dict[str, Any]:
        return {
            test: {key: np.asarray(value).tolist() for key, value in one._asdict().items()}
            for test, one in stops.items()
        }

    return {
        "fitted_on_group_a": found,
        "predicted_mu_cd_group_b": contaminant(found, "b1"),
        "stops": plain(ours),
        "stops_packaged_law": plain(packaged),
        "own_contaminant": {test: one._asdict() for test, one in from_mean.items()},
        "own_contaminant_classic": {test: one._asdict() for test, one in classic.items()},
        "group_b_mean_prediction_half_width_m_s": half_width_m_s(),
        "group_a_left_over_rms_m_s": float(np.sqrt(np.mean(np.square(off)))),
        "group_b_mean_absolute_error": errors(ours),
        "group_b_mean_absolute_error_packaged_law": errors(packaged),
        "group_b_bounds": {bound.name: bound.error_m_s for bound in bounds()},
    }


def errors(ours: dict[str, Stop]) -> dict[str, float]:
    """Return mean absolute errors on group B against measured, of ours and of the paper's model."""
    mean, deviation = _first_wheelset(ours)

    def error_m_s(values: Mapping[str, float], measured: Mapping[str, float]) -> float:
        return float(np.mean([abs(values[test] - measured[test]) for test in GROUP_B]))

    return {
        "mean_m_s": error_m_s(mean, MEASURED_MEAN),
        "deviation_m_s": error_m_s(deviation, MEASURED_STD),
        "paper_mean_m_s": error_m_s(PAPER_MEAN, MEASURED_MEAN),
        "paper_deviation_m_s": error_m_s(PAPER_STD, MEASURED_STD),
    }


def _first_wheelset(ours: dict[str, Stop]) -> tuple[dict[str, float], dict[str, float]]:
    """Return mean and standard deviation of the sliding of wheelset 1 by test, m/s."""
    mean = {test: float(one.sliding_mean_m_s[0]) for test, one in ours.items()}
    deviation = {test: float(one.sliding_std_m_s[0]) for test, one in ours.items()}
    return mean, deviation


def rows_for_table(
    ours: dict[str, Stop],
    packaged: dict[str, Stop],
    from_mean: dict[str, FromMean],
    classic: dict[str, FromMean],
) -> list[tuple[str, ...]]:
    """Return Table 6 in the paper's form with ours, then the decelerations of both halves.

    `packaged` are the same stops where cleaning ends as on the packaged soap.
    """
    mean, deviation = _first_wheelset(ours)
    mean_packaged, deviation_packaged = _first_wheelset(packaged)
    deviation_from_mean = {test: one.std_m_s for test, one in from_mean.items()}
    classic_mean = {test: one.mean_m_s for test, one in classic.items()}
    classic_deviation = {test: one.std_m_s for test, one in classic.items()}
    table = [
        ("E1, largest velocity error, paper's model", PAPER_E1),
        ("mean sliding of wheelset 1, measured", MEASURED_MEAN),
        ("mean sliding, paper's model", PAPER_MEAN),
        ("mean sliding, ours", mean),
        ("mean sliding, ours, packaged soap", mean_packaged),
        ("standard deviation, measured", MEASURED_STD),
        ("standard deviation, paper's model", PAPER_STD),
        ("standard deviation, ours", deviation),
        ("standard deviation, ours, packaged soap", deviation_packaged),
        ("standard deviation, ours, mu_cd from the test's own mean", deviation_from_mean),
        ("mean sliding, classic (tau = 0), mu_cd nearest to it", classic_mean),
        ("standard deviation, classic", classic_deviation),
    ]
    for i, (above, below) in enumerate(HALVES_M_S):
        title = f"deceleration {above:g} to {below:g} m/s, m/s2"
        our_half = {test: one.decelerations_m_s2[i] for test, one in ours.items()}
        packaged_half = {test: one.decelerations_m_s2[i] for test, one in packaged.items()}
        classic_half = {test: one.decelerations_m_s2[i] for test, one in classic.items()}
        table.append((f"{title}, ours", our_half))
        table.append((f"{title}, ours, packaged soap", packaged_half))
        table.append((f"{title}, classic", classic_half))
    return [(title, *(f"{values[test]:.2f}" for test in TESTS)) for title, values in table]


def rows_of_contaminants(
    found: dict[str, float], from_mean: dict[str, FromMean], classic: dict[str, FromMean]
) -> list[tuple[str, ...]]:
    """Return mu_cd of every test as text, and the one that the paper prints."""
    table = [
        ("printed in Table 4, for all", dict.fromkeys(TESTS, TABLE_4_MU_CD)),
        ("ours, found on group A", {test: contaminant(found, test) for test in TESTS}),
        (
            "ours, from the test's own mean",
            {test: one.mu_cd for test, one in from_mean.items()},
        ),
        (
            "classic (tau = 0), nearest to its own mean",
            {test: one.mu_cd for test, one in classic.items()},
        ),
    ]
    return [(title, *(f"{values[test]:.4f}" for test in TESTS)) for title, values in table]


# --- what can be predicted at all ---

# a rule takes speeds and means of the known tests, and the speeds at which it predicts; m/s
Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


class Bound(NamedTuple):
    """A rule, its predictions for group B, and its mean absolute error there."""

    name: str
    predicted_m_s: tuple[float, ...]
    error_m_s: float


def _robust_line(speed: np.ndarray, mean: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Predict by the line of least absolute values, which runs through two of the points."""
    lines = []
    for i in range(len(speed)):
        for j in range(i):
            if speed[i] != speed[j]:
                lines.append(np.polyfit(speed[[i, j]], mean[[i, j]], 1))

    def absolute_error(line: np.ndarray) -> float:
        return float(np.abs(np.polyval(line, speed) - mean).sum())

    return np.polyval(min(lines, key=absolute_error), at)


def _monotone(sign: float) -> Rule:
    """Return the rule that rises with speed (sign 1) or falls (-1), by isotonic regression."""

    def rule(speed: np.ndarray, mean: np.ndarray, at: np.ndarray) -> np.ndarray:
        order = np.argsort(speed)
        fitted = isotonic_regression(sign * mean[order]).x
        return sign * np.interp(at, speed[order], fitted)

    return rule


def _through_all(speed: np.ndarray, mean: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.interp(at, np.sort(speed), mean[np.argsort(speed)])


# v: speed, s: mean sliding of the known tests
RULES: tuple[tuple[str, Rule], ...] = (
    ("one value, least squares (the mean)", lambda v, s, at: np.full(len(at), s.mean())),
    ("one value, least absolute (the median)", lambda v, s, at: np.full(len(at), np.median(s))),
    ("a line, least squares", lambda v, s, at: np.polyval(np.polyfit(v, s, 1), at)),
    ("a line, least absolute", _robust_line),
    ("rising with speed, least squares", _monotone(1.0)),
    ("falling with speed, least squares", _monotone(-1.0)),
    ("through all of group A", _through_all),
    ("the largest of group A, for all", lambda v, s, at: np.full(len(at), s.max())),
    ("the largest mean / speed of group A, times speed", lambda v, s, at: np.max(s / v) * at),
)


def bounds(
    speeds_m_s: Mapping[str, float] = SPEEDS_M_S,
    measured: Mapping[str, float] = MEASURED_MEAN,
    known: Sequence[str] = GROUP_A,
    predicted: Sequence[str] = GROUP_B,
) -> list[Bound]:
    """Fit every rule to the tests `known`, and judge it on the tests `predicted`; m/s."""
    speed = np.array([speeds_m_s[test] for test in known])
    mean = np.array([measured[test] for test in known])
    at = np.array([speeds_m_s[test] for test in predicted])
    truth = np.array([measured[test] for test in predicted])

    result = []
    for name, rule in RULES:
        values = rule(speed, mean, at)
        error_m_s = float(np.abs(values - truth).mean())
        result.append(Bound(name, tuple(float(value) for value in values), error_m_s))
    return result
