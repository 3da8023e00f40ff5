"""The coach as one C function on three addresses, which callers do not compile again.

The coach is large, and numba compiles a function again into each function that calls it. Here it is
compiled once, as a C function on the addresses of its memory, its constants (`Packed.tape`) and
their layout (`Packed.layout`). Other kernels call it by its name, with `run`. Inputs and outputs of
a step are in the `ports` of the memory (`coach_state`).
"""

from typing import Any, NamedTuple

import numpy as np

from rollerrig.rig.compiled import c_function
from rollerrig.rig.compiled.c_function import FLOATS, INTEGERS, array_at, shifted
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
from rollerrig.rig.multibody.coordinates import COORDINATES

# values of the port ACTION
STEP = 0
START = 1

# places on the tape: scalars first, then the law, inertia and weight, then the tables one after
# another
(
    _MASS_KG,
    _AXLE_HEIGHT_M,
    _CONTACT_DAMPING_N_S_M,
    _ROLLER_M,
    _WHEEL_START_M,
    _WHEEL_SPACING_M,
    _WHEEL_CENTRE_M,
    _SINES_PER_NODE,
    _NODES_PER_LOG,
    _SHEAR_PA,
    _STEP_S,
    _ROLLER_INERTIA_KGM2,
    _LAW,
) = range(13)
_INERTIA = _LAW + len(Law._fields)
_WEIGHT = _INERTIA + COORDINATES
_TABLES = _WEIGHT + COORDINATES
# columns of the tables on the tape
_LINK_COLUMNS = 12
_FINE_COLUMNS = 3
_COARSE_COLUMNS = 5
_RAIL_COLUMNS = 4
_PATCH_COLUMNS = 8

# places in the layout: rows of each table, then the contact model, then the coordinates of the
# links
(
    _SPRINGS,
    _CURVES,
    _FINE_NODES,
    _COARSE_NODES,
    _RAIL_NODES,
    _PATCH_NODES,
    _MODEL,
    _CELLS,
    _BOGIE_OF,
) = range(9)
_WHEELSETS = 4
_COUNTS = _BOGIE_OF + _WHEELSETS
_COORDINATES_OF_A_LINK = 6


class Packed(NamedTuple):
    """The constants of a coach in two arrays: float64 `tape`, int64 `layout`."""

    tape: np.ndarray
    layout: np.ndarray


def packed(coach: Coach, law: Law, step_s: float, roller_inertia_kgm2: float) -> Packed:
    """Return the constants of a coach, the adhesion under it and its time step, for `run`."""
    wheel = coach.wheel
    rail = coach.rail
    patches = coach.patches
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
    tables = (
        coach.springs.row,
        coach.curves.row,
        wheel.fine,
        wheel.coarse,
        rail.nodes,
        patches.rows,
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
    )
    return Packed(tape, layout.astype(np.int64))


_motion_at = tuple_builder(
    Motion,
    "address",
    [
        f"array_at(shifted(address, {coach_state.BEGIN[name]}), {coach_state.SHAPES[name]})"
        for name in Motion._fields
    ],
    counted=True,
    array_at=array_at,
    shifted=shifted,
)
_law_on = tuple_builder(Law, "scalars", [f"scalars[{_LAW + i}]" for i in range(len(Law._fields))])


