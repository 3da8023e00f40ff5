"""A unit with plain CAN messages of any layout reaches the rig through a DBC and a mapping."""

import threading

import can
import cantools
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import rig_objects, signals
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import SYNC
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, UNIT_HEARTBEAT_ID
from rollerrig.wsp_interface.unit_map import gateway, mapping

DBC = """VERSION ""
NS_ :
BS_:
BU_: UNIT RIG
BO_ 1632 SPEEDS: 8 RIG
 SG_ V1 : 0|16@1+ (0.01,0) [0|655] "km/h" UNIT
 SG_ V2 : 16|16@1+ (0.01,0) [0|655] "km/h" UNIT
 SG_ V3 : 32|16@1+ (0.01,0) [0|655] "km/h" UNIT
 SG_ V4 : 48|16@1+ (0.01,0) [0|655] "km/h" UNIT
BO_ 1633 VALVES: 3 UNIT
 SG_ H1 : 0|1@1+ (1,0) [0|1] "" RIG
 SG_ H2 : 1|1@1+ (1,0) [0|1] "" RIG
 SG_ H3 : 2|1@1+ (1,0) [0|1] "" RIG
 SG_ H4 : 3|1@1+ (1,0) [0|1] "" RIG
 SG_ L1 : 4|1@1+ (1,0) [0|1] "" RIG
 SG_ L2 : 5|1@1+ (1,0) [0|1] "" RIG
 SG_ L3 : 6|1@1+ (1,0) [0|1] "" RIG
 SG_ L4 : 7|1@1+ (1,0) [0|1] "" RIG
 SG_ V_REF : 8|16@1+ (0.01,0) [0|655] "km/h" RIG
BO_ 145 TAKEN: 1 UNIT
 SG_ T1 : 0|8@1+ (1,0) [0|1] "" RIG
"""
TABLE = signals.table(COACH)
SPEEDS = 1632  # messages of the unit
VALVES = 1633

MAP = """dbc = "unit.dbc"
[[to_unit]]
message = "SPEEDS"
factor = 1.602
signals = { V1 = "measured_speed_1", V2 = "measured_speed_2", V3 = "measured_speed_3", V4 = "measured_speed_4" }
[from_unit]
message = "VALVES"
hold = ["H1", "H2", "H3", "H4"]
vent = ["L1", "L2", "L3", "L4"]
reference = "V_REF"
reference_factor = 0.2777778
"""


@pytest.fixture
def files(tmp_path):
    """Write the DBC; return a function that writes a mapping and returns its path."""
    (tmp_path / "unit.dbc").write_text(DBC)

    def write(text=MAP):
        path = tmp_path / "map.toml"
        path.write_text(text)
        return path

    return write


def until(bus, can_id, timeout_s=60.0):
    """Return the next message with an identifier."""
    while (message := bus.recv(timeout_s)) is not None:
        if message.arbitration_id == can_id:
            return message
    raise AssertionError(f"no frame {can_id:X}h")


def send(bus, can_id, data):
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def play_unit(bus, database):
    """Answer every message of speeds, until one shows that the wheels turn."""
    # before the first SYNC the gateway sends the speeds of a standing train
    for _ in range(50):
        speeds = database.decode_message(SPEEDS, until(bus, SPEEDS).data)
        content = {f"{kind}{axle}": 0 for kind in "HL" for axle in range(1, 5)}
        content |= {"H3": 1, "L3": 1, "H1": 1, "V_REF": speeds["V2"]}
        send(bus, VALVES, database.encode_message(VALVES, content))
        if speeds["V2"] > 1.0:
            return


