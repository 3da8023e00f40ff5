"""What a reader of `explain` learns first: cause, certainty, metres, limits, what to do next."""

import functools

import numpy as np
import pytest
from matplotlib.figure import Figure

from rollerrig.realtime.reports import cause_pictures, cause_report, cause_sentences, extended_model
from rollerrig.realtime.reports.hints import first_screen, sizes, suspects
from rollerrig.rig.identify.causes import candidates, columns, table
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import decision, gain, stopping
from rollerrig.rig.identify.decide.choice import IdentifiedCause
from rollerrig.rig.identify.decide.coherence import Contradicted, Contradiction, Window
from rollerrig.rig.identify.decide.decision import Diagnosis, Verdict
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.decide.notes import Note, NoteCode
from rollerrig.rig.mechanisms import table as mechanisms


def score_test(
    name: str,
    size: float = 0.1,
    p_value: float = 0.5,
    statistic: float = 2.0,
    smallest: float = 0.05,
):
    return ScoreTest(
        name=name,
        axle=0,
        shape={},
        estimate=(size,),
        bias=(0.0,),
        deviation=(0.01,),
        statistic=statistic,
        p_value=p_value,
        expected=1.0,
        spread=1.0,
        smallest=smallest,
    )


@functools.cache
def one_run():
    """Return a dataset of one run, its design, and the base model."""
    packaged = dataset.load("open_none")
    data = packaged._replace(runs=packaged.runs[:1])
    design = preparation.prepare(data, data.runs)
    return data, design, candidates.untuned(design)


def diagnosis(*causes: Cause, verdict: Verdict = Verdict.EXPLAINED, tests=()) -> Diagnosis:
    """The diagnosis of one run, as if these causes had been found."""
    data, design, base = one_run()
    identified = [
        IdentifiedCause(
            score_test=score_test(cause.name, cause.values[0], 1e-9, 99.0),
            cause=cause,
            likelihood_ratio=99.0,
            ratio_by_filter=(99.0,) * 5,
            deviation=(1e-6,),
            confusable=(),
            rivals=(),
        )
        for cause in causes
    ]
    return Diagnosis(
        data=data,
        design=design,
        held_out=None,
        base=base,
        final=base._replace(causes=causes) if causes else base,
        verdict=verdict,
        causes=identified,
        set_aside=[],
        score_tests=list(tests),
        remainder=[],
        gain=None,
        p_value=1e-9,
        notes=[],
        formula=None,
        elapsed_s=1.0,
    )


def contradicted(name: str, what: Contradiction, windows=(), size: float = 0.1) -> Note:
    cause = Cause(name, 0, {}, (size,))
    found = Contradicted(cause, 99.0, what, windows)
    return Note(NoteCode[what.name], causes=(name,), contradicted=found)


def test_what_is_no_sand_is_reported_with_its_times_in_at_most_three_runs() -> None:
    windows = tuple(Window(f"r{k}", 3.0 * k, 3.0 * k + 5.0) for k in range(5))
    text = cause_sentences.note_sentence(contradicted("sanding", Contradiction.NO_TRIGGER, windows))
    assert "something raises friction from 0 to 5 s in run r0" in text
    assert "and in 2 more runs" in text
    assert "not reported as sanding" in text


@pytest.mark.parametrize(
    ("name", "what", "title"),
    [
        ("contaminated_patch", Contradiction.OTHER_PLACES, "place"),
        ("sanding", Contradiction.NO_TRIGGER, "time"),
        ("torque_offset", Contradiction.OTHER_FORCE, "speed of the vehicle, along speed"),
    ],
)
def test_the_first_panel_shows_what_contradicts_a_cause(
    name: str, what: Contradiction, title: str
) -> None:
    tests = [score_test("along sliding", 0.1, 1e-9, 90.0)]
    found = diagnosis(verdict=Verdict.UNEXPLAINED, tests=tests)
    found = found._replace(notes=[contradicted(name, what, (Window("a1", 0.0, 90.0),))])
    against = cause_sentences.worst_covariates(found)
    assert cause_pictures.where(found, against)[0].title == title


def test_the_nearest_causes_are_reported_with_how_near_they_are() -> None:
    tests = [
        score_test("along sliding", 0.1, 1e-12, 200.0),
        score_test("falling_friction", 0.25, 1e-9, 150.0),
        score_test("brake_gain", 0.02, 1e-9, 50.0),
    ]
    found = diagnosis(verdict=Verdict.UNEXPLAINED, tests=tests)
    text = first_screen.nearest(found)
    assert "falling_friction, 75 % of the error along sliding" in text
    assert text.index("falling_friction") < text.index("brake_gain, 25 %")


