"""A WSP unit that is an FMU with signals: extracted, compiled if it has sources only, and stepped
once a SYNC.

A failure of the FMU stops the process of the unit, and the bench notices that as with any unit. An
output that is no finite number is a failure, because no magnet can be read from it. A watching
thread stops the process if a step does not return. What the FMU prints goes to the standard output
of this process.
Source: FMI 2.0.4 and 3.0.2, co-simulation; FMPy 0.3.
"""

import contextlib
import ctypes
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs import unpacking
from rollerrig.configs.errors import ConfigError, UnitError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.firmware_sim.fmu import fmu_file
from rollerrig.firmware_sim.fmu.fmu_file import CheckedFmu
from rollerrig.firmware_sim.fmu.fmu_log import FmuLog
from rollerrig.firmware_sim.wsp import node
from rollerrig.wsp_interface import magnets, signals
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.unit_map import mapping

_EXIT_STATUS_HANGS = 5
_WATCH_PERIOD_S = 0.1
_REFERENCE_SPEED = signals.first_place("wsp_reference_speed")
# an output that is a number means an energised magnet from here on
_ENERGISED_FROM = 0.5
_REAL_TYPES = ("Real", "Float32", "Float64")


class Watch:
    """Stops the process when a call into an FMU does not return within `patience_s`.

    The time is counted in checks, not by a clock, so that a process that was paused is not stopped.
    """

    def __init__(self, patience_s: float) -> None:
        self._failure = _failures()
        self._log: FmuLog | None = None
        self._calls = 0
        self._running = False
        self._name = ""
        self._action = ""
        self._at_s = 0.0
        threading.Thread(
            target=self._check, args=(patience_s,), name="step watch", daemon=True
        ).start()

    def call(
        self,
        at_s: float,
        name: str = "the FMU",
        action: str = "doStep",
        log: FmuLog | None = None,
    ) -> "Watch":
        """Return this watch for a `with` block, which makes a call at a time of the FMU.

        The block raises UnitError if the call fails, with the last messages of the log. `name` and
        `action` are for messages.
        """
        self._log = log
        self._at_s = at_s
        self._name = name
        self._action = action
        return self

    def __enter__(self) -> None:
        self._calls += 1
        self._running = True

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._running = False
        if isinstance(error, self._failure):
            log = self._log.text() if self._log else ""
            raise UnitError(
                f"{self._name} has failed at {self._at_s:.3f} s: {error}{log}"
            ) from None

    def _check(self, patience_s: float) -> None:
        """Count for how many checks the same call has been running."""
        call = -1
        checks = 0
        while True:
            time.sleep(_WATCH_PERIOD_S)
            if self._running and call == self._calls:
                checks += 1
            else:
                checks = 0
            call = self._calls
            if checks * _WATCH_PERIOD_S > patience_s:
                print(
                    f"{self._name} hangs: {self._action} at {self._at_s:.3f} s has not returned "
                    f"within {patience_s:g} s",
                    flush=True,
                )
                os._exit(_EXIT_STATUS_HANGS)


@contextlib.contextmanager
def initialisation_of(name: str, log: FmuLog) -> Iterator[None]:
    """Raise UnitError for every exception of FMPy in the `with` block, with the FMU's messages."""
    try:
        yield
    except UnitError:
        raise
    except Exception as error:  # FMPy raises plain exceptions
        raise UnitError(f"{name} cannot be initialised: {error}{log.text()}") from None


