"""Table 8 of the paper today: the time of four contact models on the same motion of the coach in
3D.

The coach brakes on a track from 42.3 m/s at 1e-4 s with degraded adhesion. Each wheelset is held in
sliding by a brake that is released and applied between two limits of sliding. Pieces of this stop
are recorded step by step. Every model then finds the contacts of the recorded states, and takes
whole steps from them, so that all models meet the same creepages. `VEHICLE` is the step without
contacts, timed alone on the same states.

In each round every piece is run by every model, one after another. A time is the median of the
rounds, and its spread is half the range that contains 95 % of them. A target is met only if it is
met with the spread added.

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014), Table 8 (seconds for A1, fixed step 1e-4 s).
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
from rollerrig.rig.contact import geometry
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import coach_state, motion, wheel_rail_forces

SPEED_M_S = 42.3
STEP_S = 1e-4
# the stop is recorded down to this speed
END_M_S = 1.0
# steps of a recorded piece, and from the start of a piece to that of the next
PIECE = 50
APART = 5000
# the brake of a wheelset is released above the larger sliding, and applied below the smaller one
_LEAST_M_S = 4.0
_MOST_M_S = 6.0
_BRAKE_NM = 6000.0
_LAG_S = 0.2
# running resistance: constant in N, and in N s2/m2; a constant one where single steps are timed
_RESISTANCE_N = 600.0
_RESISTANCE_N_S2_M2 = 0.9375
_TIMED_RESISTANCE_N = 1000.0
_ROUNDS = 15
# requirements: times real time, and the cost of recovery in percent of the whole step
REAL_TIME = 15.0
WHOLE_PERCENT = 3.0
# what is done with each recorded state; all read it back, and NOTHING does no more
NOTHING = 0
VEHICLE = 1
CONTACT = 2
WHOLE = 3

AXLES = 4
WHEELS = 2 * AXLES
COORDINATES = 42  # of the coach: seven bodies
# index of the pitch rate of the first wheelset in v, and the distance to that of the next
_PITCH_RATE = 22
_NEXT_WHEELSET = 6


class Row(NamedTuple):
    """A model, and its times in the paper's Table 8, in s."""

    model: str
    name: str
    vehicle_s: float
    contact_s: float

    @property
    def whole_s(self) -> float:
        return self.vehicle_s + self.contact_s


ROWS = (
    Row("johnson_vermeulen", "Kalker, saturated", 232.0, 118.0),
    Row("fastsim", "FASTSIM 10 x 10", 235.0, 213.0),
    Row("polach", "Polach", 232.0, 128.0),
    Row("degraded", "degraded adhesion", 232.0, 130.0),
)
PAPER_POLACH_S = 360.0


class Recorded(NamedTuple):
    """Pieces of a stop."""

    memory: np.ndarray  # (pieces, coach_state.SIZE) of the coach at the start of each piece
    q: np.ndarray  # (pieces, PIECE, COORDINATES) at the start of each step
    v: np.ndarray  # the same, speeds


@kernel
def _modulate(state, speed_m_s, brake_Nm, target_Nm):
    """Release the brake of a wheelset that slides much, and apply that of one that slides
    little.
    """
    for j in range(AXLES):
        left_wheel = 2 * j * wheel_rail_forces.MOST
        height = state.contacts[left_wheel, geometry.Z]  # of the contact below the axle: negative
        sliding = speed_m_s + height * state.v[_PITCH_RATE + _NEXT_WHEELSET * j]
        if sliding > _MOST_M_S:
            target_Nm[j] = 0.0
        elif sliding < _LEAST_M_S:
            target_Nm[j] = _BRAKE_NM
        brake_Nm[j] += (target_Nm[j] - brake_Nm[j]) * STEP_S / _LAG_S


@kernel
def _brake(state, steps, coach, law, brake_Nm, target_Nm, acts_Nm, rest, mu, q, v):
    """Brake for some steps, and write the state at the start of each of the first ones to q and
    v.
    """
    for i in range(steps):
        if i < q.shape[0]:
            for c in range(COORDINATES):
                q[i, c] = state.q[c]
                v[i, c] = state.v[c]
        speed = motion.mean_speed(state.v, coach)
        _modulate(state, speed, brake_Nm, target_Nm)
        resistance_N = _RESISTANCE_N + _RESISTANCE_N_S2_M2 * speed * speed
        motion.step(
            state,
            coach,
            STEP_S,
            rest,
            rest,
            1.0,
            brake_Nm,
            acts_Nm,
            resistance_N,
            mu[0],
            mu[1],
            law,
        )


