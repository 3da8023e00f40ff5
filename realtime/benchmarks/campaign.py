"""How many stops a campaign does: a minute and core, on one worker and on two, on a Dask cluster.

All figures come from stops of the packaged plan `low_adhesion`, at steps of 0.1 ms, in one run. The rate is per minute
of processor time, so that other programs do not count; the ratio of two workers to one is of wall time and wants a
machine that is free. Dask's overhead is the wall time of a worker that gets one stop at a time over that of its stops.
"""

import argparse
import time
from pathlib import Path
from typing import Any

from rich.table import Table

from rollerrig.configs.processes import children
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign import campaign

PLAN = "low_adhesion"
RATE, SPEED_UP, MEMORY_MB, OVERHEAD = 300.0, 1.8, 500.0, 0.05
RUNS, CHUNK, ROUNDS, TASKS = 160, 20, 2, 40


def run(given: argparse.Namespace, say: Say) -> Result:
    """Time the same stops four ways."""
    plan = campaign.load(PLAN, runs=RUNS, chunk=CHUNK)
    campaign.run_chunk(plan._replace(points=plan.points[:1]), 0)
    say(f"{CHUNK} stops in this process ...")
    rows, spent = _timed(plan, 0)
    say(f"{ROUNDS} times {RUNS} stops on one worker, then on two ...")
    one, two = (workers(plan, count) for count in (1, 2))
    say(f"{TASKS} stops one by one on a Dask worker ...")
    dask = on_dask(plan._replace(head=plan.head | {"chunk": 1}))
    cpu_s, speed_up = spent["cpu_s"], one["wall_s"] / two["wall_s"]
    growth_MB = max(0.0, one["memory_MB"] - one["memory_first_MB"]) * 10_000 / (ROUNDS * RUNS)
    memory_MB = max(one["memory_MB"], two["memory_MB"]) + growth_MB
    return {
        "stops": len(rows),
        "stops_per_minute_and_core": 60.0 * len(rows) / cpu_s,
        "wall_share": cpu_s / spent["wall_s"],
        "stop_mean_s": sum(row["stop_time_s"] or 0.0 for row in rows) / len(rows),
        "one_worker": one,
        "two_workers": two,
        "speed_up": speed_up,
        "speed_up_processor_time": 2.0 * one["cpu_s"] / two["cpu_s"],
        "memory_10000_MB": memory_MB,
        "dask": dask,
        # the form of a target is "at most", so rates stand as times
        "targets": [
            target("processor time of a stop", cpu_s / len(rows), 60.0 / RATE, "s"),
            target("wall time of two workers over one's", 1.0 / speed_up, 1.0 / SPEED_UP),
            target("memory of a worker after 10,000 stops", memory_MB, MEMORY_MB, "MB"),
            target("Dask's overhead", dask["overhead"], OVERHEAD),
        ],
        "notes": [
            f"two workers do {speed_up:.2f} times what one does; each had {100 * two['share']:.0f} % of a core "
            f"(one alone {100 * one['share']:.0f} %): less than 100 % is what other programs took"
        ],
    }


def workers(plan: campaign.Plan, count: int) -> Result:
    """Wall time of all stops on a number of processes that are warm, and their memory."""
    with children.pool(count) as pool:
        first = list(pool.map(_spent, [plan] * count, range(count)))
        begun = time.perf_counter()
        done = list(
            pool.map(_spent, [plan] * len(plan.chunks) * ROUNDS, list(plan.chunks) * ROUNDS)
        )
        wall_s = time.perf_counter() - begun
    cpu_s = sum(one["cpu_s"] for one in done)
    return {
        "workers": count,
        "stops": ROUNDS * len(plan.points),
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "share": cpu_s / wall_s / count,
        "memory_first_MB": min(one["memory_MB"] for one in first),
        "memory_MB": max(one["memory_MB"] for one in done),
    }


def on_dask(plan: campaign.Plan) -> Result:
    """Wall time of single stops on one worker of a Dask cluster, against the time they took."""
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
        whole = client.scatter(plan, broadcast=True)
        client.submit(_spent, whole, TASKS, pure=False).result()
        begun = time.perf_counter()
        futures = [client.submit(_spent, whole, number, pure=False) for number in range(TASKS)]
        done: list[Any] = client.gather(futures)
        wall_s = time.perf_counter() - begun
    busy_s = sum(one["wall_s"] for one in done)
    return {
        "tasks": TASKS,
        "task_s": busy_s / TASKS,
        "wall_s": wall_s,
        "overhead": wall_s / busy_s - 1.0,
    }


def _timed(plan: campaign.Plan, chunk: int) -> tuple[list[Result], dict[str, float]]:
    """Run a chunk where this is called: its rows, its times, and the memory that the process ever had."""
    wall_s, cpu_s = time.perf_counter(), time.process_time()
    rows = campaign.run_chunk(plan, chunk)
    wall_s, cpu_s = time.perf_counter() - wall_s, time.process_time() - cpu_s
    # getrusage would count the memory of the process's parent before exec
    most_kB = (
        Path("/proc/self/status").read_text(encoding="ascii").partition("VmHWM:")[2].split()[0]
    )
    return rows, {"wall_s": wall_s, "cpu_s": cpu_s, "memory_MB": int(most_kB) / 1024.0}


def _spent(plan: campaign.Plan, chunk: int) -> dict[str, float]:
    return _timed(plan, chunk)[1]


def table(result: Result) -> Table:
    """The figures of the campaign."""
    one, two, dask = result["one_worker"], result["two_workers"], result["dask"]
    return figures.table(
        "a campaign",
        ("what", "figure", "unit"),
        [
            ("stops a minute and core", result["stops_per_minute_and_core"], ""),
            ("mean length of a stop", result["stop_mean_s"], "s"),
            (f"{one['stops']} stops on one worker", one["wall_s"], "s"),
            (f"{two['stops']} stops on two workers", two["wall_s"], "s"),
            ("two workers against one", result["speed_up"], ""),
            ("the same by processor time, on free cores", result["speed_up_processor_time"], ""),
            ("most memory of a worker", max(one["memory_MB"], two["memory_MB"]), "MB"),
            ("the same, carried on to 10,000 stops", result["memory_10000_MB"], "MB"),
            ("one stop at a time on Dask", dask.get("task_s"), "s"),
            ("Dask's overhead", dask["overhead"], ""),
        ],
    )
