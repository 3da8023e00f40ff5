"""Work and forces of motors, magnets and friction brakes, in summary, report and picture."""

import json
import re

import numpy as np
import program
import pyarrow.parquet
import pytest
from program import BOTH_BRAKES

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.record import brake_work, records
from rollerrig.realtime.reports import page
from rollerrig.realtime.reports import stop as run_stop

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

WITHIN = 1e-3
AXLES = range(1, 7)
# the brakes that each scenario has besides the friction brake
OTHER_BRAKES = {
    BOTH_BRAKES: ["motors", "magnets"],
    "tram_low_dynamic": ["motors"],
    "tram_emergency_magnetic": ["magnets"],
}


def rollerrig(*words):
    """Run the program; return what it prints. Its exit status must be 0."""
    status, printed, messages = program.rollerrig(*words)
    assert status == 0, messages
    return printed


@pytest.fixture(
    scope="module",
    params=[
        name if name == BOTH_BRAKES else pytest.param(name, marks=pytest.mark.nightly)
        for name in OTHER_BRAKES
    ],
)
def stop(request, free_run_of):
    return request.param, *free_run_of(request.param)


def test_the_work_of_all_brakes_is_that_of_their_recorded_forces(stop):
    scenario, folder, printed = stop
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    brakes = summary["brakes"]
    assert list(brakes) == ["friction", *OTHER_BRAKES[scenario]]
    assert sum(brake["share"] for brake in brakes.values()) == pytest.approx(1.0)
    assert "work of the brakes: friction brake" in printed

    table = pyarrow.parquet.read_table(folder / "channels.parquet")
    time_s = table["time_s"].to_numpy()
    names = {"friction": "brake_torque", "motors": "dynamic_torque"}
    for brake, figures in brakes.items():
        if brake == "magnets":
            force_N = sum(table[f"track_brake_force_{axle}_N"].to_numpy() for axle in AXLES)
            power_W = force_N * table["vehicle_speed_m_s"].to_numpy()
            assert figures["force_max_N"] == pytest.approx(force_N.max())
        else:
            power_W = sum(
                table[f"{names[brake]}_{axle}_Nm"].to_numpy()
                * table[f"wheel_speed_{axle}_rad_s"].to_numpy()
                for axle in AXLES
            )
        assert figures["work_J"] == pytest.approx(np.trapezoid(power_W, time_s), rel=WITHIN)


def test_the_picture_of_a_stop_has_a_plot_of_the_brakes_and_a_lane_for_each_axle(stop, tmp_path):
    scenario, folder, _ = stop
    picture = tmp_path / "stop.svg"
    rollerrig("view", folder, "--png", picture)
    text = picture.read_text(encoding="utf-8")
    # matplotlib writes each text of a picture as a comment or as an element
    assert "brake forces, kN" in text
    for brake in OTHER_BRAKES[scenario]:
        assert brake_work.TITLES[brake] in text
    for axle in AXLES:
        assert re.search(rf"axle {axle}\b", text)


def test_the_table_of_the_brakes_has_a_row_for_each_with_its_work_beside_a_picture(stop):
    _, folder, _ = stop
    brakes = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["brakes"]
    run = records.load(folder)
    table = page.table(*run_stop.brakes(run.summary))
    picture = run_stop.brakes_picture(run_stop.motion_of(run))
    for brake, figures in brakes.items():
        work_MJ = f"{1e-6 * figures['work_J']:.2f}"
        row = rf"<td[^>]*>{brake_work.TITLES[brake]}</td><td[^>]*>{work_MJ}</td>"
        assert re.search(row, table)
    assert "share, %" in picture


def test_a_vehicle_with_friction_brakes_only_has_no_figures_of_brakes():
    assert brake_work.brakes(COACH) == ()
