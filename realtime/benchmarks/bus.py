"""How fast the bus is on a running bench: TPDO to valve, SYNC to last TPDO, round trips, Modbus requests.

Every figure comes from a real run in wall pacing, with nodes, recorder and real-time thread, and a client in a process
of its own. The way from a speed TPDO to the valve is read from the run's own record: stamps of the frames in can.log,
and the tick that first had the new magnets. The valve's dead time is pneumatics and comes after it.
"""

import argparse
import asyncio
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.benchmarks import client, figures, wall
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import magnets
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import Frame

RATES_HZ = (100, 1000, 2000)
SDO_WITHIN, MODBUS_PER_S = 1.5, 15_000
_TOGGLE_S, _ASK_S, _RATE_S = 10.0, 5.0, 4.0
_TICK_HZ = 1000
# the Modbus client's start and end have to lie inside the run
_MARGIN_S = 4.0
_JOINING_US, _JOINING_TRIPS = 200_000, client.BLOCK


def run(given: argparse.Namespace, say: Say) -> Result:
    """Three kinds of runs: with a unit that switches all the time, with questions, and by rates."""
    say(f"speed TPDO to valve, {_TOGGLE_S:g} s ...")
    found, timing = to_valve(_TOGGLE_S)
    rates = [timing]
    say(f"round trips, {_ASK_S:g} s ...")
    trips = round_trips(_ASK_S)
    for hz in RATES_HZ[1:]:
        say(f"SYNC at {hz} Hz, {_RATE_S:g} s ...")
        settings = (f"loop.tick_hz={max(hz, _TICK_HZ)}", f"bus.sync_period_s={1 / hz!r}")
        with wall.held(_RATE_S, "none", settings, beside=_beside("listen")) as measured:
            rates.append(_timing(hz, _RATE_S, measured))
    say(f"Modbus requests, {_RATE_S:g} s ...")
    asked = modbus_requests(_RATE_S)
    limit_ms = 1000.0 / RATES_HZ[0] + 1000.0 / _TICK_HZ
    # how late a tick began is the loop's own benchmark's to judge
    worst_us = found["from_tpdo_less_lateness_us"].get("max")
    return {
        "tpdo_to_valve": found,
        "round_trip": trips,
        "sync": rates,
        "modbus": asked,
        "targets": [
            target(
                "speed TPDO to valve effect, the longest, less the tick's lateness",
                None if worst_us is None else worst_us / 1000.0,
                limit_ms,
                "ms",
            ),
            target("SDO round trip over the hub's echo, p50", trips["ratio"], SDO_WITHIN),
            # the requirement as the time that a request may take
            target(
                f"a Modbus request, for {MODBUS_PER_S} a second",
                1e6 / asked["per_s"],
                1e6 / MODBUS_PER_S,
                "us",
            ),
        ],
        "notes": [
            "the hub carries what it is given: beyond the bit rate its load passes 100 %, which no wire would do",
            f"the client asks for SCHED_FIFO {client.PRIORITY}, as a unit with a controller of its own",
        ],
    }


def to_valve(seconds: float) -> tuple[Result, Result]:
    """A run whose unit switches all magnets at every SYNC: latencies of `chain`, and timing."""
    settings = (
        f"loop.tick_hz={_TICK_HZ}",
        f"loop.record_hz={_TICK_HZ}",
        f"bus.sync_period_s={1 / RATES_HZ[0]!r}",
    )
    with wall.held(seconds, "external", settings, beside=_beside("unit")) as measured:
        return chain(measured.folder), _timing(RATES_HZ[0], seconds, measured)


def round_trips(seconds: float) -> Result:
    """A run with questions, which must fit into the seconds: frame echo and SDO upload in us."""
    with wall.held(seconds, "none", beside=_beside("ask")) as measured:
        trips_ns = measured.beside
    echo, sdo = (
        figures.quantiles(np.array(trips_ns[name][_JOINING_TRIPS:]) / 1000.0)
        for name in ("echo", "sdo")
    )
    return {
        "echo_us": echo,
        "sdo_us": sdo,
        "ratio": sdo["p50"] / echo["p50"] if echo and sdo else None,
    }


def modbus_requests(seconds: float) -> Result:
    """A run with a Modbus client: requests a second, round trips in us, and what the loop made of it."""

    async def beside(parts: Parts) -> Any:
        while "modbus" not in parts.ports:
            await asyncio.sleep(0.01)
        return await wall.client("modbus", "127.0.0.1", parts.ports["modbus"], f"{seconds:g}")

    with wall.held(seconds + _MARGIN_S, "none", beside=beside) as measured:
        loop = measured.summary["loop"]
        return {
            "per_s": measured.beside["per_s"],
            "registers": client.REGISTERS,
            "trip_us": figures.quantiles(measured.beside["trips_us"]),
            "answered": measured.summary["modbus"]["requests"],
            "missed_ticks": loop["missed"],
            "lateness_us": loop["lateness_us"],
            "bus_thread_share": measured.bus_thread_share,
        }


def _beside(role: str) -> wall.Beside:
    """A client of the run's hub."""

    async def beside(parts: Parts) -> Any:
        host, port, bus = plugin.parse_address(parts.place)
        if role == "ask" and parts.hub:
            # a node that does nothing but answer: the transport's own round trip
            echo = parts.hub.attach(
                lambda frame: (
                    echo.send(Frame(client.ECHO_ANSWER, frame.data))
                    if frame.can_id == client.ECHO_CALL
                    else None
                ),
                "echo",
            )
        return await wall.client(role, host, port, bus)

    return beside


