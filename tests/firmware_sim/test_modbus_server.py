"""Modbus TCP as the standard wants it, asked over real sockets, in right and in wrong ways."""

import random
import struct
import threading
import time

import pytest
from endurance import fuzz
from modbus_site import HIGHEST_SPEED, WORDS, Site, adu, until
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.constants import ExcCodes

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus import server
from rollerrig.firmware_sim.modbus.server import Server
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.places import PLACES_OF_ADDRESS

SPEED_SET_POINT = 1


@pytest.fixture
def site():
    place = Site()
    place.listen()
    yield place
    place.close()


@pytest.fixture
def client(site):
    return site.connect()


def two(function, first, second):
    return struct.pack(">BHH", function, first, second)


# what is asked of unit 1, and the exception that the standard wants for it
REFUSED = {
    "no register is read": (two(3, 200, 0), "8303"),
    "more registers than fit": (two(3, 200, 126), "8303"),
    "no input register is read": (two(4, 200, 0), "8403"),
    "no coil is read": (two(1, 0, 0), "8103"),
    "more coils than fit": (two(1, 0, 2001), "8103"),
    "more discrete inputs than fit": (two(2, 0, 2001), "8203"),
    "an unknown function": (bytes((0x55,)) + bytes(4), "d501"),
    "a function beyond the request range": (bytes((0x83, 2)), "8301"),
    "function 0": (bytes((0,)), "8001"),
    "a coil that is neither on nor off": (two(5, 0, 0x1234), "8503"),
    "a coil of value 1": (two(5, 0, 1), "8503"),
    "registers that are not there": (two(3, 9000, 1), "8302"),
    "registers beyond the last address": (two(3, 0xFFFF, 2), "8302"),
    "bits beyond the last address": (two(1, 0xFFFF, 2), "8102"),
    "a row of registers with a gap": (two(3, 2, 2), "8302"),
    "a coil that is only read": (two(5, 3, 0xFF00), "8502"),
    "a register that is only read": (two(6, 100, 1), "8602"),
    "half of a value that is only read": (two(6, 300, 1), "8602"),
    "a register that is not there": (two(6, 9000, 1), "8602"),
    "a value out of range": (two(6, SPEED_SET_POINT, HIGHEST_SPEED + 1), "8603"),
    "a request that is too short": (two(3, 200, 1)[:-1], "8303"),
    "a request that is too long": (two(3, 200, 1) + b"\0", "8303"),
    "a function without data": (bytes((3,)), "8303"),
    "no coil is written": (struct.pack(">BHHB", 15, 0, 0, 0), "8f03"),
    "more coils than fit are written": (
        struct.pack(">BHHB", 15, 0, 1969, 247) + bytes(247),
        "8f03",
    ),
    "coils with a wrong byte count": (struct.pack(">BHHBB", 15, 0, 9, 1, 1), "8f03"),
    "coils without their data": (struct.pack(">BHHB", 15, 0, 1, 1), "8f03"),
    "no register is written": (struct.pack(">BHHB", 16, 0, 0, 0), "9003"),
    "more registers than fit are written": (
        struct.pack(">BHHB", 16, 0, 124, 248) + bytes(246),
        "9003",
    ),
    "registers with a wrong byte count": (struct.pack(">BHHBH", 16, 0, 1, 4, 1), "9003"),
    "registers with too much data": (struct.pack(">BHHBHH", 16, 0, 1, 2, 1, 1), "9003"),
    "a mask that is too short": (struct.pack(">BHH", 22, 0, 0), "9603"),
    "an exchange that reads nothing": (struct.pack(">BHHHHBH", 23, 0, 0, 0, 1, 2, 0), "9703"),
    "an exchange that writes nothing": (struct.pack(">BHHHHB", 23, 0, 1, 0, 0, 0), "9703"),
    "an exchange that writes too much": (
        struct.pack(">BHHHHB", 23, 0, 1, 0, 122, 244) + bytes(242),
        "9703",
    ),
    "an exchange from nowhere": (struct.pack(">BHHHHBH", 23, 9000, 1, 0, 1, 2, 5), "9702"),
    "another encapsulated interface": (bytes((0x2B, 0x0D, 1, 0)), "ab01"),
    "an unknown level of identification": (bytes((0x2B, 0x0E, 5, 0)), "ab03"),
    "an identification object that is not there": (bytes((0x2B, 0x0E, 4, 0x55)), "ab02"),
    "a writer that fails": (two(6, 0, 666), "8604"),
}


@pytest.mark.conformance(
    "Modbus", "exceptions 01, 02, 03 (counts 0 and 126, FC5 values, unknown function)"
)
@pytest.mark.parametrize("what", REFUSED)
def test_a_refused_request_gets_the_standards_exception_and_changes_nothing(what, client, site):
    request, wanted = REFUSED[what]
    assert client.ask(request).hex() == wanted
    assert site.written == []
    assert client.words(202, 1) == [1234]


