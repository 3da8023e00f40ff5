"""Recordings from other writers are read.

The files are Parquet or MDF4, with stamps as date and time, and numbers of any kind.
"""

import datetime
import zoneinfo
from decimal import Decimal

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict

BERLIN = zoneinfo.ZoneInfo("Europe/Berlin")
UTC = datetime.UTC
CHANNELS = """[channels]
time_s = {{ column = "t"{unit} }}
wheel_speed_1_m_s = {{ column = "v", name = "axle" }}
reference_speed_m_s = {{ column = "g", name = "gnss" }}
"""

# samples of a recording, their stamps and both speeds
N = 400
T_S = 0.1 * np.arange(N)
V_M_S = np.round(30.0 - 0.4 * T_S, 2)

# 20 s before the clocks go back, and forward
AUTUMN = datetime.datetime(2026, 10, 25, 0, 59, 40, tzinfo=UTC)
SPRING = datetime.datetime(2026, 3, 29, 0, 59, 40, tzinfo=UTC)


def loaded(folder, name, unit="", run=""):
    """Write dataset.toml for one file, and return the run that is read from it."""
    unit = f', unit = "{unit}"' if unit else ""
    head = 'kind = "recorder"\n'
    run_table = f'[[run]]\nfile = "{name}"\n{run}\n'
    (folder / "dataset.toml").write_text(head + CHANNELS.format(unit=unit) + run_table)
    return recording.load(folder).runs[0]


def assert_axle(run, values=V_M_S):
    """Assert that the axle has all stamps of the recording, and these values."""
    np.testing.assert_allclose(run.channels["axle"].time_s, T_S, atol=2e-6)
    np.testing.assert_allclose(run.channels["axle"].values, values, rtol=1e-5)


def instants(start, zone=None):
    """Return stamps as Python objects, exactly one tenth of a second apart."""
    return [(start + datetime.timedelta(milliseconds=100 * k)).astimezone(zone) for k in range(N)]


def write_parquet(folder, stamps, values=V_M_S, name="one.parquet"):
    """Write a recording and return the name of its file."""
    pyarrow.parquet.write_table(pa.table({"t": stamps, "v": values, "g": V_M_S}), folder / name)
    return name


def write_csv(folder, stamps, name="one.csv", values=V_M_S):
    """Write a recording and return the name of its file."""
    rows = [",".join(map(str, row)) for row in zip(stamps, values, V_M_S, strict=True)]
    (folder / name).write_text("\n".join(["t,v,g", *rows]) + "\n")
    return name


def write_recording(folder, name, stamps):
    """Write a recording as CSV or Parquet, by the suffix of its name, and return the name."""
    if name.lower().endswith("csv"):
        return write_csv(folder, stamps, name)
    return write_parquet(folder, pa.array(stamps), name=name)


# --- Parquet ---


@pytest.mark.parametrize("unit", ["ms", "us", "ns"])
@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin", "+05:30"])
def test_stamps_of_parquet_are_instants_whatever_their_unit_and_zone(tmp_path, unit, zone):
    # across the hour that Berlin has twice: instants go on
    stamps = pa.array(
        [stamp.replace(tzinfo=None) for stamp in instants(AUTUMN, UTC)], pa.timestamp(unit)
    )
    if zone:
        stamps = pa.array(instants(AUTUMN), pa.timestamp(unit, tz=zone))
    assert_axle(loaded(tmp_path, write_parquet(tmp_path, stamps)))


