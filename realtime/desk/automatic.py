"""Automatic mode: starts sequences and campaigns, and shows their messages, progress and reports.

Each of them is a program with a `rollerrig` command line (see `programs`).
"""

from pathlib import Path

from nicegui import ui

from rollerrig.configs import store
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.manual import carry_out, confirmed
from rollerrig.realtime.desk.programs import Program

_LINES_SHOWN = 14
_PROGRAMS_SHOWN = 6
# colours of lines by their first word, and of the result
_COLOURS = {"pass": "#009e73", "fail": "#d55e00", "error": "#d55e00"}
# by exit status
_RESULTS = {0: "passed", 1: "a verdict failed", 4: "interrupted, or a run is not valid"}


def build(desk: Desk) -> None:
    """Put the controls, and the programs that have been started, into the page."""
    with ui.row().classes("w-full no-wrap items-start gap-4 desk-rows"):
        with ui.card().classes("desk-card").style("width: 26rem; max-width: 100%"):
            _sequences(desk)
            ui.separator()
            _campaigns(desk)
        place = ui.column().classes("grow gap-4")
    _programs(desk, place)


def _sequences(desk: Desk) -> None:
    """The controls that play sequences."""
    ui.label("Sequences").classes("desk-title")
    names = ui.select(
        [*store.names("sequences"), *store.names_of_vehicles("sequences")],
        multiple=True,
        value=["emergency_120"],
        label="sequences (none: all of the coach)",
    )
    names.classes("w-full").props("use-chips").mark("sequences")
    unit = ui.select(["", *desk.units], value="", label="WSP unit (empty: as in the sequence)")
    unit.classes("w-full")
    pacing = ui.select(["lockstep", "wall"], value="lockstep", label="pacing")
    pacing.classes("w-full").mark("pacing")

    async def play() -> None:
        chosen = list(names.value or [])
        report = desk.free_report(chosen[0] if len(chosen) == 1 else "sequences")
        words = ["sequence", "--steps"]
        words += ["--out", report]
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
    """Keep the list of programs in `place` up to date; runs of the manual mode are not in it.

    A card stays as long as its program is shown, so that its button does not vanish under a press.
    """
    cards: dict[int, _ProgramCard] = {}  # by the process
    with place:
        nothing = ui.label("Nothing has been started here yet.").classes("desk-small")

    def follow() -> None:
        programs = [program for program in desk.programs if program.words[0] != "run"]
        nothing.set_visibility(not programs)
        shown = programs[-_PROGRAMS_SHOWN:]
        for program in shown:
            if program.pid not in cards:
                with place:
                    cards[program.pid] = _ProgramCard(desk, program)
                # the newest is on top
                cards[program.pid].card.move(place, 0)
            cards[program.pid].follow()
        for pid in set(cards) - {program.pid for program in shown}:
            cards.pop(pid).card.delete()

    ui.timer(1.0, follow)
    follow()


class _ProgramCard:
    """The card of one program: title and result, progress, last messages, report, error."""

    def __init__(self, desk: Desk, program: Program) -> None:
        self._desk = desk
        self._program = program
        self._shown = ""  # the state that the page shows
        self._stopping = False
        self.card = ui.card().classes("w-full desk-card")
        with self.card:
            with ui.row().classes("w-full items-center"):
                ui.label(program.title).classes("desk-title grow")
                self._stop = ui.button("Stop", on_click=self._ask).props("dense color=grey-8")
                self._stop.mark("stop-program")
                self._result = ui.label().mark("program-result")
            self._bar = ui.linear_progress(0.0, show_value=False)
            self._place = ui.column().classes("w-full gap-0")

    async def _ask(self) -> None:
        if await confirmed(
            "Stop this program?",
            "The run that is under way is lost. Those that are finished are kept, with a report.",
            "Stop the program",
        ):
            self._stopping = True
            self._program.stop()
            self.follow()

    def follow(self) -> None:
        """Show the present state of the program."""
        program = self._program
        status = program.status
        lines = program.lines
        state = f"{status} {self._stopping} {len(lines)} {lines[-1:]}"
        if state == self._shown:
            return
        self._shown = state
        self._stop.set_visibility(status is None)
        self._bar.set_visibility(status is None)
        if status is None:
            self._result.text = "is being stopped ..." if self._stopping else ""
            share = program.share
            self._bar.value = share or 0.0
            self._bar.props(remove="indeterminate" if share else "")
            self._bar.props("instant-feedback" if share else "indeterminate")
        else:
            colour = _COLOURS["pass" if status == 0 else "fail"]
            self._result.text = _RESULTS.get(status, f"status {status}")
            self._result.style(f"color: {colour}")
        self._place.clear()
        with self._place:
            for line in lines[-_LINES_SHOWN:]:
                colour = _COLOURS.get(line.split()[0], "inherit")
                ui.label(line).classes("desk-line").style(f"color: {colour}")
            _report_link(self._desk, program)
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
