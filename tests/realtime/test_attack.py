"""A rig that runs in real time while strangers send it rubbish through every door: a little of `bench fuzz`."""

import random
import threading
import time

import numpy as np
import pytest
from endurance import fuzz, runs

from rollerrig.realtime.record import records
from rollerrig.wsp_interface.events import Code

QUIET_S, ATTACK_S, END_S = (
    (1.0, 3.0),
    (3.5, 7.0),
    20.0,
)  # long enough for the answers on a machine that is busy


class Attacked:
    """A run in real time that was left alone for a while and attacked for a while."""

    def __init__(self):
        with runs.started("--pacing", "wall", *fuzz.SETTINGS, seconds=END_S) as bench:
            rows = bench.until(bench.rows, "its first sample")
            where = fuzz.places(bench)
            bench.until(lambda: runs.last_s(rows) >= ATTACK_S[0], "the attack")
            end_s = time.monotonic() + ATTACK_S[1] - ATTACK_S[0]
            strangers = [
                threading.Thread(
                    target=fuzz.attack,
                    args=(
                        door,
                        where[door.port],
                        random.Random(door.name),
                        1 << 30,
                        lambda: time.monotonic() < end_s,
                    ),
                )
                for door in fuzz.DOORS
            ]
            for one in strangers:
                one.start()
            for one in strangers:
                one.join()
            self.silent = fuzz.answers(where)
            self.status = bench.process.wait(runs.END_S)
            self.words, self.record = bench.words(), records.load(bench.folder)


@pytest.fixture(scope="module")
def attacked():
    return Attacked()


@pytest.mark.conformance(
    "Bad input", "rubbish through every codec and Modbus: nothing crashes, the run goes on"
)
def test_nothing_that_strangers_send_ends_the_run_or_fails_inside_it(attacked):
    assert attacked.status == 4, attacked.words  # it does not stop in that time
    assert "Traceback" not in attacked.words
    told = attacked.record.summary
    assert told["ended"] == "finished"
    assert not fuzz.failures(attacked.record.events)
    assert told["bus"]["frames"] > 1500 * END_S
    assert told["modbus"]["requests"] > 100
    assert told["loop"]["ticks"] == round(1000 * END_S)


@pytest.mark.conformance("Bad input", "no thread dies: SYNC, SDO and Modbus go on after the attack")
def test_bus_and_modbus_serve_a_polite_client_as_before(attacked):
    assert attacked.silent == []


@pytest.mark.conformance("Bad input", "the loop's lateness is that of a rig left alone")
def test_the_loop_is_as_punctual_under_attack_as_when_it_is_left_alone(attacked):
    run = attacked.record
    refused = [event.fields["refused"] for event in run.events if event.code == Code.LOOP_REFUSED]
    if any("SCHED_FIFO" in what for what in refused):
        pytest.skip("no SCHED_FIFO here: the loop shares the processor with whoever attacks it")
    time_s, late_us = run.column("time_s"), run.column("tick_lateness_us")
    quiet, under = (
        np.median(late_us[(time_s > begin) & (time_s < end)]) for begin, end in (QUIET_S, ATTACK_S)
    )
    # ten ticks' worst, half of the time: less than a tick later
    assert under < quiet + 1000.0, (quiet, under)
