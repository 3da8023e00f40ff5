"""The table of runs on the page.

The user can sort and filter runs, compare two of them, open a run in Rerun, download it, and write
a note on it.
"""

import asyncio
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import quote

from nicegui import run, ui

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.desk import guard, library, live
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.library import ComparedFigure
from rollerrig.realtime.desk.manual import carry_out
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import figures
from rollerrig.realtime.reports import train

# figures of a summary that have a column in the table
_FIGURES = (
    "braking_time_s",
    "braking_distance_m",
    "sliding_max_m_s",
    "longest_lock_s",
    "vents",
    "air_consumption_NL",
)
# titles of columns that say more than the titles of their figures
_TITLES = {"vents": "interventions: vents of the WSP"}
# a comparison lists the channels with such names
_COMPARED_CHANNELS = re.compile(r"vehicle_speed|sliding_|adhesion_\d|cylinder_pressure_")
# columns whose words may be broken where the page is narrow
_LONG = ("name", "faults", "verdict", "note")
_KM_H_PER_M_S = 3.6
_VALID = "valid"
# the viewer serves its page after this time
_VIEWER_STARTS_S = 2.0
# Vue templates of Quasar: a good verdict is green, another one orange
_VERDICT_CELL = """<q-td :props="props"><span :style="{color: ['valid', 'pass'].includes(props.value) ?
        'var(--good)' : 'var(--bad)'}" class="desk-verdict">{{ props.value }}</span></q-td>"""
# the check boxes that choose runs, with a name for screen readers
_CHOOSE = """<q-checkbox v-model="props.selected" dense
        :aria-label="props.row ? 'choose ' + props.row.name : 'choose all'" />"""
_ALL = "all"
# instead of the number of a car
_WHOLE_TRAIN = 0
_TEST_RESULTS = ("pass", "fail", "error")
_NOT_VALID = "not valid"


def _has_verdict(row: dict[str, Any], verdict: str) -> bool:
    """Return whether a run has a verdict of the filter."""
    if verdict == _NOT_VALID:
        return bool(row["verdict"] != _VALID)
    return verdict == _ALL or verdict in (row["verdict"], row["test"])


def _columns() -> list[dict[str, Any]]:
    """Return the columns of the table in the form that NiceGUI requires."""
    labels = {
        "name": "run",
        "when": "when",
        "scenario": "scenario",
        "cars": "cars",
        "unit": "unit",
        "initial_km_h": "initial speed (km/h)",
        "adhesion": "adhesion (mu_cd)",
        "faults": "faults",
        "test": "test",
        "verdict": "verdict",
    }
    for figure in figures.FIGURES:
        if figure.name in _FIGURES:
            title = _TITLES.get(figure.name, figure.title)
            labels[figure.name] = _with_unit(title, figure.unit)
    labels["note"] = "note"
    return [
        {
            "name": name,
            "label": label,
            "field": name,
            "sortable": True,
            "align": "left",
            "classes": "desk-cell desk-long" if name in _LONG else "desk-cell",
        }
        for name, label in labels.items()
    ]


def _with_unit(title: str, unit: str) -> str:
    return f"{title} ({unit})" if unit else title


