"""Makes the sentence of a finding: what was measured, what is allowed, and what to do next."""

from collections.abc import Sequence

from rollerrig.rig.identify.base import shared
from rollerrig.rig.identify.base.findings import Code, Finding


def sentence(finding: Finding) -> str:
    """Return the sentence of a finding, with its code."""
    of_runs = shared.sentence(finding.runs, finding.shared)
    if of_runs:
        return f"{_TEXTS[finding.code](finding)}. {of_runs} [{finding.code}]"
    return f"{_TEXTS[finding.code](finding)} [{finding.code}]"


def _percent(ratio: float) -> str:
    """Return a deviation from 1 in words, such as "1.5 % more"."""
    how = "more" if ratio > 1.0 else "less"
    return f"{100.0 * abs(ratio - 1.0):.2g} % {how}"


def _list(names: Sequence[str]) -> str:
    """Return names as words: "a", "a and b", "a, b and c"."""
    *others, last = [str(name) for name in names]
    return f"{', '.join(others)} and {last}" if others else last


def _of_runs(finding: Finding) -> str:
    """Return the runs that show a finding, with the preposition."""
    if not finding.runs:
        return ""
    return f"in {'run' if len(finding.runs) == 1 else 'runs'} {_list(finding.runs)} "


def _these(finding: Finding) -> str:
    """Return how to refer to the runs of a finding again."""
    return "this run" if len(finding.runs) == 1 else "these runs"


def _radius(finding: Finding) -> str:
    speed = "fast" if finding.measured > 1.0 else "slow"
    if finding.runs:
        return (
            f"{_of_runs(finding)}all wheelsets roll {100.0 * abs(finding.measured - 1.0):.2g} % too "
            f"{speed} for the vehicle's speed while no brake acts ({100.0 * finding.allowed:.2g} % is "
            f"allowed), and in the other runs they do not: {_these(finding)} may be of another vehicle, "
            "have other wheels, or another scale of vehicle_speed_m_s; correct it, or leave "
            f"{_these(finding)} out"
        )
    return (
        f"all wheelsets roll {100.0 * abs(finding.measured - 1.0):.2g} % too {speed} for the "
        f"vehicle's speed while no brake acts ({100.0 * finding.allowed:.2g} % is allowed): "
        "wheel_radius_m is wrong by this share, or the scale of vehicle_speed_m_s is; measure the "
        "radius, or correct the scale of the speed"
    )


def _wheel_speed_scale(finding: Finding) -> str:
    return (
        f"{finding.channels[0]} is {_percent(finding.measured)} than the vehicle's speed gives while "
        f"the wheelset rolls, and the others agree with it ({100.0 * finding.allowed:.2g} % is "
        "allowed, for worn wheels): check the unit of this channel, and the pulses a turn of its "
        "sensor"
    )


def _mass(finding: Finding) -> str:
    return (
        f"{_of_runs(finding)}the loads add up to {_percent(finding.measured)} than mass_kg weighs, and "
        f"the torques stop as much mass as the loads weigh ({100.0 * finding.allowed:.2g} % is "
        "allowed): correct mass_kg in [vehicle], or give the run its mass_kg (payload)"
    )


def _loads(finding: Finding) -> str:
    return (
        f"{_of_runs(finding)}the loads add up to {_percent(finding.measured)} than mass_kg weighs, but "
        f"the torques agree with mass_kg ({100.0 * finding.allowed:.2g} % is allowed): check the "
        "scale of wheel_load, and that it is the load of both wheels of each wheelset"
    )


def _torque_unit(finding: Finding) -> str:
    if finding.runs:
        return (
            f"{_of_runs(finding)}brake_torque accounts for {finding.measured:.3g} of the momentum for "
            f"which it accounts in the other runs, as {finding.detail} taken for N m: convert the "
            f"torque of {_these(finding)} to N m"
        )
    return (
        f"brake_torque accounts for {finding.measured:.3g} of the momentum that the vehicle loses, "
        f"which is the share of {finding.detail}: convert it to N m"
    )


def _torque_share(finding: Finding) -> str:
    what = "is it the commanded torque and not the acting one, or does it hold both wheels twice?"
    if finding.measured < 1.0:
        what = "does another brake act (dynamic, track or eddy-current), or is a gradient missing?"
    return (
        f"brake_torque accounts for {finding.measured:.3g} of the momentum that the vehicle loses in "
        f"all runs (1 is right, {100.0 * finding.allowed:.2g} % more or less is allowed): {what} give "
        "the whole torque that acts on each wheelset, and check mass_kg"
    )


