"""A sealed rig does not show what it hides, and `discover` finds it from stops."""

import json
import os
import re
import shutil

import pytest
from generator import diagnoses

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.discover import discover, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.causes.candidates import Cause
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.rig.identify.replay import sensitivity

# a brake demand of all axles at the mass of the packaged scenarios
PRESSURE_PA = 3.8e5
MASS_KG = 43000.0
ALL_AXLES = 0


def sealed(folder, hidden=None, seed=3):
    """Return a sealed rig and its key; `hidden` replaces the content that the seed draws."""
    rig = folder / "rig.toml"
    assert cli.main(["hide", "--seed", str(seed), "--out", str(rig)]) == 0
    if hidden is not None:
        before_seal = rig.read_text().partition("sealed = ")[0]
        encoded = sealed_rig.seal.encode(hidden).replace("\n", "")
        rig.write_text(f'{before_seal}sealed = "{encoded}"\n')
    return rig, folder / "rig.key"


def brake(rig, folder, speed_m_s, held_s=0.0):
    """Run one stop of a rig; return its folder."""
    stop = Stop(speed_m_s, PRESSURE_PA, MASS_KG, ALL_AXLES, held_s)
    return discover.brake((str(rig), folder, stop, 0))


def find_out(rig, out, most, **changed):
    return discover.find_out(str(rig), out, most, 0, print, lambda *_: None, **changed)


def test_only_the_key_of_a_sealed_rig_shows_what_it_hides_and_a_seed_repeats_both(
    tmp_path, capsys
) -> None:
    plain = set()
    for seed in range(4):
        rig, key = sealed(tmp_path, seed=seed)
        text = rig.read_text()
        words = key.read_text()
        plain.add(re.sub('sealed = "[A-Za-z0-9+/=]+"', "", text))
        assert len(plain) == 1
        for cause in sealed_rig.causes(rig):
            # the fault of a wheel's diameter has the cause wheel_radius
            assert cause in words or "diameter" in words

        sealed(tmp_path, seed=seed)
        assert rig.read_text() == text
        assert key.read_text() == words
    hidden = [sealed_rig.draw(seed) for seed in range(60)]
    assert len(set(map(str, hidden))) == 60
    axles = {
        row[key]
        for rig in hidden
        for row in (rig["mechanisms"], *rig["fault"])
        for key in row
        if key.endswith("axle")
    }
    assert axles == {1, 2, 3, 4}


def test_sealed_effects_act_and_no_file_of_a_run_shows_them(tmp_path, capsys) -> None:
    hidden = {
        "mechanisms": {"brake_gain_gain": 0.2},
        "causes": ["brake_gain", "wheel_radius"],
        "fault": [{"kind": "wheel_diameter_mismatch", "axle": 2, "difference_percent": 5.0}],
    }
    rig, _ = sealed(tmp_path, hidden)
    plan = scenario.load(str(rig))
    assert plan.params.effects.on_torque
    assert plan.resolved["mechanisms"]["brake_gain_gain"] == 0.0
    folder = brake(rig, tmp_path / "run", 4.0)
    run = records.load(folder)
    ratio = run.column("wheel_speed_2_rad_s") / run.column("measured_speed_2_rad_s")
    assert ratio[1:50] == pytest.approx(1.05, abs=1e-6)
    for name in ("scenario.toml", "events.jsonl", "summary.json"):
        text = (folder / name).read_text()
        assert "difference_percent" not in text
        # a scenario has other values of 0.2
        if name != "scenario.toml":
            assert "0.2" not in [word.strip(",") for word in text.split()]

    # the recorded scenario hides the same effects
    again = scenario.load(str(folder / "scenario.toml"))
    assert again.params.effects.on_torque
    assert [fault.kind.name for fault in again.faults] == ["wheel_diameter_mismatch"]


def test_a_rig_holds_a_speed_while_its_wheels_slide_and_the_replay_needs_no_force_balance(
    tmp_path,
) -> None:
    run = records.load(brake("velim_a1", tmp_path / "held", 35.0, held_s=6.0))
    assert run.summary["invalid_because"] == []
    assert run.column("vehicle_speed_m_s") == pytest.approx(35.0, abs=1e-9)
    assert run.column("sliding_1_m_s").max() > 1.0
    assert run.column("roller_speed_1_rad_s")[-1] == pytest.approx(35.0, rel=0.01)
    made = discover.run_dataset.from_folders(
        [run.folder], tmp_path / "set", (), discover.run_sensors.NOISE
    )
    data = dataset.load(made)
    design = prepare(data, data.runs)
    explanation = candidates.untuned(design)
    nu, variance = sensitivity.replay_vehicles(design, candidates.inputs(design, explanation))
    assert (nu**2 / variance).mean() == pytest.approx(1.0, abs=0.2)

    # a force on the vehicle does not change the residuals
    uphill = explanation._replace(causes=(Cause("track_gradient", 0, {}, (0.02,)),))
    nu_uphill, _ = sensitivity.replay_vehicles(design, candidates.inputs(design, uphill))
    assert (nu_uphill == nu).all()


