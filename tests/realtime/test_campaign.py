"""Campaigns: the result does not depend on how the runs are spread, nor on killed processes."""

import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import program
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pypdf import PdfReader

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign, design, outcome, spreading, stopping
from rollerrig.realtime.reports import campaign as report

PLAN = """
title = "short stops"
scenario = "{scenario}"
design = "{design}"
runs = 12
seed = 3
chunk = 2

[vary]
{vary}
"""
SCENARIO = """
title = "A short stop"
initial_speed_m_s = 3.0
[[demand]]
pressure_Pa = 3.8e5
"""
MATRIX = '"adhesion.mu_cd" = [0.03, 0.06, 0.1]\ninitial_speed_m_s = [2.0, 3.0, 4.0, 5.0]'
SPEEDS = f"initial_speed_m_s = {[2.0 + 0.1 * k for k in range(12)]}"
RANGES = """"adhesion.mu_cd" = { low = 0.03, high = 0.1, log = true }
initial_speed_m_s = { low = 2.0, high = 5.0 }"""
RUNS = 12  # of both designs
# Sobol indices need more runs
DRAWN_DESIGNS = [name for name in design.DESIGNS if name not in (design.MATRIX, design.SALTELLI)]


@pytest.fixture
def plan_file(tmp_path):
    (tmp_path / "short.toml").write_text(SCENARIO)

    def write(design="matrix", vary=MATRIX) -> str:
        path = tmp_path / f"{design}.toml"
        path.write_text(PLAN.format(scenario=tmp_path / "short.toml", design=design, vary=vary))
        return str(path)

    return write


def content(out: Path) -> dict[str, list]:
    return campaign.result(out).to_pydict()


def run_serially(plan, out, chunks=None) -> None:
    """Run chunks one after another; by default those that are missing."""
    if chunks is None:
        chunks = campaign.open_result(plan, out)
    for chunk in chunks:
        campaign.write_chunk(out, chunk, campaign.run_chunk(plan, chunk))


def write_times_ns(out: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in (out / "results").glob("*.parquet")}


def assert_unchanged(times_ns: dict[Path, int]) -> None:
    for path, time_ns in times_ns.items():
        assert path.stat().st_mtime_ns == time_ns


def campaign_words(plan: str, out: Path) -> list[str]:
    """Return the words of the command line for a campaign with one worker."""
    return ["campaign", plan, "--workers", "1", "--out", str(out)]


def campaign_command(plan: str, out: Path) -> list[str]:
    """Return the command of a campaign with one worker."""
    return [sys.executable, "-m", "rollerrig.realtime.cli", *campaign_words(plan, out)]


def test_a_matrix_runs_every_combination_once(plan_file, tmp_path):
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path / "out")
    rows = content(tmp_path / "out")
    assert rows["run"] == list(range(RUNS))
    combinations = set(zip(rows["adhesion.mu_cd"], rows["initial_speed_m_s"], strict=True))
    assert len(combinations) == RUNS
    assert all(rows["stopped"])
    assert rows["error"] == [None] * RUNS


def test_one_campaign_runs_several_vehicles_as_each_runs_alone(plan_file, tmp_path):
    vary = "initial_speed_m_s = [3.0, 5.0]\nvehicle_set = {}"
    names = ["uic_z1", "bogie_module", "multiple_unit_2_cars"]
    run_serially(campaign.load(plan_file(vary=vary.format(json.dumps(names)))), tmp_path / "all")
    rows = content(tmp_path / "all")
    assert rows["vehicle_set"] == names * 2
    assert all(rows["stopped"])
    for at, name in enumerate(names):
        plan = campaign.load(plan_file(vary=vary.format(json.dumps([name]))))
        run_serially(plan, tmp_path / name)
        alone = content(tmp_path / name)
        for figure in ("stop_distance_m", "stop_time_s", "longest_lock_s"):
            assert alone[figure] == rows[figure][at :: len(names)]


