"""Vehicles with two, six and eight axles: laws over whole runs, from the recorded channels alone.

The tests read the files of each run as any other program does.
"""

import json
import sys
import tomllib

import cantools
import numpy as np
import pyarrow.parquet
import pytest
from program import BOTH_BRAKES, rollerrig

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import effects, panel
from rollerrig.firmware_sim.modbus.pdu import RefusedError
from rollerrig.realtime.bench import fault_registers, scenario

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

AXLES = {
    BOTH_BRAKES: 6,
    "bogie_low": 2,
    "tram_low": 6,
    "multiple_unit_low": 8,
    "tram_low_dynamic": 6,
}
# all but one run every night
VEHICLES = [
    name if name == BOTH_BRAKES else pytest.param(name, marks=pytest.mark.nightly) for name in AXLES
]
GRAVITY_M_S2 = 9.80665
WITHIN = 1e-3  # relative difference of two balances


ON_HUB = ("--set", "bus.interface=hub", "--set", "bus.socketcand_port=0")


class Record:
    """A run's channels and scenario; `axles(name)` is an array of (samples, axles)."""

    def __init__(self, name, folder):
        self.scenario = name
        self.folder = folder
        self.number_of_axles = AXLES[name]
        self.table = pyarrow.parquet.read_table(folder / "channels.parquet")
        self.plan = tomllib.loads((folder / "scenario.toml").read_text(encoding="utf-8"))
        self.summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        self.time_s = self.table["time_s"].to_numpy()
        self.speed_m_s = self.table["vehicle_speed_m_s"].to_numpy()
        self.contact_N = self.axles("adhesion") * self.axles("wheel_load", "_N")
        self.magnets_N = 0.0
        if "track_brake_force_1_N" in self.table.column_names:
            self.magnets_N = self.axles("track_brake_force", "_N").sum(axis=1)

    def axles(self, name, unit=""):
        columns = []
        for axle in range(1, self.number_of_axles + 1):
            columns.append(self.table[f"{name}_{axle}{unit}"].to_numpy())
        return np.column_stack(columns)

    def integral(self, values):
        total = values.sum(axis=1) if values.ndim == 2 else values
        return np.trapezoid(total, self.time_s)


@pytest.fixture(scope="module", params=VEHICLES)
def record(request, free_run_of):
    folder, _ = free_run_of(request.param)
    return Record(request.param, folder)


@pytest.fixture(scope="module")
def on_bus(record, tmp_path_factory):
    """The same run on the bus, with a unit for each group."""
    name = record.scenario
    folder = tmp_path_factory.mktemp("on_bus") / "run"
    status, _, messages = rollerrig(
        *("run", name, "--pacing", "lockstep", "--set", "loop.record_hz=1000"),
        *(*ON_HUB, "--out", folder),
    )
    assert status == 0, messages
    return Record(name, folder)


def test_the_channels_are_those_of_the_vehicles_axles(record):
    assert f"wheel_speed_{record.number_of_axles}_rad_s" in record.table.column_names
    assert f"wheel_speed_{record.number_of_axles + 1}_rad_s" not in record.table.column_names
    assert len(record.summary["axles"]) == record.number_of_axles
    assert record.summary["valid"]


def test_the_loads_of_all_axles_are_the_weight_of_the_vehicle(record):
    weight_N = GRAVITY_M_S2 * record.plan["vehicle"]["mass_kg"]
    loads_N = record.axles("wheel_load", "_N")
    np.testing.assert_allclose(loads_N.sum(axis=1), weight_N, rtol=1e-9)
    # braking loads the leading axle of each bogie
    braking = loads_N[np.argmin(record.table["vehicle_acceleration_m_s2"].to_numpy())]
    assert (braking[0::2] > braking[1::2]).all()


@pytest.mark.nightly
@pytest.mark.parametrize("record", ["tram_low"], indirect=True)
def test_a_reference_unit_whose_axles_slide_in_the_first_second_learns_the_deceleration(record):
    reference_m_s = record.table["wsp_reference_speed_m_s"].to_numpy()
    late_and_fast = (record.time_s > 1.0) & (record.speed_m_s > 3.0)
    assert np.abs(reference_m_s - record.speed_m_s)[late_and_fast].max() < 1.2
    events = {event["code"] for event in record.summary["events"]}
    assert not events & {"wsp.reference_drifts", "wsp.vents_without_sliding"}


