"""The type of a mechanism's row: its place in the model, its parameters, its formula.

The formula of a mechanism is a function of one of two kinds:

- A course is a kernel. It returns the effect that one unit of the mechanism's coefficient has at
  one moment. Its first arguments are covariates (names in COVARIATES). The shape parameters of the
  mechanism follow, in the order of its row.
- A function of constants changes constants of a model. Its first argument maps the names of these
  constants to their values. All parameters of the mechanism's formula follow, in the order of its
  row. It returns the constants that it changes, by name.

Plant, coach and replay call the same function. Reports show the first paragraph of its docstring.
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
# A scale of this value or above has no effect: the mechanism does not level off (see `saturating`).
# The unit is that of the scale: m/s, s or MJ. No speed, time or heat of a stop comes near it.
WIDE = 1e4
# whether the coach in 3D models a mechanism: completely, only on all axles alike, or not at all
MODELLED = "completely"
MODELLED_ON_ALL_AXLES = "all axles alike"
NOT_MODELLED = "not"


class Covariate(NamedTuple):
    """A quantity that a course may depend on.

    An empirical term identifies its covariate by a number: 1 is the first row of COVARIATES. Rows
    with a `word` must come first there, because the plant counts only these.
    """

    name: str  # as an argument of a course, and as a field of prepared runs
    of_plant: str  # Python expression in the plant; its variables are `applied._ARGUMENTS`
    word: str = ""  # name in the formula of an empirical term; empty: never in such a term
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

    Its first `free` parameters are coefficients. A coefficient is 0 when the mechanism is absent; a
    lower bound of 0 means that its sign is fixed by nature. The other parameters are shape
    parameters. AXLE comes last if the mechanism has it.
    """

    name: str
    acts_on: str  # its place in the model: FRICTION, TORQUE, ...
    parameters: tuple[Row, ...]
    formula: str  # as reports show it
    text: str  # what is wrong when this is the cause; reports show it
    source: str
    courses: tuple[Any, ...] = ()  # a kernel for each coefficient
    share: bool = False  # a course is a share of the torque or load, not an addition in its unit
    constants: Callable[..., dict[str, Any]] | None = None  # function of constants
    changes: tuple[str, ...] = ()  # names of the constants that `constants` changes
    free: int = 1  # number of coefficients
    in_coach: str = MODELLED

    @property
    def axlewise(self) -> bool:
        """Whether the mechanism may act on a single axle."""
        return self.parameters[-1].name == "axle"

    @property
    def formula_parameters(self) -> tuple[Row, ...]:
        """The parameters that are arguments of the formula.

        The model itself reads the others: the axle, and for friction `contaminant_alone`. A
        function of constants reads `contaminant_alone` itself.
        """
        read_by_model = {AXLE.name}
        if self.acts_on == FRICTION:
            read_by_model.add(ALONE.name)
        return tuple(row for row in self.parameters if row.name not in read_by_model)

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Keys of the coefficients in the section [mechanisms]."""
        return tuple(f"{self.name}_{row.name}" for row in self.parameters[: self.free])


def arguments(course: Any, shape_count: int) -> list[str]:
    """Return the arguments of a course without its last `shape_count`, the shape parameters.

    These are the names of its covariates.
    """
    names = list(inspect.signature(course).parameters)
    return names[: len(names) - shape_count]


def number(name: str, low: float, high: float, unit: str, default: float = 0.0) -> Row:
    """Return a parameter of a mechanism. `unit` may also be a short text that explains it."""
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
    """Return the row of a mechanism with one formula.

    `formula` is a course. With `changes` it is a function of constants, and `changes` are the
    constants that it changes. The mechanism has the name of this function, and the text of its
    formula is the first paragraph of the function's docstring. `more` are further fields of
    `Mechanism`; `courses` among them replaces the single course.
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


AXLE = number(
    "axle", -4, 8, "wheelset it acts on, counted from 1; 0: all; -1: those of the first bogie, ..."
)
# 1: the mechanism acts on the degraded friction alone, 0: on the recovered friction too
ALONE = number("contaminant_alone", 0.0, 1.0, "-")


@kernel
def saturating(x, scale):
    """Return x levelled off at a scale: scale (1 - exp(-x / scale)), or x for a scale >= WIDE."""
    return x if scale >= WIDE else -scale * math.expm1(-x / scale)
