"""`rollerrig sequence --repeat`: a sequence with several seeds, and one table of its limits."""

import json

import pytest

from rollerrig.configs import store
from rollerrig.realtime import cli

TIMES = 2
NOISY = """
title = "a noisy coach"
vehicle = "uic_z1"
rig = "full_scale"
adhesion = "soap"

[sensor]
noise_rad_s = {noise}
"""


def play(folder, capsys, noise, *words):
    """Play a short sequence on a coach with noisy sensors; return exit status and output."""
    (folder / "coach.toml").write_text(NOISY.format(noise=noise), encoding="utf-8")
    text = (store.ROOT / "sequences" / "emergency_040.toml").read_text(encoding="utf-8")
    text = text.replace('speed = "40 km/h"', 'speed = "20 km/h"')
    sequence = folder / "slow.toml"
    sequence.write_text(f'scenario = "{folder}/coach.toml"\n{text}', encoding="utf-8")
    out = ("--out", str(folder / "report"), "--repeat", str(TIMES), "--seed", "4")
    status = cli.main(["sequence", str(sequence), *out, *words])
    return status, capsys.readouterr()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("repeated")


def test_repetitions_have_successive_seeds_and_one_row_for_each_limit(folder, capsys):
    status, printed = play(folder, capsys, 0.05, "--json")
    result = json.loads(printed.out)
    names = [f"slow_{number + 1}" for number in range(TIMES)]
    assert list(result["sequences"]) == names

    summaries = [
        json.loads((folder / "report" / name / "summary.json").read_text()) for name in names
    ]
    assert [summary["seed"] for summary in summaries] == [4, 5]
    assert all(summary["random"] for summary in summaries)

    rows = {row["limit"]: row for row in result["limits"]}
    for row in rows.values():
        assert (row["sequence"], row["played"]) == ("slow", TIMES)
        assert row["least"] <= row["mean"] <= row["largest"]
    assert any(row["least"] < row["largest"] for row in rows.values())
    all_passed = all(row["passed"] == TIMES for row in rows.values())
    assert (status == 0) == all_passed


def test_repetitions_without_noise_are_equal_and_the_table_says_so(tmp_path, capsys):
    _, printed = play(tmp_path, capsys, 0.0)
    assert "nothing in these runs is random" in printed.out
    assert f"each sequence {TIMES} times" in printed.out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--repeat", "0"), "--repeat 0: allowed are numbers from 1"),
        (("--repeat", "2", "--bus", "tcp://127.0.0.1:1"), "--repeat and --bus"),
    ],
)
def test_a_repetition_that_cannot_be_is_refused(words, message, capsys):
    assert cli.main(["sequence", "low_speed_010", *words]) == 2
    assert message in capsys.readouterr().err
