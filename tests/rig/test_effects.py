"""The extended model in the plant: no effect at zero, an effect otherwise, by the same kernel."""

import numpy as np
import pytest
from rolling import DRY, FILL, HOLD, SOAP, TRACK, VENT, Rig

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario
from rollerrig.rig import plant, vehicle, wheelset
from rollerrig.rig.contact import adhesion
from rollerrig.rig.identify.causes import courses
from rollerrig.rig.identify.data import parameters
from rollerrig.rig.identify.replay import wheel
from rollerrig.rig.mechanisms import applied as effects
from rollerrig.rig.mechanisms import friction, table
from rollerrig.rig.plant import Plant
from rollerrig.rig.state import SIZE, slots, views

TICKS = 3000


def braked(params, ticks: int = TICKS) -> Plant:
    """Return a plant after some ticks of full brake from 30 m/s."""
    run = Plant(params, 30.0)
    for tick in range(ticks):
        plant.advance(run.state, run.delay, np.zeros(4), np.nan, tick, params)
        plant.observe(run.state, params)
    return run


def extended(**coefficients: float):
    """Return the parameters of a scenario with these values of [mechanisms]."""
    settings = tuple(f"mechanisms.{name}={value}" for name, value in coefficients.items())
    return scenario.load("velim_a1", "", settings).params


@pytest.fixture(scope="module")
def base():
    return extended()


def test_mechanisms_at_zero_change_no_bit_even_when_they_are_computed(base) -> None:
    forced = base._replace(
        effects=base.effects._replace(on_friction=True, on_torque=True),
        wheels=base.wheels._replace(swings=True, swing_phase_rad=1.0),
    )
    with_them = braked(forced).buffer
    without = braked(base).buffer
    for name, at in slots(4).items():
        if name not in ("sliding_distance", "rail_work", "braked_angle"):
            assert np.array_equal(with_them[at], without[at], equal_nan=True), name


def test_a_model_with_zero_for_every_mechanism_changes_no_bit(base) -> None:
    coefficients = {key: 0.0 for mechanism in table.IN_PLANT for key in mechanism.coefficients}
    axles = {row.name: 2.0 for row in table.rows() if row.name.endswith("_axle")}
    shapes = {
        "adhesion_memory_speed_power": 1.0,
        "adhesion_memory_of_work": 1.0,
        "wheel_out_of_round_phase_rad": 2.0,
        "falling_friction_height": 1.0,
        "interfacial_layer_whole": 1.0,
    }
    assert {
        "adhesion_memory_length_m",
        "wheel_out_of_round_amplitude",
        "wheel_radius_fraction",
        "wheel_inertia_fraction",
    } <= set(coefficients)
    zero = extended(**coefficients, **axles, **shapes)
    assert braked(zero).buffer.tobytes() == braked(base).buffer.tobytes()


def test_cleaning_by_leading_wheels_raises_friction_only_behind_them() -> None:
    params = extended(rail_cleaning_gain=0.2, rail_cleaning_energy_J_m=100.0)
    first, second, third, fourth = braked(params).state.friction_degraded
    assert first == pytest.approx(params.law.mu_cd)
    assert second > first
    assert fourth >= third


def test_resistance_gradient_radius_and_layer_are_built_in(base) -> None:
    params = extended(
        running_resistance_force_N=500.0,
        track_gradient_gradient=0.001,
        wheel_radius_fraction=0.01,
        roller_curvature_stiffness_fraction=0.5,
    )
    gradient_N = 0.001 * 43000.0 * 9.80665
    resistance_N = base.vehicle.resistance_A_N + 500.0 + gradient_N
    assert params.vehicle.resistance_A_N == pytest.approx(resistance_N)
    assert params.vehicle.wheel_radius_m == pytest.approx(1.01 * base.vehicle.wheel_radius_m)
    assert params.patch.eps1 > 1.4 * base.patch.eps1


def torque(capacity_Nm: float, axle: int, work_J: float, mechanisms) -> float:
    """Return the torque of an axle whose brake has done this work."""
    state = views(np.zeros(SIZE), 4)
    state.brake_work[:] = work_J
    return effects.torque(capacity_Nm, state, axle, 0.0, mechanisms)


def test_torque_changes_at_one_axle_only() -> None:
    mechanisms = extended(brake_gain_gain=0.1, brake_gain_axle=2.0).effects
    assert torque(1000.0, 1, 0.0, mechanisms) == pytest.approx(1100.0)
    assert torque(1000.0, 0, 0.0, mechanisms) == 1000.0


