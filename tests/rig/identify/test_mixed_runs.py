"""Runs of two vehicles, days, rigs, directions or kinds of weather in one dataset are named."""

import json

import pytest
from generator import mixed_runs
from generator.mixed_runs import MIXTURES

from rollerrig.realtime import cli
from rollerrig.realtime.reports.hints import runs as words
from rollerrig.rig.identify.base import by_run, check
from rollerrig.rig.identify.base.by_run import Quantity
from rollerrig.rig.identify.base.findings import Code
from rollerrig.rig.identify.base.shared import Shared
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import side_by_side

# what differs in each set, and what its runs share
SEEN = {
    "two vehicles": (Quantity.ROLLING, Shared.RIG),
    "a run in the wrong direction": (Quantity.TO_FRONT, None),
    "a sensor changed between days": (Quantity.ROLLING_OF_AXLE, Shared.DATE),
    "a run on other rollers": (Quantity.ROLLING, Shared.RIG),
    "a cold run": (Quantity.TORQUE, Shared.FIRST),
    "half of the runs on a wetter rail": (Quantity.FRICTION, Shared.DATE),
}
REFUSED = "two vehicles of different wheels"


def test_every_mixture_is_judged():
    assert {*SEEN, REFUSED} == set(MIXTURES)


@pytest.mark.parametrize("name", SEEN)
def test_the_runs_that_differ_are_named_with_what_they_share(name, tmp_path):
    mixture = MIXTURES[name]
    quantity, shared = SEEN[name]
    data = dataset.load(mixed_runs.make(tmp_path / "set", mixture, 1))
    check.check(data)
    found = side_by_side.of_runs(data.runs, by_run.measure(data), None)
    [apart] = [one for one in found.apart if one.runs == mixture.runs]
    assert quantity in {one.quantity for one in apart.differences}
    if shared is not None:
        assert shared in apart.shared
    # no other runs are named
    assert {one.runs for one in found.apart} == {mixture.runs}
    assert f"{words.names(mixture.runs)} differ" in words.story(found)[0]


def test_a_refusal_names_the_runs_and_what_they_share(tmp_path):
    mixture = MIXTURES[REFUSED]
    data = dataset.load(mixed_runs.make(tmp_path / "set", mixture, 1))
    with pytest.raises(check.WrongBaseError) as caught:
        check.check(data)
    [finding] = caught.value.findings
    assert finding.code is Code.RADIUS
    assert finding.runs == mixture.runs
    assert finding.shared == {Shared.RIG: "coach 12"}
    assert "They are of rig coach 12." in str(caught.value)


@pytest.mark.nightly
@pytest.mark.parametrize("name", SEEN)
def test_the_report_names_the_runs(name, tmp_path):
    mixture = MIXTURES[name]
    folder = mixed_runs.make(tmp_path / "set", mixture, 1)
    cli.main(["explain", str(folder), "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert list(mixture.runs) in [one["runs"] for one in report["runs"]["differ"]]
    assert report["verdict"] != "consistent" or name == "half of the runs on a wetter rail"