def test_a_run_that_does_not_stop_in_its_time_has_the_fields_that_statistics_read(
    plan_file, tmp_path
):
    plan = campaign.load(plan_file(vary="duration_max_s = [1.5, 60.0]"))
    run_serially(plan, tmp_path / "out")
    rows = content(tmp_path / "out")
    assert rows["valid"] == [False, True]
    assert rows["stopped"] == [False, True]
    assert rows["stop_distance_m"][0] is None
    counts, distance_m = stopping.counted(campaign.result(tmp_path / "out"))
    assert counts.tolist() == [True, True]
    assert np.isinf(distance_m).tolist() == [True, False]


@pytest.mark.parametrize("drawn", DRAWN_DESIGNS)
def test_a_random_design_repeats_and_stays_within_its_bounds(plan_file, drawn):
    first = campaign.load(plan_file(drawn, RANGES))
    second = campaign.load(plan_file(drawn, RANGES))
    assert first.points == second.points
    assert len(set(first.points)) == RUNS
    for mu_cd, speed_m_s in first.points:
        assert 0.03 <= mu_cd <= 0.1
        assert 2.0 <= speed_m_s <= 5.0


def test_a_campaign_that_was_interrupted_computes_only_the_missing_chunks(plan_file, tmp_path):
    plan = campaign.load(plan_file())
    out = tmp_path / "out"
    missing = campaign.open_result(plan, out)
    run_serially(plan, out, missing[:4])
    before = write_times_ns(out)
    assert len(before) == 4
    assert campaign.open_result(plan, out) == missing[4:]
    run_serially(plan, out)
    assert_unchanged(before)
    assert content(out)["run"] == list(range(RUNS))


def test_a_result_folder_of_another_plan_is_refused(plan_file, tmp_path):
    campaign.open_result(campaign.load(plan_file()), tmp_path / "out")
    with pytest.raises(ConfigError, match="another plan"):
        campaign.open_result(campaign.load(plan_file("sobol", RANGES)), tmp_path / "out")


@pytest.mark.parametrize("changed", ["short.toml", "unit.toml"])
def test_a_campaign_whose_scenario_or_unit_has_changed_is_not_continued(
    plan_file, tmp_path, changed
):
    unit = tmp_path / "unit.toml"
    unit.write_text("cut_off_m_s = 1.0\n")
    scenario = tmp_path / "short.toml"
    scenario.write_text(f'wsp_config = "{unit}"\n{SCENARIO}')
    name = plan_file()
    campaign.open_result(campaign.load(name), tmp_path / "out")
    campaign.open_result(campaign.load(name), tmp_path / "out")  # nothing has changed

    edited = {"short.toml": ("3.8e5", "3.7e5"), "unit.toml": ("1.0", "1.1")}[changed]
    path = tmp_path / changed
    path.write_text(path.read_text().replace(*edited))
    with pytest.raises(ConfigError, match="another plan, scenario, unit or version"):
        campaign.open_result(campaign.load(name), tmp_path / "out")


@pytest.mark.parametrize(
    ("kind", "vary", "message"),
    [
        ("matrix", '"adhesion.mu_cd" = 0.05', "list of values"),
        ("sobol", '"adhesion.mu_cd" = [0.03, 0.06]', "low = "),
        ("sobol", '"adhesion.mu_cd" = { low = 0.1, high = 0.03 }', "must rise"),
        ("matrix", '"adhesion.mu_kd" = [0.03]', "mu_cd"),
        ("matrix", '"adhesion.mu_cd" = [7.0]', "out of range"),
    ],
)
def test_a_bad_plan_is_refused_before_the_first_run(plan_file, kind, vary, message):
    with pytest.raises(ConfigError, match=message):
        campaign.load(plan_file(kind, vary))


def test_the_worst_runs_are_listed_with_the_unit_of_their_figure():
    assert report.read_with_unit("braking_distance_m", 1047.2) == "1047 m"
    assert report.read_with_unit("braking_distance_m", None) == "not stopped"


def test_the_message_about_an_unknown_key_of_a_plan_lists_its_values_and_its_tables(plan_file):
    path = Path(plan_file())
    path.write_text(f"varied = 1\n{path.read_text()}")
    with pytest.raises(ConfigError, match="unknown key 'varied'") as refused:
        campaign.load(str(path))
    allowed = str(refused.value).partition("Allowed: ")[2].split(", ")
    assert {"runs", "design", "vary", "inputs", "correlation", "etcs"} <= set(allowed)


