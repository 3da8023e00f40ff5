"""The Modbus map: what stands where, and that the documents say what the devices do."""

import csv
import io

import numpy as np
import pytest
from modbus_site import MEASURED_SPEED, TABLE, WORDS, RATED_Nm

from rollerrig.firmware_sim.drive402 import drive as drive402
from rollerrig.firmware_sim.modbus import map
from rollerrig.firmware_sim.modbus.map import BIT, BITS
from rollerrig.wsp_interface import signals


@pytest.fixture(scope="module")
def drive():
    row = np.zeros(signals.WIDTH)
    return drive402.build(1, 1, row, {"rated_torque_Nm": RATED_Nm}).dictionary


def spaces(drive):
    return {"plc bits": BITS, "plc registers": WORDS, "drive": map.drive_registers(drive)}


def test_no_register_is_taken_twice_and_no_name_is_used_twice(drive):
    for rows in spaces(drive).values():
        taken = [row.address + i for row in rows for i in range(row.width)]
        assert len(taken) == len(set(taken))
        assert len({row.name for row in rows}) == len(rows)
    assert not {row.name for row in BITS} & {row.name for row in WORDS}


def test_bits_are_bits_and_registers_hold_integers(drive):
    for name, rows in spaces(drive).items():
        assert {row.kind for row in rows} <= (
            {BIT} if "bits" in name else {"U16", "I16", "U32", "I32"}
        )
        assert all(row.text for row in rows)
        assert all(row.scale > 0 for row in rows)


@pytest.mark.conformance(
    "Modbus", "speeds, pressures and temperatures with the scale of the CAN bus"
)
@pytest.mark.parametrize(
    "name",
    [
        "brake_demand",
        "cylinder_pressure",
        MEASURED_SPEED,
        "roller_speed",
        "motor_torque",
        "tooth_frequency",
        "pulse_count",
        "wsp_reference_speed",
    ],
)
def test_what_the_can_nodes_tell_has_the_same_scale_here(name):
    signal, rows = TABLE.by_name[name], [row for row in WORDS if row.signal == name]
    assert len(rows) == signal.axles
    for row in rows:
        place = signal.places[0]
        assert (row.kind, row.scale, row.unit) == (place.kind, place.scale, signal.unit)


def test_speeds_and_pressures_of_every_axle_have_registers():
    for name in (MEASURED_SPEED, "cylinder_pressure", "roller_speed", "motor_torque", "sliding"):
        assert [row.axle for row in WORDS if row.signal == name] == [1, 2, 3, 4]


def test_measured_ranges_hold_what_the_rig_can_do():
    most = {
        "vehicle_speed": 100.0,
        "position": 1e5,
        "time": 36000.0,
        "cylinder_pressure": 1e6,
        "brake_torque": 30000.0,
        "wheel_load": 3e5,
        "wheel_circumferential_speed": 100.0,
    }
    assert most.keys() <= {row.signal for row in WORDS}
    for row in WORDS:
        if row.signal in most:
            assert most[row.signal] / row.scale <= signals.KINDS[row.kind][1], row.name


def test_a_drives_rows_are_those_of_its_dictionary(drive):
    assert len(map.drive_registers(drive)) > 20
    for row in map.drive_registers(drive):
        variable = drive[row.od_index]
        assert row.scale == variable.factor
        assert row.access == "ro" or variable.writable
        assert row.width == (2 if len(variable) == 32 else 1)


@pytest.mark.conformance("Modbus", "map written by rollerrig devices")
def test_map_and_table_name_every_row_with_its_register(tmp_path, drive):
    drives = dict.fromkeys(TABLE.drive_nodes, drive)
    document, sheet = map.write(tmp_path, TABLE, drives, ("dry_stop", "velim_a1"))
    lines = list(csv.DictReader(io.StringIO(sheet.read_text())))
    assert len(lines) == len(BITS) + len(WORDS) + 4 * len(map.drive_registers(drive))
    found = {(line["unit"], line["space"], line["name"]): line for line in lines}
    speed = found["1", "registers", "speed_set_point"]
    assert (speed["register"], speed["scale"], speed["unit_of_value"]) == ("1", "0.01", "m/s")
    assert (speed["reference"], speed["access"]) == ("40002", "rw")
    assert found["13", "registers", "velocity_actual_value"]["register"] == "102..103"
    text = document.read_text()
    assert all(
        f"| {line['register']} | {line['reference']} | {line['name']} |" in text for line in lines
    )
    assert "| 1 | velim_a1 |" in text


def test_the_same_devices_give_the_same_document(drive):
    row = np.zeros(signals.WIDTH)
    again = drive402.build(1, 1, row, {"rated_torque_Nm": RATED_Nm}).dictionary
    assert map.markdown(TABLE, {1: drive}) == map.markdown(TABLE, {1: again})
