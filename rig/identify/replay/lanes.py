"""The replay and the adhesion law for several wheelsets, in the processor's vector registers.

The filter, the step of a wheelset and the adhesion law have one source each, in `replay`, `wheel`
and `adhesion`. Here it is compiled with the functions of `vector_math`, which the compiler can turn
into vector instructions. Where recovered adhesion is below degraded, the law needs more than these
functions: the result is then NaN. A kernel with the argument `exact` is compiled with the functions
of `math` for such wheelsets; otherwise `exact` is None.

A loop over the lanes (the wheelsets of one or two runs) reads and writes one array only, `cells`.
It holds a row of numbers for each quantity, at known places: a row has room for the lanes of the
longest vehicles, and those of the others use its beginning. The compiler then needs no check that
arrays or rows overlap, and such a check would prevent the vector instructions.
"""

import math
from functools import partial
from typing import NamedTuple

import numpy as np

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import module_variant, variant
from rollerrig.rig.compiled.vector_math import MATH
from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.identify.data.parameters import PARAMETERS, WheelModel, wheel_model
from rollerrig.rig.identify.replay import replay, wheel

# wheelsets of two of the longest vehicles
MOST_LANES = 2 * MOST_AXLES

# --- the law, the step and the filter with vector mathematics ---


@kernel_inlined
def _not_a_number(_):
    """Return NaN. Takes the place of Lambert's function, which has no vector form."""
    return math.nan


# compiles a formula with vector mathematics, and with other functions under some names
_vector = partial(variant, math=MATH)
_polach = module_variant(
    polach,
    curve=_vector(polach.curve, shape=_vector(polach.shape), friction=_vector(polach.friction)),
)
_adhesion = module_variant(
    adhesion,
    curves=_vector(adhesion.curves, polach=_polach),
    f_and_lambda=_vector(
        adhesion.f_and_lambda, recovery=_vector(adhesion.recovery, lambert_w0=_not_a_number)
    ),
    lag_rate_1_s=_vector(adhesion.lag_rate_1_s),
)
matrix_step = _vector(wheel.matrix_step)
wheel_adhesion = _vector(wheel.wheel_adhesion, adhesion=_adhesion)
wheel_step = _vector(
    wheel.wheel_step, adhesion=_adhesion, wheel_adhesion=wheel_adhesion, matrix_step=matrix_step
)
_predict = _vector(replay.predict, wheel=module_variant(wheel, wheel_step=wheel_step))


# --- the cells: rows of MOST_LANES numbers ---

# the rows of the state are those of `replay.FilterState`; the next ones are
_AFTER_STATE = len(replay.FilterState._fields)
INPUTS = 5  # speed, load, torque, factor of the degraded friction, of the recovered
OMEGA, M, LAMBDA, *FREE_ROWS = range(0, _AFTER_STATE * MOST_LANES, MOST_LANES)
MEASURED = _AFTER_STATE * MOST_LANES
INNOVATION = MEASURED + MOST_LANES
VARIANCE = INNOVATION + MOST_LANES
SPEED = VARIANCE + MOST_LANES
LOAD = SPEED + MOST_LANES
TORQUE = LOAD + MOST_LANES
DEGRADED = TORQUE + MOST_LANES
RECOVERED = DEGRADED + MOST_LANES
MODEL = RECOVERED + MOST_LANES  # PARAMETERS rows
CELLS = MODEL + MOST_LANES * PARAMETERS

_STATE = [f"cells[{MOST_LANES * k} + j]" for k in range(_AFTER_STATE)]
load_state = tuple_builder(replay.FilterState, "cells, j", _STATE)
store_state = tuple_writer("cells, j", _STATE)
# builds the WheelModel of lane j
lane_model = tuple_builder(
    WheelModel, "cells, j", [f"cells[{MODEL + MOST_LANES * k} + j]" for k in range(PARAMETERS)]
)


@kernel_inlined
def store_models(parameters, first_lane, cells):
    """Write rows of parameters, one for each lane from `first_lane` on, for `lane_model`."""
    for i in range(PARAMETERS):
        for j in range(len(parameters)):
            cells[MODEL + MOST_LANES * i + first_lane + j] = parameters[j, i]


