"""The library of runs on the page: sort, filter, compare two, open in Rerun, download, write a note."""

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import run, ui

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.desk import library, live
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.manual import tell
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import figures

_COLUMNS = (
    ("name", "run"),
    ("when", "when"),
    ("scenario", "scenario"),
    ("unit", "unit"),
    ("verdict", "verdict"),
    *(
        (one.name, f"{one.title}{f' ({one.unit})' if one.unit else ''}")
        for one in figures.FIGURES
        if one.name
        in (
            "stop_time_s",
            "stop_distance_m",
            "sliding_max_m_s",
            "longest_lock_s",
            "vents",
            "air_consumption_NL",
        )
    ),
    ("note", "note"),
)
_KNOWN = (
    "vehicle_speed",
    "sliding_",
    "adhesion_1",
    "adhesion_2",
    "adhesion_3",
    "adhesion_4",
    "cylinder_pressure_",
)


def build(desk: Desk) -> Callable[[], None]:
    """Put the table, and what can be done with the runs that are chosen in it, into the page; what reads it anew."""
    with ui.row().classes("w-full items-center gap-2"):
        words = ui.input("filter").props("dense clearable").mark("filter")
        ui.button("Look again", on_click=lambda: fill()).props("flat")
        ui.button("Compare two", on_click=lambda: tell(compare())).mark("compare")
        ui.button("Open in Rerun", on_click=lambda: tell(rerun())).props("flat")
        for kind, name in library.FORMATS.items():
            ui.button(name, icon="download", on_click=lambda kind=kind: tell(download(kind))).props(
                "flat"
            ).mark(f"download-{kind}")
        note = ui.input("note on the run").props("dense").classes("grow").mark("note")
        ui.button(
            "Keep", on_click=lambda: tell(keep(), "the note is kept in the run's folder")
        ).mark("keep")
    table = (
        ui.table(
            columns=[
                {
                    "name": name,
                    "label": label,
                    "field": name,
                    "sortable": True,
                    "align": "left",
                    "classes": "desk-cell",
                }
                for name, label in _COLUMNS
            ],
            rows=[],
            row_key="name",
            selection="multiple",
            pagination=15,
        )
        .classes("w-full")
        .mark("runs")
    )
    table.bind_filter_from(words, "value")
    table.add_slot(
        "body-cell-verdict",
        """<q-td :props="props"><span :style="{color: props.value === 'valid' ?
        '#2fbf93' : '#ff8a4c'}" class="desk-verdict">{{ props.value }}</span></q-td>""",
    )
    place = ui.column().classes("w-full")

    def fill() -> None:
        table.rows = library.rows(desk.folder)

    def chosen(count: int) -> list[Any]:
        if len(table.selected) != count:
            raise ConfigError(f"{len(table.selected)} runs are chosen in the table: choose {count}")
        return [desk.folder / one["name"] for one in table.selected]

    def show() -> None:
        if len(table.selected) == 1:
            note.value = library.note(desk.folder / table.selected[0]["name"])

    table.on_select(show)

    async def compare() -> None:
        first, second = chosen(2)
        beside, different = await run.io_bound(library.compared, first, second) or ([], [])
        curves = [
            await run.io_bound(library.channel, one, "vehicle_speed_m_s", 3.6)
            for one in (first, second)
        ]
        place.clear()
        with place:
            _compared([first.name, second.name], beside, different, curves)

    async def rerun() -> None:
        address = await run.io_bound(desk.rerun, chosen(1)[0]) or ""
        await asyncio.sleep(2.0)  # the viewer begins to serve
        ui.navigate.to(address, new_tab=True)
        place.clear()
        with place:
            ui.link(f"Rerun: {address}", address, new_tab=True)

    async def download(kind: str) -> None:
        (one,) = chosen(1)
        ui.notify(f"{one.name} is being written as {library.FORMATS[kind]} ...")
        name, content = await run.io_bound(library.export, one, kind) or ("", b"")
        ui.download.content(content, name)

    async def keep() -> None:
        library.write_note(chosen(1)[0], str(note.value or ""))
        fill()

    fill()
    return fill


def _compared(names: list[str], beside: list[Any], different: list[Any], curves: list[Any]) -> None:
    """Two runs: figures, vehicle speeds, and the largest differences of some channels."""
    with ui.row().classes("w-full no-wrap items-start gap-4"):
        _table(
            "Figures",
            (("what", ""), ("a", names[0]), ("b", names[1])),
            [
                {"what": f"{title} ({unit})" if unit else title, "a": _text(a), "b": _text(b)}
                for title, unit, a, b in beside
            ],
        ).mark("compared")
        ranked = [one for one in different if one.channel.startswith(_KNOWN)]
        _table(
            "Largest differences by value",
            (("channel", "channel"), ("largest", "largest"), ("rms", "rms"), ("at", "at s")),
            [
                {
                    "channel": one.channel,
                    "largest": _text(one.largest),
                    "rms": _text(one.rms),
                    "at": f"{one.at_s:.2f}",
                }
                for one in ranked
            ],
        )
        ui.echart(
            {
                "animation": False,
                "title": live.title_of("vehicle speed (km/h)"),
                "legend": {"right": 10, "top": 2, "textStyle": {"color": "#c8ccd2"}},
                "xAxis": live.axis("{value} s"),
                "yAxis": live.axis(),
                "series": [
                    {
                        "type": "line",
                        "name": name,
                        "showSymbol": False,
                        "data": curve,
                        "color": colours.on_page(shade),
                    }
                    for name, curve, shade in zip(
                        names, curves, (colours.SKY_BLUE, colours.ORANGE), strict=True
                    )
                ],
            }
        ).classes("grow").style("height: 320px")


def _table(title: str, heads: tuple[tuple[str, str], ...], rows: list[dict[str, Any]]) -> ui.table:
    return ui.table(
        title=title,
        rows=rows,
        columns=[
            {"name": key, "label": label, "field": key, "align": "left"} for key, label in heads
        ],
    ).classes("desk-card")


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
