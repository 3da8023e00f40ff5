"""A unit that does one thing wrong: the record states what has happened, and no more.

Other files have units that are swapped (`test_diagnosis.py`), that exit or fall silent
(`test_validity.py`, `test_command_units.py`) and whose outputs are no numbers
(`test_failed_units.py`).
"""

import os
import signal
import time

import pytest
from bench_process import HEARTBEAT, MAGNETS, BenchProcess
from wrong_units import (
    BEAT,
    BOOTS,
    COMMAND,
    FILLS,
    OPERATES,
    VENTS,
    Unit,
    data_frame,
    remote_frame,
)

from rollerrig.wsp_interface.events import Code

# another identifier, and those of node 33 and of the unit of a second group
WRONG_ID = 0x212
HEARTBEAT_OF_NODE_33 = 0x721
HEARTBEAT_OF_GROUP_2 = 0x740
MAGNETS_OF_GROUP_2 = 0x231
# a dry stop from 3 m/s is over at this SYNC
STOPPED_BY_SYNC = 400

SHORT_STOP = ("--wsp", "external", "--set", "initial_speed_m_s=3", "--set", "adhesion=dry")


def play(out, pacing, *units, more=()):
    """Run a short stop with some units, each a dictionary of arguments; return the bench."""
    words = ("--pacing", pacing, *SHORT_STOP, "--wait", "2", "--answer-wait", "1", *more)
    bench = BenchProcess(out, *words)
    address = bench.address()
    programs = [Unit(address, **unit) for unit in units]
    bench.finish()
    for program in programs:
        program.close()
    assert "Traceback" not in bench.stderr
    return bench


def answers(*frames):
    """A unit that answers each SYNC with these frames."""
    return {"answer": lambda n: list(frames)}


EXTENDED = data_frame(MAGNETS, VENTS, extended=True)
REMOTE = remote_frame(MAGNETS)
EMPTY = data_frame(MAGNETS, b"")
REFUSED = {
    "extended": (EXTENDED, Code.FRAME_EXTENDED, {}, "sends 00000211h as an extended frame"),
    "remote": (REMOTE, Code.FRAME_REMOTE, {}, "sends 211h as a remote frame"),
    "empty": (EMPTY, Code.FRAME_LENGTH, {"length": 0, "least": 1, "most": 8}, "with 0 data bytes"),
}
CASES = [(kind, pacing) for kind in REFUSED for pacing in ("lockstep", "wall")]


@pytest.mark.parametrize(("kind", "pacing"), CASES)
def test_a_command_that_the_rig_refuses_is_no_answer_and_no_command(kind, pacing, tmp_path):
    frame, code, fields, words = REFUSED[kind]
    bench = play(tmp_path / "run", pacing, answers(frame))

    (refused,) = bench.reported(code, can_id=MAGNETS, **fields)
    assert words in refused.text
    assert bench.status == 4
    summary = bench.record.summary
    assert summary["valid"] is False
    assert not summary["wsp"]["vents"]
    if pacing == "lockstep":
        (failed,) = bench.reported(Code.RUN_FAILED)
        assert "the WSP unit has not answered SYNC" in failed.text
        assert refused.text in failed.text
    else:
        assert bench.reported(Code.UNIT_NO_COMMAND, node=32, can_id=MAGNETS)
        assert any("has given no valid command" in why for why in summary["invalid_because"])


@pytest.mark.parametrize(
    ("sent", "instead"),
    [
        ((), "programs have sent 720h"),
        ((data_frame(WRONG_ID, FILLS),), "programs have sent 720h, 212h"),
    ],
    ids=["heartbeats_only", "wrong_identifier"],
)
@pytest.mark.parametrize("pacing", ["lockstep", "wall"])
def test_a_unit_without_a_command_protects_nothing_and_its_run_is_not_valid(
    sent, instead, pacing, tmp_path
):
    bench = play(tmp_path / "run", pacing, answers(*sent))
    assert bench.status == 4
    if pacing == "lockstep":
        (failed,) = bench.reported(Code.RUN_FAILED)
        assert instead in failed.text
        assert "RPDO1 of node 17 (211h)" in failed.text
    else:
        assert bench.reported(Code.UNIT_NO_COMMAND, node=32)


