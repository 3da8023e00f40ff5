"""One lockstep run with every fault of the catalogue in turn, and a scripted WSP unit on its bus.

The unit answers each SYNC with magnets by its script, so that dead magnets have something to
refuse.
"""

import asyncio
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rollerrig.realtime.bench import bench, options, scenario
from rollerrig.realtime.record import records, run_folder
from rollerrig.wsp_interface.bus.frames import Frame

NODE_UNIT, SYNC, ANSWER = 0x720, 0x080, 0x211
HOLD_ALL, VENT_ALL = 0x55, 0xFF
HEARTBEAT_SYNCS = 5

# kind, begin, end, parameters; axles are chosen so that an untouched one is beside each
PLAN = (
    ("speed_sensor_stuck", 0.5, 1.0, {"axle": 1}),
    ("speed_sensor_dropout", 0.5, 1.0, {"axle": 2}),
    ("missing_tooth", 0.5, 1.0, {"axle": 3, "teeth": 2}),
    ("speed_noise_burst", 0.5, 1.0, {"axle": 4, "std_rad_s": 5.0}),
    ("swapped_axles", 1.1, 1.3, {"axle": 1, "other": 2}),
    ("wheel_diameter_mismatch", 1.1, 1.3, {"axle": 3, "difference_percent": 5.0}),
    ("hold_magnet_stuck", 1.4, 2.0, {"axle": 1}),
    ("vent_magnet_stuck", 1.4, 2.0, {"axle": 2}),
    ("hold_magnet_dead", 2.0, 2.8, {"axle": 3}),
    ("vent_magnet_dead", 2.0, 2.8, {"axle": 4}),
    ("cylinder_leak", 3.0, 3.6, {"axle": 1, "time_constant_s": 0.5}),
    ("torque_ripple", 3.0, 3.6, {"axle": 2, "amplitude_Nm": 3000.0, "order": 2.0}),
    ("drive_trip", 3.8, 4.2, {"axle": 1, "code": 0x5112}),
    ("drive_over_temperature", 3.8, 4.2, {"axle": 2, "load": 1.25}),
    ("power_dip", 4.4, 4.7, {"dc_link_V": 300.0}),
    ("node_off", 4.9, 5.2, {"node": 16}),
    ("node_babbling", 5.3, 5.5, {"node": 3, "can_id": 0x07F, "rate_Hz": 2000.0}),
    ("frame_lost", 5.6, 5.8, {"can_id": 0x191, "every": 2}),
    ("frame_delayed", 5.9, 6.2, {"can_id": 0x190, "delay_s": 0.05}),
    ("frame_duplicated", 6.3, 6.5, {"can_id": 0x191, "every": 1}),
    ("error_frame", 6.6, 6.8, {"node": 17, "attempts": 2}),
    ("bus_off", 6.9, 7.2, {"node": 4}),
    ("heartbeat_late", 7.3, 7.8, {"node": 17, "delay_s": 0.6}),
    ("wsp_frozen", 8.0, 8.4, {}),
    ("receive_error", 9.0, 9.4, {"node": 16, "attempts": 1}),
    ("sander_blocked", 1.0, 2.0, {"axle": 1}),
    ("sander_wrong_orifice", 3.0, 4.0, {"axle": 1, "factor": 0.3}),
    ("sander_late", 5.0, 6.0, {"axle": 2, "delay_s": 3.0}),
    ("sander_empty", 7.0, 8.0, {"axle": 2}),
)
# what the unit asks of the magnets
SCRIPT = ((2.1, 2.4, HOLD_ALL), (2.4, 2.7, VENT_ALL))
BY_HAND = (8.6, 8.7, {"name": "speed_sensor_dropout", "axle": 4})
END_S = 9.9


@dataclass
class Recorded:
    """What a run has left. `frames`: (time_s, identifier, data), error frames as in candump."""

    run: records.Run

    @cached_property
    def frames(self):
        lines = (self.run.folder / run_folder.CAN_LOG).read_text().splitlines()
        found = []
        for line in lines:
            time, _, body = line.split()
            can_id, data = body.split("#")
            found.append((float(time.strip("()")), int(can_id, 16), bytes.fromhex(data)))
        return found

    def channel(self, name, from_s, to_s):
        """Samples of a channel whose time is within an interval, shape (n,)."""
        time = self.run.column("time_s")
        return self.run.column(name)[(time >= from_s) & (time < to_s)]

    def on_bus(self, can_id, from_s, to_s):
        """Data of an identifier's frames within an interval."""
        return [data for time, one, data in self.frames if one == can_id and from_s <= time < to_s]

    def reported(self, code, **fields):
        """The times of the events of a code with these fields."""
        return [
            event.time_s
            for event in self.run.events
            if event.code == code and fields.items() <= event.fields.items()
        ]


class ScriptedUnit:
    """A WSP unit on a port of the bench's hub, which also injects and clears by hand."""

    def __init__(self, rig):
        self.rig, self.syncs, self.state = rig, 0, 0

    async def join(self):
        while self.rig.bus is None:
            await asyncio.sleep(0.01)
        self.port = self.rig.hub.attach(self.take, "unit")
        for state in (0, 5):
            self.port.send(Frame(NODE_UNIT, bytes([state])))

    def take(self, frame):
        if frame.can_id != SYNC:
            return
        time_s = frame.time_ns / 1e9
        self.by_hand(time_s)
        self.syncs += 1
        if self.syncs % HEARTBEAT_SYNCS == 0:
            self.port.send(Frame(NODE_UNIT, b"\x05"))
        magnets = next((what for begin, end, what in SCRIPT if begin <= time_s < end), 0)
        self.port.send(Frame(ANSWER, bytes([magnets])))

    def by_hand(self, time_s):
        begin, end, values = BY_HAND
        if self.state == 0 and time_s >= begin:
            self.state = 1
            self.rig.faults.inject(**values)
        elif self.state == 1 and time_s >= end:
            self.state = 2
            self.rig.faults.clear(**values)


def scenario_file(folder: Path) -> Path:
    """The scenario as a file."""
    lines = [
        'title = "every fault in turn"',
        'adhesion = "dry"',
        "initial_speed_m_s = 30.0",
        f"duration_max_s = {END_S}",
        "[sanders]",
        "axle = 1",
        "second_axle = 2",
        "from_s = 0.0",
        "[bus]",
        'interface = "hub"',
        "socketcand_port = 0",
        "[[demand]]",
        "from_s = 0.0",
        "pressure_Pa = 3.8e5",
    ]
    for kind, begin, end, values in PLAN:
        lines += ["[[fault]]", f'kind = "{kind}"', f"at_s = {begin}", f"for_s = {end - begin:.6f}"]
        lines += [f"{name} = {value}" for name, value in values.items()]
    path = folder / "faults.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def run(folder: Path) -> Recorded:
    """Run it in lockstep and load the record."""
    plan = scenario.load(str(scenario_file(folder)))
    out = folder / "run"

    async def both():
        rig = bench.Bench(plan, options.Options("lockstep", "external", out), lambda progress: None)
        unit = asyncio.ensure_future(ScriptedUnit(rig.parts).join())
        try:
            await rig.run()
        finally:
            unit.cancel()

    asyncio.run(both())
    return Recorded(records.load(out))


def samples(recorded: Recorded, name: str, from_s: float, to_s: float) -> np.ndarray:
    """The four axles' samples of a signal within an interval, shape (4, n)."""
    stem, unit = name.split(":")
    return np.array(
        [recorded.channel(f"{stem}_{axle}{unit}", from_s, to_s) for axle in (1, 2, 3, 4)]
    )
