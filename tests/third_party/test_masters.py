"""Other people's CANopen masters drive the rig's drives and valves through a whole stop.

The bench leaves NMT, SYNC and drives to them and runs in real time; they are processes of their own.
"""

import asyncio
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rollerrig.realtime.bench import bench, options, scenario
from rollerrig.realtime.record import records

HERE = Path(__file__).parent
DRIVES = (1, 2, 3, 4)
INSTALL_S = 240.0


@pytest.fixture(scope="session")
def eds_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("eds")
    subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", "devices", "--out", folder],
        check=True,
        capture_output=True,
    )
    return folder


def install(command, folder, **environment):
    """Run an installer, or skip where it gets no package."""
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=INSTALL_S,
            env=os.environ | environment,
        )
    except subprocess.TimeoutExpired:
        pytest.skip(f"{command[0]}: no package within {INSTALL_S:g} s; is there a registry?")
    if done.returncode:
        pytest.skip(f"{command[0]} could not install: {done.stderr.strip().splitlines()[-1:]}")


@pytest.fixture(scope="session")
def npm_master(tmp_path_factory):
    """How to start npm's canopen, in a copy of its folder."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("no Node.js on this machine: npm canopen is not tried as a master")
    folder = tmp_path_factory.mktemp("npm") / "npm_canopen"
    shutil.copytree(HERE / "npm_canopen", folder, ignore=shutil.ignore_patterns("node_modules"))
    install(["npm", "install", "--no-audit", "--no-fund", "--package-lock=false"], folder)
    return ["node", str(folder / "master.js")]


@pytest.fixture(scope="session")
def go_master(tmp_path_factory, go):
    """How to start gocanopen, built in a copy of its folder."""
    folder = tmp_path_factory.mktemp("go") / "gocanopen"
    shutil.copytree(HERE / "gocanopen", folder)
    install([go, "build", "-o", "master", "."], folder, CGO_ENABLED="0", GOFLAGS="-mod=mod")
    return [str(folder / "master")]


@pytest.fixture(scope="session")
def canopen_master():
    """How to start canopen's BaseNode402."""
    return [sys.executable, str(HERE / "basenode402" / "master.py")]


def stop_with(command, protocol, out, eds_folder):
    """Run the stop with a master; the bench's summary, what the master tells, and the record."""
    plan = scenario.load(str(HERE / "stop.toml"))

    async def both():
        rig = bench.Bench(plan, options.Options("wall", "external", out), lambda progress: None)
        run = asyncio.ensure_future(rig.run())
        while not rig.parts.ports and not run.done():
            await asyncio.sleep(0.02)
        port = (
            rig.parts.ports[protocol]
            if protocol in rig.parts.ports
            else int(rig.parts.place.rpartition(":")[2].partition("/")[0])
        )
        master = await asyncio.create_subprocess_exec(
            *command,
            "127.0.0.1",
            str(port),
            str(eds_folder),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            result = await run
            told, errors = await asyncio.wait_for(master.communicate(), 15.0)
        finally:
            if master.returncode is None:
                master.kill()
        return result, told.decode(), errors.decode()

    result, told, errors = asyncio.run(both())
    assert told.strip(), errors[-3000:]
    return result, json.loads(told.strip().splitlines()[-1]), records.load(out)


MASTERS = [
    pytest.param(
        "npm_master",
        "socketcand",
        id="npm canopen 6.2.1",
        marks=pytest.mark.conformance(
            "Masters",
            "npm canopen 6.2.1: enables drives, turns a roller, reads speeds, drives valves",
        ),
    ),
    pytest.param(
        "go_master",
        "virtualcan",
        id="gocanopen v1.4.4",
        marks=pytest.mark.conformance(
            "Masters",
            "gocanopen v1.4.4: enables drives, turns a roller, reads speeds, drives valves",
        ),
    ),
    pytest.param(
        "canopen_master",
        "socketcand",
        id="BaseNode402",
        marks=pytest.mark.conformance(
            "Masters",
            "canopen BaseNode402: enables drives, turns a roller, reads speeds, drives valves",
        ),
    ),
]


@pytest.mark.parametrize(("fixture", "protocol"), MASTERS)
def test_a_foreign_master_enables_the_drives_turns_a_roller_and_drives_the_valves_to_standstill(
    fixture, protocol, tmp_path, eds_folder, request
):
    command = request.getfixturevalue(fixture)
    result, told, run = stop_with(command, protocol, tmp_path / "run", eds_folder)
    assert told["enabled"] == list(DRIVES)
    for drive in DRIVES:
        enabled = {"node": drive, "state": "OPERATION ENABLED"}.items()
        assert any(enabled <= event.fields.items() for event in run.events)
    # the roller that was turned ran ahead of its neighbour, as the master read and the bench recorded
    assert told["turned"] > 1.03
    before = run.column("time_s") < 4.0
    ahead = run.column("roller_speed_1_rad_s")[before] / run.column("roller_speed_2_rad_s")[before]
    assert ahead.max() > 1.03
    assert told["speeds_read"] > 300
    assert told["vents"] > 0
    assert sum(axle["vents"] for axle in result["axles"]) > 0
    assert result["stopped"]
    assert told["stopped"]
    # the rollers have carried the vehicle's inertia: they never left its speed by much
    error = run.column("roller_speed_2_rad_s") - run.column("vehicle_speed_m_s")
    assert np.abs(error).max() < 1.0
