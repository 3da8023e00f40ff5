"""The page of trains: each of its commands runs, on the file that it lets its reader write."""

import os
import re
import shlex
import sys
from pathlib import Path

import pytest

from rollerrig.configs import store
from rollerrig.realtime import cli
from rollerrig.realtime.commands import output
from rollerrig.realtime.record import records
from rollerrig.realtime.train import plan, stop

PAGE = (Path(__file__).parents[3] / "docs" / "howto_train.md").read_text(encoding="utf-8")
FILE = re.search(r"^`my_train.toml`:\n\n((?: {4}.*\n|\n(?= {4}))+)", PAGE, re.MULTILINE)
SANDERS = {
    **{"axle": 1, "second_axle": 3, "rate_kg_s": 0.067},
    **{"from_s": 0.5, "until_s": 100.0},
}
COMMANDS = re.findall(r"^ {4}(rollerrig .+)$", PAGE.replace("\\\n", " "), re.MULTILINE)
# commands that are not run here, and why
NOT_RUN = {
    "rollerrig run five_coaches --pacing wall": "test_train_units.py has units in real time",
    "rollerrig programme": "needs a unit of the reader; test_train_sequences.py plays a programme",
    "rollerrig campaign": "600 stops; test_train_campaign.py computes fewer",
    "rollerrig etcs": "needs this campaign",
}


def test_the_commands_of_the_page_run_one_after_another(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # the page starts `rollerrig wsp` as a unit
    programs = Path(sys.executable).parent
    monkeypatch.setenv("PATH", f"{programs}{os.pathsep}{os.environ['PATH']}")
    assert FILE
    content = re.sub(r"^ {4}", "", FILE[1], flags=re.MULTILINE)
    Path("my_train.toml").write_text(content, encoding="utf-8")
    assert len(COMMANDS) >= 6
    assert all(any(command.startswith(one) for command in COMMANDS) for one in NOT_RUN)
    for command in COMMANDS:
        if command.startswith(tuple(NOT_RUN)):
            continue
        words = shlex.split(command)[1:]
        assert cli.main(words) == output.PASS, command
        capsys.readouterr()
        if words[0] == "run":
            assert (Path(words[-1]) / "report.html").is_file()

    # the page quotes the result of its first run
    summary = records.summary(Path("runs/coaches"))
    quoted = f"in {summary['braking_time_s']:.2f} s and {summary['braking_distance_m']:.1f} m"
    assert quoted in PAGE
    alone_m = summary["alone"]["braking_distance_m"]
    assert f"its car 1 alone: {alone_m:.1f} m" in PAGE
    # the late brake has larger forces in its couplers
    forces = [
        max(abs(one["compression_max_N"]) for one in records.summary(Path(folder))["couplers"])
        for folder in ("runs/mine", "runs/late")
    ]
    assert forces[1] > 0.0
    assert forces[0] != forces[1]


@pytest.mark.parametrize(
    ("adhesion", "sands"), [("low", False), ("very_low", True)], ids=["low", "sanded"]
)
def test_the_distances_of_the_page_are_those_of_trains_of_these_lengths(adhesion, sands):
    title = f"`{adhesion}`, {'first car' if sands else 'none'}"
    row = re.search(rf"^\| {re.escape(title)} \| (.+) \|$", PAGE, re.MULTILINE)
    content, path = store.load("trains", "four_car_unit")
    car = {"length_m": 24.0}
    first = {**car, "sanders": SANDERS} if sands else car
    for cars, quoted in zip((1, 2, 4, 8), row[1].split(" | "), strict=True):
        behind = [{**car, "count": cars - 1}] if cars > 1 else []
        of_train = {**content["train"], "coupler": "automatic", "car": [first, *behind]}
        train = plan.read({**content, "adhesion": adhesion, "train": of_train}, path)
        position_m = stop.simulate(train).samples().cars[0]["position_m"]
        assert float(position_m[-1] - position_m[0]) == pytest.approx(float(quoted), abs=0.06)
