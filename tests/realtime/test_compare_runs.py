"""`compare` finds the channels that differ by more than their tolerance, and its exit status."""

import json
import re

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime import cli
from rollerrig.realtime.record.channels import Channels
from rollerrig.wsp_interface import signals

RECORD_HZ = 100.0
COLUMNS = signals.table(COACH).columns


def recorded(folder, rows, speed_m_s, summary):
    """Write the folder of a run at a constant speed, with a spike of the first sliding at 0.5 s."""
    values = np.zeros((rows, len(COLUMNS)))
    values[:, COLUMNS.index("time_s")] = np.arange(rows) / RECORD_HZ
    values[:, COLUMNS.index("vehicle_speed_m_s")] = speed_m_s
    values[50, COLUMNS.index("sliding_1_m_s")] = speed_m_s - 20.0
    folder.mkdir()
    writer = Channels(folder, COLUMNS)
    writer.add(values)
    writer.finish()
    (folder / "scenario.toml").write_text('title = "a run"\n')
    (folder / "summary.json").write_text(json.dumps(summary))
    return str(folder)


@pytest.fixture
def folders(tmp_path):
    """The folders of two runs that differ by 0.3 m/s; the second one is longer."""
    summary = {"valid": True, "invalid_because": []}
    return (
        recorded(tmp_path / "a", 100, 20.0, summary),
        recorded(tmp_path / "b", 120, 20.3, summary),
    )


@pytest.mark.parametrize(
    ("tolerances", "status"),
    [
        ((), 0),
        (("m_s=0.31",), 0),
        (("m_s=0.29",), 1),
        # the tolerance of a channel replaces that of its unit
        (("m_s=0.31", "sliding_1_m_s=0.29"), 1),
        (("m_s=0.29", "sliding_1_m_s=0.31", "vehicle_speed_m_s=0.31"), 0),
    ],
)
def test_a_difference_above_its_tolerance_gives_status_1(folders, capsys, tolerances, status):
    options = [word for tolerance in tolerances for word in ("--tolerance", tolerance)]
    assert cli.main(["compare", *folders, *options, "--json"]) == status
    printed = json.loads(capsys.readouterr().out)
    assert printed["passed"] is (status == 0)


def test_a_difference_has_its_largest_value_with_its_time_and_its_root_mean_square(folders, capsys):
    cli.main(["compare", *folders, "--json"])
    printed = json.loads(capsys.readouterr().out)
    by_channel = {row["channel"]: row for row in printed["differences"]}
    sliding = by_channel["sliding_1_m_s"]
    assert sliding["largest"] == pytest.approx(0.3)
    assert sliding["at_s"] == 0.5
    # one sample of a hundred differs
    assert sliding["rms"] == pytest.approx(0.03)
    assert by_channel["vehicle_speed_m_s"]["rms"] == pytest.approx(0.3)
    assert by_channel["sliding_2_m_s"]["largest"] == 0.0


def test_each_further_run_has_a_column_of_differences_from_the_first(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    runs = []
    for name, distance_m in (("short", 400.0), ("long", 425.5), ("equal", 400.0)):
        found = {"valid": True, "invalid_because": [], "braking_distance_m": distance_m}
        runs.append(recorded(tmp_path / name, 100, 20.0, found))

    assert cli.main(["compare", *runs, "--json"]) == 0
    figures = {row["name"]: row for row in json.loads(capsys.readouterr().out)["figures"]}
    assert figures["stopping distance"]["differences"] == [25.5, 0.0]
    # these runs have no such figure
    assert figures["longest lock"]["differences"] == [None, None]

    assert cli.main(["compare", *runs[:2]]) == 0
    shown = capsys.readouterr().out
    assert "long - short" in shown
    (row,) = (line for line in shown.splitlines() if "stopping distance" in line)
    assert re.findall(r"[-+\d.]+", row) == ["400", "425.5", "+25.5"]

    # of more runs, the differences have a table, so that both fit a terminal
    assert cli.main(["compare", *runs]) == 0
    shown = capsys.readouterr().out
    assert "less short" in shown
    values, differences = (line for line in shown.splitlines() if "stopping distance" in line)
    assert re.findall(r"[-+\d.]+", values) == ["400", "425.5", "400"]
    assert re.findall(r"[-+\d.]+", differences) == ["+25.5", "0"]


def test_a_tolerance_for_a_channel_that_the_first_run_has_not_is_refused(folders, capsys):
    assert cli.main(["compare", *folders, "--tolerance", "sliding_5_m_s=0.1"]) == 2
    assert "no unit or channel is called 'sliding_5_m_s'" in capsys.readouterr().err
