"""The measures of `bench explain` and `score`, on answers written by hand; exported sets."""

import json
import subprocess
import sys
from collections.abc import Iterable
from itertools import count
from pathlib import Path
from typing import Any

import pytest
from benchmarks import explain as bench
from generator import braking_stops
from sealed import answers, cases, score

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli

TESTS = Path(__file__).parents[1]
GAIN = "gain on runs never fitted, share of the possible: median, quartiles"
REMAINDER = "effect outside the library: reported as a remainder"
INTERVALS = "95 % intervals contain the true value"


def entry(kind: str, hidden: dict[str, float], **more: Any) -> dict[str, Any]:
    """Return what a key holds of a set."""
    empty: dict[str, Any] = {"meaning": {}, "base_error": {}, "least_error": {}}
    return {"kind": kind, "effects": hidden} | empty | more


def answer(verdict: str, *sets: Iterable[str], **more: Any) -> dict[str, Any]:
    """Return an answer; each of `sets` is the name of a cause and its confusable ones."""
    causes = []
    for name, *confusable in sets:
        causes.append({"name": name, "confusable_with": confusable})
    return {"verdict": verdict, "causes": causes} | more


def write_key(folder: Path, sets: dict[str, dict[str, Any]]) -> None:
    cases._write_key(folder, {"generator": "first", "seed": 0, "sets": sets})


def judged(folder: Path, *pairs: tuple[dict, dict]) -> dict[str, dict]:
    """Return the measures of some (key, answer), through the files that another tool would use."""
    keys = {}
    given = {}
    for number, (key, its_answer) in enumerate(pairs, start=1):
        name = f"set_{number:04d}"
        keys[name] = key
        given[name] = its_answer
    write_key(folder, keys)
    file = folder / "answers.json"
    file.write_text(json.dumps(given))
    return {row["measure"]: row for row in bench.judge(folder, file)["rows"]}


def counts(rows: dict[str, dict]) -> dict[str, tuple[int, int]]:
    """Return (hits, counted) by measure."""
    return {name: (row["yes"], row["of"]) for name, row in rows.items()}


