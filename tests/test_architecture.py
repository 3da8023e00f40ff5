"""Who may import whom: the table of rooms, read from every source file."""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = ("rig", "firmware_sim", "wsp_interface", "realtime", "configs")
# outside packages of each part of the house; the longest prefix that fits a file counts
OUTSIDE = {
    "rig": {"numpy", "numba"},
    "rig/multibody": {"numpy", "numba", "llvmlite"},  # numba's own: a compiled function by its name
    "rig/identify": {"numpy", "numba", "scipy", "pyarrow", "threadpoolctl", "matplotlib",
                     "asammdf"},
    "firmware_sim": {"numpy", "can", "canopen", "pymodbus"},
    "wsp_interface": {"numpy", "can", "canopen", "tomli_w", "cantools", "pytest"},  # pytest: a fixture's own
    "configs": set(),
}
# rooms and modules of our own; realtime, which composes, may take all of them
INSIDE = {
    "rig": ("configs", "rig"),
    "rig/multibody": ("configs", "rig"),
    "rig/identify": ("configs", "rig"),
    "firmware_sim": ("configs", "firmware_sim", "wsp_interface", "rig.kernel"),
    "wsp_interface": ("configs", "wsp_interface"),
    "configs": ("configs",),
    "realtime": ROOMS,
}
DRAWS = {"recorder", "live", "views", "viewer", "drawing", "scene", "study_view", "verb_explain"}
PACKAGES = {"contact", "multibody"}
# what each file of the physics may know of its siblings; only the plant names them all
SIBLINGS = {
    "kernel": set(), "state_type": set(), "state": {"state_type"}, "params": {"effects", "mechanisms"},
    "brake": {"kernel", "state"}, "motor": {"kernel", "state"}, "vehicle": {"kernel", "state"},
    "wheelset": {"kernel", "state", "vehicle"},
}


def sources(room):
    return sorted(path for path in (ROOT / room).rglob("*.py") if "__pycache__" not in path.parts)


def imports(path):
    """Full names of all that a file imports, also inside functions; relative ones resolved."""
    found = set()
    package = ".".join(("rollerrig", *path.relative_to(ROOT).parent.parts))
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                base = ".".join(filter(None, [package.rsplit(".", node.level - 1)[0], base]))
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


def rule(table, path):
    """The entry of a table that fits a file best."""
    inside = path.relative_to(ROOT).as_posix()
    fits = [key for key in table if inside.startswith(f"{key}/")]
    return table[max(fits, key=len)] if fits else None


def begins(name, prefixes):
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


FILES = [path for room in ROOMS for path in sources(room)]
NAMES = [path.relative_to(ROOT).as_posix() for path in FILES]


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_a_file_imports_only_rooms_that_it_may(path):
    allowed = rule(INSIDE, path)
    own = {name.removeprefix("rollerrig.") for name in imports(path) if begins(name, ["rollerrig"])}
    assert {name for name in own if not begins(name, allowed)} == set()


@pytest.mark.parametrize("path", FILES, ids=NAMES)
def test_a_file_imports_only_outside_packages_that_it_may(path):
    allowed = rule(OUTSIDE, path)
    if allowed is None:
        return  # realtime, which composes
    outside = {name.partition(".")[0] for name in imports(path)} - {"rollerrig"}
    assert outside - set(sys.stdlib_module_names) - allowed == set()


def test_nothing_but_realtime_imports_realtime():
    users = {path.relative_to(ROOT).parts[0] for path in FILES
             if any(begins(name, ["rollerrig.realtime"]) for name in imports(path))}
    assert users == {"realtime"}


def test_the_physics_does_not_know_its_identification():
    for path in sources("rig"):
        if "identify" not in path.parts:
            assert not any(begins(name, ["rollerrig.rig.identify"]) for name in imports(path)), path


@pytest.mark.parametrize("stem", SIBLINGS)
def test_only_the_plant_names_all_of_the_physics(stem):
    own = {name.split(".")[2] for name in imports(ROOT / "rig" / f"{stem}.py")
           if begins(name, ["rollerrig.rig"])}
    assert own - PACKAGES <= SIBLINGS[stem]
    named = {name.split(".")[2] for name in imports(ROOT / "rig" / "plant.py")
             if begins(name, ["rollerrig.rig"])}
    assert named >= {"brake", "motor", "wheelset", "vehicle"}


def test_only_what_draws_imports_rerun():
    users = {path.stem for path in sources("realtime")
             if any(begins(name, ["rerun"]) for name in imports(path))}
    assert {"recorder", "live", "views"} <= users <= DRAWS


def test_rooms_are_never_imported_under_their_bare_names():
    # PyPI has other packages called rig and realtime
    for path in FILES:
        assert not any(begins(name, ROOMS) for name in imports(path)), path


def test_every_package_says_what_it_is_and_holds_nothing_else():
    for path in FILES:
        if path.name == "__init__.py":
            body = ast.parse(path.read_text(encoding="utf-8")).body
            assert len(body) == 1, path
            assert isinstance(body[0], ast.Expr), path


def test_every_file_begins_with_what_happens_in_it():
    for path in FILES:
        assert ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))), path
