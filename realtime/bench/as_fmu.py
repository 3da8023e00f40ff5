"""The rig of a scenario as an FMU for other simulation tools: FMI 3, co-simulation.

The FMU runs in Python with rollerrig. It advances as a free run does, in whole ticks. Its inputs
are magnets, brake demand and friction. Its outputs are what a WSP unit receives, by the names that
such a unit has as an FMU, with loads, adhesion and motion. Kernels are compiled at instantiation.
Source: FMI 3.0.2; PythonFMU3 0.3.
"""

import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import make_folder, write_bytes, writing
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.bench.free import Stop
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.loop import ring, tick
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, VENT_MAGNET
from rollerrig.wsp_interface.signals import AXLES

STEP_S = 0.01
# resources of the FMU: the resolved scenario, and the name of the model
_SCENARIO = "scenario.toml"
_NAME = "model_name.txt"
# the rig never ends its run: the importing tool decides
_ENDLESS = 1 << 60
# how far a step may be from a whole number of ticks, in ticks
_ROUNDING = 1e-6
_UNITS = {
    "m/s": {"m": 1, "s": -1},
    "m": {"m": 1},
    "rad/s": {"rad": 1, "s": -1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "N": {"kg": 1, "m": 1, "s": -2},
}
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
# The program in every FMU. It is the same for all scenarios: nothing of a scenario, not even its
# name, becomes part of a program.
_SCRIPT = '''"""The rig of a scenario. Python with rollerrig must be installed where this runs."""

from pythonfmu3 import Fmi3Slave
from rollerrig.realtime.bench import as_fmu


class Rig(Fmi3Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.rig = as_fmu.Rig(self.resources)
        self.modelName = self.rig.name
        as_fmu.declare(self, self.rig)

    def do_step(self, current_time, step_size):
        return self.rig.step(step_size)
'''


class Port(NamedTuple):
    """A variable of the FMU; `set` is None for an output."""

    name: str
    text: str
    unit: str | None
    get: Callable[[], Any]
    set: Callable[[Any], None] | None = None
    boolean: bool = False


class Rig:
    """A rig at its initial speed, ready to be stepped; `resources` holds its scenario.

    `name` is the name of the model. Raises ConfigError.
    """

    def __init__(self, resources: str | Path) -> None:
        """Build and compile it."""
        plan = scenario.load(str(Path(resources) / _SCENARIO))
        self.name = (Path(resources) / _NAME).read_text(encoding="utf-8")
        self.time_s = 0.0
        self._tick_hz = plan["loop"]["tick_hz"]
        data = tick_data.build(plan, ring.Memory(1, len(signals.COLUMNS)))
        data = data._replace(end_tick=_ENDLESS, stand_ticks=_ENDLESS)
        self._stop = Stop(plan, data, "none")
        tick_data.warm_up(self._stop.data, "free")

    def step(self, step_s: float) -> Any:
        """Advance by whole ticks; return the result of the step as PythonFMU3 has it."""
        from pythonfmu3 import Fmi3Status, Fmi3StepResult

        ticks = round(step_s * self._tick_hz)
        if ticks < 1 or abs(ticks - step_s * self._tick_hz) > _ROUNDING:
            print(
                f"rollerrig: a step of {step_s:g} s is not a whole number of ticks of "
                f"{1.0 / self._tick_hz:g} s",
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
        """Yield all variables, inputs first."""
        command = self._stop.data.commands.values
        for axle in range(AXLES):
            yield _magnet_port(command, axle, "hold", HOLD_MAGNET)
            yield _magnet_port(command, axle, "vent", VENT_MAGNET)
        yield _demand_port(command)
        for axle in range(AXLES):
            yield _friction_port(command, axle)
        for name, signal, unit in _OUTPUTS:
            yield from _output_ports(self._stop.data.row, name, signal, unit)


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
    )


def _friction_port(command: np.ndarray, axle: int) -> Port:
    place = tick.FRICTION + axle

    def get() -> float:
        return float(command[place])

    def contaminate(friction: Any) -> None:
        command[place] = max(friction, 0.0)

    return Port(
        f"friction_{axle + 1}",
        "kinematic friction of the contaminant under the axle; 0: as in the scenario",
        None,
        get,
        contaminate,
    )


def _output_ports(row: np.ndarray, name: str, signal: str, unit: str | None) -> Iterator[Port]:
    """Yield the ports of a signal, one for each axle that it has."""
    place = signals.span(signal)
    many = signals.BY_NAME[signal].axles > 1
    for at in range(place.start, place.stop):
        yield Port(
            f"{name}_{at - place.start + 1}" if many else name,
            signals.BY_NAME[signal].text,
            unit,
            lambda at=at: float(row[at]),
        )


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
        common = {
            "causality": Fmi3Causality.input if port.set else Fmi3Causality.output,
            "getter": port.get,
            "setter": port.set,
            "description": port.text,
        }
        if port.boolean:
            variable = Boolean(port.name, variability=Fmi3Variability.discrete, **common)
        else:
            variable = Float64(
                port.name,
                variability=Fmi3Variability.continuous,
                unit=port.unit,
                **common,
            )
        slave.register_variable(variable)


def write(plan: Scenario, out: Path) -> int:
    """Write the FMU of a scenario; return how many variables it has. Raises ConfigError."""
    try:
        from pythonfmu3 import FmuBuilder
    except ImportError:
        raise ConfigError("FMUs need the extra: pip install 'rollerrig[fmu]'") from None
    with tempfile.TemporaryDirectory(prefix="rollerrig-fmu-") as place, writing(out):
        folder = Path(place)
        (folder / _SCENARIO).write_text(scenario.dump(plan), encoding="utf-8")
        (folder / _NAME).write_text(_identifier(plan.name), encoding="utf-8")
        (folder / "rig.py").write_text(_SCRIPT, encoding="utf-8")
        made = FmuBuilder.build_FMU(
            folder / "rig.py",
            folder / "made",
            [folder / _SCENARIO, folder / _NAME],
            needsExecutionTool=True,
            canHandleVariableCommunicationStepSize=True,
        )
        make_folder(out.parent)
        write_bytes(out, made.read_bytes())
        variables = sum(1 for _ in Rig(folder).ports())
        return 1 + variables  # with time


def _identifier(name: str) -> str:
    """Return the name of a scenario as an identifier of FMI."""
    identifier = re.sub(r"\W", "_", name, flags=re.ASCII)
    return identifier if re.match("[A-Za-z_]", identifier) else f"rig_{identifier}"
