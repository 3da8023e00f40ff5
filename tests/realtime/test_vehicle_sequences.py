"""Packaged sequences of the tram, the multiple unit and the bogie module, played in lockstep with
their units on the bus; and copies with a flaw, which must fail.
"""

import json
from pathlib import Path

import pytest
from program import rollerrig

from rollerrig.configs import store

pytestmark = [pytest.mark.nightly, pytest.mark.xdist_group("vehicles")]

MAGNETS = "[start.tables.magnetic_track_brake]\n"
UNCONTROLLED = '[start.tables.dynamic_brake]\nslide_control = "none"\n\n'
# the beginning of the names of a vehicle's sequences: copies with a flaw, by their names, each with
# the packaged sequence, a text of it, and what replaces this text
FLAWS = {
    "tram_": {
        "no_slide_control": ("tram_dynamic_low", MAGNETS, UNCONTROLLED + MAGNETS),
        "no_slip_control": ("tram_start_low", MAGNETS, UNCONTROLLED + MAGNETS),
        "friction_brake_too_slow": (
            "tram_dynamic_brake_lost",
            MAGNETS,
            f"[start.tables.brake]\nfill_time_constant_s = 5.0\n\n{MAGNETS}",
        ),
        "magnets_of_two_bogies": ("tram_emergency_magnets", "[1, 2, 3]", "[1, 3]"),
        "magnets_of_one_bogie": ("tram_track_brake_dead", "[1, 2, 3]", "[2, 3]"),
        "one_motor": (
            "tram_dry_060",
            MAGNETS,
            f"[start.tables.dynamic_brake]\naxles = [1]\n\n{MAGNETS}",
        ),
    },
    "multiple_unit_": {
        "no_slide_control": (
            "multiple_unit_dynamic_low",
            'adhesion = "low"\n',
            f'adhesion = "low"\n\n{UNCONTROLLED}',
        ),
        "friction_brake_too_slow": (
            "multiple_unit_dynamic_brake_lost",
            'adhesion = "wet"\n',
            'adhesion = "wet"\n\n[start.tables.brake]\nfill_time_constant_s = 8.0\n',
        ),
    },
    "bogie_": {
        "unprotected": (
            "bogie_low_120",
            'scenario = "bogie_low"\n',
            'scenario = "bogie_low"\nwsp = "none"\n',
        ),
        "both_axles_unbraked": (
            "bogie_vent_magnet_stuck",
            '"vent_magnet_stuck axle=2"',
            '["vent_magnet_stuck axle=1", "vent_magnet_stuck axle=2"]',
        ),
    },
}

# the contrast of a sequence without a flaw: it passes because the stop is bad
CONTRASTS = {"tram_": ["tram_dynamic_low_uncontrolled"]}


def packaged(prefix):
    """Return the names of a vehicle's packaged sequences that are played here.

    They are those that have a copy with a flaw. Stops like these at another speed, on another
    adhesion or with another fault are only read, by `test_sequence.py`.
    """
    with_flaw = {original for original, _, _ in FLAWS[prefix].values()}
    return sorted(with_flaw) + CONTRASTS.get(prefix, [])


class Played:
    """The sequences of a report: results and measures by name, and the events of a run."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        content = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        self.results = {one["name"]: one["result"] for one in content["sequences"]}
        self.measures = {
            one["name"]: {verdict["what"]: verdict["value"] for verdict in one["verdicts"]}
            for one in content["sequences"]
        }

    def events(self, name):
        lines = (self.folder / name / "events.jsonl").read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def played(request, tmp_path_factory):
    """Play the packaged sequences of a vehicle, and their copies with flaws."""
    prefix = request.param
    folder = tmp_path_factory.mktemp("sequences")
    flawed = folder / "flawed"
    flawed.mkdir()
    for name, (original, old, new) in FLAWS[prefix].items():
        text = store.find("sequences", original).read_text(encoding="utf-8")
        assert text.count(old) == 1, original
        (flawed / f"{name}.toml").write_text(text.replace(old, new), encoding="utf-8")
    words = ("sequence", *packaged(prefix), str(flawed), "--jobs", "2", "--out", folder / "report")
    status, _, messages = rollerrig(*words)
    # the copies fail
    assert status == 1, messages
    return Played(folder / "report")


@pytest.mark.parametrize("played", FLAWS, indirect=True)
def test_a_vehicle_passes_its_sequences_and_fails_those_with_a_flaw(played, request):
    prefix = request.node.callspec.params["played"]
    names = packaged(prefix)
    assert {name: played.results[name] for name in names} == dict.fromkeys(names, "pass")
    flaws = FLAWS[prefix]
    # a stop that does not end fails, and its distance is an error
    assert {name for name in flaws if played.results[name] not in ("fail", "error")} == set()


@pytest.mark.parametrize("played", ["tram_"], indirect=True)
def test_without_slide_control_the_driven_bogies_lock_and_with_it_the_stop_is_shorter(played):
    controlled = played.measures["tram_dynamic_low"]
    uncontrolled = played.measures["tram_dynamic_low_uncontrolled"]
    assert controlled["longest_lock"] <= 0.4
    assert uncontrolled["longest_lock"] > 5.0
    assert controlled["stop_distance"] < 0.8 * uncontrolled["stop_distance"]


@pytest.mark.parametrize("played", ["tram_"], indirect=True)
def test_more_magnets_make_the_stop_shorter(played):
    names = ("tram_emergency_magnets", "magnets_of_two_bogies", "magnets_of_one_bogie")
    distances_m = [played.measures[name]["stop_distance"] for name in names]
    assert distances_m == sorted(distances_m)
    assert len(set(distances_m)) == len(names)


@pytest.mark.parametrize("played", ["tram_"], indirect=True)
def test_no_verdict_on_the_unit_comes_while_motors_drive(played):
    for name in ("tram_start_low", "no_slip_control"):
        events = played.events(name)
        # the brake is demanded 10 s after the start
        early = [one for one in events if one["code"].startswith("wsp.") and one["time_s"] < 10.0]
        assert early == []
        # and the unit is judged from then on
        assert any(one["code"].startswith("wsp.") for one in events)


@pytest.mark.parametrize("played", ["multiple_unit_"], indirect=True)
def test_each_car_of_a_multiple_unit_has_a_unit_on_the_bus(played):
    appeared = {
        one["fields"]["node"]
        for one in played.events("multiple_unit_dynamic_low")
        if one["code"] == "unit.appeared"
    }
    assert appeared == {32, 64}
