"""Table 8 of the paper today: what four contact models cost on one and the same motion, by the coach in 3D.

The coach brakes on a track from 42.3 m/s at 1e-4 s with degraded adhesion, each wheelset held in sliding by a brake
that is released and applied between two slidings. Pieces of this stop are recorded step by step; every model then finds
the contacts of the recorded states, and takes whole steps from them, so that all meet the same creepages. Vehicle is
the step without contacts, timed alone on the same states. In each round every piece is run by every model, one after
another; a cost is the median of the rounds, and the spread beside it is half the range in which 95 % of them lie: a
target is met only where it is met with the spread added. Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014), Table 8
(seconds for A1, fixed step 1e-4 s).
"""

import time
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.rig import params
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import coach_state, motion, wheel_rail_forces

SPEED_M_S, STEP_S, END_M_S = 42.3, 1e-4, 1.0
# steps of a recorded piece, and from the beginning of one to that of the next
PIECE, APART = 50, 5000
# sliding between which the brake of a wheelset is modulated, its torque and its lag
_LEAST_M_S, _MOST_M_S, _BRAKE_NM, _LAG_S = 4.0, 6.0, 6000.0, 0.2
_RESISTANCE = (600.0, 0.9375)
_ROUNDS = 15
REAL_TIME, WHOLE_PERCENT = 15.0, 3.0
# what is done with a recorded state; all read it back, NOTHING does no more
NOTHING, VEHICLE, CONTACT, WHOLE = range(4)


class Row(NamedTuple):
    """A model and what the paper's Table 8 says of it, in s."""

    model: str
    name: str
    vehicle_s: float
    contact_s: float


ROWS = (
    Row("johnson_vermeulen", "Kalker, saturated", 232.0, 118.0),
    Row("fastsim", "FASTSIM 10 x 10", 235.0, 213.0),
    Row("polach", "Polach", 232.0, 128.0),
    Row("degraded", "degraded adhesion", 232.0, 130.0),
)


class Recorded(NamedTuple):
    """Pieces of a stop: the coach's memory at the beginning of each, (pieces, SIZE), and each step's q and v."""

    memory: np.ndarray
    q: np.ndarray  # (pieces, PIECE, 42)
    v: np.ndarray


@kernel
def _modulate(state, speed_m_s, brake_Nm, target_Nm):
    """Release the brake of a wheelset that slides much, apply that of one that slides little."""
    for j in range(4):
        sliding = (
            speed_m_s + state.contacts[2 * j * wheel_rail_forces.MOST, 4] * state.v[22 + 6 * j]
        )
        if sliding > _MOST_M_S:
            target_Nm[j] = 0.0
        elif sliding < _LEAST_M_S:
            target_Nm[j] = _BRAKE_NM
        brake_Nm[j] += (target_Nm[j] - brake_Nm[j]) * STEP_S / _LAG_S


@kernel
def _brake(state, steps, coach, law, brake_Nm, target_Nm, acts_Nm, rest, mu, q, v):
    """Brake for some steps, and note the state at the beginning of each of the first ones."""
    for i in range(steps):
        if i < q.shape[0]:
            for c in range(42):
                q[i, c], v[i, c] = state.q[c], state.v[c]
        speed = motion.mean_speed(state.v, coach)
        _modulate(state, speed, brake_Nm, target_Nm)
        motion.step(
            state,
            coach,
            STEP_S,
            rest,
            rest,
            1.0,
            brake_Nm,
            acts_Nm,
            _RESISTANCE[0] + _RESISTANCE[1] * speed * speed,
            mu[0],
            mu[1],
            law,
        )


@kernel
def _again(what, state, q, v, coach, law, brake_Nm, acts_Nm, rest, mu):
    """Do `what` from each recorded state of a piece."""
    for i in range(q.shape[0]):
        for c in range(42):
            state.q[c], state.v[c] = q[i, c], v[i, c]
        if what == CONTACT:
            motion.touch(state, coach, rest, mu[0], mu[1], law)
        elif what == VEHICLE:
            motion.hang(state, coach, STEP_S, 1000.0)
            motion.respond(state, coach, STEP_S, rest, rest, 1.0, brake_Nm, acts_Nm, 1000.0)
        elif what == WHOLE:
            motion.step(
                state, coach, STEP_S, rest, rest, 1.0, brake_Nm, acts_Nm, 1000.0, mu[0], mu[1], law
            )


