"""The layout in Rerun of vehicles with motors, magnets or more than four axles."""

import functools
from typing import NamedTuple

import pytest

from rollerrig.configs.vehicle import COACH, Kind
from rollerrig.realtime.telemetry import views
from rollerrig.wsp_interface import signals

TAB = "Motors and magnets"
BOTH = Kind(6, dynamic_brake=True, magnetic_track_brake=True)


class Layout(NamedTuple):
    """The default layout of a vehicle.

    `names` are those of all tabs and plots, `contents` the paths that they show, and `entities` the
    paths of all entities with the names of their series.
    """

    names: list
    contents: list
    entities: list


@functools.cache
def layout(kind):
    table = signals.table(kind)
    names = []
    contents = []

    def walk(part):
        names.append(getattr(part, "name", None))
        for path in getattr(part, "contents", []):
            if isinstance(path, str):
                contents.append(path)
            else:
                walk(path)

    walk(views.blueprint(table).root_container)
    return Layout(names, contents, [(line.path, line.names) for line in views.lines(table)])


@pytest.mark.parametrize(
    "groups",
    [
        ["dynamic_torques", "dynamic_share"],
        ["track_brake", "track_brake_lowered", "track_brake_cleaning"],
    ],
)
def test_motors_and_magnets_have_a_tab_of_the_default_layout(groups):
    found = layout(BOTH)
    assert found.names.count(TAB) == 1
    for group in groups:
        assert found.contents.count(f"/{group}/**") == 1
        paths = [path for path, _ in found.entities if path.startswith(f"/{group}/")]
        assert paths, group


def test_the_lines_of_a_plot_of_motors_have_different_names():
    of_plot = {}
    for path, names in layout(BOTH).entities:
        group = path.split("/")[1]
        if group.startswith(("dynamic_", "track_brake")):
            of_plot.setdefault(group, []).extend(names)
    assert len(of_plot["dynamic_torques"]) == 12
    for group, names in of_plot.items():
        assert len(set(names)) == len(names), group


def test_a_vehicle_without_motors_and_magnets_has_no_tab_of_them():
    found = layout(COACH)
    assert TAB not in found.names
    assert "Axle by axle" in found.names
    assert not [path for path, _ in found.entities if "track_brake" in path or "dynamic" in path]


def test_each_group_of_axles_has_a_tab_with_a_column_for_each_of_its_axles():
    names = layout(Kind(8)).names
    assert "Axles 1 to 4" in names
    assert "Axles 5 to 8" in names
    for axle in range(1, 9):
        assert f"Axle {axle}: speed (km/h)" in names
