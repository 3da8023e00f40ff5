"""A WSP unit of one's own in plain Python: python-can's stock socketcand client, nothing else.

    rollerrig run velim_a1 --wsp external &  python wsp_unit.py [host [port [bus]]]

After each SYNC (080h) node 16 sends four axle speeds (190h, I16, 0.01 rad/s); the answer is one
byte for node 17 (211h): bit 2j holds, bit 2j+1 vents axle j+1. Every fifth SYNC brings a heartbeat
(720h) before the answer, because in lockstep pacing time-outs count simulated time; the wall clock
counts only while no SYNC comes, and then a send also notices that the rig has gone.
"""

import struct
import sys
import time

import can

RADIUS_M, CYCLE_S = 0.445, 0.01
SYNC, SPEEDS, MAGNETS, HEARTBEAT = 0x080, 0x190, 0x211, 0x720
FILL, HOLD, VENT = 0b00, 0b01, 0b11
QUIET_S = 0.1


def protect(speeds, memory):
    """One byte of magnets for four axle speeds in m/s."""
    memory["reference"] = v_ref = max(*speeds, memory["reference"] - 1.4 * CYCLE_S)
    # all wheels may slide at once: axle 4 then runs free now and then and shows the vehicle's speed
    memory["cycles"] = memory["cycles"] + 1 if memory["byte"] else 0
    pilot = 3 if memory["cycles"] % 400 > 280 else None
    byte = 0
    for j, v in enumerate(speeds):
        lag = memory["lagged"][j] if memory["lagged"] else v
        rate = (v - lag) / (4 * CYCLE_S)
        memory["next"][j] = lag + rate * CYCLE_S
        valve, sliding = FILL, v_ref - v
        if j == pilot and v_ref > 2.0:
            valve = VENT
        elif v_ref > 2.0 and sliding > 0.5 + 0.05 * v_ref and rate < 1.0:
            valve = VENT if rate < -1.8 or sliding > 0.15 * v_ref + 1.0 else HOLD
        byte |= valve << 2 * j
    memory["lagged"], memory["byte"] = list(memory["next"]), byte
    return byte


def serve(bus):
    """Answer every SYNC until the rig has gone."""
    def send(can_id, byte):
        bus.send(can.Message(arbitration_id=can_id, data=[byte], is_extended_id=False))
        return time.monotonic() + QUIET_S

    memory = {"reference": 0.0, "lagged": None, "next": [0.0] * 4, "cycles": 0, "byte": 0}
    syncs, awaiting = 0, False
    send(HEARTBEAT, 0x00)  # boot-up
    quiet_until = send(HEARTBEAT, 0x05)  # operational
    while True:
        frame = bus.recv(QUIET_S)
        if frame is not None and frame.arbitration_id == SYNC:
            syncs, awaiting, quiet_until = syncs + 1, True, time.monotonic() + QUIET_S
            if syncs % 5 == 0:
                send(HEARTBEAT, 0x05)
        elif frame is not None and frame.arbitration_id == SPEEDS and awaiting:
            awaiting = False
            raw = struct.unpack("<4h", frame.data)
            send(MAGNETS, protect([n * 0.01 * RADIUS_M for n in raw], memory))
        elif time.monotonic() > quiet_until:
            quiet_until = send(HEARTBEAT, 0x05)


def main(host="127.0.0.1", port="29536", channel="rig0"):
    """Connect, serve, leave."""
    with can.Bus(interface="socketcand", host=host, port=int(port), channel=channel,
                 tcp_tune=True) as bus:
        try:
            serve(bus)
        except (OSError, can.CanError, KeyboardInterrupt):
            print("the rig has gone, or Ctrl-C", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
