"""Runs the program `rollerrig` in a new process, as a user does.

A process simulates one number of axles and one equipment, so the tests of other vehicles than the
coach run the program.
"""

import subprocess
import sys

# s. The program compiles the kernels of its vehicle where nothing has used them before.
LONGEST_S = 900


def rollerrig(*words):
    """Return the exit status of the program, what it prints, and its messages."""
    done = subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", *map(str, words)],
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr
