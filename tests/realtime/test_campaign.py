"""Campaigns: the same result however the runs are spread, whatever is killed on the way."""

import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign
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
RANGES = '"adhesion.mu_cd" = { low = 0.03, high = 0.1, log = true }\ninitial_speed_m_s = { low = 2.0, high = 5.0 }'


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
    for chunk in campaign.open_result(plan, out) if chunks is None else chunks:
        campaign.write_chunk(out, chunk, campaign.run_chunk(plan, chunk))


def test_a_matrix_runs_every_combination_once(plan_file, tmp_path):
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path / "out")
    rows = content(tmp_path / "out")
    assert rows["run"] == list(range(12))
    assert len(set(zip(rows["adhesion.mu_cd"], rows["initial_speed_m_s"], strict=True))) == 12
    assert all(rows["stopped"])
    assert rows["error"] == [None] * 12


@pytest.mark.parametrize("design", campaign.DESIGNS[1:])
def test_a_random_design_repeats_and_stays_within_its_bounds(plan_file, design):
    first, second = (campaign.load(plan_file(design, RANGES)) for _ in range(2))
    assert first.points == second.points
    assert len(set(first.points)) == 12
    assert all(0.03 <= mu <= 0.1 and 2.0 <= speed <= 5.0 for mu, speed in first.points)


def test_a_campaign_that_was_cut_off_computes_only_what_is_missing(plan_file, tmp_path):
    plan, out = campaign.load(plan_file()), tmp_path / "out"
    todo = campaign.open_result(plan, out)
    run_serially(plan, out, todo[:4])
    before = {path: path.stat().st_mtime_ns for path in (out / "results").iterdir()}
    assert campaign.open_result(plan, out) == todo[4:]
    run_serially(plan, out)
    assert all(path.stat().st_mtime_ns == then for path, then in before.items())
    assert content(out)["run"] == list(range(12))


def test_a_result_folder_of_another_plan_is_refused(plan_file, tmp_path):
    campaign.open_result(campaign.load(plan_file()), tmp_path / "out")
    with pytest.raises(ConfigError, match="another plan"):
        campaign.open_result(campaign.load(plan_file("sobol", RANGES)), tmp_path / "out")


@pytest.mark.parametrize(
    ("design", "vary", "says"),
    [
        ("matrix", '"adhesion.mu_cd" = 0.05', "list of values"),
        ("sobol", '"adhesion.mu_cd" = [0.03, 0.06]', "low = "),
        ("sobol", '"adhesion.mu_cd" = { low = 0.1, high = 0.03 }', "must rise"),
        ("matrix", '"adhesion.mu_kd" = [0.03]', "mu_cd"),
        ("matrix", '"adhesion.mu_cd" = [7.0]', "out of range"),
    ],
)
def test_a_bad_plan_is_refused_before_the_first_run(plan_file, design, vary, says):
    with pytest.raises(ConfigError, match=says):
        campaign.load(plan_file(design, vary))


def test_the_worst_runs_are_worst_in_the_direction_of_their_figure(plan_file):
    plan = campaign.load(plan_file())
    table = pa.table(
        {
            "run": range(12),
            "invalid_because": pa.nulls(12),
            "stop_distance_m": [*map(float, range(11)), None],
            "adhesion_mean": [0.1 + 0.01 * k for k in range(12)],
        }
    )
    assert [row["run"] for row in report.worst(plan, table, "stop_distance_m")] == [11, 10, 9, 8, 7]
    assert [row["run"] for row in report.worst(plan, table, "adhesion_mean")] == [0, 1, 2, 3, 4]


def test_the_page_shows_every_figure_against_what_was_varied(plan_file, tmp_path):
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path)
    page = report.write(plan, campaign.result(tmp_path), tmp_path, "stop_distance_m").read_text()
    assert page.count("<svg") == 2  # a map over two inputs, and figures against each
    assert page.index("Worst stop distance") < page.index("<svg")
    assert "rollerrig run " in page
    assert all(name in page for name in (*plan.axes, "stop distance, m", "energy of sliding, MJ"))


def dying_unit():
    """A unit whose process dies the first time that it is asked, and holds the brakes ever after."""
    dead = Path(os.environ["ROLLERRIG_TEST_DEAD"])

    def unit(_inputs) -> int:
        if not dead.exists():
            dead.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    return unit


def test_a_worker_that_dies_costs_no_run(plan_file, tmp_path, monkeypatch):
    monkeypatch.setenv("ROLLERRIG_TEST_DEAD", str(tmp_path / "dead"))
    plan = campaign.load(plan_file(), unit=f"{__name__}:dying_unit", design="matrix")
    out = tmp_path / "out"
    for chunk, rows in campaign.spread_local(plan, campaign.open_result(plan, out), 2):
        campaign.write_chunk(out, chunk, rows)
    assert (tmp_path / "dead").exists()
    assert content(out)["run"] == list(range(12))
    assert all(content(out)["stopped"])


def test_a_campaign_that_is_killed_goes_on_where_it_was(plan_file, tmp_path):
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "rollerrig.realtime.cli",
        "campaign",
        plan_file(),
        "--workers",
        "1",
        "--out",
        str(out),
    ]
    first = subprocess.Popen(command, stderr=subprocess.DEVNULL, start_new_session=True)
    until = time.monotonic() + 120.0
    while len(list((out / "results").glob("*.parquet"))) < 2 and time.monotonic() < until:
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)
    first.wait()
    done = {path: path.stat().st_mtime_ns for path in (out / "results").glob("*.parquet")}
    assert len(done) >= 2
    again = subprocess.run([*command, "--json"], capture_output=True, text=True)
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["runs"] == 12
    assert all(path.stat().st_mtime_ns == then for path, then in done.items())


def test_a_full_disk_ends_a_campaign_with_status_2_and_keeps_what_is_done(plan_file, tmp_path):
    plan, out = campaign.load(plan_file()), tmp_path / "out"
    todo = campaign.open_result(plan, out)
    run_serially(plan, out, todo[:2])
    kept = {path: path.read_bytes() for path in (out / "results").iterdir()}
    full = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))  # noqa: E731
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "rollerrig.realtime.cli",
            "campaign",
            plan_file(),
            "--workers",
            "1",
            "--out",
            str(out),
        ],
        capture_output=True,
        text=True,
        preexec_fn=full,
    )
    assert done.returncode == 2
    assert "make room" in done.stderr
    assert {path: path.read_bytes() for path in (out / "results").iterdir()} == kept


def test_a_cluster_that_loses_a_worker_gives_the_same_result_as_this_machine(plan_file, tmp_path):
    pytest.importorskip("distributed")
    plan = campaign.load(plan_file())
    run_serially(plan, tmp_path / "local")
    scheduler, address = start_scheduler()
    workers = [start_worker(address) for _ in range(3)]
    try:
        out = tmp_path / "cluster"
        for done, (chunk, rows) in enumerate(
            campaign.spread_dask(plan, campaign.open_result(plan, out), address)
        ):
            campaign.write_chunk(out, chunk, rows)
            if done == 0:
                workers[0].send_signal(signal.SIGKILL)
    finally:
        for process in (*workers, scheduler):
            process.kill()
            process.wait()
    parts = sorted(path.name for path in (tmp_path / "local" / "results").iterdir())
    assert sorted(path.name for path in (out / "results").iterdir()) == parts
    for name in parts:
        assert pq.read_table(out / "results" / name).equals(
            pq.read_table(tmp_path / "local" / "results" / name)
        )


def start_scheduler() -> tuple[subprocess.Popen, str]:
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
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
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
