"""The six stops of the paper at Velim, in closed loop with the reference WSP: Table 6, ours beside it.

What the paper does not print (brake demand, WSP thresholds, the contaminant of each test) is found on
group A, where Table 6 prints mean and spread of the sliding of wheelset 1; it stands in
`configs/velim.toml`. Group B is predicted: Table 5's initial speed is all that is known of a test, so
its contaminant is the geometric mean of group A's. The stops run on the track, with Table 4.

    [Q1] cost = sum over A1..A3 of (mean - measured)^2 + (deviation - measured)^2
    [Q2] mean and deviation over the whole stop, paper eqs. 23 and 24

Doubt: the recordings are not public, so E1 cannot be computed, and sliding is compared by two numbers
a test. Table 6's B rows are never used for fitting.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from rollerrig.configs import store
from rollerrig.configs.table import number, read
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.studies import velim_bounds
from rollerrig.wsp_interface import signals

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
_FIT = "fitted on group A of Table 6"
ROWS = (
    number("pressure_Pa", 3.8e5, 1e5, 5e5, _FIT),
    number("band_low_m_s", 5.2, 0.5, 15.0, _FIT),
    number("band_high_m_s", 6.2, 0.6, 16.0, _FIT),
    *(number(f"mu_cd_{test}", 0.03, 1e-3, 0.3, _FIT) for test in GROUP_A),
)


class Stop(NamedTuple):
    """What Table 6 says of a test, ours; per axle shape (4,)."""

    mean_m_s: np.ndarray
    deviation_m_s: np.ndarray
    stop_time_s: float
    stop_distance_m: float
    longest_lock_s: float


def settings() -> dict[str, float]:
    """What was found on group A: `configs/velim.toml`. Raises ConfigError."""
    path = store.ROOT / "velim.toml"
    return read(ROWS, store.parse(path), str(path))


def contaminant(found: dict[str, float], test: str) -> float:
    """mu_cd of a test: its own in group A, the geometric mean of those in group B."""
    if test in GROUP_A:
        return found[f"mu_cd_{test}"]
    return float(np.exp(np.mean([np.log(found[f"mu_cd_{name}"]) for name in GROUP_A])))


def plan_of(test: str, found: dict[str, float]) -> scenario.Scenario:
    """The scenario of a test on the track, under what was found."""
    return scenario.load(
        f"velim_{test}", settings=("rig.mode=track", f"adhesion.mu_cd={contaminant(found, test)!r}"),
        tables={"demand": [{"from_s": 0.0, "pressure_Pa": found["pressure_Pa"]}]})


def rows_of(test: str, found: dict[str, float]) -> np.ndarray:
    """Samples of a test's stop up to standstill, under what was found."""
    plan = plan_of(test, found)
    band = {name: found[name] for name in ("band_low_m_s", "band_high_m_s")}
    return free.moving(free.simulate(plan, logic.load(plan["wsp_config"])._replace(**band)))


def stop(test: str, found: dict[str, float]) -> Stop:
    """Run a test and reduce it to Table 6's numbers [Q2]."""
    rows = rows_of(test, found)
    sliding = rows[:, signals.span("sliding")]
    return Stop(sliding.mean(axis=0), sliding.std(axis=0), SAMPLE_S * len(rows),
                float(rows[-1, signals.column("position")]),
                float(rows[-1, signals.span("longest_lock")].max()))


def table6(found: dict[str, float], say: Callable[[str], None] = lambda _: None) -> dict[str, Stop]:
    """All six stops."""
    out = {}
    for test in TESTS:
        say(f"stop {test.upper()} ...")
        out[test] = stop(test, found)
    return out


