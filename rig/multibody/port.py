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

from rollerrig.rig.contact.adhesion import Law
from rollerrig.rig.contact.profiles import Rail, Wheel
from rollerrig.rig.kernel import kernel_inlined
from rollerrig.rig.multibody import memory, motion
from rollerrig.rig.multibody.coach import Coach, Links
from rollerrig.rig.multibody.memory import (
    ACTION,
    BRAKE_ACTS_NM,
    BRAKE_NM,
    CLEANING_CREEPAGE,
    LAW,
    MOTOR_NM,
    MU_CD,
    MU_CR,
    PORTS,
    RESISTANCE_N,
    ROLLER_INERTIA_KGM2,
    ROLLER_RAD_S,
    SPEED_M_S,
    STEP_S,
    Motion,
)
from rollerrig.rig.multibody.patches import Patches

STEP, START = 0, 1  # values of the port ACTION
_SCALARS = 11
# how many of each the layout tells: springs, curves, nodes of the wheel, coarse ones, of the rail, of
# the patches' table; then model, cells, four bogies, and the coordinates of springs and curves
_COUNTS = 12


class Packed(NamedTuple):
    """A coach's constants in two arrays: float64 `tape`, int64 `layout`."""

    tape: np.ndarray
    layout: np.ndarray


def packed(coach: Coach) -> Packed:
    """The constants of a coach for `run`."""
    wheel, rail, patches = coach.wheel, coach.rail, coach.patches
    tables = (coach.springs.row, coach.curves.row, wheel.fine, wheel.coarse, rail.nodes, patches.rows)
    scalars = (coach.mass_kg, coach.axle_height_m, coach.contact_damping_N_s_m, coach.roller_m,
               wheel.start_m, wheel.spacing_m, wheel.centre_m, rail.sines_per_node,
               patches.nodes_per_log, patches.shear_Pa, 0.0)
    tape = np.concatenate([np.array(scalars), coach.inertia, coach.weight_N,
                           *(table.ravel() for table in tables)])
    layout = np.concatenate([
        np.array([len(table) for table in tables]), np.array([patches.model, patches.cells]),
        coach.bogie_of, coach.springs.at.ravel(), coach.curves.at.ravel()]).astype(np.int64)
    return Packed(tape, layout)


def _shift(typing_context, pointer, count):
    def generate(context, builder, signature, args):
        return builder.gep(args[0], [args[1]])

    return pointer(pointer, types.intp), generate


_shifted: Any = intrinsic(_shift)

_B = tuple(memory.BEGIN[name] for name in Motion._fields)
_S: Any = tuple(memory.SHAPES[name] for name in Motion._fields)
(_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8, _S9, _S10, _S11, _S12, _S13, _S14, _S15, _S16,
 _S17, _S18) = _S
_FLOATS, _INTS = types.CPointer(types.float64), types.CPointer(types.int64)
_NAME = "rollerrig_coach"


def _act(memory_at, tape_at, layout_at):
    state = Motion(
        carray(memory_at, _S0), carray(_shifted(memory_at, _B[1]), _S1),
        carray(_shifted(memory_at, _B[2]), _S2), carray(_shifted(memory_at, _B[3]), _S3),
        carray(_shifted(memory_at, _B[4]), _S4), carray(_shifted(memory_at, _B[5]), _S5),
        carray(_shifted(memory_at, _B[6]), _S6), carray(_shifted(memory_at, _B[7]), _S7),
        carray(_shifted(memory_at, _B[8]), _S8), carray(_shifted(memory_at, _B[9]), _S9),
        carray(_shifted(memory_at, _B[10]), _S10), carray(_shifted(memory_at, _B[11]), _S11),
        carray(_shifted(memory_at, _B[12]), _S12), carray(_shifted(memory_at, _B[13]), _S13),
        carray(_shifted(memory_at, _B[14]), _S14), carray(_shifted(memory_at, _B[15]), _S15),
        carray(_shifted(memory_at, _B[16]), _S16), carray(_shifted(memory_at, _B[17]), _S17),
        carray(_shifted(memory_at, _B[18]), _S18))
    layout = carray(layout_at, (_COUNTS,))
    n_s, n_c, n_f, n_w, n_r, n_p = layout[0], layout[1], layout[2], layout[3], layout[4], layout[5]
    one = carray(tape_at, (_SCALARS,))
    at = _SCALARS + 84
    row_s = carray(_shifted(tape_at, at), (n_s, 12))
    at += 12 * n_s
    row_c = carray(_shifted(tape_at, at), (n_c, 12))
    at += 12 * n_c
    fine = carray(_shifted(tape_at, at), (n_f, 3))
    at += 3 * n_f
    coarse = carray(_shifted(tape_at, at), (n_w, 5))
    at += 5 * n_w
    nodes = carray(_shifted(tape_at, at), (n_r, 4))
    at += 4 * n_r
    coach = Coach(
        carray(_shifted(tape_at, _SCALARS), (42,)), carray(_shifted(tape_at, _SCALARS + 42), (42,)),
        one[0], Links(carray(_shifted(layout_at, _COUNTS), (n_s, 6)), row_s),
        Links(carray(_shifted(layout_at, _COUNTS + 6 * n_s), (n_c, 6)), row_c), one[1],
        Wheel(one[4], one[5], one[6], fine, coarse), Rail(one[7], nodes),
        Patches(one[8], one[9], layout[6], layout[7], carray(_shifted(tape_at, at), (n_p, 8))),
        one[2], one[3], carray(_shifted(layout_at, 8), (4,)))
    _obey(state, coach)


@kernel_inlined
def _obey(state, coach):
    """Do what the ports ask."""
    io = state.ports
    if io[ACTION] == START:
        motion.start(state, coach, io[SPEED_M_S])
        return
    k = LAW
    law = Law(io[k], io[k + 1], io[k + 2], io[k + 3], io[k + 4], io[k + 5], io[k + 6], io[k + 7],
              io[k + 8], io[k + 9], io[k + 10])
    motion.step(
        state, coach, io[STEP_S], io[ROLLER_RAD_S:ROLLER_RAD_S + 4], io[MOTOR_NM:MOTOR_NM + 4],
        io[ROLLER_INERTIA_KGM2], io[BRAKE_NM:BRAKE_NM + 4], io[BRAKE_ACTS_NM:BRAKE_ACTS_NM + 4],
        io[RESISTANCE_N], io[MU_CD:MU_CD + 4], io[MU_CR:MU_CR + 4], law, io[CLEANING_CREEPAGE])
    io[SPEED_M_S] = motion.mean_speed(state.v, coach)


_external: Any = types.ExternalFunction(_NAME, types.void(_FLOATS, _FLOATS, _INTS))
_compiled: list[Any] = []


def prepare() -> None:
    """Compile the coach, or load it, and give it its name: before anything that calls `run`."""
    if not _compiled and not numba.config.DISABLE_JIT:  # type: ignore[attr-defined]
        _compiled.append(numba.cfunc(types.void(_FLOATS, _FLOATS, _INTS), cache=True,
                                     error_model="numpy")(_act))
        binding.add_symbol(_NAME, _compiled[0].address)


@kernel_inlined
def run(buffer, tape, layout):
    """Let the coach do what its ports ask: start, or advance by a step.

    buffer (memory.SIZE,) is its memory, tape and layout from `packed`.
    """
    _external(buffer.ctypes, tape.ctypes, layout.ctypes)


assert PORTS == MU_CR + 4
