"""Every kernel of the lanes against its twin in the plant: random rigs in random states, by seed.

`TWINS` has a check for each kernel of `rig/lanes`, which compares it with the plant. A kernel
without a check fails, so the lanes cannot have arithmetic that the plant does not have. Both have
the same equations in another order: they agree to 1e-9 of the largest value of a row.
"""

import math

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher
from rolling import Rig

from rollerrig.rig import heat, plant, vehicle, wheelset
from rollerrig.rig.compiled.kernel import kernel
from rollerrig.rig.contact import adhesion
from rollerrig.rig.lanes import layout, quiet_tick, rail_cleaning, step
from rollerrig.rig.lanes.layout import rigs_of
from rollerrig.rig.mechanisms import applied
from rollerrig.rig.state import NAMES, views

AXLES = 4
RIGS = rigs_of(AXLES)
MODES = ("track", "contaminated_rollers")
CLOSE = 1e-9
# slots of a stage of a step, not of the state
OF_A_STAGE = (
    "wheel_rate",
    "roller_rate",
    "instantaneous_transition",
    "transition_before",
    *(name for name in NAMES if name.startswith("stage_")),
    # the last solution: the lanes keep their own
    "solved_work",
    "work_change",
    "work_change_before",
    "is_solved",
)
ORDER = (
    "pneumatics_and_motors",
    "contacts",
    "contacts_outside_domain",
    "begin",
    "predict",
    "contacts",
    "contacts_outside_domain",
    "finish",
    "move",
)
# kernels of the vehicles; the others are of the axles
OF_RIGS = ("predict", "move")
# rows that a kernel writes, and the slot of the plant's state with the same value after that step
WRITTEN_ROWS = {
    "pneumatics_and_motors": {
        "DEMAND": "brake_demand",
        "PRESSURE": "cylinder_pressure",
        "MOTOR": "motor_torque",
        "BRAKE": "brake_torque",
    },
    "begin": {"WHEEL_K": "wheel_rate", "ROLLER_K": "roller_rate"},
    "finish": {
        "WHEEL": "wheel_speed",
        "ROLLER": "roller_speed",
        "WHEEL_RAD": "wheel_angle",
        "ROLLER_RAD": "roller_angle",
        "BRAKE_WORK": "brake_work",
        "MOTOR_WORK": "motor_work",
        "FORCE": "contact_force",
        "BRAKE_MEAN": "brake_mean",
        "CAPACITY": "brake_capacity",
        "MOTOR_BEFORE": "motor_before",
    },
    "move": {
        "V": "vehicle_speed",
        "FELT": "felt_acceleration",
        "RATE": "vehicle_acceleration",
        "PLACE": "position",
        "RESISTANCE_WORK": "resistance_work",
        "SLIDING_WORK": "sliding_work",
    },
}


@kernel
def plant_step(state, target_Pa, params):
    plant.step(state, target_Pa, params)


@kernel
def scatter(w, rig, state, target_Pa):
    layout.scatter(w, rig, state, target_Pa)


@kernel
def gather(w, rig, state):
    layout.gather(w, rig, state)


def assert_close(values, expected, what=""):
    """Compare to CLOSE, relative to each value and to the largest one."""
    expected = np.asarray(expected, dtype=float)
    atol = CLOSE * np.abs(expected).max(initial=0.0)
    np.testing.assert_allclose(values, expected, rtol=CLOSE, atol=atol, err_msg=what)


