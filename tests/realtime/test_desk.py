"""The desk reads a bench, and controls it from its page."""

import asyncio
import contextlib
import json
import math
import os
import resource
import shutil
import subprocess
import sys

import numpy as np
import program
import pyarrow.parquet as pq
import pytest
from bench_process import until
from chromium import browsing
from desk_process import FREE_PORTS, TABULATOR, Page, served

from rollerrig.configs.errors import BusError, ConfigError
from rollerrig.configs.vehicle import ALLOWED_AXLES, COACH, Kind
from rollerrig.firmware_sim.modbus.map import State
from rollerrig.realtime.loop import ring
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make
from rollerrig.wsp_interface.unit_choice import AllowList

pytest.importorskip("nicegui", reason="the desk needs nicegui")

from nicegui import ui
from nicegui.testing.user_simulation import user_simulation

from rollerrig.realtime.desk import desk, library, live, page, reader
from rollerrig.realtime.pictures import colours

WRITER = """
import sys
import time
from pathlib import Path
import numpy as np
from rollerrig.realtime.loop import ring
if len(sys.argv) > 1:
    ring.folder = lambda: Path(sys.argv[1])
from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import signals
rows = ring.Ring(ring.place("rows"), np.float64, 64, len(signals.table(COACH).columns))
events = ring.Ring(ring.place("events"), np.int64, 64, ring.EVENT_WORDS)
print("there", flush=True)
time.sleep(900)
"""
COLUMNS = signals.table(COACH).columns
SHOWN = reader.columns_of(signals.table(COACH)).names
PATIENCE = 1200  # tries of 0.1 s each: a first run compiles, perhaps on a busy machine


@pytest.fixture
def rings():
    """The rings of rows and events, as a bench makes them; this process is their writer."""
    rows = ring.Ring(ring.place("rows"), np.float64, 4096, len(COLUMNS))
    events = ring.Ring(ring.place("events"), np.int64, 256, ring.EVENT_WORDS)
    yield rows, events
    rows.unlink()
    events.unlink()


def row(time_s, **values):
    """A recorded row: zeros except for its time and these values, those of axle 1."""
    table = signals.table(COACH)
    recorded = np.zeros(len(COLUMNS))
    recorded[COLUMNS.index("time_s")] = time_s
    for name, value in values.items():
        recorded[COLUMNS.index(signals.columns(table.by_name[name])[0])] = value
    return recorded


# -- reading a bench


def test_a_bench_of_any_vehicle_is_recognised_by_the_width_of_its_rows():
    kinds = [table.kind for table in reader._tables().values()]
    assert len(kinds) == len(set(kinds)) == 4 * len(ALLOWED_AXLES)
    for kind in kinds:
        columns = signals.table(kind).columns
        rows = ring.Ring(ring.place("rows"), np.float64, 8, len(columns))
        events = ring.Ring(ring.place("events"), np.int64, 8, ring.EVENT_WORDS)
        try:
            (bench,) = reader.running(lambda pid: pid == os.getpid())
            rows.push(np.arange(len(columns), dtype=float))
            bench.poll()
        finally:
            rows.unlink()
            events.unlink()
        assert bench.table.kind == kind
        name = f"valve_{kind.axles}"
        assert bench.value("valve", kind.axles) == columns.index(name)
        assert math.isnan(bench.value("valve", kind.axles + 1))


def test_no_spike_is_lost_in_the_points_that_a_page_receives(rings):
    rows, _ = rings
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    spike_m_s = 3.3
    for number in range(1000):
        sliding_m_s = {637: spike_m_s, 643: -spike_m_s}.get(number, 0.0)
        rows.push(row(0.01 * number, sliding=sliding_m_s))
        if number % 37 == 0:
            bench.poll()
    bench.poll()

    recent = np.array(bench.since(0))
    sliding = SHOWN.index("sliding_1_m_s")
    for points in (recent, bench.whole):
        assert points[:, sliding].max() == spike_m_s
        assert points[:, sliding].min() == -spike_m_s

    # a pair of points for each tenth of a second, except for the last one, which is not complete
    assert bench.points == 2 * 99
    assert len(recent) == bench.points
    assert bench.since(bench.points) == []
    assert len(bench.since(bench.points - 4)) == 4


def test_the_reader_knows_the_distance_since_the_first_brake_demand(rings):
    rows, _ = rings
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    for number in range(500):
        demand_Pa = 3.8e5 if 101 <= number < 300 else 0.0
        rows.push(row(0.01 * number, position=0.2 * number, brake_demand=demand_Pa))
        if number % 37 == 0:
            bench.poll()
        if number < 100:
            assert math.isnan(bench.braked_m)
    bench.poll()
    # a row shows the demand of the tick before it: the demand was given at row 100
    assert bench.braked_m == pytest.approx(0.2 * 499 - 0.2 * 100)


