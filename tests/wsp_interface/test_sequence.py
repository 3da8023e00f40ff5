"""Sequences: how they are read, what is refused with which line, and the packaged library."""

import json
from pathlib import Path

import pytest
from synthetic_record import GOOD

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime import cli
from rollerrig.realtime.commands import sequence as verb_sequence
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.sequences import conditions, sequence, verdict


def read(folder: Path, text: str) -> sequence.Sequence:
    """Write a sequence into a file and load it."""
    path = folder / "one.toml"
    path.write_text(text, encoding="utf-8")
    return sequence.load(path, catalogue.parse)


def test_quantities_become_si_at_the_edge(tmp_path):
    loaded = read(tmp_path, GOOD)
    step = loaded.steps[0]
    assert loaded.speed_m_s == pytest.approx(40 / 3.6)
    assert step.brake_Pa == pytest.approx(3.8e5)
    assert (step.at_s, step.timeout_s) == (1.0, 60.0)
    assert step.until.bound == pytest.approx(1 / 3.6)
    assert loaded.criteria.limits


# a text of the good sequence, its replacement, the line in the message and a part of the message
REFUSED = (
    ('title = "A stop from forty on soap"', 'title = "stop"', "line 1", "sentence"),
    ("{ brake_demand =", "{ gradient =", "line 11", "mass and gradient stay constant"),
    ("set = {", "sett = {", "line 11", "unknown key"),
    ("vehicle_speed < 1 km/h", "vehicle_sped < 1 km/h", "line 12", "vehicle_speed"),
    ("vehicle_speed < 1 km/h", "vehicle_speed < 1 bar", "line 12", "does not belong"),
    ("vehicle_speed < 1 km/h", "vehicle_speed < 1 furlong", "line 12", "no unit"),
    (
        "vehicle_speed < 1 km/h",
        "vehicle_speed < 1",
        "line 12",
        "the unit is missing; write a number",
    ),
    ("vehicle_speed < 1 km/h", "any adhesion > 1 bar", "line 12", "without a unit or with %"),
    ("[[step]]\ntitle", "[[steps]]\ntitle", "line 8", "did you mean 'step'"),
    ("vehicle_speed < 1 km/h", "vehicle_speed < 0 km/h", "line 12", "can never be"),
    ("vehicle_speed < 1 km/h", "vehicle_speed > 50 km/h", "line 12", "nothing drives it"),
    ("vehicle_speed < 1 km/h", "time < 1 s", "line 12", "can never be"),
    ("vehicle_speed < 1 km/h", "any valve > 2", "line 12", "can never be"),
    ("timeout =", 'for = "2 s"\ntimeout =', "line 13", "either"),
    ("timeout =", 'hold = "99 s"\ntimeout =', "line 13", "never be within"),
    ('"3.8 bar"', '"38 bar"', "line 11", "0 to 10 bar"),
    ('"3.8 bar"', "3.8", "line 11", "with its unit"),
    ("brake_demand", "brake_demands", "line 11", "brake_demand"),
    ("timeout =", 'fault = "speed_sensor_lost axle=2"\ntimeout =', "line 13", "is not a fault"),
    ("timeout =", 'fault = "speed_sensor_stuck axle=7"\ntimeout =', "line 13", "allowed 1 to 4"),
    ("timeout =", "friction = { mu = 0.05, axles = [9] }\ntimeout =", "line 13", "axle numbers"),
)


@pytest.mark.parametrize(("old", "new", "line", "expected"), REFUSED)
def test_a_wrong_sequence_is_refused_with_file_and_line(tmp_path, old, new, line, expected):
    assert old in GOOD
    with pytest.raises(ConfigError) as refusal:
        read(tmp_path, GOOD.replace(old, new, 1))
    text = str(refusal.value)
    assert "one.toml" in text
    assert line in text
    assert expected in text


