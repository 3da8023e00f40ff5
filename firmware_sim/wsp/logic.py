"""The reference wheel slide protection: four axle speeds in, dump-valve magnets out, once a cycle.

The unit first rejects speed sensors with impossible readings (`sensors`). The reference speed
follows the fastest axle that is left, but its fall is limited [W1]. The sliding of each axle
against it [W2] and its filtered acceleration [W3] drive the phase machine of the valve. The unit
keeps the wheels sliding within a band on purpose, because sliding cleans the rail [W4]. Every few
seconds one axle runs up unbraked to the speed of the vehicle. This speed is an anchor of the
reference, and the unit learns the deceleration from it [W5]. While no axle slides, the fall is
limited by the deceleration of all axles, since a light vehicle on a dry rail brakes harder than the
usual limit [W8]. A pulse of the valve is as long as the wheel needs to come back to the middle of
its band [W6, W7]. An axle without a sensor follows another axle, and its brake is relieved at
intervals while wheels slide, so that it does not lock.

    [W1] v_ref' = min(max(v_ref - b T, max v_j), v_ref + b_rise T)
    [W2] s_j = v_ref - v_j
    [W3] a_j = (v_j - l_j) / T_a,  l_j' = l_j + a_j T
    [W4] s_low = min(S_low, k c_low v_ref), s_high likewise; k falls from 1 to a share where the
         learned deceleration of a braked axle is small, because the rail gives most there at less
         sliding
    [W5] b = max(b_max, b_calm) while no axle slides, else b_learned + margin, at most b_max
    [W6] x_j = -b_learned - a_j + (s_j - (s_low + s_high) / 2) / T_approach: too much brake, in m/s2
    [W7] a vent pulse lasts g_vent x_j, a fill pulse -g_fill x_j, each within its limits
    [W8] b_calm = min((l - max v_j) / T_calm + margin, a_fall), l' = l - T (l - max v_j) / T_calm;
         l = max v_j until no axle has slid for T_calm

The cycle has no clock and takes the integers of the bus, so the unit on the bus and the compiled
loop get the same bits. Source: common practice of such units, from memory; every threshold is
marked so in `configs/wsp/`. Limits: braking only; wheel diameters as configured; a wheel that does
not reach the speed of the vehicle in a run-up is no anchor; a vehicle that can brake harder than
a_fall needs a larger a_fall; two or three sensors that drift alike may be believed.
"""

from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import store, table
from rollerrig.configs.vehicle import AXLES_OF_GROUP
from rollerrig.firmware_sim.wsp import reference_speed as reference
from rollerrig.firmware_sim.wsp import sensors
from rollerrig.firmware_sim.wsp.phases import INTERRUPTS, MAGNETS, NEXT, WISHES, Event, Phase
from rollerrig.rig.compiled import record_type, state_type
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.compiled.state_type import Width
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import BITS_PER_AXLE, PAIR_MASK, VENT_MAGNET, VENTING

REFERENCE_SCALE_M_S = signals.first_place("wsp_reference_speed").scale

