"""Large campaigns: the memory does not grow, and a kill changes no byte of the result."""

import json
import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign, drawn_rows, etcs, large, outcome, spreading
from rollerrig.realtime.campaign.statistics import quantiles
from rollerrig.realtime.reports import campaign as report

SCENARIO = """
initial_speed_m_s = 2.0
adhesion = "dry"
[[demand]]
pressure_Pa = 3.8e5
"""
PLAN = """
scenario = "{scenario}"
design = "random"
runs = {runs}
seed = 4
chunk = {chunk}
rows_up_to = {rows_up_to}
[inputs."brake.pad_friction"]
distribution = "norm"
loc = 0.35
scale = 0.02
source = "test"
[vary]
initial_speed_m_s = {{ low = 1.0, high = 3.0 }}
[etcs]
speeds_km_h = [0, 3]
build_up_s = 0.2
"""
RUNS = 72
CHUNK = 2
KILLS = 10


@pytest.fixture(scope="module")
def plan(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plans")
    (folder / "short.toml").write_text(SCENARIO)

    def plan(runs=RUNS, rows_up_to=RUNS - 1, chunk=CHUNK) -> str:
        path = folder / f"plan_{runs}_{rows_up_to}.toml"
        scenario = folder / "short.toml"
        text = PLAN.format(scenario=scenario, runs=runs, rows_up_to=rows_up_to, chunk=chunk)
        path.write_text(text)
        return str(path)

    return plan


@pytest.fixture
def few_rows(monkeypatch):
    """Make tails and samples so small that a campaign of a test is larger than them."""
    monkeypatch.setattr(large, "TAIL_ROWS", 20)
    monkeypatch.setattr(large, "FIRST_ROWS", 25)


# the rows of chunks that a test has run; they are the same in every test
DONE: dict[tuple[str, int], list[campaign.Row]] = {}


def part_of(plan, chunk, limits):
    """Return what a worker returns for a chunk; its stops are computed once."""
    key = (campaign.fingerprint(plan), chunk)
    if key not in DONE:
        DONE[key] = campaign.run_chunk(plan, chunk)
    return large.part(plan, campaign.as_table(DONE[key]), limits)


def merge(plan, out, chunks) -> large.Merger:
    """Do chunks in this process, and merge them."""
    campaign.claim(plan, out)
    merger = large.Merger(plan, out)
    for chunk in chunks:
        merger.add(chunk, part_of(plan, chunk, merger.kept.limits))
    return merger


def run_here(plan, out, order=None):
    """Run a large campaign in this process; chunks are done in an order, and merged in theirs."""
    begin = large.read(large.tails_of(plan), out).chunks
    merge(plan, out, order or list(plan.chunks)[begin:]).write()


def files(out: Path) -> dict[str, bytes]:
    """Return the content of all files of a result, by their paths in it."""
    results = out / "results"
    return {
        str(path.relative_to(results)): path.read_bytes()
        for path in sorted(results.rglob("*"))
        if path.is_file()
    }


# --- the points ---


def test_the_points_of_a_large_design_are_those_of_a_small_one(plan):
    drawn = campaign.load(plan(runs=2 * drawn_rows.BLOCK + 7, rows_up_to=10))
    kept = campaign.load(plan(runs=2 * drawn_rows.BLOCK + 7, rows_up_to=100_000))
    assert drawn.is_large
    assert not kept.is_large
    assert np.array(drawn.points[:]) == pytest.approx(np.array(kept.points), rel=1e-14)
    assert drawn.points[drawn_rows.BLOCK] == drawn.points[drawn_rows.BLOCK - 1 :][1]
    assert drawn.points[-1] == drawn.points[len(drawn.points) - 1]
    assert drawn.ranges == kept.ranges


def test_a_plan_of_a_thousand_million_runs_needs_no_memory_for_its_points(plan):
    path = Path(plan(runs=1_000_000))
    million = campaign.load(str(path))
    column = [row[0] for row in million.points[:10_000]]
    first = million.points.extremes[0]
    assert million.points[first[0]][0] <= min(column)
    assert million.points[first[1]][0] >= max(column)
    # the points of a chunk go to a worker, and they are the only ones in memory
    assert len(campaign.piece(million, 100_000).points) == CHUNK


# --- what is kept ---


@pytest.mark.nightly
def test_a_large_campaign_has_the_statistics_of_one_that_keeps_all_rows(plan, tmp_path, few_rows):
    small = campaign.load(plan(rows_up_to=RUNS))
    for chunk in campaign.open_result(small, tmp_path / "small"):
        campaign.write_chunk(tmp_path / "small", chunk, campaign.run_chunk(small, chunk))
    run_here(campaign.load(plan()), tmp_path / "large")
    of_rows = outcome.read(small, tmp_path / "small")
    of_kept = outcome.read(campaign.load(plan()), tmp_path / "large")

    assert of_kept.runs == of_rows.runs == RUNS
    assert of_kept.distance_m.size == of_rows.distance_m.size
    ordered_m = of_rows.distance_m.largest
    assert of_kept.distance_m.largest.tolist() == ordered_m[-20:].tolist()
    assert of_kept.distance_m.at(30) == pytest.approx(ordered_m[29], rel=1.001e-4)
    exact = quantiles.upper_bound(ordered_m, 0.9)
    assert quantiles.upper_bound(of_kept.distance_m, 0.9) == exact
    worst = [report.worst(small, found.longest, large.DISTANCE) for found in (of_rows, of_kept)]
    assert worst[0] == worst[1]
    # all of the quantiles but those between two runs, which a large campaign does not interpolate
    assert [name for name, _ in of_kept.quantiles] == [name for name, _ in of_rows.quantiles]
    for (_, found), (_, expected) in zip(of_kept.quantiles, of_rows.quantiles, strict=True):
        assert found[0] == pytest.approx(expected[0], rel=1.001e-4, abs=1e-9)
        assert found[-1] == pytest.approx(expected[-1], rel=1.001e-4, abs=1e-9)
    assert of_kept.rows.num_rows == 25

    dry = [etcs.sample(tmp_path / name) for name in ("small", "large")]
    assert dry[0].runs == dry[1].runs
    exact, found = (etcs.table(one, dry[0], 0.0)["steps"][0] for one in dry)
    assert found["kwet_rst"] == pytest.approx(exact["kwet_rst"], rel=1e-9)
    assert found["kdry_rst"][1]["bound"] == pytest.approx(exact["kdry_rst"][1]["bound"], rel=3e-4)


def test_the_order_in_which_chunks_are_done_changes_no_byte(plan, tmp_path, few_rows):
    loaded = campaign.load(plan())
    run_here(loaded, tmp_path / "forwards")
    order = list(loaded.chunks)
    run_here(loaded, tmp_path / "backwards", order[::-1])
    run_here(loaded, tmp_path / "halves", order[15:] + order[:15])
    assert len(files(tmp_path / "forwards")) == 6
    assert files(tmp_path / "backwards") == files(tmp_path / "forwards")
    assert files(tmp_path / "halves") == files(tmp_path / "forwards")


def test_the_files_of_a_result_do_not_grow_with_the_runs(plan, tmp_path, few_rows):
    loaded = campaign.load(plan())
    run_here(loaded, tmp_path)
    (row,) = DONE[campaign.fingerprint(loaded), 0][:1]
    rng = np.random.default_rng(2)
    sizes = {}
    for runs in (4_000, 16_000):
        kept = large.Kept(large.tails_of(loaded))
        for begin in range(0, runs, 1_000):
            distances_m = rng.uniform(100.0, 110.0, 1_000).tolist()
            rows = [
                row | {"run": begin + place, "braking_distance_m": distance_m}
                for place, distance_m in enumerate(distances_m)
            ]
            kept.add(large.part(loaded, campaign.as_table(rows), kept.limits))
        out = tmp_path / str(runs)
        kept.write(out)
        sizes[runs] = {name.partition("/")[2]: len(content) for name, content in files(out).items()}
    for name, size in sizes[4_000].items():
        assert sizes[16_000][name] <= 1.1 * size


# --- kills ---


def reached(out: Path) -> int:
    """Return how many chunks the state on disk has."""
    states = [path.name for path in (out / "results").glob("kept-*")]
    return max((int(name.partition("-")[2]) for name in states), default=0)


def wait_for_chunks(out: Path, chunks: int) -> None:
    until_s = time.monotonic() + 120.0
    while reached(out) < chunks:
        assert time.monotonic() < until_s, f"{reached(out)} of {chunks} chunks after 120 s"
        time.sleep(0.001)


def merge_some_and_wait(plan, out, chunks) -> None:
    """Do some further chunks, writing the state after each, and then wait to be killed."""
    large.WRITE_AFTER_S = 0.0
    large.WRITE_AFTER_WRITINGS = 0.0
    begin = reached(out)
    merge(plan, out, range(begin, begin + chunks))
    time.sleep(600.0)


@pytest.mark.nightly
def test_a_large_campaign_that_is_killed_ten_times_gives_the_same_result_to_the_byte(
    plan, tmp_path, few_rows
):
    loaded = campaign.load(plan())
    run_here(loaded, tmp_path / "whole")
    out = tmp_path / "killed"
    campaign.claim(loaded, out)
    for _ in range(KILLS):
        before = reached(out)
        process = multiprocessing.get_context("fork").Process(
            target=merge_some_and_wait, args=(loaded, out, 3)
        )
        process.start()
        # it is killed while it writes the state, or does the next chunk
        wait_for_chunks(out, before + 2)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    assert reached(out) < len(loaded.chunks)
    run_here(loaded, out)
    assert files(out) == files(tmp_path / "whole")


def dying_unit():
    """Return a unit that kills its process at the first calls after it was armed."""
    armed = Path(os.environ["ROLLERRIG_TEST_DEATHS"])

    def unit(_inputs) -> int:
        left = sorted(armed.iterdir())
        if left:
            left[0].unlink(missing_ok=True)
            os.kill(os.getpid(), signal.SIGKILL)
        return 0

    return unit


@pytest.mark.nightly
def test_workers_that_die_change_no_byte(plan, tmp_path, monkeypatch, few_rows):
    armed = tmp_path / "armed"
    armed.mkdir()
    monkeypatch.setenv("ROLLERRIG_TEST_DEATHS", str(armed))
    loaded = campaign.load(plan(runs=12, rows_up_to=10), True, unit=f"{__name__}:dying_unit")
    run_here(loaded, tmp_path / "whole")

    for death in range(2):
        (armed / str(death)).touch()
    out = tmp_path / "deaths"
    campaign.claim(loaded, out)
    merger = large.Merger(loaded, out)
    work = large.work(loaded, merger.kept)
    with merger.writing():
        for chunk, found in spreading.on_this_machine(work, loaded.chunks, 1):
            merger.add(chunk, found)
    assert not list(armed.iterdir())
    assert files(out) == files(tmp_path / "whole")


def test_the_command_writes_the_report_of_a_large_campaign_that_was_continued(
    plan, tmp_path, capsys, few_rows
):
    path = plan()
    out = tmp_path / "out"
    loaded = campaign.load(path)
    merge(loaded, out, list(loaded.chunks)[:-1]).write()
    run_here(loaded, out)

    assert cli.main(["campaign", path, "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["runs"] == RUNS
    assert printed["stopping_distance"][0]["bound_m"] is not None
    page = (out / "report.html").read_text()
    assert "keeps no rows of all runs" in page
    assert "20 longest stops" in " ".join(page.split())
    run_here(loaded, tmp_path / "whole")
    assert files(out) == files(tmp_path / "whole")
    assert cli.main(["etcs", str(out), "--out", str(tmp_path / "etcs")]) == 0


@pytest.mark.nightly
def test_the_command_continues_a_large_campaign(plan, tmp_path, few_rows):
    path = plan()
    out = tmp_path / "out"
    loaded = campaign.load(path)
    merge(loaded, out, list(loaded.chunks)[:-1]).write()
    assert cli.main(["campaign", path, "--workers", "1", "--out", str(out), "--json"]) == 0
    run_here(loaded, tmp_path / "whole")
    assert files(out) == files(tmp_path / "whole")


def test_a_ranking_by_another_figure_is_refused_before_the_first_run(plan, tmp_path, capsys):
    out = tmp_path / "out"
    words = ["campaign", plan(), "--worst", "vents", "--out", str(out)]
    assert cli.main(words) == 2
    assert "rows_up_to" in capsys.readouterr().err
    assert not out.exists()


def test_a_state_that_cannot_be_read_is_refused_with_the_remedy(plan, tmp_path):
    loaded = campaign.load(plan())
    merge(loaded, tmp_path, [0]).write()
    (tmp_path / "results" / "kept-000000001" / "sketches.parquet").write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="remove it, and repeat the command"):
        large.Merger(loaded, tmp_path)