def test_the_worst_runs_are_worst_in_the_direction_of_their_figure(plan_file):
    plan = campaign.load(plan_file())
    table = pa.table(
        {
            "run": range(RUNS),
            "invalid_because": pa.nulls(RUNS),
            "stop_distance_m": [*map(float, range(RUNS - 1)), None],
            "braking_distance_m": [*map(float, range(RUNS - 1)), None],
            "adhesion_mean": [0.1 + 0.01 * k for k in range(RUNS)],
        }
    )
    longest = [row["run"] for row in report.worst(plan, table, "braking_distance_m")]
    assert longest == [11, 10, 9, 8, 7]
    least_adhesion = [row["run"] for row in report.worst(plan, table, "adhesion_mean")]
    assert least_adhesion == [0, 1, 2, 3, 4]


def test_the_page_shows_every_figure_against_what_was_varied(plan_file, tmp_path):
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path)
    found = outcome.read(plan, tmp_path)
    # pictures of many figures take long
    figures = ("stop_distance_m", "braking_distance_m", "dissipated_energy_J")
    found = found._replace(quantiles=[row for row in found.quantiles if row[0] in figures])
    page = report.write(plan, found, tmp_path, "stop_distance_m").read_text()
    # a map over two inputs, and the figures against each input
    assert page.count("<svg") == 2
    assert page.index("Worst distance from the start") < page.index("<svg")
    assert "rollerrig run " in page
    for name in (
        *plan.axes,
        "adhesion: mu_cd",
        "initial speed, m/s",
        "stopping distance, m",
        "energy of sliding, MJ",
    ):
        assert name in page


def test_the_page_begins_with_a_title_block_and_the_stopping_distance(plan_file, tmp_path):
    plan = campaign.load(plan_file("sobol", RANGES))
    run_serially(plan, tmp_path)
    about = {"document number": "R-12", "revision": "B", "tested by": "A. Meier"}
    found = outcome.read(plan, tmp_path)
    # pictures of many figures take long
    found = found._replace(quantiles=found.quantiles[:2])
    path = report.write(plan, found, tmp_path, "stop_time_s", True, about)
    page = path.read_text()
    headings = re.findall(r"<h2[^>]*>(.*?)</h2>", page)
    assert headings[:2] == ["Stopping distance", "What was varied"]
    assert headings[-1] == "Signatures"
    for text in ("document number", "R-12", "sobol, seed 3", "reference WSP", "Not a certif"):
        assert page.index(text) < page.index("Stopping distance")
    ranges = page[page.index("What was varied") :]
    for cell in ("adhesion: mu_cd", "0.03", "0.1", "evenly in the logarithm", "2", "5"):
        assert f">{cell}<" in ranges
    # the range is in the map, and the axes have names and units
    assert "range of the plan" in page
    assert "initial speed, m/s" in page
    # a label of a logarithmic axis is a number, not a formula
    assert "mathdefault" not in page
    reader = PdfReader(path.with_suffix(".pdf"))
    assert reader.metadata.title == "short stops"
    assert "revision: B" in reader.pages[0].extract_text()
    assert f"page 1 of {len(reader.pages)}" in reader.pages[0].extract_text()


@pytest.mark.parametrize(
    ("key", "title"),
    [
        ("initial_speed_m_s", "initial speed, m/s"),
        ("vehicle.mass_kg", "vehicle: mass, kg"),
        ("adhesion.mu_cd", "adhesion: mu_cd"),
        ("valve.dead_time_s", "valve: dead time, s"),
    ],
)
def test_an_input_is_named_in_words_with_its_unit(key, title):
    assert report.input_title(key) == title


def dying_unit():
    """Return a unit that kills its process in its first call; later it energises no magnet."""
    dead = Path(os.environ["ROLLERRIG_TEST_DEAD"])

    def unit(_inputs) -> int:
        if not dead.exists():
            dead.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    return unit


