"""The six stops of the paper at Velim, in closed loop with the reference WSP: Table 6, ours beside it.

What the paper does not print (brake demand, WSP thresholds, the contaminant of each test) is found on
group A, where Table 6 prints mean and spread of the sliding of wheelset 1; it stands in
`tests/paper/velim.toml`. Group B is predicted: Table 5's initial speed is all that is known of a test, so
its contaminant is the geometric mean of group A's. The stops run on the track, with Table 4.

    [Q1] cost = sum over A1..A3 of (mean - measured)^2 + (deviation - measured)^2
    [Q2] mean and deviation over the whole stop, paper eqs. 23 and 24
    [Q3] mean of a test not yet run: ours +- t s sqrt(1 + 1/3), s the deviation of group A's measured means
         and t Student's for two degrees of freedom

Beside this blind prediction stands the paper's own task: each test's mu_cd is what gives its measured mean, and the
deviation is predicted; with the law and, for the classic model, without recovery (tau = 0). What recovery is for, the
decelerations of the first and the second half of a stop show.

Table 5's speed is all that is printed of a test before it runs, so whatever a model is, its prediction for group B is a
function of speed found on the three tests of group A. `bounds` fits such functions to the measured numbers themselves,
as a model without any error of its own would; no model of the stop takes part. Least absolute values is the robust
fit: it lets go of A3, which was measured 1.3 m/s below B1 at the same speed. The largest values are no fits: that they
do better is seen on group B only. Source: paper Tables 5 and 6.

Doubt: the recordings are not public, so E1 cannot be computed, and sliding is compared by two numbers
a test. Table 6's B rows are never used for fitting.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.stats import t

from rollerrig.configs import store
from rollerrig.configs.table import number, read
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import four_stops
from rollerrig.wsp_interface import signals

SETTINGS = Path(__file__).with_name("velim.toml")
GROUP_A, GROUP_B = ("a1", "a2", "a3"), ("b1", "b2", "b3")
TESTS = GROUP_A + GROUP_B
# paper Table 5
SPEEDS_M_S = dict(zip(TESTS, (42.3, 40.4, 40.8, 40.8, 41.1, 41.8), strict=True))
MEASURED_MEAN = dict(zip(TESTS, (5.00, 5.25, 4.23, 5.49, 5.41, 5.83), strict=True))
MEASURED_STD = dict(zip(TESTS, (1.72, 2.19, 1.59, 1.75, 1.77, 1.78), strict=True))
PAPER_MEAN = dict(zip(TESTS, (5.61, 4.96, 4.61, 5.14, 5.30, 5.73), strict=True))
PAPER_STD = dict(zip(TESTS, (1.49, 1.79, 1.59, 1.58, 1.45, 1.84), strict=True))
PAPER_E1 = dict(zip(TESTS, (2.05, 0.90, 1.84, 1.51, 0.91, 1.68), strict=True))
SAMPLE_S = 0.01
HALVES_M_S = ((40.0, 30.0), (20.0, 10.0))
TABLE_4_MU_CD = 0.06
# contaminants that `own` tries
SCAN = tuple(map(float, np.geomspace(0.006, 0.06, 9)))
# lower edge of the WSP's band and its width, m/s, that `calibrate` tries
BANDS = tuple((low, width) for low in (4.2, 4.5, 4.8, 5.1) for width in (0.9, 1.3, 1.7))
Rule = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
_FIT = "fitted on group A of Table 6"
ROWS = (
    number("pressure_Pa", 3.8e5, 1e5, 5e5, _FIT),
    number("band_low_m_s", 5.2, 0.5, 15.0, _FIT),
    number("band_high_m_s", 6.2, 0.6, 16.0, _FIT),
    *(number(f"mu_cd_{test}", 0.03, 1e-3, 0.3, _FIT) for test in GROUP_A),
)


class Stop(NamedTuple):
    """What Table 6 says of a test, ours; per axle shape (4,)."""

    sliding_mean_m_s: np.ndarray
    sliding_std_m_s: np.ndarray
    stop_time_s: float
    stop_distance_m: float
    longest_lock_s: float
    decelerations_m_s2: tuple[float, ...]  # over HALVES_M_S


class Own(NamedTuple):
    """A test whose contaminant is what gives the measured mean sliding of wheelset 1, the rest predicted."""

    mu_cd: float
    mean_m_s: float
    std_m_s: float
    decelerations_m_s2: tuple[float, ...]


def settings() -> dict[str, float]:
    """What was found on group A: `velim.toml` beside this file. Raises ConfigError."""
    return read(ROWS, store.parse(SETTINGS), str(SETTINGS))


def contaminant(found: dict[str, float], test: str) -> float:
    """mu_cd of a test: its own in group A, the geometric mean of those in group B."""
    if test in GROUP_A:
        return found[f"mu_cd_{test}"]
    return float(np.exp(np.mean([np.log(found[f"mu_cd_{name}"]) for name in GROUP_A])))


def plan_of(test: str, found: dict[str, float], *law: str) -> scenario.Scenario:
    """The scenario of a test on the track, under what was found; `law` are further settings."""
    return scenario.load(
        f"velim_{test}",
        settings=("rig.mode=track", f"adhesion.mu_cd={contaminant(found, test)!r}", *law),
        tables={"demand": [{"from_s": 0.0, "pressure_Pa": found["pressure_Pa"]}]},
    )


def unit_of(plan: scenario.Scenario, found: dict[str, float]) -> logic.Params:
    """The reference WSP unit, with the band that was found."""
    return logic.load(plan["wsp_config"])._replace(
        **{name: found[name] for name in ("band_low_m_s", "band_high_m_s")}
    )


def rows_of(test: str, found: dict[str, float]) -> np.ndarray:
    """Samples of a test's stop up to standstill, under what was found."""
    plan = plan_of(test, found)
    return free.moving(free.simulate(plan, unit_of(plan, found)))


