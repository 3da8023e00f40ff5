"""The page: head with bench and emergency stop, state line, the modes behind tabs, and alarms.

Every browser has the same page; each one is built separately.
"""

from pathlib import Path

from nicegui import ui

from rollerrig.realtime.desk import automatic, lights, live, manual, runs
from rollerrig.realtime.desk.desk import Alarm, Desk
from rollerrig.realtime.pictures import colours

NO_SAFETY = (
    "This page has no safety function: its emergency stop is a request over a network. "
    "What protects people is the rig's own emergency stop."
)
_LIGHTS = {
    lights.GREEN: colours.GREEN,
    lights.YELLOW: colours.YELLOW,
    lights.RED: colours.VERMILION,
    lights.GREY: colours.GREY,
}
# what the lights show besides their colours
_SIGNS = {lights.GREEN: "✓", lights.YELLOW: "!", lights.RED: "✕", lights.GREY: "?"}
_ALARMS_SHOWN = 60
# buttons with white text, whose contrast is above 4.5 (WCAG 2.2, 1.4.3)
_STOP = "#b3140a"
_GO = "#00694c"
# of the page, in this order
SCRIPTS = ("desk.js", "connection.js")


def build(desk: Desk) -> None:
    """Build the page for one browser."""
    ui.add_css(Path(__file__).with_name("desk.css"))
    for script in SCRIPTS:
        ui.add_head_html(f'<script src="/desk/{script}"></script>')
    ui.dark_mode(None)  # as the system
    ui.context.client.content.classes("desk-page")
    for kind in (ui.select, ui.number, ui.input):
        kind.default_props("dense options-dense")
    ui.colors(
        primary=colours.as_hex(colours.BLUE),
        positive=_GO,
        negative=_STOP,
        warning=colours.as_hex(colours.ORANGE),
    )
    tabs = _head(desk)
    _state_line(desk)
    with ui.tab_panels(tabs, value="Manual", animated=False).classes("w-full desk-panels"):
        with ui.tab_panel("Manual").classes("p-0"):
            _manual(desk)
        with ui.tab_panel("Automatic").classes("p-0"):
            automatic.build(desk)
        with ui.tab_panel("Runs").classes("p-0"):
            read_runs = runs.build(desk)

    def on_tab() -> None:
        if tabs.value == "Runs":
            read_runs()

    tabs.on_value_change(on_tab)


def _manual(desk: Desk) -> None:
    """The three parts of the manual mode; desk.css places them.

    Left the controls of the bench, right faults and alarms, between them the live view.
    """
    with ui.element("div").classes("desk-columns"):
        with ui.column().classes("gap-2 desk-controls"):
            manual.build(desk)
        with ui.column().classes("gap-1 desk-live"):
            live.build(desk)
        with ui.column().classes("gap-2 desk-side"):
            manual.build_faults(desk)
            _alarms(desk)


# -- the head


def _head(desk: Desk) -> ui.tabs:
    """Name, tabs, bench, warning and the buttons of the emergency stop, which stay in view."""
    with ui.element("header").classes("desk-head"):
        ui.html("rollerrig desk", sanitize=False, tag="h1").classes("desk-name")
        with ui.tabs().props("align=left dense no-caps") as tabs:
            for name in ("Manual", "Automatic", "Runs"):
                ui.tab(name).mark(f"tab-{name}")
        with ui.column().classes("gap-0 desk-bench"):
            bench = ui.label().mark("bench")
            _bench_choice(desk)
            ui.label(NO_SAFETY).classes("desk-small").mark("no-safety")
        _emergency_stop(desk)

        def follow() -> None:
            bench.text = _bench_sentence(desk)

        ui.timer(0.5, follow)
        follow()
    return tabs


def _bench_choice(desk: Desk) -> None:
    """The field that chooses the bench of the desk, shown while there is a choice."""
    benches = ui.select({}, label="choose the bench of this desk").classes("w-full").mark("benches")

    def follow() -> None:
        names = {bench.key: bench.name for bench in desk.choices}
        benches.set_visibility(bool(names))
        if names != benches.options:
            benches.set_options(names, value=None)

    async def choose() -> None:
        if benches.value is None:
            return
        await manual.carry_out(_follow(desk, str(benches.value)), "this desk belongs to it now")

    benches.on_value_change(choose)
    ui.timer(0.5, follow)
    follow()


async def _follow(desk: Desk, key: str) -> None:
    desk.follow(key)


def _emergency_stop(desk: Desk) -> None:
    """The button that requests the emergency stop, and the button that resets it.

    They are two commands, so that a press too many never resets a stop. A reset must be confirmed.
    """
    confirmed_stops = 0

    async def stop() -> None:
        dialog.close()
        await manual.carry_out(desk.emergency_stop(), "emergency stop requested")

    def ask() -> None:
        nonlocal confirmed_stops
        confirmed_stops = desk.stops
        dialog.open()

    async def reset() -> None:
        dialog.close()
        await manual.carry_out(desk.reset_emergency_stop(confirmed_stops), "emergency stop reset")

    with ui.dialog() as dialog, ui.card().classes("desk-card"):
        ui.label("Reset the emergency stop?").classes("desk-title")
        ui.label("The rig may be started again afterwards. Make sure that it is safe.")
        with ui.row().classes("w-full justify-end gap-2"):
            keep = ui.button("Keep stopped", on_click=dialog.close)
            keep.props("autofocus").mark("keep-stopped")
            confirm = ui.button("Confirm reset", on_click=reset)
            confirm.props("color=warning text-color=black").mark("confirm-reset")
    dialog.mark("reset-question")
    button = ui.button("Emergency stop", on_click=stop).props("color=negative")
    button.mark("emergency")
    reset_button = ui.button("Reset emergency stop", on_click=ask)
    reset_button.props("color=warning text-color=black")
    reset_button.mark("reset-emergency")

    def follow() -> None:
        reset_button.set_enabled(desk.stopped)

    ui.timer(0.5, follow)
    follow()


