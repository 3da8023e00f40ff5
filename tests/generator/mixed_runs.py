"""Sets of six stops in which some runs differ: another vehicle, day, rig, direction or weather.

Each set hides one thing that no cause explains in all runs. Nothing is imported from the rig: the
stops are those of `other_stops`, in which the runs differ by their physics, and the sensors of some
runs are changed as in `mistakes`.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from generator import mistakes, other_stops
from generator.other_stops import OtherRun

Columns = dict[str, np.ndarray]


class Mixture(NamedTuple):
    """A set of runs of which some differ: which, in what, and what dataset.toml says of the runs.

    `words` has the lines that are added to the table of each run that differs, and of each other.
    """

    runs: tuple[str, ...]
    other: OtherRun = OtherRun()
    columns: Callable[[Columns], Columns] | None = None
    all_columns: Callable[[Columns], Columns] | None = None
    words: tuple[str, str] = ("", "")


def scaled(names: tuple[str, ...], factor: float) -> Callable[[Columns], Columns]:
    """Return the change of some columns by a factor."""
    return lambda columns: columns | {name: columns[name] * factor for name in names}


def noisier(name: str, deviation: float, seed: int) -> Callable[[Columns], Columns]:
    """Return the change of a column by white noise."""

    def change(columns: Columns) -> Columns:
        noise = np.random.default_rng(seed).normal(0.0, deviation, columns[name].size)
        return columns | {name: columns[name] + noise}

    return change


SURFACES = tuple(f"surface_speed_{axle}_m_s" for axle in range(1, 5))


def on_rollers(columns: Columns) -> Columns:
    """Add the speed of the rollers' surface, which is that of the vehicle."""
    rng = np.random.default_rng(int(1e3 * columns["vehicle_speed_m_s"][0]))
    speed = columns["vehicle_speed_m_s"]
    surfaces = {name: speed + rng.normal(0.0, 0.01, speed.size) for name in SURFACES}
    return columns | surfaces


MIXTURES: Mapping[str, Mixture] = {
    "two vehicles": Mixture(
        runs=("a2", "b1", "b3"),
        other=OtherRun(radius_fraction=-0.0015, load_shares=(0.04, 0.02, -0.02, -0.04)),
        words=('rig = "coach 12"', 'rig = "coach 7"'),
    ),
    "two vehicles of different wheels": Mixture(
        runs=("a2", "b1", "b3"),
        other=OtherRun(radius_fraction=-0.006),
        words=('rig = "coach 12"', 'rig = "coach 7"'),
    ),
    "a run in the wrong direction": Mixture(runs=("a3",), columns=mistakes.reversed_axles),
    "a sensor changed between days": Mixture(
        runs=("b1", "b2", "b3"),
        columns=lambda columns: noisier(mistakes.WHEELS[2], 0.1, 5)(
            scaled(mistakes.WHEELS[2:3], 1.003)(columns)
        ),
        words=('date = "2026-03-05"', 'date = "2026-03-02"'),
    ),
    "a run on other rollers": Mixture(
        runs=("b3",),
        other=OtherRun(effects={"roller_curvature": 0.5}),
        columns=scaled(SURFACES, 1.004),
        all_columns=on_rollers,
        words=('rig = "rollers B"', 'rig = "rollers A"'),
    ),
    # the brake of a cold disc is 8 % stronger, and loses that until the disc is warm
    "a cold run": Mixture(
        runs=("a1",), other=OtherRun(effects={"brake_gain": 0.08, "pad_fade": 0.04})
    ),
    "half of the runs on a wetter rail": Mixture(
        runs=("a2", "b1", "b2"),
        other=OtherRun(friction_fraction=-0.35),
        words=('date = "2026-11-04"', 'date = "2026-08-20"'),
    ),
}


def make(folder: Path, mixture: Mixture, seed: int) -> Path:
    """Write the set of a mixture; return its folder."""
    other_stops.make(folder, {}, seed, other=dict.fromkeys(mixture.runs, mixture.other))
    for name in other_stops.RUNS:
        path = folder / "runs" / f"{name}.csv"
        columns = mistakes.read(path)
        if mixture.all_columns is not None:
            columns = mixture.all_columns(columns)
        if mixture.columns is not None and name in mixture.runs:
            columns = mixture.columns(columns)
        mistakes.write(path, columns)

    path = folder / "dataset.toml"
    of_runs, of_others = mixture.words

    def with_words(found: re.Match[str]) -> str:
        words = of_runs if found[1] in mixture.runs else of_others
        return f"{found[0]}\n{words}" if words else found[0]

    text = path.read_text(encoding="utf-8")
    path.write_text(re.sub(r'^file = "runs/(\w+).csv"$', with_words, text, flags=re.M), "utf-8")
    return folder
