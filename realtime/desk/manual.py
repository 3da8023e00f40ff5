"""Manual mode: controls that prepare, start and stop a bench, set its values and inject faults.

Each control passes a command of the desk, or of its doors, to `carry_out`. If the bench refuses the
command, the page shows the message of the bench.
"""

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Any

from nicegui import ui

from rollerrig.configs import store
from rollerrig.configs.errors import RollerrigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.desk import vehicle
from rollerrig.realtime.desk.desk import Desk
from rollerrig.wsp_interface.signals import Table

# largest values that the fields accept
_HIGHEST_BAR = 10.0
_HIGHEST_KM_H = 300.0
_PA_PER_BAR = 1e5
_KM_H_PER_M_S = 3.6
# an error message disappears after this time
_ERROR_SHOWN_MS = 15_000
# time between two looks at the state of the bench
_FOLLOW_S = 0.5
# the choice that leaves a value as it is in the scenario
_UNCHANGED = ""


async def carry_out(command: Awaitable[Any], done: str = "") -> bool:
    """Carry out a command and show the text `done`, or the error; return whether it succeeded."""
    # keep the client: the control that was clicked may be gone when the answer comes
    client = ui.context.client
    try:
        await command
    except RollerrigError as error:
        with client:
            ui.notify(
                str(error),
                type="negative",
                multi_line=True,
                close_button=True,
                timeout=_ERROR_SHOWN_MS,
            )
        return False
    if done:
        with client:
            ui.notify(done, type="positive")
    return True


async def confirmed(question: str, consequence: str, yes: str) -> bool:
    """Ask whether something that would be lost shall be done; return the answer."""
    with ui.dialog() as dialog, ui.card().classes("desk-card"):
        ui.label(question).classes("desk-title")
        ui.label(consequence)
        with ui.row().classes("w-full justify-end gap-2"):
            keep = ui.button("Go back", on_click=lambda: dialog.submit(False))
            keep.props("autofocus").mark("confirm-no")
            go_on = ui.button(yes, on_click=lambda: dialog.submit(True))
            go_on.props("color=warning text-color=black").mark("confirm-yes")
    dialog.mark("question")
    answer = await dialog
    dialog.delete()
    return bool(answer)


def frictions() -> dict[float, str]:
    """Return the kinematic frictions mu_cd that can be set under an axle, with their labels.

    0 restores the friction of the scenario.
    """
    labels = {0.0: "scenario"}
    for name in ("dry", "wet", "soap"):
        mu = store.parse(store.find("adhesion", name))["adhesion"]["mu_cd"]
        labels[mu] = f"{name} ({mu:g})"
    for mu in (0.065, 0.03):
        labels[mu] = f"{mu:g}"
    return labels


def build(desk: Desk) -> None:
    """Put the controls of the bench, its set-points and the friction into the page."""
    _bench(desk)
    _set_points(desk)
    _adhesion(desk)


def _card(title: str) -> ui.card:
    card = ui.card().classes("w-full desk-card")
    with card:
        ui.label(title).classes("desk-title")
    return card


# -- the bench and its run


