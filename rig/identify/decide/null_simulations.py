"""Runs the search on simulated stops with no further cause in them, on all cores of the machine.

Each null simulation is simulated from the fitted model with a separate seed. It is prepared and
scored like the measured runs. The seeds are fixed, so the decision is repeatable.
"""

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, Future
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children, cores
from rollerrig.rig.identify.causes import columns, discrepancy, simulate, table
from rollerrig.rig.identify.causes.candidates import Explanation, inputs
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.pulses import Sensor
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import evidence, fitting, goodness, thresholds
from rollerrig.rig.identify.decide.evidence import Scores, ScoreTest
from rollerrig.rig.identify.replay import rail, sensitivity
from rollerrig.rig.identify.replay.rail import USUAL, RailShares
from rollerrig.rig.identify.replay.sensitivity import LinearisedReplay

MOST_PROCESSES = 8
SEED_STRIDE = 100003  # seeds of a search do not overlap with those of the next
Progress = Callable[[str, float], None]


class Workspace(NamedTuple):
    """The measured runs that are explained, and the processes that work on them."""

    data: Dataset
    measured: list[Run]  # the runs that are fitted
    design: Design  # the same, prepared
    pool: Executor
    progress: Progress  # called with the title of a step and its share done, 0 to 1
    shares: RailShares = USUAL  # of the irregularity that wheelsets have in common

    def run_all(
        self, work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]], title: str
    ) -> list[Any]:
        """Return work(*task) of all tasks, in their order. Reports progress."""
        futures = [self.pool.submit(work, *task) for task in tasks]
        results = []
        for future in futures:
            results.append(future.result())
            self.progress(title, len(results) / len(futures))
        return results


class _LazyResult(Future[Any]):
    """A result that is computed in this process when a caller requests it."""

    def __init__(self, work: Callable[[], Any]) -> None:
        super().__init__()
        self._work = work

    def result(self, timeout: float | None = None) -> Any:
        return self._work()


