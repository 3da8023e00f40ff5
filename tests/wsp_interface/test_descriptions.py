"""EDS, DBC and the signal table: parsers of other projects read the nodes as they are."""

import configparser
import csv
import shutil
import subprocess
import sys
from pathlib import Path

import canopen
import cantools
import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import encoder406, io401, sander401
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.wsp_interface import descriptions, signals
from rollerrig.wsp_interface.bus.connection_set import NMT, SDO_REPLY, SYNC, TPDO
from rollerrig.wsp_interface.bus.frames import Frame

TABLE = signals.table(COACH)
RATED_Nm = 5000.0
# attributes of an object that its EDS must have
ATTRIBUTES = (
    "name",
    "data_type",
    "access_type",
    "pdo_mappable",
    "min",
    "max",
)
# the options of CiA 306-1 for an object; any other option is an error for strict tools
OPTIONS = {
    "ParameterName",
    "ObjectType",
    "DataType",
    "AccessType",
    "DefaultValue",
    "PDOMapping",
    "LowLimit",
    "HighLimit",
    "SubNumber",
}
NODES = (1, 2, 3, 4, 16, 17, 18)
FIELD = Path(__file__).parent.parent / "data" / "field" / "eds_tools"


@pytest.fixture
def rig():
    """The nodes by number, and the live row of signals that they read."""
    row = np.zeros(signals.WIDTH)
    nodes = [
        drive.build(node, axle, row, {"rated_torque_Nm": RATED_Nm})
        for axle, node in enumerate(TABLE.drive_nodes, 1)
    ]
    nodes += [
        encoder406.build(TABLE, row),
        io401.build(TABLE, row, np.zeros(io401.COMMANDS)),
        sander401.build(TABLE, row, np.zeros(COACH.axles)),
    ]
    return {node.node_id: node for node in nodes}, row


@pytest.fixture
def folder(rig, tmp_path):
    descriptions.write(tmp_path, TABLE, [node.dictionary for node in rig[0].values()])
    return tmp_path


def eds_of(folder, number):
    """Return the EDS file of a node."""
    (file,) = folder.glob(f"node_{number:03d}_*.eds")
    return file


@pytest.mark.conformance("CiA 301", "EDS: canopen reads the objects that the node has")
@pytest.mark.parametrize("number", [1, 2, 3, 4, 16, 17, 18])
def test_canopen_reads_from_the_eds_the_same_objects_that_the_node_has(rig, folder, number):
    node = rig[0][number]
    read = canopen.import_od(str(eds_of(folder, number)), number)
    for at, variable in node.objects.variables.items():
        same = read.get_variable(at >> 8, at & 0xFF)
        for name in ATTRIBUTES:
            assert getattr(same, name) == getattr(variable, name), (hex(at), name)
        assert same.default == variable.default, hex(at)
    dummies = {index for index in read if index < 0x1000}
    assert set(read) - dummies == set(node.dictionary)


@pytest.mark.conformance("CiA 301", "EDS: PDOMapping 0 or 1, DeviceInfo counts")
@pytest.mark.parametrize("number", [1, 16, 17])
def test_the_eds_has_mapping_flags_of_0_or_1_and_the_numbers_of_pdos(folder, number):
    parser = configparser.ConfigParser()
    parser.optionxform = str
    parser.read(eds_of(folder, number))
    flags = {body["PDOMapping"] for body in parser.values() if "PDOMapping" in body}
    assert flags == {"0", "1"}

    device = parser["DeviceInfo"]
    rpdos = [index for index in range(0x1400, 0x1600) if f"{index:04X}" in parser]
    tpdos = [index for index in range(0x1800, 0x1A00) if f"{index:04X}" in parser]
    assert int(device["NrOfRXPDO"]) == len(rpdos)
    assert int(device["NrOfTXPDO"]) == len(tpdos)

    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        listed = parser[name]
        count = int(listed["SupportedObjects"])
        assert len(listed) == count + 1
        for number in range(1, count + 1):
            assert listed[str(number)].removeprefix("0x") in parser
    for name, body in parser.items():
        if "SubNumber" in body:
            subs = [section for section in parser if section.startswith(f"{name}sub")]
            assert int(body["SubNumber"]) == len(subs)


