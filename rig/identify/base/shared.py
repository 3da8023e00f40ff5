"""Finds what the runs that differ share, and no other run has: rig, date, order, speed, mass."""

from collections.abc import Mapping, Sequence
from enum import StrEnum

import numpy as np

from rollerrig.rig.identify.data.runs import Run

# Speeds and masses of two groups of runs differ if they are apart by this ratio. Chosen.
LEAST_RATIO = 1.02


class Shared(StrEnum):
    """What the runs that differ share, and no other run has."""

    RIG = "rig"
    DATE = "date"
    FIRST = "first"  # in the order of dataset.toml
    LAST = "last"
    SLOWER = "slower"  # initial speeds
    FASTER = "faster"
    HEAVIER = "heavier"
    LIGHTER = "lighter"
    NOT_FITTED = "not_fitted"


_WORDS = {
    Shared.RIG: "of rig {name}",
    Shared.DATE: "of {name}",
    Shared.FIRST: "the first of the dataset",
    Shared.LAST: "the last of the dataset",
    Shared.SLOWER: "slower than the others, so an effect of speed looks alike",
    Shared.FASTER: "faster than the others, so an effect of speed looks alike",
    Shared.HEAVIER: "of a heavier vehicle",
    Shared.LIGHTER: "of a lighter vehicle",
    Shared.NOT_FITTED: "not among the fitted runs",
}


def find(runs: Sequence[Run], apart: Sequence[int], others: Sequence[int]) -> dict[Shared, str]:
    """Return what the runs `apart` share and no run of `others` has, by places in `runs`.

    The value is the name of the rig, or the date, else "".
    """
    found: dict[Shared, str] = {}
    if not apart or not others:
        return found
    for shared, key in ((Shared.RIG, "rig"), (Shared.DATE, "date")):
        names = {getattr(runs[k], key) for k in apart}
        if (
            len(names) == 1
            and names != {""}
            and not any(getattr(runs[k], key) in names for k in others)
        ):
            found[shared] = names.pop()
    if max(apart) < min(others):
        found[Shared.FIRST] = ""
    if min(apart) > max(others):
        found[Shared.LAST] = ""
    initial_m_s = [float(np.median(run.speed_m_s[:20])) for run in runs]
    masses_kg = [run.mass_kg for run in runs]
    for values, below, above in (
        (initial_m_s, Shared.SLOWER, Shared.FASTER),
        (masses_kg, Shared.LIGHTER, Shared.HEAVIER),
    ):
        of_apart = [values[k] for k in apart]
        of_others = [values[k] for k in others]
        if max(of_apart) * LEAST_RATIO < min(of_others):
            found[below] = ""
        if min(of_apart) > max(of_others) * LEAST_RATIO:
            found[above] = ""
    if {runs[k].group for k in apart} == {"validate"} and {runs[k].group for k in others} == {
        "tune"
    }:
        found[Shared.NOT_FITTED] = ""
    return found


def sentence(runs: Sequence[str], shared: Mapping[Shared, str]) -> str:
    """Return what some runs share as a sentence; "" if they share nothing."""
    if not shared:
        return ""
    are = "It is" if len(runs) == 1 else "They are"
    words = [_WORDS[one].format(name=name) for one, name in shared.items()]
    return f"{are} {'; '.join(words)}."
