"""Wrong input and failures give a clear message or event and no traceback; the record is kept."""

import os
import re
import signal
import socket

import bench_process
import program
import pytest
from bench_process import MAGNETS, BenchProcess, SimpleUnit
from process_tree import is_running

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

# the start of a valid scenario
HEAD = 'title = "t"\n[[demand]]\nfrom_s = 0.0\npressure_Pa = 3.8e5\n'


def refused(capsys, *arguments):
    """Start a run that must be refused before it begins; return the error message."""
    status = cli.main(["run", *arguments])
    printed = capsys.readouterr()
    assert status == 2, printed
    assert printed.out == ""
    assert "Traceback" not in printed.err
    assert printed.err.startswith("rollerrig run: ")
    return printed.err


# --- configuration ---


@pytest.mark.parametrize(
    ("setting", "parts"),
    [
        ("vehicle.mas_kg=1", ["--set [vehicle]", "unknown key 'mas_kg'", "did you mean 'mass_kg'"]),
        (
            "vehicel.mass_kg=1",
            ["--set", "unknown table or key 'vehicel'", "did you mean 'vehicle'"],
        ),
        (
            "vehicle.mass_kg=-1",
            ["--set [vehicle]", "mass_kg = -1 is out of range", "1000 to 400000"],
        ),
        ("vehicle.mass_kg=heavy", ["mass_kg = 'heavy'", "must be a number"]),
        ("vehicle.mass_kg=nan", ["mass_kg = nan", "out of range"]),
        ("vehicle.mass_kg=9000", ["mass_kg = 9000", "13280 kg", "raise it"]),
        ("adhesion.mu_cd=0.9", ["recovered friction", "below the degraded"]),
        ("rig.mode=moon", ["mode = 'moon'", "contaminated_rollers"]),
        ("bus.master=1", ["master = 1", "true or false"]),
        ("initial_speed_m_s=1e3", ["initial_speed_m_s = 1000 is out of range", "0.5 to 100"]),
        ("loop.step_s=3e-4", ["step_s = 0.0003", "whole number"]),
        ("loop.record_hz=300", ["record_hz = 300", "whole number"]),
        ("bus.sync_period_s=0.0105", ["sync_period_s = 0.0105", "whole number"]),
        ("loop.tick_hz=1000.5", ["tick_hz = 1000.5", "whole number"]),
        ("adhesion=sope", ["'sope'", "did you mean 'soap'"]),
        ("vehicle=3", ["vehicle", "'3'"]),
        ("demand=3", ["demand = 3", "[[demand]]"]),
        ("demand=[1, 2]", ["demand = [1, 2]", "[[demand]]"]),
        (
            "friction=[{from_s=1.0, from_m=2.0}]",
            ["[[friction]] 1", "from_s (time) or from_m (place)"],
        ),
        ("friction=[{from_s=1.0, axles=[5]}]", ["[[friction]] 1", "axles = [5]", "1 to 4"]),
        ("friction=[{from_s=1.0, axles=[1.5]}]", ["[[friction]] 1", "axles = [1.5]"]),
        ("friction=[{from_s=1.0, mu_cd=0.9}]", ["[[friction]] 1", "below the degraded"]),
        (
            "demand=[{from_s=3.0, pressure_Pa=1e5}, {from_s=1.0, pressure_Pa=0}]",
            ["[[demand]]", "rise"],
        ),
        ("demand=[{from_s=3.0}]", ["[[demand]] 1", "pressure_Pa is missing"]),
        ("mass_kg", ["--set mass_kg", "section.key=value"]),
        (
            "speed=120",
            [
                "--set: unknown table or key 'speed'",
                "did you mean 'initial_speed_m_s' or 'rig.speed'",
            ],
        ),
        ("mass_kg=40000", ["--set: unknown table or key 'mass_kg'", "mean 'vehicle.mass_kg'"]),
        ("Adhesion=soap", ["--set: unknown table or key 'Adhesion'", "did you mean 'adhesion'"]),
        ("initial_speed_m_s=fast", ["--set: initial_speed_m_s = 'fast'", "must be a number"]),
        ("friction=3", ["--set: friction = 3", "[[friction]]"]),
        ("bus_set=slow", ["no bus is called 'slow'", "default"]),
    ],
)
def test_a_wrong_setting_is_refused_with_what_is_allowed(setting, parts):
    with pytest.raises(ConfigError) as refusal:
        scenario.load("velim_a1", settings=(setting,))
    for part in parts:
        assert part in str(refusal.value)


