"""Measured data that breaks a rule is refused, and the message names what is wrong."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset

SHIPPED = store.ROOT / "datasets" / "open_none"
RADIUS_M = 0.445


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of a shipped dataset."""
    return Path(shutil.copytree(SHIPPED, tmp_path / "set"))


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
    with pytest.raises(ConfigError, match="gap"):
        dataset.load(copy)


def test_a_constant_channel_is_refused(copy: Path) -> None:
    change_column(copy, "a3", "brake_torque_2_Nm", np.zeros_like)
    with pytest.raises(ConfigError, match="constant"):
        dataset.load(copy)


def test_a_copy_cannot_validate(copy: Path) -> None:
    shutil.copy(copy / "runs" / "a1.csv", copy / "runs" / "b1.csv")
    edit(copy, "initial_speed_m_s = 41.1", "initial_speed_m_s = 42.3")
    with pytest.raises(ConfigError, match="copy"):
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


def test_no_run_to_validate_is_a_warning_that_forbids_a_gain(copy: Path) -> None:
    edit(copy, '"validate"', '"tune"')
    assert any("no gain" in warning for warning in dataset.load(copy).warnings)


def test_an_unknown_key_is_named_with_what_is_allowed(copy: Path) -> None:
    edit(copy, "torque_fraction", "torque_share")
    with pytest.raises(ConfigError, match="torque_share"):
        dataset.load(copy)
