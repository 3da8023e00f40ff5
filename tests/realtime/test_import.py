"""`rollerrig import` makes a dataset of a logger's files; `explain` reads it, and own exports."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import program
import pyarrow.csv
import pyarrow.parquet
import pytest

from rollerrig.configs import store
from rollerrig.realtime import cli
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.train_recorder import recording, verdict

ROOT = Path(__file__).parent.parent.parent
TRIPS = sorted((ROOT / "docs" / "examples" / "import").glob("fahrt_*.csv"))
FIELD = ROOT / "tests" / "data" / "field"
STOPS = store.ROOT / "datasets" / "open_none"


def import_files(*arguments: Any) -> int:
    return cli.main(["import", *map(str, arguments)])


def test_a_proposal_is_shown_and_nothing_is_written_without_a_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "trips"
    assert import_files(*TRIPS, "--out", out) == cli.USAGE
    printed = capsys.readouterr()
    for text in ("recorder", "n_Rad2", "1/min", "v_GPS", "km/h", "cp1252", "semicolon"):
        assert text in printed.out
    assert "accept it with --yes" in printed.err
    assert not out.exists()


def test_the_german_files_of_the_page_are_imported_and_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "trips"
    assert import_files(*TRIPS, "--out", out, "--yes", "--json") == cli.PASS
    result = json.loads(capsys.readouterr().out)
    assert result["written"]
    assert [run["date"] for run in result["runs"]] == ["2026-03-01", "2026-03-01"]
    channels = {channel["key"]: channel for channel in result["channels"]}
    assert channels["wheel_speed_2_m_s"]["column"] == "n_Rad2"
    assert channels["wheel_speed_2_m_s"]["unit"] == "1/min"
    # the files are copied, because they are outside of the dataset
    assert (out / "fahrt_1.csv").read_bytes() == TRIPS[0].read_bytes()

    assert cli.main(["explain", str(out), "--out", str(tmp_path / "report"), "--json"]) == cli.PASS
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "explained"
    [radius] = [cause for cause in report["causes"] if cause["name"] == "wheel_radius"]
    # wheel 2 of the example is 0.9 % larger than the others, and wheel 1 slides
    size = next(iter(radius["parameters"].values()))
    assert size["ci95"][0] <= 0.9 <= size["ci95"][1]
    assert [episode["axles"] for episode in report["episodes"]] == [[1], [1]]


def test_the_page_shows_the_dataset_that_its_command_writes(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "howto_import.md").read_text(encoding="utf-8")
    shown = re.search(r"```toml\n(# imported.*?)```", page, re.DOTALL)
    assert shown
    assert import_files(*TRIPS, "--out", tmp_path / "trips", "--yes") == cli.PASS
    assert (tmp_path / "trips" / "dataset.toml").read_text(encoding="utf-8") == shown[1]


def test_files_in_the_folder_of_the_dataset_are_referred_to(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    inside = [Path(shutil.copy(trip, tmp_path / "raw")) for trip in TRIPS]
    assert import_files(*inside, "--out", tmp_path, "--yes") == cli.PASS
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dataset.toml", "raw"]
    assert [run.name for run in recording.load(tmp_path).runs] == ["fahrt_1", "fahrt_2"]


def test_files_of_the_same_name_are_both_copied(tmp_path: Path) -> None:
    for number, trip in enumerate(TRIPS):
        (tmp_path / str(number)).mkdir()
        shutil.copy(trip, tmp_path / str(number) / "trip.csv")
    out = tmp_path / "out"
    assert import_files(*sorted(tmp_path.glob("*/trip.csv")), "--out", out, "--yes") == cli.PASS
    assert (out / "trip_2.csv").read_bytes() == TRIPS[1].read_bytes()


def test_a_terminal_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal:
        """Standard input of a user who types an answer."""

        def __init__(self, answer: str) -> None:
            self.answer = answer

        def isatty(self) -> bool:
            return True

        def readline(self, *_: int) -> str:
            return f"{self.answer}\n"

    out = tmp_path / "trips"
    monkeypatch.setattr("sys.stdin", Terminal("n"))
    assert import_files(*TRIPS, "--out", out) == cli.USAGE
    assert not out.exists()
    monkeypatch.setattr("sys.stdin", Terminal("y"))
    assert import_files(*TRIPS, "--out", out) == cli.PASS
    assert (out / "dataset.toml").is_file()


def test_units_that_no_file_gives_are_required(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = FIELD / "rec_excel_days" / "run1.csv"
    out = tmp_path / "days"
    assert import_files(file, "--out", out, "--yes") == cli.USAGE
    assert "no unit is known for reference_speed_m_s, wheel_speed_1_m_s" in capsys.readouterr().err
    assert not out.exists()

    units = ("--unit", "wheel=km/h", "--unit", "reference=km/h", "--unit", "position_m=m")
    assert import_files(file, "--out", out, "--yes", *units) == cli.PASS
    imported = recording.load(out).runs[0].channels
    written_by_hand = recording.load(FIELD / "rec_excel_days").runs[0].channels
    assert imported.keys() == written_by_hand.keys()
    for name, channel in imported.items():
        np.testing.assert_array_equal(channel.values, written_by_hand[name].values)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--map", "gps_speed=v_GPS"), "recorder has no channel gps_speed"),
        (("--map", "wheel_speed_1_m_s=n_Rad9"), "no column 'n_Rad9'"),
        (("--map", "v_GPS"), "write NAME=VALUE"),
        (("--unit", "wheel=furlong"), "unit is not known"),
        (("--unit", "wheel=km/h"), "'1/min' in the file"),
        (("--vehicle", "uic_z9"), "uic_z9"),
        (("--kind", "braking_runs"), "vehicle_speed_m_s"),
    ],
)
def test_a_wrong_option_is_a_message(
    arguments: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert import_files(*TRIPS, "--out", tmp_path / "out", "--yes", *arguments) == cli.USAGE
    assert message in capsys.readouterr().err


def test_a_dataset_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dataset.toml").write_text("mine")
    assert import_files(*TRIPS, "--out", tmp_path, "--yes") == cli.USAGE
    assert "is there already" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.toml"]


@pytest.mark.parametrize("name", ["none.csv", "none.mf4", "none.parquet"])
def test_a_missing_file_is_a_message_about_the_files_of_the_logger(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    missing = tmp_path / name
    assert import_files(TRIPS[0], missing, "--out", tmp_path / "out", "--yes") == cli.USAGE
    message = f"{missing}: no such file; give the files that the logger wrote"
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_files_with_other_columns_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "other.csv"
    other.write_bytes(TRIPS[1].read_bytes().replace(b"n_Rad3", b"n_Rad5"))
    assert import_files(TRIPS[0], other, "--out", tmp_path / "out", "--yes") == cli.USAGE
    assert "other.csv: column 'n_Rad3' is missing" in capsys.readouterr().err


# --- braking runs ---

GERMAN = {
    "time_s": ("Zeit [ms]", 1e3),
    "vehicle_speed_m_s": ("Fahrzeuggeschwindigkeit [km/h]", 3.6),
    **{f"wheel_speed_{j}_rad_s": (f"n_Rad{j} [1/min]", 30.0 / np.pi) for j in range(1, 5)},
    **{f"wheel_load_{j}_N": (f"Achslast {j} [kN]", 1e-3) for j in range(1, 5)},
    **{f"brake_torque_{j}_Nm": (f"Bremsmoment {j} [kNm]", 1e-3) for j in range(1, 5)},
}


def german_stop(source: Path, target: Path) -> None:
    """Write a stop of a packaged dataset as a German logger would."""
    table = pyarrow.csv.read_csv(source)
    lines = [";".join(name for name, _ in GERMAN.values())]
    columns = [scale * table[key].to_numpy() for key, (_, scale) in GERMAN.items()]
    for row in np.column_stack(columns):
        lines.append(";".join(f"{value:.9g}".replace(".", ",") for value in row))
    target.write_bytes(("\r\n".join(lines) + "\r\n").encode("utf-16"))


def a_stop_without_names(folder: Path) -> tuple[Path, list[str]]:
    """Write a stop whose columns are called KX00, KX01, ...; return it, and the `--map` of all."""
    stop = sorted((STOPS / "runs").glob("*.csv"))[0]
    head, *lines = stop.read_text().splitlines()
    names = head.split(",")
    codes = [f"KX{number:02}" for number in range(len(names))]
    file = folder / "stop.csv"
    file.write_text("\n".join([",".join(codes), *lines]))
    short = [re.sub("_(m_s|rad_s|Nm|N)$", "", name) for name in names]
    maps = [f"--map={name}={code}" for name, code in zip(short, codes, strict=True)]
    return file, maps


def test_columns_are_mapped_by_names_without_units_and_their_kind_is_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, maps = a_stop_without_names(tmp_path)
    units = ("--unit", "vehicle_speed=m/s", "--unit", "wheel_speed=rad/s")
    out = tmp_path / "out"
    assert import_files(file, "--out", out, "--yes", "--json", *maps, *units) == cli.PASS
    result = json.loads(capsys.readouterr().out)
    assert result["kind"] == "braking_runs"
    load = next(one for one in result["channels"] if one["key"] == "wheel_load_1_N")
    # what is taken where neither the file nor the user gives a unit is said
    assert (load["unit"], load["unit_from"]) == ("N", "no unit in the file: the default")
    assert_same_stops(dataset.load(out).runs, dataset.load(STOPS).runs[:1])


def test_all_wrong_names_are_in_one_message_with_the_kind_that_has_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, maps = a_stop_without_names(tmp_path)
    call = (file, "--out", tmp_path / "out", "--yes")
    # without the torques they are no braking runs
    few = [one for one in maps if "torque" not in one]
    assert import_files(*call, *few) == cli.USAGE
    message = capsys.readouterr().err
    assert "vehicle_speed, " in message
    assert "wheel_load_4" in message
    assert "--kind braking_runs" in message

    assert import_files(*call, *maps, "--map=wheel_load_9=KX01", "--map=slip=KX01") == cli.USAGE
    message = capsys.readouterr().err
    assert "no channel wheel_load_9_N, slip;" in message
    assert "wheel_speed_1_rad_s .. wheel_speed_4_rad_s" in message

    assert import_files(*call, "--map=vehicle_speed=A", "--map=wheel_speed_1=B") == cli.USAGE
    message = capsys.readouterr().err
    assert "no column 'A'" in message
    assert "no column 'B'" in message


def assert_same_stops(imported: Any, expected: Any) -> None:
    assert len(imported) == len(expected)
    for run, original in zip(imported, expected, strict=True):
        for field in ("time_s", "speed_m_s", "wheel_speed_rad_s", "load_N", "torque_Nm"):
            np.testing.assert_allclose(
                getattr(run, field), getattr(original, field), rtol=1e-7, atol=1e-5
            )


def test_german_files_of_stops_give_the_same_arrays_as_the_dataset(tmp_path: Path) -> None:
    expected = dataset.load(STOPS).runs[:3]
    files = []
    for run in expected:
        files.append(tmp_path / f"{run.name}.csv")
        german_stop(STOPS / "runs" / f"{run.name}.csv", files[-1])
    out = tmp_path / "out"
    assert import_files(*files, "--out", out, "--yes") == cli.PASS
    imported = dataset.load(out)
    assert imported.sample_time_s == 0.01
    assert [run.group for run in imported.runs] == ["tune", "tune", "validate"]
    assert_same_stops(imported.runs, expected)


@pytest.mark.parametrize("suffix", [".parquet", ".mf4"])
def test_parquet_and_mdf_files_of_stops_are_imported(tmp_path: Path, suffix: str) -> None:
    expected = dataset.load(STOPS).runs[:1]
    table = pyarrow.csv.read_csv(STOPS / "runs" / f"{expected[0].name}.csv")
    file = tmp_path / f"stop{suffix}"
    if suffix == ".parquet":
        pyarrow.parquet.write_table(table, file)
    else:
        asammdf = pytest.importorskip("asammdf")
        with asammdf.MDF() as made:
            for key, (name, scale) in GERMAN.items():
                if key != "time_s":
                    unit = name.partition("[")[2].rstrip("]")
                    values = scale * table[key].to_numpy()
                    made.append(
                        asammdf.Signal(values, table["time_s"].to_numpy(), name=name, unit=unit)
                    )
            made.save(file, overwrite=True)
    assert import_files(file, "--out", tmp_path / "out", "--yes") == cli.PASS
    imported = dataset.load(tmp_path / "out").runs
    if suffix == ".mf4":  # its time counts from the first sample
        expected = [run._replace(time_s=run.time_s - run.time_s[0]) for run in expected]
    assert_same_stops(imported, expected)


# --- files of the field ---


def test_a_row_of_units_counts_and_the_report_shows_the_other_unit_of_the_key() -> None:
    data = recording.load(FIELD / "min_unit_row")
    assert any("unit 1/min in the file, but rad/s in the keys" in note for note in data.warnings)
    fastest_m_s = max(np.nanmax(channel.values) for channel in data.runs[0].channels.values())
    raw = np.loadtxt(FIELD / "min_unit_row" / "run.csv", delimiter=",", skiprows=2)
    assert fastest_m_s == pytest.approx(raw[:, 1:].max() * 2 * np.pi / 60 * 0.445)
    assert verdict.explain(data).verdict == "consistent"


def test_a_row_of_units_that_contradicts_a_given_unit_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(FIELD / "min_unit_row", tmp_path / "set")
    toml = tmp_path / "set" / "dataset.toml"
    given = 'wheel_speed_1_rad_s = { column = "n1", unit = "rad/s" }'
    toml.write_text(toml.read_text().replace('wheel_speed_1_rad_s = "n1"', given))
    assert cli.main(["explain", str(toml.parent), "--out", str(tmp_path / "r")]) == cli.USAGE
    assert "'1/min' in the file, but dataset.toml gives unit = 'rad/s'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("case", "note"),
    [
        ("rec_stamps_of_seconds", "spread evenly in between"),
        ("rec_excel_days", "days of a spreadsheet"),
    ],
)
def test_doubtful_stamps_are_read_with_a_note(case: str, note: str) -> None:
    data = recording.load(FIELD / case)
    assert any(note in warning for warning in data.warnings)
    for channel in data.runs[0].channels.values():
        assert channel.step_s == pytest.approx(0.1, rel=0.01)
    assert verdict.explain(data).verdict == "consistent"


def test_a_braking_run_in_latin_1_is_read() -> None:
    [run] = dataset.load(FIELD / "braking_latin1").runs
    assert run.time_s.size == 1912
    assert run.speed_m_s[0] == 30.0


# --- own exports ---


@pytest.fixture(scope="module")
def stops(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three stops of the bench on a plain track."""
    folder = tmp_path_factory.mktemp("stops")
    runs = []
    for speed_m_s in (12, 8, 10):
        runs.append(folder / f"from_{speed_m_s}")
        values = ("--set", "rig=plain_track", "--set", f"initial_speed_m_s={speed_m_s}")
        done = program.rollerrig("run", "velim_a1", "--pacing", "free", *values, "--out", runs[-1])
        assert done.status == cli.PASS, done.messages
    return runs


