"""Proposed stops distinguish causes that the data cannot distinguish, and the bench runs them."""

import tomllib

import numpy as np
import pytest
import tomli_w

from rollerrig.realtime import cli
from rollerrig.realtime.record import records
from rollerrig.rig.identify.causes import candidates
from rollerrig.rig.identify.data import dataset, preparation
from rollerrig.rig.identify.decide import fitting
from rollerrig.rig.identify.decide.evidence import ScoreTest
from rollerrig.rig.identify.next_stops import planning
from rollerrig.rig.identify.next_stops.planning import FittedData, Library, Table


def finding(name: str, size: float, axle: int = 0) -> ScoreTest:
    """A significant finding of a cause of this size."""
    return ScoreTest(name, axle, {}, (size,), (0.0,), (abs(size) / 5.0,), 25.0, 1e-6, 1.0, 1.0)


def silent(title: str, share: float) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def fitted() -> FittedData:
    """One stop of the shipped set with its fitted base."""
    data = dataset.load("open_none")
    design = preparation.prepare(data, data.group("tune")[:1])
    explanation = fitting.fit(design, candidates.untuned(design), 3, False)[0]
    return FittedData(data, design, explanation)


@pytest.fixture(scope="module")
def speed_or_time(fitted: FittedData) -> Library:
    """The possible stops for two causes that the data cannot distinguish."""
    two = [finding("speed_dependent_friction", 0.004), finding("friction_trend", 0.01)]
    return planning.library(fitted, two, silent)


NAMES = ("speed_dependent_friction", "friction_trend")


def test_stops_hardly_distinguish_speed_from_time_and_sliding_at_a_steady_speed_does(
    speed_or_time: Library,
) -> None:
    known, _ = planning.separation([speed_or_time.known], NAMES)
    separations = {}
    for stop, table in zip(speed_or_time.stops, speed_or_time.tables, strict=True):
        separations[stop], _ = planning.separation([speed_or_time.known, table], NAMES)

    steady = max(value for stop, value in separations.items() if stop.axle)
    # the stop that is most like the one in the data, which begins at 42.3 m/s
    like_the_known = min(
        separations, key=lambda stop: abs(stop.initial_speed_m_s - 42.3) + 100 * stop.axle
    )
    assert steady > 3.0 * known
    assert steady > 2.0 * separations[like_the_known]


def test_the_first_proposal_is_the_best_and_each_further_one_adds(speed_or_time: Library) -> None:
    proposals = planning.propose(speed_or_time, 3)
    best = max(
        planning.separation([speed_or_time.known, table], NAMES)[0]
        for table in speed_or_time.tables
    )
    assert proposals[0].after == pytest.approx(best)
    values = [proposals[0].before, *(p.after for p in proposals)]
    assert np.all(np.diff(values) > 0.0)
    assert len({p.stop for p in proposals}) == 3


def test_a_full_brake_informs_more_about_a_weak_brake_than_a_gentle_one(fitted: FittedData) -> None:
    lib = planning.library(fitted, [finding("brake_gain", 0.04, 2)], silent)
    information = {}
    for stop, table in zip(lib.stops, lib.tables, strict=True):
        if not stop.axle:
            information[stop], _ = planning.separation([table], ["brake_gain"])
    for stop, of_gentle in information.items():
        if stop.pressure_Pa < 2e5 and stop.initial_speed_m_s > 20.0:
            full = stop._replace(pressure_Pa=planning.PRESSURES_PA[-1])
            assert of_gentle < information[full]
    # only the wheelset in question is worth braking alone
    assert {stop.axle for stop in lib.stops} == {0, 2}


def test_what_the_base_could_absorb_distinguishes_nothing() -> None:
    keys = ("cause a", "cause b", "base ln_tau ")
    alike = Table(keys, np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 1.0]]))
    other = Table(keys, np.array([[4.0, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 1.0]]))
    hidden = Table(keys, np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 0.0], [2.0, 0.0, 1.0]]))
    assert planning.separation([alike], ["a", "b"])[0] == pytest.approx(0.0, abs=1e-6)
    assert planning.separation([alike, other], ["a", "b"])[0] == pytest.approx(8.0 * 0.75)
    assert planning.separation([hidden], ["a", "b"])[0] == pytest.approx(0.0, abs=1e-6)


def test_without_candidates_nothing_is_proposed(fitted: FittedData) -> None:
    assert planning.propose(planning.library(fitted, [], silent), 3) == []


def test_every_possible_stop_is_a_sequence_that_is_accepted(
    fitted: FittedData, speed_or_time: Library, tmp_path, capsys
) -> None:
    for k, stop in enumerate(speed_or_time.stops):
        proposal = planning.Proposal(stop, NAMES, 1.0, 2.0)
        text = tomli_w.dumps(planning.sequence(proposal, fitted))
        (tmp_path / f"next_{k}.toml").write_text(text)
    assert cli.main(["sequence", str(tmp_path), "--check"]) == 0
    capsys.readouterr()


def test_the_bench_runs_sliding_at_a_steady_speed(
    fitted: FittedData, speed_or_time: Library, tmp_path, capsys
) -> None:
    stop = next(s for s in speed_or_time.stops if s.axle)
    file = tmp_path / "next_1.toml"
    proposal = planning.Proposal(stop, NAMES, 1.0, 2.0)
    file.write_text(tomli_w.dumps(planning.sequence(proposal, fitted)))
    assert tomllib.loads(file.read_text())["start"]["tables"]["rig"]["mode"] == "track"
    assert cli.main(["sequence", str(file), "--out", str(tmp_path / "report")]) == 0
    capsys.readouterr()
    run = records.load(tmp_path / "report" / "next_1")
    speed, time_s = run.column("vehicle_speed_m_s"), run.column("time_s")
    assert speed[0] == pytest.approx(stop.initial_speed_m_s, abs=0.01)
    assert (speed[0] - speed[-1]) / time_s[-1] < 0.5
    assert np.abs(run.column(f"sliding_{stop.axle}_m_s")).mean() > 0.3
    for other in {1, 2, 3, 4} - {stop.axle}:
        assert np.abs(run.column(f"sliding_{other}_m_s")).mean() < 0.02