@pytest.mark.parametrize("number", NODES)
def test_an_object_in_an_eds_has_only_the_options_of_cia_306(folder, number):
    parser = configparser.ConfigParser()
    parser.optionxform = str
    parser.read(eds_of(folder, number))
    objects = [body for name, body in parser.items() if "ParameterName" in body]
    assert len(objects) > 50
    for body in objects:
        assert set(body) <= OPTIONS, body


def test_units_and_factors_of_all_objects_are_in_a_table(rig, folder):
    with (folder / "objects.csv").open(encoding="utf-8", newline="") as file:
        rows = {(int(row["node"]), row["index"], row["sub"]): row for row in csv.DictReader(file)}
    count = 0
    for number, node in rig[0].items():
        for at, variable in node.objects.variables.items():
            row = rows[number, f"{at >> 8:04X}", f"{at & 0xFF:X}"]
            assert (row["name"], row["unit"]) == (variable.name, variable.unit)
            assert float(row["value_of_a_count"]) == pytest.approx(variable.factor, rel=1e-9)
            assert row["meaning"] == variable.description
            count += 1
    assert count == len(rows)


def tool(name, *arguments, folder):
    """Run a tool of another project in a folder; return its status and all that it prints."""
    program = shutil.which(name, path=str(Path(sys.executable).parent)) or shutil.which(name)
    if not program:
        pytest.skip(f"needs {name}: pip install dcf-tools objdictgen")
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.conformance("CiA 301", "EDS: accepted by dcfchk of Lely, without a remark")
@pytest.mark.parametrize("number", NODES)
def test_dcfchk_of_lely_finds_nothing_in_an_eds(folder, number):
    assert tool("dcfchk", "-n", number, eds_of(folder, number), folder=folder) == (0, "")


@pytest.mark.conformance("CiA 301", "EDS: accepted by the editor of CANfestival")
@pytest.mark.parametrize("number", NODES)
def test_the_editor_of_canfestival_lists_the_objects_of_an_eds(folder, number):
    status, text = tool("odg", "list", eds_of(folder, number), folder=folder)
    assert status == 0, text
    assert "ValueError" not in text
    assert "0x1018" in text


@pytest.mark.conformance(
    "CiA 301", "EDS: dcfgen of Lely makes the files of a master of three nodes"
)
def test_dcfgen_of_lely_makes_a_master_from_the_eds_files(folder):
    status, text = tool("dcfgen", "-r", "-d", folder, FIELD / "bus.yml", folder=folder)
    assert status == 0, text
    # the concise DCF: what the master writes into the drive at its boot-up
    assert (folder / "drive_1.bin").stat().st_size > 100
    assert (folder / "master.dcf").is_file()


def test_an_identifier_follows_the_node_number(folder):
    read = canopen.import_od(str(eds_of(folder, 16)), 40)
    assert read[0x1800][1].default == 0x180 + 40
    assert read[0x1014].default == 0x80 + 40


def test_the_same_dictionary_gives_the_same_file(rig):
    dictionary = rig[0][1].dictionary
    assert descriptions.eds(dictionary) == descriptions.eds(dictionary)


def test_cantools_decodes_the_frames_of_a_sync_into_the_signals_of_the_table(rig, folder):
    nodes, row = rig
    row[:] = np.nan
    row[TABLE.kept] = np.linspace(1.0, 40.0, len(TABLE.kept))
    row[TABLE.span("cylinder_pressure")] = [1e5, 2e5, 3e5, 3.8e5]
    row[TABLE.span("sand_rate")] = [0.01, 0.067, 0.1, 0.2]
    database = cantools.database.load_file(folder / "rig.dbc")
    decoded = {}
    for node in nodes.values():
        sent = []
        node.start(sent.append, 0)
        node.on_frame(Frame(NMT, b"\x01\0"))
        node.on_frame(Frame(SYNC, b""))
        for frame in sent:
            if TPDO[0] <= frame.can_id < SDO_REPLY:
                decoded |= database.decode_message(frame.can_id, frame.data)

    expected = expected_signals()
    assert set(expected) <= set(decoded)
    for name, place in expected.items():
        count = place.scale * (RATED_Nm if place.of else 1.0)
        true = row[TABLE.kept[TABLE.columns.index(name)]]
        assert decoded[name] == pytest.approx(true, abs=0.5001 * count)


