"""A WSP that runs as an FMU: extracted, compiled where it is source code, and stepped once a SYNC.

Whatever goes wrong in it ends the process of the unit, which the bench hears as it hears of any unit that has died. A
step that does not return is ended by a thread that counts. What the FMU prints goes where this process prints.
Source: FMI 2.0.4 and 3.0.2, co-simulation; FMPy 0.3.
"""

import contextlib
import ctypes
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError, UnitError
from rollerrig.firmware_sim.fmu import fmu_file
from rollerrig.firmware_sim.fmu.fmu_file import Fitted
from rollerrig.firmware_sim.wsp import node
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.unit_map import SOURCES

_HUNG, _LOOK_S = 5, 0.1
_REFERENCE = signals.place("wsp_reference_speed", signals.WSP_NODE)


class Watch:
    """Ends the process when a call into an FMU does not return within `patience_s`.

    Counted in looks: a process that is stopped has not waited.
    """

    def __init__(self, patience_s: float) -> None:
        self._failure = _failures()
        self._calls, self._running, self._what, self._who, self._at_s = 0, False, "", "", 0.0
        threading.Thread(
            target=self._look, args=(patience_s,), name="step watch", daemon=True
        ).start()

    def over(self, at_s: float, who: str = "the FMU", what: str = "doStep") -> "Watch":
        """Watch what is done under `with`, at a time of the FMU. UnitError is raised where that fails."""
        self._at_s, self._who, self._what = at_s, who, what
        return self

    def __enter__(self) -> None:
        self._calls += 1
        self._running = True

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._running = False
        if isinstance(error, self._failure):
            raise UnitError(f"{self._who} has failed at {self._at_s:.3f} s: {error}") from None

    def _look(self, patience_s: float) -> None:
        call, looks = -1, 0
        while True:
            time.sleep(_LOOK_S)
            looks = looks + 1 if self._running and call == self._calls else 0
            call = self._calls
            if looks * _LOOK_S > patience_s:
                print(
                    f"{self._who} hangs: {self._what} at {self._at_s:.3f} s has not returned within {patience_s:g} s",
                    flush=True,
                )
                os._exit(_HUNG)


@contextlib.contextmanager
def initialising(who: str) -> Iterator[None]:
    """Raises UnitError for whatever FMPy raises meanwhile."""
    try:
        yield
    except UnitError:
        raise
    except Exception as error:  # FMPy's own are plain ones
        raise UnitError(f"{who} cannot be initialised: {error}") from None


class Fmu:
    """An FMU as the WSP of a unit. `patience_s`: how long a step may take before the process is ended."""

    hears: tuple[rig.Layout, ...] = (rig.SPEEDS, rig.PRESSURES)

    def __init__(self, fitted: Fitted, folder: Path, patience_s: float = 10.0) -> None:
        """Load it, extracted into a folder. Raises ConfigError, UnitError."""
        self._period_s, self._steps = fitted.period_s, 0
        self._begun = False
        self._fmu = open_fmu(fitted, folder)
        self._told = np.zeros(len(SOURCES))
        self._scales = np.array([scale for one in self.hears for scale in one.scales])
        self._inputs = _by_kind(fitted.inputs)
        self._outputs = _by_kind(fitted.outputs)
        self._watch = Watch(patience_s)

    def begin(self) -> None:
        fmu = self._fmu
        self._steps = 0
        with initialising("the FMU"):
            if self._begun:
                fmu.reset()
            else:
                fmu.instantiate()
            self._begun = True
            if hasattr(fmu, "setupExperiment"):
                fmu.setupExperiment(startTime=0.0)
                fmu.enterInitializationMode()
            else:
                fmu.enterInitializationMode(startTime=0.0)
            fmu.exitInitializationMode()

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        self._told[:] = counts * self._scales
        values = dict(zip(SOURCES, self._told.tolist(), strict=True))
        told = self._step(values)
        pairs = []
        for axle in range(1, signals.AXLES + 1):
            hold = told[f"hold_{axle}"] >= 0.5
            vent = told[f"vent_{axle}"] >= 0.5
            pairs.append(magnets.pair(hold, vent))
        reference = told.get("reference_speed")
        return magnets.pack(pairs), None if reference is None else signals.count(
            reference, _REFERENCE
        )

    def idle(self) -> None:
        self._step({})

    def stuck(self) -> int:
        return 0

    def sand(self) -> bool:
        return False

    def close(self) -> None:
        """Let it end in order, as far as it still can."""
        with contextlib.suppress(Exception):  # its run is over, and what has failed has been told
            if self._begun:
                self._fmu.terminate()
                self._fmu.freeInstance()

    def _step(self, values: dict[str, float]) -> dict[str, float]:
        """Set what is given, step by a period, and read the outputs. Raises UnitError."""
        fmu, time_s = self._fmu, self._steps * self._period_s
        with self._watch.over(time_s):
            if values:
                for kind, ports in self._inputs.items():
                    numbers = [port.factor * values[port.quantity] for port in ports]
                    whole = numbers if kind in _REAL else [round(number) for number in numbers]
                    getattr(fmu, f"set{kind}")([port.reference for port in ports], whole)
            ended = fmu.doStep(time_s, self._period_s)
            if ended and ended[1]:
                raise UnitError(f"the FMU asks to end at {time_s:.3f} s")
            self._steps += 1
            told: dict[str, float] = {}
            for kind, ports in self._outputs.items():
                read = getattr(fmu, f"get{kind}")([port.reference for port in ports])
                told |= {
                    port.quantity: float(value) / port.factor
                    for port, value in zip(ports, read, strict=True)
                }
        return told


