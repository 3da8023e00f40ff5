"""A report on paper: the page that `page.page` has made, as PDF. It needs fpdf2 (`pip install
'rollerrig[pdf]'`).

Headings, paragraphs, tables and pictures are laid out anew. Folded parts of the page and links to
files are left out. The file has a title, a bookmark for each heading, and on each page the document
number, the revision and the number of the page.
"""

import base64
import io
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib

from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_bytes
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.reports.page import DOCUMENT, PNG, SIGNATURES

_FONT = "DejaVu"

# points, by element
_SIZES = {"h1": 17.0, "h2": 12.0, "p": 8.5}
_TABLE_PT = 7.5

# background of a row, by its class
_MARKED = {"marked": (250, 226, 211)}

# colour of a cell, by its first word
_WORDS = {"pass": colours.GREEN, "fail": colours.VERMILION, "error": colours.PURPLE}

_MARGIN_MM = 14

# the foot of each page: how far from the edge of the paper, and its size in points
_FOOT_MM = 10
_FOOT_PT = 7.0

# height of a row to sign in
_SIGNATURE_MM = 14.0

# levels of bookmarks, by element
_LEVELS = {"h1": 0, "h2": 1}

# A table is kept on one page if it is lower than this share of the page.
_KEPT_SHARE = 0.6

# Marks before and after bold text, for fpdf2, whose own marks could be a part of a text. They and
# those of the other styles are pairs of characters that no text has (private use of Unicode).
_BOLD = "\ue000\ue000"
_NO_MARKS = ("\ue001\ue001", "\ue002\ue002", "\ue003\ue003")

# what must be free below a heading
_LEAST_MM = 60.0

# width of a table of facts
_FACTS_MM = 110.0

# characters. Longer cells get no more width, and longer words may break.
_WIDE_CHARACTERS = 60
_LONGEST_WORD = 40

# around the text of a cell, and the height of a line of text in heights of the font
_PADDING_MM = 0.8
_LINE_HEIGHT = 1.5

# left and right of the text of a cell, together, with a reserve
_CELL_PADDING_MM = 2.0

# text of a cell in a column of numbers; an empty cell is allowed, too
_NUMBER = re.compile(r"[-+]?\d|-$|never")


def check() -> Any:
    """Return the library. Raises ConfigError if it is not installed."""
    try:
        import fpdf
    except ImportError:
        raise ConfigError(
            "--pdf needs fpdf2, which is not installed: pip install 'rollerrig[pdf]'"
        ) from None
    return fpdf


def write(page: str, path: Path) -> Path:
    """Write a page, which was made with `page.on_paper`, as PDF. Raises ConfigError, OSError."""
    end = "</body>"
    body = page[page.index("<body>") : page.index(end) + len(end)]
    parts = ET.fromstring(body.replace("<br>", "<br/>"))
    title = "".join(_text(part) for part in parts if part.tag == "h1").strip()

    paper = _paper(_foot(title, parts))
    paper.set_title(title)
    paper.set_lang("en")
    paper.set_creator("rollerrig")
    fonts = Path(matplotlib.get_data_path(), "fonts", "ttf")
    for style, name in (("", "DejaVuSans.ttf"), ("B", "DejaVuSans-Bold.ttf")):
        paper.add_font(_FONT, style, fonts / name)
    paper.set_margins(_MARGIN_MM, _MARGIN_MM)
    paper.set_auto_page_break(True, _MARGIN_MM)
    paper.alias_nb_pages()
    paper.add_page()

    for part in parts:
        _add_part(paper, part)
    write_bytes(path, bytes(paper.output()))
    return path


def _foot(title: str, parts: ET.Element) -> str:
    """Return what is at the foot of each page: the title, document number and revision."""
    facts: dict[str, str] = {}
    for row in parts.iterfind("./table[@class='facts']/tr"):
        name, value = (_cell_text(cell) for cell in row)
        facts.setdefault(name, value)
    words = [f"{name}: {facts[name]}" for name in DOCUMENT if name in facts]
    return " · ".join([title, *words])


