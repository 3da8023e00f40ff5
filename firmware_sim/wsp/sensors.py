"""The speed sensors that the WSP trusts: which readings a braked wheel can give, and which not.

A sensor is rejected when its reading is impossible for a wheel that is braked, never driven:

    [S1] a jump: from one cycle to the next the speed falls faster than the brake, or rises faster
         than the best rail, can turn a wheel; a lost signal (0 from above 5 m/s) and noise are
         jumps
    [S2] frozen: the counts do not change for a time in which those of two trusted axles do, or of
         one if there are no more
    [S3] silent: the reading stays 0, or does not change at all, although the valve has vented for
         long
    [S4] disagreement: an axle has vented for long and its speed no longer rises, so it turns with
         the vehicle. No wheel can be faster than that. So an axle that is faster is false, or
         the released axle is. The axles of each speed vote, but a faster one whose counts have not
         changed for a time is false. Where two are faster, the speed that the last anchor and the
         learned deceleration let expect votes too

A rejected sensor is out until its readings have been plausible for a time: none of the above, and
between the slowest trusted axle and the reference speed [S5]. An axle without a sensor does what
the other axle of its bogie does, or an axle of the other bogie if that one has no sensor
either [S6]. If no axle has a sensor, the brakes apply.

Source: physical bounds of a braked wheel; that units substitute the other axle of the bogie is an
assumption, as is every threshold. Limits: a false reading that a braked wheel could give (a slow
drift, a gain) is found only when [S4] compares axles; two or three sensors that drift alike may
outvote the true ones.
"""

import numpy as np

from rollerrig.rig.compiled.kernel import kernel

NOBODY = -1
# votes of the expected speed in [S4]: more than one axle, so that it decides between two and two
EXPECTATION = 1.5


@kernel
def passed(cycles, duration_s, params):
    """Whether a number of cycles has lasted the duration; half a cycle allows for rounding."""
    return (cycles + 0.5) * params.cycle_s >= duration_s


@kernel
def rejected(state, j):
    """Whether the unit does not use the speed sensor of axle j."""
    return state.out[j] != 0.0


@kernel
def judge(state, speeds_raw, rims_m_s, params):
    """Reject sensors with impossible readings, and trust those again that have been plausible.

    Parameters: `speeds_raw`, counts of this cycle, and `rims_m_s`, the same as circumferential
    speeds in m/s. `state.raw` and `state.speed_m_s` are still those of the last cycle.
    """
    trusted = 0
    moving = 0  # trusted axles whose counts change
    for j in range(state.axles):
        if not rejected(state, j):
            trusted += 1
            moving += speeds_raw[j] != state.raw[j]
    compare(state, params)
    for j in range(state.axles):
        changed = speeds_raw[j] != state.raw[j]
        state.still[j] = 0.0 if changed else state.still[j] + 1.0
        if changed or speeds_raw[j] == 0:
            # the speed of a locked wheel is constantly zero, and that is plausible
            state.same[j] = 0.0
        elif moving > 0 and moving >= min(2, trusted - 1):
            state.same[j] += 1.0
        # a wheel that vents must run up
        unchanging = speeds_raw[j] == 0 or passed(state.still[j], params.silent_s, params)
        silent = unchanging and passed(state.free_age[j], params.silent_s, params)
        frozen = passed(state.same[j], params.stuck_s, params)
        disputed = passed(state.disputed[j], params.confirm_s, params)
        impossible = jumps(state.rim_m_s[j], rims_m_s[j], params)
        if state.cycles[0] == 0.0:
            impossible = False
        if rejected(state, j) and not among_trusted_axles(state, j, rims_m_s, params):
            impossible = True  # [S5]
        if impossible or frozen or disputed or (silent and not rejected(state, j)):
            state.out[j] = 1.0
            state.plausible[j] = 0.0
        else:
            state.plausible[j] += 1.0
            if passed(state.plausible[j], params.trust_again_s, params):
                state.out[j] = 0.0
    for j in range(state.axles):
        state.raw[j] = speeds_raw[j]
        state.rim_m_s[j] = rims_m_s[j]