def test_a_plain_unit_gets_its_speeds_and_moves_the_magnets(start_hub, files):
    hub = start_hub()
    database = cantools.database.load_file(files().parent / "unit.dbc")
    address = f"socketcand://{hub.address()}"
    with (
        buses.open_client(address) as rig,
        buses.open_client(address) as unit,
        gateway.companion(files(), TABLE)(address),
    ):
        thread = threading.Thread(target=play_unit, args=(unit, database))
        thread.start()
        until(rig, UNIT_HEARTBEAT_ID)
        # one cycle of the rig, at 20 rad/s
        send(rig, SYNC, b"")
        send(rig, rig_objects.SPEEDS_ID, (2000).to_bytes(2, "little") * 4)
        send(rig, rig_objects.PRESSURES_ID, bytes(8))
        thread.join(5.0)
        reference = 0
        while reference == 0:
            message = until(rig, rig_objects.REFERENCE_SPEED_ID)
            reference = int.from_bytes(message.data, "little")
        byte = until(rig, MAGNETS_ID).data[0]
    # 20 rad/s at 0.445 m are 8.9 m/s
    assert reference * 0.01 == pytest.approx(8.9, abs=0.02)
    assert byte == 0b00_11_00_01


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"SPEEDS"', '"SPEED"', "SPEEDS"),
        ('"L4"', '"L5"', "no signal 'L5'"),
        ('"VALVES"', '"TAKEN"', "91h, which the rig uses"),
        ("unit.dbc", "none.dbc", "cannot be read"),
        ("measured_speed_4", "wheel_speed_4", "measured_speed_4"),
        (', V4 = "measured_speed_4"', "", "V4; map all"),
        ("reference =", "refrence =", "unknown key"),
    ],
)
def test_a_wrong_mapping_is_refused(files, old, new, expected):
    mapping.load(files(), TABLE)
    with pytest.raises(ConfigError) as refusal:
        mapping.load(files(MAP.replace(old, new)), TABLE)
    assert expected in str(refusal.value)


def refusal(files, dbc=DBC, text=MAP):
    """Return the message with which a mapping and a DBC are refused."""
    path = files(text)
    (path.parent / "unit.dbc").write_text(dbc)
    with pytest.raises(ConfigError) as refused:
        mapping.load(path, TABLE)
    return str(refused.value)


def with_dbc(files, dbc, text=MAP, encoding="utf-8"):
    """Return the mapping that a text and a DBC make."""
    path = files(text)
    (path.parent / "unit.dbc").write_bytes(dbc.encode(encoding))
    return mapping.load(path, TABLE)


class Log:
    """A bus that keeps what is sent."""

    def __init__(self):
        self.sent = []

    def send(self, message):
        self.sent.append(message)


def messages_of(unit_map, values):
    """Return the data that a gateway sends its unit for each row of values of the rig."""
    log = Log()
    translator = gateway.Gateway(log, unit_map)
    for row in values:
        translator.values |= row
        translator._send_to_unit()
    return translator, [bytes(message.data) for message in log.sent]


def test_a_message_of_can_fd_is_refused_when_the_mapping_is_read(files):
    message = refusal(files, DBC.replace("SPEEDS: 8", "SPEEDS: 16"))
    assert "SPEEDS has 16 bytes, so it is a message of CAN FD" in message
    assert "[[to_unit]] 1" in message
    message = refusal(files, DBC.replace("VALVES: 3", "VALVES: 12"))
    assert "[from_unit]: VALVES has 12 bytes" in message


# what is wrong with messages that nobody maps: signals that overlap, that do not fit, a name twice
OTHERS = """BO_ 1700 OTHER: 1 UNIT
 SG_ STATUS : 0|8@1+ (1,0) [0|255] "" RIG
 SG_ FLAG : 0|1@1+ (1,0) [0|1] "" RIG
BO_ 1701 SHORT: 1 UNIT
 SG_ LONG : 4|16@1+ (1,0) [0|255] "" RIG
BO_ 1702 OTHER: 1 UNIT
 SG_ STATUS : 0|8@1+ (1,0) [0|255] "" RIG
"""


def test_a_dbc_is_judged_by_its_mapped_messages_only(files):
    assert with_dbc(files, DBC + OTHERS).outgoing[0].message.name == "SPEEDS"
    overlapping = DBC.replace("V2 : 16|16", "V2 : 8|16")
    message = refusal(files, overlapping)
    assert "message = 'SPEEDS'" in message
    assert "overlapping" in message
    twice = DBC + OTHERS.replace("OTHER", "SPEEDS")
    assert "the DBC has two messages of that name" in refusal(files, twice)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "gbk"])
