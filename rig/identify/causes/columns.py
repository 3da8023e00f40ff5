"""The list of all that could change a replay: base parameters, causes, and smooth functions.

A column is a course in time of the change of a wheel's acceleration (and of the vehicle's) for a
unit of one coefficient. Base parameters always stay in the fit, those with a declared tolerance
under a prior; a cause is one or several columns, some causes have variants of shape.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.rig.identify.causes import courses
from rollerrig.rig.identify.data.preparation import Design
from rollerrig.rig.identify.filter import sensitivity
from rollerrig.rig.identify.filter.sensitivity import Inputs, Linear

AXLES = 4
PLACE_BIN_M = 25.0
TIME_BIN_S = 2.0
BASE = "base"
# tolerance of ln tau and of the contact's constants, which the base may use freely
_FREE = 0.0


class Column(NamedTuple):
    """One coefficient: whose it is, its label, prior deviation (0: free)."""

    owner: str
    label: str
    prior: float


# causes in given shapes
Shaped = tuple[tuple[str, dict[str, float]], ...]


class Variant(NamedTuple):
    """A cause in one shape: the columns that it frees, and what the shape is."""

    cause: str
    columns: tuple[int, ...]
    shape: dict[str, float]
    axle: int  # 0: all


class SensitivityMatrix(NamedTuple):
    """Columns, their courses and variants. `wheel` (n, columns), `vehicle` (nv, columns)."""

    columns: list[Column]
    wheel: np.ndarray
    vehicle: np.ndarray
    variants: list[Variant]


class _Writer:
    """Collects columns: a wheel part (flat) and a vehicle part (flat)."""

    def __init__(self, design: Design) -> None:
        self.design = design
        self.columns: list[Column] = []
        self.wheel: list[np.ndarray] = []
        self.vehicle: list[np.ndarray] = []
        self.variants: list[Variant] = []

    def add(self, owner: str, label: str, wheel: np.ndarray | None,
            vehicle: np.ndarray | None = None, prior: float = _FREE) -> int:
        d = self.design
        self.columns.append(Column(owner, label, prior))
        self.wheel.append(np.zeros(d.measured_rad_s.size, np.float32) if wheel is None
                          else wheel.astype(np.float32))
        self.vehicle.append(np.zeros(d.vehicle_m_s.size, np.float32) if vehicle is None
                            else vehicle.astype(np.float32))
        return len(self.columns) - 1

    def variant(self, cause: str, columns: list[int], axle: int = 0) -> None:
        self.variants.append(Variant(cause, tuple(columns), {}, axle))

    def shaped(self, cause: str, column: int, axle: int, shape: dict[str, float]) -> None:
        self.variants.append(Variant(cause, (column,), shape, axle))


def of_axle(design: Design, axle: int) -> np.ndarray:
    """1 on the samples of an axle (0 the leading), shape (n,)."""
    return np.repeat((design.axle == axle).astype(float), np.diff(design.start))


def of_run(design: Design, run: int) -> np.ndarray:
    """1 on the samples of a run."""
    return np.repeat((design.run == run).astype(float), np.diff(design.start))


def smooth_torque(design: Design, torque: np.ndarray) -> np.ndarray:
    """Torque smoothed within each segment (0.03 s), half a sample on: of the step that follows."""
    out = np.empty_like(torque)
    for s in range(design.segments):
        at = design.span(s)
        smooth = gaussian_filter1d(torque[at], 0.03 / design.step_s, mode="nearest")
        out[at] = 0.5 * (smooth + np.append(smooth[1:], smooth[-1]))
    return out


def rate(design: Design, values: np.ndarray) -> np.ndarray:
    """d/dt within each segment."""
    out = np.empty_like(values)
    for s in range(design.segments):
        at = design.span(s)
        out[at] = np.gradient(values[at], design.step_s)
    return out


def to_vehicle(design: Design, force: np.ndarray) -> np.ndarray:
    """Sum over the wheelsets of a flat array, as one flat array of vehicles."""
    out = np.zeros(design.vehicle_m_s.size)
    for s in range(design.segments):
        run = int(design.run[s])
        at = slice(int(design.vehicle_start[run]), int(design.vehicle_start[run + 1]))
        out[at] += force[design.span(s)]
    return out


def vehicle_mass(design: Design) -> np.ndarray:
    """Mass in kg on each vehicle sample."""
    return np.repeat(design.mass_kg, np.diff(design.vehicle_start))


def write(design: Design, inputs: Inputs, linear: Linear,
          only: frozenset[str] | None = None, shaped: Shaped = ()) -> SensitivityMatrix:
    """Columns of a design around a replay: all, or those of some owners; and shapes of causes."""
    w = _Writer(design)
    torque = smooth_torque(design, inputs.torque_Nm)
    _base(w, design, inputs, linear, torque)
    friction = linear.rates[:, sensitivity.FRICTION]
    groups: tuple[tuple[tuple[str, ...], Callable[[], None]], ...] = (
        (("rail_cleaning", "speed_dependent_friction", "friction_trend", "negative_conditioning"),
         lambda: _friction_causes(w, design, friction)),
        (("brake_gain", "torque_offset", "pad_fade", "running_resistance", "track_gradient"),
         lambda: _torque_causes(w, design, inputs, torque)),
        (("roller_curvature", "interfacial_layer", "falling_friction", "adhesion_memory"),
         lambda: _contact_causes(w, design, linear)),
        (("torque_sensor_delay", "speed_sensor_delay", "wheel_inertia", "wheel_radius"),
         lambda: _sensor_causes(w, design, inputs, linear, torque)),
        (("load_transfer", "wheel_out_of_round"), lambda: _load_causes(w, design, linear)),
        (("windows",), lambda: _windows(w, design, friction)),
        (("along",), lambda: _smooth_functions(w, design, linear)),
    )
    for owners, build in groups:
        if only is None or only & set(owners):
            build()
    _shaped(w, design, friction, lambda owner, label, change: _torque_column(
        w, design, inputs, owner, label, change * torque), shaped)
    return SensitivityMatrix(w.columns, np.column_stack(w.wheel), np.column_stack(w.vehicle), w.variants)


def _torque_column(w: _Writer, d: Design, inputs: Inputs, owner: str, label: str,
                   change: np.ndarray, prior: float = _FREE) -> int:
    inertia = inputs.parameters[0, 1]
    return w.add(owner, label, -change / inertia,
                 -to_vehicle(d, change) / (d.base[0] * vehicle_mass(d)), prior)


def _base(w: _Writer, d: Design, inputs: Inputs, linear: Linear, torque: np.ndarray) -> None:
    load = linear.rates[:, sensitivity.LOAD]
    tolerance = max(d.calibration, 1e-4)
    runs = d.mass_kg.size
    for run in range(runs):
        w.add(BASE, f"ln_mu_cd_{run}", linear.rates[:, sensitivity.LEVEL] * of_run(d, run))
    w.add(BASE, "ln_tau", linear.rates[:, sensitivity.TAU])
    _torque_column(w, d, inputs, BASE, "torque_gain", torque,
                   tolerance / np.sqrt(2.0))
    for j in range(AXLES):
        _torque_column(w, d, inputs, BASE, f"torque_gain_{j}", torque * of_axle(d, j),
                       tolerance / np.sqrt(2.0))
        w.add(BASE, f"load_gain_{j}", load * of_axle(d, j), None, tolerance)
    force = np.concatenate([sensitivity.vehicle_force(d, inputs, run) for run in range(runs)])
    for run in range(runs):
        mask = np.zeros_like(force)
        mask[d.vehicle_start[run]:d.vehicle_start[run + 1]] = 1.0
        w.add(BASE, f"mass_{run}", None, force * mask, tolerance)


def _empirical(w: _Writer, d: Design, friction: np.ndarray, shape: dict[str, float]) -> None:
    found = []
    for k, course in enumerate(courses.empirical(d, shape).T):
        if "on_vehicle" in shape:
            found.append(w.add("empirical", str(k), None,
                               -courses.of_vehicle(d, course) / vehicle_mass(d)))
        else:
            found.append(w.add("empirical", str(k), friction * course))
    w.variants.append(Variant("empirical", tuple(found), shape, 0))


# shapes that the search tries before it refines them
SHAPES: dict[str, tuple[dict[str, float], ...]] = {
    "rail_cleaning": ({"energy_J_m": 10.0}, {"energy_J_m": 40.0}, {"energy_J_m": 150.0},
                      {"energy_J_m": 600.0}, {"energy_J_m": 2000.0}),
    "speed_dependent_friction": ({}, {"knee_m_s": 12.0}),
    "friction_trend": ({}, {"time_s": 10.0}, {"time_s": 4.0}),
    "negative_conditioning": ({"distance_m": 10.0}, {"distance_m": 30.0}, {"distance_m": 100.0}),
}
TORQUE_SHAPES: dict[str, tuple[dict[str, float], ...]] = {
    "torque_offset": ({}, {"from_Nm": 300.0}),
    "pad_fade": ({}, {"heat_MJ": 3.0}),
    "running_resistance": ({}, {"speed_power": 1.0}, {"speed_power": 2.0}),
}
MEMORY_SHAPES: tuple[dict[str, float], ...] = ({}, {"speed_power": 1.0}, {"of_work": 1.0})


def _friction_causes(w: _Writer, d: Design, friction: np.ndarray) -> None:
    for name, shapes in SHAPES.items():
        for shape in shapes:
            at = w.add(name, "", friction * courses.course(d, name, shape))
            w.shaped(name, at, 0, shape)


def _shaped(w: _Writer, d: Design, friction: np.ndarray,
            of_torque: Callable[[str, str, np.ndarray], int], shaped: Shaped) -> None:
    """Causes in shapes off the search's grid, where they are not on it."""
    known = {(v.cause, tuple(sorted(v.shape.items()))) for v in w.variants}
    for name, shape in shaped:
        if (name, tuple(sorted(shape.items()))) in known:
            continue
        if name == "empirical":
            _empirical(w, d, friction, shape)
        elif name == "pad_fade":
            w.shaped(name, of_torque(name, "fade_1_MJ", -courses.heat(d, shape)), 0, shape)
        elif name in courses.NAMES:
            at = w.add(name, "", friction * courses.course(d, name, shape))
            w.shaped(name, at, 0, shape)


