"""Automatic mode: starts sequences and campaigns, and shows their messages, progress and reports.

Each of them is a program with a `rollerrig` command line (see `programs`).
"""

from pathlib import Path

from nicegui import ui

from rollerrig.configs import store
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.manual import carry_out
from rollerrig.realtime.desk.programs import Program

_LINES_SHOWN = 14
_PROGRAMS_SHOWN = 6
# colours of lines by their first word, and of the result
_COLOURS = {"pass": "#009e73", "fail": "#d55e00", "error": "#d55e00"}
# by exit status
_RESULTS = {0: "passed", 1: "a verdict failed", 4: "interrupted, or a run is not valid"}


def build(desk: Desk) -> None:
    """Put the controls, and the programs that have been started, into the page."""
    with ui.row().classes("w-full no-wrap items-start gap-4"):
        with ui.card().classes("desk-card").style("width: 26rem"):
            _sequences(desk)
            ui.separator()
            _campaigns(desk)
        place = ui.column().classes("grow gap-4")
    _programs(desk, place)


def _sequences(desk: Desk) -> None:
    """The controls that play sequences."""
    ui.label("Sequences").classes("desk-title")
    names = ui.select(
        store.names("sequences"),
        multiple=True,
        value=["emergency_120"],
        label="sequences (none: the whole library)",
    )
    names.classes("w-full").props("use-chips").mark("sequences")
    unit = ui.select(["", *desk.units], value="", label="WSP unit (empty: as in the sequence)")
    unit.classes("w-full")
    pacing = ui.select(["lockstep", "wall"], value="lockstep", label="pacing")
    pacing.classes("w-full").mark("pacing")

    async def play() -> None:
        chosen = list(names.value or [])
        report = chosen[0] if len(chosen) == 1 else "sequences"
        words = ["sequence", "--steps"]
        words += ["--out", f"reports/{report}"]
        words += ["--pacing", str(pacing.value)]
        if unit.value:
            words.append(f"--wsp={unit.value}")
        await carry_out(_start(desk, [*words, "--", *chosen]), "started")

    ui.button("Play", on_click=play).props("color=primary").classes("w-full").mark("play")


def _campaigns(desk: Desk) -> None:
    """The controls that run a campaign."""
    ui.label("Campaign").classes("desk-title")
    plans = store.names("campaigns")
    plan = ui.select(plans, value=plans[0], label="plan").classes("w-full")

    async def run() -> None:
        words = ["campaign", str(plan.value), "--out", f"campaigns/{plan.value}"]
        await carry_out(_start(desk, words), "started")

    ui.button("Run", on_click=run).props("color=primary").classes("w-full").mark("campaign")
    ui.label("A campaign that was begun earlier continues.").classes("desk-small")


async def _start(desk: Desk, words: list[str]) -> None:
    desk.start(words)


def _programs(desk: Desk, place: ui.column) -> None:
    """Keep the list of programs in `place` up to date; runs of the manual mode are not in it."""
    shown: dict[int, str] = {}  # state of each program that the page shows, by its process

    def follow() -> None:
        programs = [program for program in desk.programs if program.words[0] != "run"]
        state = {program.pid: f"{program.status} {len(program.lines)}" for program in programs}
        if state == shown:
            return
        shown.clear()
        shown.update(state)
        place.clear()
        with place:
            if not programs:
                ui.label("Nothing has been started here yet.").classes("desk-small")
            for program in reversed(programs[-_PROGRAMS_SHOWN:]):
                _program(desk, program)

    ui.timer(1.0, follow)
    follow()


def _program(desk: Desk, program: Program) -> None:
    """The card of one program: title and result, progress, last messages, report, error."""
    status = program.status
    with ui.card().classes("w-full desk-card"):
        with ui.row().classes("w-full items-center"):
            ui.label(program.title).classes("desk-title grow")
            if status is None:
                ui.button("Stop", on_click=program.stop).props("flat dense")
            else:
                colour = _COLOURS["pass" if status == 0 else "fail"]
                ui.label(_RESULTS.get(status, f"status {status}")).style(f"color: {colour}")
        if status is None:
            share = program.share
            bar = ui.linear_progress(share or 0.0, show_value=False)
            bar.props("instant-feedback" if share else "indeterminate")
        for line in program.lines[-_LINES_SHOWN:]:
            colour = _COLOURS.get(line.split()[0], "inherit")
            ui.label(line).classes("desk-line").style(f"color: {colour}")
        _report_link(desk, program)
        if program.error:
            ui.label(program.error).style(f"color: {_COLOURS['error']}")


def _report_link(desk: Desk, program: Program) -> None:
    """A link to the report of a program, if it has one below the folder of the desk."""
    report = program.result.get("report")
    if not report:
        return
    path = (program.folder / Path(report)).resolve()
    folder = desk.folder.resolve()
    if path.is_relative_to(folder):
        address = f"/file/{path.relative_to(folder)}"
        ui.link("Open the report", address, new_tab=True).mark("report")
