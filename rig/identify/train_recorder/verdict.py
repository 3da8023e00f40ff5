"""Explains a recording: faults, rolling wheels, slides, places, then what remains unexplained."""

import time
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import faults, rolling, slides
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.findings import (
    NAMES,
    Details,
    Finding,
    SpeedOffset,
    SpeedScatter,
)
from rollerrig.rig.identify.train_recorder.recording import Recording, Run
from rollerrig.rig.identify.train_recorder.rolling import Aligned
from rollerrig.rig.identify.train_recorder.slides import Slide

# samples of a speed. A run in which no speed has more is left out after the checks of the sensors.
_LEAST_SAMPLES = 50

# s. Blocks this close to a slide are not judged.
_AROUND_SLIDES_S = 2.0

# m/s. The usual scatter of a speed is taken as at least this.
_LEAST_SCATTER_M_S = 0.02

# m/s^2. A vehicle that loses more speed is braked.
_BRAKED_M_S2 = -0.1


class Account(NamedTuple):
    """The explanation of a recording; `unknown` are findings without a cause."""

    recording: Recording
    aligned: list[Aligned]
    vehicle: list[np.ndarray]  # speed of the vehicle in each aligned run, m/s
    findings: list[Finding]
    slides: list[Slide]
    unknown: list[Finding]
    elapsed_s: float

    @property
    def verdict(self) -> str:
        """One of consistent, explained, partly, unexplained."""
        if self.unknown:
            return "partly" if self.findings else "unexplained"
        return "explained" if self.findings else "consistent"


def explain(recording: Recording) -> Account:
    """Return the explanation of a recording."""
    begun_s = time.perf_counter()
    found: list[Finding] = []

    runs = []
    for recorded in recording.runs:
        run, more = faults.find(recorded)
        runs.append(run)
        found += more
    runs, more = faults.copies(runs)
    found += more

    aligned, more = rolling.fit([run for run in runs if _has_speed(run)])
    found += more

    all_slides, sliding_flags = slides.find(aligned)
    found += [slide.finding for slide in all_slides]
    found += slides.places(aligned, all_slides)

    unknown = []
    for a, sliding in zip(aligned, sliding_flags, strict=True):
        unknown += _unexplained_blocks(a, sliding)

    found.sort(key=lambda f: (NAMES.index(f.name), f.run, f.channels, f.start_s))
    return Account(
        recording=recording,
        aligned=aligned,
        vehicle=[slides.vehicle(a) for a in aligned],
        findings=found,
        slides=all_slides,
        unknown=unknown,
        elapsed_s=time.perf_counter() - begun_s,
    )


def _has_speed(run: Run) -> bool:
    """Whether any speed has enough samples."""
    return any(np.isfinite(channel.values).sum() > _LEAST_SAMPLES for channel in run.of("speed"))


def _unexplained_blocks(a: Aligned, sliding: np.ndarray) -> list[Finding]:
    """Return blocks in which a speed is off or rough beyond chance and braking wheels."""
    noise = slides.scatter(a)
    reach = round(_AROUND_SLIDES_S / a.step_s)
    near_slide = np.convolve(sliding.any(axis=1), np.ones(2 * reach + 1), "same") > 0.0
    base, names = _comparison(a)
    change_m_s2 = np.nan_to_num(rolling.slope(a.time_s, base))
    block = a.blocks()

    found: list[Finding] = []
    for j, name in enumerate(names):
        offset = a.speed[:, j] - base
        good = np.isfinite(offset) & (base > limit.SLOWEST_M_S) & ~near_slide
        parts = [good & (block == k) for k in np.unique(block[good])]
        parts = [part for part in parts if a.is_filled(part)]

        roughness = np.array([float(np.std(np.diff(offset[part]))) for part in parts])
        usual = _LEAST_SCATTER_M_S
        if roughness.size:
            usual = max(float(np.median(roughness)), _LEAST_SCATTER_M_S)

        for part, scatter in zip(parts, roughness, strict=True):
            finding = _offset_finding(a, name, part, offset, base, change_m_s2, noise[j])
            if finding is None:
                finding = _scatter_finding(a, name, part, float(scatter), usual)
            if finding is not None:
                found.append(finding)
    return _join_blocks(found)


def _comparison(a: Aligned) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the speed to compare with, and the speeds that are compared with it.

    Without a reference a single speed shows nothing about itself, and two speeds only show how the
    first differs from the second.
    """
    if a.has_reference or len(a.names) > 2:
        return a.vehicle, a.names
    if len(a.names) == 2:
        return a.speed[:, 1], a.names[:1]
    return a.vehicle, ()


def _offset_finding(
    a: Aligned,
    name: str,
    part: np.ndarray,
    offset: np.ndarray,
    base: np.ndarray,
    change_m_s2: np.ndarray,
    noise_m_s: float,
) -> Finding | None:
    """Return a finding if the mean of a block is off; a braked wheel may be a little slower."""
    mean = float(offset[part].mean())
    mean_speed = float(base[part].mean())
    # a quarter of the samples counts as independent
    error = float(noise_m_s) / np.sqrt(max(part.sum() / 4.0, 1.0))

    least = max(limit.LEFT_M_S, limit.LEFT_SHARE * mean_speed)
    if abs(mean) <= least + limit.LEFT_DEVIATIONS * error:
        return None
    slowest_in_braking = -limit.SLIDE_M_S - limit.SLIDE_SHARE * mean_speed
    is_braked = change_m_s2[part].mean() < _BRAKED_M_S2
    if is_braked and slowest_in_braking < mean < 0.0:
        return None
    return _unknown(
        a,
        name,
        part,
        size=mean,
        low=float(mean - 2 * error),
        high=float(mean + 2 * error),
        details=SpeedOffset(faster=mean > 0),
    )


def _scatter_finding(
    a: Aligned, name: str, part: np.ndarray, scatter: float, usual: float
) -> Finding | None:
    """Return a finding if a speed scatters much more in a block than usual."""
    if scatter <= limit.ROUGH * usual or scatter <= limit.LEFT_M_S:
        return None
    return _unknown(
        a,
        name,
        part,
        size=scatter,
        low=0.8 * scatter,
        high=1.2 * scatter,
        details=SpeedScatter(times_usual=scatter / usual),
    )


def _unknown(
    a: Aligned,
    name: str,
    part: np.ndarray,
    *,
    size: float,
    low: float,
    high: float,
    details: Details,
) -> Finding:
    time_s = a.time_s[part]
    return Finding(
        name="unknown",
        channels=(name,),
        run=a.run.name,
        start_s=float(time_s[0]),
        end_s=float(time_s[-1]),
        size=size,
        low=low,
        high=high,
        unit="m/s",
        details=details,
    )


def _join_blocks(found: list[Finding]) -> list[Finding]:
    """Make one finding of successive blocks of a channel; its size is the larger one."""
    joined: list[Finding] = []
    for finding in found:
        if joined and _follows(finding, joined[-1]):
            before = joined[-1]
            larger = finding if abs(finding.size) > abs(before.size) else before
            joined[-1] = larger._replace(start_s=before.start_s, end_s=finding.end_s)
        else:
            joined.append(finding)
    return joined


def _follows(finding: Finding, before: Finding) -> bool:
    """Whether a block continues another one of the same kind: faster, slower or scattering."""
    return (
        finding.channels == before.channels
        and finding.run == before.run
        and finding.start_s - before.end_s < limit.BLOCK_S
        and _kind(finding) == _kind(before)
    )


def _kind(finding: Finding) -> tuple[str, bool]:
    if isinstance(finding.details, SpeedOffset):
        return "offset", finding.details.faster
    return "scatter", False
