"""The inner loops of the drives, in the compiled tick of a whole rig: torque, velocity, a stop."""

import numpy as np
import pytest

from rollerrig.firmware_sim.drive402 import axis
from rollerrig.realtime.bench import scenario, tick_data
from rollerrig.realtime.loop import mailbox, tick
from rollerrig.realtime.loop import ring as rings
from rollerrig.wsp_interface import signals

SPEED_M_S = 10.0


class Rig:
    """A machine whose brakes are released, and what its drives are asked."""

    def __init__(self, folder, *settings):
        ring = rings.Ring(folder / "rows", np.float64, 1 << 12, len(signals.COLUMNS))
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

    def ask(self, loop, torque_Nm=0.0, velocity_rad_s=0.0, limit_Nm=1e9, enabled=1.0):
        command = self.machine.commands.values.copy()
        drives = command[tick.DRIVES : tick.FAULTS].reshape(4, axis.COMMANDS)
        drives[:] = enabled, loop, torque_Nm, velocity_rad_s, limit_Nm
        mailbox.post(self.machine.commands, command)

    def run(self, seconds):
        tick.run_ticks(self.machine, round(1000 * seconds))
        return {
            name: self.machine.row[signals.span(name)].copy()
            for name in ("roller_speed", "motor_torque", "motor_torque_demand", "vehicle_speed")
        }


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path)


@pytest.mark.conformance("CiA 402", "inner torque loop in the tick, within its limits")
@pytest.mark.parametrize(
    ("asked_Nm", "limit_Nm", "given_Nm"),
    [
        (2000.0, 1e9, 2000.0),
        (-2000.0, 1e9, -2000.0),
        (9000.0, 5000.0, 5000.0),
        (-1e6, 1e9, -30000.0),
    ],
)
def test_a_drive_gives_the_torque_that_it_is_asked_for_within_its_limits(
    rig, asked_Nm, limit_Nm, given_Nm
):
    rig.ask(axis.LOOP_TORQUE, torque_Nm=asked_Nm, limit_Nm=limit_Nm)
    # ten time constants of the motor
    assert rig.run(0.05)["motor_torque"] == pytest.approx(given_Nm, rel=1e-3)


@pytest.mark.conformance("CiA 402", "inner velocity loop in the tick")
def test_a_drive_reaches_the_velocity_that_it_is_asked_for_and_holds_it(rig):
    rig.ask(axis.LOOP_VELOCITY, velocity_rad_s=SPEED_M_S + 2.0)
    # the load is the whole coach, which the rollers drag along through the contact
    assert rig.run(20.0)["roller_speed"] == pytest.approx(SPEED_M_S + 2.0, abs=0.02)
    assert rig.run(1.0)["roller_speed"] == pytest.approx(SPEED_M_S + 2.0, abs=0.02)


def test_a_change_of_hands_makes_no_jump_in_torque(rig):
    before = rig.run(1.0)
    rig.ask(axis.LOOP_VELOCITY, velocity_rad_s=float(before["roller_speed"][0]))
    after = rig.run(0.001)
    assert np.abs(after["motor_torque_demand"] - before["motor_torque_demand"]).max() < 300.0


def test_a_drive_that_is_not_enabled_gives_no_torque(rig):
    rig.ask(axis.LOOP_TORQUE, torque_Nm=5000.0)
    assert rig.run(0.05)["motor_torque"].min() > 4900.0
    rig.ask(axis.LOOP_TORQUE, torque_Nm=5000.0, enabled=0.0)
    assert np.abs(rig.run(0.1)["motor_torque"]).max() < 1.0


def test_in_a_stop_the_vehicle_is_no_faster_than_its_rollers_and_both_come_to_rest(rig):
    rig.ask(axis.LOOP_STOP)
    for _ in range(20):
        now = rig.run(0.1)
        assert now["vehicle_speed"][0] <= max(now["roller_speed"].mean(), 0.0) + 0.05
    assert now["vehicle_speed"][0] == 0.0
    assert not now["roller_speed"].any()