def recorded(coach: coaches.Coach, law: params.Law, most: int = 200) -> Recorded:
    """Brake from SPEED_M_S to END_M_S, or for so many pieces, and keep a piece of PIECE steps every APART steps."""
    buffer = np.zeros(coach_state.SIZE)
    state = coach_state.views(buffer)
    motion.start(state, coach, SPEED_M_S)
    brake, target, acts, rest = np.zeros(4), np.full(4, _BRAKE_NM), np.zeros(4), np.zeros(4)
    mu = np.array([[law.mu_cd] * 4, [law.mu_cr] * 4])
    pieces: list[tuple[np.ndarray, ...]] = []
    while len(pieces) < most and motion.mean_speed(state.v, coach) > END_M_S:
        begun = buffer.copy()
        q, v = np.empty((2, PIECE, 42))
        _brake(state, APART, coach, law, brake, target, acts, rest, mu, q, v)
        pieces.append((begun, q, v))
    return Recorded(*map(np.array, zip(*pieces, strict=True)))


def seconds(
    what: int,
    coach: coaches.Coach,
    law: params.Law,
    piece: int,
    given: Recorded,
    buffer: np.ndarray,
) -> float:
    """Processor time in s of a recorded piece; `buffer` (SIZE,) is worked in and holds what came of it."""
    buffer[:] = given.memory[piece]
    state, mu = coach_state.views(buffer), np.array([[law.mu_cd] * 4, [law.mu_cr] * 4])
    q, v, brake, acts, rest = (
        given.q[piece],
        given.v[piece],
        np.full(4, _BRAKE_NM),
        np.zeros(4),
        np.zeros(4),
    )
    begun_s = time.thread_time()
    _again(what, state, q, v, coach, law, brake, acts, rest, mu)
    return time.thread_time() - begun_s


def run(say: Say) -> Result:
    """Record a stop and time all four models on it."""
    sections = params.check(
        scenario.load("velim_a1", settings=("rig=plain_track",)).resolved, "velim_a1"
    )
    law = params.law_of(sections["adhesion"])
    ready = {row.model: coaches.build(sections, np.inf, MODELS[row.model], 10) for row in ROWS}
    say("recording a stop of the coach ...")
    given = recorded(ready["degraded"], law)
    # one coach serves what has no contacts
    tasks: list[tuple[str, int]] = [
        ("polach", NOTHING),
        ("polach", VEHICLE),
        *((row.model, what) for row in ROWS for what in (CONTACT, WHOLE)),
    ]
    buffer, spent = np.zeros(coach_state.SIZE), np.zeros((_ROUNDS, len(tasks)))
    for model, what in tasks:
        seconds(what, ready[model], law, 0, given, buffer)
    for k in range(_ROUNDS):
        say(f"{len(given.memory)} pieces of the stop by every model, {k + 1} of {_ROUNDS} ...")
        for piece in range(len(given.memory)):
            # another task is first each time
            for i in range(len(tasks)):
                at = (i + piece + k) % len(tasks)
                model, what = tasks[at]
                spent[k, at] += seconds(what, ready[model], law, piece, given, buffer)
    step_us = (spent[:, 1:] - spent[:, :1]) * 1e6 / given.q[:, :, 0].size
    return judged(dict(zip(tasks[1:], step_us.T, strict=True)), STEP_S * APART * len(given.memory))


