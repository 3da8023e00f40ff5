"""Replays the wheelsets of two runs simultaneously, in the processor's vector registers.

The filters of `replay` and `memory_replay` and the adhesion law have one source each. Here the same
sources are compiled a second time, with the functions of `vector_math`, which the compiler can turn
into vector instructions. Where recovered adhesion is below degraded, the law needs more than these
functions: the result is then NaN, and the caller replays the wheelsets one by one.

A loop over the lanes (the wheelsets of both runs) reads and writes one array only, `cells`. It
holds a row of numbers for each quantity, at known places: a row has room for the lanes of the
longest vehicles, and those of the others use its beginning. The compiler then needs no check that
arrays or rows overlap, and such a check would prevent the vector instructions.
"""

import math
from typing import Any

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import module_variant, variant
from rollerrig.rig.compiled.vector_math import MATH
from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.identify.data.parameters import MEMORY, PARAMETERS, WheelModel, wheel_model
from rollerrig.rig.identify.replay import memory_replay, replay

# wheelsets of two of the longest vehicles
MOST_LANES = 2 * MOST_AXLES

# --- the law and the filter with vector mathematics ---


@kernel_inlined
def _no_lag(*_):
    """Return 1: lambda goes all of its way in a step. Takes the place of `replay.lag_share`."""
    return 1.0


@kernel_inlined
def _not_a_number(_):
    """Return NaN. Takes the place of Lambert's function, which has no vector form."""
    return math.nan


_polach = module_variant(
    polach,
    curve=variant(
        polach.curve,
        shape=variant(polach.shape, math=MATH),
        friction=variant(polach.friction, math=MATH),
    ),
)
_recovery = variant(adhesion.recovery, math=MATH, lambert_w0=_not_a_number)
_adhesion = module_variant(
    adhesion,
    curves=variant(adhesion.curves, math=MATH, polach=_polach),
    f_and_lambda=variant(adhesion.f_and_lambda, math=MATH, recovery=_recovery),
)
_curves = variant(replay.curves, math=MATH, adhesion=_adhesion)
_wheel_adhesion = variant(replay.wheel_adhesion, adhesion=_adhesion, curves=_curves)
# the module `replay` for callers that have vector mathematics and no adhesion memory
REPLAY = module_variant(replay, wheel_adhesion=_wheel_adhesion, lag_share=_no_lag)

_adhesion_with_memory = module_variant(
    adhesion,
    f_and_lambda=_adhesion.f_and_lambda,
    lag_rate_1_s=variant(adhesion.lag_rate_1_s, math=MATH),
)
_matrix_step = variant(memory_replay.matrix_step, math=MATH)


# --- the cells: rows of MOST_LANES numbers ---

STATE_ROWS = len(memory_replay.MemoryFilterState._fields)  # of the larger of both filters
INPUTS = 5  # speed, load, torque, factor of the degraded friction, of the recovered
# also that of `replay.FilterState`
M = memory_replay.MemoryFilterState._fields.index("m") * MOST_LANES

# where the rows begin, after those of the state
MEASURED = STATE_ROWS * MOST_LANES
SPEED = MEASURED + MOST_LANES
LOAD = SPEED + MOST_LANES
TORQUE = LOAD + MOST_LANES
DEGRADED = TORQUE + MOST_LANES
RECOVERED = DEGRADED + MOST_LANES
INNOVATION = RECOVERED + MOST_LANES
VARIANCE = INNOVATION + MOST_LANES
MODEL = VARIANCE + MOST_LANES  # PARAMETERS rows
CELLS = MODEL + MOST_LANES * PARAMETERS

# builds the WheelModel of lane j
lane_model = tuple_builder(
    WheelModel, "cells, j", [f"cells[{MODEL + MOST_LANES * k} + j]" for k in range(PARAMETERS)]
)


@kernel_inlined
def store_models(parameters, cells):
    """Write rows of parameters, one for each lane from the first on, for `lane_model`."""
    for i in range(PARAMETERS):
        for j in range(len(parameters)):
            cells[MODEL + MOST_LANES * i + j] = parameters[j, i]


def _state_kernels(state: Any) -> dict[str, Any]:
    """Return the kernels that read and write the state of a filter in the cells of a lane."""
    places = [f"cells[{MOST_LANES * k} + j]" for k in range(len(state._fields))]
    return {
        "load_state": tuple_builder(state, "cells, j", places),
        "store_state": tuple_writer("cells, j", places),
    }


# --- the replay of two runs ---

# The names that `_replay_pair` uses. Its variant with memory has others under them.
initial_state = replay.initial_state
correct = replay.correct
predict = variant(replay.predict, math=MATH, wheel_adhesion=_wheel_adhesion)
_kernels = _state_kernels(replay.FilterState)
load_state = _kernels["load_state"]
store_state = _kernels["store_state"]


@kernel_inlined
def _store_inputs(start, inputs, k, w, first_lane, cells):
    """Write the inputs of a run's wheelsets, a share `w` of the way from sample k to the next.

    After the end of its run a wheelset keeps the inputs of the last sample.
    """
    length = start[1] - start[0]
    wheelsets = len(start) - 1
    before = min(k, length - 1)
    after = min(k + 1, length - 1)
    for q in range(INPUTS):
        first = SPEED + MOST_LANES * q + first_lane
        for j in range(wheelsets):
            value_before = inputs[q, start[j] + before]
            value_after = inputs[q, start[j] + after]
            cells[first + j] = (1.0 - w) * value_before + w * value_after