def _bench_sentence(desk: Desk) -> str:
    """The state of the bench in a sentence."""
    preparing = any(program.is_bench and program.status is None for program in desk.programs)
    bench = desk.bench
    doors = desk.doors
    if bench is None or doors is None:
        if desk.choices:
            return f"{len(desk.choices)} benches run on this machine: choose the bench of this desk"
        if preparing:
            return "the bench is being prepared: kernels, bus, unit ..."
        return "no bench runs on this machine: prepare one, or start one with rollerrig run"

    if bench.ended:
        how = "has ended" if bench.ended == "closed" else "was killed"
        then = "its run is under Runs"
        if preparing:
            then = "another is being prepared"
        elif desk.choices:
            then = "choose the next bench of this desk"
        return f"the bench ({bench.name}) {how} at {bench.time_s:.1f} s; {then}"

    if doors.state is not None:
        state = doors.state.name.lower()
    elif bench.points:
        state = "running, without Modbus"
    else:
        state = "starting (a first start compiles its kernels, for minutes)"
    return f"bench ({bench.name}) on {bench.bus or 'no bus'}: {state}"


# -- lights


def _state_line(desk: Desk) -> None:
    """A light for each part of the bench."""
    places: list[tuple[ui.html, ui.label]] = []  # of the name and of the reason of each light
    with ui.element("div").classes("desk-lights"):
        for name in lights.NAMES:
            with ui.element("div").classes("desk-light").mark(f"light-{name}"):
                places.append((ui.html(sanitize=False), ui.label().classes("desk-small")))

    def follow() -> None:
        state = lights.line(desk.bench, desk.doors, desk.folder)
        for (head, reason), light in zip(places, state, strict=True):
            colour = colours.as_hex(_LIGHTS[light.colour])
            dot = (
                f'<span class="desk-dot" style="background:{colour}" title="{light.colour}">'
                f"{_SIGNS[light.colour]}</span>"
            )
            head.content = f"{dot}{light.name}"
            reason.text = light.why
            # where the reason does not fit, the pointer shows all of it
            reason.props["title"] = light.why

    ui.timer(1.0, follow)
    follow()


# -- alarms


def _alarms(desk: Desk) -> None:
    """The alarms of the followed bench, the newest first; below, those of earlier runs.

    An alarm belongs to the run in which it was raised.
    """
    with ui.card().classes("w-full desk-card desk-list desk-alarms").props("tabindex=0"):
        ui.label("Alarms of this run").classes("desk-title")
        place = ui.column().classes("w-full gap-1").mark("alarms")
        earlier = ui.expansion("Earlier runs").classes("w-full desk-small").mark("earlier-alarms")
        with earlier:
            earlier_place = ui.column().classes("w-full gap-1")
    shown: list[tuple[int, str, bool]] = []

    def follow() -> None:
        alarms = list(desk.alarms)[:_ALARMS_SHOWN]
        state = [(id(alarm), alarm.acknowledged, desk.is_present(alarm)) for alarm in alarms]
        if state == shown and shown:
            return
        shown[:] = state
        present = [alarm for alarm in alarms if desk.is_present(alarm)]
        former = [alarm for alarm in alarms if not desk.is_present(alarm)]
        place.clear()
        with place:
            if not present:
                ui.label("none").classes("desk-small")
            for alarm in present:
                _alarm(desk, alarm)
        earlier.text = f"Earlier runs: {len(former)} alarms"
        earlier.set_visibility(bool(former))
        earlier_place.clear()
        with earlier_place:
            run = ""
            for alarm in former:
                if alarm.run != run:
                    run = alarm.run
                    ui.label(run).classes("desk-small")
                _alarm(desk, alarm)

    ui.timer(0.5, follow)
    follow()


def _alarm(desk: Desk, alarm: Alarm) -> None:
    """One alarm, with a button that acknowledges it."""
    colour = colours.as_hex(colours.VERMILION if alarm.level == "error" else colours.YELLOW)
    border = colours.as_hex(colours.GREY) if alarm.acknowledged else colour
    row = ui.row().classes("w-full no-wrap items-start gap-1")
    row.style(f"border-left: 4px solid {border}; padding-left: 8px").mark("alarm")
    with row:
        # the word says what the colour says
        text = f"{alarm.level}: {alarm.text}"
        if not alarm.of_desk:
            text = f"{alarm.time_s:.2f} s  {text}"
        label = ui.label(text).classes("grow")
        label.style("font-size: 12px; overflow-wrap: anywhere")
        if alarm.acknowledged:
            ui.label(f"acknowledged {alarm.acknowledged}").classes("desk-small")
        else:
            button = ui.button(
                icon="check", on_click=lambda: manual.carry_out(desk.acknowledge(alarm))
            )
            button.props('flat dense size=sm aria-label="acknowledge"').tooltip("acknowledge").mark(
                "acknowledge"
            )
