"""Momentum and energy are balanced over whole runs, for every rig and both vehicle models.

The vehicle brakes with the WSP, or without it until the wheels lock. The balances use only the
recorded channels.
"""

import itertools

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario

RIGS = {
    "rollers": ("rig=full_scale",),
    "small_rollers": ("rig=full_scale", "contact.roller_radius_m=0.5"),
    "virtual_track": ("rig=virtual_track",),
    "track": ("rig=plain_track",),
}
# settings of a run, by the unit that protects it
UNITS = {
    "reference": ("adhesion=soap",),
    # here every wheelset locks within 3 s
    "none": ("adhesion=leaf_film", "initial_speed_m_s=12"),
}
# a reference unit that never acts, because every speed is below its cut-off speed
IDLE = logic.load()._replace(cut_off_m_s=np.inf)
WITHIN = 1e-3  # relative difference of two balances


class Record:
    """A run's recorded channels and its scenario; `axles(name)` is an array of (samples, axles).

    `wheel_rad_s` are the speeds of the wheelsets that the vehicle has. On a virtual track the
    recorded wheel speeds are those of the real wheelsets, which follow these.
    """

    def __init__(self, unit, settings):
        self.unit = unit
        self.plan = scenario.load("velim_a1", settings=settings)
        # a run without a unit has other kernels, which take long to compile for the coach in 3D
        protects = IDLE if unit == "none" else unit
        self.columns = free.channels(free.simulate(self.plan, protects), self.plan.table)
        self.time_s = self.columns["time_s"]
        self.speed_m_s = self.columns["vehicle_speed_m_s"]
        vehicle = self.plan["vehicle"]
        self.resistance_N = (
            vehicle["resistance_A_N"]
            + vehicle["resistance_B_N_s_m"] * self.speed_m_s
            + vehicle["resistance_C_N_s2_m2"] * self.speed_m_s**2
        )
        self.contact_N = self.axles("adhesion") * self.axles("wheel_load", "N")
        self.wheel_rad_s = self.axles("wheel_speed", "rad_s")
        if self.plan["rig"]["mode"] == "virtual_track":
            rim_m_s = self.speed_m_s[:, np.newaxis] - self.axles("sliding", "m_s")
            self.wheel_rad_s = rim_m_s / vehicle["wheel_radius_m"]

    def axles(self, name, unit=""):
        suffix = f"_{unit}" if unit else ""
        columns = []
        for axle in range(1, COACH.axles + 1):
            columns.append(self.columns[f"{name}_{axle}{suffix}"])
        return np.column_stack(columns)

    def integral(self, values):
        """The integral over the run of (samples,), or of the sum over the axles of (samples,
        axles).
        """
        total = values.sum(axis=1) if values.ndim == 2 else values
        return np.trapezoid(total, self.time_s)


@pytest.fixture(
    scope="module", params=itertools.product(RIGS, ("planar", "multibody"), UNITS), ids="-".join
)
def record(request):
    rig, model, unit = request.param
    settings = (
        *RIGS[rig],
        *UNITS[unit],
        f"vehicle.model={model}",
        "duration_max_s=4",
        "loop.record_hz=1000",
    )
    return Record(unit, settings)


def test_only_without_wsp_the_wheels_lock(record):
    locked = record.wheel_rad_s[-1] < 0.1
    assert locked.all() if record.unit == "none" else not locked.any()


def test_the_vehicle_loses_the_momentum_and_energy_that_contacts_and_air_resistance_take(record):
    mass_kg = record.plan["vehicle"]["mass_kg"]
    speed_m_s = record.speed_m_s
    force_N = record.contact_N.sum(axis=1) + record.resistance_N

    momentum_kg_m_s = mass_kg * speed_m_s
    energy_J = 0.5 * mass_kg * speed_m_s**2
    assert momentum_kg_m_s[0] > momentum_kg_m_s[-1] + 1000.0
    assert record.integral(force_N) == pytest.approx(
        momentum_kg_m_s[0] - momentum_kg_m_s[-1], rel=WITHIN
    )
    assert record.integral(force_N * speed_m_s) == pytest.approx(
        energy_J[0] - energy_J[-1], rel=WITHIN
    )


def test_brake_and_contact_change_the_angular_momentum_of_each_wheelset(record):
    vehicle = record.plan["vehicle"]
    contact_Nm = vehicle["wheel_radius_m"] * record.contact_N
    angular_Nms = vehicle["wheelset_inertia_kgm2"] * record.wheel_rad_s
    for axle in range(COACH.axles):
        driven_Nms = record.integral(contact_Nm[:, axle])
        braked_Nms = record.integral(record.axles("brake_torque", "Nm")[:, axle])
        assert braked_Nms > 1000.0
        gained_Nms = angular_Nms[-1, axle] - angular_Nms[0, axle]
        assert driven_Nms - gained_Nms == pytest.approx(braked_Nms, rel=WITHIN)


def test_motor_and_brake_change_the_momentum_of_each_wheelset_with_its_roller(record):
    """The momenta are those at the contact, whose force acts on both.

    On a virtual track this holds until the wheelset locks: the recorded brake torque is that of the
    vehicle, and a locked wheelset takes no more of it than its contact gives.
    """
    roller_rad_s = record.axles("roller_speed", "rad_s")
    if record.plan["rig"]["mode"] == "track":
        assert not roller_rad_s.any()
        return
    drive = record.plan["drive"]
    vehicle = record.plan["vehicle"]
    wheel_radius_m = vehicle["wheel_radius_m"]
    roller_radius_m = record.plan["contact"]["roller_radius_m"]
    roller_kg_m_s = drive["roller_inertia_kgm2"] / roller_radius_m * roller_rad_s
    wheel_rad_s = record.axles("wheel_speed", "rad_s")
    wheel_kg_m_s = vehicle["wheelset_inertia_kgm2"] / wheel_radius_m * wheel_rad_s
    motor_N = record.axles("motor_torque", "Nm") / roller_radius_m
    brake_N = record.axles("brake_torque", "Nm") / wheel_radius_m
    for axle in range(COACH.axles):
        locks = np.append(np.flatnonzero(record.wheel_rad_s[:, axle] <= 0.0), len(record.time_s))[0]
        turns = slice(0, locks)
        time_s = record.time_s[turns]
        braked_kg_m_s = np.trapezoid(brake_N[turns, axle], time_s)
        driven_kg_m_s = np.trapezoid(motor_N[turns, axle], time_s)
        momentum_kg_m_s = (roller_kg_m_s + wheel_kg_m_s)[turns, axle]
        gained_kg_m_s = momentum_kg_m_s[-1] - momentum_kg_m_s[0]
        assert braked_kg_m_s > 1000.0
        assert driven_kg_m_s - gained_kg_m_s == pytest.approx(braked_kg_m_s, rel=WITHIN)


def test_brakes_and_contacts_take_the_energy_that_is_lost_or_comes_from_the_motors(record):
    """On rollers, wheelsets and rollers are a closed machine with motors.

    On a track and on a virtual track, the vehicle drives the wheelsets.
    """
    vehicle = record.plan["vehicle"]
    drive = record.plan["drive"]
    wheel = record.wheel_rad_s
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
