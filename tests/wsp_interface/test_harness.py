"""A harness on a real bench over a real bus: what it asks happens, and time waits for it."""

import os
import signal
import time

import pytest

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim import faults
from rollerrig.wsp_interface import own_bench, play, sequence
from rollerrig.wsp_interface.harness import COLUMNS, TimeOutError
from rollerrig.wsp_interface.sdo_client import RefusedError
from rollerrig.wsp_interface.verdict import Result

WALKING = {"initial_speed_km_h": 18.0, "adhesion": "soap"}
STOP = """title = "A stop from walking pace on soap"
criteria = "low_speed"

[start]
speed = "9 km/h"
adhesion = "soap"

[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
"""


def test_what_a_harness_asks_happens_on_the_rig(tmp_path):
    with own_bench.start(tmp_path / "run", **WALKING) as bench:
        rig = bench.harness
        assert rig.lockstep
        assert rig.vehicle_speed_m_s == pytest.approx(5.0, abs=0.01)
        rig.note("the driver looks out")
        # time passes only when the harness lets it
        before_s = rig.time_s
        time.sleep(0.3)
        rig.step()
        assert rig.time_s == pytest.approx(before_s + 0.01)
        rig.inject("speed_sensor_dropout axle=2 for=0.2")
        rig.wait(0.05)
        assert rig.axles("measured_speed")[1] == 0.0
        assert rig.axles("measured_speed")[0] > 10.0
        rig.wait(0.3)
        assert rig.axles("measured_speed")[1] > 10.0
        rig.inject("vent_magnet_stuck axle=3")
        rig.brake(bar=2.0)
        rig.friction(0.02, axles=[1])
        rig.until(lambda: rig.axles("cylinder_pressure")[0] > 1e5, timeout_s=5.0)
        assert rig.axles("cylinder_pressure")[2] < 0.2e5
        assert rig.axles("adhesion")[0] < 0.04 < rig.axles("adhesion")[1]
        rig.lift("vent_magnet_stuck axle=3")
        rig.until(lambda: rig.axles("cylinder_pressure")[2] > 1e5, timeout_s=5.0)
        with pytest.raises(RefusedError):
            rig.inject("speed_sensor_dropout axle=9")
        with pytest.raises(TimeOutError):
            rig.until(lambda: rig.vehicle_speed_m_s > 50.0, timeout_s=0.1)
        assert len(rig.trace[0]) == len(COLUMNS)
    told = [event["text"] for event in own_bench.summary(tmp_path / "run")["events"]]
    assert "note: the driver looks out" in told
    assert any("speed_sensor_dropout axle=2" in text and "begins" in text for text in told)


def test_a_sequence_in_lockstep_repeats_bit_for_bit(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_text(STOP, encoding="utf-8")
    one = sequence.load(path, faults.parse)
    first, second = (play.on_own_bench(one, tmp_path / name) for name in ("first", "second"))
    assert first.result is second.result is Result.PASS, (first.error, first.verdicts)
    rows = [(tmp_path / name / play.TRACE).read_bytes() for name in ("first", "second")]
    assert rows[0] == rows[1]
    assert rows[0].count(b"\n") > 100


def test_a_bench_that_vanishes_is_an_error_and_its_rows_are_kept(tmp_path):
    path = tmp_path / "walk.toml"
    path.write_text(STOP, encoding="utf-8")
    one = sequence.load(path, faults.parse)
    outcome = play.Outcome(one, tmp_path / "run")
    with (pytest.raises(BusError, match="has gone|silent|not answered"),
          own_bench.start(tmp_path / "run", **WALKING) as bench):
        rig = bench.harness
        rig.wait(0.2)
        os.kill(bench.process.pid, signal.SIGKILL)
        outcome.error = "the bench was killed"
        rig.wait(5.0)
    assert play.keep(tmp_path / "run", rig).read_text().count("\n") > 15
    assert outcome.result is Result.ERROR
