"""The Modbus map of vehicles with motors, magnets or more than four axles, and of the coach.

A client of pymodbus reads the registers of a running bench. What it has read is then compared with
the recorded channels.
"""

import csv
import json
import re
import time

import numpy as np
import program
import pyarrow.parquet
import pytest
from program import BOTH_BRAKES, LONGEST_S
from pymodbus.client import ModbusTcpClient

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.modbus.map import MotorState, words
from rollerrig.wsp_interface import signals

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

ILLEGAL_ADDRESS = 2
MOST_REGISTERS = 125
# the fault of motors, and how many counts a rounded value may differ from a channel
DYNAMIC_BRAKE_LOST = "dynamic_brake_lost"
ROUNDING = 0.51

OF_MOTORS = ("dynamic_torque_demand", "dynamic_torque", "dynamic_share", "friction_demand")
OF_MAGNETS = (
    "track_brake_demand",
    "track_brake_lowered",
    "track_brake_force",
    "track_brake_cleaning",
)


def rollerrig(*words):
    """Run the program; its exit status must be 0."""
    status, _, messages = program.rollerrig(*words)
    assert status == 0, messages


def rows_of(scenario, folder):
    """The registers of unit 1 by name, as `rollerrig devices` writes them."""
    rollerrig("devices", "--scenario", scenario, "--out", folder)
    lines = csv.DictReader((folder / "modbus.csv").read_text(encoding="utf-8").splitlines())
    return {
        line["name"]: line for line in lines if line["unit"] == "1" and line["space"] == "registers"
    }


def first_register(line):
    return int(line["register"].split("..")[0])


# the trams that are played
PLAYED = pytest.mark.parametrize(
    "tram", ["tram_low_dynamic", "tram_emergency_magnetic"], indirect=True
)


@pytest.fixture(scope="module", params=[BOTH_BRAKES])
def tram(request, tmp_path_factory):
    return request.param, rows_of(request.param, tmp_path_factory.mktemp("devices") / "tram")


@pytest.mark.conformance(
    "Modbus", "a vehicle with motors, magnets or further groups moves no register of the coach"
)
def test_the_registers_of_the_leading_group_are_those_of_the_coach(tram):
    _, rows = tram
    for row in words(signals.table(COACH)):
        line = rows[row.name]
        assert (first_register(line), line["kind"]) == (row.address, row.kind), row.name
        assert line["scale"].split()[0] == f"{row.scale:.6g}"


def test_a_further_group_has_the_registers_of_the_leading_one_a_thousand_higher(tram):
    _, rows = tram
    for name in ("cylinder_pressure", "valve", "roller_speed", "pulse_count", "disc_temperature"):
        for axle in (5, 6):
            leading = first_register(rows[f"{name}_{axle - 4}"])
            assert first_register(rows[f"{name}_{axle}"]) == leading + 1000
    assert first_register(rows["wsp_reference_speed_2"]) == 1207
    assert first_register(rows["wsp_unit_2_state"]) == 1102
    assert first_register(rows["node_33_state"]) == 1103
    assert first_register(rows["node_49_state"]) == 1108


def test_no_register_of_a_vehicle_with_motors_or_magnets_is_taken_twice(tram):
    _, rows = tram
    taken = []
    for line in rows.values():
        first, _, last = line["register"].partition("..")
        taken += range(int(first), int(last or first) + 1)
    assert len(taken) == len(set(taken))