def expected_signals():
    """Return the place of each column that the nodes send by default."""
    columns = {}
    for signal in TABLE.signals:
        if signal.direction != signals.OUT or not signal.places:
            continue
        place = signal.places[0]
        # the harness maps the PDOs of the bench; no default PDO has the counters
        if place.node == signals.BENCH_NODE or place.index == 0x2101:
            continue
        for name in signals.columns(signal):
            columns[name] = place
    return columns


def test_the_dbc_encodes_magnets_axle_by_axle(folder):
    database = cantools.database.load_file(folder / "rig.dbc")
    pairs = {"magnets_1": 3, "magnets_2": 0, "magnets_3": 1, "magnets_4": 2}
    assert database.encode_message("node_17_RPDO1", pairs) == bytes([0b10_01_00_11])


def test_the_dbc_names_the_magnets(folder):
    database = cantools.database.load_file(folder / "rig.dbc")
    decoded = database.decode_message("node_17_RPDO1", bytes([0b10_01_00_11]))
    assert [str(decoded[f"magnets_{axle}"]) for axle in range(1, 5)] == [
        "vent",
        "fill",
        "hold",
        "vent_without_hold",
    ]


def test_the_dbc_has_the_cycle_times_of_messages_that_are_sent_regularly(rig, tmp_path):
    dictionaries = [node.dictionary for node in rig[0].values()]
    descriptions.write(tmp_path, TABLE, dictionaries, sync_period_s=0.02)
    database = cantools.database.load_file(tmp_path / "rig.dbc")
    cycle_ms = {message.name: message.cycle_time for message in database.messages}
    assert cycle_ms["SYNC"] == 20
    assert cycle_ms["node_16_TPDO1"] == cycle_ms["node_17_RPDO1"] == 20
    assert cycle_ms["node_17_TPDO2"] is None  # after changes only
    heartbeat_ms = rig[0][16].dictionary[0x1017].default
    assert cycle_ms["axle_speed_unit_heartbeat"] == heartbeat_ms > 0
    assert cycle_ms["wsp_unit_heartbeat"] == 100


def test_a_unit_sends_only_its_messages_and_those_of_brakes_and_sanders_in_the_dbc(folder):
    database = cantools.database.load_file(folder / "rig.dbc")
    sent = {message.name for message in database.messages if "wsp_unit" in message.senders}
    assert sent == {"node_17_RPDO1", "node_18_RPDO1", "node_32_TPDO1", "wsp_unit_heartbeat"}
    (drive,) = database.get_message_by_name("node_1_RPDO1").senders
    assert drive == "bench"


def test_the_brake_demand_is_a_signal_of_the_dbc(rig, folder):
    nodes, row = rig
    database = cantools.database.load_file(folder / "rig.dbc")
    sent = []
    node = nodes[17]
    node.start(sent.append, 0)
    node.on_frame(Frame(NMT, b"\x01\0"))
    demands = []
    for pressure_Pa in (0.0, 3.8e5, 3.8e5, 1.2e5):
        row[signals.column("brake_demand")] = pressure_Pa
        node.on_frame(Frame(SYNC, b""))
    for frame in sent:
        if frame.can_id == TPDO[1] + 17:
            demands.append(database.decode_message(frame.can_id, frame.data)["brake_demand_Pa"])
    # with the SYNC after a change
    assert demands == pytest.approx([0.0, 3.8e5, 1.2e5])


def test_every_identifier_and_every_name_of_a_signal_is_in_the_dbc_only_once(folder):
    database = cantools.database.load_file(folder / "rig.dbc", strict=True)
    identifiers = [message.frame_id for message in database.messages]
    names = [signal.name for message in database.messages for signal in message.signals]
    assert len(set(identifiers)) == len(identifiers)
    assert len(set(names)) == len(names)


def test_the_signal_table_has_a_row_for_every_signal():
    text = descriptions.signal_table(TABLE)
    assert len(text.splitlines()) == len(TABLE.signals) + 2
    for signal in TABLE.signals:
        assert f"| `{signal.name}` |" in text
        for place in signal.places:
            assert f"{place.index:04X}h" in text
