"""Faults over Modbus: choose one by its number, say where and for how long, and inject it.

Unit 1 has three registers to choose with, a coil that injects and a coil that lifts; parameters that have no register
take the catalogue's defaults. A fault that cannot be is refused with exception 03, and an event says why.
"""

from functools import partial
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults.catalogue import BY_NUMBER, LASTS
from rollerrig.firmware_sim.faults.panel import Panel
from rollerrig.firmware_sim.modbus.pdu import ExcCodes, RefusedError
from rollerrig.firmware_sim.modbus.unit import Reader, Writer
from rollerrig.wsp_interface.events import Code, OnEvent

AIMS = ("axle", "node", "can_id")
DURATION_UNIT_S = 0.1


class FaultRegisters:
    """Readers and writers of the fault registers. 0 of `target`: the default; of `duration`: no end."""

    def __init__(self, faults: Panel, on_event: OnEvent) -> None:
        self.faults, self.on_event = faults, on_event
        self.chosen = {"fault": 0, "fault_target": 0, "fault_duration": 0}

    def readers(self) -> dict[str, Reader]:
        """Raw values by name of the register."""
        return {name: (lambda name=name: self.chosen[name]) for name in self.chosen} | {
            "inject_fault": lambda: bool(self.faults.active),
            "lift_faults": lambda: False,
            "faults_active": lambda: len(self.faults.active),
        }

    def writers(self) -> dict[str, Writer]:
        """What a write does, by name of the register."""
        return {name: partial(self._choose, name) for name in self.chosen} | {
            "inject_fault": self._inject,
            "lift_faults": self._lift,
        }

    def _choose(self, name: str, raw: int, only: bool) -> None:
        if name == "fault" and raw not in BY_NUMBER:
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if not only:
            self.chosen[name] = raw

    def _inject(self, raw: int, only: bool) -> None:
        if not raw or only:
            return
        kind, target = BY_NUMBER[self.chosen["fault"]], self.chosen["fault_target"]
        values: dict[str, Any] = {"for_s": self.chosen["fault_duration"] * DURATION_UNIT_S or LASTS}
        aim = next((row.name for row in kind.parameters if row.name in AIMS), "")
        if target and aim:
            values[aim] = target
        try:
            self.faults.inject(kind.name, **values)
        except ConfigError as error:
            self.on_event(Code.FAULT_REFUSED, reason=str(error))
            raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None

    def _lift(self, raw: int, only: bool) -> None:
        if raw and not only:
            self.faults.clear()