@pytest.mark.parametrize(
    ("kind", "per_s", "unit"),
    [
        (pa.int64(), 10**9, "ns"),
        (pa.uint64(), 10**9, "ns"),
        (pa.int64(), 10**6, "us"),
        (pa.int64(), 10**3, "ms"),
        (pa.float64(), 1, "s"),
        (pa.decimal128(20, 6), 1, "s"),
    ],
    ids=str,
)
def test_stamps_of_parquet_may_be_numbers_since_an_epoch_in_their_unit(tmp_path, kind, per_s, unit):
    tenths = 17_743_320_000 + np.arange(N)
    if pa.types.is_integer(kind):
        stamps = pa.array([int(tenth) * per_s // 10 for tenth in tenths], kind)
    elif pa.types.is_decimal(kind):
        stamps = pa.array([Decimal(int(tenth)) / 10 for tenth in tenths], kind)
    else:
        stamps = pa.array(tenths / 10.0, kind)
    assert_axle(loaded(tmp_path, write_parquet(tmp_path, stamps), unit))


@pytest.mark.parametrize("kind", [pa.duration("us"), pa.time32("ms"), pa.time64("us")], ids=str)
def test_stamps_of_parquet_may_be_durations_or_times_of_a_day(tmp_path, kind):
    since = [datetime.timedelta(hours=10, milliseconds=100 * k) for k in range(N)]
    if pa.types.is_time(kind):
        since = [(datetime.datetime.min + duration).time() for duration in since]
    assert_axle(loaded(tmp_path, write_parquet(tmp_path, pa.array(since, kind))))


@pytest.mark.parametrize(
    "kind", [pa.float16(), pa.float32(), pa.int32(), pa.decimal128(10, 3)], ids=str
)
def test_values_of_parquet_may_be_of_any_kind_of_number_and_missing(tmp_path, kind):
    whole = np.rint(V_M_S)
    if pa.types.is_decimal(kind):
        values = [Decimal(int(value)) for value in whole]
    elif kind == pa.float16():
        values = [np.float16(value) for value in whole]
    else:
        values = [int(value) for value in whole]
    values[50:60] = [None] * 10
    name = write_parquet(tmp_path, pa.array(T_S), pa.array(values, kind))

    expected = whole.copy()
    expected[50:60] = np.nan
    assert_axle(loaded(tmp_path, name), values=expected)


def test_a_frame_of_pandas_reads_with_its_index_of_times_and_its_categories(tmp_path):
    pandas = pytest.importorskip("pandas")
    index = pandas.DatetimeIndex(instants(AUTUMN), name="t").tz_convert("Europe/Berlin")
    frame = pandas.DataFrame(
        {"v": V_M_S.astype("float32"), "g": V_M_S, "state": pandas.Categorical(["on"] * N)}, index
    )
    frame.to_parquet(tmp_path / "one.parquet")
    assert_axle(loaded(tmp_path, "one.parquet"))


@pytest.mark.parametrize("name", ["one.csv", "one.parquet"])
def test_a_column_that_is_there_twice_is_refused_by_name(tmp_path, name):
    speed = pa.array(V_M_S)
    made = pa.Table.from_arrays([pa.array(T_S), speed, speed, speed], ["t", "v", "v", "g"])
    if name.endswith("csv"):
        pa.csv.write_csv(made, tmp_path / name)
    else:
        pyarrow.parquet.write_table(made, tmp_path / name)
    with pytest.raises(ConfigError, match=r"column 'v'.*2"):
        loaded(tmp_path, name)


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_the_end_of_a_name_may_be_in_capitals(tmp_path, suffix):
    name = write_recording(tmp_path, f"ONE.{suffix.upper()}", T_S)
    assert_axle(loaded(tmp_path, name))


@pytest.mark.parametrize("name", ["one.csv", "one.parquet"])
def test_a_file_without_any_stamp_is_refused(tmp_path, name):
    if name.endswith("parquet"):
        write_parquet(tmp_path, pa.array([None] * N, pa.float64()))
    else:
        write_csv(tmp_path, [""] * N)
    with pytest.raises(ConfigError, match=r"'t'.*no stamp"):
        loaded(tmp_path, name)


# --- date and time as text ---


@pytest.mark.parametrize(
    "write",
    [
        lambda stamp: stamp.strftime("%Y-%m-%d %H:%M:%S.%f"),
        lambda stamp: stamp.strftime("%Y-%m-%dT%H:%M:%S.%f")[:-3],
        # whole seconds have no fraction
        lambda stamp: stamp.replace(tzinfo=None).isoformat(),
        lambda stamp: stamp.replace(tzinfo=None).isoformat(" "),
        lambda stamp: stamp.replace(tzinfo=None).isoformat() + "Z",
        lambda stamp: stamp.isoformat(),
        lambda stamp: stamp.astimezone(BERLIN).isoformat(),
        lambda stamp: stamp.astimezone(BERLIN).isoformat(" "),
    ],
)
@pytest.mark.parametrize("name", ["one.csv", "one.parquet"])
def test_date_and_time_as_text_are_instants_also_while_a_zone_turns_its_clocks_back(
    tmp_path, write, name
):
    stamps = [write(stamp) for stamp in instants(AUTUMN, UTC)]
    write_recording(tmp_path, name, stamps)
    assert_axle(loaded(tmp_path, name))


@pytest.mark.parametrize(
    ("start", "size_s"), [(AUTUMN, -3600.0), (SPRING, 3600.0)], ids=["autumn", "spring"]
)
@pytest.mark.parametrize("name", ["one.csv", "one.parquet"])
def test_a_local_clock_without_a_zone_that_is_turned_is_reported_as_a_step_of_an_hour(
    tmp_path, start, size_s, name
):
    stamps = [stamp.replace(tzinfo=None) for stamp in instants(start, BERLIN)]
    write_recording(tmp_path, name, stamps)
    run = loaded(tmp_path, name)
    account = verdict.explain(recording.load(tmp_path))
    assert len(account.findings) == 1, report.story(account)

    step = account.findings[0]
    assert step.name == "clock_step"
    assert round(step.size, 1) == size_s
    assert f"{size_s:+.0f} s exactly" in report.sentence(step)
    assert run.channels["axle"].values.size == N


@pytest.mark.parametrize(
    "stamp", ["31.02.2026 10:00:00", "13/29/2026 10:00:00", "2026-03-29 25:00:00", "yesterday"]
)
@pytest.mark.parametrize("name", ["one.csv", "one.parquet"])
def test_text_that_is_no_stamp_is_refused_with_the_forms_that_are_read(tmp_path, stamp, name):
    write_recording(tmp_path, name, [stamp] * N)
    with pytest.raises(ConfigError, match=r"one\.(csv|parquet): column 't'.*2026-03-29 10:00:00"):
        loaded(tmp_path, name)


@pytest.mark.parametrize("run", ['date = "01.03.2026"', 'date = "2026-3-1"', 'date = "March"'])
def test_a_date_of_a_run_that_would_not_sort_is_refused(tmp_path, run):
    with pytest.raises(ConfigError, match=r"date.*year-month-day"):
        loaded(tmp_path, write_csv(tmp_path, T_S), run=run)


@pytest.mark.parametrize("run", ['date = "2026-03-01"', "date = 2026-03-01"])
def test_a_date_of_a_run_may_be_a_text_or_a_date(tmp_path, run):
    assert loaded(tmp_path, write_csv(tmp_path, T_S), run=run).date == "2026-03-01"


# --- MDF4 ---


def mdf_file(folder, signals, version="4.10", name="one.mf4", start=None):
    """Write a file with asammdf, each of `signals` in a separate group, and return its name."""
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version=version) as file:
        if start:
            file.start_time = start
        for signal in signals:
            whole_signal = {"timestamps": T_S, "samples": V_M_S} | signal
            file.append([asammdf.Signal(**whole_signal)])
        file.save(folder / name, overwrite=True)
    return name


BOTH = ({"name": "v"}, {"name": "g"})


@pytest.mark.parametrize("version", ["3.30", "4.00", "4.10", "4.20"])
def test_mdf_channels_keep_their_stamps_and_their_units(tmp_path, version):
    name = mdf_file(
        tmp_path,
        (
            {"name": "v", "samples": 3.6 * V_M_S, "unit": "km/h"},
            {"name": "g", "timestamps": T_S[::2] + 0.037, "samples": V_M_S[::2], "unit": "m/s"},
        ),
        version,
        "one.mdf" if version < "4" else "one.mf4",
    )
    run = loaded(tmp_path, name)
    assert_axle(run)
    np.testing.assert_allclose(run.channels["gnss"].time_s, T_S[::2] + 0.037, atol=1e-6)


def test_mdf_stamps_count_from_the_first_sample_whatever_the_start_of_the_file(tmp_path):
    late = [signal | {"timestamps": T_S + 3600.0} for signal in BOTH]
    name = mdf_file(tmp_path, late, start=AUTUMN)
    assert_axle(loaded(tmp_path, name))


@pytest.mark.parametrize("kind", ["uint16", "int32", "float32"])
def test_mdf_counts_are_read_by_their_conversion(tmp_path, kind):
    speed = {
        "name": "v",
        "samples": np.rint(100.0 * V_M_S).astype(kind),
        "conversion": {"a": 0.01, "b": 0.0},
    }
    name = mdf_file(tmp_path, (speed, {"name": "g"}))
    assert_axle(loaded(tmp_path, name))


def test_mdf_counts_that_mean_no_number_are_no_data(tmp_path):
    counts = np.rint(5.0 * V_M_S).astype("uint8")
    counts[40:50] = 255
    scale = {
        "lower_0": 0,
        "upper_0": 250,
        "text_0": {"a": 0.2, "b": 0.0},
        "lower_1": 255,
        "upper_1": 255,
        "text_1": b"signal not available",
        "default": b"",
    }
    speed = {"name": "v", "samples": counts, "conversion": scale}
    name = mdf_file(tmp_path, (speed, {"name": "g"}))
    expected = np.where(counts == 255, np.nan, 0.2 * counts)
    assert_axle(loaded(tmp_path, name), values=expected)


def test_mdf_samples_that_are_marked_as_invalid_are_no_data(tmp_path):
    asammdf = pytest.importorskip("asammdf")
    is_invalid = np.zeros(N, bool)
    is_invalid[100:130] = True
    # some versions of asammdf have a type for these bits
    bits = is_invalid
    if hasattr(asammdf.blocks.utils, "InvalidationArray"):
        bits = asammdf.blocks.utils.InvalidationArray(is_invalid)
    speed = {
        "name": "v",
        "samples": np.where(is_invalid, 0.0, V_M_S),
        "invalidation_bits": bits,
    }
    name = mdf_file(tmp_path, (speed, {"name": "g"}))

    channel = loaded(tmp_path, name).channels["axle"]
    is_finite = np.isfinite(channel.values)
    np.testing.assert_allclose(channel.values[is_finite], V_M_S[~is_invalid], rtol=1e-6)
    np.testing.assert_allclose(channel.time_s[is_finite], T_S[~is_invalid], atol=1e-6)


def test_mdf_values_that_a_table_turns_into_words_for_errors_are_no_data(tmp_path):
    words = {"val_0": 0.0, "text_0": b"SNA", "val_1": 1.0, "text_1": b"error", "default": b""}
    speed = {"name": "v", "samples": np.full(N, 1, "uint8"), "conversion": words}
    name = mdf_file(tmp_path, (speed, {"name": "g"}))
    with pytest.raises(ConfigError, match=r"one\.mf4: column 'v'"):
        loaded(tmp_path, name)


def test_a_channel_that_an_mdf_file_has_twice_is_refused_by_name(tmp_path):
    with pytest.raises(ConfigError, match=r"one\.mf4.*'v'"):
        loaded(tmp_path, mdf_file(tmp_path, (*BOTH, {"name": "v"})))


def test_an_mdf_file_that_is_cut_off_is_refused(tmp_path):
    name = mdf_file(tmp_path, BOTH)
    whole = (tmp_path / name).read_bytes()
    for size in (0, 40, 400, len(whole) // 2, len(whole) - 10):
        (tmp_path / name).write_bytes(whole[:size])
        with pytest.raises(ConfigError, match=r"one\.mf4"):
            loaded(tmp_path, name)


def test_a_recording_gives_the_same_account_from_csv_parquet_and_mdf(tmp_path):
    accounts = []
    held = V_M_S.copy()
    held[150:200] = held[150]
    for name in ("one.csv", "one.parquet", "one.mf4"):
        if name.endswith("csv"):
            write_csv(tmp_path, np.round(T_S, 3), values=held)
        elif name.endswith("parquet"):
            stamps = pa.array(instants(SPRING), pa.timestamp("us", tz="Europe/Berlin"))
            write_parquet(tmp_path, stamps, held)
        else:
            mdf_file(tmp_path, ({"name": "v", "samples": held}, {"name": "g"}))
        loaded(tmp_path, name)
        findings = verdict.explain(recording.load(tmp_path)).findings
        assert [finding.name for finding in findings] == ["sensor_stuck"]
        stuck = findings[0]
        accounts.append((stuck.channels, round(stuck.start_s, 2), round(stuck.size, 2)))
    assert accounts[0] == accounts[1] == accounts[2]
