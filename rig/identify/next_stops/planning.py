"""Proposes further stops: those that distinguish the causes which the data cannot distinguish.

Each possible stop is simulated from the fitted model, and the linearised response of the replay shows
what every candidate would add to its innovations there. The information of all stops adds up, and what
the base parameters could absorb is projected out [L1]. The value of a stop is the least separation
that it leaves between any two candidates [L2]. Stops are chosen one after another, each together with
those already chosen.

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

SPEEDS_M_S = (14.0, 24.0, 36.0, 50.0)  # initial speeds of stops with all wheelsets
PRESSURES_PA = (1.2e5, 3.8e5)  # a gentle and a full brake
LADEN = 1.25  # mass of a laden vehicle over that of the dataset
STEADY_M_S = (14.0, 38.0)  # initial speeds of stops with one wheelset
# Only rollers can hold a speed, which distinguishes friction by speed from friction by time.
HELD_M_S = (12.0, 35.0)
HELD_S = 30.0
MOST_RIVALS = 3
DISTINGUISHED = 15.0  # separation above which the data distinguish two causes
SEED = 3  # of the noise of simulated stops
Progress = Callable[[str, float], None]


class Table(NamedTuple):
    """The information of one set of stops: keys of base parameters and candidates, and a matrix."""

    keys: tuple[str, ...]
    A: np.ndarray  # (keys, keys)


class Proposal(NamedTuple):
    """A proposed stop, and what it adds."""

    stop: Stop
    pair: tuple[str, str]  # the causes that are hardest to distinguish after it
    before: float  # separation [L2] without the stop
    after: float

    @property
    def reason(self) -> str:
        """Why the stop is proposed, in words."""
        return (
            f"distinguishes {self.pair[0]} from {self.pair[1]}: separation {self.before:.3g} before, "
            f"{self.after:.3g} with it (the data distinguish causes above {DISTINGUISHED:g})"
        )


class FittedData(NamedTuple):
    """Data, its prepared runs, and the explanation that was fitted to them."""

    data: Dataset
    design: Design
    explanation: Explanation


class Library(NamedTuple):
    """The information of the data and of every possible stop about the candidates."""

    candidates: tuple[ScoreTest, ...]
    known: Table  # of the data
    stops: tuple[Stop, ...]
    tables: tuple[Table, ...]  # of the stops


def surviving(account: Diagnosis) -> tuple[ScoreTest, ...]:
    """Returns the causes that are identified or cannot be distinguished from an identified one.

    The most likely rivals are added to a single cause.
    """
    # a shape with values of single runs is unknown for a future stop
    causes = [
        finding
        for finding in account.score_tests
        if not is_smooth_function(finding.name)
        and not any(" " in key for key in finding.shape)
        and np.all(np.isfinite(finding.estimate))
    ]
    names: list[str] = []
    for identified in account.causes:
        names.append(identified.score_test.name)
        names += identified.confusable

    chosen = {finding.name: finding for finding in causes if finding.name in names}
    for finding in causes:
        if len(chosen) > max(1, len(names)) or len(chosen) > MOST_RIVALS:
            break
        chosen.setdefault(finding.name, finding)
    return tuple(chosen.values())


def possible(data: Dataset, candidates: Sequence[ScoreTest]) -> tuple[Stop, ...]:
    """Returns the stops that proposals are chosen from."""
    mass_kg = float(data.sections["vehicle"]["mass_kg"])
    full_Pa = PRESSURES_PA[-1]

    stops = []
    for speed_m_s in SPEEDS_M_S:
        for pressure_Pa in PRESSURES_PA:
            for stop_mass_kg in (mass_kg, LADEN * mass_kg):
                stops.append(Stop(speed_m_s, pressure_Pa, stop_mass_kg, axle=0))

    # with the brake on one wheelset: those of the candidates
    axles = sorted({finding.axle for finding in candidates if finding.axle}) or [1]
    for speed_m_s in STEADY_M_S:
        for axle in axles:
            stops.append(Stop(speed_m_s, full_Pa, mass_kg, axle))

    on_rollers = math.isfinite(data.sections["contact"]["roller_radius_m"])
    if on_rollers:
        for speed_m_s in HELD_M_S:
            stops.append(Stop(speed_m_s, full_Pa, mass_kg, axle=0, held_s=HELD_S))
    return tuple(stops)


def library(fitted: FittedData, candidates: Sequence[ScoreTest], progress: Progress) -> Library:
    """Returns the information of the data and of each possible stop; a stop takes a fifth of a second."""
    if not candidates:
        return Library((), Table((), np.zeros((0, 0))), (), ())
    # the base with all candidates at size 0, so that their shapes have columns
    explanation = fitted.explanation._replace(
        causes=tuple(
            Cause(finding.name, finding.axle, finding.shape, (0.0,) * len(finding.estimate))
            for finding in candidates
        )
    )
    normal, _, _ = fitting.normal_equations(fitted.design, explanation, False)
    known = _table(normal, candidates, "known")

    stops = []
    tables = []
    tried = possible(fitted.data, candidates)
    for k, stop in enumerate(tried):
        design, expected = _simulated(fitted, stop, explanation)
        normal, _, _ = fitting.normal_equations(design, expected, False)
        if np.all(np.isfinite(normal.A)):
            stops.append(stop)
            tables.append(_table(normal, candidates, f"stop {k}"))
        progress("possible stops", (k + 1) / len(tried))
    return Library(tuple(candidates), known, tuple(stops), tuple(tables))


def propose(lib: Library, count: int, among: Sequence[str] = ()) -> list[Proposal]:
    """Returns the best `count` stops, one after another, for all candidates or those `among` them."""
    names = [finding.name for finding in lib.candidates if not among or finding.name in among]
    have = [lib.known]
    remaining = list(range(len(lib.stops)))
    proposals: list[Proposal] = []
    while names and remaining and len(proposals) < count:
        before, _ = separation(have, names)
        separations = [separation([*have, lib.tables[k]], names) for k in remaining]
        best = int(np.argmax([value for value, _ in separations]))
        after, pair = separations[best]
        number = remaining.pop(best)
        proposals.append(Proposal(lib.stops[number], pair, before, after))
        have.append(lib.tables[number])
    return proposals


def separation(tables: Sequence[Table], names: Sequence[str]) -> tuple[float, tuple[str, str]]:
    """Returns the least separation [L2] of causes by some sets of stops, and the pair that has it."""
    S = _projected(tables, names)
    size = np.maximum(np.diag(S), 1e-12)
    if len(names) == 1:
        return float(size[0]), (names[0], "nothing")

    of_pairs = []
    for a, b in combinations(range(len(names)), 2):
        rho_squared = min(S[a, b] ** 2 / (size[a] * size[b]), 1.0)
        of_pairs.append((float(min(size[a], size[b]) * (1.0 - rho_squared)), (a, b)))
    least, (a, b) = min(of_pairs)
    return least, (names[a], names[b])


def _projected(tables: Sequence[Table], names: Sequence[str]) -> np.ndarray:
    """Returns S of [L1], shape (names, names)."""
    base = sorted({key for table in tables for key in table.keys if key.startswith(BASE)})
    keys = [*(f"cause {name}" for name in names), *base]
    place = {key: k for k, key in enumerate(keys)}
    A = np.zeros((len(keys), len(keys)))
    for table in tables:
        known = [k for k, key in enumerate(table.keys) if key in place]
        at = [place[table.keys[k]] for k in known]
        A[np.ix_(at, at)] += table.A[np.ix_(known, known)]

    # base parameters have different units: scale their part to a diagonal of 1
    n = len(names)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[n:], 1e-30))
    A_bb = A[n:, n:] * np.outer(scale, scale) + 1e-9 * np.eye(len(base))
    A_bc = scale[:, None] * A[n:, :n]
    return A[:n, :n] - A_bc.T @ np.linalg.solve(A_bb, A_bc)  # [L1]


def _table(normal: fitting.NormalEquations, candidates: Sequence[ScoreTest], name: str) -> Table:
    """Returns the information of a set of stops, with one key per base parameter and candidate.

    The column of a candidate is in units of its size. A base parameter of a single run gets the name of
    the set, so that it is not one with that of another set.
    """
    columns = normal.matrix.columns
    base = fitting.base_columns(normal.matrix)
    A = normal.A.copy()
    keys = []
    P = np.zeros((len(columns), len(base) + len(candidates)))
    for k, c in enumerate(base):
        label = columns[c].label
        of_run = label.startswith(("ln_mu_cd", "mass"))
        keys.append(f"{BASE} {label} {name if of_run else ''}")
        P[c, k] = 1.0
        if columns[c].prior > 0.0 and not of_run and name != "known":
            # the tolerance is one for all stops, so it counts once
            A[c, c] -= 1.0 / columns[c].prior ** 2
    for k, finding in enumerate(candidates):
        keys.append(f"cause {finding.name}")
        for c, size in _direction(normal, finding):
            P[c, len(base) + k] = size
    return Table(tuple(keys), P.T @ A @ P)


def _direction(normal: fitting.NormalEquations, finding: ScoreTest) -> list[tuple[int, float]]:
    """Returns (column, size) of each coefficient of a candidate."""
    variants = [
        variant
        for variant in normal.matrix.variants
        if variant.cause == finding.name and variant.axle == finding.axle
    ]
    same_shape = [variant for variant in variants if variant.shape == finding.shape]
    chosen = same_shape or variants
    if not chosen:
        return []
    columns = chosen[0].columns
    if len(columns) == len(finding.estimate):
        return list(zip(columns, finding.estimate, strict=True))
    # a cause once a turn has a phase in each run, and that of a new run is unknown
    amplitude = float(np.sqrt(2.0 * np.mean(np.square(finding.estimate))))
    return [(c, amplitude if k % 2 == 0 else 0.0) for k, c in enumerate(columns)]


def _simulated(
    fitted: FittedData, stop: Stop, explanation: Explanation
) -> tuple[Design, Explanation]:
    """Returns the design of a stop, simulated with the fitted base, and the explanation for it."""
    base = {
        label: value
        for label, value in explanation.base.items()
        if not label.startswith(("ln_mu_cd", "mass"))
    }
    base["ln_mu_cd_0"] = explanation.level
    expected = explanation._replace(base=base)
    rough = prototype.rough_run(fitted.data, fitted.design.base, stop, expected)
    rough_design = _with_noise_of(prepare(fitted.data, [rough]), fitted.design)
    simulated = simulate.runs(
        fitted.data, rough_design, [rough], expected, np.random.default_rng(SEED)
    )
    return _with_noise_of(prepare(fitted.data, simulated), fitted.design), expected


def _with_noise_of(design: Design, fitted: Design) -> Design:
    """Returns a design with the measurement noise of another one."""
    torque_noise_Nm = float(np.median(fitted.torque_noise_Nm))
    return design._replace(
        speed_noise_m_s=fitted.speed_noise_m_s,
        wheel_noise_rad_s=fitted.wheel_noise_rad_s,
        torque_noise_Nm=np.full(design.mass_kg.size, torque_noise_Nm),
    )


def sequence(proposal: Proposal, fitted: FittedData) -> dict[str, Any]:
    """Returns a proposal as plain data for a TOML file that `rollerrig sequence` runs."""
    return prototype.sequence(proposal.stop, proposal.reason, fitted.data, fitted.explanation)


def as_json(proposals: Sequence[Proposal], files: Sequence[str]) -> list[dict[str, Any]]:
    """Returns the entries of proposals in a report."""
    return [
        {
            "file": name,
            "title": proposal.stop.title,
            "reason": proposal.reason,
            **proposal.stop._asdict(),
            "parts": list(proposal.pair),
            "separation_before": proposal.before,
            "separation_after": proposal.after,
        }
        for proposal, name in zip(proposals, files, strict=True)
    ]