def test_a_cause_on_a_bogie_names_its_wheelsets() -> None:
    found = diagnosis(Cause("brake_gain", -2, {}, (0.05,)))
    headline = cause_sentences.story(found)[0]
    assert "on bogie 2 (wheelsets 3 and 4)" in headline
    assert cause_report.as_json(found)["causes"][0]["axles"] == [3, 4]
    assert "brake_gain_axle = -2.0" in extended_model.toml(found)


def test_a_stronger_brake_costs_metres_in_proportion_to_its_share() -> None:
    found = diagnosis(Cause("brake_gain", 0, {}, (-0.05,)))
    distance = stopping.costs(found.design, found.base, found.final)
    assert distance is not None
    # the torque takes nearly all of the momentum, so the stop is about 5 % longer than predicted
    assert distance.extended_m / distance.base_m == pytest.approx(1.05, abs=0.006)
    assert distance.from_m_s == pytest.approx(42.3, abs=0.3)
    story = " ".join(cause_sentences.story(found))
    assert f"{distance.longer_m:.0f} m longer than the base model predicts" in story
    assert "How sure:" in story


def test_less_friction_makes_a_stop_longer_and_a_late_sensor_costs_no_metres() -> None:
    less = diagnosis(Cause("rail_cleaning", 0, {"energy_J_m": 150.0}, (0.2,)))
    distance = stopping.costs(less.design, less.base, less.final)
    assert distance is not None
    assert distance.longer_m < 0.0

    late = diagnosis(Cause("speed_sensor_delay", 0, {}, (0.01,)))
    assert stopping.costs(late.design, late.base, late.final) is None
    assert "none in stopping distance" in first_screen.cost(late)


def test_a_constant_of_the_form_has_no_interval() -> None:
    found = diagnosis(Cause("falling_friction", 0, {"height": 1.0}, (0.3,)))
    headline = cause_sentences.story(found)[0]
    assert "height = 1" in headline
    assert "1 to 1" not in headline


def test_the_headline_of_sand_has_a_range_of_times_and_no_time_of_each_run() -> None:
    shape = {"contaminant_alone": 1.0}
    for k, run in enumerate(("a1", "a2", "a3", "a4")):
        shape[f"start_s {run}"] = 4.0 + k
        shape[f"duration_s {run}"] = 5.0
    headline = cause_sentences.story(diagnosis(Cause("sanding", 0, shape, (0.2,))))[0]
    assert "start_s = 4 to 7 in 4 runs" in headline
    assert "a2" not in headline


def test_what_was_ruled_out_says_in_words_which_size_would_have_shown() -> None:
    found = diagnosis(verdict=Verdict.CONSISTENT, tests=[score_test("brake_gain")])
    why = cause_sentences.rejected_because(found, "brake_gain")
    assert "a brake torque that is 5 % off in half of the cases" in why
    unseen = diagnosis(
        verdict=Verdict.CONSISTENT, tests=[score_test("brake_gain", smallest=np.inf)]
    )
    assert "no size of it" in cause_sentences.rejected_because(unseen, "brake_gain")
    entries = {entry["name"]: entry for entry in cause_report.as_json(unseen)["screened"]}
    assert entries["brake_gain"]["detectability"] is None
    assert cause_sentences.rejected_because(found, "sanding").startswith("not judged")
    entries = {entry["name"]: entry for entry in cause_report.as_json(found)["screened"]}
    assert entries["brake_gain"]["judged"]
    assert not entries["sanding"]["judged"]
    assert "sanding" in first_screen.not_judged(found)


def test_an_alternative_of_a_cause_is_not_among_what_was_ruled_out() -> None:
    tests = [score_test(name, 0.01, 1e-9, 90.0) for name in ("sensor_scale", "brake_gain")]
    found = diagnosis(Cause("wheel_radius", 2, {}, (-0.015,)), tests=tests)
    (cause,) = found.causes
    found = found._replace(causes=[cause._replace(confusable=("sensor_scale",))])
    report = cause_report.as_json(found)
    entries = {entry["name"]: entry["rejected_because"] for entry in report["screened"]}
    assert entries["sensor_scale"].startswith("not ruled out")
    assert "explains the same error" in entries["brake_gain"]
    _, ruled_out = cause_report.as_markdown(found, report).split("## What was ruled out")
    assert mechanisms.BY_NAME["brake_gain"].text in ruled_out
    assert mechanisms.BY_NAME["sensor_scale"].text not in ruled_out
    page = cause_report.page(found, report)
    _, of_page = page.split("What was ruled out</h2>")
    assert "<td>brake_gain</td>" in of_page
    assert "<td>sensor_scale</td>" not in of_page