def _timing(hz: int, seconds: float, measured: wall.Measured) -> Result:
    """SYNC to last TPDO in a client's hands, and whether the rate was kept."""
    begun_ns, heard = measured.parts.begun_ns, measured.beside["syncs"][:-1]
    # the hub holds the first frames of a client back until it has read the handshake
    late_us = [
        (last_ns - begun_ns) / 1000.0 - stamp_us
        for stamp_us, _, last_ns in heard
        if last_ns and stamp_us > heard[0][0] + _JOINING_US
    ]
    frames = records.frames(measured.folder)
    sent, bus = len(_stamps(frames, client.SYNC)), measured.summary["bus"]
    return {
        "hz": hz,
        "syncs": sent,
        "expected": round(seconds * hz),
        "last_tpdo_us": figures.quantiles(late_us),
        "last_tpdo_hub_us": figures.quantiles(bursts(frames)),
        "kept": sent >= 0.999 * seconds * hz - 1,
        "bus_thread_share": measured.bus_thread_share,
        "dropped": bus["dropped"],
        "load_percent": bus["load_percent"],
        "missed_ticks": measured.summary["loop"]["missed"],
    }


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


def _stamps(frames: Iterable[tuple[int, int, str]], can_id: int) -> np.ndarray:
    return np.array([stamp for stamp, one, _ in frames if one == can_id], dtype=np.int64)


def chain(folder: Path) -> Result:
    """From the record of a run: SYNC, speed TPDO, magnets' frame, first tick that has the magnets.

    The run was recorded every tick: a row is what a tick left behind that began at the row's time,
    later by the lateness of that tick, which is told by the row before.
    """
    frames, run = records.frames(folder), records.load(folder)
    time_us, leading_pair = 1e6 * run.column("time_s"), run.column("magnets_1")
    began_us = time_us + np.concatenate(([0.0], run.column("tick_lateness_us")[:-1]))
    syncs, speeds = _stamps(frames, client.SYNC), _stamps(frames, client.SPEEDS)
    commands = [
        (stamp, magnets.unpack(int(data, 16))[0])
        for stamp, can_id, data in frames
        if can_id == client.MAGNETS and data
    ]
    at_us = np.array([stamp for stamp, _ in commands])
    found: dict[str, list[float]] = {
        name: []
        for name in (
            "from_sync_us",
            "from_tpdo_us",
            "from_command_us",
            "from_tpdo_less_lateness_us",
        )
    }
    for row in np.flatnonzero(np.diff(leading_pair)) + 1:
        last = int(np.searchsorted(at_us, began_us[row], side="right")) - 1
        if last < 0 or commands[last][1] != leading_pair[row]:
            continue  # the fall to the fail-safe value at the end has no frame
        tpdo = int(np.searchsorted(speeds, at_us[last])) - 1
        sync = int(np.searchsorted(syncs, speeds[tpdo], side="right")) - 1
        if tpdo >= 0 and sync >= 0:
            for values, begun_us in zip(
                found.values(),
                (
                    began_us[row] - syncs[sync],
                    began_us[row] - speeds[tpdo],
                    began_us[row] - at_us[last],
                    time_us[row] - speeds[tpdo],
                ),
                strict=True,
            ):
                values.append(begun_us)
    return {
        "switches": len(found["from_tpdo_us"]),
        "syncs": len(syncs),
        **{name: figures.quantiles(values) for name, values in found.items()},
    }


def table(result: Result) -> Table:
    """All latencies in us, then each rate."""
    valve, trips, asked = result["tpdo_to_valve"], result["round_trip"], result["modbus"]
    named = [
        ("SYNC to valve effect", valve["from_sync_us"], valve["switches"]),
        ("speed TPDO to valve effect", valve["from_tpdo_us"], valve["switches"]),
        ("the same less the tick's lateness", valve["from_tpdo_less_lateness_us"], ""),
        ("magnets' frame to valve effect", valve["from_command_us"], valve["switches"]),
        ("round trip of a frame (echo)", trips["echo_us"], ""),
        ("round trip of an SDO upload", trips["sdo_us"], ""),
        ("round trip of a Modbus request", asked["trip_us"], f"{asked['per_s']:.0f} a second"),
    ]
    named += [
        (f"SYNC to last TPDO at the hub, {one['hz']} Hz", one["last_tpdo_hub_us"], "")
        for one in result["sync"]
    ]
    named += [
        (
            f"SYNC to last TPDO at a client, {one['hz']} Hz",
            one["last_tpdo_us"],
            f"{one['syncs']} of "
            f"{one['expected']}{'' if one['kept'] else ' NOT KEPT'}, bus thread {100 * one['bus_thread_share']:.0f} "
            f"%, {one['dropped']} dropped, bus load {one['load_percent']:.0f} %",
        )
        for one in result["sync"]
    ]
    return figures.table(
        "the bus, in us",
        ("", *figures.QUANTILES, "SYNCs"),
        [(name, *map(found.get, figures.QUANTILES), note) for name, found, note in named],
    )
