"""Other people's Modbus clients against the rig's units: mbpoll, and simonvetter/modbus in Go."""

import ctypes
import ctypes.util
import json
import os
import shutil
import subprocess
import threading
from pathlib import Path

import pytest
from modbus_site import Site

GO_CLIENT = Path(__file__).parent / "modbus_go"
GOBURROW_CLIENT = Path(__file__).parent / "modbus_goburrow"
LIBMODBUS = ctypes.util.find_library("modbus")
MBPOLL = shutil.which("mbpoll")
needs_mbpoll = pytest.mark.skipif(not MBPOLL, reason="needs mbpoll: apt-get install mbpoll")


@pytest.fixture
def site():
    place = Site()
    yield place
    place.close()


def run(*command, **more):
    # the first one compiles, and beside a busy machine that takes minutes
    return subprocess.run([*map(str, command)], capture_output=True, text=True, timeout=600, **more)


def mbpoll(way, *arguments):
    done = run(MBPOLL, *way, "-0", "-1", "-o", 2, *arguments)
    return done.returncode, done.stdout + done.stderr


def read_values(text):
    """Value by reference, as mbpoll prints them."""
    lines = (line.split(":") for line in text.splitlines() if line.startswith("["))
    return {int(at.strip("[] ")): int(value.split()[0]) for at, value in lines}


def tcp(site):
    return ["-m", "tcp", "-p", str(site.listen()), "127.0.0.1"]


def rtu(site):
    return ["-m", "rtu", "-b", "19200", "-P", "even", site.serial()]


@pytest.mark.conformance("Masters", "mbpoll over TCP and RTU on a pty: reads")
@needs_mbpoll
@pytest.mark.parametrize("way", [tcp, pytest.param(rtu, marks=pytest.mark.nightly)])
def test_mbpoll_reads_speeds_counters_and_bits(way, site):
    at = way(site)
    status, text = mbpoll(at, "-a", 1, "-t", 4, "-r", 208, "-c", 3)
    assert (status, read_values(text)) == (0, {208: 100, 209: 200, 210: 300})
    status, text = mbpoll(at, "-a", 1, "-t", "3:int", "-B", "-r", 260, "-c", 2)
    assert (status, read_values(text)) == (0, {260: 70000, 262: 1})
    status, text = mbpoll(at, "-a", 1, "-t", 1, "-r", 0, "-c", 8)
    assert (status, read_values(text)) == (0, dict.fromkeys(range(8), 0))


@pytest.mark.nightly
@pytest.mark.conformance("Masters", "mbpoll over TCP and RTU on a pty: writes, walks a drive")
@needs_mbpoll
@pytest.mark.parametrize("way", [tcp, rtu])
def test_mbpoll_writes_set_points_and_walks_a_drive(way, site):
    at = way(site)
    assert mbpoll([*at, "2500"], "-a", 1, "-t", 4, "-r", 1)[0] == 0
    assert mbpoll([*at, "1"], "-a", 1, "-t", 0, "-r", 0)[0] == 0
    assert site.written == [("speed_set_point", 2500), ("run", 1)]
    for word, state in ((6, 0x21), (7, 0x23), (15, 0x27)):
        assert mbpoll([*at, str(word)], "-a", 14, "-t", 4, "-r", 0)[0] == 0
        _, text = mbpoll(at, "-a", 14, "-t", 3, "-r", 100)
        assert read_values(text)[100] & 0x6F == state


@pytest.mark.nightly
@needs_mbpoll
def test_mbpoll_is_told_what_it_may_not(site):
    at = tcp(site)
    assert "Illegal data address" in mbpoll(at, "-a", 1, "-t", 4, "-r", 9000)[1]
    assert "Illegal data value" in mbpoll([*at, "60000"], "-a", 1, "-t", 4, "-r", 1)[1]
    assert "Target device failed to respond" in mbpoll(at, "-a", 77, "-t", 4, "-r", 208)[1]


@pytest.mark.conformance("Masters", "libmodbus over TCP without modbus_set_slave: unit 255")
@pytest.mark.skipif(not LIBMODBUS, reason="needs libmodbus: apt-get install libmodbus5")
@pytest.mark.parametrize(
    "unit",
    [
        pytest.param(None, id="default"),
        pytest.param(0, id="0", marks=pytest.mark.nightly),
        pytest.param(255, id="255", marks=pytest.mark.nightly),
        pytest.param(1, id="1", marks=pytest.mark.nightly),
    ],
)
def test_libmodbus_reads_speeds_with_its_default_unit(unit, site):
    library = ctypes.CDLL(LIBMODBUS)
    library.modbus_new_tcp.restype = ctypes.c_void_p
    context = ctypes.c_void_p(library.modbus_new_tcp(b"127.0.0.1", site.listen()))
    registers = (ctypes.c_uint16 * 4)()
    try:
        if unit is not None:
            assert library.modbus_set_slave(context, unit) == 0
        assert library.modbus_connect(context) == 0
        assert library.modbus_read_registers(context, 208, 4, registers) == 4
        assert list(registers) == [100, 200, 300, 65536 - 400]
    finally:
        library.modbus_close(context)
        library.modbus_free(context)