def _act(memory_at: Any, tape_at: Any, layout_at: Any) -> None:
    """Unpack the coach at these addresses, and do the action in its ports."""
    scalars = array_at(tape_at, (_INERTIA,))
    layout = array_at(layout_at, (_COUNTS,))
    springs = layout[_SPRINGS]
    curves = layout[_CURVES]
    fine = layout[_FINE_NODES]
    coarse = layout[_COARSE_NODES]
    rail = layout[_RAIL_NODES]
    patches = layout[_PATCH_NODES]

    # where the tables begin on the tape
    curves_at = _TABLES + _LINK_COLUMNS * springs
    fine_at = curves_at + _LINK_COLUMNS * curves
    coarse_at = fine_at + _FINE_COLUMNS * fine
    rail_at = coarse_at + _COARSE_COLUMNS * coarse
    patches_at = rail_at + _RAIL_COLUMNS * rail
    # where the coordinates of the nonlinear links begin in the layout
    curve_coordinates_at = _COUNTS + _COORDINATES_OF_A_LINK * springs

    coach = Coach(
        array_at(shifted(tape_at, _INERTIA), (COORDINATES,)),
        array_at(shifted(tape_at, _WEIGHT), (COORDINATES,)),
        scalars[_MASS_KG],
        Links(
            array_at(shifted(layout_at, _COUNTS), (springs, _COORDINATES_OF_A_LINK)),
            array_at(shifted(tape_at, _TABLES), (springs, _LINK_COLUMNS)),
        ),
        Links(
            array_at(shifted(layout_at, curve_coordinates_at), (curves, _COORDINATES_OF_A_LINK)),
            array_at(shifted(tape_at, curves_at), (curves, _LINK_COLUMNS)),
        ),
        scalars[_AXLE_HEIGHT_M],
        Wheel(
            scalars[_WHEEL_START_M],
            scalars[_WHEEL_SPACING_M],
            scalars[_WHEEL_CENTRE_M],
            array_at(shifted(tape_at, fine_at), (fine, _FINE_COLUMNS)),
            array_at(shifted(tape_at, coarse_at), (coarse, _COARSE_COLUMNS)),
        ),
        Rail(
            scalars[_SINES_PER_NODE],
            array_at(shifted(tape_at, rail_at), (rail, _RAIL_COLUMNS)),
        ),
        Patches(
            scalars[_NODES_PER_LOG],
            scalars[_SHEAR_PA],
            layout[_MODEL],
            layout[_CELLS],
            array_at(shifted(tape_at, patches_at), (patches, _PATCH_COLUMNS)),
        ),
        scalars[_CONTACT_DAMPING_N_S_M],
        scalars[_ROLLER_M],
        array_at(shifted(layout_at, _BOGIE_OF), (_WHEELSETS,)),
    )
    _obey(
        _motion_at(memory_at),
        coach,
        scalars[_STEP_S],
        scalars[_ROLLER_INERTIA_KGM2],
        _law_on(scalars),
    )


@kernel_inlined
def _obey(state, coach, step_s, roller_inertia_kgm2, law):
    """Do the action in the ports: start the coach or advance it by a step."""
    ports = state.ports
    if ports[coach_state.ACTION] == START:
        motion.start(state, coach, ports[coach_state.SPEED_M_S])
        return
    motion.step(
        state,
        coach,
        step_s,
        ports[ROLLER_RAD_S : ROLLER_RAD_S + _WHEELSETS],
        ports[MOTOR_NM : MOTOR_NM + _WHEELSETS],
        roller_inertia_kgm2,
        ports[BRAKE_NM : BRAKE_NM + _WHEELSETS],
        ports[BRAKE_ACTS_NM : BRAKE_ACTS_NM + _WHEELSETS],
        ports[coach_state.RESISTANCE_N],
        ports[MU_CD : MU_CD + _WHEELSETS],
        ports[MU_CR : MU_CR + _WHEELSETS],
        law,
    )
    ports[coach_state.SPEED_M_S] = motion.mean_speed(state.v, coach)


_NAME = "rollerrig_coach"
_call = c_function.external_function(_NAME, "void", FLOATS, FLOATS, INTEGERS)
# the compiled function, which lives as long as this module
_compiled: list[Any] = []


def prepare() -> None:
    """Compile the coach, or load it from the cache, before any kernel that calls `run`."""
    if not _compiled:
        _compiled.append(c_function.compile_named(_NAME, _act, FLOATS, FLOATS, INTEGERS))


@kernel_inlined
def run(buffer, tape, layout):
    """Do the action in the ports of a coach.

    `buffer` (coach_state.SIZE,) is its memory; `packed` returns tape and layout.
    """
    _call(buffer.ctypes, tape.ctypes, layout.ctypes)
