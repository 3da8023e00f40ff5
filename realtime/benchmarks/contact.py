"""What one evaluation of a contact costs, on one core, after compilation.

Each law is called for many slidings in a row inside one kernel, as a step of the physics calls it;
the sum of the results is returned so that no call can be left out.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.realtime import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.rig import wheelset
from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.kernel import kernel

_CALLS = 200_000
_REPEATS = 5
_SPEED_m_s, _LOAD_N = 30.0, 105_000.0


class Contact(NamedTuple):
    """A law: its name, what it is, and the kernel that calls it for each sliding of an array."""

    name: str
    text: str
    sweep: Callable[[np.ndarray, Any], float]


@kernel
def _polach(slidings, params):
    total = 0.0
    law, unit = params.law, params.patch.eps1 * (0.5 * _LOAD_N) ** (-1.0 / 3.0)
    for s in slidings:
        total += polach.curve(s, s / _SPEED_m_s, unit, law.mu_cd, law.A_d, law.gamma_d_s_m,
                              law.k_ad, law.k_sd)[0]
    return total


@kernel
def _degraded(slidings, params):
    total = 0.0
    for s in slidings:
        total += adhesion.degraded(s, _SPEED_m_s, 0.5 * _LOAD_N, params.patch, params.law)[0]
    return total


@kernel
def _wheelset(slidings, params):
    total = 0.0
    law = params.law
    for s in slidings:
        total += wheelset.creep(s, _SPEED_m_s, _LOAD_N, law.mu_cd, law.mu_cr, params.patch, law,
                                params.cleaning_creepage)[0]
    return total


# a contact law of rig/contact gets a row here; the first is what the others are compared with
CONTACTS = (
    Contact("polach", "one creep curve with falling friction", _polach),
    Contact("degraded", "both curves and the closed form between them", _degraded),
    Contact("wheelset", "the same as the plant calls it, with the limit on cleaning", _wheelset),
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Time every law; the best of some repeats, since whatever disturbs makes it slower."""
    params = scenario.load("velim_a1").params
    # from micro-slip to a locked wheel, in an order that no branch predictor knows
    slidings = np.random.default_rng(given.seed).permutation(
        np.geomspace(1e-4, _SPEED_m_s, _CALLS))
    found: Result = {}
    for contact in CONTACTS:
        say(f"contact {contact.name} ...")
        contact.sweep(slidings[:10], params)
        best_s = min(_seconds(contact, slidings, params) for _ in range(_REPEATS))
        found[contact.name] = {"time_ns": 1e9 * best_s / _CALLS}
    first = found[CONTACTS[0].name]["time_ns"]
    for one in found.values():
        one["ratio"] = one["time_ns"] / first
    return {"contacts": found}


def _seconds(contact: Contact, slidings: np.ndarray, params: Any) -> float:
    begun_s = time.thread_time()
    contact.sweep(slidings, params)
    return time.thread_time() - begun_s


def table(result: Result) -> Table:
    """The cost of each law, and over the first one's."""
    texts = {contact.name: contact.text for contact in CONTACTS}
    rows = [(name, one["time_ns"], one["ratio"], texts[name])
            for name, one in result["contacts"].items()]
    return figures.table("one contact", ("law", "ns", "ratio", "what"), rows)
