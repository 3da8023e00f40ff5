"""Explains a dataset: fit the base, judge every cause, fit those that count, check what is left.

The order is the argument: first the base gets its best chance; then clean sets of the same design
say what is ordinary; a cause is taken when it is beyond that, alone or beside those that cannot be
told from it; then the remainder is judged again in the same way, with the cause in the clean sets.
"""

import time
from typing import NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify import (
    candidates,
    clean,
    evidence,
    gain,
    preparation,
    sensitivity,
    shapes,
    tuning,
    unknown,
)
from rollerrig.rig.identify.candidates import Cause, Explanation
from rollerrig.rig.identify.dataset import Dataset, Run
from rollerrig.rig.identify.evidence import Finding
from rollerrig.rig.identify.gain import Gain
from rollerrig.rig.identify.preparation import Design
from rollerrig.rig.identify.unknown import Formula

CLEAN_SETS, CHECK_SETS = 60, 40
MOST_PROMISING, MOST_FITTED, MOST_BESIDE, MOST_CAUSES = 4, 5, 3, 2
# likelihood that a cause must win at least
TAKEN = 20.0
# a remainder above this share of the causes' likelihood is not a matter of their shape, unless it
# lies along what the cause itself goes by: there its shape may differ more
REMAINDER_SHARE, OWN_REMAINDER_SHARE = 0.08, 0.2
GOES_BY = {
    "rail_cleaning": ("axle", "load"), "speed_dependent_friction": ("speed",), "friction_trend": ("time",),
    "falling_friction": ("sliding",), "running_resistance": ("vehicle speed",), "pad_fade": ("disc_heat",),
    "adhesion_memory": ("energy",)}
# share of the evidence that must lie outside its best block
ELSEWHERE = 0.2
# a second cause below this share of the first is taken for the first one's shape
SECOND_SHARE, SECOND_FLOOR = 0.11, 20.0
# one of a single wheelset is no matter of the shape of a first one of all
SECOND_SHARE_OF_AXLE = 0.05
# likelihood beyond what a clean set can win
CERTAIN = 300.0
# its score, before it is fitted, may be this share of that
SCORE_SHARE = 0.3
# a second cause that could be taken for the first must have this share of its likelihood
OWN_SHARE = 0.3
# likelihood that each further coefficient of a shape must earn, beside that of the choice of shape
PRICE = 5.0
EXTRA = {"sanding": 6, "contaminated_patch": 2, "wheel_out_of_round": 2, "load_transfer": 1,
         "rail_cleaning": 0, "negative_conditioning": 1}
BLOCK_S = 3.0
EVENTS = ("sanding", "contaminated_patch")


class Named(NamedTuple):
    """A cause that is taken: its finding, its share of the likelihood, what it is confused with."""

    finding: Finding
    cause: Cause
    ratio: float
    deviation: tuple[float, ...]
    confusable: tuple[str, ...]


class Account(NamedTuple):
    """All that was found about braking runs."""

    data: Dataset
    design: Design
    held: Design | None
    base: Explanation
    final: Explanation
    verdict: str
    causes: list[Named]
    findings: list[Finding]
    remainder: list[Finding]
    gain: Gain | None
    p_value: float
    notes: list[str]
    unknown: Formula | None
    elapsed_s: float


class _Fit(NamedTuple):
    data: Dataset
    measured: list[Run]
    told: Explanation


class _Fitted(NamedTuple):
    told: Explanation
    value: float
    covariance: np.ndarray
    blocks: np.ndarray


class _Rival(NamedTuple):
    finding: Finding
    fit: _Fitted


def braking_runs(data: Dataset, seed: int, progress: clean.Progress) -> Account:
    """The account of a set of braking runs. Raises ConfigError where nothing can be concluded."""
    from threadpoolctl import threadpool_limits

    began = time.monotonic()
    with threadpool_limits(1), clean.workers() as pool:
        measured = data.group("tune")
        design = preparation.prepare(data, measured)
        progress("fit of the base", 0.0)
        base, value, _ = tuning.fit(design, candidates.start(design))
        progress("fit of the base", 1.0)
        _check(design, base)
        quiet, promising = _quiet(pool, data, measured, design, base, progress)
        nulls = clean.sets(pool, data, measured, quiet, CLEAN_SETS, seed, (), progress)
        _enough(nulls)
        scored = tuning.normal(design, quiet)[0]
        found = evidence.findings(design, scored, nulls)
        rivals = _fitted(pool, data, measured, base, found, MOST_FITTED, progress)
        rivals = [_better(rival, promising, scored, nulls) for rival in rivals]
        rivals += _certain(value, promising, rivals, scored, nulls)
        told, causes = _scaled(design, *_choose(design, base, value, rivals))
        remainder: list[Finding] = [f for f in found if evidence.generic(f.name)]
        if causes:
            told, causes, remainder = _second(pool, data, measured, design, told, causes, rivals,
                                              seed, progress)
        held_runs = data.group("validate")
        held = preparation.prepare(data, held_runs) if held_runs else None
        notes: list[str] = list(data.warnings)
        won = _gain(held, base, told, causes, seed, notes)
        verdict = _verdict(causes, remainder, won, notes)
        formula = None
        if verdict != "explained":
            causes, told, won = [], base, None
        if verdict == "unexplained":
            progress("formula", 0.0)
            formula = unknown.find(design, held, quiet, [f for f in found if evidence.generic(f.name)],
                                   seed)
            progress("formula", 1.0)
        if formula is not None:
            told, won = formula.told, formula.gain
    p_value = min([f.p_value for f in found], default=1.0)
    return Account(data, design, held, base, told, verdict, causes, found, remainder, won,
                   float(1.0 - (1.0 - p_value) ** 30), notes, formula, time.monotonic() - began)


