"""Which WSP unit a run gets, as text, and which units data may choose.

An FMU is a program: it runs with the rights of the user. The user allows an FMU by writing it on
the command line (`--wsp fmu:FILE`). A file, a page or a recorded run is data, and data starts no
program. It may choose an FMU only if the user has allowed this file with `--allow-unit FILE`.
"""

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs.errors import ConfigError

# units that run no code of other people
NAMES = ("reference", "external", "none")
# how an FMU is written: fmu:FILE, and several as fmu:FILE,fmu:FILE
FMU = "fmu:"
# the option of the command line that adds a file to the allow-list
ALLOW_UNIT = "--allow-unit"

_ALLOWED_TEXTS = f"{', '.join(NAMES)}, {FMU}FILE"


def check(unit: str) -> str:
    """Return the text of a unit unchanged. Raises ConfigError if it is not the text of a unit."""
    if unit in NAMES or (unit.startswith(FMU) and all(map(str.strip, _files(unit)))):
        return unit
    raise ConfigError(f"{unit!r}: choose from {_ALLOWED_TEXTS}")


def fmus_of(unit: str) -> tuple[Path, ...]:
    """Return the files of fmu:FILE,fmu:FILE; none for another unit."""
    return tuple(map(Path, _files(unit)))


def _files(unit: str) -> list[str]:
    if not unit.startswith(FMU):
        return []
    return re.split(f"(?:^|,){FMU}", unit)[1:]


class AllowList(NamedTuple):
    """The FMUs that data may choose, as absolute paths without symbolic links.

    The empty list allows the units that run no code of other people: reference, external, none.
    """

    files: tuple[Path, ...] = ()

    @classmethod
    def of(cls, files: "list[Path] | tuple[Path, ...]") -> "AllowList":
        """Return the list of the files of `--allow-unit`. Raises ConfigError if one is missing."""
        allowed = []
        for file in files:
            if not file.is_file():
                raise ConfigError(
                    f"{ALLOW_UNIT} {file}: there is no such file; give the path of an FMU"
                )
            allowed.append(file.resolve())
        return cls(tuple(allowed))

    def check(self, unit: str, where: str) -> str:
        """Return a unit that data has chosen, unchanged.

        `where` begins the message: the file and line, or the field of a page. Raises ConfigError if
        `unit` is not the text of a unit, or needs an FMU that is not in this list.
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
        return unit


# allows no FMU
NOTHING = AllowList()
