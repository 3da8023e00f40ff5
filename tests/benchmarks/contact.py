"""What one evaluation of a contact costs, on one core, after compilation, and Table 8 of the paper.

Each law is called for many slidings in a row inside one kernel, as a step of the physics calls it; the sum of the
results is returned so that no call can be left out. Then come the four models of the coach's wheels, with lateral
creepage and spin, and the search for the contact points of a swaying wheel; then `table8` lets them brake the coach.
"""

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from paper import table8
from rich.console import Group

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.rig import wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion, creep_force, geometry, polach, profiles

_CALLS = 200_000
# lateral creepage and spin of the contacts in both directions, and what recovery may cost
_LATERAL, _SPIN_1_m, RECOVERY_NS = 1e-3, 0.1, 100.0
_REPEATS = 5
# what the points of one wheel may cost, as a multiple of Polach's curve
POINTS_OVER_POLACH = 60.0
_SPEED_m_s, _LOAD_N = 30.0, 105_000.0


class Contact(NamedTuple):
    """A law: its name, what it is, and the kernel that calls it for each sliding of an array."""

    name: str
    text: str
    sweep: Callable[[np.ndarray, Any], float]


@kernel
def _polach(slidings, params):
    total, law = 0.0, params.law
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
    total, sideways = 0.0, _LATERAL
    for s in slidings:
        sideways = -sideways
        fx, fy, mz = creep_force.creep_force(
            params.patch.model,
            s / _SPEED_m_s,
            sideways,
            _SPIN_1_m,
            s,
            0.5 * _LOAD_N + s,
            params.patch,
            params.law,
        )
        total += fx + fy + mz
    return total


@kernel
def _search(slidings, given):
    wheel, rail, roller_m, found, misfits = given
    total = 0
    for i in range(slidings.size):
        total += geometry.detect(
            found,
            0,
            0,
            misfits,
            0,
            (0.0, 0.004 * math.sin(i * 1e-3), 0.4447),
            geometry.axis(0.0, 0.005),
            roller_m,
            wheel,
            rail,
        )
    return float(total)


@kernel
def _follow(slidings, given):
    wheel, rail, roller_m, found, misfits = given
    count = geometry.detect(
        found, 0, 0, misfits, 0, (0.0, 0.0, 0.4447), geometry.axis(0.0, 0.0), roller_m, wheel, rail
    )
    for i in range(slidings.size):
        pose = 0.0, 0.004 * math.sin(i * 1e-3), 0.4447
        axle = geometry.axis(0.0, 0.005 * math.cos(i * 1e-3))
        count = geometry.track(found, 0, count, pose, axle, roller_m, wheel, rail)
        if i % 16 == 0:
            count = geometry.detect(found, 0, count, misfits, 0, pose, axle, roller_m, wheel, rail)
    return float(count)


# a contact law of rig/contact gets a row here
CONTACTS = (
    Contact("polach", "one creep curve with falling friction", _polach),
    Contact("degraded", "both curves and the closed form between them", _degraded),
    Contact("wheelset", "the same as the plant calls it, with the limit on cleaning", _wheelset),
)
# the same for a model of `creep_force`, with lateral creepage and spin
MODELS = tuple(Contact(row.model, row.name, _both_directions) for row in table8.ROWS)
POINTS = (
    Contact("search", "all points of a wheel, from nothing", _search),
    Contact("follow", "the same from step to step, searched anew every 16", _follow),
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Time every law, and the coach; the best of some repeats: whatever disturbs makes it slower."""
    params = scenario.load("velim_a1").params
    # from micro-slip to a locked wheel, in an order that no branch predictor knows
    slidings = np.random.default_rng(given.seed).permutation(np.geomspace(1e-4, _SPEED_m_s, _CALLS))
    found = {contact.name: _timed(contact, slidings, params, say) for contact in CONTACTS}
    spinning = {
        contact.name: _timed(
            contact,
            slidings,
            params._replace(
                patch=params.patch._replace(model=creep_force.MODELS[contact.name], cells=10)
            ),
            say,
        )
        for contact in MODELS
    }
    wheel, rail = profiles.s1002(), profiles.uic60()
    points = {
        f"{contact.name} on a {where}": _timed(
            contact,
            slidings,
            (
                wheel,
                rail,
                roller_m,
                np.zeros((geometry.MOST, geometry.COLUMNS)),
                np.zeros((1, len(wheel.coarse))),
            ),
            say,
        )
        for contact in POINTS
        for where, roller_m in (("rail", math.inf), ("roller", 1.0))
    }
    for group in (found, spinning, points):
        for one in group.values():
            one["ratio"] = (
                one["time_ns"] / (found if group is points else group)["polach"]["time_ns"]
            )
    along_ns, more_ns = (
        group["degraded"]["time_ns"] - group["polach"]["time_ns"] for group in (found, spinning)
    )
    whole = table8.run(say)
    dearest = max(one["ratio"] for one in points.values())
    return {
        "contacts": found,
        "with_spin": spinning,
        "points": points,
        "recovery_ns": more_ns,
        "table8": whole,
        "targets": [
            target(
                "degraded over Polach, along the rail, one contact", along_ns, RECOVERY_NS, "ns"
            ),
            target("degraded over Polach, with spin, one contact", more_ns, RECOVERY_NS, "ns"),
            target(
                "contact points of one wheel over one Polach curve", dearest, POINTS_OVER_POLACH
            ),
            *whole["targets"],
        ],
        "notes": whole["notes"],
    }


def _timed(contact: Contact, slidings: np.ndarray, params: Any, say: Say) -> Result:
    """The best of some repeats, in ns a call."""
    say(f"contact {contact.name} ...")
    contact.sweep(slidings[:10], params)
    taken_s = []
    for _ in range(_REPEATS):
        begun_s = time.thread_time()
        contact.sweep(slidings, params)
        taken_s.append(time.thread_time() - begun_s)
    return {"time_ns": 1e9 * min(taken_s) / _CALLS}


def table(result: Result) -> Group:
    """The cost of each law, and over Polach's; then Table 8."""
    heads = ("law", "ns", "over Polach", "what")
    laws = (
        ("one contact, along the rail", CONTACTS, "contacts"),
        ("one contact, in two directions and with spin", MODELS, "with_spin"),
    )
    return Group(
        *(
            figures.table(
                title,
                heads,
                [(law.name, *result[key][law.name].values(), law.text) for law in group],
            )
            for title, group, key in laws
        ),
        figures.table(
            "contact points of one wheel",
            ("what", "ns", "over Polach"),
            [(name, *one.values()) for name, one in result["points"].items()],
        ),
        table8.table(result["table8"]),
    )
