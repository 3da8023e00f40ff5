"""The licences of the packages that rollerrig uses, from the metadata of the installed packages.

`make docs` writes them to docs/licences.md. The packages are the dependencies of [project] in
pyproject.toml and of its extras, without the tools of developers, and all packages that these need.
The licence of a package is its SPDX expression, or else its classifiers, or else its licence field.
"""

import tomllib
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parent.parent
# extras with tools that no user needs
DEVELOPERS = ("dev", "docs")
# extras that are another name for one
SAME_AS = {"export": "mdf"}
REQUIRED = "always"
_CLASSIFIER = "License :: "
_NOT_DECLARED = "not declared, see the files of the package"
# parts of a licence's name that mark it as copyleft
_COPYLEFT = ("GPL", "GNU", "MPL", "Mozilla", "EPL", "CDDL", "EUPL")
_LONGEST = 80
_HEAD = """# Licences of dependencies

This page is for people who install, ship or audit rollerrig. After reading it you know the licence of each
package that rollerrig uses. `make docs` writes it from what the installed packages declare.

rollerrig is under the [Apache License 2.0](../LICENSE). It contains no code of these packages: `pip`
installs them next to it, and you can replace each of them by another version. An FMU that
`rollerrig export-fmu` writes contains the headers of FMI 3.0 (BSD-2-Clause). This page is no legal advice.

"""
_COPYLEFT_TEXT = """## Copyleft

The licences of these packages require more than a notice. If you pass such a package on, for example in
an image of an installed system, you must also pass on its licence and offer its source. rollerrig
imports these packages unchanged. Some of them are under several licences.

"""
_OTHERS_TEXT = """## All packages

"always" means that every installation needs the package. Otherwise the last column lists the extras
that need it, as in `pip install 'rollerrig[EXTRA]'`.

"""


class Package(NamedTuple):
    """A package: its name, the licence that it declares, and the extras that need it."""

    name: str
    licence: str
    needed_by: tuple[str, ...]

    @property
    def row(self) -> str:
        """The line of the table."""
        return f"| {self.name} | {self.licence} | {', '.join(self.needed_by)} |"


def packages() -> list[Package]:
    """Return all packages that are needed in this environment, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {REQUIRED: project["dependencies"]}
    for extra, requirements in project["optional-dependencies"].items():
        if extra not in DEVELOPERS and extra not in SAME_AS:
            groups[extra] = requirements

    needed_by: dict[str, list[str]] = {}
    for group, requirements in groups.items():
        for name in _needed(requirements):
            if REQUIRED not in needed_by.setdefault(name, []):
                needed_by[name].append(group)
    return [Package(name, licence(name), tuple(needed_by[name])) for name in sorted(needed_by)]


def _needed(requirements: list[str]) -> set[str]:
    """Return the names of required packages, and of all that they need in turn."""
    waiting = [Requirement(text) for text in requirements]
    seen = set()
    while waiting:
        requirement = waiting.pop()
        extras = tuple(sorted(requirement.extras))
        wanted = (canonicalize_name(requirement.name), extras)
        if wanted in seen:
            continue
        seen.add(wanted)
        for text in metadata.requires(requirement.name) or ():
            further = Requirement(text)
            if further.marker is None or any(
                further.marker.evaluate({"extra": extra}) for extra in ("", *extras)
            ):
                waiting.append(further)
    return {name for name, _ in seen}


def licence(name: str) -> str:
    """Return the licence that an installed package declares."""
    declared = metadata.metadata(name)
    expression = declared.get("License-Expression")
    if expression:
        return expression
    classifiers = [
        text.rpartition(" :: ")[2]
        for text in declared.get_all("Classifier") or ()
        if text.startswith(_CLASSIFIER)
    ]
    if classifiers:
        return ", ".join(classifiers)
    field = (declared.get("License") or "").strip().partition("\n")[0]
    return field[:_LONGEST] or _NOT_DECLARED


def is_copyleft(package: Package) -> bool:
    """Return whether the licence of a package requires more than a notice."""
    return any(mark in package.licence for mark in _COPYLEFT)


def markdown() -> str:
    """Return the page of licences."""
    all_packages = packages()
    copyleft = [package for package in all_packages if is_copyleft(package)]
    return _HEAD + _COPYLEFT_TEXT + _table(copyleft) + "\n" + _OTHERS_TEXT + _table(all_packages)


def _table(rows: list[Package]) -> str:
    lines = ["| package | licence | needed by |", "|---|---|---|"]
    lines += [package.row for package in rows]
    return "\n".join(lines) + "\n"