@kernel
def _repeat(what, state, q, v, coach, law, brake_Nm, acts_Nm, rest, mu):
    """Do `what` from each recorded state of a piece."""
    resistance_N = _TIMED_RESISTANCE_N
    for i in range(q.shape[0]):
        for c in range(COORDINATES):
            state.q[c] = q[i, c]
            state.v[c] = v[i, c]
        if what == CONTACT:
            motion.touch(state, coach, rest, mu[0], mu[1], law)
        elif what == VEHICLE:
            motion.hang(state, coach, STEP_S, resistance_N)
            motion.respond(state, coach, STEP_S, rest, rest, 1.0, brake_Nm, acts_Nm, resistance_N)
        elif what == WHOLE:
            motion.step(
                state,
                coach,
                STEP_S,
                rest,
                rest,
                1.0,
                brake_Nm,
                acts_Nm,
                resistance_N,
                mu[0],
                mu[1],
                law,
            )


def recorded(coach: coaches.Coach, law: params.Law, most: int = 200) -> Recorded:
    """Brake from SPEED_M_S to END_M_S; return a piece of PIECE steps every APART steps.

    At most `most` pieces are recorded.
    """
    buffer = np.zeros(coach_state.SIZE)
    state = coach_state.views(buffer)
    motion.start(state, coach, SPEED_M_S)
    brake_Nm = np.zeros(AXLES)
    target_Nm = np.full(AXLES, _BRAKE_NM)
    acts_Nm = np.zeros(AXLES)
    rest = np.zeros(AXLES)
    mu = _friction(law)
    memory: list[np.ndarray] = []
    qs: list[np.ndarray] = []
    vs: list[np.ndarray] = []
    while len(memory) < most and motion.mean_speed(state.v, coach) > END_M_S:
        memory.append(buffer.copy())
        q, v = np.empty((2, PIECE, COORDINATES))
        _brake(state, APART, coach, law, brake_Nm, target_Nm, acts_Nm, rest, mu, q, v)
        qs.append(q)
        vs.append(v)
    return Recorded(np.array(memory), np.array(qs), np.array(vs))


def _friction(law: params.Law) -> np.ndarray:
    """Return mu_cd and mu_cr of each wheelset, shape (2, AXLES)."""
    return np.array([[law.mu_cd] * AXLES, [law.mu_cr] * AXLES])


def seconds(
    what: int,
    coach: coaches.Coach,
    law: params.Law,
    piece: int,
    stop: Recorded,
    buffer: np.ndarray,
) -> float:
    """Do `what` with a recorded piece, and return the processor time in s.

    `buffer` (coach_state.SIZE,) is the working memory, and holds the state afterwards.
    """
    buffer[:] = stop.memory[piece]
    state = coach_state.views(buffer)
    mu = _friction(law)
    q = stop.q[piece]
    v = stop.v[piece]
    brake_Nm = np.full(AXLES, _BRAKE_NM)
    acts_Nm = np.zeros(AXLES)
    rest = np.zeros(AXLES)
    begun_s = time.thread_time()
    _repeat(what, state, q, v, coach, law, brake_Nm, acts_Nm, rest, mu)
    return time.thread_time() - begun_s


def run(say: Say) -> Result:
    """Record a stop, and time all four models on it."""
    plan = scenario.load("velim_a1", settings=("rig=plain_track",))
    sections = params.check(plan.resolved, "velim_a1")
    law = params.law_of(sections["adhesion"])
    ready = {row.model: coaches.build(sections, np.inf, MODELS[row.model], 10) for row in ROWS}
    say("recording a stop of the coach ...")
    stop = recorded(ready["degraded"], law)
    pieces = len(stop.memory)

    # NOTHING and VEHICLE have no contacts, so one coach is enough for them
    tasks: list[tuple[str, int]] = [("polach", NOTHING), ("polach", VEHICLE)]
    for row in ROWS:
        tasks += [(row.model, CONTACT), (row.model, WHOLE)]
    buffer = np.zeros(coach_state.SIZE)
    spent_s = np.zeros((_ROUNDS, len(tasks)))
    for model, what in tasks:
        seconds(what, ready[model], law, 0, stop, buffer)  # compiles
    for k in range(_ROUNDS):
        say(f"{pieces} pieces of the stop by every model, {k + 1} of {_ROUNDS} ...")
        for piece in range(pieces):
            for i in range(len(tasks)):
                # each time another task is first
                at = (i + piece + k) % len(tasks)
                model, what = tasks[at]
                spent_s[k, at] += seconds(what, ready[model], law, piece, stop, buffer)

    steps = stop.q[:, :, 0].size
    step_us = (spent_s[:, 1:] - spent_s[:, :1]) * 1e6 / steps
    return judged(dict(zip(tasks[1:], step_us.T, strict=True)), STEP_S * APART * pieces)


