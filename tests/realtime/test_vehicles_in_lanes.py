"""Stops of vehicles with other numbers of axles, in vector lanes, against the same stops alone."""

import json

import numpy as np
import program
import pytest

from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.rig.state import rigs_together
from rollerrig.wsp_interface import signals

# they share runs
pytestmark = pytest.mark.xdist_group("vehicles")

# packaged scenarios of other vehicles, with and without motors and magnets
FITTING = (
    "bogie_low",
    "tram_low",
    "multiple_unit_low",
    "tram_low_dynamic",
    "tram_emergency_magnetic",
    "tram_start_low",
)


SHORT = ("initial_speed_m_s=3", "duration_max_s=6")


def plans_of(name):
    """Return scenarios of short stops of a vehicle, with more of them than places.

    They differ in speed and contaminant, and a place is used twice.
    """
    axles = scenario.load(name).kind.axles
    return {
        f"{name} {number}": scenario.load(
            name,
            settings=(
                f"initial_speed_m_s={6.0 + number}",
                f"adhesion.mu_cd={0.03 + 0.01 * number}",
                "duration_max_s=12.0",
            ),
        )
        for number in range(rigs_together(axles) + 1)
    }


def distance_m(channels):
    return float(channels["position_m"][-1])


def assert_agrees(among, alone, table):
    """Check that a stop among others has the samples of the same stop alone, to rounding."""
    assert len(among["time_s"]) == len(alone["time_s"])
    assert distance_m(among) == pytest.approx(distance_m(alone), rel=1e-7)
    for name in table.columns:
        # the tracking error is a small difference of large numbers
        if not name.startswith("tracking_error"):
            differs = np.abs(among[name] - alone[name]) / (1.0 + np.abs(alone[name]))
            assert np.nanmax(differs, initial=0.0) < 1e-6, name


@pytest.mark.nightly
@pytest.mark.parametrize("name", FITTING)
def test_stops_of_a_vehicle_in_lanes_are_the_stops_alone(name):
    plans = plans_of(name)
    for finished in stops_in_lanes.together(plans.items()):
        plan = plans[finished.tag]
        assert stops_in_lanes.fits(plan)
        assert_agrees(finished.channels, free.channels(free.simulate(plan), plan.table), plan.table)
        [without_others] = stops_in_lanes.together([(0, plan)])
        for channel in plan.table.columns:
            expected = finished.channels[channel]
            found = without_others.channels[channel]
            np.testing.assert_array_equal(found, expected, err_msg=channel)


def test_stops_of_several_vehicles_run_in_one_call():
    names = (*FITTING, "velim_a1", "dry_stop")
    plans = {name: scenario.load(name, settings=SHORT) for name in names}
    found = {finished.tag: finished for finished in stops_in_lanes.together(plans.items())}
    assert set(found) == set(names)
    for name, plan in plans.items():
        assert tuple(found[name].channels) == signals.table(plan.kind).columns
        assert_agrees(
            found[name].channels, free.channels(free.simulate(plan), plan.table), plan.table
        )


@pytest.mark.nightly
def test_a_campaign_of_another_vehicle_may_draw_its_values(tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'title = "two axles"\nscenario = "bogie_low"\ndesign = "random"\nruns = 2\n'
        '[vary."adhesion.mu_cd"]\nlow = 0.02\nhigh = 0.05\n'
        "[vary.initial_speed_m_s]\nlow = 2.0\nhigh = 4.0\n"
    )
    done = program.rollerrig(
        *("campaign", plan, "--workers", "1", "--out", tmp_path / "campaign", "--json")
    )
    assert done.status == 0, done.messages
    assert json.loads(done.printed)["runs"] == 2