@pytest.mark.parametrize("name", [row.name for row in table.TABLE if row.name != "empirical"])
def test_every_cause_has_a_size_in_words(name: str) -> None:
    assert name in sizes.WORDS
    text = sizes.in_words(name, -0.0123)
    assert any(letter.isdigit() for letter in text)
    assert "-" not in text


def test_a_size_is_in_the_unit_of_its_words() -> None:
    assert sizes.in_words("track_gradient", -0.005) == "a gradient of 5 in 1000"
    assert sizes.in_words("speed_sensor_delay", 0.0214) == "wheel speeds that are 21 ms late"
    assert sizes.in_words("brake_gain", 0.05) == "a brake torque that is 5 % off"


@pytest.mark.parametrize("name", [*columns.ALONG, "axle", "vehicle time", "wheel_angle"])
def test_every_covariate_has_suspects_and_what_to_measure_next(name: str) -> None:
    one = suspects.suspect(name)
    assert one is suspects.SUSPECTS[name]
    assert one.measure
    assert suspects.suspect("time of axle 2") is suspects.SUSPECTS["axle"]


def test_an_unexplained_speed_of_the_vehicle_is_drawn_as_speed_with_its_suspects() -> None:
    tests = [
        score_test("along vehicle speed", 5.0, 1e-12, 90.0),
        score_test("along sliding", 0.1, 1e-6, 40.0),
        score_test("running_resistance", 900.0, 1e-9, 80.0),
    ]
    found = diagnosis(verdict=Verdict.UNEXPLAINED, tests=tests)
    panels = cause_pictures.where(found, cause_sentences.worst_covariates(found))
    assert panels[0].y_label == "error of the speed 5 s ahead, m/s"
    assert panels[1].y_label == "measured less base model, adhesion"
    assert len(panels) == cause_pictures.MOST_PANELS
    figure = Figure()
    cause_pictures.draw(figure, panels)
    assert figure.axes[1].get_ylabel() == panels[1].y_label

    story = " ".join(cause_sentences.story(found))
    assert "gradient" in story
    assert "Measure next: let the vehicle coast" in story
    assert "Nearest in the library" in story
    assert "a resistance that is 900 N off (running_resistance, 89 %" in story


def test_covariates_with_the_same_suspects_share_one_line() -> None:
    tests = [
        score_test("along vehicle speed", 5.0, 1e-12, 90.0),
        score_test("along vehicle time", 5.0, 1e-11, 80.0),
        score_test("along sliding", 0.1, 1e-9, 60.0),
    ]
    found = diagnosis(verdict=Verdict.UNEXPLAINED, tests=tests)
    lines = first_screen.what_next(found, cause_sentences.worst_covariates(found))
    assert len(lines) == 2
    assert lines[0].startswith("Suspect along vehicle speed and vehicle time: ")
    assert "hysteresis of the brake" in lines[0]
    texts = [line.partition(": ")[2] for line in lines]
    assert len(set(texts)) == len(texts)


@pytest.mark.parametrize(("p_value", "is_near"), [(0.015, True), (1e-6, False)])
def test_an_error_near_the_limit_is_possible_and_one_stop_is_to_be_repeated(
    p_value: float, is_near: bool
) -> None:
    tests = [score_test("along vehicle speed", 5.0, p_value / 30.0, 17.0)]
    found = diagnosis(verdict=Verdict.UNEXPLAINED, tests=tests)._replace(p_value=p_value)
    story = " ".join(cause_sentences.story(found))
    assert ("possibly wrong" in story) == is_near
    assert ("repeat one stop unchanged" in story) == is_near
    assert ("The base model is wrong" in story) != is_near
    assert ("Suspect along" in story) != is_near


def test_the_measured_adhesion_of_another_inertia_is_that_of_the_extended_model() -> None:
    found = diagnosis(Cause("wheel_inertia", 0, {}, (0.5,)))
    courses = cause_report.adhesion_courses(found)
    measured, _, _ = gain.adhesion(found.design, found.final)
    by_base, _, _ = gain.adhesion(found.design, found.base)
    first = found.design.span(0)
    _, values = next(iter(courses.values()))
    assert np.array_equal(values[:, 0], measured[first])
    assert np.abs(measured - by_base).max() > 0.01

    figure = Figure()
    cause_pictures.stretch(figure, found)
    labels = [line.get_label() for line in figure.axes[0].get_lines()]
    assert "measured, as the base reads it" in labels


