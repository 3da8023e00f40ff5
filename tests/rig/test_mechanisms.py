"""Every row of the tables of mechanisms and causes: plant, replay and derivative agree."""

import math
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rolling import FILL, SOAP, TRACK, VENT, Rig

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
ROUGHLY = {"rail_cleaning": (0.75, 0.3), "torque_offset": (0.85, 0.25)}
# sizes of causes: the step of its derivative, for the others a share of the upper bound
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
CAUSES = [
    (row, shape, axle)
    for row in table.TABLE
    if row.name != "empirical"
    for shape in (row.shapes or (WINDOWS[row.name], WINDOWS[row.name] | table.CONTAMINANT_ALONE))
    for axle in row.axles[:2]
]
ROWS = [cause for cause in CAUSES if cause[0].mechanism in IN_PLANT]


def name(value) -> str:
    return value.name if isinstance(value, table.Search) else str(value)


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
    plain = params.check(
        {"adhesion": SOAP, "rig": TRACK, "contact": {"roller_radius_m": math.inf}}, "a test"
    )
    # the recorded torque and load are those of the base model
    capacity = np.vectorize(lambda pressure_Pa: brake.capacity(pressure_Pa, rig.params.brake))
    torque_Nm = capacity(history.cylinder_pressure[::every])
    load_N = np.empty((history.time.size, 4))
    for i, felt in enumerate(history.felt_acceleration):
        for j in range(4):
            load_N[i, j] = vehicle.load(j, felt, plain_vehicle())
    run = Run(
        "stop",
        "tune",
        plain["vehicle"]["mass_kg"],
        None,
        history.time[::every],
        history.vehicle_speed[::every],
        history.wheel_speed[::every],
        load_N[::every],
        torque_Nm,
        None,
        None,
    )
    data = Dataset(
        "test",
        "braking_runs",
        Path(),
        STEP_S,
        plain,
        ACCURACY,
        rig.params.axle_position_m,
        [run],
        None,
        [],
    )
    return preparation.prepare(data, [run])


@pytest.fixture(scope="module")
def plain() -> preparation.Design:
    return recorded()


def whitened(design: preparation.Design, acts_on: str, *causes: Cause) -> np.ndarray:
    """Return innovations over their deviations, shape (n,).

    They are those of the vehicle for a mechanism that acts on it, else those of the wheels.
    """
    explanation = candidates.untuned(design)._replace(causes=causes)
    nu, S, _, vehicle_nu, vehicle_S = sensitivity.innovations(
        design, candidates.inputs(design, explanation)
    )
    if acts_on == VEHICLE:
        return vehicle_nu / np.sqrt(vehicle_S)
    return nu / np.sqrt(S)


def cause_of(row: table.Search, shape: table.Shape, axle: int, size: float) -> Cause:
    shape_of_stop = {}
    for key, value in shape.items():
        # the window of sanding belongs to one stop
        is_window = row.name == "sanding" and key in WINDOWS["sanding"]
        shape_of_stop[f"{key} stop" if is_window else key] = value
    has_second_value = row.phase or row.mechanism.free == 2
    values = (size, 0.0) if has_second_value else (size,)
    return Cause(row.name, axle, shape_of_stop, values)


@pytest.mark.parametrize(("row", "shape", "axle"), ROWS, ids=name)
def test_the_replay_removes_the_effect_of_a_small_cause_in_the_plant(
    plain, row, shape, axle
) -> None:
    size = size_of(row)
    mechanisms = {row.mechanism.coefficients[0]: size}
    for key, value in shape.items():
        mechanisms[f"{row.name}_{key}"] = value
    if axle:
        mechanisms[f"{row.name}_axle"] = float(axle)
    design = recorded(**mechanisms)

    acts_on = row.mechanism.acts_on
    with_cause = whitened(design, acts_on)
    effect = with_cause - whitened(plain, acts_on)
    removed = with_cause - whitened(design, acts_on, cause_of(row, shape, axle, size))
    least_correlation, most_apart = ROUGHLY.get(row.name, (0.9, 0.2))
    correlation = np.dot(effect, removed) / np.linalg.norm(effect) / np.linalg.norm(removed)
    assert correlation > least_correlation
    assert np.dot(effect, removed) / np.dot(removed, removed) == pytest.approx(1.0, abs=most_apart)


@pytest.mark.parametrize(
    ("row", "shape", "axle"), [c for c in ROWS if c[0].mechanism.acts_on != VEHICLE], ids=name
)
def test_the_linearised_response_is_the_derivative_of_the_replay(plain, row, shape, axle) -> None:
    size = row.finite_step or 0.1 * size_of(row)
    cause = cause_of(row, shape, axle, size)
    found, _, responses = fitting.normal_equations(
        plain,
        candidates.untuned(plain)._replace(
            causes=(cause._replace(values=tuple(0.0 for _ in cause.values)),)
        ),
    )
    column = next(
        v.columns[0]
        for v in found.matrix.variants
        if (v.cause, v.axle, v.shape) == (cause.name, cause.axle, cause.shape)
    )
    change = (whitened(plain, "wheels", cause) - whitened(plain, "wheels")) / size
    answer = fitting.wheel_responses(plain, responses, [column])[:, 0]
    assert np.dot(change, answer) / np.linalg.norm(change) / np.linalg.norm(answer) > 0.95
    assert np.dot(change, answer) / np.dot(answer, answer) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(("row", "shape", "axle"), CAUSES, ids=name)
def test_a_cause_of_size_zero_changes_no_bit_of_the_replay(plain, row, shape, axle) -> None:
    explanation = candidates.untuned(plain)
    with_it = explanation._replace(causes=(cause_of(row, shape, axle, 0.0),))
    found = [
        sensitivity.innovations(plain, candidates.inputs(plain, one))
        for one in (explanation, with_it)
    ]
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize(
    ("row", "shape", "axle"),
    [c for c in ROWS if c[0].mechanism.acts_on in (FRICTION, CONTACT, LOAD, VEHICLE)],
    ids=name,
)
def test_causes_of_contact_and_load_act_only_on_the_wheels_and_causes_of_the_vehicle_only_on_it(
    plain, row, shape, axle
) -> None:
    other = "wheels" if row.mechanism.acts_on == VEHICLE else VEHICLE
    with_it = whitened(plain, other, cause_of(row, shape, axle, size_of(row)))
    assert np.array_equal(with_it, whitened(plain, other))


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
