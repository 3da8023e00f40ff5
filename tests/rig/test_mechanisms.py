"""Every row of the tables of mechanisms and causes: plant, replay and derivative agree."""

import math
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from rolling import FILL, SOAP, TRACK, VENT, Rig

from rollerrig.configs.vehicle import COACH_AXLES
from rollerrig.rig import brake, params, vehicle
from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import preparation
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.replay import sensitivity
from rollerrig.rig.mechanisms.mechanism import CONTACT, FRICTION, LOAD, VEHICLE
from rollerrig.rig.mechanisms.table import BY_NAME, IN_PLANT

SPEED_M_S = 30.0
DURATION_S = 6.0
STEP_S = 0.01  # of the recorded samples
# brakes fill and vent alternately, so that wheels slide and recover
FILLS_MS = 1300
VENTS_MS = 600
DEMAND_PA = 3.8e5
# windows of the causes that act only in a part of the stop; `table` searches these windows
WINDOWS = {
    "contaminated_patch": {"start_m": 40.0, "length_m": 60.0},
    "sanding": {"start_s": 2.0, "duration_s": 2.0},
}
# Smallest correlation and largest difference of causes that agree less well: the plant uses a lag
# for the way between wheels, and its released brake gives no torque, whatever the offset of the
# sensor is.
ROUGHLY = {"rail_cleaning": (0.7, 0.3), "torque_offset": (0.85, 0.25)}
# sizes of causes: that of the step of the derivative, or else a share of the upper bound
SIZE = {"adhesion_memory": 2.0}
SHARE = 1e-3
ACCURACY = {
    "speed_m_s": 0.01,
    "wheel_speed_rad_s": 0.02,
    "torque_fraction": 0.005,
    "load_fraction": 0.01,
    "calibration_fraction": 0.003,
    "form_fraction": 0.0,
}


class Case(NamedTuple):
    """A row of the table of causes with one of its shapes, on one axle or on all (0)."""

    row: table.Search
    shape: table.Shape
    axle: int

    def __str__(self):
        return f"{self.row.name}-{self.shape}-{self.axle}"


def shapes_of(row: table.Search) -> tuple[table.Shape, ...]:
    """Return the shapes of a row; a row without shapes gets its window."""
    if row.shapes:
        return row.shapes
    window = WINDOWS[row.name]
    return (window, window | table.CONTAMINANT_ALONE)


CASES = []
for _row in table.TABLE:
    if _row.name == "empirical":
        continue
    for _shape in shapes_of(_row):
        # all axles, or all and the first one
        for _axle in _row.places(COACH_AXLES)[:2]:
            CASES.append(Case(_row, _shape, _axle))
IN_PLANT_CASES = [case for case in CASES if case.row.mechanism in IN_PLANT]


def cases_on(*places: str) -> list[Case]:
    """Return the cases in the plant whose mechanism acts on one of these places."""
    return [case for case in IN_PLANT_CASES if case.row.mechanism.acts_on in places]


def each_case(cases: list[Case]):
    return pytest.mark.parametrize("case", cases, ids=str)


def size_of(row: table.Search) -> float:
    return SIZE.get(row.name, SHARE * row.mechanism.parameters[0].high)


@cache
def plain_vehicle():
    return Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK).params.vehicle