def test_the_record_of_a_stop_shows_faults_of_which_there_is_no_event(tmp_path, capsys) -> None:
    hidden = {
        "fault": [
            {"kind": "vent_magnet_stuck", "axle": 3},
            {"kind": "speed_noise_burst", "axle": 2},
        ]
    }
    rig, _ = sealed(tmp_path, hidden)
    folder = brake(rig, tmp_path / "run", 12.0)
    faults = discover.common_faults([folder])
    assert faults == ["speed_noise_burst axle=2", "vent_magnet_stuck axle=3"]
    assert "fault" not in (folder / "events.jsonl").read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("discover", "velim_a1", "--stops", "2"), "3 stops or more"),
        (("discover", "no_such_rig"), "no scenario is called"),
        (("hide", "--effects", "3"), "1 or 2 effects"),
        (("run", "velim_a1", "--set", "sealed=abc"), "sealed: the text is damaged"),
        (
            ("run", "velim_a1", "--set", "rig.speed=held", "--set", "rig=plain_track"),
            "drives hold the speed",
        ),
    ],
)
def test_impossible_arguments_are_refused_with_the_reason(
    words, message, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(list(words)) == 2
    assert message in capsys.readouterr().err


def test_a_history_of_another_rig_is_refused(tmp_path) -> None:
    (tmp_path / discover.HISTORY).write_text(
        json.dumps({"rig": "another", "seed": 0, "rounds": []})
    )
    with pytest.raises(ConfigError, match="another rig"):
        find_out("velim_a1", tmp_path, 9)


# --- the search, with given diagnoses of its rounds ---

SPEED = Cause("speed_dependent_friction", 0, {}, (0.004,))
TIME = Cause("friction_trend", 0, {}, (0.01,))
EITHER = (diagnoses.identified(SPEED, [TIME.name]),)
RADIUS = (diagnoses.identified(Cause("wheel_radius", 3, {}, (0.006,))),)


def explain_as(rounds, seen):
    """Return an `explain` that finds the causes of these rounds; `seen` collects its datasets."""
    tests = [diagnoses.score_test(cause) for cause in (SPEED, TIME)]

    def explain(data, seed, progress):
        seen.append(data)
        return diagnoses.diagnosis(data, rounds[len(seen) - 1], tests)

    return explain


def stops_of(history):
    """Return the number of stops of each round."""
    return [row["stops"] for row in history["rounds"]]


@pytest.fixture(scope="module")
def first_stops(tmp_path_factory):
    """The folder of a search with its first three stops, as after an interruption."""
    out = tmp_path_factory.mktemp("stops")
    for name, speed_m_s in (("01", 38.0), ("02", 22.0), ("03", 30.0)):
        brake("velim_a1", out / "stops" / name, speed_m_s)
    return out


@pytest.fixture(scope="module")
def searched(first_stops, tmp_path_factory):
    """A search of five stops in which two causes look alike: folder, history and datasets."""
    out = tmp_path_factory.mktemp("search") / "found"
    with_stops(first_stops, out, 3)
    seen = []
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})  # on one core a single process runs the two other stops
    try:
        _, history = find_out("velim_a1", out, 5, explain=explain_as([EITHER] * 2, seen))
    finally:
        os.sched_setaffinity(0, cores)
    return out, history, seen


def with_stops(source, out, number):
    """Copy the first stops of the search, and return where the file of each one was written."""
    for name in range(1, number + 1):
        folder = f"{name:02d}"
        shutil.copytree(source / "stops" / folder, out / "stops" / folder)
    return {path: path.stat().st_mtime_ns for path in out.glob("stops/*/channels.parquet")}


def with_first_round(searched, out, **changed):
    """Write the history of the search as it was after its first round, with the next stops."""
    history = json.loads((searched[0] / discover.HISTORY).read_text())
    first, *_ = history["rounds"]
    history["rounds"] = [first | changed]
    (out / discover.HISTORY).write_text(json.dumps(history))


def written_again(files):
    """Return the files that are not as they were."""
    return [path for path, at_ns in files.items() if path.stat().st_mtime_ns != at_ns]


@pytest.mark.nightly
def test_the_search_runs_new_stops_until_the_budget_is_used_up(searched) -> None:
    out, history, seen = searched
    assert stops_of(history) == [3, 5]
    names = ["01", "02", "03", "04", "05"]
    assert sorted(path.name for path in (out / "stops").iterdir()) == names
    rows = history["stops"]
    assert [row["initial_speed_m_s"] for row in rows[:3]] == [38.0, 22.0, 30.0]
    assert len({discover._stop_of(row) for row in rows}) == 5
    for row in rows[3:]:
        assert SPEED.name in row["why"]
    # the third stop is never fitted
    for data in seen:
        assert [run.name for run in data.group("validate")] == ["03"]
    assert [len(data.group("tune")) for data in seen] == [2, 4]

    written = json.loads((out / "discover.json").read_text())
    assert written["stops_used"] == 5
    assert written["verdict"] == "explained"
    assert written["causes"] == [[SPEED.name, TIME.name]]


