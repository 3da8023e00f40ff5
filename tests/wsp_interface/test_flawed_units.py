"""The packaged limits tell a wheel slide protection from none, and from one with a flaw.

A limit that a train without protection passes says nothing. So this is a rule for every profile: on
low adhesion the reference unit passes each packaged sequence, and the train without a unit fails
it, and so does each of ten flawed units. One short stop is played before each commit, the others
every night.
"""

import functools
import json

import judge_flawed
import memory_bench
import pytest
from flawed_units import FLAWED, DeadWhenSlow, Unit, WrongDiameter
from program import rollerrig

from rollerrig.configs import store
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.wsp_interface.sequences import measures, sequence
from rollerrig.wsp_interface.sequences.verdict import Result

LOW_SETS = ("low", "very_low", "wet_leaves", "leaf_film")
# the stop that is played before each commit
FIRST = "emergency_040"
# sequences on low adhesion that do not judge the unit on it: why
OTHERS = {
    "tram_dynamic_low_uncontrolled": "the contrast: it passes because nothing protects the motors",
    "tram_low_speed_010": "it begins below the speed at which protections act",
    "tram_start_low": "it judges the slip control of the traction unit",
}
# sequences that do not show every flaw, but the lack of a unit: why
MILD = {
    "patches_one_side": "between the patches the adhesion suffices",
}
# these judge what a false sensor costs, and a unit with a wide band may bear this well
MILD |= dict.fromkeys(
    [name for name in store.names("sequences") if name.startswith("sensor_")],
    "it judges how a unit bears a false sensor",
)
# flaws that a sequence cannot show: why
EMPTY = "below 20 km/h the reservoir is too empty to lock a wheel"
CLEANED = "below 20 km/h the rail is so clean that this brake locks no wheel"
SHORT = "the stop is so short that its wheels slide deeply for 0.68 s only, and 0.7 s is the limit"
HARMLESS = {
    ("emergency_040", WrongDiameter): SHORT,
    ("air_120", DeadWhenSlow): CLEANED,
    ("air_exhausted_120", DeadWhenSlow): EMPTY,
    ("air_exhausted_very_low_080", DeadWhenSlow): EMPTY,
    ("emergency_120_laden", DeadWhenSlow): CLEANED,
    ("service_160", DeadWhenSlow): CLEANED,
    ("service_200", DeadWhenSlow): CLEANED,
}


def load(name):
    return sequence.load(name, catalogue.parse)


def packaged():
    """Return the names of all packaged sequences that need no bus."""
    names = store.names("sequences") + store.names_of_vehicles("sequences")
    return [name for name in names if not memory_bench.needs_bus(load(name))]


@functools.cache
def low_sequences():
    """Return the names of the packaged sequences that judge a unit on low adhesion."""
    loaded = {name: load(name) for name in packaged()}
    return [
        name
        for name, one in loaded.items()
        if one.adhesion in LOW_SETS
        and one.wsp == "reference"
        and name not in OTHERS
        # tests/realtime/train judges trains
        and not one.is_train
    ]


@functools.cache
def outcome_of(name, kind_of_unit):
    """Return the outcome of a sequence with a kind of unit, or without WSP (None)."""
    return judge_flawed.judged(name, kind_of_unit)


def lines(outcome):
    """Return the verdicts that are no pass, as text."""
    bad = [line for line in outcome.verdicts if line.result in (Result.FAIL, Result.ERROR)]
    return [f"{line.against_limit}: {line.result}" for line in bad]


NAMES = [
    name if name == FIRST else pytest.param(name, marks=pytest.mark.nightly)
    for name in low_sequences()
]


def is_severe(name):
    """Return whether a sequence shows every flaw: a fault may take away what the unit needs."""
    return name not in MILD and not any(step.faults for step in load(name).steps)


SEVERE = [name for name in NAMES if is_severe(name if name == FIRST else name.values[0])]
ids = {"ids": lambda kind: kind if isinstance(kind, str) else kind.__name__}


def test_the_rule_covers_every_profile_for_low_adhesion():
    judged = {load(name).criteria.name for name in low_sequences()}
    assert {"low_adhesion", "very_low_adhesion", "air", "air_exhausted", "flats"} <= judged
    assert FIRST in low_sequences()
    assert set(OTHERS) | set(MILD) <= set(packaged())
    assert len(FLAWED) == 10


@pytest.mark.parametrize("name", NAMES)
def test_the_reference_unit_passes(name):
    outcome = outcome_of(name, Unit)
    assert outcome.result is Result.PASS, lines(outcome)


@pytest.mark.parametrize("name", NAMES)
def test_a_train_without_a_unit_fails(name):
    outcome = outcome_of(name, None)
    assert outcome.result is Result.FAIL, lines(outcome)


@pytest.mark.parametrize("name", SEVERE)
@pytest.mark.parametrize("kind_of_unit", FLAWED, **ids)
def test_a_flawed_unit_fails(name, kind_of_unit):
    if (name, kind_of_unit) in HARMLESS:
        pytest.skip(HARMLESS[name, kind_of_unit])
    outcome = outcome_of(name, kind_of_unit)
    assert outcome.result is Result.FAIL, lines(outcome)


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["emergency_040", "tram_dynamic_low_040"])
def test_a_stop_in_memory_has_the_measures_of_a_bench_on_the_bus(name, tmp_path):
    status, _, messages = rollerrig("sequence", name, "--out", tmp_path)
    # pass or fail: the measures are compared, not judged
    assert status in (0, 1), messages
    (on_bus,) = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["sequences"]
    record = outcome_of(name, Unit).record
    in_memory = {measure.name: measure.of(record) for measure in measures.of_kind(is_train=False)}
    # not applicable and unknown values are not in the report
    assert {"stop_distance", "longest_lock", "air_consumption"} <= set(on_bus["figures"])
    for measure, value in on_bus["figures"].items():
        assert in_memory[measure] == pytest.approx(value, rel=1e-6, abs=1e-9), measure