def recorded(**mechanisms: float) -> preparation.Design:
    """Return a stop on soap of a plant with these mechanisms, measured by sensors without noise."""
    rig = Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK, mechanisms=mechanisms)
    cycle = np.repeat([FILL, VENT], [FILLS_MS, VENTS_MS])
    ticks = round(DURATION_S / rig.params.tick_s)
    magnets = np.resize(cycle, ticks)[:, None]
    history = rig.roll(DURATION_S, magnets, DEMAND_PA)
    every = round(STEP_S / rig.params.tick_s)
    base_model = params.check(
        {"adhesion": SOAP, "rig": TRACK, "contact": {"roller_radius_m": math.inf}}, "a test"
    )

    # the recorded torque and load are those of the base model
    constants = rig.params.brake
    capacity = np.vectorize(
        lambda pressure_Pa: brake.torque_at(
            pressure_Pa, constants.torque_Nm_Pa[0], constants.spring_pressure_Pa
        )
    )
    torque_Nm = capacity(history.cylinder_pressure[::every])
    felt_m_s2 = history.felt_acceleration[::every]
    load_N = np.empty((felt_m_s2.size, 4))
    for i, felt in enumerate(felt_m_s2):
        for j in range(4):
            load_N[i, j] = vehicle.load(j, felt, plain_vehicle())

    run = Run(
        name="stop",
        group="tune",
        mass_kg=base_model["vehicle"]["mass_kg"],
        mu_cd=None,
        time_s=history.time[::every],
        speed_m_s=history.vehicle_speed[::every],
        wheel_speed_rad_s=history.wheel_speed[::every],
        load_N=load_N,
        torque_Nm=torque_Nm,
        position_m=None,
        surface_m_s=None,
    )
    data = Dataset(
        name="test",
        kind="braking_runs",
        folder=Path(),
        sample_time_s=STEP_S,
        sections=base_model,
        accuracy=ACCURACY,
        axle_position_m=rig.params.axle_position_m,
        runs=[run],
        curve=None,
        warnings=[],
    )
    return preparation.prepare(data, [run])


@pytest.fixture(scope="module")
def plain() -> preparation.Design:
    return recorded()


def whitened(design: preparation.Design, acts_on: str, *causes: Cause) -> np.ndarray:
    """Return innovations over their deviations, shape (n,).

    They are those of the vehicle for a mechanism that acts on it, else those of the wheels.
    """
    nu, variance, _, vehicle_nu, vehicle_variance = innovations(design, *causes)
    if acts_on == VEHICLE:
        return vehicle_nu / np.sqrt(vehicle_variance)
    return nu / np.sqrt(variance)


def innovations(design: preparation.Design, *causes: Cause) -> tuple[np.ndarray, ...]:
    """Return what `sensitivity.innovations` returns for a replay with these causes."""
    explanation = candidates.untuned(design)._replace(causes=causes)
    return sensitivity.innovations(design, candidates.inputs(design, explanation))


def cause_of(case: Case, size: float) -> Cause:
    """Return the cause of a case, of this size."""
    row = case.row
    shape_of_stop = {}
    for key, value in case.shape.items():
        # the window of sanding belongs to one stop
        is_window = row.name == "sanding" and key in WINDOWS["sanding"]
        name = f"{key} stop" if is_window else key
        shape_of_stop[name] = value
    has_second_value = row.phase or row.mechanism.free == 2
    values = (size, 0.0) if has_second_value else (size,)
    return Cause(row.name, case.axle, shape_of_stop, values)


def mechanisms_of(case: Case, size: float) -> dict[str, float]:
    """Return the section [mechanisms] of a plant with the cause of a case."""
    row = case.row
    mechanisms = {row.mechanism.coefficients[0]: size}
    for key, value in case.shape.items():
        mechanisms[f"{row.name}_{key}"] = value
    if case.axle:
        mechanisms[f"{row.name}_axle"] = float(case.axle)
    return mechanisms


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    return np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b)


def regression(a: np.ndarray, b: np.ndarray) -> float:
    """Return the factor of b that is closest to a."""
    return np.dot(a, b) / np.dot(b, b)


@each_case(IN_PLANT_CASES)
def test_the_replay_removes_the_effect_of_a_small_cause_in_the_plant(plain, case) -> None:
    size = size_of(case.row)
    design = recorded(**mechanisms_of(case, size))

    acts_on = case.row.mechanism.acts_on
    with_effect = whitened(design, acts_on)
    effect = with_effect - whitened(plain, acts_on)
    removed = with_effect - whitened(design, acts_on, cause_of(case, size))
    least_correlation, largest_difference = ROUGHLY.get(case.row.name, (0.9, 0.2))
    assert correlation(effect, removed) > least_correlation
    assert regression(effect, removed) == pytest.approx(1.0, abs=largest_difference)


