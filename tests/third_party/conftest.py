"""The Modbus site of tests/firmware_sim, and the languages that programs of other projects need."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "firmware_sim"))
GO_VERSION = (1, 21)  # or newer


@pytest.fixture(scope="session")
def go():
    """The command `go`. Skips the test, with the reason, if Go is missing or too old."""
    needed = "needs Go {}.{} or newer".format(*GO_VERSION)
    program = shutil.which("go")
    if not program:
        pytest.skip(f"{needed}: apt-get install golang-go, or install it from go.dev")
    done = subprocess.run([program, "version"], capture_output=True, text=True, check=False)
    match = re.search(r"go(\d+)\.(\d+)", done.stdout)
    if not match:
        pytest.skip(f"{needed}; {program} does not run")
    version = (int(match[1]), int(match[2]))
    if version < GO_VERSION:
        pytest.skip(f"{needed}; this machine has {done.stdout.strip()}")
    return program
