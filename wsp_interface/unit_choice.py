"""Which WSP unit a run gets, as text, and which units data may choose.

A unit may be a program of the user, which a command line starts for each run: `command:./unit
{host} {port}`. `{address}`, `{host}` and `{port}` are replaced by those of the bus, `{car}` by the
number of the car in a train (1: a vehicle alone).

An FMU and a command are programs: they run with the rights of the user. The user allows one by
writing it on the command line (`--wsp fmu:FILE`, `--unit COMMAND`). A file, a page or a recorded
run is data, and data starts no program. It may choose an FMU or a command only if the user has
allowed exactly this one, with `--allow-unit FILE` or `--allow-unit 'command:COMMAND'`.
"""

import re
import shlex
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, Kind

# units that run no code of other people
NAMES = ("reference", "external", "none")
# how an FMU is written: fmu:FILE, and several as fmu:FILE,fmu:FILE
FMU = "fmu:"
# how a program of the user is written: command:LINE
COMMAND = "command:"
# what a command may contain, for the bus of its run
_PLACES = ("address", "host", "port", "car")
# the option of the command line that adds a file to the allow-list
ALLOW_UNIT = "--allow-unit"

_ALLOWED_TEXTS = f"{', '.join(NAMES)}, {FMU}FILE, {COMMAND}LINE"


def check(unit: str) -> str:
    """Return the text of a unit unchanged. Raises ConfigError if it is not the text of a unit."""
    if unit in NAMES or (unit.startswith(FMU) and all(map(str.strip, _files(unit)))):
        return unit
    if unit.startswith(COMMAND):
        command_words(command_of(unit), "")
        return unit
    raise ConfigError(f"{unit!r}: choose from {_ALLOWED_TEXTS}")


def command_of(unit: str) -> str:
    """Return the command of command:LINE; "" for another unit."""
    return unit.removeprefix(COMMAND) if unit.startswith(COMMAND) else ""


def command_words(
    command: str, address: str, host: str = "", port: int = 0, car: int = 1
) -> list[str]:
    """Return the words of a command, with the address of the bus and its car in their places.

    Raises ConfigError if the command is empty, is not a command line, or has another place.
    """
    remedy = "write a command line, as in './unit {host} {port}'"
    places = {"address": address, "host": host, "port": str(port), "car": str(car)}
    try:
        words = shlex.split(command)
        filled = [word.format(**places) for word in words]
    except KeyError as error:
        raise ConfigError(
            f"unit {command!r}: {{{error.args[0]}}} is not known; allowed are "
            f"{', '.join(f'{{{place}}}' for place in _PLACES)}, and a brace is written twice"
        ) from None
    except (ValueError, IndexError, AttributeError) as error:
        raise ConfigError(f"unit {command!r}: {error}; {remedy}") from None
    if not words:
        raise ConfigError(f"the command of the unit is empty; {remedy}")
    return filled


def vehicle_options(kind: Kind, group: int = 0) -> list[str]:
    """Return the options of `rollerrig wsp` for the unit of a group (from 0) of a vehicle.

    The unit of the coach needs none.
    """
    words = []
    if kind.axles != COACH.axles:
        words += ["--axles", str(kind.axles)]
    if kind.dynamic_brake:
        words.append("--dynamic-brake")
    if group > 0:
        words += ["--group", str(group + 1)]
    return words


def fmus_of(unit: str) -> tuple[Path, ...]:
    """Return the files of fmu:FILE,fmu:FILE; none for another unit."""
    return tuple(map(Path, _files(unit)))


def _files(unit: str) -> list[str]:
    if not unit.startswith(FMU):
        return []
    return re.split(f"(?:^|,){FMU}", unit)[1:]


class AllowList(NamedTuple):
    """The programs that data may choose as a unit.

    `files` are FMUs, as absolute paths without symbolic links. `commands` are command lines. The
    empty list allows the units that run no code of other people: reference, external, none.
    """

    files: tuple[Path, ...] = ()
    commands: tuple[str, ...] = ()

    @classmethod
    def of(cls, units: "Iterable[Path | str]") -> "AllowList":
        """Return the list of the values of `--allow-unit`: files, or texts command:LINE.

        Raises ConfigError if a file is missing, or a command is none.
        """
        files: list[Path] = []
        commands: list[str] = []
        for unit in units:
            if str(unit).startswith(COMMAND):
                commands.append(command_of(check(str(unit))))
                continue
            file = Path(unit)
            if not file.is_file():
                raise ConfigError(
                    f"{ALLOW_UNIT} {file}: there is no such file; give the path of an FMU, or "
                    f"{COMMAND}LINE for a command"
                )
            files.append(file.resolve())
        return cls(tuple(files), tuple(commands))

    def check(self, unit: str, where: str) -> str:
        """Return a unit that data has chosen, unchanged.

        `where` begins the message: the file and line, or the field of a page. Raises ConfigError if
        `unit` is not the text of a unit, or needs a program that is not in this list.
        """
        try:
            check(unit)
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None
        for file in fmus_of(unit):
            if file.resolve() not in self.files:
                # a user pastes the option into a shell, where a name must not become a command
                quoted = shlex.quote(str(file))
                raise ConfigError(
                    f"{where}: {FMU}{file} is a program, and data starts no program; if you trust "
                    f"this file, allow it on the command line with {ALLOW_UNIT} {quoted}"
                )
        command = command_of(unit)
        if command and command not in self.commands:
            raise ConfigError(
                f"{where}: {unit} is a program, and data starts no program; if you trust it, allow "
                f"it on the command line with {ALLOW_UNIT} {shlex.quote(unit)}"
            )
        return unit


# allows no program
NOTHING = AllowList()
