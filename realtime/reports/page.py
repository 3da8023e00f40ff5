"""The page that every report is: one HTML file that needs nothing else, in light and dark.

A report is made of elements; plain text in them is escaped. Pictures are drawn by matplotlib and stand in the page as
SVG, in the colours of the Rerun views; what is drawn in INK takes the colour of the text around it.
"""

import base64
import contextlib
import html
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from rollerrig.realtime.pictures import colours

INK, PNG = "#222222", "data:image/png;base64,"
_PIXELS = ContextVar("pixels", default=False)
AXLES = tuple(map(colours.on_page, colours.AXLES))
GREY, VERMILION = map(colours.on_page, (colours.GREY, colours.VERMILION))
MEASURED, BASE, EXTENDED = INK, *map(colours.on_page, (colours.BASE, colours.EXTENDED))
# of several runs, in their order
RUNS = tuple(
    map(
        colours.on_page,
        (
            colours.BLUE,
            colours.ORANGE,
            colours.GREEN,
            colours.PURPLE,
            colours.SKY_BLUE,
            colours.VERMILION,
        ),
    )
)
_STYLE = """
:root{color-scheme:light dark}
body{font:15px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem}
h2{margin-top:2.5rem;border-top:1px solid #8886;padding-top:1rem}
table{border-collapse:collapse;margin:1rem 0;font-size:.93em}
td,th{padding:.2rem .7rem;border-bottom:1px solid #8884;text-align:left;vertical-align:top}
.number{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
svg{width:100%;height:auto}pre{overflow:auto;font-size:.85em}summary{cursor:pointer}
small{opacity:.75}small.fail{opacity:1}.note{background:#8882;padding:.5em .8em}
tr.marked td{background:#d55e0033}tr.void td{opacity:.6}td{overflow-wrap:anywhere}th.number{white-space:normal}
@media (prefers-color-scheme:dark){svg{filter:brightness(1.3)}}
@media print{details{display:none}}
""" + "".join(
    f".{kind}{{color:{colours.on_page(colour)}}}"
    for kind, colour in (
        ("pass", colours.GREEN),
        ("fail", colours.VERMILION),
        ("warn", colours.VERMILION),
        ("error", colours.PURPLE),
    )
)
_MATPLOTLIB: Any = {
    # a fixed salt: the same data give the same file
    "svg.hashsalt": "rollerrig",
    "svg.fonttype": "none",
    "font.size": 9,
    "legend.fontsize": 8,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    **dict.fromkeys(
        ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK
    ),
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
    """Text that is HTML already and is not escaped again."""


BREAK = Markup("<br>")


def element(tag: str, *parts: str, kind: str = "", **attributes: str) -> Markup:
    """An element around its parts, of class `kind`."""
    named = ({"class": kind} if kind else {}) | attributes
    head = "".join(f' {name}="{html.escape(value)}"' for name, value in named.items())
    body = "".join(part if isinstance(part, Markup) else html.escape(part) for part in parts)
    return Markup(f"<{tag}{head}>{body}</{tag}>")


def page(title: str, *parts: str) -> str:
    """The whole document under its title."""
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8">'
        + element("title", title)
        + f"<style>{_STYLE}</style>"
        + element("body", element("h1", title), *parts)
        + "</html>\n"
    )


def paragraph(*parts: str, kind: str = "") -> Markup:
    """A paragraph; `kind` warn or note sets it off."""
    return element("p", *parts, kind=kind)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], marked: Sequence[str] = ()) -> Markup:
    """A table; columns of numbers stand to the right, rows that are `marked` or void stand out.

    Nothing where there are no rows.
    """
    kinds = [
        "number" if all(re.match(r"[-+]?\d|-?$|never|nan", cell) for cell in column) else ""
        for column in zip(*rows, strict=True)
    ]

    def line(tag: str, cells: Sequence[str], mark: str = "") -> Markup:
        return element(
            "tr",
            *(element(tag, cell, kind=kind) for cell, kind in zip(cells, kinds, strict=True)),
            kind=mark,
        )

    marks = marked or [""] * len(rows)
    return (
        element(
            "table",
            line("th", head),
            *(line("td", row, mark) for row, mark in zip(rows, marks, strict=True)),
        )
        if rows
        else Markup()
    )


def facts(rows: Mapping[str, str]) -> Markup:
    """A table of names and what they are, as the title block of a report."""
    return element(
        "table",
        *(element("tr", element("th", name), element("td", text)) for name, text in rows.items()),
        kind="facts",
    )


def folded(title: str, *parts: str) -> Markup:
    """What is shown only when its title is clicked on."""
    return element("details", element("summary", title), *parts)


@contextlib.contextmanager
def on_paper() -> Iterator[None]:
    """While it lasts pictures are pixels, as `pdf.write` wants them."""
    token = _PIXELS.set(True)
    try:
        yield
    finally:
        _PIXELS.reset(token)


def picture(draw: Callable[[Figure], None], size: tuple[float, float] = (11.0, 4.5)) -> Markup:
    """What a function draws, as SVG; size in inches at 72 points."""
    out = io.StringIO()
    with matplotlib.rc_context(_MATPLOTLIB):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        if _PIXELS.get():
            pixels = io.BytesIO()
            figure.savefig(pixels, format="png", dpi=150, facecolor="white")
            return element("img", src=f"{PNG}{base64.b64encode(pixels.getvalue()).decode()}")
        # without date, creator and format, matplotlib writes no metadata
        figure.savefig(
            out, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
        )
    svg = out.getvalue()
    return Markup(svg[svg.index("<svg") :].replace(INK, "currentColor"))
