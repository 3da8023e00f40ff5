"""The rig of a scenario as an FMU for simulations of others: FMI 3, co-simulation, run by Python with rollerrig.

The FMU goes on as a free run does, in whole ticks. It hears magnets, brake demand and friction, and tells what a WSP
unit hears by the names that such a unit as an FMU has, with loads, adhesion and motion. Compiled at instantiation.
Source: FMI 3.0.2; PythonFMU3 0.3.
"""

import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.bench.free import Stop
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring, tick
from rollerrig.realtime.record.files import writing
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, VENT_MAGNET
from rollerrig.wsp_interface.signals import AXLES

STEP_S = 0.01
_SCENARIO = "scenario.toml"
_ENDLESS = 1 << 60
_UNITS = {
    "m/s": {"m": 1, "s": -1},
    "m": {"m": 1},
    "rad/s": {"rad": 1, "s": -1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
}
# what the FMU tells: its name, the signal, and the unit
_TOLD = (
    ("vehicle_speed", "vehicle_speed", "m/s"),
    ("position", "position", "m"),
    ("wheel_speed", "measured_speed", "rad/s"),
    ("cylinder_pressure", "cylinder_pressure", "Pa"),
    ("sliding", "sliding", "m/s"),
    ("wheel_load", "wheel_load", "N"),
    ("adhesion", "adhesion", None),
)
_SCRIPT = '''"""The rig of scenario {name}. Python with rollerrig has to be installed where this runs."""

from pythonfmu3 import Fmi3Slave
from rollerrig.realtime.bench import as_fmu


class Rig(Fmi3Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.modelName = {identifier!r}
        self.rig = as_fmu.Rig(self.resources)
        as_fmu.declare(self, self.rig)

    def do_step(self, current_time, step_size):
        return self.rig.step(step_size)
'''


class Port(NamedTuple):
    """A variable; `set` is None for what the FMU tells."""

    name: str
    text: str
    unit: str | None
    get: Callable[[], Any]
    set: Callable[[Any], None] | None = None
    boolean: bool = False


class Rig:
    """A rig at its initial speed, ready to be stepped; `resources` holds its scenario. Raises ConfigError."""

    def __init__(self, resources: str | Path) -> None:
        """Build and compile it."""
        path = Path(resources) / _SCENARIO
        plan = scenario.load(str(path))
        self.time_s, self._tick_hz = 0.0, plan["loop"]["tick_hz"]
        data = tick_data.build(plan, ring.Memory(1, len(signals.COLUMNS)))
        self._stop = Stop(plan, data._replace(end_tick=_ENDLESS, stand_ticks=_ENDLESS), "none")
        tick_data.warm_up(self._stop.data, "free")

    def step(self, step_s: float) -> Any:
        """Go on by whole ticks."""
        from pythonfmu3 import Fmi3Status, Fmi3StepResult

        ticks = round(step_s * self._tick_hz)
        if ticks < 1 or abs(ticks - step_s * self._tick_hz) > 1e-6:
            print(
                f"rollerrig: a step of {step_s:g} s is no whole number of ticks of {1.0 / self._tick_hz:g} s",
                flush=True,
            )
            return Fmi3StepResult(status=Fmi3Status.error)
        control = self._stop.data.control
        end = int(control[tick.TICK]) + ticks
        while (left := end - int(control[tick.TICK])) > 0:
            self._stop.advance(left)
        self.time_s = end / self._tick_hz
        return Fmi3StepResult()

    def ports(self) -> Iterator[Port]:
        """All variables, inputs first."""
        command, row = self._stop.data.commands.values, self._stop.data.row
        for axle in range(AXLES):
            for name, bit in (("hold", HOLD_MAGNET), ("vent", VENT_MAGNET)):
                yield Port(
                    f"{name}_{axle + 1}",
                    f"{name} magnet of the axle's dump valve is energised",
                    None,
                    lambda axle=axle, bit=bit: bool(int(command[axle]) & bit),
                    lambda on, axle=axle, bit=bit: _switch(command, axle, bit, on),
                    True,
                )
        yield Port(
            "brake_demand",
            "brake cylinder pressure asked for; below 0: what the scenario demands",
            "Pa",
            lambda: float(np.nan_to_num(command[tick.DEMAND], nan=-1.0)),
            lambda value: _demand(command, value),
        )
        for axle in range(AXLES):
            yield Port(
                f"friction_{axle + 1}",
                "kinematic friction of the contaminant under the axle; 0: as the scenario has it",
                None,
                lambda axle=axle: float(command[tick.FRICTION + axle]),
                lambda value, axle=axle: command.__setitem__(tick.FRICTION + axle, max(value, 0.0)),
            )
        for name, signal, unit in _TOLD:
            place, many = signals.span(signal), signals.BY_NAME[signal].axles > 1
            for at in range(place.start, place.stop):
                yield Port(
                    f"{name}_{at - place.start + 1}" if many else name,
                    signals.BY_NAME[signal].text,
                    unit,
                    lambda at=at: float(row[at]),
                )


def _switch(command: np.ndarray, axle: int, bit: int, on: bool) -> None:
    command[axle] = int(command[axle]) & ~bit | (bit if on else 0)


def _demand(command: np.ndarray, pressure_Pa: float) -> None:
    command[tick.DEMAND] = pressure_Pa if pressure_Pa >= 0.0 else np.nan


def declare(slave: Any, rig: Rig) -> None:
    """Give a slave of PythonFMU3 the variables of a rig."""
    from pythonfmu3 import Boolean, DefaultExperiment, Float64, Fmi3Causality, Fmi3Variability, Unit

    slave.register_units([Unit(name, **base) for name, base in _UNITS.items()])
    slave.default_experiment = DefaultExperiment(start_time=0.0, step_size=STEP_S)
    slave.register_variable(
        Float64(
            "time",
            causality=Fmi3Causality.independent,
            variability=Fmi3Variability.continuous,
            getter=lambda: rig.time_s,
        )
    )
    for port in rig.ports():
        kind, unit = (Boolean, {}) if port.boolean else (Float64, {"unit": port.unit})
        slave.register_variable(
            kind(
                port.name,
                causality=Fmi3Causality.input if port.set else Fmi3Causality.output,
                getter=port.get,
                setter=port.set,
                description=port.text,
                variability=Fmi3Variability.discrete
                if port.boolean
                else Fmi3Variability.continuous,
                **unit,
            )
        )


def write(plan: Scenario, out: Path) -> int:
    """Write the FMU of a scenario; how many variables it has. Raises ConfigError."""
    try:
        from pythonfmu3 import FmuBuilder
    except ImportError:
        raise ConfigError("FMUs need the extra: pip install 'rollerrig[fmu]'") from None
    identifier = re.sub(r"\W", "_", plan.name, flags=re.ASCII)
    identifier = identifier if re.match("[A-Za-z_]", identifier) else f"rig_{identifier}"
    with tempfile.TemporaryDirectory(prefix="rollerrig-fmu-") as place, writing(out):
        folder = Path(place)
        (folder / _SCENARIO).write_text(scenario.dump(plan), encoding="utf-8")
        (folder / "rig.py").write_text(
            _SCRIPT.format(name=plan.name, identifier=identifier), encoding="utf-8"
        )
        made = FmuBuilder.build_FMU(
            folder / "rig.py",
            folder / "made",
            [folder / _SCENARIO],
            needsExecutionTool=True,
            canHandleVariableCommunicationStepSize=True,
        )
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_bytes(made.read_bytes())
        return 1 + sum(1 for _ in Rig(folder).ports())