def test_a_vehicle_loses_the_momentum_and_energy_that_contacts_magnets_and_air_take(record):
    vehicle = record.plan["vehicle"]
    mass_kg = vehicle["mass_kg"]
    speed_m_s = record.speed_m_s
    resistance_N = (
        vehicle["resistance_A_N"]
        + vehicle["resistance_B_N_s_m"] * speed_m_s
        + vehicle["resistance_C_N_s2_m2"] * speed_m_s**2
    )
    moving = speed_m_s > 0.1
    taken_N = record.contact_N.sum(axis=1) + record.magnets_N + resistance_N
    force_N = np.where(moving, taken_N, 0.0)
    last = np.flatnonzero(moving)[-1]
    assert record.integral(force_N) == pytest.approx(
        mass_kg * (speed_m_s[0] - speed_m_s[last]), rel=WITHIN
    )
    assert record.integral(force_N * speed_m_s) == pytest.approx(
        0.5 * mass_kg * (speed_m_s[0] ** 2 - speed_m_s[last] ** 2), rel=WITHIN
    )


def test_brake_and_contact_change_the_angular_momentum_of_each_wheelset_of_a_vehicle(record):
    vehicle = record.plan["vehicle"]
    moving = record.speed_m_s > 0.5
    last = np.flatnonzero(moving)[-1] + 1
    contact_Nm = vehicle["wheel_radius_m"] * record.contact_N[:last]
    brake_Nm = record.axles("brake_torque", "_Nm")[:last]
    inertias_kgm2 = np.full(record.number_of_axles, vehicle["wheelset_inertia_kgm2"])
    motors = record.plan.get("dynamic_brake")
    if motors and motors["axles"]:
        brake_Nm = brake_Nm + record.axles("dynamic_torque", "_Nm")[:last]
        driven = np.array(motors["axles"], dtype=int) - 1
        inertias_kgm2[driven] += motors["rotor_inertia_kgm2"]
    wheel_rad_s = record.axles("wheel_speed", "_rad_s")[:last]
    time_s = record.time_s[:last]
    for axle in range(record.number_of_axles):
        driven_Nms = np.trapezoid(contact_Nm[:, axle], time_s)
        braked_Nms = np.trapezoid(brake_Nm[:, axle], time_s)
        gained_rad_s = wheel_rad_s[-1, axle] - wheel_rad_s[0, axle]
        gained_Nms = inertias_kgm2[axle] * gained_rad_s
        assert driven_Nms - gained_Nms == pytest.approx(braked_Nms, rel=WITHIN)


@pytest.mark.nightly
def test_on_low_adhesion_every_vehicle_stops_sooner_with_its_wsp_units(record, tmp_path):
    name = record.scenario
    folder = tmp_path / "none"
    status, _, messages = rollerrig(
        *("run", name, "--pacing", "lockstep", "--wsp", "none", *ON_HUB, "--out", folder)
    )
    assert status == 0, messages
    without = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert record.summary["stop_distance_m"] < without["stop_distance_m"]
    # each group has a unit of its own, and each unit has acted
    vents = record.axles("vents")[-1]
    for first in range(0, record.number_of_axles, 4):
        assert vents[first : first + 4].any()


def test_other_verbs_read_the_run_of_a_vehicle(record):
    status, printed, messages = rollerrig("compare", record.folder, record.folder, "--json")
    assert status == 0, messages
    assert str(record.number_of_axles) in printed


def test_on_the_bus_a_vehicle_with_a_unit_for_each_group_stops_as_without_a_bus(record, on_bus):
    # counters of the loop are not part of the physics
    names = [column for column in record.table.column_names if not column.startswith("tick")]
    for column in names:
        expected = record.table[column].to_numpy()
        np.testing.assert_array_equal(on_bus.table[column].to_numpy(), expected, column)


