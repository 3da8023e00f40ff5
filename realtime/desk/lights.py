"""The state line: how each part of a bench is, green, yellow or red, with the reason in words; grey is not known."""

import shutil
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim.modbus.map import UNHEARD, State
from rollerrig.realtime.desk.doors import Doors
from rollerrig.realtime.desk.reader import COLUMNS, Bench
from rollerrig.realtime.loop import ring
from rollerrig.wsp_interface.signals import BRAKE_NODE, DRIVE_NODES, SPEED_NODE, WSP_NODE

GREEN, YELLOW, RED, GREY = "green", "yellow", "red", "grey"
NAMES = ("loop", "bus", "unit", "drives", "brake I/O", "Modbus", "recorder", "disk")
_LATE_US, _FULL_PERCENT = 500.0, 80.0  # assumption: half a tick; a bus is planned to less than this
_SILENT_S, _LITTLE_MB = 3.0, 1000.0
_MISSED, _LATENESS = COLUMNS.index("ticks_missed"), COLUMNS.index("tick_lateness_us")
_OPERATIONAL, _STATES = 5, {0: "booted", 4: "stopped", 5: "operational", 127: "pre-operational"}


class Light(NamedTuple):
    """One part: its colour and why."""

    name: str
    colour: str
    why: str


def line(bench: Bench | None, doors: Doors | None, folder: Path) -> list[Light]:
    """All lights, in the order of NAMES."""
    if bench is None or doors is None:
        return [*(Light(name, GREY, "no bench runs here") for name in NAMES[:-1]), _disk(folder)]
    if bench.ended:
        why = (
            "the run has ended"
            if bench.ended == "closed"
            else f"the bench (process {bench.pid}) was killed; its recorder keeps what there was"
        )
        colour = GREY if bench.ended == "closed" else RED
        return [*(Light(name, colour, why) for name in NAMES[:-1]), _disk(folder)]
    known = doors.values
    return [
        _loop(bench, doors),
        _bus(bench, known),
        _unit(bench, known),
        _nodes("drives", DRIVE_NODES, known, doors),
        _nodes("brake I/O", (SPEED_NODE, BRAKE_NODE), known, doors),
        _modbus(bench, doors),
        _recorder(bench),
        _disk(folder),
    ]


def _loop(bench: Bench, doors: Doors) -> Light:
    if doors.state in (State.HELD, State.STARTING) or not bench.points:
        held = doors.state is State.HELD
        return Light(
            "loop", GREEN if held else GREY, "held, and rolls" if held else "the run has not begun"
        )
    silent_s = time.monotonic() - bench.heard_s
    if silent_s > _SILENT_S:
        return Light("loop", RED, f"no sample for {silent_s:.0f} s")
    minute = np.array(bench.since(0))
    missed = float(np.ptp(minute[:, _MISSED]))
    worst = float(minute[-100:, _LATENESS].max())
    if missed > 0.0:
        return Light(
            "loop", YELLOW, f"{missed:.0f} ticks missed in the last minute, latest {worst:.0f} us"
        )
    return Light(
        "loop", YELLOW if worst > _LATE_US else GREEN, f"no tick missed, latest {worst:.0f} us"
    )


def _bus(bench: Bench, known: dict[str, float]) -> Light:
    if not bench.bus:
        return Light("bus", GREY, "this run has none, or has not opened it yet")
    if not known:
        return Light("bus", GREY, f"{bench.bus}; its load is told over Modbus alone")
    load, dropped = known["bus_load"], known["bus_frames_dropped"]
    why = f"load {load:.1f} %" + (
        f", {dropped:.0f} frames dropped for a slow client" if dropped else ""
    )
    return Light("bus", YELLOW if dropped or load > _FULL_PERCENT else GREEN, why)


def _unit(bench: Bench, known: dict[str, float]) -> Light:
    name = f"node {WSP_NODE}"
    if bench.unit_lost:
        return Light("unit", RED, f"{name} lost: no heartbeat")
    if "wsp_unit_state" not in known:
        return Light("unit", GREY, f"{name}: its state is told over Modbus alone")
    state = int(known["wsp_unit_state"])
    if state == UNHEARD:
        return Light("unit", GREY, f"{name} has not been heard (--wsp none?)")
    return Light(
        "unit",
        GREEN if state == _OPERATIONAL else YELLOW,
        f"{name} is {_STATES.get(state, state)}, beats",
    )


def _nodes(name: str, nodes: tuple[int, ...], known: dict[str, float], doors: Doors) -> Light:
    if not known:
        return Light(name, GREY, f"no Modbus: {doors.why}")
    wrong = {
        node: int(known[f"node_{node}_state"])
        for node in nodes
        if known[f"node_{node}_state"] != _OPERATIONAL
    }
    if known["emergency_stop"] and name == "drives":
        return Light(name, RED, "emergency stop: quick stop, then switched off")
    if not wrong:
        return Light(name, GREEN, f"nodes {', '.join(map(str, nodes))} operational")
    why = ", ".join(
        f"node {node} {_STATES.get(state, 'not heard')}" for node, state in wrong.items()
    )
    return Light(name, RED if UNHEARD in wrong.values() else YELLOW, why)


def _modbus(bench: Bench, doors: Doors) -> Light:
    if not doors.why:
        return Light(
            "Modbus",
            GREEN,
            f"{bench.modbus[0]}:{bench.modbus[1]}, {doors.values['modbus_clients']:.0f} clients",
        )
    return Light("Modbus", RED if "answer" in doors.why else GREY, doors.why)


def _recorder(bench: Bench) -> Light:
    header = bench.rows.header
    if not header[ring.RECORDER_BEAT_NS]:
        return Light("recorder", GREY, "not ready yet")
    silent_s = (time.monotonic_ns() - int(header[ring.RECORDER_BEAT_NS])) / 1e9
    if lost := int(header[ring.LOST]):
        return Light("recorder", RED, f"{lost} samples lost")
    if silent_s > _SILENT_S:
        return Light(
            "recorder", RED, f"silent for {silent_s:.0f} s: it has ended, or its disk is slow"
        )
    return Light("recorder", GREEN, f"{int(header[ring.READ]):,} samples".replace(",", " "))


def _disk(folder: Path) -> Light:
    try:
        free_MB = shutil.disk_usage(folder).free / 1e6
    except OSError as error:
        return Light("disk", RED, f"{folder}: {error.strerror}")
    colour = RED if free_MB < 0.1 * _LITTLE_MB else YELLOW if free_MB < _LITTLE_MB else GREEN
    return Light("disk", colour, f"{free_MB / 1e3:.1f} GB free")
