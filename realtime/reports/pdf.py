"""A report on paper: the page that `page.page` has made, as PDF. It needs fpdf2 (`pip install 'rollerrig[pdf]'`).

Headings, paragraphs, tables and pictures are laid out anew; what is folded on the page, and its links, are left out.
"""

import base64
import io
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import matplotlib

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record.files import replaced
from rollerrig.realtime.reports.page import PNG

_FONT = "DejaVu"
_SIZES = {"h1": 17.0, "h2": 12.0, "p": 8.5}
_MARKED = {"marked": (250, 226, 211)}
_WORDS = {"pass": colours.GREEN, "fail": colours.VERMILION, "error": colours.PURPLE}
_SHORT, _ROW_MM = 8, 9.0  # a table of fewer rows is kept together
_LEAST_MM = 60.0  # what must be free below a heading


def check() -> Any:
    """The library. Raises ConfigError where it is not installed."""
    try:
        import fpdf
    except ImportError:
        raise ConfigError(
            "--pdf needs fpdf2, which is not installed: pip install 'rollerrig[pdf]'"
        ) from None
    return fpdf


def write(page: str, path: Path) -> Path:
    """Write a page, made while `page.on_paper`, as PDF. Raises ConfigError, OSError."""
    paper = check().FPDF(format="A4")
    fonts = Path(matplotlib.get_data_path(), "fonts", "ttf")
    for style, name in (("", "DejaVuSans.ttf"), ("B", "DejaVuSans-Bold.ttf")):
        paper.add_font(_FONT, style, fonts / name)
    paper.set_margins(14, 14)
    paper.set_auto_page_break(True, 14)
    paper.alias_nb_pages()
    paper.add_page()
    body = ET.fromstring(
        page[page.index("<body>") : page.index("</body>") + 7].replace("<br>", "<br/>")
    )
    for part in body:
        _part(paper, part)
    with replaced(path) as new:
        new.write_bytes(bytes(paper.output()))
    return path


def _part(paper: Any, part: ET.Element) -> None:
    if part.tag == "table":
        _table(paper, part)
    elif part.tag == "img":
        paper.image(io.BytesIO(base64.b64decode(part.attrib["src"].removeprefix(PNG))), w=paper.epw)
        paper.ln(2)
    elif part.tag in _SIZES:
        if part.tag == "h2":
            paper.ln(3)
            if paper.will_page_break(_LEAST_MM):
                paper.add_page()
        paper.set_font(_FONT, "" if part.tag == "p" else "B", _SIZES[part.tag])
        paper.multi_cell(0, text=_text(part), align="LEFT", new_x="LMARGIN", new_y="NEXT")
        paper.ln(1.5)


def _text(part: ET.Element) -> str:
    """All text of an element, links to files left out."""
    if part.tag == "br":
        return f"\n{part.tail or ''}"
    own = (
        ""
        if part.tag == "a" and not part.attrib.get("href", "").startswith("#")
        else ((part.text or "") + "".join(map(_text, part)))
    )
    return own + (part.tail or "" if part.tag not in ("p", "h1", "h2", "td", "th") else "")


def _table(paper: Any, part: ET.Element) -> None:
    rows = [[re.sub(r"[^\S\n]+", " ", _text(cell)).strip() for cell in row] for row in part]
    kinds = [row.attrib.get("class", "") for row in part]
    kept = [at for at in range(len(rows[0])) if any(row[at] for row in rows[1:]) or len(rows) == 1]
    rows = [[row[at] for at in kept] for row in rows]
    if len(rows) < _SHORT and paper.will_page_break(_ROW_MM * len(rows)):
        paper.add_page()
    # as wide as the longest word of a column at least, the rest by how much text a column has
    longest = [
        max(len(max(re.split(r"\s", row[at]), key=len)) for row in rows)
        for at in range(len(rows[0]))
    ]
    most = [max(max(map(len, row[at].split("\n"))) for row in rows) for at in range(len(rows[0]))]
    widths = [
        least + 0.35 * max(0, min(much, 60) - least) + 1.5
        for least, much in zip(longest, most, strict=True)
    ]
    facts = part.attrib.get("class") == "facts"
    paper.set_font(_FONT, "", min(7.5, 7.5 * 118 / max(sum(longest) + 2.0 * len(longest), 1)))
    right = [
        all(not cell or re.match(r"[-+]?\d|-$|never", cell) for cell in column)
        for column in zip(*rows[1:], strict=True)
    ] or [False] * len(rows[0])
    fpdf = check()
    with paper.table(
        col_widths=widths,
        first_row_as_headings=not facts,
        borders_layout="HORIZONTAL_LINES",
        text_align=tuple("RIGHT" if one and not facts else "LEFT" for one in right),
        padding=0.8,
        line_height=1.5 * paper.font_size,
        width=min(paper.epw, 110.0) if facts else paper.epw,
        align="LEFT",
    ) as table:
        for cells, kind in zip(rows, kinds, strict=True):
            row = table.row()
            for at, cell in enumerate(cells):
                word = _WORDS.get(cell.split(" ")[0]) if not facts else None
                face = fpdf.FontFace(
                    color=word,
                    emphasis="BOLD" if word or (facts and at == 0) else None,
                    fill_color=_MARKED.get(kind),
                )
                row.cell(cell, style=face)
    paper.ln(3)