def test_each_group_has_its_nodes_and_its_unit_on_the_bus(record, on_bus):
    log = (on_bus.folder / "can.log").read_text(encoding="utf-8")
    sent = {int(line.split()[2].split("#")[0], 16) for line in log.splitlines()}
    groups = -(-record.number_of_axles // 4)
    for group in range(groups):
        offset = 32 * group
        # speeds, pressures, magnets and heartbeat of the unit
        assert {0x190 + offset, 0x191 + offset, 0x211 + offset, 0x720 + offset} <= sent
        axles = min(record.number_of_axles - 4 * group, 4)
        drives = {0x180 + offset + axle for axle in range(1, axles + 1)}
        assert drives <= sent
    assert 0x211 + 32 * groups not in sent


@pytest.mark.nightly
def test_in_real_time_a_vehicle_runs_with_modbus(record, tmp_path):
    folder = tmp_path / "wall"
    status, _, messages = rollerrig(
        *("run", record.scenario, "--pacing", "wall", "--set", "duration_max_s=2"),
        *("--set", "bus.interface=hub", "--set", "bus.socketcand_port=0"),
        *("--set", "modbus.port=0", "--out", folder),
    )
    # a run of two seconds does not stop
    assert status == 4, messages
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert summary["loop"]["ticks"] == 2000
    assert summary["bus"]["frames"] > 0


def test_the_files_of_devices_describe_the_nodes_of_every_group(record, tmp_path):
    status, _, messages = rollerrig(
        "devices", "--scenario", record.scenario, "--out", tmp_path / "devices"
    )
    assert status == 0, messages
    names = {path.name for path in (tmp_path / "devices").iterdir()}
    groups = -(-record.number_of_axles // 4)
    numbers = [int(name[5:8]) for name in names if name.endswith(".eds")]
    for group in range(groups):
        assert {32 * group + 1, 32 * group + 16, 32 * group + 17} <= set(numbers)
    # cantools accepts no signal or identifier that is there twice
    database = cantools.database.load_file(tmp_path / "devices" / "rig.dbc")
    carried = {signal.name for message in database.messages for signal in message.signals}
    for axle in range(1, record.number_of_axles + 1):
        assert f"measured_speed_{axle}_rad_s" in carried
    # also in a group of two axles each axle has two bits of the byte of the magnets
    for group in range(groups):
        message = database.get_message_by_frame_id(0x211 + 32 * group)
        places = [(signal.start, signal.length) for signal in message.signals]
        assert places == [(2 * at, 2) for at in range(len(places))]
        assert all(signal.choices for signal in message.signals)


@pytest.mark.nightly
def test_a_sequence_plays_on_the_bus_with_all_axles_of_a_vehicle(tmp_path):
    sequence = tmp_path / "gentle.toml"
    sequence.write_text(
        """
title = "Eight axles brake gently on low adhesion"
scenario = "multiple_unit_low"

[start]
speed = "40 km/h"
adhesion = "low"

[[step]]
title = "the driver brakes until the train stands"
ramp = { brake_demand = "2 bar", in = "2 s" }
until = "vehicle_speed < 0.01 m/s"
timeout = "60 s"
expect = "every cylinder_pressure > 1.5 bar"
""",
        encoding="utf-8",
    )
    status, _, messages = rollerrig("sequence", sequence, "--out", tmp_path / "report")
    assert status == 0, messages
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert "Eight axles brake gently" in page


@pytest.mark.nightly
def test_a_group_without_a_unit_is_reported_with_its_axles(tmp_path):
    # the command starts the unit of the leading group only
    unit = f"{sys.executable} -m rollerrig.realtime.cli wsp --bus {{address}} --lockstep 0.01"
    status, _, messages = rollerrig(
        *("run", "tram_low", "--pacing", "lockstep", "--unit", unit, "--wait", "60"),
        *(*ON_HUB, "--out", tmp_path / "command"),
    )
    assert status == 2
    assert "no heartbeat on 740h (group 2, axles 5 to 6)" in messages
    assert "720h (" not in messages


def test_the_message_about_groups_without_units_has_the_command_that_starts_one(tmp_path):
    status, _, messages = rollerrig(
        *("run", BOTH_BRAKES, "--pacing", "lockstep", "--wsp", "external", "--wait", "1"),
        *(*ON_HUB, "--out", tmp_path / "none"),
    )
    assert status == 2
    assert "720h (group 1, axles 1 to 4) and 740h (group 2, axles 5 to 6)" in messages
    assert "rollerrig wsp --bus" in messages
    assert "--axles 6 --dynamic-brake --group 2" in messages


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            (BOTH_BRAKES, "--set", "dynamic_brake.axles=[1, 9]"),
            "axles = [1, 9]: the vehicle has 6 axles; list each driven axle once",
        ),
        ((BOTH_BRAKES, "--set", "dynamic_brake.force_N=0"), "without a curve"),
        ((BOTH_BRAKES, "--set", "dynamic_brake.demand_N_Pa=0.9"), "which have 137.0 kN"),
        (
            (BOTH_BRAKES, "--set", "magnetic_track_brake.bogies=[1, 5]"),
            "bogies = [1, 5]: the vehicle has 3 bogies",
        ),
        (
            (BOTH_BRAKES, "--fault", "dynamic_brake_lost axle=3"),
            "axle 3 has no such brake; allowed are 1, 2, 5, 6 ([dynamic_brake] axles)",
        ),
        (
            ("velim_a1", "--fault", "track_brake_dead bogie=1"),
            "track_brake_dead is a fault of vehicles with [magnetic_track_brake] bogies",
        ),
    ],
)
def test_a_motor_magnet_or_fault_that_the_vehicle_cannot_have_is_refused_before_the_run(
    words, message, tmp_path
):
    status, _, messages = rollerrig("run", *words, "--pacing", "free", "--out", tmp_path / "run")
    assert status == 2
    assert message in messages
    assert "Traceback" not in messages
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("number", "target", "message"),
    [
        (29, 2, ""),
        (
            29,
            3,
            "fault dynamic_brake_lost axle=3: axle 3 has no such brake; allowed are 1, 2, 5, 6",
        ),
        (30, 2, ""),
        (30, 3, "fault track_brake_dead bogie=3: bogie 3 has no such brake; allowed are 1, 2"),
    ],
)
def test_a_running_rig_refuses_the_fault_of_a_motor_or_magnet_that_is_not_there(
    number, target, message
):
    events = []

    def record(code, /, **fields):
        events.append((code.value, fields))

    array = np.zeros(effects.SIZE)
    sections = {
        "vehicle": {"axles": 6},
        "dynamic_brake": {"axles": [1, 2, 5, 6]},
        "magnetic_track_brake": {"bogies": [1, 2]},
    }
    faults = panel.Panel((), record, sections)
    faults.connect(panel.Site(array, lambda: None))
    write = fault_registers.FaultRegisters(faults, record).writers()
    write["fault"](number, False)
    write["fault_target"](target, False)
    if message:
        with pytest.raises(RefusedError):
            write["inject_fault"](1, False)
    else:
        write["inject_fault"](1, False)
    assert ("fault.begins" in [code for code, _ in events]) != bool(message)
    # the number of the target reaches the fault
    assert f"={target}" in str(events)
    assert message in str(events)
    # a fault that is refused has no effect
    assert array.any() != bool(message)