def _torque_causes(w: _Writer, d: Design, inputs: Inputs, torque: np.ndarray) -> None:
    def axles(name: str, label: str, change: np.ndarray, shape: dict[str, float]) -> None:
        w.shaped(name, _torque_column(w, d, inputs, name, label, change), 0, shape)
        for j in range(AXLES):
            at = _torque_column(w, d, inputs, name, label, change * of_axle(d, j))
            w.shaped(name, at, j + 1, shape)

    axles("brake_gain", "gain", torque, {})
    for shape in TORQUE_SHAPES["torque_offset"]:
        axles("torque_offset", "offset_Nm", courses.applied(d, shape), shape)
    for shape in TORQUE_SHAPES["pad_fade"]:
        at = _torque_column(w, d, inputs, "pad_fade", "fade_1_MJ",
                            -torque * courses.heat(d, shape))
        w.shaped("pad_fade", at, 0, shape)
    mass = vehicle_mass(d)
    for shape in TORQUE_SHAPES["running_resistance"]:
        at = w.add("running_resistance", "force_N", None, -courses.resistance(d, shape) / mass)
        w.shaped("running_resistance", at, 0, shape)
    at = w.add("track_gradient", "gradient", None, np.full(mass.size, -9.80665))
    w.shaped("track_gradient", at, 0, {})


