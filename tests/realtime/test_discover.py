"""A rig that hides something tells nothing of it, and finds out by itself."""

import json
import re

import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.discover import discover, sealed_rig
from rollerrig.realtime.record import records
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.preparation import prepare
from rollerrig.rig.identify.next_stops.prototype import Stop
from rollerrig.rig.identify.replay import sensitivity


def sealed(folder, hidden=None, seed=3):
    """A sealed rig, and its key; `hidden` in place of what the seed draws."""
    rig, key = folder / "rig.toml", folder / "rig.key"
    assert cli.main(["hide", "--seed", str(seed), "--out", str(rig)]) == 0
    if hidden is not None:
        text = rig.read_text()
        begin = text.index("sealed = ")
        rig.write_text(
            text[:begin] + f'sealed = "{sealed_rig.seal.encode(hidden)}"\n'.replace("\n", "") + "\n"
        )
    return rig, key


def test_a_sealed_rig_tells_nothing_and_repeats_by_its_seed_and_its_key_tells_all(
    tmp_path, capsys
) -> None:
    plain = set()
    for seed in range(4):
        rig, key = sealed(tmp_path, seed=seed)
        plain.add(re.sub('sealed = "[A-Za-z0-9+/=]+"', "", rig.read_text()))
        assert len(plain) == 1
        assert all(
            mechanism in key.read_text() or "diameter" in key.read_text()
            for mechanism in sealed_rig.causes(rig)
        )
        text, words = rig.read_text(), key.read_text()
        sealed(tmp_path, seed=seed)
        assert (rig.read_text(), key.read_text()) == (text, words)
    assert len({str(sealed_rig.drawn(seed)) for seed in range(20)}) == 20


def test_what_is_sealed_acts_and_stands_in_no_text_of_a_run(tmp_path, capsys) -> None:
    hidden = {
        "mechanisms": {"brake_gain_gain": 0.2},
        "causes": ["brake_gain", "wheel_radius"],
        "fault": [{"kind": "wheel_diameter_mismatch", "axle": 2, "difference_percent": 5.0}],
    }
    rig, _ = sealed(tmp_path, hidden)
    plan = scenario.load(str(rig))
    assert plan.params.effects.on_torque
    assert plan.resolved["mechanisms"]["brake_gain_gain"] == 0.0
    folder = discover.brake((str(rig), tmp_path / "run", Stop(4.0, 3.8e5, 43000.0, 0), 0))
    run = records.load(folder)
    ratio = run.column("wheel_speed_2_rad_s") / run.column("measured_speed_2_rad_s")
    assert ratio[1:50] == pytest.approx(1.05, abs=1e-6)
    for name in ("scenario.toml", "events.jsonl", "summary.json"):
        told = (folder / name).read_text()
        assert "difference_percent" not in told
        assert "0.2" not in [word.strip(",") for word in told.split()] or name == "scenario.toml"
    # run again from its own record it hides the same
    again = scenario.load(str(folder / "scenario.toml"))
    assert again.params.effects.on_torque
    assert [fault.kind.name for fault in again.faults] == ["wheel_diameter_mismatch"]


def test_a_rig_holds_a_speed_while_its_wheels_slide_and_the_replay_asks_for_no_force_balance(
    tmp_path,
) -> None:
    stop = Stop(35.0, 3.8e5, 43000.0, 0, 6.0)
    run = records.load(discover.brake(("velim_a1", tmp_path / "held", stop, 0)))
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
    # no force on a vehicle shows in it
    uphill = explanation._replace(causes=(candidates.Cause("track_gradient", 0, {}, (0.02,)),))
    assert (sensitivity.replay_vehicles(design, candidates.inputs(design, uphill))[0] == nu).all()


