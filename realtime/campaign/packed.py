"""Parameters of a stop as rows of numbers, so that compiled code takes many stops as few arrays.

A kernel would take the named tuples of a stop as hundreds of values. For short stops their
conversion takes longer than the physics. Here each number has a place in a tape of float64, and an
array of the parameters is behind them, with its bounds at its place. Arrays of whole numbers have a
second tape, int64. The kernels of this file make the named tuple again, and the compiler leaves out
what nobody reads.
"""

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple, get_type_hints

import numpy as np

from rollerrig.firmware_sim.wsp import logic
from rollerrig.rig.compiled.generated import tuple_builder
from rollerrig.rig.dynamic_params import DynamicBrake
from rollerrig.rig.mechanisms.applied import Wheels
from rollerrig.rig.params import Friction, Params
from rollerrig.rig.track_brake_params import MagneticTrackBrake

# arrays of whole numbers: the class and the field
_WHOLE = {
    (Friction, "by_place"),
    (Friction, "axles"),
    (DynamicBrake, "driven"),
    (DynamicBrake, "blends_with"),
    (MagneticTrackBrake, "fitted"),
}
# arrays with more than one row, one row after another in the tape: the class, the field, and the
# number of rows
_ROWS_OF = {(Wheels, "table"): 4}
# how compiled code reads a number of each kind at a place of the tape
_READ = {float: "tape[{}]", int: "int(tape[{}])", bool: "tape[{}] != 0.0"}


def _expressions(kind: Any, places: Iterator[int], names: dict[str, Any]) -> list[str]:
    """Return the source text of each field of a named tuple; add the classes in it to `names`."""
    found = []
    for field, hint in get_type_hints(kind).items():
        if hint in _READ:
            found.append(_READ[hint].format(next(places)))
        elif hint is np.ndarray:
            tape = "whole" if (kind, field) in _WHOLE else "tape"
            array = f"{tape}[int(tape[{next(places)}]) : int(tape[{next(places)}])]"
            if (kind, field) in _ROWS_OF:
                array += f".reshape(({_ROWS_OF[kind, field]}, -1))"
            found.append(array)
        elif hasattr(hint, "_fields"):
            names[hint.__name__] = hint
            found.append(f"{hint.__name__}({', '.join(_expressions(hint, places, names))})")
        else:
            # the coach in 3D does not run in lanes
            found.append("None")
    return found


def _builder() -> tuple[Any, int]:
    """Return the kernel `params`, and the number of places before the arrays in the tape."""
    places = itertools.count()
    names: dict[str, Any] = {}
    fields = _expressions(Params, places, names)
    return tuple_builder(Params, "tape, whole", fields, **names), next(places)


# kernel: the parameters of a plant from its two tapes
params, _NUMBERS = _builder()


def _unit_builder() -> Any:
    """Return the kernel `unit_params`."""
    places = itertools.count()
    fields = []
    for row in logic.ROWS:
        if isinstance(row.default, tuple):
            values = [_READ[float].format(next(places)) for _ in row.default]
            fields.append(f"({', '.join(values)})")
        else:
            fields.append(_READ[type(row.default)].format(next(places)))
    return tuple_builder(logic.Params, "tape", fields)


# kernel: the parameters of a reference WSP unit from their tape
unit_params = _unit_builder()


class Tapes(NamedTuple):
    """The parameters of a plant: float64 (n,), int64 (m,)."""

    tape: np.ndarray
    whole: np.ndarray


def tapes(plant: Params) -> Tapes:
    """Return the parameters of a plant that fits into lanes as tapes."""
    numbers: list[float] = []
    arrays: list[np.ndarray] = []
    wholes: list[np.ndarray] = []
    _append(plant, numbers, arrays, wholes)
    return Tapes(
        np.concatenate([numbers, *arrays]),
        np.concatenate([np.zeros(0, dtype=np.int64), *wholes]),
    )


def _append(
    values: Any, numbers: list[float], arrays: list[np.ndarray], wholes: list[np.ndarray]
) -> None:
    """Append the fields of a named tuple, in the order of `_expressions`."""
    for field, value in zip(values._fields, values, strict=True):
        if isinstance(value, np.ndarray):
            is_whole = (type(values), field) in _WHOLE
            group = wholes if is_whole else arrays
            begin = sum(array.size for array in group) + (0 if is_whole else _NUMBERS)
            numbers += (begin, begin + value.size)
            group.append(value.astype(np.int64) if is_whole else value.ravel())
        elif hasattr(value, "_fields"):
            _append(value, numbers, arrays, wholes)
        elif value is not None:
            numbers.append(float(value))


def unit_tape(unit: Any) -> np.ndarray:
    """Return the parameters of a reference WSP unit (`logic.Params`) as a tape."""
    return np.hstack(unit).astype(float)
