"""Parts of the page that depend on the vehicle, such as those with a control for each axle."""

from collections.abc import Callable

from nicegui import ui

from rollerrig.realtime.desk.desk import Desk
from rollerrig.wsp_interface.signals import Table

# time between two looks at the vehicle of the desk
_FOLLOW_S = 0.5


def build(desk: Desk, part: Callable[[Table], None]) -> None:
    """Put a part into the page, and build it again whenever the desk shows another vehicle.

    `part` builds it for the signals of a vehicle.
    """
    place = ui.column().classes("w-full gap-1 desk-of-vehicle")
    shown: Table | None = None

    def follow() -> None:
        nonlocal shown
        if desk.table is shown:
            return
        shown = desk.table
        place.clear()
        with place:
            part(shown)

    ui.timer(_FOLLOW_S, follow)
    follow()
