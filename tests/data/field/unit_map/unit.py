"""A unit with its own CAN messages: four speeds in 0.01 km/h, unsigned, and its valves."""

import struct
import sys

import can

SPEEDS = 2566844929 & 0x1FFFFFFF
VALVES = 2566844930 & 0x1FFFFFFF
REFERENCE_FALLS_KM_H = 0.06  # with each message
HOLD = 1
VENT_AND_HOLD = 3

reference_km_h = 0.0
with can.Bus(sys.argv[1], interface="rollerrig") as bus:
    try:
        for message in bus:
            if message.arbitration_id != SPEEDS or not message.is_extended_id:
                continue
            speeds_km_h = [0.01 * count for count in struct.unpack("<4H", message.data)]
            reference_km_h = max(*speeds_km_h, reference_km_h - REFERENCE_FALLS_KM_H)
            magnets = 0
            for axle, speed_km_h in enumerate(speeds_km_h):
                if reference_km_h > 5 and speed_km_h < 0.95 * reference_km_h:
                    pair = VENT_AND_HOLD if speed_km_h < 0.9 * reference_km_h else HOLD
                    magnets |= pair << 2 * axle
            bus.send(can.Message(arbitration_id=VALVES, data=[magnets], is_extended_id=True))
    except can.CanError:
        pass  # the run has ended
