"""`rollerrig bench campaign`: how many stops a campaign does, on one worker, on two, and on Dask.

All figures come from stops of the packaged plan `low_adhesion`. With `--axles N` they have the
scenario of SCENARIOS instead of that of the plan. The rate is per minute of processor time, so that
other programs do not affect it. The ratio of two workers to one is of wall time, and needs a
machine that is otherwise idle. Dask's overhead is the wall time of a worker that receives one stop
at a time, relative to the time of its stops. All of these have the step of the scenario (0.1 ms).

Some stops then run with longer steps, alternately with the same stops at 0.1 ms. The factors are
ratios of processor time, and the deviations are those of the stopping distance. With `--beside
FOLDER` an older checkout runs the same stops at 0.1 ms, alternately too, and the factors are also
those over this checkout. One more pass has half the step of the scenario. Its deviations are those
of the bench itself: a WSP unit decides at thresholds, so a small error may change a distance much.
"""

import argparse
import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.realtime.benchmarks import campaign_on_gpu, figures, older_checkout
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign import campaign

PLAN = "low_adhesion"
# scenarios of the plan by the number of axles
SCENARIOS = {2: "bogie_low", 4: "velim_a1", 6: "tram_low", 8: "multiple_unit_low"}
# longer steps that are compared with the step of the scenario, and stops of the comparison
STEPS_S = (2e-4, 5e-4, 1e-3)
COMPARED = 60
# the largest deviation of a stopping distance that 99 % of the stops may have
DEVIATION = 5e-4
# half the step of the scenario
HALF_STEP_S = 5e-5
# requirements: stops per minute and core, two workers over one, memory of a worker, Dask's overhead
RATE = 300.0
SPEED_UP = 1.8
MEMORY_MB = 500.0
OVERHEAD = 0.05
# stops of the plan, stops that a worker receives at a time, how often the workers do all stops
RUNS = 160
CHUNK = 20
ROUNDS = 2
WITHOUT_DASK = (
    "Dask is not installed, so its overhead was not measured: pip install 'rollerrig[cluster]'"
)
# stops on Dask
TASKS = 40
# the memory of a worker is extrapolated to so many stops
_MANY_STOPS = 10_000


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure the same stops in four ways, or with `--device cuda` on a GPU."""
    if given.device == campaign.CUDA:
        return campaign_on_gpu.run(given, say)
    if given.axles not in SCENARIOS:
        raise ConfigError(
            f"--axles {given.axles}: bench campaign has no scenario with so many axles; allowed are "
            f"{', '.join(map(str, SCENARIOS))}"
        )
    older_checkout.check(given.beside)
    scenario = SCENARIOS[given.axles]
    plan = campaign.load(PLAN, runs=RUNS, chunk=CHUNK, scenario=scenario, step_s=0.0)
    # loads and compiles what the first stop needs
    campaign.run_chunk(plan._replace(points=plan.points[:1]), 0)

    say(f"{CHUNK} stops in this process ...")
    rows, spent = _timed(plan, 0)
    cpu_s = spent["cpu_s"]

    say(f"{COMPARED} stops with longer steps, alternately with 0.1 ms ...")
    with older_checkout.chunks(given.beside, PLAN, plan, given.axles) as older_chunk_s:
        steps = longer_steps(plan, older_chunk_s)

    say(f"{ROUNDS} times {RUNS} stops on one worker, then on two ...")
    one = workers(plan, 1)
    two = workers(plan, 2)
    speed_up = one["wall_s"] / two["wall_s"]
    memory_MB = _memory_after_many_stops(one, two)

    say(f"{TASKS} stops one by one on a Dask worker ...")
    dask = on_dask(plan._replace(head=plan.head | {"chunk": 1}))

    return {
        "stops": len(rows),
        "stops_per_minute_and_core": 60.0 * len(rows) / cpu_s,
        "wall_share": cpu_s / spent["wall_s"],
        "stop_mean_s": sum(row["stop_time_s"] or 0.0 for row in rows) / len(rows),
        "axles": given.axles,
        "steps": steps,
        "one_worker": one,
        "two_workers": two,
        "speed_up": speed_up,
        "speed_up_processor_time": 2.0 * one["cpu_s"] / two["cpu_s"],
        "memory_10000_MB": memory_MB,
        "dask": dask,
        # a target is an upper limit, so required rates are given as times
        "targets": [
            target("processor time of a stop", cpu_s / len(rows), 60.0 / RATE, "s"),
            target("wall time of two workers over one's", 1.0 / speed_up, 1.0 / SPEED_UP),
            target("memory of a worker after 10,000 stops", memory_MB, MEMORY_MB, "MB"),
            *_targets_of_dask(dask),
        ],
        "notes": [
            *([] if dask["tasks"] else [WITHOUT_DASK]),
            f"two workers do {speed_up:.2f} times as much as one; each had "
            f"{100 * two['share']:.0f} % of a core (one alone {100 * one['share']:.0f} %), "
            "and other programs used the rest",
        ],
    }


def section(given: argparse.Namespace) -> str:
    """Return the heading of the figures on a page: each number of axles has a section."""
    if given.device == campaign.CUDA:
        return "campaign on a GPU"
    return "campaign" if given.axles == COACH_AXLES else f"campaign with {given.axles} axles"


def longer_steps(
    plan: campaign.Plan, older_chunk_s: Callable[[int], float] | None, stops: int = COMPARED
) -> Result:
    """Return factor of time and deviations of the distances for each of STEPS_S.

    `plan` has the step of the scenario. Each chunk runs in all ways before the next one begins.
    "stop_s" is the processor time of a stop with the step of the scenario.
    """
    plans = {0.0: plan}
    for step_s in STEPS_S:
        # without the longest stops, which would run again at the step of the scenario
        plans[step_s] = plan._replace(head=plan.head | {campaign.STEP: step_s})
    distances_m: dict[float, list[float]] = {step_s: [] for step_s in plans}
    spent_s = dict.fromkeys(plans, 0.0)
    half = _with_half_step(plan)
    half_m: list[float] = []
    older_s = 0.0
    for chunk in range(stops // plan.head["chunk"]):
        if older_chunk_s is not None:
            older_s += older_chunk_s(chunk)
        for step_s, each in plans.items():
            begun_s = time.process_time()
            rows = campaign.once(campaign.piece(each, chunk)).values()
            spent_s[step_s] += time.process_time() - begun_s
            distances_m[step_s] += _distances_m(rows)
        half_m += _distances_m(campaign.once(campaign.piece(half, chunk)).values())

    exact_m = np.array(distances_m[0.0])
    found = []
    for step_s in STEPS_S:
        figures_of_step: Result = {"step_s": step_s, "factor": spent_s[0.0] / spent_s[step_s]}
        if older_chunk_s is not None:
            figures_of_step["factor_over_older"] = older_s / spent_s[step_s]
        found.append(figures_of_step | _deviations(distances_m[step_s], exact_m))
    return {
        "steps": found,
        "stop_s": spent_s[0.0] / len(distances_m[0.0]),
        "half": _deviations(half_m, exact_m),
        "factor_over_older": older_s / spent_s[0.0] if older_chunk_s is not None else None,
    }


def _with_half_step(plan: campaign.Plan) -> campaign.Plan:
    """Return the plan with HALF_STEP_S in all its runs."""
    points = [(*point, HALF_STEP_S) for point in plan.points]
    return plan._replace(axes=(*plan.axes, "loop.step_s"), points=points)


def _distances_m(rows: Iterable[campaign.Row]) -> list[float]:
    return [row["braking_distance_m"] or math.nan for row in rows]


def _deviations(distances_m: list[float], exact_m: np.ndarray) -> Result:
    """Return figures of the relative deviations of distances from the exact ones."""
    missed = np.abs(np.array(distances_m) / exact_m - 1.0)
    missed = missed[np.isfinite(missed)]
    return {
        "stops": missed.size,
        "median": float(np.quantile(missed, 0.5)),
        "p99": float(np.quantile(missed, 0.99)),
        "worst": float(missed.max()),
        "share_within": float((missed <= DEVIATION).mean()),
    }


def _memory_after_many_stops(one: Result, two: Result) -> float:
    """Return the largest memory of a worker in MB, with the growth of one worker extrapolated."""
    growth_MB = max(0.0, one["memory_MB"] - one["memory_first_MB"])
    growth_of_many_MB = growth_MB * _MANY_STOPS / (ROUNDS * RUNS)
    return max(one["memory_MB"], two["memory_MB"]) + growth_of_many_MB


def workers(plan: campaign.Plan, count: int) -> Result:
    """Return the times of all stops on some warm worker processes, and the memory of these."""
    with children.pool(count) as pool:
        first = list(pool.map(_spent, [plan] * count, range(count)))
        chunks = list(plan.chunks) * ROUNDS
        begun_s = time.perf_counter()
        done = list(pool.map(_spent, [plan] * len(chunks), chunks))
        wall_s = time.perf_counter() - begun_s
    cpu_s = sum(chunk["cpu_s"] for chunk in done)
    return {
        "workers": count,
        "stops": ROUNDS * len(plan.points),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "share": cpu_s / wall_s / count,
        "memory_first_MB": min(chunk["memory_MB"] for chunk in first),
        "memory_MB": max(chunk["memory_MB"] for chunk in done),
    }


def _targets_of_dask(dask: Result) -> list[Result]:
    """Return the target of Dask; none where it is not installed, because nothing was measured."""
    return [target("Dask's overhead", dask["overhead"], OVERHEAD)] if dask["tasks"] else []


def on_dask(plan: campaign.Plan) -> Result:
    """Return the wall time of single stops on one Dask worker, and the time that the stops took.

    Without `distributed` the overhead is None, and the notes say how to install it.
    """
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        return {"tasks": 0, "overhead": None}

    with (
        LocalCluster(
            n_workers=1,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            host="127.0.0.1",
        ) as cluster,
        Client(cluster) as client,
    ):
        plan_there = client.scatter(plan, broadcast=True)
        # the first stop warms the worker
        client.submit(_spent, plan_there, TASKS, pure=False).result()
        begun_s = time.perf_counter()
        futures = [client.submit(_spent, plan_there, number, pure=False) for number in range(TASKS)]
        done: list[Any] = client.gather(futures)
        wall_s = time.perf_counter() - begun_s

    busy_s = sum(stop["wall_s"] for stop in done)
    return {
        "tasks": TASKS,
        "task_s": busy_s / TASKS,
        "wall_s": wall_s,
        "overhead": wall_s / busy_s - 1.0,
    }


def _timed(plan: campaign.Plan, chunk: int) -> tuple[list[Result], dict[str, float]]:
    """Run a chunk in this process; return its rows, its times, and the peak memory so far."""
    wall_begun_s = time.perf_counter()
    cpu_begun_s = time.process_time()
    rows = campaign.run_chunk(plan, chunk)
    wall_s = time.perf_counter() - wall_begun_s
    cpu_s = time.process_time() - cpu_begun_s
    return rows, {"wall_s": wall_s, "cpu_s": cpu_s, "memory_MB": peak_memory_MB()}


def _spent(plan: campaign.Plan, chunk: int) -> dict[str, float]:
    """Run a chunk in this process; return its times, and the peak memory of the process."""
    return _timed(plan, chunk)[1]


def peak_memory_MB() -> float:
    """Return the largest memory that this process has had."""
    # getrusage would count the memory that the parent of the process had before exec
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak_kB = status.partition("VmHWM:")[2].split()[0]
    return int(peak_kB) / 1024.0


def table(result: Result) -> Table:
    """Return the figures of the campaign."""
    if "device" in result:
        return campaign_on_gpu.table(result)
    compared = result["steps"]
    steps = []
    if compared["factor_over_older"] is not None:
        steps.append(("stops in the time of one of --beside", compared["factor_over_older"], ""))
    for step in compared["steps"]:
        name = f"steps of {1e3 * step['step_s']:g} ms"
        steps.append((f"{name}: times as many stops as at 0.1 ms", step["factor"], ""))
        if "factor_over_older" in step:
            over_older = step["factor_over_older"]
            steps.append((f"{name}: stops in the time of one of --beside", over_older, ""))
        steps += _rows_of_deviations(name, step)
    steps += _rows_of_deviations(f"steps of {1e3 * HALF_STEP_S:g} ms", compared["half"])
    one = result["one_worker"]
    two = result["two_workers"]
    dask = result["dask"]
    return figures.table(
        "a campaign",
        ("what", "figure", "unit"),
        [
            ("stops per minute and core", result["stops_per_minute_and_core"], ""),
            ("mean length of a stop", result["stop_mean_s"], "s"),
            ("axles", result["axles"], ""),
            *steps,
            (f"{one['stops']} stops on one worker", one["wall_s"], "s"),
            (f"{two['stops']} stops on two workers", two["wall_s"], "s"),
            ("two workers over one", result["speed_up"], ""),
            ("the same by processor time, on idle cores", result["speed_up_processor_time"], ""),
            ("largest memory of a worker", max(one["memory_MB"], two["memory_MB"]), "MB"),
            ("the same, extrapolated to 10,000 stops", result["memory_10000_MB"], "MB"),
            ("one stop at a time on Dask", dask.get("task_s"), "s"),
            ("Dask's overhead", dask["overhead"], ""),
        ],
    )


def _rows_of_deviations(name: str, found: Result) -> list[tuple[str, float, str]]:
    return [
        (f"{name}: median deviation of the distance", 100 * found["median"], "%"),
        (f"{name}: stops within {100 * DEVIATION:g} %", 100 * found["share_within"], "%"),
        (f"{name}: deviation of 99 % of {found['stops']} stops", 100 * found["p99"], "%"),
        (f"{name}: worst deviation", 100 * found["worst"], "%"),
    ]
