"""Vehicles with several groups of axles: what belongs to one group, and what two groups share."""

import json
from binascii import crc32

import fmpy
import fmus
import numpy as np
import pyarrow.parquet
import pytest
from program import BOTH_BRAKES, rollerrig

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

ON_HUB = ("--set", "bus.interface=hub", "--set", "bus.socketcand_port=0")


# --- identifiers ---


def store(folder, node, values=None, settings=None):
    """Write the file of a node as the node does when a master stores values or LSS settings."""
    parts = (values or {}, settings or {})
    content = {
        "checksum": crc32(json.dumps(parts, sort_keys=True).encode()),
        "values": parts[0],
        "lss": parts[1],
    }
    folder.mkdir(exist_ok=True)
    (folder / f"node_{node:03d}.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("node", "values", "settings", "message"),
    [
        # TPDO1 of the second brake I/O has the identifier of the first one
        (
            49,
            {"180001": 0x191},
            {},
            "node 17 of group 1 in object 1800h:1 and node 49 of group 2 in object 1800h:1 have the "
            "identifier 191h",
        ),
        # a drive of the first group sends what the unit of the second one sends
        (
            1,
            {"180001": 0x231},
            {},
            "the WSP unit of group 2 and node 1 of group 1 in object 1800h:1 have the identifier 231h",
        ),
        (
            16,
            {},
            {"node_id": 48, "bit_timing": 2},
            "node 16 of group 1 and node 48 of group 2 have the node number 48 (LSS)",
        ),
        (
            48,
            {},
            {"node_id": 32, "bit_timing": 2},
            "the WSP unit of group 1 and node 48 of group 2 have the node number 32 (LSS)",
        ),
    ],
)
def test_a_stored_identifier_of_another_group_is_refused_before_the_run(
    node, values, settings, message, tmp_path
):
    memory = tmp_path / "memory"
    store(memory, node, values, settings)
    status, _, messages = rollerrig(
        *("run", BOTH_BRAKES, "--pacing", "lockstep", "--set", f"bus.store={memory}", *ON_HUB),
        *("--out", tmp_path / "run"),
    )
    assert status == 2
    assert message in " ".join(messages.split())
    assert f"node_{node:03d}.json" in messages
    assert "delete the file" in " ".join(messages.split())
    assert not (tmp_path / "run").exists()


GENTLE_TRAM = """
title = "A tram brakes gently on low adhesion"
scenario = "{scenario}"

[start]
speed = "40 km/h"

[[step]]
title = "the driver brakes"
set = {{ brake_demand = "2 bar" }}
until = "vehicle_speed < 0.01 m/s"
timeout = "60 s"
"""
DBC = """VERSION ""
NS_ :
BS_:
BU_: UNIT RIG
BO_ 561 TAKEN: 1 UNIT
 SG_ V1 : 0|8@1+ (1,0) [0|255] "rad/s" UNIT
"""
MAP = """dbc = "unit.dbc"
[[to_unit]]
message = "TAKEN"
signals = { V1 = "measured_speed_1" }
[from_unit]
message = "TAKEN"
hold = []
vent = []
"""


def test_a_message_of_a_unit_with_an_identifier_of_a_further_group_is_refused(tmp_path):
    (tmp_path / "gentle.toml").write_text(GENTLE_TRAM.format(scenario=BOTH_BRAKES))
    (tmp_path / "unit.dbc").write_text(DBC)
    (tmp_path / "map.toml").write_text(MAP)
    status, _, messages = rollerrig(
        *("sequence", tmp_path / "gentle.toml", "--wsp", "external", "--unit", "true"),
        *("--unit-map", tmp_path / "map.toml", "--out", tmp_path / "report"),
    )
    assert status == 2
    expected = "TAKEN has the identifier 231h, which the rig uses for group 2 (axles 5 to 6)"
    assert expected in " ".join(messages.split())


# --- faults and reference speeds by group ---


def frames_of(folder):
    """The frames of a run as (time in s, identifier), in the order of the bus."""
    frames = []
    for line in (folder / "can.log").read_text(encoding="utf-8").splitlines():
        stamp, _, frame = line.split()
        frames.append((float(stamp.strip("()")), int(frame.partition("#")[0], 16)))
    return frames


def events_of(folder):
    lines = (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line) for line in lines]


def test_a_fault_stops_the_unit_of_one_group_and_the_others_go_on(tmp_path):
    folder = tmp_path / "run"
    status, _, messages = rollerrig(
        *("run", BOTH_BRAKES, "--pacing", "lockstep", "--set", "duration_max_s=3", *ON_HUB),
        *("--fault", "wsp_frozen group=2 at=1 for=1", "--out", folder),
    )
    # a run of three seconds does not stop
    assert status == 4, messages
    frozen = [can_id for time_s, can_id in frames_of(folder) if 1.0 < time_s < 1.995]
    assert frozen.count(0x231) == 0
    assert frozen.count(0x211) == 99
    after = [can_id for time_s, can_id in frames_of(folder) if time_s > 1.995]
    # the second unit answers again, and the SYNCs that it has missed too
    assert after.count(0x231) > after.count(0x211)

    lost = [event["fields"]["node"] for event in events_of(folder) if event["code"] == "unit.lost"]
    assert lost == [64]
    table = pyarrow.parquet.read_table(folder / "channels.parquet")
    time_s = table["time_s"].to_numpy()
    held = (time_s > 1.3) & (time_s < 2.0)
    # without its unit a group has no reference speed
    assert np.isnan(table["wsp_reference_speed_2_m_s"].to_numpy()[held]).all()
    assert np.isfinite(table["wsp_reference_speed_m_s"].to_numpy()[held]).all()
    # the units see other axles, so their reference speeds differ
    before = (time_s > 0.5) & (time_s < 1.0)
    first, second = (
        table[f"wsp_reference_speed{place}_m_s"].to_numpy()[before] for place in ("", "_2")
    )
    np.testing.assert_allclose(second, first, rtol=0.1)
    assert (second != first).any()


