"""A train in Rerun: its row of cars over the rail, and a tab of plots for the train and each car.

Above, the cars stand at their places, and the rail moves below them. The colour of a car and of its
wheels is the slip, that of the rail between two wheels is the friction that the next wheel meets
there: it shows how the wheels ahead have cleaned it. Below are plots by car and, in a tab for each
car, by axle. A quantity of car n is under /car_n. Displacements of couplers are drawn `STRETCH`
times larger.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from rollerrig.realtime.pictures import colours
from rollerrig.realtime.pictures.colours import Colour
from rollerrig.realtime.record import cars, records, run_folder
from rollerrig.realtime.record.cars import Car
from rollerrig.realtime.record.records import Run
from rollerrig.realtime.telemetry import derived, drawing, scene, views
from rollerrig.wsp_interface.events import Event

# displacements of couplers are drawn larger by this factor
STRETCH = 50.0
# a wheel or a car has the full colour of slip from this slip, as a share of the train's speed
FULL_SLIP = 0.3

# path of what the row of cars shows
ROW = "/row"

# m; sizes of the row that are only drawn, for a train of _USUAL_LENGTH_M or shorter
_USUAL_LENGTH_M = 130.0
_WHEEL_RADIUS_M = 0.6
_FLOOR_M = 1.5
_ROOF_M = 4.5
_GAP_M = 0.6  # between a body and the end of its car
_RAIL_HEIGHT_M = 0.5
_MARGIN_M = 4.0
# m; length of a cell of the drawn rail
_CELL_M = 0.5
# 1/s of simulated time; rate of the colours and places of the row
_RATE_HZ = scene.RATE_HZ
# m/s; below it slip is drawn as none
_SLOWEST_M_S = 1.0
# colours are sent where one of so many steps changes
_STEPS = 40

_NO_SLIP = (150, 155, 162)
_FULL = scene.LOCKED
_TENSION = colours.SKY_BLUE
_COMPRESSION = colours.VERMILION
DIRTY = (118, 72, 40)
CLEAN = (205, 222, 235)

# width of lines in points
_WIDTH = 1.5
_FINE = 0.8
_KM_H_PER_M_S = 3.6


class _Lines(NamedTuple):
    """An entity of scalars with its values, shape (n, series)."""

    path: str
    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    values: np.ndarray
    width: float = _WIDTH


class _Signal(NamedTuple):
    """A signal of axles: its group, its title, its name and unit in the record, and its scale."""

    group: str
    title: str
    name: str
    unit: str
    scale: float


# signals of axles that have a plot by car, and one by axle in the tab of each car
_OF_AXLES = (
    _Signal("sliding", "Sliding (m/s)", "sliding", "m_s", 1.0),
    _Signal("pressures", "Brake cylinders (bar)", "cylinder_pressure", "Pa", 1e-5),
    _Signal("adhesion", "Adhesion used", "adhesion", "", 1.0),
    _Signal("friction", "Friction mu_cd of the contaminant", "friction_degraded", "", 1.0),
)


def recording(run: Run, bare: bool = False) -> bytes:
    """Return the recording of a train's run, as the content of a .rrd file.

    `bare` leaves out the bars of the viewer. Raises ConfigError for a run without a summary.
    """
    of_train = cars.cars(run.summary)
    stream = rr.RecordingStream(views.APPLICATION)
    # in memory: when the disk is full, Rerun would wait for it for ever
    memory = stream.memory_recording()
    stream.send_blueprint(_blueprint(run, of_train, bare))
    stream.send_recording_name(run_folder.short_names([run.folder])[0])

    time_s = run.column("time_s")
    for lines in _lines(run, of_train):
        stream.log(lines.path, views.series_style(lines, "", False), static=True)
        _send_scalars(stream, lines.path, time_s, lines.values)
    _draw_valves(stream, run, of_train)
    _draw_events(stream, run)
    document = rr.TextDocument(_result(run), media_type=rr.MediaType.MARKDOWN)
    stream.log(views.RESULT, document, static=True)
    _Row(stream, run, of_train).draw()
    return memory.drain_as_bytes()


# --- plots ---


def _name(number: int) -> str:
    return f"car {number}"


def _path(car: Car, group: str) -> str:
    """Return the path of a group of a car."""
    return f"/car_{car.number}/{group}"


def _lines(run: Run, of_train: Sequence[Car]) -> list[_Lines]:
    """Return all entities of scalars."""
    column = run.column
    speed_m_s = column("vehicle_speed_m_s")
    of_cars = [column(f"car_{car.number}_speed_m_s") for car in of_train]
    kmh = [_KM_H_PER_M_S * speed_m_s, *(_KM_H_PER_M_S * one for one in of_cars)]
    found = [
        _Lines(
            "/train/speed",
            ("train", *(_name(car.number) for car in of_train)),
            (colours.VEHICLE, *(colours.CARS[car.number - 1] for car in of_train)),
            np.column_stack(kmh),
        ),
        _by_car("/train/speed_difference", of_train, [one - speed_m_s for one in of_cars]),
    ]
    ends = sorted({1, len(of_train)})
    demands = [1e-5 * column(f"car_{number}_brake_demand_Pa") for number in ends]
    names = tuple(f"demand, {_name(number)}" for number in ends)
    shades = (colours.REFERENCE,) * len(ends)
    found.append(_Lines("/train/demand", names, shades, np.column_stack(demands), _FINE))
    if _has_pipe(run):
        pipes = [1e-5 * column(f"car_{car.number}_brake_pipe_Pa") for car in of_train]
        found.append(_by_car("/train/brake_pipe", of_train, pipes))
    for signal in _OF_AXLES:
        means = [signal.scale * car.mean(column, signal.name, signal.unit) for car in of_train]
        found.append(_by_car(f"/train/{signal.group}", of_train, means))
        for car in of_train:
            found.append(_of_axles(run, car, signal))
    if len(of_train) > 1:
        couplers = range(1, len(of_train))
        forces = [1e-3 * column(f"coupler_{number}_N") for number in couplers]
        names = tuple(f"cars {number} and {number + 1}" for number in couplers)
        shades = tuple(colours.CARS[number - 1] for number in couplers)
        found.append(_Lines("/train/couplers", names, shades, np.column_stack(forces)))
    return found


def _by_car(path: str, of_train: Sequence[Car], values: Sequence[np.ndarray]) -> _Lines:
    """Return an entity with a series for each car."""
    names = tuple(_name(car.number) for car in of_train)
    shades = tuple(colours.CARS[car.number - 1] for car in of_train)
    return _Lines(path, names, shades, np.column_stack(values))


def _of_axles(run: Run, car: Car, signal: _Signal) -> _Lines:
    """Return an entity with a series for each axle of a car."""
    behind = f"_{signal.unit}" if signal.unit else ""
    names = [f"{signal.name}_{axle}{behind}" for axle in car.axles]
    return _Lines(
        _path(car, signal.group),
        tuple(f"axle {axle}" for axle in car.axles),
        tuple(colours.AXLES[seat] for seat in range(len(car.axles))),
        signal.scale * np.column_stack([run.column(name) for name in names]),
    )


def _has_pipe(run: Run) -> bool:
    return "car_1_brake_pipe_Pa" in run.table.column_names


def _send_scalars(
    stream: rr.RecordingStream, path: str, time_s: np.ndarray, values: np.ndarray
) -> None:
    """Send values of shape (n, series) as one entity."""
    count, series = values.shape
    columns = rr.Scalars.columns(scalars=np.ascontiguousarray(values).ravel())
    if series > 1:
        columns = columns.partition([series] * count)
    stream.send_columns(path, [views.times(time_s)], columns)


def _draw_valves(stream: rr.RecordingStream, run: Run, of_train: Sequence[Car]) -> None:
    """Send the states of the dump valves of each car."""
    changes = views.Changes(stream)
    time_s = run.column("time_s")
    names = [name for name, _ in colours.VALVE_STATES]
    shades = [colour for _, colour in colours.VALVE_STATES]
    style = rr.StateConfiguration(values=names, labels=names, colors=shades)
    for car in of_train:
        for axle in car.axles:
            path = f"{_path(car, 'valves')}/axle_{axle}"
            stream.log(path, style, static=True)
            states = views.states_of(run.column(f"valve_{axle}"))
            changes.send(path, time_s, states, drawing.valve_columns)


def _draw_events(stream: rr.RecordingStream, run: Run) -> None:
    """Send the events of all cars, each with the number of its car."""
    found: list[tuple[int, Event]] = []
    for number in range(1, len(run.summary["cars"]) + 1):
        of_car = run.folder / f"car_{number}"
        found += [(number, event) for event in records.each_event(of_car)]
    shown = [pair for pair in found if not derived.is_of_network(pair[1])]
    if not shown:
        return
    shown.sort(key=lambda pair: pair[1].time_s)
    texts = [f"{event.time_s:7.2f} s  {_name(number)}: {event.text}" for number, event in shown]
    drawing.send_texts(stream, views.EVENTS, [event for _, event in shown], texts)


def _result(run: Run) -> str:
    """Return the result of a train as Markdown."""
    summary = run.summary
    train = summary["train"]
    alone = summary.get("alone") or {}
    lines = [
        derived.result_text(summary),
        f"{train['cars']} cars, {1e-3 * train['mass_kg']:.0f} t, {train['length_m']:.0f} m",
    ]
    if alone.get("braking_distance_m") is not None:
        lines.append(f"car {alone['car']} alone: {alone['braking_distance_m']:.0f} m")
    return "\n\n".join(lines)


# --- the layout ---


def _blueprint(run: Run, of_train: Sequence[Car], bare: bool) -> rrb.Blueprint:
    """Return the layout: the row of cars above, plots below, and the result beside them."""
    axis = views.time_axis(False)

    def plot(title: str, *paths: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(
            name=title,
            origin="/",
            contents=list(paths),
            axis_x=axis,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.RightTop, visible=True),
        )

    tabs: list[rrb.Container] = [_tab_of_train(run, plot)]
    for car in of_train:
        valves = rrb.StateTimelineView(
            name="Dump valves: fill grey, hold yellow, vent red",
            origin=_path(car, "valves"),
            time_view=axis,
        )
        plots = [plot(signal.title, _path(car, signal.group)) for signal in _OF_AXLES]
        left = rrb.Vertical(*plots[:2], valves)
        tabs.append(rrb.Horizontal(left, rrb.Vertical(*plots[2:]), name=f"Car {car.number}"))
    result = rrb.TextDocumentView(name="Result", origin="/", contents=[views.RESULT])
    events = views.event_list("Events", [views.EVENTS])
    below = rrb.Horizontal(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.Vertical(result, events, row_shares=[3, 2]),
        column_shares=[8, 2.2],
    )
    content = rrb.Vertical(_row_view(run, of_train), below, row_shares=[1.7, 8])
    return views.framed(content, bare=bare)


def _tab_of_train(run: Run, plot: Any) -> rrb.Horizontal:
    """Return the tab with the plots by car."""
    left = [
        plot("Speed (km/h)", "/train/speed"),
        plot("Speed above that of the train (m/s)", "/train/speed_difference"),
        plot("Sliding, mean of each car (m/s)", "/train/sliding"),
    ]
    right = [
        plot(
            "Brake cylinders, mean of each car, and demand (bar)",
            "/train/pressures",
            "/train/demand",
        ),
        plot("Friction mu_cd of the contaminant, mean of each car", "/train/friction"),
        plot("Adhesion used, mean of each car", "/train/adhesion"),
    ]
    if len(run.summary["cars"]) > 1:
        left.append(plot("Couplers (kN, tension positive)", "/train/couplers"))
    if _has_pipe(run):
        right.append(plot("Brake pipe (bar)", "/train/brake_pipe"))
    return rrb.Horizontal(rrb.Vertical(*left), rrb.Vertical(*right), name="Train")


def _height_scale(of_train: Sequence[Car]) -> float:
    """Return how much higher than long the row is drawn, so that a long train stays visible."""
    last = of_train[-1]
    return max(1.0, (last.front_m + last.length_m) / _USUAL_LENGTH_M)


def _row_view(run: Run, of_train: Sequence[Car]) -> rrb.Spatial2DView:
    """Return the view of the row of cars; its title explains the colours."""
    last = of_train[-1]
    scale = _height_scale(of_train)
    low, high = _ends_of_friction(run, of_train)
    rail = f"rail: friction {low:.3g}, the same everywhere"
    if high > low:
        rail = f"rail ahead of each wheel: brown mu_cd {low:.3g}, light {high:.3g}"
    return rrb.Spatial2DView(
        name=(
            f"Train to the left; cars and wheels: grey no slip, red {100 * FULL_SLIP:.0f} % and more; "
            f"{rail}; couplers: blue tension, orange compression, displaced {STRETCH:.0f} times"
        ),
        origin=ROW,
        background=(24, 27, 31),
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-_MARGIN_M, last.front_m + last.length_m + _MARGIN_M),
            y_range=(-(_ROOF_M + 2.0) * scale, 1.5 * scale),
        ),
    )


def _ends_of_friction(run: Run, of_train: Sequence[Car]) -> tuple[float, float]:
    """Return the lowest and the highest friction that an axle has met."""
    met = [run.column(f"friction_degraded_{axle}") for car in of_train for axle in car.axles]
    return float(np.min(met)), float(np.max(met))


# --- the row of cars ---


class _Row:
    """Sends the row of cars: bodies and wheels, couplers, and the rail below them.

    In its plane x points backwards along the train and y points down; the top of the rail is 0.
    """

    def __init__(self, stream: rr.RecordingStream, run: Run, of_train: Sequence[Car]) -> None:
        self._stream = stream
        self._run = run
        self._cars = of_train
        self._scale = _height_scale(of_train)
        self._time_s = run.column("time_s")
        self._frames = _frames(self._time_s)
        self._times = views.times(self._time_s[self._frames])
        speed_m_s = run.column("vehicle_speed_m_s")[self._frames]
        self._fast_m_s = np.where(speed_m_s >= _SLOWEST_M_S, speed_m_s, np.inf)
        self._changes = views.Changes(stream)

    def draw(self) -> None:
        """Send everything."""
        shift_m = np.zeros(len(self._frames))
        for car in self._cars:
            if car.number > 1:
                displacement_m = self._run.column(f"coupler_{car.number - 1}_m")[self._frames]
                self._draw_coupler(car)
                shift_m = shift_m + STRETCH * displacement_m
            self._draw_car(car, shift_m)
        self._draw_rail()

    def _draw_car(self, car: Car, shift_m: np.ndarray) -> None:
        path = f"{ROW}/car_{car.number}"
        translation = np.column_stack([shift_m, np.zeros((len(shift_m), 2))])
        moved = rr.Transform3D.columns(translation=translation)
        self._stream.send_columns(path, [self._times], moved)

        middle_m = -0.5 * (_FLOOR_M + _ROOF_M) * self._scale
        half_m = 0.5 * (_ROOF_M - _FLOOR_M) * self._scale
        # the ends of a strip are round: it reaches half its height further
        front_m = car.front_m + _GAP_M + half_m
        rear_m = car.front_m + car.length_m - _GAP_M - half_m
        body = rr.LineStrips2D.from_fields(
            strips=[[(front_m, middle_m), (rear_m, middle_m)]],
            radii=half_m,
            draw_order=1.0,
        )
        self._stream.log(f"{path}/body", body, static=True)
        label = rr.Points2D(
            [(0.5 * (front_m + rear_m), middle_m)],
            radii=0.01,
            colors=[(0, 0, 0)],
            labels=[_name(car.number)],
            show_labels=True,
            draw_order=3.0,
        )
        self._stream.log(f"{path}/name", label, static=True)
        slips = [self._slip(axle) for axle in car.axles]
        self._send_steps(f"{path}/body", np.mean(slips, axis=0), rr.LineStrips2D)

        radius_m = _WHEEL_RADIUS_M * self._scale
        wheels = rr.Points2D.from_fields(
            positions=[(place_m, -radius_m) for place_m in car.wheelsets_m],
            radii=radius_m,
            draw_order=2.0,
        )
        self._stream.log(f"{path}/wheels", wheels, static=True)
        shades = _mixed(np.column_stack(slips), _NO_SLIP, _FULL)
        self._send_colours(f"{path}/wheels", shades, rr.Points2D)

    def _slip(self, axle: int) -> np.ndarray:
        """Return the slip of an axle as a share of `FULL_SLIP`, 0 to 1, shape (frames,)."""
        sliding_m_s = np.nan_to_num(self._run.column(f"sliding_{axle}_m_s")[self._frames])
        return np.clip(np.abs(sliding_m_s) / self._fast_m_s / FULL_SLIP, 0.0, 1.0)

    def _draw_coupler(self, behind: Car) -> None:
        """Draw the coupler ahead of a car, in the colour of its force."""
        # it moves with this car
        path = f"{ROW}/car_{behind.number}/coupler"
        height_m = -_FLOOR_M * self._scale
        ends = [
            (behind.front_m - 2.0 * _GAP_M, height_m),
            (behind.front_m + 2.0 * _GAP_M, height_m),
        ]
        strip = rr.LineStrips2D.from_fields(strips=[ends], radii=0.2 * self._scale, draw_order=2.0)
        self._stream.log(path, strip, static=True)
        force_N = self._run.column(f"coupler_{behind.number - 1}_N")[self._frames]
        largest_N = max(float(np.abs(force_N).max(initial=0.0)), 1.0)
        self._send_steps(path, force_N / largest_N, rr.LineStrips2D, _TENSION, _COMPRESSION)

    def _draw_rail(self) -> None:
        """Draw the rail below the train: each cell has the friction that the next wheel meets."""
        axles_m = np.array([place_m for car in self._cars for place_m in car.wheelsets_m])
        cell_m = _CELL_M * self._scale
        cells_m = np.arange(0.5 * cell_m - _MARGIN_M, axles_m[-1], cell_m)
        # the first axle behind each cell meets it next
        nexts = np.searchsorted(axles_m, cells_m)
        top_m = 0.5 * _RAIL_HEIGHT_M * self._scale
        strips = [
            [(place_m - 0.5 * cell_m, top_m), (place_m + 0.5 * cell_m, top_m)]
            for place_m in cells_m
        ]
        rail = rr.LineStrips2D.from_fields(strips=strips, radii=top_m, draw_order=0.0)
        self._stream.log(f"{ROW}/rail", rail, static=True)

        column = self._run.column
        ways_m = [car.place_m(column, axle) for car in self._cars for axle in car.axles]
        front_m = ways_m[0][self._frames] + axles_m[0]
        friction = np.empty((len(self._frames), len(cells_m)))
        for cell, (behind_m, axle) in enumerate(zip(cells_m, nexts, strict=True)):
            met = column(f"friction_degraded_{axle + 1}")
            friction[:, cell] = np.interp(front_m - behind_m, ways_m[axle], met)
        low, high = _ends_of_friction(self._run, self._cars)
        share = (friction - low) / max(high - low, 1e-9)
        self._send_colours(f"{ROW}/rail", _mixed(share, DIRTY, CLEAN), rr.LineStrips2D)

    def _send_steps(
        self,
        path: str,
        share: np.ndarray,
        archetype: Any,
        full: Colour = _FULL,
        negative: Colour = _FULL,
    ) -> None:
        """Send one colour where it changes: from no slip to `full` (1) or `negative` (-1)."""
        steps = np.rint(_STEPS * np.clip(share, -1.0, 1.0)).astype(np.int64) + _STEPS

        def columns(places: np.ndarray) -> Any:
            shares = (places - _STEPS) / _STEPS
            up = _mixed(np.maximum(shares, 0.0), _NO_SLIP, full)
            down = _mixed(np.maximum(-shares, 0.0), _NO_SLIP, negative)
            return archetype.columns(colors=np.where(shares[:, np.newaxis] < 0.0, down, up))

        self._changes.send(path, self._time_s[self._frames], steps, columns)

    def _send_colours(self, path: str, shades: np.ndarray, archetype: Any) -> None:
        """Send the colours of several shapes of one entity, shape (frames, shapes, 3)."""
        frames, shapes, _ = shades.shape
        columns = archetype.columns(colors=shades.reshape(frames * shapes, 3))
        self._stream.send_columns(path, [self._times], columns.partition([shapes] * frames))


def _frames(time_s: np.ndarray) -> np.ndarray:
    """Return the places of the samples that begin a frame of the animation."""
    frame = np.floor(time_s * _RATE_HZ + 1e-6).astype(np.int64)
    return np.flatnonzero(np.diff(frame, prepend=-1) > 0)


def _mixed(share: np.ndarray, none: Colour, full: Colour) -> np.ndarray:
    """Return colours between `none` (0) and `full` (1), uint8, with the shape of `share` and 3."""
    share = np.clip(share, 0.0, 1.0)[..., np.newaxis]
    return np.rint((1.0 - share) * np.array(none) + share * np.array(full)).astype(np.uint8)