@pytest.mark.conformance("Modbus", "unknown unit: exception 0B")
@pytest.mark.parametrize("unit", [2, 10, 15, 247, 254])
def test_an_unknown_unit_is_a_gateway_target_that_does_not_respond(unit, client):
    assert client.ask(two(3, 200, 1), unit).hex() == "830b"


@pytest.mark.conformance("Modbus", "TCP: units 0 and 255 address the device itself")
@pytest.mark.parametrize("unit", [0, 255])
def test_units_0_and_255_address_the_device_itself_and_stand_in_its_answers(unit, client, site):
    # `ask` checks that the answer carries the unit of the request
    assert client.words(208, 3, unit) == client.words(208, 3, 1) == [100, 200, 300]
    assert client.ask(two(6, 1, 2500), unit) == two(6, 1, 2500)
    assert client.ask(two(5, 2, 0xFF00), unit) == two(5, 2, 0xFF00)
    assert site.written == [("speed_set_point", 2500), ("emergency_stop", 1)]
    assert client.ask(two(3, 9000, 1), unit).hex() == "8302"


@pytest.mark.conformance("Modbus", "several requests in one segment")
def test_requests_in_one_segment_are_answered_each_with_its_number(client):
    client.send(b"".join(adu(two(3, 202, 1), 1, number) for number in (5, 9, 700, 65535)))
    replies = [client.receive() for _ in range(4)]
    assert [number for number, _, _ in replies] == [5, 9, 700, 65535]
    assert {reply.hex() for _, _, reply in replies} == {"030204d2"}


@pytest.mark.conformance("Modbus", "a request in single bytes")
def test_a_request_that_comes_in_single_bytes_is_answered_once(client):
    for byte in adu(two(3, 202, 1), 1, 3):
        client.send(bytes((byte,)))
        time.sleep(0.002)
    assert client.receive() == (3, 1, bytes.fromhex("030204d2"))


@pytest.mark.conformance("Modbus", "broken MBAP header closes the connection")
@pytest.mark.parametrize(
    "data",
    [
        adu(two(3, 200, 1), length=0),
        adu(two(3, 200, 1), length=1),
        adu(two(3, 200, 1), length=255),
        adu(two(3, 200, 1), length=2000),
        adu(two(3, 200, 1), protocol=1),
        adu(two(3, 200, 1), protocol=0xFFFF),
        b"GET / HTTP/1.1\r\n\r\n",
        b"\0\1\0\1",
    ],
    ids=lambda data: data[:8].hex(),
)
def test_what_cannot_be_a_header_closes_the_connection_and_no_other(data, client, site):
    other = site.connect()
    client.send(data)
    assert client.receive() is None
    assert other.words(202, 1) == [1234]
    assert site.server.counters.malformed == 1


def test_what_was_sound_before_a_broken_header_is_answered(client):
    client.send(adu(two(3, 202, 1), 1, 1) + adu(two(3, 202, 1), 1, 2, protocol=7))
    assert client.receive() == (1, 1, bytes.fromhex("030204d2"))
    assert client.receive() is None


@pytest.mark.conformance("Modbus", "functions 1 to 4: measured values")
def test_signals_are_read_as_their_scale_says(client):
    assert client.words(202, 1, function=4) == [1234]
    assert client.words(208, 4) == [100, 200, 300, 65536 - 400]
    # a counter of two registers has the higher one first, and wraps
    assert client.words(260, 8) == [1, 4464, 0, 1, 0, 2, 0, 5]


def test_a_quantity_that_is_not_known_is_the_lowest_count(client, site):
    site.row[:] = float("nan")
    assert client.words(207, 1) == [0x8000]


@pytest.mark.conformance("Modbus", "functions 5, 6, 15, 16, 22, 23")
def test_registers_coils_and_masks_are_written(client, site):
    assert client.ask(two(5, 0, 0xFF00)) == two(5, 0, 0xFF00)
    assert client.ask(struct.pack(">BHHBB", 15, 0, 3, 1, 0b110)) == two(15, 0, 3)
    assert client.ask(struct.pack(">BHHBHHH", 16, 0, 3, 6, 4, 2500, 0xFFFF)) == two(16, 0, 3)
    assert client.ask(struct.pack(">BHHH", 22, 1, 0xFF00, 0x0012))[:1] == bytes((22,))
    reply = client.ask(struct.pack(">BHHHHBH", 23, 0, 3, 1, 1, 2, 777))
    assert reply == struct.pack(">BBHHH", 23, 6, 4, 777, 0xFFFF)
    assert site.written == [
        ("run", 1),
        ("run", 0),
        ("stop", 1),
        ("emergency_stop", 1),
        ("scenario", 4),
        ("speed_set_point", 2500),
        ("brake_demand_set_point", -1),
        ("speed_set_point", 2500 & 0xFF00 | 0x12),
        ("speed_set_point", 777),
    ]
    assert client.ask(two(1, 0, 3)).hex() == "010106"


