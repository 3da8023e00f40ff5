"""The Modbus site of tests/firmware_sim, and the languages that other people's programs need."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent.parent / "firmware_sim"))
GO_WANTED = (1, 21)


@pytest.fixture(scope="session")
def go():
    """The command `go`, or a skip that says what is missing."""
    program = shutil.which("go")
    wanted = ".".join(map(str, GO_WANTED))
    if not program:
        pytest.skip(
            f"needs Go {wanted} or newer: apt-get install golang-go, or an installation of one's own"
        )
    said = subprocess.run([program, "version"], capture_output=True, text=True, check=False).stdout
    found = re.search(r"go(\d+)\.(\d+)", said)
    if not found or tuple(map(int, found.groups())) < GO_WANTED:
        pytest.skip(f"needs Go {wanted} or newer, here is: {said.strip() or 'none that works'}")
    return program