def _quiet(pool: clean.Pool, data: Dataset, measured: list[Run], design: Design,
           base: Explanation, progress: clean.Progress) -> tuple[Explanation, list[_Fitted]]:
    """The base with the irregularity that is left beside the most promising causes, and their fits.

    A cause that the base does not have looks like a rougher rail, and would hide in it.
    """
    likely = evidence.likely(design, tuning.normal(design, base)[0], MOST_PROMISING)
    tasks = [_Fit(data, measured, base._replace(causes=(cause,))) for cause in likely]
    fits: list[_Fitted] = clean.run_all(pool, fit_one, tasks, "irregularity of the rail", progress)
    best = min(fits, key=lambda fit: fit.value, default=None)
    if best is None or best.told.sigma >= base.sigma:
        return base, fits
    calm = base._replace(sigma=best.told.sigma, length_m=best.told.length_m)
    return tuning.fit(design, calm, 4, False)[0], fits


def _check(design: Design, base: Explanation) -> None:
    nu, S, *_ = sensitivity.innovations(design, candidates.inputs(design, base))
    spread = float(np.median(nu * nu / S) / 0.455)
    if spread > 2.5 or spread < 0.3:
        raise ConfigError(
            f"the innovations have {spread:.2g} times the variance that the declared accuracy "
            "allows (1 is right, 0.3 to 2.5 is accepted): correct [accuracy] in dataset.toml, or "
            "leave its values out to have them estimated")


def _enough(nulls: list[evidence.Scores]) -> None:
    if len(nulls) < CLEAN_SETS // 2:
        raise ConfigError(f"only {len(nulls)} of {CLEAN_SETS} simulated clean sets could be "
                          "replayed: the fitted base model does not brake like the recording; check "
                          "vehicle, loads and torques in dataset.toml")


def fit_one(task: _Fit) -> _Fitted:
    """Fit one explanation; its deviance by blocks of 3 s."""
    design = preparation.prepare(task.data, task.measured)
    told, value, covariance = tuning.fit(design, task.told, 6)
    if any(cause.name == tuning.MEMORY for cause in told.causes):
        told, value, covariance = min(
            (told, value, covariance), tuning.fit(design, shapes.remembered(design, told), 7),
            key=lambda fit: fit[1])
    if any(cause.name in EVENTS for cause in told.causes):
        told, value, covariance = tuning.fit(design, shapes.refined(design, told), 4)
    return _Fitted(told, value, covariance, blocks(design, told))


def blocks(design: Design, told: Explanation) -> np.ndarray:
    """Deviance in blocks of 3 s, wheels and vehicle of a run together."""
    nu, S, _, vnu, vS = sensitivity.innovations(design, candidates.inputs(design, told))
    wheel, car = np.minimum(nu * nu / S, 36.0) + np.log(S), np.minimum(vnu**2 / vS, 36.0) + np.log(vS)
    length, found = int(BLOCK_S / design.step_s), []
    for run in range(design.mass_kg.size):
        parts = [wheel[design.span(4 * run + j)] for j in range(4)]
        parts.append(car[int(design.vehicle_start[run]):int(design.vehicle_start[run + 1])])
        whole = np.sum(parts, axis=0)
        found += [whole[k:k + length].sum() for k in range(0, whole.size, length)]
    return np.array(found)


def _fitted(pool: clean.Pool, data: Dataset, measured: list[Run], told: Explanation,
            found: list[Finding], most: int, progress: clean.Progress) -> list[_Rival]:
    """The causes that count beside an explanation, each fitted."""
    present = {cause.name for cause in told.causes}
    counted = [f for f in found if not evidence.generic(f.name) and evidence.significant(f)
               and f.name not in present]
    counted = sorted(counted, key=lambda f: -f.statistic)[:most]
    tasks = [_Fit(data, measured, told._replace(causes=(*told.causes, f.cause()))) for f in counted]
    fits = clean.run_all(pool, fit_one, tasks, "fit of causes", progress)
    return [_Rival(f, fit) for f, fit in zip(counted, fits, strict=True)]


