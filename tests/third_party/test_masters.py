"""CANopen masters of other projects command drives and valves of the rig through a whole stop.

The bench runs in real time and leaves NMT, SYNC and drives to the master, which is another process.
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
INSTALL_S = 240.0  # patience for an installer
BRAKE_S = 4.0  # stop.toml demands the brake from here on


@pytest.fixture(scope="session")
def eds_folder(tmp_path_factory):
    """A folder with the EDS files of the rig."""
    folder = tmp_path_factory.mktemp("eds")
    subprocess.run(
        [sys.executable, "-m", "rollerrig.realtime.cli", "devices", "--out", folder],
        check=True,
        capture_output=True,
    )
    return folder


def install(command, folder, **environment):
    """Run an installer; skip the test if it cannot get a package."""
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
        pytest.skip(
            f"{command[0]}: no package within {INSTALL_S:g} s; can this machine reach a registry?"
        )
    if done.returncode:
        last_line = done.stderr.strip().splitlines()[-1:]
        pytest.skip(f"{command[0]} could not install: {last_line}")


@pytest.fixture(scope="session")
def npm_master(tmp_path_factory):
    """The command that starts npm canopen, in a copy of its folder."""
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("this machine has no Node.js with npm, which npm canopen needs")
    folder = tmp_path_factory.mktemp("npm") / "npm_canopen"
    shutil.copytree(HERE / "npm_canopen", folder, ignore=shutil.ignore_patterns("node_modules"))
    install(["npm", "install", "--no-audit", "--no-fund", "--package-lock=false"], folder)
    return ["node", str(folder / "master.js")]


@pytest.fixture(scope="session")
def go_master(tmp_path_factory, go):
    """The command that starts gocanopen, built in a copy of its folder."""
    folder = tmp_path_factory.mktemp("go") / "gocanopen"
    shutil.copytree(HERE / "gocanopen", folder)
    install([go, "build", "-o", "master", "."], folder, CGO_ENABLED="0", GOFLAGS="-mod=mod")
    return [str(folder / "master")]


@pytest.fixture(scope="session")
def canopen_master():
    """The command that starts canopen's BaseNode402."""
    return [sys.executable, str(HERE / "basenode402" / "master.py")]


def stop_with(command, protocol, out, eds_folder):
    """Run the stop with a master.

    Returns the summary of the bench, the result that the master prints, and the record.
    """
    plan = scenario.load(str(HERE / "stop.toml"))

    async def both():
        rig = bench.Bench(plan, options.Options("wall", "external", out), lambda progress: None)
        run = asyncio.ensure_future(rig.run())
        while not rig.parts.ports and not run.done():
            await asyncio.sleep(0.02)
        master = await asyncio.create_subprocess_exec(
            *command,
            "127.0.0.1",
            str(port_of(rig, protocol)),
            str(eds_folder),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            summary = await run
            output, errors = await asyncio.wait_for(master.communicate(), INSTALL_S)
        finally:
            if master.returncode is None:
                master.kill()
        return summary, output.decode(), errors.decode()

    summary, output, errors = asyncio.run(both())
    assert output.strip(), errors[-3000:]
    *_, last_line = output.strip().splitlines()
    return summary, json.loads(last_line), records.load(out)


def port_of(rig, protocol):
    """Return the port of a protocol. The port of socketcand is in the address of the bus."""
    if protocol in rig.parts.ports:
        return rig.parts.ports[protocol]
    host_and_port, _, _ = rig.parts.place.rpartition("/")
    return int(host_and_port.rpartition(":")[2])


MASTERS = [
    pytest.param(
        "npm_master",
        "socketcand",
        id="npm canopen 6.2.1",
        # they fetch packages
        marks=(
            pytest.mark.nightly,
            pytest.mark.conformance(
                "Masters",
                "npm canopen 6.2.1: enables drives, turns a roller, reads speeds, drives valves",
            ),
        ),
    ),
    pytest.param(
        "go_master",
        "virtualcan",
        id="gocanopen v1.4.4",
        # they fetch packages
        marks=(
            pytest.mark.nightly,
            pytest.mark.conformance(
                "Masters",
                "gocanopen v1.4.4: enables drives, turns a roller, reads speeds, drives valves",
            ),
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
    summary, of_master, run = stop_with(command, protocol, tmp_path / "run", eds_folder)
    assert of_master["enabled"] == list(DRIVES)
    for drive in DRIVES:
        enabled = {"node": drive, "state": "OPERATION ENABLED"}.items()
        assert any(enabled <= event.fields.items() for event in run.events)

    # roller 1 was faster than roller 2: the master has read it, and the bench has recorded it
    assert of_master["turned"] > 1.03
    before = run.column("time_s") < BRAKE_S
    first_rad_s = run.column("roller_speed_1_rad_s")[before]
    second_rad_s = run.column("roller_speed_2_rad_s")[before]
    assert (first_rad_s / second_rad_s).max() > 1.03

    assert of_master["speeds_read"] > 300
    assert of_master["vents"] > 0
    assert sum(axle["vents"] for axle in summary["axles"]) > 0
    assert summary["stopped"]
    assert of_master["stopped"]

    # the drives have simulated the inertia of the vehicle: their speed stays near its speed (1 m
    # roller)
    error = run.column("roller_speed_2_rad_s") - run.column("vehicle_speed_m_s")
    assert np.abs(error).max() < 1.0
