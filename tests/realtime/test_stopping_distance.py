"""Every place that shows the stopping distance of a run shows the same number."""

import json
import re

import pytest
from rich.console import Console

from rollerrig.realtime import cli
from rollerrig.realtime.desk import library
from rollerrig.realtime.record import figures, records, summary
from rollerrig.realtime.telemetry import derived

# the coach coasts for 1 s before it brakes
SEQUENCE = """title = "A stop with a long wait before it"
criteria = "none"
[start]
speed = "18 km/h"
adhesion = "dry"
[[step]]
at = "1 s"
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "60 s"
[[measure]]
measure = "stop_distance"
unit = "m"
max = 1000.0
source = "test"
"""


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    """The folder of the report of a sequence."""
    place = tmp_path_factory.mktemp("played")
    (place / "late.toml").write_text(SEQUENCE)
    out = place / "report"
    assert cli.main(["sequence", str(place / "late.toml"), "--wsp", "none", "--out", str(out)]) == 0
    return out


def test_report_summary_table_page_and_desk_show_the_same_stopping_distance(played):
    run = records.load(played / "late")
    distance_m = run.summary["braking_distance_m"]
    # the coach has coasted for 1 s at 5 m/s
    assert run.summary["stop_distance_m"] - distance_m == pytest.approx(5.0, rel=0.01)

    (sequence,) = json.loads((played / "report.json").read_text())["sequences"]
    (verdict,) = [one for one in sequence["verdicts"] if one["what"] == "stop_distance"]
    # the bus rounds positions to millimetres
    assert verdict["value"] == pytest.approx(distance_m, abs=2e-3)
    assert sequence["figures"]["stop_distance"] == verdict["value"]
    page = (played / "report.html").read_text()
    assert "stopping distance, m" in page
    assert f"{distance_m:.0f}" in page

    (row,) = library.rows(played)
    assert row["braking_distance_m"] == pytest.approx(distance_m, rel=1e-3)
    assert figures.BY_NAME["braking_distance_m"].title == "stopping distance"

    console = Console(width=200, record=True)
    console.print(summary.table(run.summary))
    in_table = f"and {distance_m:.1f} m after the brake demand"
    assert in_table in re.sub(r"\s+", " ", console.export_text())
    in_view = f"**{distance_m:.0f} m** in"
    assert in_view in derived.result_text(run.summary)