SEQUENCE_OF_A_TRAM = """
title = "A tram loses the dynamic brake of one axle and stops"
criteria = "none"
scenario = "{scenario}"

[start]
speed = "60 km/h"

[[step]]
title = "the motor fails"
fault = "dynamic_brake_lost axle={axle}"
set = {{ brake_demand = "3.8 bar" }}
until = "vehicle_speed < 0.01 m/s"
timeout = "60 s"
"""


@pytest.mark.parametrize(
    ("axle", "expected_status", "message"),
    [
        (5, 0, ""),
        (3, 2, "axle 3 has no such brake; allowed are 1, 2, 5, 6 ([dynamic_brake] axles)"),
    ],
)
def test_the_faults_of_a_sequence_are_checked_for_the_vehicle_of_the_sequence(
    axle, expected_status, message, tmp_path
):
    path = tmp_path / "tram.toml"
    path.write_text(SEQUENCE_OF_A_TRAM.format(scenario=BOTH_BRAKES, axle=axle))
    status, _, messages = rollerrig("sequence", path, "--check")
    assert status == expected_status, messages
    assert message in messages


def test_a_unit_for_a_group_that_is_not_there_is_refused():
    status, _, messages = rollerrig("wsp", "--group", "2")
    assert status == 2
    assert "a vehicle with 4 axles has 1 group" in messages


def test_one_command_plays_sequences_of_different_vehicles():
    names = ("emergency_120", "tram_loss_of_unit", "multiple_unit_dynamic_low", "bogie_low_120")
    status, printed, messages = rollerrig("sequence", *names, "--check", "--json")
    assert status == 0, messages
    assert json.loads(printed)["checked"] == list(names)


@pytest.mark.parametrize("name", ["ROLLERRIG_AXLES", "ROLLERRIG_EQUIPMENT"])
def test_a_former_variable_of_the_environment_has_no_effect_which_one_line_reports(name, tmp_path):
    words = ("run", "dry_stop", "--wsp", "none", "--pacing", "free", "--out", tmp_path / "run")
    short = ("--set", "initial_speed_m_s=2", "--json")
    done = rollerrig(*words, *short, **{name: "6"})
    assert done.status == 0, done.messages
    assert len(json.loads(done.printed)["axles"]) == 4
    assert done.messages.count(name) == 1


def test_a_vehicle_without_a_dynamic_brake_does_not_have_its_channels(record):
    motors = record.plan.get("dynamic_brake", {"axles": []})
    has_motors = len(motors["axles"]) > 0
    assert has_motors == (record.scenario in (BOTH_BRAKES, "tram_low_dynamic"))
    assert ("dynamic_torque_1_Nm" in record.table.column_names) == has_motors


def test_bogies_that_no_number_of_bodies_shares_are_refused():
    with pytest.raises(ConfigError, match="bogies_per_body = 3 does not divide"):
        scenario.load("velim_a1", settings=("vehicle.bogies_per_body=3",))