@pytest.mark.parametrize(
    ("setting", "parts"),
    [
        ("vehicle.mas_kg=1", ["--set [vehicle]: unknown key 'mas_kg'; did you mean 'mass_kg'"]),
        ("wsp_config=nobody", ["'nobody'", "reference"]),
    ],
)
def test_a_run_with_a_wrong_setting_ends_with_its_message_and_makes_no_folder(
    setting, parts, tmp_path, capsys
):
    out = tmp_path / "run"
    text = refused(capsys, "velim_a1", "--set", setting, "--out", str(out))
    for part in parts:
        assert part in text
    assert not out.exists()


@pytest.mark.parametrize(
    ("content", "parts"),
    [
        (
            HEAD + "[adhesoin]\nmu_cd = 0.1\n",
            ["own.toml", "unknown table or key 'adhesoin'", "adhesion"],
        ),
        ("initial_speed = 3\n" + HEAD, ["own.toml", "'initial_speed'", "initial_speed_m_s"]),
        ("vehicle = 7\n" + HEAD, ["own.toml", "vehicle = 7", "a table [vehicle]"]),
        ('vehicle = "a"\nvehicle_set = "b"\n' + HEAD, ["own.toml", "vehicle and vehicle_set"]),
        ("[demand]\nfrom_s = 0\n", ["own.toml", "[[demand]] with two brackets"]),
        ("title = \n", ["own.toml", "not valid TOML", "line 1"]),
        ('rig = "../nowhere.toml"\n' + HEAD, ["../nowhere.toml", "no such file", "full_scale"]),
    ],
)
def test_a_wrong_file_is_refused_with_its_name(content, parts, tmp_path):
    file = tmp_path / "own.toml"
    file.write_text(content)
    with pytest.raises(ConfigError) as refusal:
        scenario.load(str(file))
    for part in parts:
        assert part in str(refusal.value)


def test_a_run_of_a_wrong_file_ends_with_its_message_and_makes_no_folder(tmp_path, capsys):
    (tmp_path / "own.toml").write_text("initial_speed = 3\n" + HEAD)
    text = refused(capsys, str(tmp_path / "own.toml"), "--out", str(tmp_path / "run"))
    assert "own.toml" in text
    assert "initial_speed_m_s" in text
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["velim_a9"], ["'velim_a9'", "velim_a1"]),
        (["velim_a1", "--fault", ""], ["--fault ''", "kind, the name of the fault, is missing"]),
        (["velim_a1", "--fault", "Node_Off"], ["--fault 'Node_Off'", "did you mean 'node_off'?"]),
        (["no/such/file.toml"], ["no/such/file.toml: no such file"]),
        (["velim_a1", "--model", "no/model.toml"], ["no/model.toml: no such file"]),
        (["velim_a1", "--pacing", "free", "--wsp", "external"], ["--pacing free", "lockstep"]),
    ],
)
def test_a_file_that_is_missing_and_options_that_contradict_are_refused(
    arguments, parts, tmp_path, capsys
):
    text = refused(capsys, *arguments, "--out", str(tmp_path / "run"))
    for part in parts:
        assert part in text


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Velim_A1", r"'Velim_A1'.*did you mean 'velim_a1'\?"),
        ("VELIM_B1.toml", r"VELIM_B1\.toml: no such file.*did you mean 'velim_b1'\?"),
    ],
)
def test_a_scenario_in_other_letters_is_refused_with_the_name_that_is_meant(name, message):
    with pytest.raises(ConfigError, match=message):
        scenario.load(name)


def test_a_model_that_is_no_table_is_refused(tmp_path, capsys):
    (tmp_path / "extended.toml").write_text("adhesion = 0.1\n")
    text = refused(capsys, "velim_a1", "--model", str(tmp_path / "extended.toml"))
    assert "extended.toml: adhesion = 0.1: write a table [adhesion]" in text


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path, capsys):
    (tmp_path / "thesis.txt").write_text("years of work")
    text = refused(capsys, "velim_a1", "--pacing", "free", "--out", str(tmp_path))
    assert "not a run's folder" in text
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_run_does_not_replace_the_users_scenario_in_its_output_folder(tmp_path, capsys):
    folder = tmp_path / "mine"
    folder.mkdir()
    own = folder / "scenario.toml"
    own.write_text('vehicle = "uic_z1"\n')
    (folder / "notes.txt").write_text("what I saw")

    text = refused(capsys, str(own), "--pacing", "free", "--out", str(folder))

    assert "nothing in it is replaced" in text
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "scenario.toml"]
    assert own.read_text() == 'vehicle = "uic_z1"\n'