def test_comments_and_units_may_be_in_any_encoding(encoding, files):
    text = "轮速 前轴" if encoding == "gbk" else "Räder in °/s"
    dbc = f'{DBC}CM_ BO_ 1632 "{text}";\n'
    assert with_dbc(files, dbc, encoding=encoding).outgoing[0].message.length == 8


@pytest.mark.parametrize(
    ("rad_s", "counts"),
    [(0.0, 0), (10.0, 1602), (-3.0, 0), (408.0, 65362), (500.0, 65500), (1e9, 65500)],
)
def test_a_value_that_does_not_fit_its_signal_becomes_the_nearest_one_that_does(
    rad_s, counts, files
):
    # the signal is unsigned, of 0.01 km/h, and the DBC declares 0 to 655
    row = {f"measured_speed_{axle}": rad_s for axle in range(1, 5)}
    translator, (data,) = messages_of(with_dbc(files, DBC), [row])
    assert data == counts.to_bytes(2, "little") * 4
    fits = 0.0 <= 1.602 * rad_s <= 655.0
    assert bool(list(translator.notes())) is not fits


def test_signed_big_endian_and_floating_signals_are_limited_too(files):
    dbc = DBC.replace("V1 : 0|16@1+ (0.01,0) [0|655]", "V1 : 7|16@0- (0.01,0) [0|0]")
    dbc = dbc.replace("V2 : 16|16@1+ (0.01,0) [0|655]", "V2 : 16|16@1+ (-0.01,100) [0|0]")
    unit_map = with_dbc(files, dbc, MAP.replace("1.602", "1"))
    _, sent = messages_of(
        unit_map,
        [
            {"measured_speed_1": -1e4, "measured_speed_2": 1e4},
            {"measured_speed_1": 1e4, "measured_speed_2": -1e4},
            {"measured_speed_1": -1.0, "measured_speed_2": 99.0},
        ],
    )
    assert [data[:4].hex() for data in sent] == ["80000000", "7fffffff", "ff9c6400"]


FILLED_DBC = DBC.replace(
    """ SG_ V4 : 48|16@1+ (0.01,0) [0|655] "km/h" UNIT
""",
    """ SG_ ALIVE : 48|2@1+ (1,0) [0|3] "" UNIT
 SG_ MODE : 50|6@1+ (0.5,0) [0|31.5] "" UNIT
 SG_ CRC : 56|8@1+ (1,0) [0|255] "" UNIT
""",
)
FILLED_MAP = MAP.replace(', V4 = "measured_speed_4"', "").replace(
    "factor = 1.602",
    """factor = 1.602
constants = { MODE = 2.5 }
counter = "ALIVE"
checksum = { signal = "CRC", kind = "crc8_sae_j1850", prefix = [0x1A] }""",
)


def crc8_sae_j1850(data):
    """Bit by bit: polynomial 1Dh, begins with FFh, ends inverted."""
    remainder = 0xFF
    for byte in data:
        remainder ^= byte
        for _ in range(8):
            remainder = (remainder << 1 ^ 0x1D if remainder & 0x80 else remainder << 1) & 0xFF
    return remainder ^ 0xFF


def test_alive_counter_checksum_and_constants_are_sent_beside_the_speeds(files):
    # the check value of the catalogue of CRC algorithms
    assert crc8_sae_j1850(b"123456789") == 0x4B
    unit_map = with_dbc(files, FILLED_DBC, FILLED_MAP)
    row = {f"measured_speed_{axle}": 10.0 for axle in range(1, 5)}
    _, sent = messages_of(unit_map, [row] * 5)
    assert [data[6] for data in sent] == [5 << 2 | count for count in (0, 1, 2, 3, 0)]
    for data in sent:
        assert data[:6] == (1602).to_bytes(2, "little") * 3
        assert data[7] == crc8_sae_j1850(b"\x1a" + data[:7])


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('counter = "ALIVE"\n', "", "also has ALIVE; map all"),
        ("MODE = 2.5", "MODE = 40", "MODE = 40: allowed is 0 to 31.5"),
        ("MODE = 2.5", "MOD = 2.5", "no signal 'MOD'"),
        ("MODE = 2.5", "MODE = 2.5, ALIVE = 1", "ALIVE is given twice"),
        ("crc8_sae_j1850", "crc8_sae_j1859", "crc8_sae_j1850"),
        ("crc8_sae_j1850", "crc16_arc", "crc16_arc has 16 bits, and CRC 8"),
        ("[0x1A]", "[300]", "bytes from 0 to 255"),
        ('counter = "ALIVE"', "counter = 1", 'write counter = "ALIVE"'),
    ],
)
def test_a_field_that_cannot_be_filled_so_is_refused(old, new, expected, files):
    assert expected in refusal(files, FILLED_DBC, FILLED_MAP.replace(old, new))