@pytest.mark.nightly
def test_a_worker_that_dies_costs_no_run(plan_file, tmp_path, monkeypatch):
    monkeypatch.setenv("ROLLERRIG_TEST_DEAD", str(tmp_path / "dead"))
    plan = campaign.load(plan_file(), True, unit=f"{__name__}:dying_unit", design="matrix")
    out = tmp_path / "out"
    for chunk, rows in spreading.on_this_machine(
        campaign.work(plan), campaign.open_result(plan, out), 2
    ):
        campaign.write_chunk(out, chunk, rows)
    assert (tmp_path / "dead").exists()
    assert content(out)["run"] == list(range(RUNS))
    assert all(content(out)["stopped"])


@pytest.mark.nightly
def test_a_campaign_that_was_killed_continues_where_it_stopped(plan_file, tmp_path):
    out = tmp_path / "out"
    words = campaign_words(plan_file(vary=SPEEDS), out)
    killed = program.start(words, tmp_path / "stdout", tmp_path / "stderr")
    until_s = time.monotonic() + 120.0
    while len(write_times_ns(out)) < 2 and time.monotonic() < until_s:
        time.sleep(0.02)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    before = write_times_ns(out)
    assert len(before) >= 2

    second = program.rollerrig(*words, "--json")
    assert second.status == 0, second.messages
    assert json.loads(second.printed)["runs"] == RUNS
    assert f"continued: {2 * len(before)} of {RUNS} runs were there" in second.messages
    assert_unchanged(before)


@pytest.mark.parametrize(
    "by", [pytest.param(signal.SIGINT, marks=pytest.mark.nightly), signal.SIGTERM]
)
def test_an_interrupted_campaign_stops_in_order_and_keeps_its_finished_runs(
    plan_file, tmp_path, by
):
    out = tmp_path / "out"
    # long enough that runs are left
    plan = plan_file(vary='"adhesion.mu_cd" = [0.03, 0.06]\ninitial_speed_m_s = [30.0, 31.0, 32.0]')
    stderr = tmp_path / "stderr"
    first = program.start(campaign_words(plan, out), tmp_path / "stdout", stderr)
    until_s = time.monotonic() + 120.0
    while not write_times_ns(out) and time.monotonic() < until_s:
        time.sleep(0.01)
    first.send_signal(by)
    status = first.wait()
    printed = stderr.read_text()
    assert status == 4, printed
    assert "interrupted" in printed
    # a process that leaves semaphores behind has not ended in order
    assert "leaked" not in printed
    assert write_times_ns(out)


@pytest.mark.nightly
def test_a_campaign_shows_no_counter_of_runs_before_its_first_result(plan_file, tmp_path):
    done = subprocess.run(
        campaign_command(plan_file(), tmp_path / "out"), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert not re.search(rf"^0 of {RUNS} runs", done.stderr, re.MULTILINE)
    assert "continued" not in done.stderr


@pytest.mark.nightly
def test_a_campaign_that_is_killed_again_and_again_gives_the_same_result_to_the_byte(
    plan_file, tmp_path
):
    plan = plan_file("random", RANGES)
    run_serially(campaign.load(plan), tmp_path / "whole")
    out = tmp_path / "killed"
    for chunks in (1, 2, 4):
        process = subprocess.Popen(
            campaign_command(plan, out), stderr=subprocess.DEVNULL, start_new_session=True
        )
        until_s = time.monotonic() + 120.0
        while len(write_times_ns(out)) < chunks and time.monotonic() < until_s:
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        assert len(write_times_ns(out)) >= chunks
    assert subprocess.run(campaign_command(plan, out), capture_output=True).returncode == 0

    names = sorted(path.name for path in (tmp_path / "whole" / "results").iterdir())
    assert sorted(path.name for path in (out / "results").iterdir()) == names
    for name in names:
        whole = tmp_path / "whole" / "results" / name
        assert (out / "results" / name).read_bytes() == whole.read_bytes()


@pytest.mark.nightly
def test_a_full_disk_stops_a_campaign_with_status_2_and_finished_chunks_are_kept(
    plan_file, tmp_path
):
    plan = campaign.load(plan_file())
    out = tmp_path / "out"
    run_serially(plan, out, campaign.open_result(plan, out)[:2])
    before = {path: path.read_bytes() for path in (out / "results").iterdir()}

    def limit_file_size() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))

    process = subprocess.run(
        campaign_command(plan_file(), out),
        capture_output=True,
        text=True,
        preexec_fn=limit_file_size,
        # the limit would cut off the bytecode that Python caches for all later starts
        env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert process.returncode == 2
    assert "make room" in process.stderr
    assert {path: path.read_bytes() for path in (out / "results").iterdir()} == before


@pytest.mark.nightly
def test_a_cluster_that_loses_a_worker_gives_the_same_result_as_this_machine(plan_file, tmp_path):
    pytest.importorskip("distributed")
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path / "local")
    scheduler, address = start_scheduler()
    workers = [start_worker(address) for _ in range(3)]
    try:
        out = tmp_path / "cluster"
        chunks = campaign.open_result(plan, out)
        for count, (chunk, rows) in enumerate(
            spreading.on_a_cluster(campaign.work(plan), chunks, address)
        ):
            campaign.write_chunk(out, chunk, rows)
            if count == 0:
                workers[0].send_signal(signal.SIGKILL)
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()

    local = tmp_path / "local" / "results"
    names = sorted(path.name for path in local.iterdir())
    assert sorted(path.name for path in (out / "results").iterdir()) == names
    for name in names:
        from_cluster = pq.read_table(out / "results" / name)
        assert from_cluster.equals(pq.read_table(local / name))


