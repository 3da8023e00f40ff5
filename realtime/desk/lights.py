"""The state line: the condition of each part of a bench as a light, with the reason in words.

Green is good, yellow needs attention, red is a failure, grey is not known.
"""

import shutil
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim.modbus.map import UNHEARD, State
from rollerrig.realtime.desk.doors import Doors
from rollerrig.realtime.desk.reader import Bench
from rollerrig.realtime.loop import ring
from rollerrig.wsp_interface.signals import BRAKE_NODE, SPEED_NODE, WSP_NODE

GREEN, YELLOW, RED, GREY = "green", "yellow", "red", "grey"
NAMES = ("loop", "bus", "unit", "drives", "brake I/O", "Modbus", "recorder", "disk")

_LATE_US = 500.0  # assumption: half a tick
_FULL_PERCENT = 80.0  # assumption: a bus is planned with less load than this
_SILENT_S = 3.0
_LITTLE_SPACE_MB = 1000.0
_RECENT_SAMPLES = 100  # over which the latest tick is looked for

# NMT states as a heartbeat has them (CiA 301)
_OPERATIONAL = 5
_STATES = {0: "booted", 4: "stopped", 5: "operational", 127: "pre-operational"}


class Light(NamedTuple):
    """One part of the bench: its name, its colour, and the reason."""

    name: str
    colour: str
    why: str


def line(bench: Bench | None, doors: Doors | None, folder: Path) -> list[Light]:
    """All lights in the order of NAMES; `folder` is where runs are recorded."""
    if bench is None or doors is None:
        return _all_but_disk(GREY, "no bench runs here", folder)
    if bench.ended == "closed":
        return _all_but_disk(GREY, "the run has ended", folder)
    if bench.ended:
        why = f"the bench (process {bench.pid}) was killed; its recorder keeps the data so far"
        return _all_but_disk(RED, why, folder)

    registers = doors.values
    return [
        _loop(bench, doors),
        _bus(bench, registers),
        _unit(bench, registers),
        _drives(bench, registers, doors),
        _nodes("brake I/O", _speed_and_brake_nodes(bench), registers, doors),
        _modbus(bench, doors),
        _recorder(bench),
        _disk(folder),
    ]


def _all_but_disk(colour: str, why: str, folder: Path) -> list[Light]:
    """The same light for all parts of the bench, and that of the disk."""
    lights = [Light(name, colour, why) for name in NAMES[:-1]]
    return [*lights, _disk(folder)]


def _loop(bench: Bench, doors: Doors) -> Light:
    if doors.state is State.HELD:
        return Light("loop", GREEN, "held, and rolls")
    if doors.state is State.STARTING or not bench.points:
        return Light("loop", GREY, "the run has not begun")

    silent_s = time.monotonic() - bench.heard_s
    if silent_s > _SILENT_S:
        return Light("loop", RED, f"no sample for {silent_s:.0f} s")

    last_minute = np.array(bench.since(0))
    names = bench.columns.names
    missed = float(np.ptp(last_minute[:, names.index("ticks_missed")]))
    lateness_us = last_minute[-_RECENT_SAMPLES:, names.index("tick_lateness_us")]
    latest_us = float(lateness_us.max())
    if missed > 0.0:
        why = f"{missed:.0f} deadlines missed in the last minute, latest cycle {latest_us:.0f} us"
        return Light("loop", YELLOW, why)
    colour = YELLOW if latest_us > _LATE_US else GREEN
    return Light("loop", colour, f"no deadline missed, latest cycle {latest_us:.0f} us")


def _bus(bench: Bench, registers: dict[str, float]) -> Light:
    if not bench.bus:
        return Light("bus", GREY, "this run has none, or has not opened it yet")
    if not registers:
        return Light("bus", GREY, f"{bench.bus}; only Modbus reports its load")
    load_percent = registers["bus_load"]
    dropped = registers["bus_frames_dropped"]
    why = f"load {load_percent:.1f} %"
    if dropped:
        why += f", {dropped:.0f} frames dropped for a slow client"
    colour = YELLOW if dropped or load_percent > _FULL_PERCENT else GREEN
    return Light("bus", colour, why)


