"""The page: head with the emergency stop, the state line, the modes behind tabs, alarms; the same for every browser."""

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
_SHOWN = 60


def build(desk: Desk) -> None:
    """Build the page for one browser."""
    ui.add_css(Path(__file__).with_name("desk.css"))
    ui.add_head_html('<script src="/desk/desk.js"></script>')
    ui.dark_mode(True)
    for kind in (ui.select, ui.number, ui.input):
        kind.default_props("dense options-dense")
    ui.colors(
        primary=colours.on_page(colours.BLUE),
        positive=colours.on_page(colours.GREEN),
        negative=colours.on_page(colours.VERMILION),
        warning=colours.on_page(colours.ORANGE),
    )
    _head(desk)
    _state_line(desk)
    with ui.tabs().props("align=left dense") as tabs:
        for name in ("Manual", "Automatic", "Runs"):
            ui.tab(name).mark(f"tab-{name}")
    with ui.tab_panels(tabs, value="Manual").classes("w-full").style("background: transparent"):
        with (
            ui.tab_panel("Manual").classes("p-0"),
            ui.row().classes("w-full no-wrap items-start gap-4"),
        ):
            with ui.column().classes("gap-3").style("width: 23rem; flex: none"):
                manual.build(desk)
            with ui.column().classes("grow gap-1").style("min-width: 0"):
                live.build()
            with ui.column().classes("gap-2").style("width: 21rem; flex: none"):
                _alarms(desk)
        with ui.tab_panel("Automatic").classes("p-0"):
            automatic.build(desk)
        with ui.tab_panel("Runs").classes("p-0"):
            read = runs.build(desk)
    tabs.on_value_change(lambda: read() if tabs.value == "Runs" else None)


def _head(desk: Desk) -> None:
    with ui.row().classes("w-full items-center no-wrap gap-6"):
        ui.label("rollerrig desk").style("font-size: 22px; font-weight: 600; white-space: nowrap")
        bench = ui.label().classes("grow").mark("bench")
        ui.label(NO_SAFETY).classes("desk-small").style("max-width: 26rem").mark("no-safety")

        async def toggle() -> None:
            on = not (desk.doors and desk.doors.values.get("emergency_stop"))

            async def ask() -> None:
                await desk.door().write("emergency_stop", float(on))

            await manual.tell(ask(), "emergency stop " + ("asked for" if on else "reset"))

        button = (
            ui.button("Emergency stop", on_click=toggle)
            .props("color=negative size=lg")
            .mark("emergency")
        )

        def follow() -> None:
            bench.text = _told(desk)
            stopped = bool(desk.doors and desk.doors.values.get("emergency_stop"))
            button.text = "Reset emergency stop" if stopped else "Emergency stop"
            button.props(f"color={'orange-10' if stopped else 'negative'}")

        ui.timer(0.5, follow)
        follow()


def _told(desk: Desk) -> str:
    """The bench in a sentence."""
    starting = [one for one in desk.programs if one.words[0] == "run" and one.status is None]
    if desk.bench is None or desk.doors is None:
        return (
            "the bench is being prepared: kernels, bus, unit ..."
            if starting
            else "no bench runs on this machine: prepare one, or start one with rollerrig run"
        )
    bench = desk.bench
    if bench.ended:
        how = "has ended" if bench.ended == "closed" else "was killed"
        return f"the bench (process {bench.pid}) {how} at {bench.time_s:.1f} s" + (
            "; another is being prepared" if starting else "; its run stands under Runs"
        )
    state = desk.doors.state
    what = (
        state.name.lower()
        if state is not None
        else "running, without Modbus"
        if bench.points
        else "starting (a first start compiles its kernels, for minutes)"
    )
    return f"bench (process {bench.pid}) on {bench.bus or 'no bus'}: {what}"


def _state_line(desk: Desk) -> None:
    shown: list[tuple[ui.html, ui.label]] = []
    with ui.row().classes("w-full gap-2"):
        for name in lights.NAMES:
            with ui.element("div").classes("desk-light").mark(f"light-{name}"):
                shown.append((ui.html(sanitize=False), ui.label().classes("desk-small")))

    def follow() -> None:
        for (head, why), one in zip(
            shown, lights.line(desk.bench, desk.doors, desk.folder), strict=True
        ):
            colour = colours.on_page(_LIGHTS[one.colour])
            head.content = f'<span class="desk-dot" style="background:{colour}" title="{one.colour}"></span>{one.name}'
            why.text = one.why

    ui.timer(1.0, follow)
    follow()


def _alarms(desk: Desk) -> None:
    ui.label("Alarms").classes("desk-title")
    place = ui.column().classes("w-full gap-1")
    shown: list[tuple[int, str]] = []

    def follow() -> None:
        alarms = list(desk.alarms)[:_SHOWN]
        state = [(id(one), one.acknowledged) for one in alarms]
        if state == shown and shown:
            return
        shown[:] = state
        place.clear()
        with place:
            if not alarms:
                ui.label("none").classes("desk-small")
            for one in alarms:
                _alarm(desk, one)

    ui.timer(0.5, follow)
    follow()


def _alarm(desk: Desk, alarm: Alarm) -> None:
    colour = colours.on_page(colours.VERMILION if alarm.level == "error" else colours.YELLOW)
    border = colours.on_page(colours.GREY) if alarm.acknowledged else colour
    with (
        ui.row()
        .classes("w-full no-wrap items-start gap-1")
        .style(f"border-left: 4px solid {border}; padding-left: 8px")
        .mark("alarm")
    ):
        at = f"{alarm.time_s:.2f} s  " if alarm.time_s == alarm.time_s else ""
        ui.label(f"{at}{alarm.text}").classes("grow").style(
            "font-size: 12px; overflow-wrap: anywhere"
        )
        if alarm.acknowledged:
            ui.label(f"acknowledged {alarm.acknowledged}").classes("desk-small")
        else:
            ui.button(icon="check", on_click=lambda: manual.tell(desk.acknowledge(alarm))).props(
                "flat dense size=sm"
            ).tooltip("acknowledge").mark("acknowledge")
