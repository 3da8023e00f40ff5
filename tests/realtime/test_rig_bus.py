"""The rig's nodes as a run builds them: what they keep from one run to the next."""

import numpy as np
import pytest

from rollerrig.realtime.bench import rig_bus, scenario
from rollerrig.wsp_interface import events, signals
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.hub import Hub

SAVE = b"save"


class Rig:
    """A rig on a hub that listens nowhere, and an SDO client."""

    def __init__(self, *settings):
        self.hub, self.answers = Hub(lambda: 0), []
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

    def ask(self, node, data):
        self.answers.clear()
        self.port.send(Frame(0x600 + node, data.ljust(8, b"\0")))
        return self.answers[-1]

    def heartbeat_ms(self, node):
        return int.from_bytes(self.ask(node, b"\x40\x17\x10\0")[4:6], "little")


@pytest.mark.parametrize("node", [1, 16, 17])
def test_what_a_master_stores_in_a_node_is_there_in_the_next_run_of_a_rig_with_that_store(
    node, tmp_path
):
    store = f"bus.store={tmp_path / 'memory'}"
    first = Rig(store)
    assert first.heartbeat_ms(node) == 100
    first.ask(node, b"\x2b\x17\x10\0" + (250).to_bytes(2, "little"))
    assert first.ask(node, b"\x23\x10\x10\1" + SAVE)[0] == 0x60
    assert Rig(store).heartbeat_ms(node) == 250
    assert Rig().heartbeat_ms(node) == 100
