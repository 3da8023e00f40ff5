"""Proposes further stops: those that distinguish the causes which the data cannot distinguish.

Each possible stop is simulated from the fitted model. The linearised replay of that stop shows what
every candidate cause would add to its innovations. The information of several stops is the sum of
their information. What the base parameters could absorb is then projected out [L1]. The value of a
stop is the least separation that it leaves between any two candidates [L2]. Stops are chosen one
after another, each together with the data and the stops chosen before it.

    [L1] S = sum A_cc - A_cb A_bb^-1 A_bc over candidates c and base b, of columns times their size
    [L2] max over stops of min over pairs of min(S_aa, S_bb) (1 - rho^2),
         rho^2 = S_ab^2 / (S_aa S_bb)

Source: Atkinson and Donev, Optimum Experimental Designs (1992), chapter 20.
A stop with the brake on only one wheelset keeps its speed for long: it shows sliding at a steady
speed.
"""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import wheelsets_of
from rollerrig.rig.identify.causes import discrepancy, simulate
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.causes.columns import BASE, Variant
from rollerrig.rig.identify.data.preparation import Design, prepare
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.decide.evidence import ScoreTest, is_smooth_function
from rollerrig.rig.identify.next_stops import prototype
from rollerrig.rig.identify.next_stops.prototype import Stop

# --- the possible stops ---

# initial speeds of stops with the brake on all wheelsets
SPEEDS_M_S = (14.0, 24.0, 36.0, 50.0)
# pressures of a gentle and of a full brake
PRESSURES_PA = (1.2e5, 3.8e5)
# mass of a laden vehicle over that of the dataset
LADEN = 1.25
# initial speeds of stops with the brake on one wheelset
STEADY_M_S = (14.0, 38.0)
# Speeds that the drives of the rollers hold, and for how long. Only rollers can hold a speed. A
# held speed distinguishes friction that depends on speed from friction that depends on time.
HELD_M_S = (12.0, 35.0)
HELD_S = 30.0

# --- the choice among them ---

# the most likely other causes are added to a single identified one, until there are more than this
MOST_RIVALS = 3
# separation [L2] above which the data distinguish two causes
DISTINGUISHED = 15.0
# seed of the noise of the simulated stops
SEED = 3

# base parameters that each run has for itself, by the beginnings of their labels
_LABELS_OF_RUNS = ("ln_mu_cd", "mass", discrepancy.BRAKE)

# least values that are divided by: of a separation, and of the information of a base parameter
_LEAST_SEPARATION = 1e-12
_LEAST_INFORMATION = 1e-30
# added to the scaled information of the base, so that it can be inverted
_REGULARISATION = 1e-9

Progress = Callable[[str, float], None]


class Information(NamedTuple):
    """The information of some runs about base parameters and candidates.

    The key of a candidate is "cause NAME", that of a base parameter begins with `BASE`. Runs share
    a parameter if they share its key.
    """

    keys: tuple[str, ...]
    matrix: np.ndarray  # (keys, keys)


class Separation(NamedTuple):
    """The least separation [L2] of any two causes, and the names of these two."""

    value: float
    pair: tuple[str, str]


class Proposal(NamedTuple):
    """A proposed stop, and what it adds."""

    stop: Stop
    pair: tuple[str, str]  # the causes that are hardest to distinguish after it
    before: float  # separation [L2] without the stop
    after: float  # the same with the stop


class FittedData(NamedTuple):
    """Data, its prepared runs, and the explanation that was fitted to them."""

    data: Dataset
    design: Design
    explanation: Explanation


class Library(NamedTuple):
    """The information of the data and of every possible stop about the candidates."""

    candidates: tuple[ScoreTest, ...]
    of_data: Information
    stops: tuple[Stop, ...]
    of_stops: tuple[Information, ...]  # one for each stop


# --- candidates and possible stops ---


def surviving(diagnosis: Diagnosis) -> tuple[ScoreTest, ...]:
    """Return the causes that are identified or cannot be distinguished from an identified one.

    The most likely other causes are added if these are too few.
    """
    tests = [test for test in diagnosis.score_tests if _can_be_predicted(test)]

    names: list[str] = []
    for identified in diagnosis.causes:
        names.append(identified.score_test.name)
        names += identified.confusable
    chosen = {test.name: test for test in tests if test.name in names}

    # the score tests are sorted: the most significant comes first
    for test in tests:
        if len(chosen) > max(1, len(names)) or len(chosen) > MOST_RIVALS:
            break
        chosen.setdefault(test.name, test)
    return tuple(chosen.values())


def _can_be_predicted(test: ScoreTest) -> bool:
    """Return whether the effect of a cause on a stop that has not been run is known."""
    if is_smooth_function(test.name):
        return False
    # a key with a space ("start_s RUN") holds the value of a single run, unknown for a future stop
    if any(" " in key for key in test.shape):
        return False
    return bool(np.all(np.isfinite(test.estimate)))


