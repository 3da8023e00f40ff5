"""Finds faults in the frames of a run in lockstep, from can.log alone; no event is read.

[B1] a node whose frames are destroyed, or that destroys frames, reports by EMCY that it is error
     passive
[B2] a silent node is off; after its return it boots, or it reports that its controller was bus-off
[B3] a drive reports by EMCY why it has tripped
[B4] a synchronous frame comes once after each SYNC; a delayed frame is missing in one stretch of
     cycles, a lost frame again and again
"""

from typing import NamedTuple

import numpy as np

from rollerrig.firmware_sim.drive402.drive import OVER_TEMPERATURE, UNDER_VOLTAGE
from rollerrig.firmware_sim.faults.confinement import ERROR_PASSIVE, RECOVERED
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, HEARTBEAT, SYNC, TPDO
from rollerrig.wsp_interface.bus.frames import ERROR_FLAG
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID
from rollerrig.wsp_interface.signals import BRAKE_NODE, SPEED_NODE, WSP_NODE, Table

# a longer silence means that a node is off: it is back from bus-off within 0.1 s (chosen)
SILENT_US = 300_000
# so many cycles may lack a frame: the end of a stop may cut off the last cycle (chosen)
MOST_CYCLES_MISSED = 2
# data of the boot-up message, as can.log has it
BOOT_UP_DATA = "00"
# bit in the third byte of an error frame: the error happened while a node sent
SENDER_BIT = 0x80
# EMCY codes from here on are not trips of a drive
FIRST_CODE_BEYOND_TRIPS = 0x8000


class _Frames(NamedTuple):
    """All frames of a run, shape (frames,) each."""

    at_us: np.ndarray
    ids: np.ndarray
    data: np.ndarray  # as hexadecimal digits


class _Emergency(NamedTuple):
    """The sender and the error code of an EMCY message."""

    node: int
    code: int


def of(run: records.Run) -> list[str]:
    """Return the faults that the bus shows, by the first law that is broken.

    Empty if no bus was recorded.
    """
    recorded = records.frames(run.folder)
    if not recorded:
        return []
    at_us, ids, data = zip(*recorded, strict=True)
    frames = _Frames(np.array(at_us), np.array(ids), np.array(data))
    # several frames may show the same fault
    return list(dict.fromkeys(_faults(frames, run.signal_table)))


def _faults(frames: _Frames, table: Table) -> list[str]:
    """Return the faults by the first broken law: a fault also breaks the laws behind it.

    `table` has the nodes of the vehicle.
    """
    emergencies = _emergencies(frames, table)
    error_frames = frames.data[frames.ids >= ERROR_FLAG]
    if error_frames.size:
        return _error_passive_nodes(error_frames, emergencies)
    silent = _silent_nodes(frames, emergencies, table)
    if silent:
        return silent
    trips = [
        emergency
        for emergency in emergencies
        if emergency.node in table.drive_nodes and 0 < emergency.code < FIRST_CODE_BEYOND_TRIPS
    ]
    if trips:
        return _drive_faults(trips, table)
    return _missing_frames(frames, table)


def _synchronous_ids(table: Table) -> tuple[int, ...]:
    """Return the frames that follow each SYNC.

    Those of the WSP unit are left out: it answers what it receives, so they also depend on other
    nodes.
    """
    return (
        *(base + node for base in TPDO[:2] for node in table.drive_nodes),
        *(base + SPEED_NODE for base in TPDO[:3]),
        TPDO[0] + BRAKE_NODE,
        MAGNETS_ID,
    )


def _emergencies(frames: _Frames, table: Table) -> list[_Emergency]:
    """Return the EMCY messages, sorted by node and then by time."""
    found = []
    for node in table.rig_nodes:
        for data in frames.data[frames.ids == EMERGENCY + node]:
            # the code is in the first two bytes, low byte first
            code = int(data[2:4] + data[:2], 16)
            found.append(_Emergency(node, code))
    return found


def _error_passive_nodes(error_frames: np.ndarray, emergencies: list[_Emergency]) -> list[str]:
    """Return a fault for each node that became error passive [B1]."""
    sender_erred = any(int(data[4:6], 16) & SENDER_BIT for data in error_frames)
    kind = "error_frame" if sender_erred else "receive_error"
    return [
        f"{kind} node={emergency.node}"
        for emergency in emergencies
        if emergency.code == ERROR_PASSIVE
    ]


def _silent_nodes(frames: _Frames, emergencies: list[_Emergency], table: Table) -> list[str]:
    """Return a fault for each node that was silent for too long [B2]."""
    found = []
    for node in (*table.rig_nodes, WSP_NODE):
        from_node = np.isin(frames.ids, [HEARTBEAT + node, *(base + node for base in TPDO)])
        # a boot-up message does not end the silence
        alive_us = frames.at_us[from_node & (frames.data != BOOT_UP_DATA)]
        silences_us = np.diff(alive_us, prepend=0, append=frames.at_us[-1])
        if silences_us.max() <= SILENT_US:
            continue
        if node == WSP_NODE:
            found.append("wsp_frozen")
            continue
        # every node boots once at the start
        boots = np.sum(frames.data[frames.ids == HEARTBEAT + node] == BOOT_UP_DATA)
        if boots > 1:
            reason = "node_off"
        elif (node, RECOVERED) in emergencies:
            reason = "bus_off"
        else:
            reason = "node_off or bus_off"
        found.append(f"{reason} node={node}")
    return found


def _drive_faults(trips: list[_Emergency], table: Table) -> list[str]:
    """Return the faults that made drives trip [B3]."""
    # a power dip reaches all drives
    if all((node, UNDER_VOLTAGE) in trips for node in table.drive_nodes):
        return ["power_dip"]
    found = []
    for node, code in trips:
        kind = "drive_over_temperature" if code == OVER_TEMPERATURE else "drive_trip"
        found.append(f"{kind} axle={node}")
    return found


def _missing_frames(frames: _Frames, table: Table) -> list[str]:
    """Return the fault of the first synchronous frame that is missing in too many cycles [B4]."""
    sync_us = frames.at_us[frames.ids == SYNC]
    for can_id in _synchronous_ids(table):
        cycles = np.searchsorted(sync_us, frames.at_us[frames.ids == can_id], "right") - 1
        missed = np.setdiff1d(np.arange(sync_us.size), cycles)
        if missed.size <= MOST_CYCLES_MISSED:
            continue
        # a delayed frame is missing in one stretch of cycles, a lost one again and again
        in_a_row = cycles.size and (np.diff(missed) == 1).all()
        kind = "frame_delayed" if in_a_row else "frame_lost"
        return [f"{kind} can_id={can_id:#x}"]
    return []