_REAL = ("Real", "Float32", "Float64")


def _by_kind(ports: tuple[fmu_file.Port, ...]) -> dict[str, list[fmu_file.Port]]:
    """Ports by the type in whose name FMPy sets and gets them."""
    kinds: dict[str, list[fmu_file.Port]] = {}
    for port in ports:
        kinds.setdefault(port.kind, []).append(port)
    return kinds


def _failures() -> type[Exception]:
    from fmpy.fmi1 import FMICallException

    return FMICallException


def open_fmu(fitted: Fitted, folder: Path) -> Any:
    """An FMU of FMPy, its library loaded. Raises ConfigError."""
    from fmpy import extract, fmi2, fmi3

    description = fitted.description
    try:
        extract(fitted.path, folder)
        if fitted.sources:
            _compile(fitted, folder)
        kind = fmi2.FMU2Slave if description.fmiMajorVersion == 2 else fmi3.FMU3Slave
        return kind(
            guid=description.guid,
            unzipDirectory=str(folder),
            instanceName="wsp",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )
    except ConfigError:
        raise
    except Exception as error:  # FMPy's own are plain ones
        raise ConfigError(
            f"{fitted.path}: cannot be loaded: {error}; see that what it links to is installed"
        ) from None


def _compile(fitted: Fitted, folder: Path) -> None:
    """Compile the sources of an FMU. Raises ConfigError with the compiler's first error."""
    import fmpy

    binary, sources = folder / fitted.binary, folder / "sources"
    binary.parent.mkdir(parents=True, exist_ok=True)
    files = fitted.description.buildConfigurations[0].sourceFileSets
    defined = [
        f"-D{one.name}={one.value or ''}" for each in files for one in each.preprocessorDefinitions
    ]
    command = [
        "cc",
        "-shared",
        "-fPIC",
        "-O2",
        "-w",
        *defined,
        # sources may give all functions the prefix that they need where several FMUs are linked into one
        f"-DFMI{fitted.description.fmiMajorVersion}_OVERRIDE_FUNCTION_PREFIX",
        f"-I{sources}",
        f"-I{Path(fmpy.__file__).parent / 'c-code'}",
        "-o",
        str(binary),
        *(str(sources / name) for name in fitted.sources),
        "-lm",
    ]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "error" in line] or [
            done.stderr.strip()
        ]
        raise ConfigError(
            f"{fitted.path}: its sources do not compile: {errors[0]}; have it exported with a binary"
        )


def main(
    fitted: Fitted,
    bus_address: str,
    priority: int = 0,
    lockstep_s: float = 0.0,
    patience_s: float = 10.0,
) -> int:
    """Run an FMU on a bus until that ends; as `node.main`. Raises ConfigError, BusError, UnitError."""
    print_at_once()
    with tempfile.TemporaryDirectory(prefix="rollerrig-fmu-") as folder:
        unit = Fmu(fitted, Path(folder), patience_s)
        try:
            return node.serve(
                lambda bus: node.Unit(bus, unit, lockstep_s), bus_address, priority, lockstep_s
            )
        finally:
            unit.close()


def print_at_once() -> None:
    """Lines that we or the FMU print are not lost with the process."""
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    libc = ctypes.CDLL(None)
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), None, 1, 0)
