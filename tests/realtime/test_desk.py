"""The desk: what it reads of a bench, whom it serves, what its page shows and refuses."""

import asyncio
import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from bench_process import until

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.modbus.map import State
from rollerrig.realtime.loop import ring
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make

pytest.importorskip("nicegui", reason="the desk needs nicegui")

from nicegui import ui
from nicegui.testing.user_simulation import user_simulation

from rollerrig.realtime.desk import desk, library, page, reader, server

FREE_PORTS = "modbus.port=0 bus.interface=hub bus.socketcand_port=0"
WRITER = """
import time
import numpy as np
from rollerrig.realtime.loop import ring
from rollerrig.wsp_interface import signals
rows = ring.Ring(ring.place("rows"), np.float64, 64, len(signals.COLUMNS))
events = ring.Ring(ring.place("events"), np.int64, 64, ring.EVENT_WORDS)
print("there", flush=True)
time.sleep(900)
"""
PATIENCE = 1200  # of 0.1 s: a first run compiles, perhaps on a busy machine


@pytest.fixture
def rings():
    """Rings as a bench makes them, of this process."""
    made = [
        ring.Ring(ring.place("rows"), np.float64, 4096, len(signals.COLUMNS)),
        ring.Ring(ring.place("events"), np.int64, 256, ring.EVENT_WORDS),
    ]
    yield made
    for one in made:
        one.unlink()


def row(time_s, **values):
    found = np.zeros(len(signals.COLUMNS))
    found[signals.column("time")] = time_s
    for name, value in values.items():
        found[signals.column(name)] = value
    return found


# -- what is read


def test_no_spike_is_lost_in_what_a_page_is_told(rings):
    bench = reader.find(among=[os.getpid()])
    spike = 3.3
    for at in range(1000):
        rings[0].push(row(0.01 * at, sliding=spike if at == 637 else 0.0))
        if at % 37 == 0:
            bench.poll()
    bench.poll()
    recent, at = np.array(bench.since(0)), reader.COLUMNS.index("sliding_1_m_s")
    assert recent[:, at].max() == bench.whole[:, at].max() == spike
    assert (
        len(recent) == bench.points == 2 * 99
    )  # a pair for each tenth of a second, but the one that goes on
    assert bench.since(bench.points) == []
    assert len(bench.since(bench.points - 4)) == 4


def test_a_bench_tells_where_it_listens_which_faults_act_and_how_it_ended(rings):
    rows, events = rings
    stuck = {"fault": "speed_sensor_stuck axle=2", "kind": "speed_sensor_stuck"}
    off = {"fault": "node_off node=1", "kind": "node_off", "reaches_unit": False}
    for code, fields in (
        (Code.BUS_PLACE, {"address": "socketcand://127.0.0.1:4711/rig0"}),
        (Code.MODBUS_SERVED, {"transport": "TCP", "host": "127.0.0.1", "port": 5021}),
        (Code.FAULT_BEGINS, stuck | {"reaches_unit": False}),
        (Code.FAULT_BEGINS, off),
        (Code.FAULT_LIFTED, off | {"frames_met": None}),
    ):
        ring.push_event(events, make(0.0, code, **fields))
    bench = reader.find(among=[os.getpid()])
    bench.poll()
    assert (bench.bus, bench.modbus) == ("socketcand://127.0.0.1:4711/rig0", ("127.0.0.1", 5021))
    assert bench.faults == ["speed_sensor_stuck axle=2"]
    assert bench.ended == ""
    rows.close()
    assert bench.ended == "closed"
    assert reader.find(among=[os.getpid()]) is None


def test_a_bench_that_is_killed_is_an_alarm(tmp_path):
    writer = subprocess.Popen([sys.executable, "-c", WRITER], stdout=subprocess.PIPE, text=True)
    try:
        assert writer.stdout.readline()
        one = desk.Desk(tmp_path, own=True)
        one.bench = reader.find(among=[writer.pid])
        one.look()
        assert not one.alarms
        writer.kill()
        writer.wait()
        one.look()
        one.look()
        assert [alarm.text[:20] for alarm in one.alarms] == ["the bench was killed"]
    finally:
        writer.kill()
        writer.communicate()
        for path in ring.folder().glob(f"rollerrig-{writer.pid}-*"):
            path.unlink()


# -- whom it serves


@pytest.mark.parametrize(
    ("heads", "asked", "token", "why"),
    [
        ({"host": "127.0.0.1:8530"}, "", "", ""),
        ({"host": "localhost:8530", "origin": "http://localhost:8530"}, "", "", ""),
        (
            {"host": "127.0.0.1:8530", "origin": "http://elsewhere.example"},
            "",
            "",
            "are not allowed",
        ),
        ({"host": "elsewhere.example"}, "", "", "answers to 127.0.0.1"),
        ({"host": "10.0.0.1:8530"}, "", "secret", "token is missing"),
        ({"host": "10.0.0.1:8530"}, "sekret", "secret", "token is missing or wrong"),
        ({"host": "10.0.0.1:8530"}, "secret", "secret", ""),
        ({"host": "10.0.0.1:8530", "cookie": f"{server.COOKIE}=secret"}, "", "secret", ""),
        ({"host": "10.0.0.1:8530", "cookie": f"{server.COOKIE}=wrong"}, "", "secret", "token"),
    ],
)
def test_who_is_refused(heads, asked, token, why):
    told = server.refused(heads, asked, token)
    assert (why in told) if why else told == ""