def judged(step_us: dict[tuple[str, int], np.ndarray], simulated_s: float) -> Result:
    """Costs with their spread, and ratios to Polach; `step_us` (rounds,) of a model's contacts and whole, and vehicle.

    Key: model and what was timed; the vehicle stands under Polach's.
    """
    vehicle, per_stop = step_us["polach", VEHICLE], 1e-6 * simulated_s / STEP_S
    polach, degraded = step_us["polach", WHOLE], step_us["degraded", WHOLE]
    models = {}
    for row in ROWS:
        whole, contact = step_us[row.model, WHOLE], step_us[row.model, CONTACT]
        figure: dict[str, Any] = {
            "vehicle_s": vehicle * per_stop,
            "contact_s": contact * per_stop,
            "whole_s": whole * per_stop,
            "step_us": whole,
            "ratio": whole / polach,
            "real_time_factor": 1e6 * STEP_S / whole,
        }
        models[row.model] = (
            {name: middle(values) for name, values in figure.items()}
            | {f"{name}_spread": spread(values) for name, values in figure.items()}
            | {
                "paper_vehicle_s": row.vehicle_s,
                "paper_contact_s": row.contact_s,
                "paper_whole_s": row.vehicle_s + row.contact_s,
                "paper_ratio": (row.vehicle_s + row.contact_s) / 360.0,
            }
        )
    percent = 100.0 * (degraded - polach) / polach
    more_us = (step_us["degraded", CONTACT] - step_us["polach", CONTACT]) / 8.0
    of_contact = 100.0 * 8.0 * more_us / step_us["polach", CONTACT]
    each_us = step_us["polach", CONTACT] / 8.0
    return {
        "simulated_s": simulated_s,
        "rounds": len(vehicle),
        "models": models,
        "recovery_percent_of_whole": middle(percent),
        "recovery_percent_of_whole_spread": spread(percent),
        "recovery_us_a_contact": middle(more_us),
        "recovery_us_a_contact_spread": spread(more_us),
        "targets": [
            target(
                "degraded over Polach, of the whole",
                middle(percent),
                WHOLE_PERCENT,
                "%",
                spread(percent),
            ),
            target(
                "real time over the whole with degraded adhesion",
                middle(degraded) * 1e-6 / STEP_S,
                1.0 / REAL_TIME,
                "",
                spread(degraded) * 1e-6 / STEP_S,
            ),
        ],
        "notes": [
            f"recovery costs {middle(more_us):.3f} +- {spread(more_us):.3f} us a contact in the coach, "
            f"{middle(of_contact):.1f} +- {spread(of_contact):.1f} % of the contact with Polach and "
            f"{middle(percent):.1f} +- {spread(percent):.1f} % of the whole; the paper's: 1.6 % and 0.6 % of a "
            "whole that ran about ten times slower than real time",
            f"a contact with Polach, contact points included, takes {middle(each_us):.2f} +- "
            f"{spread(each_us):.2f} us",
        ],
    }


def middle(rounds: np.ndarray) -> float:
    """The median of the rounds."""
    return float(np.median(rounds))


def spread(rounds: np.ndarray) -> float:
    """Half the range in which 95 % of the rounds lie."""
    low, high = np.percentile(rounds, (2.5, 97.5))
    return float(0.5 * (high - low))


QUANTITIES = {
    "vehicle, s": "vehicle_s",
    "contact, s": "contact_s",
    "whole, s": "whole_s",
    "whole over Polach's": "ratio",
    "times real time": "real_time_factor",
    "one step, us": "step_us",
    "paper: vehicle, s": "paper_vehicle_s",
    "paper: contact, s": "paper_contact_s",
    "paper: whole, s": "paper_whole_s",
    "paper: whole over Polach's": "paper_ratio",
}


def table(result: Result) -> Table:
    """Ours with their spread, and the paper's below, on one stop from the same speed."""

    def cell(one: Result, key: str) -> str:
        beside = f" +- {one[f'{key}_spread']:.2g}" if f"{key}_spread" in one else ""
        return f"{one[key]:.3g}{beside}"

    return figures.table(
        f"Table 8: a stop of {result['simulated_s']:g} s, every model on its states, the coach in 3D on one core",
        ("", *(row.name for row in ROWS)),
        [
            (text, *(cell(result["models"][row.model], key) for row in ROWS))
            for text, key in QUANTITIES.items()
        ],
    )
