"""`rollerrig bench bus`: how fast the bus is on a running bench.

All figures come from real runs in wall pacing, with nodes, recorder and real-time thread, and a
client in a separate process. Measured are the latency from a speed TPDO to the valve, the time from
SYNC to the last TPDO at three rates, round trips, and Modbus requests.

The latency to the valve is read from the record of the run: the time stamps of the frames in
can.log, and the tick that had the new magnets first. The dead time of the valve is pneumatic and
comes after that.
"""

import argparse
import asyncio
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.benchmarks import client, figures, wall
from rollerrig.realtime.benchmarks.figures import Result, Say, target
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import magnets
from rollerrig.wsp_interface.bus import plugin
from rollerrig.wsp_interface.bus.frames import Frame

# of SYNC; the latency to the valve is measured at the first
RATES_HZ = (100, 1000, 2000)
# requirements: SDO round trip over that of an echo, and Modbus requests per second
SDO_WITHIN = 1.5
MODBUS_PER_S = 15_000
# duration of each kind of run
_VALVE_S = 10.0
_ROUND_TRIPS_S = 5.0
_RATE_S = 4.0
_TICK_HZ = 1000
# a Modbus run is so much longer than its client, which has to begin and to finish inside it
_MARGIN_S = 4.0
# left out, because the hub holds back the first frames of a client until its handshake is done
_JOINING_US = 200_000
_JOINING_TRIPS = client.BLOCK
# a rate is kept when this share of its SYNCs was sent
_KEPT_SHARE = 0.999

# a row of can.log: time stamp in us, identifier, data as hexadecimal text
LoggedFrame = tuple[int, int, str]


def run(given: argparse.Namespace, say: Say) -> Result:
    """Measure the latency to the valve, round trips, SYNC at all rates, and Modbus requests."""
    say(f"speed TPDO to valve, {_VALVE_S:g} s ...")
    valve, timing = to_valve(_VALVE_S)
    rates = [timing]

    say(f"round trips, {_ROUND_TRIPS_S:g} s ...")
    trips = round_trips(_ROUND_TRIPS_S)

    for hz in RATES_HZ[1:]:
        say(f"SYNC at {hz} Hz, {_RATE_S:g} s ...")
        settings = (f"loop.tick_hz={max(hz, _TICK_HZ)}", f"bus.sync_period_s={1 / hz!r}")
        with wall.held(_RATE_S, "none", settings, measurement=_client_as("listen")) as measured:
            rates.append(_timing(hz, _RATE_S, measured))

    say(f"Modbus requests, {_RATE_S:g} s ...")
    modbus = modbus_requests(_RATE_S)
    return {
        "tpdo_to_valve": valve,
        "round_trip": trips,
        "sync": rates,
        "modbus": modbus,
        "targets": _targets(valve, trips, modbus),
        "notes": [
            "the hub carries every frame: above the bit rate its load exceeds 100 %, which is "
            "impossible on a wire",
            f"the client requests SCHED_FIFO {client.PRIORITY}, as a unit with its own controller",
        ],
    }


def _targets(valve: Result, trips: Result, modbus: Result) -> list[Result]:
    # at the latest, the magnets act one SYNC period and one tick after the TPDO; the lateness of
    # the tick is left out, because the benchmark `loop` judges it
    limit_ms = 1000.0 / RATES_HZ[0] + 1000.0 / _TICK_HZ
    worst_us = valve["from_tpdo_less_lateness_us"].get("max")
    return [
        target(
            "speed TPDO to valve effect, the longest, less the tick's lateness",
            None if worst_us is None else worst_us / 1000.0,
            limit_ms,
            "ms",
        ),
        target("SDO round trip over the hub's echo, p50", trips["ratio"], SDO_WITHIN),
        # a target is an upper limit, so the required rate is given as the time of a request
        target(
            f"a Modbus request, for {MODBUS_PER_S} per second",
            1e6 / modbus["per_s"],
            1e6 / MODBUS_PER_S,
            "us",
        ),
    ]


def to_valve(seconds: float) -> tuple[Result, Result]:
    """Run with a unit that switches all magnets at every SYNC; return `chain` and `_timing`."""
    settings = (
        f"loop.tick_hz={_TICK_HZ}",
        f"loop.record_hz={_TICK_HZ}",
        f"bus.sync_period_s={1 / RATES_HZ[0]!r}",
    )
    with wall.held(seconds, "external", settings, measurement=_client_as("unit")) as measured:
        return chain(measured.folder), _timing(RATES_HZ[0], seconds, measured)