_A = "assumption"
_M = "recollection of typical units, to be checked against UIC 541-05"
_T = "tuned on this project's plant"
ROWS = (
    table.Row("wheel_diameter_m", (0.89,) * AXLES_OF_GROUP, 0.3, 1.4, "paper Table 1"),
    table.number("cycle_s", 0.01, 0.001, 0.1, "SYNC period of the default rig"),
    table.number("acceleration_filter_s", 0.04, 0.01, 0.5, _A),
    table.number("reference_fall_m_s2", 1.6, 0.5, 5.0, _M + ": 1.3 to 1.6"),
    table.number("reference_rise_m_s2", 12.0, 0.5, 50.0, _A),
    table.number("first_deceleration_m_s2", 0.7, 0.1, 3.0, _A),
    table.number("deceleration_margin_m_s2", 0.15, 0.0, 1.0, _A),
    table.number("confirm_s", 0.1, 0.0, 5.0, _A),
    table.number("calm_s", 1.0, 0.2, 60.0, _A),
    table.number("run_up_first_s", 1.5, 0.0, 60.0, _A),
    table.number("run_up_interval_s", 5.0, 0.5, 60.0, _A),
    table.integer(
        "run_up_axles", 3, 1, AXLES_OF_GROUP, _A + ": one more than sensors may be false at once"
    ),
    table.number("run_up_shortest_s", 0.35, 0.1, 5.0, _A),
    table.number("run_up_longest_s", 4.0, 0.2, 10.0, _A),
    table.number("run_up_done_m_s2", 0.5, 0.0, 5.0, _A),
    table.number("stuck_s", 1.0, 0.1, 60.0, _A + ": no wheel keeps its speed to a count so long"),
    table.number("jump_m_s", 0.1, 0.0, 10.0, _A + ": noise of a good sensor in one cycle"),
    table.number("jump_fall_m_s2", 50.0, 5.0, 1e4, _A + ": a full brake slows a free wheel by 20"),
    table.number("jump_rise_m_s2", 120.0, 5.0, 1e4, _A + ": dry rail turns a locked wheel by 80"),
    table.number("silent_s", 3.0, 0.5, 60.0, _A + ": a released wheel turns within 2 s on ice"),
    table.number("free_s", 1.2, 0.2, 60.0, _A + ": the cylinder is empty and the wheel has run up"),
    table.number("agree_fraction", 0.06, 0.0, 0.5, _A + ": diameters differ by up to 5 %"),
    table.number("agree_m_s", 0.3, 0.0, 5.0, _A + ": noise of a good sensor"),
    table.number("trust_again_s", 2.0, 0.1, 60.0, _A + ": longer than a sensor is right by chance"),
    table.number("relief_interval_s", 2.0, 0.1, 60.0, _A + ": shorter than a wheel takes to lock"),
    table.number("relief_s", 1.0, 0.0, 60.0, _T + ": a wheel without a sensor does not lock"),
    table.number("learning_s", 0.5, 0.01, 60.0, _A),
    table.number("slide_begin_m_s", 0.5, 0.05, 5.0, _A),
    table.number("slide_begin_fraction", 0.02, 0.0, 0.2, _A),
    table.number("band_low_m_s", 10.0, 0.1, 20.0, _A),
    table.number("band_low_fraction", 0.22, 0.0, 0.9, _T),
    table.number("band_high_m_s", 12.5, 0.2, 20.0, _A),
    table.number("band_high_fraction", 0.33, 0.0, 0.9, _T),
    table.number(
        "narrow_share", 0.35, 0.05, 1.0, _T + ": very low adhesion is largest at 3 to 6 %"
    ),
    table.number("narrow_below_m_s2", 0.4, 0.0, 5.0, _T + ": very low adhesion gives 0.3"),
    table.number("wide_above_m_s2", 0.7, 0.0, 5.0, _T + ": low adhesion gives 0.7 and more"),
    table.number("deep_factor", 1.5, 1.0, 3.0, _T),
    table.number("fast_fall_m_s2", 8.0, 0.5, 50.0, _T),
    table.number("fall_m_s2", 4.0, 0.2, 50.0, _T),
    table.number("rise_m_s2", 0.8, 0.0, 50.0, _A),
    table.number("fast_rise_m_s2", 3.0, 0.1, 50.0, _A),
    table.number("approach_s", 1.0, 0.05, 60.0, _T + ": a slide returns to its band in this time"),
    table.number("fill_gain_s3_m", 0.02, 0.0, 10.0, _T + ": pulse for each m/s2 too little brake"),
    table.number("fill_pulse_shortest_s", 0.01, 0.01, 1.0, _A + ": one cycle"),
    table.number("fill_pulse_s", 0.08, 0.01, 1.0, _A + ": the longest; a quarter of the fill time"),
    table.number("fill_pause_s", 3.0, 0.0, 5.0, _T + ": strokes of the valve"),
    table.number(
        "refill_pause_s", 1.0, 0.0, 5.0, _T + ": the same, for a wheel that does not slide"
    ),
    table.number("vent_gain_s3_m", 0.014, 0.0, 10.0, _T + ": pulse for each m/s2 too much brake"),
    table.number(
        "vent_pulse_s", 0.03, 0.01, 1.0, _A + ": the shortest; above the valve's dead time"
    ),
    table.number("vent_pulse_longest_s", 0.3, 0.01, 2.0, _A + ": it empties most of a cylinder"),
    table.number("vent_pause_s", 0.5, 0.0, 5.0, _T),
    table.number("vent_timer_s", 10.0, 0.5, 60.0, _M),
    table.number("hold_timer_s", 5.0, 0.5, 60.0, _M),
    table.number("lock_out_s", 0.5, 0.1, 60.0, _A),
    table.flag(
        "sand",
        False,
        _A + ": requests sand from node 18 from the first sliding until calm_s after the last",
    ),
    table.number(
        "cut_off_m_s", 0.5, 0.3, 10.0, _A + ": no lock worth a flat below; many cut at 1.4"
    ),
)

