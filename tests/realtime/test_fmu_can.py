"""WSP units that are CAN nodes in FMUs (FMI-LS-BUS): a node in C, compiled here, speaks with the
rig by frames.
"""

import json
import os

import bench_process
import fmus
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.fmu import fmu_file, ls_bus
from rollerrig.realtime import cli
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code

SHORT = ("--pacing", "lockstep", "--set", "duration_max_s=1.5")


def said(run):
    """What the FMUs have printed."""
    return (run.out / "wsp.log").read_text()


def test_rules_on_a_can_node_of_an_fmu_give_the_channels_of_those_with_signals(
    stop_with_fmu, tmp_path
):
    # each frame waits for the confirmation of the last
    unit = fmus.build_can(tmp_path)
    run = bench_process.run(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--set",
        "duration_max_s=7",
        "--wsp",
        f"fmu:{unit}",
    )
    assert not run.reported(Code.UNIT_ENDED), run.stderr + said(run)
    assert run.record.column("vents_2")[-1] > 0
    bench_process.assert_same_channels(run, stop_with_fmu)
    assert json.loads((run.out / "summary.json").read_text())["wsp"]["unit"] == f"fmu:{unit}"


def test_a_can_node_of_an_fmu_that_crashes_is_a_unit_that_died_and_the_record_is_kept(tmp_path):
    unit = fmus.build_can(tmp_path, defines=["CRASH_AT_S=0.5", "SEGFAULT"])
    run = bench_process.run(tmp_path / "run", *SHORT, "--wsp", f"fmu:{unit}")
    assert run.status == 4
    assert (
        "the WSP unit wsp.fmu crashed (signal 11, SIGSEGV); its last words: the next step crashes"
        in run.stderr
    )
    assert "Traceback" not in run.stderr + said(run)
    (failed,) = run.reported(Code.RUN_FAILED)
    assert "the WSP unit wsp.fmu crashed (signal 11, SIGSEGV)" in failed.fields["reason"]
    assert len(run.record.column("time_s")) > 45
    assert not json.loads((run.out / "summary.json").read_text())["valid"]


@pytest.mark.nightly
def test_the_brakes_apply_when_a_can_node_of_an_fmu_hangs_in_real_time_also_on_one_core(tmp_path):
    unit = fmus.build_can(tmp_path, defines=["HANG_AT_S=1.0"])
    core = min(os.sched_getaffinity(0))
    # the unit may be late where the machine is busy
    run = bench_process.run(
        tmp_path / "run",
        "--set",
        "duration_max_s=15",
        "--answer-wait",
        "2",
        "--wsp",
        f"fmu:{unit}",
        cores={core},
    )
    assert run.status == 4  # not valid
    lost_s = min(event.time_s for event in run.reported(Code.UNIT_LOST))
    assert lost_s < 3.0
    (ended,) = run.reported(Code.UNIT_ENDED, unit="WSP unit wsp.fmu", status=5)
    assert ended.fields["last_words"].startswith("wsp.fmu hangs: its event at ")
    assert all(run.record.column(f"magnets_{axle}")[-1] == 0 for axle in range(1, 5))
    assert run.record.column("time_s")[-1] > 14.9


@pytest.fixture(scope="module")
def run_of_three(tmp_path_factory):
    """A function that runs three FMUs on the bus."""
    tmp_path = tmp_path_factory.mktemp("three")
    unit = fmus.build_can(tmp_path, notifications=False)
    talker = fmus.build_can(tmp_path, "talker", "countdown", ["TALKER"])
    loser = fmus.build_can(tmp_path, "loser", "countdown", ["TALKER", "TALK_ID=0x124", "DISCARD"])
    all_three = [word for one in (unit, talker, loser) for word in ("--wsp", f"fmu:{one}")]

    def run(name):
        return bench_process.run(tmp_path / name, *SHORT, *all_three)

    return run


@pytest.mark.nightly
def test_several_fmus_share_the_bus(run_of_three):
    run = run_of_three("one")
    assert run.status in (0, 4), run.stderr + said(run)
    assert "the unit hears the talker" in said(run)
    assert "the talker hears the unit" in said(run)
    assert "124 has lost the arbitration" in said(run)
    frames = (run.out / "can.log").read_bytes()
    assert frames.count(b" 123#68656C6C6F") >= 13
    assert b" 124#" not in frames


@pytest.mark.nightly
def test_a_run_of_several_fmus_repeats(run_of_three):
    first, second = ((run_of_three(name).out / "can.log").read_bytes() for name in ("two", "three"))
    assert first == second