class Bench:
    """`rollerrig run` in real time as a process, and a client of its Modbus server."""

    def __init__(self, scenario, folder, *more):
        self.folder = folder
        self.messages = folder.with_suffix(".messages")
        words = [
            *("run", scenario, "--start", "modbus", "--wsp", "reference", "--json"),
            *("--set", "bus.interface=hub", "--set", "bus.socketcand_port=0"),
            *("--set", "modbus.port=0", "--set", "loop.record_hz=1000"),
            *("--out", str(folder), *more),
        ]
        self.process = program.start(words, folder.with_suffix(".printed"), self.messages)
        self.client = self.connected()

    def connected(self):
        deadline = time.monotonic() + LONGEST_S
        while time.monotonic() < deadline and self.process.poll() is None:
            found = re.search(r"unit 1 on 127\.0\.0\.1:(\d+)\n", self.messages.read_text())
            if found:
                client = ModbusTcpClient("127.0.0.1", port=int(found[1]), timeout=60.0)
                assert client.connect()
                return client
            time.sleep(0.1)
        raise AssertionError(self.messages.read_text())

    def registers(self, first, count):
        answer = self.client.read_input_registers(first, count=count, device_id=1)
        assert not answer.isError(), answer
        return answer.registers

    def value(self, line):
        """The value of a row of the map in its unit."""
        width = 2 if line["kind"] in ("U32", "I32") else 1
        raw = 0
        for word in self.registers(first_register(line), width):
            raw = raw << 16 | word
        bits = 16 * width
        if line["kind"].startswith("I") and raw >> (bits - 1):
            raw -= 1 << bits
        return raw * float(line["scale"].split()[0])

    def until(self, line, wanted):
        deadline = time.monotonic() + LONGEST_S
        while not wanted(self.value(line)):
            assert time.monotonic() < deadline, f"{line['name']} stays at {self.value(line)}"
            time.sleep(0.02)

    def close(self):
        self.client.close()
        self.process.wait(timeout=LONGEST_S)

    def kill(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


@pytest.mark.nightly
@PLAYED
@pytest.mark.conformance("Modbus", "motors and magnets of every axle hold the recorded channels")
def test_every_register_of_motors_and_magnets_holds_its_channel_while_a_tram_brakes(tram, tmp_path):
    scenario, rows = tram
    prefixes = ("dynamic_", "friction_demand", "traction_demand", "track_brake_")
    lines = [line for line in rows.values() if line["name"].startswith(prefixes)]
    # both groups, every axle
    names = OF_MOTORS if scenario == "tram_low_dynamic" else OF_MAGNETS
    for name in names:
        assert [line["name"] for line in lines if re.fullmatch(rf"{name}_\d", line["name"])] == [
            f"{name}_{axle}" for axle in range(1, 7)
        ]

    bench = Bench(scenario, tmp_path / "run", "--set", "duration_max_s=60")
    try:
        clock = rows["time"]
        bench.until(rows["state"], lambda state: state == 1.0)
        bench.client.write_coil(0, True, device_id=1)
        seen = []
        for read_at_s in (2.0, 4.0, 6.0):
            bench.until(clock, lambda time_s, at_s=read_at_s: time_s > at_s)
            for line in lines:
                before_s = bench.value(clock)
                value = bench.value(line)
                seen.append((line, value, before_s, bench.value(clock)))
        bench.client.write_coil(1, True, device_id=1)
    finally:
        bench.close()
        bench.kill()
    check_against_channels(bench.folder, seen)


def check_against_channels(folder, seen):
    """Check that each value is that of its channel between the times before and after the read."""
    table = pyarrow.parquet.read_table(folder / "channels.parquet")
    time_s = table["time_s"].to_numpy()
    not_zero = 0
    for line, value, before_s, after_s in seen:
        unit = line["unit_of_value"].replace("/", "_")
        column = f"{line['name']}_{unit}" if unit else line["name"]
        # the bus sends its row with each SYNC, so the row may be a period older than its time
        inside = (time_s >= before_s - 0.002) & (time_s <= after_s + 0.002)
        channel = table[column].to_numpy()[inside]
        step = ROUNDING * float(line["scale"].split()[0])
        assert channel.min() - step <= value <= channel.max() + step, (
            line["name"],
            value,
            before_s,
        )
        not_zero += value != 0.0
    # a map that only has zeros would pass too
    assert not_zero > len(seen) / 4


@pytest.mark.nightly
def test_the_state_of_a_motor_follows_slide_control_and_faults(tmp_path):
    rows = rows_of("tram_low_dynamic", tmp_path / "devices")
    document = (tmp_path / "devices" / "modbus.md").read_text(encoding="utf-8")
    number = int(re.search(rf"\| (\d+) \| {DYNAMIC_BRAKE_LOST} \|", document)[1])
    bench = Bench("tram_low_dynamic", tmp_path / "run")
    try:
        bench.until(rows["state"], lambda state: state == 1.0)
        states = [bench.value(rows[f"motor_state_{axle}"]) for axle in range(1, 7)]
        permitted = MotorState.PERMITTED
        # the tram has motors in its end bogies
        assert states == [permitted, permitted, 0, 0, permitted, permitted]
        bench.client.write_coil(0, True, device_id=1)
        bench.until(rows["motor_state_1"], lambda state: state == MotorState.RELEASED)

        bench.client.write_register(20, number, device_id=1)
        bench.client.write_register(21, 6, device_id=1)
        assert not bench.client.write_coil(16, True, device_id=1).isError()
        bench.until(rows["motor_state_6"], lambda state: state == MotorState.FAILED)
        bench.until(rows["dynamic_torque_6"], lambda torque_Nm: torque_Nm == 0.0)
        bench.client.write_coil(1, True, device_id=1)
    finally:
        bench.close()
        bench.kill()
    events = (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8").splitlines()
    assert any(json.loads(event).get("code") == "fault.begins" for event in events)


@pytest.mark.conformance("Modbus", "registers that a vehicle does not have: exception 02")
def test_the_coach_answers_that_registers_of_motors_magnets_and_further_groups_do_not_exist(
    tmp_path,
):
    bench = Bench("dry_stop", tmp_path / "run")
    try:
        for address in (500, 512, 540, 560, 1102, 1220, 1500):
            answer = bench.client.read_input_registers(address, count=1, device_id=1)
            assert answer.exception_code == ILLEGAL_ADDRESS
        assert np.isfinite(bench.registers(200, 91)).all()
        bench.client.write_coil(1, True, device_id=1)
    finally:
        bench.close()
        bench.kill()