def _better(rival: _Rival, others: list[_Fitted], scored: tuning.Normal,
            nulls: list[evidence.Scores]) -> _Rival:
    """The same cause in another shape, where that was fitted already and is the better one."""
    for fit in others:
        cause = fit.told.causes[-1]
        if cause.name == rival.finding.name and fit.value < rival.fit.value - 4.0:
            finding = evidence.finding_of(scored, nulls, cause)
            if finding is not None:
                return _Rival(finding._replace(trials=rival.finding.trials), fit)
    return rival


def _certain(value: float, fits: list[_Fitted], rivals: list[_Rival], scored: tuning.Normal,
             nulls: list[evidence.Scores]) -> list[_Rival]:
    """Causes whose fit wins so much that no score is asked: far from the base, scores say little."""
    known = {rival.finding.name for rival in rivals}
    found = [(evidence.finding_of(scored, nulls, fit.told.causes[-1]), fit) for fit in fits
             if fit.told.causes[-1].name not in known and value - fit.value > CERTAIN]
    return [_Rival(finding, fit) for finding, fit in found if finding is not None]


def _choose(design: Design, told: Explanation, value: float, rivals: list[_Rival]
            ) -> tuple[Explanation, list[Named]]:
    """The best further cause, with those that cannot be told from it."""
    if not rivals:
        return told, []
    ratio = [value - fit.value - max(f.expected - len(f.estimate), 0.0) - _price(f)
             for f, fit in rivals]
    order = np.argsort(ratio)[::-1]
    top = int(order[0])
    if ratio[top] < TAKEN:
        return told, []
    finding, best = rivals[top]
    drop = blocks(design, told) - best.blocks
    # what tolerances had taken up stands in no block; the rest must not be one place of one run
    whole = max(float(drop.sum()), ratio[top])
    if finding.name not in EVENTS and whole - drop.max() < max(evidence.FLOOR, ELSEWHERE * whole):
        return told, []
    confusable = tuple(rivals[int(k)].finding.name for k in order[1:]
                       if _alike(best, rivals[int(k)].fit, ratio[top], ratio[int(k)]))
    at = len(best.covariance) - len(best.told.causes[-1].values)
    named = Named(finding, best.told.causes[-1], float(ratio[top]), _deviation(finding, best, at),
                  confusable)
    return best.told, [named]


def _scaled(design: Design, told: Explanation, causes: list[Named]
            ) -> tuple[Explanation, list[Named]]:
    """The causes with their scales off the grid of the search, fitted again."""
    better = shapes.scaled(design, told)
    if better == told:
        return told, causes
    fit = _Fitted(*tuning.fit(design, better, 4), np.zeros(0))
    found, at = [], 0
    for named, cause in zip(causes, fit.told.causes, strict=True):
        found.append(named._replace(cause=cause, deviation=_deviation(named.finding, fit, at)))
        at += len(cause.values)
    return fit.told, found


def _price(finding: Finding) -> float:
    return PRICE * EXTRA.get(finding.name, 0) + 2.0 * float(np.log(finding.trials))


def _deviation(finding: Finding, fit: _Fitted, at: int) -> tuple[float, ...]:
    """Deviations of a cause's coefficients, which stand from place `at` on in the covariance."""
    nominal = np.sqrt(np.diag(fit.covariance)[at:at + len(finding.estimate)])
    floor = evidence.SYSTEMATIC.get(finding.name, 0.0)
    return tuple(float(np.hypot(s * max(finding.spread, 1.0), floor)) for s in nominal)


def _alike(best: _Fitted, other: _Fitted, ratio: float, less: float) -> bool:
    """Vuong's test on blocks: may the other be the better one?"""
    if less < 0.75 * ratio and ratio - less > 10.0:
        return False
    difference = other.blocks - best.blocks
    spread = float(difference.std(ddof=1) * np.sqrt(difference.size))
    return ratio - less < 1.64 * max(spread, 1e-9) or ratio - less < 4.0