def stop(test: str, found: dict[str, float]) -> Stop:
    """Run a test and reduce it to Table 6's numbers [Q2]."""
    return reduced(rows_of(test, found))


def reduced(rows: np.ndarray) -> Stop:
    """Table 6's numbers [Q2] of a stop's samples up to standstill."""
    sliding, speed = rows[:, signals.span("sliding")], rows[:, signals.column("vehicle_speed")]
    return Stop(
        sliding.mean(axis=0),
        sliding.std(axis=0),
        SAMPLE_S * len(rows),
        float(rows[-1, signals.column("position")]),
        float(rows[-1, signals.span("longest_lock")].max()),
        tuple(
            (above - below)
            / (SAMPLE_S * (int(np.argmax(speed < below)) - int(np.argmax(speed < above))))
            for above, below in HALVES_M_S
        ),
    )


def over_contaminants(
    test: str, found: dict[str, float], *law: str
) -> tuple[np.ndarray, np.ndarray]:
    """(mu_cd (n,), figures (4, n)): mean, deviation, decelerations of a test over contaminants; `law` as in `plan_of`.

    Stick and slip scatter a stop by about 0.1 m/s, so the figures are cubics in ln mu_cd over the stops of `SCAN`.
    """
    plans = [
        (mu_cd, plan_of(test, found, f"adhesion.mu_cd={mu_cd!r}", "duration_max_s=1000.0", *law))
        for mu_cd in SCAN
    ]
    stops = {
        mu_cd: reduced(free.moving(np.column_stack(list(channels.values()))))
        for mu_cd, _, channels in four_stops.together(plans, unit_of(plans[0][1], found))
    }
    values = np.array(
        [
            (one.sliding_mean_m_s[0], one.sliding_std_m_s[0], *one.decelerations_m_s2)
            for one in map(stops.__getitem__, SCAN)
        ]
    )
    tried = np.log(SCAN)
    at = np.linspace(tried[0], tried[-1], 500)
    return np.exp(at), np.array(
        [np.polyval(np.polyfit(tried, column, 3), at) for column in values.T]
    )


def own(test: str, found: dict[str, float], *law: str) -> Own:
    """The paper's own task for a test: mu_cd from its measured mean, all else predicted; `law` as in `plan_of`.

    Without recovery two contaminants give the same mean: the one nearer to the printed 0.06 counts, the largest. Where
    none gives it, the nearest.
    """
    mu_cd, figures = over_contaminants(test, found, *law)
    off = np.abs(figures[0] - MEASURED_MEAN[test])
    best = int(np.flatnonzero(off <= off.min() + 0.02)[-1])
    mean, deviation, *halves = map(float, figures[:, best])
    return Own(float(mu_cd[best]), mean, deviation, tuple(halves))


def table6(found: dict[str, float], say: Callable[[str], None]) -> dict[str, Stop]:
    """All six stops."""
    out = {}
    for test in TESTS:
        say(f"stop {test.upper()} ...")
        out[test] = stop(test, found)
    return out