def test_the_distance_since_a_brake_demand_that_nobody_has_seen_is_not_known(rings):
    rows, _ = rings
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    for number in range(100, 200):
        rows.push(row(0.01 * number, position=0.2 * number, brake_demand=3.8e5))
        bench.poll()
    assert math.isnan(bench.braked_m)


def test_the_reader_knows_where_a_bench_listens_which_faults_act_and_how_it_ended(rings):
    rows, events = rings
    stuck = {"fault": "speed_sensor_stuck axle=2", "kind": "speed_sensor_stuck", "units": []}
    off = {"fault": "node_off node=1", "kind": "node_off", "reaches_unit": False, "units": []}
    for event in (
        make(0.0, Code.BUS_PLACE, address="socketcand://127.0.0.1:4711/rig0"),
        make(0.0, Code.MODBUS_SERVED, transport="TCP", host="127.0.0.1", port=5021),
        make(0.0, Code.FAULT_BEGINS, reaches_unit=False, **stuck),
        make(0.0, Code.FAULT_BEGINS, **off),
        make(0.0, Code.FAULT_LIFTED, frames_met=None, **off),
    ):
        ring.push_event(events, event)
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    bench.poll()
    assert bench.bus == "socketcand://127.0.0.1:4711/rig0"
    assert bench.modbus == ("127.0.0.1", 5021)
    assert bench.faults == ["speed_sensor_stuck axle=2"]
    assert bench.ended == ""
    rows.close()
    assert bench.ended == "closed"
    assert reader.running(lambda pid: pid == os.getpid()) == []


def test_the_reader_has_the_speed_that_a_sensor_shows_at_the_rim_of_its_wheel(rings):
    rows, _ = rings
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    radius_m = 0.42
    for number in range(100):
        stuck_rad_s = 30.0 if number > 50 else 60.0
        rows.push(
            row(
                0.01 * number,
                wheel_speed=60.0,
                wheel_circumferential_speed=60.0 * radius_m,
                measured_speed=stuck_rad_s,
            )
        )
    bench.poll()
    column = SHOWN.index("measured_rim_speed_1_m_s")
    assert bench.newest[column] == pytest.approx(30.0 * radius_m)
    assert bench.whole[0, column] == pytest.approx(60.0 * radius_m)


def test_the_plots_receive_when_faults_began_and_were_lifted(rings, tmp_path):
    rows, events = rings
    stuck = {"fault": "speed_sensor_stuck axle=2", "kind": "speed_sensor_stuck", "units": []}
    ring.push_event(events, make(1.5, Code.FAULT_BEGINS, reaches_unit=False, **stuck))
    ring.push_event(
        events, make(4.0, Code.FAULT_LIFTED, reaches_unit=False, frames_met=None, **stuck)
    )
    rows.push(row(5.0))
    one = desk.Desk(tmp_path)
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    one._follow(bench)
    one.look()
    assert live.answer(one, "", 0, False)["marks"] == [
        (1.5, "speed_sensor_stuck axle=2", True),
        (4.0, "speed_sensor_stuck axle=2", False),
    ]


def test_alarms_belong_to_their_run(rings, tmp_path):
    rows, events = rings
    rows.push(row(5.0))
    ring.push_event(events, make(2.0, Code.SYNC_FOREIGN))
    one = desk.Desk(tmp_path)
    (first,) = reader.running(lambda pid: pid == os.getpid())
    one._follow(first)
    one.look()
    (alarm,) = one.alarms
    assert one.is_present(alarm)
    assert alarm.run == first.name

    rows.close()
    later = ring.Ring(ring.place("rows"), np.float64, 64, len(COLUMNS))
    later_events = ring.Ring(ring.place("events"), np.int64, 64, ring.EVENT_WORDS)
    try:
        (second,) = reader.running(lambda pid: pid == os.getpid())
        one._follow(second)
        assert not one.is_present(alarm)
        one.alarm("error", "of the desk")
        assert one.is_present(one.alarms[0])
    finally:
        later.unlink()
        later_events.unlink()


def test_a_new_report_replaces_no_earlier_one(tmp_path):
    one = desk.Desk(tmp_path, own=True)
    assert one.free_report("emergency_120") == "reports/emergency_120"
    (tmp_path / "reports/emergency_120").mkdir(parents=True)
    assert one.free_report("emergency_120") == "reports/emergency_120-2"


