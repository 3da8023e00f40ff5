"""The table of causes: how the identification searches for each mechanism, one row per cause.

A row states which shapes the search tries, within which limits it refines them, what a cause costs,
and along which covariates it may leave a remainder. How a cause changes a replay follows from its
row in `mechanisms`: a course of friction, torque or load, or constants of the model. The few other
causes have their columns in `columns`.
"""

from collections.abc import Mapping
from typing import NamedTuple

from rollerrig.configs.vehicle import AXLES_OF_BOGIE
from rollerrig.rig.mechanisms import table as mechanisms
from rollerrig.rig.mechanisms.mechanism import Mechanism

Shape = dict[str, float]
ALPHA_CAUSE = 0.02 / 30.0  # probability of a false alarm that a cause may have


class Search(NamedTuple):
    """How the identification searches for a cause. `name` is that of its mechanism."""

    name: str

    # the shapes that the search tries
    shapes: tuple[Shape, ...] = ({},)

    # shape parameters that are refined afterwards, and their limits
    scales: Mapping[str, tuple[float, float]] = {}

    # standard deviation, in the unit of the coefficient, that numerical errors of the filter cause
    floor: float = 0.0

    # the choice of a shape counts as so many coefficients, in addition to the fitted ones
    price: int = 0

    # covariates along which the cause may leave a remainder, because its true shape may differ
    remainder_along: tuple[str, ...] = ()

    # the cause is searched for on single wheelsets only
    single_axles_only: bool = False

    # the cause is searched for on the wheelsets of each bogie too
    on_bogies: bool = False

    # a shape parameter that is fitted as cosine and sine, separately for each run
    phase: str = ""

    # causes that differ from this one only in how their effect depends on load
    alike_at_one_load: tuple[str, ...] = ()

    # above 0: the cause acts in a window, which is searched for in bins; this is the first step, in
    # m or s, by which its edges are then moved
    edge_step: float = 0.0

    # above 0: the cause has no derivative at size 0 that the noise of a filter would not spoil, so
    # the replay is repeated with a coefficient of this size, in its unit; else the linearised
    # filter serves
    finite_step: float = 0.0

    alpha: float = ALPHA_CAUSE

    # runs that were not fitted do not show the shape of the cause, for example its moments
    unknown_in_other_runs: bool = False

    @property
    def mechanism(self) -> Mechanism:
        """The formula and the parameters of the cause."""
        return mechanisms.BY_NAME[self.name]

    def places(self, axles: int) -> tuple[int, ...]:
        """Return where the cause is searched for on a vehicle with this number of axles.

        A place is one of `configs.vehicle.wheelsets_of`.
        """
        if not self.mechanism.axlewise:
            return (0,)
        single = tuple(range(1, axles + 1))
        if self.single_axles_only:
            return single
        if not self.on_bogies:
            return (0, *single)
        bogies = range(1, axles // AXLES_OF_BOGIE + 1)
        return (0, *single, *(-bogie for bogie in bogies))


def _shapes(key: str, *values: float) -> tuple[Shape, ...]:
    """Return a shape for each value of a parameter; the value 0 means the default shape."""
    return tuple({key: value} if value else {} for value in values)


CONTAMINANT_ALONE: Shape = {"contaminant_alone": 1.0}
TABLE = (
    Search(
        "rail_cleaning",
        shapes=(
            *_shapes("energy_J_m", 10.0, 40.0, 150.0, 600.0, 2000.0),
            CONTAMINANT_ALONE | {"energy_J_m": 150.0},
        ),
        scales={"energy_J_m": (3.0, 4000.0)},
        remainder_along=("axle", "load", "time of one axle"),
    ),
    Search(
        "speed_dependent_friction",
        shapes=(*_shapes("knee_m_s", 0.0, 12.0), CONTAMINANT_ALONE),
        scales={"knee_m_s": (4.0, 80.0)},
        remainder_along=("speed",),
    ),
    Search(
        "friction_trend",
        shapes=(
            *_shapes("time_s", 0.0, 10.0, 4.0),
            CONTAMINANT_ALONE,
            CONTAMINANT_ALONE | {"time_s": 10.0},
        ),
        scales={"time_s": (1.5, 60.0)},
        remainder_along=("time",),
    ),
    Search(
        "negative_conditioning",
        shapes=(
            *_shapes("distance_m", 10.0, 30.0, 100.0),
            CONTAMINANT_ALONE | {"distance_m": 30.0},
        ),
        scales={"distance_m": (3.0, 400.0)},
        floor=0.007,
        price=1,
    ),
    Search("brake_gain", on_bogies=True),
    Search("torque_offset", shapes=_shapes("from_Nm", 0.0, 300.0), on_bogies=True),
    Search(
        "pad_fade",
        shapes=_shapes("heat_MJ", 0.0, 3.0),
        scales={"heat_MJ": (0.5, 40.0)},
        remainder_along=("disc_heat",),
    ),
    Search(
        "wet_pads",
        shapes=_shapes("turns", 3.0, 12.0),
        scales={"turns": (0.5, 100.0)},
        remainder_along=("time",),
    ),
    Search(
        "running_resistance",
        shapes=_shapes("speed_power", 0.0, 1.0, 2.0),
        remainder_along=("vehicle speed",),
    ),
    Search("track_gradient"),
    Search("roller_curvature", floor=0.028, alike_at_one_load=("interfacial_layer",)),
    Search(
        "interfacial_layer",
        shapes=_shapes("whole", 0.0, 1.0),
        floor=0.042,
        alike_at_one_load=("roller_curvature",),
    ),
    Search(
        "falling_friction",
        shapes=(
            *_shapes("height", 0.0, 1.0),
            CONTAMINANT_ALONE,
            CONTAMINANT_ALONE | {"height": 1.0},
        ),
        floor=0.014,
        remainder_along=("sliding",),
    ),
    Search(
        "adhesion_memory",
        shapes=({}, {"speed_power": 1.0}, {"of_work": 1.0}),
        floor=0.2,
        remainder_along=("energy",),
        finite_step=2.0,
    ),
    Search("torque_sensor_delay", floor=0.0014),
    Search("speed_sensor_delay", floor=0.001),
    Search("wheel_inertia", floor=0.006),
    Search("wheel_radius", floor=4e-5, single_axles_only=True),
    # its price makes the radius the first of the two where the data do not distinguish them
    Search("sensor_scale", floor=4e-5, price=1, single_axles_only=True),
    Search("load_transfer", price=1),
    Search(
        "wheel_out_of_round",
        price=2,
        single_axles_only=True,
        phase="phase_rad",
        unknown_in_other_runs=True,
    ),
    # Its alpha is small, because all runs use the same rail: an irregularity with longer waves than
    # those of the null simulations looks like a patch.
    Search("contaminated_patch", shapes=(), price=2, edge_step=12.0, alpha=2e-5),
    Search(
        "sanding",
        shapes=(),
        price=6,
        edge_step=1.0,
        unknown_in_other_runs=True,
    ),
    Search("empirical", shapes=()),
)
BY_NAME: dict[str, Search] = {row.name: row for row in TABLE}
