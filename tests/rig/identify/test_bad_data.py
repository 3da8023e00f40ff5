"""Every way in which measured data is wrong that we know of, and what is said about it: one row each."""

import contextlib
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset

SHIPPED = store.ROOT / "datasets" / "open_none"
RADIUS_M = 0.445
SPEEDS = tuple(f"wheel_speed_{j}_rad_s" for j in range(1, 5))
LOADS = tuple(f"wheel_load_{j}_N" for j in range(1, 5))
TORQUES = tuple(f"brake_torque_{j}_Nm" for j in range(1, 5))
ALL = ("time_s", "vehicle_speed_m_s", *SPEEDS, *LOADS, *TORQUES)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    return Path(shutil.copytree(SHIPPED, tmp_path / "set"))


def read(copy: Path, run: str) -> dict[str, np.ndarray]:
    path = copy / "runs" / f"{run}.csv"
    names = path.read_text().splitlines()[0].split(",")
    return dict(zip(names, np.loadtxt(path, delimiter=",", skiprows=1).T, strict=True))


def write(copy: Path, run: str, columns: dict[str, np.ndarray]) -> None:
    np.savetxt(
        copy / "runs" / f"{run}.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        fmt="%.9g",
        header=",".join(columns),
        comments="",
    )


def edited(copy: Path, old: str, new: str) -> None:
    path = copy / "dataset.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


def times(factor, names):
    def change(columns):
        for name in names:
            columns[name] = factor * columns[name]
        return columns

    return change


def later(names, samples):
    def change(columns):
        return {
            k: np.concatenate([np.repeat(v[:1], samples), v])[: v.size] if k in names else v
            for k, v in columns.items()
        }

    return change


def clock(function):
    return lambda columns: columns | {"time_s": function(columns["time_s"])}


def rows(function):
    def change(columns):
        at = function(np.arange(columns["time_s"].size))
        return {k: v[at] for k, v in columns.items()}

    return change


def at_rest(columns):
    return columns | {
        SPEEDS[2]: np.where(columns["time_s"] > 8.0, columns[SPEEDS[2]][800], columns[SPEEDS[2]])
    }