def test_a_folder_whose_summary_is_no_table_is_not_a_runs_folder(tmp_path, capsys):
    (tmp_path / "summary.json").write_text("5")
    text = refused(capsys, "velim_a1", "--pacing", "free", "--out", str(tmp_path))
    assert "not a run's folder" in text
    assert (tmp_path / "summary.json").read_text() == "5"


def test_a_second_run_replaces_the_files_of_the_first_and_keeps_all_others(tmp_path):
    out = tmp_path / "run"
    words = ("run", "dry_stop", "--wsp", "none", "--pacing", "free", "--out", str(out), "--set")
    assert program.rollerrig(*words, "initial_speed_m_s=1").status == 0

    (out / "notes.txt").write_text("what I saw")
    (out / "exports").mkdir()
    (out / "exports" / "run.csv").write_text("1")
    assert program.rollerrig(*words, "initial_speed_m_s=2").status == 0

    assert records.load(out).scenario["initial_speed_m_s"] == 2.0
    assert (out / "notes.txt").read_text() == "what I saw"
    assert (out / "exports" / "run.csv").read_text() == "1"


def test_an_out_that_is_a_file_is_refused(tmp_path, capsys):
    file = tmp_path / "run"
    file.write_text("")
    text = refused(capsys, "velim_a1", "--pacing", "free", "--out", str(file))
    assert "--out" in text


# --- the bus ---


def failed(bench, *parts, status=2):
    """Check that the run exited with this status and message, and that its record is complete."""
    assert bench.status == status, bench.stderr
    assert "Traceback" not in bench.stderr
    for part in parts:
        assert part in bench.stderr
        assert part in bench.result["error"]

    summary = records.summary(bench.out)
    assert summary["ended"] == "error"
    assert summary["invalid_because"][-1].startswith("the run ended with an error: ")

    failures = [event for event in summary["events"] if event["code"] == Code.RUN_FAILED]
    assert any(parts[0] in event["fields"]["reason"] for event in failures)

    assert bench.record.scenario["initial_speed_m_s"] > 0.0


def test_a_port_in_use_is_reported(tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        bench = bench_process.run(
            tmp_path / "run", "--pacing", "lockstep", "--set", f"bus.socketcand_port={port}"
        )
    failed(bench, str(port))


def test_a_missing_interface_is_reported_with_an_alternative(tmp_path):
    bench = bench_process.run(
        tmp_path / "run", "--pacing", "lockstep", "--set", "bus.interface=socketcan:nope"
    )
    failed(bench, "socketcan:nope", "or use the bench's own hub")


# --- the unit ---

VENT = 2.0  # the recorded state of a valve that vents; 0 fills


def test_a_run_without_a_unit_stops_and_reports_how_to_start_a_unit(tmp_path):
    bench = bench_process.run(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--wait", "1"
    )
    failed(bench, "no WSP unit on socketcand://", "within 1 s", "rollerrig wsp --bus", "--wait")


def dies_after(last_sync, magnets):
    """Return the answers of a unit that sends these magnets and is silent after this SYNC."""

    def answer(n):
        if n <= last_sync:
            return [(MAGNETS, magnets)]
        return None

    return answer


def test_a_unit_that_dies_in_lockstep_stops_the_run_within_about_a_second(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--answer-wait", "1"
    )
    unit = SimpleUnit(bench.address(), dies_after(199, b"\0"))
    bench.finish()
    unit.close()

    failed(bench, "has not answered SYNC within 1 s", "at 1.99", "211h", "--answer-wait", status=4)
    assert bench.record.column("time_s")[-1] == pytest.approx(1.98, abs=0.02)


def test_killing_the_reference_unit_in_lockstep_stops_the_run_with_a_report(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "lockstep")
    bench.runs_for(0.5)
    os.kill(bench.child("wsp"), signal.SIGKILL)
    bench.finish()

    failed(bench, "the reference WSP unit was killed (signal 9, SIGKILL)", "wsp.log", status=4)
    assert len(bench.record.table) > 50


@pytest.mark.conformance("Bad input", "a unit that dies: the brakes apply, the run goes on")
def test_a_unit_that_dies_in_real_time_lets_the_brakes_apply_and_the_run_go_on(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "wall", "--wsp", "external", "--set", "duration_max_s=3"
    )
    # the unit vents all axles for a second, then stops without a message
    unit = SimpleUnit(bench.address(), dies_after(99, b"\xff"))
    bench.finish()
    unit.close()

    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    # on a busy machine late heartbeats may cause earlier losses
    lost = r"the WSP unit was lost \d+ times? \(no heartbeat\)"
    assert re.match(lost, bench.result["invalid_because"][0])

    run = bench.record
    time_s = run.column("time_s")
    assert time_s[-1] > 2.9

    losses = bench.reported(Code.HEARTBEAT_LOST, partner=32)
    assert {event.fields["node"] for event in losses} == {17}
    *early_losses_s, last_loss_s = [event.time_s for event in losses]
    if early_losses_s:
        # The machine stalled, so less simulated time may have passed until the unit's last answer.
        assert 1.0 < last_loss_s < 1.5 or last_loss_s > early_losses_s[-1]
    else:
        assert 1.0 < last_loss_s < 1.5
    assert bench.reported(Code.NODE_EMERGENCY, error_code=0x8130)

    unit_vents = (time_s > 0.4) & (time_s < 0.95)
    unit_is_lost = time_s > last_loss_s + 0.1
    for axle in "1234":
        valve = run.column(f"valve_{axle}")
        if not early_losses_s:
            assert valve[unit_vents].min() == VENT
        assert not valve[unit_is_lost].any()
        assert run.column(f"cylinder_pressure_{axle}_Pa")[-1] > 1e5


@pytest.mark.conformance("Bad input", "short PDOs and garbage of a unit")
def test_short_pdos_and_garbage_of_a_unit_are_events_and_the_run_goes_on(tmp_path):
    garbage = [
        (MAGNETS, b""),
        (MAGNETS, b"\1\2\3\4\5\6\7\x08"),
        (0x720, b""),
        (0x720, b"\xff\xff"),
        (0x000, b"\x81"),
        (0x080, b"\1\2\3"),
        (0x611, b"\xff" * 8),
        (0x7FF, b""),
        (0x1FFFFFFF, b"x"),
        (0x1A0, b"\0"),
        (0x77F, b"\5"),
    ]
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "lockstep", "--wsp", "external", "--set", "duration_max_s=3"
    )

    def answer(n):
        return [garbage[n % len(garbage)], (MAGNETS, b"\0")]

    unit = SimpleUnit(bench.address(), answer)
    bench.finish()
    unit.close()

    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    (reason,) = bench.result["invalid_because"]
    assert "did not stop" in reason
    assert len(bench.record.table) >= 295
    emergencies = bench.reported(Code.NODE_EMERGENCY, error_code=0x8210)
    assert emergencies or bench.reported(Code.PDO_TOO_SHORT, pdo=1)