def _second(pool: clean.Pool, data: Dataset, measured: list[Run], design: Design, told: Explanation,
            causes: list[Named], rivals: list[_Rival], seed: int, progress: clean.Progress
            ) -> tuple[Explanation, list[Named], list[Finding]]:
    """Further causes beside the first, and the remainder behind all of them."""
    remainder: list[Finding] = []
    for turn in range(MOST_CAUSES):
        known = tuple(named.finding.name for named in causes)
        nulls = clean.sets(pool, data, measured, told, CHECK_SETS, seed + 7 + turn, known, progress)
        if len(nulls) < CHECK_SETS // 2:
            break
        value = tuning.deviance(design, told)
        found = evidence.findings(design, tuning.normal(design, told)[0], nulls, known)
        remainder = [f for f in found if evidence.generic(f.name)]
        floor = max(SECOND_FLOOR, SECOND_SHARE * causes[0].ratio)
        found = [f for f in found if f.statistic > SCORE_SHARE * floor]
        if len(causes) >= MOST_CAUSES:
            break
        beside = _fitted(pool, data, measured, told, found, MOST_BESIDE, progress)
        better, more = _choose(design, told, value, beside)
        first = causes[0]
        if more and more[0].cause.axle and not first.cause.axle:
            floor = max(SECOND_FLOOR, SECOND_SHARE_OF_AXLE * first.ratio)
        if not more or more[0].ratio < floor:
            break
        if not _both_needed(data, measured, better, value):
            break
        better, both = _swapped(pool, data, measured, design, better,
                                [first._replace(cause=better.causes[0]), more[0]], rivals, progress)
        if more[0].finding.name in first.confusable and \
                value - tuning.deviance(design, better) < OWN_SHARE * first.ratio:
            break
        told, causes = _scaled(design, better, both)
        names = {named.finding.name for named in causes}
        causes = [named._replace(confusable=tuple(n for n in named.confusable if n not in names))
                  for named in causes]
    return told, causes, remainder


def _swapped(pool: clean.Pool, data: Dataset, measured: list[Run], design: Design,
             told: Explanation, causes: list[Named], rivals: list[_Rival],
             progress: clean.Progress) -> tuple[Explanation, list[Named]]:
    """The first cause looked for again beside the second: one that had to stand for both gives way."""
    names = {named.finding.name for named in causes}
    others = [rival for rival in rivals if rival.finding.name not in names]
    tasks = [_Fit(data, measured, told._replace(causes=(rival.fit.told.causes[-1], told.causes[1])))
             for rival in others]
    fits: list[_Fitted] = clean.run_all(pool, fit_one, tasks, "first cause again", progress)
    value = tuning.deviance(design, told) + _price(causes[0].finding)
    won = [value - fit.value - _price(rival.finding) for rival, fit in zip(others, fits, strict=True)]
    if not won or max(won) < 4.0:
        return told, causes
    top = int(np.argmax(won))
    finding, better = others[top].finding, fits[top].told
    first = Named(finding, better.causes[0], causes[0].ratio + won[top],
                  _deviation(finding, fits[top], 0), ())
    return better, [first, causes[1]._replace(cause=better.causes[1])]


def _both_needed(data: Dataset, measured: list[Run], told: Explanation, value: float) -> bool:
    """Whether the first cause still earns its likelihood beside the second."""
    both = fit_one(_Fit(data, measured, told))
    alone = fit_one(_Fit(data, measured, told._replace(causes=told.causes[1:])))
    return alone.value - both.value > max(SECOND_FLOOR, SECOND_SHARE * (value - both.value))


def _gain(held: Design | None, base: Explanation, told: Explanation, causes: list[Named], seed: int,
          notes: list[str]) -> Gain | None:
    if held is None or not causes:
        return None
    if any(named.finding.name == "sanding" for named in causes):
        notes.append("the moments of sanding are not known for the runs that were not fitted: the "
                     "gain cannot be judged there")
        return None
    if any(named.finding.name == "wheel_out_of_round" for named in causes):
        notes.append("the angle of an out-of-round wheel at the start is not known for the runs that "
                     "were not fitted: the gain cannot be judged there")
        return None
    return gain.measure(held, base, told, seed)


def _verdict(causes: list[Named], remainder: list[Finding], won: Gain | None,
             notes: list[str]) -> str:
    """consistent, explained or unexplained; a small remainder becomes a note."""
    left = [f for f in remainder if evidence.significant(f, 20.0)]
    if not causes:
        return "unexplained" if left else "consistent"
    if won is not None and won.likelihood < 0.0:
        notes.append(f"{causes[0].finding.name} would fit the tuning runs but makes runs that were "
                     "not fitted worse: not named")
        return "unexplained"
    total = sum(named.ratio for named in causes)
    own = {f"along {name}" for named in causes for name in GOES_BY.get(named.finding.name, ())}
    much = [f for f in left
            if f.statistic > total * (OWN_REMAINDER_SHARE if f.name in own else REMAINDER_SHARE)]
    if much:
        notes.append(f"behind {causes[0].finding.name} much remains along "
                     f"{evidence.against(much[0])}: the cause is not in the library")
        return "unexplained"
    if left:
        notes.append(f"a small part remains along {evidence.against(left[0])}")
    return "explained"
