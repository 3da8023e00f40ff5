"""The reference stop against published calculations by EN 14531-1, to their printed digits.

Data and results: github.com/RailProfAC/RailwayBrakeCalculation, MIT License, Copyright (c) 2023
Raphael Pfaff. The multiple unit is BrakeCalculationAverageValues.ipynb at commit c232ace, the wagon
is BrakeCalculationAverageValuesWagon.ipynb at commit 9a780ab. Later commits have no results.
"""

from typing import NamedTuple

import pytest

from rollerrig.wsp_interface.sequences import measures


class BrakeStation(NamedTuple):
    """The brake of one axle, and the axle's masses."""

    pressure_bar: float
    area_cm2: float
    cylinder_efficiency: float
    cylinder_spring_N: float
    rigging_spring_N: float
    friction: float
    friction_radius_m: float
    wheel_diameter_m: float
    delay_s: float
    rise_s: float
    mass_kg: float
    rotating_mass_kg: float

    @property
    def force_N(self) -> float:
        """The brake force at the rim; all rigging ratios are 5 with an efficiency of 0.95."""
        area_m2 = self.area_cm2 * 1e-4
        cylinder_N = self.pressure_bar * 1e5 * area_m2 * self.cylinder_efficiency
        blocks_N = (cylinder_N + self.cylinder_spring_N) * 5.0 * 0.95 + self.rigging_spring_N
        return blocks_N * self.friction * 2.0 * self.friction_radius_m / self.wheel_diameter_m

    @property
    def response_s(self) -> float:
        return self.delay_s + 0.5 * self.rise_s


TREAD = BrakeStation(3.8, 346, 0.95, -300, -500, 0.28, 0.5, 1.0, 0.6, 3.0, 15000, 1500)
DISC = BrakeStation(3.0, 324, 0.98, -500, 0, 0.35, 0.27, 0.89, 0.3, 2.0, 14500, 700)
MULTIPLE_UNIT = (TREAD, TREAD, DISC, DISC, DISC, DISC, TREAD, TREAD)


def test_the_multiple_unit_of_the_published_example_has_its_distance_to_the_printed_digits():
    # the notebook's resistance is that from 45 m/s, and its distance that from 200 km/h
    resistance_N = measures.mean_resistance_N(3000.0, 110.0, 7.0, 45.0)
    assert resistance_N == pytest.approx(13387.5, abs=1e-6)
    mass_kg = sum(station.mass_kg + station.rotating_mass_kg for station in MULTIPLE_UNIT)
    assert mass_kg == 126800.0
    force_N = sum(station.force_N for station in MULTIPLE_UNIT) + resistance_N
    response_s = sum(station.response_s * station.force_N for station in MULTIPLE_UNIT) / force_N
    deceleration_m_s2 = force_N / mass_kg
    assert response_s == pytest.approx(1.598264, abs=5e-7)
    assert deceleration_m_s2 == pytest.approx(0.899829, abs=5e-7)
    distance_m = measures.equivalent_distance_m(200.0 / 3.6, response_s, deceleration_m_s2)
    assert distance_m == pytest.approx(1803.796711, abs=5e-7)


def test_the_wagon_of_the_published_example_has_its_distance_to_the_printed_digits():
    mass_kg, rotating_mass_kg, initial_m_s = 90_000.0, 3_600.0, 80.0 / 3.6
    # at that commit the part that grows with the speed lacks the mass, so it is almost 0
    resistance_N = measures.mean_resistance_N(
        1.6e-3 * mass_kg * 9.81, 0.0, 5.7e-3 * 3.6**2 / 1e5, initial_m_s
    )
    cylinder_N = 3.8e5 * 0.1295 * 0.98 - 1500.0
    entry_points_N = (cylinder_N * 0.515 / 0.325 - 2000.0) * 4 * 2 * 0.83
    assert round(resistance_N, 1) == 1412.6
    assert round(cylinder_N) == 46726
    assert round(entry_points_N) == 478362
    force_N = 0.12 * entry_points_N
    # the notebook subtracts the resistance of a wagon, which rollerrig adds to the brake force
    deceleration_m_s2 = (force_N - resistance_N) / (mass_kg + rotating_mass_kg)
    response_s = 0.2 + 0.5 * 4.0
    distance_m = measures.equivalent_distance_m(initial_m_s, response_s, deceleration_m_s2)
    assert round(deceleration_m_s2, 2) == 0.6
    assert round(distance_m, 1) == 461.7
    energy_J = force_N * (distance_m - initial_m_s * response_s)
    assert round(energy_J / 1e6, 2) == 23.69
