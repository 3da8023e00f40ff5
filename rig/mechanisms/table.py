"""What the base model leaves out: one row a mechanism, one coefficient a parameter.

Each mechanism changes one place of the base model: the friction under a wheel, the torque at a
wheelset, its load, its sensors or the resistance of the vehicle. Its size is a coefficient whose
default 0 is the base model itself, to the last bit. The same rows give the identification its
bounds, the extended model its keys and the report its words.

    friction:  mu_cd and mu_cr of an axle are multiplied by exp(sum of the friction terms)   [X1]
    torque:    C = (1 + gain) C_0 (1 - fade h(H)) + offset, H the brake work of the wheelset [X2]
    vehicle:   M dv/dt = -sum T - (R + dR + M g gradient)                                    [X3]
    contact:   d lambda/dx = (lambda_0 - lambda) / L, lambda_0 of the base model             [X4]

Sources: PHYSICS section 8 of the project's material; doubt: the shapes are the simplest ones.
"""

from typing import NamedTuple

from rollerrig.configs.table import Row, number

FRICTION, TORQUE, LOAD, VEHICLE, SENSOR, WHEEL, CONTACT = (
    "friction", "torque", "load", "vehicle", "sensor", "wheel", "contact")


class Mechanism(NamedTuple):
    """One possible cause. `acts_on` is the place in the model, `axlewise` one axle at a time.

    The first `free` parameters are coefficients, 0 when the mechanism is absent; the others give
    its shape. A coefficient whose lower bound is 0 has a sign by nature.
    """

    name: str
    acts_on: str
    parameters: tuple[Row, ...]
    formula: str
    text: str
    source: str
    axlewise: bool = False
    free: int = 1


def _row(name: str, low: float, high: float, text: str, default: float = 0.0) -> Row:
    return number(name, default, low, high, text)


_AXLE = _row("axle", 0, 8, "wheelset it acts on, counted from 1; 0: all")

TABLE: tuple[Mechanism, ...] = (
    Mechanism(
        "rail_cleaning", FRICTION,
        (_row("gain", 0.0, 1.0, "-"), _row("energy_J_m", 1.0, 5000.0, "J/m", 150.0)),
        "ln mu += gain (1 - exp(-W / energy)), W: work on this metre of rail by the wheels before",
        "leading wheels clean the rail for the following ones", "Allotta et al. 2014; PHYSICS 8"),
    Mechanism(
        "adhesion_memory", CONTACT,
        (_row("length_m", 0.0, 50.0, "m"), _row("speed_power", 0.0, 1.0, "-"),
         _row("of_work", 0.0, 1.0, "-")),
        "d lambda/dx = (lambda_0 - lambda) / (length (v / 20 m/s)^speed_power); of_work = 1: "
        "lambda_0 = 1 - exp(-tau W) of the work W done meanwhile, not that of the base model",
        "recovery lags the dissipated energy",
        "assumption; PHYSICS 8"),
    Mechanism(
        "speed_dependent_friction", FRICTION,
        (_row("slope_per_m_s", -0.05, 0.05, "s/m"), _row("knee_m_s", 2.0, 1e4, "m/s", 1e4)),
        "ln mu += slope knee (1 - exp(-(v - 20 m/s) / knee)), slope (v - 20 m/s) for a wide knee",
        "friction depends on the vehicle's speed",
        "Curtius and Kniffler 1950"),
    Mechanism(
        "negative_conditioning", FRICTION,
        (_row("loss", 0.0, 0.9, "-"), _row("distance_m", 1.0, 500.0, "m", 30.0)),
        "ln mu -= loss (1 - exp(-S / distance)), S: sliding distance of the wheel so far",
        "sliding destroys adhesion", "oil paste: Beagley and Pritchard 1975"),
    Mechanism(
        "contaminated_patch", FRICTION,
        (_row("depth", 0.0, 1.0, "-"), _row("start_m", -100.0, 1e5, "m"),
         _row("length_m", 0.0, 1e4, "m"), _row("ramp", 0.0, 1.0, "-")),
        "ln mu -= depth for start <= place < start + length; over the share ramp of the length, half "
        "at either end, it rises and falls as sin^2", "friction depends on the place",
        "assumption"),
    Mechanism(
        "friction_trend", FRICTION,
        (_row("rate_1_s", -0.2, 0.2, "1/s"), _row("time_s", 0.1, 1e4, "s", 1e4)),
        "ln mu += rate time (1 - exp(-t / time)), rate t for a long time",
        "friction drifts with time in a stop", "assumption"),
    Mechanism(
        "brake_gain", TORQUE, (_row("gain", -0.3, 0.3, "-"), _AXLE),
        "C = (1 + gain) C_0", "the brake gives another torque than told", "PHYSICS 6", True),
    Mechanism(
        "pad_fade", TORQUE,
        (_row("fade_1_MJ", 0.0, 0.2, "1/MJ"), _row("heat_MJ", 0.1, 1e4, "MJ", 1e4)),
        "C = C_0 (1 - fade heat (1 - exp(-H / heat))), H: brake work of the wheelset so far",
        "torque falls with the heat of the discs", "PHYSICS 6"),
    Mechanism(
        "torque_offset", TORQUE,
        (_row("offset_Nm", -1500.0, 1500.0, "N m"), _row("from_Nm", -1e4, 1e4, "N m", -1e4), _AXLE),
        "C = C_0 + offset where C_0 > from", "the torque has an offset", "PHYSICS 6", True),
    Mechanism(
        "running_resistance", VEHICLE,
        (_row("force_N", -5000.0, 5000.0, "N"), _row("speed_power", 0.0, 2.0, "-")),
        "R = R_0 + force (v / 20 m/s)^speed_power", "the vehicle runs with another resistance",
        "PHYSICS 8"),
    Mechanism(
        "track_gradient", VEHICLE, (_row("gradient", -0.03, 0.03, "-"),),
        "R = R_0 + M g gradient; uphill is positive", "the track is not level", "PHYSICS 8"),
    Mechanism(
        "wheel_radius", WHEEL, (_row("fraction", -0.06, 0.06, "-"), _AXLE),
        "r = r_0 (1 + fraction)", "the wheels of one axle have another radius", "PHYSICS 8", True),
    Mechanism(
        "wheel_inertia", WHEEL, (_row("fraction", -0.5, 1.0, "-"), _AXLE),
        "J = J_0 (1 + fraction)", "the wheelsets have another inertia", "PHYSICS 8", True),
    Mechanism(
        "speed_sensor_delay", SENSOR, (_row("delay_s", 0.0, 0.2, "s"), _AXLE),
        "measured omega(t) = omega(t - delay)", "the wheel speed is told late", "PHYSICS 6", True),
    Mechanism(
        "torque_sensor_delay", SENSOR, (_row("delay_s", 0.0, 0.2, "s"),),
        "measured C(t) = C(t - delay)", "the torque is told late", "PHYSICS 6"),
    Mechanism(
        "wheel_out_of_round", LOAD,
        (_row("amplitude", 0.0, 0.3, "-"), _row("phase_rad", -6.3, 6.3, "rad"), _AXLE),
        "N = N_0 (1 + amplitude cos(angle + phase))", "the load swings once a turn", "PHYSICS 8",
        True),
    Mechanism(
        "load_transfer", LOAD,
        (_row("body_s2_m", -0.1, 0.1, "s2/m"), _row("bogie_s2_m", -0.1, 0.1, "s2/m")),
        "N = N_0 (1 + d (body b_j + bogie g_j)), d: deceleration, b = ++--, g = +-+-",
        "braking shifts more load than told", "PHYSICS 8", free=2),
    Mechanism(
        "sanding", FRICTION,
        (_row("gain", 0.0, 2.0, "-"), _row("start_s", 0.0, 1e4, "s"),
         _row("duration_s", 0.0, 1e4, "s"), _row("behind", 0.0, 1.0, "-")),
        "ln mu += gain for start <= t < start + duration, each run with its own window; behind = 1: "
        "not under the first wheelset",
        "sand raises friction for a while", "assumption"),
    Mechanism(
        "roller_curvature", CONTACT, (_row("stiffness_fraction", -0.9, 2.0, "-"),),
        "eps = (1 + stiffness_fraction) eps_0", "the patch is that of another curvature",
        "PHYSICS 7"),
    Mechanism(
        "interfacial_layer", CONTACT,
        (_row("reduction", 0.0, 0.95, "-"), _row("whole", 0.0, 1.0, "-")),
        "k_ad, k_ar = (1 - reduction) of the base; whole = 1: k_sd, k_sr as well",
        "a layer softens the contact",
        "Polach 2005; PHYSICS 8"),
    Mechanism(
        "falling_friction", CONTACT,
        (_row("fraction", -0.95, 5.0, "-"), _row("height", 0.0, 1.0, "-")),
        "gamma_d, gamma_r = (1 + fraction) of the base; height = 1: 1 / A_d - 1, 1 / A_r - 1 instead",
        "friction falls with sliding otherwise than told", "Polach 2005; CONTACT user guide"),
)

