"""Manual mode: prepare a bench, start and stop it, set demand, speed and adhesion, inject and lift faults.

Each control calls `tell` with a command of the desk or its doors; what is refused is shown in the bench's own words.
"""

import math
from collections.abc import Awaitable
from functools import partial
from typing import Any

from nicegui import ui

from rollerrig.configs import store
from rollerrig.configs.errors import RollerrigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.desk.desk import Desk
from rollerrig.wsp_interface import signals

UNITS = ("reference", "external", "none")
_AXLES = range(1, signals.AXLES + 1)
_HIGHEST_BAR, _HIGHEST_KM_H = 10.0, 300.0
_AS_IT_IS = ""


async def tell(what: Awaitable[Any], done: str = "") -> bool:
    """Carry a command out; say what came of it. Whether it went."""
    client = ui.context.client  # what was clicked may be gone when the answer comes
    try:
        await what
    except RollerrigError as error:
        with client:
            ui.notify(
                str(error), type="negative", multi_line=True, close_button=True, timeout=15_000
            )
        return False
    if done:
        with client:
            ui.notify(done, type="positive")
    return True


def frictions() -> dict[float, str]:
    """Friction that can be set under an axle by hand: kinematic friction mu_cd, and its name; 0: the scenario's."""
    named = {
        store.parse(store.find("adhesion", name))["adhesion"]["mu_cd"]: name
        for name in ("dry", "wet", "soap")
    }
    return {
        0.0: "as the scenario has it",
        **{mu: f"{name} ({mu:g})" for mu, name in named.items()},
        0.065: "0.065",
        0.03: "0.03",
    }


def build(desk: Desk) -> None:
    """Put the controls into the page."""
    _bench(desk)
    _run(desk)
    _set_points(desk)
    _adhesion(desk)
    _faults(desk)


def _card(title: str) -> ui.card:
    card = ui.card().classes("w-full desk-card")
    with card:
        ui.label(title).classes("desk-title")
    return card


def _bench(desk: Desk) -> None:
    with _card("1  Bench"):
        scenario = _named(store.names("scenarios"), "velim_a1", "scenario, or a TOML file").classes(
            "w-full"
        )
        chosen: dict[str, ui.select] = {}
        with ui.grid(columns=2).classes("w-full gap-2"):
            for key, kind in (("rig", "rigs"), ("adhesion", "adhesion")):
                chosen[key] = ui.select(
                    {_AS_IT_IS: "as the scenario has it"} | {one: one for one in store.names(kind)},
                    value=_AS_IT_IS,
                    label=key,
                ).mark(key)
            unit = _named(list(UNITS), "reference", "WSP unit, or fmu:FILE")
            chosen["rig.drives"] = ui.select(
                {
                    _AS_IT_IS: "as the rig has it",
                    "rig": "rig control",
                    "bus": "a master on the bus",
                },
                value=_AS_IT_IS,
                label="drives obey",
            ).mark("drives")
        more = ui.input("further values, as in adhesion.mu_cd=0.05").classes("w-full").mark("more")

        async def prepare() -> None:
            values = {key: str(one.value or "") for key, one in chosen.items()}
            await tell(
                desk.prepare(str(scenario.value), str(unit.value), values, str(more.value or "")),
                "the bench is being prepared: it will roll, held, until it is started",
            )

        ui.button("Prepare", on_click=prepare).props("color=primary").classes("w-full").mark(
            "prepare"
        )


def _named(names: list[str], value: str, label: str) -> ui.select:
    """One of some names, or another that is typed."""
    return ui.select(names, value=value, label=label, with_input=True, new_value_mode="add-unique")


def _run(desk: Desk) -> None:
    with _card("2  Run"), ui.row().classes("w-full no-wrap gap-2"):
        start = ui.button("Start", on_click=lambda: tell(_write(desk, "run", 1.0), "started"))
        start.props("color=positive").classes("grow").mark("start")
        stop = ui.button("Stop", on_click=lambda: tell(_write(desk, "stop", 1.0), "the run ends"))
        stop.props("color=grey-8").classes("grow").mark("stop")

        def follow() -> None:
            start.set_enabled(desk.held())
            stop.set_enabled(desk.running())

        ui.timer(0.5, follow)


async def _write(desk: Desk, name: str, value: float) -> None:
    await desk.door().write(name, value)


