"""The form of the frames that the rig takes from a unit and from a harness.

A frame with 29 bits has another identifier than the frame with 11 bits and the same number, and a
remote frame has no data. The rig takes neither for a command, an answer or a heartbeat, nor a frame
with a wrong number of data bytes. Remote frames that request a heartbeat or a TPDO are allowed
(CiA 301, node guarding and PDO protocols).
"""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

from rollerrig.wsp_interface.bus.frames import DATA_MAX, Frame
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.rig_objects import HARNESS_ANSWER_ID, unit_frames
from rollerrig.wsp_interface.signals import Table

_EMERGENCY_BYTES = 8


class Form(NamedTuple):
    """The allowed numbers of data bytes of a frame with a base identifier.

    may_be_requested: another node may send a remote frame with this identifier.
    """

    least: int
    most: int = DATA_MAX
    may_be_requested: bool = False


class Refusal(NamedTuple):
    """Why the rig refuses a frame: the code of an event, and its fields."""

    code: Code
    fields: dict[str, int]


@functools.cache
def forms(table: Table) -> Mapping[int, Form]:
    """Return the forms of what units and harness send, by identifier.

    A vehicle need not have motors or sanders, so their commands are not here.
    """
    found = {HARNESS_ANSWER_ID: Form(least=1)}
    for group in range(table.kind.groups):
        frames = unit_frames(table, group)
        speed_bytes = frames.reference_speed.struct.size
        found[frames.magnets_id] = Form(least=1)
        found[frames.reference_speed.can_id] = Form(speed_bytes, may_be_requested=True)
        found[frames.heartbeat_id] = Form(1, 1, may_be_requested=True)
        found[frames.emergency_id] = Form(_EMERGENCY_BYTES, _EMERGENCY_BYTES)
    return found


def refusal(frame: Frame, table: Table, hears: Callable[[Frame], bool]) -> Refusal | None:
    """Return why the rig refuses a frame of another program.

    Returns None for a frame that the rig takes, and for a frame that is not for the rig.
    `hears(frame)`: whether a node of the rig listens to this identifier in this form.
    """
    form = forms(table).get(frame.can_id)
    has_base_form = not (frame.extended or frame.remote)
    if has_base_form:
        if form is None or form.least <= len(frame.data) <= form.most:
            return None
        fields = {
            "can_id": frame.can_id,
            "length": len(frame.data),
            "least": form.least,
            "most": form.most,
        }
        return Refusal(Code.FRAME_LENGTH, fields)

    base = frame._replace(extended=False, remote=False)
    is_for_the_rig = form is not None or hears(base)
    if not is_for_the_rig or hears(frame):
        return None
    if frame.extended:
        return Refusal(Code.FRAME_EXTENDED, {"can_id": frame.can_id})
    if form is not None and form.may_be_requested:
        return None
    return Refusal(Code.FRAME_REMOTE, {"can_id": frame.can_id})
