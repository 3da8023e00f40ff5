"""What the desk costs the real-time loop: the same stop with and without a desk that ten browsers look at.

The two run by turns in wall pacing, each a bench process of its own with the reference WSP unit. The browsers are
clients that do what a browser does towards the desk: load the page, hold its websocket, ask for new rows ten times a
second. They draw nothing: what a browser takes of a machine is not the desk's. One stands still (SIGSTOP) with its
connections open. The figures are the benches' own summaries'.

    python -m rollerrig.realtime.benchmarks.desk ADDRESS
"""

import argparse
import asyncio
import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.configs.processes import children
from rollerrig.realtime.benchmarks import harness
from rollerrig.realtime.benchmarks.figures import Result, Say, target

SECONDS, BROWSERS, _SLICE_S = 120.0, 10, 20.0
_LINE_WAIT_S, _PERIOD_S = 60.0, 0.1


def run(given: argparse.Namespace, say: Say) -> Result:
    """Run both by turns for the seconds asked for."""
    rounds = max(1, round(given.seconds / (2.0 * _SLICE_S)))
    seconds = max(2.0, given.seconds / (2.0 * rounds))
    alone: list[Result] = []
    watched: list[Result] = []
    with tempfile.TemporaryDirectory(prefix="rollerrig-desk-") as place:
        for at in range(rounds):
            say(
                f"{seconds:g} s without a desk, {seconds:g} s with {BROWSERS} browsers ({at + 1} of {rounds}) ..."
            )
            alone.append(harness.alone(Path(place) / f"alone-{at}", seconds))
            with _desk(Path(place)):
                watched.append(harness.alone(Path(place) / f"watched-{at}", seconds))
    without, beside = harness.total(alone), harness.total(watched)
    late = {
        name: beside["lateness_us"][name] / max(without["lateness_us"][name], 1.0)
        for name in ("p50", "p99")
    }
    return {
        "without": without,
        "with": beside,
        "ratio": late,
        "targets": [
            target(
                "ticks missed in a thousand that a desk adds",
                beside["missed_per_mille"] - without["missed_per_mille"],
                0.0,
            )
        ],
        "notes": [
            f"lateness with over without: p50 {late['p50']:.2f}, p99 {late['p99']:.2f}",
            "where other programs want the cores, both miss ticks: compare the two columns",
        ],
    }


@contextlib.contextmanager
def _desk(folder: Path) -> Iterator[None]:
    """A desk with its browsers, the last of which stands still."""
    desk = _begun(
        "rollerrig.realtime.cli", "desk", "--port", "0", "--folder", str(folder), "--json"
    )
    browsers = []
    try:
        address = json.loads(_line(desk))["address"]
        browsers = [_begun("rollerrig.realtime.benchmarks.desk", address) for _ in range(BROWSERS)]
        for browser in browsers:
            _line(browser)
        browsers[-1].send_signal(signal.SIGSTOP)
        yield
    finally:
        for process in (*browsers, desk):
            process.kill()
            process.communicate()


def _begun(*words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        children.command(sys.executable, "-m", *words),
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def _line(process: subprocess.Popen[str]) -> str:
    """What a process says first. Raises RollerrigError where it says nothing."""
    assert process.stdout
    if line := process.stdout.readline():
        return line
    raise RollerrigError(
        "the desk or a browser has ended: " + process.communicate()[1].strip()[-300:]
    )


def table(result: Result) -> Table:
    """Both side by side; a lateness is the worst of the rounds."""
    return harness.side_by_side(
        result, "the loop beside a desk", f"with a desk, {BROWSERS} browsers"
    )


async def browse(address: str) -> None:
    """Do what a browser does, until killed; says a line when the websocket is open."""
    import httpx
    import socketio

    async with httpx.AsyncClient(base_url=address, timeout=_LINE_WAIT_S) as client:
        text = (await client.get("/")).text
        found = re.search(r"'client_id': '([0-9a-f-]+)'", text)
        assert found, text[:200]
        live = socketio.AsyncClient()
        about = "&".join(
            (
                f"client_id={found[1]}",
                "implicit_handshake=true",
                "tab_id=tab",
                "document_id=document",
                "next_message_id=0",
            )
        )
        await live.connect(
            f"{address}?{about}", socketio_path="/_nicegui_ws/socket.io", transports=["websocket"]
        )
        print("there", flush=True)
        bench, points = "", 0
        while True:
            begun_s = time.monotonic()
            told = (await client.get("/desk/rows", params={"bench": bench, "after": points})).json()
            bench, points = told["bench"], told["points"]
            await asyncio.sleep(max(0.0, _PERIOD_S - (time.monotonic() - begun_s)))


if __name__ == "__main__":
    asyncio.run(browse(sys.argv[1]))
