"""The argument over a recording: faults, rolling, slides, places, then what is left beyond chance; and its telling."""

import time
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import faults, rolling, slides
from rollerrig.rig.identify.train_recorder import thresholds as limit
from rollerrig.rig.identify.train_recorder.recording import Finding, Recording
from rollerrig.rig.identify.train_recorder.rolling import Aligned
from rollerrig.rig.identify.train_recorder.slides import Slide

# what can be named, in the order of the report, and how a sentence says it
NAMES = {
    "wrong_unit": "wrong unit",
    "clock_step": "clock step",
    "old_messages": "old messages at the start",
    "copy": "copy",
    "interpolated": "gap filled by a straight line",
    "sensor_dropout": "drop-out",
    "sensor_stuck": "stuck sensor",
    "speed_sensor_delay": "delay",
    "wheel_radius": "another wheel radius",
    "wheel_radius_step": "step of a wheel radius",
    "slide": "slide",
    "slippery_place": "slippery place",
    "unknown": "unknown",
}
VERDICTS = {
    "consistent": "Nothing is wrong beyond chance.",
    "explained": "All that is beyond chance is named.",
    "partly": "Something is named, and something else is left that nothing here accounts for.",
    "unexplained": "Something is beyond chance that nothing here accounts for.",
}


class Account(NamedTuple):
    """What was found; `unknown` are findings that are described and not named."""

    recording: Recording
    aligned: list[Aligned]
    vehicle: list[np.ndarray]
    findings: list[Finding]
    slides: list[Slide]
    unknown: list[Finding]
    elapsed_s: float

    @property
    def verdict(self) -> str:
        if self.unknown:
            return "partly" if self.findings else "unexplained"
        return "explained" if self.findings else "consistent"


def explain(recording: Recording) -> Account:
    """All that a recording tells."""
    begun = time.perf_counter()
    runs, found = [], []
    for run in recording.runs:
        run, more = faults.find(run)
        runs.append(run)
        found += more
    runs, more = faults.copies(runs)
    found += more
    kept = [run for run in runs if any(np.isfinite(c.values).sum() > 50 for c in run.of("speed"))]
    aligned, more = rolling.fit(kept)
    found += more
    sliding, flags = slides.find(aligned)
    places = slides.places(aligned, sliding)
    unknown = [f for a, flag in zip(aligned, flags, strict=True) for f in _left(a, flag)]
    order = list(NAMES)
    found = sorted(
        [*found, *(s.finding for s in sliding), *places],
        key=lambda f: (order.index(f.name), f.run, f.channels, f.start_s),
    )
    return Account(
        recording,
        aligned,
        [slides.vehicle(a) for a in aligned],
        found,
        sliding,
        unknown,
        time.perf_counter() - begun,
    )


