"""A library for Robot Framework: keywords for a bench on the roller rig.

    *** Settings ***
    Library          rollerrig.wsp_interface.robot
    Test Teardown    End Bench

    *** Test Cases ***
    No wheel locks on low adhesion
        Start Bench    speed=90 km/h    adhesion=low
        Brake    3.8 bar
        Wait Until Standstill
        Longest Lock Should Be Below    0.4 s

A bench that a test starts ends with this test at the latest. A bench that a Suite Setup starts is
there for all tests of the suite, and of the suites in it, and ends with the suite:

    *** Settings ***
    Library          rollerrig.wsp_interface.robot
    Suite Setup      Start Bench    speed=90 km/h    adhesion=low
    Suite Teardown   End Bench

Values are written with their units.

Source: Robot Framework 7.
"""

import contextlib
import itertools
import re
from pathlib import Path
from typing import Any

from robot.api import logger
from robot.api.deco import keyword, library
from robot.libraries.BuiltIn import BuiltIn

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface import own_bench
from rollerrig.wsp_interface.harness_client import Harness
from rollerrig.wsp_interface.sequences import conditions, play


@library(scope="GLOBAL", listener="SELF")
class Rig:
    """The keywords, and the present bench.

    There is one bench at a time. Its owner is the test or the suite that has started it.
    """

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self._bench: Harness | None = None
        self._folder = Path()
        self._owner = ""

    @property
    def _rig(self) -> Harness:
        if self._bench is None:
            raise ConfigError("no bench runs: begin with the keyword 'Start Bench'")
        return self._bench

    @keyword
    def start_bench(
        self,
        scenario: str = "",
        speed: str = "",
        adhesion: str = "",
        wsp: str = "reference",
        pacing: str = "lockstep",
        seed: int = 0,
        unit: str = "",
    ) -> None:
        """Starts a bench at a speed on an adhesion of configs/adhesion; ``wsp``: reference, none or
        fmu:FILE; ``unit``: the command that starts your unit, as in ``./unit {host} {port}``.
        """
        self.end_bench()
        self._owner, name = _running()
        self._folder = _new_folder(name)
        speed_m_s = conditions.quantity(speed, "m_s", "speed") if speed else None
        started = own_bench.start(
            self._folder,
            scenario,
            wsp=wsp,
            unit=unit,
            pacing=pacing,
            seed=seed,
            initial_speed_m_s=speed_m_s,
            adhesion=adhesion,
        )
        self._bench = self._stack.enter_context(started)

    @keyword
    def end_bench(self) -> None:
        """Ends the bench, and shows in the log how it stood, its plot and where its record is.

        Fails if not valid.
        """
        if self._bench is None:
            return
        state = repr(self._bench)
        self._bench = None
        self._stack.close()
        plot = own_bench.draw(self._folder)
        logger.info(f"{state}\nrun: {self._folder}")
        if plot.is_file():
            logger.info(user_files.read_text(plot, user_files.PAGE, within=plot.parent), html=True)
        own_bench.check_valid(own_bench.summary(self._folder))

    @keyword
    def brake(self, pressure: str) -> None:
        """Asks for a brake cylinder pressure: ``Brake    3.8 bar``."""
        self._rig.brake(conditions.quantity(pressure, "Pa", "pressure"))

    @keyword
    def release_brakes(self) -> None:
        """Releases the brakes."""
        self._rig.release()

    @keyword
    def adhesion(self, surface: str, axle: int = 0) -> None:
        """Sets what is under the wheels from now on: a name of configs/adhesion, or a kinematic
        friction, or 0.
        """
        mu: float | None
        try:
            mu = float(surface)
        except ValueError:
            content, _ = store.load("adhesion", surface)
            mu = content.get("adhesion", {}).get("mu_cd")
        if mu is None:
            raise ConfigError(
                f"adhesion '{surface}' does not state mu_cd; give the kinematic friction as a number"
            )
        self._rig.friction(mu, [axle] if axle else None)

    @keyword
    def inject(self, fault: str, *parameters: str) -> None:
        """Lets a fault of the catalogue begin:

        ``Inject    speed_sensor_stuck    axle=2    for=3``
        """
        self._rig.inject(" ".join((fault, *parameters)))

    @keyword
    def lift(self, fault: str, *parameters: str) -> None:
        """Lifts a fault: ``Lift    speed_sensor_stuck    axle=2``."""
        self._rig.lift(" ".join((fault, *parameters)))

    @keyword
    def note(self, text: str) -> None:
        """Puts a note into the events of the run."""
        self._rig.note(text)

    @keyword
    def let_pass(self, duration: str) -> None:
        """Lets simulated time pass: ``Let Pass    2 s``."""
        self._rig.wait(conditions.quantity(duration, "s", "duration"))

    @keyword
    def wait_until(self, condition: str, timeout: str = "300 s") -> None:
        """Waits until a condition holds:

        ``Wait Until    every cylinder_pressure > 3 bar    timeout=5 s``
        """
        wanted = self._condition(condition)
        self._rig.until(
            lambda: wanted.holds(self._rig.values),
            conditions.quantity(timeout, "s", "timeout"),
            name=f"'{condition}'",
            readings=lambda: wanted.readings(self._rig.values),
        )

    @keyword
    def wait_until_speed_below(self, speed: str, timeout: str = "300 s") -> None:
        """Waits until the vehicle is slower: ``Wait Until Speed Below    30 km/h``."""
        limit_m_s = conditions.quantity(speed, "m_s", "speed")
        self._rig.until(
            lambda: self._rig.vehicle_speed_m_s < limit_m_s,
            conditions.quantity(timeout, "s", "timeout"),
            name=f"'speed below {speed}'",
        )

    @keyword
    def wait_until_standstill(self, timeout: str = "300 s") -> None:
        """Waits until the vehicle stands."""
        self._rig.stop(conditions.quantity(timeout, "s", "timeout"))

    @keyword
    def longest_lock_should_be_below(self, limit: str) -> None:
        """Fails where a wheelset was locked for longer:

        ``Longest Lock Should Be Below    0.4 s``
        """
        self._below("longest lock", self._rig.longest_lock_s, limit, "s")

    @keyword
    def distance_should_be_below(self, limit: str) -> None:
        """Fails where the vehicle has run further since the bench began."""
        self._below("distance", self._rig.position_m, limit, "m")

    @keyword
    def should_hold(self, condition: str) -> None:
        """Fails where a condition does not hold now: ``Should Hold    any valve > 0.5``."""
        wanted = self._condition(condition)
        if not wanted.holds(self._rig.values):
            raise AssertionError(f"{condition}: it is {wanted.readings(self._rig.values)}")

    @keyword
    def limits_should_be_kept(self, criteria: str = "stop") -> None:
        """Fails where a limit of a profile of configs/criteria is not kept, with each figure
        against its limit.
        """
        missed = play.missed(self._rig, self._folder, criteria)
        if missed:
            raise AssertionError(missed)

    def _condition(self, text: str) -> conditions.Condition:
        """Return a condition for the vehicle of the bench."""
        return conditions.condition(text, "condition", self._rig.table)

    def _end_test(self, data: Any, result: Any) -> None:
        """End the bench of a test; Robot Framework calls this at the end of each test."""
        self._end_of(result.full_name)

    def _end_suite(self, data: Any, result: Any) -> None:
        """End the bench of a Suite Setup; Robot Framework calls this at the end of each suite."""
        self._end_of(result.full_name)

    def _end_of(self, name: str) -> None:
        """End the bench if the test or suite of this name has started it."""
        if self._owner == name:
            self.end_bench()

    @staticmethod
    def _below(name: str, value: float, limit: str, unit: str) -> None:
        text = f"{name} {value:.4g} {unit}, wanted below {limit}"
        logger.info(text)
        if not value < conditions.quantity(limit, unit, name):
            raise AssertionError(text)


def _running() -> tuple[str, str]:
    """Return the full name and the name of the running test, or of the suite whose setup runs."""
    robot_variables = BuiltIn()
    suite = str(robot_variables.get_variable_value("${SUITE NAME}"))
    test = robot_variables.get_variable_value("${TEST NAME}")
    if test:
        return f"{suite}.{test}", str(test)
    return suite, suite.rpartition(".")[2]


def _new_folder(name: str) -> Path:
    """Return an unused folder in Robot Framework's output, for a run of a test or suite."""
    out = Path(BuiltIn().get_variable_value("${OUTPUT DIR}"))
    safe_name = re.sub(r"\W+", "_", name)
    for number in itertools.count(1):
        folder = out / "rollerrig" / f"{safe_name}-{number}"
        if not folder.exists():
            break
    return folder