@kernel_inlined
def _write_results(start, k, first_lane, cells, out):
    """Write innovation, variance and irregularity of a run's wheelsets, up to the run's end."""
    if k < start[1] - start[0]:
        for j in range(len(start) - 1):
            at = start[j] + k
            lane = first_lane + j
            out[0, at] = cells[INNOVATION + lane]
            out[1, at] = cells[VARIANCE + lane]
            out[2, at] = cells[M + lane]


@kernel_inlined
def _replay_pair(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other):
    """Do what `replay_runs` does, for wheelsets without adhesion memory."""
    store_models(parameters, cells)
    wheelsets = len(start) - 1
    lanes = 2 * wheelsets
    for j in range(wheelsets):
        store_state(cells, j, initial_state(measured[start[j]], lane_model(cells, j)))
        lane = wheelsets + j
        store_state(cells, lane, initial_state(measured[other[j]], lane_model(cells, lane)))

    n = start[1] - start[0]
    m = other[1] - other[0]
    for k in range(max(n, m)):
        # a run that has ended stays at its last sample
        for j in range(wheelsets):
            cells[MEASURED + j] = measured[start[j] + min(k, n - 1)]
            cells[MEASURED + wheelsets + j] = measured[other[j] + min(k, m - 1)]
        for j in range(lanes):
            innovation, variance, state = correct(
                cells[MEASURED + j], load_state(cells, j), lane_model(cells, j)
            )
            cells[INNOVATION + j] = innovation
            cells[VARIANCE + j] = variance
            store_state(cells, j, state)
        _write_results(start, k, 0, cells, out)
        _write_results(other, k, wheelsets, cells, out_other)
        if k + 1 == max(n, m):
            break

        for i in range(replay.SUBSTEPS):
            w = (i + 0.5) / replay.SUBSTEPS  # the middle of the substep, between the two samples
            _store_inputs(start, inputs, k, w, 0, cells)
            _store_inputs(other, others, k, w, wheelsets, cells)
            for j in range(lanes):
                state = predict(
                    load_state(cells, j),
                    cells[SPEED + j],
                    cells[LOAD + j],
                    cells[TORQUE + j],
                    cells[DEGRADED + j],
                    cells[RECOVERED + j],
                    lane_model(cells, j),
                    step_s,
                )
                store_state(cells, j, state)


_predict_with_memory = variant(
    memory_replay.predict,
    math=MATH,
    adhesion=_adhesion_with_memory,
    matrix_step=_matrix_step,
    replay=module_variant(replay, curves=_curves),
)
_replay_pair_with_memory = variant(
    _replay_pair,
    initial_state=memory_replay.initial_state,
    correct=memory_replay.correct,
    predict=_predict_with_memory,
    **_state_kernels(memory_replay.MemoryFilterState),
)


@kernel
def replay_runs(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other):
    """Write the innovations of the wheelsets of two runs, or of the same run twice.

    `start` and `other` (wheelsets + 1,) are where the wheelsets of a run begin in the flat arrays,
    and where the last one ends. `inputs` and `others` (INPUTS, n) are those of the two runs,
    `parameters` (2 wheelsets, PARAMETERS) those of both. `out` and `out_other` (3, n) are written
    as `replay.replay_wheel` does: innovation, its variance, irregularity. `cells` (CELLS,) is work
    space.

    If only one of the runs has adhesion memory, the results of the other one are NaN.
    """
    if parameters[0, MEMORY] > 0.0 or parameters[len(start) - 1, MEMORY] > 0.0:
        _replay_pair_with_memory(
            start, other, measured, inputs, others, parameters, step_s, cells, out, out_other
        )
    else:
        _replay_pair(
            start, other, measured, inputs, others, parameters, step_s, cells, out, out_other
        )


# --- adhesion along a path ---

PATH_LANES = 16  # samples that are computed simultaneously
PATH_CELLS = 7 * PATH_LANES
# where the rows of the cells begin
PATH_SLIDING = 0
PATH_SPEED = PATH_LANES
PATH_LOAD = 2 * PATH_LANES
PATH_DEGRADED = 3 * PATH_LANES
PATH_RECOVERED = 4 * PATH_LANES
PATH_F = 5 * PATH_LANES
PATH_SLOPE = 6 * PATH_LANES


@kernel
def adhesion_along(sliding, speed, load, friction, row, cells, out):
    """Write what `replay.adhesion_along` writes without a lag of recovery, 16 samples at a time.

    `cells` (PATH_CELLS,) is work space.
    """
    model = wheel_model(row)
    for first in range(0, sliding.size, PATH_LANES):
        count = min(PATH_LANES, sliding.size - first)
        for j in range(PATH_LANES):
            k = first + min(j, count - 1)  # the last lanes may repeat the last sample
            cells[PATH_SLIDING + j] = sliding[k]
            cells[PATH_SPEED + j] = speed[k]
            cells[PATH_LOAD + j] = load[k]
            cells[PATH_DEGRADED + j] = friction[0, k]
            cells[PATH_RECOVERED + j] = friction[1, k]
        for j in range(PATH_LANES):
            f, slope, _ = _wheel_adhesion(
                cells[PATH_SLIDING + j],
                cells[PATH_SPEED + j],
                0.5 * cells[PATH_LOAD + j],
                cells[PATH_DEGRADED + j],
                cells[PATH_RECOVERED + j],
                model,
                0.0,
                1.0,
            )
            cells[PATH_F + j] = f
            cells[PATH_SLOPE + j] = slope
        for j in range(count):
            out[0, first + j] = cells[PATH_F + j]
            out[1, first + j] = cells[PATH_SLOPE + j]
