"""The rooms of the house, their floors, their sizes: read from every source file.

A room (a folder, or a file beside folders) imports only from floors below its own. Every import counts:
inside functions and for types only, too.
"""

import ast
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# floors of each folder from the ground up, divided by a bar; rooms on one floor do not import one another
FLOORS = {
    "": "configs | rig wsp_interface | firmware_sim | realtime",
    "rig": "compiled | contact mechanisms | multibody | params state | "
    "brake heat motor surface vehicle | wheelset | lanes plant | identify",
    "rig/identify": "data | replay train_recorder | causes | decide | paper next_stops",
    "wsp_interface": "events | bus magnets signals | descriptions rig_objects | harness_client | own_bench unit_map | "
    "sequences | fixture robot | harness",
    "firmware_sim": "cia301 rig_control | nmt_master process_image rack wsp | "
    "bench_node drive402 encoder406 faults fmu io401 sander401 | modbus pole_wheel",
    "realtime": "broken_pipe loop pictures record | telemetry | bench | campaign | datasets | "
    "desk discover reports | benchmarks | commands | "
    "api cli",
}
# all that a room may import of a room below it, where that is less than everything
NARROW = {("firmware_sim", "rig"): {"rig/compiled/kernel"}}
# outside packages of each room; the longest prefix that fits a file counts
OUTSIDE = {
    "configs": "",
    "rig": "numpy",
    "rig/compiled": "numpy numba llvmlite",
    "rig/identify": "numpy scipy threadpoolctl",
    "rig/identify/data": "numpy scipy pyarrow asammdf",
    "rig/identify/train_recorder": "numpy scipy pyarrow rosbags",
    "wsp_interface": "numpy can canopen cantools tomli_w pytest robot",  # the last two: for tests of others
    "wsp_interface/bus": "can",
    "wsp_interface/sequences": "numpy can cantools",
    "firmware_sim": "numpy",
    "firmware_sim/cia301": "canopen",
    "firmware_sim/modbus": "numpy canopen pymodbus",
    "firmware_sim/wsp": "numpy can",
    "firmware_sim/fmu": "numpy can fmpy",
    "realtime": "",
    "realtime/loop": "numpy",
    "realtime/record": "numpy scipy pyarrow asammdf rich",
    "realtime/telemetry": "numpy rerun PIL",
    "realtime/bench": "numpy pyarrow pymodbus tomli_w pythonfmu3",
    "realtime/campaign": "numpy scipy pyarrow tomli_w distributed",
    "realtime/datasets": "numpy scipy tomli_w",
    "realtime/discover": "numpy scipy tomli_w",
    "realtime/reports": "numpy pyarrow matplotlib rich fpdf",
    "realtime/benchmarks": "numpy rich distributed pymodbus",
    "realtime/desk": "numpy nicegui fastapi pymodbus",
    "realtime/pictures": "numpy",
    "realtime/commands": "numpy rich tomli_w",
}
# these may call importlib.import_module: benchmarks by name, modules of a clone, a campaign's own unit, python-can
BY_COMPUTED_NAME = {
    "realtime/commands/bench",
    "realtime/campaign/campaign",
    "realtime/commands/clone",
    "realtime/cli",
}
MODULES = 16
# the folder that is the package `rollerrig` itself: what a notebook imports
DOOR = {"realtime/api": "rollerrig"}
# what does not hold yet; the mark goes when it does (a strict xfail that passes fails)
NOT_YET: dict[str, str] = {}


def unless_not_yet(kind, values):
    """Parameters of a test, those in NOT_YET marked."""
    rows = [(value, NOT_YET.get(f"{kind} {value}".rstrip())) for value in values]
    return [
        pytest.param(
            value,
            id=value or "house",
            marks=[pytest.mark.xfail(strict=True, reason=why)] if why else [],
        )
        for value, why in rows
    ]


ROOMS = FLOORS[""].replace("|", " ").split()
# every source file by its path without `.py`, a package by its folder
FILES = {
    (path.parent if path.name == "__init__.py" else path.with_suffix(""))
    .relative_to(ROOT)
    .as_posix(): path
    for room in ROOMS
    for path in sorted((ROOT / room).rglob("*.py"))
}
FOLDERS = [""] + [name for name, path in FILES.items() if path.name == "__init__.py"]
MODULE_FILES = [name for name in FILES if name not in FOLDERS]


@cache
def tree(name):
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


@cache
def imports(name):
    """Full dotted names of all that a file imports; relative ones resolved."""
    found = set()
    package = ["rollerrig", *FILES[name].relative_to(ROOT).parent.parts]
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = ".".join([*base, *filter(None, [node.module])])
            found |= {f"{base}.{alias.name}" for alias in node.names}
    return found


@cache
def own_imports(name):
    """Those of our own files that a file imports, named as in FILES; a package counts too."""
    found = set()
    for one in imports(name):
        parts = one.split(".")[1:] if one.startswith("rollerrig.") else []
        while parts and "/".join(parts) not in FILES:
            parts.pop()  # a name inside a module
        found |= {"/".join(parts)} - {"", name}
    return found


def child(folder, name):
    """The room of a folder that a file is in, None outside the folder."""
    inside = name.removeprefix(f"{folder}/") if folder else name
    return inside.partition("/")[0] if inside != name or not folder else None


