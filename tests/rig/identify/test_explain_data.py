"""What measured data must be, and what is said when it is not."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset

SHIPPED = store.ROOT / "datasets" / "open_none"


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SHIPPED, tmp_path / "set"))


def changed(copy: Path, run: str, column: str, change) -> None:
    path = copy / "runs" / f"{run}.csv"
    head = path.read_text().splitlines()[0]
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    at = head.split(",").index(column)
    rows[:, at] = change(rows[:, at])
    np.savetxt(path, rows, delimiter=",", fmt="%.6g", header=head, comments="")


def edited(copy: Path, old: str, new: str) -> None:
    path = copy / "dataset.toml"
    path.write_text(path.read_text().replace(old, new))


def test_a_key_and_a_table_called_vehicle_may_stand_side_by_side(copy: Path) -> None:
    edited(copy, 'vehicle_set = "uic_z1"', 'vehicle = "uic_z1"')
    assert dataset.load(copy).sections["vehicle"]["mass_kg"] == 43000.0


def test_a_wheel_radius_in_millimetres_is_refused(copy: Path) -> None:
    edited(copy, "wheel_radius_m = 0.445", "wheel_radius_m = 445.0")
    with pytest.raises(ConfigError, match="wheel_radius_m"):
        dataset.load(copy)


def test_speeds_in_kilometres_an_hour_are_refused(copy: Path) -> None:
    changed(copy, "a1", "vehicle_speed_m_s", lambda v: 3.6 * v)
    with pytest.raises(ConfigError, match=r"km/h|another unit"):
        dataset.load(copy)


def test_a_torque_of_the_wrong_sign_is_refused(copy: Path) -> None:
    for j in range(1, 5):
        changed(copy, "a1", f"brake_torque_{j}_Nm", lambda c: -c)
    with pytest.raises(ConfigError, match="change its sign"):
        dataset.load(copy)


def test_a_missing_value_names_its_row(copy: Path) -> None:
    changed(
        copy, "a2", "wheel_speed_3_rad_s", lambda w: np.where(np.arange(w.size) == 7, np.nan, w)
    )
    with pytest.raises(ConfigError, match="row 9"):
        dataset.load(copy)


def test_a_gap_in_time_is_refused(copy: Path) -> None:
    changed(copy, "a2", "time_s", lambda t: t + 0.5 * (np.arange(t.size) > 300))
    with pytest.raises(ConfigError, match="gap"):
        dataset.load(copy)


def test_a_constant_channel_is_refused(copy: Path) -> None:
    changed(copy, "a3", "brake_torque_2_Nm", lambda c: 0.0 * c)
    with pytest.raises(ConfigError, match="constant"):
        dataset.load(copy)


def test_a_copy_cannot_validate(copy: Path) -> None:
    shutil.copy(copy / "runs" / "a1.csv", copy / "runs" / "b1.csv")
    edited(copy, "initial_speed_m_s = 41.1", "initial_speed_m_s = 42.3")
    with pytest.raises(ConfigError, match="copy"):
        dataset.load(copy)


def test_wheels_that_never_slide_tell_nothing(copy: Path) -> None:
    for run in ("a1", "a2", "a3"):
        path = copy / "runs" / f"{run}.csv"
        head = path.read_text().splitlines()[0]
        rows = np.loadtxt(path, delimiter=",", skiprows=1)
        for j in range(2, 6):
            rows[:, j] = rows[:, 1] / 0.445 + 1e-3 * np.sin(np.arange(len(rows)))
        rows[:, 2] += 2e-3
        np.savetxt(path, rows, delimiter=",", fmt="%.6g", header=head, comments="")
    with pytest.raises(ConfigError, match="hardly slide"):
        dataset.load(copy)


def test_no_run_to_validate_is_a_warning_that_forbids_a_gain(copy: Path) -> None:
    edited(copy, '"validate"', '"tune"')
    assert any("no gain" in warning for warning in dataset.load(copy).warnings)


def test_an_unknown_key_is_named_with_what_is_allowed(copy: Path) -> None:
    edited(copy, "torque_fraction", "torque_share")
    with pytest.raises(ConfigError, match="torque_share"):
        dataset.load(copy)