def judged(step_us: dict[tuple[str, int], np.ndarray], simulated_s: float) -> Result:
    """Return times with their spread, ratios to Polach's model, and targets.

    `step_us` has the time of one step in each round, shape (rounds,), by model and what was timed;
    the vehicle's is that of the model "polach".
    """
    vehicle_us = step_us["polach", VEHICLE]
    polach_us = step_us["polach", WHOLE]
    degraded_us = step_us["degraded", WHOLE]
    s_per_us = 1e-6 * simulated_s / STEP_S  # seconds of the whole stop per microsecond of one step
    models = {}
    for row in ROWS:
        whole_us = step_us[row.model, WHOLE]
        contact_us = step_us[row.model, CONTACT]
        rounds: dict[str, Any] = {
            "vehicle_s": vehicle_us * s_per_us,
            "contact_s": contact_us * s_per_us,
            "whole_s": whole_us * s_per_us,
            "step_us": whole_us,
            "ratio": whole_us / polach_us,
            "real_time_factor": 1e6 * STEP_S / whole_us,
        }
        model: Result = {name: middle(values) for name, values in rounds.items()}
        for name, values in rounds.items():
            model[f"{name}_spread"] = spread(values)
        model["paper_vehicle_s"] = row.vehicle_s
        model["paper_contact_s"] = row.contact_s
        model["paper_whole_s"] = row.whole_s
        model["paper_ratio"] = row.whole_s / PAPER_POLACH_S
        models[row.model] = model

    percent = 100.0 * (degraded_us - polach_us) / polach_us
    more_us = (step_us["degraded", CONTACT] - step_us["polach", CONTACT]) / WHEELS
    return {
        "simulated_s": simulated_s,
        "rounds": len(vehicle_us),
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
                middle(degraded_us) * 1e-6 / STEP_S,
                1.0 / REAL_TIME,
                "",
                spread(degraded_us) * 1e-6 / STEP_S,
            ),
        ],
        "notes": _notes(percent, more_us, step_us["polach", CONTACT]),
    }


def _notes(percent: np.ndarray, more_us: np.ndarray, polach_us: np.ndarray) -> list[str]:
    """Return the cost of recovery, and of a contact; `polach_us`: all contacts of a step."""
    of_contact = 100.0 * WHEELS * more_us / polach_us
    each_us = polach_us / WHEELS
    return [
        f"recovery costs {middle(more_us):.3f} +- {spread(more_us):.3f} us per contact in the "
        f"coach, {middle(of_contact):.1f} +- {spread(of_contact):.1f} % of the contact with Polach "
        f"and {middle(percent):.1f} +- {spread(percent):.1f} % of the whole; the paper's: 1.6 % "
        "and 0.6 % of a whole that ran about ten times slower than real time",
        f"a contact with Polach, contact points included, takes {middle(each_us):.2f} +- "
        f"{spread(each_us):.2f} us",
    ]


def middle(rounds: np.ndarray) -> float:
    """Return the median of the rounds."""
    return float(np.median(rounds))


def spread(rounds: np.ndarray) -> float:
    """Return half the range that contains 95 % of the rounds."""
    low, high = np.percentile(rounds, (2.5, 97.5))
    return float(0.5 * (high - low))


# key of a model's figures by the text of a row
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
    """Return our figures with their spread, and the paper's, on one stop from the same speed."""
    rows = []
    for text, key in QUANTITIES.items():
        cells = [_cell(result["models"][row.model], key) for row in ROWS]
        rows.append((text, *cells))
    return figures.table(
        f"Table 8: a stop of {result['simulated_s']:g} s, every model on its states, "
        "the coach in 3D on one core",
        ("", *(row.name for row in ROWS)),
        rows,
    )


def _cell(model: Result, key: str) -> str:
    """Return a figure with its spread, if it has one."""
    text = f"{model[key]:.3g}"
    if f"{key}_spread" in model:
        text += f" +- {model[f'{key}_spread']:.2g}"
    return text
