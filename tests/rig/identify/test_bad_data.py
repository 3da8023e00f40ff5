"""Each known defect of measured data is refused, or leads to a warning.

The tables REFUSED and DOUBTFUL have one row for each defect.
"""

import contextlib
import shutil
import sys
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import dataset, mdf, quality

SHIPPED = store.ROOT / "datasets" / "open_none"
RADIUS_M = 0.445
SPEEDS = tuple(f"wheel_speed_{axle}_rad_s" for axle in range(1, 5))
LOADS = tuple(f"wheel_load_{axle}_N" for axle in range(1, 5))
TORQUES = tuple(f"brake_torque_{axle}_Nm" for axle in range(1, 5))

# the columns of a run's file, by name
Columns: TypeAlias = dict[str, np.ndarray]
# returns columns with a defect
Defect: TypeAlias = Callable[[Columns], Columns]


class Case(NamedTuple):
    """A defect, and the text that its message must contain."""

    defect: Defect
    message: str


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of a shipped data set, which the test may damage."""
    return Path(shutil.copytree(SHIPPED, tmp_path / "set"))


def read(copy: Path, run: str) -> Columns:
    path = copy / "runs" / f"{run}.csv"
    names = path.read_text().splitlines()[0].split(",")
    values = np.loadtxt(path, delimiter=",", skiprows=1)
    return dict(zip(names, values.T, strict=True))


def write(copy: Path, run: str, columns: Columns) -> None:
    np.savetxt(
        copy / "runs" / f"{run}.csv",
        np.column_stack(list(columns.values())),
        delimiter=",",
        fmt="%.9g",
        header=",".join(columns),
        comments="",
    )


def replace_in_toml(copy: Path, old: str, new: str) -> None:
    path = copy / "dataset.toml"
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def keep_runs(copy: Path, names: Sequence[str]) -> None:
    """Remove all other runs from the data set."""
    path = copy / "dataset.toml"
    head, *runs = path.read_text().split("[[run]]")
    remaining = []
    for run in runs:
        if any(f"/{name}.csv" in run for name in names):
            remaining.append(run)
    path.write_text("[[run]]".join([head, *remaining]))


# --- defects ---


def scaled(factor: float, names: Sequence[str]) -> Defect:
    """Multiply some columns by a factor."""

    def defect(columns: Columns) -> Columns:
        for name in names:
            columns[name] = factor * columns[name]
        return columns

    return defect


def delayed(names: Sequence[str], samples: int) -> Defect:
    """Delays some columns; their first value fills the beginning."""

    def defect(columns: Columns) -> Columns:
        for name in names:
            values = columns[name]
            beginning = np.repeat(values[:1], samples)
            columns[name] = np.concatenate([beginning, values])[: values.size]
        return columns

    return defect


def with_clock(clock: Callable[[np.ndarray], np.ndarray]) -> Defect:
    """Replace the times by a function of them."""

    def defect(columns: Columns) -> Columns:
        columns["time_s"] = clock(columns["time_s"])
        return columns

    return defect


def with_rows(select: Callable[[np.ndarray], np.ndarray]) -> Defect:
    """Select rows; `select` maps the numbers of all rows to those of the selected ones."""

    def defect(columns: Columns) -> Columns:
        rows = select(np.arange(columns["time_s"].size))
        return {name: values[rows] for name, values in columns.items()}

    return defect


def uneven_clock(time_s: np.ndarray) -> np.ndarray:
    return time_s + UNEVEN.uniform(-0.002, 0.002, time_s.size)


def clock_that_repeats_a_time(time_s: np.ndarray) -> np.ndarray:
    repeated = time_s.copy()
    repeated[500] = time_s[499]
    return repeated


def with_two_rows_exchanged(rows: np.ndarray) -> np.ndarray:
    exchanged = rows.copy()
    exchanged[600] = 601
    exchanged[601] = 600
    return exchanged


def stuck_sensor(columns: Columns) -> Columns:
    """The speed of wheelset 3 stays at its value of row 800 from 8 s on."""
    speed = columns[SPEEDS[2]]
    columns[SPEEDS[2]] = np.where(columns["time_s"] > 8.0, speed[800], speed)
    return columns


def missing_load(columns: Columns) -> Columns:
    del columns[LOADS[1]]
    return columns


def two_wheelsets_that_roll(columns: Columns) -> Columns:
    rolling_rad_s = columns["vehicle_speed_m_s"] / RADIUS_M
    rows = np.arange(rolling_rad_s.size)
    for number, name in enumerate(SPEEDS[:2]):
        columns[name] = rolling_rad_s + 1e-3 * np.sin(rows + number)
    return columns


def every_second_sample_repeated(columns: Columns) -> Columns:
    speed = columns[SPEEDS[0]]
    columns[SPEEDS[0]] = np.repeat(speed[::2], 2)[: speed.size]
    return columns


# --- defects that are refused ---

UNEVEN = np.random.default_rng(1)
# The message is a regular expression; the name of the run precedes it.
REFUSED = {
    "vehicle speed in km/h, initial speed not given": Case(
        scaled(3.6, ["vehicle_speed_m_s"]), "divide it by 3.6"
    ),
    "wheel speed in rpm": Case(scaled(30.0 / np.pi, SPEEDS), "rpm"),
    "wheel speed in turns a second": Case(scaled(0.5 / np.pi, SPEEDS), "turns a second"),
    "wheel speed in m/s": Case(scaled(RADIUS_M, SPEEDS), "in m/s"),
    "wheel speed in km/h": Case(scaled(3.6 * RADIUS_M, SPEEDS), "km/h"),
    "one wheel speed in rpm": Case(scaled(30.0 / np.pi, SPEEDS[1:2]), "wheelset 2.*rpm"),
    "one wheel speed negative": Case(scaled(-1.0, SPEEDS[3:]), "wheel_speed_4.*sign"),
    "loads in kN": Case(scaled(1e-3, LOADS), "kN"),
    "loads of one wheel": Case(scaled(0.5, LOADS), "one wheel"),
    "loads in kilograms": Case(scaled(1.0 / 9.80665, LOADS), "in kg"),
    "one load in tonnes": Case(scaled(1e-3 / 9.80665, LOADS[2:3]), "wheel_load_3.*in t"),
    "torques in kN m": Case(scaled(1e-3, TORQUES), "kN m"),
    "torques of one wheel": Case(scaled(0.5, TORQUES), "one wheel"),
    "torques negative": Case(scaled(-1.0, TORQUES), "change its sign"),
    "one torque negative": Case(scaled(-1.0, TORQUES[:1]), "brake_torque_1.*sign"),
    "time in milliseconds": Case(with_clock(lambda time_s: 1000.0 * time_s), "milliseconds"),
    "time drifts": Case(with_clock(lambda time_s: 1.01 * time_s), "drifts"),
    "time not even": Case(with_clock(uneven_clock), "not even"),
    "a time is repeated": Case(with_clock(clock_that_repeats_a_time), "stands still"),
    "rows not sorted": Case(with_rows(with_two_rows_exchanged), "goes back"),
    "a gap": Case(with_rows(lambda rows: rows[(rows < 500) | (rows > 530)]), "gap"),
    "a short recording": Case(with_rows(lambda rows: rows[:150]), "at least 200"),
    "torques half a second late": Case(delayed(TORQUES, 50), "brake_torque.*behind"),
    "wheel speed of one axle late": Case(
        delayed(SPEEDS[1:2], 40), "wheel_speed of wheelset 2.*behind"
    ),
    "a sensor that sticks": Case(stuck_sensor, "stuck"),
    "wheels that turn faster than the vehicle": Case(scaled(1.2, SPEEDS), "mean sliding"),
    "a missing channel": Case(missing_load, "wheel_load_2_N"),
    "a constant channel": Case(scaled(0.0, TORQUES[1:2]), "constant"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_data_with_a_known_defect_is_refused_with_the_reason(copy: Path, name: str) -> None:
    case = REFUSED[name]
    keep_runs(copy, ("a2", "b3"))
    replace_in_toml(copy, "initial_speed_m_s = 33.0\n", "")
    write(copy, "a2", case.defect(read(copy, "a2")))
    with pytest.raises(ConfigError, match=f"a2.*{case.message}"):
        dataset.load(copy)


@pytest.mark.parametrize(("names", "is_refused"), [(SPEEDS[1:2], False), (SPEEDS, True)])
def test_a_weak_sign_of_a_late_clock_counts_only_where_most_wheels_of_a_run_show_it(
    copy: Path, names: Sequence[str], is_refused: bool
) -> None:
    columns = read(copy, "a2")
    late = delayed(names, 40)(dict(columns))
    for name in names:
        columns[name] = 0.7 * late[name] + 0.3 * columns[name]
    write(copy, "a2", columns)

    outcome: Any = contextlib.nullcontext()
    if is_refused:
        outcome = pytest.raises(ConfigError, match="behind brake_torque")
    with outcome:
        dataset.load(copy)


def test_a_repeated_column_is_refused_by_its_name(copy: Path) -> None:
    path = copy / "runs" / "a2.csv"
    doubled = []
    for line in path.read_text().splitlines():
        second = line.split(",")[1]
        doubled.append(f"{line},{second}")
    path.write_text("\n".join(doubled) + "\n")
    with pytest.raises(
        ConfigError, match=r"a2.csv: column 'vehicle_speed_m_s' is there 2 times; keep one"
    ):
        dataset.load(copy)


# --- defects that lead to a warning ---

DOUBTFUL = {
    "two wheelsets never slide": Case(two_wheelsets_that_roll, "wheelset 1, 2 hardly slides"),
    "every second sample is repeated": Case(every_second_sample_repeated, "repeat the one before"),
    "other brakes besides the discs": Case(scaled(0.4, TORQUES), "another brake"),
}


@pytest.mark.parametrize("name", DOUBTFUL)
def test_data_that_limits_the_conclusions_leads_to_a_warning(copy: Path, name: str) -> None:
    case = DOUBTFUL[name]
    keep_runs(copy, ("a2", "b3"))
    write(copy, "a2", case.defect(read(copy, "a2")))
    assert any(case.message in warning for warning in dataset.load(copy).warnings)


def test_counted_pulses_that_stay_the_same_within_their_quantum_are_no_stuck_sensor(
    copy: Path,
) -> None:
    keep_runs(copy, ("a2", "b3"))
    columns = read(copy, "a2")
    # the wheel rolls, and its counter counts whole pulses
    rolling_rad_s = columns["vehicle_speed_m_s"] / RADIUS_M
    quantum_rad_s = 5.0
    counted_rad_s = quantum_rad_s * np.floor(rolling_rad_s / quantum_rad_s)
    longest = max(len(list(same)) for _, same in groupby(counted_rad_s))
    assert longest * (columns["time_s"][1] - columns["time_s"][0]) > quality.LONGEST_HELD_S
    columns[SPEEDS[2]] = counted_rad_s
    write(copy, "a2", columns)
    dataset.load(copy)

    # the same time at the same value is too long if the vehicle slows by more than the quantum
    columns[SPEEDS[2]] = np.where(columns["time_s"] > 8.0, counted_rad_s[800], counted_rad_s)
    write(copy, "a2", columns)
    with pytest.raises(ConfigError, match="stuck"):
        dataset.load(copy)


def test_shipped_data_is_accepted_without_a_warning() -> None:
    for name in ("open_none", "open_rail_cleaning", "velim_synthetic"):
        assert dataset.load(name).warnings == []


# --- the runs that validate must be new data ---


def test_a_copy_of_a_fitted_run_cut_at_its_beginning_cannot_validate(copy: Path) -> None:
    keep_runs(copy, ("a1", "b1"))
    without_both_ends = with_rows(lambda rows: rows[100:-200])
    write(copy, "b1", without_both_ends(read(copy, "a1")))
    replace_in_toml(copy, "initial_speed_m_s = 41.1\n", "")
    with pytest.raises(ConfigError, match="same samples"):
        dataset.load(copy)


def test_a_copy_of_a_fitted_run_with_new_loads_cannot_validate(copy: Path) -> None:
    keep_runs(copy, ("a1", "b1"))
    with_other_loads = scaled(1.01, LOADS)
    write(copy, "b1", with_other_loads(read(copy, "a1")))
    replace_in_toml(copy, "initial_speed_m_s = 41.1\n", "")
    with pytest.raises(ConfigError, match="same samples"):
        dataset.load(copy)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        (("a1", "b1"), "only one run is fitted"),
        (("a1", "a2"), "no gain can be claimed"),
    ],
)
def test_with_too_few_runs_a_warning_names_what_cannot_be_concluded(
    copy: Path, runs: Sequence[str], message: str
) -> None:
    keep_runs(copy, runs)
    assert any(message in warning for warning in dataset.load(copy).warnings)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ((), r"no \[\[run\]\]"),
        (("b1", "b2"), "nothing can be fitted"),
    ],
)
def test_data_without_a_run_to_fit_is_refused(
    copy: Path, runs: Sequence[str], message: str
) -> None:
    keep_runs(copy, runs)
    with pytest.raises(ConfigError, match=message):
        dataset.load(copy)


# --- MDF4 ---


class Sampling(NamedTuple):
    """How a channel of an MDF file is sampled, compared with the CSV file."""

    every: int = 1  # 5: each fifth sample of the CSV file
    offset_s: float = 0.0  # its clock is later by this


def replace_run_a2_by_mdf(
    copy: Path,
    samplings: dict[str, Sampling] | None = None,
    units: dict[str, str] | None = None,
) -> None:
    """Write the run a2 as MDF4 in place of CSV.

    samplings: how channels are sampled, by name; the others as in the CSV file.
    units: units of channels, by name; the others have none.
    """
    from asammdf import MDF, Signal

    columns = read(copy, "a2")
    time_s = columns.pop("time_s")
    file = MDF()
    for name, values in columns.items():
        sampling = (samplings or {}).get(name, Sampling())
        stamps_s = time_s[:: sampling.every] + sampling.offset_s
        samples = values[:: sampling.every]
        if sampling.offset_s:
            samples = np.interp(stamps_s, time_s, values)
        unit = (units or {}).get(name, "")
        file.append(Signal(samples, stamps_s, name=name, unit=unit))
    file.save(copy / "runs" / "a2.mf4", overwrite=True)
    file.close()
    replace_in_toml(copy, "runs/a2.csv", "runs/a2.mf4")


def test_an_mdf_file_reads_like_the_csv_file_with_the_same_data(copy: Path) -> None:
    replace_run_a2_by_mdf(copy)
    data = dataset.load(copy)
    run = data.runs[1]
    csv = read(copy, "a2")
    assert data.warnings == []
    np.testing.assert_array_equal(run.wheel_speed_rad_s[:, 2], csv[SPEEDS[2]])
    np.testing.assert_allclose(run.time_s, csv["time_s"] - csv["time_s"][0], atol=1e-9)


def test_channels_of_an_mdf_file_with_other_clocks_are_moved_with_a_warning(copy: Path) -> None:
    samplings = {}
    for name in TORQUES:
        samplings[name] = Sampling(offset_s=0.003)
    for name in LOADS:
        samplings[name] = Sampling(every=5)
    replace_run_a2_by_mdf(copy, samplings)
    data = dataset.load(copy)
    assert any("brake_torque_1_Nm by 3 ms" in warning for warning in data.warnings)

    # the late torques begin after the first sample, so the run begins with the second one
    run = data.runs[1]
    csv = {name: values[1:] for name, values in read(copy, "a2").items()}
    n = run.time_s.size
    np.testing.assert_array_equal(run.wheel_speed_rad_s[:, 0], csv[SPEEDS[0]][:n])
    mean_load_N = read(copy, "a2")[LOADS[0]].mean()
    assert run.load_N[:, 0].mean() == pytest.approx(mean_load_N, rel=1e-3)
    # interpolation changes the torques slightly, most at both ends
    inner = slice(50, n - 50)
    error_Nm = run.torque_Nm[inner, 0] - csv[TORQUES[0]][inner]
    largest_Nm = read(copy, "a2")[TORQUES[0]].max()
    assert np.sqrt(np.mean(error_Nm**2)) < 0.02 * largest_Nm


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samplings": {TORQUES[0]: Sampling(offset_s=500.0)}}, "no time in common"),
        ({"units": {"vehicle_speed_m_s": "km/h"}}, "unit 'km/h'"),
        ({"units": {LOADS[3]: "kN"}}, "wheel_load_4_N has the unit 'kN'"),
    ],
)
def test_an_mdf_file_with_a_foreign_clock_or_unit_is_refused(
    copy: Path, options: dict[str, Any], message: str
) -> None:
    replace_run_a2_by_mdf(copy, **options)
    with pytest.raises(ConfigError, match=message):
        dataset.load(copy)


def test_a_file_that_is_not_mdf_is_refused(copy: Path) -> None:
    (copy / "runs" / "a2.mf4").write_bytes(b"not MDF at all" * 100)
    replace_in_toml(copy, "runs/a2.csv", "runs/a2.mf4")
    with pytest.raises(ConfigError, match="cannot be read as MDF"):
        dataset.load(copy)


# reads the text of a file as Python, with which a file could run any code
FORMULA_WITH_CODE = """("'", [c for c in ().__class__.__base__.__subclasses__()
if c.__name__ == "_wrap_close"][0].__init__.__globals__["system"]("touch ran"), "'")"""


@pytest.mark.parametrize("version", ["3.30", "4.10"])
@pytest.mark.parametrize(
    "formula", [FORMULA_WITH_CODE, "X.real", "sin(X)", "9**9**9**9", "X" * 999]
)
def test_a_formula_of_an_mdf_file_that_is_more_than_arithmetic_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str, formula: str
) -> None:
    monkeypatch.chdir(tmp_path)
    path = file_with_formula(tmp_path, version, formula)
    with pytest.raises(ConfigError, match=r"channel 'position_m' is the formula .* run as code"):
        mdf.channels(path, ("position_m",))
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("version", ["3.30", "4.10"])
def test_a_formula_of_an_mdf_file_that_is_arithmetic_converts_the_values(
    tmp_path: Path, version: str
) -> None:
    path = file_with_formula(tmp_path, version, "(X - 32) * 5/9 + 1.5e-1")
    values = mdf.channels(path, ("position_m",))["position_m"].samples
    np.testing.assert_allclose(values, (np.arange(5.0) - 32.0) * 5.0 / 9.0 + 0.15)


def file_with_formula(folder: Path, version: str, formula: str) -> Path:
    """Write an MDF file with one channel, whose values 0 to 4 are converted by a formula."""
    from asammdf import MDF, Signal

    samples = np.arange(5.0)
    channel = Signal(samples, 0.1 * samples, name="position_m", conversion={"formula": formula})
    with MDF(version=version) as file:
        file.append([channel])
        return Path(file.save(folder / "formula.mf4", overwrite=True))


def test_without_asammdf_the_message_names_the_extra_to_install(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace_run_a2_by_mdf(copy)
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(ConfigError, match=r"rollerrig\[mdf\]"):
        dataset.load(copy)
