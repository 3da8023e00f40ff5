"""A plausible stop for tests of the recording and the drawing.

Four axles brake with a bang-bang WSP, on adhesion that recovers with the dissipated energy. This is
not the physics of the rig: it is simple enough to understand at a glance.
"""

from dataclasses import dataclass, field

import numpy as np

from rollerrig.configs.vehicle import COACH
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import Code, make

TABLE = signals.table(COACH)
AXLES = COACH.axles
RADIUS_M = 0.445
ROLLER_M = 1.0  # radius of a roller
INERTIA_KGM2 = 160.0  # of a wheelset
LOAD_N = 105e3  # of a wheelset
MASS_KG = 43e3
RESISTANCE_N = 1200
STEP_S = 0.002

# the brake: pressure to torque, the demand from its begin on, and the time constants of a cylinder
TORQUE_NM_PA = 0.019
DEMAND_PA = 3.8e5
DEMAND_FROM_S = 1.0
FILL_S = 0.5
VENT_S = 0.2
AIR_PER_PA = 4e-5  # air that a rise of the pressure uses

# states of a dump valve
FILL = 0
HOLD = 1
VENT = 2

# the WSP: a cycle of ten steps, and the fastest plausible deceleration of the vehicle
CYCLE_STEPS = 10
CYCLE_S = 0.02
REFERENCE_M_S2 = 1.4

# the axle to lock brakes too hard between these times
GRIP_FROM_S = 6.0
GRIP_TO_S = 8.0

STOPPED_RAD_S = 1e-3  # a wheelset below this speed is locked if the vehicle moves
MOVING_M_S = 3.0
RECOVERY_PER_J = 1.9e-4  # rate at which adhesion recovers with the dissipated energy
TEETH = 100
TWO_PI = 6.2832


def _axles(value=0.0):
    return np.full(AXLES, value)