def imports_among(folder):
    """(room, imported room, file, imported file) for all imports from one room of a folder to another."""
    for name in FILES:
        for other in own_imports(name):
            here, there = child(folder, name), child(folder, other)
            if here and there and here != there:
                yield here, there, name, other


def rule(table, name):
    """The entry of a table that fits a file best."""
    fits = [key for key in table if f"{name}/".startswith(f"{key}/")]
    return table[max(fits, key=len)]


@pytest.mark.parametrize("folder", unless_not_yet("floors", FLOORS))
def test_a_room_imports_only_from_floors_below(folder):
    floor = {
        room: number
        for number, rooms in enumerate(FLOORS[folder].split("|"))
        for room in rooms.split()
    }
    assert {child(folder, name) for name in FILES} - {None} == set(floor)
    upward = {
        f"{name} imports {other}"
        for here, there, name, other in imports_among(folder)
        if floor[there] >= floor[here]
    }
    assert upward == set()


@pytest.mark.parametrize("folder", unless_not_yet("circle", FOLDERS))
def test_no_rooms_import_one_another_in_a_circle(folder):
    graph = {}
    for here, there, _, _ in imports_among(folder):
        graph.setdefault(here, set()).add(there)
    while ends := {room for room, below in graph.items() if not below & set(graph)}:
        graph = {room: below for room, below in graph.items() if room not in ends}
    assert graph == {}  # what is left stands in a circle, or above one


@pytest.mark.parametrize(("room", "below"), NARROW)
def test_of_some_rooms_only_a_part_is_open(room, below):
    seen = {
        other
        for name in FILES
        if name.startswith(f"{room}/")
        for other in own_imports(name)
        if other.startswith(f"{below}/")
    }
    assert seen <= NARROW[room, below]


@pytest.mark.parametrize("name", FILES)
def test_a_file_imports_only_outside_packages_that_its_room_may(name):
    outside = (
        {one.partition(".")[0] for one in imports(name)}
        - {"rollerrig"}
        - set(sys.stdlib_module_names)
    )
    assert outside <= set(rule(OUTSIDE, name).split())


@pytest.mark.parametrize("name", [name for name in FILES if not name.startswith("rig/compiled")])
def test_code_is_generated_and_kernels_are_changed_only_in_one_room(name):
    # `numba` itself may be imported in rig/compiled only: OUTSIDE above
    found = {node.id for node in ast.walk(tree(name)) if isinstance(node, ast.Name)} & {
        "exec",
        "eval",
        "compile",
        "__import__",
    }
    attributes = {node.attr for node in ast.walk(tree(name)) if isinstance(node, ast.Attribute)}
    found |= attributes & {"FunctionType", "CodeType", "__code__", "py_func", "_cache"}
    found |= imports(name) & {"types.FunctionType", "types.CodeType"}
    assert found == set()


def test_imports_are_written_so_that_they_can_be_read():
    # PyPI has other packages called rig and realtime
    bare = {name for name in FILES if {one.partition(".")[0] for one in imports(name)} & set(ROOMS)}
    computed = {
        name
        for name in FILES
        if "importlib.import_module" in imports(name)
        or any(
            isinstance(node, ast.Attribute) and node.attr == "import_module"
            for node in ast.walk(tree(name))
        )
    }
    assert (bare, computed) == (set(), BY_COMPUTED_NAME)


@pytest.mark.parametrize("folder", unless_not_yet("modules", FOLDERS[1:]))
def test_a_folder_holds_no_more_modules_than_one_can_oversee(folder):
    assert sum(name.rpartition("/")[0] == folder for name in MODULE_FILES) <= MODULES


def test_no_two_test_files_have_one_name():
    # pytest would collect one of them only
    names = [
        path.name
        for path in (ROOT / "tests").rglob("*.py")
        if path.name not in ("__init__.py", "conftest.py")
    ]
    assert [name for name in set(names) if names.count(name) > 1] == []


def test_every_package_is_installed():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "setuptools"
    ]
    folders = {
        DOOR.get(folder, "rollerrig." + folder.replace("/", ".")): folder for folder in FOLDERS[1:]
    }
    holding = {path.parent.relative_to(ROOT).as_posix() for path in FILES.values()}
    assert holding == set(folders.values())
    assert setup["packages"] == sorted(folders)
    assert setup["package-dir"] == folders


@pytest.mark.parametrize("folder", [folder for folder in FOLDERS[1:] if folder not in DOOR])
def test_a_package_says_what_it_is_and_holds_nothing_else(folder):
    body = tree(folder).body
    assert len(body) == 1
    assert isinstance(body[0], ast.Expr)


@pytest.mark.parametrize("name", FILES)
def test_every_function_but_a_kernel_says_its_types(name):
    # the types of a kernel are found by numba; mypy holds this where no kernels are
    untyped = {
        one.name
        for one in ast.walk(tree(name))
        if isinstance(one, ast.FunctionDef | ast.AsyncFunctionDef)
        and not any(ast.unparse(mark).startswith("kernel") for mark in one.decorator_list)
        and not (one.returns and all(given.annotation for given in arguments(one)))
    }
    assert untyped == set()


def arguments(function):
    given = function.args
    named = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    return [one for one in named if one and one.arg not in ("self", "cls")]


@pytest.mark.parametrize("name", FILES)
def test_a_file_begins_with_what_happens_in_it(name):
    assert ast.get_docstring(tree(name))
