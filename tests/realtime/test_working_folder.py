"""Files in the working folder are never imported, by no verb and by no process that a verb starts.

The working folder of these tests holds a file for every module of the standard library and of every
installed package. Each writes its name into a file when it is imported, and ends the process.
"""

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

import rollerrig
from rollerrig.configs.processes import children
from rollerrig.realtime import cli
from rollerrig.realtime.desk.programs import Program

ROLLERRIG = Path(sys.executable).with_name("rollerrig")
VERBS = [verb.name for verb in cli.VERBS]
STATUS_OF_FOREIGN_CODE = 99
FOREIGN_MODULE = """
with open({mark!r}, "a") as mark:
    mark.write(__name__ + " ")
raise SystemExit({status})
"""
# settings of packages, which look for such files in the working folder: LaTeX is a program
MATPLOTLIBRC = "text.usetex: true\nbackend: module://matplotlib_backend\n"
NUMBA_CONFIG = "disable_jit: 1\n"
SCENARIO = """
title = "A short stop"
initial_speed_m_s = 2.0
[[demand]]
pressure_Pa = 3.8e5
"""
SEQUENCE = """
title = "The vehicle slows down while the brakes apply"
[start]
speed = "2 m/s"
[[step]]
for = "0.1 s"
expect = "vehicle_speed > 0.1 m/s"
"""
PLAN = """
scenario = "short.toml"
chunk = 1
[vary]
initial_speed_m_s = [2.0]
"""
# Short work of the verbs that start processes. The runs are made by `run`.
WORK = {
    "run": ("run", "short.toml", "--pacing", "lockstep", "--out", "run"),
    "sequence": ("sequence", "one.toml", "--out", "report"),
    "campaign": ("campaign", "plan.toml", "--workers", "1", "--out", "campaign"),
    "export": ("export", "run", "--format", "svg", "--out", "stop.svg"),
    "check": ("check", "--port", "0"),
}
# A verb that starts a process, and why its processes are not tested by work of its own.
TESTED_ELSEWHERE = {
    "bench": "starts `rollerrig run` and `children.pool`, which are tested with other verbs",
    "desk": "starts `desk.programs.Program`, which is tested below",
    "discover": "starts `children.pool`, which is tested with `campaign`",
    "explain": "starts `children.pool`, which is tested with `campaign`",
    "export-fmu": "starts no process; imports the program of the FMU from a temporary folder",
    "score": "starts no process",
    "tune": "starts no process",
    "validate": "starts no process",
    "view": "starts the viewer with `children.module`, which is tested below",
    "wsp": "starts no process; `run` starts it",
    "compare": "starts no process",
    "devices": "starts no process",
    "hide": "starts no process",
    "list": "starts no process",
    "import": "starts no process",
    "etcs": "starts no process",
    "brake-calculation": "starts no process",
    "programme": "plays sequences with the processes of `sequence`, which are tested",
    "completion": "starts no process",
    "manual": "starts no process",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A working folder that is full of foreign modules; `mark` is the file that they write."""
    folder = tmp_path_factory.mktemp("foreign")
    mark = folder / "imported"
    code = FOREIGN_MODULE.format(mark=str(mark), status=STATUS_OF_FOREIGN_CODE)
    names = {"rollerrig", "sitecustomize", "usercustomize", "matplotlib_backend"}
    names |= sys.stdlib_module_names
    names |= {name for name in metadata.packages_distributions() if name.isidentifier()}
    for name in names:
        (folder / f"{name}.py").write_text(code)
    (folder / "matplotlibrc").write_text(MATPLOTLIBRC)
    (folder / ".numba_config.yaml").write_text(NUMBA_CONFIG)
    (folder / "short.toml").write_text(SCENARIO)
    (folder / "one.toml").write_text(SEQUENCE)
    (folder / "plan.toml").write_text(PLAN)
    return folder


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    """Each test works in the folder, and no foreign module runs in it."""
    monkeypatch.chdir(folder)
    monkeypatch.delenv("PYTHONPATH", raising=False)
    # first set, because monkeypatch does not restore a variable that was not there: a test sets it
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    monkeypatch.delenv("PYTHONSAFEPATH")
    mark = folder / "imported"
    yield
    imported = mark.read_text() if mark.exists() else ""
    mark.unlink(missing_ok=True)
    assert imported == ""


def run(words, **options):
    """Return the finished process of a command."""
    return subprocess.run(words, capture_output=True, text=True, check=False, **options)


def test_the_modules_of_these_tests_would_run_if_they_were_imported(folder):
    # so a test that finds none of them shows something
    done = run([sys.executable, "-m", "rollerrig.realtime.cli", "--version"])
    assert done.returncode == STATUS_OF_FOREIGN_CODE
    assert (folder / "imported").read_text() != ""
    (folder / "imported").unlink()


# all verbs are imported at each start
@pytest.mark.parametrize(
    "verb",
    ["run", *(pytest.param(verb, marks=pytest.mark.nightly) for verb in VERBS if verb != "run")],
)
def test_a_verb_starts_without_an_import_from_the_working_folder(verb):
    done = run([ROLLERRIG, verb, "--help"])
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "verb",
    [
        pytest.param(verb, marks=() if verb in ("run", "export") else pytest.mark.nightly)
        for verb in WORK
    ],
)
def test_the_processes_of_a_verb_import_nothing_from_the_working_folder(verb):
    done = run([ROLLERRIG, *WORK[verb]])
    assert done.returncode == 0, done.stderr


def test_every_verb_is_tested_with_its_processes_or_with_those_of_another_verb():
    assert set(VERBS) == set(WORK) | set(TESTED_ELSEWHERE)


def test_a_module_that_a_process_starts_imports_nothing_from_the_working_folder():
    done = run(children.module("rollerrig.realtime.cli", "--version"))
    assert done.returncode == 0, done.stderr


def test_a_program_of_the_desk_imports_nothing_from_its_folder(folder):
    program = Program(["list", "scenarios"], folder)
    program._process.wait()
    assert program.status == 0, program.lines


def test_a_command_that_a_notebook_starts_imports_nothing_from_the_working_folder():
    assert "scenarios" in str(rollerrig._call_command(["list", "scenarios"]))


def test_a_program_of_the_user_gets_the_environment_of_the_user(monkeypatch):
    """It may import files next to itself, which Python does not do with this variable."""
    before = dict(os.environ)
    children.keep_working_folder_out()
    assert os.environ["PYTHONSAFEPATH"]
    assert children.users_environment() == before

    # a variable that the user has set stays
    monkeypatch.setenv("PYTHONSAFEPATH", "1")
    children.keep_working_folder_out()
    assert children.users_environment()["PYTHONSAFEPATH"] == "1"
