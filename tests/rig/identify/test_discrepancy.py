"""What a right model may differ by from measured runs is no cause: sensors, brakes, rails."""

from pathlib import Path

import numpy as np
import pytest
from generator import conditions, other_stops
from generator.conditions import Conditions
from tiers import first_of

from rollerrig.realtime.reports import cause_sentences
from rollerrig.rig.identify.causes import candidates, discrepancy, simulate
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset, preparation, pulses
from rollerrig.rig.identify.data.preparation import CommonBrake
from rollerrig.rig.identify.data.pulses import Sensor
from rollerrig.rig.identify.decide import (
    coherence,
    decision,
    evidence,
    fitting,
    stopping,
)
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.notes import Note, NoteCode
from rollerrig.rig.identify.replay import rail, sensitivity
from rollerrig.rig.identify.replay.rail import RailShares

STEP_S = 0.01
SEED = 3


def slowing_wheels() -> tuple[np.ndarray, np.ndarray]:
    """Times of a millisecond, and speeds of four wheels that slow down and slide now and then."""
    time_s = np.arange(0.0, 30.0, 0.001)
    slides = 4.0 * np.sin(2.0 * np.pi * time_s[:, None] / (1.7 + 0.1 * np.arange(4)))
    return time_s, 90.0 - 2.4 * time_s[:, None] - np.maximum(slides, 0.0)


def shown(sensor: str) -> np.ndarray:
    """What a sensor of the generators shows of these wheels, shape (samples, 4)."""
    time_s, spins_rad_s = slowing_wheels()
    wheels = conditions.pole_wheels(SEED, 0)
    of_sensor = Conditions(sensor=sensor)
    return conditions.wheel_speeds(of_sensor, time_s, spins_rad_s, time_s[::10], wheels)


def run_of(wheel_rad_s: np.ndarray) -> preparation.Run:
    data = dataset.load("open_none")
    run = data.runs[0]
    return run._replace(time_s=STEP_S * np.arange(len(wheel_rad_s)), wheel_speed_rad_s=wheel_rad_s)


# --- wheel speeds from pulses ---


@pytest.mark.parametrize(
    ("sensor", "kind"),
    [("counted", Sensor.COUNTED), ("timed", Sensor.TIMED), ("last period", Sensor.TIMED)],
)
def test_wheel_speeds_from_pulses_are_recognised(sensor: str, kind: Sensor) -> None:
    assert pulses.recognise([run_of(shown(sensor))]).kind is kind


@pytest.mark.parametrize("step_rad_s", first_of([0.1, 0.0, 0.01]))
def test_white_noise_is_no_sensor_of_pulses_also_where_it_is_rounded(step_rad_s: float) -> None:
    _, spins_rad_s = slowing_wheels()
    noise_rad_s = np.random.default_rng(SEED).normal(0.0, 0.07, spins_rad_s[::10].shape)
    wheel_rad_s = spins_rad_s[::10] + noise_rad_s
    if step_rad_s:
        wheel_rad_s = np.round(wheel_rad_s / step_rad_s) * step_rad_s
    assert not pulses.recognise([run_of(wheel_rad_s)]).is_pulses


def test_the_quantum_of_counted_pulses_is_one_pulse_in_a_sample() -> None:
    teeth = conditions.pole_wheels(SEED, 0).teeth
    sensor = pulses.recognise([run_of(shown("counted"))])
    assert sensor.quantum_rad_s == pytest.approx(2.0 * np.pi / teeth / STEP_S, rel=1e-3)


