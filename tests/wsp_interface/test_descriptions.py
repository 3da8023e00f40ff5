"""EDS, DBC and the signal table: other people's parsers read them as the nodes are."""

import configparser

import canopen
import cantools
import numpy as np
import pytest

from rollerrig.firmware_sim import encoder406, io401, sander401
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.wsp_interface import descriptions, signals
from rollerrig.wsp_interface.bus.frames import Frame

RATED_Nm = 5000.0


@pytest.fixture
def rig():
    """Nodes by number, and the live row they read."""
    row = np.zeros(len(signals.COLUMNS))
    nodes = [
        drive.build(node, axle, row, {"rated_torque_Nm": RATED_Nm})
        for axle, node in enumerate(signals.DRIVE_NODES, 1)
    ]
    nodes += [
        encoder406.build(row),
        io401.build(row, np.zeros(io401.COMMANDS)),
        sander401.build(row, np.zeros(signals.AXLES)),
    ]
    return {node.node_id: node for node in nodes}, row


@pytest.fixture
def folder(rig, tmp_path):
    descriptions.write(tmp_path, [node.dictionary for node in rig[0].values()])
    return tmp_path


def eds_of(folder, number):
    (found,) = folder.glob(f"node_{number:03d}_*.eds")
    return found


@pytest.mark.conformance("CiA 301", "EDS: canopen reads the objects that the node has")
@pytest.mark.parametrize("number", [1, 2, 3, 4, 16, 17, 18])
def test_canopen_reads_from_the_eds_the_same_objects_that_the_node_has(rig, folder, number):
    node = rig[0][number]
    read = canopen.import_od(str(eds_of(folder, number)), number)
    for at, variable in node.objects.variables.items():
        same = read.get_variable(at >> 8, at & 0xFF)
        for name in (
            "name",
            "data_type",
            "access_type",
            "pdo_mappable",
            "min",
            "max",
            "unit",
            "description",
        ):
            assert getattr(same, name) == getattr(variable, name), (hex(at), name)
        assert same.factor == pytest.approx(variable.factor, rel=1e-9)
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
    about = parser["DeviceInfo"]
    assert int(about["NrOfRXPDO"]) == sum(f"{at:04X}" in parser for at in range(0x1400, 0x1600))
    assert int(about["NrOfTXPDO"]) == sum(f"{at:04X}" in parser for at in range(0x1800, 0x1A00))
    for name in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        listed = parser[name]
        count = int(listed["SupportedObjects"])
        assert len(listed) == count + 1
        assert all(listed[str(at)][2:] in parser for at in range(1, count + 1))
    for name, body in parser.items():
        if "SubNumber" in body:
            assert int(body["SubNumber"]) == sum(one.startswith(f"{name}sub") for one in parser)


def test_an_identifier_that_follows_the_node_number_says_so(folder):
    read = canopen.import_od(str(eds_of(folder, 16)), 40)
    assert read[0x1800][1].default == 0x180 + 40
    assert read[0x1014].default == 0x80 + 40


def test_the_same_dictionary_gives_the_same_file(rig):
    dictionary = rig[0][1].dictionary
    assert descriptions.eds(dictionary) == descriptions.eds(dictionary)


def test_cantools_decodes_the_frames_of_a_sync_into_the_signals_of_the_table(rig, folder):
    nodes, row = rig
    row[:] = np.linspace(1.0, 40.0, len(row))
    row[signals.span("cylinder_pressure")] = [1e5, 2e5, 3e5, 3.8e5]
    row[signals.span("sand_rate")] = [0.01, 0.067, 0.1, 0.2]
    base = cantools.database.load_file(folder / "rig.dbc")
    decoded = {}
    for node in nodes.values():
        sent = []
        node.start(sent.append, 0)
        for can_id, data in ((0, b"\x01\0"), (0x80, b"")):
            node.on_frame(Frame(can_id, data))
        for frame in sent:
            if 0x180 <= frame.can_id < 0x580:
                decoded |= base.decode_message(frame.can_id, frame.data)
    expected = {
        name
        for signal in signals.SIGNALS
        if signal.direction == signals.OUT
        for place in signal.places[:1]
        if place.index not in (0x6411, 0x2101)
        and place.node != signals.BENCH_NODE  # its PDOs are the harness's to map
        for name in signals.columns(signal)
    }
    assert expected <= set(decoded)
    for name in expected:
        signal = next(one for one in signals.SIGNALS if name in signals.columns(one))
        place = signal.places[0]
        count = place.scale * (RATED_Nm if place.of else 1.0)
        assert decoded[name] == pytest.approx(row[signals.COLUMNS.index(name)], abs=0.5001 * count)


def test_the_dbc_encodes_magnets_axle_by_axle(folder):
    base = cantools.database.load_file(folder / "rig.dbc")
    wanted = {"magnets_1": 3, "magnets_2": 0, "magnets_3": 1, "magnets_4": 2}
    assert base.encode_message("node_17_RPDO1", wanted) == bytes([0b10_01_00_11])


def test_every_identifier_of_the_dbc_stands_once_and_every_name_of_a_signal_too(folder):
    base = cantools.database.load_file(folder / "rig.dbc", strict=True)
    identifiers = [message.frame_id for message in base.messages]
    names = [signal.name for message in base.messages for signal in message.signals]
    assert len(set(identifiers)) == len(identifiers)
    assert len(set(names)) == len(names)


def test_the_signal_table_has_a_row_for_every_signal():
    text = descriptions.signal_table()
    assert len(text.splitlines()) == len(signals.SIGNALS) + 2
    for signal in signals.SIGNALS:
        assert f"| `{signal.name}` |" in text
        for place in signal.places:
            assert f"{place.index:04X}h" in text
