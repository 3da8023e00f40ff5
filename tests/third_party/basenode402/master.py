"""canopen's BaseNode402 as the master of the rig, and as its WSP unit (node 32).

The master walks the drives to OPERATION ENABLED, turns a roller, reads speeds by PDO and drives the
valves until the train has stopped. It simulates the inertia of the vehicle.

Usage: master.py HOST PORT EDS_FOLDER; the port is the socketcand port of the bench. The last line
of the output is the result as JSON.
"""

import json
import os
import sys
import time
from pathlib import Path

import can
import canopen
from canopen.profiles.p402 import BaseNode402

# node numbers
DRIVES = (1, 2, 3, 4)
SPEED_UNIT = 16
BRAKE_IO = 17
UNIT = 32

CYCLE_S = 0.01
HEARTBEAT_S = 0.05
OPERATIONAL = 5  # NMT state in a heartbeat
CYCLIC_VELOCITY = 9  # mode of operation

# the data sheet of the rig
ROLLER_M = 1.0
WHEEL_M = 0.445
MASS_KG = 43000.0
INERTIA_KGM2 = 1200.0  # of a roller
RATED_NM = 15000.0
# units of one count on the bus
WHEEL_SPEED_RAD_S = 0.01
ROLLER_SPEED_RAD_S = 1e-4
TORQUE_FRACTION = 1e-3

# turning a roller: roller 1 runs faster than the others for some cycles, once the rig moves
SPEED_UP = 1.05
TURN_CYCLES = 60
ROLLING_MRAD = 4000  # angle of a roller that shows that the rig moves
BRAKED_MBAR = 100  # cylinder pressure

# The state setter of canopen gives up after 0.8 s. This master sends each controlword until the
# drive reports the state.
CONTROLWORDS = {"READY TO SWITCH ON": 6, "SWITCHED ON": 7, "OPERATION ENABLED": 15}
STATE_PATIENCE_S = 5.0

# the master finishes when the train has stood for this many cycles
STANDING_CYCLES = 60
LONGEST_RUN_S = 60.0
# without this many readings of a turning wheel the train has not run yet
READINGS_OF_A_RUN = 200