# --- the replay of two runs ---


class Run(NamedTuple):
    """A run to replay. `start` is where wheelsets begin in flat arrays, and where the last ends."""

    start: np.ndarray  # (wheelsets + 1,)
    measured_rad_s: np.ndarray  # (n,), wheel speeds
    inputs: np.ndarray  # (INPUTS, n)
    parameters: np.ndarray  # (wheelsets, PARAMETERS)
    out: np.ndarray  # (3, n), written: innovation, its variance, filtered irregularity


@kernel_inlined
def _begin(run, first_lane, cells):
    """Write the parameters of a run's wheelsets, and the state of their filters."""
    store_models(run.parameters, first_lane, cells)
    for j in range(len(run.parameters)):
        lane = first_lane + j
        measured_rad_s = run.measured_rad_s[run.start[j]]
        store_state(cells, lane, replay.initial_state(measured_rad_s, lane_model(cells, lane)))


@kernel_inlined
def _store_measured(run, k, first_lane, cells):
    """Write the measured speeds of a run's wheelsets at sample k; after its end the last ones."""
    at = min(k, run.start[1] - run.start[0] - 1)
    for j in range(len(run.parameters)):
        cells[MEASURED + first_lane + j] = run.measured_rad_s[run.start[j] + at]


@kernel_inlined
def _store_inputs(run, k, w, first_lane, cells):
    """Write the inputs of a run's wheelsets, a share `w` of the way from sample k to the next.

    After the end of its run a wheelset keeps the inputs of the last sample.
    """
    last = run.start[1] - run.start[0] - 1
    before = min(k, last)
    after = min(k + 1, last)
    for q in range(INPUTS):
        first = SPEED + MOST_LANES * q + first_lane
        for j in range(len(run.parameters)):
            value_before = run.inputs[q, run.start[j] + before]
            value_after = run.inputs[q, run.start[j] + after]
            cells[first + j] = (1.0 - w) * value_before + w * value_after


@kernel_inlined
def _write_results(run, k, first_lane, cells):
    """Write innovation, variance and irregularity of a run's wheelsets, up to the run's end."""
    if k < run.start[1] - run.start[0]:
        for j in range(len(run.parameters)):
            at = run.start[j] + k
            lane = first_lane + j
            run.out[0, at] = cells[INNOVATION + lane]
            run.out[1, at] = cells[VARIANCE + lane]
            run.out[2, at] = cells[M + lane]


@kernel_inlined
def _predicted(j, cells, step_s, memory, exact):
    """Return the state of the filter of lane j after a substep."""
    arguments = (
        load_state(cells, j),
        cells[SPEED + j],
        cells[LOAD + j],
        cells[TORQUE + j],
        cells[DEGRADED + j],
        cells[RECOVERED + j],
        lane_model(cells, j),
        step_s,
        memory,
    )
    if exact is None:
        return _predict(*arguments)
    return replay.predict(*arguments)


@kernel
def replay_runs(run, other, step_s, memory, exact, cells):
    """Replay the wheelsets of two runs, or of the same run twice.

    `step_s` is the time of a sample. `memory` is None if recovery has no memory in both runs,
    `exact` is None for vector mathematics. `cells` (CELLS,) is work space.
    """
    wheelsets = len(run.parameters)
    _begin(run, 0, cells)
    _begin(other, wheelsets, cells)
    samples = max(run.start[1] - run.start[0], other.start[1] - other.start[0])
    for k in range(samples):
        _store_measured(run, k, 0, cells)
        _store_measured(other, k, wheelsets, cells)
        for j in range(2 * wheelsets):
            innovation, variance, state = replay.correct(
                cells[MEASURED + j], load_state(cells, j), lane_model(cells, j)
            )
            cells[INNOVATION + j] = innovation
            cells[VARIANCE + j] = variance
            store_state(cells, j, state)
        _write_results(run, k, 0, cells)
        _write_results(other, k, wheelsets, cells)
        if k + 1 == samples:
            break

        for i in range(replay.SUBSTEPS):
            w = (i + 0.5) / replay.SUBSTEPS  # the middle of the substep, between the two samples
            _store_inputs(run, k, w, 0, cells)
            _store_inputs(other, k, w, wheelsets, cells)
            for j in range(2 * wheelsets):
                store_state(cells, j, _predicted(j, cells, step_s, memory, exact))


