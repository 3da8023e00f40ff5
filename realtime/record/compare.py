"""Compares recorded runs: figures of their summaries side by side, and channels by value.

Each channel of a further run is laid on the time of the first; the difference counts where both
have a value. A tolerance is given for a unit (as in m_s=0.1) or a channel; what is beyond it fails.
Ticks' lateness is no result and is left out.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import nearest
from rollerrig.realtime.record import records
from rollerrig.realtime.record.figures import FIGURES
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


def figures(runs: Sequence[records.Run]) -> list[tuple[str, str, list[float | None]]]:
    """Rows of (title, unit, a value a run); None where a run has no such figure."""
    return [(one.title, one.unit, [one.shown(run.summary) for run in runs]) for one in FIGURES]


def differences(runs: Sequence[records.Run], tolerances: Mapping[str, float]) -> list[Difference]:
    """Every channel of every further run against the first; a tolerance of the channel itself counts first."""
    first, found = runs[0], []
    time_s = first.column("time_s")
    units = {name: signal.unit or "1" for signal in signals.SIGNALS if signal.name not in _NO_RESULT
             for name in signals.columns(signal) if name in first.table.column_names}
    for run in runs[1:]:
        for name in [name for name in units if name in run.table.column_names]:
            other = np.interp(time_s, run.column("time_s"), run.column(name), right=np.nan)
            gap = np.abs(first.column(name) - other)
            known = np.flatnonzero(np.isfinite(gap))
            if known.size:
                worst = known[np.argmax(gap[known])]
                found.append(Difference(
                    run=str(run.folder), channel=name, largest=float(gap[worst]),
                    rms=float(np.sqrt(np.mean(gap[known] ** 2))), at_s=float(time_s[worst]),
                    tolerance=tolerances.get(name, tolerances.get(units[name], np.nan))))
    return found


def tolerances(given: Sequence[str]) -> dict[str, float]:
    """From texts such as "m_s=0.1" or "sliding_1_m_s=0.5". Raises ConfigError."""
    units = sorted({signal.unit or "1" for signal in signals.SIGNALS})
    found = {}
    for text in given:
        name, _, value = text.partition("=")
        if name not in units and name not in signals.COLUMNS:
            raise ConfigError(f"--tolerance {text}: no unit or channel is called '{name}'"
                              f"{nearest(name, [*units, *signals.COLUMNS])}")
        try:
            found[name] = float(value)
        except ValueError:
            raise ConfigError(f"--tolerance {text}: '{value}' is not a number; write as in "
                              "m_s=0.1") from None
        if not found[name] >= 0.0:
            raise ConfigError(f"--tolerance {text}: must be 0 or more")
    return found


def load(folders: Sequence[Path]) -> list[records.Run]:
    """The runs of folders, at least two. Raises ConfigError."""
    if len(folders) < 2:
        raise ConfigError("compare needs at least two run folders, as in: "
                          "rollerrig compare runs/a runs/b")
    return [records.load(folder) for folder in folders]
