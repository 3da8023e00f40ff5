"""A unit with its own CAN messages brakes, also with values that its messages cannot carry."""

import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import own_bench, signals
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result
from rollerrig.wsp_interface.unit_map import fields, gateway

FIELD = Path(__file__).parent.parent / "data" / "field" / "unit_map"


START_RAD_S = 12.0 / 3.6 / 0.445  # of the stop


def play_stop(folder, pacing="lockstep", case=FIELD):
    """Play the stop of the field case with its unit; return the outcome."""
    stop = sequence.load(FIELD / "stop.toml", catalogue.parse)
    unit = own_bench.program(f"{sys.executable} {case / 'unit.py'} {{address}}", folder / "log")
    folder.mkdir()
    translated = gateway.companion(
        case / "map.toml", signals.table(COACH), START_RAD_S, folder / "unit_can.log"
    )
    companions = (translated, unit)
    return play.on_own_bench(stop, folder / "run", pacing, wsp="external", companions=companions)


def test_a_speed_below_zero_is_limited_in_an_unsigned_message_and_the_stop_goes_on(tmp_path):
    outcome = play_stop(tmp_path / "stop")
    assert outcome.error == ""
    assert [line.result for line in outcome.verdicts] == [Result.PASS] * 3
    limited = [event.text for event in outcome.events if "limited to the range" in event.text]
    assert len(limited) == 1
    assert limited[0].startswith("SPEEDS.V1: the value was limited")


def test_on_a_bus_of_its_own_a_unit_may_use_identifiers_of_the_rig_and_brakes_the_same(tmp_path):
    """201h and 301h are those of drives 1: on the bus of the rig the unit would command them."""
    case = tmp_path / "case"
    case.mkdir()
    for name in ("map.toml", "unit.dbc", "unit.py"):
        text = (FIELD / name).read_text()
        text = text.replace("2566844929", f"{0x201}").replace("2566844930", f"{0x301}")
        text = text.replace("is_extended_id=True", "is_extended_id=False")
        text = text.replace("not message.is_extended_id", "message.is_extended_id")
        (case / name).write_text(text)
    with pytest.raises(ConfigError, match=r'SPEEDS has the identifier 201h.*write bus = "own"'):
        gateway.companion(case / "map.toml", signals.table(COACH))
    (case / "map.toml").write_text('bus = "own"\n' + (case / "map.toml").read_text())

    outcomes = [play_stop(tmp_path / "shared"), play_stop(tmp_path / "own", case=case)]
    assert [outcome.error for outcome in outcomes] == ["", ""]
    shared, own = (records.load(tmp_path / name / "run") for name in ("shared", "own"))
    for channel in shared.table.column_names:
        one, other = own.column(channel), shared.column(channel)
        assert np.array_equal(one, other, equal_nan=True), channel

    # the log of the unit's bus: the first message has the speed at the start, none is of the rig
    lines = (tmp_path / "own" / "unit_can.log").read_text().splitlines()
    frames = [line.split()[2].split("#") for line in lines]
    assert {can_id for can_id, _ in frames} == {"201", "301"}
    assert int.from_bytes(bytes.fromhex(frames[0][1])[:2], "little") == pytest.approx(1200, abs=1)
    times_s = [float(line[1:].partition(")")[0]) for line in lines]
    assert times_s == sorted(times_s)
    assert times_s[-1] == pytest.approx(own.column("time_s")[-1], abs=0.5)
    of_rig = (tmp_path / "own" / "run" / "can.log").read_text()
    assert " 301#" not in of_rig


@pytest.mark.parametrize("given", [7, "can1", "own bus"])
def test_a_bus_that_is_no_address_is_refused_with_what_is_allowed(given, tmp_path):
    text = (FIELD / "map.toml").read_text().replace("unit.dbc", str(FIELD / "unit.dbc"))
    (tmp_path / "map.toml").write_text(f"bus = {given!r}\n{text}")
    with pytest.raises(ConfigError, match=r'bus = .*write "own" for a bus on a free port'):
        gateway.companion(tmp_path / "map.toml", signals.table(COACH))


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
