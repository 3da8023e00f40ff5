"""A unit with its own CAN messages brakes, also with values that its messages cannot carry."""

import sys
from functools import partial
from pathlib import Path

import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import own_bench, signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result
from rollerrig.wsp_interface.unit_map import fields, gateway

FIELD = Path(__file__).parent.parent / "data" / "field" / "unit_map"


def play_stop(folder, pacing="lockstep"):
    """Play the stop of the field case with its unit; return the outcome."""
    stop = sequence.load(FIELD / "stop.toml", catalogue.parse)
    unit = own_bench.program(f"{sys.executable} {FIELD / 'unit.py'} {{address}}", folder / "log")
    folder.mkdir()
    companions = (gateway.companion(FIELD / "map.toml", signals.table(COACH)), unit)
    return play.on_own_bench(stop, folder / "run", pacing, wsp="external", companions=companions)


def test_a_speed_below_zero_is_limited_in_an_unsigned_message_and_the_stop_goes_on(tmp_path):
    outcome = play_stop(tmp_path / "stop")
    assert outcome.error == ""
    assert [line.result for line in outcome.verdicts] == [Result.PASS] * 3
    limited = [event.text for event in outcome.events if "limited to the range" in event.text]
    assert len(limited) == 1
    assert limited[0].startswith("SPEEDS.V1: the value was limited")


@pytest.mark.nightly
@pytest.mark.parametrize("pacing", ["lockstep", pytest.param("wall", marks=pytest.mark.nightly)])
def test_a_gateway_that_fails_ends_the_run_with_its_reason_and_without_blame_for_the_unit(
    pacing, tmp_path, monkeypatch
):
    """The 300th message to the unit makes the gateway fail."""
    encoded = []

    def fail_later(encode, message, raw_values):
        encoded.append(message.name)
        if len(encoded) > 300:
            raise RuntimeError("no such page in the book")
        return encode(message, raw_values)

    monkeypatch.setattr(fields, "encode", partial(fail_later, fields.encode))
    outcome = play_stop(tmp_path / "stop", pacing)
    assert outcome.result is Result.ERROR
    assert (
        "the gateway between rig and unit has failed (RuntimeError: no such page" in outcome.error
    )
    assert "has not answered" not in outcome.error

    run = records.load(tmp_path / "stop" / "run")
    assert run.summary["valid"] is False
    (reason,) = run.summary["invalid_because"]
    assert "the gateway between rig and unit has failed" in reason
    blaming = (Code.UNIT_LOST, Code.UNIT_FAILED, Code.UNIT_ENDED, Code.UNIT_UNANSWERED)
    assert [event for event in run.events if event.code in blaming] == []