@pytest.mark.parametrize(
    ("beat", "instead"),
    [
        (
            data_frame(HEARTBEAT, OPERATES, extended=True),
            "sends 00000720h as an extended frame (29 bits), which the rig refuses; send 720h with 11",
        ),
        (data_frame(HEARTBEAT, b""), "sends 720h with 0 data bytes"),
        (data_frame(HEARTBEAT_OF_NODE_33, OPERATES), "programs have sent 721h"),
        (data_frame(HEARTBEAT_OF_GROUP_2, OPERATES), "programs have sent 740h"),
    ],
    ids=["extended", "empty", "wrong_node", "wrong_group"],
)
def test_without_a_heartbeat_the_message_states_what_came_instead(beat, instead, tmp_path):
    unit = {"answer": lambda n: [COMMAND], "first": (beat,), "beats": (beat,)}
    bench = play(tmp_path / "run", "lockstep", unit)
    assert bench.status == 2
    assert "no heartbeat on 720h within 2 s" in bench.result["error"]
    assert instead in bench.result["error"]


def test_a_remote_frame_that_requests_a_heartbeat_is_not_refused(tmp_path):
    """Node guarding by an outside master."""
    bench = play(tmp_path / "run", "lockstep", answers(remote_frame(HEARTBEAT), COMMAND))
    assert bench.status == 0, bench.stderr
    assert not bench.reported(Code.FRAME_REMOTE)


def late(n):
    """Answer one SYNC late."""
    if n == 50:
        time.sleep(0.3)
    return [COMMAND]


# units that are unusual, and do what the rig needs
ALLOWED = {
    "late": {"answer": late},
    "double": answers(COMMAND, COMMAND),
    "too_long": answers(data_frame(MAGNETS, bytes(8))),
    "no_boot_up": {"answer": lambda n: [COMMAND], "first": (BEAT,)},
    "early": {"answer": lambda n: [COMMAND], "first": (COMMAND, BEAT, COMMAND)},
    "babbling": answers(*[data_frame(0x7F0, bytes(8))] * 40, COMMAND),
}


@pytest.mark.parametrize("kind", ALLOWED)
def test_what_is_unusual_but_allowed_is_no_fault_of_a_unit(kind, tmp_path):
    bench = play(tmp_path / "run", "lockstep", ALLOWED[kind])
    assert bench.status == 0, bench.stderr
    assert [event.text for event in bench.record.events if event.level != "info"] == []


@pytest.mark.parametrize("pacing", ["lockstep", "wall"])
def test_two_units_are_an_event_and_their_run_is_not_valid(pacing, tmp_path):
    unit = answers(COMMAND)
    bench = play(tmp_path / "run", pacing, unit, unit)
    assert bench.status == 4
    assert len(bench.reported(Code.UNIT_TWO_SENDERS, node=32, can_id=MAGNETS)) == 1
    assert any("two programs" in why for why in bench.result["invalid_because"])


def test_a_unit_that_first_commands_after_the_stop_has_protected_nothing(tmp_path):
    syncs = []

    def answer(n):
        syncs.append(n)
        return [COMMAND] if n > STOPPED_BY_SYNC else []

    bench = play(tmp_path / "run", "wall", {"answer": answer}, more=("--set", "stand_s=3"))
    assert bench.result["stop_time_s"] < STOPPED_BY_SYNC * 0.01
    assert syncs[-1] > STOPPED_BY_SYNC, "the run is too short for a command"
    assert bench.status == 4
    assert bench.reported(Code.UNIT_NO_COMMAND, node=32)


def test_a_unit_that_hangs_is_lost(tmp_path):
    def answer(n):
        return [COMMAND] if n < 60 else None

    bench = play(tmp_path / "run", "wall", {"answer": answer})
    assert bench.status == 4
    assert bench.reported(Code.UNIT_LOST, node=32)
    assert not bench.reported(Code.UNIT_NO_COMMAND)


def test_a_unit_whose_controller_is_off_the_bus_for_a_second_is_lost_and_back(tmp_path):
    def answer(n):
        if 60 <= n < 160:
            unit["beats"].clear()
            return []
        if n == 160:
            unit["beats"].append(BEAT)
            return [data_frame(HEARTBEAT, BOOTS), BEAT, COMMAND]
        return [COMMAND]

    unit = {"answer": answer, "beats": [BEAT]}
    bench = play(tmp_path / "run", "wall", unit)
    assert bench.status == 4
    assert bench.reported(Code.UNIT_LOST, node=32)
    assert bench.reported(Code.UNIT_BACK, node=32)
    assert not bench.reported(Code.UNIT_NO_COMMAND)


def test_an_answer_of_a_harness_that_the_rig_refuses_is_no_answer(tmp_path):
    joins = data_frame(0x67F, bytes((0x2F, 0x00, 0x20, 0x01, 0x01, 0, 0, 0)))
    extended = data_frame(0x27F, b"\0", extended=True)
    # the bench waits for a harness six times as long as for a unit
    words = ("--pacing", "lockstep", "--wsp", "none", "--answer-wait", "0.3")
    bench = BenchProcess(tmp_path / "run", *words)
    harness = Unit(bench.address(), lambda n: [extended], first=(joins,), beats=())
    bench.finish()
    harness.close()
    assert bench.status == 4
    (failed,) = bench.reported(Code.RUN_FAILED)
    assert "the harness has not answered SYNC within 1.8 s" in failed.text
    assert "sends 0000027Fh as an extended frame" in failed.text


