"""The bench as a device, node 127: what a test harness on the bus can read and command.

A harness joins by writing 1 to HARNESS:JOINED. From then on a bench in lockstep also waits for its
RPDO1 (any byte) after each SYNC before simulated time continues. The harness injects faults and
adds notes as plain text, sets the friction under axles, and ends the run. It maps the quantities
from 2100h on into TPDOs as it needs them. There is no other way from a harness into the rig.
Source: CiA 301 for the services; the objects 2000h to 21FFh are specific to this rig.
"""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from rollerrig.configs.errors import RollerrigError
from rollerrig.firmware_sim import process_image
from rollerrig.firmware_sim.cia301.communication import EVENT_DRIVEN, Pdo, Profile
from rollerrig.firmware_sim.cia301.dictionary import Row, array
from rollerrig.firmware_sim.cia301.nmt import Command, State
from rollerrig.firmware_sim.cia301.node import Node
from rollerrig.firmware_sim.cia301.objects import Abort, AbortError
from rollerrig.wsp_interface import rig_objects as rig
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.signals import BENCH_NODE, Table

DEVICE_TYPE = 0  # no profile of CiA covers a test bench
PRODUCT = process_image.Product("bench", 0x127)


def further_tpdos(groups: int) -> int:
    """Return the number of TPDOs beyond four, for so many groups of axles.

    Four cannot carry what a harness judges a stop by, and each further group needs five.
    """
    return 4 + 5 * (groups - 1)


def titles(table: Table) -> dict[int, str]:
    """Return the names of the objects that carry signals, by index: the names of the signals."""
    found = {}
    for signal in table.signals:
        for place in signal.places:
            if place.node == BENCH_NODE:
                found[place.index] = signal.name.replace("_", " ").capitalize()
    found[0x2105] = "Dump valve"
    return found


def rows(table: Table, pacing: str) -> list[Row]:
    """Return the objects beyond CiA 301."""
    return [
        *process_image.rows(process_image.carried(table, BENCH_NODE, {}), titles(table)),
        *array(
            rig.HARNESS,
            "Harness",
            "U8",
            "rw",
            [0, 0, 0],
            ("Joined", "Cycle", "End of the run"),
            mappable=True,
            high=255,
            text="1 joins or ends; cycle: any value, by RPDO1",
        ),
        Row(
            rig.PACING,
            0,
            "Pacing",
            "U8",
            "ro",
            rig.PACINGS.index(pacing),
            text="0 wall, 1 lockstep",
        ),
        *array(
            rig.FAULT,
            "Fault",
            "TEXT",
            "rw",
            ["", ""],
            ("Inject", "Lift"),
            text="as in: speed_sensor_stuck axle=2 for=3",
        ),
        *array(
            rig.FRICTION,
            "Friction under the axle",
            "U16",
            "rw",
            [0] * table.kind.axles,
            [f"Axle {axle}" for axle in table.axles],
            mappable=True,
            high=10_000,
            factor=rig.FRICTION_SCALE,
            text="0: default of the scenario",
        ),
        Row(
            rig.NOTE, 0, "Operator note", "TEXT", "rw", "", text="is added to the events of the run"
        ),
        Row(
            rig.FAILURE,
            0,
            "Failure of the test",
            "TEXT",
            "rw",
            "",
            text="ends the run, which is not valid, with this reason",
        ),
        Row(
            rig.REFUSAL,
            0,
            "Reason of the last refusal",
            "TEXT",
            "ro",
            "",
            text="why the bench has refused a command with an SDO abort",
        ),
        Row(
            rig.CONFIGURATION,
            0,
            "Configuration of the run",
            "TEXT",
            "ro",
            "",
            text="JSON: resolved scenario, its hash, pacing, seed, unit; empty: not known",
        ),
    ]