def round_trips(seconds: float) -> Result:
    """Run with a client that measures round trips; return those of an echo and of an SDO upload."""
    with wall.held(seconds, "none", measurement=_client_as("ask")) as measured:
        trips_ns = measured.result
    echo_us = figures.quantiles(np.array(trips_ns["echo"][_JOINING_TRIPS:]) / 1000.0)
    sdo_us = figures.quantiles(np.array(trips_ns["sdo"][_JOINING_TRIPS:]) / 1000.0)
    ratio = sdo_us["p50"] / echo_us["p50"] if echo_us and sdo_us else None
    return {"echo_us": echo_us, "sdo_us": sdo_us, "ratio": ratio}


def modbus_requests(seconds: float) -> Result:
    """Run with a Modbus client; return requests per second, round trips and lateness."""

    async def measurement(parts: Parts) -> Any:
        while "modbus" not in parts.ports:
            await asyncio.sleep(0.01)
        return await wall.client("modbus", "127.0.0.1", parts.ports["modbus"], f"{seconds:g}")

    with wall.held(seconds + _MARGIN_S, "none", measurement=measurement) as measured:
        loop = measured.summary["loop"]
        return {
            "per_s": measured.result["per_s"],
            "registers": client.REGISTERS,
            "trip_us": figures.quantiles(measured.result["trips_us"]),
            "answered": measured.summary["modbus"]["requests"],
            "missed_ticks": loop["missed"],
            "lateness_us": loop["lateness_us"],
            "bus_thread_share": measured.bus_thread_share,
        }


def _client_as(role: str) -> wall.Measurement:
    """Return a measurement by a client of the run's hub, in this role."""

    async def measurement(parts: Parts) -> Any:
        host, port, bus = plugin.parse_address(parts.place)
        if role == "ask":
            _attach_echo(parts)
        return await wall.client(role, host, port, bus)

    return measurement


def _attach_echo(parts: Parts) -> None:
    """Attach a node to the hub that only answers: its round trip is that of the transport alone."""
    if not parts.hub:
        return

    def answer(frame: Frame) -> None:
        if frame.can_id == client.ECHO_CALL:
            echo.send(Frame(client.ECHO_ANSWER, frame.data))

    echo = parts.hub.attach(answer, "echo")


def _timing(hz: int, seconds: float, measured: wall.Measured) -> Result:
    """Return the time from SYNC to the last TPDO, at the hub and at the client, and the load."""
    begun_ns = measured.parts.real_time.begun_ns
    # the last cycle may be incomplete
    syncs = [client.Sync(**sync) for sync in measured.result["syncs"][:-1]]
    late_us = []
    for sync in syncs:
        joined = sync.stamp_us > syncs[0].stamp_us + _JOINING_US
        if sync.last_tpdo_ns and joined:
            late_us.append((sync.last_tpdo_ns - begun_ns) / 1000.0 - sync.stamp_us)

    frames = records.frames(measured.folder)
    sent = len(_stamps(frames, client.SYNC))
    bus = measured.summary["bus"]
    return {
        "hz": hz,
        "syncs": sent,
        "expected": round(seconds * hz),
        "last_tpdo_us": figures.quantiles(late_us),
        "last_tpdo_hub_us": figures.quantiles(bursts(frames)),
        "kept": sent >= _KEPT_SHARE * seconds * hz - 1,
        "bus_thread_share": measured.bus_thread_share,
        "dropped": bus["dropped"],
        "load_percent": bus["load_percent"],
        "missed_ticks": measured.summary["loop"]["missed"],
    }


def bursts(frames: Iterable[LoggedFrame]) -> list[int]:
    """Return the times from each SYNC to the last TPDO before the next SYNC, in us."""
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


def _stamps(frames: Iterable[LoggedFrame], can_id: int) -> np.ndarray:
    """Return the time stamps in us of all frames with an identifier."""
    return np.array([stamp for stamp, its_id, _ in frames if its_id == can_id], dtype=np.int64)