@pytest.mark.nightly
def test_the_last_round_runs_no_more_stops_than_the_budget_has(searched, tmp_path) -> None:
    with_stops(searched[0], tmp_path, 4)
    with_first_round(searched, tmp_path)
    _, history = find_out("velim_a1", tmp_path, 4, explain=explain_as([EITHER], []))
    assert stops_of(history) == [3, 4]


def test_the_search_is_over_with_one_cause_that_nothing_looks_like(first_stops, tmp_path) -> None:
    files = with_stops(first_stops, tmp_path, 3)
    diagnosis, history = find_out("velim_a1", tmp_path, 9, explain=explain_as([RADIUS], []))
    assert stops_of(history) == [3]
    assert history["rounds"][0]["causes"] == [["wheel_radius"]]
    assert diagnosis.causes == list(RADIUS)
    assert written_again(files) == []


@pytest.mark.nightly
def test_the_search_is_over_after_two_rounds_without_a_cause(searched, tmp_path) -> None:
    files = with_stops(searched[0], tmp_path, 5)
    with_first_round(searched, tmp_path, verdict="consistent", causes=[])
    diagnosis, history = find_out("velim_a1", tmp_path, 9, explain=explain_as([()], []))
    assert stops_of(history) == [3, 5]
    assert diagnosis.verdict == "consistent"
    assert written_again(files) == []


@pytest.mark.nightly
def test_a_search_that_was_interrupted_continues_with_its_stops(searched, tmp_path) -> None:
    files = with_stops(searched[0], tmp_path, 5)
    with_first_round(searched, tmp_path)
    _, history = find_out("velim_a1", tmp_path, 5, explain=explain_as([EITHER], []))
    assert stops_of(history) == [3, 5]
    assert written_again(files) == []


@pytest.mark.nightly
def test_a_search_continues_with_a_larger_budget_and_proposes_the_same_stops(
    searched, tmp_path
) -> None:
    files = with_stops(searched[0], tmp_path, 5)
    _, history = find_out("velim_a1", tmp_path, 3, explain=explain_as([EITHER], []))
    assert stops_of(history) == [3]
    _, history = find_out("velim_a1", tmp_path, 5, explain=explain_as([EITHER] * 2, []))
    assert stops_of(history) == [3, 5]
    assert written_again(files) == []


def test_data_that_cannot_be_explained_end_the_search_with_the_reason(
    first_stops, tmp_path
) -> None:
    def explain(data, seed, progress):
        raise ConfigError("this is the reason")

    with_stops(first_stops, tmp_path, 3)
    with pytest.raises(ConfigError, match="this is the reason"):
        find_out("velim_a1", tmp_path, 3, explain=explain)


# --- whole searches ---


@pytest.mark.nightly
@pytest.mark.explanation
def test_a_large_effect_is_found_and_an_interrupted_search_continues(tmp_path, capsys) -> None:
    hidden = {
        "mechanisms": {"wheel_radius_fraction": 0.006, "wheel_radius_axle": 3.0},
        "fault": [],
        "causes": ["wheel_radius"],
    }
    rig, _ = sealed(tmp_path, hidden)
    out = tmp_path / "found"
    # the first stop is there, as after an interruption
    first_stop = brake(rig, out / "stops" / "01", 38.0) / "channels.parquet"
    written_ns = first_stop.stat().st_mtime_ns
    assert cli.main(["discover", str(rig), "--stops", "3", "--out", str(out)]) == 0
    assert first_stop.stat().st_mtime_ns == written_ns

    report = json.loads((out / "report.json").read_text())
    assert report["verdict"] == "explained"
    assert [cause["name"] for cause in report["causes"]] == ["wheel_radius"]
    assert report["causes"][0]["axles"] == [3]
    assert [row["stops"] for row in report["history"]["rounds"]] == [3]
    assert (out / "report.html").is_file()


# The hidden mechanisms, and the causes that three stops at one mass identify: each set holds causes
# that the stops cannot distinguish.
TWO_EFFECTS = {
    "one pair of causes cannot be fitted": (
        {"friction_trend_rate_1_s": -0.0128, "running_resistance_force_N": 698.0},
        [{"friction_trend"}, {"track_gradient", "running_resistance"}],
    ),
    "the first cause is replaced when the second is fitted": (
        {"track_gradient_gradient": -0.00465, "load_transfer_body_s2_m": 0.0303},
        [{"track_gradient", "running_resistance"}, {"load_transfer"}],
    ),
}


@pytest.mark.nightly
@pytest.mark.explanation
@pytest.mark.parametrize("case", TWO_EFFECTS)
def test_each_of_two_causes_is_identified_with_its_confusable_causes(tmp_path, case) -> None:
    mechanisms, wanted = TWO_EFFECTS[case]
    rig, _ = sealed(tmp_path, {"mechanisms": mechanisms, "fault": [], "causes": []})
    diagnosis, history = find_out(rig, tmp_path / "found", 3)
    assert diagnosis.verdict == "explained"
    causes = [set(names) for names in history["rounds"][-1]["causes"]]
    assert sorted(causes, key=sorted) == sorted(wanted, key=sorted)