@contextlib.contextmanager
def served(folder, *arguments):
    """A desk as a process of its own, and its address."""
    # NiceGUI takes a process of pytest for a simulation
    outside = {key: value for key, value in os.environ.items() if key != "PYTEST_CURRENT_TEST"}
    with open(folder / "desk.stderr", "wb") as said:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "rollerrig.realtime.cli",
                "desk",
                "--port",
                "0",
                "--own",
                "--folder",
                str(folder),
                "--json",
                *arguments,
            ],
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            env=outside,
        )
    try:
        yield json.loads(process.stdout.readline())["address"]
    finally:
        process.terminate()
        process.communicate(timeout=60)
        for one in Path("/proc").glob("[0-9]*/cwd"):  # what the desk has started goes on without it
            with contextlib.suppress(OSError):
                if one.resolve() == folder.resolve():
                    os.kill(int(one.parent.name), signal.SIGKILL)


def get(address, **heads):
    try:
        with urllib.request.urlopen(
            urllib.request.Request(address, headers=heads), timeout=60
        ) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_a_desk_serves_its_page_on_loopback_and_a_second_one_on_its_port_is_refused(tmp_path):
    (tmp_path / "reports").mkdir()
    (tmp_path / "reports/report.html").write_text("the report")
    (tmp_path / "secret.toml").write_text("no report")
    with served(tmp_path) as address:
        assert page.NO_SAFETY in get(address)[1]
        assert json.loads(get(address + "desk/rows")[1])["bench"] == ""
        assert get(address + "desk/rows", Origin="http://elsewhere.example")[0] == 403
        assert get(address + "file/reports/report.html") == (200, "the report")
        assert "no report is there" in get(address + "file/secret.toml")[1]
        assert "no report is there" in get(address + "file/%2e%2e/%2e%2e/etc/hostname")[1]
        port = address.rstrip("/").rpartition(":")[2]
        second = subprocess.run(
            [sys.executable, "-m", "rollerrig.realtime.cli", "desk", "--port", port],
            capture_output=True,
            text=True,
            timeout=120,
        )
    assert second.returncode == 2
    assert "if a desk runs there already, open http://127.0.0.1:" in second.stderr
    assert "Traceback" not in second.stderr


def test_beyond_loopback_it_says_so_loudly_and_wants_its_token(tmp_path):
    with served(tmp_path, "--host", "0.0.0.0") as address:
        token, here = (
            address.partition("token=")[2],
            address.partition("?")[0].replace("0.0.0.0", "127.0.0.1"),
        )
        assert len(token) >= 32
        assert get(here)[0] == get(here + "?token=" + token[:-1])[0] == 403
        assert get(here + "?token=" + token)[0] == 200
        assert get(here + "desk/rows", Cookie=f"{server.COOKIE}={token}")[0] == 200
    assert "THE DESK LISTENS BEYOND THIS MACHINE" in (tmp_path / "desk.stderr").read_text()


# -- the library


@pytest.fixture
def runs(tmp_path, stop_on_leaves, stop_without_wsp):
    """A folder with two runs and what is left of two others."""
    for name, run in (
        ("with", stop_on_leaves),
        ("without", stop_without_wsp),
        ("cut", stop_on_leaves),
        ("damaged", stop_on_leaves),
    ):
        shutil.copytree(run.out, tmp_path / "runs" / name)
    (tmp_path / "runs/cut/summary.json").unlink()
    (tmp_path / "runs/damaged/summary.json").write_text("{")
    return tmp_path


def test_the_library_lists_runs_also_those_without_a_summary(runs):
    rows = {one["name"]: one for one in library.rows(runs)}
    assert rows["runs/with"]["verdict"] == "valid"
    assert rows["runs/with"]["longest_lock_s"] < rows["runs/without"]["longest_lock_s"]
    assert "it has no summary" in rows["runs/cut"]["verdict"]
    assert "not valid JSON" in rows["runs/damaged"]["verdict"]


def test_a_note_that_cannot_be_written_leaves_the_old_one(runs):
    library.write_note(runs / "runs/with", "first stop of the day")
    (runs / "runs/with/.note.txt.new").mkdir()
    with pytest.raises(ConfigError, match=r"cannot be written.*the old note is kept"):
        library.write_note(runs / "runs/with", "another")
    assert library.note(runs / "runs/with") == "first stop of the day"


@pytest.mark.parametrize(("kind", "name"), [("csv", "with.zip"), ("mat", "with.mat")])
def test_a_run_is_downloaded_as_export_writes_it(runs, kind, name):
    assert library.export(runs / "runs/with", kind)[0] == name
    with pytest.raises(ConfigError, match="no such file"):
        library.export(runs / "runs", kind)


