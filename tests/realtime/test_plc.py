"""The PLC of a running bench: a Modbus client alone runs a scenario from start to stop."""

import asyncio
import json
import re
import socket
import struct
import time

import bench_process
import can
import program
import pytest
from pymodbus.client import AsyncModbusTcpClient

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.modbus.map import BITS, State, words
from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import own_bench, signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import FRICTION, FRICTION_SCALE

ADDRESS_OF = {row.name: row.address for row in (*BITS, *words(signals.table(COACH)))}
BIT_NAMES = {row.name for row in BITS}
# time-outs of wall time, for a busy machine
START_S = 240.0
END_S = 240.0
# exception codes of Modbus
ILLEGAL_VALUE = 3
BUSY = 6
# the modules of the four drives: unit identifiers of Modbus, and the statusword there
DRIVE_UNITS = (11, 12, 13, 14)
STATUSWORD = 100
# the state bits of a statusword, and two states
STATE_BITS = 0x6F
OPERATION_ENABLED = 0x27
SWITCH_ON_DISABLED = 0x40


class Rig:
    """`rollerrig run` as a separate process, and a client of its PLC."""

    def __init__(self, out, *more, unit="none"):
        self.out = out
        self.runner = asyncio.Runner()
        words = [
            "run",
            "dry_stop",
            "--wsp",
            unit,
            "--set",
            "bus.interface=hub",
            "--set",
            "bus.socketcand_port=0",
            "--out",
            str(out),
            "--json",
            *more,
        ]
        self.stderr_path = out.with_suffix(".stderr")
        self.stdout_path = out.with_suffix(".stdout")
        self.process = program.start(words, self.stdout_path, self.stderr_path)

    def connect(self):
        deadline = time.monotonic() + START_S
        while time.monotonic() < deadline and self.process.poll() is None:
            printed = self.stderr_path.read_text()
            found = re.search(r"unit 1 on 127\.0\.0\.1:(\d+)\n", printed)
            if found:
                self.port = int(found[1])
                self.client = self.runner.run(self.connected_client())
                return
            time.sleep(0.1)
        raise AssertionError(self.stderr_path.read_text())

    async def connected_client(self):
        client = AsyncModbusTcpClient(
            "127.0.0.1", port=self.port, timeout=60.0, reconnect_delay=0.0
        )
        assert await client.connect()
        return client

    def request(self, function, *arguments, device_id=1, **more):
        """The answer to a request; `function` is a method of the client of pymodbus."""
        method = getattr(self.client, function)
        return self.runner.run(method(*arguments, device_id=device_id, **more))

    def read(self, name, count=1):
        answer = self.request("read_input_registers", ADDRESS_OF[name], count=count)
        return answer.registers[0] if count == 1 else answer.registers

    def bit(self, name):
        return self.request("read_coils", ADDRESS_OF[name], count=1).bits[0]

    def write(self, name, value):
        """Write a register; return the exception code, or 0."""
        return self.request("write_register", ADDRESS_OF[name], value & 0xFFFF).exception_code

    def set(self, name, on=True):
        return self.request("write_coil", ADDRESS_OF[name], on).exception_code

    def until(self, name, wanted, patience_s=120.0):
        """Read a value until it is as wanted; return it."""
        deadline = time.monotonic() + patience_s
        is_bit = ADDRESS_OF[name] < 8 and name in BIT_NAMES
        while time.monotonic() < deadline:
            value = self.bit(name) if is_bit else self.read(name)
            if wanted(value):
                return value
            time.sleep(0.05)
        raise AssertionError(f"{name} stays at {value}")

    def result(self):
        status = self.process.wait(END_S)
        return status, json.loads(self.stdout_path.read_text())

    def close(self):
        self.runner.close()
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(END_S)


HELD = ("--start", "modbus", "--set", "modbus.port=0")


@pytest.fixture
def rig(tmp_path):
    started = []

    def start(*more, **unit):
        started.append(Rig(tmp_path / "run", *more, **unit))
        return started[-1]

    yield start
    for one in started:
        one.close()