UNEVEN = np.random.default_rng(1)
REFUSED = {
    "vehicle speed in km/h, initial speed not told": (times(3.6, ALL[1:2]), "divide it by 3.6"),
    "wheel speed in rpm": (times(30.0 / np.pi, SPEEDS), "rpm"),
    "wheel speed in turns a second": (times(0.5 / np.pi, SPEEDS), "turns a second"),
    "wheel speed in m/s": (times(RADIUS_M, SPEEDS), "in m/s"),
    "wheel speed in km/h": (times(3.6 * RADIUS_M, SPEEDS), "km/h"),
    "one wheel speed in rpm": (times(30.0 / np.pi, SPEEDS[1:2]), "wheelset 2.*rpm"),
    "one wheel speed negative": (times(-1.0, SPEEDS[3:]), "wheel_speed_4.*sign"),
    "loads in kN": (times(1e-3, LOADS), "kN"),
    "loads of one wheel": (times(0.5, LOADS), "one wheel"),
    "loads in kilograms": (times(1.0 / 9.80665, LOADS), "in kg"),
    "one load in tonnes": (times(1e-3 / 9.80665, LOADS[2:3]), "wheel_load_3.*in t"),
    "torques in kN m": (times(1e-3, TORQUES), "kN m"),
    "torques of one wheel": (times(0.5, TORQUES), "one wheel"),
    "torques negative": (times(-1.0, TORQUES), "change its sign"),
    "one torque negative": (times(-1.0, TORQUES[:1]), "brake_torque_1.*sign"),
    "time in milliseconds": (clock(lambda t: 1000.0 * t), "milliseconds"),
    "time drifts": (clock(lambda t: 1.01 * t), "drifts"),
    "time not even": (clock(lambda t: t + UNEVEN.uniform(-0.002, 0.002, t.size)), "not even"),
    "time stands": (clock(lambda t: np.where(np.arange(t.size) == 500, t[499], t)), "stands still"),
    "rows not sorted": (
        rows(lambda k: np.where(k == 600, 601, np.where(k == 601, 600, k))),
        "goes back",
    ),
    "a gap": (rows(lambda k: k[(k < 500) | (k > 530)]), "gap"),
    "a short recording": (rows(lambda k: k[:150]), "at least 200"),
    "torques half a second late": (later(TORQUES, 50), "brake_torque.*behind"),
    "wheel speed of one axle late": (later(SPEEDS[1:2], 40), "wheel_speed of wheelset 2.*behind"),
    "a sensor that sticks": (at_rest, "stuck"),
    "wheels that turn faster than the vehicle": (times(1.2, SPEEDS), "mean sliding"),
    "a missing channel": (
        lambda c: {k: v for k, v in c.items() if k != LOADS[1]},
        "wheel_load_2_N",
    ),
    "a constant channel": (times(0.0, TORQUES[1:2]), "constant"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_data_that_cannot_be_what_it_says_is_refused_and_the_message_says_why(
    copy: Path, what: str
) -> None:
    change, said = REFUSED[what]
    edited(copy, "initial_speed_m_s = 33.0\n", "")
    write(copy, "a2", change(read(copy, "a2")))
    with pytest.raises(ConfigError, match=f"a2.*{said}"):
        dataset.load(copy)


@pytest.mark.parametrize(("names", "refused"), [(SPEEDS[1:2], False), (SPEEDS, True)])
def test_a_weak_sign_of_a_late_clock_counts_only_where_most_wheels_of_a_run_show_it(
    copy: Path, names, refused
) -> None:
    told = read(copy, "a2")
    late = later(names, 40)(told)
    write(copy, "a2", told | {name: 0.7 * late[name] + 0.3 * told[name] for name in names})
    with (
        pytest.raises(ConfigError, match="behind brake_torque")
        if refused
        else contextlib.nullcontext()
    ):
        dataset.load(copy)


def test_a_column_that_is_there_twice_is_refused_by_its_name(copy: Path) -> None:
    path = copy / "runs" / "a2.csv"
    rows = path.read_text().splitlines()
    first = next(k for k, row in enumerate(rows) if row.startswith("time_s"))
    doubled = [f"{row},{row.split(',')[1]}" for row in rows[first:]]
    path.write_text("\n".join([*rows[:first], *doubled]) + "\n")
    with pytest.raises(
        ConfigError, match=r"a2.csv: column 'vehicle_speed_m_s' is there 2 times; keep one"
    ):
        dataset.load(copy)


def gentle(columns):
    rolling = columns["vehicle_speed_m_s"] / RADIUS_M
    return columns | {
        name: rolling + 1e-3 * np.sin(np.arange(rolling.size) + k)
        for k, name in enumerate(SPEEDS[:2])
    }


def held(columns):
    return columns | {SPEEDS[0]: np.repeat(columns[SPEEDS[0]][::2], 2)[: columns["time_s"].size]}


DOUBTFUL = {
    "two wheelsets never slide": (gentle, "wheelset 1, 2 hardly slides"),
    "every second sample is held": (held, "repeat the one before"),
    "other brakes beside the discs": (times(0.4, TORQUES), "another brake"),
}


@pytest.mark.parametrize("what", DOUBTFUL)
def test_data_that_narrows_what_can_be_concluded_warns(copy: Path, what: str) -> None:
    change, said = DOUBTFUL[what]
    write(copy, "a2", change(read(copy, "a2")))
    assert any(said in warning for warning in dataset.load(copy).warnings)


def test_shipped_data_is_accepted_without_a_warning() -> None:
    for name in ("open_none", "open_rail_cleaning", "velim_synthetic"):
        assert dataset.load(name).warnings == []


def test_a_copy_cut_at_its_beginning_cannot_validate(copy: Path) -> None:
    write(copy, "b1", rows(lambda k: k[:-200])({k: v[100:] for k, v in read(copy, "a1").items()}))
    edited(copy, "initial_speed_m_s = 41.1\n", "")
    with pytest.raises(ConfigError, match="same samples"):
        dataset.load(copy)


def test_a_copy_with_new_loads_cannot_validate(copy: Path) -> None:
    write(copy, "b1", times(1.01, LOADS)(read(copy, "a1")))
    edited(copy, "initial_speed_m_s = 41.1\n", "")
    with pytest.raises(ConfigError, match="same samples"):
        dataset.load(copy)


def only(copy: Path, *names: str) -> None:
    head, *runs = (copy / "dataset.toml").read_text().split("[[run]]")
    kept = [run for run in runs if any(f"/{name}.csv" in run for name in names)]
    (copy / "dataset.toml").write_text("[[run]]".join([head, *kept]))


@pytest.mark.parametrize(
    ("kept", "said"),
    [
        (("a1", "b1"), "only one run is fitted"),
        (("a1", "a2"), "no gain can be claimed"),
    ],
)
def test_too_few_runs_say_what_can_still_be_concluded(
    copy: Path, kept: tuple[str, ...], said: str
) -> None:
    only(copy, *kept)
    assert any(said in warning for warning in dataset.load(copy).warnings)


@pytest.mark.parametrize(
    ("kept", "said"), [((), "no \\[\\[run\\]\\]"), (("b1", "b2"), "nothing can be fitted")]
)
def test_no_run_to_fit_is_refused(copy: Path, kept: tuple[str, ...], said: str) -> None:
    only(copy, *kept)
    with pytest.raises(ConfigError, match=said):
        dataset.load(copy)


# --- MDF4 ---


def as_mdf(copy: Path, clocks=None, units=None) -> None:
    """The run a2 as MDF4; `clocks` name -> (every, offset in s), the signal of a finer recording."""
    from asammdf import MDF, Signal

    columns = read(copy, "a2")
    time = columns.pop("time_s")
    file = MDF()
    for name, values in columns.items():
        every, offset_s = (clocks or {}).get(name, (1, 0.0))
        stamps = time[::every] + offset_s
        file.append(
            Signal(
                np.interp(stamps, time, values) if offset_s else values[::every],
                stamps,
                name=name,
                unit=(units or {}).get(name, ""),
            )
        )
    file.save(copy / "runs" / "a2.mf4", overwrite=True)
    file.close()
    edited(copy, "runs/a2.csv", "runs/a2.mf4")


def test_an_mdf_file_reads_like_the_csv_that_it_holds(copy: Path) -> None:
    as_mdf(copy)
    found = dataset.load(copy)
    truth, run = read(copy, "a2"), found.runs[1]
    assert found.warnings == []
    np.testing.assert_array_equal(run.wheel_speed_rad_s[:, 2], truth[SPEEDS[2]])
    np.testing.assert_allclose(run.time_s, truth["time_s"] - truth["time_s"][0], atol=1e-9)


def test_channels_of_an_mdf_file_with_other_clocks_are_moved_and_a_warning_says_so(
    copy: Path,
) -> None:
    as_mdf(copy, {name: (1, 0.003) for name in TORQUES} | {name: (5, 0.0) for name in LOADS})
    found = dataset.load(copy)
    assert any("brake_torque_1_Nm by 3 ms" in warning for warning in found.warnings)
    truth, run = read(copy, "a2"), found.runs[1]
    n = run.time_s.size
    off = run.torque_Nm[50 : n - 50, 0] - truth[TORQUES[0]][1:][50 : n - 50]
    assert np.sqrt(np.mean(off**2)) < 0.02 * truth[TORQUES[0]].max()
    assert run.load_N[:, 0].mean() == pytest.approx(truth[LOADS[0]].mean(), rel=1e-3)
    np.testing.assert_array_equal(run.wheel_speed_rad_s[:, 0], truth[SPEEDS[0]][1 : n + 1])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"clocks": {TORQUES[0]: (1, 500.0)}}, "no time in common"),
        ({"units": {"vehicle_speed_m_s": "km/h"}}, "unit 'km/h'"),
        ({"units": {LOADS[3]: "kN"}}, "wheel_load_4_N has the unit 'kN'"),
    ],
)
def test_an_mdf_file_whose_channels_do_not_fit_is_refused(copy: Path, given, said: str) -> None:
    as_mdf(copy, **given)
    with pytest.raises(ConfigError, match=said):
        dataset.load(copy)


def test_a_file_that_is_no_mdf_is_refused(copy: Path) -> None:
    (copy / "runs" / "a2.mf4").write_bytes(b"not MDF at all" * 100)
    edited(copy, "runs/a2.csv", "runs/a2.mf4")
    with pytest.raises(ConfigError, match="cannot be read as MDF"):
        dataset.load(copy)


def test_without_asammdf_the_message_names_the_extra(copy: Path, monkeypatch) -> None:
    as_mdf(copy)
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(ConfigError, match=r"rollerrig\[mdf\]"):
        dataset.load(copy)
