"""Watches what the plant alone knows: a wheel of the coach in 3D off its rail, exhausted air, empty sand boxes, flats.

The physics notes the place where a wheel had nothing within reach any more; what it computes from then
on is a wheel in the air. Here that becomes an event of the run, once for each wheel, and the run ends. Air is
exhausted when the reservoir holds less than the cylinders are asked to have: from there on brakes are weak. A flat is
told when its wheel turns again, or the train stands.
"""

from collections.abc import Callable

import numpy as np

from rollerrig.rig.multibody import coach_state
from rollerrig.rig.state import AXLES, SIZE, SLOTS
from rollerrig.wsp_interface.events import Code, OnEvent

SIDES = ("left", "right")
_LACK_PA = 5e3  # so much less than is asked counts
_NEW_FLAT_M = 2e-3  # so much longer is a flat worth telling of
_RESERVOIR, _DEMAND = (SLOTS[name].start for name in ("reservoir_pressure", "brake_demand"))


class Watch:
    """Looks at the state of the plant from time to time; `on_event(code, **fields)` and `stop()` are called."""

    def __init__(self, on_event: OnEvent, stop: Callable[[], None]) -> None:
        self._on_event, self._stop = on_event, stop
        self._seen = np.zeros(coach_state.WHEELS, dtype=bool)
        self._exhausted = False
        self._flat_m, self._box_kg = [0.0] * AXLES, [0.0] * AXLES

    def look(self, buffer: np.ndarray) -> None:
        """Tell of what is new; `buffer` as of `rig.state`."""
        held_Pa, asked_Pa = (
            buffer.item(_RESERVOIR),
            buffer.item(_DEMAND),
        )  # 0 where air never runs out
        if not self._exhausted and 0.0 < held_Pa < asked_Pa - _LACK_PA:
            self._exhausted = True
            self._on_event(Code.AIR_EXHAUSTED, reservoir_Pa=held_Pa, demand_Pa=asked_Pa)
        held_kg, self._box_kg = self._box_kg, buffer[SLOTS["sand_box"]].tolist()
        for j in range(AXLES):
            if self._box_kg[j] <= 0.0 < held_kg[j]:
                self._on_event(Code.SAND_EMPTY, axle=j + 1)
        for j, flat_m in enumerate(buffer[SLOTS["flat_length"]].tolist()):
            if flat_m > self._flat_m[j] + _NEW_FLAT_M and (
                buffer[SLOTS["wheel_speed"]][j] > 0.0 or buffer[SLOTS["standing"]][0] != 0.0
            ):
                self._flat_m[j] = flat_m
                self._on_event(Code.WHEEL_FLAT, axle=j + 1, length_m=flat_m)
        if buffer.size == SIZE or self._seen.all():
            return
        left_m = coach_state.views(buffer[SIZE:]).left
        for wheel in np.flatnonzero((left_m != 0.0) & ~self._seen):
            self._seen[wheel] = True
            self._on_event(
                Code.COACH_DERAILED,
                side=SIDES[wheel % 2],
                axle=int(wheel) // 2 + 1,
                distance_m=float(left_m[wheel]),
            )
        if self._seen.any():
            self._stop()
