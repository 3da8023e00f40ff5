"""What a run shows of the wiring and the reference speed of a WSP unit, as events and as measures.

`Diagnosis` looks at the true motion once a bus cycle. It reports each finding once a run:

    `wsp.vents_without_sliding`   a dump valve begins to vent, and its axle has not slid by
                                  `SLIDES_M_S` within the last `MEMORY_S`
    `wsp.vents_on`                a dump valve has vented for `OPEN_S` without a break while its
                                  axle slides by less than `SLIDES_M_S`, however the vent began
    `wsp.axles_swapped`           a dump valve vents although its axle does not slide, while another
                                  axle slides by more than `SLIDES_FAR_M_S` and more than
                                  `SLIDES_FAR_SHARE` of the speed, which no protection allows, and
                                  its valve fills; together for `SWAPPED_S`, and clearly with one
                                  other axle
    `wsp.reference_drifts`        the reference speed of the unit is off by more than `DRIFT_M_S`
                                  and by more than `DRIFT_SHARE` of the speed, for `DRIFT_S`

While a known fault explains them, these findings are neither reported nor counted; in place of the
last one comes `wsp.reference_drifts_in_fault`, which names the fault. A fault explains an axle
until `RECOVERY_S` after it is lifted, and as long after that as the axle slides.

The drift is found from the reference speed that the unit sends (TPDO 1A0h, or a mapped signal). It
is not observable from the magnets alone: a valve that vents too late may have a wrong threshold as
well as a wrong reference.

`start_anew` and `end` are for what is not the doing of the unit: a pause of the bench, an emergency
stop, another program that sets the valves, stops a node or moves the drives.

Source of the thresholds: assumption. The reference unit stays below each of them by a factor of 1.5
or more in all stops of the paper (`tests/realtime/test_diagnosis.py`). Limits: below `SLOWEST_M_S`
nothing is judged, because units cut off there. While motors may drive nothing is judged either:
wheels that slip in traction turn faster than the vehicle, so their speed is no reference, and a
valve that vents releases no brake.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import Kind
from rollerrig.wsp_interface.events import Code, OnEvent

FILLS = 0.5  # a valve below this value fills
VENTS = 1.5  # a valve above this value vents
SLOWEST_M_S = 2.0
SLIDES_M_S = 0.4
MEMORY_S = 0.5
OPEN_S = 0.5  # the reference unit ends a vent within 0.3 s after its axle has run up
SLIDES_FAR_M_S = 1.0
SLIDES_FAR_SHARE = 0.35  # a unit may let wheels slide by a fifth of the speed on purpose
SWAPPED_S = 1.0
CLEARLY = 1.5  # so many times longer than beside any third axle
DRIFT_M_S = 3.0
DRIFT_SHARE = 0.1
DRIFT_S = 1.0
RECOVERY_S = 2.0  # a unit trusts a sensor again only some time after it is whole
_NEVER_S = -1e9


class Sample(NamedTuple):
    """One bus cycle: lists have one value an axle.

    sliding_m_s: true sliding; negative where a motor drives the axle.
    valves: 0 fill, 1 hold, 2 vent.
    reference_m_s: the reference speed that the unit sends; NaN if it sends none.
    brake_demand_Pa: the demanded brake pressure; NaN if nothing demands one.
    faults: the known fault that explains a strange behaviour of the unit there, or ""; empty if no
        fault is known.
    """

    time_s: float
    speed_m_s: float
    sliding_m_s: list[float]
    valves: list[float]
    reference_m_s: float
    brake_demand_Pa: float
    faults: Sequence[str] = ()


class Diagnosis:
    """Looks at one sample of a kind of vehicle after another, in the order of their times.

    vents_without_sliding: how often a valve began to vent although its axle had not slid.
    open_without_sliding_s: the longest time for which a valve vented without a break while its
        axle did not slide.
    beside_s: shape (axles, axles): for how long the valve of the first axle vented although this
        axle did not slide, while the second axle slid far and its valve filled.
    drift_s: the longest time for which the reference speed was off; NaN if the unit sends none.
    """

    def __init__(self, kind: Kind, on_event: OnEvent) -> None:
        self._kind = kind
        self._on_event = on_event
        self.vents_without_sliding = 0
        self.open_without_sliding_s = 0.0
        self.beside_s = np.zeros((kind.axles, kind.axles))
        self.drift_s = float("nan")
        self._before: Sample | None = None
        self._slid_at_s = [_NEVER_S] * kind.axles
        self._open_since_s = [math.inf] * kind.axles  # inf: it does not vent, or the axle slides
        self._reported_open = [False] * kind.axles
        self._explained_by = [""] * kind.axles
        self._fault_at_s = [_NEVER_S] * kind.axles
        self._reported_vents = [False] * kind.axles
        self._reported_swaps: set[frozenset[int]] = set()
        self._drifts_since_s: float | None = None
        self._reported_drifts: set[Code] = set()
        self._ended = False

    @property
    def wrong_axle_s(self) -> float:
        """The longest time for which one valve vented in place of that of another axle."""
        return float(self.beside_s.max())

    def start_anew(self) -> None:
        """Forget what lasts at present: the samples have a gap, in which the unit went on."""
        if self._before is not None:
            self._slid_at_s = [self._before.time_s] * self._kind.axles
        self._before = None
        self._forget_durations()

    def end(self) -> None:
        """Look at no further sample: from here on the run does not show what the unit does."""
        self._ended = True

    def _forget_durations(self) -> None:
        self._open_since_s = [math.inf] * self._kind.axles
        self._drifts_since_s = None

    def look(self, sample: Sample) -> None:
        """Take the next sample; report what is new."""
        before = self._before
        if not self._take(sample) or before is None:
            return
        if sample.speed_m_s < SLOWEST_M_S or self._may_drive(sample):
            self._forget_durations()
            return
        for axle in range(self._kind.axles):
            self._look_at_open_valve(axle, sample)
            vents = sample.valves[axle] > VENTS
            has_not_slid = sample.time_s - self._slid_at_s[axle] > MEMORY_S
            if vents and has_not_slid and not self._explained_by[axle]:
                if before.valves[axle] <= VENTS:
                    self._count_vent(axle, sample)
                self._compare_with_others(axle, sample, sample.time_s - before.time_s)
        self._look_at_reference(sample)

    def skip(self, sample: Sample) -> None:
        """Take the next sample without judging it: it only shows which axles have slid."""
        self._take(sample)
        self._forget_durations()

    def _take(self, sample: Sample) -> bool:
        """Remember a sample; return whether it is a new one that follows another."""
        if self._ended:
            return False
        before = self._before
        if before is None:
            self._before = sample
            return False
        if sample.time_s <= before.time_s:
            return False
        self._before = sample
        for axle in range(self._kind.axles):
            if abs(sample.sliding_m_s[axle]) > SLIDES_M_S:
                self._slid_at_s[axle] = sample.time_s
            has_not_slid = sample.time_s - self._slid_at_s[axle] > MEMORY_S
            fault = sample.faults[axle] if sample.faults else ""
            if fault:
                self._fault_at_s[axle] = sample.time_s
            is_over = has_not_slid and sample.time_s - self._fault_at_s[axle] > RECOVERY_S
            if fault or is_over:
                self._explained_by[axle] = fault
        return True

    def _may_drive(self, sample: Sample) -> bool:
        """Return whether motors may drive: the vehicle has motors, and no brake is demanded."""
        return self._kind.dynamic_brake and not sample.brake_demand_Pa > 0.0

    def _look_at_open_valve(self, axle: int, sample: Sample) -> None:
        """Count for how long a valve vents while its axle rolls, however the vent began."""
        slides = abs(sample.sliding_m_s[axle]) > SLIDES_M_S
        if slides or sample.valves[axle] <= VENTS or self._explained_by[axle]:
            self._open_since_s[axle] = math.inf
            return
        self._open_since_s[axle] = min(self._open_since_s[axle], sample.time_s)
        lasts_s = sample.time_s - self._open_since_s[axle]
        self.open_without_sliding_s = max(self.open_without_sliding_s, lasts_s)
        if lasts_s >= OPEN_S and not self._reported_open[axle]:
            self._reported_open[axle] = True
            self._on_event(
                Code.WSP_VENTS_ON,
                axle=axle + 1,
                for_s=lasts_s,
                speed_m_s=float(sample.speed_m_s),
            )

    def _count_vent(self, axle: int, sample: Sample) -> None:
        self.vents_without_sliding += 1
        if not self._reported_vents[axle]:
            self._reported_vents[axle] = True
            self._on_event(
                Code.WSP_VENTS_WITHOUT_SLIDING,
                axle=axle + 1,
                sliding_m_s=float(sample.sliding_m_s[axle]),
                speed_m_s=float(sample.speed_m_s),
            )

    def _compare_with_others(self, axle: int, sample: Sample, lasts_s: float) -> None:
        """Count for how long other axles slide, unprotected, while the valve of `axle` vents."""
        beside_s = self.beside_s[axle]
        far_m_s = max(SLIDES_FAR_M_S, SLIDES_FAR_SHARE * sample.speed_m_s)
        for other in range(self._kind.axles):
            slides = sample.sliding_m_s[other] > far_m_s
            fills = sample.valves[other] < FILLS
            is_candidate = other != axle and not self._explained_by[other]
            if is_candidate and slides and fills:
                beside_s[other] += lasts_s
        other = int(np.argmax(beside_s))
        longest_s = float(beside_s[other])
        next_s = float(np.sort(beside_s)[-2])
        pair = frozenset((axle, other))
        is_clear = longest_s >= SWAPPED_S and longest_s > CLEARLY * next_s
        if is_clear and pair not in self._reported_swaps:
            self._reported_swaps.add(pair)
            self._on_event(Code.WSP_AXLES_SWAPPED, axle=axle + 1, other=other + 1, for_s=longest_s)

    def _look_at_reference(self, sample: Sample) -> None:
        if not np.isfinite(sample.reference_m_s):
            self._drifts_since_s = None
            return
        if np.isnan(self.drift_s):
            self.drift_s = 0.0
        error_m_s = sample.reference_m_s - sample.speed_m_s
        if abs(error_m_s) <= max(DRIFT_M_S, DRIFT_SHARE * sample.speed_m_s):
            self._drifts_since_s = None
            return
        if self._drifts_since_s is None:
            self._drifts_since_s = sample.time_s
        lasts_s = sample.time_s - self._drifts_since_s
        self.drift_s = max(self.drift_s, lasts_s)
        if lasts_s >= DRIFT_S:
            self._report_drift(sample, lasts_s)

    def _report_drift(self, sample: Sample, lasts_s: float) -> None:
        """Report a wrong reference speed once, and once while a known fault explains it."""
        fault = next(filter(None, self._explained_by), "")
        code = Code.WSP_REFERENCE_DRIFTS_IN_FAULT if fault else Code.WSP_REFERENCE_DRIFTS
        if code in self._reported_drifts:
            return
        self._reported_drifts.add(code)
        named = {"fault": fault} if fault else {}
        self._on_event(
            code,
            **named,
            reference_m_s=float(sample.reference_m_s),
            speed_m_s=float(sample.speed_m_s),
            for_s=lasts_s,
        )
