"""The replay of the wheelsets of two runs at once, side by side in the processor's vectors.

The filter of `replay` and the law of adhesion are the same sources, compiled once more with the functions of
`vector_math`, which the compiler can turn into vector instructions.
Where recovered adhesion lies below degraded, the law needs more than that: the replay is then no number, and the
wheelsets go one by one.
"""

import math
from typing import Any, NamedTuple

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.generated import tuple_builder, tuple_writer
from rollerrig.rig.compiled.kernel import kernel, kernel_inlined
from rollerrig.rig.compiled.variants import module_variant, variant
from rollerrig.rig.compiled.vector_math import MATH
from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.identify.data.parameters import PARAMETERS
from rollerrig.rig.identify.replay import memory_replay, replay


@kernel_inlined
def _one(*_):
    return 1.0


@kernel_inlined
def _none(_):
    return math.nan


_polach = module_variant(
    polach,
    curve=variant(
        polach.curve,
        shape=variant(polach.shape, math=MATH),
        friction=variant(polach.friction, math=MATH),
    ),
)
_recovery = variant(adhesion.recovery, math=MATH, lambert_w0=_none)
_adhesion = module_variant(
    adhesion,
    curves=variant(adhesion.curves, math=MATH, polach=_polach),
    f_and_lambda=variant(adhesion.f_and_lambda, math=MATH, recovery=_recovery),
)
_curves = variant(replay.curves, math=MATH, adhesion=_adhesion)
_wheel_adhesion = variant(replay.wheel_adhesion, adhesion=_adhesion, curves=_curves)
REPLAY = module_variant(replay, wheel_adhesion=_wheel_adhesion, closes=_one)
_law_lagging = module_variant(
    adhesion,
    f_and_lambda=_adhesion.f_and_lambda,
    lag_rate_1_s=variant(adhesion.lag_rate_1_s, math=MATH),
)
_step_of = variant(memory_replay.step_of, math=MATH)
_Row = NamedTuple("_Row", [(f"p{k}", float) for k in range(PARAMETERS)])
LANES = 2 * AXLES
# cells: the state, what is measured, the inputs, what is told, the parameters; LANES of each
_MEASURED = len(memory_replay.State._fields) * LANES
_INPUT, _TOLD, _PARAMETERS = _MEASURED + LANES, _MEASURED + 6 * LANES, _MEASURED + 8 * LANES
CELLS = _PARAMETERS + LANES * PARAMETERS
row = tuple_builder(
    _Row, "cells, j", [f"cells[{_PARAMETERS + LANES * k} + j]" for k in range(PARAMETERS)]
)

told = tuple_builder(_Row, "p", [f"p[{k}]" for k in range(PARAMETERS)])
_WIDE = 16
LONG = 7 * _WIDE


@kernel
def along(sliding, speed, load, friction, p, cells, out):
    """What `replay.along` gives where recovery does not lag, many samples at once."""
    fixed = told(p)
    for first in range(0, sliding.size, _WIDE):
        here = min(_WIDE, sliding.size - first)
        for j in range(_WIDE):
            k = first + min(j, here - 1)
            cells[j], cells[_WIDE + j] = sliding[k], speed[k]
            cells[2 * _WIDE + j], cells[3 * _WIDE + j], cells[4 * _WIDE + j] = (
                load[k],
                friction[0, k],
                friction[1, k],
            )
        for j in range(_WIDE):
            cells[5 * _WIDE + j], cells[6 * _WIDE + j], _ = _wheel_adhesion(
                cells[j],
                cells[_WIDE + j],
                0.5 * cells[2 * _WIDE + j],
                cells[3 * _WIDE + j],
                cells[4 * _WIDE + j],
                fixed,
                0.0,
                1.0,
            )
        for j in range(here):
            out[0, first + j], out[1, first + j] = cells[5 * _WIDE + j], cells[6 * _WIDE + j]


@kernel_inlined
def tell(parameters, cells):
    """Writes the rows of wheelsets where `row` looks for them."""
    for i in range(PARAMETERS):
        for j in range(len(parameters)):
            cells[_PARAMETERS + LANES * i + j] = parameters[j, i]


