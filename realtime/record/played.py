"""What a run has played: the unit, the scenario, the vehicle and the seed, and whether it is valid.

The bench makes a `Unit` before the run (`unit_of`), and the summary contains it. Every record and
report makes a `Played` from the summary (`of_summary`) and writes its `facts` for people or its
`texts` for programs. What a user states with --about is written besides.
"""

import functools
import hashlib
import json
import os
import shutil
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

from rollerrig.configs import unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import validity
from rollerrig.wsp_interface import unit_choice

REFERENCE = "reference"
COMMAND = "command"
FMU = "fmu"
EXTERNAL = "external"
NONE = "none"
# a Python function, which only campaigns have
FUNCTION = "function"

NOT_STATED = "not stated"
# rows of a title block: what is recorded of the unit, and what only the user can state
UNIT_PLAYED = "unit played"
ABOUT_UNIT = ("unit under test", "version of the unit")
_PIECE = 1 << 20


class Unit(NamedTuple):
    """The unit that was played.

    kind: one of the constants of this file.
    command: the command line that started it; None without one.
    sha256: the hash of each file that is known to belong to it, by its name: the program and files
        in the command, FMUs, a mapping. Files that a program itself loads are not known, nor those
        of a command that its user may run but not read.
    version: of the reference unit, or that of the description of each FMU; None if not known.
    identity: the object 1018h of the unit of each group that has it: node, vendor_id, product_code,
        revision, serial; None if no unit has it or was asked.
    """

    kind: str
    command: str | None = None
    sha256: Mapping[str, str] = {}
    version: str | None = None
    identity: Sequence[Mapping[str, int | None]] | None = None


class Played(NamedTuple):
    """What a run has played; `unit` is None in records of older versions.

    random: whether the rig has drawn a random number; None if that is not known.
    valid: None if that is not known: the record of a sequence on a running bench is elsewhere.
    """

    unit: Unit | None
    scenario: str
    vehicle: str
    seed: int | None
    random: bool | None
    version: str
    config_hash: str
    valid: bool | None
    invalid_because: tuple[str, ...]

    def facts(self) -> dict[str, str]:
        """Return what was played as rows for people."""
        return {
            UNIT_PLAYED: words(self.unit),
            "scenario": self.scenario,
            "vehicle": self.vehicle,
            "seed": self._seed_text(),
            "valid": self._validity_text(),
        }

    def _validity_text(self) -> str:
        if self.valid is None:
            return NOT_STATED
        return "yes" if self.valid else f"NO: {'; '.join(self.invalid_because)}"

    def _seed_text(self) -> str:
        if self.seed is None:
            return NOT_STATED
        if self.random is False:
            return f"{self.seed}, without effect: nothing in the rig was random"
        return str(self.seed)

    def texts(self) -> dict[str, str]:
        """Return what was played as texts for the metadata of a file.

        `unit_played` and `invalid_because` are JSON, `valid` is true, false or null.
        """
        return {
            "unit_played": json.dumps(None if self.unit is None else self.unit._asdict()),
            "scenario": self.scenario,
            "vehicle": self.vehicle,
            "seed": "" if self.seed is None else str(self.seed),
            "version": self.version,
            "config_hash": self.config_hash,
            "valid": json.dumps(self.valid),
            "invalid_because": json.dumps(self.invalid_because),
        }


@functools.cache
def version() -> str:
    """Return the version of this installation, read once: a campaign makes many summaries."""
    return metadata.version("rollerrig")


def of_summary(summary: Mapping[str, Any]) -> Played:
    """Return what the run of a summary has played; a run without a summary is not valid."""
    because = tuple(validity.because(summary))
    return Played(
        unit=unit_in(summary.get("unit_played")),
        scenario=str(summary.get("scenario") or NOT_STATED),
        vehicle=str(summary.get("vehicle") or NOT_STATED),
        seed=summary.get("seed"),
        random=summary.get("random"),
        version=str(summary.get("version") or NOT_STATED),
        config_hash=str(summary.get("config_hash") or NOT_STATED),
        valid=summary.get("valid") if summary else False,
        invalid_because=because,
    )


def unit_in(content: Any) -> Unit | None:
    """Return the unit that a summary or an evidence file contains; None if it contains none."""
    if not isinstance(content, Mapping) or "kind" not in content:
        return None
    known = {name: content[name] for name in Unit._fields if name in content}
    return Unit(**known)


# --- the unit ---


