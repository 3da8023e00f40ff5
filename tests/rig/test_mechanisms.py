"""Every row of the tables of mechanisms and causes: plant, replay and its derivative mean the same by it."""

import math
from pathlib import Path

import numpy as np
import pytest
from rolling import SOAP, TRACK, Rig

from rollerrig.rig import brake, params
from rollerrig.rig.identify.causes import candidates, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import preparation
from rollerrig.rig.identify.data.runs import Dataset, Run
from rollerrig.rig.identify.decide import tuning
from rollerrig.rig.identify.filter import sensitivity
from rollerrig.rig.mechanisms.table import IN_PLANT

SPEED_M_S, LASTS_S, STEP_S = 20.0, 6.0, 0.01
# where a cause acts that is no formula of the whole stop; `table` searches these
WINDOWS = {"contaminated_patch": {"start_m": 30.0, "length_m": 40.0}, "sanding": {"start_s": 2.0, "duration_s": 2.0}}
SIZE = {"adhesion_memory": 2.0}  # the step of its derivative; of the others a thousandth of the upper bound
SHARE = 1e-3
ACCURACY = {"speed_m_s": 0.01, "wheel_speed_rad_s": 0.02, "torque_fraction": 0.005, "load_fraction": 0.01,
            "calibration_fraction": 0.003}
ROWS = [(row, shape, axle) for row in table.TABLE if row.mechanism in IN_PLANT and row.name != "empirical"
        for shape in (row.shapes or (WINDOWS[row.name],)) for axle in row.axles[:2]]
NAMES = [f"{row.name} {' '.join(map(str, shape.values()))} {axle or ''}".strip() for row, shape, axle in ROWS]


def size_of(row: table.Search) -> float:
    return SIZE.get(row.name, SHARE * row.mechanism.parameters[0].high)


def recorded(**mechanisms: float) -> preparation.Design:
    """A stop on soap of a plant with these mechanisms, as sensors without noise would tell it."""
    rig = Rig(SPEED_M_S, adhesion=SOAP, rig=TRACK, mechanisms=mechanisms)
    seen = rig.roll(LASTS_S, demand_Pa=1.1e5)
    every = round(STEP_S / rig.params.tick_s)
    plain = params.check({"adhesion": SOAP, "rig": TRACK, "contact": {"roller_radius_m": math.inf}}, "a test")
    told_Nm = np.vectorize(lambda Pa: brake.capacity(Pa, rig.params.brake))(seen.cylinder_pressure[::every])
    load_N = seen.wheel_load
    run = Run("stop", "tune", plain["vehicle"]["mass_kg"], None, seen.time[::every], seen.vehicle_speed[::every],
              seen.wheel_speed[::every], load_N[::every], told_Nm, None, None)
    data = Dataset("test", "braking_runs", Path(), STEP_S, plain, ACCURACY, rig.params.axle_position_m, [run], None, [])
    return preparation.prepare(data, [run])


@pytest.fixture(scope="module")
def plain() -> preparation.Design:
    return recorded()


def whitened(design: preparation.Design, *causes: Cause) -> np.ndarray:
    """Innovations of wheels and vehicle over their deviations, shape (n + vehicle samples,)."""
    explanation = candidates.start(design)._replace(causes=causes)
    nu, S, _, vehicle_nu, vehicle_S = sensitivity.innovations(design, candidates.inputs(design, explanation))
    return np.concatenate([nu / np.sqrt(S), vehicle_nu / np.sqrt(vehicle_S)])


def cause_of(row: table.Search, shape: table.Shape, axle: int, size: float) -> Cause:
    own = {f"{key} stop" if row.name == "sanding" else key: value for key, value in shape.items()}
    return Cause(row.name, axle, own, (size,) + (0.0,) * (1 if row.phase or row.mechanism.free == 2 else 0))


@pytest.mark.parametrize(("row", "shape", "axle"), ROWS, ids=NAMES)
def test_the_replay_takes_back_what_a_small_cause_did_in_the_plant(plain, row, shape, axle) -> None:
    size = size_of(row)
    keys = {row.mechanism.coefficients[0]: size, **{f"{row.name}_{key}": value for key, value in shape.items()}}
    if axle:
        keys[f"{row.name}_axle"] = float(axle)
    design = recorded(**keys)
    did = whitened(design) - whitened(plain)
    undone = whitened(design) - whitened(design, cause_of(row, shape, axle, size))
    print("SIZES", row.name, shape, axle, np.linalg.norm(did), np.linalg.norm(undone), np.dot(did, undone))
    assert np.linalg.norm(did) > 0.0
    assert np.dot(did, undone) / np.linalg.norm(did) / np.linalg.norm(undone) > 0.9
    assert np.dot(did, undone) / np.dot(undone, undone) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(("row", "shape", "axle"), ROWS, ids=NAMES)
def test_the_linearised_answer_is_the_derivative_of_the_replay(plain, row, shape, axle) -> None:
    size = 0.1 * size_of(row) if row.name != "adhesion_memory" else tuning.MEMORY_STEP_M
    cause = cause_of(row, shape, axle, size)
    found, linear, _, Z = tuning.normal(plain, candidates.start(plain)._replace(causes=(cause._replace(
        values=tuple(0.0 for _ in cause.values)),)))
    column = next(v.columns[0] for v in found.matrix.variants
                  if (v.cause, v.axle, v.shape) == (cause.name, cause.axle, cause.shape))
    n = linear.nu.size
    change = (whitened(plain, cause) - whitened(plain))[:n] / size
    answer = Z[:, column].astype(float)
    if np.linalg.norm(answer) == 0.0:
        return  # a cause of the vehicle alone
    assert np.dot(change, answer) / np.linalg.norm(change) / np.linalg.norm(answer) > 0.98
    assert np.dot(change, answer) / np.dot(answer, answer) == pytest.approx(1.0, abs=0.06)