@dataclass
class _Stop:
    """All quantities of the stop at one time; arrays have one value an axle."""

    speed_m_s: float
    friction: np.ndarray  # degraded coefficient of friction
    reference_m_s: float  # reference speed of the WSP
    omega_rad_s: np.ndarray
    time_s: float = 0.0
    position_m: float = 0.0
    demand_Pa: float = 0.0
    angle_rad: np.ndarray = field(default_factory=_axles)
    roller_angle_rad: np.ndarray = field(default_factory=_axles)
    sliding_m_s: np.ndarray = field(default_factory=_axles)
    degraded: np.ndarray = field(default_factory=_axles)
    recovered: np.ndarray = field(default_factory=_axles)
    adhesion: np.ndarray = field(default_factory=_axles)
    energy_J: np.ndarray = field(default_factory=_axles)
    torque_Nm: np.ndarray = field(default_factory=_axles)
    pressure_Pa: np.ndarray = field(default_factory=_axles)
    valve: np.ndarray = field(default_factory=_axles)
    vents: np.ndarray = field(default_factory=_axles)
    work_J: np.ndarray = field(default_factory=_axles)
    lock_s: np.ndarray = field(default_factory=_axles)
    longest_lock_s: np.ndarray = field(default_factory=_axles)
    air: float = 0.0

    def gripping(self, lock_axle):
        """Whether the brake of `lock_axle` grips too hard now."""
        return lock_axle is not None and GRIP_FROM_S < self.time_s < GRIP_TO_S

    def update_contacts(self):
        """Set sliding, adhesion and dissipated energy."""
        speed = max(self.speed_m_s, 0.5)
        self.sliding_m_s = np.maximum(self.speed_m_s - RADIUS_M * self.omega_rad_s, 0.0)
        self.degraded = _polach(self.sliding_m_s, speed, self.friction, 0.2, 12.0)
        self.recovered = _polach(self.sliding_m_s, speed, 0.28, 0.6, 40.0)

        # adhesion depends on the energy, and the energy on adhesion: a few iterations are enough
        adhesion = self.degraded.copy()
        for _ in range(6):
            rest = np.exp(-RECOVERY_PER_J * adhesion * LOAD_N / 2 * self.sliding_m_s / speed)
            adhesion = self.recovered - (self.recovered - self.degraded) * rest
        self.adhesion = adhesion
        self.energy_J = adhesion * LOAD_N / 2 * self.sliding_m_s / speed

    def update_brakes(self, lock_axle):
        """Set the torques of the brakes."""
        turning = np.where(self.omega_rad_s > STOPPED_RAD_S, 1.0, 0.0)
        self.torque_Nm = turning * self.pressure_Pa * TORQUE_NM_PA
        if self.gripping(lock_axle):
            self.torque_Nm[lock_axle - 1] *= 2.0

    def wsp_cycle(self, lock_axle):
        """Set the valves from the slip of each axle: hold at little slip, vent at more."""
        wheel_m_s = RADIUS_M * self.omega_rad_s
        fastest_m_s = float(np.max(wheel_m_s))
        self.reference_m_s = max(fastest_m_s, self.reference_m_s - REFERENCE_M_S2 * CYCLE_S)

        slip_m_s = self.reference_m_s - wheel_m_s
        valve = np.where(slip_m_s > 0.06 * self.reference_m_s + 0.2, HOLD, FILL)
        valve = np.where(slip_m_s > 0.16 * self.reference_m_s + 0.5, VENT, valve)
        if self.gripping(lock_axle):
            valve[lock_axle - 1] = FILL

        self.vents += (valve == VENT) & (self.valve != VENT)
        self.valve = valve.astype(float)

    def move(self):
        """Advance cylinders, wheelsets and vehicle by one step."""
        filled_Pa = np.where(self.valve == FILL, self.demand_Pa, self.pressure_Pa)
        target_Pa = np.where(self.valve == VENT, 0.0, filled_Pa)
        time_constant_s = np.where(self.valve == VENT, VENT_S, FILL_S)
        rise_Pa = (target_Pa - self.pressure_Pa) * STEP_S / time_constant_s
        self.air += float(np.sum(np.maximum(rise_Pa, 0))) * AIR_PER_PA
        self.pressure_Pa = self.pressure_Pa + rise_Pa

        driving_Nm = RADIUS_M * self.adhesion * LOAD_N
        omega = self.omega_rad_s + (driving_Nm - self.torque_Nm) / INERTIA_KGM2 * STEP_S
        omega = np.maximum(omega, 0.0)
        self.omega_rad_s = np.minimum(omega, self.speed_m_s / RADIUS_M)

        locked = (self.omega_rad_s < STOPPED_RAD_S) & (self.speed_m_s > MOVING_M_S)
        self.lock_s = np.where(locked, self.lock_s + STEP_S, 0.0)
        self.longest_lock_s = np.maximum(self.longest_lock_s, self.lock_s)
        self.work_J += self.adhesion * LOAD_N * self.sliding_m_s * STEP_S

        braking_N = np.sum(self.adhesion) * LOAD_N + RESISTANCE_N
        self.speed_m_s = max(self.speed_m_s - braking_N / MASS_KG * STEP_S, 0.0)
        self.position_m = self.position_m + self.speed_m_s * STEP_S
        self.angle_rad = self.angle_rad + self.omega_rad_s * STEP_S
        self.roller_angle_rad = self.roller_angle_rad + self.speed_m_s / ROLLER_M * STEP_S

    def row(self):
        """The row of all signals; signals that this stop does not have are NaN."""
        motor_Nm = self.adhesion * LOAD_N * ROLLER_M
        magnets_of_valve = np.array([0, 1, 3])
        values = {
            "time": self.time_s,
            "vehicle_speed": self.speed_m_s,
            "position": self.position_m,
            "vehicle_acceleration": -np.sum(self.adhesion) * LOAD_N / MASS_KG,
            "brake_demand": self.demand_Pa,
            "wheel_speed": self.omega_rad_s,
            "wheel_circumferential_speed": RADIUS_M * self.omega_rad_s,
            "wheel_angle": self.angle_rad,
            "tooth_frequency": self.omega_rad_s * TEETH / TWO_PI,
            "pulse_count": np.floor(self.angle_rad * TEETH / TWO_PI),
            "roller_speed": _axles(self.speed_m_s / ROLLER_M),
            "roller_angle": self.roller_angle_rad,
            "sliding": self.sliding_m_s,
            "creepage": self.sliding_m_s / max(self.speed_m_s, 0.5),
            "adhesion": self.adhesion,
            "adhesion_degraded": self.degraded,
            "adhesion_recovered": self.recovered,
            "transition": 1 - np.exp(-RECOVERY_PER_J * self.energy_J),
            "dissipated_energy": self.energy_J,
            "sliding_work": self.work_J,
            "friction_degraded": self.friction,
            "wheel_load": _axles(LOAD_N),
            "brake_torque": self.torque_Nm,
            "cylinder_pressure": self.pressure_Pa,
            "valve": self.valve,
            "vents": self.vents,
            "longest_lock": self.longest_lock_s,
            "air_consumption": self.air,
            "motor_torque_demand": motor_Nm,
            "motor_torque": 0.98 * self.adhesion * LOAD_N * ROLLER_M,
            "wsp_reference_speed": self.reference_m_s,
            "magnets": magnets_of_valve[self.valve.astype(int)],
            "tick_lateness": 20 + 60 * abs(np.sin(self.time_s * 7)),
            "tick_duration": 25.0,
            "ticks_missed": 0,
        }
        row = np.full(signals.WIDTH, np.nan)
        for name, value in values.items():
            row[TABLE.span(name)] = value
        return row