class _Switch(NamedTuple):
    """Latencies of one change of the magnets, in us, up to the tick that had it first."""

    from_sync_us: float
    from_tpdo_us: float
    from_command_us: float
    from_tpdo_less_lateness_us: float


def chain(folder: Path) -> Result:
    """Return quantiles of the latencies from SYNC, speed TPDO and magnets' frame to the tick.

    The run was recorded every tick. A row holds the state after the tick that was scheduled at the
    row's time, and the lateness of the tick before; so the tick began at the row's time plus the
    lateness in the row before.
    """
    switches, syncs = _switches(folder)
    latencies = {
        name: figures.quantiles([getattr(switch, name) for switch in switches])
        for name in _Switch._fields
    }
    return {"switches": len(switches), "syncs": syncs, **latencies}


def _switches(folder: Path) -> tuple[list[_Switch], int]:
    """Return each change of the first wheelset's magnets that a frame caused, and the SYNCs."""
    frames = records.frames(folder)
    run = records.load(folder)
    time_us = 1e6 * run.column("time_s")
    began_us = time_us + np.concatenate(([0.0], run.column("tick_lateness_us")[:-1]))
    leading_pair = run.column("magnets_1")

    sync_us = _stamps(frames, client.SYNC)
    speed_us = _stamps(frames, client.SPEEDS)
    commands = [
        (stamp, magnets.unpack(int(data, 16))[0])
        for stamp, can_id, data in frames
        if can_id == client.MAGNETS and data
    ]
    command_us = np.array([stamp for stamp, _ in commands])

    switches = []
    for row in np.flatnonzero(np.diff(leading_pair)) + 1:
        # the newest command when the tick began, then the speeds before it, then their SYNC
        command = int(np.searchsorted(command_us, began_us[row], side="right")) - 1
        if command < 0 or commands[command][1] != leading_pair[row]:
            continue  # at the end the magnets fall to the fail-safe value without a frame
        speed = int(np.searchsorted(speed_us, command_us[command])) - 1
        sync = int(np.searchsorted(sync_us, speed_us[speed], side="right")) - 1
        if speed < 0 or sync < 0:
            continue
        switches.append(
            _Switch(
                from_sync_us=began_us[row] - sync_us[sync],
                from_tpdo_us=began_us[row] - speed_us[speed],
                from_command_us=began_us[row] - command_us[command],
                from_tpdo_less_lateness_us=time_us[row] - speed_us[speed],
            )
        )
    return switches, len(sync_us)


def table(result: Result) -> Table:
    """Return all latencies in us, then those of each rate."""
    valve = result["tpdo_to_valve"]
    trips = result["round_trip"]
    modbus = result["modbus"]
    rows = [
        _row("SYNC to valve effect", valve["from_sync_us"], valve["switches"]),
        _row("speed TPDO to valve effect", valve["from_tpdo_us"], valve["switches"]),
        _row("the same less the tick's lateness", valve["from_tpdo_less_lateness_us"]),
        _row("magnets' frame to valve effect", valve["from_command_us"], valve["switches"]),
        _row("round trip of a frame (echo)", trips["echo_us"]),
        _row("round trip of an SDO upload", trips["sdo_us"]),
        _row(
            "round trip of a Modbus request",
            modbus["trip_us"],
            f"{modbus['per_s']:.0f} per second",
        ),
    ]
    for rate in result["sync"]:
        title = f"SYNC to last TPDO at the hub, {rate['hz']} Hz"
        rows.append(_row(title, rate["last_tpdo_hub_us"]))
    for rate in result["sync"]:
        title = f"SYNC to last TPDO at a client, {rate['hz']} Hz"
        kept = "" if rate["kept"] else " NOT KEPT"
        note = (
            f"{rate['syncs']} of {rate['expected']}{kept}, "
            f"bus thread {100 * rate['bus_thread_share']:.0f} %, {rate['dropped']} dropped, "
            f"bus load {rate['load_percent']:.0f} %"
        )
        rows.append(_row(title, rate["last_tpdo_us"], note))
    return figures.table("the bus, in us", ("", *figures.QUANTILES, "SYNCs"), rows)


def _row(title: str, quantiles: dict[str, float], note: object = "") -> Sequence[object]:
    return (title, *(quantiles.get(name) for name in figures.QUANTILES), note)