class _ThisProcess(Executor):
    """An executor without other processes. Progress is reported after each task, as with them."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return _LazyResult(partial(fn, *args, **kwargs))


def worker_pool() -> Executor:
    """Return a pool with a process for each core, at most eight; this process alone on one core."""
    from threadpoolctl import threadpool_limits

    count = cores.allowed()
    if count == 1:
        return _ThisProcess()
    return children.pool(min(count, MOST_PROCESSES), threadpool_limits, 1)


def simulate_and_score(
    data: Dataset,
    measured: list[Run],
    design: Design,
    explanation: Explanation,
    seed: int,
    known: Sequence[str],
    shares: RailShares,
    most_mean_square: float,
) -> Scores | None:
    """Return the scores of one null simulation; None if wheels locked or scores are not finite.

    `most_mean_square` is that of normalised innovations above which a wheel has locked.
    """
    rng = np.random.default_rng(seed)
    simulated = simulate.runs(data, design, measured, explanation, rng, shares)
    prepared = prepare(data, simulated, design)
    if any(table.BY_NAME[cause.name].phase for cause in explanation.causes):
        prepared = _with_angles_of(design, prepared)
    normal, linear, _ = fitting.normal_equations(prepared, explanation)

    has_run_away = _mean_square(linear) > most_mean_square
    is_finite = np.all(np.isfinite(normal.A)) and np.all(np.isfinite(normal.b))
    if has_run_away or not is_finite:
        return None

    result = evidence.scores(normal, known)
    # single precision: the matrix goes from process to process
    return Scores(S=result.S.astype(np.float32), g=result.g)


def _with_angles_of(measured: Design, simulated: Design) -> Design:
    """Return simulated stops with the angles of the measured wheels, along which loads swing there.

    A simulated wheel slides otherwise, and so turns by another angle. After some hundred metres the
    swing of its load would be out of phase, and a large one would look like a locked wheel.
    """
    angles = []
    for segment in range(simulated.segments):
        samples = simulated.measured_rad_s[simulated.span(segment)].size
        angles.append(measured.angle_rad[measured.span(segment)][:samples])
    return simulated._replace(angle_rad=np.concatenate(angles))


def _mean_square(linear: LinearisedReplay) -> float:
    """Return the mean square of the normalised innovations.

    A locked wheel has innovations of any size: each is bounded, so that one instant does not
    decide.
    """
    return float(np.mean(np.minimum(linear.nu**2 / linear.variance, 100.0)))


def _common_irregularity(
    data: Dataset, measured: list[Run], design: Design, explanation: Explanation, seed: int
) -> RailShares:
    """Return the correlations of the irregularity in stops simulated on a shared rail."""
    on_shared_rail = RailShares(1.0, 1.0)
    rng = np.random.default_rng(seed)
    simulated = simulate.runs(data, design, measured, explanation, rng, on_shared_rail)
    prepared = prepare(data, simulated, design)
    _, _, field, *_ = sensitivity.innovations(prepared, inputs(prepared, explanation))
    return rail.common(prepared, field)


def rail_shares(workspace: Workspace, explanation: Explanation, seed: int) -> RailShares:
    """Return how much of the irregularity of the rail the measured wheelsets have in common."""
    design = workspace.design
    _, _, field, *_ = sensitivity.innovations(design, inputs(design, explanation))
    without_tolerances = _without_tolerances(explanation)
    tasks = [
        (
            workspace.data,
            workspace.measured,
            design,
            without_tolerances,
            seed * SEED_STRIDE + SEED_STRIDE - k - 1,
        )
        for k in range(rail.SIMULATED)
    ]
    on_shared_rail = workspace.run_all(_common_irregularity, tasks, "shared rail")
    return rail.shares(rail.common(design, field), on_shared_rail)


def _without_tolerances(explanation: Explanation) -> Explanation:
    """Return the explanation without the tolerances, which belong to one recording.

    Each null simulation draws them again.
    """
    kept = ("ln_", discrepancy.LATE)
    free = {label: value for label, value in explanation.base.items() if label.startswith(kept)}
    return explanation._replace(base=free)


def _is_biased(design: Design, test: ScoreTest) -> bool:
    """Return whether counted pulses let null simulations show friction that is not there.

    Their error, a whole pulse, exceeds the sliding. At small decelerations it looks like friction
    that differs by a factor of two, and a bias of this size does not hold for every recording.
    """
    if design.wheel_sensor.kind is not Sensor.COUNTED:
        return False
    if not evidence.is_smooth_function(test.name):
        return False
    is_of_friction = test.name.removeprefix("along ") in columns.ALONG
    return is_of_friction and max(map(abs, test.bias)) > thresholds.LARGEST_NULL_BIAS


def score_against_nulls(
    workspace: Workspace,
    explanation: Explanation,
    most: int,
    seed: int,
    known: Sequence[str] = (),
) -> tuple[list[ScoreTest], fitting.NormalEquations, list[Scores]]:
    """Return the score tests of the measured runs, their normal equations, and the nulls' scores.

    `known` causes are in the explanation already and are not tested. Null simulations are added in
    rounds until more would not change what counts, at most `most`. Raises ConfigError if less than
    half of them can be replayed, or if the scores of the measured runs are not finite.
    """
    without_tolerances = _without_tolerances(explanation)
    normal, linear, _ = fitting.normal_equations(workspace.design, explanation)
    goodness.check_finite(workspace.design, normal)
    # the error of pulses is not white, so also the measured innovations are larger at times
    most_mean_square = thresholds.RUNAWAY_VARIANCE
    if workspace.design.wheel_sensor.is_pulses:
        most_mean_square *= max(1.0, _mean_square(linear))
    nulls: list[Scores] = []
    for begin in range(0, most, thresholds.NULL_SIMULATIONS_PER_ROUND):
        end = min(begin + thresholds.NULL_SIMULATIONS_PER_ROUND, most)
        tasks = [
            (
                workspace.data,
                workspace.measured,
                workspace.design,
                without_tolerances,
                seed * SEED_STRIDE + number,
                known,
                workspace.shares,
                most_mean_square,
            )
            for number in range(begin, end)
        ]
        scored = workspace.run_all(simulate_and_score, tasks, "null simulations")
        nulls += [scores for scores in scored if scores is not None]
        if 2 * len(nulls) < end:
            raise ConfigError(
                f"only {len(nulls)} of {end} simulated stops could be replayed: the fitted model "
                "does not brake like the recording; check vehicle, loads and torques in dataset.toml"
            )
        tests = evidence.score_tests(workspace.design, normal, nulls, known)
        tests = [test for test in tests if not _is_biased(workspace.design, test)]
        if evidence.is_settled(tests):
            break
    return tests, normal, nulls