def _polach(sliding_m_s, speed_m_s, friction, gamma, stiffness):
    """Adhesion that saturates at a coefficient of friction which falls with sliding."""
    limit = friction + (friction / 0.4 - friction) * np.exp(-gamma * sliding_m_s)
    return limit * 2 / np.pi * np.arctan(stiffness * sliding_m_s / speed_m_s / limit)


def stop(speed_m_s=42.3, record_hz=100, mu_cd=0.05, lock_axle=None, end_s=90.0):
    """Rows of all signals, shape (n, signals.WIDTH), from the brake demand to standstill.

    The brake of `lock_axle` grips twice as hard for two seconds, and its valve fills.
    """
    now = _Stop(
        speed_m_s=speed_m_s,
        friction=mu_cd * np.array([0.9, 1.0, 1.15, 1.3]),
        reference_m_s=speed_m_s,
        omega_rad_s=_axles(speed_m_s / RADIUS_M),
    )
    steps_per_row = round(1 / record_hz / STEP_S)
    rows = []
    for step in range(int(end_s / STEP_S)):
        now.time_s = step * STEP_S
        now.demand_Pa = DEMAND_PA if now.time_s >= DEMAND_FROM_S else 0.0
        now.update_contacts()
        now.update_brakes(lock_axle)
        if step % CYCLE_STEPS == 0:
            now.wsp_cycle(lock_axle)
        if step % steps_per_row == 0:
            rows.append(now.row())
        if now.speed_m_s <= 0.0 and now.time_s > 2:
            break
        now.move()
    return np.array(rows)


EVENTS = [
    make(0.0, Code.OPERATOR_NOTE, note="run velim_a1 begins"),
    make(1.0, Code.TEST_BRAKE, pressure_Pa=3.8e5),
    make(2.4, Code.UNIT_STATE, node=32, state="OPERATIONAL"),
    make(12.6, Code.WHEEL_FLAT, axle=1, length_m=0.01),
    make(13.1, Code.HEARTBEAT_LOST, node=17, partner=32, silent_s=0.2),
]
