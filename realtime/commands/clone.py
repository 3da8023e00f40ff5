"""Loads modules from the `tests` folder of a clone, for the commands that need one.

The installed package holds what a user needs. The benchmarks of the project itself, its endurance
runs, the sealed benchmark and the tables of the paper are in `tests/`, which only a clone has. The
clone is found from the location of this file, so the commands work from any folder.
"""

import importlib
import sys
from pathlib import Path
from types import ModuleType

from rollerrig.configs.errors import ConfigError

# a clone has the rooms and `tests` in one folder; an installed package has no such folder
TESTS = Path(__file__).resolve().parents[2] / "tests"


def load(name: str, command: str) -> ModuleType:
    """Return the module `name`, a dotted path below `tests`, as in `benchmarks.contact`.

    `command` is what the user called; the error message names it. Raises ConfigError where
    rollerrig is installed without a clone.
    """
    file = TESTS.joinpath(*name.split(".")).with_suffix(".py")
    if not file.is_file():
        raise ConfigError(
            f"{command} needs {name.replace('.', '/')}.py of the folder tests, which the installed "
            "package does not have; clone the repository of rollerrig, run `make demo` there once, "
            "and use .venv/bin/rollerrig of the clone"
        )
    # worker processes inherit this path, and find functions of these modules by their names
    if str(TESTS) not in sys.path:
        sys.path.insert(0, str(TESTS))
    return importlib.import_module(name)