def test_each_group_of_a_multiplexed_message_is_a_message_of_the_mapping(files):
    dbc = DBC.replace("V1 : 0|16", 'M M : 0|8@1+ (1,0) [0|1] "" UNIT\n SG_ V1 m0 : 16|16')
    dbc = dbc.replace("V2 : 16|16", "V2 m0 : 32|16")
    dbc = dbc.replace("V3 : 32|16", "V3 m1 : 16|16").replace("V4 : 48|16", "V4 m1 : 32|16")
    table = """[[to_unit]]
message = "SPEEDS"
factor = 1
constants = { M = %d }
signals = { V%d = "measured_speed_1", V%d = "measured_speed_2" }
"""
    text = MAP.replace(
        MAP[MAP.index("[[") : MAP.index("[from")], table % (0, 1, 2) + table % (1, 3, 4)
    )
    row = {"measured_speed_1": 1.0, "measured_speed_2": 2.0}
    _, sent = messages_of(with_dbc(files, dbc, text), [row])
    assert [data.hex() for data in sent] == ["00006400c8000000", "01006400c8000000"]
    swapped = text.replace("V2 =", "V4 =", 1)
    assert "not in the multiplexed group" in refusal(files, dbc, swapped)
    chosen = text.replace("constants = { M = 0 }\n", "")
    assert "multiplexed by M; choose a group" in refusal(files, dbc, chosen)
    assert "M = 7: allowed is 0 to 1" in refusal(files, dbc, text.replace("M = 1", "M = 7"))


def test_a_message_of_the_unit_with_a_wrong_checksum_is_no_answer(files):
    dbc = DBC.replace('V_REF : 8|16@1+ (0.01,0) [0|655] "km/h"', 'SUM : 8|8@1+ (1,0) [0|255] ""')
    text = MAP.replace('reference = "V_REF"\nreference_factor = 0.2777778\n', "")
    unit_map = with_dbc(files, dbc, text + 'checksum = { signal = "SUM", kind = "sum8" }\n')
    log = Log()
    translator = gateway.Gateway(log, unit_map)
    translator._translate_answer(bytes([0x11, 0x12, 0x00]))
    assert log.sent == []
    assert "1 messages of the unit had a wrong checksum" in "".join(translator.notes())
    translator._translate_answer(bytes([0x11, 0x11, 0x00]))
    assert [(message.arbitration_id, bytes(message.data)) for message in log.sent] == [
        (MAGNETS_ID, b"\x03")
    ]


def multiplexed(number, signals_of_message):
    """The lines of a message whose signals are all multiplexed."""
    lines = [f"BO_ {number} M{number}: 8 RIG", ' SG_ X M : 0|16@1+ (1,0) [0|1] "" UNIT']
    for group in range(signals_of_message):
        lines.append(f' SG_ S{group} m{group} : 16|8@1+ (1,0) [0|1] "" UNIT')
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    "lines",
    [
        multiplexed(500, 2_000),
        "".join(multiplexed(500 + n, 900) for n in range(30)),
        multiplexed(500, 2_000).replace("\n", " "),
        multiplexed(500, 2_000).replace('""', '"\nBO_ "'),
    ],
    ids=["in one message", "in all", "on one line", "with texts that look like messages"],
)
def test_a_dbc_that_would_take_minutes_to_read_is_refused(files, tmp_path, lines):
    (tmp_path / "unit.dbc").write_text(DBC + lines)
    with pytest.raises(ConfigError, match=r"more than 20000 signals.*more than 1000"):
        mapping.load(files(), TABLE)