@pytest.mark.conformance("Modbus", "a Modbus client alone runs a scenario from start to stop")
def test_a_modbus_client_alone_runs_a_scenario_from_start_to_stop(rig):
    one = rig(*HELD, "--set", "initial_speed_m_s=6")
    one.connect()
    one.until("state", lambda state: state == State.HELD)

    # the rig rolls and its bus works, while the time of the run stands still
    assert one.read("vehicle_speed") == 600
    frames = one.read("bus_frames", 2)
    assert one.until("held", bool)

    # choose another scenario and another speed
    wanted = own_bench.scenarios_of(COACH).index("step_adhesion")
    assert one.write("scenario", wanted) == 0
    one.until("state", lambda state: state == State.HELD)
    assert one.read("scenario") == wanted
    assert one.write("scenario", 999) == ILLEGAL_VALUE
    assert one.write("speed_set_point", 20) == ILLEGAL_VALUE
    assert one.write("speed_set_point", 8100) == ILLEGAL_VALUE  # the rollers reach 80 m/s
    assert one.write("speed_set_point", 500) == 0
    assert one.write("brake_demand_set_point", 0) == 0
    one.until("at_set_speed", bool)
    assert one.read("bus_frames", 2) > frames
    assert one.read("time", 2) == [0, 0]

    # an emergency stop prevents the start
    assert one.set("emergency_stop") == 0
    assert one.set("run") == BUSY
    assert one.set("emergency_stop", False) == 0
    one.until("at_set_speed", bool)

    # the run begins without brakes, because the set point over Modbus is 0
    assert one.set("run") == 0
    one.until("state", lambda state: state == State.RUNNING)
    assert one.bit("run")
    one.until("time", lambda _: one.read("time", 2)[1] > 1000)
    assert one.read("cylinder_pressure_1") == 0
    assert one.read("vehicle_speed") > 490
    assert one.write("speed_set_point", 600) == BUSY
    assert one.write("scenario", 0) == BUSY

    # an emergency stop brakes
    assert one.set("emergency_stop") == 0
    one.until("cylinder_pressure_1", lambda mbar: mbar > 200)
    one.until("state", lambda state: state == State.ENDED)
    status, summary = one.result()
    check_emergency_stop(status, summary)
    assert summary["stopped"] is True
    assert summary["scenario"] == "step_adhesion"
    assert summary["initial_speed_m_s"] == pytest.approx(5.0, abs=0.01)
    assert summary["modbus"]["requests"] > 30
    codes = [event["code"] for event in summary["events"]]
    assert Code.RUN_STARTED in codes
    assert Code.EMERGENCY_STOP_SET in codes
    check_record(one.out, summary)


def check_emergency_stop(status, summary):
    """Check that the run is not valid, because its stop is not that of the brakes."""
    assert status == 4
    assert summary["valid"] is False
    (reason,) = summary["invalid_because"]
    assert "the emergency stop was set over Modbus while the coach rolled, at " in reason


def check_record(folder, summary):
    """Check that the record begins at 0, without the time while the rig was held."""
    run = records.load(folder)
    time_s = run.column("time_s")
    speed = run.column("vehicle_speed_m_s")
    assert time_s[0] == 0.0
    assert speed[0] == pytest.approx(5.0, abs=0.02)
    assert run.column("position_m")[0] == 0.0
    assert run.column("time_s")[-1] == pytest.approx(summary["loop"]["ticks"] / 1000, abs=0.02)
    assert run.scenario["initial_speed_m_s"] == pytest.approx(5.0, abs=0.01)
    assert run.scenario["friction"]

    stamps = []
    syncs = []
    for line in (folder / "can.log").read_text().splitlines():
        stamp_s = float(line[1 : line.index(")")])
        stamps.append(stamp_s)
        if " 080#" in line:
            syncs.append(stamp_s)
    assert stamps == sorted(stamps)
    assert stamps[-1] - summary["loop"]["stalled_s"] == pytest.approx(time_s[-1], abs=0.1)
    assert stamps[0] >= 0.0
    # it is 0.01 s where no other program delays the bus
    assert syncs[0] < 0.5