def test_each_axle_has_a_kind_of_line_besides_its_colour_and_each_plot_a_least_range():
    kinds = {str(dashes) for dashes in colours.AXLE_DASHES}
    assert len(kinds) == COACH.axles
    assert len(set(colours.AXLES)) == len(colours.AXLES)
    of_all_brakes = Kind(6, dynamic_brake=True, magnetic_track_brake=True)
    plots = live.plots_of(reader.columns_of(signals.table(of_all_brakes)))
    assert len(plots) == 7
    for plot in plots:
        assert plot.least > 0.0
        # lines of one plot that share a colour have different kinds
        looks = set()
        for line in plot.lines:
            for at, _ in enumerate(line.columns):
                colour = line.colour or colours.AXLES[at]
                dashes = colours.AXLE_DASHES[at] if line.dashes is None else line.dashes
                looks.add((line.name or f"axle {at + 1}", colour, dashes))
        assert len({look[1:] for look in looks}) == len(looks)


def test_a_bench_that_is_killed_is_an_alarm(tmp_path):
    writer = subprocess.Popen([sys.executable, "-c", WRITER], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout.readline()
        one = desk.Desk(tmp_path, own=True)
        (bench,) = reader.running(lambda pid: pid == writer.pid)
        one._follow(bench)
        one.look()
        assert not one.alarms

        writer.kill()
        writer.wait()
        one.look()
        one.look()  # the alarm is raised once only
        assert [alarm.text[:20] for alarm in one.alarms] == ["the bench was killed"]
    finally:
        writer.kill()
        writer.communicate()
        for path in ring.folder().glob(f"rollerrig-{writer.pid}-*"):
            path.unlink()


@pytest.mark.conformance("Bad input", "the desk survives a ring that is cut off: an alarm")
@pytest.mark.parametrize("kind", ["rows", "events"])
def test_a_ring_that_is_cut_off_is_an_alarm_and_the_desk_continues(tmp_path, kind):
    writer = subprocess.Popen([sys.executable, "-c", WRITER], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout.readline()
        one = desk.Desk(tmp_path, own=True)
        (bench,) = reader.running(lambda pid: pid == writer.pid)
        one._follow(bench)
        (path,) = ring.folder().glob(f"rollerrig-{writer.pid}-*-{kind}")
        os.truncate(path, 0)
        one.look()
        one.look()  # the alarm is raised once only
        (alarm,) = one.alarms
        assert f"{kind}: another program has cut the ring off" in alarm.text
    finally:
        writer.kill()
        writer.communicate()
        for path in ring.folder().glob(f"rollerrig-{writer.pid}-*"):
            path.unlink()


def test_a_ring_to_which_other_users_have_access_is_no_bench(rings):
    rows, _ = rings
    assert len(reader.running(lambda pid: pid == os.getpid())) == 1
    rows.path.chmod(0o666)
    assert reader.running(lambda pid: pid == os.getpid()) == []


# -- a desk belongs to one bench


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Starts benches that are the only ones of this machine, and kills them in the end."""
    (tmp_path / "rings").mkdir()
    monkeypatch.setattr(ring, "folder", lambda: tmp_path / "rings")
    writers = []

    def start():
        command = [sys.executable, "-c", WRITER, str(tmp_path / "rings")]
        writer = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        writers.append(writer)
        assert writer.stdout.readline()
        return writer

    yield start
    for writer in writers:
        writer.kill()
        writer.communicate()


def test_a_desk_follows_the_only_bench_of_the_machine_but_no_later_one(machine, tmp_path):
    first = machine()
    one = desk.Desk(tmp_path)
    one.find()
    assert one.bench.pid == first.pid
    assert one.bench.name == f"process {first.pid} in {os.getcwd()}"

    first.kill()
    first.wait()
    second = machine()
    one.find()
    assert one.bench.pid == first.pid
    assert [bench.pid for bench in one.choices] == [second.pid]
    with pytest.raises(BusError, match="1 bench runs on this machine that this desk does not"):
        one.door()


def test_of_several_benches_the_user_chooses_one_and_the_desk_stays_with_it(machine, tmp_path):
    first, second = machine(), machine()
    one = desk.Desk(tmp_path)
    one.find()
    assert one.bench is None
    assert [bench.pid for bench in one.choices] == [first.pid, second.pid]
    with pytest.raises(BusError, match="2 benches run on this machine"):
        one.door()
    with pytest.raises(ConfigError, match="a bench runs already on this machine"):
        asyncio.run(one.prepare("velim_a1", "none", {}))

    older, newer = one.choices
    one.follow(older.key)
    assert one.door().bench.pid == first.pid
    with pytest.raises(ConfigError, match=f"belongs to the bench of process {first.pid}"):
        one.follow(newer.key)


def test_a_desk_of_its_own_benches_offers_no_other(machine, tmp_path):
    machine()
    one = desk.Desk(tmp_path, own=True)
    one.find()
    assert one.bench is None
    assert one.choices == []


def test_the_page_names_the_benches_and_follows_the_chosen_one(machine, tmp_path):
    machine()
    second = machine()
    one = desk.Desk(tmp_path)

    async def play(user):
        await user.should_see("2 benches run on this machine", retries=PATIENCE)
        user.find(marker="emergency").click()
        await user.should_see("choose the bench of this desk first", retries=PATIENCE)
        choice = user.find(kind=ui.select, marker="benches").elements.pop()
        (key,) = (key for key, name in choice.options.items() if f"process {second.pid} " in name)
        with user:
            choice.value = key
        await user.should_see(f"bench (process {second.pid} in", retries=PATIENCE)

    simulated(one, play)
    assert one.bench.pid == second.pid


# -- what may be started


def prepared(one, scenario="velim_a1", unit="none", more=""):
    """Prepare a bench as the page does, and return the words of the program that was started."""
    try:
        asyncio.run(one.prepare(scenario, unit, {}, more))
        return one.programs[-1].words
    finally:
        for program in one.programs:
            program.stop()


@pytest.fixture
def fmu(tmp_path):
    """A file that counts as an FMU until somebody opens it."""
    (tmp_path / "units").mkdir()
    file = tmp_path / "units/unit.fmu"
    file.write_bytes(b"no archive")
    return file


def test_a_unit_that_the_command_line_does_not_allow_is_not_started(tmp_path, fmu):
    other = tmp_path / "other.fmu"
    one = desk.Desk(tmp_path, own=True, allowed=AllowList.of([fmu]))
    (tmp_path / "link.fmu").symlink_to(other)
    for unit in (
        f"fmu:{other}",
        "fmu:other.fmu",
        "fmu:link.fmu",
        f"fmu:{fmu},fmu:{other}",
        "fmu:",
        "elsewhere",
        f"none --wsp=fmu:{other}",
        "fmu:a\0b",
        "",
    ):
        with pytest.raises(ConfigError):
            prepared(one, unit=unit)
    with pytest.raises(
        ConfigError, match=f"allow it on the command line with --allow-unit {other}"
    ):
        prepared(one, unit=f"fmu:{other}")
    assert one.programs == []
    assert f"fmu:{fmu}" in one.units


@pytest.mark.parametrize("unit", ["fmu:{fmu}", "fmu:units/unit.fmu"])
def test_an_allowed_unit_is_started_by_its_absolute_path(tmp_path, fmu, unit):
    one = desk.Desk(tmp_path, own=True, allowed=AllowList.of([fmu]))
    assert f"--wsp=fmu:{fmu}" in prepared(one, unit=unit.format(fmu=fmu))


def test_a_command_is_started_only_if_the_command_line_allows_exactly_this_one(tmp_path):
    unit = "command:./unit {host} {port}"
    with pytest.raises(ConfigError, match="data starts no program"):
        prepared(desk.Desk(tmp_path, own=True), unit=unit)
    one = desk.Desk(tmp_path, own=True, allowed=AllowList.of([unit]))
    with pytest.raises(ConfigError, match="data starts no program"):
        prepared(one, unit=f"{unit} --more")
    assert one.programs == []
    assert unit in one.units
    assert f"--wsp={unit}" in prepared(one, unit=unit)


def test_scenario_files_are_in_the_folder_of_the_desk_or_in_an_allowed_one(tmp_path):
    for name in ("here", "allowed", "elsewhere"):
        (tmp_path / name).mkdir()
    one = desk.Desk(tmp_path / "here", own=True, scenario_folders=[tmp_path / "allowed"])
    for scenario in (f"{tmp_path}/elsewhere/a.toml", "../elsewhere/a.toml", "/etc/hostname"):
        with pytest.raises(ConfigError, match="start the desk with --allow-folder DIR"):
            prepared(one, scenario)
    assert one.programs == []
    allowed = f"{tmp_path}/allowed/a.toml"
    assert prepared(one, allowed)[-1] == allowed


def test_the_page_shows_the_vehicle_of_the_scenario_until_there_is_a_bench(rings, tmp_path):
    one = desk.Desk(tmp_path, own=True)
    assert one.table.kind == COACH
    (tmp_path / "mine.toml").write_text('vehicle = "bogie_module"\n')
    for scenario, settings, kind in (
        ("tram_low_dynamic", (), Kind(6, dynamic_brake=True)),
        ("multiple_unit_low", (), Kind(8)),
        ("mine.toml", (), Kind(2)),
        ("velim_a1", (), COACH),
        ("velim_a1", ("vehicle=bogie_module",), Kind(2)),
        # the bench reports what is wrong
        ("there_is_none", (), Kind(2)),
    ):
        one.show_vehicle_of(scenario, settings)
        assert one.table.kind == kind
    assert "tram_low" in prepared(one, "tram_low")
    assert one.table.kind == Kind(6)
    (bench,) = reader.running(lambda pid: pid == os.getpid())
    one._follow(bench)
    assert one.table.kind == COACH


def test_the_parts_of_the_page_follow_the_vehicle(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        await user.should_see(marker="friction-4", retries=50)
        await user.should_not_see(marker="friction-5", retries=50)
        one.show_vehicle_of("tram_emergency_magnetic")
        await user.should_see(marker="friction-6", retries=50)
        faults = user.find(kind=ui.select, marker="fault").elements.pop().options
        assert "track_brake_dead" in faults
        assert "dynamic_brake_lost" not in faults
        one.show_vehicle_of("bogie_low")
        await user.should_not_see(marker="friction-3", retries=50)
        faults = user.find(kind=ui.select, marker="fault").elements.pop().options
        assert "track_brake_dead" not in faults

    simulated(one, play)


def test_text_of_the_page_cannot_become_an_option(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        await one.prepare("--allow-unit=evil.fmu", "none", {"rig": "--live"}, "--wsp=fmu:evil.fmu")
        await user.should_see(marker="acknowledge", retries=PATIENCE)

    simulated(one, play)
    assert one.programs[-1].status == 2
    assert "no scenario is called '--allow-unit=evil.fmu'" in one.programs[-1].error
    with pytest.raises(ConfigError, match="close each quotation mark"):
        prepared(one, more="adhesion.mu_cd='0.05")


def test_the_options_that_allow_units_name_files_and_folders_that_exist(tmp_path):
    for option in ("--allow-unit", "--allow-folder"):
        refused = program.rollerrig("desk", option, "nowhere", folder=tmp_path)
        assert refused.status == 2
        assert f"{option} nowhere: there is no such" in refused.messages


# -- the library


@pytest.fixture
def runs(tmp_path, stop_on_leaves, stop_without_wsp):
    """A folder with two complete runs, one without a summary, and one with a damaged summary."""
    copies = {
        "with": stop_on_leaves,
        "without": stop_without_wsp,
        "cut": stop_on_leaves,
        "damaged": stop_on_leaves,
    }
    for name, run in copies.items():
        no_view = shutil.ignore_patterns("run.rrd")
        shutil.copytree(run.out, tmp_path / "runs" / name, ignore=no_view)
    (tmp_path / "runs/cut/summary.json").unlink()
    (tmp_path / "runs/damaged/summary.json").write_text("{")
    return tmp_path


def test_the_library_lists_runs_also_those_without_a_summary(runs):
    rows = {row["name"]: row for row in library.rows(runs)}
    assert rows["runs/with"]["verdict"] == "valid"
    assert rows["runs/with"]["longest_lock_s"] < rows["runs/without"]["longest_lock_s"]
    assert rows["runs/with"]["initial_km_h"] > 0.0
    assert rows["runs/with"]["adhesion"].startswith("leaf_film 0.0")
    assert rows["runs/with"]["faults"] == ""
    assert "it has no summary" in rows["runs/cut"]["verdict"]
    assert "not valid JSON" in rows["runs/damaged"]["verdict"]


def test_the_library_lists_the_faults_of_a_run_once_each(runs):
    path = runs / "runs/with/summary.json"
    summary = json.loads(path.read_text())
    for fault in ("node_off node=1", "speed_sensor_stuck axle=2", "node_off node=1"):
        fields = {"fault": fault, "kind": fault.split()[0], "reaches_unit": False, "units": []}
        event = {"time_s": 1.0, "level": "warning", "text": "", "fields": fields}
        summary["events"].append(event | {"code": Code.FAULT_BEGINS})
    path.write_text(json.dumps(summary))
    rows = {row["name"]: row for row in library.rows(runs)}
    assert rows["runs/with"]["faults"] == "node_off node=1, speed_sensor_stuck axle=2"


def test_a_note_that_cannot_be_written_leaves_the_old_one(runs):
    library.write_note(runs / "runs/with", "first stop of the day")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    # as on a full disk
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        with pytest.raises(ConfigError, match=r"cannot be written.*the old note is kept"):
            library.write_note(runs / "runs/with", "another")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert library.note(runs / "runs/with") == "first stop of the day"


@pytest.mark.parametrize(
    ("kind", "name"),
    [("csv", "with.zip"), pytest.param("mat", "with.mat", marks=pytest.mark.nightly)],
)
def test_a_run_is_downloaded_as_export_writes_it(runs, kind, name):
    # a second of the run is enough
    channels = runs / "runs/with/channels.parquet"
    pq.write_table(pq.read_table(channels).slice(0, 100), channels)
    assert library.export(runs / "runs/with", kind)[0] == name
    with pytest.raises(ConfigError, match="no such file"):
        library.export(runs / "runs", kind)


# -- the page


def simulated(one, play):
    """Let a simulated user work on the page of a desk, while the desk runs."""

    async def go():
        async with user_simulation(root=lambda: page.build(one)) as user:
            working = asyncio.create_task(one.work())
            try:
                await user.open("/")
                await play(user)
            finally:
                working.cancel()
                one.close()
                for program in one.programs:
                    program.stop()

    asyncio.run(go())


def asked(user):
    """Whether the page asks to confirm the reset of the emergency stop."""
    return user.find(marker="reset-question").elements.pop().value


def asks_to_confirm(user):
    """Whether the page asks to confirm something that would be lost."""
    try:
        return any(dialog.value for dialog in user.find(marker="question").elements)
    except AssertionError:
        return False


@pytest.mark.nightly
def test_a_library_of_sequences_is_stopped_from_the_page(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        one.start(["sequence", "--steps", "--jobs", "1", "--out", "reports/sequences"])
        (program,) = one.programs
        for _ in range(PATIENCE):
            if any("brake" in line or "step" in line for line in program.lines):
                break
            assert program.status is None, program.error
            await asyncio.sleep(0.1)
        user.find(marker="tab-Automatic").click()
        await user.should_see(marker="stop-program", retries=50)
        user.find(marker="stop-program").click()
        await user.should_see("Stop this program?", retries=50)
        user.find(marker="confirm-yes").click()
        await user.should_see("interrupted, or a run is not valid", retries=PATIENCE)

    simulated(one, play)
    assert one.programs[0].status == 4
    assert (tmp_path / "reports/sequences/report.html").is_file()


def test_without_a_bench_the_page_reports_it_and_refuses_with_a_message(tmp_path):
    async def play(user):
        await user.should_see("no bench runs on this machine")
        await user.should_see(page.NO_SAFETY)
        for count, marker in enumerate(("emergency", "set-demand", "inject"), start=1):
            user.find(marker=marker).click()
            for _ in range(PATIENCE):
                if user.notify.messages.count("no bench runs here: prepare one first") == count:
                    break
                await asyncio.sleep(0.1)
            else:
                raise AssertionError(user.notify.messages)

    simulated(desk.Desk(tmp_path, own=True), play)


def test_an_error_of_the_command_line_becomes_an_alarm_that_is_acknowledged(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def play(user):
        user.find(marker="more").type("adhesoin=soap")
        user.find(marker="prepare").click()
        await user.should_see("did you mean 'adhesion'", retries=PATIENCE)
        await user.should_see(marker="acknowledge", retries=50)
        user.find(marker="acknowledge").click()
        await user.should_see("acknowledged ", retries=50)

    simulated(one, play)
    assert [alarm.level for alarm in one.alarms] == ["error"]


@pytest.mark.nightly
def test_two_runs_are_compared_and_a_note_is_kept_on_the_page(runs):
    async def play(user):
        user.find(marker="compare").click()
        await user.should_see("0 runs are chosen in the table: choose 2", retries=50)
        table = user.find(kind=ui.table, marker="runs").elements.pop()
        complete = ("runs/with", "runs/without")
        table.selected = [row for row in table.rows if row["name"] in complete]
        user.find(marker="compare").click()
        await user.should_see(marker="compared", retries=PATIENCE)
        table.selected = table.selected[:1]
        user.find(marker="note").type("seen")
        user.find(marker="keep").click()
        await user.should_see("the note is kept", retries=50)

    simulated(desk.Desk(runs, own=True), play)
    assert "seen" in [library.note(runs / "runs" / name) for name in ("with", "without")]


def test_a_bench_is_prepared_started_disturbed_and_stopped_from_the_page(tmp_path):
    one = desk.Desk(tmp_path, own=True)

    async def come(reached, what, press=lambda: None):
        """Press a button every two seconds until something is reached."""
        for attempt in range(PATIENCE):
            if reached():
                return
            if one.programs:
                assert one.programs[-1].status is None, (what, one.alarms)
            if attempt % 20 == 0:
                # the button may not be on the page yet
                with contextlib.suppress(AssertionError):
                    press()
            await asyncio.sleep(0.1)
        raise AssertionError(f"{what}: {one.doors and one.doors.no_modbus_because}, {one.alarms}")

    async def play(user):
        def press(marker):
            return lambda: user.find(marker=marker).click()

        def reported(code, **fields):
            def matches(event):
                return event.code == code and fields.items() <= event.fields.items()

            def is_reported():
                return any(matches(event) for event in one.bench.events)

            return is_reported

        user.find(marker="more").type(f"{FREE_PORTS} duration_max_s=600 stand_s=60")
        user.find(marker="prepare").click()
        await come(one.held, "held")
        await come(lambda: one.doors.state is State.RUNNING, "running", press("start"))

        # a running bench refuses another speed
        user.find(marker="set-speed").click()
        await user.should_see("the bench refuses speed_set_point", retries=PATIENCE)

        stuck = "speed_sensor_stuck axle=1"
        await come(reported(Code.FAULT_BEGINS, fault=stuck), "fault", press("inject"))
        await come(reported(Code.OPERATOR_NOTE), "acknowledged", press("acknowledge"))
        await come(reported(Code.FAULT_LIFTED, fault=stuck), "lifted", press("lift"))

        with user:
            user.find(kind=ui.select, marker="friction-3").elements.pop().value = 0.03
        await come(
            lambda: one.bench.value("friction_degraded", 3) == pytest.approx(0.03), "friction"
        )
        with user:
            user.find(kind=ui.number, marker="demand").elements.pop().value = 1.25
        user.find(marker="set-demand").click()
        await come(
            lambda: one.set_point("brake_demand_set_point") == pytest.approx(1.25e5), "demand"
        )

        # a page that is loaded again, or another browser, shows what is in force
        await user.open("/")

        def chosen(kind, marker):
            return user.find(kind=kind, marker=marker).elements.pop().value

        assert chosen(ui.select, "friction-3") == 0.03
        assert chosen(ui.select, "friction-2") == 0.0
        assert chosen(ui.number, "demand") == pytest.approx(1.25)
        assert "duration_max_s=600" in chosen(ui.input, "more")
        await user.should_see("in force: 0.030", retries=50)
        await user.should_see("set to 1.25 bar over Modbus", retries=50)
        # a page that follows sends no command by itself
        await asyncio.sleep(1.5)
        assert user.notify.messages.count("axle 3: 0.03") == 1

        # an operator who presses the emergency stop again does not reset it
        user.find(marker="emergency").click()
        await come(lambda: one.stopped, "emergency stop")
        for presses in (2, 3):
            user.find(marker="emergency").click()
            await come(
                lambda: user.notify.messages.count("emergency stop requested") == presses,  # noqa: B023
                "another emergency stop",
            )
        # a reset needs a confirmation, which a further stop makes void
        with pytest.raises(BusError, match="it was requested again in the meantime"):
            await one.reset_emergency_stop(one.stops - 1)
        await come(lambda: asked(user), "question", press("reset-emergency"))
        user.find(marker="keep-stopped").click()
        await come(lambda: not asked(user), "the question is closed")
        await come(lambda: asked(user), "question", press("reset-emergency"))
        assert not reported(Code.EMERGENCY_STOP_RESET)()
        user.find(marker="confirm-reset").click()
        await come(reported(Code.EMERGENCY_STOP_RESET), "reset")
        # a run that would be lost is ended only when the operator confirms it
        await come(lambda: asks_to_confirm(user), "question", press("stop"))
        user.find(marker="confirm-no").click()
        await come(lambda: not asks_to_confirm(user), "no")
        assert one.running()
        await come(lambda: asks_to_confirm(user), "question", press("stop"))
        with contextlib.suppress(AssertionError):
            await come(lambda: False, "ended", press("confirm-yes"))

    simulated(one, play)
    codes = [event["code"] for event in one.programs[-1].result["events"]]
    for code in (Code.RUN_STARTED, Code.RUN_STOPPED):
        assert code in codes
    emergency_stops = [code for code in codes if code.startswith("emergency_stop.")]
    assert emergency_stops == [Code.EMERGENCY_STOP_SET, Code.EMERGENCY_STOP_RESET]


@pytest.mark.nightly
def test_a_browser_runs_the_rig_sees_an_axle_lock_and_stops_it(tmp_path):
    with served(tmp_path) as one, browsing() as browser:
        browser.get(one.address)
        play_in(browser)
    (run,) = (tmp_path / "runs").iterdir()
    events = (run / "events.jsonl").read_text()
    assert "fault speed_sensor_stuck axle=1 begins" in events
    # the newest alarm, which may be a message of the unit about the sensor
    assert "note: alarm acknowledged at the desk: " in events
    assert '"emergency_stop.set"' in events


# whether a point in the middle of the button belongs to the button, and whether all of it is seen
EMERGENCY_IN_VIEW = """
const button = [...document.querySelectorAll("button")].find(
  (one) => one.textContent.trim() === "Emergency stop");
const box = button.getBoundingClientRect();
const inside = box.top >= 0 && box.left >= 0 && box.bottom <= window.innerHeight
  && box.right <= document.documentElement.clientWidth;
const top = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
return inside && button.contains(top);
"""
# how far the page is wider than the screen, in pixels
TOO_WIDE = "return document.documentElement.scrollWidth - document.documentElement.clientWidth;"


def open_tab(browser, name):
    """Open a tab of the page, as soon as the page is there."""
    path = f"//div[@role='tab'][.='{name}']"
    (tab,) = until(lambda: browser.find_elements("xpath", path), name)
    browser.execute_script("arguments[0].click()", tab)


@pytest.mark.nightly
def test_the_emergency_stop_stays_in_view_on_every_screen(tmp_path):
    with served(tmp_path) as one, browsing() as browser:
        browser.get(one.address)
        for width, height in ((390, 844), (1366, 768), (1920, 1080)):
            metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
            browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
            for tab in ("Manual", "Automatic", "Runs"):
                browser.execute_script("window.scrollTo(0, 0)")
                open_tab(browser, tab)
                until(lambda: browser.execute_script(EMERGENCY_IN_VIEW), (width, tab))
                browser.execute_script("window.scrollTo(0, document.body.scrollHeight)")
                until(lambda: browser.execute_script(EMERGENCY_IN_VIEW), (width, tab, "below"))
            open_tab(browser, "Manual")
            until(lambda: browser.execute_script(TOO_WIDE) <= 0, (width, "too wide"))


# whether the columns of the table of runs fit into its frame
TABLE_FITS = """
const frame = document.querySelector(".desk-runs .q-table__middle");
return frame !== null && frame.clientWidth > 0 && frame.scrollWidth <= frame.clientWidth;
"""


@pytest.mark.nightly
@pytest.mark.parametrize("width", [1180, 1280, 1700])
def test_every_column_of_the_table_of_runs_is_in_view(runs, width):
    with served(runs) as one, browsing() as browser:
        browser.get(one.address)
        metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
        open_tab(browser, "Runs")
        until(lambda: browser.find_elements("xpath", "//td[.='runs/damaged']"), "runs")
        until(lambda: browser.execute_script(TABLE_FITS), width)


@pytest.mark.nightly
def test_the_plots_have_legends_and_an_idle_rig_has_no_magnified_noise(tmp_path):
    chart_options = """
    return desk.settings.plots.map((plot) => {
      const option = getElement(plot.id).chart.getOption();
      return {
        names: [...new Set(option.series.map((one) => one.name))],
        legend: option.legend.length,
        top: option.yAxis[0].max,
        least: plot.least,
      };
    });
    """
    noise = """
    const noise = [[0, 1e-4], [1, 2e-4], [2, null]];
    return verticalRange([{ data: noise }], 1.0);
    """
    with served(tmp_path) as one, browsing() as browser:
        browser.get(one.address)
        until(lambda: browser.execute_script("return Boolean(window.desk?.settings)"), "settings")
        plots = browser.execute_script(chart_options)
        assert len(plots) == 4
        for plot in plots:
            assert plot["legend"] == 1
            assert {f"axle {axle}" for axle in range(1, 5)} <= set(plot["names"])
            assert plot["top"] == plot["least"] > 0.0
        assert {"vehicle", "measured by the sensors", "WSP reference"} <= set(plots[0]["names"])
        assert browser.execute_script(noise) == {"min": 0, "max": 1}
        # the headline has what an operator needs; cycles and deadlines are at the light of the loop
        labels = [one.text for one in browser.find_elements("css selector", ".desk-figure span")]
        assert labels[0] == "simulated time"
        assert not any("tick" in label or "missed" in label for label in labels)


@pytest.mark.nightly
def test_who_works_with_the_keyboard_sees_where_it_is(tmp_path):
    focused = """
    const one = document.activeElement;
    const shown = one.closest(".q-field__control") ?? one;
    const style = getComputedStyle(shown);
    const framed = style.outlineStyle === "solid" && parseFloat(style.outlineWidth) >= 2;
    return [one.tagName, framed || style.boxShadow.includes("0px 0px 0px 3px")];
    """
    with served(tmp_path) as one, browsing() as browser:
        browser.get(one.address)
        until(lambda: browser.find_elements("xpath", "//button"), "buttons")
        body = browser.find_element("css selector", "body")
        seen = set()
        for _ in range(14):
            body.send_keys(TABULATOR) if not seen else browser.switch_to.active_element.send_keys(
                TABULATOR
            )
            tag, is_framed = browser.execute_script(focused)
            if tag != "BODY":
                seen.add(tag)
                assert is_framed, tag
        assert {"BUTTON", "INPUT"} <= seen


def play_in(browser):
    """Run the rig from the page: prepare, start, inject a fault, lock an axle, and stop."""
    desk_page = Page(browser)
    desk_page.shows("This page has no safety function")
    desk_page.prepare("adhesion=leaf_film initial_speed_m_s=6 duration_max_s=600 stand_s=60")
    desk_page.click("Start")
    desk_page.shows(": running")
    desk_page.click("Inject")
    desk_page.shows("speed_sensor_stuck axle=1 begins")
    desk_page.put("brake demand, bar", "3.8")
    desk_page.click("Set")
    desk_page.shows("1: locked")
    desk_page.click("check")
    desk_page.shows("acknowledged ")
    desk_page.click("Emergency stop")
    desk_page.click("Reset emergency stop")
    desk_page.click("Confirm reset")
    desk_page.end()
    desk_page.open_tab("Runs")
    desk_page.there("//td[.='runs/velim_a1']")
