"""Proposes further stops: those that part the causes which the data at hand cannot tell apart.

Each possible stop is simulated from the fitted model, and the replay's linearised answer says what
every candidate would add to its innovations there. Information of all stops adds up; what the base
could take up is projected out [L1]. A stop is worth the least separation that it leaves between any
two candidates [L2], and stops are chosen one after another, each beside those already chosen.

    [L1] S = sum A_cc - A_cb A_bb^-1 A_bc over candidates c and base b, of columns times their size
    [L2] max over stops of min over pairs of min(S_aa, S_bb) (1 - rho^2), rho^2 = S_ab^2 / (S_aa S_bb)

Source: Atkinson and Donev, Optimum Experimental Designs (1992), chapter 20.
A stop with the brake on one wheelset only keeps its speed for long: sliding at a steady speed.
"""

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.causes.columns import BASE
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import fitting, simulate
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.decide.evidence import ScoreTest, is_smooth_function
from rollerrig.rig.identify.next_stops import prototype
from rollerrig.rig.identify.next_stops.prototype import Stop

SPEEDS_M_S = (14.0, 24.0, 36.0, 50.0)
PRESSURES_PA = (1.2e5, 3.8e5)
LADEN = 1.25
STEADY_M_S = (14.0, 38.0)
HELD_M_S, HELD_S = (
    (12.0, 35.0),
    30.0,
)  # only rollers hold a speed: what tells friction by speed from friction by time
MOST_RIVALS = 3
Progress = Callable[[str, float], None]


class Table(NamedTuple):
    """Information of one set of stops: keys of base and candidates, matrix (keys, keys)."""

    keys: tuple[str, ...]
    A: np.ndarray


class Proposal(NamedTuple):
    """A stop, the two causes that are hardest to part after it, and [L2] before and after it."""

    stop: Stop
    parts: tuple[str, str]
    before: float
    after: float

    @property
    def reason(self) -> str:
        """Why it is proposed."""
        return (
            f"parts {self.parts[0]} from {self.parts[1]}: separation {self.before:.3g} before, "
            f"{self.after:.3g} with it (above 15 they are told apart)"
        )


class Ground(NamedTuple):
    """What stops are planned on: data, its prepared runs, and the base that was fitted to them."""

    data: Dataset
    design: Design
    explanation: Explanation


class Library(NamedTuple):
    """What the data at hand and every possible stop tell of the candidates."""

    candidates: tuple[ScoreTest, ...]
    known: Table
    stops: tuple[Stop, ...]
    tables: tuple[Table, ...]


def surviving(account: Diagnosis) -> tuple[ScoreTest, ...]:
    """The causes that are named or may stand in their place; beside a single one its likeliest rivals."""
    # a shape of single runs is not known for a stop to come
    causes = [
        f
        for f in account.findings
        if not is_smooth_function(f.name)
        and not any(" " in key for key in f.shape)
        and np.all(np.isfinite(f.estimate))
    ]
    names = [name for n in account.causes for name in (n.finding.name, *n.confusable)]
    chosen = {f.name: f for f in causes if f.name in names}
    for f in causes:
        if len(chosen) > max(1, len(names)) or len(chosen) > MOST_RIVALS:
            break
        chosen.setdefault(f.name, f)
    return tuple(chosen.values())


def possible(data: Dataset, chosen: Sequence[ScoreTest]) -> tuple[Stop, ...]:
    """The stops among which is chosen."""
    mass_kg = float(data.sections["vehicle"]["mass_kg"])
    axles = sorted({f.axle for f in chosen if f.axle}) or [1]
    full = [
        Stop(v, p, m, 0)
        for v in SPEEDS_M_S
        for p in PRESSURES_PA
        for m in (mass_kg, LADEN * mass_kg)
    ]
    rollers = math.isfinite(data.sections["contact"]["roller_radius_m"])
    held = [Stop(v, PRESSURES_PA[-1], mass_kg, 0, HELD_S) for v in HELD_M_S if rollers]
    return tuple(
        full
        + [Stop(v, PRESSURES_PA[-1], mass_kg, axle) for v in STEADY_M_S for axle in axles]
        + held
    )


def library(on: Ground, chosen: Sequence[ScoreTest], progress: Progress) -> Library:
    """Information of the data at hand and of each possible stop; a fifth of a second a stop."""
    if not chosen:
        return Library((), Table((), np.zeros((0, 0))), (), ())
    # the base with all candidates at size 0, so that their shapes have columns
    explanation = on.explanation._replace(
        causes=tuple(Cause(f.name, f.axle, f.shape, (0.0,) * len(f.estimate)) for f in chosen)
    )
    known = _table(fitting.normal_equations(on.design, explanation, False)[0], chosen, "known")
    stops, kept, tables = possible(on.data, chosen), [], []
    for k, stop in enumerate(stops):
        design, expected = _simulated(on, stop, explanation)
        found = fitting.normal_equations(design, expected, False)[0]
        if np.all(np.isfinite(found.A)):
            kept.append(stop)
            tables.append(_table(found, chosen, f"stop {k}"))
        progress("possible stops", (k + 1) / len(stops))
    return Library(tuple(chosen), known, tuple(kept), tuple(tables))


