"""`rollerrig bench evidence`: what of the rig is verified, against what, and where that is valid.

The first table is measured now, on this machine: laws that every stop must obey.

[R1] Energy: the kinetic energy at the begin of a stop is what its brakes, its sliding contacts and
     its running resistance have taken, and what is left. All are integrated from the samples.
[R2] Repeatability: a stop that runs twice gives the same samples to the bit.
[R3] Step: with half the step of the physics, the stopping distance changes little. A stop on
     slippery rails is sensitive: the WSP decides in cycles, and a decision may move by a cycle.
[R4] Several stops at a time, as in campaigns, give the distances of single stops.

The second table lists the comparisons with references outside of this project. The tests of the
repository make them; a test checks that each of them exists. The layout is in the manner of CEN/TR
17833 (recollection, to be checked).
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
from rich.console import Group

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.rig.state import rigs_together
from rollerrig.wsp_interface import braking

DRY = "dry_stop"
SLIPPERY = "velim_a1"
# relative limits
ENERGY = 1e-4
STEP_DRY = 1e-5
STEP_SLIPPERY = 2e-3
SEVERAL_AT_A_TIME = 1e-7

NOT_A_CERTIFICATE = (
    "not a certificate: no authority has checked the rig, and no test on a real roller rig is part "
    "of it"
)


class Reference(NamedTuple):
    """A comparison that a test of the repository makes.

    subject: what is verified. against: the reference. deviation: the largest that the test allows.
    valid: where it holds. file, test: the test, below `tests/`.
    """

    subject: str
    against: str
    deviation: str
    valid: str
    file: str
    test: str


REFERENCES = (
    Reference(
        "size of the contact patch",
        "a table of Hertz's theory",
        "6e-8, relative",
        "smooth bodies of steel, one patch, no plasticity",
        "rig/contact/test_hertz.py",
        "test_the_patch_agrees_with_the_reference_table_to_its_printed_digits",
    ),
    Reference(
        "creep coefficients",
        "Kalker's table",
        "1e-13, relative",
        "patches of the table; beyond its ends by Kalker's asymptotes within 7 %",
        "rig/contact/test_kalker.py",
        "test_every_row_of_kalkers_table_is_met",
    ),
    Reference(
        "creep force, four models",
        "the half-space program CONTACT",
        "0.08 of the friction limit",
        "without spin, dry and with constant friction",
        "rig/contact/test_creep_force.py",
        "test_without_spin_each_model_stays_within_0_08_mu_N_of_contact",
    ),
    Reference(
        "creep force with spin, FASTSIM",
        "a half-space model that agrees with CONTACT",
        "0.075 of the friction limit",
        "with spin; other models deviate more",
        "rig/contact/test_other_patches.py",
        "test_with_spin_fastsim_stays_within_0_075_mu_N_of_the_half_space",
    ),
    Reference(
        "sliding and deceleration on soap",
        "the published test A1 at Velim",
        "mean sliding within 0.35 m/s of 5.00 m/s, its deviation within 0.35 m/s of 1.72 m/s",
        "one coach on soap and water from 152 km/h; mu_cd and the band of the WSP were fitted "
        "to this test, so it is not the scenario velim_a1",
        "realtime/test_velim.py",
        "test_the_six_stops_run_by_the_papers_law_and_adhesion_recovers_in_their_second_half",
    ),
    Reference(
        "samples of a campaign's stop",
        "the same stop alone",
        "1e-6",
        "reference unit or none; stops that do not fit run alone",
        "realtime/test_stops_in_lanes.py",
        "test_a_stop_among_others_is_the_stop_alone",
    ),
)

NOT_VERIFIED = (
    "not verified: thermal and wear models, sand, and most parameters of brake and air are "
    "recollections or assumptions; each says so at its key",
    "not verified: no measured record of a real WSP on a real rig is compared here; compare your "
    "own with 'rollerrig explain'",
    "timing is a property of the machine: 'rollerrig bench loop bus' measures it",
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure the laws of the first table."""
    say("a dry stop and a slippery stop, each three times ...")
    found: Result = {"references": [reference._asdict() for reference in REFERENCES]}
    targets = []
    for name, step_limit in ((DRY, STEP_DRY), (SLIPPERY, STEP_SLIPPERY)):
        measured = _measure(name)
        found[name] = measured
        targets += [
            target(f"{name}: energy that is missing [R1]", measured["energy"], ENERGY),
            target(f"{name}: samples that differ in a second run [R2]", measured["differ"], 0.0),
            target(
                f"{name}: change of distance at half the step [R3]", measured["step"], step_limit
            ),
            target(
                f"{name}: several stops at a time [R4]", measured["together"], SEVERAL_AT_A_TIME
            ),
        ]
    return found | {"targets": targets, "notes": [*NOT_VERIFIED, NOT_A_CERTIFICATE]}


