"""Run one lockstep run with every fault of the catalogue and a scripted WSP unit on its bus.

The unit answers each SYNC with the magnets of its script. The script commands hold and vent while
magnets are dead, because a dead magnet shows only when it is commanded.
"""

import asyncio
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from rollerrig.realtime.bench import bench, options, scenario
from rollerrig.realtime.record import records, run_folder
from rollerrig.wsp_interface.bus.frames import Frame

# identifiers on the bus
HEARTBEAT = 0x720  # of the WSP unit
SYNC = 0x080
ANSWER = 0x211  # the magnets that the WSP unit commands

# states in a heartbeat
BOOT_UP = 0
OPERATIONAL = 5
# the unit sends a heartbeat after this number of SYNCs
HEARTBEAT_SYNCS = 5

# magnets of all four axles, two bits an axle
FILL_ALL = 0x00
HOLD_ALL = 0x55
VENT_ALL = 0xFF

# (kind, begin in s, end in s, parameters). At any time another axle is free of this fault, for
# comparison.
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
    ("speed_sensor_drift", 7.3, 7.8, {"axle": 4, "step_percent": -10.0, "rate_percent_s": 4.0}),
    ("heartbeat_late", 7.3, 7.8, {"node": 17, "delay_s": 0.6}),
    ("wsp_frozen", 8.0, 8.4, {}),
    ("receive_error", 9.0, 9.4, {"node": 16, "attempts": 1}),
    ("sander_blocked", 1.0, 2.0, {"axle": 1}),
    ("sander_wrong_orifice", 3.0, 4.0, {"axle": 1, "factor": 0.3}),
    ("sander_late", 5.0, 6.0, {"axle": 2, "delay_s": 3.0}),
    ("sander_empty", 7.0, 8.0, {"axle": 2}),
)
# (begin in s, end in s, magnets that the unit commands); otherwise the unit commands FILL_ALL
SCRIPT = ((2.1, 2.4, HOLD_ALL), (2.4, 2.7, VENT_ALL))
# (begin in s, end in s, fault) of the fault that is injected and cleared without a plan
BY_HAND = (8.6, 8.7, {"name": "speed_sensor_dropout", "axle": 4})
# duration of the run
END_S = 9.9


@dataclass
class Recorded:
    """The record of a run, with functions that select frames, samples and events."""

    run: records.Run

    @cached_property
    def frames(self):
        """All frames as (time_s, identifier, data); an error frame's identifier is candump's."""
        lines = (self.run.folder / run_folder.CAN_LOG).read_text().splitlines()
        frames = []
        for line in lines:
            time, _, body = line.split()
            can_id, data = body.split("#")
            frames.append((float(time.strip("()")), int(can_id, 16), bytes.fromhex(data)))
        return frames

    def channel(self, name, from_s, to_s):
        """Return the samples of a channel within an interval, shape (n,)."""
        time_s = self.run.column("time_s")
        within = (time_s >= from_s) & (time_s < to_s)
        return self.run.column(name)[within]

    def on_bus(self, can_id, from_s, to_s):
        """Return the data of the frames with this identifier within an interval."""
        return [
            data
            for time_s, frame_id, data in self.frames
            if frame_id == can_id and from_s <= time_s < to_s
        ]

    def reported(self, code, **fields):
        """Return the times in s of the events that have this code and these fields."""
        return [
            event.time_s
            for event in self.run.events
            if event.code == code and fields.items() <= event.fields.items()
        ]


class ManualFault:
    """Injects the fault BY_HAND at its begin and clears it at its end, once each."""

    def __init__(self, rig):
        self.rig = rig
        self.injected = False
        self.cleared = False

    def poll(self, time_s):
        """Inject or clear the fault if its time has come."""
        begin, end, values = BY_HAND
        if not self.injected:
            if time_s >= begin:
                self.injected = True
                self.rig.faults.inject(**values)
        elif not self.cleared and time_s >= end:
            self.cleared = True
            self.rig.faults.clear(**values)


def scripted_magnets(time_s):
    """Return the magnets that the script commands at this time."""
    for begin, end, magnets in SCRIPT:
        if begin <= time_s < end:
            return magnets
    return FILL_ALL


class ScriptedUnit:
    """A WSP unit on a port of the bench's hub. It also drives the manual fault."""

    def __init__(self, rig):
        self.rig = rig
        self.syncs = 0
        self.manual_fault = ManualFault(rig)

    async def join(self):
        """Wait for the bench's bus, attach the unit to it and send the first heartbeats."""
        while self.rig.bus is None:
            await asyncio.sleep(0.01)
        self.port = self.rig.hub.attach(self.take, "unit")
        self.send_heartbeat(BOOT_UP)
        self.send_heartbeat(OPERATIONAL)

    def send_heartbeat(self, state):
        """Send a heartbeat with this state."""
        self.port.send(Frame(HEARTBEAT, bytes([state])))

    def take(self, frame):
        """Answer a SYNC and ignore every other frame."""
        if frame.can_id != SYNC:
            return
        time_s = frame.time_ns / 1e9
        self.manual_fault.poll(time_s)

        self.syncs += 1
        if self.syncs % HEARTBEAT_SYNCS == 0:
            self.send_heartbeat(OPERATIONAL)
        self.port.send(Frame(ANSWER, bytes([scripted_magnets(time_s)])))


def scenario_file(folder: Path) -> Path:
    """Write the scenario with all faults of the plan to a file and return its path."""
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
        lines.append("[[fault]]")
        lines.append(f'kind = "{kind}"')
        lines.append(f"at_s = {begin}")
        lines.append(f"for_s = {end - begin:.6f}")
        for name, value in values.items():
            lines.append(f"{name} = {value}")

    path = folder / "faults.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def run(folder: Path) -> Recorded:
    """Run the scenario in lockstep and return its record."""
    plan = scenario.load(str(scenario_file(folder)))
    out = folder / "run"

    async def run_with_unit():
        rig = bench.Bench(plan, options.Options("lockstep", "external", out), lambda progress: None)
        unit = asyncio.ensure_future(ScriptedUnit(rig.parts).join())
        try:
            await rig.run()
        finally:
            unit.cancel()

    asyncio.run(run_with_unit())
    return Recorded(records.load(out))


def samples(recorded: Recorded, name: str, from_s: float, to_s: float) -> np.ndarray:
    """Return the four axles' samples of a signal within an interval, shape (4, n).

    The name has a colon where the number of the axle belongs: `wheel_speed:_rad_s`.
    """
    stem, unit = name.split(":")
    return np.array(
        [recorded.channel(f"{stem}_{axle}{unit}", from_s, to_s) for axle in (1, 2, 3, 4)]
    )