def test_an_exported_csv_is_a_file_of_a_dataset_as_it_is(stops: list[Path], tmp_path: Path) -> None:
    toml = 'kind = "braking_runs"\n'
    for run in stops[:2]:
        file = tmp_path / f"{run.name}.csv"
        assert cli.main(["export", str(run), "--format", "csv", "--out", str(file)]) == cli.PASS
        toml += f'[[run]]\nfile = "{file.name}"\n'
    (tmp_path / "dataset.toml").write_text(toml)
    run = dataset.load(tmp_path).runs[0]
    recorded = pyarrow.parquet.read_table(stops[0] / "channels.parquet")
    np.testing.assert_array_equal(run.speed_m_s, recorded["vehicle_speed_m_s"].to_numpy())
    np.testing.assert_array_equal(run.torque_Nm[:, 3], recorded["brake_torque_4_Nm"].to_numpy())

    out = tmp_path / "imported"
    assert import_files(tmp_path / "from_12.csv", "--out", out, "--yes") == cli.PASS
    assert_same_stops(dataset.load(out).runs, [run])


def test_runs_are_exported_as_a_dataset(
    stops: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "stops"
    command = ["export", *map(str, stops), "--format", "dataset", "--out", str(out)]
    capsys.readouterr()
    assert cli.main([*command, "--json"]) == cli.PASS
    assert json.loads(capsys.readouterr().out)["validate"] == ["from_10"]
    data = dataset.load(out)
    assert [run.name for run in data.runs] == ["from_12", "from_8", "from_10"]
    assert [run.name for run in data.group("validate")] == ["from_10"]

    assert cli.main(command) == cli.USAGE
    assert "is there already" in capsys.readouterr().err
    assert cli.main(command[:-2]) == cli.USAGE
    assert "needs the folder" in capsys.readouterr().err


def test_several_runs_cannot_be_exported_to_one_file(
    stops: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", *map(str, stops), "--format", "csv"]
    assert cli.main([*command, "--out", str(tmp_path / "a.csv")]) == cli.USAGE
    assert "each run gets its file" in capsys.readouterr().err
