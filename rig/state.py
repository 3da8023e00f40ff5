"""The state of the plant: named views into one float64 buffer, so that a snapshot is one copy.

The number of axles is that of the vehicle. Slots of equipment that a vehicle does not have stay 0.
The comment of each slot gives its unit and the stage that writes it. Every quantity that is
observed, recorded or carried by a bus is a slot here, with the same name as in the table of
signals.

A bench has one rig. A campaign computes several rigs, with the same number of axles, in one buffer:
a slot has the axles of all rigs one after another. A kernel that takes the state of all rigs loops
over all axles, which the compiler turns into vector instructions. `rig_of` gives the state of one
rig, with the same names.
"""

import functools
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import ALLOWED_AXLES, MOST_AXLES
from rollerrig.rig.compiled import state_type
from rollerrig.rig.compiled.state_type import Place, Width, one_after_another
from rollerrig.rig.multibody import coach_state

# states of a dump valve
FILL = 0
HOLD = 1
VENT = 2
CELLS = 256  # of the rail below and ahead of the vehicle (`surface`)
SECTORS = 16  # of a roller's surface
# most axles in one buffer, and most rigs
MOST_LANES = 2 * MOST_AXLES
MOST_RIGS = MOST_LANES // min(ALLOWED_AXLES)
# With fewer axles in a loop the latency of divisions is not hidden, with more the slots leave the
# nearest cache.
_LANES_WANTED = 24


