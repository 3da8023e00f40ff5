"""Explains a recording: faults, rolling wheels, slides, places, then what remains unexplained."""

import time
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from rollerrig.rig.identify.train_recorder import (
    clock_rate,
    judged,
    rolling,
    sampling,
)
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.alignment import Aligned, base_speed, slope
from rollerrig.rig.identify.train_recorder.faults import copies, removal
from rollerrig.rig.identify.train_recorder.findings import (
    NAMES,
    Details,
    Finding,
    ReferenceOff,
    SpeedDrop,
    SpeedOffset,
    SpeedScatter,
)
from rollerrig.rig.identify.train_recorder.judged import Check
from rollerrig.rig.identify.train_recorder.recording import Recording, Run
from rollerrig.rig.identify.train_recorder.rolling import Rolling
from rollerrig.rig.identify.train_recorder.sliding import driving, slides
from rollerrig.rig.identify.train_recorder.sliding.slides import Slide

# samples of a speed. A run in which no speed has more is left out after the checks of the sensors.
_LEAST_SAMPLES = 50

# s. A block of BLOCK_S, less a few samples at its ends.
_SHORTEST_SCATTER_S = 0.8 * limit.BLOCK_S

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
    checks: list[Check]  # what could be judged, by name of a finding
    elapsed_s: float

    @property
    def verdict(self) -> str:
        """One of consistent, explained, partly, unexplained, not_judged."""
        if self.unknown:
            return "partly" if self.findings else "unexplained"
        if self.findings:
            return "explained"
        # the file alone, as its stamps and gaps, does not make wheels consistent
        is_judged = any(check.judged for check in self.checks if check.name in judged.OF_MOTION)
        return "consistent" if is_judged else "not_judged"


def explain(recording: Recording) -> Account:
    """Return the explanation of a recording."""
    begun_s = time.perf_counter()
    found: list[Finding] = []

    runs = []
    for recorded in recording.runs:
        run, more = _without_faults(recorded)
        runs.append(run)
        found += more
    runs, more = copies.between_runs(runs)
    found += more

    fit = rolling.fit([run for run in runs if _has_speed(run)])
    aligned = fit.aligned
    found += fit.found

    all_slides, sliding_flags = slides.find(aligned)
    slips, slipping_flags = driving.find(aligned, sliding_flags)
    checks = judged.checks(runs, fit, sliding_flags)
    smallest_m_s = next(c.smallest for c in checks if c.name == "slide")
    all_slides = slides.at_least(all_slides, np.nan_to_num(smallest_m_s))
    found += [slide.finding for slide in all_slides]
    found += slides.places(aligned, all_slides)
    found += slips

    unknown = _rivals(fit)
    for a, sliding, slipping in zip(aligned, sliding_flags, slipping_flags, strict=True):
        off, is_off = _off_references(a)
        unknown += off + _short_drops(a, sliding)
        unknown += _unexplained_blocks(a, sliding | slipping | is_off[:, None])

    found.sort(key=lambda f: (NAMES.index(f.name), f.run, f.channels, f.start_s))
    return Account(
        recording=recording,
        aligned=aligned,
        vehicle=[slides.vehicle(a) for a in aligned],
        findings=found,
        slides=all_slides,
        unknown=unknown,
        checks=checks,
        elapsed_s=time.perf_counter() - begun_s,
    )


def _without_faults(recorded: Run) -> tuple[Run, list[Finding]]:
    """Return a run without the faults of its recorder, with one rate of all clocks; and the faults.

    A reference at another rate is compared with the wheels at wrong times. So the sensors are
    checked again after its stamps are corrected.
    """
    run, found = removal.without_faults(recorded)
    if not (run.of("speed") and run.of("reference")):
        return run, found
    rate = clock_rate.find(run)
    if rate is None:
        return run, found
    if run.logs_on_change:
        # its rows are filled already, by what all channels log together
        return clock_rate.corrected(run, rate.size), [*found, rate]
    run, found = removal.without_faults(clock_rate.corrected(recorded, rate.size))
    return run, [*found, rate]


def _rivals(fit: Rolling) -> list[Finding]:
    """Return the speeds with a difference that several causes explain, each of them once."""
    by_delays = {name for finding in fit.delays.unknown for name in finding.channels}
    by_scales = [f for f in fit.scales.unknown if not by_delays.intersection(f.channels)]
    return list(fit.delays.unknown) + by_scales


def _has_speed(run: Run) -> bool:
    """Whether any speed has enough samples."""
    return any(np.isfinite(channel.values).sum() > _LEAST_SAMPLES for channel in run.of("speed"))


