"""CANopen's predefined connection set: the identifier of each service, to which a node's number is added.

Source: CiA 301, predefined connection set (without node: NMT, SYNC, TIME); CiA 305 for LSS.
"""

NMT, SYNC, TIME = 0x000, 0x080, 0x100  # 000h, 080h, 100h
EMERGENCY, HEARTBEAT = 0x080, 0x700  # 080h, 700h
TPDO = (0x180, 0x280, 0x380, 0x480)  # 180h ...
RPDO = (0x200, 0x300, 0x400, 0x500)  # 200h ...
SDO_REPLY, SDO_REQUEST = 0x580, 0x600  # 580h, 600h
LSS_ANSWER, LSS_REQUEST = 0x7E4, 0x7E5  # 7E4h, 7E5h
NODE_MASK = 0x7F