# --- interrupted and killed ---


def test_ctrl_c_stops_the_wait_for_a_unit(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "lockstep", "--wsp", "external")
    bench.address()
    bench.interrupt()
    bench.finish()

    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    assert bench.result["ended"] == "interrupted"


def time_of_last_frame(can_log):
    """Return the time of the last line of a can.log in s; a line begins with `(seconds)`."""
    last_line = can_log.read_text().splitlines()[-1]
    return float(last_line[1:18])


def test_a_bench_that_is_killed_leaves_complete_files_and_no_process(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", "duration_max_s=20")
    bench.runs_for(1.0)
    unit = bench.child("wsp")
    recorder = bench.child("rollerrig.realtime.telemetry.recorder")
    bench.process.kill()
    killed_s = float(bench.record.column("time_s")[-1])
    bench.process.wait()

    for pid in (unit, recorder):
        bench_process.until(lambda pid=pid: not is_running(pid), f"the exit of process {pid}")

    run = bench.record
    assert run.column("time_s")[-1] >= killed_s
    assert run.summary["ended"] == "killed"
    reasons = run.summary["invalid_because"]
    assert any(reason.startswith("the bench was killed") for reason in reasons)
    assert not (bench.out / "channels.tail").exists()
    assert (bench.out / "run.rrd").stat().st_size > 10_000
    assert time_of_last_frame(bench.out / "can.log") > killed_s - 1.0


def test_a_recorder_that_is_killed_is_an_event_and_its_files_are_readable(tmp_path):
    bench = BenchProcess(
        tmp_path / "run", "--pacing", "wall", "--wsp", "none", "--set", "duration_max_s=3"
    )
    bench.runs_for(1.0)
    os.kill(bench.child("rollerrig.realtime.telemetry.recorder"), signal.SIGKILL)
    bench.finish()

    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    assert bench.result["invalid_because"][0].startswith(
        "the recorder was killed (signal 9, SIGKILL)"
    )
    assert "the recorder was killed (signal 9, SIGKILL)" in bench.stderr
    assert bench.result["loop"]["ticks"] == 3000
    assert Code.RECORDER_ENDED in [event["code"] for event in bench.result["events"]]
    assert 1.0 <= bench.record.column("time_s")[-1] < 3.0
    assert (bench.out / "can.log").stat().st_size > 1000
