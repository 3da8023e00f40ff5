"""A unit with plain CAN messages of any layout reaches the rig through a DBC and a mapping."""

import threading

import can
import cantools
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.wsp_interface import rig_objects, unit_map
from rollerrig.wsp_interface.bus import buses
from rollerrig.wsp_interface.bus.connection_set import SYNC
from rollerrig.wsp_interface.rig_objects import MAGNETS_ID, UNIT_HEARTBEAT_ID

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
        unit_map.companion(files())(address),
    ):
        thread = threading.Thread(target=play_unit, args=(unit, database))
        thread.start()
        until(rig, UNIT_HEARTBEAT_ID)
        # one cycle of the rig, at 20 rad/s
        send(rig, SYNC, b"")
        send(rig, rig_objects.SPEEDS.can_id, (2000).to_bytes(2, "little") * 4)
        send(rig, rig_objects.PRESSURES.can_id, bytes(8))
        thread.join(5.0)
        reference = 0
        while reference == 0:
            message = until(rig, rig_objects.REFERENCE_SPEED.can_id)
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
    unit_map.load(files())
    with pytest.raises(ConfigError) as refusal:
        unit_map.load(files(MAP.replace(old, new)))
    assert expected in str(refusal.value)