def test_a_plc_that_follows_the_documented_steps_gets_the_dry_stop_of_the_scenario(rig):
    # docs/howto_plc.md, with the reference unit, which hears the rollers change their speed
    more = ("--set", "initial_speed_m_s=7", "--set", "stand_s=60")
    one = rig(*HELD, *more, unit="reference")
    one.connect()
    one.until("state", lambda state: state == State.HELD)
    assert one.write("speed_set_point", 500) == 0
    one.until("at_set_speed", bool)
    assert one.set("run") == 0
    one.until("state", lambda state: state == State.RUNNING)
    assert one.write("brake_demand_set_point", 3800) == 0
    one.until("standing", bool)
    assert one.set("stop") == 0
    status, summary = one.result()
    assert status == 0
    assert summary["wsp"]["vents"] == 0
    codes = {event["code"] for event in summary["events"]}
    assert not codes & {
        Code.WSP_VENTS_WITHOUT_SLIDING,
        Code.WSP_REFERENCE_DRIFTS,
        Code.RUN_STARTED_EARLY,
    }

    free = ("--pacing", "free", "--set", "initial_speed_m_s=5")
    packaged = bench_process.run(one.out.with_name("packaged"), *free, scenario="dry_stop")
    assert summary["stop_distance_m"] == pytest.approx(packaged.result["stop_distance_m"], rel=0.01)


def test_a_run_that_starts_before_the_rollers_have_settled_is_a_warning(rig):
    one = rig(*HELD, "--set", "initial_speed_m_s=5", "--set", "duration_max_s=1")
    one.connect()
    one.until("at_set_speed", bool)
    assert one.write("speed_set_point", 2000) == 0
    assert not one.bit("at_set_speed")
    assert one.set("run") == 0
    _, summary = one.result()
    (early,) = [event for event in summary["events"] if event["code"] == Code.RUN_STARTED_EARLY]
    assert early["fields"]["set_speed_m_s"] == pytest.approx(20.0)
    assert early["fields"]["speed_m_s"] == pytest.approx(summary["initial_speed_m_s"])
    assert "discrete input 4" in early["text"]


@pytest.mark.nightly
def test_what_a_plc_and_a_master_on_the_bus_set_is_in_the_events(rig):
    one = rig(*HELD, "--set", "initial_speed_m_s=6", "--set", "duration_max_s=3")
    one.connect()
    one.until("at_set_speed", bool)
    assert one.write("speed_set_point", 500) == 0
    one.until("at_set_speed", bool)
    with can.Bus(interface="rollerrig", channel=bus_address(one.out)) as bus:
        # a download of two bytes to 6411h:1 of node 17, and of the friction under axle 2
        bus.send(sdo_download(17, 0x6411, 1, 0x2B, 1000))
        until_events(one.out, Code.SET_POINT_BRAKE_DEMAND, 1)
        bus.send(sdo_download(127, FRICTION, 2, 0x2B, round(0.05 / FRICTION_SCALE)))
        until_events(one.out, Code.SET_POINT_FRICTION, 1)
    assert one.set("run") == 0
    for mbar in range(100, 3801, 200):
        assert one.write("brake_demand_set_point", mbar) == 0
    one.write("brake_demand_set_point", -1)
    _, summary = one.result()
    found = [(event["code"], event["fields"]) for event in summary["events"]]
    assert [fields for code, fields in found if code == Code.SET_POINT_SPEED] == [
        {"speed_m_s": 5.0}
    ]
    demands = [fields for code, fields in found if code == Code.SET_POINT_BRAKE_DEMAND]
    assert demands[0] == {"source": "node 17", "pressure_Pa": 1e5}
    assert demands[1] == {"source": "Modbus", "pressure_Pa": 1e4}
    # far fewer than the writes, and the last one is there
    assert len(demands) < 10
    assert (Code.SET_POINT_BRAKE_DEMAND_NONE, {"source": "Modbus"}) in found
    assert (Code.SET_POINT_FRICTION, {"axle": 2, "mu": pytest.approx(0.05)}) in found