def possible(data: Dataset, candidates: Sequence[ScoreTest]) -> tuple[Stop, ...]:
    """Return the stops that proposals are chosen from."""
    mass_kg = float(data.sections["vehicle"]["mass_kg"])
    full_Pa = PRESSURES_PA[-1]

    stops = []
    for speed_m_s in SPEEDS_M_S:
        for pressure_Pa in PRESSURES_PA:
            for stop_mass_kg in (mass_kg, LADEN * mass_kg):
                stops.append(Stop(speed_m_s, pressure_Pa, stop_mass_kg, axle=0))

    # the brake on one wheelset: on each one on which a candidate acts
    # (of a bogie: its first wheelset)
    axles = sorted({wheelsets_of(test.axle, data.axles)[0] for test in candidates if test.axle})
    if not axles:
        axles = [1]
    for speed_m_s in STEADY_M_S:
        for axle in axles:
            stops.append(Stop(speed_m_s, full_Pa, mass_kg, axle))

    if prototype.is_on_rollers(data):
        for speed_m_s in HELD_M_S:
            stops.append(Stop(speed_m_s, full_Pa, mass_kg, axle=0, held_s=HELD_S))
    return tuple(stops)


# --- the information of data and stops ---


def library(fitted: FittedData, candidates: Sequence[ScoreTest], progress: Progress) -> Library:
    """Return the information of the data and of each possible stop about the candidates.

    Each stop takes about a fifth of a second. A stop is left out if its information is not finite.
    """
    if not candidates:
        nothing = Information((), np.zeros((0, 0)))
        return Library(candidates=(), of_data=nothing, stops=(), of_stops=())

    # all candidates are in the explanation with size 0, so that their shapes have columns
    causes = []
    for test in candidates:
        zeros = (0.0,) * len(test.estimate)
        causes.append(Cause(test.name, test.axle, test.shape, zeros))
    explanation = fitted.explanation._replace(causes=tuple(causes))

    normal, _, _ = fitting.normal_equations(fitted.design, explanation, search=False)
    of_data = _information(normal, candidates)

    stops = []
    of_stops = []
    tried = possible(fitted.data, candidates)
    for number, stop in enumerate(tried):
        design, expected = _simulated(fitted, stop, explanation)
        normal, _, _ = fitting.normal_equations(design, expected, search=False)
        if np.all(np.isfinite(normal.A)):
            stops.append(stop)
            of_stops.append(_information(normal, candidates, number))
        progress("possible stops", (number + 1) / len(tried))
    return Library(tuple(candidates), of_data, tuple(stops), tuple(of_stops))


def _simulated(
    fitted: FittedData, stop: Stop, explanation: Explanation
) -> tuple[Design, Explanation]:
    """Return the design of a stop, simulated with the fitted base, and the explanation for it."""
    # the level of the new run is the mean of the fitted runs, and its mass is that of the stop
    base = {}
    for label, value in explanation.base.items():
        if not label.startswith(_LABELS_OF_RUNS):
            base[label] = value
    base["ln_mu_cd_0"] = explanation.level
    expected = explanation._replace(base=base)

    rough = prototype.rough_run(fitted.data, fitted.design.base, stop, expected)
    rough_design = _with_noise_of(prepare(fitted.data, [rough]), fitted.design)
    simulated = simulate.runs(
        fitted.data, rough_design, [rough], expected, np.random.default_rng(SEED)
    )
    return _with_noise_of(prepare(fitted.data, simulated), fitted.design), expected


def _with_noise_of(design: Design, fitted: Design) -> Design:
    """Return a design with the measurement noise of another one."""
    torque_noise_Nm = float(np.median(fitted.torque_noise_Nm))
    return design._replace(
        speed_noise_m_s=fitted.speed_noise_m_s,
        wheel_noise_rad_s=fitted.wheel_noise_rad_s,
        torque_noise_Nm=np.full(design.mass_kg.size, torque_noise_Nm),
    )


def _information(
    normal: fitting.NormalEquations,
    candidates: Sequence[ScoreTest],
    number_of_stop: int | None = None,
) -> Information:
    """Return the information of normal equations, with a key for each base parameter and candidate.

    The normal equations are those of the data, or of a possible stop with this number. The column
    of a candidate is in units of its size.
    """
    columns = normal.matrix.columns
    base = fitting.base_columns(normal.matrix)
    is_of_data = number_of_stop is None
    # The parameter of a single run has the name of its runs in the key, so that it is never added
    # to that of other runs.
    runs = "known" if is_of_data else f"stop {number_of_stop}"

    A = normal.A.copy()
    keys = []
    # column k of P holds what key k is made of: coefficients of the normal equations
    P = np.zeros((len(columns), len(base) + len(candidates)))
    for k, c in enumerate(base):
        label = columns[c].label
        is_of_run = label.startswith(_LABELS_OF_RUNS)
        keys.append(f"{BASE} {label} {runs if is_of_run else ''}")
        P[c, k] = 1.0
        if columns[c].prior > 0.0 and not is_of_run and not is_of_data:
            # the data and all stops share one tolerance, which counts once: in the data
            A[c, c] -= 1.0 / columns[c].prior ** 2

    for k, test in enumerate(candidates):
        keys.append(f"cause {test.name}")
        for coefficient in _coefficients(normal, test):
            P[coefficient.column, len(base) + k] = coefficient.size
    return Information(tuple(keys), P.T @ A @ P)


