"""The replay follows the law of the plant, and its innovations are white for simulated stops.

Wheelsets that are replayed together in lanes give the same results as wheelsets replayed alone.
"""

import math
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from rollerrig.rig.contact import adhesion
from rollerrig.rig.contact.patch import patch_for
from rollerrig.rig.identify.causes import candidates, simulate
from rollerrig.rig.identify.causes.candidates import Cause, Explanation
from rollerrig.rig.identify.data import dataset, parameters, preparation
from rollerrig.rig.identify.data.parameters import WheelModel
from rollerrig.rig.identify.decide import evidence, fitting
from rollerrig.rig.identify.replay import lanes, sensitivity, wheel

SPEED_M_S = 25.0
WHEEL_LOAD_N = 52700.0


@pytest.fixture(scope="module")
def data() -> dataset.Dataset:
    return dataset.load("open_none")


@pytest.fixture(scope="module")
def design(data: dataset.Dataset) -> preparation.Design:
    return preparation.prepare(data, data.group("tune"))


@pytest.fixture(scope="module")
def fitted(design: preparation.Design) -> Explanation:
    return Explanation(
        base={"ln_mu_cd_0": -0.397, "ln_mu_cd_1": -0.522, "ln_mu_cd_2": -0.455},
        sigma=0.0225,
        length_m=6.9,
        causes=(),
    )


def test_the_replayed_law_is_the_law_of_the_plant(design: preparation.Design) -> None:
    patch = patch_for(
        wheel_radius_m=0.445,
        roller_radius_m=math.inf,
        lateral_radius_m=0.3,
        young_Pa=2.1e11,
        shear_Pa=8.0e10,
        poisson=0.3,
    )
    for limit in (
        {"cleaning_creepage": math.inf},
        {"cleaning_creepage": 0.3, "cleaning_half_speed_m_s": 9.0},
        {"cleaning_creepage": 0.55, "cleaning_sliding_m_s": 8.1},
    ):
        model = WheelModel(*design.base)._replace(**limit)
        law = adhesion.Law(*(getattr(model, name) for name in adhesion.Law._fields))
        for sliding in (0.01, 0.3, 2.0, 8.0, 15.0, 25.0, -1.0):
            replayed = wheel.wheel_adhesion(sliding, SPEED_M_S, WHEEL_LOAD_N, 1.0, 1.0, model, None)
            expected_f, _, _, _, _, expected_slope = adhesion.wheel_adhesion(
                sliding, SPEED_M_S, WHEEL_LOAD_N, patch, law
            )
            assert replayed.f == pytest.approx(expected_f, rel=1e-12)
            assert replayed.slope_s_m == pytest.approx(expected_slope, rel=1e-9)


MEMORIES = [{}, {"speed_power": 1.0}, {"of_work": 1.0}]


def with_memory(base: Explanation, shape: dict[str, float], length_m: float) -> Explanation:
    """Return the explanation with adhesion memory as its only cause."""
    return base._replace(causes=(Cause("adhesion_memory", 0, shape, (length_m,)),))


def replayed_alone(design: preparation.Design, i: sensitivity.Inputs) -> np.ndarray:
    """Return the replay of each wheelset alone, without vector instructions, shape (3, n)."""
    out = np.empty((3, design.measured_rad_s.size))
    cells = np.empty(lanes.CELLS)
    inputs = np.array([i.speed_m_s, i.load_N, i.torque_Nm, *i.friction])
    for s, row in enumerate(i.parameters):
        start = design.start[s : s + 2]
        run = lanes.Run(start, design.measured_rad_s, inputs, row[np.newaxis], out)
        memory = bool(row[parameters.MEMORY] > 0.0) or None
        lanes.replay_runs(run, run, design.step_s, memory, True, cells)
    return out


