"""`rollerrig bench contact`: the time of one contact on one core, and Table 8 of the paper.

Each law is called for many slidings in a row inside one kernel, as a step of the physics calls it;
the kernel returns the sum of the results, so that the compiler cannot leave out a call. Three
groups are timed: the laws along the rail, the four models of the coach's wheels with lateral
creepage and spin, and the search for the contact points of a swaying wheel. Then `paper.table8`
lets the four models brake the coach.
"""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from paper import table8
from rich.console import Group
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion, creep_force, geometry, polach, profiles

# requirements: time of recovery in a contact, and time of the contact points of one wheel as a
# multiple of the time of Polach's curve
RECOVERY_NS = 100.0
POINTS_OVER_POLACH = 60.0
_CALLS = 200_000
# the shortest of so many repeats counts, because every disturbance makes a repeat longer
_REPEATS = 5
_SPEED_m_s = 30.0
_LOAD_N = 105_000.0  # of a wheelset
# of the contacts in both directions
_LATERAL_CREEPAGE = 1e-3
_SPIN_1_m = 0.1
# the wheelset sways: height of its centre, amplitudes of lateral shift and yaw, phase of a call
_HEIGHT_M = 0.4447
_SHIFT_M = 0.004
_YAW_RAD = 0.005
_PHASE_RAD = 1e-3
_ROLLER_M = 1.0
# a wheel is searched anew after so many steps
_SEARCH_EVERY = 16


class Contact(NamedTuple):
    """A row of a table: a law or a search, and the kernel that calls it for each sliding."""

    name: str
    text: str
    sweep: Callable[[np.ndarray, Any], float]  # (slidings in m/s, parameters)


@kernel
def _polach(slidings, params):
    total = 0.0
    law = params.law
    for s in slidings:
        # the load differs from call to call, as in a step
        unit = params.patch.eps1 * math.exp(math.log(0.5 * _LOAD_N + s) / -3.0)
        f, by_friction, by_creepage = polach.curve(
            s, s / _SPEED_m_s, unit, law.mu_cd, law.A_d, law.gamma_d_s_m, law.k_ad, law.k_sd
        )
        total += f + by_friction + by_creepage / _SPEED_m_s
    return total


@kernel
def _degraded(slidings, params):
    total = 0.0
    for s in slidings:
        f, _, _, _, _, slope = adhesion.wheel_adhesion(
            s, _SPEED_m_s, 0.5 * _LOAD_N + s, params.patch, params.law
        )
        total += f + slope
    return total


@kernel
def _wheelset(slidings, params):
    total = 0.0
    law = params.law
    for s in slidings:
        total += wheelset.wheelset_adhesion(
            s, _SPEED_m_s, _LOAD_N, law.mu_cd, law.mu_cr, params.patch, law
        )[0]
    return total


@kernel
def _both_directions(slidings, params):
    total = 0.0
    lateral = _LATERAL_CREEPAGE
    for s in slidings:
        lateral = -lateral
        fx, fy, mz = creep_force.creep_force(
            params.patch.model,
            s / _SPEED_m_s,
            lateral,
            _SPIN_1_m,
            s,
            0.5 * _LOAD_N + s,
            params.patch,
            params.law,
        )
        total += fx + fy + mz
    return total


class _Wheel(NamedTuple):
    """A wheel on a rail or a roller, and memory for its contacts."""

    wheel: profiles.Wheel
    rail: profiles.Rail
    roller_m: float  # radius of the roller; inf: a rail
    found: np.ndarray  # (geometry.MOST, geometry.COLUMNS) contacts
    misfits: np.ndarray  # (1, coarse nodes)


@kernel
def _search(slidings, one):
    total = 0
    for i in range(slidings.size):
        pose = 0.0, _SHIFT_M * math.sin(i * _PHASE_RAD), _HEIGHT_M
        axle = geometry.axis(0.0, _YAW_RAD)
        total += geometry.detect(
            one.found, 0, 0, one.misfits, 0, pose, axle, one.roller_m, one.wheel, one.rail
        )
    return float(total)


@kernel
def _follow(slidings, one):
    pose = 0.0, 0.0, _HEIGHT_M
    axle = geometry.axis(0.0, 0.0)
    count = geometry.detect(
        one.found, 0, 0, one.misfits, 0, pose, axle, one.roller_m, one.wheel, one.rail
    )
    for i in range(slidings.size):
        pose = 0.0, _SHIFT_M * math.sin(i * _PHASE_RAD), _HEIGHT_M
        axle = geometry.axis(0.0, _YAW_RAD * math.cos(i * _PHASE_RAD))
        count = geometry.track(one.found, 0, count, pose, axle, one.roller_m, one.wheel, one.rail)
        if i % _SEARCH_EVERY == 0:
            count = geometry.detect(
                one.found, 0, count, one.misfits, 0, pose, axle, one.roller_m, one.wheel, one.rail
            )
    return float(count)