class _Coefficient(NamedTuple):
    """A coefficient of a candidate: the number of its column, and its size."""

    column: int
    size: float


def _coefficients(normal: fitting.NormalEquations, test: ScoreTest) -> list[_Coefficient]:
    """Return the coefficients of a candidate; none if the normal equations do not contain it."""
    variant = _variant_of(normal, test)
    if variant is None:
        return []
    if len(variant.columns) == len(test.estimate):
        return [
            _Coefficient(column, size)
            for column, size in zip(variant.columns, test.estimate, strict=True)
        ]

    # A cause with a phase has a cosine and a sine in each run. The phase of a new run is unknown,
    # so the mean amplitude is assigned to the cosines.
    amplitude = float(np.sqrt(2.0 * np.mean(np.square(test.estimate))))
    coefficients = []
    for k, column in enumerate(variant.columns):
        is_cosine = k % 2 == 0
        coefficients.append(_Coefficient(column, amplitude if is_cosine else 0.0))
    return coefficients


def _variant_of(normal: fitting.NormalEquations, test: ScoreTest) -> Variant | None:
    """Return the variant of a candidate, in its shape if there is one; None if there is none."""
    variants = []
    for variant in normal.matrix.variants:
        if variant.cause == test.name and variant.axle == test.axle:
            if variant.shape == test.shape:
                return variant
            variants.append(variant)
    return variants[0] if variants else None


# --- the choice of stops ---


def propose(lib: Library, count: int, among: Sequence[str] = ()) -> list[Proposal]:
    """Return the best `count` stops, one after another.

    They distinguish the candidates with names in `among`, or all candidates if it is empty.
    """
    names = [test.name for test in lib.candidates if not among or test.name in among]
    chosen = [lib.of_data]
    remaining = list(range(len(lib.stops)))
    proposals: list[Proposal] = []
    while names and remaining and len(proposals) < count:
        before = separation(chosen, names)
        separations = [separation([*chosen, lib.of_stops[k]], names) for k in remaining]
        best = int(np.argmax([after.value for after in separations]))

        number = remaining.pop(best)
        chosen.append(lib.of_stops[number])
        proposals.append(
            Proposal(
                stop=lib.stops[number],
                pair=separations[best].pair,
                before=before.value,
                after=separations[best].value,
            )
        )
    return proposals


def separation(runs: Sequence[Information], names: Sequence[str]) -> Separation:
    """Return the least separation [L2] of causes with these names, by the information of some runs.

    A single cause is separated from nothing by its information.
    """
    S = _projected(runs, names)
    size = np.maximum(np.diag(S), _LEAST_SEPARATION)
    if len(names) == 1:
        return Separation(float(size[0]), (names[0], "nothing"))

    # tuples are compared by their values first, then by the numbers of the causes
    of_pairs = []
    for a, b in combinations(range(len(names)), 2):
        rho_squared = min(S[a, b] ** 2 / (size[a] * size[b]), 1.0)
        value = float(min(size[a], size[b]) * (1.0 - rho_squared))  # [L2]
        of_pairs.append((value, a, b))
    least, a, b = min(of_pairs)
    return Separation(least, (names[a], names[b]))


def _projected(runs: Sequence[Information], names: Sequence[str]) -> np.ndarray:
    """Return S of [L1], shape (names, names)."""
    base = set()
    for information in runs:
        base |= {key for key in information.keys if key.startswith(BASE)}
    keys = [*(f"cause {name}" for name in names), *sorted(base)]
    place_of = {key: place for place, key in enumerate(keys)}

    # the sum of the information of all runs; other candidates are left out
    A = np.zeros((len(keys), len(keys)))
    for information in runs:
        used = [k for k, key in enumerate(information.keys) if key in place_of]
        places = [place_of[information.keys[k]] for k in used]
        A[np.ix_(places, places)] += information.matrix[np.ix_(used, used)]

    # base parameters have different units: their block is scaled to a diagonal of 1
    n = len(names)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A)[n:], _LEAST_INFORMATION))
    A_bb = A[n:, n:] * np.outer(scale, scale) + _REGULARISATION * np.eye(len(base))
    A_bc = scale[:, None] * A[n:, :n]
    return A[:n, :n] - A_bc.T @ np.linalg.solve(A_bb, A_bc)  # [L1]