def random_rig(rng, mode):
    """Return a rig that the lanes accept, of any mass, brake, wheels and contaminant."""
    adhesion_of = {
        "mu_cd": rng.uniform(0.01, 0.15),
        "mu_cr": rng.uniform(0.16, 0.4),
        "gamma_d_s_m": rng.uniform(0.0, 0.5),
        "tau_m_J": rng.choice([0.0, 1e-5, 1.9e-4, 1e-3]),
        "cleaning_creepage": rng.choice([0.05, 0.2, math.inf]),
        "cleaning_half_speed_m_s": rng.choice([0.0, 9.0]),
    }
    return Rig(
        30.0,
        step_s=1e-4,
        adhesion=adhesion_of,
        rig={"mode": mode},
        vehicle={
            "mass_kg": rng.uniform(2.5e4, 8e4),
            "wheel_radius_m": rng.uniform(0.35, 0.55),
            "wheelset_inertia_kgm2": rng.uniform(60.0, 300.0),
            "resistance_B_N_s_m": rng.uniform(0.0, 50.0),
            "body_height_m": rng.uniform(1.0, 2.5),
        },
        brake={
            "pad_friction": rng.uniform(0.1, 0.5),
            "fill_time_constant_s": rng.uniform(0.3, 3.0),
        },
        contact={"roller_radius_m": rng.uniform(0.5, 2.0)},
        drive={
            "roller_inertia_kgm2": rng.uniform(300.0, 3000.0),
            "max_speed_rad_s": rng.uniform(10.0, 80.0),
        },
        mechanisms={
            "wheel_radius_fraction": rng.uniform(-0.05, 0.05),
            "wheel_radius_axle": float(rng.integers(1, AXLES + 1)),
            "wheel_inertia_fraction": rng.uniform(-0.2, 0.2),
            "wheel_inertia_axle": float(rng.integers(1, AXLES + 1)),
        },
    )


def set_random_state(rng, rig):
    """Set a state that a run may reach, from micro-slip to a lock; some vehicles stand."""
    s = rig.state
    p = rig.params
    shape = (AXLES,)
    v = 0.0 if rng.random() < 0.1 else 10.0 ** rng.uniform(-3.0, 1.8)
    creepage = 10.0 ** rng.uniform(-6.0, 0.0, shape) * rng.choice([1.0, 1.0, 1.0, -1.0], shape)
    creepage[rng.random(4) < 0.15] = 1.0  # locked
    radius_m = p.wheels.table[vehicle.RADIUS_M]
    s.vehicle_speed[0] = v
    s.standing[0] = float(v == 0.0)
    if p.mode == 0:
        s.roller_speed[:] = 0.0
        surface_m_s = v
    else:
        s.roller_speed[:] = v / p.drive.roller_radius_m * rng.uniform(0.95, 1.05, shape)
        surface_m_s = p.drive.roller_radius_m * s.roller_speed
    s.wheel_speed[:] = np.maximum(0.0, surface_m_s * (1.0 - creepage) / radius_m)
    s.felt_acceleration[0] = rng.uniform(-3.0, 1.0)
    s.position[0] = rng.uniform(0.0, 1e3)
    s.brake_demand[0] = rng.uniform(0.0, 5e5)
    s.valve[:] = rng.integers(0, 3, shape)
    for name, most in (
        ("cylinder_pressure", 5e5),
        ("brake_capacity", 2e4),
        ("brake_torque", 2e4),
        ("motor_torque", 3e4),
        ("motor_before", 3e4),
        ("wheel_angle", 1e3),
        ("roller_angle", 1e3),
        ("brake_work", 1e6),
        ("sliding_work", 1e6),
        ("motor_work", 1e6),
        ("contact_force", 2e4),
        ("brake_mean", 2e4),
        ("observer", 1e5),
        ("brake_work_before", 1e6),
        ("disc_temperature", 600.0),
        ("motor_temperature", 400.0),
        ("locked_since", 1.0),
        ("longest_lock", 2.0),
    ):
        getattr(s, name)[:] = rng.uniform(0.0, most, shape)
    s.motor_torque_demand[:] = rng.uniform(-4e4, 4e4, shape)
    s.friction_degraded[:] = p.law.mu_cd * rng.uniform(0.5, 1.5, shape)
    s.friction_recovered[:] = p.law.mu_cr * rng.uniform(0.9, 1.2, shape)


