"""A rig at its initial speed that another program steps: its variables, and what it refuses.

It advances as a free run does, in whole ticks. Its inputs are magnets, brake demand and friction.
Its outputs are what a WSP unit receives, by the names that such a unit has as an FMU, with loads,
adhesion and motion.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.bench.free import Stop
from rollerrig.realtime.loop import ring, tick
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, VENT_MAGNET
from rollerrig.wsp_interface.signals import Table

# resources of the FMU: the resolved scenario, and the name of the model
SCENARIO = "scenario.toml"
NAME = "model_name.txt"
HIGHEST_DEMAND_Pa = 1e6  # as object 6411h of node 17
HIGHEST_FRICTION = 1.0  # as adhesion.mu_cd of a scenario
# the rig never ends its run: the importing tool decides
_ENDLESS = 1 << 60
# how far a time or a step may be from a whole number of ticks, in ticks
_ROUNDING = 1e-6
# outputs: the name in the FMU, the signal, and the unit
_OUTPUTS = (
    ("vehicle_speed", "vehicle_speed", "m/s"),
    ("position", "position", "m"),
    ("wheel_speed", "measured_speed", "rad/s"),
    ("cylinder_pressure", "cylinder_pressure", "Pa"),
    ("sliding", "sliding", "m/s"),
    ("wheel_load", "wheel_load", "N"),
    ("adhesion", "adhesion", None),
)


class RefusedError(RollerrigError):
    """A call that the rig refuses, with the reason."""


class Port(NamedTuple):
    """A variable of the FMU; `set` is None for an output.

    `low` and `high` are the bounds of an input that is a number.
    """

    name: str
    text: str
    unit: str | None
    get: Callable[[], Any]
    set: Callable[[Any], None] | None = None
    boolean: bool = False
    low: float = -math.inf
    high: float = math.inf

    def check(self, value: float) -> None:
        """Raise RefusedError unless a value may be set."""
        if self.set is None:
            raise RefusedError(f"{self.name} is an output and cannot be set")
        if self.boolean or (math.isfinite(value) and self.low <= value <= self.high):
            return
        unit = f" {self.unit}" if self.unit else ""
        below = f"{self.low:g}" if math.isfinite(self.low) else "any number below 0"
        raise RefusedError(
            f"{self.name} = {value:g}{unit}: allowed is {below} to {self.high:g}{unit}; nothing "
            "has been set"
        )


class Rig:
    """A rig at its initial speed, ready to be stepped; `resources` holds its scenario.

    `name` is the name of the model. Raises ConfigError.
    """

    def __init__(self, resources: str | Path) -> None:
        """Build and compile it."""
        folder = Path(resources)
        self._plan = scenario.load(str(folder / SCENARIO))
        self.name = (folder / NAME).read_text(encoding="utf-8")
        self._tick_hz = self._plan["loop"]["tick_hz"]
        self._begin_s = 0.0
        self._make()

    def _make(self) -> None:
        data = tick_data.build(self._plan, ring.Memory(1, self._plan.table))
        data = data._replace(end_tick=_ENDLESS, stand_ticks=_ENDLESS)
        self._stop = Stop(self._plan, data, "none")
        tick_data.warm_up(self._stop.data, "free")
        self.ports = tuple(self._ports())

    @property
    def time_s(self) -> float:
        """Time of the importing tool."""
        return self._begin_s + int(self._stop.data.control[tick.TICK]) / self._tick_hz

    def reset(self) -> None:
        """Return to the initial speed and to the start values of all inputs."""
        self._begin_s = 0.0
        self._make()

    def begin(self, start_s: float) -> None:
        """Take the time at which the importing tool starts. Raises RefusedError."""
        if not math.isfinite(start_s):
            raise RefusedError(f"the start time {start_s} is no finite number")
        self._begin_s = start_s

    def get(self, references: Sequence[int], boolean: bool) -> list[Any]:
        """Return the values of variables by their value references. Raises RefusedError."""
        return [self._port(reference, boolean).get() for reference in references]

    def set(self, references: Sequence[int], values: Sequence[Any], boolean: bool) -> None:
        """Set inputs, all or none of them. Raises RefusedError."""
        ports = [self._port(reference, boolean) for reference in references]
        for port, value in zip(ports, values, strict=True):
            port.check(value)
        for port, value in zip(ports, values, strict=True):
            assert port.set
            port.set(value)

    def _port(self, reference: int, boolean: bool) -> Port:
        if not 0 <= reference < len(self.ports):
            raise RefusedError(f"there is no variable with the value reference {reference}")
        port = self.ports[reference]
        if port.boolean is not boolean:
            kind = "Boolean" if port.boolean else "Float64"
            raise RefusedError(f"{port.name} (value reference {reference}) is of type {kind}")
        return port

    def step(self, at_s: float, step_s: float) -> float:
        """Advance by whole ticks from a time, which must be that of the rig; return the new time.

        Raises RefusedError.
        """
        tick_s = 1.0 / self._tick_hz
        if not abs(at_s - self.time_s) <= _ROUNDING * tick_s + 1e-12 * abs(at_s):
            raise RefusedError(
                f"a step from {at_s:g} s, but the rig is at {self.time_s:g} s; step from there"
            )
        exact = step_s * self._tick_hz
        ticks = round(exact) if math.isfinite(exact) else 0
        if ticks < 1 or abs(ticks - exact) > _ROUNDING * max(exact, 1.0):
            raise RefusedError(
                f"a step of {step_s:g} s is not a whole number of ticks of {tick_s:g} s"
            )
        control = self._stop.data.control
        end = int(control[tick.TICK]) + ticks
        while (left := end - int(control[tick.TICK])) > 0:
            self._stop.advance(left)
        return self.time_s

    def _ports(self) -> Iterator[Port]:
        """Yield all variables in the order of their value references, inputs first after time."""
        yield Port("time", "time of the importing tool", "s", lambda: self.time_s)
        command = self._stop.data.commands.values
        axles = self._plan.kind.axles
        for axle in range(axles):
            yield _magnet_port(command, axle, "hold", HOLD_MAGNET)
            yield _magnet_port(command, axle, "vent", VENT_MAGNET)
        yield _demand_port(command)
        for axle in range(axles):
            yield _friction_port(command, axle)
        for name, signal, unit in _OUTPUTS:
            yield from _output_ports(self._plan.table, self._stop.data.row, name, signal, unit)


def _magnet_port(command: np.ndarray, axle: int, magnet: str, bit: int) -> Port:
    def get() -> bool:
        return bool(int(command[axle]) & bit)

    def switch(on: Any) -> None:
        others = int(command[axle]) & ~bit
        command[axle] = others | bit if on else others

    return Port(
        f"{magnet}_{axle + 1}",
        f"{magnet} magnet of the axle's dump valve is energised",
        None,
        get,
        switch,
        boolean=True,
    )


def _demand_port(command: np.ndarray) -> Port:
    def get() -> float:
        return float(np.nan_to_num(command[tick.DEMAND], nan=-1.0))

    def demand(pressure_Pa: Any) -> None:
        command[tick.DEMAND] = pressure_Pa if pressure_Pa >= 0.0 else np.nan

    return Port(
        "brake_demand",
        "demanded brake cylinder pressure; below 0: the demand of the scenario",
        "Pa",
        get,
        demand,
        high=HIGHEST_DEMAND_Pa,
    )


def _friction_port(command: np.ndarray, axle: int) -> Port:
    place = tick.FRICTION + axle

    def get() -> float:
        return float(command[place])

    def contaminate(friction: Any) -> None:
        command[place] = friction

    return Port(
        f"friction_{axle + 1}",
        "kinematic friction of the contaminant under the axle; 0: as in the scenario",
        None,
        get,
        contaminate,
        low=0.0,
        high=HIGHEST_FRICTION,
    )


def _output_ports(
    table: Table, row: np.ndarray, name: str, signal: str, unit: str | None
) -> Iterator[Port]:
    """Yield the ports of a signal, one for each axle that it has."""
    place = table.span(signal)
    many = table.by_name[signal].axles > 1
    for at in range(place.start, place.stop):
        yield Port(
            f"{name}_{at - place.start + 1}" if many else name,
            table.by_name[signal].text,
            unit,
            lambda at=at: float(row[at]),
        )