def build(
    table: Table,
    row: np.ndarray,
    friction: np.ndarray,
    on_command: Callable[[], None],
    pacing: str = "wall",
) -> Node:
    """Build the node.

    `table`: the signals of the vehicle. `row`: live float64 array of all signals. `friction`:
    float64 array of shape (axles,) or more, which the node writes before it calls `on_command()`:
    the kinematic friction commanded under each axle, 0 for none.
    """
    profile = Profile(
        DEVICE_TYPE,
        PRODUCT.name,
        rpdos=(Pdo(EVENT_DRIVEN, ((rig.HARNESS, rig.CYCLE, 8),)),),
        heartbeat_ms=0,
        further_tpdos=further_tpdos(table.kind.groups),
    )
    carried = process_image.carried(table, BENCH_NODE, {})
    node = process_image.build(BENCH_NODE, profile, PRODUCT, rows(table, pacing), row, carried)
    node.device = BenchNode(table, node, friction, on_command)
    return node


class BenchNode:
    """The commands of a harness.

    joined: whether a harness takes part in the run.
    refusal: why the last command was refused.
    configuration: returns what the bench plays, as JSON; "" if that is not known.
    """

    def __init__(
        self, table: Table, node: Node, friction: np.ndarray, on_command: Callable[[], None]
    ) -> None:
        self.node = node
        self.joined = False
        self.refusal = ""
        self.configuration: Callable[[], str] = lambda: ""
        self._friction = friction
        self._on_command = on_command
        self._actions: Mapping[str, Callable[..., Any]] = {}
        attach = node.objects.attach
        attach(rig.HARNESS, rig.JOINED, effect=self._join)
        attach(rig.HARNESS, rig.END, effect=self._end)
        attach(rig.FAULT, rig.INJECT, effect=partial(self._act, "inject"))
        attach(rig.FAULT, rig.LIFT, effect=partial(self._act, "lift"))
        attach(rig.REFUSAL, read=lambda: self.refusal)
        attach(rig.CONFIGURATION, read=lambda: self.configuration())
        attach(rig.NOTE, effect=lambda text: node.on_event(Code.OPERATOR_NOTE, note=text))
        attach(rig.FAILURE, effect=partial(self._act, "fail"))
        for axle in table.axles:
            attach(rig.FRICTION, axle, effect=partial(self._set_friction, axle))
        node.on_reset.append(lambda: self._join(0))
        node.on_poll.append(lambda _: self._start())

    def wire(self, **actions: Callable[..., Any]) -> None:
        """Set the calls of commands: end(), fail(reason), inject(text), lift(text).

        And of a harness that comes and goes: joined(), left().
        """
        self._actions = actions

    def _start(self) -> None:
        # the node starts itself, as CiA 302-2 allows (1F80h): a bench waits for no master
        if self.node.state is State.PRE_OPERATIONAL:
            self.node.on_frame(Frame(0, bytes([Command.START, BENCH_NODE])))

    def _join(self, value: int) -> None:
        joined = bool(value)
        if joined and "joined" in self._actions:
            # also if one has joined already: the harness may have a new connection
            self._actions["joined"]()
        if joined == self.joined:
            return
        self.joined = joined
        self.node.on_event(Code.HARNESS_JOINED if joined else Code.HARNESS_LEFT)
        if not joined and "left" in self._actions:
            self._actions["left"]()

    def _end(self, value: int) -> None:
        if value:
            self._act("end")

    def _act(self, name: str, *arguments: str) -> None:
        """Carry out a command. Raises AbortError if the bench has no such command or refuses it."""
        if name not in self._actions:
            raise AbortError(Abort.DEVICE_STATE)
        try:
            self._actions[name](*arguments)
        except RollerrigError as error:
            self.refusal = str(error).encode("ascii", "replace").decode()
            self.node.on_event(Code.HARNESS_REFUSED, reason=str(error))
            raise AbortError(Abort.INVALID_VALUE) from None

    def _set_friction(self, axle: int, raw: int) -> None:
        self._friction[axle - 1] = raw * rig.FRICTION_SCALE
        self._on_command()
