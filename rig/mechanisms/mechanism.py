"""The type of a mechanism's row: what it acts on, its parameters, its formula.

A formula is either a course, a kernel of covariates by their names (COVARIATES) and then of the row's
shape parameters in their order; or a function of constants of the model by their names, which returns
those that it changes. Its docstring is the formula that reports show. Plant, coach and replay call it.
"""

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

from rollerrig.configs import table
from rollerrig.configs.table import Row
from rollerrig.rig.compiled.kernel import kernel

FRICTION, TORQUE, LOAD, VEHICLE, SENSOR, WHEEL, CONTACT = (
    "friction",
    "torque",
    "load",
    "vehicle",
    "sensor",
    "wheel",
    "contact",
)
WIDE = 1e4  # a scale as wide as this is none
# what the coach in 3D knows of a mechanism: it, it for all axles alike, nothing
WHOLLY, AXLES_ALIKE, NOT = "wholly", "all axles alike", "not"


class Covariate(NamedTuple):
    """What a course may depend on, under the name by which prepared runs have it.

    `of_plant` says where the plant has it, for `axle` at `place_m`; `word` is its name in the formula of
    an empirical term, whose code is its place in the table, from 1.
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
    """One possible cause: `acts_on` is the place in the model, `courses` or `constants` its formula.

    The first `free` parameters are coefficients, 0 when the mechanism is absent, each with its course;
    the others give its shape. A coefficient whose lower bound is 0 has a sign by nature. With `share`
    a course is a share of the torque or load itself. `constants` changes those of `changes`.
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
        """Whether it may act on one axle alone."""
        return self.parameters[-1].name == "axle"

    @property
    def formula_parameters(self) -> tuple[Row, ...]:
        """All but the axle, and but which friction it acts on."""
        beside = (AXLE.name, ALONE.name if self.acts_on == FRICTION else "")
        return tuple(row for row in self.parameters if row.name not in beside)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Keys of its coefficients in the section [mechanisms]."""
        return tuple(f"{self.name}_{row.name}" for row in self.parameters[: self.free])


def arguments(course: Any, shape: int) -> list[str]:
    """The covariates of a course that has this many shape parameters."""
    names = list(inspect.signature(course).parameters)
    return names[: len(names) - shape]


def number(name: str, low: float, high: float, unit: str, default: float = 0.0) -> Row:
    """A parameter of a mechanism."""
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
    """The row of a course or, with `changes`, of a function of constants, which gives it its name and formula."""
    given: dict[str, Any] = (
        {"constants": formula, "changes": changes} if changes else {"courses": (formula,)}
    )
    words = " ".join((formula.__doc__ or "").split("\n\n")[0].split())
    return Mechanism(formula.__name__, acts_on, parameters, words, text, source, **given | more)


AXLE = number("axle", 0, 8, "wheelset it acts on, counted from 1; 0: all")
ALONE = number(
    "contaminant_alone", 0.0, 1.0, "-"
)  # 1: it acts on the degraded friction, 0: on the recovered too


@kernel
def saturating(x, scale):
    """x that levels off at a scale: scale (1 - exp(-x / scale)), x itself where the scale is wide."""
    return x if scale >= WIDE else -scale * math.expm1(-x / scale)
