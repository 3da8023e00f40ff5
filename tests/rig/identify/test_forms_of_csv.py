"""A recording written in any form that loggers write gives the same numbers, or is refused.

The forms are written here by hand, without code of the reader.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import channels, csv_form, stamps, tables, units
from rollerrig.rig.identify.files.channels import Source

N = 60
T_S = np.arange(N) * 0.1
SPEED_KM_H = 83.5 - np.arange(N) * 0.55
TURNS = 512.25 - np.arange(N) * 3.5
NAMES = ("Zeit", "v_Fzg", "n_Rad1")
UNITS = ("s", "km/h", "1/min")


class Form(NamedTuple):
    """How the recording is written."""

    separator: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    end: str = "\n"
    above: str = ""  # lines above the names
    names: tuple[str, ...] = NAMES
    units: tuple[str, ...] = ()  # a row of units
    behind: str = ""  # behind each line
    below: str = ""  # lines below the samples
    quoted: bool = False
    digits: int = 2
    again: int = 0  # the head is repeated after so many samples


BRACKETS = ("Zeit [s]", "v_Fzg [km/h]", "n_Rad1 [1/min]")
FORMS = {
    "comma": Form(),
    "semicolon": Form(separator=";"),
    "tab": Form(separator="\t"),
    "bar": Form(separator="|"),
    "blanks": Form(separator="   "),
    "German": Form(separator=";", decimal=",", names=BRACKETS),
    "German with tabs": Form(separator="\t", decimal=",", names=BRACKETS),
    "quoted, with decimal commas": Form(decimal=",", quoted=True),
    "three digits behind a decimal comma": Form(separator=";", decimal=",", digits=3),
    "row of units": Form(units=UNITS),
    "row of units in brackets": Form(separator=";", units=("[s]", "[km/h]", "[1/min]")),
    "units behind a slash": Form(names=("Zeit / s", "v_Fzg / km/h", "n_Rad1 / 1/min")),
    "UTF-8 with mark": Form(encoding="utf-8-sig", names=("Zeit", "v_Züg", "n_Rad1")),
    "UTF-16 with mark": Form(separator="\t", encoding="utf-16"),
    "UTF-16 without mark": Form(separator="\t", encoding="utf-16-le"),
    "UTF-16, high byte first": Form(separator=";", encoding="utf-16-be"),
    "Latin-1": Form(encoding="latin-1", above="Prüfstelle Köln\n"),
    "Windows-1252": Form(encoding="cp1252", above="Gebühr 5 €\n"),
    "ends of Windows": Form(end="\r\n"),
    "ends of old Macs": Form(separator=";", end="\r"),
    "sep= line": Form(separator=";", above="sep=;\n"),
    "preamble": Form(
        separator=";",
        decimal=",",
        above="Logger X200\nSeriennummer;12345\nStart;01.03.2026 10:00:00\n\n",
        units=UNITS,
    ),
    "preamble padded by a spreadsheet": Form(
        separator=";", decimal=",", above="Fahrt;Probefahrt;\nNummer;17;\n;;\n"
    ),
    "comments": Form(above="# logger X200\n# run, 17, dry\n"),
    "names in a comment": Form(names=("# Zeit", "v_Fzg", "n_Rad1")),
    "trailing separators": Form(separator=";", decimal=",", behind=";"),
    "quoted": Form(quoted=True, names=("Zeit", "v_Fzg\n[km/h]", "n_Rad1, vorne")),
    "half a last line": Form(below="6.0,8"),
    "zeros of a full disk": Form(below="\0\0\0\0"),
    "exponents": Form(digits=-1),
    "names again in the middle": Form(separator=";", decimal=",", again=20),
    "names and units again in the middle": Form(separator=";", units=UNITS, again=20),
    "sums at the end": Form(separator=";", below="Ende\n"),
}


def number(value: float, form: Form) -> str:
    """Return a number as it is written in a form."""
    text = f"{value:.6e}" if form.digits < 0 else f"{value:.{form.digits}f}"
    text = text.replace(".", form.decimal)
    return f'"{text}"' if form.quoted else text


def written(form: Form, columns: tuple[np.ndarray, ...] = (T_S, SPEED_KM_H, TURNS)) -> bytes:
    """Return the recording as bytes."""
    names = [f'"{name}"' if form.quoted else name for name in form.names]
    rows = [names]
    if form.units:
        rows.append(list(form.units))
    samples = [[number(value, form) for value in row] for row in zip(*columns, strict=True)]
    if form.again:
        samples = samples[: form.again] + rows + samples[form.again :]
    rows = rows + samples
    text = form.above
    text += "".join(form.separator.join(row) + form.behind + "\n" for row in rows)
    text += form.below
    return text.replace("\n", form.end).encode(form.encoding)


def parsed(content: bytes, **head: Any) -> tables.Table:
    return tables.parse_csv(Path("run.csv"), content, **head)


def column(table: tables.Table, name: str) -> np.ndarray:
    return channels.values(Path("run.csv"), table, name)


def test_names_in_the_middle_are_left_out_with_a_note() -> None:
    table = parsed(written(FORMS["names again in the middle"]))
    assert table.notes == ("line 22 repeats the head of the file and is left out",)


def test_values_that_dataset_toml_calls_missing_are_none() -> None:
    speed = SPEED_KM_H.copy()
    speed[7] = 65535.0
    content = written(Form(digits=1), (T_S, speed, TURNS))
    text = content.decode().replace("512.2\n", "n.v.\n", 1).encode()
    table = parsed(text, missing=("65535.0", "n.v."))
    assert np.flatnonzero(np.isnan(column(table, "v_Fzg"))).tolist() == [7]
    assert np.flatnonzero(np.isnan(column(table, "n_Rad1"))).tolist() == [0]


def test_missing_that_is_no_list_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"no list of values.*missing = \[65535"):
        tables.take_missing({"missing": "65535"}, "dataset.toml")


@pytest.mark.parametrize("form", FORMS.values(), ids=list(FORMS))
def test_a_recording_in_any_form_gives_the_same_numbers(form: Form) -> None:
    table = parsed(written(form))
    assert len(table.names) == 3
    for name, values in zip(table.names, (T_S, SPEED_KM_H, TURNS), strict=True):
        np.testing.assert_allclose(column(table, name), np.round(values, 3), rtol=0, atol=1e-6)
    names = [" ".join(name.replace("# ", "").split()) for name in form.names]
    assert table.names == names
    if form.units:
        assert table.units == dict(zip(NAMES, UNITS, strict=True))


def test_the_line_of_a_sample_is_known_below_a_preamble() -> None:
    table = parsed(written(FORMS["preamble"]))
    assert table.place(0) == "line 7"
    assert table.place(3) == "line 10"


# --- what is ambiguous ---


def three(*values: str, separator: str = ";", name: str = "v", other: str = "") -> bytes:
    """Return a file with stamps in whole seconds, these values, and another column."""
    lines = [separator.join(["t", name, "x"])]
    for second, value in enumerate(values):
        lines.append(separator.join([str(second), value, other or str(second)]))
    return "\n".join(lines).encode()


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        # the separator decides
        (three("1,234", "2,345"), [1.234, 2.345]),
        (three("1.234", "2.345", separator=","), [1.234, 2.345]),
        # a value of the column decides
        (three("1,234", "0,345"), [1.234, 0.345]),
        (three("1.234", "2.3456"), [1.234, 2.3456]),
        (three("1.234,5", "999,5"), [1234.5, 999.5]),
        (three("1,234.5", "999.5"), [1234.5, 999.5]),
        (three("1,234,567", "2,345,678.5"), [1234567, 2345678.5]),
        (three('"1,234.5"', '"999.5"', separator=","), [1234.5, 999.5]),
        # another column decides
        (three("1,234", "2,345", separator="\t", other="0,5"), [1.234, 2.345]),
        (three("1.234", "2.345", other="0.5"), [1.234, 2.345]),
        # other marks of thousands
        (three("1'234.5", "999.5"), [1234.5, 999.5]),
        (three("1 234,5", "999,5"), [1234.5, 999.5]),
        (three("1\u00a0234,5", "999,5"), [1234.5, 999.5]),
        (three("+1.5", "-2.5"), [1.5, -2.5]),
        (three(".5", "5."), [0.5, 5.0]),
        (three("true", "false"), [1.0, 0.0]),
        (three("EIN", "AUS"), [1.0, 0.0]),
        (three("#NV", "1,5", "-", "n/a", ""), [np.nan, 1.5, np.nan, np.nan, np.nan]),
    ],
)
def test_decimal_marks_and_thousands_are_read_as_what_decides_says(
    content: bytes, expected: list[float]
) -> None:
    np.testing.assert_array_equal(column(parsed(content), "v"), expected)


@pytest.mark.parametrize(
    ("content", "first", "second"),
    [
        (three("1,234", "2,345", separator="\t"), "1.234", "1234"),
        (three("1.234", "2.345"), "1.234", "1234"),
        (three('"1,234"', '"2,345"', separator=","), "1.234", "1234"),
        # thousands are never assumed, whatever the other columns show
        (three("1.234", "2.345", other="0,5"), "1.234", "1234"),
        (three("1,234", "2,345", other="0.5"), "1.234", "1234"),
    ],
)
def test_an_ambiguous_column_is_refused_with_both_readings(
    content: bytes, first: str, second: str
) -> None:
    with pytest.raises(ConfigError, match=rf"'v' is ambiguous.* is {first} .* and {second} "):
        parsed(content)


def test_a_stated_decimal_mark_decides() -> None:
    content = three("1,234", "2,345", separator="\t")
    np.testing.assert_array_equal(column(parsed(content, decimal=","), "v"), [1.234, 2.345])
    np.testing.assert_array_equal(column(parsed(content, decimal="."), "v"), [1234, 2345])


# --- what is refused ---


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (written(Form(decimal=",")), "comma is both the separator and the decimal mark"),
        (b"0.0,1.0\n0.1,2.0\n0.2,3.0\n", "line 1 holds values already.*names"),
        (b"a\n1\n2\n3\n", "no separator"),
        (b"t,v\n1,2\n", "2 lines"),
        (b"t,v\n1,2\n2,3\n3,4,5\n4,5\n", "line 4 has 3 cells, but 2 are needed"),
        (bytes(range(256)) * 4, "is not text"),
        (b"PK\x03\x04" + bytes(200), "save the sheet as CSV"),
        (b"", "0 lines"),
    ],
)
def test_a_file_in_no_form_is_refused_with_the_reason(content: bytes, message: str) -> None:
    with pytest.raises(ConfigError, match=rf"run\.csv: .*({message})"):
        parsed(content)


@pytest.mark.parametrize("text", ["broken", "e5", "+", ".", "1.2.3", "0x1F"])
def test_text_among_numbers_is_shown_where_it_is(text: str) -> None:
    with pytest.raises(ConfigError, match="'v' is not all numbers: sample 2 is") as error:
        column(parsed(three("1.5", text, "2.5", "3.5")), "v")
    assert repr(text) in str(error.value)


# --- units ---


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("Zeit [s]", ("Zeit", "s")),
        ("v_Fzg [km/h]", ("v_Fzg", "km/h")),
        ("n_Rad1 [1/min]", ("n_Rad1", "1/min")),
        ("Bremszylinderdruck 1 [bar]", ("Bremszylinderdruck 1", "bar")),
        ("wheel speed FL (m/s)", ("wheel speed FL", "m/s")),
        ("Time (sec)", ("Time", "sec")),
        ("v / km/h", ("v", "km/h")),
        ("speed (front)", ("speed (front)", "")),
        ("wheel (1)", ("wheel (1)", "")),
    ],
)
def test_the_unit_in_a_name_is_found(name: str, parts: tuple[str, str]) -> None:
    assert units.split(name) == parts


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("[km/h]", "km/h"),
        ("kmh", "km/h"),
        ("RPM", "1/min"),
        ("U/min", "1/min"),
        ("N*m", "Nm"),
        ("mS", "ms"),
        ("kN", "kN"),
        ("1/s", None),
        ("MN", None),
    ],
)
def test_spellings_of_a_unit_are_the_same_unit(text: str, unit: str | None) -> None:
    found = units.find(text)
    assert (found.name if found else None) == unit


@pytest.mark.parametrize(
    ("given", "found", "factor"),
    [
        ("", "", 1.0),
        ("1/min", "", 2 * np.pi / 60),
        ("", "1/min", 2 * np.pi / 60),
        ("rpm", "1/min", 2 * np.pi / 60),
        ("", "km/h", 1 / 3.6 / 0.46),
        ("rev/s", "1/s", 2 * np.pi),
        ("", "1/s", 1.0),  # the key decides
    ],
)
def test_a_wheel_speed_in_any_unit_becomes_rad_s(given: str, found: str, factor: float) -> None:
    got = channels.factor(
        Path("run.csv"), Source("n1", given), "wheel_speed_1_rad_s", "rad/s", found, 0.46
    )
    assert got == pytest.approx(factor, rel=1e-12)


@pytest.mark.parametrize(
    ("given", "found", "message"),
    [
        ("km/h", "m/s", "'m/s' in the file, but dataset.toml gives unit = 'km/h'"),
        ("", "bar", "'bar', which is no unit of"),
        ("", "furlong", "'furlong' in the file, which is not known"),
        ("", "1/s", "rad/s or turns a second"),
    ],
)
def test_units_that_contradict_are_refused(given: str, found: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        channels.factor(Path("run.csv"), Source("v", given), "wheel_speed_1_m_s", "m/s", found, 0.4)


# --- stamps ---


def read_stamps(*texts: str, unit: str = "") -> stamps.Stamps:
    """Return the stamps of a file with these texts as stamps."""
    lines = ["t;v", *(f"{text};{number}.5" for number, text in enumerate(texts))]
    table = parsed("\n".join(lines).encode())
    return channels.seconds(Path("run.csv"), table, Source("t", unit))


@pytest.mark.parametrize(
    "texts",
    [
        ("0.0", "0.25", "0.5"),
        ("2026-03-29 10:00:00.00", "2026-03-29 10:00:00.25", "2026-03-29 10:00:00.50"),
        ("2026-03-29 10:00:00", "2026-03-29 10:00:00.25", "2026-03-29 10:00:00.5"),
        ("2026-03-29T10:00:00,00", "2026-03-29T10:00:00,25", "2026-03-29T10:00:00,50"),
        ("2026-03-29T10:00:00.00Z", "2026-03-29T10:00:00.25Z", "2026-03-29T10:00:00.50Z"),
        ("2026-03-29 10:00:00.0+02:00", "2026-03-29 10:00:00.25+02:00", "2026-03-29 08:00:00.5Z"),
        ("2026/03/29 10:00:00,0", "2026/03/29 10:00:00,25", "2026/03/29 10:00:00,5"),
        ("29.03.2026 10:00:00,000", "29.03.2026 10:00:00,250", "29.03.2026 10:00:00,500"),
        ("29.3.26 10:00:00.000", "29.3.26 10:00:00.250", "29.3.26 10:00:00.500"),
        ("29/03/2026 10:00:00.0", "29/03/2026 10:00:00.25", "29/03/2026 10:00:00.5"),
        ("03/29/2026 11:59:59.75 AM", "03/29/2026 12:00:00.00 PM", "03/29/2026 12:00:00.25 PM"),
        # the order of day and month does not matter within a date
        ("03/04/2026 10:00:00.0", "03/04/2026 10:00:00.25", "03/04/2026 10:00:00.5"),
        ("10:00:00.0", "10:00:00.25", "10:00:00.5"),
        ("10:00:00:000", "10:00:00:250", "10:00:00:500"),
        ("23:59:59,75", "00:00:00,00", "00:00:00,25"),
    ],
)
def test_stamps_of_any_form_are_the_same_seconds(texts: tuple[str, ...]) -> None:
    time_s = read_stamps(*texts).time_s
    np.testing.assert_allclose(time_s - time_s[0], [0.0, 0.25, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("unit", "second"),
    [("s", 1), ("ms", 1000), ("us", 10**6), ("ns", 10**9), ("min", 1 / 60), ("d", 1 / 86400)],
)
@pytest.mark.parametrize("start_s", [0, 1774778400])
def test_stamps_count_in_any_unit_since_any_moment(unit: str, second: float, start_s: int) -> None:
    texts = [repr((start_s + number) * second) for number in range(5)]
    time_s = read_stamps(*texts, unit=unit).time_s
    np.testing.assert_allclose(np.diff(time_s), 1.0, atol=1e-5)


def test_a_date_whose_day_and_month_nothing_decides_is_refused_with_both_readings() -> None:
    with pytest.raises(ConfigError, match="day 03 of month 04, or day 04 of month 03"):
        read_stamps("03/04/2026 10:00:00", "03/05/2026 10:00:00")
    # a later date decides
    time_s = read_stamps("03/04/2026 10:00:00", "03/31/2026 10:00:00").time_s
    assert np.diff(time_s) == pytest.approx(27 * 86400)


def test_days_of_a_spreadsheet_become_seconds_with_a_note() -> None:
    days = [f"{46082.41666 + number * 0.1 / 86400:.10f}" for number in range(50)]
    found = read_stamps(*days)
    np.testing.assert_allclose(np.diff(found.time_s), 0.1, atol=1e-4)
    assert "days of a spreadsheet" in found.notes[0]


def test_samples_closer_than_those_of_a_vehicle_are_refused_with_the_units() -> None:
    with pytest.raises(ConfigError, match=r"1e-06 s apart if its unit is s.*s, ms, us, ns"):
        read_stamps(*[f"{number * 1e-6:.7f}" for number in range(50)])


def test_samples_in_the_same_second_are_spread_in_it() -> None:
    # the recording begins and ends within a second
    moments_s = 0.6 + np.arange(96) / 10
    found = read_stamps(*[f"2026-03-01 10:00:{int(moment):02d}" for moment in moments_s])
    np.testing.assert_allclose(found.time_s - found.time_s[0], np.arange(96) / 10, atol=1e-6)
    assert "whole multiples of 1 s with about 10 samples" in found.notes[0]


def test_samples_in_the_same_second_are_refused_if_their_number_changes() -> None:
    seconds = [*[0] * 10, *[1] * 10, *[2] * 3, *[3] * 10, *[4] * 10]
    with pytest.raises(ConfigError, match="several samples each, usually 10, but 3 at sample 21"):
        read_stamps(*map(str, seconds))


def test_a_large_file_is_read_in_the_time_of_its_size() -> None:
    # only a reader that looks at each value many times would not finish
    rows = 200_000
    lines = ["Zeit;v1;v2"]
    lines += [f"{number / 100:.2f};{number % 97},5;{number % 89},25".replace(".", ",") for number
              in range(rows)]  # fmt: skip
    table = parsed("\n".join(lines).encode())
    assert len(table.data) == rows
    assert column(table, "v2")[1] == 1.25


def test_the_form_is_described_in_words() -> None:
    text, encoding = csv_form.decode(Path("run.csv"), written(FORMS["preamble"]))
    form = csv_form.find(Path("run.csv"), text, encoding)
    assert form.description() == (
        "utf-8, separator semicolon, names in line 5, then a row of units"
    )
