"""The figures of a stop, read from its summary: by these, runs are judged, compared and ranked."""

import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rollerrig.realtime.record import validity

Summary = Mapping[str, Any]


class Figure(NamedTuple):
    """One figure: `get` takes it from a summary, in the unit of its name.

    `better` is -1 where less is better, 1 where more is better, 0 where neither is. `scale`
    converts the value to `unit`, in which people read it.
    """

    name: str
    title: str
    unit: str
    get: Callable[[Summary], Any]
    better: int = -1
    scale: float = 1.0

    def of(self, summary: Summary) -> Any:
        """Return the figure of a run.

        None where it has none, and always for a run that is not valid.
        """
        if validity.because(summary):
            return None
        try:
            return self.get(summary)
        except (KeyError, TypeError, ValueError):
            return None

    def shown(self, summary: Summary) -> float | None:
        """Return the figure in the unit that people read."""
        value = self.of(summary)
        return None if value is None else value * self.scale


def _axles(summary: Summary, key: str) -> list[float]:
    return [axle[key] for axle in summary["axles"]]


def _mean(summary: Summary, key: str) -> float:
    values = _axles(summary, key)
    return sum(values) / len(values)


FIGURES = (
    # the names of these four are defined in `wsp_interface.braking`
    Figure("braking_time_s", "stopping time", "s", lambda s: s["braking_time_s"]),
    Figure("braking_distance_m", "stopping distance", "m", lambda s: s["braking_distance_m"]),
    Figure("stop_time_s", "time from the start", "s", lambda s: s["stop_time_s"]),
    Figure("stop_distance_m", "distance from the start", "m", lambda s: s["stop_distance_m"]),
    Figure(
        "sliding_mean_m_s",
        "mean sliding, all axles",
        "m/s",
        lambda s: _mean(s, "sliding_mean_m_s"),
        better=0,
    ),
    Figure(
        "sliding_std_m_s",
        "standard deviation of sliding",
        "m/s",
        lambda s: _mean(s, "sliding_std_m_s"),
    ),
    Figure(
        "sliding_max_m_s", "largest sliding", "m/s", lambda s: max(_axles(s, "sliding_max_m_s"))
    ),
    Figure("longest_lock_s", "longest lock", "s", lambda s: max(_axles(s, "longest_lock_s"))),
    Figure(
        "longest_deep_slide_s",
        "longest deep slide",
        "s",
        lambda s: max(_axles(s, "longest_deep_slide_s")),
    ),
    Figure("adhesion_mean", "mean adhesion", "", lambda s: _mean(s, "adhesion_mean"), better=1),
    Figure(
        "dissipated_energy_J",
        "energy of sliding",
        "MJ",
        lambda s: sum(_axles(s, "dissipated_energy_J")),
        scale=1e-6,
    ),
    Figure("vents", "vents", "", lambda s: s["wsp"]["vents"]),
    Figure("air_consumption_NL", "air", "NL", lambda s: s["air_consumption_NL"]),
    Figure(
        "tracking_max_m_s", "tracking error, largest", "m/s", lambda s: s["tracking"]["max_m_s"]
    ),
    Figure("tracking_rms_m_s", "tracking error, rms", "m/s", lambda s: s["tracking"]["rms_m_s"]),
)
BY_NAME = {figure.name: figure for figure in FIGURES}


def spread(summaries: Sequence[Summary]) -> list[dict[str, Any]]:
    """Return the spread of each figure over the valid runs that have it, in the unit of people.

    The standard deviation is that of a sample; it is 0 for one run.
    """
    found = []
    for figure in FIGURES:
        known = [figure.of(summary) for summary in summaries]
        values = [figure.scale * value for value in known if _is_number(value)]
        if values:
            found.append(
                {
                    "name": figure.name,
                    "title": figure.title,
                    "unit": figure.unit,
                    "runs": len(values),
                    **spread_of(values),
                }
            )
    return found


def spread_of(values: Sequence[float]) -> dict[str, float]:
    """Return mean, standard deviation of a sample (0 for one value), least and largest value."""
    return {
        "mean": statistics.fmean(values),
        "standard_deviation": statistics.stdev(values) if len(values) > 1 else 0.0,
        "least": min(values),
        "largest": max(values),
    }


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)