def _contact_causes(w: _Writer, d: Design, linear: Linear) -> None:
    for name, label, index in (("roller_curvature", "stiffness_fraction", sensitivity.STIFFNESS),
                               ("interfacial_layer", "reduction", sensitivity.STICKING),
                               ("falling_friction", "fraction", sensitivity.GAMMA)):
        at = w.add(name, label, linear.rates[:, index])
        w.variant(name, [at])
    w.shaped("falling_friction", w.add("falling_friction", "fraction", linear.rates[:, sensitivity.HEIGHT]),
             0, {"height": 1.0})
    w.shaped("interfacial_layer", w.add("interfacial_layer", "reduction", -linear.rates[:, sensitivity.STIFFNESS]),
             0, {"whole": 1.0})
    # its answer is a finite step of the whole filter, see `tuning`
    for k, shape in enumerate(MEMORY_SHAPES):
        w.shaped("adhesion_memory", w.add("adhesion_memory", str(k), None), 0, shape)


def _sensor_causes(w: _Writer, d: Design, inputs: Inputs, linear: Linear,
                   torque: np.ndarray) -> None:
    inertia = inputs.parameters[0, 1]
    at = _torque_column(w, d, inputs, "torque_sensor_delay", "delay_s", rate(d, torque))
    w.variant("torque_sensor_delay", [at])
    # a late wheel speed: the wheel lives on the inputs of a moment ago
    surface = -linear.coefficients[:, 0]
    growth = np.log(np.maximum(-surface, 1e-12)) / d.step_s
    r = inputs.parameters[0, 0]
    late = rate(d, torque) / inertia + growth / r * rate(d, d.speed_m_s)
    accelerated = linear.rates[:, sensitivity.LATE] - torque / inertia
    for axle in range(AXLES + 1):
        mask = 1.0 if axle == 0 else of_axle(d, axle - 1)
        at = w.add("speed_sensor_delay", "delay_s", late * mask)
        w.variant("speed_sensor_delay", [at], axle=axle)
        at = w.add("wheel_inertia", "fraction", -accelerated * mask)
        w.variant("wheel_inertia", [at], axle=axle)
        if axle:
            at = w.add("wheel_radius", "fraction", linear.rates[:, sensitivity.RADIUS] * mask)
            w.variant("wheel_radius", [at], axle=axle)