def test_torque_changes_at_the_wheelsets_of_one_bogie_only() -> None:
    mechanisms = extended(brake_gain_gain=0.1, brake_gain_axle=-2.0).effects
    changed = [torque(1000.0, axle, 0.0, mechanisms) for axle in range(4)]
    assert changed == pytest.approx([1000.0, 1000.0, 1100.0, 1100.0])


def test_there_is_no_third_bogie() -> None:
    with pytest.raises(ConfigError, match="brake_gain_axle"):
        extended(brake_gain_gain=0.1, brake_gain_axle=-3.0)


def test_a_coefficient_out_of_bounds_is_refused() -> None:
    with pytest.raises(ConfigError, match="rail_cleaning_gain"):
        extended(rail_cleaning_gain=7.0)


def test_resistance_grows_with_the_given_power_of_the_speed(base) -> None:
    linear = extended(running_resistance_force_N=400.0, running_resistance_speed_power=1.0)
    square = extended(running_resistance_force_N=400.0, running_resistance_speed_power=2.0)
    more_B = linear.vehicle.resistance_B_N_s_m - base.vehicle.resistance_B_N_s_m
    more_C = square.vehicle.resistance_C_N_s2_m2 - base.vehicle.resistance_C_N_s2_m2
    assert more_B == pytest.approx(20.0)
    assert more_C == pytest.approx(1.0)
    with pytest.raises(ConfigError, match="speed_power"):
        extended(running_resistance_speed_power=0.5)


def test_fade_of_a_pad_saturates_with_its_heat() -> None:
    straight = extended(pad_fade_fade_1_MJ=0.01).effects
    bent = extended(pad_fade_fade_1_MJ=0.01, pad_fade_heat_MJ=3.0).effects
    assert torque(1000.0, 0, 5e6, straight) == pytest.approx(950.0, rel=1e-4)
    lost_share = 0.01 * 3.0 * (1.0 - np.exp(-5.0 / 3.0))
    assert torque(1000.0, 0, 5e6, bent) == pytest.approx(1000.0 * (1.0 - lost_share))


def test_a_torque_offset_may_begin_at_a_torque() -> None:
    mechanisms = extended(torque_offset_offset_Nm=50.0, torque_offset_from_Nm=300.0).effects
    assert torque(200.0, 0, 0.0, mechanisms) == 200.0
    assert torque(400.0, 0, 0.0, mechanisms) == 450.0


def friction_after(seconds: float, **coefficients: float) -> tuple[np.ndarray, float]:
    """Return the factors on the degraded friction of all axles after a time, and that time."""
    params = extended(**coefficients)
    state = braked(params, ticks=round(seconds * 1000)).state
    return state.friction_degraded / params.law.mu_cd, state.time[0]


def test_sand_behind_the_first_wheelset_does_not_change_that_one() -> None:
    factors, _ = friction_after(
        0.5, sanding_gain=0.2, sanding_start_s=0.1, sanding_duration_s=5.0, sanding_behind=1.0
    )
    sanded = np.exp(0.2)
    assert factors == pytest.approx([1.0, sanded, sanded, sanded])


def test_an_empirical_term_acts_by_its_formula() -> None:
    factors, time_s = friction_after(
        0.5,
        empirical_covariate=2.0,
        empirical_linear=0.1,
        empirical_quadratic=-0.05,
        empirical_centre=1.0,
        empirical_scale=2.0,
    )
    z = (time_s - 1.0) / 2.0
    parabola = np.full(4, 0.1 * z - 0.05 * z * z)
    assert np.log(factors) == pytest.approx(parabola, abs=2e-4)


def test_an_empirical_term_with_a_period_is_a_wave() -> None:
    factors, time_s = friction_after(
        0.5, empirical_covariate=2.0, empirical_linear=0.1, empirical_period=4.0
    )
    wave = np.full(4, 0.1 * np.cos(2.0 * np.pi * time_s / 4.0))
    assert np.log(factors) == pytest.approx(wave, abs=2e-4)


def test_friction_follows_the_speed_on_a_bent_line() -> None:
    factors, _ = friction_after(
        0.2, speed_dependent_friction_slope_per_m_s=0.01, speed_dependent_friction_knee_m_s=12.0
    )
    assert np.log(factors[0]) == pytest.approx(0.12 * (1.0 - np.exp(-10.0 / 12.0)), rel=2e-3)


# --- memory of adhesion ---


