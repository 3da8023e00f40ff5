"""`rollerrig compare` of two campaigns: pairs, samples, and folders that cannot be compared."""

import json

import pyarrow as pa
import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.campaign import campaign, comparison, large
from rollerrig.realtime.record import figures

SCENARIO = """
title = "A short stop"
initial_speed_m_s = 3.0
[[demand]]
pressure_Pa = {pressure_Pa}
"""
PLAN = """
scenario = "{scenario}"
unit = "{unit}"
design = "{design}"
runs = {runs}
seed = {seed}
chunk = 4
rows_up_to = {rows_up_to}
[vary]
{vary}
"""
RANGES = (
    'initial_speed_m_s = { low = 2.0, high = 5.0 }\n"adhesion.mu_cd" = { low = 0.03, high = 0.1 }'
)


@pytest.fixture
def run_campaign(tmp_path):
    """Return a function that runs a campaign, or some of its chunks, in a new folder."""

    def run(
        name,
        design="random",
        seed=3,
        runs=16,
        vary=RANGES,
        pressure_Pa=3.8e5,
        unit="reference",
        rows_up_to=1000,
        chunks=None,
    ):
        scenario = tmp_path / f"stop_{pressure_Pa:.0f}.toml"
        scenario.write_text(SCENARIO.format(pressure_Pa=pressure_Pa))
        path = tmp_path / f"{name}.toml"
        heads = {"scenario": scenario, "unit": unit, "design": design, "runs": runs, "seed": seed}
        path.write_text(PLAN.format(**heads, vary=vary, rows_up_to=rows_up_to))
        plan = campaign.load(str(path))
        out = tmp_path / name
        if plan.is_large:
            campaign.claim(plan, out)
            merger = large.Merger(plan, out)
            for chunk in plan.chunks:
                merger.add(chunk, large.run_chunk(campaign.piece(plan, chunk), chunk, {}))
            merger.write()
        else:
            for chunk in campaign.open_result(plan, out)[:chunks]:
                campaign.write_chunk(out, chunk, campaign.run_chunk(plan, chunk))
        return out

    return run


def compared(first, second, capsys) -> tuple[int, dict]:
    status = cli.main(["compare", str(first), str(second), "--json"])
    return status, json.loads(capsys.readouterr().out)


def shown(first, second, capsys) -> str:
    cli.main(["compare", str(first), str(second)])
    return " ".join(capsys.readouterr().out.split())


def figure(result, name) -> dict:
    return next(one for one in result["figures"] if one["name"] == name)


def test_a_weaker_brake_is_worse_in_every_pair_and_this_is_more_than_chance(run_campaign, capsys):
    first, second = run_campaign("strong"), run_campaign("weak", pressure_Pa=2.5e5)
    status, result = compared(first, second, capsys)
    assert status == 0
    assert result["paired"]
    distance = figure(result, "braking_distance_m")
    assert distance["pairs"] == {
        "worse": 16,
        "better": 0,
        "equal": 0,
        "only_first": 0,
        "only_second": 0,
    }
    # the figures are those of the rows
    rows = [campaign.result(folder).to_pydict() for folder in (first, second)]
    pairs = zip(*(one["braking_distance_m"] for one in rows), strict=True)
    gaps_m = sorted(after - before for before, after in pairs)
    assert distance["difference"]["median"] == pytest.approx(sum(gaps_m[7:9]) / 2.0)
    assert gaps_m[0] <= distance["difference"]["low"] <= distance["difference"]["median"]
    assert distance["difference"]["median"] <= distance["difference"]["high"] <= gaps_m[-1]
    assert distance["difference"]["significant"]
    assert distance["worst"] == [max(one["braking_distance_m"]) for one in rows]
    assert distance["worst_run"] == [
        one["braking_distance_m"].index(max(one["braking_distance_m"])) for one in rows
    ]
    text = shown(first, second, capsys)
    assert "weak stops longer than strong" in text
    assert "weak is worse in 16 of 16 pairs" in text
    assert "This is more than chance" in text


