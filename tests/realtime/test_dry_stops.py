"""On a dry rail the reference unit leaves the brake alone, whatever a vehicle weighs and however
hard its pads brake.
"""

import itertools

import numpy as np
import pytest

from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, scenario

# scenario of a vehicle, and its mass in t, empty, normal and laden
VEHICLES = {
    "dry_stop": (33.0, 40.1, 43.0, 53.0),
    "bogie_low": (16.5, 21.5, 26.5),
    "tram_low": (36.9, 43.4, 50.0),
    "multiple_unit_low": (80.0, 101.5, 120.0),
}
PAD_FRICTIONS = (0.30, 0.36, 0.40)
SPEEDS_KM_H = (20.0, 70.0)


def dry_stop(name, mass_t, friction, *settings):
    plan = scenario.load(
        name,
        settings=(
            "adhesion=dry",
            f"vehicle.mass_kg={1000.0 * mass_t}",
            f"brake.pad_friction={friction}",
            "duration_max_s=90",
            *settings,
        ),
    )
    columns = free.channels(free.simulate(plan), plan.table)
    assert columns["vehicle_speed_m_s"][-1] < 0.1
    return columns


def commands(columns):
    """The samples above the cut-off speed of the magnets of all axles, in one row."""
    acts = columns["vehicle_speed_m_s"] > logic.load().cut_off_m_s
    return np.concatenate([columns[name][acts] for name in columns if name.startswith("magnets_")])


@pytest.mark.parametrize("name", VEHICLES)
def test_no_magnet_is_energised_on_dry_rails_at_any_load_pad_and_speed(name):
    for mass_t, friction in itertools.product(VEHICLES[name], PAD_FRICTIONS):
        settings = [()]
        settings += [(f"initial_speed_m_s={speed_km_h / 3.6}",) for speed_km_h in SPEEDS_KM_H]
        for speed in settings:
            columns = dry_stop(name, mass_t, friction, *speed)
            assert not commands(columns).any(), (mass_t, friction, speed)


def test_the_empty_coach_brakes_harder_than_the_usual_limit_of_the_reference():
    # a unit with this limit alone vents here
    columns = dry_stop("dry_stop", 33.0, 0.40)
    slope_m_s2 = -np.gradient(columns["vehicle_speed_m_s"], columns["time_s"])
    assert np.percentile(slope_m_s2, 75) > logic.load().reference_fall_m_s2
