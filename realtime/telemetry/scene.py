"""The rig in three dimensions: wheelsets on their rollers, with spokes that show whether they turn.

Each wheelset and each roller pair is one entity that turns as its recorded angle does, geared down
so that the eye (and 25 pictures a second) can follow. The spokes turn red when a wheel is locked,
and a lamp above each axle shows its dump valve. Axles stand closer than on the vehicle.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.telemetry import views
from rollerrig.wsp_interface import signals

GEARING = 20.0
RATE_HZ = 25.0
_GAUGE_M, _WIDTH_M = 1.5, 0.13
_GAP_M = 3.2  # longest distance drawn between two axles
_SPOKES = 6
STEEL, RUNNING, LOCKED = (120, 128, 138), (245, 245, 245), (235, 40, 30)


class Scene(NamedTuple):
    """Radii in m, axle places (axles, 3) of wheels and rollers in m; a rail has radius inf."""

    wheel_radius_m: float
    roller_radius_m: float
    wheels: np.ndarray
    rollers: np.ndarray


def scene(scenario: Mapping[str, Any]) -> Scene:
    """The geometry of a resolved scenario; what it does not say is taken as the default rig's."""
    vehicle, contact = scenario.get("vehicle", {}), scenario.get("contact", {})
    wheel = float(vehicle.get("wheel_radius_m", 0.445))
    on_track = scenario.get("rig", {}).get("mode") == "track"
    roller = math.inf if on_track else float(contact.get("roller_radius_m", 1.0))
    base, pivots = (
        float(vehicle.get("bogie_wheelbase_m", 2.56)),
        float(vehicle.get("bogie_distance_m", 19.0)),
    )
    behind = np.cumsum([0.0, *np.minimum(np.diff([0.0, base, pivots, pivots + base]), _GAP_M)])
    rollers = np.column_stack([behind.mean() - behind, np.zeros((4, 2))])
    return Scene(
        wheel,
        roller,
        np.add(rollers, (0.0, 0.0, wheel + (0.0 if math.isinf(roller) else roller))),
        rollers,
    )


def eye(place: Scene) -> rrb.EyeControls3D:
    """A view from the side, a little above, that holds all axles."""
    length = float(np.ptp(place.wheels[:, 0])) + 2.0
    height = float(place.wheels[0, 2])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        eye_up=(0, 0, 1),
        position=(0.12 * length, -0.8 * length, height + 0.12 * length),
        look_target=(0, 0, 0.5 * height),
    )