class Case:
    """Rigs in their lanes, and the same rigs after a step of the plant."""

    def __init__(self, seed, mode):
        rng = np.random.default_rng([seed, MODES.index(mode)])
        self.rng = rng
        self.rigs = [random_rig(rng, mode) for _ in range(RIGS)]
        self.targets = rng.uniform(0.0, 5e5, RIGS)
        self.w = np.zeros(layout.SIZE)
        self.before = []
        self.after = []
        for number, rig in enumerate(self.rigs):
            set_random_state(rng, rig)
            layout.load_constants(self.w, number, rig.params)
            scatter(self.w, number, rig.state, self.targets[number])
            self.before.append(rig.plant.buffer.copy())
            buffer = rig.plant.buffer.copy()
            plant_step(views(buffer, AXLES), self.targets[number], rig.params)
            self.after.append(views(buffer, AXLES))

    def row(self, name):
        """Return a row of the lanes, (rigs, axles)."""
        at = getattr(layout, name)
        return self.w[at : at + RIGS * AXLES].reshape(RIGS, AXLES)

    def run_up_to(self, name):
        """Run the kernels of a step up to the first of this name."""
        for each in ORDER[: ORDER.index(name) + 1]:
            lanes_kernel = getattr(step, each)
            if each in OF_RIGS:
                lanes_kernel(self.w, RIGS, AXLES)
            else:
                lanes_kernel(self.w, RIGS * AXLES)

    def moving(self):
        """Return the rigs that move before and after the step."""
        return [n for n, state in enumerate(self.after) if state.standing[0] == 0.0]


def of_the_step(name):
    def check(case):
        case.run_up_to(name)
        for row, slot in WRITTEN_ROWS[name].items():
            for n in case.moving():
                expected = np.broadcast_to(getattr(case.after[n], slot), AXLES)
                assert_close(case.row(row)[n], expected, f"{name}: {row}")

    return check


def whole_step(case):
    step.step(case.w, RIGS, AXLES)
    for n, expected in enumerate(case.after):
        gathered = views(case.before[n].copy(), AXLES)
        gather(case.w, n, gathered)
        for name in NAMES:
            if name not in OF_A_STAGE:
                assert_close(getattr(gathered, name), getattr(expected, name), name)


def round_trip(case):
    # the lanes carry everything that a step of the plant changes
    for n, expected in enumerate(case.after):
        scatter(case.w, n, expected, 0.0)
        gathered = views(case.before[n].copy(), AXLES)
        gather(case.w, n, gathered)
        for name in NAMES:
            if name not in OF_A_STAGE:
                assert np.array_equal(getattr(gathered, name), getattr(expected, name)), name


def constants(case):
    for n, rig in enumerate(case.rigs):
        p = rig.params
        for row, value in (
            ("EPS1", p.patch.eps1),
            ("STEP", p.step_s),
            ("ON_TRACK", p.mode == 0),
            ("ROLLER_M", p.drive.roller_radius_m),
            ("TORQUE_PER_PA", p.brake.torque_Nm_Pa),
        ):
            assert (case.row(row)[n] == value).all(), row
        for j in range(AXLES):
            expected = rig.params.law._replace(
                mu_cd=rig.state.friction_degraded[j], mu_cr=rig.state.friction_recovered[j]
            )
            assert layout.law_of_lane(case.w, n * AXLES + j) == expected
            load_N = case.row("STATIC_N")[n, j] - 2.0 * case.row("TRANSFER_KG")[n, j]
            assert_close(load_N, vehicle.load(j, 2.0, p.vehicle))


@kernel
def end_of_tick(state, params):
    heat.advance(state, params.heat)
    for axle in range(AXLES):
        plant.watch_lock(state, axle, params)


def quiet(case):
    # after a step, as after the steps of a tick
    step.step(case.w, RIGS, AXLES)
    for n, rig in enumerate(case.rigs):
        expected = views(case.before[n].copy(), AXLES)
        gather(case.w, n, expected)
        end_of_tick(expected, rig.params)
        assert_close(layout.air_NL(case.w, AXLES * n, AXLES), expected.air_consumption[0])
        quiet_tick.end(case.w, AXLES * n, AXLES)
        gathered = views(case.before[n].copy(), AXLES)
        gather(case.w, n, gathered)
        # the lanes do not have the speed of the rims
        gathered.wheel_circumferential_speed[:] = expected.wheel_circumferential_speed
        for name in NAMES:
            assert_close(getattr(gathered, name), getattr(expected, name), name)
        assert np.all(case.row("AIR_NL")[n] == 0.0)