def unit_of(unit: str, unit_map: Path | None = None, started: str = "") -> Unit:
    """Return the unit of a run from its text in the options.

    `started`: the command with which another program starts an external unit. Raises ConfigError
    for a file that cannot be read.
    """
    command = unit_choice.command_of(unit) or started
    maps = [] if unit_map is None else [unit_map]
    if command:
        files = _files_of_command(unit_choice.command_words(command, ""))
        return Unit(COMMAND, command=command, sha256=sha256_of([*files, *maps]))
    fmus = unit_choice.fmus_of(unit)
    if fmus:
        versions = [_version_of_fmu(fmu) for fmu in fmus]
        stated = ", ".join(filter(None, versions))
        return Unit(FMU, sha256=sha256_of([*fmus, *maps]), version=stated or None)
    if unit == REFERENCE:
        return Unit(REFERENCE, version=version())
    if unit in (EXTERNAL, NONE):
        return Unit(unit, sha256=sha256_of(maps))
    return Unit(FUNCTION, command=unit)


def words(unit: Unit | None) -> str:
    """Return a unit in words for people."""
    if unit is None:
        return f"{NOT_STATED} in this record"
    if unit.kind == NONE:
        return "none"
    beginnings = {
        REFERENCE: "reference WSP of rollerrig (simulated)",
        COMMAND: f"command {unit.command}",
        FMU: "FMU",
        EXTERNAL: "unknown unit on the bus",
        FUNCTION: f"Python function {unit.command}",
    }
    parts = [beginnings.get(unit.kind, unit.kind)]
    if unit.version:
        parts.append(f"version {unit.version}")
    parts += [f"{name}: SHA-256 {digest}" for name, digest in unit.sha256.items()]
    for one in unit.identity or ():
        known = {key: value for key, value in one.items() if value is not None and key != "node"}
        numbers = ", ".join(f"{key} {value:X}h" for key, value in known.items())
        parts.append(f"identity of node {one['node']} (1018h): {numbers}")
    if unit.kind == EXTERNAL and not unit.identity:
        parts.append("without an identity object (1018h)")
    return "; ".join(parts)


def contradictions(units: Iterable[Unit | None], about: Mapping[str, str]) -> list[str]:
    """Return a warning if --about names a unit, and no unit of the user was played."""
    stated = {}
    for key, text in about.items():
        if key.strip().lower() in ABOUT_UNIT and REFERENCE not in text.lower():
            stated[key] = text
    kinds = {NOT_STATED if unit is None else unit.kind for unit in units}
    if not stated or not kinds or not kinds <= {REFERENCE, NONE}:
        return []
    shown = " and ".join(f"'{key}={text}'" for key, text in stated.items())
    was_played = "the reference unit of rollerrig was" if REFERENCE in kinds else "no unit was"
    return [
        f"the record contradicts --about {shown}: {was_played} played; play your unit with --unit "
        "COMMAND, --wsp external or --wsp fmu:FILE"
    ]


# --- the files of a unit ---


def sha256_of(files: Iterable[Path]) -> dict[str, str]:
    """Return the SHA-256 of files by their names as given. Raises ConfigError."""
    return {str(file): sha256(file) for file in files}


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file. Raises ConfigError if it cannot be read."""
    found = hashlib.sha256()
    with user_files.open_binary(path, user_files.RRD) as file:
        while block := file.read(_PIECE):
            found.update(block)
    return found.hexdigest()


def _files_of_command(command: list[str]) -> list[Path]:
    """Return the program of a command and the files among its words, as in --config=unit.toml.

    Files that this user may not read are left out: a program may be allowed to be run only.
    """
    files = []
    program = shutil.which(command[0])
    if program:
        files.append(Path(program))
    for word in command[1:]:
        for text in (word, word.partition("=")[2]):
            # os.path, because Path raises an error for a name that is too long or contains NUL
            if text and os.path.isfile(text):
                files.append(Path(text))
    return [file for file in files if os.access(file, os.R_OK, effective_ids=True)]


def _version_of_fmu(path: Path) -> str:
    """Return the version that the description of an FMU states; "" without one."""
    try:
        with zipfile.ZipFile(path) as archive:
            content = unpacking.read_xml(archive, "modelDescription.xml", str(path))
    except (ConfigError, OSError, KeyError, zipfile.BadZipFile):
        return ""  # the check of the FMU reports it
    return ElementTree.fromstring(content).get("version", "")
