"""Finds the form of a CSV file: encoding, separator, lines above the names, names and units.

Loggers and spreadsheets write many forms. The rules:

- Encoding: a byte order mark decides. Without one, text with zeros in every second byte is UTF-16,
  then UTF-8 is tried, and then Windows-1252 and Latin-1.
- Separator: a line "sep=;" at the top decides. Otherwise it is the first one of tab, semicolon, bar
  and comma that divides nearly all lines in the same number of cells. The comma is last, because it
  may be the decimal mark of a file with semicolons. Columns may also be aligned with blanks.
- Names: the first line that has as many cells as the samples, no numbers, and only a row of units
  or empty lines between it and the samples. All lines above it are a preamble.
- Units: the line below the names, if it has a unit of time or if at least half of its cells are
  units.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.files import units

SEPARATORS = ("\t", ";", "|", ",")
BLANKS = "blanks"  # columns that are aligned with blanks
_NAMES_OF_SEPARATORS = {"\t": "tab", ";": "semicolon", "|": "bar", ",": "comma"}

_HEAD_LINES = 600  # the form is found in so many lines
_SAME_WIDTH_SHARE = 0.8  # of the lines, if a separator is right
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # it begins as the mark of UTF-16
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# the first bytes of xlsx and other archives, and of xls
_WORKBOOKS = (b"PK\x03\x04", b"\xd0\xcf\x11\xe0")
_SEP_LINE = re.compile(r'"?sep=(.)"?[;,\t|"]*', re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?(\d[\d.,'\u2019\u00a0\u202f ]*|[.,]\d+)([eE][-+]?\d+)?")
_STAMP = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{1,4}([ T].*)?|\d{1,2}:\d{2}.*")
# cells without a value
MISSING = frozenset(
    (
        *("", "-", "--", "---", "?", "nan", "-nan", "na", "n/a", "#n/a", "#na", "null", "none"),
        *("#nv", "#wert!", "#value!", "#div/0!", "1.#qnan", "1.#ind", "-1.#ind"),
        *("invalid", "ungültig"),
    )
)


class Form(NamedTuple):
    """The form of a CSV file.

    separator: the character between cells, or BLANKS.
    names: of the columns, in the order of the file; a column without a name has the name "".
    units: text of the unit of each column from a row of units; "" where there is none.
    names_line: number of the line of the names, the first line of the file is 1.
    first_line: number of the line of the first sample.
    """

    encoding: str
    separator: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    names_line: int
    first_line: int

    def description(self) -> str:
        """Return the form in words."""
        separator = _NAMES_OF_SEPARATORS.get(self.separator, self.separator)
        text = f"{self.encoding}, separator {separator}, names in line {self.names_line}"
        if any(self.units):
            text += ", then a row of units"
        return text


class _Record(NamedTuple):
    """The cells of a line, and the number of its first line in the file."""

    line: int
    next_line: int
    cells: list[str]


def decode(path: Path, content: bytes) -> tuple[str, str]:
    """Return (text, encoding) of the content of a file; all ends of lines become "\\n".

    Raises ConfigError if the content is not text.
    """
    if content.startswith(_WORKBOOKS):
        raise ConfigError(
            f"{path}: is a workbook of a spreadsheet or an archive; save the sheet as CSV, in Excel "
            "as 'CSV UTF-8'"
        )
    encoding = _encoding(content)
    text = user_files.decode(path, content, encoding)
    # a logger that was switched off may leave zeros at the end
    text = text.rstrip("\0").removeprefix("\ufeff")
    if "\0" in text:
        raise ConfigError(f"{path}: is not text, it has bytes of zero; give a CSV file")
    if encoding == "utf-8-sig":
        encoding = "utf-8"
    return text, encoding


def _encoding(content: bytes) -> str:
    """Return the encoding of the content of a file."""
    for mark, encoding in _MARKS:
        if content.startswith(mark):
            return encoding
    begin = content[:2000]
    if begin and begin[1::2].count(0) > 0.4 * len(begin[1::2]) and begin[::2].count(0) == 0:
        return "utf-16-le"
    if begin and begin[::2].count(0) > 0.4 * len(begin[::2]) and begin[1::2].count(0) == 0:
        return "utf-16-be"
    for encoding in ("utf-8", "cp1252"):
        try:
            content.decode(encoding)
        except UnicodeDecodeError:
            continue
        return encoding
    return "latin-1"


def find(path: Path, text: str, encoding: str, separator: str = "auto") -> Form:
    """Return the form of the text of a CSV file.

    `separator` is "auto", "tab" or the character itself. Raises ConfigError with the reason if no
    line of names fits the samples.
    """
    lines = _first_lines(text)
    if len([line for line in lines if line.strip()]) < 3:
        raise ConfigError(
            f"{path}: the file has {len(lines)} lines; it needs a line of names and one line for "
            "each sample"
        )
    skipped = 0
    marked = _SEP_LINE.fullmatch(lines[0].strip(" \n"))
    if marked:
        skipped = 1
    if separator == "tab":
        separator = "\t"
    elif separator == "auto" and marked:
        separator = marked[1]
    elif separator == "auto":
        separator = _find_separator(path, lines)

    records = list(_records(lines[skipped:], separator, skipped))
    width = _usual_width(records)
    return _find_names(path, records, width, encoding, separator)


def _first_lines(text: str) -> list[str]:
    """Return the first lines of a text, with their ends."""
    lines: list[str] = []
    begin = 0
    while begin < len(text) and len(lines) < _HEAD_LINES:
        end = text.find("\n", begin)
        end = len(text) if end < 0 else end + 1
        lines.append(text[begin:end])
        begin = end
    return lines


def _records(lines: list[str], separator: str, skipped: int = 0) -> Iterator[_Record]:
    """Yield the cells of lines; a cell in quotes may have ends of lines."""
    if separator == BLANKS:
        for number, line in enumerate(lines, start=skipped + 1):
            yield _Record(number, number + 1, line.split())
        return
    reader = csv.reader(lines, delimiter=separator)
    begin = 0
    while True:
        try:
            cells = next(reader)
        except StopIteration:
            return
        except csv.Error:  # a cell of more than 128 kB
            cells = []
        yield _Record(skipped + begin + 1, skipped + reader.line_num + 1, cells)
        begin = reader.line_num


def _find_separator(path: Path, lines: list[str]) -> str:
    """Return the separator that divides lines in the same number of cells. Raises ConfigError."""
    for separator in (*SEPARATORS, BLANKS):
        records = [record for record in _records(lines, separator) if record.cells]
        width = _usual_width(records)
        last = records[len(records) // 2 :]
        same = sum(width - 1 <= len(record.cells) <= width + 1 for record in last)
        if width > 1 and same > _SAME_WIDTH_SHARE * len(last):
            return separator
    raise ConfigError(
        f"{path}: no separator divides its lines in the same number of cells; tried: tab, "
        "semicolon, bar, comma, blanks. Save it as CSV with one line of names and one line for "
        "each sample"
    )


def _usual_width(records: list[_Record]) -> int:
    """Return the most frequent number of cells in the second half of the records."""
    widths = [len(record.cells) for record in records if record.cells]
    counts = Counter(widths[len(widths) // 2 :])
    return counts.most_common(1)[0][0] if counts else 0


def is_missing(cell: str) -> bool:
    """Return whether a cell holds no value."""
    return cell.strip().lower() in MISSING


def is_value(cell: str) -> bool:
    """Return whether a cell looks like a number or a stamp."""
    cell = cell.strip()
    return bool(_NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell))


def _is_sample(record: _Record, of_values: list[int]) -> bool:
    """Return whether most of the columns that hold values have a value in a record.

    `of_values` are the places of the columns that hold values.
    """
    cells = [record.cells[place] for place in of_values if place < len(record.cells)]
    filled = [cell for cell in cells if not is_missing(cell)]
    values = sum(map(is_value, filled))
    return values > 0 and 2 * values > len(filled)


def _are_names(cells: list[str], width: int) -> bool:
    """Return whether cells can be the names of as many columns."""
    while cells and not cells[-1].strip():
        cells = cells[:-1]
    filled = [cell for cell in cells if cell.strip()]
    if not width - 1 <= len(cells) <= width or 2 * len(filled) < width:
        return False
    return not any(is_value(cell) for cell in filled)


def are_units(cells: list[str]) -> bool:
    """Return whether cells are a row of units."""
    filled = [cell for cell in cells if cell.strip()]
    found = [units.find(cell) for cell in filled]
    has_time = any(unit is not None and unit.quantity == units.TIME for unit in found)
    known = sum(map(units.is_unit, filled))
    return bool(filled) and (has_time or 2 * known >= len(filled))


def _find_names(
    path: Path, records: list[_Record], width: int, encoding: str, separator: str
) -> Form:
    """Return the form with the first line of names that samples follow. Raises ConfigError."""
    last = [record for record in records if len(record.cells) == width][-200:]
    of_values = []
    for place in range(width):
        cells = [record.cells[place] for record in last]
        filled = [cell for cell in cells if not is_missing(cell)]
        if 2 * sum(map(is_value, filled)) > len(filled):
            of_values.append(place)

    for number, record in enumerate(records):
        cells = list(record.cells)
        if cells:
            # a line of names may begin as a comment
            cells[0] = cells[0].lstrip("#%").strip()
        if not _are_names(cells, width):
            continue
        row_of_units: list[str] = []
        for below in islice(records, number + 1, None):
            if not any(cell.strip() for cell in below.cells):
                continue
            if _is_sample(below, of_values):
                return Form(
                    encoding=encoding,
                    separator=separator,
                    names=_padded(cells, width),
                    units=_padded([units.bare(cell) for cell in row_of_units], width),
                    names_line=record.line,
                    first_line=below.line,
                )
            if row_of_units or len(below.cells) > width or not are_units(below.cells):
                break
            row_of_units = below.cells
    raise _no_names(path, records, width, of_values, separator)


def _padded(cells: list[str], width: int) -> tuple[str, ...]:
    """Return cells without blanks around them, and empty cells up to a width."""
    stripped = [" ".join(cell.split()) for cell in cells]
    return tuple((stripped + [""] * width)[:width])


def _no_names(
    path: Path, records: list[_Record], width: int, of_values: list[int], separator: str
) -> ConfigError:
    """Return the error for a file in which no line of names fits the samples."""
    first = next((record for record in records if any(record.cells)), None)
    if first and len(first.cells) == width and _is_sample(first, of_values):
        return ConfigError(
            f"{path}: line {first.line} holds values already, so no line gives the columns their "
            "names; write a line of names above the samples"
        )
    widths = sorted({len(record.cells) for record in records if 1 < len(record.cells) < width})
    if separator == "," and widths and 2 * (widths[-1] - 1) <= width <= 2 * widths[-1]:
        return ConfigError(
            f"{path}: samples have {width} cells, but the names only {widths[-1]}: the comma is "
            "both the separator and the decimal mark; save the file with semicolons as separator"
        )
    return ConfigError(
        f"{path}: no line of names fits the samples, which have {width} cells; write one line with "
        f"{width} names directly above the samples, and at most a row of units between them"
    )
