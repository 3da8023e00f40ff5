"""LSS and stored parameters, with the LSS master of canopen over the hub."""

import struct
from collections.abc import Callable
from typing import NamedTuple

import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import encoder406, io401
from rollerrig.firmware_sim.cia301.lss import UNCONFIGURED
from rollerrig.firmware_sim.cia301.objects import AbortError
from rollerrig.firmware_sim.drive402 import drive
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
# signatures of 1010h and 1011h
SAVE = int.from_bytes(b"save", "little")
LOAD = int.from_bytes(b"load", "little")
# NMT commands
START = 1
RESET_NODE = 129
RESET_COMMUNICATION = 130

NOT_PARAMETERS = {0x1003, 0x1010, 0x1011}  # history of errors, store, restore
FILLER = 0x00050008  # an unsigned byte in a receive PDO


class NodeWithMemory(NamedTuple):
    """A node whose parameters are stored.

    `build(wire, file)` makes it. `not_stored`: objects that are commands or have a live source.
    `mappable`: an entry that the mapping of a PDO may have.
    """

    build: Callable
    not_stored: set[int]
    mappable: int


NODES = {
    "drive": NodeWithMemory(
        build=lambda wire, file: drive.build(2, 2, wire.row, storage=file),
        not_stored={0x2000, 0x6040, 0x6060, 0x6071, 0x60B1, 0x60B2, 0x60FE, 0x60FF},
        mappable=0x60410010,
    ),
    "encoder": NodeWithMemory(
        build=lambda wire, file: encoder406.build(TABLE, wire.row, storage=file),
        not_stored={0x6200},
        mappable=0x60300110,
    ),
    "brake": NodeWithMemory(
        build=lambda wire, file: io401.build(TABLE, wire.row, wire.commands, storage=file),
        not_stored={0x6200, 0x6411},
        mappable=0x62000108,
    ),
}


@pytest.fixture
def lss(wire, monkeypatch):
    """The LSS master."""
    # canopen's master sleeps between messages for slow devices
    monkeypatch.setattr("canopen.lss.time.sleep", lambda seconds: None)
    wire.master.lss.RESPONSE_TIMEOUT = 0.001
    wire.master.subscribe(0x7E4, wire.master.lss.on_message_received)
    return wire.master.lss


def identity(node):
    """Return the four numbers of 1018h: vendor, product, revision, serial number."""
    return [node.objects.get(0x1018, sub) for sub in range(1, 5)]


@pytest.mark.conformance("CiA 305", "LSS switch state selective, configure node-ID")
def test_a_node_is_selected_by_its_identity_and_gets_a_new_identifier(wire, lss):
    node = wire.encoder()
    wire.brake()
    assert lss.send_switch_state_selective(*identity(node))
    assert lss.inquire_node_id() == 16
    lss.configure_node_id(40)
    assert lss.inquire_node_id() == 16
    lss.send_switch_state_global(lss.WAITING_STATE)
    wire.take()

    # the identifier becomes active with the reset, also in COB-IDs
    wire.nmt(RESET_COMMUNICATION, 16)
    assert wire.take(0x728) == [b"\0"]
    assert wire.read(40, 0x1000) == b"\x96\x01\x0a\x00"
    assert wire.read(40, 0x1800, 1) == b"\xa8\x01\0\0"
    wire.nmt(START, 40)
    wire.take()
    wire.sync()
    assert len(wire.take(0x1A8)) == 1


@pytest.mark.conformance("CiA 305", "LSS refuses a node-ID out of range")
def test_an_identifier_that_is_not_allowed_is_refused(wire, lss):
    wire.encoder()
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    for node_id in (0, 128, 254):
        with pytest.raises(Exception, match="1"):
            lss.configure_node_id(node_id)


@pytest.mark.parametrize(("outside", "answers"), [(0, True), (1, False)])
def test_a_node_answers_to_a_range_that_contains_its_numbers(wire, lss, outside, answers):
    vendor, product, revision, serial = identity(wire.encoder())
    for command, number in (
        (0x46, vendor),
        (0x47, product),
        (0x48, revision),
        (0x49, revision),
        (0x4A, serial + outside),
        (0x4B, serial + outside),
    ):
        wire.send(0x7E5, struct.pack("<BI3x", command, number))
    assert wire.take(0x7E4) == [b"\x4f" + bytes(7)] * answers