@pytest.mark.parametrize(
    ("scenario", "fault", "message"),
    [
        (BOTH_BRAKES, "wsp_frozen group=3", "group = 3"),
        ("velim_a1", "wsp_frozen group=1", "group"),
    ],
)
def test_a_fault_of_the_unit_of_a_group_that_is_not_there_is_refused(
    scenario, fault, message, tmp_path
):
    status, _, messages = rollerrig(
        *("run", scenario, "--pacing", "lockstep", "--fault", fault, "--out", tmp_path / "run")
    )
    assert status == 2
    assert message in messages
    assert not (tmp_path / "run").exists()


# --- one unit for each group ---


# the rules of the FMU are those of the packaged configuration of the coach
TRAIN = (
    *(
        "run",
        "multiple_unit_low",
        "--pacing",
        "lockstep",
        "--set",
        "wsp_config=reference",
        "--set",
        "adhesion=very_low",
    ),
    *("--set", "duration_max_s=8", *ON_HUB),
)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """The rules of the reference unit as an FMU."""
    return fmus.build(tmp_path_factory.mktemp("fmu"))


@pytest.fixture(scope="module")
def train(tmp_path_factory):
    """The folder of a run of a train of two cars, each with a reference unit in a process."""
    folder = tmp_path_factory.mktemp("train") / "run"
    status, _, messages = rollerrig(*TRAIN, "--out", folder)
    # a run of eight seconds does not stop
    assert status == 4, messages
    return folder


@pytest.mark.nightly
def test_a_train_with_one_unit_a_car_in_two_processes_repeats_to_the_byte(train, tmp_path):
    status, _, messages = rollerrig(*TRAIN, "--out", tmp_path / "again")
    assert status == 4, messages
    for name in ("channels.parquet", "can.log"):
        assert (tmp_path / "again" / name).read_bytes() == (train / name).read_bytes()
    # both units have acted, and both answer every SYNC
    magnets = pyarrow.parquet.read_table(train / "channels.parquet")
    for car in ((1, 2, 3, 4), (5, 6, 7, 8)):
        assert any(magnets[f"magnets_{axle}"].to_numpy().any() for axle in car)
    ids = [can_id for _, can_id in frames_of(train)]
    assert ids.count(0x211) == ids.count(0x231) == ids.count(0x080)


@pytest.mark.nightly
def test_an_fmu_for_each_group_gives_the_channels_of_the_reference_units(fmu, train, tmp_path):
    status, _, messages = rollerrig(*TRAIN, "--wsp", f"fmu:{fmu}", "--out", tmp_path / "fmu")
    assert status == 4, messages
    expected = pyarrow.parquet.read_table(train / "channels.parquet")
    table = pyarrow.parquet.read_table(tmp_path / "fmu" / "channels.parquet")
    for name in expected.column_names:
        np.testing.assert_array_equal(table[name].to_numpy(), expected[name].to_numpy(), name)


@pytest.mark.nightly
def test_an_fmu_protects_a_last_group_that_has_two_axles(fmu, tmp_path):
    folder = tmp_path / "tram"
    status, _, messages = rollerrig(
        *("run", "tram_low", "--pacing", "lockstep", "--wsp", f"fmu:{fmu}"),
        *("--set", "duration_max_s=4", *ON_HUB, "--out", folder),
    )
    assert status == 4, messages
    table = pyarrow.parquet.read_table(folder / "channels.parquet")
    # its second instance has acted, and its reference speed is near that of the vehicle
    assert table["magnets_6"].to_numpy().any()
    reference = table["wsp_reference_speed_2_m_s"].to_numpy()[20]
    assert reference == pytest.approx(table["vehicle_speed_m_s"].to_numpy()[20], rel=0.5)


# --- the rig as an FMU ---


@pytest.mark.nightly
@pytest.mark.parametrize("scenario", ["bogie_low", "tram_low", "multiple_unit_low"])
def test_the_rig_of_every_vehicle_as_an_fmu_brakes_as_a_free_run(scenario, tmp_path):
    out = tmp_path / "rig.fmu"
    status, _, messages = rollerrig("export-fmu", scenario, "--out", out)
    assert status == 0, messages
    status, _, messages = rollerrig(
        *("run", scenario, "--pacing", "free", "--wsp", "none", "--set", "duration_max_s=1.5"),
        *("--out", tmp_path / "run"),
    )
    assert status == 4, messages
    table = pyarrow.parquet.read_table(tmp_path / "run" / "channels.parquet")
    last = sum(name.startswith("wheel_load_") for name in table.column_names)
    names = {"vehicle_speed": "vehicle_speed_m_s", f"wheel_load_{last}": f"wheel_load_{last}_N"}
    result = fmpy.simulate_fmu(
        str(out), stop_time=1.0, step_size=0.01, output_interval=0.01, output=list(names)
    )
    for variable, column in names.items():
        recorded = np.interp(result["time"], table["time_s"].to_numpy(), table[column].to_numpy())
        np.testing.assert_allclose(result[variable], recorded, rtol=1e-9, err_msg=variable)
