"""The brake I/O: magnets, fail-safe, pressures, brake demand. Real frames over the hub."""

import math

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim import io401
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code

TABLE = signals.table(COACH)
# NMT commands
START = 1
STOP = 2
RESET_NODE = 129
RESET_COMMUNICATION = 130
# energised magnets of an axle: bit 0 hold, bit 1 vent
FILL = 0b00
HOLD = 0b01
VENT = 0b11

UNIT_ALIVE = 0x720  # heartbeat of the WSP unit
MAGNETS = 0x211  # RPDO1


@pytest.fixture
def brake(wire):
    """The node, OPERATIONAL, with the WSP unit alive."""
    node = wire.brake()
    wire.nmt(START)
    wire.send(UNIT_ALIVE, b"\x05")
    return node


def magnets(wire):
    """Return the commanded magnets of each axle."""
    return wire.commands[: COACH.axles].tolist()


@pytest.mark.conformance("CiA 401", "digital outputs 6200h take effect immediately")
def test_a_magnet_command_takes_effect_immediately_and_once(wire, brake):
    wire.commands_taken.clear()
    wire.send(MAGNETS, [0b00_01_11_00])
    assert magnets(wire) == [FILL, VENT, HOLD, FILL]
    assert len(wire.commands_taken) == 1


@pytest.mark.conformance("CiA 401", "vent without hold is reported and treated as vent")
@pytest.mark.parametrize("axle", [1, 2, 3, 4])
def test_vent_without_hold_is_treated_as_vent_and_reported_once_per_occurrence(wire, brake, axle):
    vent_alone = 0b10 << 2 * (axle - 1)
    for byte in (vent_alone, vent_alone, 0, vent_alone):
        wire.send(MAGNETS, [byte])
    assert magnets(wire)[axle - 1] == VENT
    assert len(wire.reported(Code.MAGNETS_VENT_ALONE, axle=axle)) == 2


@pytest.mark.conformance("CiA 401", "fail-safe value on a lost heartbeat, EMCY 8130h")
def test_magnets_fall_off_200_ms_after_the_last_heartbeat_with_an_emcy(wire, brake):
    wire.send(MAGNETS, [0xFF])
    wire.take()
    wire.run(199)
    assert magnets(wire) == [VENT] * 4
    assert wire.take(0x91) == []
    wire.run(1)
    assert magnets(wire) == [FILL] * 4
    assert wire.take(0x91)[0][:2] == b"\x30\x81"
    assert wire.read(17, 0x6200, 1) == b"\0"
    assert wire.reported(Code.HEARTBEAT_LOST, partner=32)
    assert wire.reported(Code.MAGNETS_FAIL_SAFE, magnets=0)


@pytest.mark.conformance("CiA 401", "fail-safe value holds until the heartbeat is back")
def test_magnets_stay_at_the_fail_safe_value_until_the_heartbeat_is_back(wire, brake):
    wire.send(MAGNETS, [0xFF])
    wire.run(201)

    # commands are refused
    wire.send(MAGNETS, [0xFF])
    assert magnets(wire) == [FILL] * 4
    assert wire.write(17, 0x6200, 1, 0xFF, 1) == 0x08000022

    # the heartbeat alone energises nothing, a new command does
    wire.send(UNIT_ALIVE, b"\x05")
    assert magnets(wire) == [FILL] * 4
    wire.send(MAGNETS, [0xFF])
    assert magnets(wire) == [VENT] * 4
    assert wire.reported(Code.HEARTBEAT_BACK, partner=32)


@pytest.mark.conformance("CiA 401", "error mode 6206h and error value 6207h")
@pytest.mark.parametrize(
    ("mask", "value", "after"),
    [
        (0xFF, 0x05, [HOLD, HOLD, FILL, FILL]),
        (0x0F, 0x00, [FILL, FILL, VENT, VENT]),
        (0x00, 0x00, [VENT, VENT, VENT, VENT]),
    ],
)
def test_6206h_selects_the_magnets_that_take_the_value_of_6207h(wire, brake, mask, value, after):
    wire.write(17, 0x6206, 1, mask, 1)
    wire.write(17, 0x6207, 1, value, 1)
    wire.send(MAGNETS, [0xFF])
    wire.run(201)
    assert magnets(wire) == after


@pytest.mark.conformance("CiA 401", "fail-safe value when stopped or reset")
@pytest.mark.parametrize("command", [STOP, RESET_NODE, RESET_COMMUNICATION])
def test_magnets_fall_off_when_the_node_is_stopped_or_reset(wire, brake, command):
    wire.send(MAGNETS, [0xFF])
    wire.nmt(command, 17)
    assert magnets(wire) == [FILL] * 4


def test_without_a_first_heartbeat_no_unit_is_lost(wire):
    wire.brake()
    wire.nmt(START)
    wire.send(MAGNETS, [0xFF])
    wire.run(1000)
    assert magnets(wire) == [VENT] * 4


def test_the_node_stays_operational_when_the_unit_is_lost(wire, brake):
    wire.run(300)
    wire.take()
    wire.sync()
    assert len(wire.take(0x191)) == 1


@pytest.mark.conformance("CiA 401", "analogue inputs 6401h")
def test_cylinder_pressures_go_out_in_millibar_and_saturate(wire, brake):
    wire.row[TABLE.span("cylinder_pressure")] = [380_000.0, 0.0, 1e9, math.nan]
    wire.take()
    wire.sync()
    (data,) = wire.take(0x191)
    assert np.frombuffer(data, dtype="<i2").tolist() == [3800, 0, 32767, -32768]


@pytest.mark.conformance("CiA 401", "analogue output 6411h")
def test_6411h_reads_the_present_brake_demand_and_a_write_commands_another(wire, brake):
    assert math.isnan(wire.commands[io401.BRAKE_DEMAND])
    wire.row[signals.column("brake_demand")] = 250_000.0
    assert wire.read(17, 0x6411, 1) == (2500).to_bytes(2, "little")

    assert wire.write(17, 0x6411, 1, 3800, 2) == 0
    assert wire.commands[io401.BRAKE_DEMAND] == 380_000.0
    assert wire.read(17, 0x6411, 1) == (2500).to_bytes(2, "little")

    # too low, too high
    assert wire.write(17, 0x6411, 1, -1, 2) == 0x06090032
    assert wire.write(17, 0x6411, 1, 10_001, 2) == 0x06090031


def test_a_reset_forgets_the_brake_demand_of_the_bus(wire, brake):
    wire.write(17, 0x6411, 1, 3800, 2)
    wire.nmt(RESET_NODE, 17)
    assert math.isnan(wire.commands[io401.BRAKE_DEMAND])


@pytest.mark.conformance("CiA 401", "6423h global interrupt enable, analogue")
def test_analogue_inputs_are_sent_on_change_only_where_6423h_allows(wire, brake):
    wire.write(17, 0x1800, 2, 255, 1)  # event-driven
    wire.run(5)
    wire.take()
    pressure = signals.column("cylinder_pressure", 1)
    wire.row[pressure] = 100_000.0
    wire.run(5)
    assert wire.take(0x191) == []

    wire.write(17, 0x6423, 0, 1, 1)
    wire.row[pressure] = 200_000.0
    wire.run(5)
    assert len(wire.take(0x191)) == 1


@pytest.mark.conformance("CiA 401", "digital inputs 6000h read the outputs back")
def test_the_energised_magnets_can_be_read_back(wire, brake):
    wire.send(MAGNETS, [0x0D])
    assert wire.read(17, 0x6000, 1) == b"\x0d"