@kernel
def friction_of_next_tick(state, params):
    plant.observe(state, params)
    plant.friction(state, params)


def cleaning(case):
    # a rail that the wheels clean, from the state at the beginning of the step
    extra = {"rail_cleaning_gain": 0.2, "rail_cleaning_energy_J_m": 150.0}
    for alone in (0.0, 1.0):
        extra["rail_cleaning_contaminant_alone"] = alone
        states = []
        for n, rig in enumerate(case.rigs):
            effects = applied.build({key: extra.get(key, 0.0) for key in applied.PLACE})
            params = rig.params._replace(effects=effects)
            assert rail_cleaning.is_alone(params)
            assert not rail_cleaning.is_alone(rig.params)
            state = views(case.before[n].copy(), AXLES)
            state.friction_degraded[:] = params.law.mu_cd
            state.friction_recovered[:] = params.law.mu_cr
            layout.load_constants(case.w, n, params)
            scatter(case.w, n, state, 0.0)
            friction_of_next_tick(state, params)
            states.append(state)
        rail_cleaning.write_energy(case.w, RIGS * AXLES)
        for n in case.moving():
            # below SMALL_M_S the lanes have the secant at that sliding; 150 J/m clean the rail
            expected = states[n].dissipated_energy
            np.testing.assert_allclose(case.row("ENERGY")[n], expected, rtol=CLOSE, atol=1e-6)
            rail_cleaning.clean(case.w, AXLES * n, AXLES)
            expected = states[n].rail_work
            np.testing.assert_allclose(case.row("RAIL_WORK")[n], expected, rtol=CLOSE, atol=1e-6)
            assert_close(case.row("MU_CD")[n], states[n].friction_degraded)
            assert_close(case.row("MU_CR")[n], states[n].friction_recovered)


def force_of(case, n, j):
    """Return (T, secant slope) of an axle at the beginning of the step, by `wheelset`."""
    s = views(case.before[n], AXLES)
    p = case.rigs[n].params
    surface = s.vehicle_speed[0] if p.mode == 0 else p.drive.roller_radius_m * s.roller_speed[j]
    sliding = surface - p.wheels.table[vehicle.RADIUS_M, j] * s.wheel_speed[j]
    at = max(abs(sliding), wheelset.SMALL_M_S)
    T, _, _ = wheelset.contact_force(
        at,
        surface,
        vehicle.load(j, s.felt_acceleration[0], p.vehicle),
        s.friction_degraded[j],
        s.friction_recovered[j],
        p.patch,
        p.law,
        adhesion.NO_MEMORY,
        0.0,
    )
    return T / at * sliding, T / at


def of_the_contacts(name):
    def check(case):
        case.run_up_to(name)
        if name == "contacts":
            # the kernel begins with a solution of a moment before, which the first step has not
            step.contacts_outside_domain(case.w, RIGS * AXLES)
            case.row("SOLVED")[:] += case.rng.uniform(-2e-4, 2e-4, (RIGS, AXLES))
            step.contacts(case.w, RIGS * AXLES)
        inside = 0
        for n in case.moving():
            for j in range(AXLES):
                _, slope = force_of(case, n, j)
                assert_close(step.exact_slope(case.w, AXLES * n + j), slope)
                if name != "contacts" or case.row("INSIDE")[n, j]:
                    inside += 1
                    assert_close(case.row("SLOPE")[n, j], slope)
        assert inside > 2 * len(case.moving())

    return check


def stages_of(case, n, j):
    """Return slopes, pull and acting brake of the first stage, by `wheelset`."""
    s = views(case.before[n], AXLES)
    after = case.after[n]
    p = case.rigs[n].params
    T, g = force_of(case, n, j)
    wheel_k, brake_Nm, locked = wheelset.wheel_acceleration(
        s.wheel_speed[j], T, s.brake_capacity[j], 0.0, j, p.wheels
    )
    roller_k = wheelset.roller_acceleration(s.motor_before[j], T, p.mode == 0, p.drive)
    wheel_k, roller_k, added_N = wheelset.implicit_slopes(
        wheel_k, roller_k, max(g, 0.0), locked, p.mode == 0, p.step_s, j, p.wheels, p.drive
    )
    assert_close((wheel_k, roller_k), (after.wheel_rate[j], after.roller_rate[j]))
    return wheel_k, roller_k, T + added_N, brake_Nm