@each_case([case for case in IN_PLANT_CASES if case.row.mechanism.acts_on != VEHICLE])
def test_the_linearised_response_is_the_derivative_of_the_replay(plain, case) -> None:
    size = case.row.finite_step or 0.1 * size_of(case.row)
    cause = cause_of(case, size)
    change = (whitened(plain, "wheels", cause) - whitened(plain, "wheels")) / size

    absent = cause._replace(values=(0.0,) * len(cause.values))
    explanation = candidates.untuned(plain)._replace(causes=(absent,))
    normal, _, responses = fitting.normal_equations(plain, explanation)
    column = next(
        variant.columns[0]
        for variant in normal.matrix.variants
        if (variant.cause, variant.axle, variant.shape) == (cause.name, cause.axle, cause.shape)
    )
    response = fitting.wheel_responses(plain, responses, [column])[:, 0]
    assert correlation(change, response) > 0.95
    assert regression(change, response) == pytest.approx(1.0, abs=0.1)


@each_case(CASES)
def test_a_cause_of_size_zero_changes_no_bit_of_the_replay(plain, case) -> None:
    without_cause = innovations(plain)
    with_cause = innovations(plain, cause_of(case, 0.0))
    for values, expected in zip(with_cause, without_cause, strict=True):
        assert np.array_equal(values, expected)


@each_case(cases_on(FRICTION, CONTACT, LOAD))
def test_causes_of_contact_and_load_act_only_on_the_wheels(plain, case) -> None:
    with_cause = whitened(plain, VEHICLE, cause_of(case, size_of(case.row)))
    assert np.array_equal(with_cause, whitened(plain, VEHICLE))


@each_case(cases_on(VEHICLE))
def test_causes_of_the_vehicle_act_only_on_the_vehicle(plain, case) -> None:
    with_cause = whitened(plain, "wheels", cause_of(case, size_of(case.row)))
    assert np.array_equal(with_cause, whitened(plain, "wheels"))


def test_the_inertia_of_the_wheelsets_also_counts_in_the_balance_of_the_vehicle(plain) -> None:
    heavy = recorded(wheel_inertia_fraction=0.3)
    cause = Cause("wheel_inertia", 0, {}, (0.3,))
    wrong = np.sum(whitened(heavy, VEHICLE) ** 2)
    right = np.sum(whitened(heavy, VEHICLE, cause) ** 2)
    assert right < 0.5 * wrong
    assert right == pytest.approx(np.sum(whitened(plain, VEHICLE) ** 2), rel=0.3)


def test_a_late_wheel_speed_does_not_delay_the_torque_that_slows_the_vehicle(plain) -> None:
    late = whitened(plain, VEHICLE, Cause("speed_sensor_delay", 0, {}, (0.02,)))
    np.testing.assert_allclose(late, whitened(plain, VEHICLE), atol=1e-6)


def test_every_mechanism_has_its_row_in_the_search() -> None:
    assert {row.name for row in table.TABLE} == set(BY_NAME)


def test_wet_pads_dry_with_the_turns_under_the_brake() -> None:
    wet_pads = {"wet_pads_loss": 0.3, "wet_pads_turns": 8.0}
    dry = Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK).roll(3.0, demand_Pa=1e5)
    wet = Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK, mechanisms=wet_pads).roll(3.0, demand_Pa=1e5)
    on = dry.brake_torque[:, 0] > 0.0
    turns = wet.braked_angle[on, 0] / (2.0 * math.pi)
    assert turns[-1] > 20.0
    share = wet.brake_torque[on, 0] / dry.brake_torque[on, 0]
    np.testing.assert_allclose(share, 1.0 - 0.3 * np.exp(-turns / 8.0), rtol=1e-3)