def test_a_cluster_without_workers_is_reported_and_computes_when_one_has_joined(
    plan_file, tmp_path, monkeypatch
):
    pytest.importorskip("distributed")
    monkeypatch.setattr(spreading, "REPORT_AFTER_S", 0.2)
    plan = campaign.load(plan_file())
    scheduler, address = start_scheduler()
    processes = [scheduler]
    messages = []

    def report(message):
        messages.append(message)
        processes.append(start_worker(address))

    try:
        done = dict(spreading.on_a_cluster(campaign.work(plan), [0, 1], address, report))
    finally:
        for process in processes:
            process.kill()
            process.wait()
    assert sorted(done) == [0, 1]
    assert messages == [
        f"no worker is connected to {address}, so nothing is computed; start one with 'dask worker "
        f"{address}' (Ctrl-C stops, and finished chunks are kept)"
    ]


def test_a_page_has_one_definition_of_a_quantile_and_no_exponents(plan_file, tmp_path):
    """A quantile is the value of a run, so counts are whole numbers."""
    plan = campaign.load(plan_file(design="random", vary=RANGES))
    run_serially(plan, tmp_path / "out")
    found = outcome.read(plan, tmp_path / "out")
    bounds = {bound["quantile"]: bound for bound in stopping.bounds(found.distance_m)}
    (shown,) = [values for name, values in found.quantiles if name == "braking_distance_m"]
    for quantile, value in zip(outcome.QUANTILES, shown, strict=True):
        if quantile in bounds:
            assert bounds[quantile]["estimate_m"] == value
    for name, values in found.quantiles:
        column = content(tmp_path / "out")[name]
        assert set(values) <= set(column)
    for row in report.cells(found):
        assert not any("e+" in cell or "e-" in cell for cell in row[1:])


def start_scheduler() -> tuple[subprocess.Popen, str]:
    """Start a Dask scheduler; return its process and its address when it listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            str(port),
            "--no-dashboard",
        ],
        stderr=subprocess.DEVNULL,
    )
    until_s = time.monotonic() + 60.0
    while time.monotonic() < until_s:
        with socket.socket() as probe:
            if not probe.connect_ex(("127.0.0.1", port)):
                return process, f"tcp://127.0.0.1:{port}"
        time.sleep(0.2)
    raise AssertionError("the scheduler did not listen within a minute")


def start_worker(address: str) -> subprocess.Popen:
    return subprocess.Popen(
        [
            sys.executable,
            "-m",
            "distributed.cli.dask_worker",
            address,
            "--host",
            "127.0.0.1",
            "--nthreads",
            "1",
            "--no-nanny",
            "--no-dashboard",
        ],
        stderr=subprocess.DEVNULL,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
