"""A unit whose outputs are no numbers has failed: its run has an event and is not valid."""

import contextlib
import struct
import threading

import can
import pytest
from bench_process import BenchProcess
from short_sequences import WALKING_PACE

from rollerrig.configs.errors import UnitError
from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import UNIT_HAS_FAILED
from rollerrig.wsp_interface.sequences import play, sequence
from rollerrig.wsp_interface.sequences.verdict import Result
from rollerrig.wsp_interface.unit_map import gateway

# the messages of a unit with floating-point signals
SPEEDS_ID = 1632
VALVES_ID = 1633
DBC = """VERSION ""
NS_ :
BS_:
BU_: UNIT RIG
BO_ 1632 SPEEDS: 8 RIG
 SG_ V1 : 0|16@1+ (0.01,0) [0|655] "rad/s" UNIT
BO_ 1633 VALVES: 5 UNIT
 SG_ OFF : 0|1@1+ (1,0) [0|1] "" RIG
 SG_ V_REF : 8|32@1- (1,0) [0|0] "m/s" RIG
SIG_VALTYPE_ 1633 V_REF : 1;
"""
MAP = """dbc = "unit.dbc"
[[to_unit]]
message = "SPEEDS"
signals = { V1 = "measured_speed_1" }
[from_unit]
message = "VALVES"
hold = ["OFF", "OFF", "OFF", "OFF"]
vent = ["OFF", "OFF", "OFF", "OFF"]
reference = "V_REF"
"""


class FloatUnit:
    """A unit that answers each message of speeds; from the 60th on, its reference speed is NaN."""

    def __init__(self, address):
        self.bus = buses.open_client(address)
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def serve(self):
        answers = 0
        with contextlib.suppress(can.CanError):
            while True:
                message = self.bus.recv(0.1)
                if message is None or message.arbitration_id != SPEEDS_ID:
                    continue
                # before the first SYNC the wheels stand for the gateway
                answers += int(any(message.data))
                reference = float("nan") if answers > 60 else 1.0
                data = struct.pack("<Bf", 0, reference)
                self.bus.send(
                    can.Message(arbitration_id=VALVES_ID, data=data, is_extended_id=False)
                )


@contextlib.contextmanager
def float_unit(address):
    unit = FloatUnit(address)
    try:
        yield unit
    finally:
        unit.bus.shutdown()
        unit.thread.join(5.0)


@pytest.mark.parametrize("pacing", ["lockstep", pytest.param("wall", marks=pytest.mark.nightly)])
def test_a_gateway_reports_a_unit_whose_signals_are_no_numbers_and_its_run_is_not_valid(
    pacing, tmp_path
):
    (tmp_path / "unit.dbc").write_text(DBC)
    (tmp_path / "map.toml").write_text(MAP)
    (tmp_path / "walk.toml").write_text(WALKING_PACE)
    walk = sequence.load(tmp_path / "walk.toml", catalogue.parse)

    outcome = play.on_own_bench(
        walk,
        tmp_path / "run",
        pacing,
        wsp="external",
        companions=(gateway.companion(tmp_path / "map.toml", signals.table(COACH)), float_unit),
    )
    assert outcome.result is Result.ERROR
    assert "the WSP unit (node 32) reports that it has failed: EMCY FF02h" in outcome.error
    texts = [event.text for event in outcome.events]
    assert any("its signal V_REF in VALVES is nan" in text for text in texts)

    run = records.load(tmp_path / "run")
    assert run.summary["valid"] is False
    (event,) = [event for event in run.events if event.code == Code.UNIT_FAILED]
    assert event.level == "error"
    assert event.fields["error_code"] == UNIT_HAS_FAILED
    # the heartbeat has stopped
    assert any(event.code == Code.UNIT_LOST for event in run.events)


@pytest.mark.parametrize("pacing", ["lockstep", pytest.param("wall", marks=pytest.mark.nightly)])
def test_an_fmu_whose_output_is_no_number_has_failed_and_its_run_is_not_valid(pacing, tmp_path):
    fmus = pytest.importorskip("fmus")
    unit = fmus.build(tmp_path, defines=("NAN_AT_S=0.5",))
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        pacing,
        "--wsp",
        f"fmu:{unit}",
        "--set",
        "initial_speed_m_s=4",
    ).finish()
    assert bench.status == 4, bench.stderr
    assert "Traceback" not in bench.stderr
    summary = records.summary(bench.out)
    assert summary["valid"] is False
    (event,) = bench.reported(Code.RUN_FAILED if pacing == "lockstep" else Code.UNIT_ENDED)
    assert event.level == "error"
    assert "its output for reference_speed is nan" in event.text


FAILURES = {
    "terminate": (("TERMINATE_AT_S=0.5",), "requests the end of the simulation at 0.500 s"),
    "discard": (("DISCARD_AT_S=0.5",), "fmi3DoStep failed with status 2 (discard)"),
    "nan": (("NAN_AT_S=0.5",), "its output for reference_speed is nan"),
    "prints_more": (("NAN_AT_S=0.5", "LAST_WORDS"), "its output for reference_speed is nan"),
}


@pytest.mark.parametrize("failure", FAILURES)
@pytest.mark.parametrize("pacing", ["lockstep", pytest.param("wall", marks=pytest.mark.nightly)])
def test_the_record_states_why_an_fmu_has_failed(failure, pacing, tmp_path):
    fmus = pytest.importorskip("fmus")
    defines, reason = FAILURES[failure]
    unit = fmus.build(tmp_path, defines=defines)
    words = ("--pacing", pacing, "--wsp", f"fmu:{unit}", "--set", "initial_speed_m_s=4")
    bench = BenchProcess(tmp_path / "run", *words).finish()
    assert bench.status == 4, bench.stderr
    (event,) = bench.reported(Code.RUN_FAILED if pacing == "lockstep" else Code.UNIT_ENDED)
    assert reason in event.text
    assert any(reason in why for why in bench.record.summary["invalid_because"])


def test_a_unit_of_a_campaign_that_returns_no_number_makes_its_run_not_valid():
    plan = scenario.load("dry_stop", settings=("initial_speed_m_s=3",))
    calls = []

    def unit(_inputs):
        calls.append(1)
        return float("nan") if len(calls) > 20 else 0

    [finished] = stops_in_lanes.together([(0, plan)], unit)
    summary = campaign.summarize(finished, "fails")
    assert summary["valid"] is False
    (reason,) = summary["invalid_because"]
    assert "the run ended with an error: the unit has failed at 0.200 s: it returns nan" in reason

    calls.clear()
    with pytest.raises(UnitError, match=r"the unit has failed at 0\.200 s"):
        free.simulate(plan, unit)
