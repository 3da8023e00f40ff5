"""Slides, the adhesion that was used in them at least, and places where several runs slide.

    [S1] sliding = V - v_i / (1 + rho_i), V by the reference; without one, the least speed of the vehicle that
         the fastest wheel allows: V(t) >= max over t' of v_max(t') - a |t - t'|, a the hardest braking
         from t' on, and before it next to nothing, for nobody drives while wheels slide in braking
    [S2] mu >= (d - 2 s_d - R / M) / g, d the deceleration of the vehicle while wheels slide, s_d its error

[S2] is the mean over all wheels of what the contact took; the best wheel had at least that. It assumes level track
(10 per mille uphill add 0.010 to it), no other brake that acts on the rail, and a running resistance R of at
most RESISTANCE_M_S2.
"""

from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import GRAVITY_M_S2
from rollerrig.rig.identify.train_recorder import rolling
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.faults import stretches
from rollerrig.rig.identify.train_recorder.recording import Finding
from rollerrig.rig.identify.train_recorder.rolling import Aligned


class Slide(NamedTuple):
    """One episode: samples of the aligned run, and the mean adhesion used with its interval."""

    run: int
    first: int
    last: int
    finding: Finding
    adhesion: tuple[float, float, float]


def vehicle(a: Aligned) -> np.ndarray:
    """The vehicle's speed also while wheels slide, m/s [S1]."""
    some = np.isfinite(a.speed).any(axis=1)
    fastest = np.where(
        some, np.max(np.where(np.isfinite(a.speed), a.speed, -np.inf), axis=1), -np.inf
    )
    brakes, drives = (
        one * (a.time_s - a.time_s[0]) for one in (limit.HARDEST_M_S2, limit.DRIVES_M_S2)
    )
    ahead = np.maximum.accumulate(fastest + brakes) - brakes
    back = np.maximum.accumulate((fastest - drives)[::-1])[::-1] + drives
    least = np.maximum(ahead, back)
    return np.where(np.isfinite(a.reference), a.reference, np.where(some, least, np.nan))


def scatter(a: Aligned) -> np.ndarray:
    """Deviation of each speed from the vehicle's while nobody brakes hard, m/s, shape (m,)."""
    still, v = rolling.quiet(a), a.vehicle
    found = []
    for own in a.speed.T:
        off = (own - v)[still & np.isfinite(own) & np.isfinite(v)]
        found.append(
            1.4826 * float(np.median(np.abs(off - np.median(off)))) if off.size > 20 else 0.1
        )
    return np.maximum(found, 0.02)


def find(aligned: list[Aligned]) -> tuple[list[Slide], list[np.ndarray]]:
    """Slides of all runs, and where each speed slides, shape (n, m) each."""
    found: list[Slide] = []
    flags = []
    for r, a in enumerate(aligned):
        v, noise = vehicle(a), scatter(a)
        sliding = v[:, None] - a.speed
        least = np.maximum(
            np.maximum(limit.SLIDE_M_S, limit.SLIDE_SHARE * v)[:, None],
            limit.SLIDE_DEVIATIONS * noise,
        )
        flag = np.where(np.isfinite(sliding), sliding > least, False)
        shortest = max(round(limit.SLIDE_S / a.step_s), 2)
        braked = rolling.slope(a.time_s, v, 1.5)
        for j in range(flag.shape[1]):
            for part in stretches(flag[:, j]):
                slows = (
                    np.nanmean(np.append(braked[part.first : part.last + 1], np.nan))
                    if np.isfinite(braked[part.first : part.last + 1]).any()
                    else 0.0
                )
                if part.last - part.first + 1 < shortest or slows > -0.1:
                    flag[part.first : part.last + 1, j] = False
        flags.append(flag)
        found += [
            _slide(r, a, v, sliding, noise, *ends, flag)
            for ends in _episodes(a, np.any(flag, axis=1))
        ]
    return found, flags


def _episodes(a: Aligned, any_: np.ndarray) -> list[tuple[int, int]]:
    """Stretches of sliding, those less than 2 s apart as one."""
    out: list[tuple[int, int]] = []
    for first, last in stretches(any_):
        if out and a.time_s[first] - a.time_s[out[-1][1]] < 2.0:
            out[-1] = (out[-1][0], last)
        else:
            out.append((first, last))
    return out


def _slide(
    r: int,
    a: Aligned,
    v: np.ndarray,
    sliding: np.ndarray,
    noise: np.ndarray,
    first: int,
    last: int,
    flag: np.ndarray,
) -> Slide:
    within = np.where(flag[first : last + 1], sliding[first : last + 1], 0.0)
    worst = int(np.argmax(within.max(axis=0)))
    most, half = float(within.max()), 2.0 * float(noise[worst]) + 0.02 * float(within.max())
    adhesion = _adhesion(a, v, first, last)
    names = tuple(
        name for name, own in zip(a.names, flag[first : last + 1].T, strict=True) if own.any()
    )
    start, end = float(a.time_s[first]), float(a.time_s[last])
    bound = (
        f"adhesion used at least {max(adhesion[1], 0.0):.3f}"
        if np.isfinite(adhesion[1])
        else "what adhesion was used cannot be told without a reference"
    )
    text = (
        f"slides for {end - start + a.step_s:.1f} s from {v[first]:.1f} m/s, up to {most:.1f} m/s below the "
        f"vehicle; {bound}"
    )
    finding = Finding(
        "slide",
        names,
        a.run.name,
        start,
        end,
        most,
        most - half,
        most + half,
        "m/s",
        text,
        a.run.date,
    )
    return Slide(r, first, last, finding, adhesion)


