"""The rig in three dimensions: wheelsets on their rollers, with spokes that show their rotation.

Each wheelset and each pair of rollers is one entity. It rotates by its recorded angle divided by
`GEARING`, so that the eye (and 25 pictures in a second) can follow. The spokes are red while a
wheel is locked, and a lamp above each axle shows the state of its dump valve. The axles are closer
together than on the vehicle.
"""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.configs.vehicle import AXLES_OF_BOGIE, Kind, axle_positions_m
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.realtime.telemetry import views
from rollerrig.wsp_interface import signals

# the drawn rotation is slower by this factor
GEARING = 20.0

# 1/s of simulated time. The rate at which angles are sent.
RATE_HZ = 25.0

# the default rig, for a scenario that states nothing else; a body has two bogies where that is
# possible
_WHEEL_RADIUS_M = 0.445
_ROLLER_RADIUS_M = 1.0
_BOGIES_OF_BODY = 2
_LAYOUT = {
    "bogie_wheelbase_m": 2.56,
    "bogie_distance_m": 19.0,
    "body_distance_m": 26.4,
}

# m. Sizes that are only drawn.
_GAUGE_M = 1.5
_WHEEL_WIDTH_M = 0.13
_SHAFT_RADIUS_M = 0.09
_LONGEST_GAP_M = 3.2  # between two axles
_LAMP_RADIUS_M = 0.16
_LAMP_ABOVE_WHEEL_M = 0.4
_FRAME_HALF_WIDTH_M = 1.0
_FRAME_RADIUS_M = 0.05
_RAIL_RADIUS_M = 0.04
_RAIL_BEYOND_AXLE_M = 1.5
_SPOKES_BEFORE_FACE_M = 0.01

_SPOKES = 6
# length of a spoke, as a share of the radius of its wheel
_SPOKE_SHARE = 0.86
_RIM_POINTS = 40

# A wheel is drawn as locked below this share of the vehicle speed, if the vehicle is this fast.
_LOCKED_SHARE = 0.1
_LOCKED_ABOVE_M_S = 0.5

STEEL = (120, 128, 138)
RUNNING = (245, 245, 245)
LOCKED = (235, 40, 30)

# the colour of the spokes of a wheel, by whether it is locked (0 or 1)
_SPOKE_COLOURS = np.array((RUNNING, LOCKED), dtype=np.uint8)
# the colour of the lamp of an axle, by the state of its valve
_LAMP_COLOURS = np.array([colour for _, colour in colours.VALVE_STATES], dtype=np.uint8)


class Geometry(NamedTuple):
    """Radii in m, and centres of wheelsets and rollers in m, shape (axles, 3).

    The x axis points forwards and the z axis upwards. A rail is a roller of infinite radius.
    """

    wheel_radius_m: float
    roller_radius_m: float
    wheels: np.ndarray
    rollers: np.ndarray

    @property
    def on_track(self) -> bool:
        """Whether the wheels run on rails."""
        return math.isinf(self.roller_radius_m)


def geometry(kind: Kind, scenario: Mapping[str, Any]) -> Geometry:
    """Return the geometry of a resolved scenario; the default rig's where it states nothing.

    `kind` is that of the vehicle.
    """
    vehicle = scenario.get("vehicle", {})
    contact = scenario.get("contact", {})
    wheel_radius_m = float(vehicle.get("wheel_radius_m", _WHEEL_RADIUS_M))
    if scenario.get("rig", {}).get("mode") == "track":
        roller_radius_m = math.inf
    else:
        roller_radius_m = float(contact.get("roller_radius_m", _ROLLER_RADIUS_M))

    # distance of each axle behind the first, with shortened gaps
    default = {**_LAYOUT, "bogies_per_body": math.gcd(kind.bogies, _BOGIES_OF_BODY)}
    axles_m = axle_positions_m({**default, **vehicle, "axles": kind.axles})
    gaps_m = np.minimum(np.diff(axles_m), _LONGEST_GAP_M)
    behind_m = np.cumsum([0.0, *gaps_m])

    rollers = np.zeros((len(axles_m), 3))
    rollers[:, 0] = behind_m.mean() - behind_m
    height_m = wheel_radius_m
    if not math.isinf(roller_radius_m):
        height_m = wheel_radius_m + roller_radius_m
    wheels = rollers + np.array([0.0, 0.0, height_m])
    return Geometry(wheel_radius_m, roller_radius_m, wheels, rollers)