@pytest.mark.parametrize(
    ("speed_m_s", "power"), [(20.0, 0.0), (10.0, 0.0), (10.0, 1.0), (30.0, 0.5)]
)
def test_after_a_step_in_sliding_a_wheel_with_memory_recovers_by_its_length(
    speed_m_s, power
) -> None:
    length_m = 0.4
    rig = Rig(
        speed_m_s,
        rig=TRACK,
        brake={"cylinder_area_m2": 0.1},
        mechanisms={"adhesion_memory_length_m": length_m, "adhesion_memory_speed_power": power},
    )
    # strong brakes have locked all wheels: by the paper's law lambda_0 then hardly changes with the
    # way
    rig.state.wheel_speed[:] = 0.0
    rig.charge(4e5)
    rig.state.brake_capacity[:] = 2e4
    way_m = length_m * (speed_m_s / 20.0) ** power
    run = rig.roll(2.5 * way_m / speed_m_s, demand_Pa=4e5)
    assert run.wheel_speed.max() == 0.0

    # lambda_0 of the first wheelset after each tick
    target = []
    for tick in range(1, run.time.size):
        _, _, _, lambda_0, _, _ = wheelset.wheelset_adhesion(
            run.sliding[tick, 0],
            run.vehicle_speed[tick],
            run.wheel_load[tick, 0],
            0.06,
            0.28,
            rig.params.patch,
            rig.params.law,
        )
        target.append(lambda_0)
    assert np.ptp(target) < 0.07 * target[0]

    expected = 1.0 - np.exp(-run.position[1:] / way_m)
    np.testing.assert_allclose(run.transition[1:, 0] / np.mean(target), expected, atol=0.015)
    # and the force is that of the recovery so far
    f_d = run.adhesion_degraded[1:, 0]
    f_r = run.adhesion_recovered[1:, 0]
    late = run.transition[1:, 0]
    np.testing.assert_allclose(run.adhesion[1:, 0], (1.0 - late) * f_d + late * f_r, rtol=1e-12)


def test_a_memory_of_the_work_done_recovers_by_the_actual_work() -> None:
    length_m = 2.0
    rig = Rig(
        20.0,
        adhesion=SOAP,
        rig=TRACK,
        mechanisms={"adhesion_memory_length_m": length_m, "adhesion_memory_of_work": 1.0},
    )
    rig.charge(4e5)
    run = rig.roll(1.5, demand_Pa=4e5)
    assert run.transition.max() > 0.05

    # lambda_0 from the recorded work of one wheel on a metre of rail; means between two ticks
    target = 1.0 - np.exp(-rig.params.law.tau_m_J * run.dissipated_energy[:, 0])
    mean_target = 0.5 * (target[1:] + target[:-1])
    lagging = run.transition[:, 0]
    mean_lagging = 0.5 * (lagging[1:] + lagging[:-1])
    slope_1_m = np.diff(lagging) / np.diff(run.position)
    expected_1_m = (mean_target - mean_lagging) / length_m
    tolerance_1_m = 2e-3 * np.abs(slope_1_m).max()
    np.testing.assert_allclose(slope_1_m, expected_1_m, atol=tolerance_1_m)


@pytest.mark.parametrize("of_work", [0.0, 1.0])
def test_a_very_short_memory_is_the_base_model(of_work) -> None:
    memory = {"adhesion_memory_length_m": 1e-4, "adhesion_memory_of_work": of_work}
    base_rig = Rig(20.0, adhesion=SOAP)
    memory_rig = Rig(20.0, adhesion=SOAP, mechanisms=memory)
    for rig in (base_rig, memory_rig):
        rig.charge(2.5e5)
    plain = base_rig.roll(3.0)
    lagging = memory_rig.roll(3.0)
    assert plain.transition.max() > 0.1
    np.testing.assert_allclose(lagging.wheel_speed, plain.wheel_speed, atol=0.02)
    np.testing.assert_allclose(lagging.position, plain.position, atol=1e-4)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_memory_in_the_plant_equals_that_of_the_replay_and_is_finite_at_standstill(power) -> None:
    memory = extended(adhesion_memory_length_m=3.0, adhesion_memory_speed_power=power).effects
    row = np.zeros(parameters.PARAMETERS)
    row[parameters.MEMORY] = 3.0
    row[parameters.MEMORY_POWER] = power
    model = parameters.WheelModel(*row)
    for speed_m_s in (0.1, 5.0, 20.0, 44.0):
        in_plant = wheelset.lagged_transition(0.0, 1.0, speed_m_s, 0.01, memory)
        in_replay = wheel.lag_share(speed_m_s, 0.01, model)
        assert in_plant == pytest.approx(in_replay, rel=1e-12)

    standing = wheelset.lagged_transition(0.2, 1.0, 0.0, 0.01, memory)
    assert 0.2 <= standing < 0.3
    if power < 1.0:
        assert standing == 0.2


