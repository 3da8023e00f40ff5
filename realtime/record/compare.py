"""Compares recorded runs: figures of their summaries side by side, and channels by value.

Each channel of a further run is interpolated at the times of the first run; the difference counts
where both have a value. A tolerance is given for a unit (as in m_s=0.1) or for a channel; a larger
difference fails. The lateness of ticks is not a result and is left out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals

_NO_RESULT = frozenset(("time", "tick_lateness", "tick_duration", "ticks_missed"))
_THIRDS = 3
# what is compared in thirds of the stop
_DRIFTS = ("adhesion while sliding", "friction mu_cd")
# a stop is taken to be at least this long
_SHORTEST_M = 1e-9
# sliding above this counts as sliding
_SLIDES_M_S = 0.5


class Difference(NamedTuple):
    """One channel of one run against the first run: `tolerance` is NaN where none is given."""

    run: str
    channel: str
    largest: float
    rms: float
    at_s: float
    tolerance: float

    @property
    def failed(self) -> bool:
        return self.largest > self.tolerance


def differences(runs: Sequence[records.Run], tolerances: Mapping[str, float]) -> list[Difference]:
    """Return the differences of every channel of every further run from the first run.

    The tolerance of a channel wins over that of its unit.
    """
    first = runs[0]
    units = _units(first)
    found: list[Difference] = []
    for run in runs[1:]:
        for name, unit in units.items():
            if name in run.table.column_names:
                tolerance = tolerances.get(name, tolerances.get(unit, np.nan))
                difference = _difference(first, run, name, tolerance)
                if difference:
                    found.append(difference)
    return found


def _units(run: records.Run) -> dict[str, str]:
    """Return the units of the channels of a run that are results, by name."""
    units: dict[str, str] = {}
    for signal in run.signal_table.signals:
        if signal.name in _NO_RESULT:
            continue
        for name in signals.columns(signal):
            if name in run.table.column_names:
                units[name] = signal.unit or "1"
    return units


def _difference(
    first: records.Run, run: records.Run, name: str, tolerance: float
) -> Difference | None:
    """Return how one channel differs; None where the runs have no time in common."""
    time_s = first.column("time_s")
    if not len(run.table):
        # the run has failed before its first sample
        return None
    other = np.interp(time_s, run.column("time_s"), run.column(name), right=np.nan)
    gap = np.abs(first.column(name) - other)
    known = np.flatnonzero(np.isfinite(gap))
    if not known.size:
        return None
    worst = known[np.argmax(gap[known])]
    return Difference(
        run=str(run.folder),
        channel=name,
        largest=float(gap[worst]),
        rms=float(np.sqrt(np.mean(gap[known] ** 2))),
        at_s=float(time_s[worst]),
        tolerance=tolerance,
    )


def drifts(run: records.Run) -> dict[str, tuple[float | None, ...]]:
    """Return how adhesion changes over a stop: means of all wheelsets in thirds of its distance.

    None where no wheel slides, and always None for a run that is not valid or has no sample.
    `adhesion while sliding` is over samples at which a wheel slides by more than 0.5 m/s,
    `friction mu_cd` over all samples. On a track the contaminant is always fresh; on rollers it is
    not. The difference of two runs is the effect of the rig.
    """
    if not len(run.table):
        return dict.fromkeys(_DRIFTS, (None,) * _THIRDS)
    position_m = run.column("position_m")
    way_m = position_m - position_m[0]
    length_m = max(float(position_m[-1] - position_m[0]), _SHORTEST_M)
    # the last sample belongs to the last third
    third = np.minimum(_THIRDS * way_m / length_m, _THIRDS - 1e-3).astype(int)

    axles = run.signal_table.axles
    adhesion = np.array([run.column(f"adhesion_{axle}") for axle in axles])
    sliding_m_s = np.array([run.column(f"sliding_{axle}_m_s") for axle in axles])
    friction = np.array([run.column(f"friction_degraded_{axle}") for axle in axles])

    valid = bool(run.summary.get("valid", True))
    slides = valid & (sliding_m_s > _SLIDES_M_S)
    known = valid & np.isfinite(friction)
    found = (_means(adhesion, slides, third), _means(friction, known, third))
    return dict(zip(_DRIFTS, found, strict=True))


def _means(values: np.ndarray, counts: np.ndarray, third: np.ndarray) -> tuple[float | None, ...]:
    """Return the mean of values (axles, n) that count in each third; None without any."""
    means: list[float | None] = []
    for number in range(_THIRDS):
        inside = third == number
        chosen = values[:, inside][counts[:, inside]]
        means.append(float(chosen.mean()) if chosen.size else None)
    return tuple(means)


def tolerances(given: Sequence[str], table: signals.Table) -> dict[str, float]:
    """Return tolerances from texts such as "m_s=0.1" or "sliding_1_m_s=0.5".

    `table` has the signals of the first run. Raises ConfigError.
    """
    units = sorted({signal.unit or "1" for signal in table.signals})
    found: dict[str, float] = {}
    for text in given:
        name, _, value = text.partition("=")
        if name not in units and name not in table.columns:
            raise ConfigError(
                f"--tolerance {text}: no unit or channel is called '{name}'"
                f"{nearest(name, units, 'Units', others=table.columns)}; or give a channel "
                "from 'rollerrig list signals', with its unit, as in sliding_1_m_s"
            )
        try:
            found[name] = float(value)
        except ValueError:
            raise ConfigError(
                f"--tolerance {text}: '{value}' is not a number; write as in m_s=0.1"
            ) from None
        if not found[name] >= 0.0:
            raise ConfigError(f"--tolerance {text}: must be 0 or more")
    return found