def test_simulated_sensors_of_pulses_keep_the_angle_and_are_late() -> None:
    _, spins_rad_s = slowing_wheels()
    wheel_rad_s = spins_rad_s[::10]
    rng = np.random.default_rng(SEED)
    quantum_rad_s = 5.0
    counted = pulses.counted(wheel_rad_s, quantum_rad_s, rng)
    in_sample_rad_s = 0.5 * (wheel_rad_s[1:] + wheel_rad_s[:-1])
    off_rad = np.cumsum(counted[1:] - in_sample_rad_s, axis=0) * STEP_S
    # the error of the angle is never more than a pulse
    assert np.ptp(off_rad, axis=0).max() < 1.01 * quantum_rad_s * STEP_S

    sensor = pulses.recognise([run_of(shown("last period"))])
    timed = pulses.timed(sensor, wheel_rad_s, STEP_S, -pulses.LATE_WINDOW, 0.0, rng)
    late_steps = pulses.late_s(STEP_S, wheel_rad_s, -pulses.LATE_WINDOW, 0.0) / STEP_S
    for wheel in range(4):
        true_rad_s = wheel_rad_s[:, wheel]
        expected_rad_s = pulses.delayed(true_rad_s, late_steps[:, wheel])
        rate_rad_s2 = np.gradient(true_rad_s, STEP_S)
        power = rate_rad_s2 @ rate_rad_s2
        late_s = (true_rad_s - timed[:, wheel]) @ rate_rad_s2 / power
        expected_s = (true_rad_s - expected_rad_s) @ rate_rad_s2 / power
        assert late_s == pytest.approx(expected_s, rel=0.25)


# --- the brake and the rail ---


@pytest.fixture(scope="module")
def stops() -> tuple[dataset.Dataset, preparation.Design, candidates.Explanation]:
    data = dataset.load("open_none")
    data = data._replace(runs=data.group("tune")[1:])
    design = preparation.prepare(data, data.runs)
    return data, design, fitting.fit(design, candidates.untuned(design), 4).explanation


def test_the_shape_of_the_brake_stays_within_its_calibration(stops) -> None:
    _, design, _ = stops
    shares = []
    for seed in range(20):
        drawn = discrepancy.draw_brake(design, np.random.default_rng(seed))
        shares.append(discrepancy.brake_share(design, drawn))
    deviation = float(np.std(shares))
    assert 0.2 * design.calibration < deviation < design.calibration
    assert discrepancy.brake_share(design, {}) is None


def test_a_rail_that_all_wheelsets_share_is_recognised(stops) -> None:
    data, design, base = stops
    base = base._replace(sigma=0.04)

    def common(shares: RailShares, seed: int) -> RailShares:
        rng = np.random.default_rng(seed)
        made = simulate.runs(data, design, data.group("tune"), base, rng, shares)
        prepared = preparation.prepare(data, made, design)
        replayed = sensitivity.innovations(prepared, candidates.inputs(prepared, base))
        return rail.common(prepared, replayed[2])

    on_shared = [common(RailShares(1.0, 1.0), seed) for seed in range(2)]
    shared = rail.shares(common(RailShares(0.95, 0.95), 7), on_shared)
    assert shared.in_all > 0.8
    own = rail.shares(common(RailShares(0.0, 0.0), 7), on_shared)
    assert own == rail.USUAL
    of_runs = rail.shares(common(RailShares(0.95, 0.0), 7), on_shared)
    assert of_runs.in_run > 0.8
    assert of_runs.in_all < 0.7


def test_a_remaining_force_inside_the_calibration_of_the_brake_is_a_note(stops) -> None:
    _, design, _ = stops
    small = stopping.remaining_force_share(design, stopping.TIME, (1e-4, 1e-4, 1e-4, 1e-4))
    large = stopping.remaining_force_share(design, stopping.TIME, (1e-2, 1e-2, 1e-2, 1e-2))
    assert large == pytest.approx(100.0 * small)
    test = evidence.ScoreTest(
        name=stopping.TIME,
        axle=0,
        shape={},
        estimate=(1e-4,),
        bias=(0.0,),
        deviation=(1e-5,),
        statistic=100.0,
        p_value=1e-9,
        expected=1.0,
        spread=1.0,
    )
    note = Note(NoteCode.IMMATERIAL_REMAINDER, remainder=test, share=0.005, tolerance=0.003)
    sentence = cause_sentences.note_sentence(note)
    assert "0.5 % of the braking force, within twice your 0.3 %" in sentence


# --- brakes that vary in common, inside their calibration ---


def with_varying_brakes(design: preparation.Design, share: float) -> preparation.Design:
    """The design of brakes that act by up to this share more or less than recorded."""
    common = design._replace(common_brake=CommonBrake.TIME_OF_RUN)
    modes = {mode.label: share for mode in discrepancy.common_modes(common) if mode.number == 2}
    acting = discrepancy.brake_share(common, modes)
    assert acting is not None
    factor = 1.0 / (1.0 + acting)
    return design._replace(torque_Nm=design.torque_Nm * factor, brake_Nm=design.brake_Nm * factor)