@kernel
def jumps(before_m_s, now_m_s, params):
    """Whether a speed changes within a cycle as no wheel can [S1]."""
    change_m_s = now_m_s - before_m_s
    fall_m_s = params.jump_m_s + params.jump_fall_m_s2 * params.cycle_s
    rise_m_s = params.jump_m_s + params.jump_rise_m_s2 * params.cycle_s
    return change_m_s < -fall_m_s or change_m_s > rise_m_s


@kernel
def far_above(faster_m_s, slower_m_s, params):
    """Whether one wheel is faster than another by more than diameters and noise explain."""
    return faster_m_s > slower_m_s * (1.0 + params.agree_fraction) + params.agree_m_s


@kernel
def among_trusted_axles(state, j, rims_m_s, params):
    """Whether axle j reads a speed between the slowest trusted axle and the reference speed [S5].

    If no axle is trusted, every reading is.
    """
    slowest_m_s = np.inf
    fastest_m_s = state.reference_m_s[0]
    for k in range(state.axles):
        if not rejected(state, k):
            slowest_m_s = min(slowest_m_s, rims_m_s[k])
            fastest_m_s = max(fastest_m_s, rims_m_s[k])
    if slowest_m_s == np.inf:
        return True
    above = far_above(rims_m_s[j], fastest_m_s, params)
    below = far_above(slowest_m_s, rims_m_s[j], params)
    return not above and not below


@kernel
def runs_free(state, j, params):
    """Whether axle j has vented so long, and rises so little, that it turns with the vehicle."""
    if rejected(state, j) or not passed(state.free_age[j], params.free_s, params):
        return False
    if passed(state.still[j], params.stuck_s, params):
        return False  # the vehicle brakes, so its counts would change
    return state.acceleration_m_s2[j] < params.run_up_done_m_s2


@kernel
def compare(state, params):
    """Count the cycles in which released axles and faster axles contradict each other [S4]."""
    for j in range(state.axles):
        state.accused[j] = 0.0
    for j in range(state.axles):
        if runs_free(state, j, params):
            accuse(state, j, params)
    for j in range(state.axles):
        state.disputed[j] = state.disputed[j] + 1.0 if state.accused[j] != 0.0 else 0.0


@kernel
def accuse(state, j, params):
    """Mark the sensors that must be false if axle j, which runs free, is compared with all."""
    expected_m_s = expected_speed_m_s(state, params)
    against = 0.0
    witnesses = 0.0  # axles that run free at the same speed, axle j among them
    nearest_m_s = np.inf  # of the faster axles to the expected speed
    for k in range(state.axles):
        if rejected(state, k):
            continue
        if far_above(state.speed_m_s[k], state.speed_m_s[j], params):
            if passed(state.still[k], params.stuck_s, params):
                state.accused[k] = 1.0
                continue
            against += 1.0
            nearest_m_s = min(nearest_m_s, abs(state.speed_m_s[k] - expected_m_s))
        elif runs_free(state, k, params):
            witnesses += not far_above(state.speed_m_s[j], state.speed_m_s[k], params)
    if against == 0.0:
        return
    if against >= 2.0:
        # a single faster axle may have raised what is expected
        if nearest_m_s < abs(state.speed_m_s[j] - expected_m_s):
            against += EXPECTATION
        else:
            witnesses += EXPECTATION
    if against > witnesses:
        state.accused[j] = 1.0
        return
    for k in range(state.axles):
        if not rejected(state, k) and far_above(state.speed_m_s[k], state.speed_m_s[j], params):
            state.accused[k] = 1.0


@kernel
def expected_speed_m_s(state, params):
    """Return the vehicle speed by the last anchor and the learned deceleration."""
    elapsed_s = state.anchor_age[0] * params.cycle_s
    return state.anchor_m_s[0] - state.deceleration_m_s2[0] * elapsed_s


@kernel
def followed(state, j):
    """Return the trusted axle that axle j follows if its sensor is rejected, or NOBODY [S6]."""
    for step in range(1, 4):
        # the other axle of the bogie, then those of the other bogie of the group
        other = j ^ step
        if other < state.axles and not rejected(state, other):
            return other
    return NOBODY
