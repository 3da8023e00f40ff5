"""The summary of a run: stop, axles, WSP, air, loop and buses, from what was recorded.

The stop lasts from the first sample to the first sample at standstill. Means and standard
deviations of sliding are over all its samples, as in the paper's Table 6; what only the bench
knows (ticks, frames, requests) comes as counters and is null where it is not known.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from importlib import metadata
from typing import Any

import numpy as np
import pyarrow as pa
from rich.table import Table

from rollerrig.wsp_interface.signals import AXLES, BY_NAME, columns

STANDSTILL_M_S = 0.01


def of(columns: pa.Table | Mapping[str, Any], counters: Mapping[str, Any],
       scenario: Mapping[str, Any]) -> dict[str, Any]:
    """The summary of recorded channels: the keys of INTERFACES section 4, and a few more.

    `columns` by the names of the table of signals, each of shape (n,). `counters` may hold
    version, config_hash, scenario, pacing, seed, unit, ended, and the tables loop, bus and modbus.
    `scenario` is the resolved one. The same input gives the same output.
    """
    channels = _Channels(columns)
    speed, time_s = channels.get("vehicle_speed_m_s"), channels.get("time_s")
    still = np.flatnonzero(speed <= STANDSTILL_M_S)
    # a vehicle that stands at the first sample has not been driven, let alone stopped
    stopped = bool(still.size and still[0] > 0)
    end = int(still[0]) if stopped else len(speed) - 1
    stop = slice(0, end + 1)
    position = channels.get("position_m")
    loop = scenario.get("loop", {})
    text = json.dumps(scenario, sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode()).hexdigest()[:16]
    bus = {"frames": None, "dropped": None, "load_percent": None}
    return {
        "version": counters.get("version") or metadata.version("rollerrig"),
        "config_hash": counters.get("config_hash") or digest,
        "scenario": counters.get("scenario"),
        "title": scenario.get("title") or None,
        "pacing": counters.get("pacing"),
        "seed": counters.get("seed"),
        "ended": counters.get("ended", "finished"),
        "tick_hz": loop.get("tick_hz"),
        "step_s": loop.get("step_s"),
        "samples": len(speed),
        "duration_s": _span(time_s, len(time_s) - 1),
        "initial_speed_m_s": _number(speed[0]) if len(speed) else None,
        "stop_time_s": _span(time_s, end) if stopped else None,
        "stop_distance_m": _span(position, end) if stopped else None,
        "stopped": stopped,
        "axles": [_axle(channels, j, stop) for j in range(1, AXLES + 1)],
        "wsp": _wsp(channels, stop, counters),
        "tracking": _tracking(channels, stop),
        "air_consumption_NL": _last(channels.get("air_consumption_NL")),
        "loop": _loop(channels, counters, loop),
        "bus": bus | dict(counters.get("bus") or {}),
        "modbus": {"requests": None} | dict(counters.get("modbus") or {}),
        "recorder": {"lost": 0} | dict(counters.get("recorder") or {}),
    }


class _Channels:
    """Columns as arrays; one that was not recorded is NaN throughout."""

    def __init__(self, columns: pa.Table | Mapping[str, Any]) -> None:
        self._columns = columns
        self._names = set(columns.column_names if isinstance(columns, pa.Table) else columns)

    def get(self, name: str) -> np.ndarray:
        if name in self._names:
            return np.asarray(self._columns[name], dtype=np.float64)
        return np.full(len(self.get("time_s")) if name != "time_s" else 0, np.nan)


def _axle(channels: _Channels, axle: int, stop: slice) -> dict[str, Any]:
    sliding = channels.get(f"sliding_{axle}_m_s")[stop]
    work = channels.get(f"sliding_work_{axle}_J")[stop]
    return {
        "sliding_mean_m_s": _of(np.mean, sliding),
        "sliding_std_m_s": _of(np.std, sliding),
        "sliding_max_m_s": _of(np.max, sliding),
        "longest_lock_s": _last(channels.get(f"longest_lock_{axle}_s")[stop]),
        "dissipated_energy_J": _number(work[-1] - work[0]) if len(work) else None,
        "adhesion_mean": _of(np.mean, channels.get(f"adhesion_{axle}")[stop]),
        "vents": _whole(_last(channels.get(f"vents_{axle}"))),
    }


def _wsp(channels: _Channels, stop: slice, counters: Mapping[str, Any]) -> dict[str, Any]:
    """How long any dump valve did not fill, and how often one began to vent, all axles together."""
    time_s = channels.get("time_s")[stop]
    valves = np.array([channels.get(f"valve_{axle}")[stop] for axle in range(1, AXLES + 1)])
    acting = np.any(valves > 0.5, axis=0)[:-1] if len(time_s) > 1 else np.zeros(0, dtype=bool)
    vents = [_whole(_last(channels.get(f"vents_{axle}"))) for axle in range(1, AXLES + 1)]
    known = [count for count in vents if count is not None]
    return {
        "unit": counters.get("unit"),
        "active_s": _number(np.sum(np.diff(time_s)[acting])) if acting.size else 0.0,
        "vents": sum(known) if len(known) == AXLES else None,
    } | dict(counters.get("wsp") or {})


def _tracking(channels: _Channels, stop: slice) -> dict[str, Any]:
    """How well the motors held what they were to hold, all axles: largest error and rms in m/s."""
    errors = np.concatenate([channels.get(name)[stop] for name in columns(BY_NAME["tracking_error"])])
    errors = errors[np.isfinite(errors)]
    if not errors.size:
        return {"max_m_s": None, "rms_m_s": None}
    return {"max_m_s": float(np.abs(errors).max()), "rms_m_s": float(np.sqrt(np.mean(errors**2)))}


def _loop(channels: _Channels, counters: Mapping[str, Any],
          loop: Mapping[str, Any]) -> dict[str, Any]:
    """The bench's own count; without it what the samples tell (a killed run)."""
    time_s, lateness = channels.get("time_s"), channels.get("tick_lateness_us")
    told = {
        "ticks": round(time_s[-1] * loop["tick_hz"]) if len(time_s) and "tick_hz" in loop else None,
        "missed": _whole(_last(channels.get("ticks_missed"))),
        "lateness_us": {"p50": None, "p99": None, "p999": None, "max": _of(np.max, lateness)},
    }
    return told | dict(counters.get("loop") or {})


