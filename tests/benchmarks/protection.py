"""`rollerrig bench protection`: what a WSP is worth on every packaged set of low adhesion.

The coach brakes with an emergency demand from 80, 120 and 160 km/h: without WSP, with the reference
WSP, and with the reference WSP at other slip bands. A slip band is the range of creepage in which
the unit lets wheels slide. More sliding cleans the rail more, until too much of it locks the wheel,
so the best band lies between. The steady curve of adhesion over creepage shows why: adhesion is
largest at some creepage, and a locked wheel has no more than the initial adhesion. `--png` draws
both. `--set` changes a value of all stops, as in `--set adhesion.cleaning_sliding_m_s=6`.
"""

import argparse
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.rig.contact import adhesion
from rollerrig.wsp_interface import signals

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# packaged sets of [adhesion] on which wheels slide under an emergency demand, and the others
LOW_SETS = ("soap", "low", "very_low", "wet_leaves")
OTHER_SETS = ("dry", "wet_clean", "wet_design")
SPEEDS_KM_H = (80, 120, 160)
# lower edges of the slip bands, as shares of the reference speed, and the upper edge of each
BANDS = (0.02, 0.03, 0.05, 0.08, 0.12, 0.16, 0.20, 0.25, 0.30, 0.40)
UPPER_OVER_LOWER = 1.25
# requirements: the reference WSP over the best band, and no WSP over the reference WSP
REFERENCE_OVER_BEST = 1.10
WITHOUT_OVER_REFERENCE = 1.25
# on soap a wheel has nearly the adhesion that an emergency brake needs; there a stop without WSP
# from these speeds must only be longer
SHORT_ON_SOAP_KM_H = (80, 120)

# an emergency demand, as in the packaged sequences emergency_*
_PRESSURE_PA = 3.8e5
_LONGEST_S = 400.0
# no limit of the band in m/s below this speed difference
_NO_LIMIT_M_S = 20.0
_LOCKS = signals.columns(signals.table(COACH).by_name["longest_lock"])

# the steady curves: speeds, and the creepages of the curve
CURVE_SPEEDS_M_S = (10.0, 20.0, 30.0, 40.0, 50.0)
CREEPAGES = np.linspace(0.002, 1.0, 500)
WHEEL_LOAD_N = 52.7e3
# sliding at which a contact has the adhesion that tests state as the initial one
INITIAL_SLIDING_M_S = 1.0


class StopFigures(NamedTuple):
    """The figures of one stop."""

    distance_m: float
    longest_lock_s: float  # of the wheelset that was locked longest


class Case(NamedTuple):
    """The stops from one speed on one set of adhesion."""

    without: StopFigures
    reference: StopFigures
    by_band: dict[float, StopFigures]  # by the lower edge of the slip band

    @property
    def best_m(self) -> float:
        """The shortest distance of all slip bands."""
        return min(stop.distance_m for stop in self.by_band.values())


Cases = dict[tuple[str, int], Case]


# --- stops ---


def cases(
    sets: Sequence[str] = LOW_SETS,
    speeds_km_h: Sequence[int] = SPEEDS_KM_H,
    bands: Sequence[float] = BANDS,
    say: Say = lambda _: None,
    settings: Sequence[str] = (),
) -> Cases:
    """Return the stops by set of adhesion and speed in km/h; `settings` change the scenario."""
    jobs = []
    for name in sets:
        for speed in speeds_km_h:
            jobs.append(((name, speed), plan_of(name, speed, settings)))

    say("stops without WSP ...")
    without = _stops(jobs, "none")
    say("stops with the reference WSP ...")
    reference = _stops(jobs, logic.load())
    by_band = {}
    for band in bands:
        say(f"stops with a slip band from {band:.0%} of the speed ...")
        by_band[band] = _stops(jobs, unit_of(band))

    result = {}
    for tag, _ in jobs:
        stops = {band: by_band[band][tag] for band in bands}
        result[tag] = Case(without[tag], reference[tag], stops)
    return result