# --- adhesion along a path ---

PATH_LANES = 16  # samples that are computed simultaneously
# rows of the path: sliding, speed, load, factors of degraded and recovered friction
PATH_INPUTS = 5
PATH_SLIDING, PATH_SPEED, PATH_LOAD, PATH_DEGRADED, PATH_RECOVERED = range(PATH_INPUTS)
# rows of the results: f, its slope, f_d and f_r
PATH_RESULTS = 4
OUT_F, OUT_SLOPE, OUT_F_D, OUT_F_R = range(PATH_RESULTS)
PATH_CELLS = (PATH_INPUTS + PATH_RESULTS) * PATH_LANES


@kernel
def adhesion_along(path, row, exact, cells, out):
    """Write f, df/dsliding, f_d and f_r of one wheel along a path to `out`, shape (4, n).

    `path` (5, n) has the sliding, the speed, the wheelset's load and the factors of its two
    frictions, `row` (PARAMETERS,) its parameters; recovery has no memory. `exact` is None for
    vector mathematics. `cells` (PATH_CELLS,) is work space.
    """
    model = wheel_model(row)
    n = path.shape[1]
    for first in range(0, n, PATH_LANES):
        count = min(PATH_LANES, n - first)
        for q in range(PATH_INPUTS):
            for j in range(PATH_LANES):
                # the last lanes may repeat the last sample
                cells[PATH_LANES * q + j] = path[q, first + min(j, count - 1)]
        for j in range(PATH_LANES):
            arguments = (
                cells[PATH_SLIDING * PATH_LANES + j],
                cells[PATH_SPEED * PATH_LANES + j],
                0.5 * cells[PATH_LOAD * PATH_LANES + j],
                cells[PATH_DEGRADED * PATH_LANES + j],
                cells[PATH_RECOVERED * PATH_LANES + j],
                model,
                None,
            )
            a = wheel_adhesion(*arguments) if exact is None else wheel.wheel_adhesion(*arguments)
            cells[(PATH_INPUTS + OUT_F) * PATH_LANES + j] = a.f
            cells[(PATH_INPUTS + OUT_SLOPE) * PATH_LANES + j] = a.slope_s_m
            cells[(PATH_INPUTS + OUT_F_D) * PATH_LANES + j] = a.degraded
            cells[(PATH_INPUTS + OUT_F_R) * PATH_LANES + j] = a.recovered
        for q in range(PATH_RESULTS):
            for j in range(count):
                out[q, first + j] = cells[PATH_LANES * (PATH_INPUTS + q) + j]


@kernel
def lagging_adhesion_along(path, row, step_s, lagging, follow, out):
    """Write what `adhesion_along` writes where recovery has a memory.

    `lagging` (n + 1,) is lambda before each sample, each `step_s` long; with `follow` it is
    written, otherwise only read.
    """
    model = wheel_model(row)
    for k in range(path.shape[1]):
        sliding = path[PATH_SLIDING, k]
        speed = path[PATH_SPEED, k]
        a = wheel.wheel_adhesion(
            sliding,
            speed,
            0.5 * path[PATH_LOAD, k],
            path[PATH_DEGRADED, k],
            path[PATH_RECOVERED, k],
            model,
            lagging[k],
        )
        share = wheel.lag_share(speed, step_s, model)
        change = share * (a.lambda_0 - lagging[k])
        spread = a.recovered - a.degraded
        out[OUT_F, k] = a.f + change * math.copysign(1.0, sliding) * spread
        out[OUT_SLOPE, k] = a.slope_s_m + change * a.slope_by_lambda_s_m
        out[OUT_SLOPE, k] += share * spread * a.lambda_0_slope_s_m
        out[OUT_F_D, k] = a.degraded
        out[OUT_F_R, k] = a.recovered
        if follow:
            lagging[k + 1] = lagging[k] + change
