"""The nodes of the rig keep stored parameters from one run to the next."""

import numpy as np
import pytest

from rollerrig.realtime.bench import rig_bus, scenario
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

SAVE = b"save"  # the signature in 1010h that stores the parameters
# requests of SDO as they are on the bus: command specifier, index, sub-index
READ_1017 = b"\x40\x17\x10\0"  # read the heartbeat time
WRITE_1017 = b"\x2b\x17\x10\0"  # write two bytes to it
STORE_ALL = b"\x23\x10\x10\1"  # write four bytes to 1010h sub 1
WRITTEN = 0x60
SDO_REQUEST = 0x600


class Rig:
    """A rig on a hub that listens nowhere, and an SDO client."""

    def __init__(self, *settings):
        self.hub = Hub(lambda: 0)
        self.answers = []
        plan = scenario.load("dry_stop", settings=settings)
        rig_bus.RigBus(
            self.hub,
            plan,
            np.zeros(len(signals.COLUMNS)),
            lambda row: None,
            events.ignore,
            lambda: 0,
        )
        self.port = self.hub.attach(lambda frame: self.answers.append(frame.data), "client")

    def request(self, node, data):
        """The answer of a node to an SDO request."""
        self.answers.clear()
        self.port.send(Frame(SDO_REQUEST + node, data.ljust(8, b"\0")))
        return self.answers[-1]

    def heartbeat_ms(self, node):
        answer = self.request(node, READ_1017)
        return int.from_bytes(answer[4:6], "little")


@pytest.mark.parametrize("node", [1, 16, 17])
def test_a_parameter_that_a_master_stores_is_kept_in_the_next_run_with_the_same_store(
    node, tmp_path
):
    store = f"bus.store={tmp_path / 'memory'}"
    first = Rig(store)
    assert first.heartbeat_ms(node) == 100
    first.request(node, WRITE_1017 + (250).to_bytes(2, "little"))
    assert first.request(node, STORE_ALL + SAVE)[0] == WRITTEN
    assert Rig(store).heartbeat_ms(node) == 250
    assert Rig().heartbeat_ms(node) == 100