def _measure(name: str) -> dict[str, float]:
    """Return the relative deviations of a scenario, and the number of samples that differ."""
    plan = scenario.load(name)
    rows = free.simulate(plan)
    again = free.simulate(plan)
    distance_m = _distance_m(free.channels(rows, plan.table))

    half = scenario.load(name, settings=(f"loop.step_s={0.5 * plan['loop']['step_s']!r}",))
    half_m = _distance_m(free.channels(free.simulate(half), half.table))

    jobs = [(place, plan) for place in range(rigs_together(plan.kind.axles))]
    together_m = [_distance_m(finished.channels) for finished in stops_in_lanes.together(jobs)]
    return {
        "distance_m": distance_m,
        "energy": abs(energy_missing(plan, free.channels(free.moving(rows), plan.table))),
        "differ": float(np.sum(~np.isclose(rows, again, rtol=0.0, atol=0.0, equal_nan=True))),
        "step": abs(half_m / distance_m - 1.0),
        "together": max(abs(other_m / distance_m - 1.0) for other_m in together_m),
    }


def _distance_m(channels: dict[str, np.ndarray]) -> float:
    """Return the stopping distance."""
    begin = braking.begin(channels["brake_demand_Pa"])
    end = braking.standstill(channels["vehicle_speed_m_s"])
    assert begin is not None, "the scenario brakes"
    assert end is not None, "the scenario stops"
    return float(channels["position_m"][end] - channels["position_m"][begin])


def energy_missing(plan: scenario.Scenario, channels: dict[str, np.ndarray]) -> float:
    """Return the share of the kinetic energy at the begin that no loss accounts for [R1]."""
    vehicle = plan["vehicle"]
    time_s = channels["time_s"]
    speed_m_s = channels["vehicle_speed_m_s"]
    rotation_rad_s = []
    for axle in range(1, plan.kind.axles + 1):
        rim_m_s = channels[f"wheel_circumferential_speed_{axle}_m_s"]
        rotation_rad_s.append(rim_m_s / vehicle["wheel_radius_m"])

    kinetic_J = 0.5 * vehicle["mass_kg"] * speed_m_s**2
    for rotation in rotation_rad_s:
        kinetic_J = kinetic_J + 0.5 * vehicle["wheelset_inertia_kgm2"] * rotation**2

    resistance_N = (
        vehicle["resistance_A_N"]
        + vehicle["resistance_B_N_s_m"] * speed_m_s
        + vehicle["resistance_C_N_s2_m2"] * speed_m_s**2
    )
    lost_J = _integral(resistance_N * speed_m_s, time_s)
    for axle, rotation in enumerate(rotation_rad_s, start=1):
        lost_J += _integral(channels[f"brake_torque_{axle}_Nm"] * rotation, time_s)
        sliding_work_J = channels[f"sliding_work_{axle}_J"]
        lost_J += float(sliding_work_J[-1] - sliding_work_J[0])
    return float((kinetic_J[0] - kinetic_J[-1] - lost_J) / kinetic_J[0])


def _integral(values: np.ndarray, time_s: np.ndarray) -> float:
    """Return the integral over time by the trapezoidal rule."""
    return float(np.sum(0.5 * (values[1:] + values[:-1]) * np.diff(time_s)))


def table(result: Result) -> Any:
    """Return the two tables: measured now, and verified by tests."""
    measured = figures.table(
        "measured now, relative",
        ("stop", "distance, m", "energy [R1]", "half step [R3]", "several at a time [R4]"),
        [
            (name, *(result[name][key] for key in ("distance_m", "energy", "step", "together")))
            for name in (DRY, SLIPPERY)
        ],
    )
    verified = figures.table(
        "verified by tests of the repository",
        ("what", "against", "deviation allowed", "valid", "test"),
        [
            (row["subject"], row["against"], row["deviation"], row["valid"], row["test"])
            for row in result["references"]
        ],
    )
    return Group(measured, verified)
