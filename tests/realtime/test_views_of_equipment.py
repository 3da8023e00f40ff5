"""The layout in Rerun of vehicles with motors, magnets or more than four axles.

A process has the signals of one kind of vehicle, so each layout is made in a process.
"""

import functools
import json

import pytest
from program import python

# they share the servers of programs of these vehicles, and runs
pytestmark = pytest.mark.xdist_group("vehicles")

# prints the titles of all tabs and plots of the default layout, and the paths of all entities
PROGRAM = """
import json
from rollerrig.realtime.telemetry import views

names = []
contents = []

def walk(part):
    names.append(getattr(part, "name", None))
    for path in getattr(part, "contents", []):
        if isinstance(path, str):
            contents.append(path)
        else:
            walk(path)

walk(views.blueprint().root_container)
entities = [(line.path, line.names) for line in views.lines()]
print(json.dumps({"names": names, "contents": contents, "entities": entities}))
"""
TAB = "Motors and magnets"
BOTH = "dynamic_brake,magnetic_track_brake"


@functools.cache
def layout(axles, equipment):
    done = python(*("-c", PROGRAM), ROLLERRIG_AXLES=str(axles), ROLLERRIG_EQUIPMENT=equipment)
    assert done.status == 0, done.messages
    return json.loads(done.printed)


@pytest.mark.parametrize(
    "groups",
    [
        ["dynamic_torques", "dynamic_share"],
        ["track_brake", "track_brake_lowered", "track_brake_cleaning"],
    ],
)
def test_motors_and_magnets_have_a_tab_of_the_default_layout(groups):
    found = layout(6, BOTH)
    assert found["names"].count(TAB) == 1
    for group in groups:
        assert found["contents"].count(f"/{group}/**") == 1
        paths = [path for path, _ in found["entities"] if path.startswith(f"/{group}/")]
        assert paths, group


def test_the_lines_of_a_plot_of_motors_have_different_names():
    found = layout(6, BOTH)
    of_plot = {}
    for path, names in found["entities"]:
        group = path.split("/")[1]
        if group.startswith(("dynamic_", "track_brake")):
            of_plot.setdefault(group, []).extend(names)
    assert len(of_plot["dynamic_torques"]) == 12
    for group, names in of_plot.items():
        assert len(set(names)) == len(names), group


@pytest.mark.nightly
def test_a_vehicle_without_motors_and_magnets_has_no_tab_of_them():
    found = layout(4, "")
    assert TAB not in found["names"]
    assert "Axle by axle" in found["names"]
    assert not [path for path, _ in found["entities"] if "track_brake" in path or "dynamic" in path]


@pytest.mark.nightly
def test_each_group_of_axles_has_a_tab_with_a_column_for_each_of_its_axles():
    names = layout(8, "")["names"]
    assert "Axles 1 to 4" in names
    assert "Axles 5 to 8" in names
    for axle in range(1, 9):
        assert f"Axle {axle}: speed (km/h)" in names
