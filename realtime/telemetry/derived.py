"""Curves, marks and the result of a run, which Rerun shows with the recorded signals.

The curves are slip, the control limits of the unit, the demanded deceleration, and the band between
the limits of adhesion. Slip is in percent of the reference speed of the unit, or of the speed of
the vehicle where the unit sends no reference speed.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import played, validity
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.events import INFO, Code, Event
from rollerrig.wsp_interface.sequences import measures
from rollerrig.wsp_interface.sequences.record import Record
from rollerrig.wsp_interface.signals import Table

# m/s. Below this speed a percentage of the speed means nothing.
_SLOWEST_M_S = 1.0

_KM_H_PER_M_S = 3.6

# opacity of the band between the limits of adhesion, of 255
_BAND_OPACITY = 70

# what the text of a result shows for an unknown value
_UNKNOWN = "–"


class Curve(NamedTuple):
    """An entity of scalars: its path, and name and colour of each of its series.

    `values` computes them, shape (n, series), from rows of all signals, shape (n, signals.WIDTH).
    """

    path: str
    names: tuple[str, ...]
    colours: tuple[tuple[int, ...], ...]
    width: float
    values: Callable[[np.ndarray], np.ndarray]


# --- curves ---


def curves(table: Table, scenario: Mapping[str, Any], unit: str, band: bool = True) -> list[Curve]:
    """Return all curves of a run: of its vehicle, its resolved scenario and its unit.

    `band` adds the band between the limits of adhesion.
    """
    shown = [_slip_curve(axle) for axle in table.axles]
    if band:
        shown += [_adhesion_band_curve(axle) for axle in table.axles]
    if unit == "reference":
        shown += _control_limit_curves(scenario)
    return shown + _demanded_deceleration_curves(scenario)


def _slip_curve(axle: int) -> Curve:
    return Curve(
        path=f"/slip/axle_{axle}",
        names=(f"axle {axle}",),
        colours=(colours.AXLES[axle - 1],),
        width=1.5,
        values=lambda rows: _slip_percent(rows, axle),
    )


def _adhesion_band_curve(axle: int) -> Curve:
    return Curve(
        path=f"/adhesion/band_{axle}",
        names=("f_d to f_r",),
        colours=((*colours.LIMIT, _BAND_OPACITY),),
        width=1.0,
        values=lambda rows: _between_limits(rows, axle),
    )


class _ControlLimit(NamedTuple):
    """A limit of slip of the reference unit: the smaller of a speed difference and a share."""

    speed_m_s: float
    share: float


def _control_limit_curves(scenario: Mapping[str, Any]) -> list[Curve]:
    """Return the curve of both limits of the reference unit; none if its settings are unknown."""
    try:
        settings, _ = store.load("wsp", scenario["wsp_config"])
        low = _ControlLimit(float(settings["band_low_m_s"]), float(settings["band_low_fraction"]))
        high = _ControlLimit(
            float(settings["band_high_m_s"]), float(settings["band_high_fraction"])
        )
    except (ConfigError, KeyError):
        return []
    curve = Curve(
        path="/slip/bands",
        names=("band of the unit, low", "high"),
        colours=(colours.REFERENCE, colours.REFERENCE),
        width=0.8,
        values=lambda rows: _limits_percent(rows, (low, high)),
    )
    return [curve]


def _demanded_deceleration_curves(scenario: Mapping[str, Any]) -> list[Curve]:
    """Return the curve of the demanded deceleration; none if the scenario has no complete brake."""
    record = Record({}, (), {}, scenario)
    try:
        measures.demanded_m_s2(record, 0.0, 0.0)
    except (KeyError, ZeroDivisionError):
        return []
    curve = Curve(
        path="/acceleration/demanded",
        names=("demanded",),
        colours=(colours.REFERENCE,),
        width=1.5,
        values=lambda rows: _demanded_m_s2(rows, record),
    )
    return [curve]


# --- values of the curves, shape (n, series) ---


def _reference_speed_m_s(rows: np.ndarray, axle: int = 1) -> np.ndarray:
    """Return the speed to which the slip of an axle refers, shape (n,); NaN where it is too low."""
    name = signals.reference_speed_name(signals.group_of_axle(axle))
    of_unit = rows[:, signals.column(name)]
    of_vehicle = rows[:, signals.column("vehicle_speed")]
    speed = np.where(np.isfinite(of_unit), of_unit, of_vehicle)
    return np.where(speed >= _SLOWEST_M_S, speed, np.nan)


def _slip_percent(rows: np.ndarray, axle: int) -> np.ndarray:
    reference = _reference_speed_m_s(rows, axle)
    wheel = rows[:, signals.column("wheel_circumferential_speed", axle)]
    slip = 100.0 * (reference - wheel) / reference
    return slip[:, np.newaxis]


def _limits_percent(rows: np.ndarray, limits: tuple[_ControlLimit, ...]) -> np.ndarray:
    reference = _reference_speed_m_s(rows)
    percent = [100.0 * np.minimum(limit.speed_m_s / reference, limit.share) for limit in limits]
    return np.column_stack(percent)


def _demanded_m_s2(rows: np.ndarray, record: Record) -> np.ndarray:
    pressure = rows[:, signals.column("brake_demand")]
    speed = rows[:, signals.column("vehicle_speed")]
    demanded = np.where(speed > 0.0, measures.demanded_m_s2(record, pressure, speed), 0.0)
    return demanded[:, np.newaxis]


def _between_limits(rows: np.ndarray, axle: int) -> np.ndarray:
    """Return f_d and f_r alternately: Rerun does not fill areas, but such a curve looks filled."""
    low = rows[:, signals.column("adhesion_degraded", axle)]
    high = rows[:, signals.column("adhesion_recovered", axle)]
    is_odd = np.arange(len(rows)) % 2
    return np.where(is_odd, high, low)[:, np.newaxis]


# --- the result ---


def result_text(summary: Mapping[str, Any]) -> str:
    """Return the result of a run in a few lines of Markdown."""
    name = summary.get("title") or summary.get("scenario") or "run"
    paragraphs = (
        f"#### {name}",
        f"{_stop_text(summary)} · {_validity_text(summary)}",
        _wsp_text(summary),
        _played_text(summary),
    )
    return "\n\n".join(paragraphs)


def _stop_text(summary: Mapping[str, Any]) -> str:
    initial_km_h = _number(summary.get("initial_speed_m_s"), 0, _KM_H_PER_M_S)
    if not summary.get("stopped"):
        return f"**not stopped** from {initial_km_h} km/h"
    kind = "stop" if summary.get("braking_distance_m") is None else "braking"
    beginning = "the start" if kind == "stop" else "the brake demand"
    distance_m = _number(summary[f"{kind}_distance_m"], 0)
    time_s = _number(summary[f"{kind}_time_s"], 1)
    return f"**{distance_m} m** in **{time_s} s** after {beginning}, from {initial_km_h} km/h"


def _validity_text(summary: Mapping[str, Any]) -> str:
    reasons = validity.because(summary)
    if reasons:
        return f"**NOT VALID**: {'; '.join(reasons)}"
    return "**valid**"


def _wsp_text(summary: Mapping[str, Any]) -> str:
    locks_s = []
    for axle in summary.get("axles") or []:
        lock_s = axle.get("longest_lock_s")
        if lock_s is not None:
            locks_s.append(lock_s)
    wsp = summary.get("wsp") or {}
    return (
        f"longest lock {_number(max(locks_s, default=None), 2)} s · "
        f"{_number(wsp.get('vents'), 0)} vents · "
        f"air {_number(summary.get('air_consumption_NL'), 0)} NL"
    )


def _played_text(summary: Mapping[str, Any]) -> str:
    facts = played.of_summary(summary).facts()
    # the line on the stop states whether the run is valid
    del facts["valid"]
    return " · ".join(f"{name} {text}" for name, text in facts.items())


def _number(value: float | None, places: int, factor: float = 1.0) -> str:
    if value is None:
        return _UNKNOWN
    return f"{factor * value:.{places}f}"


# --- events ---


def to_be_marked(events: Iterable[Event]) -> list[Event]:
    """Return the events that the plots of speeds mark: faults, warnings and errors."""
    return [event for event in events if event.level != INFO or event.code == Code.FAULT_LIFTED]


def is_of_network(event: Event) -> bool:
    """Return whether an event is about the network itself. Such events have a separate tab."""
    return event.code in (Code.NMT_STATE, Code.BUS_PLACE)