# --- materiality, and the metric of the gain ---


@pytest.mark.parametrize(("fade", "is_reported"), [(1e-5, False), (0.02, True)])
def test_a_cause_inside_the_declared_calibration_is_a_note_and_no_cause(
    fade: float, is_reported: bool
) -> None:
    found = diagnosis(Cause("pad_fade", 0, {}, (fade,)))
    search = decision._Search(
        explanation=found.final,
        causes=found.causes,
        score_tests=[],
        remainder=[],
        smoother_base=found.base,
    )
    left, notes = decision._without_immaterial(found.design, search)
    assert bool(left.causes) == is_reported
    assert bool(left.explanation.causes) == is_reported
    assert bool(notes) != is_reported
    verdict, _ = decision.decide_verdict(left.causes, left.remainder, None)
    assert (verdict == Verdict.CONSISTENT) != is_reported
    for note in notes:
        text = cause_sentences.note_sentence(note)
        assert "pad_fade is significant but immaterial" in text
        assert "inside your 0.3 %" in text


def test_an_immaterial_cause_is_reported_with_its_size() -> None:
    note = Note(NoteCode.IMMATERIAL, causes=("pad_fade",), share=0.001, tolerance=0.003)
    assert "changes the braking force by 0.1 %, inside your 0.3 %" in cause_sentences.note_sentence(
        note
    )


def test_a_consistent_answer_reports_what_is_significant_inside_the_calibration() -> None:
    note = Note(
        NoteCode.INSIDE_CALIBRATION,
        causes=("pad_fade", "track_gradient"),
        remainder=score_test(stopping.TIME),
        share=0.0041,
        tolerance=0.003,
        allowed=0.006,
    )
    found = diagnosis(verdict=Verdict.CONSISTENT)._replace(notes=[note])
    story = " ".join(cause_sentences.story(found))
    assert "Nothing is statistically significant" not in story
    assert "is 0.41 % of the braking force, within twice your 0.3 %" in story
    assert "pad_fade and track_gradient and a remainder along vehicle time" in story

    entry = cause_report.as_json(found)["immaterial"]
    assert entry == [
        {
            "code": "causes.inside_calibration",
            "causes": ["pad_fade", "track_gradient"],
            "along": "vehicle time",
            "share": 0.0041,
            "calibration_fraction": 0.003,
            "allowed_share": 0.006,
        }
    ]


def test_the_metric_of_a_gain_shows_what_its_causes_act_on() -> None:
    brake = Cause("brake_gain", 0, {}, (-0.05,))
    inertia = Cause("wheel_inertia", 0, {}, (1e-6,))
    alone = diagnosis(brake)
    assert gain.metric_of(alone.design, alone.base, alone.final) == gain.FREE_RUN
    friction = diagnosis(Cause("rail_cleaning", 0, {"energy_J_m": 150.0}, (0.2,)))
    assert gain.metric_of(friction.design, friction.base, friction.final) == gain.ADHESION

    # torques that really are 8 % too large, beside a cause that changes nothing
    both = diagnosis(Cause("brake_gain", 0, {}, (-0.08,)), inertia)
    torque_Nm = both.design.torque_Nm / 0.92
    design = both.design._replace(torque_Nm=torque_Nm)
    assert gain.metric_of(design, both.base, both.final) == gain.FREE_RUN
    assert gain.metric_of(None, both.base, both.final) == gain.ADHESION


def test_a_wrong_brake_shows_its_gain_although_a_wrong_mass_would_hide_it() -> None:
    brake = diagnosis(Cause("brake_gain", 0, {}, (-0.08,)))
    design = brake.design._replace(torque_Nm=brake.design.torque_Nm / 0.92)
    measured = gain.measure(design, brake.base, brake.final, 0)
    assert measured.metric == gain.FREE_RUN
    assert measured.claimed
    assert measured.reduction > 0.8


@pytest.mark.parametrize("fraction", [0.003, -0.005])
def test_a_brake_that_is_off_by_no_more_than_its_calibration_gains_nothing(fraction: float) -> None:
    brake = diagnosis(Cause("brake_gain", 0, {}, (fraction,)))
    assert abs(fraction) < gain.TOLERANCES * brake.design.calibration
    design = brake.design._replace(torque_Nm=brake.design.torque_Nm / (1.0 + fraction))
    measured = gain.measure(design, brake.base, brake.final, 0)
    assert measured.metric == gain.FREE_RUN
    assert abs(measured.reduction) < 0.05
    assert not measured.claimed
