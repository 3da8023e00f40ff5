"""Automatic mode: starts sequences, programmes, campaigns and trains; shows progress and reports.

Each of them is a program with a `rollerrig` command line (see `programs`).
"""

from pathlib import Path

from nicegui import ui

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.desk.desk import Desk
from rollerrig.realtime.desk.manual import carry_out, confirmed
from rollerrig.realtime.desk.programs import Program

_LINES_SHOWN = 14
_PROGRAMS_SHOWN = 6
# colours of lines by their first word, and of the result (desk.css)
_COLOURS = {"pass": "var(--good)", "fail": "var(--bad)", "error": "var(--bad)"}
# by exit status
_RESULTS = {0: "passed", 1: "a verdict failed", 4: "interrupted, or a run is not valid"}
# entries of the title block that have a field, with the label of the field
_ENTRIES = {
    "document number": "document number",
    "revision": "revision",
    "unit under test": "unit under test",
    "tested by": "operator (tested by)",
}
# under which the desk keeps the other entries
_FURTHER = "further entries"
_AS_PLAYED = ""


def build(desk: Desk) -> None:
    """Put the controls, and the programs that have been started, into the page."""
    with ui.row().classes("w-full no-wrap items-start gap-2 desk-rows"):
        with ui.column().classes("gap-2").style("width: 26rem; max-width: 100%; flex: none"):
            title_block = _TitleBlock(desk)
            _sequences(desk, title_block)
            _programme(desk, title_block)
            _campaigns(desk, title_block)
            _trains(desk)
        place = ui.column().classes("grow gap-2").style("min-width: 0")
    _programs(desk, place)


class _TitleBlock:
    """The fields of the title block of the next report, and whether it is written as PDF too."""

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        with ui.card().classes("w-full desk-card"):
            ui.label("Title block of the next report").classes("desk-title")
            with ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0"):
                for name, label in _ENTRIES.items():
                    field = ui.input(label).mark(f"about-{name}")
                    field.bind_value(desk.about, name)
            with ui.row().classes("w-full no-wrap items-end gap-2"):
                further = ui.textarea(
                    "further entries, one a line", placeholder="checked by=A. Meier"
                )
                further.bind_value(desk.about, _FURTHER)
                further.props("dense stack-label rows=1 autogrow").classes("grow")
                further.mark("about-further")
                self._pdf = ui.checkbox("PDF").props("dense").mark("pdf")

    def words(self) -> list[str]:
        """Return the options of the command line. Raises ConfigError for an unusable entry."""
        about = self._desk.about
        entries = [f"{name}={about[name]}" for name in _ENTRIES if (about.get(name) or "").strip()]
        entries += [
            line.strip() for line in (about.get(_FURTHER) or "").splitlines() if line.strip()
        ]
        for entry in entries:
            if not entry.isprintable():
                raise ConfigError(f"title block: {entry!r} has a control character; remove it")
            if "=" not in entry:
                raise ConfigError(
                    f"title block: {entry!r} has no '='; write WHAT=TEXT, as in checked by=A. Meier"
                )
        # in one word, so that no entry can become an option
        words = [f"--about={entry}" for entry in entries]
        return [*words, "--pdf"] if self._pdf.value else words


def _unit_choice(desk: Desk, label: str) -> ui.select:
    """Return the field that chooses the WSP unit of a program."""
    labels = {_AS_PLAYED: label, **{unit: unit for unit in desk.units}}
    return ui.select(labels, value=_AS_PLAYED, label="WSP unit").classes("w-full")


def _unit_words(desk: Desk, unit: str) -> list[str]:
    """Return the option for a unit. Raises ConfigError if the unit is not allowed."""
    return [f"--wsp={desk.checked(unit)}"] if unit else []


def _file_choice(desk: Desk, kind: str, packaged: list[str], label: str) -> ui.select:
    """Return the field that chooses a packaged file of a kind, or one of the user."""
    return ui.select(
        [*desk.own_files(kind), *packaged],
        value=packaged[0],
        label=label,
        with_input=True,
        new_value_mode="add-unique",
    )


def _sequences(desk: Desk, title_block: _TitleBlock) -> None:
    """The controls that play sequences."""
    with ui.card().classes("w-full desk-card"):
        ui.label("Sequences").classes("desk-title")
        packaged = [*store.names("sequences"), *store.names_of_vehicles("sequences")]
        names = ui.select(
            [*desk.own_files("sequences"), *packaged],
            multiple=True,
            value=["emergency_120"],
            label="sequences or files (none: all of the coach)",
            with_input=True,
            new_value_mode="add-unique",
        )
        names.classes("w-full").props("use-chips").mark("sequences")
        with ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0"):
            unit = _unit_choice(desk, "as in the sequence")
            pacing = ui.select(["lockstep", "wall"], value="lockstep", label="pacing")
            pacing.mark("pacing")

        async def play() -> None:
            chosen = [str(name) for name in names.value or []]
            for name in chosen:
                desk.check_file("sequence", name)
            stem = Path(chosen[0]).stem if len(chosen) == 1 else "sequences"
            words = ["sequence", "--steps", "--out", desk.free_report(stem)]
            words += ["--pacing", str(pacing.value)]
            words += _unit_words(desk, str(unit.value))
            desk.start([*words, *title_block.words(), "--", *chosen])

        button = ui.button("Play", on_click=lambda: carry_out(play(), "started"))
        button.props("color=primary").classes("w-full").mark("play")


