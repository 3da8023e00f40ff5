"""Kdry_rst and Kwet_rst of a vehicle from its campaigns on dry and on wet rails.

The formulas are in `statistics.corrections`. The decelerations are those of `speed_steps`.
"""

import hashlib
import math
import shlex
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import EQUIPMENT_KEYS
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import (
    campaign,
    combined,
    design,
    large,
    outcome,
    speed_steps,
    stopping,
    train_stops,
)
from rollerrig.realtime.campaign.statistics import corrections, draws, quantiles, strata
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.realtime.train import plan as trains

NOT_A_CERTIFICATE = (
    "Not a certificate: these numbers show what this model did over the laws of its inputs. They "
    "are no proof of the brakes of a train, and no authority has checked them."
)
ASSUMPTIONS = (
    "The formulas and the levels of M_NVEBCL are from memory, to be checked against UNISIG "
    "SUBSET-026.",
    "Kdry_rst is a quantile of the ratio of the mean deceleration of a step to the nominal one. All "
    "variation of the brake is in the laws of the inputs of the campaign on dry rails, failures "
    "of equipment only if the plan has them.",
    "Kwet_rst is the ratio of the mean decelerations on wet and on dry rails, and at most 1. It has no "
    "confidence level.",
    "Levels that the runs do not reach are extrapolated by a generalised Pareto law. Its interval "
    "holds if the tail follows this law, which no sample can prove.",
    "The build-up of the brake force is left out of the decelerations; the brake model has a time for "
    "it.",
    "Every run that does not leave a step of speed before its end counts as a deceleration of 0.",
)
# of a stratified campaign, in the place of the assumption on extrapolation
_IN_STRATA = (
    "Stops are drawn in strata of exact probabilities, so no level is extrapolated. Estimates are "
    "unbiased probabilities of a weaker brake. Bounds assume that the strength of the brake, by its "
    "inputs, decides which stops with the same failures are the weakest."
)
_EXTRAPOLATED = ASSUMPTIONS[3]


class Step(NamedTuple):
    """The decelerations of one step in m/s2; runs that began below the step are left out.

    weakness: the order statistics of the negative decelerations.
    """

    weakness: draws.Draws | strata.Sample
    moments: draws.Moments

    @property
    def size(self) -> int:
        """The number of decelerations."""
        return self.weakness.size


class Sample(NamedTuple):
    """The decelerations of a campaign.

    folder: of its results.
    steps: of its plan.
    by_step: the decelerations of each step.
    build_up_s: the times of the build-up [V2]; None where they are not kept.
    isolates: equipment that its combination isolates.
    runs, left_out: all runs, and those that failed or are not valid and do not count.
    head: the top of the plan. sources: the laws of its inputs.
    digest: of all files of the results.
    """

    folder: Path
    steps: speed_steps.Steps
    by_step: list[Step]
    build_up_s: draws.Draws | strata.Sample | None
    isolates: tuple[str, ...]
    runs: int
    left_out: int
    head: dict[str, Any]
    sources: list[list[str]]
    digest: str


def sample(folder: Path) -> Sample:
    """Return the decelerations of a result folder. Raises ConfigError."""
    if not (folder / "plan.json").exists():
        raise ConfigError(
            f"{folder}: no result folder of a campaign; make one with 'rollerrig campaign etcs_dry "
            f"--out {shlex.quote(str(folder))}'"
        )
    content = user_files.read_json(folder / "plan.json", within=folder)
    given = content.get("etcs") if isinstance(content, dict) else None
    if given is None:
        raise ConfigError(
            f"{folder}: its plan has no table [etcs], so its runs have no decelerations by speed; add, "
            "for example, [etcs] speeds_km_h = [0, 40, 80, 120] to the plan and run it again"
        )
    steps = speed_steps.read(given, f"{folder / 'plan.json'} etcs")
    head = content.get("head", {})
    if head.get("design") not in design.SAMPLES:
        raise ConfigError(
            f"{folder}: a {head.get('design')} design is no sample of independent draws, and the "
            f'levels need one; set design = "{design.INDEPENDENT}" or "{design.STRATIFIED}" in the '
            "plan and run it again"
        )
    of_plan = strata.from_json(content.get("strata", []), str(folder / "plan.json"))
    is_large = large.is_in(folder)
    by_step, build_up_s, runs, left_out = (
        _of_large(folder, steps) if is_large else _of_rows(folder, steps, of_plan)
    )
    isolates = tuple((content.get("combination") or {}).get(combined.ISOLATES, ()))
    for name in isolates:
        if name not in EQUIPMENT_KEYS:
            raise ConfigError(f"{folder / 'plan.json'}: isolates {name!r}; repeat its campaign")
    if runs != content.get("runs"):
        raise ConfigError(
            f"{folder}: has {runs} of {content.get('runs')} runs; repeat its 'rollerrig campaign' to "
            "finish it"
        )
    return Sample(
        folder,
        steps,
        by_step,
        build_up_s,
        isolates,
        runs=runs,
        left_out=left_out,
        head=head,
        sources=content.get("sources", []),
        digest=_digest(folder),
    )