def _of(what: Any, values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return _number(what(known)) if known.size else None


def _number(value: Any) -> float | None:
    return float(value) if math.isfinite(value) else None


def _last(values: np.ndarray) -> float | None:
    return _number(values[-1]) if len(values) else None


def _whole(value: float | None) -> int | None:
    return None if value is None else round(value)


def _span(values: np.ndarray, end: int) -> float | None:
    return _number(values[end] - values[0]) if len(values) else None


def table(summary: Mapping[str, Any]) -> Table:
    """The summary for a terminal: a rich table of the axles under a line on the stop."""
    shown = Table(title=_headline(summary), title_justify="left", caption=_footline(summary),
                  caption_justify="left")
    for name in ("axle", "sliding m/s", "std", "max", "lock s", "energy MJ", "adhesion", "vents"):
        shown.add_column(name, justify="right")
    for number, axle in enumerate(summary["axles"], start=1):
        energy = axle["dissipated_energy_J"]
        shown.add_row(
            str(number), _show(axle["sliding_mean_m_s"]), _show(axle["sliding_std_m_s"]),
            _show(axle["sliding_max_m_s"]), _show(axle["longest_lock_s"]),
            _show(None if energy is None else energy / 1e6), _show(axle["adhesion_mean"], 4),
            _show(axle.get("vents"), 0))
    return shown


def _headline(summary: Mapping[str, Any]) -> str:
    speed = f"from {_show(summary['initial_speed_m_s'], 1)} m/s"
    name = summary["scenario"] or summary.get("title") or "run"
    if summary["stopped"]:
        return (f"{name}: stopped {speed} in {_show(summary['stop_time_s'])} s and "
                f"{_show(summary['stop_distance_m'], 1)} m")
    return f"{name}: not stopped {speed} after {_show(summary.get('duration_s'))} s"


def _footline(summary: Mapping[str, Any]) -> str:
    wsp, loop, bus = summary["wsp"], summary["loop"], summary["bus"]
    late = loop["lateness_us"]
    return (
        f"WSP {wsp['unit'] or '-'}: active {_show(wsp['active_s'])} s, "
        f"{_show(wsp['vents'], 0)} vents, air {_show(summary['air_consumption_NL'], 1)} NL\n"
        f"loop: {_show(loop['ticks'], 0)} ticks, {_show(loop['missed'], 0)} missed, late "
        f"p50 {_show(late['p50'], 0)} p99 {_show(late['p99'], 0)} max {_show(late['max'], 0)} us\n"
        f"bus: {_show(bus['frames'], 0)} frames, {_show(bus['dropped'], 0)} dropped, "
        f"load {_show(bus['load_percent'], 1)} %{_more(bus)}; Modbus: "
        f"{_show(summary['modbus']['requests'], 0)} requests")


def _more(bus: Mapping[str, Any]) -> str:
    waits = bus.get("longest_wait_us")
    stray = bus.get("stray_syncs")
    return ((f", longest wait {waits:.0f} us" if waits is not None else "")
            + (f", {stray} stray SYNCs" if stray else ""))


def _show(value: float | None, places: int = 2) -> str:
    return "-" if value is None else f"{value:.{places}f}"
