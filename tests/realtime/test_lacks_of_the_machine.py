"""What the machine lacks is a sentence: memory, room on the disk, the end of a file."""

import gc
import importlib.metadata
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from program import CLI

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import program
from rollerrig.rig.identify.data import mdf

PROGRAM = "import sys; from rollerrig.realtime import program; sys.exit(program.main())"
# a short recording of a train
RECORDING = Path(__file__).parents[1] / "data" / "field" / "min_unit_row"
PATIENCE_S = 300.0


def rollerrig(*words, before=None, stdout=subprocess.PIPE, stderr=subprocess.PIPE):
    """Run a command in a new process, after `before` in it, and return the finished process."""
    return subprocess.run(
        [sys.executable, *CLI, *map(str, words)],
        preexec_fn=before,
        stdout=stdout,
        stderr=stderr,
        text=True,
        timeout=PATIENCE_S,
    )


# --- memory ---


@pytest.mark.parametrize("megabytes", [200, 700, 1400])
def test_too_little_memory_is_one_sentence(megabytes):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 1_000_000,) * 2)

    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, "run", "dry_stop"],
        preexec_fn=limit,
        capture_output=True,
        text=True,
    )
    assert done.stdout == ""
    assert done.stderr == (
        f"rollerrig: a limit of this shell leaves {megabytes} MB of memory, and at least 1500 MB are "
        "needed; allow more: ulimit -v unlimited\n"
    )
    assert done.returncode == 2


def test_the_installed_program_checks_its_memory_first():
    (script,) = importlib.metadata.entry_points(group="console_scripts", name="rollerrig")
    assert script.load() is program.main


LITTLE_MORE = """
import resource, sys
from pathlib import Path
from rollerrig.realtime import cli
# the verb imports its libraries
cli.main(["import", sys.argv[3], "--out", sys.argv[2] + "_first"])
print("-- limit --", file=sys.stderr)
pages = int(Path("/proc/self/statm").read_text().split()[0])
limit = pages * resource.getpagesize() + 40_000_000
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(cli.main(["import", sys.argv[1], "--out", sys.argv[2]]))
"""


def test_memory_that_runs_out_during_a_command_is_one_sentence(tmp_path):
    large = tmp_path / "large.csv"
    large.write_bytes(b"t,v\n" + b"0,0\n" * 20_000_000)
    small = RECORDING / "run.csv"
    done = subprocess.run(
        [sys.executable, "-c", LITTLE_MORE, large, tmp_path / "out", small],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 2, done.stderr
    message = done.stderr.partition("-- limit --\n")[2]
    assert message.startswith("rollerrig import: there is not enough memory; close other")
    assert len(message.splitlines()) == 1


# --- disk ---


@pytest.mark.parametrize(
    "words", [("list", "scenarios"), ("list", "faults", "--json"), ("manual",)]
)
def test_output_that_a_full_disk_does_not_take_is_one_sentence(words):
    with open("/dev/full", "w") as full:
        done = rollerrig(*words, stdout=full)
    assert done.returncode == 2
    assert done.stderr == (
        f"rollerrig {words[0]}: the output cannot be written: No space left on device; make room, or "
        "write it to another place\n"
    )


def test_messages_that_a_full_disk_does_not_take_change_nothing():
    with open("/dev/full", "w") as full:
        assert rollerrig("list", "scenarios", stderr=full).stdout
        done = rollerrig("run", "no_such_scenario", stderr=full)
    assert done.returncode == 2


def test_a_report_for_which_the_disk_has_no_room_is_one_sentence_with_its_file(tmp_path):
    def limit():
        # the report in HTML is larger
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    out = tmp_path / "report"
    done = rollerrig("explain", RECORDING, "--out", out, before=limit)
    assert done.returncode == 2
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"rollerrig explain: {out}")
    assert "File too large" in last
    assert "Traceback" not in done.stderr
    # nothing is left of the file that has no room
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


# --- the end of a file ---


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path_factory.mktemp("mdf") / "whole.mf4"
    time_s = 0.01 * np.arange(2000)
    with asammdf.MDF(version="4.10") as file:
        signals = [
            asammdf.Signal(np.cos(time_s + k), time_s, name=f"speed_{k}", unit="m/s")
            for k in range(3)
        ]
        file.append(signals)
        return Path(file.save(path, overwrite=True, compression=2))


@pytest.mark.parametrize("part", [0.001, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 0.999])
def test_an_mf4_that_is_cut_off_is_one_message_and_no_traceback(
    recording, tmp_path, monkeypatch, part
):
    ignored = []
    monkeypatch.setattr(sys, "unraisablehook", ignored.append)
    whole = recording.read_bytes()
    cut = tmp_path / "cut.mf4"
    cut.write_bytes(whole[: int(part * len(whole))])
    with pytest.raises(ConfigError, match=r"cut\.mf4: cannot be read as MDF.*cut off"):
        mdf.listed(cut)
    gc.collect()
    assert ignored == []
