"""Measured data that breaks a rule is refused, and the message names what is wrong."""

import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.vehicle import brake_torque_Nm_Pa
from rollerrig.rig.identify.data import dataset, preparation

SHIPPED = store.ROOT / "datasets" / "open_none"
RADIUS_M = 0.445


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of four stops of a shipped dataset."""
    folder = Path(shutil.copytree(SHIPPED, tmp_path / "set"))
    head, *tables = (folder / "dataset.toml").read_text().split("[[run]]")
    kept = [head]
    for table in tables:
        name = tomllib.loads(table)["file"]
        if Path(name).stem in ("a1", "a2", "a3", "b1"):
            kept.append(table)
        else:
            (folder / name).unlink()
    (folder / "dataset.toml").write_text("[[run]]".join(kept))
    return folder


def read(copy: Path, run: str) -> dict[str, np.ndarray]:
    """Return the columns of a run by their names."""
    path = copy / "runs" / f"{run}.csv"
    names = path.read_text().splitlines()[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return dict(zip(names, values.T, strict=True))


def write(copy: Path, run: str, columns: dict[str, np.ndarray]) -> None:
    """Write the columns of a run with six digits."""
    np.savetxt(
        copy / "runs" / f"{run}.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        fmt="%.6g",
        header=",".join(columns),
        comments="",
    )


def change_column(
    copy: Path, run: str, name: str, change: Callable[[np.ndarray], np.ndarray]
) -> None:
    """Change one column of a run."""
    columns = read(copy, run)
    columns[name] = change(columns[name])
    write(copy, run, columns)


def edit(copy: Path, old: str, new: str) -> None:
    """Replace a text in dataset.toml."""
    path = copy / "dataset.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def test_a_key_and_a_table_may_both_be_called_vehicle(copy: Path) -> None:
    edit(copy, 'vehicle_set = "uic_z1"', 'vehicle = "uic_z1"')
    assert dataset.load(copy).sections["vehicle"]["mass_kg"] == 43000.0


@pytest.mark.parametrize(("axles", "bogies_per_body"), [(2, 1), (8, 2), (12, 3)])
def test_vehicles_with_any_number_of_axles_are_read(
    copy: Path, axles: int, bogies_per_body: int
) -> None:
    # each wheelset carries as much and brakes as much as those of the coach
    for mass_kg in (43000.0, 49449.99999999999):
        edit(copy, f"mass_kg = {mass_kg}", f"mass_kg = {mass_kg * axles / 4}")
    vehicle = f"[vehicle]\naxles = {axles}\nbogies_per_body = {bogies_per_body}\n"
    edit(copy, "[vehicle]\n", vehicle)
    positions_m = [10.0 * axle for axle in range(axles)]
    edit(copy, "[0.0, 2.56, 19.0, 21.56]", str(positions_m))
    for run in ("a1", "a2", "a3", "b1"):
        columns = read(copy, run)
        for axle in range(5, axles + 1):
            like = (axle - 1) % 4 + 1
            columns[f"wheel_speed_{axle}_rad_s"] = columns[f"wheel_speed_{like}_rad_s"]
            columns[f"wheel_load_{axle}_N"] = columns[f"wheel_load_{like}_N"]
            columns[f"brake_torque_{axle}_Nm"] = columns[f"brake_torque_{like}_Nm"]
        write(copy, run, columns)

    data = dataset.load(copy)
    assert data.axles == axles
    assert [run.axles for run in data.runs] == [axles] * 4
    design = preparation.prepare(data, data.group("tune"))
    assert design.segments == 3 * axles
    np.testing.assert_array_equal(design.axle, [*range(axles)] * 3)


def test_a_number_of_axles_that_no_vehicle_has_is_refused(copy: Path) -> None:
    edit(copy, "[vehicle]\n", "[vehicle]\naxles = 5\n")
    with pytest.raises(ConfigError, match=r"axles = 5.* 2, 4, 6, 8, 10, 12"):
        dataset.load(copy)


def test_a_wheel_radius_in_millimetres_is_refused(copy: Path) -> None:
    edit(copy, "wheel_radius_m = 0.445", "wheel_radius_m = 445.0")
    with pytest.raises(ConfigError, match="wheel_radius_m"):
        dataset.load(copy)


def test_speeds_in_kilometres_an_hour_are_refused(copy: Path) -> None:
    change_column(copy, "a1", "vehicle_speed_m_s", lambda speed_m_s: 3.6 * speed_m_s)
    with pytest.raises(ConfigError, match=r"km/h|another unit"):
        dataset.load(copy)


def test_a_torque_of_the_wrong_sign_is_refused(copy: Path) -> None:
    for axle in range(1, 5):
        change_column(copy, "a1", f"brake_torque_{axle}_Nm", lambda torque_Nm: -torque_Nm)
    with pytest.raises(ConfigError, match="change its sign"):
        dataset.load(copy)


def test_a_missing_value_names_its_line(copy: Path) -> None:
    def without_value_7(speed_rad_s: np.ndarray) -> np.ndarray:
        speed_rad_s = speed_rad_s.copy()
        speed_rad_s[7] = np.nan
        return speed_rad_s

    change_column(copy, "a2", "wheel_speed_3_rad_s", without_value_7)
    # lines of the file count from 1, and the first one holds the names
    with pytest.raises(ConfigError, match="line 9"):
        dataset.load(copy)


def test_a_gap_in_time_is_refused(copy: Path) -> None:
    def with_gap(time_s: np.ndarray) -> np.ndarray:
        is_later = np.arange(time_s.size) > 300
        return time_s + 0.5 * is_later

    change_column(copy, "a2", "time_s", with_gap)
    with pytest.raises(ConfigError, match="1 gaps, the first of"):
        dataset.load(copy)


def with_late_stamps(time_s: np.ndarray) -> np.ndarray:
    """Return stamps of a computer that reads even samples up to 8 ms late."""
    rng = np.random.default_rng(1)
    return time_s + np.minimum(rng.gamma(1.5, 0.001, time_s.size), 0.008)


def test_late_stamps_of_even_samples_are_refused_with_a_remedy_that_keeps_them(copy: Path) -> None:
    change_column(copy, "a2", "time_s", with_late_stamps)
    with pytest.raises(ConfigError, match=r'stamps = "even".*do not resample'):
        dataset.load(copy)

    toml = copy / "dataset.toml"
    toml.write_text(f'stamps = "even"\n{toml.read_text()}')
    data = dataset.load(copy)
    [run] = [run for run in data.runs if run.name == "a2"]
    assert np.ptp(np.diff(run.time_s)) < 1e-9
    assert any("replaced by even ones" in warning for warning in data.warnings)


def test_stamps_are_not_even_where_a_row_is_missing(copy: Path) -> None:
    def without_a_row(time_s: np.ndarray) -> np.ndarray:
        is_later = np.arange(time_s.size) > 300
        return with_late_stamps(time_s) + 0.01 * is_later

    change_column(copy, "a2", "time_s", without_a_row)
    with pytest.raises(ConfigError, match=r"split the run there|not even"):
        dataset.load(copy)
    toml = copy / "dataset.toml"
    toml.write_text(f'stamps = "even"\n{toml.read_text()}')
    with pytest.raises(ConfigError, match="rows are missing"):
        dataset.load(copy)


def test_a_channel_without_numbers_is_refused_with_the_advice_to_leave_the_run_out(
    copy: Path,
) -> None:
    change_column(copy, "a2", "wheel_load_4_N", lambda load_N: np.full(load_N.size, np.nan))
    with pytest.raises(ConfigError, match=r"a2\.csv: column 'wheel_load_4_N' has no number.*leave"):
        dataset.load(copy)


def test_a_missing_channel_is_no_reason_to_suggest_a_column_in_use(copy: Path) -> None:
    path = copy / "runs" / "a2.csv"
    path.write_text(path.read_text().replace("wheel_load_4_N", "something", 1))
    with pytest.raises(ConfigError, match=r"'wheel_load_4_N' is missing.*leave this run") as caught:
        dataset.load(copy)
    assert "did you mean" not in str(caught.value)


def test_a_missing_channel_with_a_similar_column_that_is_free_is_suggested(copy: Path) -> None:
    path = copy / "runs" / "a2.csv"
    path.write_text(path.read_text().replace("wheel_load_4_N", "wheel_load4_N", 1))
    with pytest.raises(ConfigError, match="did you mean 'wheel_load4_N'"):
        dataset.load(copy)


def test_a_constant_channel_is_refused(copy: Path) -> None:
    change_column(copy, "a3", "brake_torque_2_Nm", np.zeros_like)
    with pytest.raises(ConfigError, match="is constant"):
        dataset.load(copy)


def test_a_copy_cannot_validate(copy: Path) -> None:
    shutil.copy(copy / "runs" / "a1.csv", copy / "runs" / "b1.csv")
    edit(copy, "initial_speed_m_s = 41.1", "initial_speed_m_s = 42.3")
    with pytest.raises(ConfigError, match="have the same samples"):
        dataset.load(copy)


def test_runs_whose_wheels_never_slide_are_refused(copy: Path) -> None:
    for run in ("a1", "a2", "a3"):
        columns = read(copy, run)
        rolling_rad_s = columns["vehicle_speed_m_s"] / RADIUS_M
        ripple_rad_s = 1e-3 * np.sin(np.arange(rolling_rad_s.size))
        for axle in range(1, 5):
            columns[f"wheel_speed_{axle}_rad_s"] = rolling_rad_s + ripple_rad_s
        # wheelset 1 differs a little from the others
        columns["wheel_speed_1_rad_s"] = columns["wheel_speed_1_rad_s"] + 2e-3
        write(copy, run, columns)
    with pytest.raises(ConfigError, match="hardly slide"):
        dataset.load(copy)


def test_brief_sliding_in_a_long_run_is_judged_over_the_time_in_which_wheels_slide(
    copy: Path,
) -> None:
    for run in ("a1", "a2", "a3"):
        columns = read(copy, run)
        rolling_rad_s = columns["vehicle_speed_m_s"] / RADIUS_M
        rows = np.arange(rolling_rad_s.size)
        slides = (rows > 500) & (rows < 800)
        for axle in range(1, 5):
            ripple_rad_s = 2e-3 * np.sin(rows + axle)
            columns[f"wheel_speed_{axle}_rad_s"] = rolling_rad_s + ripple_rad_s - 1.0 * slides
        write(copy, run, columns)
    assert dataset.load(copy).runs


# --- pressures in the place of torques ---


def write_pressures(copy: Path, share_of_gain: float, unit_Pa: float = 1.0) -> None:
    """Replace the torques of all runs by pressures.

    `share_of_gain` is the torque for each Pa as a share of that of the vehicle's brake.
    """
    brake = dataset.load(copy).sections["brake"]
    torque_Nm_Pa = share_of_gain * brake_torque_Nm_Pa(brake)
    for path in (copy / "runs").glob("*.csv"):
        columns = {}
        for name, values in read(copy, path.stem).items():
            if not name.startswith("brake_torque"):
                columns[name] = values
                continue
            pressure_Pa = values / torque_Nm_Pa + brake["spring_pressure_Pa"] * (values > 0.0)
            name_of_pressure = name.replace("torque", "pressure").replace("_Nm", "_Pa")
            columns[name_of_pressure] = pressure_Pa / unit_Pa
        write(copy, path.stem, columns)


def test_pressures_become_torques_by_the_momentum_that_the_vehicle_loses(copy: Path) -> None:
    measured = dataset.load(copy)
    write_pressures(copy, 1.2)
    data = dataset.load(copy)
    for run, of_torque in zip(data.runs, measured.runs, strict=True):
        # within the calibration of torque and mass, 0.3 % each
        acts = of_torque.torque_Nm > 500.0
        np.testing.assert_allclose(run.torque_Nm[acts], of_torque.torque_Nm[acts], rtol=0.01)
    assert any("N m per bar" in warning for warning in data.warnings)


def test_pressures_may_be_in_bar(copy: Path) -> None:
    write_pressures(copy, 1.2, unit_Pa=1e5)
    lines = ["[channels]"]
    for axle in range(1, 5):
        key = f"brake_pressure_{axle}_Pa"
        lines.append(f'{key} = {{ column = "brake_pressure_{axle}", unit = "bar" }}')
    for path in (copy / "runs").glob("*.csv"):
        text = path.read_text()
        path.write_text(text.replace("_Pa", ""))
    path = copy / "dataset.toml"
    path.write_text(path.read_text() + "\n" + "\n".join(lines) + "\n")
    assert dataset.load(copy).runs[0].torque_Nm.max() > 1000.0


@pytest.mark.parametrize("share", [0.1, 10.0])
def test_pressures_in_a_wrong_unit_are_refused(copy: Path, share: float) -> None:
    write_pressures(copy, share)
    with pytest.raises(ConfigError, match="unit of the pressures"):
        dataset.load(copy)


def test_pressures_whose_gain_differs_from_run_to_run_are_refused(copy: Path) -> None:
    write_pressures(copy, 1.0)
    change = read(copy, "a2")
    for axle in range(1, 5):
        change[f"brake_pressure_{axle}_Pa"] *= 1.2
    write(copy, "a2", change)
    with pytest.raises(ConfigError, match="or give torques"):
        dataset.load(copy)


def test_no_run_to_validate_is_a_warning_that_forbids_a_gain(copy: Path) -> None:
    edit(copy, '"validate"', '"tune"')
    assert any("no gain" in warning for warning in dataset.load(copy).warnings)


def test_an_unknown_key_is_named_with_what_is_allowed(copy: Path) -> None:
    edit(copy, "torque_fraction", "torque_share")
    with pytest.raises(ConfigError, match="torque_share"):
        dataset.load(copy)