# -- the page


def simulated(one, play):
    """Let a simulated user play on the page of a desk that works meanwhile."""

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


def test_without_a_bench_the_page_says_so_and_refuses_in_words(tmp_path):
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


def test_what_a_command_line_refuses_becomes_an_alarm_that_is_acknowledged(tmp_path):
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


def test_two_runs_are_compared_and_a_note_is_kept_on_the_page(runs):
    async def play(user):
        user.find(marker="compare").click()
        await user.should_see("0 runs are chosen in the table: choose 2", retries=50)
        table = user.find(kind=ui.table, marker="runs").elements.pop()
        table.selected = [one for one in table.rows if one["name"] in ("runs/with", "runs/without")]
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
        for at in range(PATIENCE):
            if reached():
                return
            assert not one.programs or one.programs[-1].status is None, (what, one.alarms)
            if at % 20 == 0:
                with contextlib.suppress(AssertionError):  # it is not there yet
                    press()
            await asyncio.sleep(0.1)
        raise AssertionError(f"{what}: {one.doors and one.doors.why}, {one.alarms}")

    async def play(user):
        def press(marker):
            return lambda: user.find(marker=marker).click()

        def told(code, **fields):
            return lambda: any(
                event.code == code and fields.items() <= event.fields.items()
                for event in one.bench.events
            )

        user.find(marker="more").type(f"{FREE_PORTS} duration_max_s=600 stand_s=60")
        user.find(marker="prepare").click()
        await come(one.held, "held")
        await come(lambda: one.doors.state is State.RUNNING, "running", press("start"))
        user.find(marker="set-speed").click()  # not while it runs
        await user.should_see("the bench refuses speed_set_point", retries=PATIENCE)
        await come(
            told(Code.FAULT_BEGINS, fault="speed_sensor_stuck axle=1"), "fault", press("inject")
        )
        await come(told(Code.OPERATOR_NOTE), "acknowledged", press("acknowledge"))
        await come(
            told(Code.FAULT_LIFTED, fault="speed_sensor_stuck axle=1"), "lifted", press("lift")
        )
        with user:
            user.find(kind=ui.select, marker="friction-3").elements.pop().value = 0.03
        await come(
            lambda: one.bench.value("friction_degraded", 3) == pytest.approx(0.03), "friction"
        )
        user.find(marker="emergency").click()
        await user.should_see("Reset emergency stop", retries=PATIENCE)
        with contextlib.suppress(AssertionError):
            await come(lambda: False, "ended", press("stop"))

    simulated(one, play)
    codes = [event["code"] for event in one.programs[-1].result["events"]]
    for code in (Code.RUN_STARTED, Code.EMERGENCY_STOP_SET, Code.RUN_STOPPED):
        assert code in codes


def test_a_browser_runs_the_rig_sees_an_axle_lock_and_stops_it(tmp_path):
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    if not (shutil.which("chromium") and shutil.which("chromedriver")):
        pytest.skip("Debian's chromium and chromium-driver are not installed")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    for word in (
        "--headless=new",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-dev-shm-usage",
        "--window-size=1700,1500",
    ):
        options.add_argument(word)
    with served(tmp_path) as address:
        browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
        try:
            browser.get(address)
            play_in(browser)
        finally:
            browser.quit()
    (run,) = (tmp_path / "runs").iterdir()
    told = (run / "events.jsonl").read_text()
    assert "fault speed_sensor_stuck axle=1 begins" in told
    # the newest, which may be the unit's own word on the sensor
    assert "note: alarm acknowledged at the desk: " in told
    assert '"emergency_stop.set"' in told


def play_in(browser):
    def there(path):
        return until(lambda: next(iter(browser.find_elements("xpath", path)), None), path)

    def click(text):
        # not the mouse: a message of before may lie over the button
        browser.execute_script(
            "arguments[0].click()", there(f"//button[not(@disabled)][normalize-space()='{text}']")
        )

    def put(label, text):
        field = there(f"//input[@aria-label='{label}']")
        field.send_keys(
            "\ue009a\ue000", text, "\ue004"
        )  # all of it anew, then on to the next field

    def shows(text):
        return there(f"//*[contains(text(), '{text}')]")

    shows("This page has no safety function")
    put(
        "further values, as in adhesion.mu_cd=0.05",
        f"{FREE_PORTS} adhesion=leaf_film initial_speed_m_s=6 duration_max_s=600 stand_s=60",
    )
    click("Prepare")
    shows(": held")
    put("brake demand, bar", "0")
    click("Set")
    shows("demand 0.00 bar")
    click("Start")
    shows(": running")
    click("Inject")
    shows("speed_sensor_stuck axle=1 begins")
    put("brake demand, bar", "3.8")
    click("Set")
    shows("1: locked")
    click("check")
    shows("acknowledged ")
    click("Emergency stop")
    click("Reset emergency stop")
    click("Stop")
    shows("its run is under Runs")
    browser.execute_script("arguments[0].click()", there("//div[@role='tab'][.='Runs']"))
    there("//td[.='runs/velim_a1']")
