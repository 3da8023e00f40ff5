"""What the identification knows of each mechanism beyond its formula: one row a cause.

Which shapes the search tries and between which bounds it refines them, what a cause costs, along what
its remainder may go. What a cause moves in a replay follows from its row in `mechanisms`: a course of
friction, torque or load, or constants of the model; the few others have columns of their own.
"""

from collections.abc import Mapping
from typing import NamedTuple

from rollerrig.rig.mechanisms.mechanism import Mechanism
from rollerrig.rig.mechanisms.table import BY_NAME

Shape = dict[str, float]
ALPHA_CAUSE = 0.02 / 30.0  # chance of a false alarm that a cause may have


class Search(NamedTuple):
    """How one cause is looked for. `name` is that of its mechanism."""

    name: str
    shapes: tuple[Shape, ...] = ({},)  # those that are tried
    scales: Mapping[
        str, tuple[float, float]
    ] = {}  # shape parameters that are then moved, with their bounds
    floor: float = (
        0.0  # what the filter's numerics may pretend, one deviation, in the unit of the coefficient
    )
    price: int = 0  # coefficients that its choice of shape is worth, beyond those that are fitted
    goes_by: tuple[
        str, ...
    ] = ()  # covariates along which more may remain, for its shape may differ there
    each_axle: bool = False  # looked for on single axles only
    phase: str = ""  # a shape parameter that is found as cosine and sine, for each run its own
    edge_step: float = 0.0  # it acts in a window: first step of its edges, m or s; searched in bins
    alpha: float = ALPHA_CAUSE
    not_elsewhere: str = ""  # what of it is not known for runs that were not fitted

    @property
    def mechanism(self) -> Mechanism:
        """Its formula and parameters."""
        return BY_NAME[self.name]

    @property
    def axles(self) -> tuple[int, ...]:
        """Axles on which it is looked for, 0: all of them alike."""
        if not self.mechanism.axlewise:
            return (0,)
        return (1, 2, 3, 4) if self.each_axle else (0, 1, 2, 3, 4)


def _of(key: str, *values: float) -> tuple[Shape, ...]:
    """The default shape for a value of 0, else that value."""
    return tuple({key: value} if value else {} for value in values)


ALONE: Shape = {"contaminant_alone": 1.0}
TABLE = (
    Search(
        "rail_cleaning",
        (*_of("energy_J_m", 10.0, 40.0, 150.0, 600.0, 2000.0), ALONE | {"energy_J_m": 150.0}),
        {"energy_J_m": (3.0, 4000.0)},
        goes_by=("axle", "load", "time of one axle"),
    ),
    Search(
        "speed_dependent_friction",
        (*_of("knee_m_s", 0.0, 12.0), ALONE),
        {"knee_m_s": (4.0, 80.0)},
        goes_by=("speed",),
    ),
    Search(
        "friction_trend",
        (*_of("time_s", 0.0, 10.0, 4.0), ALONE, ALONE | {"time_s": 10.0}),
        {"time_s": (1.5, 60.0)},
        goes_by=("time",),
    ),
    Search(
        "negative_conditioning",
        (*_of("distance_m", 10.0, 30.0, 100.0), ALONE | {"distance_m": 30.0}),
        {"distance_m": (3.0, 400.0)},
        floor=0.005,
        price=1,
    ),
    Search("brake_gain"),
    Search("torque_offset", _of("from_Nm", 0.0, 300.0)),
    Search("pad_fade", _of("heat_MJ", 0.0, 3.0), {"heat_MJ": (0.5, 40.0)}, goes_by=("disc_heat",)),
    Search("wet_pads", _of("turns", 3.0, 12.0), {"turns": (0.5, 100.0)}, goes_by=("time",)),
    Search("running_resistance", _of("speed_power", 0.0, 1.0, 2.0), goes_by=("vehicle speed",)),
    Search("track_gradient"),
    Search("roller_curvature", floor=0.02),
    Search("interfacial_layer", _of("whole", 0.0, 1.0), floor=0.03),
    Search(
        "falling_friction",
        (*_of("height", 0.0, 1.0), ALONE, ALONE | {"height": 1.0}),
        floor=0.01,
        goes_by=("sliding",),
    ),
    Search(
        "adhesion_memory",
        ({}, {"speed_power": 1.0}, {"of_work": 1.0}),
        floor=0.15,
        goes_by=("energy",),
    ),
    Search("torque_sensor_delay", floor=0.001),
    Search("speed_sensor_delay", floor=0.001),
    Search("wheel_inertia", floor=0.006),
    Search("wheel_radius", floor=3e-5, each_axle=True),
    Search("load_transfer", price=1),
    Search(
        "wheel_out_of_round",
        price=2,
        each_axle=True,
        phase="phase_rad",
        not_elsewhere="the angle of an out-of-round wheel at the start is",
    ),
    # all runs go over the same rail: an irregularity of longer waves than the clean sets' looks like a patch
    Search("contaminated_patch", (), price=2, edge_step=12.0, alpha=2e-5),
    Search("sanding", (), price=6, edge_step=1.0, not_elsewhere="the moments of sanding are"),
    Search("empirical", ()),
)
OF: dict[str, Search] = {row.name: row for row in TABLE}