class _RunTable:
    """The table of runs, buttons that act on the chosen runs, and a place for results."""

    def __init__(self, desk: Desk) -> None:
        self.desk = desk
        self.filter: ui.input
        self.note: ui.input
        self._every_row: list[dict[str, Any]] = []
        self._build_filter()
        self._build_buttons()
        self.table = ui.table(
            columns=_columns(),
            rows=[],
            row_key="name",
            selection="multiple",
            pagination=15,
        )
        self.table.classes("w-full desk-runs").props("dense wrap-cells").mark("runs")
        self.table.bind_filter_from(self.filter, "value")
        for name in ("verdict", "test"):
            self.table.add_slot(f"body-cell-{name}", _VERDICT_CELL)
        for slot in ("header-selection", "body-selection"):
            self.table.add_slot(slot, _CHOOSE)
        self.table.on_select(self.show_chosen)
        self.place = ui.column().classes("w-full")
        self.show_chosen()

    def _build_filter(self) -> None:
        """Put the filters into the page: by the verdict, with the number of runs, and by words."""
        with ui.row().classes("w-full items-center gap-2"):
            ui.label("Verdict").classes("desk-title")
            self.verdict = ui.toggle([_ALL], value=_ALL, on_change=self._show)
            self.verdict.props('dense no-caps size=sm padding="2px 10px" aria-label="verdict"')
            self.verdict.mark("verdict-filter")
            self.filter = ui.input("filter by words").props("dense clearable").mark("filter")

    def _build_buttons(self) -> None:
        with ui.row().classes("w-full items-center gap-2"):
            ui.button("Look again", on_click=self.fill).props("flat")
            compare = ui.button("Compare two", on_click=lambda: carry_out(self.compare()))
            compare.mark("compare")
            self.car = ui.select({_WHOLE_TRAIN: "whole train"}, value=_WHOLE_TRAIN, label="car")
            self.car.props("dense").style("min-width: 8rem").mark("car")
            report = ui.button("Open the report", on_click=lambda: carry_out(self.report()))
            report.props("flat").mark("report-of-run")
            ui.button("Open in Rerun", on_click=lambda: carry_out(self.rerun())).props("flat")
            for kind, name in library.FORMATS.items():
                download = ui.button(name, icon="download", on_click=partial(self.download, kind))
                download.props("flat").mark(f"download-{kind}")
            self.note = ui.input("note on the run").props("dense").classes("grow").mark("note")
            keep = ui.button(
                "Keep",
                on_click=lambda: carry_out(self.keep(), "the note is kept in the run's folder"),
            )
            keep.mark("keep")

    def fill(self) -> None:
        """Read the runs again."""
        self._every_row = library.rows(self.desk.folder)
        verdicts = (_ALL, _VALID, _NOT_VALID, *_TEST_RESULTS)
        counts = {
            verdict: sum(_has_verdict(row, verdict) for row in self._every_row)
            for verdict in verdicts
        }
        labels = {verdict: f"{verdict} ({count})" for verdict, count in counts.items()}
        self.verdict.set_options(labels, value=self.verdict.value)
        self._show()

    def _show(self) -> None:
        """Show the runs with the chosen verdict; hidden runs are not chosen."""
        verdict = str(self.verdict.value)
        self.table.rows = [row for row in self._every_row if _has_verdict(row, verdict)]
        shown = {row["name"] for row in self.table.rows}
        self.table.selected = [row for row in self.table.selected if row["name"] in shown]
        self.show_chosen()

    def chosen(self, count: int) -> list[Path]:
        """Return the folders of the chosen runs; of trains, those of the chosen car.

        Raises ConfigError unless exactly `count` runs are chosen.
        """
        selected = self.table.selected
        if len(selected) != count:
            raise ConfigError(f"{len(selected)} runs are chosen in the table: choose {count}")

        folders = []
        for row in selected:
            folder = self.desk.folder / row["name"]
            if row["cars"] and self.car.value:
                folder /= f"car_{self.car.value}"
            folders.append(folder)
        return folders

    def show_chosen(self) -> None:
        """Offer the cars that all chosen runs have; show the note of the only chosen run."""
        trains = [row["cars"] for row in self.table.selected if row["cars"]]
        labels = {_WHOLE_TRAIN: "whole train"}
        labels |= {number: f"car {number}" for number in range(1, min(trains, default=0) + 1)}
        self.car.set_options(labels, value=self.car.value if self.car.value in labels else 0)
        self.car.set_enabled(bool(trains))
        self.show_note()

    def show_note(self) -> None:
        """Show the note of the chosen run, if exactly one run is chosen."""
        if len(self.table.selected) == 1:
            self.note.value = library.note(self.chosen(1)[0])

    async def compare(self) -> None:
        """Show two runs next to each other."""
        first, second = self.chosen(2)
        if not self.car.value and any(row["cars"] for row in self.table.selected):
            raise ConfigError("whole trains are not compared: choose a car in the field car")
        # `io_bound` returns None if the desk shuts down
        compared = await run.io_bound(library.compared, first, second)
        figures_of_both, differences = compared or ([], [])
        curves = []
        for folder in (first, second):
            curve = await run.io_bound(library.channel, folder, "vehicle_speed_m_s", _KM_H_PER_M_S)
            curves.append(curve)

        self.place.clear()
        with self.place:
            _comparison([first.name, second.name], figures_of_both, differences, curves)

    async def report(self) -> None:
        """Open the report of the chosen run in another tab of the browser."""
        self.chosen(1)
        run_name = self.table.selected[0]["name"]
        file = Path(run_name) / train.REPORT
        if not (self.desk.folder / file).is_file():
            raise ConfigError(
                f"{run_name}: this run has no report; trains have one, and sequences and campaigns "
                "under Automatic"
            )
        ui.navigate.to(f"{guard.FILES}{quote(str(file))}", new_tab=True)

    async def rerun(self) -> None:
        """Open the chosen run in Rerun's viewer, in another tab of the browser."""
        address = await run.io_bound(self.desk.rerun, self.chosen(1)[0]) or ""
        await asyncio.sleep(_VIEWER_STARTS_S)
        ui.navigate.to(address, new_tab=True)
        # the link is for browsers that block the new tab
        self.place.clear()
        with self.place:
            ui.link(f"Rerun: {address}", address, new_tab=True)

    async def download(self, kind: str) -> None:
        """Send the chosen run to the browser as a file of a kind of `library.FORMATS`."""
        await carry_out(self._download(kind))

    async def _download(self, kind: str) -> None:
        (folder,) = self.chosen(1)
        ui.notify(f"{folder.name} is being written as {library.FORMATS[kind]} ...")
        name, content = await run.io_bound(library.export, folder, kind) or ("", b"")
        ui.download.content(content, name)

    async def keep(self) -> None:
        """Write the note into the folder of the chosen run."""
        library.write_note(self.chosen(1)[0], str(self.note.value or ""))
        self.fill()