def _load_causes(w: _Writer, d: Design, linear: Linear) -> None:
    load = linear.rates[:, sensitivity.LOAD]
    body = np.repeat(np.where(d.axle < 2, 1.0, -1.0), np.diff(d.start))
    bogie = np.repeat(np.where(d.axle % 2 == 0, 1.0, -1.0), np.diff(d.start))
    first = w.add("load_transfer", "body_s2_m", load * d.deceleration_m_s2 * body)
    second = w.add("load_transfer", "bogie_s2_m", load * d.deceleration_m_s2 * bogie)
    w.variant("load_transfer", [first, second])
    for j in range(AXLES):
        found = []
        for run in range(d.mass_kg.size):
            mask = of_axle(d, j) * of_run(d, run)
            for part, shape in (("cos", np.cos), ("sin", np.sin)):
                found.append(w.add("wheel_out_of_round", f"{part}_{run}",
                                   load * mask * shape(d.angle_rad)))
        w.variant("wheel_out_of_round", found, axle=j + 1)


def _windows(w: _Writer, d: Design, friction: np.ndarray) -> None:
    """Bins of place (all runs) and of time (each run): windows are runs of bins."""
    lowest, highest = d.places_m
    for i in range(int(np.ceil((highest - lowest) / PLACE_BIN_M))):
        low = lowest + i * PLACE_BIN_M
        inside = (d.place_m >= low) & (d.place_m < low + PLACE_BIN_M)
        w.add("place_bin", f"{low:.6g}", friction * inside)
    behind = 1.0 - of_axle(d, 0)
    for run in range(d.mass_kg.size):
        mask = of_run(d, run)
        for i in range(int(np.ceil(d.ends_s[run] / TIME_BIN_S))):
            inside = (d.time_s >= i * TIME_BIN_S) & (d.time_s < (i + 1) * TIME_BIN_S)
            label, change = f"{run} {i * TIME_BIN_S:.6g}", friction * inside * mask
            w.add("time_bin", label, change)
            w.add("time_bin behind", label, change * behind)


COVARIATES: dict[str, Callable[[Design, Linear], np.ndarray]] = {
    "sliding": lambda d, l: l.sliding_m_s,
    "speed": lambda d, l: d.speed_m_s,
    "time": lambda d, l: d.time_s,
    "energy": lambda d, l: np.sqrt(np.maximum(l.energy_J_m, 0.0)),
    "load": lambda d, l: d.load_N,
    "acceleration": lambda d, l: np.clip(l.acceleration_rad_s2, -30.0, 30.0),
    "disc_heat": lambda d, l: d.heat_MJ,
    "deceleration": lambda d, l: d.deceleration_m_s2,
}


def bumps(values: np.ndarray, count: int = 4) -> np.ndarray:
    """Smooth functions of a covariate: Gaussian bumps at its quantiles, shape (n, count)."""
    knots = np.quantile(values, np.linspace(0.04, 0.96, count))
    width = np.maximum(np.gradient(knots), 1e-3 * max(np.ptp(values), 1e-12))
    return np.exp(-0.5 * ((values[:, None] - knots) / width) ** 2)


def _smooth_functions(w: _Writer, d: Design, linear: Linear) -> None:
    friction = linear.rates[:, sensitivity.FRICTION]
    for name, of in COVARIATES.items():
        shapes = bumps(of(d, linear))
        w.variant(f"along {name}", [w.add(f"along {name}", str(i), friction * shapes[:, i])
                                    for i in range(shapes.shape[1])])
    w.variant("along axle", [w.add("along axle", str(j), friction * of_axle(d, j))
                             for j in range(AXLES - 1)])
    # what befalls one wheelset at some moment, not all the time
    shapes = bumps(d.time_s)
    shapes = shapes - shapes.mean(axis=0)
    for j in range(AXLES):
        w.variant("along time of one axle",
                  [w.add("along time of one axle", f"{j} {i}", friction * shapes[:, i] * of_axle(d, j))
                   for i in range(shapes.shape[1])], axle=j + 1)
    found = [w.add("along wheel_angle", str(k), friction * shape(k * d.angle_rad))
             for k in (1, 2) for shape in (np.cos, np.sin)]
    w.variant("along wheel_angle", found)
    time = d.time_s[np.concatenate([np.arange(d.start[4 * r], d.start[4 * r + 1])
                                    for r in range(d.mass_kg.size)])]
    speed = d.speed_m_s[np.concatenate([np.arange(d.start[4 * r], d.start[4 * r + 1])
                                        for r in range(d.mass_kg.size)])]
    for name, values in (("vehicle time", time), ("vehicle speed", speed)):
        shapes = bumps(values)
        w.variant(f"along {name}", [w.add(f"along {name}", str(i), None, shapes[:, i])
                                    for i in range(shapes.shape[1])])
