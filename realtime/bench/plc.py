"""The supervisory PLC: the registers of the bench over Modbus, and what writing them does.

Unit 1 reads the live row, the health of the loop and the events of the run. It writes run, stop,
emergency stop, scenario, speed and brake demand. The units from 11 are the drives. A held rig can
be given another scenario or speed. `brake_demand` decides how the demands of this PLC rank among
the others. Everything happens in the bus thread.
"""

import math
import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from rollerrig.configs.errors import BusError, RollerrigError
from rollerrig.firmware_sim.modbus import map
from rollerrig.firmware_sim.modbus import unit as modbus_unit
from rollerrig.firmware_sim.modbus.access import tls_context
from rollerrig.firmware_sim.modbus.map import (
    BITS,
    COMMANDS_AND_STATES,
    NO_DEMAND,
    UNHEARD,
    MotorState,
    Register,
    State,
)
from rollerrig.firmware_sim.modbus.pdu import ExcCodes, RefusedError
from rollerrig.firmware_sim.modbus.rtu import SerialLine
from rollerrig.firmware_sim.modbus.server import Server
from rollerrig.firmware_sim.modbus.unit import Reader, Unit, Writer
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.fault_registers import FaultRegisters
from rollerrig.realtime.bench.parts import Parts
from rollerrig.realtime.bench.rig_bus import RigBus
from rollerrig.realtime.loop import loop
from rollerrig.realtime.loop.held_rig import (
    APPROACH_M_S2,
    EMERGENCY_RATE_M_S2,
    HOLDING,
    RATE_M_S2,
    RELEASED,
    RUNNING,
    SET_M_S,
    has_settled,
)
from rollerrig.realtime.loop.tick import DONE, HELD, HOLD, STOP, TICK, WORST_NS
from rollerrig.wsp_interface import events, own_bench, signals
from rollerrig.wsp_interface.bus.hub import beyond_loopback
from rollerrig.wsp_interface.events import Code

# tables that a held rig cannot change: nodes and loop have been built from them
BUILT_IN = ("loop", "bus", "modbus", "contact", "drive", "sensor", "rig")
# the register `scenario` of a run whose scenario is not a packaged one
_NOT_PACKAGED = 0xFFFF
# how old percentiles of lateness may be: counting them takes long
_STATISTICS_S = 0.5
_HIGHEST_DEMAND_Pa = 1e6


def _register(name: str) -> Register:
    return next(row for row in COMMANDS_AND_STATES if row.name == name)


_SPEED = _register("speed_set_point")
_DEMAND = _register("brake_demand_set_point")


