"""The page that every report is: one HTML file that needs nothing else, in light and dark.

A report is made of elements. Plain text in them is escaped. matplotlib draws the pictures, and they
are in the page as SVG, in the colours of the Rerun views. What is drawn in INK has the colour of
the text around it.
"""

import base64
import contextlib
import html
import io
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any
from urllib.parse import quote

import matplotlib
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, StrMethodFormatter

from rollerrig.configs.printable import printable
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import played

# matplotlib has read a file matplotlibrc if there is one in the working folder. It could switch on
# LaTeX, which is a program. Reports look the same everywhere and use the defaults of matplotlib.
matplotlib.rcdefaults()

# a colour that stands for the colour of the text
INK = "#222222"

# address of a picture that is pixels
PNG = "data:image/png;base64,"

# rows of every title block that identify the document
DOCUMENT = ("document number", "revision")
# rows that only the user can state
STATED = (*played.ABOUT_UNIT, "tested by")

# roles of the people who sign
SIGNED = ("tested", "checked", "approved")

# class of the table in which they sign
SIGNATURES = "signatures"

# whether pictures are pixels, for `pdf`
_PIXELS = ContextVar("pixels", default=False)
_PIXELS_PER_INCH = 150

AXLES = tuple(colours.as_hex(colour) for colour in colours.AXLES)
GREY = colours.as_hex(colours.GREY)
VERMILION = colours.as_hex(colours.VERMILION)
MEASURED = INK
BASE = colours.as_hex(colours.BASE)
EXTENDED = colours.as_hex(colours.EXTENDED)

# several runs, in their order
RUNS = tuple(
    colours.as_hex(colour)
    for colour in (
        colours.BLUE,
        colours.ORANGE,
        colours.GREEN,
        colours.PURPLE,
        colours.SKY_BLUE,
        colours.VERMILION,
    )
)

