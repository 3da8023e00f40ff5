"""Watches the plant for a derailed coach, exhausted air, empty sand boxes and wheel flats.

The physics notes the place where a wheel had no rail within reach any more; from then on it
computes a wheel in the air. Here that becomes an event of the run, once for each wheel, and the run
ends. Air is exhausted when the reservoir holds less than the demanded cylinder pressure: from there
on the brakes are weak. A flat is reported when its wheel turns again, or when the train stands.
"""

from collections.abc import Callable

import numpy as np

from rollerrig.rig.multibody import coach_state
from rollerrig.rig.state import SIZE, slots
from rollerrig.wsp_interface.events import Code, OnEvent

SIDES = ("left", "right")
# a reservoir pressure below the demand by more than this counts as exhausted
_LACK_PA = 5e3
# a flat that is longer than the last reported one by this is reported
_NEW_FLAT_M = 2e-3


class Watch:
    """Looks at the state of the plant from time to time; calls `on_event` and `stop()`.

    The vehicle has so many `axles`.
    """

    def __init__(self, axles: int, on_event: OnEvent, stop: Callable[[], None]) -> None:
        self._slots = slots(axles)
        self._on_event = on_event
        self._stop = stop
        self._derailed = np.zeros(coach_state.WHEELS, dtype=bool)
        self._exhausted = False
        self._flat_m = [0.0] * axles
        self._box_kg = [0.0] * axles

    def look(self, buffer: np.ndarray) -> None:
        """Report what is new; `buffer` is laid out as in `rig.state`."""
        self._look_at_air(buffer)
        self._look_at_sand(buffer)
        self._look_at_flats(buffer)
        has_coach = buffer.size > SIZE
        if has_coach and not self._derailed.all():
            self._look_at_wheels(buffer)

    def _look_at_air(self, buffer: np.ndarray) -> None:
        # the reservoir is 0 where the air of the scenario is never exhausted
        reservoir_Pa = buffer.item(self._slots["reservoir_pressure"].start)
        demand_Pa = buffer.item(self._slots["brake_demand"].start)
        if not self._exhausted and 0.0 < reservoir_Pa < demand_Pa - _LACK_PA:
            self._exhausted = True
            self._on_event(Code.AIR_EXHAUSTED, reservoir_Pa=reservoir_Pa, demand_Pa=demand_Pa)

    def _look_at_sand(self, buffer: np.ndarray) -> None:
        before_kg = self._box_kg
        self._box_kg = buffer[self._slots["sand_box"]].tolist()
        for j, box_kg in enumerate(self._box_kg):
            if box_kg <= 0.0 < before_kg[j]:
                self._on_event(Code.SAND_EMPTY, axle=j + 1)

    def _look_at_flats(self, buffer: np.ndarray) -> None:
        stands = buffer[self._slots["standing"]][0] != 0.0
        turns = buffer[self._slots["wheel_speed"]] > 0.0
        for j, flat_m in enumerate(buffer[self._slots["flat_length"]].tolist()):
            is_new = flat_m > self._flat_m[j] + _NEW_FLAT_M
            if is_new and (turns[j] or stands):
                self._flat_m[j] = flat_m
                self._on_event(Code.WHEEL_FLAT, axle=j + 1, length_m=flat_m)

    def _look_at_wheels(self, buffer: np.ndarray) -> None:
        """Report wheels of the coach that have left their rail, and end the run."""
        # the place in m where a wheel left its rail; 0: it has not
        left_m = coach_state.views(buffer[SIZE:]).left
        for wheel in np.flatnonzero((left_m != 0.0) & ~self._derailed):
            self._derailed[wheel] = True
            self._on_event(
                Code.COACH_DERAILED,
                side=SIDES[wheel % 2],
                axle=int(wheel) // 2 + 1,
                distance_m=float(left_m[wheel]),
            )
        if self._derailed.any():
            self._stop()