FILL_EVENT = int(Event.FILL)  # as the kernels take it

# the parameters as the kernels take them: SI units, unchangeable
Params = NamedTuple("Params", [(row.name, Any) for row in ROWS])  # type: ignore[misc]
record_type.register(Params)


class State(NamedTuple):
    """The memory of the unit: views into one float64 buffer, of shape (1,), or of shape (n,) with
    the axles of its group.

    After each field stands the stage of `cycle` that writes it.
    """

    cycles: np.ndarray  # cycles done so far; `cycle`
    speed_m_s: np.ndarray  # circumferential speed; `measure`
    lagged_m_s: np.ndarray  # the same speed after the filter; `measure`
    acceleration_m_s2: np.ndarray  # filtered; `measure`
    falling: np.ndarray  # cycles since it began to fall as only a sliding wheel does; `measure`
    reference_m_s: np.ndarray  # reference speed; `advance`
    deceleration_m_s2: np.ndarray  # learned from anchor to anchor; `anchor`
    anchor_m_s: np.ndarray  # speed of the last anchor; `anchor`
    anchor_age: np.ndarray  # cycles since the last anchor; `advance`
    calm: np.ndarray  # cycles since an axle slid; `advance`
    calm_lagged_m_s: np.ndarray  # the fastest axle after a filter, while calm; `calm_fall_m_s2`
    runner: np.ndarray  # axle that runs up, -1: none; `choose_runner`, `finish_run_up`
    run_ups: np.ndarray  # run-ups begun since axles slide; `choose_runner`
    sliding_m_s: np.ndarray  # against the reference; `event_of`
    raw: np.ndarray  # counts of the last cycle; `judge`
    measured_m_s: np.ndarray  # circumferential speed by the axle's sensor; `measure`
    rim_m_s: np.ndarray  # the same of the last cycle; `judge`
    same: np.ndarray  # cycles in which only the counts of other axles have changed; `judge`
    still: np.ndarray  # cycles since its counts changed; `judge`
    accused: np.ndarray  # 1: contradicts an axle that runs free; `compare`
    disputed: np.ndarray  # cycles in which it has done so; `compare`
    out: np.ndarray  # 1: its sensor is rejected; `judge`
    relief: np.ndarray  # cycles since an axle without a sensor was last relieved; `follow`
    plausible: np.ndarray  # cycles since its last impossible reading; `judge`
    phase: np.ndarray  # Phase; `act`
    phase_age: np.ndarray  # cycles since the phase (or its pulse) began; `act`
    pulse_s: np.ndarray  # length of the pulse of the phase; `act`
    free_age: np.ndarray  # cycles of venting without a break; `act`
    vent_age: np.ndarray  # cycles of venting since the valve last filled; `act`
    hold_age: np.ndarray  # cycles of holding since the valve last filled; `act`

    @property
    def axles(self) -> int:
        """The number of axles of the group."""
        return self.speed_m_s.size


# fields with one value for the whole unit; the others have one value an axle
PER_UNIT = (
    "cycles",
    "reference_m_s",
    "deceleration_m_s2",
    "anchor_m_s",
    "anchor_age",
    "calm",
    "calm_lagged_m_s",
    "runner",
    "run_ups",
)
# where the fields lie in the buffer of a unit
PLACES = state_type.one_after_another(
    {name: Width(0, 1) if name in PER_UNIT else Width(1) for name in State._fields},
    AXLES_OF_GROUP,
)
state_type.register(State, PLACES, counted="speed_m_s")
# kernel: the state of a unit in its buffer, for the number of axles of its group
state_at = state_type.state_in(PLACES)
# number of values of a unit with the most axles
SIZE = PLACES[State._fields[-1]].of(AXLES_OF_GROUP).stop


class Unit(NamedTuple):
    """The memory and the parameters of a unit, for the compiled loop and for the unit on the
    bus.
    """

    state: State
    params: Any


def new_unit(params: Any, axles: int = AXLES_OF_GROUP) -> Unit:
    """Return a unit for a group of 2 or 4 axles that has just been switched on."""
    return Unit(views(np.zeros(SIZE), axles), params)


