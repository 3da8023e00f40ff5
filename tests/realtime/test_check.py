"""`rollerrig check`: what it finds on this machine, and what it reports of a limited one."""

import argparse
import json
import os
import socket

import program
import pytest

from rollerrig.realtime import cli
from rollerrig.realtime.commands import check
from rollerrig.realtime.commands.check import Finding, State


@pytest.fixture
def used_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server.getsockname()[1]


def test_every_row_has_a_state_and_a_remedy_if_it_is_not_ok():
    findings = check.check_machine(0)
    names = {finding.name for finding in findings}
    assert len(names) == len(findings) >= 15
    for finding in findings:
        assert finding.found
        assert finding.state is State.OK or finding.mend, finding.name


def test_check_prints_one_json_object_and_a_run_is_possible_here(capsys):
    status = cli.main(["check", "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["possible"] is (status == 0) is True
    assert {"name", "state", "found", "mend"} == set(result["checks"][0])


def test_a_port_in_use_is_reported_with_its_holder_and_a_way_out(used_port):
    finding = check.port(used_port)
    assert finding.state is State.WEAKER
    assert "in use" in finding.found
    assert str(used_port) in finding.mend
    assert "socketcand_port=0" in finding.mend
    if check.shutil.which("ss"):
        assert str(os.getpid()) in finding.found


def test_a_free_port_is_free():
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
    assert check.port(number).state is State.OK


def test_a_port_that_cannot_exist_is_not_free():
    assert check.port(70000).state is State.WEAKER


def test_the_check_of_priority_does_not_change_the_priority_of_this_thread():
    check.priority()
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_a_process_without_rights_learns_how_to_get_priority_and_locked_memory():
    # limits of zero, and no capabilities: what a fresh user account has
    script = (
        "import resource, os\n"
        "from rollerrig.realtime.loop import clock, loop\n"
        "from rollerrig.realtime.commands import check\n"
        "for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):\n"
        "    resource.setrlimit(limit, (0, 0))\n"
        "if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "for finding in (check.priority(), check.memory_lock()):\n"
        "    print(finding.state, '|', finding.mend)\n"
    )
    rights, memory = program.python("-c", script).printed.splitlines()
    for line, limit in ((rights, "rtprio"), (memory, "memlock")):
        assert line.startswith("weaker")
        assert limit in line


def test_one_missing_row_means_that_no_run_is_possible(capsys):
    findings = [Finding("shared memory", State.MISSING, "1 MB free", "make room")]
    assert check.show(argparse.Namespace(json=False), findings) == 2
    printed = capsys.readouterr()
    assert "make room" in printed.out
    assert "no run is possible" in printed.err
