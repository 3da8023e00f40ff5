"""The summary of a run: stop, axles, WSP, air, loop and buses, from what was recorded.

The stop lasts from the first sample to the first sample at standstill. The braking lasts from the
first brake demand to standstill (`wsp_interface.braking`). Means and standard deviations of sliding
are over all samples of the stop, as in the paper's Table 6. What only the bench knows
(ticks, frames, requests) is passed as counters, and is null where it is not known.
"""

import functools
import hashlib
import json
import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa

from rollerrig.configs.vehicle import Kind, kind_of
from rollerrig.realtime.record import brake_work, channels, played, validity
from rollerrig.wsp_interface import braking, signals
from rollerrig.wsp_interface.events import Event

_UNKNOWN_BUS = {"frames": None, "dropped": None, "load_percent": None}
# columns of the table of axles
_SHOWN = ("sliding_mean_m_s", "sliding_std_m_s", "sliding_max_m_s", "longest_lock_s")
# the signals that a summary reads
_READ = (
    *("time", "position", "vehicle_speed", "brake_demand", "air_consumption", "reservoir_least"),
    *("sliding", "sliding_work", "longest_lock", "flat_length", "adhesion", "vents", "valve"),
    *("tracking_error", "tick_lateness", "ticks_missed"),
)
Channel = Callable[[str], np.ndarray]


def channels_of(kind: Kind) -> tuple[str, ...]:
    """Return the channels that the summary of a kind of vehicle reads."""
    table = signals.table(kind)
    if brake_work.brakes(kind):
        # several brakes need further ones
        return table.columns
    return tuple(column for name in _READ for column in signals.columns(table.by_name[name]))


def of(
    columns: pa.Table | Mapping[str, Any],
    counters: Mapping[str, Any],
    scenario: Mapping[str, Any],
    events: Iterable[Event] = (),
    kind: Kind | None = None,
) -> dict[str, Any]:
    """Return the summary of recorded channels, as in summary.json.

    `columns` has arrays of shape (n,) by the names of the table of signals. `counters` may have
    version, config_hash, scenario, pacing, seed, random, unit, unit_played, ended, and the tables
    loop, bus, modbus and recorder. `scenario` is the resolved one, `events` are all events of the
    run. `kind` is that of the vehicle; default: that of the scenario. The same input gives the same
    output.
    """
    if kind is None:
        kind = kind_of(scenario, "the scenario of the run")
    recorded_names = columns.column_names if isinstance(columns, pa.Table) else columns
    sample_count = len(columns["time_s"]) if "time_s" in recorded_names else 0

    def channel(name: str) -> np.ndarray:
        # a channel that was not recorded is NaN throughout
        if name in recorded_names:
            # samples of a stop in memory are a column of an array, which many passes would stride
            return np.ascontiguousarray(channels.values(columns[name]))
        return np.full(sample_count, np.nan)

    speed_m_s = channel("vehicle_speed_m_s")
    time_s = channel("time_s")
    position_m = channel("position_m")
    standstill = braking.standstill(speed_m_s)
    # a vehicle that stands at the first sample has not moved, so it has not stopped either
    stopped = bool(standstill)
    stop = slice(0, standstill + 1 if standstill else len(speed_m_s))

    stop_time_s = None
    stop_distance_m = None
    braking_time_s = None
    braking_distance_m = None
    if standstill:
        stop_time_s = _span(time_s[stop])
        stop_distance_m = _span(position_m[stop])
        braking_begin = braking.begin(channel("brake_demand_Pa"))
        if braking_begin is not None and braking_begin < standstill:
            braked = slice(braking_begin, stop.stop)
            braking_time_s = _span(time_s[braked])
            braking_distance_m = _span(position_m[braked])

    loop = scenario.get("loop", {})
    found = {
        "version": counters.get("version") or played.version(),
        "config_hash": counters.get("config_hash") or _digest(scenario),
        "scenario": counters.get("scenario"),
        "title": scenario.get("title") or None,
        "vehicle": scenario.get("vehicle_set"),
        "unit_played": counters.get("unit_played") or _unit_played(counters.get("unit")),
        "pacing": counters.get("pacing"),
        "seed": counters.get("seed"),
        "random": counters.get("random"),
        "ended": counters.get("ended", "finished"),
        "tick_hz": loop.get("tick_hz"),
        "step_s": loop.get("step_s"),
        "samples": len(speed_m_s),
        "duration_s": _span(time_s),
        "initial_speed_m_s": _first(speed_m_s),
        "final_speed_m_s": _last(speed_m_s),
        "stop_time_s": stop_time_s,
        "stop_distance_m": stop_distance_m,
        "braking_time_s": braking_time_s,
        "braking_distance_m": braking_distance_m,
        "stopped": stopped,
        "axles": [
            _axle(channel, axle, stop, scenario.get("rig", {}).get("lock_above_m_s"))
            for axle in range(1, kind.axles + 1)
        ],
        "wsp": _counted(
            counters, "wsp", {**_wsp(kind, channel, stop), "unit": counters.get("unit")}
        ),
        "tracking": _tracking(kind, channel, stop),
        "air_consumption_NL": _last(channel("air_consumption_NL")),
        "reservoir_least_Pa": _last(channel("reservoir_least_Pa")),
        "loop": _counted(counters, "loop", _loop(channel, loop)),
        "bus": _counted(counters, "bus", _UNKNOWN_BUS),
        "modbus": _counted(counters, "modbus", {"requests": None}),
        "recorder": _counted(counters, "recorder", {"lost": 0}),
    }
    if brake_work.brakes(kind) and "vehicle" in scenario:
        found["brakes"] = _brakes(kind, channel, scenario["vehicle"]["wheel_radius_m"])
    judgement = validity.judge(found, scenario, events)
    return found | {"valid": not judgement.invalid_because, **judgement._asdict()}


