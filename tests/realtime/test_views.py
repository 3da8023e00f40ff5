"""A recording shows every signal, with one colour for each axle, and shows only recorded values."""

import itertools
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
import synthetic_stop
from drawn_samples import entities
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image
from rerun.chunk import RrdReader

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.vehicle import ALLOWED_AXLES, COACH, Kind
from rollerrig.realtime import cli
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import channels, records
from rollerrig.realtime.reports import stop as run_stop
from rollerrig.realtime.telemetry import drawing, scene, viewer, views
from rollerrig.wsp_interface import signals

TABLE = signals.table(COACH)
COLUMNS = TABLE.columns
TIME = signals.column("time")
GROUPS = sorted({signal.group for signal in TABLE.signals if signal.group})

# Signals that are an entity of scalars in a group. The valves are states, not scalars.
SCALARS_OF_GROUPS = [s for s in TABLE.signals if s.group and s.name != "valve"]

AXLE_COLOURS = colours.AXLES[: COACH.axles]

# components of entities
SCALARS = "Scalars:scalars"
STATE = "StateChange:state"
QUATERNION = "Transform3D:quaternion"
SPOKE_COLOURS = "LineStrips3D:colors"
TEXT = "TextLog:text"
LEVEL = "TextLog:level"
AGGREGATION = "SeriesLines:aggregation_policy"


@pytest.fixture(autouse=True)
def strict():
    """Let Rerun raise its errors; by default it only logs them."""
    rr.set_strict_mode(True)


@pytest.fixture(scope="module")
def stop():
    """The rows of all signals of a stop in which axle 1 locks."""
    return synthetic_stop.stop(speed_m_s=20.0, lock_axle=1)


def recorded(path, rows):
    """Make the folder of a recorded run; return it."""
    path.mkdir()
    writer = channels.Channels(path, COLUMNS)
    writer.add(rows[:, TABLE.kept])
    writer.finish()
    (path / "scenario.toml").write_text('title = "a run"\n[contact]\nroller_radius_m = 0.75\n')
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory, stop):
    """The folder of a recorded run."""
    return recorded(tmp_path_factory.mktemp("runs") / "first", stop)


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, stop):
    """The entities of a run that is drawn in blocks of rows, see `entities`."""
    path = tmp_path_factory.mktemp("drawn") / "run.rrd"
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(path), default_blueprint=views.blueprint(TABLE))
    run = drawing.Drawing(stream, TABLE, {})
    block_rows = 70
    for first in range(0, len(stop), block_rows):
        run.rows(stop[first : first + block_rows])
    run.events(synthetic_stop.EVENTS)
    stream.disconnect()
    return entities(path)


def times_of(samples):
    """Return the times of samples in s, shape (n,)."""
    return np.array([sample.time_s for sample in samples])


def values_of(samples):
    return [sample.value for sample in samples]


def lines_with(column):
    """Return the entities of scalars that show a column of a row."""
    return [line for line in views.lines(TABLE) if column in line.columns]


# --- entities and layout ---


def test_every_recorded_column_is_drawn_exactly_once():
    columns = [TIME, *range(signals.WIDTH)[TABLE.span("valve")]]
    for line in views.lines(TABLE):
        columns += line.columns
    assert sorted(columns) == TABLE.kept.tolist()


@pytest.mark.parametrize("signal", SCALARS_OF_GROUPS, ids=lambda signal: signal.name)
def test_a_signal_of_a_group_has_a_path_of_its_group_and_name(signal):
    (line,) = lines_with(signals.column(signal.name))
    assert line.path.startswith(f"/{signal.group}/{signal.name}")


def views_in(container):
    """Yield all views of a container of the layout, also those in nested containers."""
    for part in container.contents:
        is_view = hasattr(part, "class_identifier")
        if is_view:
            yield part
        else:
            yield from views_in(part)


def paths_shown_by(view):
    if view.contents == "$origin/**":
        return [view.origin]
    return view.contents


@pytest.mark.parametrize("group", GROUPS)
def test_every_group_is_shown_by_a_view(group):
    paths = []
    for view in views_in(views.blueprint(TABLE).root_container):
        paths += paths_shown_by(view)
    assert any(str(path).startswith(f"/{group}") for path in paths)


def test_signals_of_no_group_can_be_left_out(tmp_path, stop):
    file = tmp_path / "run.rrd"
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(file))
    drawing.Drawing(stream, TABLE, {}, everything=False).rows(stop[:10])
    stream.disconnect()
    assert not [path for path in entities(file) if path.startswith("/more")]


# --- styles ---


