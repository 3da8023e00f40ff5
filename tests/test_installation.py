"""Other ways to install: the wheel in a fresh environment, the Containerfile, what shells get."""

import contextlib
import json
import os
import pty
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
from importlib import metadata
from pathlib import Path

import pytest

from rollerrig.configs import store
from rollerrig.realtime import cli

ROOT = Path(__file__).parents[1]
CONTAINERFILE = ROOT / "Containerfile"


# --- the wheel ---


def tracked_files():
    """Return the files of the repository by their paths in it, without what is ignored."""
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).is_file()]


@pytest.fixture(scope="module")
def release(tmp_path_factory):
    """A folder with the sdist and the wheel that is built from it, as `make release` does."""
    folder = tmp_path_factory.mktemp("release")
    source = folder / "source"
    rooms = ("configs/", "firmware_sim/", "realtime/", "rig/", "wsp_interface/")
    for name in tracked_files():
        if name.startswith(rooms) or name in ("pyproject.toml", "README.md", "LICENSE"):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    build = [sys.executable, "-m", "build", "--no-isolation", "--outdir", folder / "dist", source]
    subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
    return folder / "dist"


@pytest.fixture(scope="module")
def wheel(release):
    (found,) = release.glob("rollerrig-*.whl")
    return found


@pytest.fixture(scope="module")
def program(wheel, tmp_path_factory):
    """The program `rollerrig` of the wheel in a fresh environment.

    The environment finds the dependencies in that of this test, so that nothing is downloaded.
    """
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv/bin/python"
    install = [*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, check=True)
    (packages,) = (folder / "venv/lib").glob("python*/site-packages")
    # a path in such a file is only searched; the editable rollerrig there is not installed by it
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return folder / "venv/bin/rollerrig"