def _bench(desk: Desk) -> None:
    """Show the controls that prepare a bench, and those that start and stop its run."""
    with _card("Bench and run"):
        # a page that is opened later shows what the bench was prepared with
        before = desk.prepared
        settings: dict[str, ui.select] = {}
        with ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0"):
            scenario = _choice_or_text(
                store.names("scenarios"), before.get("scenario", "velim_a1"), "scenario or file"
            )
            unit = _choice_or_text(desk.units, before.get("unit", "reference"), "WSP unit")
            for key, kind in (("rig", "rigs"), ("adhesion", "adhesion")):
                labels = {_UNCHANGED: "as in the scenario"}
                labels |= {name: name for name in store.names(kind)}
                chosen = before.get(key, _UNCHANGED)
                settings[key] = ui.select(labels, value=chosen, label=key).mark(key)
            labels = {
                _UNCHANGED: "as in the rig",
                "rig": "rig control",
                "bus": "a master on the bus",
            }
            chosen = before.get("rig.drives", _UNCHANGED)
            drives = ui.select(labels, value=chosen, label="drives obey").mark("drives")
            settings["rig.drives"] = drives
            more = ui.input(
                "further values", placeholder="adhesion.mu_cd=0.05", value=before.get("more", "")
            )
            more.props("stack-label").mark("more")

        async def prepare() -> None:
            values = {key: str(select.value or "") for key, select in settings.items()}
            await carry_out(
                desk.prepare(str(scenario.value), str(unit.value), values, str(more.value or "")),
                "the bench is being prepared: it will roll, held, until it is started",
            )

        with ui.row().classes("w-full no-wrap gap-2"):
            button = ui.button("Prepare", on_click=prepare).props("color=primary")
            button.classes("grow").mark("prepare")
            _run(desk, button)


def _choice_or_text(names: list[str], value: str, label: str) -> ui.select:
    """Return a field that offers names and also accepts any other typed name."""
    offered = names if value in names else [*names, value]
    return ui.select(
        offered, value=value, label=label, with_input=True, new_value_mode="add-unique"
    )


def _run(desk: Desk, prepare: ui.button) -> None:
    """Show the buttons that start and stop the run; each button works only where it has an effect.

    `prepare` is the button that prepares a bench, of which there is one at a time.
    """
    start = ui.button("Start", on_click=lambda: carry_out(_write(desk, "run", 1.0), "started"))
    start.props("color=positive").classes("grow").mark("start")

    async def end() -> None:
        if await confirmed(
            "End the run?",
            "Its record is kept so far, but the run cannot be continued.",
            "End the run",
        ):
            await carry_out(_write(desk, "stop", 1.0), "the run ends")

    stop = ui.button("Stop", on_click=end)
    stop.props("color=grey-8").classes("grow").mark("stop")

    def follow() -> None:
        prepare.set_enabled(not desk.running())
        start.set_enabled(desk.held())
        # a train has no Modbus: its program is stopped in the automatic mode
        stop.set_enabled(desk.running() and not (desk.bench and desk.bench.car))

    ui.timer(_FOLLOW_S, follow)
    follow()


async def _write(desk: Desk, register: str, value: float) -> None:
    await desk.door().write(register, value)


# -- set-points


def _set_points(desk: Desk) -> None:
    """Show the controls of brake demand and roller speed, each with the value in force."""
    with _card("Set-points"):
        _demand(desk)
        _speed(desk)


class _Followed:
    """A field for a set-point that shows a new value in force, also one of another page.

    `value()` returns the value that is set, in the unit of the field, or None if none is.
    """

    def __init__(self, field: ui.number, value: Callable[[], float | None]) -> None:
        self._field = field
        self._value = value
        self._seen: float | None = None

    def follow(self) -> None:
        """Take a value that is new since the last look; what a user is typing is left alone."""
        value = self._value()
        if value is not None and value != self._seen:
            self._field.value = round(value, 3)
        self._seen = value


def _demand(desk: Desk) -> None:
    """Show the controls of the brake demand, and the demand in force."""
    with ui.row().classes("w-full no-wrap items-center gap-2"):
        field = ui.number(
            "brake demand, bar", value=3.8, min=0.0, max=_HIGHEST_BAR, step=0.1, format="%.2f"
        )
        field.classes("grow").mark("demand")

        async def set_demand() -> None:
            bar = _number(field)
            await carry_out(_brake(desk, bar * _PA_PER_BAR), f"demand {bar:.2f} bar")

        async def release() -> None:
            # NaN releases the demand
            done = "the demand comes from node 17 or the scenario again"
            await carry_out(_brake(desk, math.nan), done)

        ui.button("Set", on_click=set_demand).mark("set-demand")
    with ui.row().classes("w-full no-wrap items-center justify-between gap-2"):
        in_force = ui.label().classes("desk-small").mark("demand-in-force")
        programmed = ui.button("As programmed", on_click=release)
        programmed.props("flat dense no-caps no-wrap size=sm").mark("release-demand")
        programmed.style("flex: none")

    def set_bar() -> float | None:
        pressure_Pa = desk.set_point("brake_demand_set_point")
        return None if pressure_Pa is None else pressure_Pa / _PA_PER_BAR

    followed = _Followed(field, set_bar)

    def follow() -> None:
        followed.follow()
        in_force.text = _demand_in_force(desk, set_bar())

    ui.timer(_FOLLOW_S, follow)
    follow()


