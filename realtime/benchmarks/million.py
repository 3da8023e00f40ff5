"""`rollerrig bench million`: the hours of a million stops of the coach on two cores, by the step.

The stops are those of packaged plans, with the reference unit. Each chunk runs with the step of the
scenario (0.1 ms), with longer ones, and with half of it, before the next chunk begins. The hours
follow from the processor time of a whole stop: scenario, physics, unit and figures. With a longer
step the longest stops of a campaign run again, and their time counts too.
"""

import argparse

from rich.table import Table

from rollerrig.realtime.benchmarks import campaign as bench_campaign
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign import campaign

PLANS = ("low_adhesion", "etcs_dry")
STOPS = 60
CHUNK = 20
# requirement: hours on so many cores, with 99 % of the distances within `bench campaign`s DEVIATION
HOURS = 12.0
CORES = 2
_MILLION = 1e6
_HOUR_S = 3600.0


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure stops of each plan with each step."""
    plans = []
    for name in PLANS:
        stops = given.count or STOPS
        plan = campaign.load(name, runs=stops, chunk=min(CHUNK, stops), step_s=0.0)
        # loads and compiles what the first stop needs
        campaign.once(plan._replace(points=plan.points[:1]))
        say(f"{name}: {stops} stops with each step ...")
        steps = bench_campaign.longer_steps(plan, None, stops)
        exact_s = steps["stop_s"]
        rows = [{"step_s": None, "hours": _hours(exact_s), "share_within": 1.0, "worst": 0.0}]
        for step in steps["steps"]:
            again_s = campaign.AGAIN * exact_s
            rows.append(step | {"hours": _hours(exact_s / step["factor"] + again_s)})
        plans.append({"plan": name, "stops": stops, "stop_s": exact_s, "steps": rows})
    return {
        "plans": plans,
        "targets": [
            target(f"{plan['plan']}: a million stops on {CORES} cores", _fewest(plan), HOURS, "h")
            for plan in plans
        ],
        "notes": [
            f"the hours of a target are the fewest with 99 % of the distances within "
            f"{100 * bench_campaign.DEVIATION:g} %"
        ],
    }


def _hours(stop_s: float) -> float:
    """Return the hours of a million stops on all cores together."""
    return _MILLION * stop_s / CORES / _HOUR_S


def _fewest(plan: Result) -> float:
    """Return the fewest hours of a step whose deviations are allowed."""
    return min(step["hours"] for step in plan["steps"] if step["share_within"] >= 0.99)


def table(result: Result) -> Table:
    """Return a row for each plan and step."""
    rows = []
    for plan in result["plans"]:
        for step in plan["steps"]:
            is_exact = step["step_s"] is None
            rows.append(
                (
                    plan["plan"],
                    "of the scenario" if is_exact else f"{1e3 * step['step_s']:g} ms",
                    step["hours"],
                    None if is_exact else 100.0 * step["median"],
                    None if is_exact else 100.0 * step["share_within"],
                    None if is_exact else 100.0 * step["p99"],
                    None if is_exact else 100.0 * step["worst"],
                )
            )
    heads = (
        "plan",
        "step",
        f"1e6 stops on {CORES} cores, h",
        "median deviation, %",
        f"within {100 * bench_campaign.DEVIATION:g} %, %",
        "99 % of the stops, %",
        "worst, %",
    )
    return figures.table(
        f"a million stops, from {result['plans'][0]['stops']} of each", heads, rows
    )
