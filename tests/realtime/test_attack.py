"""A rig that runs in real time under malformed input at every interface: a short `bench fuzz`."""

import random
import threading
import time

import numpy as np
import pytest
from endurance import fuzz, runs

from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

pytestmark = pytest.mark.nightly

# simulated seconds: without attack, under attack, end of the run; after the attack, a busy machine
# needs time for the answers
QUIET_S = (1.0, 3.0)
ATTACK_S = (3.5, 7.0)
END_S = 20.0


class Attacked:
    """A run in real time: first without an attack, then under attack."""

    def __init__(self):
        with runs.started("--pacing", "wall", *fuzz.SETTINGS, seconds=END_S) as bench:
            rows = bench.wait_for(bench.rows, "its first sample")
            where = fuzz.addresses(bench)
            bench.wait_for(lambda: runs.last_s(rows) >= ATTACK_S[0], "the attack")
            attack_all(where, ATTACK_S[1] - ATTACK_S[0])
            self.unanswered = fuzz.unanswered(where)
            self.status = bench.process.wait(runs.STOP_WITHIN_S)
            self.stderr = bench.stderr()
            self.record = records.load(bench.folder)


def attack_all(where, seconds):
    """Attack all interfaces simultaneously for some seconds."""
    end_s = time.monotonic() + seconds
    attackers = []
    for interface in fuzz.INTERFACES:
        arguments = {
            "interface": interface,
            "address": where[interface.port],
            "source": random.Random(interface.name),
            "count": 1 << 30,
            "goes_on": lambda: time.monotonic() < end_s,
        }
        attackers.append(threading.Thread(target=fuzz.attack, kwargs=arguments))
    for attacker in attackers:
        attacker.start()
    for attacker in attackers:
        attacker.join()


@pytest.fixture(scope="module")
def attacked():
    return Attacked()


@pytest.mark.conformance(
    "Bad input",
    "malformed input through every codec and Modbus: nothing crashes, the run continues",
)
def test_no_input_ends_the_run_or_fails_inside_it(attacked):
    assert attacked.status == 4, attacked.stderr  # the coach does not stop in that time
    assert "Traceback" not in attacked.stderr
    summary = attacked.record.summary
    assert summary["ended"] == "finished"
    assert not fuzz.failures(attacked.record.events)
    assert summary["bus"]["frames"] > 1500 * END_S
    assert summary["modbus"]["requests"] > 100
    assert summary["loop"]["ticks"] == round(1000 * END_S)


@pytest.mark.conformance(
    "Bad input", "no thread dies: SYNC, SDO and Modbus continue after the attack"
)
def test_bus_and_modbus_serve_a_correct_client_as_before(attacked):
    assert attacked.unanswered == []


@pytest.mark.conformance("Bad input", "the loop's lateness is that of a rig without an attack")
def test_the_loop_is_as_punctual_under_attack_as_without_one(attacked):
    run = attacked.record
    refused = [event.fields["refused"] for event in run.events if event.code == Code.LOOP_REFUSED]
    if any("SCHED_FIFO" in what for what in refused):
        pytest.skip("no SCHED_FIFO here: the loop shares the processor with the attackers")
    time_s = run.column("time_s")
    late_us = run.column("tick_lateness_us")

    def median_us(begin_s, end_s):
        return np.median(late_us[(time_s > begin_s) & (time_s < end_s)])

    quiet_us = median_us(*QUIET_S)
    attacked_us = median_us(*ATTACK_S)
    # each sample has the worst of ten ticks: half of them are less than a tick later
    assert attacked_us < quiet_us + 1000.0, (quiet_us, attacked_us)
