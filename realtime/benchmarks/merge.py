"""`rollerrig bench merge`: memory, disk and time of a large campaign, apart from its stops.

The stops of this benchmark are no simulation: a formula gives a distance and decelerations from the
drawn inputs of the packaged plan `etcs_dry`, in microseconds. All else is that of a large campaign:
worker processes, drawing of the points, sketches, tails, merging in the order of the chunks, and
the files. The time of real stops is in `rollerrig bench campaign`.
"""

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from rich.table import Table

from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.campaign import peak_memory_MB
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign import campaign, large, spreading

PLAN = "etcs_dry"
STOPS = 1_000_000
CHUNK = 1_000
WORKERS = 2
# the numbers of stops are this much apart, and there are so many of them
FACTOR = 10
SIZES = 3
# requirements: growth of memory and disk from the second number of stops to the third
GROWTH = 1.2
# deceleration without variation, and equivalent response time, of the formula
_NOMINAL_M_S2 = 1.2
_RESPONSE_S = 2.0
_SPEED_M_S = 33.3


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure campaigns of a hundredth, a tenth and all of the requested stops."""
    stops = given.count or STOPS
    sizes = [max(stops // FACTOR**power, CHUNK) for power in reversed(range(SIZES))]
    campaigns = []
    for size in sizes:
        say(f"{size} stops ...")
        campaigns.append(_measure(size))
    before, last = campaigns[-2:]
    return {
        "campaigns": campaigns,
        "targets": [
            target(
                f"{name}, {last['stops']} stops over {before['stops']}",
                last[key] / before[key],
                GROWTH,
            )
            for name, key in (
                ("memory of the process that merges", "memory_MB"),
                ("memory of a worker", "worker_memory_MB"),
                ("disk", "disk_MB"),
            )
        ],
        "notes": ["the stops are a formula, no simulation: see 'rollerrig bench campaign'"],
    }


def _measure(stops: int) -> Result:
    """Return the figures of a campaign."""
    plan = campaign.load(PLAN, runs=stops, chunk=CHUNK, rows_up_to=0)
    with tempfile.TemporaryDirectory(prefix="rollerrig-merge-") as place:
        out = Path(place) / "campaign"
        campaign.claim(plan, out)
        merger = large.Merger(plan, out)
        wall_begun_s = time.perf_counter()
        cpu_begun_s = time.process_time()
        worker_memory_MB = 0.0

        def work(chunk: int) -> tuple[Any, ...]:
            return _do_chunk, campaign.piece(plan, chunk), dict(merger.kept.limits)

        for chunk, (found, memory_MB) in spreading.on_this_machine(work, plan.chunks, WORKERS):
            merger.add(chunk, found)
            worker_memory_MB = max(worker_memory_MB, memory_MB)
        merger.write()
        cpu_s = time.process_time() - cpu_begun_s
        disk = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
        return {
            "stops": stops,
            "wall_s": time.perf_counter() - wall_begun_s,
            "merge_us": 1e6 * cpu_s / stops,
            "memory_MB": peak_memory_MB(),
            "worker_memory_MB": worker_memory_MB,
            "disk_MB": disk / 1e6,
        }


def _do_chunk(piece: campaign.Plan, limits: large.Limits) -> tuple[large.Part, float]:
    """Return what a chunk leaves, and the peak memory of the worker in MB."""
    return large.part(piece, _rows(piece), limits), peak_memory_MB()


def _rows(piece: campaign.Plan) -> pa.Table:
    """Return rows whose distances and decelerations are from a formula of the inputs."""
    points = np.array(piece.points)
    mass_kg, pad_friction, efficiency = points.T
    deceleration_m_s2 = (
        _NOMINAL_M_S2 * (43_000.0 / mass_kg) * (pad_friction / 0.35) * (efficiency / 0.95)
    )
    distance_m = _SPEED_M_S * _RESPONSE_S + _SPEED_M_S**2 / (2.0 * deceleration_m_s2)
    template = campaign.empty_row(piece, piece.first, piece.points[0])
    template |= {"stopped": True, "valid": True, "ended": "finished", "config_hash": "0" * 64}
    table = campaign.as_table([template] * len(points))
    changed = {"run": piece.first + np.arange(len(points)), large.DISTANCE: distance_m}
    changed |= dict(zip(piece.axes, points.T, strict=True))
    assert piece.steps is not None
    changed |= dict.fromkeys(piece.steps.columns, deceleration_m_s2)
    for name, values in changed.items():
        table = table.set_column(table.column_names.index(name), name, pa.array(values))
    return table


def table(result: Result) -> Table:
    """Return the figures of all campaigns."""
    rows = [
        (
            f"{found['stops']:,}",
            found["wall_s"],
            found["merge_us"],
            found["memory_MB"],
            found["worker_memory_MB"],
            found["disk_MB"],
        )
        for found in result["campaigns"]
    ]
    heads = (
        "stops",
        "wall, s",
        "merging, us a stop",
        "memory of the merging process, MB",
        "memory of a worker, MB",
        "disk, MB",
    )
    return figures.table("a large campaign without its stops", heads, rows)