def test_the_record_of_a_stop_tells_of_faults_that_no_event_tells(tmp_path, capsys) -> None:
    hidden = {
        "fault": [
            {"kind": "vent_magnet_stuck", "axle": 3},
            {"kind": "speed_noise_burst", "axle": 2},
        ]
    }
    rig, _ = sealed(tmp_path, hidden)
    folder = discover.brake((str(rig), tmp_path / "run", Stop(20.0, 3.8e5, 43000.0, 0), 0))
    assert discover.shown([folder]) == ["speed_noise_burst axle=2", "vent_magnet_stuck axle=3"]
    assert "fault" not in (folder / "events.jsonl").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("discover", "velim_a1", "--stops", "2"), "3 stops and more"),
        (("discover", "no_such_rig"), "no scenario is called"),
        (("hide", "--effects", "3"), "1 or 2 effects"),
        (("run", "velim_a1", "--set", "sealed=abc"), "sealed: the text is damaged"),
        (
            ("run", "velim_a1", "--set", "rig.speed=held", "--set", "rig=plain_track"),
            "drives hold the speed",
        ),
    ],
)
def test_what_cannot_be_is_told_clearly(words, said, tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(list(words)) == 2
    assert said in capsys.readouterr().err


def test_a_history_of_another_rig_is_refused(tmp_path) -> None:
    (tmp_path / discover.HISTORY).write_text(
        json.dumps({"rig": "another", "seed": 0, "rounds": []})
    )
    with pytest.raises(ConfigError, match="another rig"):
        discover.find_out("velim_a1", tmp_path, 9, 0, print, lambda *_: None)


@pytest.mark.explanation
def test_a_loud_effect_is_found_out_and_an_interrupted_search_goes_on(tmp_path, capsys) -> None:
    rig, _ = sealed(
        tmp_path,
        {
            "mechanisms": {"wheel_radius_fraction": 0.006, "wheel_radius_axle": 3.0},
            "fault": [],
            "causes": ["wheel_radius"],
        },
    )
    # as if it had been interrupted behind its first stop
    first = discover.brake(
        (str(rig), tmp_path / "found" / "stops" / "01", Stop(38.0, 3.8e5, 43000.0, 0), 0)
    )
    made_ns = (first / "channels.parquet").stat().st_mtime_ns
    assert cli.main(["discover", str(rig), "--stops", "3", "--out", str(tmp_path / "found")]) == 0
    told = json.loads((tmp_path / "found" / "report.json").read_text())
    assert (first / "channels.parquet").stat().st_mtime_ns == made_ns
    assert told["verdict"] == "explained"
    assert [one["name"] for one in told["causes"]] == ["wheel_radius"]
    assert told["causes"][0]["axles"] == [3]
    assert [one["stops"] for one in told["history"]["rounds"]] == [3]
    assert (tmp_path / "found" / "report.html").is_file()


# what a rig hides, and what three stops at one mass tell of it: sets of causes that they cannot part
BESIDE = {
    "one pair of causes cannot be fitted": (
        {"friction_trend_rate_1_s": -0.0128, "running_resistance_force_N": 698.0},
        [{"friction_trend"}, {"track_gradient", "running_resistance"}],
    ),
    "the first cause gives way beside the second": (
        {"track_gradient_gradient": -0.00465, "load_transfer_body_s2_m": 0.0303},
        [{"track_gradient", "running_resistance"}, {"load_transfer"}],
    ),
}


@pytest.mark.explanation
@pytest.mark.parametrize("what", BESIDE)
def test_a_cause_beside_another_is_told_with_what_it_is_confused_with(tmp_path, what) -> None:
    mechanisms, wanted = BESIDE[what]
    rig, _ = sealed(tmp_path, {"mechanisms": mechanisms, "fault": [], "causes": []})
    account, history = discover.find_out(str(rig), tmp_path / "found", 3, 0, print, lambda *_: None)
    assert account.verdict == "explained"
    told = [set(names) for names in history["rounds"][-1]["causes"]]
    assert sorted(told, key=sorted) == sorted(wanted, key=sorted)
