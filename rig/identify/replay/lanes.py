"""The replay of the wheelsets of two runs at once, side by side in the processor's vectors.

A loop is only put into vectors where it calls nothing, so exp, log and atan are written out, without branches that
have to be taken; the filter of `replay` and the law of adhesion are the same sources, compiled once more with these.
Where recovered adhesion lies below degraded, the law needs more than that: the replay is then no number, and the
wheelsets go one by one.

Source: Moshier, Methods and Programs for Mathematical Functions (1989), for the range reduction and the atan. Errors
of 3e-16.
"""

import math
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import AXLES
from rollerrig.rig.compiled.kernel import again, constructor, kernel, kernel_inlined, writer
from rollerrig.rig.contact import adhesion, polach
from rollerrig.rig.identify.data.parameters import PARAMETERS
from rollerrig.rig.identify.replay import memory_replay, replay

_SHIFT, _BIAS = (
    4503599627370496.0,
    1023.0,
)  # 2^52: its mantissa holds an integer; that of the exponent
_HALF_PI_REST = 6.123233995736766e-17


@kernel_inlined
def _power(x):
    """(2^k, e^r - 1) with e^x = 2^k e^r, |r| < 0.35."""
    x = min(max(x, -700.0), 700.0)
    k = math.floor(1.4426950408889634 * x + 0.5)
    r = (x - k * 0.693145751953125) - k * 1.42860682030941723212e-6
    p = 1.0 / 5040.0 + r * (
        1.0 / 40320.0
        + r
        * (
            1.0 / 362880.0
            + r
            * (
                1.0 / 3628800.0
                + r * (1.0 / 39916800.0 + r * (1.0 / 479001600.0 + r / 6227020800.0))
            )
        )
    )
    p = r * (
        1.0
        + r
        * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0 + r * (1.0 / 720.0 + r * p)))))
    )
    return np.int64(np.float64(k + _BIAS + _SHIFT).view(np.int64) << 52).view(np.float64), p


@kernel_inlined
def exp(x):
    """e^x for |x| < 700."""
    whole, part = _power(x)
    return whole + whole * part


@kernel_inlined
def expm1(x):
    """e^x - 1."""
    whole, part = _power(x)
    return whole * part + (whole - 1.0)


@kernel_inlined
def log(x):
    """ln x for 0 < x, not subnormal."""
    bits = np.float64(x).view(np.int64)
    power = np.int64((bits >> 52) | 0x4330000000000000).view(np.float64) - (_SHIFT + _BIAS)
    m = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    above = m > 1.4142135623730951
    m, power = (0.5 * m, power + 1.0) if above else (m, power)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    rest = z * (
        1.0 / 3.0
        + z
        * (
            0.2
            + z
            * (
                1.0 / 7.0
                + z
                * (
                    1.0 / 9.0
                    + z
                    * (
                        1.0 / 11.0
                        + z
                        * (
                            1.0 / 13.0
                            + z * (1.0 / 15.0 + z * (1.0 / 17.0 + z * (1.0 / 19.0 + z / 21.0)))
                        )
                    )
                )
            )
        )
    )
    return 2.0 * (s + s * rest) + power * 0.6931471805599453


@kernel_inlined
def atan(x):
    """Arctangent, after Cephes."""
    a = abs(x)
    far, middle = a > 2.414213562373095, a > 0.66
    turn = 2.0 if far else (1.0 if middle else 0.0)
    z = (-1.0 if far else (a - 1.0 if middle else a)) / (a if far else (a + 1.0 if middle else 1.0))
    w = z * z
    p = w * (
        (
            ((-0.8750608600031904 * w - 16.15753718733365) * w - 75.00855792314705) * w
            - 122.88666844901361
        )
        * w
        - 64.85021904942025
    )
    q = (
        (((w + 24.858464901423062) * w + 165.02700983169885) * w + 432.88106049129027) * w
        + 485.3903996359137
    ) * w + 194.5506571482614
    return math.copysign(
        turn * 0.7853981633974483 + (z * p / q + z + turn * 0.5 * _HALF_PI_REST), x
    )


