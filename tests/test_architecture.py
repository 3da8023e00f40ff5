"""The rooms of the product, their floors and their sizes, read from every source file.

A room is a folder, or a file next to folders. It imports only from lower floors. Every import
counts, also imports inside functions and imports for types only.
"""

import ast
import sys
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from each import for_each

ROOT = Path(__file__).parent.parent
# The floors of each folder, the lowest first: the rooms on a floor. Rooms on the same floor do not
# import one another.
FLOORS = {
    "": (
        "configs",
        "rig wsp_interface",
        "firmware_sim",
        "realtime",
    ),
    "rig": (
        "compiled",
        "contact mechanisms",
        "multibody",
        "dynamic_params track_brake_params",
        "params state",
        "many_rigs",
        "adhesion_profile brake brake_calculation heat motor surface vehicle",
        "dynamic_brake track_brake",
        "wheelset",
        "plant",
        "identify train",
    ),
    "rig/identify": (
        "files statistics",
        "data",
        "base replay train_recorder",
        "causes",
        "decide",
        "paper next_stops",
        "creep_curves",
    ),
    "wsp_interface": (
        "events unit_choice",
        "places",
        "braking bus magnets signals",
        "descriptions diagnosis rig_objects",
        "frame_forms harness_client",
        "own_bench unit_map",
        "sequences",
        "fixture robot",
        "harness",
    ),
    "firmware_sim": (
        "cia301 rig_control unit_answers",
        "identifiers nmt_master process_image rack wsp",
        "bench_node drive402 encoder406 faults fmu io401 sander401 traction401",
        "modbus pole_wheel",
    ),
    "realtime": (
        "loop pictures record standard_streams",
        "telemetry",
        "bench",
        "campaign",
        "datasets train",
        "reports",
        "desk discover",
        "benchmarks",
        "commands",
        "api cli",
        "program",
    ),
}
# (room, lower room): the only files of the lower room that the room may import
NARROW = {
    ("firmware_sim", "rig"): {
        "rig/compiled/kernel",
        "rig/compiled/record_type",
        "rig/compiled/state_type",
    }
}
# The outside packages that each room may import. For a file, the entry with the longest matching
# path counts.
OUTSIDE = {
    "configs": "",
    "rig": "numpy",
    "rig/compiled": "numpy numba llvmlite numba_cuda",
    "rig/train": "numpy",
    "rig/identify": "numpy scipy threadpoolctl",
    "rig/identify/files": "numpy pyarrow",
    "rig/identify/data": "numpy scipy pyarrow asammdf",
    "rig/identify/train_recorder": "numpy scipy pyarrow rosbags apsw backports lz4",
    # pytest and robot: for the tests of users
    "wsp_interface": "numpy can canopen cantools tomli_w pytest robot",
    "wsp_interface/bus": "can",
    "wsp_interface/sequences": "numpy can cantools",
    "wsp_interface/unit_map": "can cantools crccheck",
    "firmware_sim": "numpy",
    "firmware_sim/cia301": "canopen",
    "firmware_sim/modbus": "numpy canopen pymodbus",
    "firmware_sim/wsp": "numpy can",
    "firmware_sim/fmu": "numpy can fmpy tomli_w",
    "realtime": "",
    "realtime/loop": "numpy",
    "realtime/record": "numpy scipy pyarrow asammdf mcap rich",
    "realtime/telemetry": "numpy rerun PIL",
    "realtime/bench": "numpy pyarrow pymodbus tomli_w",
    "realtime/bench/rig_fmu": "numpy fmpy",
    "realtime/campaign": "numpy scipy pyarrow tomli_w distributed",
    "realtime/campaign/statistics": "numpy scipy SALib",
    "realtime/datasets": "numpy scipy tomli_w",
    "realtime/train": "numpy pyarrow tomli_w",
    "realtime/discover": "numpy scipy tomli_w",
    "realtime/reports": "numpy pyarrow matplotlib rich fpdf",
    "realtime/benchmarks": "numpy rich distributed pymodbus pyarrow",
    "realtime/desk": "numpy nicegui fastapi uvicorn pymodbus",
    "realtime/pictures": "numpy",
    "realtime/commands": "numpy rich tomli_w",
    "realtime/commands/shell": "argcomplete argparse_manpage",
}
# Files that may call importlib.import_module: for benchmarks by name, modules of a clone, the unit
# of a campaign, and packages that only some commands need.
BY_COMPUTED_NAME = {
    "realtime/commands/bench",
    "realtime/campaign/campaign",
    "realtime/commands/clone",
    "realtime/cli",
}
# Files that open files themselves. All other files of the product open the files of users through
# `configs/user_files`, and write through `configs/output_files`.
OPENS = {
    "configs/user_files": "files of users",
    "configs/output_files": "results",
    "configs/unpacking": "archives that are checked",
    "configs/processes/children": "standard streams, logs of own processes",
    "configs/processes/cores": "the kernel",
    "realtime/standard_streams": "standard streams",
    "rig/params": "the table of parameters",
    "rig/compiled/compile_lock": "a lock in the cache",
    "rig/compiled/kernel_cache": "sources of the product, the cache",
    "rig/compiled/kernel_files": "sources of kernels, the cache",
    "rig/identify/data/mdf": "blocks of a file that is checked",
    "firmware_sim/modbus/map": "a temporary file of `replaced`",
    "firmware_sim/modbus/rtu": "a serial line",
    "wsp_interface/bus/kernel": "interfaces of the kernel",
    "wsp_interface/own_bench": "a temporary folder",
    "wsp_interface/sequences/play": "a temporary file of `replaced`",
    "realtime/loop/clock": "a device of the kernel",
    "realtime/loop/cores": "the kernel",
    "realtime/loop/ring": "shared memory",
    "realtime/datasets/imported": "a temporary file of `replaced`",
    "realtime/record/export": "a temporary file of `replaced`",
    "realtime/record/records": "a temporary folder",
    "realtime/loop/interrupts": "the kernel, a record of root",
    "realtime/bench/rig_fmu/export": "a temporary folder",
    "realtime/bench/rig_fmu/rig": "resources of the FMU",
    "realtime/bench/rig_fmu/server": "standard streams",
    "realtime/telemetry/viewer": "settings of the viewer, a temporary folder",
    "realtime/benchmarks/campaign": "status of the process",
    "realtime/benchmarks/train": "processor time of the processes of a run",
    "realtime/benchmarks/figures": "the kernel",
    "realtime/benchmarks/references": "the kernel",
    "realtime/benchmarks/vehicle": "a temporary folder",
    "realtime/desk/library": "a temporary folder",
    "realtime/desk/server": "a temporary folder",
    "realtime/commands/check": "the kernel",
    "realtime/commands/listing": "files of the product",
    "wsp_interface/sequences/progress": "files in a temporary folder",
    "realtime/commands/wsp": "the log that a bench has made",
}
MODULES = 16  # files in a folder at most
# the folder that is the package `rollerrig` itself, which notebooks import
PUBLIC_PACKAGE = {"realtime/api": "rollerrig"}


