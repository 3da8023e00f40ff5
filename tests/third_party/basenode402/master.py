"""canopen's BaseNode402 as the master of the rig, and its WSP unit (node 32).

It walks the drives to OPERATION ENABLED, turns a roller, reads speeds by PDO and drives the valves
until the train stands. Usage: master.py HOST PORT EDS_FOLDER; the bus is the hub's socketcand port.
"""

import json
import os
import sys
import time
from pathlib import Path

import can
import canopen
from canopen.profiles.p402 import BaseNode402

DRIVES, SPEED_UNIT, BRAKE_IO, UNIT = (1, 2, 3, 4), 16, 17, 32
CYCLE_S = 0.01
# the rig's data sheet: rollers, wheels, vehicle
ROLLER_M, WHEEL_M, MASS_KG, INERTIA_KGM2, RATED_NM = 1.0, 0.445, 43000.0, 1200.0, 15000.0
SPEED_UP, TURN_CYCLES, ROLLING_MRAD = 1.05, 60, 4000
# its state setter gives up after 0.8 s; here each step is asked for until it is there
WORDS = {"READY TO SWITCH ON": 6, "SWITCHED ON": 7, "OPERATION ENABLED": 15}


class Master:
    """The network, the last PDOs of every node, and the speed that the train should have."""

    def __init__(self, host, port, folder):
        self.network = canopen.Network()
        self.network.connect(
            interface="socketcand", host=host, port=int(port), channel="rig0", tcp_tune=True
        )
        self.nodes = {node: self.add(node, folder) for node in (*DRIVES, SPEED_UNIT, BRAKE_IO)}
        self.speed_m_s, self.before_s, self.turning = 0.0, time.monotonic(), 0
        self.told = {
            "enabled": [],
            "turned": 0.0,
            "cycles": 0,
            "vents": 0,
            "speeds_read": 0,
            "stopped": False,
        }

    def add(self, number, folder):
        eds = str(next(Path(folder).glob(f"node_{number:03d}_*.eds")))
        kind = BaseNode402 if number in DRIVES else canopen.RemoteNode
        node = kind(number, eds)
        self.network.add_node(node)
        return node

    def start(self):
        """Start heartbeat, nodes and the reading of PDOs, then enable the drives."""
        self.network.send_periodic(0x700 + UNIT, b"\x05", 0.05)
        for number, node in self.nodes.items():
            node.nmt.wait_for_heartbeat(timeout=5.0)
            if number in DRIVES:
                node.setup_402_state_machine()
            else:
                node.tpdo.read()
                node.rpdo.read()
        self.network.nmt.state = "OPERATIONAL"
        for number in DRIVES:
            drive = self.nodes[number]
            drive.sdo["Modes of operation"].raw = 9
            drive.rpdo[1]["Modes of operation"].raw = 9
            for wanted in WORDS:
                self.to(drive, wanted)
            self.told["enabled"].append(number)

    def to(self, drive, wanted):
        """Ask for a state with each SYNC, until the drive tells it."""
        until_s = time.monotonic() + 5.0
        while drive.state != wanted:
            if time.monotonic() > until_s:
                raise RuntimeError(f"drive {drive.id}: {drive.state} where {wanted} is wanted")
            drive.controlword = WORDS[wanted]
            # a synchronous PDO counts as one that is sent by a timer
            drive.rpdo[1].transmit()
            # the rig may roll already: a drive that is enabled shall find its speed
            self.simulate()
            self.aim()
            self.network.sync.transmit()
            time.sleep(CYCLE_S)

    def wheel(self, axle):
        """Speed at the rim of a wheel in m/s."""
        return self.nodes[SPEED_UNIT].tpdo[1][axle - 1].raw * 0.01 * WHEEL_M

    def simulate(self):
        """The vehicle's inertia, from the drives' torques; before braking the wheels tell."""
        now_s = time.monotonic()
        elapsed_s, self.before_s = now_s - self.before_s, now_s
        pressures = [one.raw for one in self.nodes[BRAKE_IO].tpdo[1]]
        if max(pressures) < 100:
            # once the rollers are held they tell what they were told: the speed of before counts
            if not self.turning:
                self.speed_m_s = sum(map(self.wheel, (2, 3, 4))) / 3
            return
        torque_Nm = sum(self.nodes[one].tpdo[1][2].raw for one in DRIVES) * 1e-3 * RATED_NM
        rolling_kg = MASS_KG - 4 * INERTIA_KGM2 / ROLLER_M**2
        self.speed_m_s = max(0.0, self.speed_m_s - torque_Nm / ROLLER_M / rolling_kg * elapsed_s)

    def magnets(self):
        """A simple slide protection: vent a wheel that slides much, hold one that slides."""
        bits = 0
        for axle in DRIVES:
            sliding = self.speed_m_s - self.wheel(axle)
            if self.speed_m_s > 1 and sliding > 0.5 + 0.15 * self.speed_m_s:
                bits |= 3 << 2 * (axle - 1)
                self.told["vents"] += 1
            elif self.speed_m_s > 1 and sliding > 0.3 + 0.05 * self.speed_m_s:
                bits |= 1 << 2 * (axle - 1)
        return bits

    def aim(self, factor=1.0):
        """Send each drive the speed of the train, the first one `factor` times that."""
        for number in DRIVES:
            target = self.nodes[number].rpdo[2]
            target[0].raw = round(
                self.speed_m_s * (factor if number == 1 else 1.0) / ROLLER_M * 1e4
            )
            target.transmit()

    def cycle(self):
        """One bus cycle."""
        self.told["cycles"] += 1
        self.simulate()
        brake = self.nodes[BRAKE_IO].rpdo[1]
        brake[0].raw = self.magnets()
        brake.transmit()
        rolls = self.nodes[2].tpdo[2][1].raw > ROLLING_MRAD
        if rolls and self.turning < TURN_CYCLES:
            self.turning += 1
            second = max(self.nodes[2].tpdo[2][0].raw, 1)
            self.told["turned"] = max(self.told["turned"], self.nodes[1].tpdo[2][0].raw / second)
        self.aim(SPEED_UP if rolls and self.turning < TURN_CYCLES else 1.0)
        self.network.sync.transmit()
        wheels = [self.wheel(axle) for axle in DRIVES]
        self.told["speeds_read"] += any(wheels)
        rollers = [self.nodes[number].tpdo[2][0].raw for number in DRIVES]
        self.told["stopped"] = (
            self.told["speeds_read"] > 200 and not any(wheels) and not any(rollers)
        )

    def run(self):
        """Cycle until the train has stood for a while, or the bus has ended."""
        still, due_s, end_s = 0, time.monotonic(), time.monotonic() + 60.0
        while still < 60 and time.monotonic() < end_s:
            due_s += CYCLE_S
            time.sleep(max(0.0, due_s - time.monotonic()))
            try:
                self.cycle()
            except (can.CanError, OSError):
                break
            still += self.told["stopped"]


def main():
    """Drive the rig and print what happened as one line of JSON."""
    master = Master(*sys.argv[1:])
    master.start()
    master.run()
    print(json.dumps(master.told), flush=True)
    # python-can's client would wait for a bus that has ended
    os._exit(0)


main()