def _left(a: Aligned, sliding: np.ndarray) -> list[Finding]:
    """Blocks in which a speed is off, or rougher, than chance and braking wheels account for."""
    found = []
    noise = slides.scatter(a)
    reach = round(2.0 / a.step_s)
    alone = not np.isfinite(a.reference).any()
    # one speed alone tells nothing of itself, two only how they differ
    for j, name in enumerate(
        a.names if not alone else a.names[:-1] if len(a.names) < 3 else a.names
    ):
        v = a.speed[:, 1] if alone and len(a.names) == 2 else a.vehicle
        slows = np.nan_to_num(rolling.slope(a.time_s, v))
        near = np.convolve(sliding.any(axis=1), np.ones(2 * reach + 1), "same") > 0.0
        off = a.speed[:, j] - v
        good = np.isfinite(off) & (v > limit.SLOWEST_M_S) & ~near
        block = ((a.time_s - a.time_s[0]) // limit.BLOCK_S).astype(int)
        kept = [good & (block == k) for k in np.unique(block[good])]
        kept = [own for own in kept if own.sum() * a.step_s > 0.4 * limit.BLOCK_S]
        rough = np.array([float(np.std(np.diff(off[own]))) for own in kept])
        usual = max(float(np.median(rough)), 0.02) if rough.size else 0.02
        for own, scatter in zip(kept, rough, strict=True):
            mean, size = (
                float(off[own].mean()),
                max(limit.LEFT_M_S, limit.LEFT_SHARE * float(v[own].mean())),
            )
            error = float(noise[j]) / np.sqrt(max(own.sum() / 4.0, 1.0))
            braked = (
                slows[own].mean() < -0.1
                and -limit.SLIDE_M_S - limit.SLIDE_SHARE * v[own].mean() < mean < 0.0
            )
            t = a.time_s[own]
            if abs(mean) > size + limit.LEFT_DEVIATIONS * error and not braked:
                what = "faster" if mean > 0 else "slower"
                found.append(
                    Finding(
                        "unknown",
                        (name,),
                        a.run.name,
                        float(t[0]),
                        float(t[-1]),
                        mean,
                        mean - 2 * error,
                        mean + 2 * error,
                        "m/s",
                        f"{what} than the vehicle, which is not braked hard there",
                    )
                )
            elif scatter > limit.ROUGH * usual and scatter > limit.LEFT_M_S:
                found.append(
                    Finding(
                        "unknown",
                        (name,),
                        a.run.name,
                        float(t[0]),
                        float(t[-1]),
                        scatter,
                        0.8 * scatter,
                        1.2 * scatter,
                        "m/s",
                        f"scatters by {scatter:.2f} m/s from sample to sample, "
                        f"{scatter / usual:.0f} times as much as usual",
                    )
                )
    return _joined(found)


def _joined(found: list[Finding]) -> list[Finding]:
    out: list[Finding] = []
    for f in found:
        last = out[-1] if out else None
        if (
            last
            and last.channels == f.channels
            and last.run == f.run
            and f.start_s - last.end_s < limit.BLOCK_S
            and (last.text[:4] == f.text[:4])
        ):
            more = f if abs(f.size) > abs(last.size) else last
            out[-1] = more._replace(start_s=last.start_s, end_s=f.end_s)
        else:
            out.append(f)
    return out


def as_json(a: Account) -> dict[str, Any]:
    """What report.json holds: causes, episodes of sliding, and what is described but not named."""
    axles = {c.name: c.axle for run in a.recording.runs for c in run.channels.values() if c.axle}

    def plain(f: Finding) -> dict[str, Any]:
        of_run: dict[str, Any] = {"date": f.date} if f.date else {}
        of_run |= (
            {"run": f.run, "start_s": round(f.start_s, 3), "end_s": round(f.end_s, 3)}
            if f.run
            else {}
        )
        of_run |= {"place_m": list(f.place_m)} if f.place_m else {}
        return {
            "name": f.name,
            "axles": [axles[name] for name in f.channels if name in axles] or None,
            "channels": list(f.channels),
            **of_run,
            "text": f.text,
            "parameters": {"size": {"value": f.size, "ci95": [f.low, f.high], "unit": f.unit}},
        }

    def episode(s: Slide) -> dict[str, Any]:
        used, least = (max(x, 0.0) if np.isfinite(x) else None for x in s.adhesion[:2])
        return plain(s.finding) | {"adhesion_used": used, "adhesion_used_at_least": least}

    return {
        "verdict": a.verdict,
        "kind": "recorder",
        "dataset": a.recording.name,
        "runs": len(a.recording.runs),
        "causes": [plain(f) for f in a.findings if f.name != "slide"],
        "episodes": [episode(s) for s in a.slides],
        "unknown": [plain(f) for f in a.unknown],
        "notes": a.recording.warnings,
        "elapsed_s": round(a.elapsed_s, 1),
    }


def size(f: Finding) -> str:
    """Size with its interval and unit."""
    return f"{f.size:.3g} ({f.low:.3g} to {f.high:.3g}) {f.unit}"


def channels(a: Account, f: Finding) -> str:
    """The channels of a finding, in words."""
    speeds = {c.name for run in a.recording.runs for c in run.of("speed", "reference")}
    return (
        "all channels" if len(speeds) > 1 and speeds <= set(f.channels) else ", ".join(f.channels)
    )


def story(a: Account) -> list[str]:
    """A sentence each; of many of one kind the largest, and how many more there are."""
    lines = [VERDICTS[a.verdict]]
    for name in NAMES:
        mine = [f for f in (*a.findings, *a.unknown) if f.name == name]
        for k, f in enumerate(sorted(mine, key=lambda f: -abs(f.size))):
            where = f"in {f.run}, {f.start_s:.1f} to {f.end_s:.1f} s" if f.run else f.date
            place = " ".join(filter(None, (channels(a, f), where)))
            if k == 0:
                lines.append(f"{NAMES[name].capitalize()}: {place}: {size(f)}; {f.text}.")
            elif k < 4:
                lines.append(f"  also {place}: {size(f)}.")
        if len(mine) > 4:
            lines.append(f"  and {len(mine) - 4} more of that kind.")
    return lines + [f"Note: {note}." for note in a.recording.warnings]