def views(buffer: np.ndarray, axles: int = AXLES_OF_GROUP) -> State:
    """Return the state of a unit for so many axles in its float64 buffer, shape (SIZE,)."""
    return State(*(buffer[place.of(axles)] for place in PLACES.values()))


def load(name: str = "reference") -> Params:
    """The parameters of a packaged configuration (under configs/wsp) or of a TOML file.

    Raises ConfigError, which names file and key.
    """
    given, path = store.load("wsp", name)
    return Params(**table.read(ROWS, given, str(path)))


@kernel
def cycle(unit, inputs):
    """Run one cycle of a `Unit` and change its state in place.

    Parameters: `inputs`, int64 of shape (n,) or more: the speeds of the n axles in counts of 0.01
    rad/s, as in TPDO1 of node 16. Further values (pressures) are not used.

    Returns: the byte of the magnets, and the reference speed in counts of 0.01 m/s as an I16.
    """
    state = unit.state
    params = unit.params
    reference.measure(state, inputs, params)
    reference.advance(state, params)
    reference.choose_runner(state, params)
    reference.finish_run_up(state, params)
    state.cycles[0] += 1.0
    magnets = 0
    for j in range(state.axles):
        if not sensors.rejected(state, j):
            event = event_of(state, j, params)
            magnets |= act(state, j, event, params) << (BITS_PER_AXLE * j)
    for j in range(state.axles):
        if sensors.rejected(state, j):
            magnets |= follow(state, j, magnets, params) << (BITS_PER_AXLE * j)
    counts = round(state.reference_m_s[0] / REFERENCE_SCALE_M_S)
    return magnets, min(32767, max(-32768, counts))


@kernel
def follow(state, j, magnets, params):
    """Return the magnets of axle j, whose sensor is rejected: those of the axle that it follows.

    While wheels slide, its brake is relieved at intervals, so that a lock does not last. Without a
    trusted axle the brake applies [S6 of `sensors`]. `magnets` are those of the trusted axles.
    """
    leader = sensors.followed(state, j)
    if leader == sensors.NOBODY:
        state.phase[j] = np.int64(Phase.FILL)
        state.phase_age[j] = 0.0
        state.free_age[j] = 0.0
        state.vent_age[j] = 0.0
        state.hold_age[j] = 0.0
        return 0
    state.sliding_m_s[j] = state.sliding_m_s[leader]
    state.phase[j] = state.phase[leader]
    state.phase_age[j] = state.phase_age[leader]
    state.free_age[j] = state.free_age[leader]
    state.vent_age[j] = state.vent_age[leader]
    state.hold_age[j] = state.hold_age[leader]
    if state.calm[0] > 0.0:
        # no axle slides
        state.relief[j] = 0.0
        return (magnets >> (BITS_PER_AXLE * leader)) & PAIR_MASK
    if sensors.passed(state.relief[j], params.relief_interval_s, params):
        state.relief[j] = 0.0
    relieved = not sensors.passed(state.relief[j], params.relief_s, params)
    state.relief[j] += 1.0
    if relieved:
        state.phase[j] = np.int64(Phase.VENT)
        return VENTING
    return (magnets >> (BITS_PER_AXLE * leader)) & PAIR_MASK


@kernel
def permitted_share(unit, j):
    """Return the share of its force that the unit permits to the motor of axle j: all or none.

    A motor is released as soon as its axle slides, before the valve vents, and while the valve
    holds or vents.
    """
    params = unit.params
    begin = params.slide_begin_m_s + params.slide_begin_fraction * unit.state.reference_m_s[0]
    slides = unit.state.sliding_m_s[j] > begin
    return 0.0 if slides or unit.state.phase[j] != 0.0 else 1.0


@kernel
def stuck(unit):
    """The axles whose speed sensors the unit rejects; bit 0 is the leading axle."""
    bits = 0
    for j in range(unit.state.axles):
        bits |= int(sensors.rejected(unit.state, j)) << j
    return bits


@kernel
def above(value, edges):
    """The class of a value: how many of the edges it is above."""
    count = 0
    for edge in edges:
        count += value > edge
    return count