def test_a_step_that_would_begin_in_the_past_is_refused(tmp_path):
    late = GOOD + '\n[[step]]\ntitle = "again"\nat = "0.5 s"\nfor = "1 s"\n'
    with pytest.raises(ConfigError, match=r"line 17.*is over before"):
        read(tmp_path, late)


MEASURE = '\n[[measure]]\nmeasure = "longest_lock"\nunit = "s"\nmax = 0.4\nsource = "memory"\n'


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('unit = "s"', 'unit = "ms"', 'is in s; write unit = "s"'),
        ("max = 0.4", "max = -1", "least value that longest_lock can have"),
        ("max = 0.4", "max = 0.4\nmin = 0.5", "below min"),
        ('source = "memory"\n', "", "source"),
        ('"longest_lock"', '"longest_look"', "longest_lock"),
        ("max = 0.4\n", "", "min, a max or both"),
    ],
)
def test_a_limit_that_is_impossible_or_unknown_is_refused(tmp_path, old, new, expected):
    assert read(tmp_path, GOOD + MEASURE)
    with pytest.raises(ConfigError, match=r"one\.toml, line (1[5-9]|2)") as refusal:
        read(tmp_path, GOOD + MEASURE.replace(old, new))
    assert expected in str(refusal.value)


@pytest.mark.parametrize(
    "start",
    [
        "tables = 0",
        'tables = " "',
        'mass = "40 t"\ntables = { vehicle = 1 }',
        'gradient = "1 %"\ntables = { mechanisms = 1 }',
    ],
)
def test_a_value_in_the_place_of_a_table_is_refused(tmp_path, start):
    speed = next(line for line in GOOD.splitlines() if line.startswith("speed"))
    with pytest.raises(ConfigError, match="is not a table"):
        read(tmp_path, GOOD.replace(speed, f"{speed}\n{start}"))


@pytest.mark.parametrize("key", ["scenario", "wsp", "criteria"])
def test_a_table_in_the_place_of_a_text_is_refused(tmp_path, key):
    with pytest.raises(ConfigError, match=rf"one\.toml, .*{key} = \{{.*a text in quotes"):
        read(
            tmp_path,
            f"{key} = {{ sensor = {{ noise_rad_s = 0.1 }} }}\n" + GOOD.replace(f"{key} =", "#"),
        )


def test_a_limit_of_the_sequence_replaces_that_of_its_profile(tmp_path):
    loaded = read(tmp_path, GOOD + MEASURE.replace("0.4", "0.7"))
    bounds = [limit.high for limit in loaded.criteria.limits if limit.measure == "longest_lock"]
    assert bounds == [0.7]


def test_a_condition_of_every_axle_needs_all_and_of_any_needs_one():
    coach = signals.table(COACH)
    every = conditions.condition("every cylinder_pressure > 1 bar", "here", coach)
    some = conditions.condition("any cylinder_pressure > 1 bar", "here", coach)
    values = dict(zip(every.columns, (2e5, 2e5, 2e5, 0.0), strict=True))
    assert not every.holds(values)
    assert some.holds(values)
    assert not some.holds(dict.fromkeys(every.columns, float("nan")))


# those of the coach, and those of other vehicles
PACKAGED = (*store.names("sequences"), *store.names_of_vehicles("sequences"))


@pytest.mark.parametrize("name", PACKAGED)
def test_every_packaged_sequence_is_in_order_and_has_limits(name):
    loaded = sequence.load(name, catalogue.parse)
    assert loaded.criteria.limits
    assert loaded.steps


# the coach has the packaged sequences without a vehicle, and a freight wagon has no unit to test
WITHOUT_SEQUENCES = {"uic_z1", "freight_wagon"}


@pytest.mark.parametrize("vehicle", sorted(set(store.names("vehicles")) - WITHOUT_SEQUENCES))
def test_every_shipped_vehicle_has_sequences(vehicle):
    scenarios = []
    for name in store.names_of_vehicles("sequences"):
        content, _ = store.load("sequences", name)
        scenarios.append(content["scenario"])
    of_vehicles = set(scenarios) - set(store.names("trains"))
    vehicles = {store.load("scenarios", name)[0]["vehicle"] for name in of_vehicles}
    assert vehicle in vehicles


