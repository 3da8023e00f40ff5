"""The reference speed of the WSP: an estimate of the vehicle speed from wheels that may all slide.

The reference follows the fastest axle, but its fall is limited [W1, W5, W8 of `logic`]. While axles
slide, one of the trailing axles runs up unbraked every few seconds. When its speed no longer rises,
the wheel turns with the vehicle and is an anchor: the reference takes its speed, and the unit
learns the deceleration from the loss of speed since the last anchor. Source and limits: see
`logic`.
"""

from rollerrig.firmware_sim.wsp import sensors
from rollerrig.firmware_sim.wsp.phases import Phase
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.wsp_interface import signals

SPEED_SCALE_RAD_S = signals.first_place("measured_speed").scale
NOBODY = -1.0


@kernel
def measure(state, speeds_raw, params):
    """Compute circumferential speeds in m/s and their filtered slopes in m/s2 from the counts.

    An axle whose sensor is rejected has the speed of the axle that it follows.
    """
    rims_m_s = state.measured_m_s
    for j in range(state.axles):
        rims_m_s[j] = abs(speeds_raw[j]) * SPEED_SCALE_RAD_S * 0.5 * params.wheel_diameter_m[j]
        if state.cycles[0] == 0.0:
            state.lagged_m_s[j] = rims_m_s[j]
    sensors.judge(state, speeds_raw, rims_m_s, params)
    for j in range(state.axles):
        v = rims_m_s[j]
        state.speed_m_s[j] = v
        state.acceleration_m_s2[j] = (v - state.lagged_m_s[j]) / params.acceleration_filter_s
        state.lagged_m_s[j] += state.acceleration_m_s2[j] * params.cycle_s  # [W3]
    for j in range(state.axles):
        source = sensors.followed(state, j) if sensors.rejected(state, j) else j
        if source >= 0:
            state.speed_m_s[j] = state.speed_m_s[source]  # [S6]
            state.acceleration_m_s2[j] = state.acceleration_m_s2[source]
        falls = state.acceleration_m_s2[j] < -params.fall_m_s2
        state.falling[j] = state.falling[j] + 1.0 if falls else 0.0


@kernel
def protecting(state, params):
    """Whether any axle is not in FILL, or has slowed down too fast for a while."""
    busy = 0
    for j in range(state.axles):
        busy += int(state.phase[j]) != Phase.FILL
        busy += sensors.passed(state.falling[j], params.confirm_s, params)
    return busy > 0


@kernel
def advance(state, params):
    """Advance the reference speed by a cycle."""
    fastest = 0.0
    for j in range(state.axles):
        if not sensors.rejected(state, j):
            fastest = max(fastest, state.speed_m_s[j])
    if state.cycles[0] == 0.0:
        state.reference_m_s[0] = fastest
        # wheels may slide before they have been calm for long enough to be an anchor
        state.anchor_m_s[0] = fastest
        state.deceleration_m_s2[0] = params.first_deceleration_m_s2
        state.runner[0] = NOBODY
    sliding = protecting(state, params)
    fall = max(params.reference_fall_m_s2, calm_fall_m_s2(state, fastest, params))
    if sliding:
        fall = min(fall, state.deceleration_m_s2[0] + params.deceleration_margin_m_s2)  # [W5]
    before = state.reference_m_s[0]
    v = max(before - fall * params.cycle_s, fastest)
    state.reference_m_s[0] = min(v, before + params.reference_rise_m_s2 * params.cycle_s)  # [W1]
    state.anchor_age[0] += 1.0
    state.calm[0] = 0.0 if sliding else state.calm[0] + 1.0
    # when no axle has slid for a while, the reference itself is an anchor
    if sensors.passed(state.calm[0], params.calm_s, params):
        state.anchor_m_s[0] = state.reference_m_s[0]
        state.anchor_age[0] = 0.0
        state.run_ups[0] = 0.0


@kernel
def calm_fall_m_s2(state, fastest_m_s, params):
    """Return how fast the reference may fall because all axles have slowed down so for a while
    [W8].

    A light vehicle on a dry rail brakes harder than the usual limit. On a slippery rail an axle
    falls as only a sliding wheel does long before this mean deceleration exceeds that limit.
    """
    if not sensors.passed(state.calm[0], params.calm_s, params):
        state.calm_lagged_m_s[0] = fastest_m_s
    slope_m_s2 = (state.calm_lagged_m_s[0] - fastest_m_s) / params.calm_s
    state.calm_lagged_m_s[0] -= slope_m_s2 * params.cycle_s
    return min(slope_m_s2 + params.deceleration_margin_m_s2, params.fall_m_s2)


@kernel
def choose_runner(state, params):
    """Choose the next axle in turn to run up when the last anchor is old; none below cut-off."""
    if state.reference_m_s[0] < params.cut_off_m_s:
        state.runner[0] = NOBODY
        return
    first = state.run_ups[0] == 0.0
    wait_s = params.run_up_first_s if first else params.run_up_interval_s
    if state.runner[0] != NOBODY and sensors.rejected(state, int(state.runner[0])):
        state.runner[0] = NOBODY
    if state.runner[0] == NOBODY and sensors.passed(state.anchor_age[0], wait_s, params):
        state.runner[0] = trailing(state, int(state.run_ups[0]), params)
        state.run_ups[0] += 1.0


@kernel
def trailing(state, turn, params):
    """Return the axle that runs up in this turn, of the trailing axles with a trusted sensor."""
    trusted = 0
    for j in range(state.axles):
        trusted += not sensors.rejected(state, j)
    if trusted == 0:
        return NOBODY
    skip = turn % min(params.run_up_axles, trusted)
    for j in range(state.axles - 1, -1, -1):
        if sensors.rejected(state, j):
            continue
        if skip == 0:
            return float(j)
        skip -= 1
    return NOBODY


@kernel
def finish_run_up(state, params):
    """End the run-up when the speed no longer rises (an anchor), or after a time (no anchor)."""
    j = int(state.runner[0])
    if j < 0 or int(state.phase[j]) != Phase.RUN_UP:
        return
    age = state.phase_age[j]
    long_enough = sensors.passed(age, params.run_up_shortest_s, params)
    rises = state.acceleration_m_s2[j] >= params.run_up_done_m_s2
    if long_enough and not rises:
        anchor(state, state.speed_m_s[j], params)
    elif sensors.passed(age, params.run_up_longest_s, params):
        # the reference itself is the next anchor, and nothing is learned
        state.anchor_m_s[0] = state.reference_m_s[0]
        state.anchor_age[0] = 0.0
    else:
        return
    state.runner[0] = NOBODY


@kernel
def anchor(state, speed_m_s, params):
    """Set the reference to the speed of a wheel that turns with the vehicle; learn the
    deceleration.
    """
    elapsed_s = state.anchor_age[0] * params.cycle_s
    mean = (state.anchor_m_s[0] - speed_m_s) / elapsed_s
    trust = elapsed_s / (elapsed_s + params.learning_s)
    learned = state.deceleration_m_s2[0] + trust * (mean - state.deceleration_m_s2[0])
    state.deceleration_m_s2[0] = min(max(learned, 0.0), params.reference_fall_m_s2)
    state.reference_m_s[0] = speed_m_s
    state.anchor_m_s[0] = speed_m_s
    state.anchor_age[0] = 0.0
