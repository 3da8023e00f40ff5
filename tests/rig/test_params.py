"""The table of parameters, and the constants built from it."""

import math

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig import params
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.creep_force import MODELS

ROWS = [(section, row) for section, rows in params.ROWS.items() for row in rows]
# the names of mechanisms are those in the report of `explain`, which gives their units
NUMBERS = [
    (section, row)
    for section, row in ROWS
    if isinstance(row.default, float | int) and section != "mechanisms"
]
NO_FRICTION = params.Friction(
    np.zeros(0, bool), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, int)
)
NO_DEMAND = params.Demand(np.zeros(0), np.zeros(0))


def ids(pairs):
    return [f"{section}.{row.name}" for section, row in pairs]


def build(**sections):
    return params.build(params.check(sections, "here"), NO_FRICTION, NO_DEMAND, 1e-3, 10)


@pytest.mark.parametrize(("section", "row"), ROWS, ids=ids(ROWS))
def test_every_parameter_has_a_source_and_a_default_that_is_allowed(section, row):
    assert row.source.strip()
    checked = params.check({section: {row.name: row.default}}, "here")
    assert checked[section][row.name] == row.default


@pytest.mark.parametrize(("section", "row"), NUMBERS, ids=ids(NUMBERS))
def test_every_number_has_a_unit_in_its_name_or_is_dimensionless(section, row):
    dimensionless = {
        "poisson",
        "cleaning_creepage",
        "lever_ratio",
        "efficiency",
        "pad_friction",
        "laying",
        "initial_adhesion",
        "critical_ratio",
        "weighed_least",
        "speed_loss",
        "pressure_loss",
        "fade_loss",
        "clamp_hysteresis",
        "lost_share",
        "used_share",
        "gain",
        "thinning",
        "slide_limit",
        "friction_low",
        "friction_high",
        "contamination_power",
        "cleaning_gain",
    }
    dimensionless_of_polach = ("mu_", "A", "k_")
    units = (
        "_m",
        "_s",
        "_kg",
        "_kgm2",
        "_N",
        "_Nm",
        "_Pa",
        "_W",
        "_L",
        "_m2",
        "_m_s",
        "_rad_s",
        "_s_m",
        "_m_J",
        "_N_s_m",
        "_N_s2_m2",
        "_Hz",
        "_Nm_rad",
        "_K",
        "_J_K",
        "_NL_s_bar",
        "_mm3_J",
    )
    is_count = isinstance(row.default, int)
    is_dimensionless = row.name in dimensionless or row.name.startswith(dimensionless_of_polach)
    has_unit = row.name.endswith(units)
    assert is_count or is_dimensionless or has_unit


@pytest.mark.parametrize(("section", "row"), NUMBERS, ids=ids(NUMBERS))
@pytest.mark.parametrize("bad", [math.nan, "below", "above", "12", True, None])
def test_a_value_that_is_not_allowed_is_refused_with_place_value_and_bounds(section, row, bad):
    value = bad
    if bad == "below":
        value = row.low - abs(row.low) - 1e-6
    elif bad == "above":
        if math.isinf(row.high):
            pytest.skip("this parameter has no upper bound")
        value = row.high * 2.0 + 1.0
    elif bad is None:
        value = [1.0]
    elif bad is math.nan and isinstance(row.default, int):
        pytest.skip("tested below")
    with pytest.raises(ConfigError) as caught:
        params.check({section: {row.name: value}}, "file.toml")
    text = str(caught.value)
    assert text.startswith(f"file.toml [{section}]")
    assert row.name in text
    assert "must be" in text or f"allowed {row.low:g} to {row.high:g}" in text


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_whole_number_that_is_not_finite_is_refused(bad):
    with pytest.raises(ConfigError, match="teeth"):
        params.check({"sensor": {"teeth": bad}}, "file.toml")


def test_the_message_on_an_unknown_key_gives_the_likely_one():
    with pytest.raises(ConfigError, match=r"here \[vehicle\]: unknown key 'mas_kg'.*'mass_kg'"):
        params.check({"vehicle": {"mas_kg": 1.0}}, "here")


def test_recovery_that_would_spoil_the_contact_is_refused():
    with pytest.raises(
        ConfigError, match=r"mu_cr/A_r = 0.25 is below the degraded mu_cd/A_d = 0.75"
    ):
        params.check({"adhesion": {"mu_cd": 0.3, "mu_cr": 0.1}}, "here")


def test_a_vehicle_lighter_than_its_running_gear_is_refused():
    with pytest.raises(ConfigError, match=r"mass_kg = 9000 is not more than .* \(13280 kg\)"):
        build(vehicle={"mass_kg": 9000.0})


def test_nobody_can_write_a_parameter():
    constants = build()
    for part in (
        constants,
        constants.vehicle,
        constants.brake,
        constants.drive,
        constants.patch,
        constants.law,
    ):
        with pytest.raises(AttributeError):
            setattr(part, part._fields[0], 1.0)


def test_wheelsets_are_behind_the_first_by_wheelbase_and_bogie_distance():
    np.testing.assert_allclose(build().axle_position_m, [0.0, 2.56, 19.0, 21.56])


def test_a_lag_closes_its_exact_share_of_the_gap_in_a_step():
    step_s = 1e-4
    built = build(valve={"vent_time_constant_s": 0.2}, drive={"torque_time_constant_s": step_s})
    vent_share = 1.0 - math.exp(-step_s / 0.2)
    torque_share = 1.0 - math.exp(-1.0)
    assert built.brake.valve_vent_share == pytest.approx(vent_share, rel=1e-12)
    assert built.drive.torque_share == pytest.approx(torque_share, rel=1e-12)


def test_dead_time_is_a_whole_number_of_ticks():
    assert build(valve={"dead_time_s": 0.04}).brake.dead_time_ticks == 40
    assert build(valve={"dead_time_s": 0.0}).brake.dead_time_ticks == 0


def test_the_papers_tables_are_the_defaults():
    built = build()
    assert built.vehicle.mass_kg == 43000.0
    assert built.vehicle.wheel_radius_m == 0.445
    assert built.vehicle.wheelset_inertia_kgm2 == 160.0
    assert built.law._asdict() == {
        "mu_cd": 0.06,
        "mu_cr": 0.28,
        "A_d": 0.40,
        "A_r": 0.40,
        "gamma_d_s_m": 0.20,
        "gamma_r_s_m": 0.60,
        "k_ad": 0.3,
        "k_sd": 0.1,
        "k_ar": 1.0,
        "k_sr": 0.4,
        "tau_m_J": 1.9e-4,
        "cleaning_creepage": math.inf,
        "cleaning_half_speed_m_s": 0.0,
        "cleaning_sliding_m_s": math.inf,
    }


def test_every_field_of_the_adhesion_law_is_a_parameter_of_its_section():
    rows = {row.name for row in params.ROWS["adhesion"]}
    assert set(Law._fields) <= rows


@pytest.mark.parametrize(
    ("section", "name", "known"), [("contact", "model", MODELS), ("rig", "mode", params.MODES)]
)
def test_the_choices_of_a_word_are_those_in_the_code(section, name, known):
    rows = {row.name: row for row in params.ROWS[section]}
    assert rows[name].choices == tuple(known)