def test_one_colour_means_one_axle_in_every_view():
    for signal in TABLE.signals:
        has_axle_colours = signal.axles > 1 and signal.name not in views.COLOUR_OF_SIGNAL
        if not has_axle_colours or signal.name == "valve":
            continue
        for axle in range(1, signal.axles + 1):
            column = signals.column(signal.name, axle)
            line = lines_with(column)[0]
            series = line.columns.index(column)
            assert line.colours[series] == colours.AXLES[axle - 1]


def test_the_colours_of_axles_and_limits_differ():
    shades = np.array([*AXLE_COLOURS, colours.VEHICLE, colours.REFERENCE, colours.LIMIT])
    for first, second in itertools.combinations(shades, 2):
        assert np.abs(first - second).sum() > 60


def test_a_spike_of_one_sample_is_drawn_at_its_full_height(tmp_path):
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(tmp_path / "run.rrd"))
    views.log_styles(stream, TABLE)
    stream.disconnect()

    policies = {}
    for chunk in RrdReader(tmp_path / "run.rrd").stream():
        batch = chunk.to_record_batch()
        if AGGREGATION in batch.schema.names:
            policies[str(chunk.entity_path)] = batch[AGGREGATION].to_pylist()

    min_and_max = rr.components.AggregationPolicy.MinMax.value
    assert policies == {line.path: [[min_and_max]] for line in views.lines(TABLE)}


# --- what is drawn of a run ---


def test_the_drawn_values_are_the_recorded_values(drawn, stop):
    # the timeline holds whole nanoseconds
    times_s = np.rint(stop[:, TIME] * 1e9) / 1e9
    for line in views.lines(TABLE):
        samples = drawn[line.path][SCALARS]
        expected = line.factor * stop[:, line.columns]
        assert np.array_equal(times_of(samples), times_s)
        assert np.array_equal(values_of(samples), expected, equal_nan=True)


def test_slip_is_drawn_in_percent_of_the_reference(drawn, stop):
    reference_m_s = stop[:, signals.column("wsp_reference_speed")]
    rim_m_s = stop[:, signals.column("wheel_circumferential_speed", 1)]
    samples = drawn["/slip/axle_1"][SCALARS]
    slip_percent = np.array([value[0] for value in values_of(samples)])

    is_fast = reference_m_s >= 1.0
    expected = 100.0 * (1.0 - rim_m_s[is_fast] / reference_m_s[is_fast])
    assert np.allclose(slip_percent[is_fast], expected)
    assert np.isnan(slip_percent[~is_fast]).all()
    assert slip_percent[is_fast].max() > 95.0, "axle 1 locks in the stop of this test"


def test_a_fault_is_marked_in_the_plots_of_speeds(drawn):
    marks = drawn["/speeds/marks"][SCALARS]
    faults_s = {event.time_s for event in synthetic_stop.EVENTS if event.level != "info"}
    # a mark has a third point, one nanosecond later
    assert {round(mark.time_s, 6) for mark in marks} == faults_s


@pytest.mark.parametrize("axle", range(1, 5))
def test_a_valve_is_drawn_only_where_it_changes(drawn, stop, axle):
    states = stop[:, signals.column("valve", axle)].astype(int)
    changes = np.flatnonzero(np.diff(states, prepend=-1))
    names = ("fill", "hold", "vent")

    samples = drawn[views.valve(axle)][STATE]
    assert values_of(samples) == [[names[state]] for state in states[changes]]
    assert np.allclose(times_of(samples), stop[changes, TIME])


def test_wheels_turn_by_their_recorded_angle_slowed_down(drawn, stop):
    samples = drawn["/rig/axle_2/wheels"][QUATERNION]
    times_s = times_of(samples)
    # at most 25 pictures in a second
    assert np.all(np.diff(times_s) > 0.039)

    recorded_rad = stop[:, signals.column("wheel_angle", 2)]
    angle_rad = np.interp(times_s, stop[:, TIME], recorded_rad) / scene.GEARING
    zero = np.zeros_like(angle_rad)
    # a rotation about the y axis, as x, y, z, w
    expected = np.column_stack([zero, np.sin(angle_rad / 2), zero, np.cos(angle_rad / 2)])
    quaternions = [value[0] for value in values_of(samples)]
    assert np.allclose(quaternions, expected, atol=1e-6)


def test_rollers_turn_against_their_wheels(drawn):
    # a short time after the begin, before half a revolution
    picture = 3
    (wheels,) = drawn["/rig/axle_4/wheels"][QUATERNION][picture].value
    (rollers,) = drawn["/rig/axle_4/rollers"][QUATERNION][picture].value
    _, wheels_y, _, _ = wheels
    _, rollers_y, _, _ = rollers
    assert wheels_y > 0.0
    assert rollers_y < 0.0