def owns(found: dict[str, float], say: Callable[[str], None], *law: str) -> dict[str, Own]:
    """The paper's own task for all six; `law` as in `plan_of`."""
    out = {}
    for test in TESTS:
        say(f"mu_cd of {test.upper()} from its mean {' '.join(law)} ...")
        out[test] = own(test, found, *law)
    return out


def half_width_m_s() -> float:
    """Half the 95 % prediction interval of the mean sliding of a test not yet run, from group A's means [Q3]."""
    means = [MEASURED_MEAN[test] for test in GROUP_A]
    return float(
        t.ppf(0.975, len(means) - 1) * np.std(means, ddof=1) * np.sqrt(1.0 + 1.0 / len(means))
    )


def as_json(
    found: dict[str, float], ours: dict[str, Stop], own: dict[str, Own], classic: dict[str, Own]
) -> dict[str, Any]:
    """What was fitted, what was predicted, and how far off it is."""
    mean, deviation = _first_wheelset(ours)
    off = [(mean[t] - MEASURED_MEAN[t], deviation[t] - MEASURED_STD[t]) for t in GROUP_A]  # [Q1]
    return {
        "fitted_on_group_a": found,
        "predicted_mu_cd_group_b": contaminant(found, "b1"),
        "stops": {
            test: {key: np.asarray(value).tolist() for key, value in one._asdict().items()}
            for test, one in ours.items()
        },
        "own_contaminant": {test: one._asdict() for test, one in own.items()},
        "own_contaminant_classic": {test: one._asdict() for test, one in classic.items()},
        "group_b_mean_prediction_half_width_m_s": half_width_m_s(),
        "group_a_left_over_rms_m_s": float(np.sqrt(np.mean(np.square(off)))),
        "group_b_mean_absolute_error": errors(ours),
        "group_b_bounds": {bound.name: bound.error_m_s for bound in bounds()},
    }


def errors(ours: dict[str, Stop]) -> dict[str, float]:
    """Mean absolute errors on group B against the measured rows of Table 6, ours and the paper's model's."""
    mean, deviation = _first_wheelset(ours)
    pairs = {
        "mean_m_s": (mean, MEASURED_MEAN),
        "deviation_m_s": (deviation, MEASURED_STD),
        "paper_mean_m_s": (PAPER_MEAN, MEASURED_MEAN),
        "paper_deviation_m_s": (PAPER_STD, MEASURED_STD),
    }
    return {
        name: float(np.mean([abs(values[test] - measured[test]) for test in GROUP_B]))
        for name, (values, measured) in pairs.items()
    }


def _first_wheelset(ours: dict[str, Stop]) -> tuple[dict[str, float], dict[str, float]]:
    """Mean and standard deviation of its sliding in each test, m/s."""
    return (
        {test: float(one.sliding_mean_m_s[0]) for test, one in ours.items()},
        {test: float(one.sliding_std_m_s[0]) for test, one in ours.items()},
    )


def calibrate(say: Callable[[str], None]) -> dict[str, float]:
    """Find what is not printed on group A [Q1]: contaminants of A1..A3 and the band of the WSP, of those in `BANDS`.

    The demand stays a full service brake: with less adhesion than brake nearly everywhere, Table 6 does not tell it.
    """
    found, least = settings(), np.inf
    for low, width in BANDS:
        tried, cost = found | {"band_low_m_s": low, "band_high_m_s": low + width}, 0.0
        for test in GROUP_A:
            mu_cd, (mean, deviation, *_) = over_contaminants(test, tried)
            off = (mean - MEASURED_MEAN[test]) ** 2 + (deviation - MEASURED_STD[test]) ** 2
            tried[f"mu_cd_{test}"], cost = float(mu_cd[off.argmin()]), cost + float(off.min())
        say(
            "  ".join(f"{name} {value:.4g}" for name, value in tried.items())
            + f"   rms {np.sqrt(cost / 6.0):.3f} m/s"
        )
        if cost < least:
            best, least = tried, cost
    return best