@kernel
def stage(w, j, wheel, brake_Nm, motor_Nm):
    return step.stage(w, j, wheel, brake_Nm, motor_Nm, 0.0, 0.0)


def one_stage(case):
    case.run_up_to("contacts_outside_domain")
    for n in case.moving():
        s = views(case.before[n], AXLES)
        for j in range(AXLES):
            result = stage(
                case.w, AXLES * n + j, s.wheel_speed[j], s.brake_capacity[j], s.motor_before[j]
            )
            assert_close(result, stages_of(case, n, j))


def prediction(case):
    case.run_up_to("predict")
    for n in case.moving():
        s = views(case.before[n], AXLES)
        p = case.rigs[n].params
        v = s.vehicle_speed[0]
        felt = s.felt_acceleration[0]
        h = p.step_s
        resistance_N = vehicle.resistance(v, p.vehicle)
        pulls_N = sum(stages_of(case, n, j)[2] for j in range(AXLES))
        braking_N = resistance_N + pulls_N
        assert_close(step.total(case.w, AXLES * n, AXLES, 0.0) + resistance_N, braking_N)
        rate = -braking_N / p.vehicle.mass_kg
        felt_end = felt + h * (rate - felt) / p.vehicle.pitch_time_constant_s
        assert_close(case.row("V_END")[n], np.full(AXLES, v + h * rate))
        assert_close(case.row("FELT_END")[n], np.full(AXLES, felt_end))


def standstill(case):
    for n, rig in enumerate(case.rigs):
        step.broadcast(case.w, layout.V, AXLES * n, AXLES, 0.001)
        step.settle(case.w, AXLES * n, AXLES)
        rig.state.standing[0] = 0.0
        rig.state.vehicle_speed[0] = 0.001
        vehicle.settle(rig.state)
        gathered = views(case.before[n].copy(), AXLES)
        gather(case.w, n, gathered)
        for name in (
            "vehicle_speed",
            "vehicle_acceleration",
            "wheel_speed",
            "roller_speed",
            "motor_torque",
            "brake_torque",
            "standing",
        ):
            assert np.array_equal(getattr(gathered, name), getattr(rig.state, name)), name


TWINS = {
    "layout.load_constants": constants,
    "layout.scatter": round_trip,
    "layout.gather": round_trip,
    "layout.air_NL": quiet,
    "quiet_tick.end": quiet,
    "rail_cleaning.write_energy": cleaning,
    "rail_cleaning.clean": cleaning,
    "step.step": whole_step,
    "step.stage": one_stage,
    "step.predict": prediction,
    "step.total": prediction,
    "step.broadcast": standstill,
    "step.settle": standstill,
    "step.exact_slope": of_the_contacts("contacts"),
    "step.contacts": of_the_contacts("contacts"),
    "step.contacts_outside_domain": of_the_contacts("contacts_outside_domain"),
    **{f"step.{name}": of_the_step(name) for name in WRITTEN_ROWS},
}


def test_every_kernel_of_the_lanes_has_a_twin():
    kernels = set()
    for module in (layout, quiet_tick, rail_cleaning, step):
        short = module.__name__.rpartition(".")[2]
        for name, value in vars(module).items():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == module.__name__:
                kernels.add(f"{short}.{name}")
    assert kernels == set(TWINS)


def test_the_kernels_of_a_step_are_checked_in_their_order():
    names = step.step.py_func.__code__.co_names
    called = [name for name in names if hasattr(step, name)]
    assert list(dict.fromkeys(called)) == list(dict.fromkeys(ORDER))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", TWINS)
def test_a_kernel_of_the_lanes_agrees_with_its_twin_in_the_plant(name, mode):
    for seed in range(3):
        TWINS[name](Case(seed, mode))


@pytest.mark.nightly
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("name", TWINS)
def test_a_kernel_of_the_lanes_agrees_with_its_twin_on_many_rigs(name, mode):
    for seed in range(3, 20):
        TWINS[name](Case(seed, mode))
