"""The inner loops of the drives, in the compiled tick of a whole rig: torque, velocity, a stop."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH, MOST_AXLES
from rollerrig.firmware_sim.drive402 import axis
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import mailbox, tick
from rollerrig.realtime.loop import ring as rings
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
SPEED_M_S = 10.0
ROLLER_RADIUS_M = 1.0


class Rig:
    """A whole rig with tiny brakes, and the commands of its drives."""

    def __init__(self, folder, *settings):
        ring = rings.Ring(folder / "rows", np.float64, 1 << 12, len(TABLE.columns))
        plan = scenario.load(
            "dry_stop",
            settings=(
                f"initial_speed_m_s={SPEED_M_S}",
                "duration_max_s=60",
                "brake.cylinder_area_m2=0.0001",
                *settings,
            ),
        )
        self.machine = tick_data.build(plan, ring)

    def command(self, loop, torque_Nm=0.0, velocity_rad_s=0.0, limit_Nm=1e9, enabled=1.0):
        """Give all drives the same command."""
        commands = self.machine.commands.values.copy()
        drives = commands[tick.DRIVES : tick.FAULTS].reshape(MOST_AXLES, axis.COMMANDS)
        drives[:, axis.ENABLED] = enabled
        drives[:, axis.LOOP] = loop
        drives[:, axis.TORQUE_Nm] = torque_Nm
        drives[:, axis.VELOCITY_rad_s] = velocity_rad_s
        drives[:, axis.TORQUE_LIMIT_Nm] = limit_Nm
        mailbox.post(self.machine.commands, commands)

    def run(self, seconds):
        """Let time pass; return the signals at its end by name, each with its axles."""
        tick.run_ticks(self.machine, round(1000 * seconds))
        return {
            name: self.machine.row[TABLE.span(name)].copy()
            for name in ("roller_speed", "motor_torque", "motor_torque_demand", "vehicle_speed")
        }


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path)


@pytest.mark.conformance("CiA 402", "inner torque loop in the tick, within its limits")
@pytest.mark.parametrize(
    ("commanded_Nm", "limit_Nm", "expected_Nm"),
    [
        (2000.0, 1e9, 2000.0),
        (-2000.0, 1e9, -2000.0),
        (9000.0, 5000.0, 5000.0),
        (-1e6, 1e9, -30000.0),  # the largest torque of the motor
    ],
)
def test_a_drive_gives_the_commanded_torque_within_its_limits(
    rig, commanded_Nm, limit_Nm, expected_Nm
):
    rig.command(axis.LOOP_TORQUE, torque_Nm=commanded_Nm, limit_Nm=limit_Nm)
    # ten time constants of the motor
    assert rig.run(0.05)["motor_torque"] == pytest.approx(expected_Nm, rel=1e-3)


@pytest.mark.conformance("CiA 402", "inner velocity loop in the tick")
def test_a_drive_reaches_the_commanded_velocity_and_holds_it(rig):
    velocity_rad_s = SPEED_M_S / ROLLER_RADIUS_M + 2.0
    rig.command(axis.LOOP_VELOCITY, velocity_rad_s=velocity_rad_s)
    # the load is the whole coach, which the rollers accelerate through the contact
    assert rig.run(20.0)["roller_speed"] == pytest.approx(velocity_rad_s, abs=0.02)
    assert rig.run(1.0)["roller_speed"] == pytest.approx(velocity_rad_s, abs=0.02)


def test_a_change_of_the_control_loop_causes_no_jump_in_torque(rig):
    before = rig.run(1.0)
    rig.command(axis.LOOP_VELOCITY, velocity_rad_s=float(before["roller_speed"][0]))
    after = rig.run(0.001)
    jump_Nm = after["motor_torque_demand"] - before["motor_torque_demand"]
    assert np.abs(jump_Nm).max() < 300.0


def test_a_drive_that_is_not_enabled_gives_no_torque(rig):
    rig.command(axis.LOOP_TORQUE, torque_Nm=5000.0)
    assert rig.run(0.05)["motor_torque"].min() > 4900.0
    rig.command(axis.LOOP_TORQUE, torque_Nm=5000.0, enabled=0.0)
    assert np.abs(rig.run(0.1)["motor_torque"]).max() < 1.0


def test_in_a_stop_the_vehicle_is_no_faster_than_its_rollers_and_both_come_to_rest(rig):
    rig.command(axis.LOOP_STOP)
    for _ in range(20):
        now = rig.run(0.1)
        rim_m_s = ROLLER_RADIUS_M * now["roller_speed"].mean()
        assert now["vehicle_speed"][0] <= max(rim_m_s, 0.0) + 0.05
    assert now["vehicle_speed"][0] == 0.0
    assert not now["roller_speed"].any()