@kernel
def band_m_s(state, params):
    """Return the edges of the slip band, which narrows with the learned deceleration [W4]."""
    trusted = 0
    for j in range(state.axles):
        trusted += not sensors.rejected(state, j)
    # axles without a sensor hardly brake
    per_axle_m_s2 = state.deceleration_m_s2[0] * state.axles / max(trusted, 1)
    span_m_s2 = params.wide_above_m_s2 - params.narrow_below_m_s2
    rise = min(max((per_axle_m_s2 - params.narrow_below_m_s2) / max(span_m_s2, 1e-3), 0.0), 1.0)
    share = params.narrow_share + (1.0 - params.narrow_share) * rise
    v_ref = state.reference_m_s[0]
    low = min(params.band_low_m_s, share * params.band_low_fraction * v_ref)
    high = min(params.band_high_m_s, share * params.band_high_fraction * v_ref)
    return low, high


@kernel
def event_of(state, j, params):
    """The event of axle j; also writes its sliding. A stronger event replaces a weaker one."""
    v_ref = state.reference_m_s[0]
    state.sliding_m_s[j] = v_ref - state.speed_m_s[j]  # [W2]
    begin = params.slide_begin_m_s + params.slide_begin_fraction * v_ref
    low, high = band_m_s(state, params)
    sliding_class = above(state.sliding_m_s[j], (begin, low, high, high * params.deep_factor))
    acceleration_class = above(
        state.acceleration_m_s2[j],
        (-params.fast_fall_m_s2, -params.fall_m_s2, params.rise_m_s2, params.fast_rise_m_s2),
    )
    event = WISHES[sliding_class, acceleration_class]
    if state.runner[0] == j:
        event = np.int64(Event.RUN_UP)
    vented_too_long = sensors.passed(state.vent_age[j], params.vent_timer_s, params)
    held_too_long = sensors.passed(state.hold_age[j], params.hold_timer_s, params)
    if vented_too_long or held_too_long:
        event = np.int64(Event.TIMER)
    if v_ref < params.cut_off_m_s:
        event = np.int64(Event.CUT_OFF)
    return event


@kernel
def imbalance(state, j, params):
    """Return how much too strong the brake of axle j is for the rail, in m/s2 [W6].

    A brake that is too weak is negative.
    """
    low, high = band_m_s(state, params)
    wanted = 0.5 * (low + high)
    drift = -state.deceleration_m_s2[0] - state.acceleration_m_s2[j]
    return drift + (state.sliding_m_s[j] - wanted) / params.approach_s


@kernel
def pulse_of(state, j, phase, params):
    """Return the length in s of the pulse with which a phase of axle j begins [W7]."""
    excess = imbalance(state, j, params)
    if phase == Phase.STEP_FILL:
        wanted_s = max(-excess * params.fill_gain_s3_m, params.fill_pulse_shortest_s)
        return min(wanted_s, params.fill_pulse_s)
    if phase == Phase.STEP_VENT:
        wanted_s = max(excess * params.vent_gain_s3_m, params.vent_pulse_s)
        return min(wanted_s, params.vent_pulse_longest_s)
    if phase == Phase.LOCKED_OUT:
        return params.lock_out_s
    return 0.0


@kernel
def act(state, j, event, params):
    """Advance the phase of axle j on an event; return its magnets (bit 0 hold, bit 1 vent)."""
    # by phase: FILL, STEP_FILL, HOLD, STEP_VENT, VENT, RUN_UP, LOCKED_OUT
    pause = (0.0, params.fill_pause_s, 0.0, params.vent_pause_s, 0.0, 0.0, 0.0)
    phase = int(state.phase[j])
    pause_s = pause[phase]
    if event == FILL_EVENT:
        # the wheel does not slide any more: adhesion may be back
        pause_s = min(pause_s, params.refill_pause_s)
    over = sensors.passed(state.phase_age[j], state.pulse_s[j] + pause_s, params)
    following = NEXT[phase, event]
    may_change = over or INTERRUPTS[phase, event]
    begins_again = following != phase or state.pulse_s[j] > 0.0
    if may_change and begins_again:
        phase = following
        state.phase_age[j] = 0.0
        state.pulse_s[j] = pulse_of(state, j, phase, params)
    state.phase[j] = phase

    resting = sensors.passed(state.phase_age[j], state.pulse_s[j], params)
    magnets = MAGNETS[phase, int(resting)]
    state.phase_age[j] += 1.0
    filling = magnets == 0
    venting = magnets & VENT_MAGNET
    state.free_age[j] = state.free_age[j] + 1.0 if venting else 0.0
    state.vent_age[j] = 0.0 if filling else state.vent_age[j] + (venting != 0)
    state.hold_age[j] = 0.0 if filling else state.hold_age[j] + (venting == 0)
    return magnets
