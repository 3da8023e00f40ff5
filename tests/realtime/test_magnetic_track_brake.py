"""The magnetic track brake of a tram: laws over whole runs, from the recorded channels alone."""

import json
import tomllib

import numpy as np
import pyarrow.parquet
import pytest
from program import BOTH_BRAKES, rollerrig

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, MOST_AXLES, Kind
from rollerrig.firmware_sim import io401
from rollerrig.realtime.bench import free
from rollerrig.realtime.bench import scenario as scenarios
from rollerrig.rig import params, track_brake_params
from rollerrig.wsp_interface import signals

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

SCENARIOS = [BOTH_BRAKES, pytest.param("tram_emergency_magnetic", marks=pytest.mark.nightly)]
WITHIN = 1e-3  # relative difference of two balances
AXLES = range(1, 7)
RAISED = "magnetic_track_brake.emergency_pressure_Pa=inf"


def run(scenario, folder, *words):
    """Run a scenario; return its channels, its resolved scenario and its summary."""
    status, _, messages = rollerrig(
        *("run", scenario, "--pacing", "free", "--set", "loop.record_hz=1000", "--out", folder),
        *words,
    )
    assert status == 0, messages
    return content(folder)


def content(folder):
    """The channels of a run, its resolved scenario and its summary."""
    table = pyarrow.parquet.read_table(folder / "channels.parquet")
    plan = tomllib.loads((folder / "scenario.toml").read_text(encoding="utf-8"))
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return table, plan, summary


@pytest.fixture(scope="module", params=SCENARIOS)
def scenario(request):
    return request.param


@pytest.fixture(scope="module")
def folder(scenario, free_run_of):
    return free_run_of(scenario)[0]


@pytest.fixture(scope="module")
def stop(folder):
    return content(folder)


def axles(table, name, unit=""):
    """Return the values of a channel of all axles, shape (samples, axles)."""
    return np.column_stack([table[f"{name}_{axle}{unit}"].to_numpy() for axle in AXLES])


def test_magnets_contacts_and_resistance_take_the_momentum_and_energy_of_the_tram(stop):
    table, plan, _ = stop
    vehicle = plan["vehicle"]
    time_s = table["time_s"].to_numpy()
    speed_m_s = table["vehicle_speed_m_s"].to_numpy()
    contact_N = axles(table, "adhesion") * axles(table, "wheel_load", "_N")
    magnets_N = axles(table, "track_brake_force", "_N").sum(axis=1)
    resistance_N = (
        vehicle["resistance_A_N"]
        + vehicle["resistance_B_N_s_m"] * speed_m_s
        + vehicle["resistance_C_N_s2_m2"] * speed_m_s**2
    )
    moving = speed_m_s > 0.1
    last = np.flatnonzero(moving)[-1]
    force_N = np.where(moving, contact_N.sum(axis=1) + magnets_N + resistance_N, 0.0)
    mass_kg = vehicle["mass_kg"]
    assert np.trapezoid(force_N, time_s) == pytest.approx(
        mass_kg * (speed_m_s[0] - speed_m_s[last]), rel=WITHIN
    )
    assert np.trapezoid(force_N * speed_m_s, time_s) == pytest.approx(
        0.5 * mass_kg * (speed_m_s[0] ** 2 - speed_m_s[last] ** 2), rel=WITHIN
    )
    # the recorded work of the magnets is that of their recorded force
    assert table["track_brake_work_J"].to_numpy()[last] == pytest.approx(
        np.trapezoid(np.where(moving, magnets_N * speed_m_s, 0.0), time_s), rel=WITHIN
    )


def test_explain_refuses_a_run_with_magnets_and_names_the_key_that_isolates_them(folder, tmp_path):
    status, _, messages = rollerrig("explain", folder, "--out", tmp_path / "report")
    assert status == 2
    assert "a magnetic track brake" in messages
    assert "magnetic_track_brake.bogies=[]" in messages
    assert not (tmp_path / "report" / "report.json").exists()


def test_the_force_begins_when_the_magnets_are_on_the_rail(stop):
    table, plan, _ = stop
    brake = plan["magnetic_track_brake"]
    time_s = table["time_s"].to_numpy()
    force_N = axles(table, "track_brake_force", "_N")
    demanded_s = time_s[np.argmax(axles(table, "track_brake_demand")[:, 0] > 0.0)]
    begins_s = time_s[np.argmax(force_N[:, 0] > 0.0)]
    assert begins_s - demanded_s == pytest.approx(brake["drop_time_s"], abs=0.003)
    # no more than attraction times the friction at standstill
    of_bogie_N = brake["magnets"] * brake["attraction_N"] * brake["friction_low"]
    assert force_N.max() <= 0.5 * of_bogie_N