def _kept(state: Any) -> dict[str, Any]:
    """Kernels that take the state of a filter from the cells of a lane, and give it there."""
    fields = [f"cells[{LANES * k} + j]" for k in range(len(state._fields))]
    return {
        "taken": tuple_builder(state, "cells, j", fields),
        "give": tuple_writer("cells, j", fields),
    }


begun, corrected = replay.begun, replay.corrected
moved = variant(replay.moved, math=MATH, wheel_adhesion=_wheel_adhesion)
taken, give = _kept(replay.State).values()


@kernel_inlined
def _between(start, inputs, k, w, first, cells):
    """What four wheelsets are given a share `w` of the way from a sample to the next."""
    length = start[1] - start[0]
    here, then = min(k, length - 1), min(k + 1, length - 1)
    for q in range(5):
        for j in range(AXLES):
            cells[_INPUT + LANES * q + first + j] = (1.0 - w) * inputs[
                q, start[j] + here
            ] + w * inputs[q, start[j] + then]


@kernel_inlined
def _written(start, k, first, cells, out):
    """Writes what is told of four wheelsets, up to the end of their run."""
    if k < start[1] - start[0]:
        for j in range(AXLES):
            at, lane = start[j] + k, first + j
            out[0, at], out[1, at], out[2, at] = (
                cells[_TOLD + lane],
                cells[_TOLD + LANES + lane],
                cells[LANES + lane],
            )


@kernel_inlined
def _runs(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other):
    # without a memory; all that a loop touches stands in `cells`, at known places: no check that nothing overlaps
    tell(parameters, cells)
    for j in range(AXLES):
        give(cells, j, begun(measured[start[j]], row(cells, j)))
        give(cells, AXLES + j, begun(measured[other[j]], row(cells, AXLES + j)))
    n, m = start[1] - start[0], other[1] - other[0]
    for k in range(max(n, m)):
        for j in range(AXLES):  # a run that has ended stays at its last sample
            cells[_MEASURED + j] = measured[start[j] + min(k, n - 1)]
            cells[_MEASURED + AXLES + j] = measured[other[j] + min(k, m - 1)]
        for j in range(LANES):
            nu, S, state = corrected(cells[_MEASURED + j], taken(cells, j), row(cells, j))
            cells[_TOLD + j], cells[_TOLD + LANES + j] = nu, S
            give(cells, j, state)
        _written(start, k, 0, cells, out)
        _written(other, k, AXLES, cells, out_other)
        if k + 1 == max(n, m):
            break
        for i in range(replay.SUBSTEPS):
            w = (i + 0.5) / replay.SUBSTEPS
            _between(start, inputs, k, w, 0, cells)
            _between(other, others, k, w, AXLES, cells)
            for j in range(LANES):
                give(
                    cells,
                    j,
                    moved(
                        taken(cells, j),
                        cells[_INPUT + j],
                        cells[_INPUT + LANES + j],
                        cells[_INPUT + 2 * LANES + j],
                        cells[_INPUT + 3 * LANES + j],
                        cells[_INPUT + 4 * LANES + j],
                        row(cells, j),
                        step_s,
                    ),
                )


_moved_lagging = variant(
    memory_replay.moved,
    math=MATH,
    adhesion=_law_lagging,
    step_of=_step_of,
    replay=module_variant(replay, curves=_curves),
)
_lagging = variant(
    _runs,
    begun=memory_replay.begun,
    corrected=memory_replay.corrected,
    moved=_moved_lagging,
    **_kept(memory_replay.State),
)


@kernel
def replay_runs(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other):
    """Innovations of the wheelsets of two runs, or of one twice: `inputs` (5, n) speed, load, torque, two frictions.

    `start` and `other` (5,) are where the four of a run begin in the flat arrays, and where the last ends; `parameters`
    (LANES, PARAMETERS); `out` (3, n) as `replay_wheel` writes them; no
    numbers for a run without a memory beside one with.
    """
    if parameters[0, 14] > 0.0 or parameters[AXLES, 14] > 0.0:
        _lagging(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other)
    else:
        _runs(start, other, measured, inputs, others, parameters, step_s, cells, out, out_other)
