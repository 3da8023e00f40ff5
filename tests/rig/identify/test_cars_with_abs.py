"""A car with ABS, from the files of its logger to its slides."""

import json

import car_drive
import numpy as np
import pytest

from rollerrig.realtime import cli

NAMES = ("wheel speed FL", "wheel speed FR", "wheel speed RL", "wheel speed RR")


def test_a_car_with_abs_is_imported_and_its_slides_are_explained(tmp_path, capsys):
    of = car_drive.drive(11)
    slides = car_drive.in_hard_braking(of, 11, depth_m_s=(2.0, 4.0), duration_s=(0.15, 0.3))
    columns = {"time [s]": of.time_s}
    for name, speed in zip(NAMES, car_drive.wheels(of, 11, slides), strict=True):
        columns[f"{name} [km/h]"] = 3.6 * speed
    columns["GPS speed [km/h]"] = 3.6 * car_drive.reference(of, 11)
    np.savetxt(
        tmp_path / "drive.csv",
        np.column_stack(list(columns.values())),
        delimiter=";",
        header=";".join(columns),
        comments="",
        fmt="%.4f",
    )
    out = tmp_path / "drives"
    files = [str(tmp_path / "drive.csv"), "--out", str(out)]
    assert cli.main(["import", *files, "--yes", "--json"]) == cli.PASS
    imported = json.loads(capsys.readouterr().out)
    assert imported["kind"] == "recorder"
    keys = {channel["column"]: channel["key"] for channel in imported["channels"]}
    assert keys["wheel speed RL [km/h]"] == "wheel_speed_3_m_s"

    report = ["explain", str(out), "--out", str(tmp_path / "report"), "--json"]
    assert cli.main(report) == cli.PASS
    explained = json.loads(capsys.readouterr().out)
    found = [episode for episode in explained["episodes"] if episode["name"] == "slide"]
    assert len(found) == len(slides) > 2
    for slide, episode in zip(slides, sorted(found, key=lambda e: e["start_s"]), strict=True):
        assert {cycle["channel"] for cycle in episode["cycles"]} == {f"axle {slide.wheel + 1}"}
        assert episode["start_s"] == pytest.approx(slide.start_s, abs=0.1)
