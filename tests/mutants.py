"""Applies the faults of `mutants.toml` to a copy of this checkout: which tests find them?

    .venv/bin/python tests/mutants.py                          # all faults
    .venv/bin/python tests/mutants.py hertz_growth hold_timer  # these faults
    .venv/bin/python tests/mutants.py --tier test --whole      # all tests of a tier, if necessary

A fault is one line that a developer could get wrong. Its row names the tests that are expected to
find it. The program first runs all these tests in the unchanged copy, and they must pass. Then it
applies one fault after another. A fault is found if one of its tests fails or does not finish.

The exit status is 0 only if `make test` finds at least 95 % of the faults and both tiers together
find all. Faults with `found = "none"` do not count: their row states why no test finds them.
"""

import argparse
import contextlib
import importlib
import os
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest

ROOT = Path(__file__).resolve().parent.parent
TABLE = Path(__file__).with_suffix(".toml")
# the marks of the tests of each tier, as in the Makefile
TIERS = {"test": "not nightly", "nightly": "nightly"}
FOUND_BY_TEST_TIER = 0.95
# generous limits: a test that has not finished by then waits for something that never comes
NAMED_TESTS_S = 3600
WHOLE_TIER_S = 6 * 3600
# exit status of pytest
PASSED, NO_TESTS = 0, 5
# exit status of a child in which pytest does not run
BROKEN = 70
# time between two looks at a child
_POLL_S = 0.1
# Packages of other people that most tests import. They are imported once, and each run of pytest is
# a fork of this process. Packages of the copy are imported after the fork.
PRELOADED = (
    "hypothesis",
    "numpy",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.signal",
    "scipy.stats",
    "pyarrow.parquet",
    "can",
    "canopen",
    "cantools",
    "pymodbus.server",
    "rich.table",
    "matplotlib.figure",
)
NOT_FOUND = "not found"
# sitecustomize.py: Python then imports the packages of the copy in place of those of this checkout
IMPORT_COPY = """import sys
for finder in list(sys.modules.values()):
    if finder.__name__.startswith("__editable___rollerrig_"):
        for package, folder in finder.MAPPING.items():
            finder.MAPPING[package] = folder.replace({root!r}, {copy!r}, 1)
"""


class Fault(NamedTuple):
    """A row of the table.

    `old` is in `file` once, and `new` replaces it. `kind` is the kind of fault, `user` what goes
    wrong for the user. `tests` are pytest's node identifiers. `found` is "none" with `reason` if no
    test finds the fault.
    """

    name: str
    file: str
    old: str
    new: str
    kind: str
    user: str
    tests: tuple[str, ...]
    found: str = ""
    reason: str = ""

    @property
    def room(self) -> str:
        """The folder of the file."""
        return str(Path(self.file).parent)

    def changed(self, source: str) -> str:
        """Return the source with the fault. Raises ValueError unless it has `old` once."""
        if source.count(self.old) != 1:
            raise ValueError(
                f"{self.name}: {self.file} has {source.count(self.old)} times {self.old!r}"
            )
        return source.replace(self.old, self.new)


def faults() -> list[Fault]:
    """Return the rows of the table."""
    rows = tomllib.loads(TABLE.read_text())["fault"]
    return [Fault(**{**row, "tests": tuple(row["tests"])}) for row in rows]


class Copy:
    """A copy of this checkout, with the changes that are not committed, in which tests run."""

    def __init__(self, folder: Path) -> None:
        self.root = folder / "checkout"
        # tests read the files of the repository from git
        _git("clone", "--quiet", "--shared", str(ROOT), str(self.root))
        for name in _git("diff", "--name-only", "--no-renames", "HEAD").splitlines():
            (self.root / name).unlink(missing_ok=True)
        changed = _git(
            "diff", "--name-only", "--no-renames", "--diff-filter=d", "HEAD"
        ).splitlines()
        for name in [*changed, *_git("ls-files", "--others", "--exclude-standard").splitlines()]:
            (self.root / name).parent.mkdir(parents=True, exist_ok=True)
            (self.root / name).write_bytes((ROOT / name).read_bytes())
        (self.root / ".venv").symlink_to(sys.prefix)

        self.hook = folder / "import_copy"
        self.hook.mkdir()
        text = IMPORT_COPY.format(root=str(ROOT), copy=str(self.root))
        (self.hook / "sitecustomize.py").write_text(text)
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(self.hook),
            "XDG_CACHE_HOME": str(folder / "cache"),
            # bytecode is kept also where the shell says that it shall not be
            "PYTHONDONTWRITEBYTECODE": "",
        }
        self._faults = 0  # applied so far
        self._check_imports()

    def _check_imports(self) -> None:
        program = (
            "import rollerrig.rig, rollerrig; print(rollerrig.__file__, rollerrig.rig.__file__)"
        )
        printed = subprocess.run(
            [sys.executable, "-c", program],
            cwd=self.root,
            env=self.environment,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        if printed.count(str(self.root)) != 2:
            raise SystemExit(f"Python does not import the copy, but {printed}")

    def run(self, tests: Iterable[str], marks: str, timeout_s: float) -> tuple[int | None, str]:
        """Run tests with these marks. Return pytest's exit status, None after a timeout, and the
        output.
        """
        words = ["-x", "-p", "no:cacheprovider", "--tb=short", "-m", marks, *tests]
        with tempfile.TemporaryFile() as output:
            child = os.fork()
            if child == 0:
                self._run_in_child(words, output.fileno())
            try:
                status = _wait(child, timeout_s)
            finally:
                # also processes that a failed test has left
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(child, signal.SIGKILL)
            output.seek(0)
            return status, output.read().decode(errors="replace")

    def _run_in_child(self, words: list[str], output: int) -> NoReturn:
        """Run pytest in this process, a child with its own group of processes, and exit."""
        status = BROKEN
        try:
            os.setsid()
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            os.dup2(os.open(os.devnull, os.O_RDONLY), sys.stdin.fileno())
            os.dup2(output, sys.stdout.fileno())
            os.dup2(output, sys.stderr.fileno())
            os.chdir(self.root)
            os.environ.update(self.environment)
            sys.dont_write_bytecode = False
            sys.path[:] = [str(self.root), *sys.path[1:]]
            exec((self.hook / "sitecustomize.py").read_text(), {})
            status = int(pytest.main(words))
        except BaseException:
            traceback.print_exc()
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(status)

    @contextlib.contextmanager
    def with_fault(self, fault: Fault) -> Any:
        """Apply a fault to the copy and remove it at the end."""
        path = self.root / fault.file
        source = path.read_text()
        state = path.stat()
        path.write_text(fault.changed(source))
        # Python compiles a source again only if its size or its time in seconds has changed
        self._faults += 1
        os.utime(path, (state.st_atime, state.st_mtime + 10 * self._faults))
        try:
            yield
        finally:
            path.write_text(source)
            os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def _wait(child: int, timeout_s: float) -> int | None:
    """Return the exit status of a child process, None if it has none after a timeout."""
    end_s = time.monotonic() + timeout_s
    while time.monotonic() < end_s:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status)
        time.sleep(_POLL_S)
    return None