def _paper(foot: str) -> Any:
    """Return an empty document whose pages have `foot` and their number below."""

    class Paper(check().FPDF):  # type: ignore[misc]
        MARKDOWN_BOLD_MARKER = _BOLD
        MARKDOWN_ITALICS_MARKER, MARKDOWN_STRIKETHROUGH_MARKER, MARKDOWN_UNDERLINE_MARKER = (
            _NO_MARKS
        )
        MARKDOWN_MARKERS = (_BOLD, *_NO_MARKS)
        MARKDOWN_ESCAPE_CHARACTER = "\ue004"
        # no text is a link
        MARKDOWN_LINK_REGEX = re.compile(r"(?!)")

        def footer(self) -> None:
            self.set_y(-_FOOT_MM)
            self.set_font(_FONT, "", _FOOT_PT)
            numbers = f"page {self.page_no()} of {{nb}}"
            width_mm = self.get_string_width("page 999 of 999")
            self.cell(self.epw - width_mm, text=_cut(self, foot, self.epw - width_mm))
            self.cell(width_mm, text=numbers, align="RIGHT")

    return Paper(format="A4")


def _cut(paper: Any, text: str, width_mm: float) -> str:
    """Return a text that is shortened to a width."""
    if paper.get_string_width(text) <= width_mm:
        return text
    while text and paper.get_string_width(f"{text}...") > width_mm:
        text = text[:-1]
    return f"{text}..."


def _add_part(paper: Any, part: ET.Element) -> None:
    if part.tag == "table" and part.attrib.get("class") == SIGNATURES:
        _add_signatures(paper, part)
    elif part.tag == "table":
        _add_table(paper, part)
    elif part.tag == "img":
        pixels = base64.b64decode(part.attrib["src"].removeprefix(PNG))
        paper.image(io.BytesIO(pixels), w=paper.epw)
        paper.ln(2)
    elif part.tag in _SIZES:
        if part.tag == "h2":
            paper.ln(3)
            if paper.will_page_break(_LEAST_MM):
                paper.add_page()
        text = _text(part)
        if part.tag in _LEVELS:
            # headings are bold, and have no marks
            text = text.replace(_BOLD, "")
            paper.start_section(" ".join(text.split()), level=_LEVELS[part.tag])
        paper.set_font(_FONT, "" if part.tag == "p" else "B", _SIZES[part.tag])
        paper.multi_cell(
            0,
            text=text,
            align="LEFT",
            markdown=part.tag == "p",
            new_x="LMARGIN",
            new_y="NEXT",
        )
        paper.ln(1.5)


def _text(part: ET.Element) -> str:
    """Return all text of an element and the text after it; links to files are left out."""
    after = part.tail or ""
    if part.tag == "br":
        return f"\n{after}"
    if part.tag in ("p", "h1", "h2", "td", "th"):
        after = ""

    is_file_link = part.tag == "a" and not part.attrib.get("href", "").startswith("#")
    if is_file_link:
        return after
    inside = (part.text or "") + "".join(_text(child) for child in part)
    if part.tag == "b" and inside:
        inside = f"{_BOLD}{inside}{_BOLD}"
    return inside + after


def _add_signatures(paper: Any, part: ET.Element) -> None:
    """Add the table in which people sign, on one page."""
    rows = [[_cell_text(cell) for cell in row] for row in part]
    if paper.will_page_break(_SIGNATURE_MM * len(rows)):
        paper.add_page()
    paper.set_font(_FONT, "", _TABLE_PT)
    with paper.table(
        col_widths=(2, 4, 2, 4), padding=0.8, text_align="LEFT", width=paper.epw
    ) as table:
        for cells in rows:
            row = table.row(min_height=_SIGNATURE_MM if cells[0] else None)
            for cell in cells:
                row.cell(cell)
    paper.ln(3)


