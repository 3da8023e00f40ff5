"""Faults over Modbus: select one by its number, set target and duration, and inject it.

Unit 1 has three registers for the selection, a coil that injects and a coil that lifts. Parameters
that have no register take the defaults of the catalogue. A fault that is not possible is refused
with exception 03, and an event gives the reason.
"""

from functools import partial
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.faults.catalogue import LASTS
from rollerrig.firmware_sim.faults.panel import Panel
from rollerrig.firmware_sim.modbus.pdu import ExcCodes, RefusedError
from rollerrig.firmware_sim.modbus.unit import Reader, Writer
from rollerrig.wsp_interface.events import Code, OnEvent

AIMS = ("axle", "bogie", "group", "node", "can_id")
DURATION_UNIT_S = 0.1


class FaultRegisters:
    """Readers and writers of the fault registers.

    A target of 0 is the default of the fault, a duration of 0 has no end.
    """

    def __init__(self, faults: Panel, on_event: OnEvent) -> None:
        self.faults = faults
        self.on_event = on_event
        kinds = catalogue.of(faults.vehicle).values()
        self._kinds = {kind.number: kind for kind in kinds}
        self.selected = {"fault": 0, "fault_target": 0, "fault_duration": 0}

    def readers(self) -> dict[str, Reader]:
        """Return the readers of raw values, by the name of the register."""
        readers: dict[str, Reader] = {
            "inject_fault": lambda: bool(self.faults.active),
            "lift_faults": lambda: False,
            "faults_active": lambda: len(self.faults.active),
        }
        for name in self.selected:
            readers[name] = lambda name=name: self.selected[name]
        return readers

    def writers(self) -> dict[str, Writer]:
        """Return the writers, by the name of the register."""
        writers: dict[str, Writer] = {"inject_fault": self._inject, "lift_faults": self._lift}
        for name in self.selected:
            writers[name] = partial(self._select, name)
        return writers

    def _select(self, name: str, raw: int, check_only: bool) -> None:
        if name == "fault" and raw not in self._kinds:
            raise RefusedError(ExcCodes.ILLEGAL_VALUE)
        if not check_only:
            self.selected[name] = raw

    def _inject(self, raw: int, check_only: bool) -> None:
        if not raw or check_only:
            return
        kind = self._kinds[self.selected["fault"]]
        duration_s = self.selected["fault_duration"] * DURATION_UNIT_S
        values: dict[str, Any] = {"for_s": duration_s or LASTS}
        target = self.selected["fault_target"]
        aim = next((row.name for row in kind.parameters if row.name in AIMS), "")
        if target and aim:
            values[aim] = target
        try:
            self.faults.inject(kind.name, **values)
        except ConfigError as error:
            self.on_event(Code.FAULT_REFUSED, reason=str(error))
            raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None

    def _lift(self, raw: int, check_only: bool) -> None:
        if raw and not check_only:
            self.faults.clear()