class Fmu:
    """An FMU as the WSP of a unit, see `node.Wsp`.

    `frames`: those of the group of axles that it protects. `patience_s`: how long a step may take
    before the process is stopped. An FMU has inputs and outputs for the axles of a whole group. In
    a group with fewer axles, the further inputs repeat the speeds and pressures of the axles that
    are there, and the further outputs have no effect.
    """

    def __init__(
        self,
        checked: CheckedFmu,
        folder: Path,
        frames: rig.UnitFrames,
        patience_s: float = 10.0,
    ) -> None:
        """Extract the FMU into a folder and load it. Raises ConfigError, UnitError."""
        self.hears: tuple[rig.Layout, ...] = (frames.speeds, frames.pressures)
        self._axles = len(frames.speeds.names)
        self._sources = mapping.sources_of_group(checked.unit_axles)
        self._repeated = np.arange(checked.unit_axles) % self._axles  # the axle of each input
        self._period_s = checked.period_s
        self._steps = 0
        self._begun = False
        self._description = checked.description
        self._fmu = open_fmu(checked, folder)
        self._log = FmuLog()
        self._scales = np.array([scale for layout in self.hears for scale in layout.scales])
        self._inputs = _by_type(checked.inputs)
        self._outputs = _by_type(checked.outputs)
        self._watch = Watch(patience_s)

    def begin(self) -> None:
        fmu = self._fmu
        self._steps = 0
        with initialisation_of("the FMU", self._log):
            if self._begun:
                fmu.reset()
            else:
                self._log.instantiate(fmu, self._description)
            self._begun = True
            if hasattr(fmu, "setupExperiment"):
                # FMI 2
                fmu.setupExperiment(startTime=0.0)
                fmu.enterInitializationMode()
            else:
                fmu.enterInitializationMode(startTime=0.0)
            fmu.exitInitializationMode()

    def cycle(self, counts: np.ndarray) -> tuple[int, int | None]:
        # quantities of the input frames in SI units, one row each
        values = (counts * self._scales).reshape(len(self.hears), self._axles)
        of_inputs = values[:, self._repeated].ravel()
        inputs = dict(zip(self._sources, of_inputs.tolist(), strict=True))
        outputs = self._step(inputs)

        pairs = []
        for axle in range(1, self._axles + 1):
            hold = outputs[f"hold_{axle}"] >= _ENERGISED_FROM
            vent = outputs[f"vent_{axle}"] >= _ENERGISED_FROM
            pairs.append(magnets.pair(hold, vent))

        reference_count = None
        if "reference_speed" in outputs:
            reference_count = signals.count(outputs["reference_speed"], _REFERENCE_SPEED)
        return magnets.pack(pairs), reference_count

    def idle(self) -> None:
        self._step({})

    def stuck(self) -> int:
        return 0

    def permitted_shares(self) -> None:
        return None

    def sand(self) -> bool:
        return False

    def close(self) -> None:
        """Terminate the FMU as far as possible."""
        # the run is over, and a failure has been reported already
        with contextlib.suppress(Exception):
            if self._begun:
                self._fmu.terminate()
                self._fmu.freeInstance()

    def _step(self, inputs: dict[str, float]) -> dict[str, float]:
        """Set the inputs, if any, make a step of one period, and return the outputs.

        Inputs and outputs are in SI units, by quantity. Raises UnitError.
        """
        time_s = self._steps * self._period_s
        with self._watch.call(time_s, log=self._log):
            if inputs:
                self._set_inputs(inputs)
            step_result = self._fmu.doStep(time_s, self._period_s)
            # FMI 3 only: the second item is `terminateSimulation`
            if step_result and step_result[1]:
                raise UnitError(f"the FMU requests the end of the simulation at {time_s:.3f} s")
            self._steps += 1
            return self._get_outputs()

    def _set_inputs(self, inputs: dict[str, float]) -> None:
        for type_name, ports in self._inputs.items():
            values: list[float] = []
            for port in ports:
                value = port.factor * inputs[port.quantity]
                values.append(value if type_name in _REAL_TYPES else round(value))
            set_values = getattr(self._fmu, f"set{type_name}")
            set_values([port.reference for port in ports], values)

    def _get_outputs(self) -> dict[str, float]:
        outputs: dict[str, float] = {}
        for type_name, ports in self._outputs.items():
            get_values = getattr(self._fmu, f"get{type_name}")
            values = get_values([port.reference for port in ports])
            for port, value in zip(ports, values, strict=True):
                if not math.isfinite(value):
                    time_s = self._steps * self._period_s
                    raise UnitError(
                        f"the FMU has failed at {time_s:.3f} s: its output for {port.quantity} is "
                        f"{value}; allowed are finite numbers"
                    )
                outputs[port.quantity] = float(value) / port.factor
        return outputs


