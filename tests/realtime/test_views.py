"""What is drawn of a run: every signal, in one colour an axle, and nothing that is not recorded."""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import rerun as rr
import synthetic_stop
from PIL import Image
from rerun.chunk import RrdReader

from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.realtime.pictures import colours
from rollerrig.realtime.record import channels
from rollerrig.realtime.telemetry import drawing, scene, viewer, views
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.signals import SIGNALS


@pytest.fixture(autouse=True)
def strict():
    rr.set_strict_mode(True)


@pytest.fixture(scope="module")
def stop():
    return synthetic_stop.stop(speed_m_s=20.0, lock_axle=1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, stop):
    """The folder of a recorded run."""
    path = tmp_path_factory.mktemp("runs") / "first"
    path.mkdir()
    written = channels.Channels(path)
    written.add(stop)
    written.finish()
    (path / "scenario.toml").write_text('title = "a run"\n[contact]\nroller_radius_m = 0.75\n')
    return path


@pytest.fixture(scope="module")
def drawn(tmp_path_factory, stop):
    """The chunks of a run drawn in blocks, by entity: (times in s, record batch)."""
    path = tmp_path_factory.mktemp("drawn") / "run.rrd"
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(path), default_blueprint=views.blueprint())
    one = drawing.Drawing(stream, {})
    for first in range(0, len(stop), 70):
        one.rows(stop[first : first + 70])
    one.events(synthetic_stop.EVENTS)
    stream.disconnect()
    return entities(path)


def entities(path):
    """Everything in a .rrd that has times: entity -> component -> list of (time in s, value)."""
    found = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        times = np.array(batch["t"].cast("int64").to_pylist()) / 1e9
        for name in batch.schema.names:
            if ":" in name:
                values = found.setdefault(str(chunk.entity_path), {}).setdefault(name, [])
                values += zip(times, batch[name].to_pylist(), strict=True)
    for components in found.values():
        for values in components.values():
            values.sort(key=lambda pair: pair[0])
    return found


def every_view(container):
    for part in container.contents:
        if hasattr(part, "class_identifier"):
            yield part
        else:
            yield from every_view(part)


def test_every_recorded_column_is_drawn_once():
    drawn = [column for one in views.lines() for column in one.columns]
    valves = range(*signals.span("valve").indices(len(signals.COLUMNS)))
    assert sorted([*drawn, *valves, signals.column("time")]) == list(range(len(signals.COLUMNS)))


@pytest.mark.parametrize("signal", [s for s in SIGNALS if s.group], ids=lambda s: s.name)
def test_a_signal_of_a_group_has_a_path_of_its_group_and_name(signal):
    if signal.name == "valve":
        return
    paths = [one.path for one in views.lines() if signals.column(signal.name) in one.columns]
    assert len(paths) == 1
    assert paths[0].startswith(f"/{signal.group}/{signal.name}")


@pytest.mark.parametrize("group", sorted({s.group for s in SIGNALS if s.group}))
def test_every_group_is_shown_by_a_view(group):
    shown = [
        expression
        for view in every_view(views.blueprint().root_container)
        for expression in ([view.origin] if view.contents == "$origin/**" else view.contents)
    ]
    assert any(str(path).startswith(f"/{group}") for path in shown)


def test_one_colour_means_one_axle_in_every_view():
    for signal in SIGNALS:
        if signal.axles == 1 or signal.name in ("valve", *views.COLOUR_OF_SIGNAL):
            continue
        for axle in range(1, signal.axles + 1):
            place = signals.column(signal.name, axle)
            one = next(one for one in views.lines() if place in one.columns)
            assert one.colours[one.columns.index(place)] == colours.AXLES[axle - 1]


def test_the_colours_of_axles_and_limits_differ():
    others = (colours.VEHICLE, colours.REFERENCE, colours.LIMIT)
    shades = np.array([*colours.AXLES, *others])
    apart = [np.abs(one - other).sum() for i, one in enumerate(shades) for other in shades[:i]]
    assert min(apart) > 60