def _torque_not_acting(finding: Finding) -> str:
    if finding.runs:
        return (
            f"{_of_runs(finding)}brake_torque accounts for {finding.measured:.3g} of the momentum for "
            "which it accounts in the other runs (the shares of all runs, "
            f"{finding.detail}, may differ by {100.0 * finding.allowed:.2g} %): does another brake act in "
            f"{_these(finding)}, is the torque there another sensor's or the commanded one, or is it "
            "another vehicle? correct the torque, or leave these runs out"
        )
    return (
        f"brake_torque accounts for {finding.detail} of the momentum that the vehicle loses, depending "
        "on the run (the shares may differ by "
        f"{100.0 * finding.allowed:.2g} %): is it the commanded torque and not the acting one, or "
        "does another brake act in some runs? give the torque that acts, for example from the "
        "cylinder pressure"
    )


def _channels_exchanged(finding: Finding) -> str:
    return (
        "the channels of wheelsets are exchanged: while the wheels slide, wheel_speed answers to the "
        f"brake_torque of another wheelset (wheel_speed {finding.detail}); exchange the columns of "
        "wheel_speed or those of brake_torque, whichever is wired wrongly"
    )


def _channels_equal(finding: Finding) -> str:
    return (
        f"{_list(finding.channels)} have the same values in {100.0 * finding.measured:.0f} % of the "
        "samples: one channel was written twice; give the channel of each wheelset"
    )


def _axles_reversed(finding: Finding) -> str:
    return (
        "braking moves load to the rear half of the wheelsets "
        f"({finding.measured:.2g} of mass times deceleration), so the wheelsets are counted from the "
        "rear: number the columns from the leading wheelset in the direction of travel; if only the "
        "loads are wrong, exchange these"
    )


def _interpolated(finding: Finding) -> str:
    lines = (
        f"{_list(finding.channels)}: {100.0 * finding.measured:.0f} % of the samples are on straight "
        "lines between others"
    )
    if finding.channels == ("vehicle_speed_m_s",):
        return (
            f"{lines}: it is no measurement at this rate, but was filled up from a lower rate, or "
            "computed by a slide protection whose reference falls at a limited rate: give the "
            "measured speed, independent of the wheels, with its sample_time_s"
        )
    return (
        f"{lines}, so a lower sample rate was filled up: give the samples that were measured, with "
        "their sample_time_s (0.1 s at most)"
    )


def _smoothed(finding: Finding) -> str:
    return (
        f"{_list(finding.channels)}: from sample to sample the noise is {finding.measured:.2g} times "
        f"the one that [accuracy] declares ({finding.allowed:.2g} at least): the channel was "
        "smoothed or interpolated, so its samples are not independent, or [accuracy] is wrong: give "
        "raw samples, or only every so many rows that they are independent, or correct [accuracy]"
    )


def _resolution(finding: Finding) -> str:
    return (
        f"{_list(finding.channels)} moves in steps of {finding.measured:.3g} m/s "
        f"({finding.allowed:.2g} m/s at most): it is rounded more coarsely than its noise; give more "
        "digits (whole km/h do not suffice)"
    )


def _clock(finding: Finding) -> str:
    return (
        f"position_m advances {_percent(finding.measured)} than vehicle_speed_m_s times time_s gives "
        f"({100.0 * finding.allowed:.2g} % is allowed): time_s counts too fast or too slowly, or one of "
        "the two has another scale; correct time_s with sample_time_s, or leave position_m out"
    )


def _reference(finding: Finding) -> str:
    return (
        f"vehicle_speed_m_s equals {finding.detail} in {100.0 * finding.measured:.0f} % of the samples, "
        "so it was computed from the wheel speeds and no sliding can be measured with it: give a "
        "speed that is independent of the braked wheels (radar, GNSS, or an unbraked axle)"
    )


def _reference_slow(finding: Finding) -> str:
    axles = "wheelset" if len(finding.axles) == 1 else "wheelsets"
    return (
        f"{axles} {_list([str(axle) for axle in finding.axles])} run up to "
        f"{100.0 * finding.measured:.2g} % ahead of the vehicle while they brake "
        f"({100.0 * finding.allowed:.2g} % is allowed), which no braked wheel does: "
        "vehicle_speed_m_s is too low or too late; was it computed from sliding wheels, or smoothed?"
    )


_TEXTS = {
    Code.RADIUS: _radius,
    Code.WHEEL_SPEED_SCALE: _wheel_speed_scale,
    Code.MASS: _mass,
    Code.LOADS: _loads,
    Code.TORQUE_UNIT: _torque_unit,
    Code.TORQUE_SHARE: _torque_share,
    Code.TORQUE_NOT_ACTING: _torque_not_acting,
    Code.CHANNELS_EXCHANGED: _channels_exchanged,
    Code.CHANNELS_EQUAL: _channels_equal,
    Code.AXLES_REVERSED: _axles_reversed,
    Code.INTERPOLATED: _interpolated,
    Code.SMOOTHED: _smoothed,
    Code.RESOLUTION: _resolution,
    Code.CLOCK: _clock,
    Code.REFERENCE: _reference,
    Code.REFERENCE_SLOW: _reference_slow,
}
