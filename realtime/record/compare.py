"""Compares recorded runs: figures of their summaries side by side, and channels by value.

Each channel of a further run is laid on the time of the first; the difference counts where both
have a value. A tolerance is given for a unit (as in m_s=0.1) or a channel; what is beyond it fails.
Ticks' lateness is no result and is left out.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals

_NO_RESULT = frozenset(("time", "tick_lateness", "tick_duration", "ticks_missed"))


class Difference(NamedTuple):
    """One channel of one run against the first: `tolerance` NaN where none was given."""

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
    """Every channel of every further run against the first; a tolerance of the channel itself counts first."""
    first, found = runs[0], []
    time_s = first.column("time_s")
    units = {
        name: signal.unit or "1"
        for signal in signals.SIGNALS
        if signal.name not in _NO_RESULT
        for name in signals.columns(signal)
        if name in first.table.column_names
    }
    for run in runs[1:]:
        for name in [name for name in units if name in run.table.column_names]:
            other = np.interp(time_s, run.column("time_s"), run.column(name), right=np.nan)
            gap = np.abs(first.column(name) - other)
            known = np.flatnonzero(np.isfinite(gap))
            if known.size:
                worst = known[np.argmax(gap[known])]
                found.append(
                    Difference(
                        str(run.folder),
                        name,
                        largest=float(gap[worst]),
                        rms=float(np.sqrt(np.mean(gap[known] ** 2))),
                        at_s=float(time_s[worst]),
                        tolerance=tolerances.get(name, tolerances.get(units[name], np.nan)),
                    )
                )
    return found


def drifts(run: records.Run) -> dict[str, tuple[float | None, ...]]:
    """What a stop's adhesion becomes: means of all wheelsets in each third of its way.

    None where no wheel slides, and all None of a run that is not valid. `adhesion while sliding` counts where a wheel
    slides by more than 0.5 m/s, `friction mu_cd` everywhere. On a track the contaminant is always fresh; on rollers it
    is not, and the difference of two runs is what the rig adds.
    """
    place_m = run.column("position_m")
    third = np.minimum(
        3.0 * (place_m - place_m[0]) / max(float(place_m[-1] - place_m[0]), 1e-9), 2.999
    ).astype(int)
    names = [f"_{axle}" for axle in range(1, signals.AXLES + 1)]
    f, s, mu = (
        np.array([run.column(f"{stem}{name}{unit}") for name in names])
        for stem, unit in (("adhesion", ""), ("sliding", "_m_s"), ("friction_degraded", ""))
    )
    valid = bool(run.summary.get("valid", True))
    slides, known = valid & (s > 0.5), valid & np.isfinite(mu)
    return {
        "adhesion while sliding": tuple(
            _mean(f[:, third == k], slides[:, third == k]) for k in range(3)
        ),
        "friction mu_cd": tuple(_mean(mu[:, third == k], known[:, third == k]) for k in range(3)),
    }


def _mean(values: np.ndarray, counts: np.ndarray) -> float | None:
    return float(values[counts].mean()) if counts.any() else None


def tolerances(given: Sequence[str]) -> dict[str, float]:
    """From texts such as "m_s=0.1" or "sliding_1_m_s=0.5". Raises ConfigError."""
    units = sorted({signal.unit or "1" for signal in signals.SIGNALS})
    found = {}
    for text in given:
        name, _, value = text.partition("=")
        if name not in units and name not in signals.COLUMNS:
            raise ConfigError(
                f"--tolerance {text}: no unit or channel is called '{name}'"
                f"{nearest(name, [*units, *signals.COLUMNS])}"
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
