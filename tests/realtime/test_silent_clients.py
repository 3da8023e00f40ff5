"""Programs that only connect, as the preconnect links of a web page do, keep nobody out."""

import contextlib
import os
import resource
import socket
import struct

import pytest
from bench_process import MAGNETS, BenchProcess, SimpleUnit, until

from rollerrig.wsp_interface.bus import buses, plugin
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.places import PLACES_OF_ADDRESS

READ_REGISTER_200 = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 200, 1)


@pytest.fixture
def connect():
    """Return a function that returns connections to a port; they are closed after the test."""
    with contextlib.ExitStack() as stack:

        def make(port):
            connection = socket.create_connection(("127.0.0.1", port), 60.0)
            connection.settimeout(60.0)
            return stack.enter_context(connection)

        yield make


def serve_until_the_end(bench, address):
    """Let a unit answer every SYNC of the run; return the bench when it has exited."""
    unit = SimpleUnit(address, lambda number: [(MAGNETS, b"\0")])
    bench.finish()
    unit.close()
    return bench


def open_descriptors(bench):
    return [int(number) for number in os.listdir(f"/proc/{bench.process.pid}/fd")]


def few_descriptors(bench):
    """Leave a running bench only a few descriptors; return the limits that it had."""
    before = resource.prlimit(bench.process.pid, resource.RLIMIT_NOFILE)
    few = max(open_descriptors(bench)) + 3
    resource.prlimit(bench.process.pid, resource.RLIMIT_NOFILE, (few, before[1]))
    return before


def exhaust(bench, connect, port):
    """Open connections until the bench is out of descriptors."""
    limit, _ = resource.prlimit(bench.process.pid, resource.RLIMIT_NOFILE)
    free = limit - len(open_descriptors(bench))
    for _ in range(free + 2):
        connect(port)
    (event,) = until(lambda: bench.reported(Code.SERVER_OUT_OF_DESCRIPTORS), "the event")
    assert event.fields["limit"] == limit


@pytest.mark.conformance("Bad input", "silent connections keep out neither a unit nor a PLC")
def test_unit_and_plc_are_served_while_silent_connections_hold_all_places(connect, tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--wsp",
        "external",
        "--wait",
        "240",
        "--set",
        "modbus.enabled=true",
        "--set",
        "modbus.port=0",
        "--set",
        "duration_max_s=0.5",
    )
    address = bench.address()
    (served,) = until(lambda: bench.reported(Code.MODBUS_SERVED), "its Modbus port")
    modbus_port = served.fields["port"]
    _, can_port, _ = plugin.parse_address(address)

    plc = connect(modbus_port)
    plc.sendall(READ_REGISTER_200)
    assert plc.recv(64)
    for _ in range(PLACES_OF_ADDRESS + 8):
        connect(can_port)
        connect(modbus_port)
    until(lambda: len(bench.reported(Code.SERVER_SILENT_GAVE_WAY)) == 2, "both events")

    plc.sendall(READ_REGISTER_200)
    assert plc.recv(64)
    serve_until_the_end(bench, address)
    assert bench.status == 4, bench.stderr  # it does not stop in that time
    assert bench.result["ended"] == "finished"
    assert bench.result["modbus"]["requests"] == 2


@pytest.mark.conformance("Bad input", "out of descriptors: an event, and clients join later")
def test_a_bench_out_of_descriptors_records_one_event_and_lets_a_unit_join_later(connect, tmp_path):
    bench = BenchProcess(
        tmp_path / "run",
        "--pacing",
        "lockstep",
        "--wsp",
        "external",
        "--wait",
        "240",
        "--set",
        "duration_max_s=0.5",
    )
    address = bench.address()
    _, port, _ = plugin.parse_address(address)
    limits = few_descriptors(bench)
    exhaust(bench, connect, port)
    # the silent connections give their descriptors back
    buses.open_client(address, connect_timeout_s=60.0).shutdown()

    resource.prlimit(bench.process.pid, resource.RLIMIT_NOFILE, limits)
    serve_until_the_end(bench, address)
    assert bench.status == 4, bench.stderr  # it does not stop in that time
    assert bench.result["ended"] == "finished"
    assert len(bench.reported(Code.SERVER_OUT_OF_DESCRIPTORS)) == 1
    assert bench.reported(Code.BENCH_EXCEPTION) == []
    assert "Traceback" not in bench.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("server", [Code.BUS_PLACE, Code.MODBUS_SERVED])
def test_a_bench_that_ends_while_it_is_out_of_descriptors_fails_in_nothing(
    connect, tmp_path, server
):
    bench = BenchProcess(
        tmp_path / "run",
        "--wsp",
        "external",
        "--wait",
        "240",
        "--set",
        "modbus.enabled=true",
        "--set",
        "modbus.port=0",
    )
    (served,) = until(lambda: bench.reported(Code.MODBUS_SERVED), "its Modbus port")
    port = served.fields["port"]
    if server == Code.BUS_PLACE:
        _, port, _ = plugin.parse_address(bench.address())
    limits = few_descriptors(bench)
    exhaust(bench, connect, port)
    resource.prlimit(bench.process.pid, resource.RLIMIT_NOFILE, limits)
    bench.interrupt()
    bench.finish()
    assert bench.result["ended"] == "interrupted"
    assert bench.reported(Code.BENCH_EXCEPTION) == []
    assert "Traceback" not in bench.stderr