def _of_rows(
    folder: Path, steps: speed_steps.Steps, of_plan: tuple[strata.Stratum, ...]
) -> tuple[list[Step], draws.Draws | strata.Sample | None, int, int]:
    """Return the decelerations of each step, the times of the build-up, the number of runs, and of
    those left out.
    """
    table = campaign.result(folder)
    counts, _ = stopping.counted(table)
    by_step = []
    for column in steps.columns:
        values_m_s2 = table[column].to_numpy().astype(float)
        known = counts & np.isfinite(values_m_s2)
        weakness = outcome.sample(table, known, -values_m_s2[known], of_plan)
        if isinstance(weakness, strata.Sample):
            by_step.append(Step(weakness, _moments(weakness)))
        else:
            by_step.append(Step(weakness, draws.moments(values_m_s2[known])))
    build_up_s = None
    # an earlier version had no such column
    if speed_steps.BUILD_UP in table.column_names:
        times_s = table[speed_steps.BUILD_UP].to_numpy().astype(float)
        known = counts & np.isfinite(times_s)
        if known.any():
            build_up_s = outcome.sample(table, known, times_s[known], of_plan)
    return by_step, build_up_s, table.num_rows, int((~counts).sum())


def _moments(weakness: strata.Sample) -> draws.Moments:
    """Return moments of decelerations in strata with the variance of the mean that they have."""
    if not weakness.size:
        return draws.Moments()
    mean, variance = weakness.mean()
    number = weakness.size
    return draws.Moments(number, -mean, variance * number * (number - 1))


def _of_large(
    folder: Path, steps: speed_steps.Steps
) -> tuple[list[Step], draws.Draws | strata.Sample | None, int, int]:
    """Return the same of a campaign without rows of all runs."""
    kept = large.read((large.DISTANCE, *steps.columns), folder)
    whole = kept.whole
    by_step = [Step(kept.draws(column), whole.moments[column]) for column in steps.columns]
    return by_step, None, whole.runs, whole.runs - whole.counted


def _digest(folder: Path) -> str:
    """Return the SHA-256 of the files of a result, in their order."""
    found = hashlib.sha256()
    results = folder / "results"
    for path in sorted((*results.glob("part-*.parquet"), *results.glob("kept-*/*"))):
        found.update(user_files.read_bytes(path, user_files.PARQUET, within=folder))
    return found.hexdigest()


class Nominal(NamedTuple):
    """The stop without variation: the deceleration of each step in m/s2, and its build-up [V2].

    build_up_s: None if the plan gives the decelerations, or the stop has no such time.
    """

    by_step_m_s2: tuple[float, ...]
    build_up_s: float | None


def nominal(dry: Sample) -> Nominal:
    """Return the nominal deceleration of each step: of the plan, or of one run without variation.

    Raises ConfigError if that run does not have a step.
    """
    if dry.steps.nominal_m_s2:
        return Nominal(dry.steps.nominal_m_s2, None)
    unit = str(dry.head["unit"])
    if unit not in ("reference", "none"):
        raise ConfigError(
            f"{dry.folder}: unit = '{unit}' is code; give nominal_m_s2 in [etcs], one number per step"
        )
    settings = combined.isolating(dry.isolates)
    name = str(dry.head["scenario"])
    if train_stops.is_train(name):
        train = trains.load(name, settings=settings)
        channels = next(train_stops.each([("nominal", train)], unit)).channels
    else:
        resolved = scenario.load(name, "", settings)
        free.check(resolved)
        (finished,) = stops_in_lanes.together([("nominal", resolved)], unit)
        channels = finished.channels
    found = speed_steps.figures(channels, dry.steps)
    values = []
    for column, (low_km_h, high_km_h) in zip(dry.steps.columns, dry.steps.pairs_km_h, strict=True):
        value = found[column]
        if not value:
            raise ConfigError(
                f"{dry.head['scenario']}: its stop without variation has no deceleration from "
                f"{high_km_h:g} to {low_km_h:g} km/h; begin faster, or give nominal_m_s2 in [etcs]"
            )
        values.append(value)
    return Nominal(tuple(values), found[speed_steps.BUILD_UP])