def test_the_runs_that_became_worst_have_the_commands_that_repeat_both(run_campaign, capsys):
    first, second = run_campaign("strong"), run_campaign("weak", pressure_Pa=2.5e5)
    _, result = compared(first, second, capsys)
    cases = result["became_worse"]
    changes_m = [case["second_m"] - case["first_m"] for case in cases]
    assert len(cases) == comparison.WORST
    assert changes_m == sorted(changes_m, reverse=True)
    for side, folder in enumerate((first, second)):
        plan = campaign.load(str(folder.with_suffix(".toml")))
        for case in cases:
            assert case["commands"][side] == campaign.command(plan, case["run"])


def test_a_campaign_does_not_differ_from_itself(run_campaign, capsys):
    folder = run_campaign("once")
    status, result = compared(folder, folder, capsys)
    assert status == 0
    for one in result["figures"]:
        assert one["difference"]["median"] == 0.0
        assert not one["difference"]["significant"]
    assert result["became_worse"] == []
    assert "of the same plan, scenario and unit" in shown(folder, folder, capsys)


def test_two_units_are_compared_in_pairs(run_campaign, capsys):
    with_unit, without = run_campaign("with"), run_campaign("without", unit="none")
    _, result = compared(with_unit, without, capsys)
    assert result["paired"]
    assert {"what": "unit", "values": ["reference", "none"]} in result["differs"]
    # without a unit no valve vents
    assert figure(result, "vents")["worst"][1] == 0


def test_another_seed_gives_two_samples_and_the_reason(run_campaign, capsys):
    first, second = run_campaign("first"), run_campaign("second", seed=4)
    _, result = compared(first, second, capsys)
    assert not result["paired"]
    assert result["unpaired_because"] == "seed is 3 and 4"
    assert figure(result, "braking_distance_m")["pairs"] is None
    assert 0.0 < figure(result, "braking_distance_m")["difference"]["p_value"] < 1.0
    # the longest stops of the second campaign
    longest_m = max(campaign.result(second)["braking_distance_m"].to_pylist())
    assert result["became_worse"][0]["second_m"] == longest_m
    assert "Mann-Whitney" in shown(first, second, capsys)


def test_an_input_with_another_law_is_named_and_stays_paired(run_campaign, capsys):
    first = run_campaign("first")
    second = run_campaign("second", vary=RANGES.replace("high = 0.1", "high = 0.2"))
    _, result = compared(first, second, capsys)
    assert result["paired"]
    assert result["other_inputs"] == ["adhesion.mu_cd"]
    assert "differ in adhesion.mu_cd" in shown(first, second, capsys)


def test_a_matrix_is_compared_in_pairs_without_a_test(run_campaign, capsys):
    lists = 'initial_speed_m_s = [2, 3, 4]\n"adhesion.mu_cd" = [{}]'
    first = run_campaign("first", design="matrix", vary=lists.format("0.1"))
    second = run_campaign("second", design="matrix", vary=lists.format("0.03"))
    _, result = compared(first, second, capsys)
    assert result["paired"]
    assert result["other_inputs"] == ["adhesion.mu_cd"]
    assert result["became_worse"]
    difference = figure(result, "braking_distance_m")["difference"]
    assert difference["p_value"] is None
    assert difference["low"] is None
    assert "no sample of independent draws" in shown(first, second, capsys)
    # whole numbers of a list stay whole in the command
    plan = campaign.load(str(second.with_suffix(".toml")))
    for case in result["became_worse"]:
        assert case["commands"][1] == campaign.command(plan, case["run"])


def test_lists_that_differ_are_no_pairs(run_campaign, capsys):
    first = run_campaign("first", design="matrix", vary="initial_speed_m_s = [2.0, 3.0]")
    second = run_campaign("second", design="matrix", vary="initial_speed_m_s = [2.0, 4.0]")
    _, result = compared(first, second, capsys)
    assert result["unpaired_because"] == "the lists of initial_speed_m_s differ"