# --- the adhesion law ---


def test_the_height_of_falling_friction_scales_the_fall_from_static_to_sliding() -> None:
    base = extended().law
    higher = extended(falling_friction_fraction=0.5, falling_friction_height=1.0).law
    assert 1.0 / higher.A_d - 1.0 == pytest.approx(1.5 * (1.0 / base.A_d - 1.0), rel=1e-12)
    assert 1.0 / higher.A_r - 1.0 == pytest.approx(1.5 * (1.0 / base.A_r - 1.0), rel=1e-12)
    assert higher.gamma_d_s_m == base.gamma_d_s_m
    assert higher.gamma_r_s_m == base.gamma_r_s_m


def test_a_layer_of_the_whole_contact_is_a_contact_of_less_creep_stiffness() -> None:
    layer = extended(interfacial_layer_reduction=0.4, interfacial_layer_whole=1.0)
    soft = extended(roller_curvature_stiffness_fraction=-0.4)

    def force_N(sliding_m_s: float, p) -> float:
        force, _, _ = wheelset.contact_force(
            sliding_m_s, 20.0, 1.1e5, 0.04, 0.28, p.patch, p.law, adhesion.NO_MEMORY, 0.0
        )
        return force

    for sliding_m_s in (0.01, 0.3, 4.0):
        expected_N = force_N(sliding_m_s, soft)
        assert force_N(sliding_m_s, layer) == pytest.approx(expected_N, rel=1e-9)


# --- wheels ---


def test_an_out_of_round_wheel_varies_the_load_of_its_axle_once_a_turn_by_the_amplitude() -> None:
    rig = Rig(
        20.0,
        adhesion=DRY,
        mechanisms={
            "wheel_out_of_round_amplitude": 0.05,
            "wheel_out_of_round_phase_rad": 0.7,
            "wheel_out_of_round_axle": 2.0,
        },
    )
    run = rig.roll(3.0)
    round_N = np.empty_like(run.wheel_load)
    for tick, felt_m_s2 in enumerate(run.felt_acceleration):
        for axle in range(4):
            round_N[tick, axle] = vehicle.load(axle, felt_m_s2, rig.params.vehicle)
    share = run.wheel_load / round_N
    np.testing.assert_allclose(share[:, [0, 2, 3]], 1.0, rtol=1e-12)

    second = share[:, 1]
    expected = 1.0 + 0.05 * np.cos(run.wheel_angle[:, 1] + 0.7)
    np.testing.assert_allclose(second, expected, rtol=1e-12)
    turns = run.change("wheel_angle")[1] / (2.0 * np.pi)
    rises_above_1 = (second[1:] > 1.0) & (second[:-1] <= 1.0)
    assert np.count_nonzero(rises_above_1) == pytest.approx(turns, abs=1.0)
    assert turns > 15.0


def test_one_larger_wheel_turns_slower_at_the_speed_of_the_train() -> None:
    rig = Rig(
        20.0,
        adhesion=DRY,
        rig=TRACK,
        mechanisms={"wheel_radius_fraction": 0.04, "wheel_radius_axle": 3.0},
    )
    run = rig.roll(1.0, demand_Pa=0.0)
    first, second, larger, fourth = run.wheel_speed[-1]
    assert second == pytest.approx(first, rel=1e-6)
    assert fourth == pytest.approx(first, rel=1e-6)
    assert larger == pytest.approx(first / 1.04, rel=1e-6)
    np.testing.assert_allclose(
        run.wheel_circumferential_speed[-1], run.vehicle_speed[-1], rtol=1e-5
    )


def test_one_heavier_wheelset_responds_more_slowly() -> None:
    rig = Rig(
        20.0,
        adhesion={"mu_cd": 1e-4, "mu_cr": 1e-4, "A_d": 1.0, "A_r": 1.0},
        mechanisms={"wheel_inertia_fraction": 0.5, "wheel_inertia_axle": 4.0},
    )
    run = rig.roll(1.0, demand_Pa=2e5)
    first, second, third, heavier = run.change("wheel_speed")
    assert second == pytest.approx(first, rel=1e-3)
    assert third == pytest.approx(first, rel=1e-3)
    assert heavier == pytest.approx(first / 1.5, rel=1e-3)


