"""What the frames of a run in lockstep tell of faults that change its motion over the bus: can.log alone, no event.

[B1] who sends frames that are destroyed, or destroys those of others, says by EMCY that it is error passive
[B2] a node that falls silent is off; it boots when it is back, or says that its controller was off
[B3] a drive says by EMCY why it has tripped
[B4] a synchronous frame comes once after each SYNC; one that comes late is missed once, one that is lost ever again
"""

from collections.abc import Iterator

import numpy as np

from rollerrig.firmware_sim.drive402.drive import OVER_TEMPERATURE, UNDER_VOLTAGE
from rollerrig.firmware_sim.faults.confinement import ERROR_PASSIVE, RECOVERED
from rollerrig.realtime.record import records
from rollerrig.wsp_interface.bus.connection_set import EMERGENCY, HEARTBEAT, SYNC, TPDO
from rollerrig.wsp_interface.bus.frames import ERROR_FLAG
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID
from rollerrig.wsp_interface.signals import BRAKE_NODE, DRIVE_NODES, RIG_NODES, SPEED_NODE, WSP_NODE

# chosen: a node is back from bus-off within 0.1 s; the last cycle of a stop may be cut off
SILENT_US, FEW, BOOTS, SENT = 300_000, 2, "00", 0x80
# what comes after each SYNC; the unit answers what it hears
_SYNCHRONOUS = (
    *(base + node for base in TPDO[:2] for node in DRIVE_NODES),
    *(base + SPEED_NODE for base in TPDO[:3]),
    TPDO[0] + BRAKE_NODE,
    MAGNETS_ID,
)


def of(run: records.Run) -> list[str]:
    """The faults that the bus shows, by the first law that is broken; none where no bus was recorded."""
    frames = records.frames(run.folder)
    return list(dict.fromkeys(_signs(*map(np.array, zip(*frames, strict=True))))) if frames else []


def _signs(at_us: np.ndarray, ids: np.ndarray, data: np.ndarray) -> Iterator[str]:
    codes = [
        (node, int(one[2:4] + one[:2], 16))
        for node in RIG_NODES
        for one in data[ids == EMERGENCY + node]
    ]
    if errors := [int(one[4:6], 16) & SENT for one in data[ids >= ERROR_FLAG]]:  # [B1]
        kind = "error_frame" if any(errors) else "receive_error"
        yield from (f"{kind} node={node}" for node, code in codes if code == ERROR_PASSIVE)
        return
    silent = False
    for node in (*RIG_NODES, WSP_NODE):  # [B2]
        own = np.isin(ids, [HEARTBEAT + node, *(base + node for base in TPDO)]) & (data != BOOTS)
        if np.diff(at_us[own], prepend=0, append=at_us[-1]).max() > SILENT_US:
            silent, boots = True, np.sum(data[ids == HEARTBEAT + node] == BOOTS) > 1
            why = (
                "node_off"
                if boots
                else "bus_off"
                if (node, RECOVERED) in codes
                else "node_off or bus_off"
            )
            yield "wsp_frozen" if node == WSP_NODE else f"{why} node={node}"
    trips = [(node, code) for node, code in codes if node in DRIVE_NODES and 0 < code < 0x8000]
    dip = {(node, UNDER_VOLTAGE) for node in DRIVE_NODES} <= set(trips)
    for node, code in trips if not silent else ():  # [B3]
        hot = code == OVER_TEMPERATURE
        yield "power_dip" if dip else f"drive_{'over_temperature' if hot else 'trip'} axle={node}"
    sync = at_us[ids == SYNC]
    for one in _SYNCHRONOUS if not silent and not trips else ():  # [B4]
        cycles = np.searchsorted(sync, at_us[ids == one], "right") - 1
        missed = np.setdiff1d(np.arange(sync.size), cycles)
        if missed.size > FEW:
            once = cycles.size and (np.diff(missed) == 1).all()
            yield f"{'frame_delayed' if once else 'frame_lost'} can_id={one:#x}"
            return