def bus_address(folder):
    """Return the address of the bus of a run that has just begun."""
    return until_events(folder, Code.BUS_PLACE, 1)[0]["fields"]["address"]


def until_events(folder, code, count):
    """Wait until so many events with a code are recorded; return them."""
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        # the last line may be incomplete
        lines = (folder / "events.jsonl").read_text().split("\n")[:-1]
        found = [event for event in map(json.loads, lines) if event["code"] == code]
        if len(found) >= count:
            return found
        time.sleep(0.1)
    raise AssertionError(f"no event {code}")


def sdo_download(node, index, sub, command, value):
    """Return an expedited SDO download (CiA 301)."""
    data = struct.pack("<BHBI", command, index, sub, value)
    return can.Message(arbitration_id=0x600 + node, data=data, is_extended_id=False)


@pytest.mark.conformance("Modbus", "emergency stop: brakes and a quick stop of every drive")
@pytest.mark.parametrize(
    "mode", ["full_scale", pytest.param("virtual_track", marks=pytest.mark.nightly)]
)
def test_an_emergency_stop_stops_the_rollers_and_the_vehicle_that_they_carry(rig, mode):
    one = rig(*HELD, "--set", "initial_speed_m_s=20", "--set", f"rig={mode}", "--set", "stand_s=2")
    one.connect()
    one.until("at_set_speed", bool)
    assert one.set("run") == 0
    one.until("time", lambda _: one.read("time", 2)[1] > 500)
    assert drive_states(one) == [OPERATION_ENABLED] * 4

    assert one.set("emergency_stop") == 0
    one.until("standing", bool)
    assert drive_states(one) == [SWITCH_ON_DISABLED] * 4

    # while the emergency stop is set, no master can enable a drive (controlword 15)
    one.request("write_register", 0, 15, device_id=DRIVE_UNITS[0])
    assert drive_states(one) == [SWITCH_ON_DISABLED] * 4

    # its reset gives the drives back to the rig
    assert one.set("emergency_stop", False) == 0
    assert drive_states(one) == [OPERATION_ENABLED] * 4

    status, summary = one.result()
    check_emergency_stop(status, summary)
    assert summary["stopped"] is True
    run = records.load(one.out)
    time_s = run.column("time_s")
    speed = run.column("vehicle_speed_m_s")
    (set_s,) = (event.time_s for event in run.events if event.code == Code.EMERGENCY_STOP_SET)
    # the motors' 30 kN m on 1200 kg m2 take a second or so; the brakes alone would take ten
    assert time_s[speed == 0.0][0] - set_s < 3.0
    for axle in "1234":
        assert run.column(f"roller_speed_{axle}_rad_s")[-1] == 0.0
        assert run.column(f"motor_torque_{axle}_Nm").min() < -5000.0
        assert run.column(f"cylinder_pressure_{axle}_Pa")[-1] > 1e5


def test_after_an_emergency_stop_no_event_blames_the_unit(rig):
    words = ("--set", "initial_speed_m_s=40", "--set", "stand_s=0.5")
    one = rig(*HELD, *words, unit="reference")
    one.connect()
    one.until("at_set_speed", bool)
    assert one.set("run") == 0
    one.until("time", lambda _: one.read("time", 2)[1] > 1000)
    assert one.set("emergency_stop") == 0
    one.until("state", lambda state: state == State.ENDED)
    _, summary = one.result()
    codes = {event["code"] for event in summary["events"]}
    assert Code.EMERGENCY_STOP_SET in codes
    assert [code for code in codes if code.startswith(("wsp.", "unit.silent", "unit.lost"))] == []


