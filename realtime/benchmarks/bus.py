"""How fast the bus is on a running bench: TPDO to valve, SYNC to last TPDO, round trips.

Every figure comes from a real run in wall pacing, with nodes, recorder and real-time thread, and a
client in a process of its own. The way from a speed TPDO to the valve is read from the run's own
record: stamps of the frames in can.log, and the tick that first had the new magnets. The valve's
dead time is pneumatics and comes after it.
"""

import argparse
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.benchmarks import client, figures, modbus, wall
from rollerrig.realtime.benchmarks.figures import Result, Say, Target
from rollerrig.realtime.record import records, run_folder
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

RATES_HZ = (100, 1000, 2000)
SDO_WITHIN = 1.5
_TOGGLE_S, _ASK_S, _RATE_S = 10.0, 5.0, 4.0
_TICK_HZ = 1000
_JOINING_US, _JOINING_TRIPS = 200_000, client.BLOCK
_LINE = re.compile(r"^\((\d+)\.(\d{6})\) \S+ ([0-9A-F]+)#([0-9A-F]*)", re.MULTILINE)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Three kinds of runs: with a unit that switches all the time, with questions, and by rates."""
    say(f"speed TPDO to valve, {_TOGGLE_S:g} s ...")
    found, timing = to_valve(_TOGGLE_S)
    rates = [timing]
    say(f"round trips, {_ASK_S:g} s ...")
    trips = round_trips(_ASK_S)
    for hz in RATES_HZ[1:]:
        say(f"SYNC at {hz} Hz, {_RATE_S:g} s ...")
        rates.append(at_rate(hz, _RATE_S))
    say(f"Modbus requests, {_RATE_S:g} s ...")
    asked = modbus.requests(_RATE_S)
    limit_ms = 1000.0 / RATES_HZ[0] + 1000.0 / _TICK_HZ
    # how late a tick began is the loop's own benchmark's to judge
    worst_us = found["from_tpdo_less_lateness_us"].get("max")
    return {
        "tpdo_to_valve": found, "round_trip": trips, "sync": rates, "modbus": asked,
        "targets": [
            Target("speed TPDO to valve effect, the longest, less the tick's lateness",
                   None if worst_us is None else worst_us / 1000.0, limit_ms, "ms").plain(),
            Target("SDO round trip over the hub's echo, p50", trips["ratio"], SDO_WITHIN).plain(),
            modbus.target(asked).plain(),
        ],
        "notes": ["the hub carries what it is given: beyond the bit rate its load passes 100 %, "
                  "which no wire would do",
                  f"the client asks for SCHED_FIFO {client.PRIORITY}, as a unit with a controller "
                  "of its own"],
    }


# -- runs

def to_valve(seconds: float) -> tuple[Result, Result]:
    """A run whose unit switches all magnets at every SYNC: latencies of `chain`, and timing."""
    settings = (f"loop.tick_hz={_TICK_HZ}", f"loop.record_hz={_TICK_HZ}",
                f"bus.sync_period_s={1 / RATES_HZ[0]!r}")
    with wall.held(seconds, "external", settings, beside=_beside("unit")) as measured:
        return chain(measured.folder), _timing(RATES_HZ[0], seconds, measured)


def round_trips(seconds: float) -> Result:
    """A run with questions, which must fit into the seconds: frame echo and SDO upload in us."""
    with wall.held(seconds, "none", beside=_beside("ask")) as measured:
        trips_ns = measured.beside
    echo, sdo = (figures.quantiles(np.array(trips_ns[name][_JOINING_TRIPS:]) / 1000.0) for name in ("echo", "sdo"))
    return {"echo_us": echo, "sdo_us": sdo,
            "ratio": sdo["p50"] / echo["p50"] if echo and sdo else None}


def at_rate(hz: int, seconds: float) -> Result:
    """A run with SYNC at a rate, and a client that listens."""
    settings = (f"loop.tick_hz={max(hz, _TICK_HZ)}", f"bus.sync_period_s={1 / hz!r}")
    with wall.held(seconds, "none", settings, beside=_beside("listen")) as measured:
        return _timing(hz, seconds, measured)


def _beside(role: str) -> wall.Beside:
    """A client of the run's hub."""

    async def beside(parts: Parts) -> Any:
        host, port, bus = plugin.parse_address(parts.place)
        if role == "ask" and parts.hub:
            _echo(parts.hub)
        return await wall.client("client", role, host, str(port), bus)

    return beside


def _echo(hub: Hub) -> None:
    """Put a node on the bus that does nothing but answer: the transport's own round trip."""

    def answer(frame: Frame) -> None:
        if frame.can_id == client.ECHO_CALL:
            port.send(Frame(client.ECHO_ANSWER, frame.data))

    port = hub.attach(answer, "echo")


# -- what they tell