def _adhesion(a: Aligned, v: np.ndarray, first: int, last: int) -> tuple[float, float, float]:
    """Mean adhesion used and its bounds, by the vehicle's deceleration over the episode, 2 s at least [S2].

    Without a reference from the moment before to that after in which all wheels roll; NaN where there is none.
    """
    middle, half = (
        0.5 * (a.time_s[first] + a.time_s[last]),
        max(1.0, 0.5 * (a.time_s[last] - a.time_s[first])),
    )
    own = np.flatnonzero((np.abs(a.time_s - middle) <= half + 0.5 * a.step_s) & np.isfinite(v))
    if np.isfinite(a.reference[own]).mean() > 0.67:
        t = a.time_s[own] - a.time_s[own].mean()
        slows = -float(t @ v[own] / (t @ t))
        rest = v[own] - v[own].mean() + slows * t
        # noise of a receiver is not white: as if a quarter of the samples told something
        error = 2.0 * float(np.sqrt(rest @ rest / max(own.size - 2, 1) / (t @ t)))
    else:
        count = max(round(2.0 / a.step_s), 2)
        spread = (
            np.ptp(np.where(np.isfinite(a.speed), a.speed, np.nan), axis=1)
            if len(a.names) > 1
            else v * np.nan
        )
        roll = np.convolve(
            np.nan_to_num(spread, nan=np.inf) < limit.TOGETHER_M_S, np.ones(count), "full"
        )
        before, after = (
            np.flatnonzero(roll[:first] > count - 0.5),
            last + 1 + np.flatnonzero(roll[last + count : v.size] > count - 0.5),
        )
        if not (before.size and after.size):
            return np.nan, np.nan, np.nan
        seconds = float(a.time_s[after[0]] - a.time_s[before[-1]])
        slows = -float(v[after[0]] - v[before[-1]]) / seconds
        error = 0.5 * limit.TOGETHER_M_S / seconds
    return (
        slows / GRAVITY_M_S2,
        (slows - 2.0 * error - limit.RESISTANCE_M_S2) / GRAVITY_M_S2,
        (slows + 2.0 * error) / GRAVITY_M_S2,
    )


# --- places ---


def places(aligned: list[Aligned], slides: list[Slide]) -> list[Finding]:
    """Where more runs slide than would by chance, if each slid anywhere on the track that it braked on."""
    spans: dict[int, list[tuple[float, float]]] = {}
    for s in slides:
        x = aligned[s.run].position[s.first : s.last + 1]
        if np.isfinite(x).any():
            spans.setdefault(s.run, []).append((float(np.nanmin(x)), float(np.nanmax(x))))
    if len(spans) < limit.PLACE_RUNS:
        return []
    braked = {}
    for r in spans:
        a = aligned[r]
        x = a.position[
            np.isfinite(a.position) & (np.nan_to_num(rolling.slope(a.time_s, a.vehicle)) < -0.2)
        ]
        ends = [edge for span in spans[r] for edge in span]
        braked[r] = (min([*x, *ends]), max([*x, *ends]))
    least = min(low for low, _ in braked.values())
    grid = np.arange(least, max(high for _, high in braked.values()) + 10.0, 10.0)

    def shared(moved: dict[int, float]) -> np.ndarray:
        count = np.zeros(grid.size)
        for r, own in spans.items():
            low, high = braked[r]
            hit, length = np.zeros(grid.size, bool), max(high - low, 10.0)
            for start, end in own:
                at = low + (start - low + moved.get(r, 0.0)) % length
                hit |= (grid + 10.0 > at) & (grid < at + end - start)
            count += hit
        return count

    real = shared({})
    if real.max() < limit.PLACE_RUNS:
        return []
    rng = np.random.default_rng(1)
    chance = [shared({r: rng.uniform(0.0, 1e6) for r in spans}).max() for _ in range(500)]
    p = (1 + sum(one >= real.max() for one in chance)) / 501
    if p > limit.PLACE_P:
        return []
    found = []
    for first, last in stretches(real >= max(limit.PLACE_RUNS, 0.75 * real.max())):
        names = ", ".join(
            aligned[r].run.name
            for r, own in spans.items()
            if any(end > grid[first] and start < grid[last] + 10.0 for start, end in own)
        )
        low, high = float(grid[first]), float(grid[last] + 10.0)
        found.append(
            Finding(
                "slippery_place",
                ("position",),
                "",
                0.0,
                0.0,
                high - low,
                max(high - low - 20.0, 0.0),
                high - low + 20.0,
                "m",
                f"{int(real[first : last + 1].max())} runs slide between {low:.0f} and {high:.0f} m ({names}); by "
                f"chance in {100 * p:.1g} % of such recordings or less",
                place_m=(low, high),
            )
        )
    return found