def rows_for_table(
    ours: dict[str, Stop], own: dict[str, Own], classic: dict[str, Own]
) -> list[tuple[str, ...]]:
    """Table 6 in the paper's form, with ours, as text; then what each half of a stop decelerates with."""
    mean, deviation = _first_wheelset(ours)
    halves = [
        (
            f"deceleration {above:g} to {below:g} m/s, m/s2, {name}",
            {test: one.decelerations_m_s2[i] for test, one in table.items()},
        )
        for i, (above, below) in enumerate(HALVES_M_S)
        for name, table in (("ours", ours), ("classic", classic))
    ]
    return [
        (title, *(f"{values[test]:.2f}" for test in TESTS))
        for title, values in (
            ("E1, largest velocity error, paper's model", PAPER_E1),
            ("mean sliding of wheelset 1, measured", MEASURED_MEAN),
            ("mean sliding, paper's model", PAPER_MEAN),
            ("mean sliding, ours", mean),
            ("standard deviation, measured", MEASURED_STD),
            ("standard deviation, paper's model", PAPER_STD),
            ("standard deviation, ours", deviation),
            (
                "standard deviation, ours, mu_cd from the test's own mean",
                {test: one.std_m_s for test, one in own.items()},
            ),
            (
                "mean sliding, classic (tau = 0), mu_cd nearest to it",
                {test: one.mean_m_s for test, one in classic.items()},
            ),
            ("standard deviation, classic", {test: one.std_m_s for test, one in classic.items()}),
            *halves,
        )
    ]


def rows_of_contaminants(
    found: dict[str, float], own: dict[str, Own], classic: dict[str, Own]
) -> list[tuple[str, ...]]:
    """mu_cd of every test, beside the one that the paper prints."""
    return [
        (title, *(f"{values[test]:.4f}" for test in TESTS))
        for title, values in (
            ("printed in Table 4, for all", dict.fromkeys(TESTS, TABLE_4_MU_CD)),
            ("ours, found on group A", {test: contaminant(found, test) for test in TESTS}),
            ("ours, from the test's own mean", {test: one.mu_cd for test, one in own.items()}),
            (
                "classic (tau = 0), nearest to its own mean",
                {test: one.mu_cd for test, one in classic.items()},
            ),
        )
    ]


# --- what can be predicted at all ---


class Bound(NamedTuple):
    """A rule, what it predicts for group B and its mean absolute error there, in m/s."""

    name: str
    predicted_m_s: tuple[float, ...]
    error_m_s: float


def _robust_line(v: np.ndarray, s: np.ndarray, at: np.ndarray) -> np.ndarray:
    # a line of least absolute values runs through two of the points
    pairs = [[i, j] for i in range(len(v)) for j in range(i) if v[i] != v[j]]
    lines = [np.polyfit(v[pair], s[pair], 1) for pair in pairs]
    return np.polyval(min(lines, key=lambda line: float(np.abs(np.polyval(line, v) - s).sum())), at)


def _monotone(sign: float) -> Rule:
    def rule(v: np.ndarray, s: np.ndarray, at: np.ndarray) -> np.ndarray:
        order = np.argsort(v)
        return sign * np.interp(at, v[order], isotonic_regression(sign * s[order]).x)

    return rule


RULES: tuple[tuple[str, Rule], ...] = (
    ("one value, least squares (the mean)", lambda v, s, at: np.full(len(at), s.mean())),
    ("one value, least absolute (the median)", lambda v, s, at: np.full(len(at), np.median(s))),
    ("a line, least squares", lambda v, s, at: np.polyval(np.polyfit(v, s, 1), at)),
    ("a line, least absolute", _robust_line),
    ("rising with speed, least squares", _monotone(1.0)),
    ("falling with speed, least squares", _monotone(-1.0)),
    ("through all of group A", lambda v, s, at: np.interp(at, np.sort(v), s[np.argsort(v)])),
    ("the largest of group A, for all", lambda v, s, at: np.full(len(at), s.max())),
    ("the largest mean / speed of group A, times speed", lambda v, s, at: np.max(s / v) * at),
)


def bounds(
    speeds_m_s: Mapping[str, float] = SPEEDS_M_S,
    measured: Mapping[str, float] = MEASURED_MEAN,
    known: Sequence[str] = GROUP_A,
    predicted: Sequence[str] = GROUP_B,
) -> list[Bound]:
    """Every rule found on the tests `known` and judged on the tests `predicted`; m/s."""
    v, s = (np.array([table[test] for test in known]) for table in (speeds_m_s, measured))
    at, truth = (np.array([table[test] for test in predicted]) for table in (speeds_m_s, measured))
    values = [(name, rule(v, s, at)) for name, rule in RULES]
    return [
        Bound(name, tuple(map(float, one)), float(np.abs(one - truth).mean()))
        for name, one in values
    ]