def _build_up(dry: Sample, nominal_s: float | None, confidence: float) -> dict[str, Any] | None:
    """Return the nominal time of the build-up, and the time that each level exceeds.

    Only independent draws have a bound: the strata are ordered by strength, not by time.
    """
    times = dry.build_up_s
    if times is None or nominal_s is None:
        return None
    levels = []
    for level in corrections.LEVELS:
        share = corrections.failing_share(level)
        bound = None
        if isinstance(times, strata.Sample):
            estimate = times.quantile(share)
        else:
            found = quantiles.upper_bound(times, 1.0 - share, confidence)
            reached = math.isfinite(found.bound)
            estimate = found.estimate if reached else math.nan
            bound = _number(found.bound) if reached else None
        levels.append({"m_nvebcl": level, "estimate_s": _number(estimate), "bound_s": bound})
    return {"nominal_s": nominal_s, "levels": levels}


def table(
    dry: Sample, wet: Sample | None, available_adhesion: float, confidence: float = 0.95
) -> dict[str, Any]:
    """Return the correction factors as a table for programs and reports.

    `available_adhesion` is M_NVAVADH. None instead of a missing number. Raises ConfigError if the
    two campaigns have different steps, or a step has no run.
    """
    if wet is not None and wet.steps.speeds_km_h != dry.steps.speeds_km_h:
        raise ConfigError(
            f"{wet.folder}: has the steps {list(wet.steps.speeds_km_h)} km/h and {dry.folder} has "
            f"{list(dry.steps.speeds_km_h)}; give both plans the same speeds_km_h"
        )
    found_nominal = nominal(dry)
    nominal_m_s2 = found_nominal.by_step_m_s2
    rows = []
    for place, (low_km_h, high_km_h) in enumerate(dry.steps.pairs_km_h):
        of_dry = dry.by_step[place]
        if not of_dry.size:
            raise ConfigError(
                f"{dry.folder}: no run has a deceleration from {high_km_h:g} to {low_km_h:g} km/h; "
                "begin faster, or remove this step from speeds_km_h"
            )
        found = corrections.corrections(of_dry.weakness.divided(nominal_m_s2[place]), confidence)
        wet_ratio = None
        if wet is not None:
            wet_ratio = corrections.wet_ratio(
                wet.by_step[place].moments, of_dry.moments, confidence
            )
        rows.append(
            {
                "from_km_h": low_km_h,
                "to_km_h": high_km_h,
                "runs_dry": of_dry.size,
                "runs_wet": wet.by_step[place].size if wet is not None else 0,
                "nominal_m_s2": nominal_m_s2[place],
                "kdry_rst": [
                    _level(correction, nominal_m_s2[place], wet_ratio, available_adhesion)
                    for correction in found
                ],
                "kwet_rst": _wet(wet_ratio),
            }
        )
    assumptions = list(ASSUMPTIONS)
    if dry.head["design"] == design.STRATIFIED:
        assumptions[assumptions.index(_EXTRAPOLATED)] = _IN_STRATA
    return {
        "notice": NOT_A_CERTIFICATE,
        "assumptions": assumptions,
        "confidence": confidence,
        "m_nvavadh": available_adhesion,
        "dry": _origin(dry),
        "wet": _origin(wet) if wet is not None else None,
        "steps": rows,
        "build_up": _build_up(dry, found_nominal.build_up_s, confidence),
        "isolates": list(dry.isolates),
    }


def _level(
    found: corrections.Correction,
    nominal: float,
    wet_ratio: corrections.Ratio | None,
    available_adhesion: float,
) -> dict[str, Any]:
    """Return the numbers of one level; the safe deceleration uses the lower bound."""
    safe_m_s2 = None
    if wet_ratio is None or math.isfinite(wet_ratio.estimate):
        wet = min(wet_ratio.estimate, 1.0) if wet_ratio is not None else 1.0
        safe_m_s2 = _number(
            corrections.safe_deceleration(nominal, found.bound, wet, available_adhesion)
        )
    return {
        "m_nvebcl": found.level,
        "probability": 1.0 - corrections.failing_share(found.level),
        "estimate": _number(found.estimate),
        "low": _number(found.low),
        "high": _number(found.high),
        "bound": _number(found.bound),
        "probability_error": _number(found.error),
        "method": found.method,
        "reason": found.reason or None,
        "a_safe_m_s2": safe_m_s2,
    }


def _wet(ratio: corrections.Ratio | None) -> dict[str, Any] | None:
    """Return Kwet_rst, at most 1, and its interval."""
    if ratio is None:
        return None
    numbers = {key: _number(value) for key, value in ratio._asdict().items()}
    return {key: None if value is None else min(value, 1.0) for key, value in numbers.items()}


def _origin(found: Sample) -> dict[str, Any]:
    return {
        "folder": str(found.folder),
        "scenario": found.head.get("scenario"),
        "unit": found.head.get("unit"),
        "runs": found.runs,
        "left_out": found.left_out,
        "inputs": found.sources,
        "sha256_of_results": found.digest,
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
