"""A sequence that goes on longer than the run of its bench gets a message with the remedy."""

import json

from bench_process import BenchProcess

from rollerrig.realtime import cli

SEQUENCE = """title = "A stop and a long wait after it"
criteria = "none"
[start]
speed = "9 km/h"
adhesion = "dry"
[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.01 m/s"
timeout = "20 s"
[[step]]
for = "30 s"
"""


def test_a_sequence_that_goes_on_after_the_end_of_a_running_bench_is_told_about_stand_s(tmp_path):
    path = tmp_path / "waits.toml"
    path.write_text(SEQUENCE)
    bench = BenchProcess(
        tmp_path / "run",
        *("--pacing", "lockstep", "--wsp", "none", "--harness"),
        *("--set", "initial_speed_m_s=2.5", "--set", "stand_s=1.0"),
        scenario="dry_stop",
    )
    out = tmp_path / "report"
    status = cli.main(["sequence", str(path), "--bus", bench.address(), "--out", str(out)])
    bench.finish()

    assert status == 1
    (sequence,) = json.loads((out / "report.json").read_text())["sequences"]
    assert "the bench has ended after the coach had stood for 0.99 s" in sequence["error"]
    assert "a run ends stand_s after its stop; start it with --set stand_s=60" in sequence["error"]