def test_the_wheels_behind_magnets_find_more_friction(stop):
    table, _, _ = stop
    friction = axles(table, "friction_degraded")
    recovered = 0.28
    cleaning_J_m = axles(table, "track_brake_cleaning", "_J_m")
    braking = table["track_brake_lowered_1"].to_numpy() >= 1.0
    late = np.flatnonzero(braking)[len(np.flatnonzero(braking)) // 2]
    assert cleaning_J_m[late, 0] == 0.0
    assert (np.diff(cleaning_J_m[late][[0, 1, 3, 5]]) > 0.0).all()
    assert friction[late, 1] > friction[late, 0]
    assert friction[late, 5] > friction[late, 1]
    assert friction.max() <= recovered


def test_a_tram_stops_sooner_with_its_magnets_and_later_if_those_of_a_bogie_fail(
    scenario, stop, tmp_path
):
    _, _, summary = stop
    _, _, without = run(scenario, tmp_path / "without", "--set", RAISED)
    failed, _, with_two = run(scenario, tmp_path / "failed", "--fault", "track_brake_dead bogie=2")
    distances_m = [found["stop_distance_m"] for found in (summary, with_two, without)]
    assert distances_m[0] < distances_m[1] < distances_m[2]
    assert axles(failed, "track_brake_force", "_N")[:, 2:4].max() == 0.0


def test_below_the_cut_off_speed_the_magnets_are_switched_off(scenario, tmp_path):
    table, _, _ = run(scenario, tmp_path / "cut", "--set", "magnetic_track_brake.cut_below_m_s=5")
    speed_m_s = table["vehicle_speed_m_s"].to_numpy()
    force_N = axles(table, "track_brake_force", "_N").sum(axis=1)
    assert force_N[(speed_m_s > 5.0) & (speed_m_s < 6.0)].min() > 0.0
    assert force_N[speed_m_s < 3.0].max() < 0.01 * force_N.max()


def test_node_17_of_each_group_switches_its_magnets_and_loses_them_with_its_unit():
    table = signals.table(Kind(6, magnetic_track_brake=True))
    magnets = np.zeros(MOST_AXLES)
    node = io401.build(
        table,
        np.zeros(signals.WIDTH),
        np.zeros(io401.COMMANDS),
        group=1,
        track_brake=magnets,
    )
    node.objects.download(0x6200, 2, b"\x01")
    # the second group has axles 5 and 6
    assert np.flatnonzero(magnets).tolist() == [4, 5]
    node.device.fail_safe("a test")
    assert not magnets.any()


def test_a_vehicle_without_magnets_has_no_channel_of_them():
    assert not [name for name in signals.table(COACH).columns if name.startswith("track_brake")]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"bogies": (1.0, 3.0), "attraction_N": 5e4}, "the vehicle has 2 bogies"),
        ({"bogies": (1.0, 1.0), "attraction_N": 5e4}, "once"),
        ({"bogies": (1.0,)}, "without a force"),
        ({"bogies": (1.0,), "attraction_N": 5e4, "friction_high": 0.5}, "friction_high = 0.5"),
    ],
)
def test_a_track_brake_that_cannot_work_is_refused(changed, message):
    sections = params.check({}, "test")
    sections["magnetic_track_brake"].update(changed)
    with pytest.raises(ConfigError, match=message):
        track_brake_params.build(sections, 0.001)


def test_a_light_tram_whose_brakes_are_weighed_drops_its_magnets_in_an_emergency_too():
    settings = ("initial_speed_m_s=5", "duration_max_s=2", "air.weighed_mass_kg=1e5")
    plan = scenarios.load("tram_emergency_magnetic", settings=settings)
    channels = free.channels(free.simulate(plan), plan.table)
    emergency_Pa = plan["magnetic_track_brake"]["emergency_pressure_Pa"]
    assert channels["brake_demand_Pa"].max() < 0.7 * emergency_Pa
    assert all(channels[f"track_brake_force_{axle}_N"].max() > 0.0 for axle in AXLES)