# along the rail; a contact law of rig/contact gets a row here
CONTACTS = (
    Contact("polach", "one creep curve with falling friction", _polach),
    Contact("degraded", "both curves and the closed form between them", _degraded),
    Contact("wheelset", "the same as the plant calls it, with the limit on cleaning", _wheelset),
)
# with lateral creepage and spin; a model of `creep_force` gets a row in table8.ROWS
MODELS = tuple(Contact(row.model, row.name, _both_directions) for row in table8.ROWS)
POINTS = (
    Contact("search", "all points of a wheel, without known ones", _search),
    Contact("follow", f"from step to step, with a search every {_SEARCH_EVERY} steps", _follow),
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Time every law, and the four models in the coach."""
    params = scenario.load("velim_a1").params
    # from micro-slip to a locked wheel, in an order that no branch predictor knows
    rng = np.random.default_rng(given.seed)
    slidings = rng.permutation(np.geomspace(1e-4, _SPEED_m_s, _CALLS))

    along = {contact.name: _timed(contact, slidings, params, say) for contact in CONTACTS}
    spinning = {}
    for contact in MODELS:
        patch = params.patch._replace(model=creep_force.MODELS[contact.name], cells=10)
        spinning[contact.name] = _timed(contact, slidings, params._replace(patch=patch), say)
    points = _timed_points(slidings, say)
    _add_ratios(along, along["polach"]["time_ns"])
    _add_ratios(spinning, spinning["polach"]["time_ns"])
    _add_ratios(points, along["polach"]["time_ns"])

    along_ns = along["degraded"]["time_ns"] - along["polach"]["time_ns"]
    spinning_ns = spinning["degraded"]["time_ns"] - spinning["polach"]["time_ns"]
    slowest_ratio = max(one["ratio"] for one in points.values())
    coach = table8.run(say)
    return {
        "contacts": along,
        "with_spin": spinning,
        "points": points,
        "recovery_ns": spinning_ns,
        "table8": coach,
        "targets": [
            target(
                "degraded over Polach, along the rail, one contact", along_ns, RECOVERY_NS, "ns"
            ),
            target("degraded over Polach, with spin, one contact", spinning_ns, RECOVERY_NS, "ns"),
            target(
                "contact points of one wheel over one Polach curve",
                slowest_ratio,
                POINTS_OVER_POLACH,
            ),
            *coach["targets"],
        ],
        "notes": coach["notes"],
    }


def _timed_points(slidings: np.ndarray, say: Say) -> dict[str, Result]:
    """Time the search for the contact points of a wheel, on a rail and on a roller."""
    wheel = profiles.s1002()
    rail = profiles.uic60()
    times = {}
    for contact in POINTS:
        for under, roller_m in (("rail", math.inf), ("roller", _ROLLER_M)):
            found = np.zeros((geometry.MOST, geometry.COLUMNS))
            misfits = np.zeros((1, len(wheel.coarse)))
            one = _Wheel(wheel, rail, roller_m, found, misfits)
            times[f"{contact.name} on a {under}"] = _timed(contact, slidings, one, say)
    return times


def _timed(contact: Contact, slidings: np.ndarray, params: Any, say: Say) -> Result:
    """Return the shortest time of some repeats, in ns per call."""
    say(f"contact {contact.name} ...")
    contact.sweep(slidings[:10], params)  # compiles
    taken_s = []
    for _ in range(_REPEATS):
        begun_s = time.thread_time()
        contact.sweep(slidings, params)
        taken_s.append(time.thread_time() - begun_s)
    return {"time_ns": 1e9 * min(taken_s) / _CALLS}


def _add_ratios(times: dict[str, Result], polach_ns: float) -> None:
    for one in times.values():
        one["ratio"] = one["time_ns"] / polach_ns


def table(result: Result) -> Group:
    """Return the times of each law, also relative to Polach's, and Table 8."""
    return Group(
        _laws("one contact, along the rail", CONTACTS, result["contacts"]),
        _laws("one contact, in two directions and with spin", MODELS, result["with_spin"]),
        figures.table(
            "contact points of one wheel",
            ("what", "ns", "over Polach"),
            [(name, one["time_ns"], one["ratio"]) for name, one in result["points"].items()],
        ),
        table8.table(result["table8"]),
    )


def _laws(title: str, laws: Sequence[Contact], times: dict[str, Result]) -> Table:
    rows = []
    for law in laws:
        one = times[law.name]
        rows.append((law.name, one["time_ns"], one["ratio"], law.text))
    return figures.table(title, ("law", "ns", "over Polach", "what"), rows)