def _by_type(ports: Sequence[fmu_file.Port]) -> dict[str, list[fmu_file.Port]]:
    """Return the ports by their type, because FMPy has one setter and one getter for each type."""
    ports_by_type: dict[str, list[fmu_file.Port]] = {}
    for port in ports:
        ports_by_type.setdefault(port.kind, []).append(port)
    return ports_by_type


def _failures() -> type[Exception]:
    """Return the exception of FMPy for a call that fails."""
    from fmpy.fmi1 import FMICallException

    return FMICallException


def open_fmu(checked: CheckedFmu, folder: Path) -> Any:
    """Return an FMU of FMPy with its library loaded. Raises ConfigError."""
    from fmpy import extract, fmi2, fmi3

    description = checked.description
    try:
        unpacking.check_archive(checked.path)
        extract(checked.path, folder)
        if checked.sources:
            _compile(checked, folder)
        slave = fmi2.FMU2Slave if description.fmiMajorVersion == 2 else fmi3.FMU3Slave
        return slave(
            guid=description.guid,
            unzipDirectory=str(folder),
            instanceName="wsp",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )
    except ConfigError:
        raise
    except Exception as error:  # FMPy raises plain exceptions
        raise ConfigError(
            f"{checked.path}: the FMU cannot be loaded: {error}; install the libraries that it needs"
        ) from None


def _compile(checked: CheckedFmu, folder: Path) -> None:
    """Compile the sources of an FMU. Raises ConfigError with the first error of the compiler."""
    import fmpy

    binary = folder / checked.binary
    sources = folder / "sources"
    binary.parent.mkdir(parents=True, exist_ok=True)

    macros = []
    for file_set in checked.description.buildConfigurations[0].sourceFileSets:
        for macro in file_set.preprocessorDefinitions:
            macros.append(f"-D{macro.name}={macro.value or ''}")
    # sources may give all functions a prefix, which is for tools that link several FMUs into one
    macros.append(f"-DFMI{checked.description.fmiMajorVersion}_OVERRIDE_FUNCTION_PREFIX")

    fmi_headers = Path(fmpy.__file__).parent / "c-code"
    source_files = [str(sources / name) for name in checked.sources]
    options = ["-shared", "-fPIC", "-O2", "-w"]
    includes = [f"-I{sources}", f"-I{fmi_headers}"]
    command = ["cc", *options, *macros, *includes, "-o", str(binary), *source_files, "-lm"]

    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        errors = [line for line in done.stderr.splitlines() if "error" in line]
        first_error = errors[0] if errors else done.stderr.strip()
        raise ConfigError(
            f"{checked.path}: the sources of the FMU do not compile: {first_error}; "
            "export it with a binary for this machine"
        )


def main(
    checked: CheckedFmu,
    bus_address: str,
    priority: int = 0,
    lockstep_s: float = 0.0,
    patience_s: float = 10.0,
    group: int = 1,
    kind: Kind = COACH,
) -> int:
    """Run an FMU on a bus until the bus ends, as `node.main`. Returns 0.

    Raises ConfigError, BusError, UnitError.
    """
    flush_every_line()
    frames = node.frames_of_group(kind, group)
    with tempfile.TemporaryDirectory(prefix="rollerrig-fmu-") as folder:
        fmu = Fmu(checked, Path(folder), frames, patience_s)
        try:
            return node.serve(
                lambda bus: node.Unit(bus, fmu, frames, lockstep_s),
                bus_address,
                priority,
                lockstep_s,
            )
        finally:
            fmu.close()


def flush_every_line() -> None:
    """Flush every line that this process or the FMU prints, so that none is lost with the
    process.
    """
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    libc = ctypes.CDLL(None)
    line_buffered = 1  # _IOLBF of stdio.h on Linux
    libc.setvbuf(ctypes.c_void_p.in_dll(libc, "stdout"), None, line_buffered, 0)
