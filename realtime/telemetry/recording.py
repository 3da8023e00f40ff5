"""Starts the recorder of a run and waits for it: what the bench needs of it, without its libraries."""

import json
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rollerrig.realtime.loop import ring
from rollerrig.realtime.loop.ring import Ring


def start(run_dir: Path, rows: Ring, frame: Ring, event: Ring,
          counters: Mapping[str, Any] | None = None) -> subprocess.Popen:
    """Start the recorder of a run in a session of its own; wait for it with `wait_ready`.

    `counters` (pacing, seed, unit, scenario, config_hash) go into the summary of a killed run.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "rollerrig.realtime.telemetry.recorder", str(run_dir),
         "--rows", str(rows.path), "--frames", str(frame.path), "--events", str(event.path),
         "--counters", json.dumps(dict(counters or {}))],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, start_new_session=True)


def wait_ready(process: subprocess.Popen, rows: Ring, timeout_s: float = 30.0) -> bool:
    """Wait until the recorder drains its rings; False if it died or did not come in time."""
    until = time.monotonic() + timeout_s
    while time.monotonic() < until and process.poll() is None:
        if rows.header[ring.RECORDER_BEAT_NS]:
            return True
        time.sleep(0.01)
    return False
