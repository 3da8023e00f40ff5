"""Campaigns whose stops have a longer step than the bench: which ones, how far off, and what else.

The shares of deviation that users see are measured by `rollerrig bench campaign`; the tests here
hold what does not depend on luck.
"""

import json
import math
import multiprocessing
import re
import signal
import time

import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.campaign import campaign, outcome
from rollerrig.realtime.reports import campaign as report

PLAN = """
title = "short stops"
scenario = "{scenario}"
chunk = 4
{more}

[vary]
{vary}
"""
SCENARIO = """
title = "A short stop"
initial_speed_m_s = 3.0
[[demand]]
pressure_Pa = 3.8e5
"""
SPEEDS = "initial_speed_m_s = [2.0, 3.0, 4.0, 3.5]"
LONGEST = 2  # the run with the largest speed
LONG = "step_s = 1e-3"
EXACT = "step_s = 0.0"
STEP_OF_THE_SCENARIO_S = 1e-4


@pytest.fixture
def plan(tmp_path):
    (tmp_path / "short.toml").write_text(SCENARIO)

    def load(more="", vary=SPEEDS) -> campaign.Plan:
        path = tmp_path / "plan.toml"
        path.write_text(PLAN.format(scenario=tmp_path / "short.toml", more=more, vary=vary))
        return campaign.load(str(path))

    return load


@pytest.mark.parametrize("more", ["", EXACT])
def test_without_a_step_all_stops_have_the_step_of_the_scenario_and_none_runs_again(plan, more):
    for row in campaign.run_chunk(plan(more), 0):
        assert row[campaign.STEP] == STEP_OF_THE_SCENARIO_S
        assert row[campaign.MISSED] is None


def run_all(loaded, out):
    """Run a campaign as its command does; return its rows."""
    for chunk in campaign.open_result(loaded, out):
        campaign.write_chunk(out, chunk, campaign.run_chunk(loaded, chunk))
    for chunk, stops in campaign.open_again(loaded, out).items():
        campaign.write_again(out, chunk, campaign.run_again(stops))
    return campaign.result(out).to_pylist()


def test_the_longest_stop_of_all_chunks_runs_again_with_the_step_of_the_scenario(plan, tmp_path):
    exact = campaign.run_chunk(plan(EXACT), 0)
    two_chunks = plan(LONG)
    two_chunks.head["chunk"] = 2
    rows = run_all(two_chunks, tmp_path / "out")
    steps_s = [row[campaign.STEP] for row in rows]
    assert steps_s == [1e-3, 1e-3, STEP_OF_THE_SCENARIO_S, 1e-3]
    missed = rows[LONGEST].pop(campaign.MISSED)
    assert missed != 0.0
    assert abs(missed) < 0.01
    exact[LONGEST].pop(campaign.MISSED)
    assert rows[LONGEST] == exact[LONGEST]


def test_a_campaign_that_is_killed_before_its_longest_stops_finds_the_same_ones(plan, tmp_path):
    loaded = plan(LONG)
    out = tmp_path / "out"
    rows = run_all(loaded, out)
    file = campaign.part(out, 0, "again")
    before = file.read_bytes()
    assert campaign.open_again(loaded, out) == {}
    file.unlink()
    assert run_all(loaded, out) == rows
    assert file.read_bytes() == before


def run_one_again_and_wait(loaded, out) -> None:
    """Write the next file of stops that run again, and compute the following ones until killed."""
    waiting = iter(campaign.open_again(loaded, out).items())
    chunk, stops = next(waiting)
    campaign.write_again(out, chunk, campaign.run_again(stops))
    _, following = next(waiting)
    while True:
        campaign.run_again(following)


def test_sigkill_while_stops_run_again_changes_no_byte(plan, tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "AGAIN", 1.0)
    loaded = plan(LONG)
    loaded.head["chunk"] = 1
    run_all(loaded, tmp_path / "whole")
    out = tmp_path / "killed"
    for chunk in campaign.open_result(loaded, out):
        campaign.write_chunk(out, chunk, campaign.run_chunk(loaded, chunk))
    for written in range(3):
        process = multiprocessing.get_context("fork").Process(
            target=run_one_again_and_wait, args=(loaded, out)
        )
        process.start()
        until_s = time.monotonic() + 60.0
        while not campaign.part(out, written, "again").is_file():
            assert time.monotonic() < until_s
            time.sleep(0.001)
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
    assert not campaign.part(out, 3, "again").is_file()
    run_all(loaded, out)
    for file in (tmp_path / "whole" / "results").iterdir():
        assert (out / "results" / file.name).read_bytes() == file.read_bytes()


def test_plan_json_has_the_largest_deviation_of_the_stops_that_ran_again(plan, tmp_path):
    loaded = plan(LONG)
    out = tmp_path / "out"
    run_all(loaded, out)
    again, missed = outcome.read(loaded, out).again
    campaign.write_deviation(loaded, out, again, missed)
    content = json.loads((out / "plan.json").read_text())
    assert content["long_step"] == {"ran_again": 1, "largest_deviation": missed}
    assert missed > 0.0
    assert content["unit_played"]["kind"] == "reference"
    assert content["unit_played"]["version"] == content["version"]
    # the folder still holds this plan
    assert campaign.open_result(loaded, out) == []


def test_the_stops_that_run_again_count_as_further_runs(plan):
    assert campaign.again_count(plan(LONG)) == 1
    assert campaign.again_count(plan(EXACT)) == 0


def test_a_stop_beyond_its_time_is_longer_than_any_other(plan, tmp_path):
    loaded = plan(LONG, vary="duration_max_s = [1.5, 60.0, 50.0, 40.0]")
    rows = run_all(loaded, tmp_path / "out")
    assert rows[0]["stopped"] is False
    assert rows[0][campaign.STEP] == STEP_OF_THE_SCENARIO_S
    assert [row[campaign.STEP] for row in rows[1:]] == [1e-3] * 3


@pytest.mark.parametrize("more", ["step_s = 2e-4", LONG])
def test_a_longer_step_hardly_changes_a_short_stop(plan, more):
    exact = campaign.run_chunk(plan(EXACT), 0)
    for row, of_bench in zip(campaign.run_chunk(plan(more), 0), exact, strict=True):
        assert row["braking_distance_m"] == pytest.approx(of_bench["braking_distance_m"], rel=5e-4)


def test_a_plan_that_varies_the_step_has_its_steps(plan):
    rows = campaign.run_chunk(plan(LONG, vary='"loop.step_s" = [1e-4, 2e-4]'), 0)
    assert [row["loop.step_s"] for row in rows] == [1e-4, 2e-4]
    assert [row[campaign.STEP] for row in rows] == [1e-4, 2e-4]
    assert [row[campaign.MISSED] for row in rows] == [None, None]


def test_stops_that_run_alone_keep_the_step_of_the_scenario(plan):
    vary = '"rig.mode" = ["virtual_track"]\ninitial_speed_m_s = [2.0]'
    [row] = campaign.run_chunk(plan(LONG, vary=vary), 0)
    assert row[campaign.STEP] == STEP_OF_THE_SCENARIO_S


def test_a_result_with_another_step_is_refused_with_the_reason(plan, tmp_path):
    campaign.open_result(plan(LONG), tmp_path / "out")
    with pytest.raises(ConfigError, match=re.escape("step_s = 0.001, and this plan has")):
        campaign.open_result(plan(EXACT), tmp_path / "out")


def test_a_step_that_does_not_divide_the_tick_is_refused(plan):
    with pytest.raises(ConfigError, match=r"step_s = 0\.0003.*step_s = 0 for the step"):
        plan("step_s = 3e-4")


def test_the_result_and_its_page_report_the_largest_deviation(plan, tmp_path):
    loaded = plan(LONG)
    out = tmp_path / "out"
    run_all(loaded, out)
    found = outcome.read(loaded, out)
    again, missed = found.again
    assert again == math.ceil(campaign.AGAIN * len(loaded.points))
    assert missed == abs(campaign.result(out)[campaign.MISSED][LONGEST].as_py())
    # a page without pictures of figures
    found = found._replace(quantiles=[])
    page = report.write(loaded, found, out, "braking_distance_m").read_text()
    assert "Stops have steps of 1 ms; 1 of the longest ran again" in page