WHEELS_AND_CONTACT = {
    "adhesion_memory_length_m": 1.0,
    "adhesion_memory_speed_power": 0.5,
    "wheel_out_of_round_amplitude": 0.1,
    "wheel_out_of_round_axle": 1.0,
    "wheel_radius_fraction": 0.03,
    "wheel_radius_axle": 2.0,
    "wheel_inertia_fraction": 0.3,
    "wheel_inertia_axle": 3.0,
}


@pytest.mark.parametrize("mode", [TRACK, {}], ids=["track", "rollers"])
def test_with_such_wheels_and_memory_halving_the_step_still_quarters_the_error(mode) -> None:
    def end(step_s: float) -> np.ndarray:
        rig = Rig(
            30.0,
            step_s,
            2e-3,
            adhesion=SOAP,
            rig=mode,
            brake={"spring_pressure_Pa": 0.0},
            mechanisms=WHEELS_AND_CONTACT,
        )
        run = rig.roll(2.8, controlled=False)
        assert run.sliding.max() > 0.1
        return np.hstack([run.vehicle_speed[-1], run.wheel_speed[-1], run.roller_speed[-1]])

    exact = end(2e-5)
    errors = [np.abs(end(step_s) - exact).max() for step_s in (2e-3, 1e-3, 5e-4)]
    orders = np.log2(errors[:-1]) - np.log2(errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.25)


def test_with_such_wheels_and_memory_the_energy_of_a_stop_balances() -> None:
    rig, run = stop_with_such_wheels()
    assert np.isfinite(run.log).all()
    inertia_kgm2 = rig.params.wheels.table[vehicle.INERTIA_KGM2]
    vehicle_v2 = run.vehicle_speed[0] ** 2 - run.vehicle_speed[-1] ** 2
    wheels_v2 = run.wheel_speed[0] ** 2 - run.wheel_speed[-1] ** 2
    lost_J = 0.5 * (rig.params.vehicle.mass_kg * vehicle_v2 + inertia_kgm2 @ wheels_v2)
    counted_J = (
        run.change("sliding_work").sum()
        + run.change("brake_work").sum()
        + run.change("resistance_work")
    )
    assert counted_J == pytest.approx(lost_J, rel=1e-6)

    _, repeated = stop_with_such_wheels()
    assert repeated.log.tobytes() == run.log.tobytes()


def stop_with_such_wheels():
    """Return a rig and its history of a stop in which two axles fill, one holds and one vents."""
    rig = Rig(20.0, adhesion=SOAP, rig=TRACK, mechanisms=WHEELS_AND_CONTACT)
    return rig, rig.roll(40.0, (FILL, FILL, HOLD, VENT))


@pytest.mark.parametrize(
    "mechanisms",
    [
        {"adhesion_memory_length_m": 2.0},
        {"wheel_out_of_round_amplitude": 0.1},
        {"wheel_radius_fraction": 0.02, "wheel_radius_axle": 3.0},
        {"load_transfer_body_s2_m": 0.02},
    ],
)
def test_the_coach_in_3d_refuses_a_mechanism_that_it_does_not_know(mechanisms) -> None:
    first = next(iter(mechanisms))
    with pytest.raises(ConfigError, match=f"{first}.*coach in 3D.*planar"):
        Rig(20.0, vehicle={"model": "multibody"}, mechanisms=mechanisms)


def test_a_patch_with_slow_edges_has_half_its_depth_on_the_middle_of_its_edge() -> None:
    params = extended(
        contaminated_patch_depth=0.4,
        contaminated_patch_start_m=100.0,
        contaminated_patch_length_m=80.0,
        contaminated_patch_ramp=0.5,
    )
    rig = Plant(params, 30.0)
    places_m = (99.0, 110.0, 140.0, 170.0, 181.0)
    lost = []
    for place_m in places_m:
        factor = effects.friction_factor(rig.state, 0, place_m, params.effects, False)
        lost.append(-np.log(factor))
    assert lost == pytest.approx([0.0, 0.2, 0.4, 0.2, 0.0], abs=1e-12)

    course = courses.filled(friction.contaminated_patch, 5, np.array(places_m), 100.0, 80.0, 0.5)
    assert -0.4 * course == pytest.approx(lost, abs=1e-12)
