"""Runs that differ from the others are named: by quantity, by size, and by what they share.

The stops are of `generator.other_stops`, which shares no code with the product. Each case changes
some of the runs as another rig, wheel, sensor or vehicle would.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from generator import mistakes, other_stops

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime import cli
from rollerrig.realtime.reports.hints import runs as words
from rollerrig.rig.identify.base import by_run, check
from rollerrig.rig.identify.base.by_run import Quantity
from rollerrig.rig.identify.base.findings import Code
from rollerrig.rig.identify.base.shared import Shared
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import side_by_side
from rollerrig.rig.identify.statistics import groups

Columns = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    return other_stops.make(tmp_path_factory.mktemp("sets") / "plain", {}, 77)


def changed(plain: Path, target: Path, runs, change: Callable[[Columns], Columns]) -> Path:
    """Copy a dataset and change the columns of some runs."""
    shutil.copytree(plain, target)
    for name in runs:
        path = target / "runs" / f"{name}.csv"
        mistakes.write(path, change(mistakes.read(path)))
    return target


def scaled(names, factor):
    return lambda columns: columns | {name: columns[name] * factor for name in names}


def compared(folder: Path):
    data = dataset.load(folder)
    check.check(data)
    return side_by_side.of_runs(data.runs, by_run.measure(data), None)


class Case(NamedTuple):
    """Runs that are changed, how, and what differs then: quantity, channel, and its size."""

    runs: tuple[str, ...]
    change: Callable[[Columns], Columns]
    quantity: Quantity
    channel: str
    size: float


CASES = {
    "two rigs, one reads 3 % low": Case(
        ("a2", "b1", "b3"), scaled(mistakes.TORQUES, 0.97), Quantity.TORQUE, "", -0.03
    ),
    "a cold run whose brake is 6 % stronger": Case(
        ("a1",), scaled(mistakes.TORQUES, 1.06), Quantity.TORQUE, "", 0.06
    ),
    "a run in the other direction": Case(
        ("a3",), mistakes.reversed_axles, Quantity.TO_FRONT, "", -0.2
    ),
    "a speed sensor of another day": Case(
        ("b1", "b2", "b3"),
        scaled(mistakes.WHEELS[2:3], 1.004),
        Quantity.ROLLING_OF_AXLE,
        "wheel_speed_3_rad_s",
        0.004,
    ),
    "a wheelset that was changed after two runs": Case(
        ("a1", "a2"),
        scaled(mistakes.WHEELS[1:2], 0.992),
        Quantity.ROLLING_OF_AXLE,
        "wheel_speed_2_rad_s",
        -0.008,
    ),
    "a payload that nobody declared": Case(
        ("a2",), scaled(mistakes.LOADS, 1.02), Quantity.LOAD, "", 0.02
    ),
    "a vehicle with smaller wheels": Case(
        ("a2",), scaled(mistakes.WHEELS, 1.006), Quantity.ROLLING, "", 0.006
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_the_runs_that_differ_are_named_with_the_size(name, plain, tmp_path):
    case = CASES[name]
    found = compared(changed(plain, tmp_path / "set", case.runs, case.change))
    [apart] = [one for one in found.apart if one.runs == case.runs]
    sizes = {(one.quantity, one.channel): one.difference for one in apart.differences}
    low, high = sizes[case.quantity, case.channel].interval()
    margin = 0.15 * abs(case.size)
    assert low - margin <= case.size <= high + margin
    assert ", ".join(case.runs[:-1]) in words.story(found)[0]
    assert case.runs[-1] in words.what_next(found)


def test_rollers_of_another_diameter_show_in_their_run(plain, tmp_path):
    """The surface of the rollers is measured in all runs, in one with the wrong diameter."""

    def with_surface(factor):
        surfaces = [f"surface_speed_{axle}_m_s" for axle in range(1, 5)]
        return lambda columns: (
            columns | {name: factor * columns["vehicle_speed_m_s"] for name in surfaces}
        )

    folder = changed(
        plain, tmp_path / "set", ("a1", "a2", "a3", "b1", "b2"), with_surface(factor=1.0)
    )
    path = folder / "runs" / "b3.csv"
    mistakes.write(path, with_surface(0.995)(mistakes.read(path)))
    [apart] = compared(folder).apart
    assert apart.runs == ("b3",)
    assert Quantity.ROLLING in {one.quantity for one in apart.differences}
    assert Shared.LAST in apart.shared


def test_equal_runs_do_not_differ(plain):
    assert compared(plain).apart == []
    assert words.story(compared(plain)) == []
    assert words.what_next(compared(plain)) == ""


def test_what_runs_that_differ_share_is_named(plain, tmp_path):
    folder = changed(plain, tmp_path / "set", ("a2", "b2"), scaled(mistakes.TORQUES, 0.96))
    text = (folder / "dataset.toml").read_text()
    for name in ("a1", "a2", "a3", "b1", "b2", "b3"):
        rig = "B" if name in ("a2", "b2") else "A"
        file = f'file = "runs/{name}.csv"'
        text = text.replace(file, f'{file}\nrig = "{rig}"\ndate = "2026-03-0{name[1]}"')
    (folder / "dataset.toml").write_text(text)
    [apart] = compared(folder).apart
    assert apart.shared[Shared.RIG] == "B"
    assert apart.shared[Shared.DATE] == "2026-03-02"
    [line] = words.story(compared(folder))
    assert "of rig B" in line


# --- refused data ---


def refusal(folder: Path) -> check.WrongBaseError:
    with pytest.raises(check.WrongBaseError) as caught:
        check.check(dataset.load(folder))
    return caught.value


def test_a_run_in_lbf_ft_is_named_with_its_unit(plain, tmp_path):
    folder = changed(plain, tmp_path / "set", ("a2",), scaled(mistakes.TORQUES, 0.73756))
    error = refusal(folder)
    [finding] = error.findings
    assert finding.code is Code.TORQUE_UNIT
    assert finding.runs == ("a2",)
    assert finding.detail == "lbf ft"
    assert "in run a2" in str(error)
    assert "lbf ft taken for N m" in str(error)


def test_a_run_whose_brake_takes_too_little_momentum_is_named(plain, tmp_path):
    folder = changed(plain, tmp_path / "set", ("a3",), scaled(mistakes.TORQUES, 0.82))
    [finding] = refusal(folder).findings
    assert finding.code is Code.TORQUE_NOT_ACTING
    assert finding.runs == ("a3",)
    assert finding.measured == pytest.approx(0.82, abs=0.01)


def test_runs_of_a_vehicle_with_other_wheels_are_named(plain, tmp_path):
    folder = changed(plain, tmp_path / "set", ("a2", "b2"), scaled(mistakes.WHEELS, 1.0 / 0.975))
    [finding] = refusal(folder).findings
    assert finding.code is Code.RADIUS
    assert finding.runs == ("a2", "b2")
    assert finding.measured == pytest.approx(1.0 / 0.975, abs=0.001)


@pytest.mark.parametrize(
    ("names", "factor", "unit"),
    [
        (mistakes.SPEED, 3.6, "km/h"),
        (mistakes.WHEELS, 9.5493, "rpm"),
        (mistakes.TORQUES, 1.0 / 9.80665, "kgf m"),
        (mistakes.LOADS, 0.001, "kN"),
    ],
)
def test_a_run_in_another_unit_is_refused_with_its_file_and_unit(
    names, factor, unit, plain, tmp_path
):
    folder = changed(plain, tmp_path / "set", ("a2",), scaled(names, factor))
    with pytest.raises(ConfigError) as caught:
        dataset.load(folder)
    assert "a2.csv" in str(caught.value)
    assert unit in str(caught.value)


# --- groups ---


def test_equal_sizes_are_parted_in_fewer_than_two_of_a_hundred_sets():
    rng = np.random.default_rng(1)
    errors = np.full(6, 0.5)
    parted = [groups.find(errors * rng.standard_normal(6), errors, 0.02, 1) for _ in range(2000)]
    assert sum(found is not None for found in parted) <= 40


def test_sizes_that_differ_one_by_one_are_no_two_groups():
    sizes = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert groups.p_value(sizes, np.full(6, 0.1)) < 1e-6
    assert groups.find(sizes, np.full(6, 0.1), 0.02, 1) is None


def test_the_smaller_group_is_apart_and_of_two_equal_ones_that_without_the_first_run():
    errors = np.full(6, 0.1)
    one = groups.find(np.array([1.0, 1.0, 5.0, 1.0, 1.0, 1.0]), errors, 0.02, 1)
    assert one is not None
    assert one.apart == (2,)
    half = groups.find(np.array([1.0, 5.0, 1.0, 5.0, 1.0, 5.0]), errors, 0.02, 1)
    assert half is not None
    assert half.apart == (1, 3, 5)
    assert half.difference.value == pytest.approx(4.0)


def test_a_run_without_the_quantity_is_in_no_group():
    sizes = np.array([1.0, np.nan, 5.0, 1.0, 1.0])
    found = groups.find(sizes, np.full(5, 0.1), 0.02, 1)
    assert found is not None
    assert 1 not in (*found.apart, *found.others)


# --- the whole explanation ---


@pytest.mark.nightly
def test_two_rigs_that_no_cause_shows_are_not_consistent(plain, tmp_path, capsys):
    rig_b = ("a2", "b1", "b3")
    folder = changed(plain, tmp_path / "set", rig_b, scaled(mistakes.TORQUES, 0.97))
    cli.main(["explain", str(folder), "--out", str(tmp_path / "out")])
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    [apart] = report["runs"]["differ"]
    assert apart["runs"] == list(rig_b)
    assert "torque" in {one["name"] for one in apart["differences"]}
    assert report["verdict"] == "unexplained"
    assert report["unknown"]["against"] == ["run"]
    text = " ".join(capsys.readouterr().out.split())
    assert "Runs a2, b1 and b3 differ from a1, a3 and b2" in text
    assert "coast" not in text


@pytest.mark.nightly
def test_a_report_has_the_size_of_the_nearest_cause_by_run(plain, tmp_path, capsys):
    rig_b = ("a2", "a3", "b2")
    folder = changed(plain, tmp_path / "set", rig_b, scaled(mistakes.TORQUES, 0.96))
    cli.main(["explain", str(folder), "--out", str(tmp_path / "out")])
    runs = json.loads((tmp_path / "out" / "report.json").read_text())["runs"]
    assert runs["cause"]["name"] == "brake_gain"
    sizes = dict(zip(runs["names"], runs["cause"]["by_run"], strict=True))
    of_b = np.mean([sizes[name]["value"] for name in rig_b])
    of_a = np.mean([sizes[name]["value"] for name in ("a1", "b1", "b3")])
    assert of_b - of_a == pytest.approx(0.04, abs=0.012)
    assert all(sizes[name]["ci95"][0] < sizes[name]["value"] for name in runs["names"])