def _demand_in_force(desk: Desk, set_bar: float | None) -> str:
    """Return which brake demand is in force, and where it comes from."""
    if not desk.bench or not desk.running():
        return "in force: no bench"
    whence = "as programmed" if set_bar is None else f"set to {set_bar:.2f} bar over Modbus"
    present_Pa = desk.bench.value("brake_demand")
    if math.isnan(present_Pa):
        return f"in force: {whence}"
    return f"in force: {present_Pa / _PA_PER_BAR:.2f} bar, {whence}"


async def _brake(desk: Desk, pressure_Pa: float) -> None:
    await desk.free_door().brake(pressure_Pa)


def _speed(desk: Desk) -> None:
    """Show the controls of the roller speed of a held rig, and the speed that is set."""
    with ui.row().classes("w-full no-wrap items-center gap-2"):
        field = ui.number("roller speed, km/h", value=120.0, min=0.0, max=_HIGHEST_KM_H, step=5.0)
        field.classes("grow").mark("speed")

        async def set_speed() -> None:
            km_h = _number(field)
            command = _write(desk, "speed_set_point", km_h / _KM_H_PER_M_S)
            await carry_out(command, f"a held rig rolls at {km_h:.0f} km/h")

        ui.button("Set", on_click=set_speed).mark("set-speed")
        ui.label("while held").classes("desk-small")
    in_force = ui.label().classes("desk-small").mark("speed-in-force")

    def set_km_h() -> float | None:
        speed_m_s = desk.set_point("speed_set_point")
        return None if speed_m_s is None else speed_m_s * _KM_H_PER_M_S

    followed = _Followed(field, set_km_h)

    def follow() -> None:
        followed.follow()
        km_h = set_km_h()
        if km_h is None:
            in_force.text = "in force: not known"
        elif desk.held():
            reached = "reached" if desk.at_set_speed else "the rollers change their speed"
            in_force.text = f"in force: {km_h:.1f} km/h, {reached}"
        else:
            in_force.text = f"the run began at {km_h:.1f} km/h"

    ui.timer(_FOLLOW_S, follow)
    follow()


def _number(field: ui.number) -> float:
    """Return the number in a field, or 0 if the field is empty."""
    return 0.0 if field.value is None else float(field.value)


def _adhesion(desk: Desk) -> None:
    """Show the controls of the friction under each axle."""
    with _card("Friction mu_cd under each axle"):
        vehicle.build(desk, partial(_frictions, desk))


def _frictions(desk: Desk, table: Table) -> None:
    """Show a control for each axle of a vehicle."""
    with ui.element("div").classes("desk-frictions"):
        for axle in table.axles:
            with ui.column().classes("gap-0"):
                _friction(desk, axle)


