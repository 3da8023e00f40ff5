"""Automatic mode: sequences and campaigns as their command lines, with what they say, their progress and report."""

from pathlib import Path

from nicegui import ui

from rollerrig.configs import store
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.manual import UNITS, tell
from rollerrig.realtime.desk.programs import Program

_LINES = 14
_COLOURS = {"pass": "#009e73", "fail": "#d55e00", "error": "#d55e00"}


def build(desk: Desk) -> None:
    """Put the controls, and the programs that have been started, into the page."""
    with ui.row().classes("w-full no-wrap items-start gap-4"):
        with ui.card().classes("desk-card").style("width: 26rem"):
            ui.label("Sequences").classes("desk-title")
            names = (
                ui.select(
                    store.names("sequences"),
                    multiple=True,
                    value=["emergency_120"],
                    label="sequences (none: the whole library)",
                )
                .classes("w-full")
                .props("use-chips")
                .mark("sequences")
            )
            unit = ui.select(
                ["", *UNITS], value="", label="WSP unit (empty: what the sequence says)"
            ).classes("w-full")
            pacing = (
                ui.select(["lockstep", "wall"], value="lockstep", label="pacing")
                .classes("w-full")
                .mark("pacing")
            )

            async def play() -> None:
                chosen = list(names.value or [])
                report = f"reports/{chosen[0] if len(chosen) == 1 else 'sequences'}"
                words = [
                    "sequence",
                    *chosen,
                    "--steps",
                    "--out",
                    report,
                    "--pacing",
                    str(pacing.value),
                ]
                await tell(
                    _start(desk, words + (["--wsp", str(unit.value)] if unit.value else [])),
                    "started",
                )

            ui.button("Play", on_click=play).props("color=primary").classes("w-full").mark("play")
            ui.separator()
            ui.label("Campaign").classes("desk-title")
            plans = store.names("campaigns")
            plan = ui.select(plans, value=plans[0], label="plan").classes("w-full")
            ui.button(
                "Run",
                on_click=lambda: tell(
                    _start(desk, ["campaign", str(plan.value), "--out", f"campaigns/{plan.value}"]),
                    "started",
                ),
            ).props("color=primary").classes("w-full").mark("campaign")
            ui.label("A campaign that was begun is gone on with.").classes("desk-small")
        place = ui.column().classes("grow gap-4")
    shown: dict[int, str] = {}

    def follow() -> None:
        programs = [one for one in desk.programs if one.words[0] != "run"]
        state = {one.pid: f"{one.status} {len(one.lines)}" for one in programs}
        if state == shown:
            return
        shown.clear()
        shown.update(state)
        place.clear()
        with place:
            if not programs:
                ui.label("Nothing has been started here yet.").classes("desk-small")
            for program in reversed(programs[-6:]):
                _program(desk, program)

    ui.timer(1.0, follow)
    follow()


async def _start(desk: Desk, words: list[str]) -> None:
    desk.start(words)


def _program(desk: Desk, program: Program) -> None:
    status, share = program.status, program.share
    with ui.card().classes("w-full desk-card"):
        with ui.row().classes("w-full items-center"):
            ui.label(program.title).classes("desk-title grow")
            if status is None:
                ui.button("Stop", on_click=program.stop).props("flat dense")
            else:
                ui.label(
                    {0: "passed", 1: "a verdict failed"}.get(status, f"status {status}")
                ).style(f"color: {_COLOURS['pass' if status == 0 else 'fail']}")
        if status is None:
            ui.linear_progress(share or 0.0, show_value=False).props(
                "instant-feedback" if share else "indeterminate"
            )
        for line in program.lines[-_LINES:]:
            ui.label(line).classes("desk-line").style(
                f"color: {_COLOURS.get(line.split()[0], 'inherit')}"
            )
        if report := program.result.get("report"):
            path = (program.folder / Path(report)).resolve()
            if path.is_relative_to(desk.folder.resolve()):
                ui.link(
                    "Open the report",
                    f"/file/{path.relative_to(desk.folder.resolve())}",
                    new_tab=True,
                ).mark("report")
        if program.error:
            ui.label(program.error).style(f"color: {_COLOURS['error']}")
