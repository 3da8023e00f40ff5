"""An example of a WSP unit in plain Python, with nothing but python-can's socketcand client.

    rollerrig run velim_a1 --wsp external &  python wsp_unit.py [host [port [bus]]]

After each SYNC (080h) node 16 sends four axle speeds (190h, I16, 0.01 rad/s). The answer is one
byte for node 17 (211h): bit 2j is the hold magnet of axle j+1, bit 2j+1 its vent magnet. The unit
sends a heartbeat (720h) before every fifth answer, because in lockstep the time-outs of the rig
count simulated time. While no SYNC arrives, it sends heartbeats by the wall clock; so it also
notices when the rig has exited.
"""

import contextlib
import socket
import struct
import sys
import time

import can

RADIUS_M = 0.445
CYCLE_S = 0.01
SPEED_RAD_S = 0.01  # of one count

# identifiers
SYNC = 0x080
SPEEDS = 0x190
MAGNETS = 0x211
HEARTBEAT = 0x720

# NMT states in a heartbeat
BOOT_UP = 0x00
OPERATIONAL = 0x05

# energised magnets of an axle
FILL = 0b00
HOLD = 0b01
VENT = 0b11

QUIET_S = 0.1


class Protection:
    """A simple slide protection: it looks at sliding and deceleration, once in each SYNC cycle."""

    def __init__(self):
        self.cycles = 0
        self.magnets = 0
        self.reference = 0.0  # estimated speed of the vehicle, m/s
        self.lagged = None  # axle speeds behind a first-order lag of four cycles, m/s

    def cycle(self, speeds):
        """Return the byte of magnets for four axle speeds in m/s."""
        if self.lagged is None:
            self.lagged = list(speeds)
        # the vehicle does not brake harder than 1.6 m/s2
        v_ref = max(*speeds, self.reference - 1.6 * CYCLE_S)
        self.reference = v_ref
        # All wheels may slide at the same time. So from time to time axle 4 runs free and shows
        # the speed of the vehicle.
        self.cycles += 1
        axle_4_free = self.magnets and self.cycles % 300 < 120
        self.magnets = 0
        for j, v in enumerate(speeds):
            rate = (v - self.lagged[j]) / (4 * CYCLE_S)
            self.lagged[j] += rate * CYCLE_S
            sliding = v_ref - v
            slides = sliding > 0.5 + 0.05 * v_ref
            slides_deeply = sliding > 1.0 + 0.15 * v_ref
            valve = FILL
            if axle_4_free and j == 3:
                valve = VENT
            elif slides and rate < 1.0:
                valve = VENT if rate < -1.8 or slides_deeply else HOLD
            if v_ref > 1.0:
                self.magnets |= valve << 2 * j
        return self.magnets


def serve(bus):
    """Answer every SYNC until the rig exits."""

    def send(can_id, byte):
        bus.send(can.Message(arbitration_id=can_id, data=[byte], is_extended_id=False))
        return time.monotonic() + QUIET_S

    protection = Protection()
    syncs = 0
    awaiting_speeds = False
    send(HEARTBEAT, BOOT_UP)
    quiet_until = send(HEARTBEAT, OPERATIONAL)
    while True:
        frame = bus.recv(QUIET_S)
        if frame is not None and frame.arbitration_id == SYNC:
            syncs += 1
            awaiting_speeds = True
            quiet_until = time.monotonic() + QUIET_S
            if syncs % 5 == 0:
                send(HEARTBEAT, OPERATIONAL)
        elif frame is not None and frame.arbitration_id == SPEEDS and awaiting_speeds:
            awaiting_speeds = False
            counts = struct.unpack("<4h", frame.data)
            speeds = [count * SPEED_RAD_S * RADIUS_M for count in counts]
            send(MAGNETS, protection.cycle(speeds))
        elif time.monotonic() > quiet_until:
            quiet_until = send(HEARTBEAT, OPERATIONAL)


def wait_for_rig(host, port, patience_s=300.0):
    """Return when a hub listens; python-can's client would try again without a pause."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        with contextlib.suppress(OSError), socket.create_connection((host, port), 1.0):
            return
        time.sleep(0.2)
    sys.exit(f"no hub listens at {host}:{port}: start 'rollerrig run velim_a1 --wsp external'")


def main(host="127.0.0.1", port="29536", channel="rig0"):
    """Connect to the rig and serve until it exits."""
    wait_for_rig(host, int(port))
    with can.Bus(
        interface="socketcand", host=host, port=int(port), channel=channel, tcp_tune=True
    ) as bus:
        try:
            serve(bus)
        except (OSError, can.CanError, KeyboardInterrupt):
            print("the rig has exited, or Ctrl-C", file=sys.stderr)


if __name__ == "__main__":
    main(*sys.argv[1:])