def build(desk: Desk) -> Callable[[], None]:
    """Put the table of runs into the page; return the function that reads the runs again."""
    table = _RunTable(desk)
    table.fill()
    return table.fill


def _comparison(
    names: list[str], both: list[ComparedFigure], differences: list[Any], curves: list[Any]
) -> None:
    """Show figures, largest differences of channels, and vehicle speeds of two runs."""
    with ui.row().classes("w-full no-wrap items-start gap-4 desk-rows"):
        figure_rows = [
            {
                "figure": _with_unit(figure.title, figure.unit),
                "first": _text(figure.first),
                "second": _text(figure.second),
            }
            for figure in both
        ]
        heads = {"figure": "", "first": names[0], "second": names[1]}
        _table("Figures", heads, figure_rows).mark("compared")

        difference_rows = [
            {
                "channel": difference.channel,
                "largest": _text(difference.largest),
                "rms": _text(difference.rms),
                "at": f"{difference.at_s:.2f}",
            }
            for difference in differences
            if _COMPARED_CHANNELS.match(difference.channel)
        ]
        heads = {"channel": "channel", "largest": "largest", "rms": "rms", "at": "at s"}
        _table("Largest differences by value", heads, difference_rows)

        _speeds(names, curves)


def _speeds(names: list[str], curves: list[Any]) -> None:
    """Plot the vehicle speeds of two runs in km/h."""
    series = []
    looks = ((colours.SKY_BLUE, "solid"), (colours.ORANGE, "dashed"))
    for name, curve, (shade, kind) in zip(names, curves, looks, strict=True):
        series.append(
            {
                "type": "line",
                "name": name,
                "showSymbol": False,
                "data": curve,
                "color": colours.as_hex(shade),
                "lineStyle": {"type": kind},
            }
        )
    chart = ui.echart(
        {
            "animation": False,
            "title": live.title_of("vehicle speed (km/h)"),
            "legend": live.legend(),
            "xAxis": live.axis("{value} s"),
            "yAxis": live.axis(),
            "series": series,
        }
    )
    chart.classes("grow desk-chart").style("height: 320px")


def _table(title: str, heads: dict[str, str], rows: list[dict[str, Any]]) -> ui.table:
    """Show a table; `heads` maps the keys of its rows to the heads of their columns."""
    columns = [
        {"name": key, "label": label, "field": key, "align": "left"} for key, label in heads.items()
    ]
    return ui.table(title=title, rows=rows, columns=columns).classes("desk-card")


def _text(value: float | None) -> str:
    return "–" if value is None else f"{value:.4g}"
