"""Reads CSV and Parquet files of loggers as tables: columns of numbers or text, and their units."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute
import pyarrow.csv
import pyarrow.parquet

from rollerrig.configs import table, unpacking, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import csv_form, numbers, units

FILE_REMEDY = "correct `file` in dataset.toml"
MOST_COLUMNS = 10_000
MOST_TEXT_BYTES = 256_000_000  # of a column of texts
SEPARATORS = ("auto", ",", ";", "tab", "|", "blanks")
DECIMALS = ("auto", ".", ",")
AUTO = {"separator": "auto", "decimal": "auto"}
_BLOCK_BYTES = 16_000_000


class Table(NamedTuple):
    """The content of a file.

    data: one column for each column of the file that has a name, numbers or text; null is missing.
    units: text of the unit of a column, from a row of units or from the brackets in its name.
    first_line: line of the file that holds the first sample; 0 if the file has no lines.
    form: how the file is written, in words.
    notes: what was left out.
    """

    data: pa.Table
    units: dict[str, str]
    first_line: int
    form: str
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return list(self.data.column_names)

    def place(self, sample: int) -> str:
        """Return where a sample is in the file, in words."""
        if self.first_line:
            return f"line {self.first_line + sample}"
        return f"row {sample + 1}"


def read(path: Path, folder: Path | None, head: dict[str, Any] | None = None) -> Table:
    """Return the table of a CSV or Parquet file that belongs to a folder.

    `head` has the keys `separator` and `decimal` of dataset.toml; by default both are found in the
    file. Raises ConfigError.
    """
    head = head or AUTO
    if path.suffix.lower() == ".parquet":
        try:
            data = _read_parquet(path, folder)
        except (pa.ArrowInvalid, ValueError, OSError) as error:
            raise ConfigError(f"{path}: cannot be read as a table: {error}") from None
        data = _without_codes(data, head.get("missing", ()))
        return Table(data, _units_of_names(data.column_names), 0, "Parquet")
    content = user_files.read_bytes(path, user_files.CSV, folder, FILE_REMEDY)
    missing = head.get("missing", ())
    return parse_csv(path, content, head["separator"], head["decimal"], missing)


def take_missing(content: dict[str, Any], where: str) -> tuple[str, ...]:
    """Take the key `missing` out of dataset.toml: values of a file that mean there is none.

    Raises ConfigError unless it is a list of numbers and texts.
    """
    given = content.pop("missing", [])
    is_list = isinstance(given, list)
    if not is_list or not all(type(value) in (int, float, str) for value in given):
        raise ConfigError(
            f"{where}: missing = {given!r} is no list of values; write the values that mean that there "
            'is none, as missing = [65535, "n.v."]'
        )
    return tuple(str(value) for value in given)


def _without_codes(data: pa.Table, missing: Sequence[str]) -> pa.Table:
    """Return a table without the values that mean that there is none."""
    for place, name in enumerate(data.column_names):
        if not missing:
            break
        values = data.column(place)
        is_none = np.zeros(len(values), bool)
        is_text = pa.types.is_string(values.type) or pa.types.is_large_string(values.type)
        for code in missing:
            if is_text:
                texts = pyarrow.compute.utf8_trim_whitespace(values)
                equal = pyarrow.compute.equal(texts, code).fill_null(False)
                is_none |= equal.to_numpy()
            elif numbers.is_number(code) and pa.types.is_primitive(values.type):
                floats = values.cast(pa.float64(), safe=False).fill_null(np.nan).to_numpy()
                is_none |= floats == float(code)
        if is_none.any():
            nothing = pa.scalar(None, values.type)
            kept = pyarrow.compute.if_else(pa.array(~is_none), values, nothing)
            data = data.set_column(place, name, kept)
    return data


def parse_csv(
    path: Path,
    content: bytes,
    separator: str = "auto",
    decimal: str = "auto",
    missing: Sequence[str] = (),
) -> Table:
    """Return the table of the content of a CSV file. `path` is for messages.

    `missing` are cells that mean that there is no value. Raises ConfigError.
    """
    text, encoding = csv_form.decode(path, content)
    form = csv_form.find(path, text, encoding, separator)
    check_columns(path, len(form.names))

    samples = _from_line(text, form.first_line)
    separator = form.separator
    if separator == csv_form.BLANKS:
        samples = re.sub(r"[ \t]+", "\t", re.sub(r"(?m)^[ \t]+|[ \t]+$", "", samples))
        separator = "\t"
    texts, notes = _read_cells(path, samples, separator, form)
    texts, repeated = _without_repeated_names(texts, form)
    notes += repeated
    texts = _without_codes(texts, missing)

    kept = []
    for place, name in enumerate(form.names):
        if name:
            kept.append(place)
        elif _has_values(texts.column(place)):
            # a trailing separator makes an empty column; any other column needs a name to be read
            notes.append(f"column {place + 1} has values but no name, and is not read")
    names = tuple(form.names[place] for place in kept)
    columns = numbers.columns(
        path, names, [texts.column(place) for place in kept], separator, decimal
    )
    found_units = _units_of_names(list(names))
    for place in kept:
        if form.units[place]:
            found_units[form.names[place]] = form.units[place]
    return Table(
        data=pa.Table.from_arrays(columns, names=list(names)),
        units=found_units,
        first_line=form.first_line,
        form=form.description(),
        notes=tuple(notes),
    )


def _from_line(text: str, line: int) -> str:
    """Return a text from a line on; the first line is 1."""
    begin = 0
    for _ in range(line - 1):
        begin = text.index("\n", begin) + 1
    return text[begin:]


def _has_values(column: pa.ChunkedArray) -> bool:
    """Return whether a column of text has a cell that is not empty."""
    stripped = pyarrow.compute.utf8_trim_whitespace(column)
    return bool(pyarrow.compute.any(pyarrow.compute.not_equal(stripped, "")).as_py())


def _read_cells(
    path: Path, samples: str, separator: str, form: csv_form.Form
) -> tuple[pa.Table, list[str]]:
    """Return the cells of the samples as text, and notes. Raises ConfigError.

    Lines with another number of cells are left out at the end of the file, where a logger that was
    switched off leaves half a line, and other programs write sums. Elsewhere they are an error.
    """
    width = len(form.names)
    names = [str(place) for place in range(width)]
    bad: list[Any] = []

    def keep(row: Any) -> str:
        bad.append(row)
        return "skip"

    try:
        cells = pyarrow.csv.read_csv(
            pa.BufferReader(samples.encode("utf-8", "surrogatepass")),
            # the number of a bad line is known only without threads
            pyarrow.csv.ReadOptions(column_names=names, use_threads=False, block_size=_BLOCK_BYTES),
            pyarrow.csv.ParseOptions(delimiter=separator, invalid_row_handler=keep),
            pyarrow.csv.ConvertOptions(
                column_types={name: pa.string() for name in names}, strings_can_be_null=False
            ),
        )
    except (pa.ArrowInvalid, ValueError) as error:
        raise ConfigError(
            f"{path}: cannot be read as a table: {error}; the separator is taken as {separator!r}; "
            "write separator and decimal in dataset.toml if this is wrong"
        ) from None

    notes = []
    total = len(cells) + len(bad)
    at_end = 0
    while at_end < len(bad) and bad[-1 - at_end].number == total - at_end:
        at_end += 1
    if at_end < len(bad):
        row = bad[0]
        raise ConfigError(
            f"{path}: line {form.first_line + row.number - 1} has {row.actual_columns} cells, but "
            f"{width} are needed; the separator is taken as {separator!r}; correct the line, or "
            "write separator in dataset.toml"
        )
    if at_end:
        notes.append(f"the last {at_end} lines are incomplete and left out")
    return cells, notes


def _without_repeated_names(cells: pa.Table, form: csv_form.Form) -> tuple[pa.Table, list[str]]:
    """Return the cells without lines that repeat names or units, and notes.

    A logger that begins anew writes its head into the middle of the file.
    """
    is_sample = np.ones(len(cells), bool)
    for head in (form.names, form.units):
        if not any(head):
            continue
        is_head = np.ones(len(cells), bool)
        for place, name in enumerate(head):
            column = pyarrow.compute.utf8_trim(cells.column(place), " \t#%")
            is_head &= pyarrow.compute.equal(column, name.strip(" #%")).to_numpy()
            if not is_head.any():
                break
        is_sample &= ~is_head
    lines = form.first_line + np.flatnonzero(~is_sample)
    if not lines.size:
        return cells, []
    note = f"line {lines[0]} repeats the head of the file and is left out"
    if lines.size > 1:
        note = f"lines {lines[0]} to {lines[-1]}: {lines.size} of them repeat the head of the file and are left out"
    return cells.filter(pa.array(is_sample)), [note]


def _units_of_names(names: list[str]) -> dict[str, str]:
    """Return the units that names have in brackets, by the name."""
    found = {}
    for name in names:
        unit = units.split(name).unit
        if unit:
            found[name] = unit
    return found


def check_columns(path: Path, count: int) -> None:
    """Raise ConfigError if a file has more columns than are allowed."""
    if count > MOST_COLUMNS:
        raise ConfigError(
            f"{path}: has {count} columns; at most {MOST_COLUMNS} are allowed: leave out what is not "
            "needed"
        )


def _read_parquet(path: Path, folder: Path | None) -> pa.Table:
    """Return the table of a Parquet file. Raises ConfigError, and what pyarrow raises."""
    user_files.check(path, user_files.PARQUET, folder, FILE_REMEDY)
    metadata = pyarrow.parquet.read_metadata(path)
    check_columns(path, metadata.num_columns)
    unpacking.check_parquet(path, metadata)

    texts = unpacking.text_columns(metadata)
    data = pyarrow.parquet.ParquetFile(path, read_dictionary=texts).read()
    for place, name in enumerate(data.column_names):
        values = data.column(place)
        if pa.types.is_dictionary(values.type):
            _check_text_size(path, name, values)
            data = data.set_column(place, name, values.cast(values.type.value_type))
    return data


def _check_text_size(path: Path, name: str, values: pa.ChunkedArray) -> None:
    """Raise ConfigError if a column of texts, read as dictionary, is too large as texts."""
    size = 0
    for chunk in values.chunks:
        lengths = pyarrow.compute.binary_length(chunk.dictionary)
        size += pyarrow.compute.sum(lengths.take(chunk.indices)).as_py() or 0
    if size > MOST_TEXT_BYTES:
        raise ConfigError(
            f"{path}: the texts of column '{name}' need {size / 1e6:.4g} MB; at most "
            f"{MOST_TEXT_BYTES / 1e6:.4g} MB are allowed: leave the column out"
        )


def check_column(path: Path, name: str, names: list[str]) -> None:
    """Raise ConfigError unless a name is there exactly once."""
    count = names.count(name)
    if count == 0:
        raise ConfigError(
            f"{path}: column '{name}' is missing{table.nearest(name, names, 'The file has')}; name "
            "it in dataset.toml as `column` in [channels], the column of the stamps under time_s"
        )
    if count > 1:
        raise ConfigError(
            f"{path}: column '{name}' is there {count} times; keep one, or give each column a "
            "different name"
        )