def drive_states(one):
    """The state bits of the statusword of every drive."""
    states = []
    for unit in DRIVE_UNITS:
        answer = one.request("read_input_registers", STATUSWORD, count=1, device_id=unit)
        states.append(answer.registers[0] & STATE_BITS)
    return states


def test_a_held_rig_that_is_stopped_exits_without_an_error(rig):
    one = rig(*HELD)
    one.connect()
    assert one.set("stop") == 0
    status, summary = one.result()
    assert status == 4
    assert summary["stopped"] is False
    assert summary["ended"] == "stopped over Modbus"
    assert "before it had begun" in summary["invalid_because"][0]
    assert records.load(one.out).scenario


@pytest.mark.parametrize("stands", [True, False])
def test_a_run_that_is_stopped_over_modbus_is_valid_after_standstill_only(rig, stands):
    speed_m_s = 1 if stands else 3
    one = rig(*HELD, "--set", f"initial_speed_m_s={speed_m_s}", "--set", "stand_s=60")
    one.connect()
    one.until("at_set_speed", bool)
    assert one.set("run") == 0
    if stands:
        one.until("standing", bool)
    else:
        one.until("time", lambda _: one.read("time", 2)[1] > 300)
    time.sleep(0.1)
    assert one.set("stop") == 0
    status, summary = one.result()
    if stands:
        assert status == 0
        assert summary["invalid_because"] == []
    else:
        assert status == 4
        (reason,) = summary["invalid_because"]
        assert "stopped over Modbus while the coach rolled, at " in reason


@pytest.fixture
def taken():
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_a_run_continues_without_modbus_if_its_port_is_taken(rig, taken):
    one = rig("--set", f"modbus.port={taken}", "--set", "duration_max_s=0.3")
    status, summary = one.result()
    assert status == 4  # it has not stopped
    assert summary["modbus"]["requests"] == 0
    (warning,) = [event for event in summary["events"] if event["code"] == Code.MODBUS_UNAVAILABLE]
    assert warning["level"] == "warning"
    assert str(taken) in warning["text"]
    assert "modbus.port=N" in warning["text"]


def test_a_start_over_modbus_is_refused_if_its_port_is_taken(rig, taken):
    one = rig("--start", "modbus", "--set", f"modbus.port={taken}")
    status, refusal = one.result()
    assert status == 2
    assert f"127.0.0.1:{taken}" in refusal["error"]


@pytest.mark.conformance("Bad input", "another address than loopback is told loudly")
def test_a_port_beyond_this_machine_is_a_loud_warning(rig):
    one = rig(
        "--set", "modbus.host=0.0.0.0", "--set", "modbus.port=0", "--set", "duration_max_s=0.3"
    )
    status, summary = one.result()
    assert status == 4  # it has not stopped
    (warning,) = [event for event in summary["events"] if event["code"] == Code.SERVER_EXPOSED]
    assert warning["level"] == "warning"
    assert "BEYOND THIS MACHINE" in warning["text"]


@pytest.mark.parametrize(
    "wrong",
    [
        ["--pacing", "lockstep"],
        ["--pacing", "free"],
        ["--set", "modbus.enabled=false"],
    ],
)
def test_a_start_over_modbus_that_is_impossible_is_refused(wrong, tmp_path, capsys):
    status = cli.main(
        ["run", "dry_stop", "--start", "modbus", "--out", str(tmp_path / "run"), *wrong]
    )
    assert status == 2
    assert "--start modbus" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.conformance("Modbus", "requests beside the real-time loop")
def test_every_request_is_answered_while_the_loop_runs(rig):
    one = rig(*HELD, "--set", "initial_speed_m_s=6")
    one.connect()
    one.until("state", lambda state: state == State.HELD)
    count = 1000  # `rollerrig bench bus` reports how many are possible in a second
    for _ in range(count):
        assert len(one.read("vehicle_speed", 10)) == 10
    assert one.read("lateness_p50") < 65535
    assert one.set("stop") == 0
    status, summary = one.result()
    assert status == 4  # it has not stopped
    assert summary["modbus"]["requests"] >= count