@pytest.mark.nightly
@pytest.mark.conformance("Masters", "goburrow/modbus (Go) over TCP without an ID: unit 0")
def test_goburrow_reads_speeds_with_its_default_unit(go, tmp_path, site):
    client = build_go(go, GOBURROW_CLIENT, tmp_path)
    done = run(client, f"127.0.0.1:{site.listen()}")
    assert done.returncode == 0, done.stderr
    speeds = "006400c8012cfe70"
    assert json.loads(done.stdout) == {"0": speeds, "1": speeds, "255": speeds}


@pytest.fixture(scope="session")
def go_client(tmp_path_factory, go):
    return build_go(go, GO_CLIENT, tmp_path_factory.mktemp("go"))


def build_go(go, source, out):
    """Build a Go program into a folder, and return its path; skip the test without the proxy."""
    quiet = os.environ | {"GOFLAGS": "-mod=readonly", "GOTOOLCHAIN": "local"}
    fetched = run(go, "mod", "download", cwd=source, env=quiet)
    if fetched.returncode:
        pytest.skip(f"the Go module proxy cannot be reached: {fetched.stderr.strip()[-200:]}")
    program = out / "modbus_client"
    built = run(go, "build", "-o", program, ".", cwd=source, env=quiet)
    assert built.returncode == 0, built.stderr
    return program


def check_what_go_saw(done, site):
    assert done.returncode == 0, done.stderr
    seen = json.loads(done.stdout)
    assert seen["speeds"] == [100, 200, 300, 65536 - 400]
    assert seen["pulses"] == 70000
    assert seen["bits"] == [True] + [False] * 7
    assert seen["status"] & 0x6F == 0x27
    assert seen["target"] == 123456
    assert site.drives[1].objects.get(0x60FF) == 123456
    assert site.written == [("speed_set_point", 2500), ("brake_demand_set_point", -1), ("run", 1)]


@pytest.mark.nightly
@pytest.mark.conformance("Masters", "simonvetter/modbus (Go) over TCP")
def test_a_go_client_works_over_tcp(go_client, site):
    check_what_go_saw(run(go_client, f"tcp://127.0.0.1:{site.listen()}"), site)


@pytest.mark.nightly
@pytest.mark.conformance("Masters", "simonvetter/modbus (Go) over RTU")
def test_a_go_client_works_over_rtu(go_client, site):
    check_what_go_saw(run(go_client, f"rtu://{site.serial()}"), site)


@pytest.mark.nightly
@pytest.mark.conformance("Masters", "simonvetter/modbus (Go) over TLS")
@pytest.mark.skipif(not shutil.which("openssl"), reason="needs the command openssl")
def test_a_go_client_works_over_tls_with_its_certificate_and_not_without(go_client, site, tmp_path):
    from test_modbus_tls import asked, authority, certificate

    from rollerrig.firmware_sim.modbus.access import tls_context

    for name in ("plant", "stranger"):
        authority(tmp_path, name)
    for name, signer in (("rig", "plant"), ("room", "plant"), ("intruder", "stranger")):
        certificate(tmp_path, name, signer)
    port = site.listen(tls_context(asked(tmp_path)))
    address = f"tcp+tls://127.0.0.1:{port}"
    wrong = run(
        go_client,
        address,
        tmp_path / "intruder.pem",
        tmp_path / "intruder.key",
        tmp_path / "plant.pem",
    )
    assert wrong.returncode == 1
    assert site.server.counters.requests == 0
    check_what_go_saw(
        run(
            go_client, address, tmp_path / "room.pem", tmp_path / "room.key", tmp_path / "plant.pem"
        ),
        site,
    )


@pytest.mark.nightly
@needs_mbpoll
def test_two_clients_at_once_do_not_disturb_each_other(site):
    at = tcp(site)
    found = []
    threads = [
        threading.Thread(
            target=lambda: found.append(mbpoll(at, "-a", 1, "-t", 4, "-r", 208, "-c", 2))
        )
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [read_values(text) for _, text in found] == [{208: 100, 209: 200}] * 4