@pytest.mark.conformance("CiA 305", "LSS fastscan")
def test_fastscan_finds_a_node_without_identifier(wire, lss):
    node = encoder406.build(TABLE, wire.row)
    node.lss.pending = UNCONFIGURED
    wire.plug(node)
    wire.drive(1)
    assert wire.take(0x7FF) == []
    is_found, numbers = lss.fast_scan()
    assert is_found
    assert numbers == identity(node)
    lss.configure_node_id(16)
    wire.take()
    lss.send_switch_state_global(lss.WAITING_STATE)
    assert wire.take(0x710) == [b"\0"]


@pytest.mark.conformance("CiA 305", "LSS fastscan is for nodes without node-ID")
def test_a_configured_node_does_not_answer_a_fastscan(wire, lss):
    wire.encoder()
    assert lss.fast_scan() == (False, None)


@pytest.mark.conformance("CiA 301", "store parameters, 1010h")
def test_stored_parameters_outlive_a_reset_and_a_new_start(wire, tmp_path):
    file = tmp_path / "node16.json"
    wire.encoder(storage=file)
    wire.write(16, 0x1017, 0, 33, 2)
    assert wire.write(16, 0x1010, 1, SAVE, 4) == 0
    wire.write(16, 0x1017, 0, 44, 2)
    wire.nmt(RESET_NODE, 16)
    assert wire.read(16, 0x1017) == b"\x21\0"
    wire.nodes.clear()
    restarted = encoder406.build(TABLE, wire.row, storage=file)
    restarted.start(lambda frame: None, 0)
    assert restarted.objects.get(0x1017) == 33


@pytest.mark.conformance("CiA 301", "restore defaults, 1011h")
def test_restored_defaults_take_effect_with_the_reset(wire, tmp_path):
    wire.brake(storage=tmp_path / "node17.json")
    wire.write(17, 0x1017, 0, 33, 2)
    wire.write(17, 0x6207, 1, 5, 1)
    wire.write(17, 0x1010, 1, SAVE, 4)
    assert wire.write(17, 0x1011, 2, LOAD, 4) == 0
    assert wire.read(17, 0x1017) == b"\x21\0"
    wire.nmt(RESET_NODE, 17)
    assert wire.read(17, 0x1017) == b"\x64\0"
    assert wire.read(17, 0x6207, 1) == b"\x05"


@pytest.mark.conformance("CiA 301", "1010h stores parameters, no commands")
def test_commands_are_not_stored(wire, tmp_path):
    wire.brake(storage=tmp_path / "node17.json")
    wire.write(17, 0x6200, 1, 3, 1)
    wire.write(17, 0x1010, 1, SAVE, 4)
    wire.nmt(RESET_NODE, 17)
    assert wire.read(17, 0x6200, 1) == b"\0"


@pytest.mark.conformance("CiA 301", "1010h stores every parameter, mappable ones too")
@pytest.mark.parametrize("kind", NODES)
def test_every_parameter_of_every_node_outlives_a_power_cycle(wire, tmp_path, kind):
    case = NODES[kind]
    file = tmp_path / "node.json"
    node = wire.plug(case.build(wire, file))
    parameters = parameters_of(node, case.not_stored)
    unchanged = change_all(node, parameters, case.mappable)
    # only the type of a torque profile has no other value
    assert {at >> 8 for at in unchanged} <= {0x6088}

    written = {at: node.objects.values[at] for at in parameters}
    assert wire.write(node.node_id, 0x1010, 1, SAVE, 4) == 0
    node.power_off()
    restarted = case.build(wire, file)
    restarted.start(lambda frame: None, 0)
    assert {at: restarted.objects.values[at] for at in written} == written


def parameters_of(node, not_stored):
    """Return the keys of the objects that 1010h must store."""
    parameters = []
    for at, variable in node.objects.variables.items():
        index = at >> 8
        changeable = variable.writable and variable.readable
        if changeable and index not in NOT_PARAMETERS and index not in not_stored:
            parameters.append(at)
    return parameters