@pytest.mark.conformance("Modbus", "a write is taken whole or not at all")
def test_of_several_registers_with_a_bad_one_none_is_written(client, site):
    request = struct.pack(">BHHBHHH", 16, 0, 3, 6, 4, HIGHEST_SPEED + 1, 0)
    assert client.ask(request).hex() == "9003"
    assert site.written == []


@pytest.mark.conformance("Modbus", "function 43/14 device identification")
def test_the_device_tells_who_it_is(client):
    reply = client.ask(bytes((0x2B, 0x0E, 1, 0)))
    assert reply[:7] == bytes((0x2B, 0x0E, 1, 0x82, 0, 0, 3))
    assert reply[7:].startswith(b"\0\x09rollerrig")
    assert client.ask(bytes((0x2B, 0x0E, 4, 1))).endswith(b"\x01\x0aroller rig")


@pytest.mark.conformance("Modbus", "drives on units 11 to 14: a drive walked by registers")
def test_a_drive_is_walked_to_operation_enabled_by_its_registers(client):
    for word, state in ((6, 0x21), (7, 0x23), (15, 0x27)):
        assert client.ask(two(6, 0, word), unit=12) == two(6, 0, word)
        assert client.words(100, 1, unit=12)[0] & 0x6F == state
    assert client.words(100, 1, unit=11)[0] & 0x4F == 0x40


def test_a_drives_value_of_two_registers_is_written_whole_and_has_a_sign(client, site):
    assert client.ask(struct.pack(">BHHBi", 16, 2, 2, 4, -123456), unit=11) == two(16, 2, 2)
    assert site.drives[0].objects.get(0x60FF) == -123456
    assert client.words(2, 2, unit=11) == list(struct.unpack(">HH", struct.pack(">i", -123456)))
    assert client.ask(two(6, 2, 1), unit=11).hex() == "8602"
    assert client.ask(two(6, 3, 1), unit=11).hex() == "8602"


@pytest.mark.parametrize(("at", "value"), [(1, 5), (1, 300), (16, 8), (17, 0xFFFF)])
def test_a_drive_refuses_a_value_that_its_object_refuses(at, value, client, site):
    before = client.words(at, 1, unit=13)
    assert client.ask(two(6, at, value), unit=13).hex() == "8603"
    assert client.words(at, 1, unit=13) == before


@pytest.mark.conformance("Modbus", "every row of every unit is readable")
def test_every_row_of_every_unit_is_readable(client):
    for row in WORDS:
        assert len(client.words(row.address, row.width)) == row.width
    for unit in (11, 12, 13, 14):
        assert client.words(100, 18, unit)
        assert client.words(0, 18, unit)
    assert client.ask(two(2, 0, 8))[:2] == bytes((2, 1))


@pytest.mark.conformance("Modbus", "pymodbus as a client agrees")
def test_pymodbus_as_a_client_agrees(site):
    async def talk():
        async with AsyncModbusTcpClient("127.0.0.1", port=site.port) as client:
            speeds = await client.read_holding_registers(208, count=4, device_id=1)
            assert speeds.registers[:3] == [100, 200, 300]
            assert (await client.read_coils(0, count=8, device_id=1)).bits == [False] * 8
            assert not (await client.write_register(1, 4000, device_id=1)).isError()
            assert (
                await client.read_input_registers(9999, count=1, device_id=1)
            ).exception_code == 2
            found = await client.read_device_information(read_code=1, device_id=1)
            assert found.information[0] == b"rollerrig"

    site.call(talk())
    assert site.written == [("speed_set_point", 4000)]


def test_a_port_that_is_taken_is_refused_with_how_to_mend_it(site):
    async def second():
        await Server(site.units).listen("127.0.0.1", site.port)

    with pytest.raises(BusError, match=r"modbus\.port"):
        site.call(second())


# -- what strangers do


def test_a_flooding_client_takes_turns_with_a_polite_one(site):
    flood, polite = site.connect(), site.connect()
    for one in (flood, polite):
        assert one.words(202, 1) == [1234]
    gate = threading.Event()
    site.loop.call_soon_threadsafe(
        gate.wait
    )  # both have sent all before the server reads any of it
    flood.send(
        b"".join(adu(struct.pack(">BHH", 6, 1, number), 1, number) for number in range(2400))
    )
    polite.send(adu(struct.pack(">BHH", 6, 1, 5000)))
    gate.set()
    assert [flood.receive()[0] for _ in range(2400)] == list(range(2400))
    assert polite.receive()
    assert len(site.written) == 2401
    # it waits for the turns of what the flood's connection holds, not for the flood
    assert site.written.index(("speed_set_point", 5000)) <= 2 * server.BURST


