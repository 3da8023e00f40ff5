"""Events of a run: a flood of them takes a bounded amount of memory, and is counted correctly."""

import signal
import time

import can
from bench_process import BenchProcess

from rollerrig.realtime.record.events import KEPT, Events
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.events import Code, make

# the NMT command "reset node" (129) to all nodes (0)
RESET_ALL_NODES = can.Message(arbitration_id=0, data=[129, 0], is_extended_id=False)


def note(number):
    return make(number, Code.OPERATOR_NOTE, note=f"event {number}")


def test_few_events_are_all_kept():
    events = Events()
    given = [note(number) for number in range(2 * KEPT)]
    for event in given:
        events.add(event)
    assert list(events) == given


def test_of_many_events_the_first_and_last_are_kept_and_all_are_counted():
    events = Events()
    for number in range(10 * KEPT):
        if number % 10 == 0:
            events.add(make(number, Code.RUN_FAILED, reason=f"event {number}"))
        else:
            events.add(note(number))
    kept = list(events)
    assert len(kept) == 2 * KEPT + 1
    assert kept[0].fields == {"reason": "event 0"}
    assert kept[-1] == note(10 * KEPT - 1)
    assert kept[KEPT].code == Code.EVENTS_LEFT_OUT
    assert kept[KEPT].fields == {"events": 8 * KEPT}
    assert events.counts == {"error": KEPT, "info": 9 * KEPT}


def test_a_flood_of_resets_does_not_flood_the_summary(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--wsp", "none")
    with buses.open_client(bench.address()) as bus:
        bench.runs_for(0.2)
        # each reset is for six nodes, and each node reports two events or more
        for _ in range(8 * KEPT // 100):
            for _ in range(10):
                bus.send(RESET_ALL_NODES)
            time.sleep(0.05)
        bench.process.send_signal(signal.SIGINT)
        bench.finish()
    assert len(bench.reported(Code.NMT_STATE)) > 4 * KEPT
    assert len(bench.result["events"]) <= 2 * KEPT + 1
    assert Code.EVENTS_LEFT_OUT in [event["code"] for event in bench.result["events"]]