@kernel_inlined
def power(x, y):
    """x^y for 0 < x."""
    return exp(y * log(x))


@kernel_inlined
def sin(x):
    """Sine of less than a quarter turn; of more no number."""
    z = x * x
    rest = z * (
        -1.0 / 6.0
        + z
        * (
            1.0 / 120.0
            + z
            * (
                -1.0 / 5040.0
                + z
                * (
                    1.0 / 362880.0
                    + z
                    * (
                        -1.0 / 39916800.0
                        + z
                        * (
                            1.0 / 6227020800.0
                            + z * (-1.0 / 1307674368000.0 + z / 355687428096000.0)
                        )
                    )
                )
            )
        )
    )
    return x + x * rest if z < 2.5 else math.nan


@kernel_inlined
def cos(x):
    """Cosine of less than a quarter turn; of more no number."""
    z = x * x
    rest = z * (
        -0.5
        + z
        * (
            1.0 / 24.0
            + z
            * (
                -1.0 / 720.0
                + z
                * (
                    1.0 / 40320.0
                    + z
                    * (
                        -1.0 / 3628800.0
                        + z
                        * (1.0 / 479001600.0 + z * (-1.0 / 87178291200.0 + z / 20922789888000.0))
                    )
                )
            )
        )
    )
    return 1.0 + rest if z < 2.5 else math.nan


@kernel_inlined
def _one(*_):
    return 1.0


@kernel_inlined
def _none(_):
    return math.nan


def _module(like: Any, **names: Any) -> Any:
    made = ModuleType(like.__name__)
    vars(made).update(vars(like) | names)
    return made


MATH = _module(math, exp=exp, expm1=expm1, log=log, atan=atan, pow=power, sin=sin, cos=cos)
_polach = _module(
    polach,
    curve=again(
        polach.curve,
        shape=again(polach.shape, math=MATH),
        friction=again(polach.friction, math=MATH),
    ),
)
_recovery = again(adhesion.recovery, math=MATH, lambert_w0=_none)
_adhesion = _module(
    adhesion,
    curves=again(adhesion.curves, math=MATH, polach=_polach),
    f_and_lambda=again(adhesion.f_and_lambda, math=MATH, recovery=_recovery),
)
_curves = again(replay.curves, math=MATH, adhesion=_adhesion)
_wheel_adhesion = again(replay.wheel_adhesion, adhesion=_adhesion, curves=_curves)
REPLAY = _module(replay, wheel_adhesion=_wheel_adhesion, closes=_one)
_law_lagging = _module(
    adhesion,
    f_and_lambda=_adhesion.f_and_lambda,
    lag_rate_1_s=again(adhesion.lag_rate_1_s, math=MATH),
)
_step_of = again(memory_replay.step_of, math=MATH)
_Row = NamedTuple("_Row", [(f"p{k}", float) for k in range(PARAMETERS)])
LANES = 2 * AXLES
# cells: the state, what is measured, the inputs, what is told, the parameters; LANES of each
_MEASURED = len(memory_replay.State._fields) * LANES
_INPUT, _TOLD, _PARAMETERS = _MEASURED + LANES, _MEASURED + 6 * LANES, _MEASURED + 8 * LANES
CELLS = _PARAMETERS + LANES * PARAMETERS
row = constructor(
    _Row, "cells, j", [f"cells[{_PARAMETERS + LANES * k} + j]" for k in range(PARAMETERS)]
)

told = constructor(_Row, "p", [f"p[{k}]" for k in range(PARAMETERS)])
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
    return {"taken": constructor(state, "cells, j", fields), "give": writer("cells, j", fields)}


begun, corrected = replay.begun, replay.corrected
moved = again(replay.moved, math=MATH, wheel_adhesion=_wheel_adhesion)
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


_moved_lagging = again(
    memory_replay.moved,
    math=MATH,
    adhesion=_law_lagging,
    step_of=_step_of,
    replay=_module(replay, curves=_curves),
)
_lagging = again(
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