def test_a_run_that_is_not_valid_is_in_no_difference_and_gives_status_4(run_campaign, capsys):
    vary = (
        "initial_speed_m_s = { low = 2.0, high = 5.0 }\nduration_max_s = { low = 1.0, high = 9.0 }"
    )
    first = run_campaign("first", vary=vary)
    status, result = compared(first, first, capsys)
    invalid = pa.compute.sum(campaign.result(first)["invalid_because"].is_valid()).as_py()
    assert invalid > 0
    assert status == 4
    assert result["campaigns"][0]["not_valid"] == invalid
    assert any("not valid" in warning for warning in result["warnings"])
    pairs = figure(result, "longest_lock_s")["pairs"]
    assert pairs["worse"] + pairs["better"] + pairs["equal"] == 16 - invalid


def test_a_campaign_that_is_not_finished_is_compared_with_a_warning(run_campaign, capsys):
    whole, partial = run_campaign("whole"), run_campaign("partial", chunks=2)
    _, result = compared(whole, partial, capsys)
    assert result["warnings"] == [
        f"{partial}: 8 of 16 runs are there; repeat its 'rollerrig campaign' to finish it"
    ]
    pairs = figure(result, "braking_distance_m")["pairs"]
    assert pairs["equal"] == 8
    assert pairs["worse"] + pairs["better"] == 0


def test_a_large_campaign_is_compared_by_what_it_keeps(run_campaign, capsys):
    rows = [run_campaign("rows_a"), run_campaign("rows_b", pressure_Pa=1.5e5)]
    kept = [
        run_campaign("kept_a", rows_up_to=10),
        run_campaign("kept_b", rows_up_to=10, pressure_Pa=1.5e5),
    ]
    _, result = compared(*kept, capsys)
    assert not result["paired"]
    assert "keeps no rows of all runs" in result["unpaired_because"]
    # the interval is that of two samples with rows, without pairs
    first, second = (comparison.read(folder).values("braking_distance_m") for folder in rows)
    exact = comparison.differences.unpaired(first, second)
    difference = figure(result, "braking_distance_m")["difference"]
    assert difference["median"] == pytest.approx(exact.median, rel=1e-3)
    assert difference["low"] == pytest.approx(exact.low, rel=1e-3)
    assert difference["high"] == pytest.approx(exact.high, rel=1e-3)
    assert "a large campaign" in shown(*kept, capsys)
    # a large campaign and one with rows
    assert not compared(rows[0], kept[1], capsys)[1]["paired"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["campaign", "empty"], "holds a campaign, and"),
        (["campaign", "campaign", "campaign"], "3 campaigns are given; compare two"),
        (["campaign", "campaign", "--tolerance", "m_s=0.1"], "--tolerance is for runs"),
        (["campaign", "campaign", "--out", "both.rrd"], "--out is for runs"),
    ],
)
def test_what_cannot_be_compared_is_one_clear_error(run_campaign, tmp_path, capsys, words, message):
    run_campaign("campaign", runs=4)
    (tmp_path / "empty").mkdir()
    places = {name: str(tmp_path / name) for name in ("campaign", "empty")}
    assert cli.main(["compare", *(places.get(word, word) for word in words)]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert len(error.strip().splitlines()) == 1


def test_a_damaged_plan_is_one_clear_error(run_campaign, capsys):
    folder = run_campaign("campaign", runs=4)
    (folder / "plan.json").write_text('{"head": 3}')
    assert cli.main(["compare", str(folder), str(folder)]) == 2
    assert "is not of a campaign" in capsys.readouterr().err


def test_of_every_compared_figure_less_is_better():
    assert all(figures.BY_NAME[name].better < 0 for name in comparison.FIGURES)