def plan_of(adhesion_set: str, speed_km_h: int, settings: Sequence[str] = ()) -> scenario.Scenario:
    """Return the scenario of a stop."""
    return scenario.load(
        "velim_a1",
        settings=(
            f"adhesion={adhesion_set}",
            f"initial_speed_m_s={speed_km_h / 3.6!r}",
            f"duration_max_s={_LONGEST_S}",
            "loop.record_hz=10",
            *settings,
        ),
        tables={"demand": [{"from_s": 0.0, "pressure_Pa": _PRESSURE_PA}]},
    )


def unit_of(band: float) -> logic.Params:
    """Return the parameters of the reference WSP with a slip band from this share of the speed."""
    edges: dict[str, Any] = {
        "band_low_m_s": _NO_LIMIT_M_S,
        "band_low_fraction": band,
        "band_high_m_s": _NO_LIMIT_M_S,
        "band_high_fraction": UPPER_OVER_LOWER * band,
        "narrow_share": 1.0,
    }
    return logic.load()._replace(**edges)


def _stops(jobs: list, unit: str | logic.Params) -> dict[tuple[str, int], StopFigures]:
    """Run stops; return the figures of each. A vehicle that does not stop has no distance."""
    result = {}
    for finished in stops_in_lanes.together(jobs, unit):
        channels = finished.channels
        stands = channels["vehicle_speed_m_s"][-1] < 0.1
        distance_m = float(channels["position_m"][-1]) if stands else math.inf
        longest_lock_s = max(float(channels[name][-1]) for name in _LOCKS)
        result[finished.tag] = StopFigures(distance_m, longest_lock_s)
    return result


# --- steady curves ---


def steady_curve(adhesion_set: str, speed_m_s: float, settings: Sequence[str] = ()) -> np.ndarray:
    """Return the adhesion of one wheel on a rail at each of `CREEPAGES`, shape (500,)."""
    on_rail = ("rig=plain_track", f"adhesion={adhesion_set}", *settings)
    plan = scenario.load("velim_a1", settings=on_rail)
    return np.array([_adhesion(plan, creepage * speed_m_s, speed_m_s) for creepage in CREEPAGES])


def initial_adhesion(adhesion_set: str, speed_m_s: float) -> float:
    """Return the adhesion of a wheel at `INITIAL_SLIDING_M_S`, before sliding has cleaned."""
    plan = scenario.load(
        "velim_a1", settings=("rig=plain_track", f"adhesion={adhesion_set}", "adhesion.tau_m_J=0.0")
    )
    return _adhesion(plan, INITIAL_SLIDING_M_S, speed_m_s)


def _adhesion(plan: scenario.Scenario, sliding_m_s: float, speed_m_s: float) -> float:
    params = plan.params
    f, *_ = adhesion.wheel_adhesion(sliding_m_s, speed_m_s, WHEEL_LOAD_N, params.patch, params.law)
    return f


# --- the benchmark ---


def run(given: argparse.Namespace, say: Say) -> Result:
    """Return the distances in m and the longest locks in s of all stops."""
    found = cases(say=say, settings=given.set)
    if given.png:
        _draw(found, given.set).savefig(given.png, dpi=120)
        say(f"picture: {given.png}")

    rows = []
    for (name, speed), case in found.items():
        stops = {"without": case.without, "reference": case.reference, **case.by_band}
        rows.append(
            {
                "adhesion": name,
                "speed_km_h": speed,
                "distance_m": {str(key): stop.distance_m for key, stop in stops.items()},
                "longest_lock_s": {str(key): stop.longest_lock_s for key, stop in stops.items()},
            }
        )
    largest_at = _largest_at(given.set)
    notes = []
    for name, by_speed in largest_at.items():
        places = ", ".join(f"{at:.0%} ({speed} m/s)" for speed, at in by_speed.items())
        notes.append(f"adhesion on {name} is largest at a creepage of {places}")
    return {
        "stops": rows,
        "largest_at_creepage": largest_at,
        "targets": _targets(found),
        "notes": notes,
    }


