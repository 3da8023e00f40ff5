"""Table 8 of the paper today: what four contact models cost in the stop A1, by the coach in 3D.

The coach brakes on a track from 42.3 m/s at 1e-4 s for half a minute, each wheelset held in sliding by a
brake that is released and applied between two slidings, with each tangential model in turn. Contact is
contact points, normal and tangential problem of eight wheels; its time is what the stop takes longer
when all of it is done twice in every step. Vehicle is the rest.

Source: Meli, Ridolfi, Rindi, Meccanica 49 (2014), Table 8 (seconds for A1, fixed step 1e-4 s).
"""

import time
from typing import NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench import scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, Target
from rollerrig.rig import params
from rollerrig.rig.contact.creep_force import MODELS
from rollerrig.rig.kernel import kernel
from rollerrig.rig.multibody import coach as coaches
from rollerrig.rig.multibody import coach_state, motion, stop, wheel_rail_forces

SPEED_M_S, STEP_S, DURATION_S = 42.3, 1e-4, 30.0
# sliding between which the brake of a wheelset is modulated, its torque and its lag
_LEAST_M_S, _MOST_M_S, _BRAKE_NM, _LAG_S = 4.0, 6.0, 6000.0, 0.2
_RESISTANCE = (600.0, 0.9375)
_REPEATS = 3
REAL_TIME, WHOLE_PERCENT = 15.0, 3.0


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


@kernel
def _modulate(state, speed_m_s, brake_Nm, target_Nm):
    """Release the brake of a wheelset that slides much, apply that of one that slides little."""
    for j in range(4):
        sliding = speed_m_s + state.contacts[2 * j * wheel_rail_forces.MOST, 4] * state.v[22 + 6 * j]
        if sliding > _MOST_M_S:
            target_Nm[j] = 0.0
        elif sliding < _LEAST_M_S:
            target_Nm[j] = _BRAKE_NM
        brake_Nm[j] += (target_Nm[j] - brake_Nm[j]) * STEP_S / _LAG_S


@kernel
def _run(state, twin, twice, steps, coach, law, brake_Nm, target_Nm, acts_Nm, rest, mu_cd, mu_cr):
    """Brake for some steps; `twice`: with the contacts of the same motion found once more, in `twin`."""
    for _ in range(steps):
        speed = motion.mean_speed(state.v, coach)
        _modulate(state, speed, brake_Nm, target_Nm)
        if twice:
            for i in range(42):
                twin.q[i], twin.v[i] = state.q[i], state.v[i]
            spare = wheel_rail_forces.SEARCHES
            for j in range(4):
                spare = motion.contacts(j, twin, coach, 0.0, 0.0, 0.0, mu_cd[j], mu_cr[j], law, spare)
        motion.step(state, coach, STEP_S, rest, rest, 1.0, brake_Nm, acts_Nm,
                    _RESISTANCE[0] + _RESISTANCE[1] * speed * speed, mu_cd, mu_cr, law)


def _seconds(coach: coaches.Coach, law: params.Law, twice: bool, steps: int) -> tuple[float, float]:
    """Processor time in s of so many steps, and the speed in m/s at their end."""
    state = stop.rolling(coach, SPEED_M_S)
    twin = coach_state.views(np.zeros(coach_state.SIZE))
    motion.start(twin, coach, SPEED_M_S)
    brake, target, acts, rest = np.zeros(4), np.full(4, _BRAKE_NM), np.zeros(4), np.zeros(4)
    begun_s = time.thread_time()
    _run(state, twin, twice, steps, coach, law, brake, target, acts, rest, np.full(4, law.mu_cd),
         np.full(4, law.mu_cr))
    return time.thread_time() - begun_s, motion.mean_speed(state.v, coach)


