"""The loop has a core of its own, which all else of the bench leaves, where there are two."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from bench_process import BenchProcess

from rollerrig.realtime.commands import check
from rollerrig.realtime.loop import cores, interrupts

CORES = os.sched_getaffinity(0)
needs_two_cores = pytest.mark.skipif(len(CORES) < 2, reason="this machine has one core only")


@pytest.fixture
def claims(monkeypatch):
    """Claims with a name of their own: other tests run benches that claim cores, too."""
    monkeypatch.setattr(cores, "_CLAIM_NAME", f"rollerrig test {os.getpid()} core ")


@contextlib.contextmanager
def claimed(wanted):
    claim = cores.claim(wanted)
    try:
        yield claim
    finally:
        claim.close()


def threads_allowed_on(core, pid):
    """The threads of a process that may run on a core."""
    found = []
    for name in os.listdir(f"/proc/{pid}/task"):
        with contextlib.suppress(ProcessLookupError):
            if core in os.sched_getaffinity(int(name)):
                found.append(int(name))
    return found


def children_of(pid):
    found = []
    for thread in os.listdir(f"/proc/{pid}/task"):
        found += map(int, Path(f"/proc/{pid}/task/{thread}/children").read_text().split())
    return found


def test_benches_claim_different_cores_and_leave_one_to_all_else(claims):
    with contextlib.ExitStack() as stack:
        numbers = [stack.enter_context(claimed(cores.CLAIM)).number for _ in CORES]
        *owned, last = numbers
        assert last == -1
        assert len(set(owned)) == len(owned) == len(CORES) - 1
        assert cores.claimed() == set(owned) < CORES
    assert cores.claimed() == set()


@needs_two_cores
def test_a_killed_bench_gives_its_core_back(claims):
    program = (
        "import sys, time\n"
        "from rollerrig.realtime.loop import cores\n"
        f"cores._CLAIM_NAME = {cores._CLAIM_NAME!r}\n"
        "claim = cores.claim(cores.CLAIM)\n"
        "print(claim.number, flush=True)\n"
        "time.sleep(900)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        core = int(process.stdout.readline())
        assert cores.claimed() == {core}
        process.kill()
    assert cores.claimed() == set()


def test_a_named_core_is_taken_but_two_benches_do_not_both_own_it(claims):
    core = min(CORES)
    with claimed(core) as first, claimed(core) as second:
        assert first.number == second.number == core
        assert first.owned
        assert not second.owned
    with claimed(cores.ANY) as none:
        assert none.number == -1


@needs_two_cores
def test_all_threads_leave_a_core_and_return_to_it():
    core = max(CORES)
    # a library that an earlier test of this process used may have threads on this core only
    staying = {
        thread
        for thread in threads_allowed_on(core, os.getpid())
        if os.sched_getaffinity(thread) == {core}
    }
    event = threading.Event()
    thread = threading.Thread(target=event.wait)
    thread.start()
    before = {}
    try:
        before = cores.leave({core}, os.getpid())
        assert thread.native_id in before
        assert set(threads_allowed_on(core, os.getpid())) <= staying
    finally:
        cores.restore(before)
        event.set()
        thread.join()
    assert os.sched_getaffinity(0) == CORES


def test_a_process_with_one_core_keeps_it():
    program = (
        "import os\n"
        "from rollerrig.realtime.loop import cores\n"
        f"os.sched_setaffinity(0, {{{min(CORES)}}})\n"
        f"assert cores.leave({{{min(CORES)}}}, os.getpid()) == {{}}\n"
        f"assert not cores.claim({min(CORES)}).owned\n"
        "assert cores.claim(cores.CLAIM).number == -1\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


@needs_two_cores
def test_only_the_loop_runs_on_its_core(tmp_path):
    core = max(CORES)
    run = BenchProcess(tmp_path / "run", "--pacing", "wall", "--live", "--set", f"loop.cpu={core}")
    run.runs_for(0.5)
    (loop_thread,) = threads_allowed_on(core, run.process.pid)
    assert os.sched_getaffinity(loop_thread) == {core}
    # recorder, unit, and the viewer with what it has started
    children = children_of(run.process.pid)
    assert len(children) >= 3
    for child in children:
        for process in (child, *children_of(child)):
            assert threads_allowed_on(core, process) == []
    run.interrupt()
    run.finish()
    assert run.result["loop"]["core"] == core


@pytest.mark.nightly
def test_without_own_core_the_loop_runs_on_any(tmp_path):
    run = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", f"loop.cpu={cores.ANY}")
    run.runs_for(0.3)
    assert threads_allowed_on(max(CORES), run.process.pid)
    assert os.sched_getaffinity(run.process.pid) == CORES
    run.interrupt()
    run.finish()
    assert run.result["loop"]["core"] == -1


@needs_two_cores
@pytest.mark.parametrize("content", [None, ""])
def test_a_system_that_hides_its_interrupts_has_a_core_for_the_loop(
    claims, monkeypatch, tmp_path, content
):
    hidden = tmp_path / "interrupts"
    if content is not None:
        hidden.write_text(content)
    monkeypatch.setattr(cores, "_COUNTS", hidden)
    with claimed(cores.CLAIM) as claim:
        assert claim.owned


def test_a_family_is_a_process_with_the_processes_of_its_children():
    program = "import subprocess, sys\nsubprocess.run(['sleep', '900'])\n"
    with subprocess.Popen([sys.executable, "-c", program]) as child:
        grandchildren = []
        while not grandchildren:
            grandchildren = children_of(child.pid)
        family = cores.family(os.getpid())
        assert {os.getpid(), child.pid, *grandchildren} <= set(family)
        for process in grandchildren:
            os.kill(process, signal.SIGKILL)


def test_a_core_that_the_system_refuses_is_not_reported_as_the_core_of_the_loop(tmp_path):
    absent = max(CORES) + 100
    run = BenchProcess(tmp_path / "run", "--pacing", "wall", "--set", f"loop.cpu={absent}")
    run.runs_for(0.3)
    run.interrupt()
    run.finish()
    assert run.result["loop"]["core"] == -1
    refusals = [event for event in run.result["events"] if event["code"] == "loop.refused"]
    assert any(f"core {absent}" in event["fields"]["refused"] for event in refusals)


@pytest.fixture
def lists(monkeypatch, tmp_path, claims):
    """Files as in /proc/irq: other tests run benches that move the real interrupts.

    Returns a function that returns the cores of interrupts 24 to 27. No device uses 27.
    """
    folder = tmp_path / "irq"
    for number, served in (("24", "0"), ("25", "1"), ("26", "2"), ("27", "1")):
        (folder / number / "device").mkdir(parents=True)
        (folder / number / "smp_affinity_list").write_text("0-3\n")
        (folder / number / "effective_affinity_list").write_text(served)
    (folder / "27" / "device").rmdir()
    monkeypatch.setattr(cores, "INTERRUPTS", folder)
    monkeypatch.setattr(interrupts, "_RECORD", tmp_path / "record.json")

    def read():
        numbers = ("24", "25", "26", "27")
        return [(folder / number / "smp_affinity_list").read_text().strip() for number in numbers]

    return read


EVERYWHERE = ["0-3", "0-3", "0-3", "0-3"]


def claim_of(core):
    """A claim of a core, which this machine need not have."""
    return cores.Claim(core, cores._hold(core))


def test_interrupts_of_devices_leave_the_core_and_come_back(lists):
    assert cores.interrupts_on(1) == ["25"]
    with interrupts.kept_off(claim_of(1)) as stay:
        assert stay == []
        assert lists() == ["0-3", "0,2,3", "0-3", "0-3"]
    assert lists() == EVERYWHERE


def test_interrupts_come_back_when_the_last_bench_that_moved_them_ends(lists):
    first = contextlib.ExitStack()
    second = contextlib.ExitStack()
    first.enter_context(interrupts.kept_off(claim_of(1)))
    second.enter_context(interrupts.kept_off(claim_of(2)))
    assert lists() == ["0-3", "0,3", "0,3", "0-3"]
    first.close()
    assert lists() == ["0-3", "0,1,3", "0,1,3", "0-3"]
    assert cores.interrupts_on(2) == []
    second.close()
    assert lists() == EVERYWHERE


def test_the_next_start_brings_back_the_interrupts_of_a_killed_bench(lists):
    reader, writer = os.pipe()
    process = os.fork()
    if process == 0:
        with interrupts.kept_off(claim_of(1)):
            os.write(writer, b"moved")
            signal.pause()
    assert os.read(reader, 5) == b"moved"
    assert lists()[1] == "0,2,3"
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)
    assert lists()[1] == "0,2,3"
    with interrupts.kept_off(claim_of(2)):
        assert lists() == ["0-3", "0,1,3", "0,1,3", "0-3"]
    assert lists() == EVERYWHERE


def test_an_interrupt_that_somebody_else_has_moved_meanwhile_stays_there(lists, tmp_path):
    with interrupts.kept_off(claim_of(1)):
        (tmp_path / "irq" / "25" / "smp_affinity_list").write_text("3\n")
    assert lists() == ["0-3", "3", "0-3", "0-3"]


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"25": 1}', '{"25": ["a", "b"]}', '{"99": ["0", "1"]}']
)
def test_a_damaged_record_of_interrupts_is_passed_over(lists, tmp_path, content):
    (tmp_path / "record.json").write_text(content)
    with interrupts.kept_off(claim_of(1)):
        assert lists() == ["0-3", "0,2,3", "0-3", "0-3"]
    assert lists() == EVERYWHERE


@needs_two_cores
def test_interrupts_that_the_kernel_keeps_are_named(lists, tmp_path):
    path = tmp_path / "irq" / "25" / "smp_affinity_list"
    path.unlink()
    # a list of cores that cannot be written
    path.symlink_to("/sys/devices/system/cpu/online")
    with interrupts.kept_off(claim_of(1)) as stay:
        assert stay == ["25"]


@needs_two_cores
def test_the_desk_keeps_off_the_core_of_a_loop_and_returns(claims, tmp_path):
    pytest.importorskip("nicegui", reason="the desk needs nicegui")
    from rollerrig.realtime.desk.desk import Desk

    async def follow():
        desk = Desk(tmp_path, own=True)
        work = asyncio.create_task(desk.work())
        with claimed(cores.CLAIM) as claim:
            while claim.number in os.sched_getaffinity(0):
                await asyncio.sleep(0.05)
        while os.sched_getaffinity(0) != CORES:
            await asyncio.sleep(0.05)
        work.cancel()

    asyncio.run(asyncio.wait_for(follow(), 60.0))


def test_check_names_the_core_of_the_loop_or_the_reason_against_it():
    finding = check.core_of_loop()
    assert finding.found
    if finding.state is not check.State.OK:
        assert finding.mend
    if len(CORES) < 2:
        assert finding.found == "none is free"


def test_a_core_without_rights_for_interrupts_is_reported_with_them():
    # another user may not move interrupts
    program = (
        "import os\n"
        "from rollerrig.realtime.commands import check\n"
        "from rollerrig.realtime.loop import cores, loop\n"
        "if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "print(check.core_of_loop().state)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "weaker"