class Master:
    """The network, the last PDOs of every node, and the speed that the train should have.

    `speed_m_s`: of the simulated vehicle. `turning`: cycles in which roller 1 has been turned.
    `result`: what has happened, for the test.
    """

    def __init__(self, host, port, folder):
        self.network = canopen.Network()
        self.network.connect(
            interface="socketcand", host=host, port=int(port), channel="rig0", tcp_tune=True
        )
        self.nodes = {node: self.add(node, folder) for node in (*DRIVES, SPEED_UNIT, BRAKE_IO)}
        self.speed_m_s = 0.0
        self.before_s = time.monotonic()
        self.turning = 0
        self.result = {
            "enabled": [],
            "turned": 0.0,
            "cycles": 0,
            "vents": 0,
            "speeds_read": 0,
            "stopped": False,
        }

    def add(self, number, folder):
        """Add a node of the rig to the network, from its EDS; return the node."""
        eds = str(next(Path(folder).glob(f"node_{number:03d}_*.eds")))
        kind = BaseNode402 if number in DRIVES else canopen.RemoteNode
        node = kind(number, eds)
        self.network.add_node(node)
        return node

    def start(self):
        """Start the heartbeat, the nodes and the reading of PDOs, then enable the drives."""
        self.network.send_periodic(0x700 + UNIT, bytes([OPERATIONAL]), HEARTBEAT_S)
        for number, node in self.nodes.items():
            node.nmt.wait_for_heartbeat(timeout=60.0)
            if number in DRIVES:
                node.setup_402_state_machine()
            else:
                node.tpdo.read()
                node.rpdo.read()
        self.network.nmt.state = "OPERATIONAL"
        for number in DRIVES:
            drive = self.nodes[number]
            drive.sdo["Modes of operation"].raw = CYCLIC_VELOCITY
            drive.rpdo[1]["Modes of operation"].raw = CYCLIC_VELOCITY
            for state in CONTROLWORDS:
                self.bring_to(drive, state)
            self.result["enabled"].append(number)

    def bring_to(self, drive, state):
        """Send the controlword of a state with each SYNC, until the drive reports the state."""
        end_s = time.monotonic() + STATE_PATIENCE_S
        while drive.state != state:
            if time.monotonic() > end_s:
                raise RuntimeError(f"drive {drive.id} is in {drive.state} instead of {state}")
            drive.controlword = CONTROLWORDS[state]
            # canopen does not send a synchronous PDO itself
            drive.rpdo[1].transmit()
            # the rig may move already: a drive that becomes enabled needs the present speed
            self.simulate()
            self.send_targets()
            self.network.sync.transmit()
            time.sleep(CYCLE_S)

    def wheel_speed_m_s(self, axle):
        """Return the speed at the rim of a wheel."""
        return self.nodes[SPEED_UNIT].tpdo[1][axle - 1].raw * WHEEL_SPEED_RAD_S * WHEEL_M

    def roller_speed(self, axle):
        """Return the speed of a roller in counts."""
        return self.nodes[axle].tpdo[2][0].raw

    def roller_torque_Nm(self, axle):
        """Return the torque of the motor of a roller."""
        return self.nodes[axle].tpdo[1][2].raw * TORQUE_FRACTION * RATED_NM

    def rig_moves(self):
        """Return whether the rollers turn. The rig may have waited for its unit."""
        angle_mrad = self.nodes[2].tpdo[2][1].raw
        return angle_mrad > ROLLING_MRAD

    def simulate(self):
        """Advance the speed of the vehicle to now.

        While the train brakes, the torques of the drives act on the vehicle's inertia. Before, the
        vehicle has the speed of its wheels.
        """
        now_s = time.monotonic()
        elapsed_s = now_s - self.before_s
        self.before_s = now_s

        pressures_mbar = [pressure.raw for pressure in self.nodes[BRAKE_IO].tpdo[1]]
        if max(pressures_mbar) < BRAKED_MBAR:
            # The drives follow the targets of the first turn. From then on the wheels would only
            # show these targets, so the speed before the turn remains.
            if not self.turning:
                self.speed_m_s = sum(self.wheel_speed_m_s(axle) for axle in (2, 3, 4)) / 3
            return

        torque_Nm = sum(self.roller_torque_Nm(axle) for axle in DRIVES)
        # the rollers have a part of the vehicle's inertia
        simulated_kg = MASS_KG - 4 * INERTIA_KGM2 / ROLLER_M**2
        deceleration_m_s2 = torque_Nm / ROLLER_M / simulated_kg
        self.speed_m_s = max(0.0, self.speed_m_s - deceleration_m_s2 * elapsed_s)

    def magnets(self):
        """Return the byte of the magnets of a simple slide protection.

        It vents the brake of a wheel that slides much, and holds that of a wheel that slides.
        """
        bits = 0
        if self.speed_m_s <= 1:
            return bits
        for axle in DRIVES:
            sliding_m_s = self.speed_m_s - self.wheel_speed_m_s(axle)
            if sliding_m_s > 0.5 + 0.15 * self.speed_m_s:
                bits |= 0b11 << 2 * (axle - 1)
                self.result["vents"] += 1
            elif sliding_m_s > 0.3 + 0.05 * self.speed_m_s:
                bits |= 0b01 << 2 * (axle - 1)
        return bits

    def send_targets(self, factor=1.0):
        """Send each drive the speed of the train, and drive 1 `factor` times this speed."""
        for number in DRIVES:
            speed_m_s = self.speed_m_s
            if number == 1:
                speed_m_s *= factor
            target = self.nodes[number].rpdo[2]
            target[0].raw = round(speed_m_s / ROLLER_M / ROLLER_SPEED_RAD_S)
            target.transmit()

    def cycle(self):
        """Run one bus cycle: read, simulate, command, SYNC."""
        self.result["cycles"] += 1
        self.simulate()
        brake = self.nodes[BRAKE_IO].rpdo[1]
        brake[0].raw = self.magnets()
        brake.transmit()

        factor = 1.0
        if self.rig_moves() and self.turning < TURN_CYCLES:
            self.turning += 1
            ratio = self.roller_speed(1) / max(self.roller_speed(2), 1)
            self.result["turned"] = max(self.result["turned"], ratio)
            if self.turning < TURN_CYCLES:
                factor = SPEED_UP
        self.send_targets(factor)
        self.network.sync.transmit()
        self.note_standstill()

    def note_standstill(self):
        """Note whether a wheel turns, and whether the train has run and has stopped."""
        a_wheel_turns = any(self.wheel_speed_m_s(axle) for axle in DRIVES)
        a_roller_turns = any(self.roller_speed(axle) for axle in DRIVES)
        if a_wheel_turns:
            self.result["speeds_read"] += 1
        has_run = self.result["speeds_read"] > READINGS_OF_A_RUN
        self.result["stopped"] = has_run and not a_wheel_turns and not a_roller_turns

    def run(self):
        """Run cycles until the train has stood for a while, or the bus has closed."""
        standing = 0
        due_s = time.monotonic()
        end_s = due_s + LONGEST_RUN_S
        while standing < STANDING_CYCLES and time.monotonic() < end_s:
            due_s += CYCLE_S
            time.sleep(max(0.0, due_s - time.monotonic()))
            try:
                self.cycle()
            except (can.CanError, OSError):
                break
            if self.result["stopped"]:
                standing += 1


def main():
    """Drive the rig and print the result as one line of JSON."""
    master = Master(*sys.argv[1:])
    master.start()
    master.run()
    print(json.dumps(master.result), flush=True)
    # python-can's client would wait for the closed bus
    os._exit(0)


main()
