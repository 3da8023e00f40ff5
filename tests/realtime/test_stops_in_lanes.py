"""Stops that run in vector lanes against the same stops alone."""

import numpy as np
import pytest

from rollerrig.configs.vehicle import COACH
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import campaign
from rollerrig.realtime.campaign.stops import stops_in_lanes
from rollerrig.realtime.record import summary
from rollerrig.wsp_interface import signals

COLUMNS = signals.table(COACH).columns
SHORT = ("initial_speed_m_s=8.0",)
CASES = {
    "soap": ("velim_a1", SHORT),
    "soap, very low": ("velim_a1", (*SHORT, "adhesion.mu_cd=0.02")),
    "dry": ("dry_stop", SHORT),
    "plain track": ("velim_a1", (*SHORT, "rig=plain_track")),
    "friction by place": ("step_adhesion", SHORT),
    "pole wheels": ("velim_a1", (*SHORT, 'sensor.model="pole_wheel"')),
    "other vehicle": ("velim_a1", (*SHORT, "vehicle.mass_kg=30000.0")),
    "other wheels of one axle": (
        "velim_a1",
        (
            *SHORT,
            "mechanisms.wheel_radius_fraction=0.03",
            "mechanisms.wheel_radius_axle=2.0",
            "mechanisms.wheel_inertia_fraction=0.2",
            "mechanisms.wheel_inertia_axle=3.0",
        ),
    ),
    "a valve of no dead time": ("velim_a1", (*SHORT, "valve.dead_time_s=0.0")),
    "a valve that changes between two cycles": ("velim_a1", (*SHORT, "valve.dead_time_s=0.013")),
    "a cycle longer than a sample": ("velim_a1", (*SHORT, "bus.sync_period_s=0.03")),
    "a sample in each tick": ("velim_a1", (*SHORT, "loop.record_hz=1000")),
    "friction by work": ("velim_a1", (*SHORT, "mechanisms.rail_cleaning_gain=0.2")),
    "friction by distance": ("velim_a1", (*SHORT, "mechanisms.negative_conditioning_loss=0.2")),
    "torque by speed": ("velim_a1", (*SHORT, "mechanisms.brake_gain_gain=0.1")),
    "a memory of recovery": ("velim_a1", (*SHORT, "mechanisms.adhesion_memory_length_m=2.0")),
    "wheels out of round": ("velim_a1", (*SHORT, "mechanisms.wheel_out_of_round_amplitude=0.05")),
    "wheels that wear": ("velim_a1", (*SHORT, "flats.wear_mm3_J=0.1")),
    "pads that vary": ("velim_a1", (*SHORT, "pads.speed_loss=0.2", "pads.clamp_hysteresis=0.1")),
    "a reservoir": ("velim_a1", (*SHORT, "air.reservoir_volume_L=100.0")),
    "sand": ("velim_a1", (*SHORT, "sanders.axle=1")),
}
# small differences of large numbers, which rounding changes by more
NOT_COMPARED = {
    "tracking_error_1_m_s",
    "tracking_error_2_m_s",
    "tracking_error_3_m_s",
    "tracking_error_4_m_s",
}


def simulate(plan):
    return free.channels(free.simulate(plan), plan.table)


@pytest.fixture(scope="module")
def plans():
    return {
        name: scenario.load(stem, settings=settings) for name, (stem, settings) in CASES.items()
    }


@pytest.fixture(scope="module")
def together(plans):
    """All cases, from stops that ran together."""
    return {finished.tag: finished for finished in stops_in_lanes.together(plans.items())}


@pytest.mark.parametrize("case", CASES)
def test_a_stop_among_others_is_the_stop_alone(case, plans, together):
    alone = simulate(plans[case])
    among = together[case].channels
    for name in COLUMNS:
        if name not in NOT_COMPARED:
            np.testing.assert_allclose(among[name], alone[name], rtol=1e-6, atol=1e-6, err_msg=name)


@pytest.mark.parametrize("case", CASES)
def test_the_figures_of_a_stop_among_others_are_those_of_the_stop_alone(case, plans, together):
    finished = together[case]
    alone = campaign.summarize(finished._replace(channels=simulate(plans[case])), "reference")
    among = campaign.summarize(finished, "reference")
    for key in ("stop_distance_m", "stop_time_s", "air_consumption_NL"):
        assert among[key] == pytest.approx(alone[key], rel=1e-7)
    assert among["wsp"]["vents"] == alone["wsp"]["vents"]


def test_the_stops_in_the_other_places_change_no_bit_of_a_stop(plans, together):
    [alone] = stops_in_lanes.together([("soap", plans["soap"])])
    among = together["soap"]
    for name in COLUMNS:
        assert np.array_equal(alone.channels[name], among.channels[name], equal_nan=True), name


def test_a_summary_needs_only_the_channels_that_a_campaign_keeps(plans):
    names = summary.channels_of(COACH)
    [whole] = stops_in_lanes.together([("soap", plans["soap"])])
    [kept] = stops_in_lanes.together([("soap", plans["soap"])], columns=names)
    assert tuple(kept.channels) == names
    assert campaign.summarize(kept, "reference") == campaign.summarize(whole, "reference")


def test_without_a_unit_no_magnet_is_energised(plans):
    [without] = stops_in_lanes.together([("soap", plans["soap"])], "none")
    assert max(without.channels[f"magnets_{axle}"].max() for axle in (1, 2, 3, 4)) == 0.0


@pytest.mark.parametrize(
    "setting",
    [
        # with other kernels
        pytest.param("rig=virtual_track", marks=pytest.mark.nightly),
        pytest.param('contact.model="polach"', marks=pytest.mark.nightly),
        pytest.param('vehicle.model="multibody"', marks=pytest.mark.nightly),
    ],
)
def test_a_stop_that_does_not_fit_runs_alone_and_is_equal_to_the_bit(setting):
    plan = scenario.load("velim_a1", settings=("initial_speed_m_s=2.0", setting))
    assert not stops_in_lanes.fits(plan)
    [among] = stops_in_lanes.together([(0, plan)])
    alone = simulate(plan)
    for name in COLUMNS:
        assert np.array_equal(among.channels[name], alone[name], equal_nan=True), name
