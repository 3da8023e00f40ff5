"""`rollerrig bench campaign --device cuda`: equality with a core, and stops a minute, on a GPU.

All stops are those of the packaged plan `low_adhesion` with the reference unit and the step of the
scenario (0.1 ms). Some run on a core too, and their distances are compared. Then many run on the
GPU as one wave. Its time is from the start of the threads until the last samples are in the memory
of the machine. What a core does for each stop is measured apart: resolving the scenario, placing
it, and computing its figures. The forecast is proportional to these times.
"""

import argparse
import time
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign import campaign, speed_steps
from rollerrig.realtime.campaign.stops import stops_on_device
from rollerrig.realtime.campaign.stops.stops_in_lanes import Finished
from rollerrig.realtime.record import summary
from rollerrig.rig.compiled import device

PLAN = "low_adhesion"
STOPS = 8192
# stops that run on a core too, and whose work on a core is timed
COMPARED = 64
# requirements: largest relative difference of a distance, stops a minute
DIFFERENCE = 1e-9
RATE = 100_000.0
_MANY = 1e9
_HOUR_S = 3600.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Compare and measure stops on the GPU of this machine. Raises ConfigError without one."""
    stops = given.count or STOPS
    compared = min(COMPARED, stops)
    plan = campaign.load(PLAN, device=campaign.CUDA, runs=stops, step_s=0.0)
    name = device.name()

    say(f"one stop on {name}, which compiles ...")
    compile_s = _wall_s(lambda: campaign.once(_first(plan, 1)))

    say(f"{compared} stops on the GPU and on a core ...")
    there = campaign.once(_first(plan, compared))
    here = campaign.once(_first(plan, compared)._replace(device=campaign.CORES))
    distances_m = np.array(
        [[rows[n]["braking_distance_m"] for n in here] for rows in (here, there)]
    )
    difference = float(np.abs(distances_m[1] / distances_m[0] - 1.0).max())

    say(f"{stops} stops on the GPU ...")
    begun_s = time.perf_counter()
    resolved = [campaign.resolve(plan, number) for number in range(stops)]
    # a train runs on no GPU
    scenarios = [one for one in resolved if isinstance(one, Scenario)]
    resolve_s = (time.perf_counter() - begun_s) / stops
    names = list(dict.fromkeys((*summary.channels_of(scenarios[0].kind), *speed_steps.CHANNELS)))
    begun_s = time.perf_counter()
    wave = stops_on_device.wave(scenarios, names)
    place_s = (time.perf_counter() - begun_s) / stops
    begun_s = time.perf_counter()
    samples = list(wave.run())
    gpu_s = time.perf_counter() - begun_s

    begun_s = time.perf_counter()
    for number in range(compared):
        channels = dict(zip(names, samples[number], strict=True))
        done = Finished(number, scenarios[number], channels, [], "finished")
        campaign.summarize(done, "reference")
    figures_s = (time.perf_counter() - begun_s) / compared

    core_s = resolve_s + place_s + figures_s
    return {
        "device": name,
        "stops": stops,
        "compile_s": compile_s,
        "compared": compared,
        "largest_difference": difference,
        "gpu_s": gpu_s,
        "stops_per_minute": 60.0 * stops / gpu_s,
        "mean_stop_s": float(np.mean([rows[names.index("time_s")][-1] for rows in samples])),
        "core_s_a_stop": core_s,
        "cores_that_keep_up": core_s * stops / gpu_s,
        "gpu_hours_of_1e9": _MANY * gpu_s / stops / _HOUR_S,
        "core_hours_of_1e9": _MANY * core_s / _HOUR_S,
        "targets": [
            target("largest relative difference of a distance", difference, DIFFERENCE),
            # a target is an upper limit, so the required rate is given as a time
            target("time of the GPU for a stop", gpu_s / stops, 60.0 / RATE, "s"),
        ],
        "notes": [
            "the forecasts are in proportion to the measured times; the GPU and the cores work at the "
            "same time if the processes are enough",
        ],
    }


def _first(plan: campaign.Plan, runs: int) -> campaign.Plan:
    """Return the plan with its first runs only."""
    return plan._replace(points=plan.points[:runs])


def _wall_s(call: Any) -> float:
    """Return the wall time of a call."""
    begun_s = time.perf_counter()
    call()
    return time.perf_counter() - begun_s


def table(result: Result) -> Table:
    """Return the figures of the GPU."""
    return figures.table(
        f"a campaign on {result['device']}",
        ("what", "figure", "unit"),
        [
            ("stops on the GPU together", result["stops"], ""),
            ("mean length of a stop", result["mean_stop_s"], "s"),
            ("compiling, with the first stop", result["compile_s"], "s"),
            (
                f"largest relative difference of {result['compared']} distances from a core",
                result["largest_difference"],
                "",
            ),
            ("time of the GPU, with the transfer of samples", result["gpu_s"], "s"),
            ("stops a minute", result["stops_per_minute"], ""),
            ("work of a core for a stop", 1e3 * result["core_s_a_stop"], "ms"),
            ("cores that keep up with the GPU", result["cores_that_keep_up"], ""),
            ("forecast for 1e9 stops: the GPU", result["gpu_hours_of_1e9"], "h"),
            ("forecast for 1e9 stops: cores together", result["core_hours_of_1e9"], "core h"),
        ],
    )