def _off_references(a: Aligned) -> tuple[list[Finding], np.ndarray]:
    """Return where the reference differs from all wheels, which agree; and the flags (n,)."""
    is_off = np.zeros(a.time_s.size, bool)
    found = []
    for faster in (True, False):
        off = slides.where_reference_is_off(a, faster)
        is_off |= off
        difference = a.reference - sampling.median(a.speed.T)
        for first, last in slides.episodes(a, off):
            part = slice(first, last + 1)
            if a.time_s[last] - a.time_s[first] < limit.REFERENCE_OFF_S:
                continue
            finding = _unknown(
                a,
                a.run.of("reference")[0].name,
                np.flatnonzero(off[part]) + first,
                size=float(np.nanmedian(difference[part][off[part]])),
                low=float(np.nanmin(difference[part][off[part]])),
                high=float(np.nanmax(difference[part][off[part]])),
                details=ReferenceOff(len(a.names), faster),
            )
            found.append(finding)
    return found, is_off


def _short_drops(a: Aligned, sliding: np.ndarray) -> list[Finding]:
    """Return visible drops in braking that are no slides; `sliding` (n, m) are the slides."""
    found = []
    for drop in slides.short_drops(a, sliding):
        duration_s = float(a.time_s[drop.last] - a.time_s[drop.first]) + a.step_s
        finding = _unknown(
            a,
            drop.name,
            np.arange(drop.first, drop.last + 1),
            size=drop.depth_m_s,
            low=0.5 * drop.depth_m_s,
            high=1.5 * drop.depth_m_s,
            details=SpeedDrop(duration_s),
        )
        found.append(finding)
    return found


def _unexplained_blocks(a: Aligned, sliding: np.ndarray) -> list[Finding]:
    """Return blocks in which a speed is off or rough beyond chance and braking wheels."""
    noise = slides.scatter(a)
    near_slide = driving.near(a, np.any(sliding, axis=1))
    base, names = _comparison(a)
    half_s = max(1.0, 2.5 * a.step_s)
    change_m_s2 = np.nan_to_num(slope(a.time_s, base, half_s))
    difference = a.speed - base[:, None]

    found: list[Finding] = []
    for name in names:
        j = a.names.index(name)
        parts = _parts(a, difference[:, j], base, near_slide)
        means = np.array([float(difference[part, j].mean()) for part in parts])
        roughness = np.array([_roughness(difference[part, j]) for part in parts])
        is_rough = _is_rough(a, difference, name, names, parts, roughness)
        for k, part in enumerate(parts):
            usual = _usual_offset(means, k)
            is_off = _is_off(part, difference[:, j], base, change_m_s2, noise[j], usual, a)
            if is_off and not slides.is_mirrored(difference[part], j):
                error = noise[j] / np.sqrt(max(part.sum() / 4.0, 1.0))
                found.append(
                    _unknown(
                        a,
                        name,
                        part,
                        size=float(means[k]),
                        low=float(means[k] - 2 * error),
                        high=float(means[k] + 2 * error),
                        details=SpeedOffset(faster=bool(means[k] > 0.0)),
                    )
                )
            elif is_rough[k]:
                usual = max(float(np.median(roughness)), _LEAST_SCATTER_M_S)
                scatter = float(roughness[k])
                found.append(
                    _unknown(
                        a,
                        name,
                        part,
                        size=scatter,
                        low=0.8 * scatter,
                        high=1.2 * scatter,
                        details=SpeedScatter(times_usual=scatter / usual),
                    )
                )
    return [finding for finding in _join_blocks(found) if not _is_short_scatter(finding)]


def _is_short_scatter(finding: Finding) -> bool:
    """Whether a speed scatters for less than a block of BLOCK_S, as on one bump of the road."""
    is_scatter = isinstance(finding.details, SpeedScatter)
    return is_scatter and finding.end_s - finding.start_s < _SHORTEST_SCATTER_S


def _parts(
    a: Aligned, difference: np.ndarray, base: np.ndarray, near_slide: np.ndarray
) -> list[np.ndarray]:
    """Return the blocks in which a speed is compared with the vehicle, flags (n,) of each."""
    good = np.isfinite(difference) & (base > a.slowest_m_s) & ~near_slide
    block = a.blocks()
    parts = [good & (block == k) for k in np.unique(block[good])]
    return [part for part in parts if a.is_filled(part)]


