"""The type of a mechanism's row: its place in the model, its parameters, its formula.

A formula is one of two things. A course is a kernel whose arguments are covariates by their names
(COVARIATES), followed by the shape parameters of the row in their order. Or it is a function of the
constants of the model by their names, which returns the constants that it changes. The docstring is
the formula that reports show. Plant, coach and replay call the same formula.
"""

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

from rollerrig.configs import table
from rollerrig.configs.table import Row
from rollerrig.rig.compiled.kernel import kernel

# the places in the model that a mechanism acts on
FRICTION = "friction"
TORQUE = "torque"
LOAD = "load"
VEHICLE = "vehicle"
SENSOR = "sensor"
WHEEL = "wheel"
CONTACT = "contact"
# a scale this wide has no effect
WIDE = 1e4
# whether the coach in 3D contains a mechanism: completely, only for all axles alike, or not
WHOLLY = "wholly"
AXLES_ALIKE = "all axles alike"
NOT = "not"


class Covariate(NamedTuple):
    """A quantity that a course may depend on, under its name in prepared runs.

    `of_plant` is the expression of it in the plant, for `axle` at `place_m`. `word` is its name in
    the formula of an empirical term; its code there is its place in the table, from 1.
    """

    name: str
    of_plant: str
    word: str = ""
    unit: str = ""


COVARIATES = (
    Covariate("speed_m_s", "state.vehicle_speed[0]", "speed", "m/s"),
    Covariate("time_s", "state.time[0]", "time", "s"),
    Covariate("place_m", "place_m", "place", "m"),
    Covariate("sliding_m_s", "state.sliding[axle]", "sliding", "m/s"),
    Covariate("load_N", "state.wheel_load[axle]", "load", "N"),
    Covariate("energy_J_m", "state.dissipated_energy[axle]", "energy", "J/m"),
    Covariate("heat_MJ", "1e-6 * state.brake_work[axle]", "disc_heat", "MJ"),
    Covariate("slid_m", "state.sliding_distance[axle]", "slid", "m"),
    Covariate("angle_rad", "state.wheel_angle[axle]", "wheel_angle", "rad"),
    Covariate("axle", "axle"),
    Covariate("cleaned_J_m", "state.rail_work[axle]"),
    Covariate("braked_rad", "state.braked_angle[axle]"),
    Covariate("brake_Nm", "capacity_Nm"),
    Covariate("deceleration_m_s2", "-state.felt_acceleration[0]"),
)


class Mechanism(NamedTuple):
    """One possible cause.

    `acts_on` is its place in the model. Its formula is in `courses` or in `constants`. The first
    `free` parameters are coefficients, 0 when the mechanism is absent, each with its course. The
    others are shape parameters. A coefficient whose lower bound is 0 has a fixed sign by nature.
    With `share` a course is a share of the torque or load. `constants` changes the constants in
    `changes`.
    """

    name: str
    acts_on: str
    parameters: tuple[Row, ...]
    formula: str
    text: str
    source: str
    courses: tuple[Any, ...] = ()
    share: bool = False
    constants: Callable[..., dict[str, Any]] | None = None
    changes: tuple[str, ...] = ()
    free: int = 1
    in_coach: str = WHOLLY

    @property
    def axlewise(self) -> bool:
        """Whether the mechanism may act on a single axle."""
        return self.parameters[-1].name == "axle"

    @property
    def formula_parameters(self) -> tuple[Row, ...]:
        """The parameters of the formula, without those that choose an axle or a friction."""
        choosing = {AXLE.name}
        if self.acts_on == FRICTION:
            choosing.add(ALONE.name)
        return tuple(row for row in self.parameters if row.name not in choosing)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Keys of the coefficients in the section [mechanisms]."""
        return tuple(f"{self.name}_{row.name}" for row in self.parameters[: self.free])


def arguments(course: Any, shape: int) -> list[str]:
    """Returns the covariates of a course that has this many shape parameters."""
    names = list(inspect.signature(course).parameters)
    return names[: len(names) - shape]


def number(name: str, low: float, high: float, unit: str, default: float = 0.0) -> Row:
    """Returns a parameter of a mechanism."""
    return table.number(name, default, low, high, unit)


def row_of(
    acts_on: str,
    formula: Callable[..., Any],
    parameters: tuple[Row, ...],
    text: str,
    source: str,
    changes: tuple[str, ...] = (),
    **more: Any,
) -> Mechanism:
    """Returns the row of a course or, with `changes`, of a function of constants.

    The function gives the row its name, and the first paragraph of its docstring the formula.
    """
    fields: dict[str, Any] = {"courses": (formula,)}
    if changes:
        fields = {"constants": formula, "changes": changes}
    fields.update(more)
    paragraph = (formula.__doc__ or "").split("\n\n")[0]
    return Mechanism(
        name=formula.__name__,
        acts_on=acts_on,
        parameters=parameters,
        formula=" ".join(paragraph.split()),
        text=text,
        source=source,
        **fields,
    )


AXLE = number("axle", 0, 8, "wheelset it acts on, counted from 1; 0: all")
# 1: the mechanism acts on the degraded friction alone, 0: on the recovered friction too
ALONE = number("contaminant_alone", 0.0, 1.0, "-")


@kernel
def saturating(x, scale):
    """Returns x levelled off at a scale: scale (1 - exp(-x / scale)); x where the scale is wide."""
    return x if scale >= WIDE else -scale * math.expm1(-x / scale)
