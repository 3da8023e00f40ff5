"""What is drawn beside the recorded signals, computed from rows of them: slip, decelerations, faults, the filled band.

Slip is told in percent of the reference speed of the unit, or of the vehicle's where the unit tells none. The band
between the limits of adhesion is a curve that goes from one to the other at every sample: Rerun fills no areas.
"""

import contextlib
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import validity
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import INFO, Code, Event
from rollerrig.wsp_interface.sequences import measures

_SLOWEST_M_S = 1.0  # below it a percentage of the speed tells nothing
_BANDS = ("band_low_m_s", "band_low_fraction", "band_high_m_s", "band_high_fraction")


class Curve(NamedTuple):
    """One entity of scalars: its path, how each series is drawn, and its values (n, series) of rows (n, columns)."""

    path: str
    names: tuple[str, ...]
    colours: tuple[tuple[int, ...], ...]
    width: float
    of: Callable[[np.ndarray], np.ndarray]


def curves(scenario: Mapping[str, Any], unit: str, band: bool = True) -> list[Curve]:
    """All that can be drawn of a run: its resolved scenario, and which unit protected it; with or without the band."""
    found = [
        Curve(
            f"/slip/axle_{axle}",
            (f"axle {axle}",),
            (shade,),
            1.5,
            lambda rows, axle=axle: _slip(rows, axle),
        )
        for axle, shade in enumerate(colours.AXLES, start=1)
    ]
    found += [
        Curve(
            f"/adhesion/band_{axle}",
            ("f_d to f_r",),
            ((*colours.LIMIT, 70),),
            1.0,
            lambda rows, axle=axle: _between(rows, axle),
        )
        for axle in range(1, signals.AXLES + 1)
        if band
    ]
    with contextlib.suppress(ConfigError, KeyError):
        bands = [float(store.load("wsp", scenario["wsp_config"])[0][key]) for key in _BANDS]
        if unit == "reference":
            found.append(
                Curve(
                    "/slip/bands",
                    ("band of the unit, low", "high"),
                    (colours.REFERENCE,) * 2,
                    0.8,
                    lambda rows: _bands(rows, bands),
                )
            )
    record = measures.Record({}, (), {}, scenario)
    with contextlib.suppress(KeyError, ZeroDivisionError):
        measures.demanded_m_s2(record, 0.0, 0.0)
        found.append(
            Curve(
                "/acceleration/demanded",
                ("demanded",),
                (colours.REFERENCE,),
                1.5,
                lambda rows: _demanded(rows, record),
            )
        )
    return found


def _demanded(rows: np.ndarray, record: measures.Record) -> np.ndarray:
    pressure, speed = (rows[:, signals.column(name)] for name in ("brake_demand", "vehicle_speed"))
    return np.where(speed > 0.0, measures.demanded_m_s2(record, pressure, speed), 0.0)[
        :, np.newaxis
    ]


def _reference(rows: np.ndarray) -> np.ndarray:
    told, true = (
        rows[:, signals.column(name)] for name in ("wsp_reference_speed", "vehicle_speed")
    )
    speed = np.where(np.isfinite(told), told, true)
    return np.where(speed >= _SLOWEST_M_S, speed, np.nan)


def _slip(rows: np.ndarray, axle: int) -> np.ndarray:
    reference = _reference(rows)
    rim = rows[:, signals.column("wheel_circumferential_speed", axle)]
    return (100.0 * (reference - rim) / reference)[:, np.newaxis]


def _bands(rows: np.ndarray, bands: list[float]) -> np.ndarray:
    reference = _reference(rows)
    return np.column_stack(
        [100.0 * np.minimum(speed / reference, share) for speed, share in (bands[:2], bands[2:])]
    )


def _between(rows: np.ndarray, axle: int) -> np.ndarray:
    low, high = (
        rows[:, signals.column(name, axle)] for name in ("adhesion_degraded", "adhesion_recovered")
    )
    return np.where(np.arange(len(rows)) % 2, high, low)[:, np.newaxis]


def box(summary: Mapping[str, Any]) -> str:
    """The result of a run in a few lines of Markdown."""

    def number(value: Any, places: int, factor: float = 1.0) -> str:
        return "–" if value is None else f"{factor * value:.{places}f}"

    axles = summary.get("axles") or []
    locks = [one["longest_lock_s"] for one in axles if one.get("longest_lock_s") is not None]
    begun = number(summary.get("initial_speed_m_s"), 0, 3.6)
    how = (
        f"**{number(summary['stop_distance_m'], 0)} m** in **{number(summary['stop_time_s'], 1)} s** "
        f"from {begun} km/h"
        if summary.get("stopped")
        else f"**not stopped** from {begun} km/h"
    )
    valid = (
        "**valid**"
        if not (why := validity.because(summary))
        else f"**NOT VALID**: {'; '.join(why)}"
    )
    wsp = summary.get("wsp") or {}
    return "\n\n".join(
        (
            f"#### {summary.get('title') or summary.get('scenario') or 'run'}",
            f"{how} · {valid}",
            f"longest lock {number(max(locks, default=None), 2)} s · {number(wsp.get('vents'), 0)} vents · "
            f"air {number(summary.get('air_consumption_NL'), 0)} NL · unit {wsp.get('unit') or '–'}",
        )
    )


def marks(events: Iterable[Event]) -> list[Event]:
    """Return the events that the plots of speeds mark: faults, warnings and errors."""
    return [one for one in events if one.level != INFO or one.code == Code.FAULT_LIFTED]


def of_network(event: Event) -> bool:
    """Return whether an event is about the network itself, which matters least."""
    return event.code in (Code.NMT_STATE, Code.BUS_PLACE)
