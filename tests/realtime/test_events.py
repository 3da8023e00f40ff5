"""Events of a run: a flood of them is bounded, and counted right."""

import signal
import time

import can
from bench_process import BenchProcess

from rollerrig.realtime.record.events import KEPT, Events
from rollerrig.wsp_interface.bus import buses


def test_few_events_are_all_kept():
    events = Events()
    for number in range(2 * KEPT):
        events.add(number, "info", f"event {number}")
    assert [one["text"] for one in events] == [f"event {number}" for number in range(2 * KEPT)]


def test_of_many_events_the_first_and_last_are_kept_and_all_are_counted():
    events = Events()
    for number in range(10 * KEPT):
        events.add(number, "error" if number % 10 == 0 else "info", f"event {number}")
    kept = list(events)
    assert len(kept) == 2 * KEPT + 1
    assert (kept[0]["text"], kept[-1]["text"]) == ("event 0", f"event {10 * KEPT - 1}")
    assert str(8 * KEPT) in kept[KEPT]["text"]
    assert kept[KEPT]["level"] == "warning"
    assert events.counts == {"error": KEPT, "info": 9 * KEPT}


def test_a_flood_of_resets_does_not_flood_the_summary(tmp_path):
    bench = BenchProcess(tmp_path / "run", "--pacing", "wall", "--wsp", "none")
    with buses.open_client(bench.address()) as bus:
        bench.runs_for(0.2)
        for _ in range(20 * KEPT // 100):  # each resets six nodes, which tell two or more events
            for _ in range(10):
                bus.send(can.Message(arbitration_id=0, data=[129, 0], is_extended_id=False))
            time.sleep(0.05)
        bench.process.send_signal(signal.SIGINT)
        bench.finish()
    assert len(bench.heard("NMT")) > 4 * KEPT
    assert len(bench.told["events"]) <= 2 * KEPT + 1
    assert any("left out" in one["text"] for one in bench.told["events"])