def test_spokes_become_red_when_a_wheel_locks(drawn, stop):
    vehicle_m_s = stop[:, signals.column("vehicle_speed")]
    rim_m_s = stop[:, signals.column("wheel_circumferential_speed", 1)]
    is_locked = (vehicle_m_s > 0.5) & (rim_m_s < 0.1 * vehicle_m_s)
    assert is_locked.any(), "axle 1 locks in the stop of this test"
    locks = np.flatnonzero(np.diff(is_locked.astype(int), prepend=0) == 1)

    opaque = 255
    red = int.from_bytes(bytes([*scene.LOCKED, opaque]))
    samples = drawn["/rig/axle_1/wheels/spokes"][SPOKE_COLOURS]
    becomes_red_s = [sample.time_s for sample in samples if sample.value == [red]]
    assert np.allclose(becomes_red_s, stop[locks, TIME])


def test_events_are_drawn_with_level_time_and_text(drawn):
    texts = drawn[views.EVENTS][TEXT]
    levels = drawn[views.EVENTS][LEVEL]
    assert values_of(levels) == [["INFO"], ["INFO"], ["INFO"], ["WARN"], ["ERROR"]]
    for event, text in zip(synthetic_stop.EVENTS, texts, strict=True):
        assert text.time_s == event.time_s
        assert event.text in text.value[0]


@pytest.mark.parametrize(
    "scenario",
    [
        {},
        {"contact": {"roller_radius_m": 0.5}},
        {"contact": {"roller_radius_m": float("inf")}},
        {"rig": {"mode": "track"}},
        {"vehicle": {"wheel_radius_m": 0.46, "bogie_wheelbase_m": 2.5}},
    ],
)
def test_the_rig_of_any_scenario_can_be_drawn(scenario):
    place = scene.geometry(COACH, scenario)
    ahead_m, _, height_m = place.wheels.T

    # the wheels are on the rollers, or on rails at height 0
    top_m = place.roller_radius_m
    if np.isinf(top_m):
        top_m = 0.0
    assert np.allclose(height_m, top_m + place.wheel_radius_m)

    # axle 1 leads
    assert np.all(np.diff(ahead_m) < 0.0)

    stream = rr.RecordingStream(views.APPLICATION)
    memory = stream.memory_recording()
    scene.draw(stream, place)
    assert memory.num_msgs() > 10


@pytest.mark.parametrize("axles", ALLOWED_AXLES)
def test_the_rig_of_any_vehicle_can_be_drawn_without_a_scenario(axles):
    place = scene.geometry(Kind(axles), {})
    assert len(place.wheels) == len(place.rollers) == axles
    assert np.all(np.diff(place.wheels[:, 0]) < 0.0)


# --- the viewer ---


def test_several_runs_are_drawn_in_one_recording_under_their_names(stop, tmp_path):
    first = recorded(tmp_path / "first", stop[:200])
    second = recorded(tmp_path / "second run", stop[:200])
    overlay = entities(viewer.overlay([first, second, second], tmp_path / "both.rrd"))

    of_first = "/sliding/sliding"
    of_second = "/ref/second_run/sliding/sliding"
    of_third = "/ref/second_run_2/sliding/sliding"
    assert set(overlay) >= {of_first, of_second, of_third}
    assert overlay[of_first] == overlay[of_second]


def test_runs_of_different_vehicles_are_drawn_in_one_recording(folder, tmp_path):
    table = signals.table(Kind(6, dynamic_brake=True))
    tram = tmp_path / "tram"
    tram.mkdir()
    writer = channels.Channels(tram, table.columns)
    values = np.zeros((10, len(table.columns)))
    values[:, table.columns.index("time_s")] = np.arange(10) / 100.0
    writer.add(values)
    writer.finish()
    (tram / "scenario.toml").write_text("[vehicle]\naxles = 6\n[dynamic_brake]\naxles = [1, 2]\n")
    overlay = entities(viewer.overlay([folder, tram], tmp_path / "both.rrd"))
    assert "/adhesion/adhesion_4" in overlay
    assert "/adhesion/adhesion_5" not in overlay
    assert "/ref/tram/adhesion/adhesion_6" in overlay
    assert "/ref/tram/dynamic_torques/dynamic_torque" in overlay


def test_without_a_display_the_result_is_a_command_for_a_browser(folder, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    result = viewer.open_run([folder])
    assert result["opened"] is False
    assert "no display" in result["because"]
    assert "DISPLAY" in result["because"]
    # this run had no recording, so there is a new one
    assert result["file"] == str(folder / "run.rrd")
    assert result["command"].startswith("rerun --serve-web --bind 127.0.0.1 ")
    assert result["command"].endswith(result["file"])


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="not a run's folder"):
        viewer.open_run([tmp_path])