def _set_points(desk: Desk) -> None:
    with _card("Set-points"):
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            bar = ui.number(
                "brake demand, bar", value=3.8, min=0.0, max=_HIGHEST_BAR, step=0.1, format="%.2f"
            )
            bar.classes("grow").mark("demand")
            ui.button(
                "Set",
                on_click=lambda: tell(
                    _brake(desk, _given(bar) * 1e5), f"demand {_given(bar):.2f} bar"
                ),
            ).mark("set-demand")
            ui.button(
                "As programmed",
                on_click=lambda: tell(
                    _brake(desk, math.nan), "demand as node 17 or the scenario has it"
                ),
            ).props("flat dense")
        with ui.row().classes("w-full no-wrap items-center gap-2"):
            speed = ui.number(
                "roller speed, km/h", value=120.0, min=0.0, max=_HIGHEST_KM_H, step=5.0
            )
            speed.classes("grow").mark("speed")
            ui.button(
                "Set",
                on_click=lambda: tell(
                    _write(desk, "speed_set_point", _given(speed) / 3.6),
                    f"a held rig rolls at {_given(speed):.0f} km/h",
                ),
            ).mark("set-speed")
            ui.label("while held").classes("desk-small")


def _given(field: ui.number) -> float:
    return float(field.value) if field.value is not None else 0.0


async def _brake(desk: Desk, pressure_Pa: float) -> None:
    await desk.free_door().brake(pressure_Pa)


def _adhesion(desk: Desk) -> None:
    with (
        _card("Adhesion under the axles: friction mu_cd"),
        ui.grid(columns=2).classes("w-full gap-2"),
    ):
        for axle in _AXLES:
            chosen = ui.select(frictions(), value=0.0, label=f"axle {axle}").mark(
                f"friction-{axle}"
            )
            chosen.on_value_change(partial(_friction, desk, chosen, axle))


async def _friction(desk: Desk, chosen: ui.select, axle: int) -> None:
    mu = float(chosen.value or 0.0)

    async def ask() -> None:
        await desk.free_door().ask(lambda harness: harness.friction(mu, (axle,)))

    await tell(ask(), f"axle {axle}: {frictions()[mu]}")


def _faults(desk: Desk) -> None:
    with _card("Faults"):
        kind = (
            ui.select(
                {one.name: f"{one.name}: {one.text}" for one in catalogue.CATALOGUE},
                label="fault",
                value=catalogue.CATALOGUE[0].name,
                with_input=True,
            )
            .classes("w-full")
            .mark("fault")
        )
        fields: dict[str, ui.number] = {}
        place = ui.grid(columns=2).classes("w-full gap-2")

        def parameters() -> None:
            place.clear()
            fields.clear()
            with place:
                for row in catalogue.BY_NAME[str(kind.value)].parameters:
                    fields[row.name] = (
                        ui.number(row.name, value=row.default, min=row.low, max=row.high)
                        .tooltip(f"{row.source}; {row.low:g} to {row.high:g}")
                        .mark(f"fault-{row.name}")
                    )
                fields["for"] = ui.number("for s (empty: until lifted)", min=0.001).mark(
                    "fault-for"
                )

        kind.on_value_change(parameters)
        parameters()

        async def inject() -> None:
            values = " ".join(
                f"{name}={_plain(field.value)}"
                for name, field in fields.items()
                if field.value is not None
            )
            await _fault(desk, f"{kind.value} {values}", lift=False)

        ui.button("Inject", on_click=inject).props("color=warning text-color=black").classes(
            "w-full"
        ).mark("inject")
        active = ui.column().classes("w-full gap-1")
        shown: list[str] = []

        def follow() -> None:
            now = desk.bench.faults if desk.bench and not desk.bench.ended else []
            if now != shown:
                shown[:] = now
                active.clear()
                with active:
                    for text in now:
                        with ui.row().classes("w-full no-wrap items-center"):
                            ui.label(text).classes("grow desk-active")
                            ui.button("Lift", on_click=partial(_fault, desk, text, True)).props(
                                "flat dense"
                            ).mark("lift")

        ui.timer(0.5, follow)


def _plain(value: float) -> str:
    """A number as a fault's text has it: whole ones without a point."""
    return f"{int(value)}" if float(value).is_integer() else f"{value:g}"


async def _fault(desk: Desk, text: str, lift: bool) -> None:
    async def ask() -> None:
        await desk.free_door().ask(lambda harness: (harness.lift if lift else harness.inject)(text))

    await tell(ask(), f"{'lifted' if lift else 'injected'}: {text}")