def output_of(program, folder, *words):
    """Run the installed program in a folder, and return its standard output."""
    done = subprocess.run(
        [program, *words], cwd=folder, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_wheel_runs_without_the_repository(program, tmp_path):
    version = re.search(r'^version = "(.+)"', (ROOT / "pyproject.toml").read_text(), re.MULTILINE)
    assert output_of(program, tmp_path, "--version") == f"rollerrig {version[1]}\n"
    where = [program.parent / "python", "-c", "import rollerrig; print(rollerrig.__file__)"]
    path = subprocess.run(where, cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    assert Path(path.strip()).is_relative_to(program.parents[1])


@pytest.mark.parametrize("kind", ["scenarios", "sequences", "campaigns", "adhesion", "datasets"])
def test_the_wheel_holds_every_packaged_file_of_a_kind(kind, program, tmp_path):
    listed = json.loads(output_of(program, tmp_path, "list", kind, "--json"))[kind]
    names = [entry["name"] for entry in listed]
    if kind == "datasets":
        assert names == sorted(path.parent.name for path in store.ROOT.glob("datasets/*/*.toml"))
    else:
        assert names == [*store.names(kind), *store.names_of_vehicles(kind)]


def test_the_wheel_reads_its_packaged_sequences(program, tmp_path):
    checked = json.loads(output_of(program, tmp_path, "sequence", "--check", "--json"))["checked"]
    assert checked == store.names("sequences")


# the kernels of the fresh environment are compiled for it
@pytest.mark.nightly
def test_the_wheel_brakes_a_packaged_scenario(program, tmp_path):
    words = ("run", "velim_a1", "--pacing", "free", "--set", "initial_speed_m_s=3", "--json")
    result = json.loads(output_of(program, tmp_path, *words))
    assert result["valid"]
    assert (tmp_path / "runs/velim_a1/channels.parquet").is_file()


def test_the_sdist_has_what_the_wheel_needs_and_no_documents(release):
    (path,) = release.glob("rollerrig-*.tar.gz")
    with tarfile.open(path) as archive:
        rooms = {Path(name).parts[1] for name in archive.getnames() if len(Path(name).parts) > 1}
    assert {"configs", "firmware_sim", "realtime", "rig", "wsp_interface", "LICENSE"} <= rooms
    assert "docs" not in rooms


# downloads all dependencies
@pytest.mark.nightly
@pytest.mark.parametrize("tool", ["pipx", "uv"])
def test_a_tool_for_programs_installs_the_wheel(tool, wheel, tmp_path):
    folders = {
        "PIPX_HOME": tmp_path / "home",
        "PIPX_BIN_DIR": tmp_path / "bin",
        "UV_TOOL_DIR": tmp_path / "home",
        "UV_TOOL_BIN_DIR": tmp_path / "bin",
    }
    environment = os.environ | {name: str(path) for name, path in folders.items()}
    commands = {
        "pipx": ["pipx", "install", "--python", sys.executable, str(wheel)],
        "uv": ["uv", "tool", "install", "--python", sys.executable, str(wheel)],
    }
    command = [Path(sys.executable).parent / commands[tool][0], *commands[tool][1:]]
    subprocess.run(command, check=True, env=environment)
    assert output_of(tmp_path / "bin/rollerrig", tmp_path, "--version").startswith("rollerrig ")


@pytest.mark.nightly
def test_the_list_of_components_names_every_dependency_with_its_version(tmp_path):
    """The SBOM that `make release` and the container make is CycloneDX of this environment."""
    program = Path(sys.executable).parent / "cyclonedx-py"
    pyproject = ROOT / "pyproject.toml"
    found = tmp_path / "rollerrig.cdx.json"
    command = [program, "environment", sys.executable, "--pyproject", pyproject, "-o", found]
    subprocess.run(command, check=True)
    content = json.loads(found.read_text())
    assert content["bomFormat"] == "CycloneDX"
    assert content["metadata"]["component"]["name"] == "rollerrig"
    versions = {
        part["name"].lower().replace("_", "-"): part["version"] for part in content["components"]
    }
    dependencies = tomllib.loads(pyproject.read_text())["project"]["dependencies"]
    for requirement in dependencies:
        name = re.match(r"[A-Za-z0-9-]+", requirement)[0].lower()
        assert versions[name] == metadata.version(name)


# --- the container ---


def instructions():
    """Return the instructions of the Containerfile as (keyword, arguments)."""
    text = re.sub(r"^#.*\n", "", CONTAINERFILE.read_text(), flags=re.MULTILINE)
    lines = [line for line in text.replace("\\\n", " ").splitlines() if line.strip()]
    return [tuple(line.split(maxsplit=1)) for line in lines]


def test_the_container_has_a_supported_python_and_does_not_run_as_root():
    found = instructions()
    assert {keyword for keyword, _ in found} <= {
        *("FROM", "ARG", "RUN", "USER", "WORKDIR", "COPY", "ENV", "EXPOSE", "ENTRYPOINT", "CMD")
    }
    (image,) = [arguments for keyword, arguments in found if keyword == "FROM"]
    minor = int(re.search(r"python:3\.(\d+)-slim", image)[1])
    lowest, below = re.search(
        r'requires-python = ">=3\.(\d+),<3\.(\d+)"', (ROOT / "pyproject.toml").read_text()
    ).groups()
    assert int(lowest) <= minor < int(below)
    keywords = [keyword for keyword, _ in found]
    assert dict(found)["USER"] != "root"
    # what is copied belongs to the user who runs it
    assert keywords.index("USER") < keywords.index("COPY")
    assert f"--chown={dict(found)['USER']}" in dict(found)["COPY"]


def test_every_command_of_the_container_exists(tmp_path):
    """Makes a dry run of the Makefile's targets in a fresh folder; parses rollerrig's words."""
    shutil.copyfile(ROOT / "Makefile", tmp_path / "Makefile")
    for name in ("pyproject.toml", "constraints.txt"):
        shutil.copyfile(ROOT / name, tmp_path / name)
    commands = []
    for keyword, arguments in instructions():
        if keyword == "RUN":
            commands += [shlex.split(part) for part in arguments.split("&&")]
    made = [words for words in commands if words[0] == "make"]
    run = [words for words in commands if words[0] == ".venv/bin/rollerrig"]
    assert made
    for words in [*made, ["make", "test"]]:
        planned = subprocess.run(
            ["make", "--dry-run", *words[1:]],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert planned.returncode == 0, planned.stderr
        assert "pip install" in planned.stdout
    by_keyword = dict(instructions())
    entry = json.loads(by_keyword["ENTRYPOINT"])
    assert entry == [".venv/bin/rollerrig"]
    desk = "desk --host 0.0.0.0"
    assert f"rollerrig {desk}" in (ROOT / "docs/containers.md").read_text()
    demo = json.loads(by_keyword["CMD"])
    for words in [*(words[1:] for words in run), demo, desk.split()]:
        cli.parser().parse_args(words)
    # the image has the compiled kernels of the demo
    assert demo[:-1] in [words[1:-1] for words in run]
    assert demo[-2] == "--out"
    assert by_keyword["EXPOSE"] == str(cli.parser().parse_args(["desk"]).port)


def test_the_container_compiles_for_every_processor_before_it_compiles():
    found = instructions()
    (cpu,) = [arguments for keyword, arguments in found if keyword == "ARG"]
    (settings,) = [arguments for keyword, arguments in found if keyword == "ENV"]
    name, default = cpu.split("=")
    # without features of its own the processor that builds the image would add its features
    assert settings == f'NUMBA_CPU_NAME=${name} NUMBA_CPU_FEATURES=""'
    assert default == "generic"
    order = [keyword for keyword, _ in found]
    compiling = next(
        place
        for place, (_, arguments) in enumerate(found)
        if "tests/compile_kernels.py" in arguments
    )
    assert order.index("ENV") < compiling


def test_the_container_does_not_get_what_git_ignores():
    ignored = (ROOT / ".containerignore").read_text().split()
    kept_out = {name.strip("/") for name in (ROOT / ".gitignore").read_text().split()}
    assert {"runs", "report", "build", "campaigns", "devices", ".venv"} <= kept_out
    assert {"runs", "report", "build", "campaigns", "devices", ".venv", ".git"} <= set(ignored)
    assert not {"tests", "docs", "configs", "Makefile", "constraints.txt"} & set(ignored)


# --- what a shell gets ---


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_completion_of_a_shell_names_the_program(shell, capsys):
    pytest.importorskip("argcomplete")
    assert cli.main(["completion", shell]) == 0
    lines = capsys.readouterr().out
    assert "rollerrig" in lines
    assert "_ARGCOMPLETE" in lines
    if shell != "fish":
        program = shutil.which(shell)
        if program:
            subprocess.run([program, "-n"], input=lines, text=True, check=True)


def test_bash_completes_an_option_with_the_printed_lines(tmp_path):
    pytest.importorskip("argcomplete")
    (tmp_path / "rollerrig").write_text(
        f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m rollerrig.realtime.cli "$@"\n'
    )
    (tmp_path / "rollerrig").chmod(0o755)
    script = (
        'eval "$(rollerrig completion bash)"\n'
        "COMP_LINE='rollerrig run velim_a1 --also' COMP_POINT=29 COMP_TYPE=9\n"
        "COMP_WORDS=(rollerrig run velim_a1 --also) COMP_CWORD=3\n"
        "_python_argcomplete rollerrig\n"
        'echo "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
    )
    assert done.stdout.strip() == "--also-without-wsp", done.stderr


def test_the_manual_page_has_every_verb_and_its_options(capsys):
    pytest.importorskip("argparse_manpage")
    assert cli.main(["manual"]) == 0
    page = capsys.readouterr().out
    assert page.startswith(".TH ROLLERRIG")
    plain = page.replace("\\-", "-")
    for verb in cli.VERBS:
        assert f"COMMAND \\fI\\,'rollerrig {verb.name}'" in plain
    assert "--also-without-wsp" in plain
    assert "--from-python" not in plain


# --- a run that replaces another ---

RUN = ("run", "dry_stop", "--pacing", "free", "--wsp", "none", "--set", "initial_speed_m_s=2")


def test_a_run_reports_which_run_it_replaces(tmp_path, capfd):
    out = tmp_path / "stop"
    assert cli.main([*RUN, "--out", str(out)]) == 0
    assert "replaced" not in capfd.readouterr().err
    (out / "note.txt").write_text("mine")
    assert cli.main([*RUN, "--out", str(out)]) == 0
    messages = capfd.readouterr().err
    assert f"{out} holds a run of dry_stop (free, finished), begun at 20" in messages
    assert "scenario.toml, channels.parquet" in messages
    assert "these files are replaced by the new run" in messages
    assert (out / "note.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("answer", "status"),
    [("n\n", 2), pytest.param("\n", 2, marks=pytest.mark.nightly), ("y\n", 0)],
)
def test_a_run_on_a_terminal_asks_before_it_replaces_another(answer, status, tmp_path):
    out = tmp_path / "stop"
    assert cli.main([*RUN, "--out", str(out)]) == 0
    before = (out / "summary.json").stat().st_mtime_ns

    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "rollerrig.realtime.cli", *RUN, "--out", str(out)],
        stdin=theirs,
        stdout=subprocess.DEVNULL,
        stderr=theirs,
    ) as process:
        os.close(theirs)
        shown = ""
        while "[y/N]" not in shown:
            shown += os.read(ours, 4096).decode()
        os.write(ours, answer.encode())
        with contextlib.suppress(OSError):  # raised when the terminal is closed
            while True:
                shown += os.read(ours, 4096).decode()
    os.close(ours)
    assert process.returncode == status, shown
    assert ("is kept; give a new folder with --out" in shown) == (status == 2)
    assert ((out / "summary.json").stat().st_mtime_ns == before) == (status == 2)