def draw(stream: rr.RecordingStream, place: Scene) -> None:
    """Log what never changes: bodies, spokes, frames, names."""
    stream.log(views.RIG, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    for j, colour in enumerate(colours.AXLES):
        at = f"{views.RIG}/axle_{j + 1}"
        _bodies(stream, f"{at}/wheels", place.wheel_radius_m, colour, place.wheels[j])
        stream.log(
            f"{at}/valve",
            rr.Points3D(
                [place.wheels[j] + [0, -_GAUGE_M / 2, place.wheel_radius_m + 0.4]],
                radii=0.16,
                labels=[f"axle {j + 1}"],
                show_labels=True,
            ),
            static=True,
        )
        if not math.isinf(place.roller_radius_m):
            _bodies(stream, f"{at}/rollers", place.roller_radius_m, STEEL, place.rollers[j])
            stream.log(
                f"{at}/rollers/spokes", rr.LineStrips3D.from_fields(colors=RUNNING), static=True
            )
    if math.isinf(place.roller_radius_m):
        ends = np.array([place.wheels[0, 0] + 1.5, place.wheels[-1, 0] - 1.5])
        stream.log(
            f"{views.RIG}/rails",
            rr.LineStrips3D(
                [[(x, side, 0.0) for x in ends] for side in (-_GAUGE_M / 2, _GAUGE_M / 2)],
                colors=STEEL,
                radii=0.04,
            ),
            static=True,
        )
    for first, last in ((0, 1), (2, 3)):
        stream.log(
            f"{views.RIG}/bogie_{first // 2 + 1}",
            rr.LineStrips3D(
                [[place.wheels[k] + [0, side, 0] for k in (first, last)] for side in (-1.0, 1.0)],
                colors=STEEL,
                radii=0.05,
            ),
            static=True,
        )


def _bodies(stream: Any, path: str, radius_m: float, colour: Any, centre: Any) -> None:
    """Two wheels (or rollers) on a shaft, with spokes on the faces that look outwards."""
    half = _GAUGE_M / 2
    across = rr.RotationAxisAngle(
        axis=(1, 0, 0), radians=math.pi / 2
    )  # a cylinder is upright by itself
    stream.log(path, rr.Transform3D(translation=centre), static=True)
    stream.log(
        f"{path}/body",
        rr.Cylinders3D(
            lengths=[_WIDTH_M, _WIDTH_M, _GAUGE_M],
            radii=[radius_m, radius_m, 0.09],
            centers=[(0, -half, 0), (0, half, 0), (0, 0, 0)],
            rotation_axis_angles=[across] * 3,
            colors=[colour, colour, STEEL],
            fill_mode=rr.components.FillMode.Solid,
        ),
        static=True,
    )
    angles = np.arange(_SPOKES) * math.tau / _SPOKES
    rim = np.linspace(0, math.tau, 40)
    reach = 0.86 * radius_m
    strips = []
    for side in (-1.0, 1.0):
        y = side * (half + _WIDTH_M / 2 + 0.01)
        strips += [[(0, y, 0), (reach * math.sin(a), y, reach * math.cos(a))] for a in angles]
        strips.append([(reach * math.sin(a), y, reach * math.cos(a)) for a in rim])
    # no colour here: what is static would hide the colours that `Turning` sends
    stream.log(
        f"{path}/spokes", rr.LineStrips3D(strips, radii=0.035 * radius_m + 0.005), static=True
    )


class Turning:
    """Sends angles of wheels and rollers at most 25 times a simulated second, and colours where they change."""

    def __init__(self, stream: rr.RecordingStream, place: Scene) -> None:
        self._stream, self._place = stream, place
        self._changes, self._last_frame = views.Changes(stream), -1

    def rows(self, rows: np.ndarray) -> None:
        """Rows of all signals, shape (n, columns)."""
        time_s = rows[:, signals.column("time")]
        frame = np.floor(time_s * RATE_HZ + 1e-6).astype(np.int64)
        due = np.flatnonzero(np.diff(frame, prepend=self._last_frame) > 0)
        self._last_frame = int(frame[-1])
        when = views.times(time_s[due])
        for j in range(signals.AXLES):
            at = f"{views.RIG}/axle_{j + 1}"
            if due.size:
                self._turn(
                    f"{at}/wheels",
                    rows[due, signals.column("wheel_angle", j + 1)],
                    when,
                    self._place.wheels[j],
                )
                self._turn(
                    f"{at}/rollers",
                    -rows[due, signals.column("roller_angle", j + 1)],
                    when,
                    self._place.rollers[j],
                )
            self._colours(at, j, rows, time_s)

    def _turn(self, path: str, angle: np.ndarray, when: rr.TimeColumn, centre: np.ndarray) -> None:
        half = np.where(np.isfinite(angle), angle, 0.0) / (2.0 * GEARING)
        zero = np.zeros_like(half)
        # positive angles turn about +y: the top of a wheel goes forward
        self._stream.send_columns(
            path,
            [when],
            rr.Transform3D.columns(
                translation=np.tile(centre, (half.size, 1)),
                quaternion=np.column_stack([zero, np.sin(half), zero, np.cos(half)]),
            ),
        )

    def _colours(self, at: str, j: int, rows: np.ndarray, time_s: np.ndarray) -> None:
        speed = rows[:, signals.column("vehicle_speed")]
        rim = rows[:, signals.column("wheel_circumferential_speed", j + 1)]
        locked = ((speed > 0.5) & (rim < 0.1 * speed)).astype(np.int64)
        lamps = np.array([shade for _, shade in colours.VALVE_STATES], dtype=np.uint8)
        spokes = np.array((RUNNING, LOCKED), dtype=np.uint8)
        self._changes.send(
            f"{at}/wheels/spokes",
            time_s,
            locked,
            lambda states: rr.LineStrips3D.columns(colors=spokes[states]),
        )
        self._changes.send(
            f"{at}/valve",
            time_s,
            views.valve_states(rows, j + 1),
            lambda states: rr.Points3D.columns(colors=lamps[states]),
        )