def _unit_played(unit: str | None) -> dict[str, Any] | None:
    """Return the unit of a stop in memory."""
    return None if unit is None else played.unit_of(unit)._asdict()


def _counted(counters: Mapping[str, Any], name: str, recorded: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table of the summary: what was recorded, replaced by the counters of the bench."""
    return {**recorded, **(counters.get(name) or {})}


def _digest(scenario: Mapping[str, Any]) -> str:
    """Return a hash of the scenario of a run whose bench has given none."""
    text = json.dumps(scenario, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _axle(channel: Channel, axle: int, stop: slice, above_m_s: float | None) -> dict[str, Any]:
    """Return the part of the summary on one axle; deep slides count above a speed, if known."""
    sliding = channel(f"sliding_{axle}_m_s")[stop]
    deep_slide_s = None
    if above_m_s is not None and not np.isnan(sliding).any():
        deep = braking.is_deep(sliding, channel("vehicle_speed_m_s")[stop], above_m_s)
        deep_slide_s = braking.longest_stretch_s(channel("time_s")[stop], deep)
    return {
        "sliding_mean_m_s": _statistic(np.mean, sliding),
        "sliding_std_m_s": _statistic(np.std, sliding),
        "sliding_max_m_s": _statistic(np.max, sliding),
        "longest_lock_s": _last(channel(f"longest_lock_{axle}_s")[stop]),
        "longest_deep_slide_s": deep_slide_s,
        "wheel_flat_m": _last(channel(f"flat_length_{axle}_m")),
        "dissipated_energy_J": _span(channel(f"sliding_work_{axle}_J")[stop]),
        "adhesion_mean": _statistic(np.mean, channel(f"adhesion_{axle}")[stop]),
        "vents": _count(channel(f"vents_{axle}")),
    }


def _wsp(kind: Kind, channel: Channel, stop: slice) -> dict[str, Any]:
    """Return how long any dump valve did not fill, and how often all valves began to vent."""
    axles = range(1, kind.axles + 1)
    # a valve is 0 while it fills
    valves = (channel(f"valve_{axle}")[stop] > 0.5 for axle in axles)
    acting = functools.reduce(np.logical_or, valves)[:-1]
    durations_s = np.diff(channel("time_s")[stop])
    counts = [_count(channel(f"vents_{axle}")) for axle in axles]
    known = [count for count in counts if count is not None]
    return {
        "unit": None,
        "active_s": float(np.sum(durations_s[acting])),
        "vents": sum(known) if len(known) == len(counts) else None,
    }


def _brakes(kind: Kind, channel: Channel, radius_m: float) -> dict[str, Any]:
    """Return work, share and largest force of each brake; null where channels were not recorded."""
    found = {}
    for brake, figures in brake_work.of(kind, channel, radius_m).items():
        found[brake] = {
            name: None if value is None else finite(value) for name, value in figures.items()
        }
    return found


def _tracking(kind: Kind, channel: Channel, stop: slice) -> dict[str, Any]:
    """Return the control error of the motors of all axles: largest and rms, in m/s."""
    worst: list[float] = []
    count = 0
    squares = 0.0
    # axle after axle, because a long run has large arrays
    for name in signals.columns(signals.table(kind).by_name["tracking_error"]):
        error = channel(name)[stop]
        error = error[np.isfinite(error)]
        if error.size:
            worst.append(float(np.max(np.abs(error))))
        count += error.size
        squares += float(np.sum(error**2))
    return {
        "max_m_s": max(worst, default=None),
        "rms_m_s": math.sqrt(squares / count) if count else None,
    }


def _loop(channel: Channel, loop: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the samples show of the loop.

    For a killed run this is all that is known; otherwise the counters of the bench replace it.
    """
    time_s = channel("time_s")
    ticks = None
    if len(time_s) and "tick_hz" in loop:
        ticks = round(time_s[-1] * loop["tick_hz"])
    return {
        "ticks": ticks,
        "missed": _count(channel("ticks_missed")),
        "lateness_us": {
            "p50": None,
            "p99": None,
            "p999": None,
            "max": _statistic(np.max, channel("tick_lateness_us")),
        },
    }


def _statistic(function: Callable[[np.ndarray], Any], values: np.ndarray) -> float | None:
    """Return a statistic of the finite values; None without any."""
    known = values[np.isfinite(values)]
    return finite(function(known)) if known.size else None


def finite(value: float) -> float | None:
    """Return the number, or None for NaN and infinity."""
    return float(value) if math.isfinite(value) else None


def _first(values: np.ndarray) -> float | None:
    return finite(values[0]) if len(values) else None


def _last(values: np.ndarray) -> float | None:
    return finite(values[-1]) if len(values) else None


def _count(values: np.ndarray) -> int | None:
    last = _last(values)
    return None if last is None else round(last)


def _span(values: np.ndarray) -> float | None:
    return finite(values[-1] - values[0]) if len(values) else None


def table(summary: Mapping[str, Any]) -> Any:
    """Return the summary as a rich table of the axles with lines on stop, loop and bus."""
    from rich.table import Table

    name = summary["scenario"] or summary.get("title") or "run"
    lines = [_wsp_line(summary), _loop_line(summary["loop"]), _bus_line(summary)]
    if summary.get("brakes"):
        lines.insert(1, _brakes_line(summary["brakes"]))
    shown = Table(
        title=f"{name}: {_stop_line(summary)}",
        title_justify="left",
        caption="\n".join(lines),
        caption_justify="left",
    )
    for name in ("axle", "sliding m/s", "std", "max", "lock s", "energy MJ", "adhesion", "vents"):
        shown.add_column(name, justify="right", overflow="fold")
    for number, axle in enumerate(summary["axles"], start=1):
        energy_MJ = axle["dissipated_energy_J"]
        if energy_MJ is not None:
            energy_MJ /= 1e6
        shown.add_row(
            str(number),
            *(_show(axle[key]) for key in _SHOWN),
            _show(energy_MJ),
            _show(axle["adhesion_mean"], 4),
            _show(axle.get("vents"), 0),
        )
    return shown


def _stop_line(summary: Mapping[str, Any]) -> str:
    speed = f"{_show(summary['initial_speed_m_s'], 1)} m/s"
    if not summary["stopped"]:
        return f"not stopped from {speed} after {_show(summary.get('duration_s'))} s"
    if summary.get("braking_distance_m") is None:
        time_s = _show(summary["stop_time_s"])
        distance_m = _show(summary["stop_distance_m"], 1)
        return f"stopped from {speed} in {time_s} s and {distance_m} m after the start"
    time_s = _show(summary["braking_time_s"])
    distance_m = _show(summary["braking_distance_m"], 1)
    return f"stopped from {speed} in {time_s} s and {distance_m} m after the brake demand"


def _wsp_line(summary: Mapping[str, Any]) -> str:
    wsp = summary["wsp"]
    unit = wsp["unit"] or "-"
    active_s = _show(wsp["active_s"])
    vents = _show(wsp["vents"], 0)
    air_NL = _show(summary["air_consumption_NL"], 1)
    return f"WSP {unit}: active {active_s} s, {vents} vents, air {air_NL} NL"


def _brakes_line(brakes: Mapping[str, Any]) -> str:
    words = []
    for brake, figures in brakes.items():
        work_J = figures["work_J"]
        text = f"{brake_work.TITLES[brake]} {_show(None if work_J is None else 1e-6 * work_J)} MJ"
        if figures["share"] is not None:
            text += f" ({100.0 * figures['share']:.0f} %)"
        words.append(text)
    return f"work of the brakes: {', '.join(words)}"


def _loop_line(loop: Mapping[str, Any]) -> str:
    ticks = _show(loop["ticks"], 0)
    missed = _show(loop["missed"], 0)
    late = {name: _show(loop["lateness_us"][name], 0) for name in ("p50", "p99", "max")}
    return (
        f"loop: {ticks} ticks, {missed} missed, "
        f"late p50 {late['p50']} p99 {late['p99']} max {late['max']} us"
    )


def _bus_line(summary: Mapping[str, Any]) -> str:
    bus = summary["bus"]
    frames = _show(bus["frames"], 0)
    dropped = _show(bus["dropped"], 0)
    load_percent = _show(bus["load_percent"], 1)
    line = f"bus: {frames} frames, {dropped} dropped, load {load_percent} %"
    if bus.get("longest_wait_us") is not None:
        line += f", longest wait {bus['longest_wait_us']:.0f} us"
    if bus.get("stray_syncs"):
        line += f", {bus['stray_syncs']} stray SYNCs"
    requests = _show(summary["modbus"]["requests"], 0)
    return f"{line}; Modbus: {requests} requests"


def _show(value: float | None, places: int = 2) -> str:
    return "-" if value is None else f"{value:.{places}f}"