def errors(ours: dict[str, Stop], tests: Sequence[str] = GROUP_B) -> dict[str, float]:
    """Mean absolute errors against the measured rows of Table 6, ours and the paper's model's."""
    mean, deviation = _first_wheelset(ours)

    def off(values: dict[str, float], measured: dict[str, float]) -> float:
        return float(np.mean([abs(values[test] - measured[test]) for test in tests]))

    return {"mean_m_s": off(mean, MEASURED_MEAN), "deviation_m_s": off(deviation, MEASURED_STD),
            "paper_mean_m_s": off(PAPER_MEAN, MEASURED_MEAN),
            "paper_deviation_m_s": off(PAPER_STD, MEASURED_STD)}


def _first_wheelset(ours: dict[str, Stop]) -> tuple[dict[str, float], dict[str, float]]:
    """Mean and standard deviation of its sliding in each test, m/s."""
    return ({test: float(one.mean_m_s[0]) for test, one in ours.items()},
            {test: float(one.deviation_m_s[0]) for test, one in ours.items()})


def bounds() -> list[velim_bounds.Bound]:
    """What functions of initial speed alone, found on group A's measured means, reach on group B."""
    return velim_bounds.bounds(SPEEDS_M_S, MEASURED_MEAN, GROUP_A, GROUP_B)


def left_over(ours: dict[str, Stop]) -> float:
    """rms in m/s of what the fit on group A leaves over [Q1]."""
    mean, deviation = _first_wheelset(ours)
    off = [(mean[t] - MEASURED_MEAN[t], deviation[t] - MEASURED_STD[t]) for t in GROUP_A]
    return float(np.sqrt(np.mean(np.square(off))))


def calibrate(say: Callable[[str], None], start: dict[str, float] | None = None,
              rounds: int = 6) -> dict[str, float]:
    """Find what is not printed on group A [Q1]: contaminants of A1..A3 and the band of the WSP.

    Gauss-Newton on responses averaged over two neighbouring contaminants, because stick and slip
    scatter them by about 0.1 m/s. The demand stays a full service brake: with less adhesion
    than brake everywhere, Table 6 does not tell it.
    """
    found = dict(start or settings())
    free = ["band_low_m_s", "band_high_m_s", *(f"mu_cd_{t}" for t in GROUP_A)]

    def residual(x: np.ndarray) -> np.ndarray:
        tried = found | {name: float(np.exp(v)) for name, v in zip(free, x, strict=True)}
        off = []
        for test in GROUP_A:
            near = [stop(test, tried | {f"mu_cd_{test}": tried[f"mu_cd_{test}"] * share})
                    for share in (0.98, 1.02)]
            off += [np.mean([one.mean_m_s[0] for one in near]) - MEASURED_MEAN[test],
                    np.mean([one.deviation_m_s[0] for one in near]) - MEASURED_STD[test]]
        say("  ".join(f"{name} {tried[name]:.4g}" for name in free)
            + f"   rms {np.sqrt(np.mean(np.square(off))):.3f} m/s")
        return np.array(off)

    x0 = np.log([found[name] for name in free])
    # a contaminant moves its own test only
    moves = np.zeros((6, 5))
    moves[:, :2] = 1.0
    for i in range(3):
        moves[2 * i:2 * i + 2, 2 + i] = 1.0
    fit = least_squares(residual, x0, diff_step=0.05, max_nfev=rounds, x_scale=0.2, tr_solver="lsmr",
                        jac_sparsity=moves)
    return found | {name: float(np.exp(v)) for name, v in zip(free, fit.x, strict=True)}


def rows_for_table(ours: dict[str, Stop]) -> list[tuple[str, list[str]]]:
    """Table 6 in the paper's form, with ours, as text."""
    mean, deviation = _first_wheelset(ours)
    rows = (
        ("E1, largest velocity error, paper's model", PAPER_E1),
        ("mean sliding of wheelset 1, measured", MEASURED_MEAN),
        ("mean sliding, paper's model", PAPER_MEAN),
        ("mean sliding, ours", mean),
        ("standard deviation, measured", MEASURED_STD),
        ("standard deviation, paper's model", PAPER_STD),
        ("standard deviation, ours", deviation),
    )
    return [(title, [f"{values[test]:.2f}" for test in TESTS]) for title, values in rows]