def _programme(desk: Desk, title_block: _TitleBlock) -> None:
    """The controls that play a test programme."""
    with ui.card().classes("w-full desk-card"):
        ui.label("Test programme").classes("desk-title")
        packaged = [*store.names("programmes"), *store.names_of_vehicles("programmes")]
        with ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0"):
            name = _file_choice(desk, "programmes", packaged, "programme or file")
            name.mark("programme")
            unit = _unit_choice(desk, "reference")

        async def play() -> None:
            chosen = str(name.value)
            desk.check_file("programme", chosen)
            words = ["programme", "--out", f"programmes/{Path(chosen).stem}"]
            words += _unit_words(desk, str(unit.value))
            desk.start([*words, *title_block.words(), "--", chosen])

        button = ui.button("Play programme", on_click=lambda: carry_out(play(), "started"))
        button.props("color=primary").classes("w-full").mark("play-programme")
        ui.label("What was played before with the same unit is kept.").classes("desk-small")


def _campaigns(desk: Desk, title_block: _TitleBlock) -> None:
    """The controls that run a campaign."""
    with ui.card().classes("w-full desk-card"):
        ui.label("Campaign").classes("desk-title")
        plans = store.names("campaigns")
        plan = ui.select(plans, value=plans[0], label="plan").classes("w-full")

        async def run() -> None:
            words = ["campaign", "--out", f"campaigns/{plan.value}", *title_block.words()]
            desk.start([*words, "--", str(plan.value)])

        button = ui.button("Run", on_click=lambda: carry_out(run(), "started"))
        button.props("color=primary").classes("w-full").mark("campaign")
        ui.label("A campaign that was begun earlier continues.").classes("desk-small")


def _trains(desk: Desk) -> None:
    """The controls that run a train, with reference units or with a unit on one of its cars."""
    with ui.card().classes("w-full desk-card"):
        ui.label("Train").classes("desk-title")
        name = _file_choice(desk, "trains", store.names("trains"), "train or file")
        name.classes("w-full").mark("train")
        with ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0"):
            labels = {"free": "free: no bus", "lockstep": "lockstep", "wall": "wall: real time"}
            pacing = ui.select(labels, value="free", label="pacing").mark("train-pacing")
            unit = ui.select(desk.units, value="reference", label="WSP unit").mark("train-unit")
            cars = ui.input("cars with this unit", value="all", placeholder="2, or 1,3, or all")
            cars.bind_enabled_from(pacing, "value", backward=lambda value: value != "free")
            cars.mark("train-cars")
            more = ui.input("further values", placeholder="train.delay_s=0.2").mark("train-more")
            more.props("stack-label")

        async def run() -> None:
            desk.run_train(
                str(name.value),
                str(pacing.value),
                str(unit.value),
                str(cars.value or "").strip(),
                str(more.value or ""),
            )

        button = ui.button("Run the train", on_click=lambda: carry_out(run(), "started"))
        button.props("color=primary").classes("w-full").mark("run-train")
        ui.label(
            "In real time, Manual shows the cars with this unit. The run is under Runs."
        ).classes("desk-small")


def _programs(desk: Desk, place: ui.column) -> None:
    """Keep the list of programs in `place` up to date; runs of the manual mode are not in it.

    A card stays as long as its program is shown, so that its button does not vanish under a press.
    """
    cards: dict[int, _ProgramCard] = {}  # by the process
    with place:
        nothing = ui.label("Nothing has been started here yet.").classes("desk-small")

    def follow() -> None:
        programs = [program for program in desk.programs if not program.is_bench]
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
            self._bar.props('aria-label="progress of this program"')
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
    """Links to the report of a program and its PDF, if they are in the folder of the desk."""
    folder = desk.folder.resolve()
    for file in _reports(program):
        path = (program.folder / file).resolve()
        if not path.is_relative_to(folder):
            continue
        address = f"/file/{path.relative_to(folder)}"
        if path.suffix == ".pdf":
            # a browser opens no PDF in the sandbox of the desk
            ui.link("Download the PDF", address).props("download").mark("report-pdf")
        else:
            ui.link("Open the report", address, new_tab=True).mark("report")


def _reports(program: Program) -> list[Path]:
    """The pages and PDFs that a program has written; empty while it runs."""
    result = program.result
    named = [result["report"]] if result.get("report") else result.get("files", [])
    pages = [Path(name) for name in named if Path(name).suffix == ".html"]
    printed = [page.with_suffix(".pdf") for page in pages if "--pdf" in program.words]
    return [*pages, *(file for file in printed if (program.folder / file).is_file())]
