"""The supervisory PLC: what a Modbus client may read of the bench, and ask of it.

Unit 1 reads the live row, the loop's health and the run's events, and writes run, stop, emergency stop, scenario,
speed and brake demand; units 11 to 14 are the drives. A held rig can be given another scenario or speed; an emergency
stop goes before every other demand, one over Modbus before node 17 and the scenario. All happens in the bus thread.
"""

import math
import time
from typing import Any

import numpy as np

from rollerrig.configs import store
from rollerrig.configs.errors import BusError, RollerrigError
from rollerrig.firmware_sim.modbus import map
from rollerrig.firmware_sim.modbus import unit as modbus_unit
from rollerrig.firmware_sim.modbus.access import tls_context
from rollerrig.firmware_sim.modbus.map import BITS, NO_DEMAND, UNHEARD, WORDS, State
from rollerrig.firmware_sim.modbus.pdu import ExcCodes, RefusedError
from rollerrig.firmware_sim.modbus.rtu import SerialLine
from rollerrig.firmware_sim.modbus.server import Server
from rollerrig.firmware_sim.modbus.unit import Reader, Unit, Writer
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.fault_registers import FaultRegisters
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.loop import loop, tick
from rollerrig.realtime.loop.held_rig import HOLDING, RELEASED, RUNNING
from rollerrig.realtime.loop.tick import DONE, HELD, HOLD, STOP, TICK, WORST_NS
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.hub import beyond_loopback
from rollerrig.wsp_interface.events import Code

# tables that a held rig cannot change: nodes and loop have been built from them
BUILT_IN = ("loop", "bus", "modbus", "contact", "drive", "sensor", "rig")
_NOT_PACKAGED = 0xFFFF
_STATISTICS_S = 0.5
_SPEED = next(row for row in WORDS if row.name == "speed_set_point")
_DEMAND = next(row for row in WORDS if row.name == "brake_demand_set_point")
_HIGHEST_DEMAND_Pa = 1e6