def _friction(desk: Desk, axle: int) -> None:
    """Show the choice of the friction under an axle, and the friction in force."""
    labels = frictions()
    choice = ui.select(labels, value=desk.frictions.get(axle, 0.0), label=f"axle {axle}")
    choice.classes("w-full").mark(f"friction-{axle}")
    in_force = ui.label().classes("desk-small").mark(f"friction-in-force-{axle}")
    commands_under_way = 0

    async def command() -> None:
        nonlocal commands_under_way
        mu = float(choice.value or 0.0)
        # `follow` has shown what another page has commanded: it is in force already
        if mu == desk.frictions.get(axle, 0.0):
            return
        commands_under_way += 1
        await carry_out(desk.set_friction(axle, mu), f"axle {axle}: {labels[mu]}")
        commands_under_way -= 1

    def follow() -> None:
        if not commands_under_way:
            choice.value = desk.frictions.get(axle, 0.0)
        mu = math.nan
        if desk.bench and desk.running():
            mu = desk.bench.value("friction_degraded", axle)
        in_force.text = "in force: -" if math.isnan(mu) else f"in force: {mu:.3f}"

    choice.on_value_change(command)
    ui.timer(_FOLLOW_S, follow)
    follow()


# -- faults


def build_faults(desk: Desk) -> None:
    """Put the controls that inject a fault, and the list of active faults, into the page."""
    with _card("Faults"):
        vehicle.build(desk, partial(_choose_fault, desk))
        _active_faults(desk)


def _choose_fault(desk: Desk, table: Table) -> None:
    """Show the controls that inject a fault of a vehicle."""
    faults = catalogue.of(table.kind)
    kind = ui.select(
        {row.name: f"{row.name}: {row.text}" for row in faults.values()},
        label="fault",
        value=next(iter(faults)),
        with_input=True,
    )
    kind.classes("w-full").mark("fault")
    fields: dict[str, ui.number] = {}
    place = ui.grid(columns=2).classes("w-full gap-x-2 gap-y-0")

    def show_parameters() -> None:
        place.clear()
        fields.clear()
        with place:
            for row in faults[str(kind.value)].parameters:
                field = ui.number(row.name, value=row.default, min=row.low, max=row.high)
                field.tooltip(f"{row.source}; {row.low:g} to {row.high:g}")
                fields[row.name] = field.mark(f"fault-{row.name}")
            lasting = ui.number("for s", placeholder="until lifted", min=0.001)
            fields["for"] = lasting.props("stack-label").mark("fault-for")

    kind.on_value_change(show_parameters)
    show_parameters()

    async def inject() -> None:
        words = [str(kind.value)]
        for name, field in fields.items():
            if field.value is not None:
                words.append(f"{name}={_plain(field.value)}")
        await _change_fault(desk, " ".join(words), lift=False)

    button = ui.button("Inject", on_click=inject).props("color=warning text-color=black")
    button.classes("w-full").mark("inject")


def _active_faults(desk: Desk) -> None:
    """Show the list of active faults, each with a button that lifts it."""
    place = ui.column().classes("w-full gap-0 desk-active-list").props("tabindex=0")
    shown: list[str] = []

    def follow() -> None:
        active: list[str] = []
        if desk.bench and not desk.bench.ended:
            active = desk.bench.faults
        # build the list again only when it changes
        if active == shown and place.default_slot.children:
            return
        shown[:] = active
        place.clear()
        with place:
            if not active:
                ui.label("no fault is active").classes("desk-small")
            for fault in active:
                with ui.row().classes("w-full no-wrap items-center"):
                    ui.label(fault).classes("grow desk-active")
                    lift = ui.button("Lift", on_click=partial(_change_fault, desk, fault, True))
                    lift.props("flat dense").mark("lift")

    ui.timer(_FOLLOW_S, follow)
    follow()


def _plain(value: float) -> str:
    """Return a number as in the text of a fault: whole numbers have no decimal point."""
    if float(value).is_integer():
        return f"{int(value)}"
    return f"{value:g}"


async def _change_fault(desk: Desk, fault: str, lift: bool) -> None:
    """Lift an active fault, or inject a fault given as a text such as `name parameter=value`."""

    async def command() -> None:
        door = desk.free_door()
        if lift:
            await door.send_as_harness(lambda harness: harness.lift(fault))
        else:
            await door.send_as_harness(lambda harness: harness.inject(fault))

    done = "lifted" if lift else "injected"
    await carry_out(command(), f"{done}: {fault}")