def _add_table(paper: Any, part: ET.Element) -> None:
    rows = _rows_without_empty_columns(part)
    if not rows:
        return
    kinds = [row.attrib.get("class", "") for row in part]
    is_facts = part.attrib.get("class") == "facts"
    columns = list(zip(*rows, strict=True))
    width_mm = min(paper.epw, _FACTS_MM) if is_facts else paper.epw
    size_pt, widths_mm = _sizes(paper, columns, width_mm)
    paper.set_font(_FONT, "", size_pt)
    height_mm = _height_mm(paper, rows, widths_mm)
    if height_mm < _KEPT_SHARE * paper.eph and paper.will_page_break(height_mm):
        paper.add_page()

    alignment = tuple(
        "RIGHT" if _is_numbers(column[1:], len(rows)) and not is_facts else "LEFT"
        for column in columns
    )
    fpdf = check()
    with paper.table(
        col_widths=widths_mm,
        first_row_as_headings=not is_facts,
        borders_layout="HORIZONTAL_LINES",
        text_align=alignment,
        padding=_PADDING_MM,
        line_height=_LINE_HEIGHT * paper.font_size,
        markdown=True,
        width=width_mm,
        align="LEFT",
    ) as table:
        for cells, kind in zip(rows, kinds, strict=True):
            row = table.row()
            for at, cell in enumerate(cells):
                colour = None if is_facts else _WORDS.get(cell.replace(_BOLD, "").split(" ")[0])
                is_bold = colour is not None or (is_facts and at == 0)
                face = fpdf.FontFace(
                    color=colour,
                    emphasis="BOLD" if is_bold else None,
                    fill_color=_MARKED.get(kind),
                )
                row.cell(cell, style=face)
    paper.ln(3)


def _height_mm(paper: Any, rows: Sequence[Sequence[str]], widths_mm: Sequence[float]) -> float:
    """Return the height of a table in the present font of the paper."""
    height_mm = 0.0
    for cells in rows:
        heights_mm = [
            paper.multi_cell(
                width_mm - 2.0 * _PADDING_MM,
                _LINE_HEIGHT * paper.font_size,
                cell,
                markdown=True,
                dry_run=True,
                output="HEIGHT",
            )
            for cell, width_mm in zip(cells, widths_mm, strict=True)
        ]
        height_mm += max(heights_mm) + 2.0 * _PADDING_MM
    return height_mm


def _rows_without_empty_columns(part: ET.Element) -> list[list[str]]:
    """Return the cells of a table, without columns that have nothing below their heading."""
    rows = [[_cell_text(cell) for cell in row] for row in part]
    if len(rows) < 2:
        return rows
    filled = [at for at in range(len(rows[0])) if any(row[at] for row in rows[1:])]
    return [[row[at] for at in filled] for row in rows]


def _cell_text(cell: ET.Element) -> str:
    """Return the text of a cell; only its line breaks stay."""
    return re.sub(r"[^\S\n]+", " ", _text(cell)).strip()


def _sizes(
    paper: Any, columns: Sequence[Sequence[str]], width_mm: float
) -> tuple[float, list[float]]:
    """Return the font size of a table in points, and the widths of its columns in mm.

    Each column has room for its longest word, so that no word breaks but those of more than
    `_LONGEST_WORD` characters. The rest of the width goes to the columns with longer text.
    """
    # headings and some cells are bold, which is wider
    paper.set_font(_FONT, "B", _TABLE_PT)
    words_mm = [_longest_word_mm(paper, column) for column in columns]
    padding_mm = _CELL_PADDING_MM * len(columns)
    scale = min(1.0, (width_mm - padding_mm) / max(sum(words_mm), 1.0))
    least_mm = [scale * word_mm + _CELL_PADDING_MM for word_mm in words_mm]

    spare_mm = width_mm - sum(least_mm)
    wishes = [_longer_text(column) for column in columns]
    if not sum(wishes):
        wishes = [1.0] * len(columns)
    widths_mm = []
    for least, wish in zip(least_mm, wishes, strict=True):
        widths_mm.append(least + spare_mm * wish / sum(wishes))
    return scale * _TABLE_PT, widths_mm


def _longest_word_mm(paper: Any, column: Sequence[str]) -> float:
    """Return the width of the longest word of a column; longer words than allowed are cut."""
    words = {word[:_LONGEST_WORD] for cell in column for word in cell.replace(_BOLD, "").split()}
    return max((float(paper.get_string_width(word)) for word in words), default=0.0)


def _longer_text(column: Sequence[str]) -> float:
    """Return by how many characters the longest line of a column exceeds its longest word."""
    plain = [cell.replace(_BOLD, "") for cell in column]
    longest_line = max(len(line) for cell in plain for line in cell.split("\n"))
    longest_word = max((len(word) for cell in plain for word in cell.split()), default=0)
    return float(max(0, min(longest_line, _WIDE_CHARACTERS) - longest_word))


def _is_numbers(cells: Sequence[str], rows: int) -> bool:
    """Whether a column has numbers below its heading; a table of one row has none."""
    return rows > 1 and all(not cell or _NUMBER.match(cell) for cell in cells)