@pytest.mark.conformance("Modbus", "a client that never reads harms nobody")
def test_a_client_that_never_reads_is_not_read_and_harms_nobody(site):
    deaf, polite = site.connect(), site.connect()
    deaf.socket.setblocking(False)
    burst = b"".join(adu(two(3, 200, 60), 1, number) for number in range(1000))
    sent = 0
    for _ in range(2000):
        try:
            sent += deaf.socket.send(burst)
        except BlockingIOError:
            time.sleep(0.001)
    # it comes to rest: nothing is answered into a full buffer
    until(
        lambda: site.server.counters.requests == (time.sleep(0.5), site.server.counters.requests)[1]
    )
    before = site.server.counters.requests
    assert polite.words(202, 1) == [1234]
    assert site.server.counters.requests == before + 1
    connection = max(site.server.connections, key=lambda one: one.transport.get_write_buffer_size())
    assert connection.transport.get_write_buffer_size() < 100_000
    assert len(connection._received) < 20_000


def test_when_clients_that_have_asked_take_all_places_the_idle_one_gives_way(site):
    first = site.connect()
    assert first.words(202, 1) == [1234]
    for _ in range(PLACES_OF_ADDRESS):
        assert site.connect().words(202, 1) == [1234]
    assert first.receive() is None
    assert len(site.server.connections) == PLACES_OF_ADDRESS


@pytest.mark.conformance("Modbus", "clients without a request cannot push out a PLC")
def test_a_client_without_a_request_gives_way_before_one_that_has_been_idle_for_longer():
    reported = []
    site = Site(on_event=lambda code, **fields: reported.append((code, fields)))
    site.listen()
    plc = site.connect()
    assert plc.words(202, 1) == [1234]
    silent = [site.connect() for _ in range(PLACES_OF_ADDRESS + 3)]
    for one in silent[:4]:
        assert one.receive() is None
    assert plc.words(202, 1) == [1234]
    assert silent[4].words(202, 1) == [1234]
    ((code, fields),) = reported
    assert code == Code.SERVER_SILENT_GAVE_WAY
    assert fields == {"server": "Modbus", "places": PLACES_OF_ADDRESS}
    site.close()


@pytest.mark.conformance("Modbus", "a client without a request is closed")
def test_a_client_without_a_request_is_closed_after_its_time():
    reported = []
    site = Site(
        first_request_s=3.0, on_event=lambda code, **fields: reported.append((code, fields))
    )
    site.listen()
    plc = site.connect()
    plc.send(adu(two(3, 202, 1)))
    silent = site.connect()
    unfinished = site.connect()
    unfinished.send(adu(two(3, 202, 1))[:-1])
    assert silent.receive() is None
    assert unfinished.receive() is None
    assert plc.receive()
    assert plc.words(202, 1) == [1234]
    assert reported == [(Code.SERVER_SILENT_CLOSED, {"server": "Modbus", "after_s": 3.0})]
    site.close()


def test_a_client_that_vanishes_in_the_middle_of_a_request_is_forgotten(site):
    gone, polite = site.connect(), site.connect()
    gone.send(adu(two(3, 200, 1))[:9])
    gone.socket.close()
    assert polite.words(202, 1) == [1234]
    until(lambda: len(site.server.connections) == 1)


@pytest.mark.conformance("Modbus", "fuzz: random requests")
@pytest.mark.parametrize("seed", range(4))
def test_random_requests_get_an_answer_or_an_exception_each(seed, client, site):
    rng = random.Random(seed)
    for _ in range(500):
        request, unit = fuzz.modbus_request(rng), rng.choice([1, 1, 11, 14, 0, 200])
        reply = client.ask(request, unit)
        assert reply[0] & 0x7F == request[0] & 0x7F
        if reply[0] & 0x80 and not request[0] & 0x80:
            assert len(reply) == 2
            assert reply[1] in iter(ExcCodes)
    assert site.thread.is_alive()


@pytest.mark.conformance("Modbus", "fuzz: random bytes")
@pytest.mark.parametrize("seed", range(4))
def test_random_bytes_close_or_are_answered_and_the_server_lives(seed, site):
    rng = random.Random(1000 + seed)
    for _ in range(60):
        client = site.connect()
        data = b"".join(
            adu(
                fuzz.modbus_request(rng),
                rng.randrange(256),
                rng.randrange(65536),
                rng.choice([0, 0, 0, 1, 256]),
                rng.choice([None, None, 0, 3, 254, 255, 65535]),
            )
            for _ in range(rng.randrange(1, 6))
        )
        client.send(data[: rng.randrange(len(data)) + 1])
        client.socket.close()
    assert site.connect().words(202, 1) == [1234]
    assert site.thread.is_alive()