def search_of(
    design: preparation.Design, base: candidates.Explanation, cause: Cause
) -> decision._Search:
    """What a search has found that ends with this cause, fitted."""
    fit = fitting.fit(design, base._replace(causes=(cause,)), 5)
    found = IdentifiedCause(
        score_test=evidence.ScoreTest(
            name=cause.name,
            axle=0,
            shape={},
            estimate=cause.values,
            bias=(0.0,),
            deviation=(0.01,),
            statistic=99.0,
            p_value=1e-9,
            expected=1.0,
            spread=1.0,
        ),
        cause=fit.explanation.causes[0],
        likelihood_ratio=99.0,
        ratio_by_filter=(99.0,) * 5,
        deviation=(0.01,),
        confusable=(),
        rivals=(),
    )
    return decision._Search(fit.explanation, [found], [], [], base)


@pytest.mark.parametrize(("share", "is_inside"), [(0.005, True), (0.02, False)])
def test_brakes_that_vary_in_common_are_a_note_only_inside_their_calibration(
    stops, share: float, is_inside: bool
) -> None:
    _, design, _ = stops
    varying = with_varying_brakes(design, share)
    base = fitting.fit(varying, candidates.untuned(varying), 6).explanation
    search = search_of(varying, base, Cause("pad_fade", 0, {}, (0.001,)))
    left, notes = decision._without_common_brake(varying, base, search)
    assert bool(notes) == is_inside
    assert bool(left.causes) != is_inside
    verdict, _ = decision.decide_verdict(left.causes, left.remainder, None)
    assert (verdict == "consistent") == is_inside
    for note in notes:
        assert note.causes == ("pad_fade",)
        assert note.share == pytest.approx(share, rel=0.5)
        assert note.allowed == pytest.approx(2.0 * design.calibration)
        sentence = cause_sentences.note_sentence(note)
        assert "brakes that all vary in the same way by" in sentence
        assert "your 0.3 %" in sentence


@pytest.mark.parametrize("change", first_of([1.04, 0.96]))
def test_a_wrong_gain_of_all_brakes_is_no_variation_inside_their_calibration(
    stops, change: float
) -> None:
    _, design, _ = stops
    wrong = design._replace(torque_Nm=design.torque_Nm / change, brake_Nm=design.brake_Nm / change)
    base = fitting.fit(wrong, candidates.untuned(wrong), 6).explanation
    search = search_of(wrong, base, Cause("brake_gain", 0, {}, (change - 1.0,)))
    left, notes = decision._without_common_brake(wrong, base, search)
    assert notes == []
    assert left is search


def test_a_base_model_has_no_modes_that_all_brakes_share(stops) -> None:
    _, design, base = stops
    assert discrepancy.common_modes(design) == []
    for form in coherence.FORMS:
        modes = discrepancy.common_modes(design._replace(common_brake=form))
        labels = {mode.label for mode in modes}
        assert labels
        assert not labels & set(base.base)
        assert not labels & set(discrepancy.priors(design))


@pytest.mark.parametrize("form", coherence.FORMS)
def test_more_free_values_of_a_variation_cost_evidence(stops, form: CommonBrake) -> None:
    _, design, base = stops
    varying = design._replace(common_brake=form)
    assert coherence.of_all_values(varying, base) > 0.0
    wider = varying._replace(calibration=2.0 * design.calibration)
    assert coherence.of_all_values(wider, base) > coherence.of_all_values(varying, base)


# --- whole explanations of stops with nothing hidden ---


@pytest.mark.nightly
@pytest.mark.explanation
@pytest.mark.parametrize(
    ("kind", "seed"),
    [("pulses counted", 711005), ("pulses timed", 712000), ("last pulse period", 713000)],
)
def test_sensors_of_pulses_are_consistent_where_nothing_is_hidden(
    kind: str, seed: int, tmp_path: Path
) -> None:
    folder = other_stops.make(tmp_path / "none", {}, seed, conditions=conditions.KINDS[kind])
    diagnosis = decision.explain_braking_runs(dataset.load(folder), 0, lambda *_: None)
    assert diagnosis.verdict == "consistent"
    assert diagnosis.causes == []