class Plc:
    """The PLC of a run: readers and writers of its registers."""

    def __init__(self, rig: Parts, bus: RigBus) -> None:
        self.rig = rig
        self.bus = bus
        self.table = rig.plan.table
        self.demand = rig.modbus_demand
        # a rig keeps its vehicle
        self.scenarios = own_bench.scenarios_of(self.table.kind)
        self.fault_registers = FaultRegisters(rig.faults, rig.event)
        self.server: Server | None = None
        self.line: SerialLine | None = None
        self._counted_s = -math.inf
        self._percentiles_us: dict[str, float] = {}

    # -- the ways in

    async def open(self, needed: bool) -> None:
        """Listen as [modbus] says. A port that is in use is an event, or BusError if `needed`."""
        settings = self.rig.plan["modbus"]
        self.server = Server(self.units(), self.rig.modbus, self.rig.event)
        self.rig.close_silent.append(self.server.places.close_silent)
        try:
            await self._open_port(self.server, settings, needed)
        except BusError as error:
            if needed:
                raise
            self.rig.event(Code.MODBUS_UNAVAILABLE, reason=str(error))
        if settings["serial"]:
            await self._open_line(self.server, settings)

    async def _open_port(self, server: Server, settings: Mapping[str, Any], needed: bool) -> None:
        """Listen for Modbus TCP, over TLS where there is a certificate. Raises BusError."""
        host = settings["host"]
        context = tls_context(settings)
        port = await server.listen(host, settings["port"], context)
        self.rig.ports["modbus"] = port
        transport = "TLS" if context else "TCP"
        self.rig.event(Code.MODBUS_SERVED, transport=transport, host=host, port=port)
        if beyond_loopback(host):
            self.rig.event(
                Code.SERVER_EXPOSED,
                server="MODBUS",
                host=host,
                port=port,
                who="who has a certificate" if context else "WITHOUT ANY AUTHENTICATION",
            )
        if needed:
            self.rig.report(
                f"the rig is held at {self.rig.speed_m_s:g} m/s until a Modbus client "
                f"writes 1 to coil 0 of unit 1 on {host}:{port}"
            )

    async def _open_line(self, server: Server, settings: Mapping[str, Any]) -> None:
        """Listen for Modbus RTU on a serial line. Raises BusError."""
        self.line = SerialLine(
            server,
            settings["serial"],
            settings["baud_rate"],
            settings["parity"],
            self.rig.event,
        )
        served = {"device": await self.line.open(), "baud_rate": settings["baud_rate"]}
        self.rig.event(Code.MODBUS_SERIAL_SERVED, **served)
        self.rig.report(events.text(Code.MODBUS_SERIAL_SERVED, served))

    async def close(self) -> None:
        """Close all connections."""
        if self.line:
            self.line.close()
        if self.server:
            await self.rig.await_accepting()
            await self.server.close()

    # -- the state of the rig

    def roll(self) -> None:
        """Set the speed at which a held rig rolls, and how fast it approaches this speed."""
        hold = self.rig.data.hold
        if self.demand.emergency_stop:
            hold[APPROACH_M_S2] = EMERGENCY_RATE_M_S2
            hold[SET_M_S] = 0.0
        else:
            hold[APPROACH_M_S2] = RATE_M_S2
            hold[SET_M_S] = self.rig.speed_m_s

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
        """Return the register image of every unit: the PLC and the drives."""
        rows = (*BITS, *map.words(self.table))
        rated_Nm = self.rig.plan["drive"]["rated_torque_Nm"]
        measured = modbus_unit.signal_readers(rows, self.bus.row, {"rated_torque_Nm": rated_Nm})
        readers = measured | self._states() | self._health() | self.fault_registers.readers()
        writers: dict[str, Writer] = {
            "run": self._run,
            "stop": self._stop,
            "emergency_stop": self._emergency_stop,
            "scenario": self._select_scenario,
            "speed_set_point": self._set_speed,
            "brake_demand_set_point": self._set_demand,
        }
        found = {map.PLC_UNIT: Unit(rows, readers, writers | self.fault_registers.writers())}
        for node, unit in map.drive_units(self.table).items():
            found[unit] = modbus_unit.drive(self.bus.nodes[node])
        return found

    def _states(self) -> dict[str, Reader]:
        """Return readers of what the rig does and is set to, by register."""
        rig, bus, master = self.rig, self.bus, self.bus.master
        speed = signals.column("vehicle_speed")
        readers: dict[str, Reader] = {
            "run": lambda: self.state is State.RUNNING,
            "stop": lambda: self.state is State.ENDED,
            "emergency_stop": lambda: self.demand.emergency_stop,
            "held": lambda: self.state is State.HELD,
            "at_set_speed": self._is_at_set_speed,
            "standing": lambda: bus.row[speed] == 0.0,
            "wsp_unit_operational": lambda: master.unit_is_operational,
            "nodes_operational": master.all_operational,
            "state": lambda: self.state,
            "scenarios": lambda: len(self.scenarios),
            "scenario": self._scenario_number,
            "speed_set_point": lambda: round(rig.speed_m_s / _SPEED.scale),
            "brake_demand_set_point": self._demand_count,
        }
        for group, node in enumerate(self.table.wsp_nodes):
            readers[map.unit_state_name(group)] = _nmt_state(master, node)
        for node in self.table.rig_nodes:
            readers[f"node_{node}_state"] = _nmt_state(master, node)
        if self.table.kind.dynamic_brake:
            for axle in self.table.axles:
                readers[map.motor_state_name(axle)] = partial(self._motor_state, axle)
        return readers

    def _motor_state(self, axle: int) -> MotorState:
        """Return the state of the motor of an axle (from 1)."""
        if axle not in self.rig.plan["dynamic_brake"]["axles"]:
            return MotorState.NONE
        if self.rig.data.state.dynamic_failed[axle - 1] != 0.0:
            return MotorState.FAILED
        share = self.bus.row[signals.column("dynamic_share", axle)]
        if share <= 0.0:
            return MotorState.RELEASED
        return MotorState.PERMITTED if share >= 1.0 else MotorState.REDUCED

    def _is_at_set_speed(self) -> bool:
        # not by the row of the last SYNC: a client that has just changed the set speed would
        # read the old answer
        if self.state is not State.HELD:
            return False
        return has_settled(self.rig.data)

    def _scenario_number(self) -> int:
        name = (self.rig.next_plan or self.rig.plan).name
        return self.scenarios.index(name) if name in self.scenarios else _NOT_PACKAGED

    def _demand_count(self) -> int:
        """Return the set point of the demand as its register holds it."""
        if math.isnan(self.demand.set_point_Pa):
            return NO_DEMAND
        return round(self.demand.set_point_Pa / _DEMAND.scale)

    def _health(self) -> dict[str, Reader]:
        """Return readers of the state of loop, bus and PLC and of the counts of events."""
        rig, hub, counters = self.rig, self.bus.hub, self.rig.modbus
        readers: dict[str, Reader] = {
            "ticks": lambda: int(rig.data.control[TICK]),
            "lateness_p50": lambda: self._lateness_us("p50"),
            "lateness_p99": lambda: self._lateness_us("p99"),
            "lateness_max": lambda: int(rig.data.control[WORST_NS]) // 1000,
            "bus_frames": lambda: hub.stats()["frames"],
            "bus_frames_dropped": lambda: hub.stats()["dropped"],
            "bus_load": lambda: round(10.0 * hub.stats()["load_percent"]),
            "modbus_clients": lambda: len(self.server.connections) if self.server else 0,
            "modbus_requests": lambda: counters.requests,
            "modbus_exceptions": lambda: counters.exceptions,
            "modbus_malformed": lambda: counters.malformed,
        }
        for level in events.LEVELS:
            readers[f"events_{level}"] = lambda level=level: rig.events.counts[level]
        return readers

    def _lateness_us(self, percentile: str) -> int:
        """Return a percentile of the lateness of ticks, counted anew now and then."""
        now_s = time.monotonic()
        if now_s - self._counted_s > _STATISTICS_S:
            self._counted_s = now_s
            worst_ns = int(self.rig.data.control[WORST_NS])
            self._percentiles_us = loop.percentiles(self.rig.real_time.histogram, worst_ns)
        return round(self._percentiles_us[percentile])

    # -- what a client writes
    # each writer is first called with check_only=True, and then refuses a value that is not allowed

    def _run(self, raw: int, check_only: bool) -> None:
        if not raw or self.state is State.RUNNING:
            return
        if self.demand.emergency_stop:
            raise RefusedError(ExcCodes.DEVICE_BUSY)
        self._require_held()
        if check_only:
            return
        data = self.rig.data
        settled = has_settled(data)
        set_speed_m_s = self.rig.speed_m_s
        self.rig.speed_m_s = round(float(data.state.vehicle_speed[0]), 6)
        self.roll()
        data.control[HOLD] = RELEASED
        self.rig.event(Code.RUN_STARTED)
        if not settled:
            self.rig.event(
                Code.RUN_STARTED_EARLY,
                speed_m_s=self.rig.speed_m_s,
                set_speed_m_s=set_speed_m_s,
            )

    def _stop(self, raw: int, check_only: bool) -> None:
        if raw and not check_only:
            self.rig.stop(Code.RUN_STOPPED)

    def _emergency_stop(self, raw: int, check_only: bool) -> None:
        if check_only or bool(raw) == self.demand.emergency_stop:
            return
        self.demand.emergency_stop = bool(raw)
        self.rig.event(Code.EMERGENCY_STOP_SET if raw else Code.EMERGENCY_STOP_RESET)
        self.roll()
        for node in self.table.drive_nodes:
            self.bus.nodes[node].device.emergency_stop(self.demand.emergency_stop)
        self.bus.post()

    def _set_speed(self, raw: int, check_only: bool) -> None:
        speed_m_s = raw * _SPEED.scale
        bounds = next(row for row in scenario.HEAD if row.name == "initial_speed_m_s")
        drive, contact = self.rig.plan["drive"], self.rig.plan["contact"]
        fastest_roller_m_s = drive["max_speed_rad_s"] * contact["roller_radius_m"]
        if not bounds.low <= speed_m_s <= min(bounds.high, fastest_roller_m_s):
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        self._require_held()
        if not check_only:
            if speed_m_s != self.rig.speed_m_s:
                self.rig.note_set_point("speed", Code.SET_POINT_SPEED, speed_m_s=speed_m_s)
            self.rig.speed_m_s = speed_m_s
            self.roll()

    def _set_demand(self, raw: int, check_only: bool) -> None:
        pressure_Pa = raw * _DEMAND.scale
        if raw == NO_DEMAND:
            pressure_Pa = math.nan
        elif not 0 <= pressure_Pa <= _HIGHEST_DEMAND_Pa:
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if not check_only:
            if raw != self._demand_count():
                self.rig.note_demand("Modbus", pressure_Pa)
            self.demand.set_point_Pa = pressure_Pa
            self.bus.post()

    def _select_scenario(self, raw: int, check_only: bool) -> None:
        if not 0 <= raw < len(self.scenarios):
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if raw == self._scenario_number():
            return
        self._require_held()
        rig, name = self.rig, self.scenarios[raw]
        try:
            plan = scenario.load(name, tables={key: rig.plan[key] for key in BUILT_IN})
        except RollerrigError as error:
            rig.event(Code.SCENARIO_REFUSED, reason=str(error))
            raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None
        if check_only:
            return
        rig.speed_m_s = float(plan["initial_speed_m_s"])
        # the real-time thread ends, and begins again with the next plan
        rig.next_plan = plan
        rig.data.control[STOP] = 1
        rig.event(Code.SCENARIO_CHOSEN, scenario=name)

    def _require_held(self) -> None:
        """Raise RefusedError unless the rig is held."""
        if self.state is not State.HELD or self.rig.data.control[HOLD] != HOLDING:
            raise RefusedError(ExcCodes.DEVICE_BUSY)


def _nmt_state(master: Any, node: int) -> Reader:
    """Return a reader of the NMT state of a node as its register holds it."""
    health = master.health[node]

    def read() -> int:
        if health.lost or health.state is None:
            return UNHEARD
        return int(health.state)

    return read