def _largest_at(settings: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return the creepage with the largest steady adhesion, by set and speed in m/s."""
    result: dict[str, dict[str, float]] = {}
    for name in LOW_SETS:
        result[name] = {}
        for speed in CURVE_SPEEDS_M_S:
            curve = steady_curve(name, speed, settings)
            result[name][f"{speed:g}"] = float(CREEPAGES[curve.argmax()])
    return result


def _targets(found: Cases) -> list[Result]:
    over_best = max(case.reference.distance_m / case.best_m for case in found.values())
    reference_over_without = max(
        case.reference.distance_m / case.without.distance_m
        for (name, speed), case in found.items()
        if not (name == "soap" and speed in SHORT_ON_SOAP_KM_H)
    )
    return [
        target("reference WSP over the best slip band, worst case", over_best, REFERENCE_OVER_BEST),
        target(
            "reference WSP over no WSP, worst case but soap from 80 and 120 km/h",
            reference_over_without,
            1.0 / WITHOUT_OVER_REFERENCE,
        ),
    ]


def table(result: Result) -> Table:
    """Return the table of distances; `best` is the shortest of all slip bands."""
    narrowest = str(BANDS[0])
    widest = str(BANDS[-1])
    heads = ["adhesion", "from, km/h", "no WSP", "locked, s", "reference", "best", "at"]
    heads += [f"{BANDS[0]:.0%}", f"{BANDS[-1]:.0%}"]
    rows = []
    for row in result["stops"]:
        distance_m = row["distance_m"]
        best = min(map(str, BANDS), key=distance_m.__getitem__)
        rows.append(
            (
                row["adhesion"],
                row["speed_km_h"],
                round(distance_m["without"]),
                round(row["longest_lock_s"]["without"]),
                round(distance_m["reference"]),
                round(distance_m[best]),
                f"{float(best):.0%}",
                round(distance_m[narrowest]),
                round(distance_m[widest]),
            )
        )
    return figures.table("stopping distance in m, by slip band of the WSP", heads, rows)


def _draw(found: Cases, settings: Sequence[str]) -> "Figure":
    """Return the picture: steady curves, and distances over the slip band."""
    from matplotlib.figure import Figure

    from rollerrig.realtime.pictures import colours

    figure = Figure(figsize=(11.0, 4.2), layout="constrained")
    curves, stops = figure.subplots(1, 2)
    shown = dict(zip(LOW_SETS, map(colours.as_hex, colours.AXLES), strict=False))

    for name in ("soap", "low"):
        for speed, style in ((10.0, ":"), (30.0, "-"), (50.0, "--")):
            curve = steady_curve(name, speed, settings)
            label = f"{name}, {speed:g} m/s"
            curves.plot(100.0 * CREEPAGES, curve, style, color=shown[name], label=label)
    curves.set_xlabel("creepage, %")
    curves.set_ylabel("steady adhesion of one wheel")
    curves.legend(frameon=False, fontsize=8)

    for name in LOW_SETS:
        case = found[name, 120]
        over_best = [stop.distance_m / case.best_m for stop in case.by_band.values()]
        stops.plot(
            [100.0 * band for band in case.by_band], over_best, "o-", color=shown[name], label=name
        )
    reference: Any = logic.load()
    reference_percent = 100.0 * reference.band_low_fraction
    stops.axvline(reference_percent, color="grey", linewidth=0.8, label="reference WSP")
    stops.set_xlabel("lower edge of the slip band, % of the speed")
    stops.set_ylabel("distance from 120 km/h over the shortest")
    stops.legend(frameon=False, fontsize=8)
    for axes in (curves, stops):
        axes.grid(alpha=0.3)
    return figure