def test_a_spike_of_one_sample_is_drawn_at_its_full_height(tmp_path):
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(tmp_path / "run.rrd"))
    views.log_styles(stream)
    stream.disconnect()
    policies = {}
    for chunk in RrdReader(tmp_path / "run.rrd").stream():
        batch = chunk.to_record_batch()
        if "SeriesLines:aggregation_policy" in batch.schema.names:
            policies[str(chunk.entity_path)] = batch["SeriesLines:aggregation_policy"].to_pylist()
    wanted = rr.components.AggregationPolicy.MinMax.value
    assert policies == {one.path: [[wanted]] for one in views.lines()}


def test_what_is_drawn_are_the_recorded_values(drawn, stop):
    for one in views.lines():
        values = drawn[one.path]["Scalars:scalars"]
        assert np.array_equal([time for time, _ in values], np.rint(stop[:, 0] * 1e9) / 1e9)
        assert np.array_equal(
            [row for _, row in values], one.factor * stop[:, one.columns], equal_nan=True
        )


def test_slip_is_drawn_in_percent_of_the_reference(drawn, stop):
    reference, rim = (
        stop[:, signals.column(name)]
        for name in ("wsp_reference_speed", "wheel_circumferential_speed")
    )
    found = np.array([row[0] for _, row in drawn["/slip/axle_1"]["Scalars:scalars"]])
    fast = reference >= 1.0
    assert np.allclose(found[fast], 100.0 * (1.0 - rim[fast] / reference[fast]))
    assert np.isnan(found[~fast]).all()
    assert found[fast].max() > 95.0, "the stop of this test locks axle 1"


def test_a_fault_is_marked_across_the_plots_of_speeds(drawn):
    marks = drawn["/speeds/marks"]["Scalars:scalars"]
    told = {event.time_s for event in synthetic_stop.EVENTS if event.level != "info"}
    assert {round(time, 6) for time, _ in marks} == told


def test_a_valve_is_drawn_where_it_changes_and_nowhere_else(drawn, stop):
    for axle in range(1, 5):
        column = signals.column("valve", axle)
        changes = np.flatnonzero(np.diff(stop[:, column], prepend=-1))
        names = ("fill", "hold", "vent")
        expected = [(stop[at, 0], [names[int(stop[at, column])]]) for at in changes]
        found = drawn[views.valve(axle)]["StateChange:state"]
        assert [value for _, value in found] == [value for _, value in expected]
        assert np.allclose([time for time, _ in found], [time for time, _ in expected])


def test_wheels_turn_by_their_recorded_angle_geared_down(drawn, stop):
    turned = drawn["/rig/axle_2/wheels"]["Transform3D:quaternion"]
    times = np.array([time for time, _ in turned])
    assert np.all(np.diff(times) > 0.039)
    angle = np.interp(times, stop[:, 0], stop[:, signals.column("wheel_angle", 2)]) / scene.GEARING
    expected = np.column_stack([0 * angle, np.sin(angle / 2), 0 * angle, np.cos(angle / 2)])
    assert np.allclose([value[0] for _, value in turned], expected, atol=1e-6)


def test_rollers_turn_against_their_wheels(drawn):
    last = {
        part: drawn[f"/rig/axle_4/{part}"]["Transform3D:quaternion"][3][1][0]
        for part in ("wheels", "rollers")
    }
    assert last["wheels"][1] > 0.0 > last["rollers"][1]


def test_spokes_turn_red_while_a_wheel_is_locked(drawn, stop):
    speed = stop[:, signals.column("vehicle_speed")]
    rim = stop[:, signals.column("wheel_circumferential_speed", 1)]
    locked = (speed > 0.5) & (rim < 0.1 * speed)
    assert locked.any(), "the stop of this test locks axle 1"
    red = int.from_bytes(bytes([*scene.LOCKED, 255]))
    reds = [
        time
        for time, colour in drawn["/rig/axle_1/wheels/spokes"]["LineStrips3D:colors"]
        if colour == [red]
    ]
    begins = stop[np.flatnonzero(np.diff(locked.astype(int), prepend=0) == 1), 0]
    assert np.allclose(reds, begins)


