"""Momentum and energy are balanced over whole runs, for every rig and both vehicle models.

The balances use only the recorded channels.
"""

import itertools

import numpy as np
import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.record import channels
from rollerrig.wsp_interface.signals import AXLES

RIGS = {
    "rollers": ("rig=full_scale",),
    "small_rollers": ("rig=full_scale", "contact.roller_radius_m=0.5"),
    "virtual_track": ("rig=virtual_track",),
    "track": ("rig=plain_track",),
}
WITHIN = 1e-3  # relative difference of two balances


class Record:
    """A run's recorded channels and its scenario; `axles(name)` is an array of (samples, axles)."""

    def __init__(self, folder, settings):
        table = channels.load(folder)
        self.columns = {}
        for name in table.column_names:
            self.columns[name] = table[name].to_numpy()
        self.plan = scenario.load("velim_a1", settings=settings)
        self.time_s = self.columns["time_s"]
        self.speed_m_s = self.columns["vehicle_speed_m_s"]
        vehicle = self.plan["vehicle"]
        self.resistance_N = (
            vehicle["resistance_A_N"]
            + vehicle["resistance_B_N_s_m"] * self.speed_m_s
            + vehicle["resistance_C_N_s2_m2"] * self.speed_m_s**2
        )

    def axles(self, name, unit=""):
        suffix = f"_{unit}" if unit else ""
        columns = []
        for axle in range(1, AXLES + 1):
            columns.append(self.columns[f"{name}_{axle}{suffix}"])
        return np.column_stack(columns)

    def integral(self, values):
        """The integral over the run of (samples,), or of the sum over the axles of (samples,
        axles).
        """
        total = values.sum(axis=1) if values.ndim == 2 else values
        return np.trapezoid(total, self.time_s)


@pytest.fixture(
    scope="module", params=itertools.product(RIGS, ("planar", "multibody")), ids="-".join
)
def record(request, tmp_path_factory):
    rig, model = request.param
    settings = (*RIGS[rig], f"vehicle.model={model}", "duration_max_s=4", "loop.record_hz=1000")
    folder = tmp_path_factory.mktemp("laws") / f"{rig}_{model}"
    words = ["run", "velim_a1", "--pacing", "free", "--out", str(folder)]
    for setting in settings:
        words += ["--set", setting]
    cli.main(words)
    return Record(folder, settings)


def test_the_vehicle_loses_the_momentum_and_energy_that_contacts_and_air_resistance_take(record):
    mass_kg = record.plan["vehicle"]["mass_kg"]
    speed_m_s = record.speed_m_s
    contact_N = (record.axles("adhesion") * record.axles("wheel_load", "N")).sum(axis=1)
    force_N = contact_N + record.resistance_N

    momentum_kg_m_s = mass_kg * speed_m_s
    energy_J = 0.5 * mass_kg * speed_m_s**2
    assert momentum_kg_m_s[0] > momentum_kg_m_s[-1] + 1000.0
    assert record.integral(force_N) == pytest.approx(
        momentum_kg_m_s[0] - momentum_kg_m_s[-1], rel=WITHIN
    )
    assert record.integral(force_N * speed_m_s) == pytest.approx(
        energy_J[0] - energy_J[-1], rel=WITHIN
    )


def test_brakes_and_contacts_take_the_energy_that_is_lost_or_comes_from_the_motors(record):
    """On rollers, wheelsets and rollers are a closed machine with motors.

    On a track and on a virtual track, the vehicle drives the wheelsets.
    """
    vehicle = record.plan["vehicle"]
    drive = record.plan["drive"]
    wheel = record.axles("wheel_speed", "rad_s")
    roller = record.axles("roller_speed", "rad_s")

    kinetic_J = 0.5 * vehicle["wheelset_inertia_kgm2"] * (wheel**2).sum(axis=1)
    braked_J = record.integral(record.axles("brake_torque", "Nm") * wheel)
    slid_J = record.axles("sliding_work", "J")[-1].sum()
    taken_J = braked_J + slid_J
    if record.plan["rig"]["mode"] == "contaminated_rollers":
        kinetic_J = kinetic_J + 0.5 * drive["roller_inertia_kgm2"] * (roller**2).sum(axis=1)
        taken_J -= record.integral(record.axles("motor_torque", "Nm") * roller)
    else:
        kinetic_J = kinetic_J + 0.5 * vehicle["mass_kg"] * record.speed_m_s**2
        taken_J += record.integral(record.resistance_N * record.speed_m_s)
    assert taken_J == pytest.approx(kinetic_J[0] - kinetic_J[-1], rel=WITHIN)