def test_the_viewer_does_not_report_its_use():
    process = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "analytics", "config"],
        text=True,
        env=viewer.environment(),
        capture_output=True,
        check=True,
    )
    assert '"analytics_enabled": false' in process.stdout


def test_without_a_graphics_driver_the_message_has_the_packages_to_install(
    folder, tmp_path, monkeypatch
):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, os.devnull)
    with pytest.raises(RollerrigError, match="mesa-vulkan-drivers libvulkan1"):
        viewer.picture([folder], tmp_path / "run.png")


def test_a_picture_shows_every_axle_in_its_colour(folder, tmp_path):
    png = tmp_path / "run.png"
    try:
        viewer.picture([folder], png, size=(1200, 800), time_s=5.0)
    except RollerrigError as error:
        if "Vulkan" in str(error):
            pytest.skip(str(error))
        raise

    image = np.asarray(Image.open(png).convert("RGB")).astype(int)
    assert image.shape == (800, 1200, 3)
    for colour in AXLE_COLOURS:
        difference = np.abs(image - colour).sum(axis=2)
        assert (difference < 40).sum() > 200


# --- pictures for reports ---


def other_run(folder, tmp_path):
    """Return the folder of a second run."""
    other = tmp_path / "second"
    shutil.copytree(folder, other)
    return other


@pytest.fixture
def reported(tmp_path, stop):
    """The folder of a run with a whole scenario."""
    path = tmp_path / "first"
    path.mkdir()
    writer = channels.Channels(path, COLUMNS)
    writer.add(stop[:, TABLE.kept])
    writer.finish()
    (path / "scenario.toml").write_text(scenario.dump(scenario.load("velim_a1")))
    return path


def test_a_picture_for_a_report_is_light_and_shows_every_axle_in_its_colour(reported, tmp_path):
    png = tmp_path / "report.png"
    run_stop.write_runs([records.load(reported)], png, (1200, 900))
    image = np.asarray(Image.open(png).convert("RGB")).astype(int)
    assert image.shape == (900, 1200, 3)
    assert (image[[0, -1]] == 255).all()
    assert (image == 255).all(axis=2).mean() > 0.7
    for colour in AXLE_COLOURS:
        difference = np.abs(image - colour).sum(axis=2)
        assert (difference < 40).sum() > 100


def test_the_legend_of_a_picture_names_each_run_and_each_has_other_lines(reported, tmp_path):
    runs = [records.load(reported), records.load(other_run(reported, tmp_path))]
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    run_stop.draw_runs(figure, runs)
    (legend,) = figure.legends
    entries = {
        text.get_text(): (line.get_marker(), line.get_linewidth())
        for text, line in zip(legend.get_texts(), legend.legend_handles, strict=True)
        if isinstance(line, Line2D)
    }
    first, second = (look for name, look in entries.items() if name.startswith(("first", "second")))
    assert first != second
    colours_of = {
        text.get_text(): line.get_color()
        for text, line in zip(legend.get_texts(), legend.legend_handles, strict=True)
        if isinstance(line, Line2D)
    }
    of_runs = {shade for name, shade in colours_of.items() if name.startswith(("first", "second"))}
    assert colours_of["vehicle"] not in of_runs
    # the rows of the valves have a part for each run
    assert "row of a valve has one part for each run" in legend.get_title().get_text()
    assert [f"axle {axle}" in entries for axle in range(1, 5)] == [True] * 4


def test_each_axle_has_a_kind_of_line_besides_its_colour(reported):
    figure = Figure(figsize=(12.0, 9.0), layout="constrained")
    run_stop.draw_runs(figure, [records.load(reported)])
    kinds = {
        line.get_label(): str(line._dash_pattern)
        for line in figure.axes[0].get_lines()
        if line.get_label().startswith("axle")
    }
    assert len(kinds) == len(set(kinds.values())) == 4


def test_a_picture_of_an_unknown_kind_is_refused_with_the_kinds_that_there_are(reported, tmp_path):
    with pytest.raises(ConfigError, match=r"allowed are .png, .svg, .pdf"):
        run_stop.write_runs([records.load(reported)], tmp_path / "run.gif", (800, 600))


def test_view_png_writes_the_picture_for_a_report_without_a_viewer(reported, tmp_path, monkeypatch):
    # no graphics driver is found, and none is needed
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, os.devnull)
    runs = (str(reported), str(other_run(reported, tmp_path)))
    for name in ("two.png", "two.svg"):
        words = ("view", *runs, "--png", str(tmp_path / name), "--size", "1000x800")
        assert cli.main(words) == 0
    assert Image.open(tmp_path / "two.png").size == (1000, 800)
    svg = (tmp_path / "two.svg").read_text()
    assert "first (" in svg
    assert "second (" in svg