@pytest.mark.parametrize("recovered", [1.0, 0.5], ids=["cleaned by sliding", "worsened by sliding"])
def test_the_wheelsets_of_two_runs_are_replayed_together_as_one_by_one(
    design: preparation.Design, fitted: Explanation, recovered: float
) -> None:
    i = candidates.inputs(design, fitted)
    if recovered < 1.0:
        # recovered friction is half of degraded friction
        degraded = i.parameters[:, parameters.MU_CD]
        share_of_degraded = degraded / i.parameters[:, parameters.MU_CR]
        i.parameters[:, parameters.MU_CR] *= recovered * share_of_degraded
    np.testing.assert_allclose(
        sensitivity.replay_wheels(design, i), replayed_alone(design, i), rtol=1e-8, atol=1e-10
    )

    at = design.span(1)
    n = at.stop - at.start
    path = np.array([design.sliding_m_s[at], i.speed_m_s[at], i.load_N[at], *i.friction[:, at]])
    exact = np.empty((lanes.PATH_RESULTS, n))
    lanes.adhesion_along(path, i.parameters[1], True, np.empty(lanes.PATH_CELLS), exact)
    vectors = sensitivity.replay_law(path, i.parameters[1])
    np.testing.assert_allclose(vectors, exact, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("shape", MEMORIES, ids=["over distance", "over time", "of the work done"])
@pytest.mark.parametrize("length_m", [0.3, 3.0, 30.0])
def test_wheels_with_memory_are_replayed_together_as_one_by_one(
    design: preparation.Design, fitted: Explanation, shape: dict[str, float], length_m: float
) -> None:
    i = candidates.inputs(design, with_memory(fitted, shape, length_m))
    alone = replayed_alone(design, i)
    assert np.all(np.isfinite(alone))
    np.testing.assert_allclose(sensitivity.replay_wheels(design, i), alone, rtol=1e-8, atol=1e-10)


def with_wheelsets(data: dataset.Dataset, axles: int) -> dataset.Dataset:
    """Return the data as those of a vehicle with so many wheelsets, copies of the measured ones."""
    measured = np.arange(axles) % data.axles
    runs = [
        run._replace(
            mass_kg=run.mass_kg * axles / data.axles,
            wheel_speed_rad_s=run.wheel_speed_rad_s[:, measured],
            load_N=run.load_N[:, measured],
            torque_Nm=run.torque_Nm[:, measured],
        )
        for run in data.runs
    ]
    return data._replace(runs=runs, axle_position_m=2.5 * np.arange(axles))


@pytest.mark.parametrize("axles", [2, 6, 12])
@pytest.mark.parametrize("length_m", [0.0, 3.0], ids=["without memory", "with memory"])
def test_the_wheelsets_of_any_vehicle_are_replayed_together_as_one_by_one(
    data: dataset.Dataset, fitted: Explanation, axles: int, length_m: float
) -> None:
    of_vehicle = with_wheelsets(data, axles)
    design = preparation.prepare(of_vehicle, of_vehicle.group("tune"))
    i = candidates.inputs(design, with_memory(fitted, {}, length_m))
    alone = replayed_alone(design, i)
    assert design.segments == 3 * axles
    assert np.all(np.isfinite(alone))
    np.testing.assert_allclose(sensitivity.replay_wheels(design, i), alone, rtol=1e-8, atol=1e-10)


def test_several_explanations_are_replayed_together_as_each_alone(
    design: preparation.Design, fitted: Explanation
) -> None:
    several = [
        candidates.inputs(design, with_memory(fitted, shape, length_m=2.0)) for shape in MEMORIES
    ]
    for replayed, i in zip(sensitivity.replays(design, several), several, strict=True):
        assert np.array_equal(replayed, sensitivity.replay_wheels(design, i))

    without = candidates.inputs(design, fitted)
    for mixed in ([several[0], without], [without, several[0]]):
        for replayed, i in zip(sensitivity.replays(design, mixed), mixed, strict=True):
            np.testing.assert_allclose(
                replayed, sensitivity.replay_wheels(design, i), rtol=1e-8, atol=1e-10
            )


@pytest.mark.parametrize(
    "A",
    [
        [[-30.0, 4.0], [5.0, -2.0]],
        [[-3.0, 40.0], [-50.0, -2.0]],
        [[-5.0, 1.0], [0.0, -5.0]],
        [[-1e-6, 0.0], [0.0, -2e-6]],
        [[-3000.0, 90.0], [2.0, -20.0]],
    ],
    ids=["real", "conjugates", "one eigenvalue", "hardly any", "stiff"],
)
@pytest.mark.parametrize(
    "step",
    [wheel.matrix_step, lanes.matrix_step],
    ids=["one by one", "with vector mathematics"],
)
def test_the_exact_step_of_speed_and_recovery_is_the_exponential_of_the_matrix(
    A: list[list[float]], step: Any
) -> None:
    step_s = 0.005
    # The exponential of [[A, 1], [0, 0]] h holds that of A h in its upper left block, and in its
    # upper right block the integral of exp(A s) over the step.
    augmented = np.block([[np.array(A), np.eye(2)], [np.zeros((2, 4))]])
    exponential = expm(augmented * step_s)
    expected = [*exponential[:2, :2].ravel(), *exponential[:2, 2:].ravel()]
    upper_row, lower_row = A
    np.testing.assert_allclose(step(*upper_row, *lower_row, step_s), expected, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("sliding", [0.1, 2.0, 9.0, -2.0])
@pytest.mark.parametrize(
    ("lambda_", "of_work"),
    [(None, 0.0), (0.4, 0.0), (0.4, 1.0)],
    ids=["without memory", "with memory", "of the work done"],
)
def test_a_step_of_a_wheelset_returns_its_derivatives(
    design: preparation.Design, sliding: float, lambda_: float | None, of_work: float
) -> None:
    # cleaning fades from a sliding of 3 m/s on: there more sliding cleans less
    model = WheelModel(*design.base)._replace(
        memory_m=3.0,
        memory_of_work=of_work,
        cleaning_creepage=0.3,
        cleaning_half_speed_m_s=9.0,
        cleaning_sliding_m_s=8.0,
    )
    step_s = 1e-4
    torque_Nm = 4000.0
    start = {
        "omega": (SPEED_M_S - sliding) / model.wheel_radius_m,
        "lambda_": lambda_,
        "m": 0.1,
        "torque": torque_Nm,
    }

    def step(**changes: float) -> wheel.WheelStep:
        """Return the step with changed arguments."""
        at = {**start, **changes}
        return wheel.wheel_step(
            at["omega"],
            at["lambda_"],
            at["m"],
            SPEED_M_S,
            2.0 * WHEEL_LOAD_N,
            at["torque"],
            1.0,
            1.0,
            model,
            step_s,
        )

    def change(name: str, by: float) -> tuple[float, float]:
        """Return the derivatives of omega and lambda to an argument."""
        less = step(**{name: start[name] - by})
        more = step(**{name: start[name] + by})
        return (more.omega - less.omega) / (2.0 * by), (more.lambda_ - less.lambda_) / (2.0 * by)

    stated = step()
    of_omega, lambda_of_omega = change("omega", 1e-4)
    of_m, _ = change("m", 1e-4)
    of_torque, lambda_of_torque = change("torque", 1.0)
    inertia_kgm2 = model.wheelset_inertia_kgm2
    assert stated.e00 - 1.0 == pytest.approx(of_omega - 1.0, rel=0.02, abs=5e-7)
    assert stated.b00 * stated.drive_rad_s2 == pytest.approx(of_m, rel=0.02)
    assert stated.b00 / inertia_kgm2 == pytest.approx(-of_torque, rel=1e-6)
    if lambda_ is None:
        return
    of_lambda, lambda_of_lambda = change("lambda_", 1e-5)
    assert stated.e01 == pytest.approx(of_lambda, rel=0.02)
    assert stated.e10 == pytest.approx(lambda_of_omega, rel=0.02)
    assert stated.e11 - 1.0 == pytest.approx(lambda_of_lambda - 1.0, rel=0.02)
    assert stated.b10 / inertia_kgm2 == pytest.approx(-lambda_of_torque, rel=1e-3)


def test_innovations_of_an_unchanged_recording_have_unit_variance(
    design: preparation.Design, fitted: Explanation
) -> None:
    innovation, variance, _, of_vehicle, variance_of_vehicle = sensitivity.innovations(
        design, candidates.inputs(design, fitted)
    )
    assert np.mean(innovation**2 / variance) == pytest.approx(1.0, abs=0.05)
    assert np.mean(of_vehicle**2 / variance_of_vehicle) == pytest.approx(1.0, abs=0.08)


@pytest.mark.parametrize("axles", [2, 4, 12])
def test_simulated_stops_look_like_the_recording(
    data: dataset.Dataset, fitted: Explanation, axles: int
) -> None:
    data = with_wheelsets(data, axles)
    design = preparation.prepare(data, data.group("tune"))
    rng = np.random.default_rng(5)
    made = simulate.runs(data, design, data.group("tune"), fitted, rng)
    simulated = preparation.prepare(data, made, design)
    innovation, variance, *_ = sensitivity.innovations(
        simulated, candidates.inputs(simulated, fitted)
    )
    assert np.mean(innovation**2 / variance) == pytest.approx(1.0, abs=0.06)
    assert simulated.sliding_m_s.mean() == pytest.approx(design.sliding_m_s.mean(), rel=0.25)


def test_wet_pads_hidden_in_simulated_stops_are_the_likeliest_cause(
    data: dataset.Dataset, design: preparation.Design, fitted: Explanation
) -> None:
    wet_pads = Cause("wet_pads", 0, {"turns": 12.0}, (0.25,))
    true = fitted._replace(causes=(wet_pads,))
    made = simulate.runs(data, design, data.group("tune"), true, np.random.default_rng(6))
    simulated = preparation.prepare(data, made, design)

    normal, _, _ = fitting.normal_equations(simulated, fitted)
    likeliest = evidence.most_promising(simulated, normal, 3)[0]
    assert likeliest.name == "wet_pads"

    start = fitted._replace(causes=(likeliest,))
    fit = fitting.fit(simulated, start, 4, noise=False)
    assert fit.explanation.causes[0].values[0] == pytest.approx(0.25, abs=0.08)