def run(say: Say) -> Result:
    """Time all four models, taking turns, the best of some repeats of each."""
    sections = params.check(scenario.load("velim_a1", settings=("rig=plain_track",)).resolved, "velim_a1")
    # the paper's law, without a bound on cleaning
    law = params.Law(**sections["adhesion"] | {"cleaning_creepage": np.inf})
    steps = round(DURATION_S / STEP_S)
    ready = {row.model: coaches.build(sections, np.inf, MODELS[row.model], 10) for row in ROWS}
    for twice in (False, True):
        _seconds(ready["polach"], law, twice, 1)
    found: dict[str, dict[str, list[float]]] = {row.model: {"whole": [], "twice": []} for row in ROWS}
    speeds = {}
    for repeat in range(_REPEATS):
        for row in ROWS:
            if repeat and row.model == "fastsim":
                # alone it takes as long as all others together
                continue
            say(f"the coach for {DURATION_S:g} s, {row.name}, {repeat + 1} of {_REPEATS} ...")
            whole_s, speeds[row.model] = _seconds(ready[row.model], law, False, steps)
            found[row.model]["whole"].append(whole_s)
            found[row.model]["twice"].append(_seconds(ready[row.model], law, True, steps)[0])
    models = {}
    for row in ROWS:
        whole_s = min(found[row.model]["whole"])
        contact_s = min(found[row.model]["twice"]) - whole_s
        models[row.model] = {
            "whole_s": whole_s, "contact_s": contact_s, "vehicle_s": whole_s - contact_s,
            "real_time_factor": DURATION_S / whole_s, "step_us": 1e6 * whole_s / steps,
            "speed_at_the_end_m_s": speeds[row.model],
            "paper_whole_s": row.vehicle_s + row.contact_s, "paper_contact_s": row.contact_s,
            "paper_vehicle_s": row.vehicle_s}
    return _judged(models, steps)


def _judged(models: dict[str, Result], steps: int) -> Result:
    """Ratios to Polach, and what recovery costs."""
    polach, degraded = models["polach"], models["degraded"]
    for one in models.values():
        one["ratio"] = one["whole_s"] / polach["whole_s"]
        one["paper_ratio"] = one["paper_whole_s"] / polach["paper_whole_s"]
    more_s = degraded["whole_s"] - polach["whole_s"]
    percent = 100.0 * more_s / polach["whole_s"]
    return {
        "simulated_s": DURATION_S, "models": models, "recovery_percent_of_whole": percent,
        "recovery_us_a_contact": 1e6 * more_s / (8 * steps),
        "targets": [
            Target("degraded over Polach, of the whole", percent, WHOLE_PERCENT, "%").plain(),
            Target("real time over the whole with degraded adhesion", degraded["whole_s"] / DURATION_S,
                   1.0 / REAL_TIME, "").plain(),
        ],
        "notes": [f"recovery costs {1e6 * more_s / (8 * steps):.3f} us a contact in the coach, "
                  f"{100.0 * more_s / polach['contact_s']:.1f} % of the contact with Polach and "
                  f"{percent:.1f} % of the whole; the paper's: 1.6 % and 0.6 % of a whole that ran "
                  "about ten times slower than real time",
                  "a contact with Polach, contact points included, takes "
                  f"{1e6 * polach['contact_s'] / (8 * steps):.2f} us"],
    }


QUANTITIES = (
    ("vehicle, s", "vehicle_s"), ("contact, s", "contact_s"), ("whole, s", "whole_s"),
    ("whole over Polach's", "ratio"), ("times real time", "real_time_factor"), ("one step, us", "step_us"),
    ("paper: vehicle, s", "paper_vehicle_s"), ("paper: contact, s", "paper_contact_s"),
    ("paper: whole, s", "paper_whole_s"), ("paper: whole over Polach's", "paper_ratio"),
)


def table(result: Result) -> Table:
    """Ours, and the paper's below: ours for half a minute, the paper's for the whole stop."""
    rows = [(text, *(float(result["models"][row.model][key]) for row in ROWS)) for text, key in QUANTITIES]
    return figures.table(f"Table 8: {result['simulated_s']:g} s of A1, the coach in 3D on one core",
                         ("", *(row.name for row in ROWS)), rows)
