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
_ALARMS_SHOWN = 60


def build(desk: Desk) -> None:
    """Build the page for one browser."""
    ui.add_css(Path(__file__).with_name("desk.css"))
    ui.add_head_html('<script src="/desk/desk.js"></script>')
    ui.dark_mode(True)
    for kind in (ui.select, ui.number, ui.input):
        kind.default_props("dense options-dense")
    ui.colors(
        primary=colours.as_hex(colours.BLUE),
        positive=colours.as_hex(colours.GREEN),
        negative=colours.as_hex(colours.VERMILION),
        warning=colours.as_hex(colours.ORANGE),
    )
    _head(desk)
    _state_line(desk)
    with ui.tabs().props("align=left dense") as tabs:
        for name in ("Manual", "Automatic", "Runs"):
            ui.tab(name).mark(f"tab-{name}")
    with ui.tab_panels(tabs, value="Manual").classes("w-full").style("background: transparent"):
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
    """The three columns of the manual mode: controls, live view, alarms."""
    with ui.row().classes("w-full no-wrap items-start gap-4"):
        with ui.column().classes("gap-3").style("width: 23rem; flex: none"):
            manual.build(desk)
        with ui.column().classes("grow gap-1").style("min-width: 0"):
            live.build()
        with ui.column().classes("gap-2").style("width: 21rem; flex: none"):
            _alarms(desk)


# -- the head


def _head(desk: Desk) -> None:
    """Name, bench, warning, and the buttons of the emergency stop."""
    with ui.row().classes("w-full items-center no-wrap gap-6"):
        ui.label("rollerrig desk").style("font-size: 22px; font-weight: 600; white-space: nowrap")
        with ui.column().classes("grow gap-0"):
            bench = ui.label().mark("bench")
            _bench_choice(desk)
        ui.label(NO_SAFETY).classes("desk-small").style("max-width: 26rem").mark("no-safety")
        _emergency_stop(desk)

        def follow() -> None:
            bench.text = _bench_sentence(desk)

        ui.timer(0.5, follow)
        follow()


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
            confirm.props("color=orange-10").mark("confirm-reset")
    dialog.mark("reset-question")
    button = ui.button("Emergency stop", on_click=stop).props("color=negative size=lg")
    button.mark("emergency")
    reset_button = ui.button("Reset emergency stop", on_click=ask).props("color=orange-10 outline")
    reset_button.mark("reset-emergency")

    def follow() -> None:
        reset_button.set_enabled(desk.stopped)

    ui.timer(0.5, follow)
    follow()


def _bench_sentence(desk: Desk) -> str:
    """The state of the bench in a sentence."""
    preparing = any(
        program.words[0] == "run" and program.status is None for program in desk.programs
    )
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
    with ui.row().classes("w-full gap-2"):
        for name in lights.NAMES:
            with ui.element("div").classes("desk-light").mark(f"light-{name}"):
                places.append((ui.html(sanitize=False), ui.label().classes("desk-small")))

    def follow() -> None:
        state = lights.line(desk.bench, desk.doors, desk.folder)
        for (head, reason), light in zip(places, state, strict=True):
            colour = colours.as_hex(_LIGHTS[light.colour])
            dot = (
                f'<span class="desk-dot" style="background:{colour}" title="{light.colour}"></span>'
            )
            head.content = f"{dot}{light.name}"
            reason.text = light.why

    ui.timer(1.0, follow)
    follow()


# -- alarms


def _alarms(desk: Desk) -> None:
    """The list of alarms, the newest first."""
    ui.label("Alarms").classes("desk-title")
    place = ui.column().classes("w-full gap-1")
    shown: list[tuple[int, str]] = []

    def follow() -> None:
        alarms = list(desk.alarms)[:_ALARMS_SHOWN]
        state = [(id(alarm), alarm.acknowledged) for alarm in alarms]
        if state == shown and shown:
            return
        shown[:] = state
        place.clear()
        with place:
            if not alarms:
                ui.label("none").classes("desk-small")
            for alarm in alarms:
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
        text = alarm.text if alarm.of_desk else f"{alarm.time_s:.2f} s  {alarm.text}"
        label = ui.label(text).classes("grow")
        label.style("font-size: 12px; overflow-wrap: anywhere")
        if alarm.acknowledged:
            ui.label(f"acknowledged {alarm.acknowledged}").classes("desk-small")
        else:
            button = ui.button(
                icon="check", on_click=lambda: manual.carry_out(desk.acknowledge(alarm))
            )
            button.props("flat dense size=sm").tooltip("acknowledge").mark("acknowledge")