class Supervisor:
    """Readers and writers of the PLC."""

    def __init__(self, rig: Parts, bus: RigBus) -> None:
        self.rig, self.bus = rig, bus
        self.scenarios = store.names("scenarios")
        self.emergency, self.demand = False, NO_DEMAND
        self.fault_registers = FaultRegisters(rig.faults, rig.event)
        self.server: Server | None = None
        self.line: SerialLine | None = None
        self._statistics: tuple[float, dict[str, float]] = (-math.inf, {})

    # -- the ways in

    async def open(self, needed: bool) -> None:
        """Listen as [modbus] says. A port that is taken is an event, or BusError if `needed`."""
        given = self.rig.plan["modbus"]
        context = tls_context(given)
        self.server = Server(self.units(), self.rig.modbus)
        try:
            port = await self.server.listen(given["host"], given["port"], context)
            self.rig.ports["modbus"] = port
            self.rig.event(
                Code.MODBUS_SERVED,
                transport="TLS" if context else "TCP",
                host=given["host"],
                port=port,
            )
            if beyond_loopback(given["host"]):
                self.rig.event(
                    Code.SERVER_EXPOSED,
                    server="MODBUS",
                    host=given["host"],
                    port=port,
                    who="who has a certificate" if context else "WITHOUT ANY AUTHENTICATION",
                )
            if needed:
                self.rig.report(
                    f"the rig is held at {self.rig.speed_m_s:g} m/s until a Modbus client "
                    f"writes 1 to coil 0 of unit 1 on {given['host']}:{port}"
                )
        except BusError as error:
            if needed:
                raise
            self.rig.event(Code.MODBUS_UNAVAILABLE, reason=str(error))
        if given["serial"]:
            self.line = SerialLine(
                self.server, given["serial"], given["baud_rate"], given["parity"], self.rig.event
            )
            device = await self.line.open()
            served = {"device": device, "baud_rate": given["baud_rate"]}
            self.rig.event(Code.MODBUS_SERIAL_SERVED, **served)
            self.rig.report(events.text(Code.MODBUS_SERIAL_SERVED, served))

    async def close(self) -> None:
        """End all connections."""
        if self.line:
            self.line.close()
        if self.server:
            await self.server.close()

    # -- what the bench asks

    def govern(self, command: np.ndarray) -> None:
        """Put the brake demand into a command row, where Modbus has one."""
        if self.emergency:
            command[tick.DEMAND] = self.rig.plan["modbus"]["emergency_pressure_Pa"]
        elif self.demand != NO_DEMAND:
            command[tick.DEMAND] = self.demand * _DEMAND.scale

    def roll(self) -> None:
        """Tell a held rig its speed."""
        self.rig.data.hold[0] = 0.0 if self.emergency else self.rig.speed_m_s

    @property
    def state(self) -> State:
        """What the rig does."""
        control = self.rig.data.control
        if self.rig.ended_by or control[DONE]:
            return State.ENDED
        if self.rig.next_plan:
            return State.STARTING
        if control[HOLD] != RUNNING:
            return State.HELD if control[HELD] else State.STARTING
        return State.RUNNING if control[TICK] else State.STARTING

    # -- the units

    def units(self) -> dict[int, Unit]:
        """The image of every unit."""
        bus, rows = self.bus, (*BITS, *WORDS)
        rated_Nm = self.rig.plan["drive"]["rated_torque_Nm"]
        measured = modbus_unit.signal_readers(rows, bus.row, {"rated_torque_Nm": rated_Nm})
        writers: dict[str, Writer] = {
            "run": self._run,
            "stop": self._stop,
            "emergency_stop": self._emergency_stop,
            "scenario": self._choose,
            "speed_set_point": self._set_speed,
            "brake_demand_set_point": self._set_demand,
        }
        return {
            map.PLC_UNIT: Unit(
                rows,
                measured | self._states() | self._health() | self.fault_registers.readers(),
                writers | self.fault_registers.writers(),
            )
        } | {unit: modbus_unit.drive(bus.nodes[node]) for node, unit in map.DRIVE_UNITS.items()}

    def _states(self) -> dict[str, Reader]:
        """What the rig does and is set to."""
        rig, bus, master = self.rig, self.bus, self.bus.master
        standing = signals.column("vehicle_speed")
        return {
            "run": lambda: self.state is State.RUNNING,
            "stop": lambda: self.state is State.ENDED,
            "emergency_stop": lambda: self.emergency,
            "held": lambda: self.state is State.HELD,
            # not as the bus last saw it: a client that has just changed the set speed would be told the old answer
            "at_set_speed": lambda: (
                self.state is State.HELD
                and abs(rig.data.state.vehicle_speed[0] - rig.data.hold[0]) < 1e-6
            ),
            "standing": lambda: bus.row[standing] == 0.0,
            "wsp_unit_operational": lambda: master.unit_is_operational,
            "nodes_operational": master.all_operational,
            "state": lambda: self.state,
            "scenarios": lambda: len(self.scenarios),
            "scenario": self._number,
            "speed_set_point": lambda: round(rig.speed_m_s / _SPEED.scale),
            "brake_demand_set_point": lambda: self.demand,
            "wsp_unit_state": _nmt(master, signals.WSP_NODE),
        } | {f"node_{node}_state": _nmt(master, node) for node in signals.RIG_NODES}

    def _number(self) -> int:
        name = (self.rig.next_plan or self.rig.plan).name
        return self.scenarios.index(name) if name in self.scenarios else _NOT_PACKAGED

    def _health(self) -> dict[str, Reader]:
        """How loop, buses and PLC are, and how many events there were."""
        rig, hub, counters = self.rig, self.bus.hub, self.rig.modbus
        events: dict[str, Reader] = {
            f"events_{level}": lambda level=level: rig.events.counts[level]
            for level in ("info", "warning", "error")
        }
        return events | {
            "ticks": lambda: int(rig.data.control[TICK]),
            "lateness_p50": lambda: self._lateness("p50"),
            "lateness_p99": lambda: self._lateness("p99"),
            "lateness_max": lambda: int(rig.data.control[WORST_NS]) // 1000,
            "bus_frames": lambda: hub.stats()["frames"],
            "bus_frames_dropped": lambda: hub.stats()["dropped"],
            "bus_load": lambda: round(10.0 * hub.stats()["load_percent"]),
            "modbus_clients": lambda: len(self.server.connections) if self.server else 0,
            "modbus_requests": lambda: counters.requests,
            "modbus_exceptions": lambda: counters.exceptions,
            "modbus_malformed": lambda: counters.malformed,
        }

    def _lateness(self, which: str) -> int:
        """A percentile in us; counted anew now and then, because counting takes long."""
        now = time.monotonic()
        if now - self._statistics[0] > _STATISTICS_S:
            self._statistics = (
                now,
                loop.percentiles(self.rig.histogram, int(self.rig.data.control[WORST_NS])),
            )
        return round(self._statistics[1][which])

    # -- what a client writes: each is first asked with only=True whether it would take the value

    def _run(self, raw: int, only: bool) -> None:
        if not raw or self.state is State.RUNNING:
            return
        if self.emergency:
            raise RefusedError(ExcCodes.DEVICE_BUSY)
        self._require_held()
        if not only:
            data = self.rig.data
            self.rig.speed_m_s = round(float(data.state.vehicle_speed[0]), 6)
            self.roll()
            data.control[HOLD] = RELEASED
            self.rig.event(Code.RUN_STARTED)

    def _stop(self, raw: int, only: bool) -> None:
        if raw and not only:
            self.rig.stop(Code.RUN_STOPPED)

    def _emergency_stop(self, raw: int, only: bool) -> None:
        if only or bool(raw) == self.emergency:
            return
        self.emergency = bool(raw)
        self.rig.event(Code.EMERGENCY_STOP_SET if raw else Code.EMERGENCY_STOP_RESET)
        self.roll()
        for node in signals.DRIVE_NODES:
            self.bus.nodes[node].device.emergency_stop(self.emergency)
        self.bus.post()

    def _set_speed(self, raw: int, only: bool) -> None:
        speed_m_s = raw * _SPEED.scale
        bounds = next(row for row in scenario.HEAD if row.name == "initial_speed_m_s")
        drive, contact = self.rig.plan["drive"], self.rig.plan["contact"]
        if (
            not bounds.low
            <= speed_m_s
            <= min(bounds.high, drive["max_speed_rad_s"] * contact["roller_radius_m"])
        ):
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        self._require_held()
        if not only:
            self.rig.speed_m_s = speed_m_s
            self.roll()

    def _set_demand(self, raw: int, only: bool) -> None:
        if raw != NO_DEMAND and not 0 <= raw * _DEMAND.scale <= _HIGHEST_DEMAND_Pa:
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if not only:
            self.demand = raw
            self.bus.post()

    def _choose(self, raw: int, only: bool) -> None:
        if not 0 <= raw < len(self.scenarios):
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if raw == self._number():
            return
        self._require_held()
        rig, name = self.rig, self.scenarios[raw]
        try:
            plan = scenario.load(name, tables={key: rig.plan[key] for key in BUILT_IN})
        except RollerrigError as error:
            rig.event(Code.SCENARIO_REFUSED, reason=str(error))
            raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None
        if not only:
            rig.speed_m_s = float(plan["initial_speed_m_s"])
            # the real-time thread ends, and begins again with the next plan
            rig.next_plan = plan
            rig.data.control[STOP] = 1
            rig.event(Code.SCENARIO_CHOSEN, scenario=name)

    def _require_held(self) -> None:
        if self.state is not State.HELD or self.rig.data.control[HOLD] != HOLDING:
            raise RefusedError(ExcCodes.DEVICE_BUSY)


def _nmt(master: Any, node: int) -> Reader:
    health = master.health[node]
    return lambda: UNHEARD if health.lost or health.state is None else int(health.state)