def rigs_together(axles: int) -> int:
    """Return the number of rigs with so many axles that are best computed together."""
    return max(2, _LANES_WANTED // axles)


class State(NamedTuple):
    """Views of one buffer: shape (axles,), unless `_PER_VEHICLE` or `_SURFACES` gives another one.

    Behind the unit of each slot is the function of `plant`, or the module, that writes it.
    """

    # vehicle
    time: np.ndarray  # s, finish
    standing: np.ndarray  # 1: vehicle, wheels and rollers rest; vehicle
    vehicle_speed: np.ndarray  # m/s, integrate
    position: np.ndarray  # m, integrate
    vehicle_acceleration: np.ndarray  # m/s2, integrate
    felt_acceleration: np.ndarray  # m/s2, as the pitch of body and bogies follows it; vehicle
    coupler_force: np.ndarray  # N, of both couplers, positive holds a car back, 0 alone; train
    resistance_work: np.ndarray  # J, integrate
    brake_demand: np.ndarray  # Pa, brake
    brake_target: np.ndarray  # Pa, that the demand approaches in this tick; prepare
    # wheels and rollers
    wheel_speed: np.ndarray  # rad/s, integrate
    wheel_circumferential_speed: np.ndarray  # m/s, observe
    wheel_angle: np.ndarray  # rad, integrate
    tooth_frequency: np.ndarray  # Hz, observe
    pulse_count: np.ndarray  # -, observe
    roller_speed: np.ndarray  # rad/s, integrate
    roller_angle: np.ndarray  # rad, integrate
    # contact
    sliding: np.ndarray  # m/s, observe
    creepage: np.ndarray  # -, observe
    adhesion: np.ndarray  # -, observe
    adhesion_degraded: np.ndarray  # -, observe
    adhesion_recovered: np.ndarray  # -, observe
    transition: np.ndarray  # -, observe
    dissipated_energy: np.ndarray  # J/m, one wheel; observe
    sliding_work: np.ndarray  # J, integrate
    friction_degraded: np.ndarray  # -, friction
    friction_recovered: np.ndarray  # -, friction
    friction_command: (
        np.ndarray
    )  # -, kinematic friction that replaces the plan's, 0: none; the tick
    # memory of extended models, kept only while a model needs it
    sliding_distance: np.ndarray  # m, so far; friction
    braked_angle: np.ndarray  # rad, turned while the brake was applied; friction
    rail_work: np.ndarray  # J/m, work of the wheels before on this metre; friction, train_rail
    has_train_rail: np.ndarray  # 1: the rail of a train writes `rail_work`; train_rail
    lagged_transition: np.ndarray  # -, lambda as a wheel remembers it; integrate
    instantaneous_transition: np.ndarray  # -, lambda without memory, at the last stage; integrate
    # load and brake
    wheel_load: np.ndarray  # N, observe
    # N m, acting (a locked wheel needs less than the brake could give); within a step the most at
    # its end; brake, observe
    brake_torque: np.ndarray
    brake_capacity: np.ndarray  # N m, the most at the beginning of the next step; integrate
    brake_work: np.ndarray  # J, integrate
    brake_work_before: np.ndarray  # J, at the last tick of heat; heat
    disc_temperature: np.ndarray  # K, heat
    cylinder_pressure: np.ndarray  # Pa, brake
    clamp_pressure: np.ndarray  # Pa, by which pads are clamped, kept where they vary; step
    valve: np.ndarray  # FILL, HOLD, VENT after the dead time; brake
    vents: np.ndarray  # -, brake
    reservoir_pressure: np.ndarray  # Pa, 0 where air is unlimited; brake
    reservoir_least: np.ndarray  # Pa, least pressure of the reservoir so far; brake
    air_supplied: np.ndarray  # NL, into the reservoir so far; brake
    # sand and roller film
    sand_command: np.ndarray  # 1: the bus commands the axle's sander to blow; the tick
    sand_rate_fault: np.ndarray  # -, added by a fault to the factor 1 on the rate; the tick
    sand_delay_fault: np.ndarray  # s, added by a fault to the hose's lag; the tick
    sand_box: np.ndarray  # kg, left in the box; surface
    sand_taken: np.ndarray  # kg, that the sander took from its box; surface
    sand_hose: np.ndarray  # kg, in the hose; surface
    sand_rate: np.ndarray  # kg/s, that leaves the hose; surface
    sand_dose: np.ndarray  # kg/m, that the wheels meet; surface
    sand_used: np.ndarray  # kg, that the wheels have crushed; surface
    sand_blown: np.ndarray  # kg, blown aside; surface
    sand_left: np.ndarray  # kg, left behind the vehicle; surface
    rail_sand: np.ndarray  # kg, in each cell of the rail; surface
    rail_cell: np.ndarray  # number of the cell under each axle; surface
    rail_front: np.ndarray  # number of the foremost cell; surface
    # contaminant on rollers, as a share of the prepared film; amounts as shares of a whole roller's
    film: np.ndarray  # -, that the wheel meets; surface
    roller_film: np.ndarray  # -, on each sector of each roller; surface
    film_sector: np.ndarray  # number of the sector that the roller has turned to; surface
    film_sprayed: np.ndarray  # -, amount so far; surface
    film_run_off: np.ndarray  # -, amount so far; surface
    film_worn: np.ndarray  # -, amount taken by the wheel so far; surface
    # locked wheels and flats
    locked_since: np.ndarray  # s, length of the present lock; observe
    longest_lock: np.ndarray  # s, observe
    flat_length: np.ndarray  # m, longest flat on the wheels; wear
    flat_angle: np.ndarray  # rad, angle of the wheel where the middle of its flat is below; wear
    lock_work: np.ndarray  # J, of one wheel in the present lock, kept where wheels wear; wear
    sliding_work_before: np.ndarray  # J, at the last tick of wear, likewise; wear
    # air and motors
    air_filled: np.ndarray  # NL, into the cylinder so far; brake
    air_consumption: np.ndarray  # NL, of all cylinders; brake
    motor_torque_demand: np.ndarray  # N m, written by the rig control
    motor_torque: np.ndarray  # N m, motor
    motor_work: np.ndarray  # J, integrate
    motor_temperature: np.ndarray  # K, heat
    # memory of the rig control and of a step
    observer: np.ndarray  # N m, the rig control's observer
    speed_integral: np.ndarray  # N m, the drives' velocity loops
    motor_before: np.ndarray  # N m, motor torque at the beginning of the step; integrate
    contact_force: np.ndarray  # N, of both wheels, mean of the last step; integrate
    brake_mean: np.ndarray  # N m, mean brake torque of the last step; integrate
    wheel_rate: np.ndarray  # rad/s2, first stage of a step; integrate
    roller_rate: np.ndarray  # rad/s2, first stage of a step; integrate
    # values within a step
    stage_step: np.ndarray  # s, the step; 0 for the axles of a vehicle that stands; plant
    # Pa, that the cylinder follows: mean of the step, with blending of the step before; brake
    stage_demand: np.ndarray
    # values at a stage of a step; integrate
    stage_vehicle_speed: np.ndarray  # m/s
    stage_felt: np.ndarray  # m/s2, felt acceleration
    stage_wheel_speed: np.ndarray  # rad/s
    stage_roller_speed: np.ndarray  # rad/s
    stage_angle: np.ndarray  # rad, of the wheel
    stage_transition: np.ndarray  # -, lambda as the wheel remembers it
    transition_before: np.ndarray  # -, lambda without memory, first stage
    stage_surface: np.ndarray  # m/s, speed of the rail's or roller's surface
    stage_sliding: np.ndarray  # m/s
    stage_load: np.ndarray  # N
    stage_slope: np.ndarray  # N s/m, contact force over sliding
    stage_exponent: np.ndarray  # -, k of [A5] in `adhesion`: tau W_sp for f = 1
    stage_degraded: np.ndarray  # -, degraded friction, then adhesion
    stage_recovered: np.ndarray  # -, recovered friction, then adhesion
    stage_gradient: np.ndarray  # -, gradient of the stress times friction
    stage_per_sliding: np.ndarray  # s/m, 1 / sliding
    stage_force: np.ndarray  # N, of the contact, with the implicit part
    # values of a vehicle between the stages of a step; integrate
    rate_before: np.ndarray  # m/s2, acceleration, first stage
    felt_rate_before: np.ndarray  # m/s3, of the felt acceleration, first stage
    resistance_before: np.ndarray  # N, first stage
    magnets_before: np.ndarray  # N, force of the track brake, first stage
    # the last solution of [A5], with which the next one begins; integrate
    solved_work: np.ndarray  # -, y = tau W_sp
    work_change: np.ndarray  # -, change of y in the last solution
    work_change_before: np.ndarray  # -, change of y in the solution before
    is_solved: np.ndarray  # 1 where the form of `vector_secant` is valid, else 0
    # dynamic brake and traction
    blending_axles: np.ndarray  # that blend with this one; dynamic_brake
    working_motors: np.ndarray  # of these axles; dynamic_brake
    dynamic_torque: np.ndarray  # N m, of the motor on the wheelset, positive brakes; dynamic_brake
    dynamic_torque_demand: np.ndarray  # N m, before slide control; dynamic_brake
    dynamic_before: np.ndarray  # N m, at the beginning of the step; dynamic_brake
    dynamic_braking: np.ndarray  # N, that blending has of the motor at its speed; dynamic_brake
    dynamic_credit: np.ndarray  # N, force that blending counts; dynamic_brake
    dynamic_share: np.ndarray  # -, of the force that slide control permits; dynamic_brake
    dynamic_credit_share: np.ndarray  # -, as blending counts it; dynamic_brake
    dynamic_permitted: np.ndarray  # -, share that the bus permits; the tick
    dynamic_failed: np.ndarray  # 1: the motor gives no torque; the tick
    dynamic_work: np.ndarray  # J, taken from the wheelset so far; integrate
    friction_demand: np.ndarray  # Pa, demanded from the friction brake; dynamic_brake
    traction_command: (
        np.ndarray
    )  # -, share of traction that the bus demands, below 0 none; the tick
    traction_target: np.ndarray  # -, share that bus or programme demand in this tick; dynamic_brake
    traction_demand: np.ndarray  # -, share of the traction force that acts; dynamic_brake
    # magnetic track brake, half of a bogie's for each axle
    track_brake_command: np.ndarray  # 1: the bus commands the magnets of the bogie; the tick
    track_brake_failed: np.ndarray  # 1: the magnets do not drop; the tick
    track_brake_demand: np.ndarray  # 1: the magnets are demanded; track_brake
    track_brake_lowered: np.ndarray  # -, 0 raised to 1 on the rail; track_brake
    track_brake_attraction: np.ndarray  # -, share of the whole attraction; track_brake
    track_brake_pressure: np.ndarray  # N, a N_m (mu_cd / mu_cr)^n of [T3]; track_brake
    track_brake_force: np.ndarray  # N, on the vehicle; track_brake
    track_brake_cleaning: np.ndarray  # J/m, work of magnets on the metre that the axle meets
    track_brake_work: np.ndarray  # J, of all magnets so far; integrate
    # Constants of the axle, from `params.Params`, because each rig may have others
    on_track: np.ndarray  # 1 on a track, 0 on rollers
    radius: np.ndarray  # m
    per_inertia: np.ndarray  # 1/(kg m2), of the wheelset
    roller_radius: np.ndarray  # m
    per_roller_inertia: np.ndarray  # 1/(kg m2); 0 on a track, where no roller turns
    static_load: np.ndarray  # N
    transfer: np.ndarray  # kg, change of the load with the felt acceleration
    torque_per_pressure: np.ndarray  # N m/Pa
    spring_pressure: np.ndarray  # Pa
    air_per_pressure: np.ndarray  # NL/Pa
    fill_share: np.ndarray  # of the way to the demand in a step; 0 with a reservoir
    vent_share: np.ndarray  # likewise, to 0
    motor_most: np.ndarray  # N m, the largest torque of the roller's motor
    motor_power: np.ndarray  # W, the largest
    motor_fastest: np.ndarray  # rad/s, above this speed the motor does not drive
    motor_share: np.ndarray  # of the way to the demand in a step; 0 on a track
    eps1: np.ndarray  # N^(1/3), of `patch.Patch`
    decay_d: np.ndarray  # 1 / A - 1 of the degraded friction
    decay_r: np.ndarray  # 1 / A - 1 of the recovered friction
    # and those of `adhesion.Law`, except the friction of the contaminant
    A_d: np.ndarray
    A_r: np.ndarray
    gamma_d_s_m: np.ndarray
    gamma_r_s_m: np.ndarray
    k_ad: np.ndarray
    k_sd: np.ndarray
    k_ar: np.ndarray
    k_sr: np.ndarray
    tau_m_J: np.ndarray
    cleaning_creepage: np.ndarray
    cleaning_half_speed_m_s: np.ndarray
    cleaning_sliding_m_s: np.ndarray
    # (coach_state.SIZE,) of the multibody model, None for the planar vehicle
    coach: np.ndarray | None = None

    @property
    def axles(self) -> int:
        """The number of axles."""
        return self.wheel_speed.size


_PER_VEHICLE = (
    "time",
    "standing",
    "vehicle_speed",
    "position",
    "vehicle_acceleration",
    "felt_acceleration",
    "coupler_force",
    "has_train_rail",
    "resistance_work",
    "brake_demand",
    "brake_target",
    "air_consumption",
    "reservoir_pressure",
    "reservoir_least",
    "air_supplied",
    "sand_blown",
    "sand_left",
    "rail_front",
    "traction_command",
    "traction_target",
    "traction_demand",
    "track_brake_work",
    "rate_before",
    "felt_rate_before",
    "resistance_before",
    "magnets_before",
)
# slots with more than one value for each axle or vehicle
_SURFACES = {"rail_sand": Width(0, CELLS), "roller_film": Width(SECTORS)}
# the names of all slots
NAMES = State._fields[:-1]


def _places() -> dict[str, Place]:
    """Return where each slot lies in a buffer: those of axles, of vehicles, and of surfaces.

    Surfaces are last: their room is that of the rigs that a buffer has. A coach is behind them.
    """
    of_axles = (name for name in NAMES if name not in _PER_VEHICLE and name not in _SURFACES)
    places = one_after_another(dict.fromkeys(of_axles, Width(1)), MOST_LANES)
    behind = _end(places, MOST_LANES)
    places |= {
        name: Place(behind + i * MOST_RIGS, Width(0, 1), next_rig=Width(0, 1))
        for i, name in enumerate(_PER_VEHICLE)
    }
    behind += len(_PER_VEHICLE) * MOST_RIGS
    surfaces = one_after_another(_SURFACES, MOST_AXLES, behind, next_rig=Width(0, SURFACE))
    coach = Place(behind + SURFACE, Width(0, coach_state.SIZE), next_rig=Width(0, SURFACE))
    return {name: (places | surfaces)[name] for name in NAMES} | {"coach": coach}


def _end(places: Mapping[str, Place], axles: int) -> int:
    """Return the place behind all slots of so many axles."""
    return max(place.of(axles).stop for place in places.values())


# number of values of the surfaces of a rig
SURFACE = sum(width.of(MOST_AXLES) for width in _SURFACES.values())
PLACES = _places()
state_type.register(State, PLACES, counted="wheel_speed")
# number of values of one rig without a coach's
SIZE = PLACES["coach"].begin


def size_of(rigs: int) -> int:
    """Return the number of values of so many rigs."""
    return SIZE + (rigs - 1) * SURFACE


@functools.cache
def slots(axles: int, rig: int = 0) -> Mapping[str, slice]:
    """Return where each slot of a rig lies in the buffer of rigs with so many axles each."""
    return MappingProxyType({name: PLACES[name].of(axles, rig) for name in NAMES})


def views(buffer: np.ndarray, axles: int, rig: int = 0) -> State:
    """Return the state of a rig in the float64 buffer of rigs with so many axles each.

    The buffer has the shape (size_of(rigs),), or (SIZE + coach_state.SIZE,) for one with a coach.
    """
    has_coach = buffer.size == SIZE + coach_state.SIZE
    coach = buffer[SIZE:] if has_coach else None
    places = slots(axles, rig)
    return State(**{name: buffer[place] for name, place in places.items()}, coach=coach)