def _unit(bench: Bench, registers: dict[str, float]) -> Light:
    name = f"node {WSP_NODE}"
    if bench.unit_lost:
        return Light("unit", RED, f"{name} lost: no heartbeat")
    if bench.unit_silent:
        return Light("unit", RED, f"{name} silent: heartbeat, but no command of the valves")
    if "wsp_unit_state" not in registers:
        return Light("unit", GREY, f"{name}: only Modbus reports its state")
    state = int(registers["wsp_unit_state"])
    if state == UNHEARD:
        return Light("unit", GREY, f"{name} has not been heard (--wsp none?)")
    colour = GREEN if state == _OPERATIONAL else YELLOW
    return Light("unit", colour, f"{name} is {_STATES.get(state, state)}, beats")


def _speed_and_brake_nodes(bench: Bench) -> tuple[int, ...]:
    """The nodes of the speed units and of the brake I/O of all groups of axles."""
    return (*bench.table.nodes(SPEED_NODE), *bench.table.nodes(BRAKE_NODE))


def _drives(bench: Bench, registers: dict[str, float], doors: Doors) -> Light:
    if registers and registers["emergency_stop"]:
        return Light("drives", RED, "emergency stop: quick stop, then switched off")
    return _nodes("drives", bench.table.drive_nodes, registers, doors)


def _nodes(name: str, numbers: tuple[int, ...], registers: dict[str, float], doors: Doors) -> Light:
    """One light for some nodes of the rig, by their NMT states."""
    if not registers:
        return Light(name, GREY, f"no Modbus: {doors.no_modbus_because}")
    states = {node: int(registers[f"node_{node}_state"]) for node in numbers}
    wrong = {node: state for node, state in states.items() if state != _OPERATIONAL}
    if not wrong:
        return Light(name, GREEN, f"nodes {', '.join(map(str, numbers))} operational")
    why = ", ".join(
        f"node {node} {_STATES.get(state, 'not heard')}" for node, state in wrong.items()
    )
    colour = RED if UNHEARD in wrong.values() else YELLOW
    return Light(name, colour, why)


def _modbus(bench: Bench, doors: Doors) -> Light:
    if not doors.no_modbus_because:
        host, port = bench.modbus
        clients = doors.values["modbus_clients"]
        return Light("Modbus", GREEN, f"{host}:{port}, {clients:.0f} clients")
    colour = RED if doors.unanswered else GREY
    return Light("Modbus", colour, doors.no_modbus_because)


def _recorder(bench: Bench) -> Light:
    header = bench.rows.header
    beat_ns = int(header[ring.RECORDER_BEAT_NS])
    if not beat_ns:
        return Light("recorder", GREY, "not ready yet")
    lost = int(header[ring.LOST])
    if lost:
        return Light("recorder", RED, f"{lost} samples lost")
    silent_s = (time.monotonic_ns() - beat_ns) / 1e9
    if silent_s > _SILENT_S:
        why = f"silent for {silent_s:.0f} s: it has ended, or its disk is slow"
        return Light("recorder", RED, why)
    samples = f"{int(header[ring.READ]):,}".replace(",", " ")
    return Light("recorder", GREEN, f"{samples} samples")


def _disk(folder: Path) -> Light:
    try:
        free_MB = shutil.disk_usage(folder).free / 1e6
    except OSError as error:
        return Light("disk", RED, f"{folder}: {error.strerror}")
    if free_MB < 0.1 * _LITTLE_SPACE_MB:
        colour = RED
    elif free_MB < _LITTLE_SPACE_MB:
        colour = YELLOW
    else:
        colour = GREEN
    return Light("disk", colour, f"{free_MB / 1e3:.1f} GB free")