def _git(*words: str) -> str:
    return subprocess.run(
        ["git", *words], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout


def found_by(copy: Copy, fault: Fault, tiers: Iterable[str], whole: bool) -> tuple[str, str]:
    """Return the first tier whose tests find a fault, or NOT_FOUND, and the test that failed."""
    with copy.with_fault(fault):
        for tier in tiers:
            test = failing_test(*copy.run(fault.tests, TIERS[tier], NAMED_TESTS_S))
            if not test and whole:
                test = failing_test(*copy.run(["tests"], TIERS[tier], WHOLE_TIER_S))
            if test:
                return tier, test
    return NOT_FOUND, ""


def failing_test(status: int | None, output: str) -> str:
    """Return the test that failed, or why pytest did not finish; an empty text if all passed."""
    if status is None:
        return "not finished"
    if status in (PASSED, NO_TESTS):
        return ""
    for line in output.splitlines():
        if line.startswith(("FAILED ", "ERROR ")):
            return line.partition(" ")[2].partition(" - ")[0]
    return f"pytest exits with {status}"


def check_unchanged(copy: Copy, chosen: Iterable[Fault], tiers: Iterable[str]) -> None:
    """Exit with the output unless the named tests pass in the unchanged copy."""
    tests = sorted({test for fault in chosen for test in fault.tests})
    marks = " or ".join(f"({TIERS[tier]})" for tier in tiers)
    print(f"{len(tests)} named tests in the unchanged copy ...", flush=True)
    status, output = copy.run(tests, marks, WHOLE_TIER_S)
    if status != PASSED:
        raise SystemExit(f"{output}\nwithout a fault these tests do not pass (status {status})")


def report(results: list[tuple[Fault, str]], tiers: Iterable[str]) -> bool:
    """Print the counts by tier and room; return whether enough faults are found."""
    judged = [(fault, tier) for fault, tier in results if fault.found != "none"]
    by_tier = Counter(tier for _, tier in judged)
    for room in sorted({fault.room for fault, _ in judged}):
        here = Counter(tier for fault, tier in judged if fault.room == room)
        print(f"{room:40} " + ", ".join(f"{tier} {here[tier]}" for tier in sorted(here)))
    print(f"{len(judged)} faults: " + ", ".join(f"{tier} {by_tier[tier]}" for tier in by_tier))
    for fault, tier in results:
        if fault.found == "none":
            print(f"not counted: {fault.name} ({tier}): {fault.reason}")

    enough = True
    if "test" in tiers:
        enough = by_tier["test"] >= FOUND_BY_TEST_TIER * len(judged)
    if "nightly" in tiers:
        enough = enough and not by_tier[NOT_FOUND]
    return enough


def main() -> int:
    given = arguments()
    tiers = list(TIERS) if given.tier == "both" else [given.tier]
    rows = {fault.name: fault for fault in faults()}
    if unknown := set(given.names) - set(rows):
        raise SystemExit(f"no fault is called {', '.join(sorted(unknown))}; see {TABLE.name}")
    chosen = [rows[name] for name in given.names or rows]
    for fault in chosen:
        fault.changed((ROOT / fault.file).read_text())

    for name in PRELOADED:
        importlib.import_module(name)
    # a copy and its processes also end with this program
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    results = []
    with tempfile.TemporaryDirectory(prefix="rollerrig-mutants-") as folder:
        copy = Copy(Path(folder))
        if not given.unchecked:
            check_unchanged(copy, chosen, tiers)
        for fault in chosen:
            tier, test = found_by(copy, fault, tiers, given.whole)
            print(f"{fault.name:34} {tier:10} {test}", flush=True)
            results.append((fault, tier))
    return 0 if report(results, tiers) else 1


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="faults; all of the table if none")
    parser.add_argument("--tier", choices=(*TIERS, "both"), default="both")
    parser.add_argument(
        "--whole", action="store_true", help="run a whole tier where the named tests find nothing"
    )
    parser.add_argument(
        "--unchecked", action="store_true", help="do not run the tests without a fault first"
    )
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())