# classes of words with a colour
_COLOURED_WORDS = (
    ("pass", colours.GREEN),
    ("fail", colours.VERMILION),
    ("warn", colours.VERMILION),
    ("error", colours.PURPLE),
)
_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem}
h2{margin-top:2.5rem;border-top:1px solid #8886;padding-top:1rem}
table{border-collapse:collapse;margin:1rem 0;font-size:.93em}
td,th{padding:.2rem .7rem;border-bottom:1px solid #8884;text-align:left;vertical-align:top}
.number{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
table.signatures{width:100%}.signatures td{height:3rem;border:1px solid #8886}
svg{width:100%;height:auto}pre{overflow:auto;font-size:.85em}summary{cursor:pointer}
small{opacity:.75}small.fail{opacity:1}.note{background:#8882;padding:.5em .8em}
tr.marked td{background:#d55e0033}tr.void td{opacity:.6}th.number{white-space:normal}
td{overflow-wrap:break-word}td.long{overflow-wrap:anywhere}
@media (prefers-color-scheme:dark){svg{filter:brightness(1.3)}}
@media print{details{display:none}}
""" + "".join(f".{kind}{{color:{colours.as_hex(colour)}}}" for kind, colour in _COLOURED_WORDS)

# characters. A cell with a longer word, such as a path, may break it anywhere.
_LONGEST_WORD = 24
_TAG = re.compile(r"<[^>]*>")

# a logarithmic axis whose ends have a larger ratio has labels such as 10⁻⁶
_WIDE_LOGARITHM = 1e4
_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")

# text of a cell in a column of numbers
_NUMBER = re.compile(r"[-+]?\d|-?$|never|nan")

# without date, creator, format and type matplotlib writes no metadata into a file of a kind
_NO_METADATA: dict[str, dict[str, None]] = {
    "svg": dict.fromkeys(("Date", "Creator", "Format", "Type")),
    "pdf": dict.fromkeys(("CreationDate", "Creator", "Producer")),
}

# what is drawn in the colour of the text
_INKED = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
_MATPLOTLIB: Any = {
    # a fixed salt: the same data give the same file
    "svg.hashsalt": "rollerrig",
    "svg.fonttype": "none",
    # a dollar sign in a name of a user begins no formula
    "text.parse_math": False,
    "font.size": 9,
    "legend.fontsize": 8,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    **dict.fromkeys(_INKED, INK),
    "axes.grid": True,
    "grid.color": GREY,
    "grid.alpha": 0.25,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "lines.linewidth": 1.0,
    "axes.prop_cycle": matplotlib.cycler(color=RUNS),  # type: ignore[attr-defined]
}


class Markup(str):
    """Text that is HTML and is not escaped again."""


BREAK = Markup("<br>")


def element(tag: str, *parts: str, kind: str = "", **attributes: str) -> Markup:
    """Return an element around its parts, of class `kind`."""
    if kind:
        attributes = {"class": kind, **attributes}
    head = "".join(f' {name}="{html.escape(value)}"' for name, value in attributes.items())
    body = "".join(part if isinstance(part, Markup) else html.escape(part) for part in parts)
    return Markup(f"<{tag}{head}>{body}</{tag}>")


def page(title: str, *parts: str) -> str:
    """Return the whole document under its title."""
    # hidden characters are no HTML, and could mislead a reader
    return printable(
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        + element("title", title)
        + f"<style>{_STYLE}</style>"
        + element("body", element("h1", title), *parts)
        + "</html>\n"
    )


def file_link(text: str, file: Path, folder: Path) -> Markup:
    """Return a link to a file, for a page in `folder`.

    It begins with a dot, so that the name of a file cannot be the address of a script.
    """
    path = os.path.relpath(file, folder)
    return element("a", text, href=f"./{quote(path)}")


def paragraph(*parts: str, kind: str = "") -> Markup:
    """Return a paragraph; `kind` warn or note sets it off."""
    return element("p", *parts, kind=kind)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], marked: Sequence[str] = ()) -> Markup:
    """Return a table; it is empty if there are no rows.

    Columns of numbers are aligned to the right. `marked` has the class of each row: "marked" and
    "void" set a row off.
    """
    if not rows:
        return Markup()
    kinds = [
        "number" if all(_NUMBER.match(cell) for cell in column) else ""
        for column in zip(*rows, strict=True)
    ]

    def line(tag: str, cells: Sequence[str], mark: str = "") -> Markup:
        elements = []
        for cell, kind in zip(cells, kinds, strict=True):
            elements.append(element(tag, cell, kind=kind or _kind_of_words(cell)))
        return element("tr", *elements, kind=mark)

    marks = marked or [""] * len(rows)
    lines = [line("td", row, mark) for row, mark in zip(rows, marks, strict=True)]
    return element("table", line("th", head), *lines)


def _kind_of_words(cell: str) -> str:
    """Return the class of a cell with a word that may break; "" if all its words are short."""
    text = _TAG.sub(" ", cell) if isinstance(cell, Markup) else cell
    longest = max((len(word) for word in text.split()), default=0)
    return "long" if longest > _LONGEST_WORD else ""


def facts(rows: Mapping[str, str]) -> Markup:
    """Return a table of names and their values, as the title block of a report.

    It is empty if there are none.
    """
    if not rows:
        return Markup()
    lines = []
    for name, text in rows.items():
        value = element("td", text, kind=_kind_of_words(text))
        lines.append(element("tr", element("th", name), value))
    return element("table", *lines, kind="facts")


def title_block(about: Mapping[str, str], recorded: Mapping[str, str]) -> dict[str, str]:
    """Return the rows of the title block of a report: what a user states, then what is recorded.

    The entries `about` are those of --about. They are added to the rows `recorded`, and replace
    none of them.
    """
    block = dict.fromkeys((*DOCUMENT, *STATED), played.NOT_STATED)
    block.update(about)
    block.update(recorded)
    return block


def signatures(about: Mapping[str, str]) -> Markup:
    """Return the block in which people sign: one row a role, with the name where it is known."""
    rows = []
    for role in SIGNED:
        name = about.get(f"{role} by", "")
        rows.append((f"{role} by", name, "", ""))
    head = ("", "name", "date", "signature")
    lines = [element("tr", *(element("th", cell) for cell in head))]
    lines += [element("tr", *(element("td", cell) for cell in row)) for row in rows]
    return Markup(element("h2", "Signatures") + element("table", *lines, kind=SIGNATURES))


def folded(title: str, *parts: str) -> Markup:
    """Return parts that a reader opens with a click on their title."""
    return element("details", element("summary", title), *parts)


@contextlib.contextmanager
def on_paper() -> Iterator[None]:
    """In this context pictures are pixels, as `pdf.write` needs them."""
    token = _PIXELS.set(True)
    try:
        yield
    finally:
        _PIXELS.reset(token)


def picture(draw: Callable[[Figure], None], size: tuple[float, float] = (11.0, 4.5)) -> Markup:
    """Return what a function draws, as SVG; `size` in inches of 72 points."""
    if _PIXELS.get():
        pixels = base64.b64encode(_drawn(draw, size, "png")).decode()
        return element("img", src=f"{PNG}{pixels}")
    text = _drawn(draw, size, "svg").decode("utf-8")
    svg = text[text.index("<svg") :]
    return Markup(svg.replace(INK, "currentColor"))


def plain_logarithm(axis: Axis) -> None:
    """Give a logarithmic axis labels such as 0.02, at 1, 2 and 5 times the powers of ten.

    An axis of many powers of ten has labels such as 10⁻⁶, at every second of them.
    """
    low, high = sorted(axis.get_view_interval())
    if low > 0.0 and high > _WIDE_LOGARITHM * low:
        axis.set_major_locator(LogLocator(base=100.0))
        axis.set_major_formatter(FuncFormatter(_power_of_ten))
    else:
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def _power_of_ten(value: float, _: int) -> str:
    """Return a power of ten for the label of an axis."""
    exponent = round(math.log10(value))
    return "1" if exponent == 0 else f"10{str(exponent).translate(_SUPERSCRIPTS)}"


def picture_file(
    draw: Callable[[Figure], None], size: tuple[float, float], kind: str, pixels_per_inch: int
) -> bytes:
    """Return what a function draws on white, as a file.

    size: in inches.
    kind: "png", "svg" or "pdf".
    """
    return _drawn(draw, size, kind, "white", pixels_per_inch)


def _drawn(
    draw: Callable[[Figure], None],
    size: tuple[float, float],
    kind: str,
    background: str = "none",
    pixels_per_inch: int = _PIXELS_PER_INCH,
) -> bytes:
    """Return what a function draws, as a file; a picture of pixels has a white background."""
    with matplotlib.rc_context(_MATPLOTLIB):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        file = io.BytesIO()
        if kind == "png":
            figure.savefig(file, format=kind, dpi=pixels_per_inch, facecolor="white")
        else:
            figure.savefig(
                file, format=kind, facecolor=background, metadata=_NO_METADATA.get(kind, {})
            )
    return file.getvalue()