def test_what_the_bus_does_not_carry_and_its_error_frames_are_told_to_the_node(tmp_path):
    unit = fmus.build_can(tmp_path, clock="countdown", defines=["GARBAGE", "FD"])
    run = bench_process.run(
        tmp_path / "run",
        *SHORT,
        "--wsp",
        f"fmu:{unit}",
        "--fault",
        "error_frame node=16 at=0.5 for=0.1",
    )
    for told in (
        "wsp.fmu has sent bytes that are not an operation of FMI-LS-BUS: 99 00 00 00 0a 00",
        "format error of 10 bytes, code 99",
        "bus error 3 of 123, flag 1, sender 1",
        "wsp.fmu is error passive",
        "bus error 1 of 190, flag 2, sender 0",
    ):
        assert told in said(run), said(run)
    assert run.record.column("time_s")[-1] > 1.4


def test_a_node_of_another_bit_rate_is_refused(tmp_path):
    run = bench_process.run(
        tmp_path / "run",
        *SHORT,
        "--wsp",
        f"fmu:{fmus.build_can(tmp_path, defines=['BAUD=250000'])}",
    )
    assert run.status == 2
    assert (
        "sets its CAN controller to 250000 bit/s, and the bus of the rig has 500000 bit/s"
        in run.stderr
    )


def test_a_terminal_is_found_by_its_media_type_or_refused(tmp_path, capsys):
    def changed(name, *edits):
        def edit(xml):
            for old, new in edits:
                xml = xml.replace(old, new)
            return xml

        return fmus.build_can(tmp_path, name, edit=edit)

    assert cli.main(["check", str(changed("good")), "--json"]) == 0
    rows = {one["name"]: one["found"] for one in json.loads(capsys.readouterr().out)["checks"]}
    assert rows["terminal Can0"] == 'FMI-LS-BUS, can; version="1.0.0"'
    assert rows["Tx_Clock"] == "triggered"
    for name, old, new, wrong in [
        ("lin", "fmi-ls-bus.can", "fmi-ls-bus.lin", "the bus of the rig is CAN"),
        (
            "later",
            "1.0.0",
            "2.0.0",
            "the bus of the rig is CAN: export it with a terminal of the media type",
        ),
        ("events", ' hasEventMode="true"', "", "event mode: hasEventMode is false"),
        ("member", 'memberName="Tx_Clock"', 'memberName="Clock"', "Can0 Tx_Clock: is missing"),
        (
            "way",
            'name="Can0.Rx_Data" valueReference="1" causality="input"',
            'name="Can0.Rx_Data" valueReference="1" causality="local"',
            "Can0 Rx_Data: is declared as local",
        ),
    ]:
        with pytest.raises(ConfigError, match=wrong):
            fmu_file.check(changed(name, (old, new)), None, 0.01)
    with pytest.raises(ConfigError, match="has no CAN port, so it has to be the only unit"):
        fmu_file.check_all(
            (tmp_path / "good.fmu", fmus.build(tmp_path, name="signals")), None, 0.01
        )


def test_only_fmus_can_share_a_bus_on_the_command_line(capsys):
    with pytest.raises(SystemExit):
        cli.main(["run", "velim_a1", "--wsp", "fmu:a.fmu", "--wsp", "external"])
    assert "only FMUs can share a bus, each through its CAN port" in capsys.readouterr().err


def test_operations_are_read_as_they_were_written_and_the_rest_is_corrupt():
    frame = Frame(0x123, b"\1\2\3")
    told = ls_bus.transmit(frame)
    # FMI-LS-BUS 1.0, CAN Transmit: code, length, identifier, Ide, Rtr, data length, data
    assert told == bytes.fromhex("10000000 13000000 23010000 00 00 0300 010203")
    pieces = [
        told,
        ls_bus.build(ls_bus.Code.CONFIRM, 0x123),
        ls_bus.build(ls_bus.Code.CONFIGURATION, 1, data=bytes(4)),
    ]
    read = list(ls_bus.read(b"".join(pieces)))
    assert [raw for raw, _ in read] == pieces
    assert read[0][1].frame == frame
    for wrong in (
        b"\x10",
        told[:-1],
        ls_bus.build(ls_bus.Code.CONFIGURATION, 1, data=bytes(3)),
        bytes(8),
    ):
        assert list(ls_bus.read(wrong)) == [(wrong, None)]
