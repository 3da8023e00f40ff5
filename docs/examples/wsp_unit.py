"""A WSP unit of one's own in plain Python: python-can's stock socketcand client, nothing else.

    rollerrig run velim_a1 --wsp external &  python wsp_unit.py [host [port [bus]]]

After each SYNC (080h) node 16 sends four axle speeds (190h, I16, 0.01 rad/s); the answer is one
byte for node 17 (211h): bit 2j holds, bit 2j+1 vents axle j+1. Every fifth SYNC brings a heartbeat
(720h) before the answer, because in lockstep pacing time-outs count simulated time; the wall clock
counts only while no SYNC comes, and then a send also notices that the rig has gone.
"""

import contextlib
import socket
import struct
import sys
import time

import can

RADIUS_M, CYCLE_S = 0.445, 0.01
SYNC, SPEEDS, MAGNETS, HEARTBEAT = 0x080, 0x190, 0x211, 0x720
FILL, HOLD, VENT = 0b00, 0b01, 0b11
QUIET_S = 0.1


class Protection:
    """A simple slip and deceleration protection, one `cycle` a SYNC."""

    def __init__(self):
        self.cycles = self.magnets = 0
        self.reference = 0.0
        self.lagged = None

    def cycle(self, speeds):
        """One byte of magnets for four axle speeds in m/s."""
        self.lagged = self.lagged or list(speeds)
        self.reference = v_ref = max(*speeds, self.reference - 1.6 * CYCLE_S)
        # all wheels may slide at once: now and then axle 4 runs free and shows the vehicle's speed
        self.cycles += 1
        free = self.magnets and self.cycles % 300 < 120
        self.magnets = 0
        for j, v in enumerate(speeds):
            rate = (v - self.lagged[j]) / (4 * CYCLE_S)
            self.lagged[j] += rate * CYCLE_S
            valve, sliding = FILL, v_ref - v
            if free and j == 3:
                valve = VENT
            elif sliding > 0.5 + 0.05 * v_ref and rate < 1.0:
                valve = VENT if rate < -1.8 or sliding > 1.0 + 0.15 * v_ref else HOLD
            if v_ref > 1.0:
                self.magnets |= valve << 2 * j
        return self.magnets


def serve(bus):
    """Answer every SYNC until the rig has gone."""

    def send(can_id, byte):
        bus.send(can.Message(arbitration_id=can_id, data=[byte], is_extended_id=False))
        return time.monotonic() + QUIET_S

    protection = Protection()
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
            send(MAGNETS, protection.cycle([n * 0.01 * RADIUS_M for n in raw]))
        elif time.monotonic() > quiet_until:
            quiet_until = send(HEARTBEAT, 0x05)


def wait_for_rig(host, port, patience_s=300.0):
    """Return when somebody listens; the stock client would ask without a pause."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection((host, port), 1.0):
            return
        time.sleep(0.2)
    sys.exit(f"nobody listens at {host}:{port}: start 'rollerrig run velim_a1 --wsp external'")


def main(host="127.0.0.1", port="29536", channel="rig0"):
    """Connect, serve, leave."""
    wait_for_rig(host, int(port))
    with can.Bus(
        interface="socketcand", host=host, port=int(port), channel=channel, tcp_tune=True
    ) as bus:
        try:
            serve(bus)
        except (OSError, can.CanError, KeyboardInterrupt):
            print("the rig has gone, or Ctrl-C", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
