"""Watches whether a wheel of the coach in 3D has left its rail or roller.

The physics notes the place where a wheel had nothing within reach any more; what it computes from then
on is a wheel in the air. Here that becomes an event of the run, once for each wheel, and the run ends.
"""

from collections.abc import Callable

import numpy as np

from rollerrig.rig.multibody import coach_state
from rollerrig.rig.state import SIZE

SIDES = ("left", "right")


class Watch:
    """Looks at the state of the plant from time to time; `tell(level, text)` and `stop(why)` are called."""

    def __init__(self, tell: Callable[[str, str], None], stop: Callable[[str], None]) -> None:
        self._tell, self._stop = tell, stop
        self._seen = np.zeros(coach_state.WHEELS, dtype=bool)

    def look(self, buffer: np.ndarray) -> None:
        """Tell of wheels that have newly left; `buffer` as of `rig.state`, nothing to see without a coach."""
        if buffer.size == SIZE or self._seen.all():
            return
        left_m = coach_state.views(buffer[SIZE:]).left
        for wheel in np.flatnonzero((left_m != 0.0) & ~self._seen):
            self._seen[wheel] = True
            self._tell("error", f"derailed: the {SIDES[wheel % 2]} wheel of axle {wheel // 2 + 1} left its "
                                f"rail after {left_m[wheel]:.1f} m; slow down, or check profiles, gauge_m "
                                "and the suspension under [multibody]")
        if self._seen.any():
            self._stop("derailed")