def folders(values):
    """Return the parameters of a test; the folder "" has the name "house"."""
    return [pytest.param(value, id=value or "house") for value in values]


ROOMS = " ".join(FLOORS[""]).split()


def source_files():
    """Return every source file by its name: its path without `.py`, or the folder of a package."""
    files = {}
    for room in ROOMS:
        for path in sorted((ROOT / room).rglob("*.py")):
            place = path.parent if path.name == "__init__.py" else path.with_suffix("")
            files[place.relative_to(ROOT).as_posix()] = path
    return files


FILES = source_files()
FOLDERS = [""] + [name for name, path in FILES.items() if path.name == "__init__.py"]
MODULE_FILES = [name for name in FILES if name not in FOLDERS]


@cache
def tree(name):
    """Return the syntax tree of a file."""
    return ast.parse(FILES[name].read_text(encoding="utf-8"))


@cache
def imports(name):
    """Return the full dotted names that a file imports. Relative imports are resolved."""
    imported = set()
    package = ["rollerrig", *FILES[name].relative_to(ROOT).parent.parts]
    for node in ast.walk(tree(name)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = []
            if node.level:
                parts = package[: len(package) - node.level + 1]
            if node.module:
                parts = [*parts, node.module]
            imported |= {".".join([*parts, alias.name]) for alias in node.names}
    return imported


@cache
def product_imports(name):
    """Return the files of the product that a file imports, by the names of FILES."""
    imported = set()
    for dotted in imports(name):
        package, *parts = dotted.split(".")
        if package != "rollerrig":
            continue
        while parts and "/".join(parts) not in FILES:
            parts.pop()  # a name inside a module
        imported.add("/".join(parts))
    return imported - {"", name}


def room_of(folder, name):
    """Return the room of a folder that a file is in; None if the file is outside the folder."""
    prefix = f"{folder}/" if folder else ""
    if not name.startswith(prefix):
        return None
    return name.removeprefix(prefix).partition("/")[0]


class RoomImport(NamedTuple):
    """An import from one room of a folder to another: the rooms, and the files."""

    room: str
    imported_room: str
    file: str
    imported_file: str


def imports_among(folder):
    """Yield the imports between different rooms of a folder."""
    for name in FILES:
        for other in product_imports(name):
            room = room_of(folder, name)
            imported_room = room_of(folder, other)
            if room and imported_room and room != imported_room:
                yield RoomImport(room, imported_room, name, other)


def entry_of(table, name):
    """Return the entry of a table with the longest path that contains a file."""
    matching = [key for key in table if f"{name}/".startswith(f"{key}/")]
    return table[max(matching, key=len)]


@pytest.mark.parametrize("folder", folders(FLOORS))
def test_a_room_imports_only_from_floors_below(folder):
    floor = {}
    for number, rooms in enumerate(FLOORS[folder]):
        for room in rooms.split():
            floor[room] = number
    assert {room_of(folder, name) for name in FILES} - {None} == set(floor)

    upward = set()
    for room_import in imports_among(folder):
        if floor[room_import.imported_room] >= floor[room_import.room]:
            upward.add(f"{room_import.file} imports {room_import.imported_file}")
    assert upward == set()


@pytest.mark.parametrize("folder", folders(FOLDERS))
def test_no_rooms_import_one_another_in_a_circle(folder):
    graph = {}
    for room_import in imports_among(folder):
        graph.setdefault(room_import.room, set()).add(room_import.imported_room)
    # remove the rooms that import no other remaining room, until there are none
    while ends := {room for room, below in graph.items() if not below & set(graph)}:
        graph = {room: below for room, below in graph.items() if room not in ends}
    # the remaining rooms are in a circle, or above a circle
    assert graph == {}


@pytest.mark.parametrize(("room", "below"), NARROW)
def test_a_room_imports_only_the_allowed_files_of_a_lower_room(room, below):
    imported = set()
    for name in FILES:
        if name.startswith(f"{room}/"):
            imported |= product_imports(name)
    imported_below = {name for name in imported if name.startswith(f"{below}/")}
    assert imported_below <= NARROW[room, below]


@for_each(FILES)
def test_a_file_imports_only_outside_packages_that_its_room_may(name):
    outside = packages_of(name) - {"rollerrig"} - set(sys.stdlib_module_names)
    assert outside <= set(entry_of(OUTSIDE, name).split())


def packages_of(name):
    """Return the packages from which a file imports."""
    return {dotted.partition(".")[0] for dotted in imports(name)}


@for_each([name for name in FILES if not name.startswith("rig/compiled")])
def test_code_is_generated_and_kernels_are_changed_only_in_one_room(name):
    # the table OUTSIDE allows an import of numba only there, too
    names = {node.id for node in ast.walk(tree(name)) if isinstance(node, ast.Name)}
    attributes = {node.attr for node in ast.walk(tree(name)) if isinstance(node, ast.Attribute)}
    assert not names & {"exec", "eval", "compile", "__import__"}
    assert not attributes & {"FunctionType", "CodeType", "__code__", "py_func", "_cache"}
    assert not imports(name) & {"types.FunctionType", "types.CodeType"}


def test_imports_name_the_package_and_only_some_files_compute_names():
    # PyPI has other packages called rig and realtime
    without_rollerrig = {name for name in FILES if packages_of(name) & set(ROOMS)}
    assert without_rollerrig == set()
    assert {name for name in FILES if computes_names(name)} == BY_COMPUTED_NAME


def computes_names(name):
    """Return whether a file imports modules by computed names."""
    if "importlib.import_module" in imports(name):
        return True
    attributes = {node.attr for node in ast.walk(tree(name)) if isinstance(node, ast.Attribute)}
    return "import_module" in attributes


def test_files_of_users_are_opened_in_one_place():
    assert {name for name in FILES if opens_files(name)} == set(OPENS)


def opens_files(name):
    """Return whether a file opens files itself, and not through the modules that check them."""
    checked = {"user_files", "output_files"}
    methods = {"read_text", "read_bytes", "write_text", "write_bytes"}
    for node in ast.walk(tree(name)):
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id == "open":
            return True
        if not isinstance(called, ast.Attribute):
            continue
        if isinstance(called.value, ast.Name) and called.value.id in checked:
            continue
        # an `open` without arguments opens a connection or a page
        if called.attr in methods or (called.attr == "open" and node.args):
            return True
    return False


@for_each(FILES)
def test_no_file_reads_objects_of_python_or_starts_a_shell(name):
    """A pickle in a file of data, or a name in a line for a shell, would run code."""
    assert not packages_of(name) & {
        "pickle",
        "marshal",
        "shelve",
        "dill",
        "joblib",
        "runpy",
        "yaml",
    }
    calls = [node for node in ast.walk(tree(name)) if isinstance(node, ast.Call)]
    called = {ast.unparse(call.func) for call in calls}
    assert not called & {"os.system", "os.popen", "subprocess.getoutput", "numpy.load", "np.load"}
    keywords = {keyword.arg for call in calls for keyword in call.keywords}
    assert not keywords & {"shell", "allow_pickle"}


def test_only_one_file_starts_python_and_worker_processes():
    # that file keeps the working folder out of the imports of a child
    starting = set()
    for name in FILES:
        attributes = {
            ast.unparse(node) for node in ast.walk(tree(name)) if isinstance(node, ast.Attribute)
        }
        processes = {dotted for dotted in imports(name) if dotted.startswith("multiprocessing")}
        pools = {"concurrent.futures.ProcessPoolExecutor"} & imports(name)
        if "sys.executable" in attributes or processes or pools:
            starting.add(name)
    assert starting == {"configs/processes/children"}


@pytest.mark.parametrize("folder", folders(FOLDERS[1:]))
def test_a_folder_has_a_limited_number_of_modules(folder):
    modules = [name for name in MODULE_FILES if name.rpartition("/")[0] == folder]
    assert len(modules) <= MODULES


def test_no_two_test_files_have_the_same_name():
    # pytest would collect one of them only
    names = Counter(path.name for path in (ROOT / "tests").rglob("*.py"))
    repeated = {name for name, count in names.items() if count > 1}
    assert repeated - {"__init__.py", "conftest.py"} == set()


def test_every_package_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    setup = project["tool"]["setuptools"]
    packages = {}
    for folder in FOLDERS[1:]:
        package = PUBLIC_PACKAGE.get(folder, "rollerrig." + folder.replace("/", "."))
        packages[package] = folder
    with_sources = {path.parent.relative_to(ROOT).as_posix() for path in FILES.values()}
    assert with_sources == set(packages.values())
    assert setup["packages"] == sorted(packages)
    assert setup["package-dir"] == packages


@pytest.mark.parametrize(
    "folder", [folder for folder in FOLDERS[1:] if folder not in PUBLIC_PACKAGE]
)
def test_the_init_file_of_a_package_has_only_a_docstring(folder):
    (statement,) = tree(folder).body
    assert isinstance(statement, ast.Expr)


@for_each(FILES)
def test_every_function_except_kernels_has_types(name):
    # numba infers the types of kernels; in files without kernels mypy also requires types
    untyped = set()
    for node in ast.walk(tree(name)):
        is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if is_function and not is_kernel(node) and not is_typed(node):
            untyped.add(node.name)
    assert untyped == set()


def is_kernel(function):
    """Return whether a function has a decorator for kernels."""
    decorators = [ast.unparse(decorator) for decorator in function.decorator_list]
    return any(decorator.startswith("kernel") for decorator in decorators)


def is_typed(function):
    """Return whether a function has types for its result and for all parameters."""
    parameters = function.args
    every = [
        *parameters.posonlyargs,
        *parameters.args,
        *parameters.kwonlyargs,
        parameters.vararg,
        parameters.kwarg,
    ]
    for parameter in every:
        needs_type = parameter is not None and parameter.arg not in ("self", "cls")
        if needs_type and parameter.annotation is None:
            return False
    return function.returns is not None


@for_each(FILES)
def test_every_file_has_a_docstring(name):
    assert ast.get_docstring(tree(name))