def test_no_two_packaged_sequences_have_the_same_name():
    assert not set(store.names("sequences")) & set(store.names_of_vehicles("sequences"))


def test_one_command_plays_sequences_of_several_vehicles():
    loaded = verb_sequence.load(["dry_120", "tram_dynamic_brake_lost", "multiple_unit_dynamic_low"])
    kinds = [sequence.kind for sequence in loaded]
    assert kinds == [COACH, Kind(6, True, True), Kind(8, True, False)]
    # the kind by the texts is that of the bench
    assert kinds == [verb_sequence.scenario_of(sequence).kind for sequence in loaded]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("timeout =", "friction = { mu = 0.05, axles = [7] }\ntimeout =", "numbers from 1 to 6"),
        ("timeout =", 'fault = "speed_sensor_stuck axle=7"\ntimeout =', "allowed 1 to 6"),
        ("vehicle_speed < 1 km/h", "cylinder_pressure_7 > 1 bar", "there are axles 1 to 6"),
        ('"tram_low"', '"trams_low"', "no scenario is called 'trams_low'"),
    ],
)
def test_a_sequence_has_the_axles_of_its_vehicle(tmp_path, old, new, expected):
    of_tram = GOOD.replace("[start]", 'scenario = "tram_low"\n[start]')
    conditions_of_step = read(tmp_path, of_tram).steps[0]
    assert conditions_of_step.until.columns == ("vehicle_speed_m_s",)
    with pytest.raises(ConfigError, match=expected):
        read(tmp_path, of_tram.replace(old, new, 1))


@pytest.mark.conformance("Faults", "every fault has a sequence in the library")
def test_the_library_has_every_fault_of_the_catalogue():
    used = set()
    for name in PACKAGED:
        for step in sequence.load(name, catalogue.parse).steps:
            used |= {text.split()[0] for text in step.faults}
    missing = {kind.name for kind in catalogue.CATALOGUE} - used
    assert not missing


@pytest.mark.parametrize("name", store.names("criteria"))
def test_every_number_of_a_profile_has_a_source(name):
    profile = verdict.load(name)
    assert profile.limits
    assert all(limit.source for limit in profile.limits)


def test_the_command_names_every_mistake_and_runs_nothing(tmp_path, capsys):
    (tmp_path / "one.toml").write_text(GOOD.replace("1 km/h", "1 bar"), encoding="utf-8")
    (tmp_path / "two.toml").write_text(GOOD.replace('"soap"', '"soup"'), encoding="utf-8")
    (tmp_path / "three.toml").write_text(GOOD, encoding="utf-8")
    out = tmp_path / "report"
    assert cli.main(["sequence", str(tmp_path), "--out", str(out)]) == 2
    errors = capsys.readouterr().err
    assert "one.toml, line 12" in errors
    assert "did you mean 'soap'?" in errors
    assert not out.exists()


def test_the_command_checks_a_folder_of_good_sequences(tmp_path, capsys):
    (tmp_path / "one.toml").write_text(GOOD, encoding="utf-8")
    assert cli.main(["sequence", str(tmp_path), "--check", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"checked": ["one"]}


def test_a_gradient_and_a_mass_reach_the_scenario(tmp_path):
    steep = GOOD.replace('adhesion = "soap"', 'adhesion = "soap"\ngradient = "-1 %"\nmass = "48 t"')
    tables = read(tmp_path, steep).tables
    assert tables["mechanisms"]["track_gradient_gradient"] == pytest.approx(-0.01)
    assert tables["vehicle"]["mass_kg"] == pytest.approx(48000.0)
    # downhill a train may become faster
    assert read(tmp_path, steep.replace("vehicle_speed < 1 km/h", "vehicle_speed > 45 km/h"))
