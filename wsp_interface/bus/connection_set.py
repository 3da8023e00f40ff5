"""CANopen's predefined connection set: the identifier of each service.

Services of one node add the node's number to the identifier here. NMT, SYNC and TIME have none.

Source: CiA 301, predefined connection set; CiA 305 for LSS.
"""

from rollerrig.wsp_interface.bus.frames import Frame

NMT = 0x000  # 000h
SYNC = 0x080  # 080h
TIME = 0x100  # 100h

EMERGENCY = 0x080  # 080h + node
TPDO = (0x180, 0x280, 0x380, 0x480)  # 180h + node ...
RPDO = (0x200, 0x300, 0x400, 0x500)  # 200h + node ...
SDO_REPLY = 0x580  # 580h + node
SDO_REQUEST = 0x600  # 600h + node
HEARTBEAT = 0x700  # 700h + node

LSS_ANSWER = 0x7E4  # 7E4h
LSS_REQUEST = 0x7E5  # 7E5h

NODE_MASK = 0x7F  # the bits of an identifier that hold the node's number


def is_service(frame: Frame) -> bool:
    """Return whether a frame is NMT, SDO, heartbeat or LSS; those of other programs count too."""
    return frame.extended or not SYNC <= frame.can_id < SDO_REPLY
