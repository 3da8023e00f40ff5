"""`rollerrig bench start`: processor time with children, cold and warm starts, older checkouts."""

import os
import sys

import pytest

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.realtime import cli
from rollerrig.realtime.benchmarks import figures, older_checkout, start

# uses 0.3 s of processor time in a child of a child, then exits with 5
BUSY = """import subprocess, sys
again = "import subprocess, sys; sys.exit(subprocess.call([sys.executable, '-c', sys.argv[1]]))"
busy = "import time\\nwhile time.process_time() < 0.3: pass"
subprocess.check_call([sys.executable, "-c", again, busy])
print("last words", file=sys.stderr)
sys.exit(5)
"""
# The command line of a checkout. It keeps a kernel of 2 MB where there is none, and uses processor
# time for that. Each start writes a line.
CHECKOUT = """import os, sys, time
from pathlib import Path
def main():
    kernel = Path(os.environ["XDG_CACHE_HOME"], "rollerrig", "kernels-0", "kernel.nbi")
    kind = "warm" if kernel.exists() else "cold"
    if kind == "cold":
        while time.process_time() < SECONDS:
            pass
        kernel.parent.mkdir(parents=True)
        kernel.write_bytes(bytes(2_000_000))
    with open("LOG", "a") as log:
        log.write(f"{kind} NAME {' '.join(sys.argv[1:-1])}\\n")
    sys.exit(4)
if __name__ == "__main__":
    main()
"""
TASK = start.Task("a run", ("run", "velim_a1"), accepted=(0, 4))


def times(*cpu_s):
    return [start.Start(cpu_s=each_s, wall_s=2.0 * each_s) for each_s in cpu_s]


def checkout(folder, source):
    """Make a checkout whose command line is this source."""
    (folder / "realtime").mkdir(parents=True)
    (folder / "realtime" / "cli.py").write_text(source)
    return folder


@pytest.fixture(autouse=True)
def links(tmp_path, monkeypatch):
    """Links to checkouts are in the folder of the test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "links"))


def test_processor_time_contains_that_of_children_and_their_children():
    status, error, used = start.timed([sys.executable, "-c", BUSY], dict(os.environ))
    assert status == 5
    assert error.splitlines()[-1] == "last words"
    assert used.cpu_s >= 0.3
    assert used.wall_s > 0.0


def test_each_cold_start_has_an_empty_cache_and_each_warm_start_that_of_the_last_one(tmp_path):
    log = tmp_path / "log"
    versions = []
    for name, seconds in ((start.THIS, "0.05"), (start.OLDER, "0.3")):
        source = CHECKOUT.replace("SECONDS", seconds).replace("LOG", str(log))
        folder = checkout(tmp_path / name.strip("-"), source.replace("NAME", name))
        versions.append(start.Version(name, name.strip("-"), older_checkout.variables(folder)))
    progress = []
    result = start._measure(TASK, versions, 2, 3, progress.append)

    cold = [f"cold {name} run velim_a1 --out" for name in (start.THIS, start.OLDER)]
    warm = [line.replace("cold", "warm") for line in cold]
    assert log.read_text().splitlines() == 2 * cold + 3 * warm
    older = result["versions"][start.OLDER]
    assert (older["kernels"], older["size_MB"]) == (1, 2.0)
    assert [len(older["cold_starts"]), len(older["warm_starts"])] == [2, 3]
    assert older["cold_cpu_s"] >= 0.3
    assert result["ratios"]["kernels"] == 1.0
    assert "a run, warm start 3 of 3, --beside ..." in progress
    assert start.table({"tasks": [result]}).row_count == 3


def test_a_start_that_fails_is_reported_with_its_last_words(tmp_path):
    folder = checkout(
        tmp_path / "older", "import sys\nif sys.argv[1:]:\n    sys.exit('no such run')\n"
    )
    version = start.Version(start.OLDER, "older", older_checkout.variables(folder))
    with pytest.raises(RollerrigError, match=r"a run, --beside: exit status 1; .* no such run"):
        start._measure(TASK, [version], 1, 1, print)


def test_a_cache_without_kernels_after_a_cold_start_is_refused(tmp_path):
    folder = checkout(tmp_path / "older", "")
    version = start.Version(start.OLDER, "older", older_checkout.variables(folder))
    with pytest.raises(RollerrigError, match=r"a run, --beside: no compiled kernels are kept"):
        start._measure(TASK, [version], 1, 1, print)


@pytest.mark.parametrize(
    ("cold_s", "warm_s", "met"),
    [
        (25.0, (1.0, 2.0, 3.0), [True, True]),
        (25.1, (2.9, 3.1, 3.2), [False, True]),
        (25.0, (3.1, 3.2, 3.3), [True, False]),
    ],
)
def test_a_cold_free_run_may_take_a_quarter_and_warm_starts_must_overlap(cold_s, warm_s, met):
    starts = {
        start.THIS: start.Starts(times(cold_s), times(*warm_s), kernels=15, size_MB=4.0),
        start.OLDER: start.Starts(times(100.0), times(1.0, 2.0, 3.0), kernels=300, size_MB=24.0),
    }
    result = start._figures(start.FREE_RUN, starts)
    assert result["ratios"]["cold_wall_s"] == pytest.approx(cold_s / 100.0)
    assert result["ratios"]["warm_cpu_s"] == pytest.approx(warm_s[1] / 2.0)
    targets = start._targets([result])
    assert [target["met"] for target in targets] == met
    assert len(figures.lines({"targets": targets})) == 2


def test_explain_may_take_half_of_the_older_checkout_from_an_empty_cache():
    one = start.Starts(times(50.1), times(1.0), kernels=15, size_MB=4.0)
    older = start.Starts(times(100.0), times(1.0), kernels=300, size_MB=24.0)
    result = start._figures(start.EXPLAIN, {start.THIS: one, start.OLDER: older})
    assert [target["met"] for target in start._targets([result])] == [False, True]


def test_without_an_older_checkout_there_are_no_targets():
    one = start.Starts(times(40.0), times(1.0), kernels=15, size_MB=4.0)
    result = start._figures(start.FREE_RUN, {start.THIS: one})
    assert start._targets([result]) == []
    assert start.table({"tasks": [result]}).row_count == 1


def test_a_number_of_starts_below_one_is_refused(capsys):
    assert cli.main(["bench", "start", "--runs", "0"]) == cli.USAGE
    assert "--runs 0 is out of range; allowed are 1 and more" in capsys.readouterr().err


def test_a_checkout_whose_command_cannot_be_imported_is_refused(tmp_path):
    folder = checkout(tmp_path / "older", "import a_package_that_nobody_has\n")
    with pytest.raises(ConfigError, match=r"cannot be imported: .*a_package_that_nobody_has"):
        older_checkout.variables(folder)


def test_a_rollerrig_that_python_finds_instead_of_the_checkout_is_refused(tmp_path, monkeypatch):
    folder = checkout(tmp_path / "older", "")
    installed = checkout(tmp_path / "packages" / "rollerrig", "")
    (installed / "__init__.py").write_text("")
    monkeypatch.setenv("PYTHONPATH", str(installed.parent))
    with pytest.raises(ConfigError, match=r"Python imports .*packages/rollerrig"):
        older_checkout.variables(folder)