def _roughness(difference: np.ndarray) -> float:
    """Return the scatter from sample to sample, m/s, without one bump of the road.

    A bump of one sample makes the two largest changes.
    """
    changes = np.diff(difference)
    if changes.size > 2:
        changes = changes[np.argsort(np.abs(changes))[:-2]]
    return float(np.std(changes)) if changes.size else np.nan


def _usual_offset(means: np.ndarray, k: int) -> float:
    """Return the offset that the scatter of the other block means reaches, m/s.

    Blocks next to the judged one are left out: a fault may last for several blocks. If few blocks
    are left, the largest offset of all other blocks counts; it is 0 if there is none.
    """
    others = np.concatenate([means[: max(k - 2, 0)], means[k + 3 :]])
    if others.size < limit.LEAST_BLOCKS:
        others = np.delete(means, k)
        return float(np.max(np.abs(others - np.median(others)))) if others.size else 0.0
    from_middle = np.abs(others - np.median(others))
    by_middle = limit.LEFT_SPREAD * 1.4826 * float(np.median(from_middle))
    return max(by_middle, limit.LEFT_TAIL * float(np.quantile(from_middle, 0.8)))


def _comparison(a: Aligned) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the speed to compare with, and the speeds that are compared with it.

    Without a reference a single speed shows nothing about itself, and two speeds only show how the
    first differs from the second.
    """
    base = base_speed(a)
    if base is None:
        return a.vehicle, ()
    if not a.has_reference and len(a.names) == 2:
        return base, a.names[:1]
    return base, a.names


def _is_off(
    part: np.ndarray,
    difference: np.ndarray,
    base: np.ndarray,
    change_m_s2: np.ndarray,
    noise_m_s: float,
    usual_m_s: float,
    a: Aligned,
) -> bool:
    """Whether the mean of a block is off; a braked wheel may be a little slower."""
    mean = float(difference[part].mean())
    mean_speed = float(base[part].mean())
    mean_change_m_s2 = float(change_m_s2[part].mean())
    # a quarter of the samples counts as independent
    error = float(noise_m_s) / np.sqrt(max(part.sum() / 4.0, 1.0))

    in_curves = 0.0
    if not np.isfinite(a.yaw_rad_s).any():
        # without a reference the difference of two wheels is judged
        wheels = 1.0 if a.has_reference else 2.0
        in_curves = wheels * float(limit.curve_share(np.array(mean_speed))) * mean_speed
    least = max(
        in_curves,
        limit.LEFT_M_S,
        limit.LEFT_SHARE * mean_speed,
        abs(mean_change_m_s2) * a.timing_s,
        usual_m_s,
    )
    if abs(mean) <= least + limit.LEFT_DEVIATIONS * error:
        return False
    creepage = limit.SLIDE_M_S + limit.SLIDE_SHARE * mean_speed
    is_braked = mean_change_m_s2 < _BRAKED_M_S2 and -creepage < mean < 0.0
    is_driven = mean_change_m_s2 > -_BRAKED_M_S2 and 0.0 < mean < creepage
    return not (is_braked or is_driven)


def _is_rough(
    a: Aligned,
    difference: np.ndarray,
    name: str,
    names: tuple[str, ...],
    parts: list[np.ndarray],
    roughness: np.ndarray,
) -> np.ndarray:
    """Return in which blocks a speed scatters much more than usual, flags (blocks,).

    If the other speeds scatter there, too, the road or the reference is rough and not this speed.
    With a single speed it cannot be decided which of the two is rough.
    """
    if len(parts) < limit.LEAST_BLOCKS or len(names) < 2:
        return np.zeros(len(parts), bool)
    usual = max(float(np.median(roughness)), _LEAST_SCATTER_M_S)
    # of this channel at other speeds and accelerations
    widest = float(np.quantile(roughness, 0.6))
    flags = []
    for part, scatter in zip(parts, roughness, strict=True):
        # few samples show their scatter badly: a third of them counts as independent
        freedom = max(part.sum() / 3.0, 1.0)
        by_chance = np.sqrt(chi2.ppf(1.0 - limit.ALPHA / len(parts), freedom) / freedom)
        others = [
            _roughness(difference[part, a.names.index(other)]) for other in names if other != name
        ]
        known = [other for other in others if np.isfinite(other)]
        is_alone = bool(known) and scatter > limit.ROUGH * float(np.median(known))
        least = max(limit.ROUGH * usual * by_chance, limit.ROUGH * widest, limit.LEFT_M_S)
        flags.append(bool(scatter > least and is_alone))
    return np.array(flags, bool)


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