def propose(lib: Library, count: int, among: Sequence[str] = ()) -> list[Proposal]:
    """The best `count` stops, one after another, for all candidates or those `among` them."""
    names = [f.name for f in lib.candidates if not among or f.name in among]
    have, left = [lib.known], list(range(len(lib.stops)))
    chosen: list[Proposal] = []
    while names and left and len(chosen) < count:
        before, _ = separation(have, names)
        worth = [separation([*have, lib.tables[k]], names) for k in left]
        at = int(np.argmax([w[0] for w in worth]))
        chosen.append(Proposal(lib.stops[left[at]], worth[at][1], before, worth[at][0]))
        have.append(lib.tables[left.pop(at)])
    return chosen


def separation(tables: Sequence[Table], names: Sequence[str]) -> tuple[float, tuple[str, str]]:
    """[L2] of some sets of stops together, and the pair that attains it."""
    S = _schur(tables, names)
    size = np.maximum(np.diag(S), 1e-12)
    if len(names) == 1:
        return float(size[0]), (names[0], "nothing")
    found = [
        (
            float(min(size[a], size[b]) * (1.0 - min(S[a, b] ** 2 / (size[a] * size[b]), 1.0))),
            (a, b),
        )
        for a, b in combinations(range(len(names)), 2)
    ]
    worst, (a, b) = min(found)
    return worst, (names[a], names[b])


def _schur(tables: Sequence[Table], names: Sequence[str]) -> np.ndarray:
    base = sorted({key for t in tables for key in t.keys if key.startswith(BASE)})
    keys = [*(f"cause {name}" for name in names), *base]
    place = {key: k for k, key in enumerate(keys)}
    A = np.zeros((len(keys), len(keys)))
    for t in tables:
        own = [k for k, key in enumerate(t.keys) if key in place]
        at = [place[t.keys[k]] for k in own]
        A[np.ix_(at, at)] += t.A[np.ix_(own, own)]
    n = len(names)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[n:], 1e-30))
    inner = A[n:, n:] * np.outer(scale, scale) + 1e-9 * np.eye(len(base))
    cross = scale[:, None] * A[n:, :n]
    return A[:n, :n] - cross.T @ np.linalg.solve(inner, cross)  # [L1]


def _table(normal: fitting.NormalEquations, chosen: Sequence[ScoreTest], name: str) -> Table:
    """One column for each candidate, times its size; base columns of single runs get the set's name."""
    columns, base = normal.matrix.columns, fitting.base_columns(normal.matrix)
    P = np.zeros((len(columns), len(base) + len(chosen)))
    A, keys = normal.A.copy(), []
    for k, c in enumerate(base):
        label = columns[c].label
        own = label.startswith(("ln_mu_cd", "mass"))
        keys.append(f"{BASE} {label} {name if own else ''}")
        P[c, k] = 1.0
        if columns[c].prior > 0.0 and not own and name != "known":
            A[c, c] -= 1.0 / columns[c].prior ** 2  # one tolerance for all stops counts once
    for k, f in enumerate(chosen):
        keys.append(f"cause {f.name}")
        for c, size in zip(*_direction(normal, f), strict=True):
            P[c, len(base) + k] = size
    return Table(tuple(keys), P.T @ A @ P)


def _direction(normal: fitting.NormalEquations, f: ScoreTest) -> tuple[list[int], list[float]]:
    fits = [v for v in normal.matrix.variants if v.cause == f.name and v.axle == f.axle]
    same = [v for v in fits if v.shape == f.shape] or fits
    if not same:
        return [], []
    at = list(same[0].columns)
    if len(at) == len(f.estimate):
        return at, list(f.estimate)
    # once a turn: one phase for each run, and of a new run none is known
    amplitude = float(np.sqrt(2.0 * np.mean(np.square(f.estimate))))
    return at, [amplitude if k % 2 == 0 else 0.0 for k in range(len(at))]


def _simulated(on: Ground, stop: Stop, explanation: Explanation) -> tuple[Design, Explanation]:
    """A stop as the fitted base would run it, prepared like a measured one."""
    base = {k: v for k, v in explanation.base.items() if not k.startswith(("ln_mu_cd", "mass"))}
    expected = explanation._replace(base=base | {"ln_mu_cd_0": explanation.level})
    rough = prototype.rough_run(on.data, on.design.base, stop, expected)
    design = _noisy(prepare(on.data, [rough]), on.design)
    made = simulate.runs(on.data, design, [rough], expected, np.random.default_rng(3))
    return _noisy(prepare(on.data, made), on.design), expected


def _noisy(design: Design, like: Design) -> Design:
    return design._replace(
        speed_noise_m_s=like.speed_noise_m_s,
        wheel_noise_rad_s=like.wheel_noise_rad_s,
        torque_noise_Nm=np.full(design.mass_kg.size, float(np.median(like.torque_noise_Nm))),
    )


def sequence(proposal: Proposal, on: Ground) -> dict[str, Any]:
    """A proposal as plain data that as TOML `rollerrig sequence` runs."""
    return prototype.sequence(proposal.stop, proposal.reason, on.data, on.explanation)


def as_json(proposals: Sequence[Proposal], files: Sequence[str]) -> list[dict[str, Any]]:
    """The report's entry."""
    return [
        {
            "file": name,
            "title": p.stop.title,
            "reason": p.reason,
            **p.stop._asdict(),
            "parts": list(p.parts),
            "separation_before": p.before,
            "separation_after": p.after,
        }
        for p, name in zip(proposals, files, strict=True)
    ]
