"""What can be found in a recording: the names of the findings, and a typed record of each.

A finding holds numbers and names only. The report makes its sentence (`realtime.reports.recorder`).
"""

from typing import NamedTuple

# every name that a finding may have, in the order of the report
NAMES = (
    "wrong_unit",
    "clock_step",
    "clock_rate",
    "old_messages",
    "copy",
    "interpolated",
    "sensor_dropout",
    "sensor_stuck",
    "speed_sensor_delay",
    "wheel_radius",
    "wheel_radius_step",
    "speed_scale",
    "speed_offset",
    "slide",
    "driving_slip",
    "slippery_place",
    "unknown",
)


# --- details: what a finding knows beyond its place and size ---

# evidence of a wrong unit
POSITION = "position"
OTHER_CHANNELS = "other_channels"

# reasons of a drop-out
NO_SAMPLES = "no_samples"
NO_VALUES = "no_values"
ZEROS = "zeros"


class WrongUnit(NamedTuple):
    """`wrong_unit`: the numbers are in one unit, dataset.toml declares another."""

    true_unit: str
    declared_unit: str
    evidence: str  # POSITION or OTHER_CHANNELS


class ClockStep(NamedTuple):
    """`clock_step`: the stamps jump while the motion goes on."""

    whole_seconds: int  # size where it is a whole number within its error, else 0
    returns: bool  # the stamps jump back at the end


class ClockRate(NamedTuple):
    """`clock_rate`: the stamps of one channel run at another rate than those of the others."""

    channel: str


class DropOut(NamedTuple):
    """`sensor_dropout`: reasons in their order, without repetition."""

    reasons: tuple[str, ...]  # NO_SAMPLES, NO_VALUES, ZEROS


class StuckValue(NamedTuple):
    """`sensor_stuck`: the value that the channel holds."""

    speed_m_s: float


class CopySource(NamedTuple):
    """`copy`: where the copied samples come from."""

    run: str
    start_s: float


class CopyOfChannel(NamedTuple):
    """`copy`: a channel repeats another channel in every sample."""

    channel: str


class Delay(NamedTuple):
    """`speed_sensor_delay`: the other side of the comparison. A positive size means late."""

    of_reference: bool  # the delayed channel is the reference
    against: str  # name of a single channel; "" for the median of several speeds


class WheelRadius(NamedTuple):
    """`wheel_radius` and `wheel_radius_step`: which wheels, and for how long."""

    vehicle_id: str
    until: str | None  # last date with this radius, None if the radius never steps
    ambiguous: bool  # two speeds without a reference: either of them may be wrong
    # offset of the speed that these data cannot distinguish from the radius; None if they can
    rival: "RivalOffset | None" = None


class RivalOffset(NamedTuple):
    """An offset of a speed that looks like a wheel radius.

    `radius_percent` is the difference of the radius that is left beside it.
    """

    offset_m_s: float
    radius_percent: float
    speeds_m_s: tuple[float, float]  # lowest and highest speed of the recording


class SpeedLine(NamedTuple):
    """`speed_scale` and `speed_offset`: a speed reads (1 + scale) times the true speed + offset.

    Scale and offset come from one fit, each with its 95 % interval.
    """

    scale_percent: tuple[float, float, float]  # value, low, high
    offset_m_s: tuple[float, float, float]
    of_reference: bool  # the reference differs from all wheels


class Sliding(NamedTuple):
    """`slide`: one episode, with its cycles: each time that a wheel slides and recovers."""

    duration_s: float
    initial_speed_m_s: float
    adhesion_at_least: float  # lower bound of the mean adhesion used; NaN if unknown
    cycles: tuple["Cycle", ...] = ()


class Cycle(NamedTuple):
    """One cycle of a slide or of a driving slip."""

    channel: str
    start_s: float
    end_s: float
    depth_m_s: float  # largest difference to the vehicle


class Slipping(NamedTuple):
    """`driving_slip`: one episode of wheels that are faster than the vehicle."""

    duration_s: float
    most_share: float  # of the vehicle speed
    cycles: tuple[Cycle, ...]


class SharedPlace(NamedTuple):
    """`slippery_place`: the runs that slide there."""

    runs: tuple[str, ...]
    most_runs: int  # largest number of runs that slide at one position
    chance: float  # probability that independent slides meet as often


class SpeedOffset(NamedTuple):
    """`unknown`: a speed differs from the vehicle's."""

    faster: bool


class ReferenceOff(NamedTuple):
    """`unknown`: the reference differs from all wheels, which agree with each other."""

    wheels: int
    faster: bool  # the reference


class SpeedDrop(NamedTuple):
    """`unknown`: a speed drops in braking for less than a slide lasts."""

    duration_s: float


class SpeedFactor(NamedTuple):
    """`unknown`: a speed differs by a factor from the others while the vehicle brakes."""

    factor: float
    rival: str = ""  # of two speeds the other one, which may as well be wrong


class OffsetOrDelay(NamedTuple):
    """`unknown`: an offset of a speed, or a delay while the vehicle brakes at one rate."""

    offset_m_s: float
    delay_s: float  # positive: late
    rival: str = ""  # of two speeds the other one, which may as well be wrong


class ScaleOrOffset(NamedTuple):
    """`unknown`: the reference differs from all wheels by a factor or by an offset."""

    scale_percent: float
    offset_m_s: float
    speeds_m_s: tuple[float, float]  # lowest and highest speed of the recording


class SpeedScatter(NamedTuple):
    """`unknown`: a speed scatters from sample to sample."""

    times_usual: float


Details = (
    WrongUnit
    | ClockStep
    | ClockRate
    | DropOut
    | StuckValue
    | CopySource
    | CopyOfChannel
    | Delay
    | WheelRadius
    | SpeedLine
    | Sliding
    | Slipping
    | SharedPlace
    | SpeedOffset
    | ReferenceOff
    | SpeedDrop
    | SpeedFactor
    | OffsetOrDelay
    | ScaleOrOffset
    | SpeedScatter
)


class Finding(NamedTuple):
    """A finding: where, when and on which channels, and its `size` with the 95 % interval.

    Times are stamps of the run, in s. A finding without a run holds for all runs, and has no times.
    """

    name: str  # one of NAMES
    channels: tuple[str, ...]
    size: float
    low: float
    high: float
    unit: str  # of size, low and high
    details: Details | None = None  # None for old_messages and interpolated
    run: str = ""
    start_s: float = 0.0
    end_s: float = 0.0
    date: str = ""
    place_m: tuple[float, float] | None = None  # first and last position