def _timing(hz: int, seconds: float, measured: wall.Measured) -> Result:
    """SYNC to last TPDO in a client's hands, and whether the rate was kept."""
    begun_ns = measured.parts.begun_ns
    heard = measured.beside["syncs"][:-1]
    # the hub holds the first frames of a client back until it has read the handshake
    late_us = [(last_ns - begun_ns) / 1000.0 - stamp_us for stamp_us, _, last_ns in heard
               if last_ns and stamp_us > heard[0][0] + _JOINING_US]
    frames = _frames(measured.folder)
    sent = len(_stamps(frames, client.SYNC))
    loop, bus = measured.summary["loop"], measured.summary["bus"]
    return {"hz": hz, "syncs": sent, "expected": round(seconds * hz), "last_tpdo_us":
            figures.quantiles(late_us), "last_tpdo_hub_us": figures.quantiles(bursts(frames)),
            "kept": sent >= 0.999 * seconds * hz - 1,
            "bus_thread_share": measured.bus_thread_share, "dropped": bus["dropped"],
            "load_percent": bus["load_percent"], "missed_ticks": loop["missed"]}


def bursts(frames: Iterable[tuple[int, int, str]]) -> list[int]:
    """From each SYNC's stamp to that of the last TPDO before the next SYNC, in us."""
    found: list[int] = []
    sync_us = last_us = -1
    for stamp_us, can_id, _ in frames:
        if can_id == client.SYNC:
            if last_us > sync_us >= 0:
                found.append(last_us - sync_us)
            sync_us = last_us = stamp_us
        elif can_id in client.TPDOS:
            last_us = stamp_us
    return found


def _frames(folder: Path) -> list[tuple[int, int, str]]:
    """Stamp in us, identifier and data in hex of every frame in can.log."""
    text = (folder / run_folder.CAN_LOG).read_text(encoding="ascii")
    return [(1_000_000 * int(seconds) + int(micros), int(can_id, 16), data)
            for seconds, micros, can_id, data in _LINE.findall(text)]


def _stamps(frames: Iterable[tuple[int, int, str]], can_id: int) -> np.ndarray:
    return np.array([stamp for stamp, one, _ in frames if one == can_id], dtype=np.int64)


def chain(folder: Path) -> Result:
    """From the record of a run: SYNC, speed TPDO, magnets' frame, first tick that has the magnets.

    The run was recorded every tick: a row is what a tick left behind that began at the row's time,
    later by the lateness of that tick, which is told by the row before.
    """
    frames = _frames(folder)
    run = records.load(folder)
    time_us, magnets = 1e6 * run.column("time_s"), run.column("magnets_1")
    began_us = time_us + np.concatenate(([0.0], run.column("tick_lateness_us")[:-1]))
    switched = np.flatnonzero(np.diff(magnets)) + 1
    syncs, speeds = _stamps(frames, client.SYNC), _stamps(frames, client.SPEEDS)
    commands = [(stamp, int(data, 16) & 3) for stamp, can_id, data in frames
                if can_id == client.MAGNETS and data]
    at_us = np.array([stamp for stamp, _ in commands])
    late_us = began_us - time_us
    from_sync, from_tpdo, from_command, punctual = [], [], [], []
    for row in switched:
        last = int(np.searchsorted(at_us, began_us[row], side="right")) - 1
        if last < 0 or commands[last][1] != magnets[row]:
            continue  # the fall to the fail-safe value at the end has no frame
        tpdo = int(np.searchsorted(speeds, at_us[last])) - 1
        sync = int(np.searchsorted(syncs, speeds[tpdo], side="right")) - 1
        if tpdo < 0 or sync < 0:
            continue
        from_sync.append(began_us[row] - syncs[sync])
        from_tpdo.append(began_us[row] - speeds[tpdo])
        from_command.append(began_us[row] - at_us[last])
        punctual.append(from_tpdo[-1] - late_us[row])
    return {"switches": len(from_tpdo), "syncs": len(syncs),
            "from_sync_us": figures.quantiles(from_sync),
            "from_tpdo_us": figures.quantiles(from_tpdo),
            "from_command_us": figures.quantiles(from_command),
            "from_tpdo_less_lateness_us": figures.quantiles(punctual)}


def table(result: Result) -> Table:
    """All latencies in us, then each rate."""
    valve, trips = result["tpdo_to_valve"], result["round_trip"]
    named = [("SYNC to valve effect", valve["from_sync_us"], valve["switches"]),
             ("speed TPDO to valve effect", valve["from_tpdo_us"], valve["switches"]),
             ("the same less the tick's lateness", valve["from_tpdo_less_lateness_us"], ""),
             ("magnets' frame to valve effect", valve["from_command_us"], valve["switches"]),
             ("round trip of a frame (echo)", trips["echo_us"], ""),
             ("round trip of an SDO upload", trips["sdo_us"], "")]
    asked = result["modbus"]
    named += [("round trip of a Modbus request", asked["trip_us"], f"{asked['per_s']:.0f} a second")]
    named += [(f"SYNC to last TPDO at the hub, {one['hz']} Hz", one["last_tpdo_hub_us"], "")
              for one in result["sync"]]
    named += [(f"SYNC to last TPDO at a client, {one['hz']} Hz", one["last_tpdo_us"],
               f"{one['syncs']} of {one['expected']}{'' if one['kept'] else ' NOT KEPT'}, bus "
               f"thread {100 * one['bus_thread_share']:.0f} %, {one['dropped']} dropped, bus load "
               f"{one['load_percent']:.0f} %")
              for one in result["sync"]]
    rows = [(name, *(found.get(key) for key in ("p50", "p99", "p999", "max")), note)
            for name, found, note in named]
    return figures.table("the bus, in us", ("", "p50", "p99", "p999", "max", "SYNCs"), rows)
