"""A program that is forked for a test does what the same program does that is started by hand."""

import os
import signal
import subprocess
import sys

import process_tree
import program
import pytest
from bench_process import until

# what a program finds when it begins
SURROUNDINGS = """
import os, signal, sys
import rollerrig.realtime.cli
blocked = signal.pthread_sigmask(signal.SIG_BLOCK, ())
handlers = [signal.getsignal(number) for number in sorted(signal.valid_signals())]
handlers[signal.SIGINT - 1] = "that of Python"
print(os.getcwd(), sorted(os.environ.items()), sorted(os.sched_getaffinity(0)))
print(sys.argv, sys.orig_argv[1:], sys.flags, sys.stdin.read(), os.getpid() == os.getsid(0))
print(blocked, handlers)
print("to standard error", file=sys.stderr)
sys.exit(len(sys.argv))
"""


def by_hand(*words, folder, **variables):
    done = subprocess.run(
        [sys.executable, *words],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        cwd=folder,
        env=os.environ | variables,
        start_new_session=True,
        check=False,
    )
    return program.Done(done.returncode, done.stdout, done.stderr)


def test_a_program_has_the_surroundings_of_a_program_that_is_started_by_hand(tmp_path):
    words = ("-c", SURROUNDINGS, "one", "two words")
    found = program.python(*words, folder=tmp_path, OF_THIS_TEST="3")
    assert found == by_hand(*words, folder=tmp_path, OF_THIS_TEST="3")
    assert found.status == 3


def test_a_command_gives_the_status_output_and_messages_of_a_command_that_is_started_by_hand(
    tmp_path,
):
    for words in (("list", "scenarios"), ("run", "velim_b9")):
        found = program.rollerrig(*words, folder=tmp_path)
        assert found == by_hand(*program.CLI, *words, folder=tmp_path)


def test_a_command_starts_itself_again_for_a_vehicle_that_its_process_does_not_simulate(tmp_path):
    # the server of the coach, because the words do not have the name of a packaged scenario
    (tmp_path / "tram.toml").write_text(
        'title = "a tram"\nvehicle = "tram_3_bogies"\nadhesion = "dry"\n'
    )
    words = ("devices", "--scenario", "tram.toml", "--out", "devices")
    found = program.rollerrig(*words, folder=tmp_path)
    assert found.status == 0, found.messages
    assert (tmp_path / "devices/node_033_roller_drive.eds").exists()


def test_programs_exit_with_the_process_that_has_started_their_server():
    # another process of tests, which prints the server's number and that of a program
    code = (
        "import os, program, sys, time\n"
        "with open(os.devnull, 'r+') as nothing:\n"
        "    endless = program.Program(('-c', 'import time; time.sleep(900)'), [nothing] * 3)\n"
        "print(endless.pid, os.getppid(), flush=True)\n"
        "time.sleep(900)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": os.path.dirname(program.__file__)},
    ) as tests:
        pid = int(tests.stdout.readline().split()[0])
        children = process_tree.descendants(tests.pid)
        assert pid in children
        tests.send_signal(signal.SIGKILL)
    until(lambda: not any(map(process_tree.is_running, children)), "the end of server and program")


def test_a_program_whose_time_is_over_is_killed():
    with pytest.raises(subprocess.TimeoutExpired):
        program.python("-c", "import time; time.sleep(900)", timeout_s=0.1)
