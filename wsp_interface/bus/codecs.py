"""The protocols in which outside programs join the bus, one row of `CODECS` each.

A session parses the bytes of one client. An encoder turns a frame of the bus into bytes, once for
all clients of its protocol. Neither uses a socket or the hub, so a further protocol needs one file
and one row here.
"""

from collections.abc import Callable
from typing import NamedTuple

from rollerrig.wsp_interface.bus import cannelloni, slcan, socketcand, virtualcan
from rollerrig.wsp_interface.bus.frames import Frame
from rollerrig.wsp_interface.bus.session import Session


class Codec(NamedTuple):
    """One protocol.

    The two waits exist for clients that compare a whole `recv` with one answer: every answer of
    the handshake must arrive alone.
    """

    port: int  # the usual TCP port
    session: Callable[..., Session]  # makes the session of a client, from the names of the bus
    encode: Callable[[Frame], bytes]
    answer_gap_s: float = 0.0  # between two answers of the handshake
    hold_s: float = 0.0  # between the last answer and the first frame
    handshake: bool = True  # a client sends something before it gets frames


CODECS: dict[str, Codec] = {
    "socketcand": Codec(
        29536,
        socketcand.SocketcandSession,
        socketcand.encode_event,
        answer_gap_s=0.02,
        hold_s=0.05,
    ),
    "slcan": Codec(29537, slcan.SlcanSession, slcan.encode_event),
    "virtualcan": Codec(
        18881,
        virtualcan.VirtualcanSession,
        virtualcan.encode_event,
        handshake=False,
    ),
    "cannelloni": Codec(20000, cannelloni.CannelloniSession, cannelloni.encode_event),
}
