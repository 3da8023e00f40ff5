"""Plots of a run as SVG text, for a report that is one file and needs nothing from elsewhere.

Lines keep their extremes when they are thinned out, so a short lock is seen. One colour an axle,
the same in every plot; the vehicle is black and broken lines are limits or demands.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np

# those of the Rerun views (Okabe and Ito)
AXLE_COLOURS = ("#56b4e9", "#e69f00", "#009e73", "#cc79a7")
VEHICLE_COLOUR, DEMAND_COLOUR = "#222222", "#888888"
VALVE_COLOURS = ("#e8e8e8", "#ffcc66", "#dd5544")
VALVE_NAMES = ("fill", "hold", "vent")
WIDTH, HEIGHT = 760, 190
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 8, 24
_POINTS = 380


@dataclass(frozen=True)
class Line:
    """One line of a plot."""

    name: str
    colour: str
    values: np.ndarray
    dashed: bool = False


def plot(title: str, unit: str, time_s: np.ndarray, lines: Sequence[Line],
         marks_s: Sequence[float] = ()) -> str:
    """Lines over time, as an SVG element with its title and legend. `time_s` of shape (n,)."""
    known = [line.values[np.isfinite(line.values)] for line in lines]
    known = [one for one in known if one.size]
    if not known or len(time_s) < 2:
        return ""
    low, high = min(float(one.min()) for one in known), max(float(one.max()) for one in known)
    ticks = _ticks(min(low, 0.0), high if high > low else low + 1.0, 5)
    low, high = min(ticks[0], low), max(ticks[-1], high)
    span_s = max(float(time_s[-1] - time_s[0]), 1e-9)

    def x(at_s: Any) -> Any:
        return _LEFT + (at_s - time_s[0]) / span_s * (WIDTH - _LEFT - _RIGHT)

    def y(value: Any) -> Any:
        return HEIGHT - _BOTTOM - (value - low) / (high - low) * (HEIGHT - _TOP - _BOTTOM)

    parts = [_head(HEIGHT, title)]
    for tick in ticks:
        at = f"{y(tick):.1f}"
        parts.append(f'<line x1="{_LEFT}" x2="{WIDTH - _RIGHT}" y1="{at}" y2="{at}" class="g"/>'
                     f'<text x="{_LEFT - 6}" y="{at}" class="v">{tick:g}</text>')
    parts += _time_axis(time_s, x, HEIGHT)
    parts += [f'<line x1="{x(at):.1f}" x2="{x(at):.1f}" y1="{_TOP}" y2="{HEIGHT - _BOTTOM}" '
              'class="m"/>' for at in marks_s]
    for line in lines:
        at_s, values = _thinned(time_s, line.values)
        if len(at_s):
            points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x(at_s), y(values), strict=True))
            dash = ' stroke-dasharray="5 3"' if line.dashed else ""
            parts.append(f'<polyline points="{points}" stroke="{line.colour}"{dash}/>')
    return _figure(title, unit, lines, "".join([*parts, "</svg>"]))


def lanes(title: str, time_s: np.ndarray, states: Sequence[tuple[str, np.ndarray]]) -> str:
    """Valve states (0 fill, 1 hold, 2 vent) as one lane a row, each of shape (n,)."""
    if len(time_s) < 2:
        return ""
    height, lane = _TOP + 20 * len(states) + _BOTTOM, 20
    span_s = max(float(time_s[-1] - time_s[0]), 1e-9)

    def x(at_s: float) -> float:
        return _LEFT + (at_s - time_s[0]) / span_s * (WIDTH - _LEFT - _RIGHT)

    parts = [_head(height, title)]
    for row, (name, values) in enumerate(states):
        top = _TOP + lane * row + 3
        parts.append(f'<text x="{_LEFT - 6}" y="{top + 7}" class="v">{escape(name)}</text>'
                     f'<rect x="{_LEFT}" y="{top}" width="{WIDTH - _LEFT - _RIGHT}" height="14" '
                     f'fill="{VALVE_COLOURS[0]}"/>')
        changes = np.flatnonzero(np.diff(values)) + 1
        for begin, end in zip([0, *changes], [*changes, len(values) - 1], strict=True):
            state = int(values[begin])
            if state in (1, 2):
                left, right = x(float(time_s[begin])), x(float(time_s[end]))
                parts.append(f'<rect x="{left:.1f}" y="{top}" width="{max(right - left, 0.6):.1f}" '
                             f'height="14" fill="{VALVE_COLOURS[state]}"/>')
    parts += _time_axis(time_s, x, height)
    legend = [Line(name, colour, np.zeros(0)) for name, colour
              in zip(VALVE_NAMES, VALVE_COLOURS, strict=True)]
    return _figure(title, "", legend, "".join([*parts, "</svg>"]))


def _head(height: int, title: str) -> str:
    return (f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title)}" '
            'xmlns="http://www.w3.org/2000/svg">')


def _time_axis(time_s: np.ndarray, x: Callable[[Any], Any], height: int) -> list[str]:
    ticks = [one for one in _ticks(float(time_s[0]), float(time_s[-1]), 8)
             if time_s[0] <= one <= time_s[-1]]
    return [f'<text x="{x(one):.1f}" y="{height - 8}" class="t">{one:g}</text>' for one in ticks] + [
        f'<text x="{WIDTH - _RIGHT}" y="{height - 8}" class="t">s</text>']


def _figure(title: str, unit: str, lines: Sequence[Line], svg: str) -> str:
    legend = " ".join(f'<span><i style="background:{line.colour}"></i>{escape(line.name)}</span>'
                      for line in lines)
    told = f" <small>{escape(unit)}</small>" if unit else ""
    return f"<figure><figcaption><b>{escape(title)}</b>{told} {legend}</figcaption>{svg}</figure>"


def _ticks(low: float, high: float, count: int) -> list[float]:
    """Round values that cover low to high."""
    raw = max(high - low, 1e-12) / count
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= raw * 0.999)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [round(at * step, 10) for at in range(first, last + 1)]


def _thinned(time_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest value of each of a few hundred parts, in the order of time."""
    known = np.isfinite(values)
    time_s, values = time_s[known], values[known]
    if len(values) <= 2 * _POINTS:
        return time_s, values
    edges = np.linspace(0, len(values), _POINTS + 1).astype(int)
    kept = sorted({at for begin, end in itertools.pairwise(edges) if end > begin
                   for at in (begin + int(values[begin:end].argmin()),
                              begin + int(values[begin:end].argmax()))} | {0, len(values) - 1})
    return time_s[kept], values[kept]
