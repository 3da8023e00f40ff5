"""Defines the notes of a decision: what a reader should know besides the verdict.

A note holds a code and fields. Its sentence is made in `realtime/reports/cause_sentences`.
"""

from enum import Enum
from typing import NamedTuple

from rollerrig.rig.identify.decide.coherence import Contradicted
from rollerrig.rig.identify.decide.evidence import ScoreTest


class NoteCode(Enum):
    """What a note reports."""

    # the gain of this cause cannot be judged: its moments or angles are unknown in other runs
    GAIN_NOT_JUDGED = "gain.not_judged"
    # stops simulated with these causes do not brake like the recording: they are not reported
    NOT_LIKE_RECORDING = "causes.not_like_recording"
    # this cause makes runs that were not fitted worse: it is not reported
    WORSE_ON_HELD_OUT_RUNS = "causes.worse_on_held_out_runs"
    # these causes leave a large remainder: they are not reported
    LARGE_REMAINDER = "remainder.large"
    # sand that follows no trigger: it is not reported
    NO_TRIGGER = "cause.no_trigger"
    # a patch that is at another place in each run: it is not reported
    OTHER_PLACES = "cause.other_places"
    # a torque that wheels and vehicle feel differently: it is not reported
    OTHER_FORCE = "cause.other_force"
    # the interval of this cause holds nothing: it is not reported
    INTERVAL_HOLDS_NOTHING = "cause.interval_holds_nothing"
    # two causes of the same force leave a remainder: they are not reported
    TWO_FORCES = "causes.two_forces"
    # this cause changes the torque by less than its declared calibration: it is not reported
    IMMATERIAL = "cause.immaterial"
    # a remaining force on the vehicle is smaller than that calibration of the brake
    IMMATERIAL_REMAINDER = "remainder.immaterial"
    # brakes that all vary in the same way, inside their calibration, explain the runs nearly as
    # well as these causes and their remainder: they are not reported
    INSIDE_CALIBRATION = "causes.inside_calibration"
    # nothing is significant in the fitted runs together, and runs differ from the others
    RUNS_DIFFER = "runs.differ"
    # the reported causes leave a small remainder
    SMALL_REMAINDER = "remainder.small"


class Note(NamedTuple):
    """A note with the causes, the remainder or the contradicted cause that it is about."""

    code: NoteCode
    causes: tuple[str, ...] = ()
    remainder: ScoreTest | None = None
    contradicted: Contradicted | None = None
    share: float = 0.0  # of what is immaterial: how much it changes the torque or the force
    tolerance: float = 0.0  # the declared calibration, as a share
    allowed: float = 0.0  # up to which share it is immaterial; 0: the note is on something else