def eye(place: Geometry) -> rrb.EyeControls3D:
    """Return a view from the side and slightly from above that contains all axles."""
    length = float(np.ptp(place.wheels[:, 0])) + 2.0
    height = float(place.wheels[0, 2])
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        eye_up=(0, 0, 1),
        position=(0.12 * length, -0.8 * length, height + 0.12 * length),
        look_target=(0, 0, 0.5 * height),
    )


# --- what never changes ---


def draw(stream: rr.RecordingStream, place: Geometry) -> None:
    """Log what never changes: the bodies, the spokes, the frames, the names."""
    stream.log(views.RIG, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    axles = len(place.wheels)
    for j in range(axles):
        _draw_axle(stream, place, j)
    if place.on_track:
        _draw_rails(stream, place)
    for number, first in enumerate(range(0, axles, AXLES_OF_BOGIE), start=1):
        _draw_frame(stream, place, f"{views.RIG}/bogie_{number}", (first, first + 1))


def _axle_path(j: int) -> str:
    """Return the path of the axle with index j."""
    return f"{views.RIG}/axle_{j + 1}"


def _draw_axle(stream: rr.RecordingStream, place: Geometry, j: int) -> None:
    """Draw a wheelset, the lamp of its valve, and its rollers."""
    path = _axle_path(j)
    _draw_pair(stream, f"{path}/wheels", place.wheel_radius_m, colours.AXLES[j], place.wheels[j])

    above_wheel = np.array([0.0, -_GAUGE_M / 2, place.wheel_radius_m + _LAMP_ABOVE_WHEEL_M])
    lamp = rr.Points3D(
        [place.wheels[j] + above_wheel],
        radii=_LAMP_RADIUS_M,
        labels=[f"axle {j + 1}"],
        show_labels=True,
    )
    stream.log(f"{path}/valve", lamp, static=True)

    if not place.on_track:
        _draw_pair(stream, f"{path}/rollers", place.roller_radius_m, STEEL, place.rollers[j])
        # spokes of rollers keep their colour
        steady = rr.LineStrips3D.from_fields(colors=RUNNING)
        stream.log(f"{path}/rollers/spokes", steady, static=True)


def _draw_rails(stream: rr.RecordingStream, place: Geometry) -> None:
    front_m = place.wheels[0, 0] + _RAIL_BEYOND_AXLE_M
    rear_m = place.wheels[-1, 0] - _RAIL_BEYOND_AXLE_M
    rails = []
    for side_m in (-_GAUGE_M / 2, _GAUGE_M / 2):
        rails.append([(front_m, side_m, 0.0), (rear_m, side_m, 0.0)])
    strips = rr.LineStrips3D(rails, colors=STEEL, radii=_RAIL_RADIUS_M)
    stream.log(f"{views.RIG}/rails", strips, static=True)


def _draw_frame(
    stream: rr.RecordingStream, place: Geometry, path: str, axles: tuple[int, int]
) -> None:
    """Draw the frame of a bogie as a beam on each side."""
    beams = []
    for side_m in (-_FRAME_HALF_WIDTH_M, _FRAME_HALF_WIDTH_M):
        beams.append([place.wheels[j] + [0, side_m, 0] for j in axles])
    strips = rr.LineStrips3D(beams, colors=STEEL, radii=_FRAME_RADIUS_M)
    stream.log(path, strips, static=True)


def _draw_pair(
    stream: rr.RecordingStream, path: str, radius_m: float, colour: Colour, centre: np.ndarray
) -> None:
    """Draw two wheels or rollers on a shaft, with spokes on their outer faces."""
    stream.log(path, rr.Transform3D(translation=centre), static=True)

    # Rerun's cylinder is upright
    across = rr.RotationAxisAngle(axis=(1, 0, 0), radians=math.pi / 2)
    half_gauge_m = _GAUGE_M / 2
    body = rr.Cylinders3D(
        lengths=[_WHEEL_WIDTH_M, _WHEEL_WIDTH_M, _GAUGE_M],
        radii=[radius_m, radius_m, _SHAFT_RADIUS_M],
        centers=[(0, -half_gauge_m, 0), (0, half_gauge_m, 0), (0, 0, 0)],
        rotation_axis_angles=[across, across, across],
        colors=[colour, colour, STEEL],
        fill_mode=rr.components.FillMode.Solid,
    )
    stream.log(f"{path}/body", body, static=True)

    # no colour here: it would be static, and hide the colours that `Rotation` sends
    spokes = rr.LineStrips3D(_spokes(radius_m), radii=0.035 * radius_m + 0.005)
    stream.log(f"{path}/spokes", spokes, static=True)


def _spokes(radius_m: float) -> list[list[tuple[float, float, float]]]:
    """Return the spokes and a rim for both outer faces, as strips of points (x, y, z) in m."""
    spoke_angles = np.arange(_SPOKES) * math.tau / _SPOKES
    rim_angles = np.linspace(0, math.tau, _RIM_POINTS)
    reach_m = _SPOKE_SHARE * radius_m
    face_m = _GAUGE_M / 2 + _WHEEL_WIDTH_M / 2 + _SPOKES_BEFORE_FACE_M

    def on_rim(angle: float, y: float) -> tuple[float, float, float]:
        return (reach_m * math.sin(angle), y, reach_m * math.cos(angle))

    strips = []
    for y in (-face_m, face_m):
        for angle in spoke_angles:
            strips.append([(0.0, y, 0.0), on_rim(angle, y)])
        strips.append([on_rim(angle, y) for angle in rim_angles])
    return strips


# --- what changes ---


class Rotation:
    """Sends the angles of wheels and rollers, and the colours of spokes and lamps.

    Angles are sent at most `RATE_HZ` times in a simulated second, colours where they change.
    """

    def __init__(self, stream: rr.RecordingStream, place: Geometry) -> None:
        self._stream = stream
        self._place = place
        self._changes = views.Changes(stream)
        self._last_frame = -1

    def rows(self, rows: np.ndarray) -> None:
        """Send rows of all signals, shape (n, signals.WIDTH)."""
        time_s = rows[:, signals.column("time")]
        due = self._due(time_s)
        times = views.times(time_s[due])
        for j in range(len(self._place.wheels)):
            path = _axle_path(j)
            if due.size:
                wheel_angle = rows[due, signals.column("wheel_angle", j + 1)]
                roller_angle = rows[due, signals.column("roller_angle", j + 1)]
                self._rotate(f"{path}/wheels", wheel_angle, times, self._place.wheels[j])
                # rollers turn against their wheels
                self._rotate(f"{path}/rollers", -roller_angle, times, self._place.rollers[j])
            self._send_colours(path, j, rows, time_s)

    def _due(self, time_s: np.ndarray) -> np.ndarray:
        """Return the places of rows that begin a new frame of the animation."""
        frame = np.floor(time_s * RATE_HZ + 1e-6).astype(np.int64)
        is_new = np.diff(frame, prepend=self._last_frame) > 0
        self._last_frame = int(frame[-1])
        return np.flatnonzero(is_new)

    def _rotate(
        self, path: str, angle_rad: np.ndarray, times: rr.TimeColumn, centre: np.ndarray
    ) -> None:
        known_rad = np.where(np.isfinite(angle_rad), angle_rad, 0.0)
        half_rad = known_rad / (2.0 * GEARING)
        zero = np.zeros_like(half_rad)
        # a positive angle turns about +y: the top of a wheel moves forwards
        quaternion = np.column_stack([zero, np.sin(half_rad), zero, np.cos(half_rad)])
        columns = rr.Transform3D.columns(
            translation=np.tile(centre, (half_rad.size, 1)),
            quaternion=quaternion,
        )
        self._stream.send_columns(path, [times], columns)

    def _send_colours(self, path: str, j: int, rows: np.ndarray, time_s: np.ndarray) -> None:
        vehicle_m_s = rows[:, signals.column("vehicle_speed")]
        wheel_m_s = rows[:, signals.column("wheel_circumferential_speed", j + 1)]
        is_fast = vehicle_m_s > _LOCKED_ABOVE_M_S
        is_locked = is_fast & (wheel_m_s < _LOCKED_SHARE * vehicle_m_s)
        self._changes.send(
            f"{path}/wheels/spokes",
            time_s,
            is_locked.astype(np.int64),
            lambda states: rr.LineStrips3D.columns(colors=_SPOKE_COLOURS[states]),
        )
        self._changes.send(
            f"{path}/valve",
            time_s,
            views.valve_states(rows, j + 1),
            lambda states: rr.Points3D.columns(colors=_LAMP_COLOURS[states]),
        )