def test_a_round_of_the_matrix_has_every_cause_at_two_sizes_and_its_halves_are_alike() -> None:
    matrix = cases.cases(braking_stops, 0)
    assert len({case.seed for case in matrix}) == len(matrix)
    for cause in braking_stops.SMALLEST:
        sizes = {case.effects[cause] for case in matrix if list(case.effects) == [cause]}
        assert len(sizes) == 2
    first_half = [case.kind for case in matrix[: len(matrix) // 2]]
    for kind in cases.KINDS:
        in_all = sum(case.kind == kind for case in matrix)
        assert first_half.count(kind) == pytest.approx(0.5 * in_all, abs=2.0)


def test_a_named_cause_where_nothing_is_hidden_is_a_false_alarm_and_its_rate_has_an_interval(
    tmp_path: Path,
) -> None:
    rows = judged(
        tmp_path,
        (entry("none", {}), answer("consistent")),
        (entry("none", {}), answer("explained", ("sanding",))),
    )
    row = rows["nothing hidden: consistent"]
    assert (row["yes"], row["of"]) == (1, 2)
    # Wilson: (1/2 +- z sqrt(1/8 + z^2/16)) scaled, for one of two
    assert (row["low"], row["high"]) == pytest.approx((0.0945, 0.9055), abs=1e-3)


def test_the_truth_counts_first_alone_or_in_a_set_of_two_but_not_of_three(tmp_path: Path) -> None:
    hidden = entry("one", {"pad_fade": 0.1})
    rows = judged(
        tmp_path,
        (hidden, answer("explained", ("pad_fade", "brake_gain", "torque_offset"))),
        (hidden, answer("explained", ("brake_gain", "pad_fade"))),
        (hidden, answer("explained", ("brake_gain", "pad_fade", "sanding"))),
        (hidden, answer("consistent")),
    )
    found = counts(rows)
    assert found["one cause: detected"] == (3, 4)
    assert found["one cause: it is the most likely, or one of two, of detected"] == (2, 3)
    assert found["one cause: it is identified, or an alternative, of detected"] == (3, 3)
    assert rows["one cause: number of the most likely cause and its alternatives, mean"][
        "share"
    ] == pytest.approx(8 / 3)


def test_second_causes_pairs_and_unknown_ones_are_counted_against_what_was_hidden(
    tmp_path: Path,
) -> None:
    both = {"sanding": 0.1, "wheel_radius": 0.1}
    radius = {"name": "wheel_radius", "parameters": {"fraction": {"ci95": [0.09, 0.11]}}}
    rows = judged(
        tmp_path,
        (entry("one", {"sanding": 0.1}), answer("explained", ("sanding",), ("wheel_radius",))),
        (entry("two", both), answer("explained", ("sanding",))),
        (
            entry("two", both, meaning={"wheel_radius": ["fraction", 0.1]}),
            {"verdict": "explained", "causes": [radius, {"name": "sanding"}]},
        ),
        (entry("unknown", {"joints": 0.1}), answer("explained", ("sanding",))),
        (entry("unknown", {"joints": 0.1}), answer("partly")),
    )
    found = counts(rows)
    assert found["one cause: a false second cause"] == (1, 1)
    assert found["two causes: both identified"] == (1, 2)
    assert found["effect outside the library: identified as a cause"] == (1, 2)
    assert found[REMAINDER] == (1, 2)
    assert found[INTERVALS] == (1, 1)


def test_a_gain_and_a_time_in_short_form_count_as_those_of_a_whole_report(tmp_path: Path) -> None:
    errors = {
        "base_error": {"adhesion_rmse": 4.0, "free_running_speed_rmse_m_s": 2.0},
        "least_error": {"adhesion_rmse": 2.0, "free_running_speed_rmse_m_s": 1.9},
    }
    whole = answer(
        "explained",
        ("sanding",),
        elapsed_s=30.0,
        gain={"metric": "adhesion_rmse", "reduction": 0.4, "claimed": True},
    )
    short = answer("explained", ("sanding",), heldout_gain=0.4, seconds=30.0)
    none = answer("explained", ("sanding",), heldout_gain=None, seconds=30.0)
    for given, of in ((whole, 1), (short, 1), (none, 0)):
        rows = judged(tmp_path, (entry("one", {"sanding": 0.1}, **errors), given))
        assert (rows[GAIN]["of"], rows[GAIN]["share"]) == (of, pytest.approx(0.8) if of else None)
        assert counts(rows)["within 20 s"] == (0, 1)

    wrong = answer("explained", ("sanding",), heldout_gain="much")
    with pytest.raises(ConfigError, match="set_0001: heldout_gain must be a share"):
        judged(tmp_path, (entry("one", {"sanding": 0.1}), wrong))


def test_data_that_explain_refuses_are_an_answer_that_names_nothing_and_the_benchmark_continues(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "sets" / "set_0001"
    cases.generator("first").make(folder, {}, 3)
    stick_first_wheel_speed(min((folder / "runs").glob("*.csv")))
    write_key(tmp_path, {"set_0001": entry("unknown", {"joints": 0.08})})
    assert cases._errors(folder) == {}

    lines: list[str] = []
    given = answers.answer(tmp_path, "explain", lines.append, alone=True)
    rows = bench.judge(tmp_path, given)["rows"]
    found = counts({row["measure"]: row for row in rows})
    assert found["data refused"] == (1, 1)
    assert found["effect outside the library: identified as a cause"] == (0, 1)
    assert found[REMAINDER] == (0, 1)
    assert "refused" in lines[0]


def stick_first_wheel_speed(run: Path) -> None:
    """Let the first wheel speed of a CSV file keep its value for 200 samples."""
    rows = run.read_text().splitlines()
    stuck_at = rows[500].split(",")[2]
    for number in range(500, 700):
        time_s, speed_m_s, _, *others = rows[number].split(",")
        rows[number] = ",".join([time_s, speed_m_s, stuck_at, *others])
    run.write_text("\n".join(rows) + "\n")


def test_an_error_while_answers_are_written_stops_the_work_on_the_others() -> None:
    program = """if __name__ == "__main__":
        import time
        from sealed import work
        for _ in work.all_of(time.sleep, [0.5] * 1000):
            raise OSError("no space is left")"""
    process = subprocess.run(
        [sys.executable, "-c", program],
        cwd=TESTS,
        capture_output=True,
        text=True,
        timeout=100.0,
        check=False,
    )
    assert "no space is left" in process.stderr


def test_the_gain_is_a_median_share_of_what_was_possible_and_small_possible_gains_do_not_count(
    tmp_path: Path,
) -> None:
    pairs = []
    for reduction, possible, claimed in (
        (0.10, 0.20, True),
        (0.18, 0.20, True),
        (0.30, 0.30, True),
        (0.50, 0.01, True),
        (0.2, 0.2, False),
    ):
        key = entry(
            "one",
            {"sanding": 0.1},
            base_error={"rmse": 1.0},
            least_error={"rmse": 1.0 - possible},
        )
        gain = {"metric": "rmse", "reduction": reduction, "claimed": claimed}
        pairs.append((key, answer("explained", ("sanding",), gain=gain)))
    row = judged(tmp_path, *pairs)[GAIN]
    assert row["of"] == 3
    assert row["share"] == pytest.approx(0.9)


@pytest.mark.nightly
def test_exported_sets_contain_no_truth_and_are_answered_by_every_tool_and_scored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "sealed"
    seed = next(k for k in count() if next(cases.stream(braking_stops, k)).kind == "one")
    words = ["bench", "explain", "--sets", "1", "--seed", str(seed)]

    # one set, of which no file names what is hidden
    assert cli.main([*words, "--export", str(folder)]) == 0
    case = next(cases.stream(braking_stops, seed))
    texts = [path.read_text() for path in (folder / "key", *(folder / "sets").rglob("*.*"))]
    assert len(texts) == 1 + 1 + 6
    assert not any(name in text for name in case.effects for text in texts)
    key = cases.read_key(folder)["sets"]["set_0001"]
    assert (key["kind"], key["effects"]) == (case.kind, case.effects)
    assert 0.0 < key["least_error"]["adhesion_rmse"] <= 1.05 * key["base_error"]["adhesion_rmse"]

    # an answer that is there is not made again
    answer_file = folder / "answers" / "bic" / "set_0001.json"
    bic = [*words, "--folder", str(folder), "--tool", "bic", "--alone"]
    assert cli.main(bic) == 0
    before = answer_file.stat().st_mtime_ns
    assert cli.main(bic) == 0
    assert answer_file.stat().st_mtime_ns == before

    capsys.readouterr()
    assert cli.main(["score", str(folder), str(folder / "answers" / "bic"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sets"] == 1
    with pytest.raises(ConfigError, match=f"holds sets of the first generator, seed {seed};"):
        cases.export(folder, "first", 1, seed + 1, print)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no answers can be read"),
        ("[]", "an entry for each set"),
        ('{"set_0001": {}}', "verdict is missing"),
        ('{"set_0001": {"verdict": "explained", "causes": [{}]}}', "each with a name"),
        (
            '{"set_0001": {"verdict": "explained", "causes": [{"name": "x", "parameters": {"a": 1}}]}}',
            "a needs ci95",
        ),
        ('{"set_0001": {"verdict": "explained", "gain": {"claimed": true}}}', "have a reduction"),
        ('{"set_0099": {"verdict": "consistent"}}', "has no such set"),
    ],
)
def test_answers_that_cannot_be_judged_are_refused_with_set_and_reason(
    tmp_path: Path, text: str, message: str
) -> None:
    write_key(tmp_path, {"set_0001": entry("none", {})})
    file = tmp_path / "a.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        score.judged(cases.read_key(tmp_path), answers.read(file))


def test_a_folder_without_a_key_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no key of a benchmark"):
        cases.read_key(tmp_path)


def test_generators_are_those_of_the_tests_by_the_same_name() -> None:
    assert cases.generator("first") is braking_stops