# what `explain` writes down when none of the table explains: a formula, not a cause
EMPIRICAL = Mechanism(
    "empirical", FRICTION,
    (_row("linear", -1e4, 1e4, "-"), _row("quadratic", -1e4, 1e4, "-"),
     _row("covariate", 0.0, 9.0, "-"), _row("centre", -1e6, 1e6, "of the covariate"),
     _row("scale", 1e-6, 1e6, "of the covariate", 1.0), _row("period", 0.0, 1e4, "of the covariate")),
    "ln mu += linear z + quadratic z^2, z = (x - centre) / scale; with a period linear cos(2 pi x / "
    "period) + quadratic sin(2 pi x / period); x = 1 speed m/s, 2 time s, 3 place m, 4 sliding m/s, "
    "5 load N, 6 energy J/m, 7 disc heat MJ, 8 sliding distance m, 9 wheel angle rad",
    "an empirical term of one covariate", "fitted, no physics", free=2)

BY_NAME: dict[str, Mechanism] = {mechanism.name: mechanism for mechanism in (*TABLE, EMPIRICAL)}

# what a recording does to the truth; all else is in the plant
OF_RECORDING = ("speed_sensor_delay", "torque_sensor_delay")
IN_PLANT = tuple(name for name in BY_NAME if name not in OF_RECORDING)
PLANT_AXLES = 4
# the coach in 3D takes loads, radii and contacts from its own tables, where these have no place
NOT_OF_COACH = ("adhesion_memory", "wheel_out_of_round", "load_transfer", "roller_curvature")
# nor have these of one axle, while all axles may have another value
WHOLE_COACH = ("wheel_radius", "wheel_inertia")


def rows() -> tuple[Row, ...]:
    """Rows of the section [mechanisms] of a model: `<mechanism>_<parameter>`, default 0."""
    return tuple(
        row._replace(name=f"{name}_{row.name}",
                     high=PLANT_AXLES if row.name == "axle" else row.high)
        for name in IN_PLANT for row in BY_NAME[name].parameters)
