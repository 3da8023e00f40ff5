"""The coach behind one address: a compiled function that others call without compiling it again.

Numba compiles a function anew into each that calls it, and the coach is large. Here it is compiled
once as a C function on three addresses (memory, constants, layout), registered by name, and called
by that name; what a step needs and gives goes through the `ports` of the memory.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from llvmlite import binding
from numba import carray, types
from numba.extending import intrinsic

from rollerrig.rig.compiled.generated import tuple_builder
from rollerrig.rig.compiled.kernel import kernel_inlined
from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.patch import Patches
from rollerrig.rig.contact.profiles import Rail, Wheel
from rollerrig.rig.multibody import coach_state, motion
from rollerrig.rig.multibody.coach import Coach, Links
from rollerrig.rig.multibody.coach_state import (
    BRAKE_ACTS_NM,
    BRAKE_NM,
    MOTOR_NM,
    MU_CD,
    MU_CR,
    ROLLER_RAD_S,
    Motion,
)

STEP, START = 0, 1  # values of the port ACTION
# on the tape: scalars of the coach, step and roller inertia, the law, inertia and weight of 42 coordinates
_LAW, _INERTIA = 12, 12 + len(Law._fields)
_TABLES = _INERTIA + 84
# how many of each the layout tells: springs, curves, nodes of the wheel, coarse ones, of the rail, of
# the patches' table; then model, cells, four bogies, and the coordinates of springs and curves
_COUNTS = 12


class Packed(NamedTuple):
    """A coach's constants in two arrays: float64 `tape`, int64 `layout`."""

    tape: np.ndarray
    layout: np.ndarray


def packed(coach: Coach, law: Law, step_s: float, roller_inertia_kgm2: float) -> Packed:
    """The constants of a coach, the adhesion under it and its time step for `run`."""
    wheel, rail, patches = coach.wheel, coach.rail, coach.patches
    tables = (
        coach.springs.row,
        coach.curves.row,
        wheel.fine,
        wheel.coarse,
        rail.nodes,
        patches.rows,
    )
    scalars = (
        coach.mass_kg,
        coach.axle_height_m,
        coach.contact_damping_N_s_m,
        coach.roller_m,
        wheel.start_m,
        wheel.spacing_m,
        wheel.centre_m,
        rail.sines_per_node,
        patches.nodes_per_log,
        patches.shear_Pa,
        step_s,
        roller_inertia_kgm2,
        *law,
    )
    tape = np.concatenate(
        [np.array(scalars), coach.inertia, coach.weight_N, *(table.ravel() for table in tables)]
    )
    layout = np.concatenate(
        [
            np.array([len(table) for table in tables]),
            np.array([patches.model, patches.cells]),
            coach.bogie_of,
            coach.springs.at.ravel(),
            coach.curves.at.ravel(),
        ]
    ).astype(np.int64)
    return Packed(tape, layout)


def _shift(typing_context: Any, pointer: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, types.intp), generate


_shifted: Any = intrinsic(_shift)

_FLOATS, _INTS = types.CPointer(types.float64), types.CPointer(types.int64)
_NAME = "rollerrig_coach"
_motion_at = tuple_builder(
    Motion,
    "at",
    (
        f"carray(shifted(at, {coach_state.BEGIN[name]}), {coach_state.SHAPES[name]})"
        for name in Motion._fields
    ),
    True,
    carray=carray,
    shifted=_shifted,
)
_law_of = tuple_builder(Law, "one", (f"one[{_LAW + i}]" for i in range(len(Law._fields))))


def _act(memory_at: Any, tape_at: Any, layout_at: Any) -> None:
    layout = carray(layout_at, (_COUNTS,))
    n_s, n_c, n_f, n_w, n_r, n_p = layout[0], layout[1], layout[2], layout[3], layout[4], layout[5]
    one = carray(tape_at, (_INERTIA,))
    # where the tables of `packed` begin, one after another
    at_s, at_c = _TABLES, _TABLES + 12 * n_s
    at_f = at_c + 12 * n_c
    at_w = at_f + 3 * n_f
    at_r = at_w + 5 * n_w
    at_p = at_r + 4 * n_r
    row_s, row_c = (
        carray(_shifted(tape_at, at_s), (n_s, 12)),
        carray(_shifted(tape_at, at_c), (n_c, 12)),
    )
    fine, coarse = (
        carray(_shifted(tape_at, at_f), (n_f, 3)),
        carray(_shifted(tape_at, at_w), (n_w, 5)),
    )
    nodes, rows = (
        carray(_shifted(tape_at, at_r), (n_r, 4)),
        carray(_shifted(tape_at, at_p), (n_p, 8)),
    )
    coach = Coach(
        carray(_shifted(tape_at, _INERTIA), (42,)),
        carray(_shifted(tape_at, _INERTIA + 42), (42,)),
        one[0],
        Links(carray(_shifted(layout_at, _COUNTS), (n_s, 6)), row_s),
        Links(carray(_shifted(layout_at, _COUNTS + 6 * n_s), (n_c, 6)), row_c),
        one[1],
        Wheel(one[4], one[5], one[6], fine, coarse),
        Rail(one[7], nodes),
        Patches(one[8], one[9], layout[6], layout[7], rows),
        one[2],
        one[3],
        carray(_shifted(layout_at, 8), (4,)),
    )
    _obey(_motion_at(memory_at), coach, one[10], one[11], _law_of(one))


@kernel_inlined
def _obey(state, coach, step_s, roller_inertia_kgm2, law):
    """Do what the ports ask."""
    io = state.ports
    if io[coach_state.ACTION] == START:
        motion.start(state, coach, io[coach_state.SPEED_M_S])
        return
    motion.step(
        state,
        coach,
        step_s,
        io[ROLLER_RAD_S : ROLLER_RAD_S + 4],
        io[MOTOR_NM : MOTOR_NM + 4],
        roller_inertia_kgm2,
        io[BRAKE_NM : BRAKE_NM + 4],
        io[BRAKE_ACTS_NM : BRAKE_ACTS_NM + 4],
        io[coach_state.RESISTANCE_N],
        io[MU_CD : MU_CD + 4],
        io[MU_CR : MU_CR + 4],
        law,
    )
    io[coach_state.SPEED_M_S] = motion.mean_speed(state.v, coach)


_external: Any = types.ExternalFunction(_NAME, types.void(_FLOATS, _FLOATS, _INTS))
_compiled: list[Any] = []


def prepare() -> None:
    """Compile the coach, or load it, and give it its name: before anything that calls `run`."""
    if not _compiled and not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        _compiled.append(
            numba.cfunc(types.void(_FLOATS, _FLOATS, _INTS), cache=True, error_model="numpy")(_act)
        )
        binding.add_symbol(_NAME, _compiled[0].address)


@kernel_inlined
def run(buffer, tape, layout):
    """Let the coach do what its ports ask; buffer (coach_state.SIZE,) is its memory, tape and layout from `packed`."""
    _external(buffer.ctypes, tape.ctypes, layout.ctypes)
