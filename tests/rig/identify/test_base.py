"""Each mistake of a user gets an answer that names it, and right data gets none."""

import shutil
import tomllib
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from generator import braking_stops, mistakes, mujoco_stops, other_stops
from generator.mistakes import LOADS, SPEED, TORQUES, WHEELS, Mistake

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.base import check, reference, sampling, sentences
from rollerrig.rig.identify.base.findings import Code, Finding
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.decide import decision, fitting, goodness

PACKAGED = store.ROOT / "datasets"

# the shortest stops of a packaged set without mistakes, with which each mistake shows
SHORT = ("a2", "a3", "b3")


@pytest.fixture(scope="module")
def stops(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set without mistakes."""
    packaged = PACKAGED / "open_none"
    folder = tmp_path_factory.mktemp("stops") / "set"
    (folder / "runs").mkdir(parents=True)
    text, *tables = (packaged / "dataset.toml").read_text().split("[[run]]")
    for table in tables:
        name = Path(tomllib.loads(table)["file"]).stem
        if name in SHORT:
            text += f"[[run]]{table}"
            shutil.copy(packaged / "runs" / f"{name}.csv", folder / "runs")
    (folder / "dataset.toml").write_text(text)
    return folder


class Case(NamedTuple):
    """A mistake, the code of its finding, and words that the sentence must have."""

    mistake: Mistake
    code: Code
    words: str


MISTAKES = {
    "all radii 1.5 % too large": Case(
        mistakes.of_vehicle("wheel_radius_m", 1.015), Code.RADIUS, "wheel_radius_m"
    ),
    "all radii 0.5 % too small": Case(
        mistakes.of_vehicle("wheel_radius_m", 0.995), Code.RADIUS, "0.5 % too slow"
    ),
    "one wheel speed 6 % too high": Case(
        mistakes.scaled(WHEELS[1:2], 1.06), Code.WHEEL_SPEED_SCALE, "wheel_speed_2_rad_s"
    ),
    "speed of the fastest wheel": Case(
        mistakes.speed_of_wheels(mistakes.fastest), Code.REFERENCE, "the fastest wheelset"
    ),
    "speed of the second fastest wheel": Case(
        mistakes.speed_of_wheels(mistakes.second_fastest), Code.REFERENCE, "second fastest"
    ),
    "mean speed of the wheels": Case(
        mistakes.speed_of_wheels(mistakes.mean), Code.REFERENCE, "the mean of all"
    ),
    "reference of a slide protection": Case(
        mistakes.speed_of_wheels(mistakes.slowly_falling), Code.INTERPOLATED, "slide protection"
    ),
    "mass 8 % too large": Case(mistakes.of_vehicle("mass_kg", 1.08), Code.MASS, "mass_kg"),
    "mass 8 % too small": Case(mistakes.of_vehicle("mass_kg", 0.92), Code.MASS, "mass_kg"),
    "loads 8 % too large": Case(mistakes.scaled(LOADS, 1.08), Code.LOADS, "wheel_load"),
    "wheel speeds 2 and 3 exchanged": Case(
        mistakes.exchanged(WHEELS, (0, 2, 1, 3)), Code.CHANNELS_EXCHANGED, "2 with 3"
    ),
    "wheel speeds of a bogie exchanged": Case(
        mistakes.exchanged(WHEELS, (1, 0, 2, 3)), Code.CHANNELS_EXCHANGED, "1 with 2"
    ),
    "torques 1 and 4 exchanged": Case(
        mistakes.exchanged(TORQUES, (3, 1, 2, 0)), Code.CHANNELS_EXCHANGED, "1 with 4"
    ),
    "one wheel speed written twice": Case(
        mistakes.in_columns(mistakes.one_wheel_twice),
        Code.CHANNELS_EQUAL,
        "wheel_speed_1_rad_s and wheel_speed_2_rad_s",
    ),
    "all channels from 20 to 100 Hz": Case(
        mistakes.interpolated(SPEED + WHEELS + LOADS + TORQUES, 5), Code.INTERPOLATED, "lower"
    ),
    "wheel speeds from 50 to 100 Hz": Case(
        mistakes.interpolated(WHEELS, 2), Code.INTERPOLATED, "wheel_speed_4_rad_s"
    ),
    "wheel speeds smoothed": Case(mistakes.low_passed(WHEELS, 4.0), Code.SMOOTHED, "[accuracy]"),
    "torques in lbf ft": Case(mistakes.scaled(TORQUES, 0.73756), Code.TORQUE_UNIT, "lbf ft"),
    "torques 35 % too large": Case(mistakes.scaled(TORQUES, 1.35), Code.TORQUE_SHARE, "1.35"),
    "speed in whole km/h": Case(
        mistakes.in_columns(mistakes.whole_kilometres_an_hour), Code.RESOLUTION, "0.278 m/s"
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_of_a_user_is_answered_by_its_name(
    stops: Path, tmp_path: Path, name: str
) -> None:
    case = MISTAKES[name]
    folder = mistakes.copy_with(case.mistake, stops, tmp_path / "set")
    with pytest.raises(check.WrongBaseError) as raised:
        check.check(dataset.load(folder))
    assert raised.value.findings[0].code is case.code
    assert case.words in str(raised.value)
    assert f"[{case.code}]" in str(raised.value)
    assert str(folder) in str(raised.value)


# mistakes that the reading of the data refuses
UNITS = {
    "torques in daN m": (mistakes.scaled(TORQUES, 0.1), "daN m"),
    "torques in kgf m": (mistakes.scaled(TORQUES, 1.0 / 9.80665), "kgf m"),
    "speed in km/h": (mistakes.scaled(SPEED, 3.6), "km/h: divide it by 3.6"),
    "speed in miles an hour": (mistakes.scaled(SPEED, 1.0 / 0.44704), "miles an hour"),
    "loads in kg, one wheelset far from the mean": (
        mistakes.scaled(LOADS, 1.0 / 9.80665),
        "in kg",
    ),
}


@pytest.mark.parametrize("name", UNITS)
def test_a_wrong_unit_is_refused_by_its_name_when_data_are_read(
    stops: Path, tmp_path: Path, name: str
) -> None:
    mistake, words = UNITS[name]
    folder = mistakes.copy_with(mistake, stops, tmp_path / "set")
    with pytest.raises(ConfigError, match=words):
        dataset.load(folder)


def test_a_clock_that_runs_fast_is_found_where_a_position_is_measured(tmp_path: Path) -> None:
    # this set of the second generator has a position
    right = other_stops.make(tmp_path / "right", {}, 700, ("a3",))
    assert check.findings(dataset.load(right)) == []
    folder = mistakes.copy_with(mistakes.stamped_too_fast(0.02), right, tmp_path / "fast")
    codes = [finding.code for finding in check.findings(dataset.load(folder))]
    assert codes == [Code.CLOCK]


@pytest.mark.parametrize(
    ("generator", "code"),
    [
        (braking_stops, Code.TORQUE_NOT_ACTING),
        pytest.param(mujoco_stops, Code.TORQUE_SHARE, marks=pytest.mark.nightly),
    ],
)
def test_a_commanded_torque_is_found_where_the_slide_protection_works(
    tmp_path: Path, generator, code: Code
) -> None:
    right = generator.make(tmp_path / "right", {}, 700)
    commanded = mistakes.in_columns(mistakes.commanded_torque)
    folder = mistakes.copy_with(commanded, right, tmp_path / "commanded")
    found = check.findings(dataset.load(folder))
    assert [finding.code for finding in found] == [code]
    assert "commanded torque" in sentences.sentence(found[0])


def test_axles_that_are_counted_from_the_rear_are_refused_unless_loads_are_the_cause(
    stops: Path, tmp_path: Path
) -> None:
    folder = mistakes.copy_with(
        mistakes.in_columns(mistakes.reversed_axles), stops, tmp_path / "set"
    )
    data = dataset.load(folder)
    with pytest.raises(check.WrongBaseError, match="counted from the rear"):
        check.check_order(data, causes=[])
    check.check_order(data, causes=["load_transfer"])
    check.check_order(dataset.load(stops), causes=[])


@pytest.mark.parametrize("name", ["open_none", "open_rail_cleaning", "velim_synthetic"])
def test_packaged_data_have_no_mistake(name: str) -> None:
    assert check.findings(dataset.load(name)) == []


# hidden effects that resemble a mistake, at twice their smallest sizes
EFFECTS = {
    "nothing": {},
    "a brake 8 % too strong": {"brake_gain": 0.08},
    "one worn wheelset": {"wheel_radius": 0.01},
    "load transfer": {"load_transfer": 0.024},
    "late wheel speeds": {"speed_sensor_delay": 0.01},
    "soft contact": {"interfacial_layer": 0.75},
}


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_of_physics_is_no_mistake(tmp_path: Path, name: str) -> None:
    folder = other_stops.make(tmp_path / "set", EFFECTS[name], 1807, ("a3",))
    assert check.findings(dataset.load(folder)) == []


@pytest.mark.nightly
@pytest.mark.parametrize("name", EFFECTS)
@pytest.mark.parametrize("generator", [braking_stops, other_stops, mujoco_stops])
def test_an_effect_of_physics_in_a_whole_set_is_no_mistake(
    tmp_path: Path, generator, name: str
) -> None:
    folder = generator.make(tmp_path / "set", EFFECTS[name], 1807)
    assert check.findings(dataset.load(folder)) == []


def test_white_noise_has_no_straight_lines_and_rounding_makes_none() -> None:
    noise = np.random.default_rng(3).normal(0.0, 0.07, 5000)
    assert sampling.share_on_lines(noise) < 0.05
    slowing = np.linspace(40.0, 10.0, 5000)
    assert sampling.share_on_lines(np.round(slowing + 0.1 * noise, 2)) < sampling.MOST_ON_LINES
    # a speed without noise, written with two digits
    assert sampling.share_on_lines(np.round(slowing, 2)) == 0.0


def test_an_independent_speed_equals_no_function_of_the_wheels(stops: Path) -> None:
    # rolling wheels and a vehicle, each with its noise
    noise = np.random.default_rng(5)
    speed_m_s = np.linspace(40.0, 20.0, 4000)
    rims_m_s = speed_m_s[:, None] + noise.normal(0.0, 0.03, (4000, 4))
    measured = dataset.load(stops).runs[0]
    run = measured._replace(
        speed_m_s=speed_m_s + noise.normal(0.0, 0.03, 4000),
        wheel_speed_rad_s=rims_m_s / 0.445,
    )
    shares = reference.shares_same(run, 0.445)
    assert len(shares) == 9
    assert max(shares.values()) < 0.5 * reference.MOST_SAME


@pytest.mark.parametrize("code", Code)
def test_every_finding_has_a_sentence_with_its_code(code: Code) -> None:
    finding = Finding(
        code,
        measured=1.5,
        allowed=0.1,
        runs=("a1", "a2"),
        channels=("wheel_speed_1_rad_s", "wheel_speed_2_rad_s"),
        axles=(1, 2),
        detail="detail",
    )
    text = sentences.sentence(finding)
    assert text.endswith(f"[{code}]")
    assert "\n" not in text


# --- numbers that are not finite, and a poor fit ---


def test_scores_that_are_not_finite_are_refused_and_never_consistent(
    stops: Path, tmp_path: Path
) -> None:
    folder = mistakes.copy_with(
        mistakes.of_vehicle("wheel_radius_m", 1.015), stops, tmp_path / "set"
    )
    data = dataset.load(folder)
    with pytest.raises(check.WrongBaseError):
        decision.explain_braking_runs(data, 0, lambda *_: None)

    design = prepare(data, data.group("tune"))
    normal, *_ = fitting.normal_equations(design, candidates.untuned(design))
    base = fitting.base_columns(normal.matrix)
    broken = normal.A.copy()
    broken[base[0], base[0]] = np.inf
    with pytest.raises(goodness.NumericalFailureError, match="not a finite number"):
        goodness.check_finite(design, normal._replace(A=broken))
    with pytest.raises(goodness.NumericalFailureError, match="likelihood"):
        goodness.check_deviance(design, float("nan"))


def test_a_base_that_misses_one_wheelset_by_far_is_not_called_consistent(stops: Path) -> None:
    data = dataset.load(stops)
    design = prepare(data, data.group("tune"))
    base = fitting.fit(design, candidates.untuned(design)).explanation
    goodness.check_fit(design, base)

    measured = design.measured_rad_s.copy()
    shaken = design.span(1)
    measured[shaken] += np.random.default_rng(4).normal(0.0, 0.2, measured[shaken].size)
    with pytest.raises(goodness.PoorFitError, match="wheelset 2 in run 'a2'"):
        goodness.check_fit(design._replace(measured_rad_s=measured), base)