def change_all(node, parameters, mappable):
    """Change every parameter; return the keys of those that cannot be changed."""
    # the highest index first, because 1019h is refused when 1006h is not 0
    unchanged = parameters[::-1]
    while True:
        # several rounds, because a mapping is refused while it is in use
        refused = [at for at in unchanged if not change(node, at, mappable)]
        if len(refused) == len(unchanged):
            return refused
        unchanged = refused


def change(node, at, mappable):
    """Give an object another value by a download; return whether one was accepted."""
    variable = node.objects.variables[at]
    present = node.objects.values[at]
    for value in (
        0,
        present + 1,
        present + 2,
        present - 1,
        present ^ 1 << 31,
        mappable,
        FILLER,
    ):
        if value == present:
            continue
        try:
            data = variable.encode_raw(value)
            node.objects.download(variable.index, variable.subindex, data)
        except (AbortError, ValueError, struct.error):
            continue
        return True
    return False


@pytest.mark.conformance("CiA 301", "1010h: a damaged file does no harm")
@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        '{"101700": 3}',
        '{"values": [], "checksum": 0}',
        "\0\0",
        '{"values": {"1A0000": 200}, "checksum": 0}',
    ],
)
def test_a_damaged_store_has_no_effect(wire, tmp_path, content):
    file = tmp_path / "node16.json"
    file.write_text(content)
    wire.encoder(storage=file)
    wire.nmt(START, 16)
    wire.sync()
    assert wire.read(16, 0x1017) == b"\x64\0"


@pytest.mark.conformance("CiA 301", "1010h without memory: 08000020")
def test_a_node_without_memory_refuses_to_store(wire):
    wire.encoder()
    assert wire.write(16, 0x1010, 1, SAVE, 4) == 0x08000020
    assert wire.read(16, 0x1010, 1) == bytes(4)


@pytest.mark.conformance("CiA 305", "LSS store configuration")
def test_an_identifier_stored_by_lss_outlives_a_new_start_and_stored_parameters_stay(
    wire, lss, tmp_path
):
    file = tmp_path / "memory" / "node16.json"
    node = wire.encoder(storage=file)
    wire.write(16, 0x1017, 0, 33, 2)
    assert wire.write(16, 0x1010, 1, SAVE, 4) == 0
    assert lss.send_switch_state_selective(*identity(node))
    lss.configure_node_id(40)
    lss.configure_bit_timing(3)
    lss.store_configuration()
    lss.send_switch_state_global(lss.WAITING_STATE)

    restarted = encoder406.build(TABLE, wire.row, storage=file)
    wire.take()
    wire.plug(restarted)
    assert wire.take(0x728) == [b"\0"]
    assert wire.read(40, 0x1017) == b"\x21\0"
    assert restarted.lss.bit_timing == 3

    # 1011h restores parameters, but not the identifier
    assert wire.write(40, 0x1011, 1, LOAD, 4) == 0
    with_defaults = encoder406.build(TABLE, wire.row, storage=file)
    with_defaults.start(lambda frame: None, 0)
    assert with_defaults.node_id == 40
    assert with_defaults.objects.get(0x1017) == 100


@pytest.mark.conformance("CiA 305", "LSS store configuration without memory: error 1")
def test_a_node_without_memory_reports_an_error_to_lss_and_forgets_the_identifier(wire, lss):
    wire.encoder()
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    lss.configure_node_id(40)
    with pytest.raises(Exception, match="1"):
        lss.store_configuration()
    restarted = encoder406.build(TABLE, wire.row)
    restarted.start(lambda frame: None, 0)
    assert restarted.node_id == 16


@pytest.mark.conformance("CiA 305", "LSS store configuration: no access to the memory, error 2")
def test_a_memory_that_cannot_be_written_is_reported_to_lss(wire, lss, tmp_path):
    (tmp_path / "file").write_text("")  # and no folder
    wire.encoder(storage=tmp_path / "file" / "node16.json")
    lss.send_switch_state_global(lss.CONFIGURATION_STATE)
    with pytest.raises(Exception, match="2"):
        lss.store_configuration()