# --- what is not the doing of the unit ---

BLAMES = {code for code in Code if code.startswith("wsp.")} | {
    *(Code.UNIT_LOST, Code.UNIT_SILENT, Code.UNIT_NO_COMMAND, Code.UNIT_UNANSWERED)
}


def test_a_bench_that_stood_still_states_that_its_run_does_not_judge_the_unit(tmp_path):
    words = ("--pacing", "wall", "--set", "adhesion=leaf_film", "--set", "initial_speed_m_s=6")
    bench = BenchProcess(tmp_path / "run", *words)
    bench.runs_for(0.5)
    os.kill(bench.process.pid, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(bench.process.pid, signal.SIGCONT)
    bench.finish()

    assert bench.status == 4
    stalls = [event.fields["stalled_s"] for event in bench.reported(Code.LOOP_STALLED)]
    assert max(stalls) > 2.5
    (reason,) = bench.result["invalid_because"]
    assert "the bench stood still for" in reason
    assert {event.code for event in bench.record.events} & BLAMES == set()


def test_another_program_that_sets_the_magnets_is_named_and_the_unit_is_not_blamed(tmp_path):
    vents = data_frame(0x611, bytes((0x2F, 0x00, 0x62, 0x01, 0xFF, 0, 0, 0)))
    unit = {"answer": lambda n: [COMMAND] if n % 100 == 1 else []}
    other = {"answer": lambda n: [vents] if n == 30 else [], "first": (), "beats": ()}
    bench = play(tmp_path / "run", "wall", unit, other)
    assert bench.status == 4
    assert len(bench.reported(Code.MAGNETS_FOREIGN, node=17)) == 1
    assert max(bench.record.column("valve_1")) == 2.0
    (reason,) = bench.result["invalid_because"]
    assert "another program than the WSP unit sets the magnets of node 17" in reason
    assert {event.code for event in bench.record.events} & BLAMES == set()


@pytest.mark.parametrize(("node", "command"), [(32, 2), (16, 128), (0, 129)])
def test_a_master_that_stops_a_node_during_the_stop_is_named_and_not_the_unit(
    node, command, tmp_path
):
    nmt = data_frame(0x000, bytes((command, node)))
    other = {"answer": lambda n: [nmt] if n == 30 else [], "first": (), "beats": ()}
    bench = play(tmp_path / "run", "wall", answers(COMMAND), other)
    assert bench.status == 4
    assert len(bench.reported(Code.NMT_FOREIGN, node=node, command=command)) == 1
    (reason,) = bench.result["invalid_because"]
    assert f"another program sends the NMT command {command}" in reason
    assert not [event for event in bench.record.events if str(event.code).startswith("wsp.")]


def test_a_unit_may_set_its_magnets_by_sdo(tmp_path):
    by_sdo = data_frame(0x611, bytes((0x2F, 0x00, 0x62, 0x01, 0x00, 0, 0, 0)))
    bench = play(tmp_path / "run", "wall", answers(by_sdo))
    # a slow machine may delay its heartbeat; nothing else is said of it
    assert {event.code for event in bench.record.events} & BLAMES <= {Code.UNIT_LOST}, bench.stderr
    assert not bench.reported(Code.MAGNETS_FOREIGN)


def test_frames_that_any_node_of_the_rig_takes_have_the_same_rule(tmp_path):
    extended = [data_frame(can_id, b"\0\0", extended=True) for can_id in (0x000, 0x080, 0x611)]
    refused = [*extended, remote_frame(0x201), data_frame(HEARTBEAT, b"\5\5")]
    # other identifiers, a guarding master, and a request for a TPDO
    allowed = [
        data_frame(0x18FF50E5, bytes(8), extended=True),
        data_frame(0x300, b""),
        remote_frame(0x701),
        remote_frame(0x181),
    ]
    frames = (*refused, *allowed, *refused)
    unit = {"answer": lambda n: [*(frames if n == 30 else ()), COMMAND]}
    bench = play(tmp_path / "run", "lockstep", unit)
    assert bench.status == 0, bench.stderr
    reported = {
        code: [event.fields["can_id"] for event in bench.reported(code)]
        for code in (Code.FRAME_EXTENDED, Code.FRAME_REMOTE, Code.FRAME_LENGTH)
    }
    assert reported == {
        Code.FRAME_EXTENDED: [0x000, 0x080, 0x611],
        Code.FRAME_REMOTE: [0x201],
        Code.FRAME_LENGTH: [HEARTBEAT],
    }