def test_events_are_drawn_with_level_and_time(drawn):
    events = drawn[views.EVENTS]
    assert [value for _, value in events["TextLog:level"]] == [
        ["INFO"],
        ["INFO"],
        ["INFO"],
        ["WARN"],
        ["ERROR"],
    ]
    assert [time for time, _ in events["TextLog:text"]] == [
        event.time_s for event in synthetic_stop.EVENTS
    ]
    assert all(
        event.text in value[0]
        for event, (_, value) in zip(synthetic_stop.EVENTS, events["TextLog:text"], strict=True)
    )


def test_signals_of_no_group_can_be_left_out(tmp_path, stop):
    stream = rr.RecordingStream(views.APPLICATION)
    stream.set_sinks(rr.FileSink(tmp_path / "run.rrd"))
    drawing.Drawing(stream, {}, everything=False).rows(stop[:10])
    stream.disconnect()
    assert not [path for path in entities(tmp_path / "run.rrd") if path.startswith("/more")]


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
    place = scene.geometry(scenario)
    radius = place.roller_radius_m if np.isfinite(place.roller_radius_m) else 0.0
    assert np.allclose(place.wheels[:, 2], radius + place.wheel_radius_m)  # wheels stand on rollers
    assert np.all(np.diff(place.wheels[:, 0]) < 0.0)  # axle 1 leads
    stream = rr.RecordingStream(views.APPLICATION)
    memory = stream.memory_recording()
    scene.draw(stream, place)
    assert memory.num_msgs() > 10


def test_runs_are_laid_over_one_another_under_their_names(folder, tmp_path):
    other = tmp_path / "second run"
    shutil.copytree(folder, other)
    found = entities(viewer.overlay([folder, other, other], tmp_path / "both.rrd"))
    assert {
        "/sliding/sliding",
        "/ref/second_run/sliding/sliding",
        "/ref/second_run_2/sliding/sliding",
    } <= set(found)
    assert found["/sliding/sliding"] == found["/ref/second_run/sliding/sliding"]


def test_without_a_display_the_command_for_a_browser_is_told(folder, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    opened = viewer.open_run([folder])
    assert opened["opened"] is False
    assert opened["file"] == str(folder / "run.rrd")  # drawn anew, since this run had none
    assert opened["command"].startswith("rerun --serve-web --bind 127.0.0.1 ")
    assert opened["command"].endswith(opened["file"])


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="not a run's folder"):
        viewer.open_run([tmp_path])


def test_the_viewer_is_told_not_to_report_its_use():
    told = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "analytics", "config"],
        text=True,
        env=viewer.environment(),
        capture_output=True,
        check=True,
    ).stdout
    assert '"analytics_enabled": false' in told


def test_without_a_graphics_driver_the_message_says_what_to_install(folder, tmp_path, monkeypatch):
    for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES"):
        monkeypatch.setenv(name, os.devnull)
    with pytest.raises(RollerrigError, match="mesa-vulkan-drivers libvulkan1"):
        viewer.picture([folder], tmp_path / "run.png")


def test_a_picture_shows_every_axle_in_its_colour(folder, tmp_path):
    try:
        viewer.picture([folder], tmp_path / "run.png", (1200, 800), 5.0)
    except RollerrigError as error:
        if "Vulkan" in str(error):
            pytest.skip(str(error))
        raise
    image = np.asarray(Image.open(tmp_path / "run.png").convert("RGB")).astype(int)
    assert image.shape == (800, 1200, 3)
    for colour in colours.AXLES:
        near = np.abs(image - colour).sum(axis=2) < 40
        assert near.sum() > 200
