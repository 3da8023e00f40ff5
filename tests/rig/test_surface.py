"""Sand on the rail and contaminant on rollers: closed balances, and effects on friction."""

import numpy as np
import pytest
from rolling import SOAP, TRACK, VENT, Rig

from rollerrig.rig import surface
from rollerrig.rig.lanes import layout
from rollerrig.rig.mechanisms import friction
from rollerrig.rig.state import SLOTS

ALWAYS = {"axle": 1, "second_axle": 3, "from_s": 0.5, "until_s": 4.0}
# slots that change with the place of the vehicle, even without sand and film
ALWAYS_KEPT = ("rail_cell", "rail_front", "rail_sand", "film_sector")


def stop(speed_m_s=20.0, seconds=6.0, rig=TRACK, adhesion=SOAP, **sections):
    """Return a rig and its history after a stretch in which all valves vent."""
    plant = Rig(speed_m_s, rig=rig, adhesion=adhesion, **sections)
    return plant, plant.roll(seconds, VENT)


@pytest.mark.parametrize(
    "more", [{}, {"dose_kg_m": 0.015}, {"box_kg": 0.05}, {"hose_delay_s": 0.0}]
)
def test_the_balance_of_sand_closes(more):
    rig, run = stop(sanders={**ALWAYS, **more})
    box_kg = rig.params.sanders.box_kg
    for at in (700, 2500, -1):
        found = (
            run.sand_hose[at].sum()
            + run.rail_sand[at].sum()
            + run.sand_blown[at]
            + run.sand_used[at].sum()
            + run.sand_left[at]
        )
        taken = 2.0 * box_kg - run.sand_box[at].sum()
        assert taken > 0.0
        assert found == pytest.approx(taken, rel=1e-9)
        assert run.sand_taken[at].sum() == pytest.approx(taken, rel=1e-9)
    assert run.sand_used[-1].min() > 0.0
    assert run.sand_left[-1] > 0.0
    if "box_kg" in more:
        assert run.sand_box[-1].sum() == 0.0
    assert (run.sand_box[:, [1, 3]] == 0.0).all()


def test_a_dose_is_laid_at_any_speed_and_each_wheel_uses_its_share_of_the_sand_it_meets():
    _, run = stop(
        sanders={
            "axle": 1,
            "from_s": 0.0,
            "dose_kg_m": 0.010,
            "rate_kg_s": 1.0,
            "hose_delay_s": 0.1,
            "used_share": 0.3,
        }
    )
    settled = run.sand_dose[4000:]
    met = 0.8 * 0.010 * 0.7 ** np.arange(4)
    np.testing.assert_allclose(settled.mean(axis=0), met, rtol=2e-2)


def test_the_hose_holds_sand_back_and_lets_it_out_after_the_sander_is_off():
    _, run = stop(sanders={**ALWAYS, "second_axle": 0, "hose_delay_s": 0.4})
    rate = run.sand_rate[:, 0]
    assert rate[499] == 0.0
    assert rate[900] == pytest.approx(0.067 * (1.0 - np.exp(-1.0)), rel=2e-2)
    assert rate[3999] == pytest.approx(0.067, rel=1e-3)
    assert rate[4400] == pytest.approx(0.067 * np.exp(-1.0), rel=2e-2)


def test_sand_raises_friction_only_where_wheels_meet_it_and_not_beyond_the_clean_limit():
    _, run = stop(sanders={"axle": 3, "from_s": 0.0, "gain": 5.0})
    assert (run.friction_degraded[:, :2] == 0.06).all()
    assert (run.friction_degraded[2000:, 2:] > 0.06).all()
    assert run.friction_degraded.max() <= 0.28 + 1e-12
    assert (run.friction_recovered == 0.28).all()


def test_faults_change_rate_and_lag_of_one_sander():
    rig = Rig(20.0, rig=TRACK, sanders=ALWAYS | {"from_s": 0.0})
    rig.state.sand_rate_fault[0] = -0.7
    rig.state.sand_delay_fault[2] = 2.0
    run = rig.roll(2.0, VENT)
    assert run.sand_rate[-1, 0] == pytest.approx(0.3 * 0.067, rel=2e-2)
    assert run.sand_rate[-1, 2] < 0.6 * 0.067


def test_sanders_without_a_command_and_a_film_that_nothing_thins_change_no_bit():
    plain = Rig(25.0, adhesion=SOAP).roll(4.0)
    fitted = Rig(25.0, adhesion=SOAP, sanders={"axle": 2}).roll(4.0)
    for name in SLOTS:
        if name not in (*ALWAYS_KEPT, "sand_box"):
            assert np.array_equal(getattr(plain, name), getattr(fitted, name), equal_nan=True), name
    track = Rig(25.0, rig=TRACK, adhesion=SOAP).roll(2.0)
    filmed = Rig(25.0, rig=TRACK, adhesion=SOAP, roller_film={"thinning": 0.01}).roll(2.0)
    assert np.array_equal(track.log, filmed.log, equal_nan=True)
    assert friction.dose_share(0.0, 0.004) == 0.0 == friction.film_share(1.0)


@pytest.mark.parametrize("spray_1_s", [0.0, 0.05, 5.0])
def test_the_balance_of_a_rollers_film_closes(spray_1_s):
    _, run = stop(rig={}, roller_film={"thinning": 0.02, "spray_1_s": spray_1_s})
    assert run.change("roller_angle").min() > 60.0
    for at in (1000, -1):
        left = run.roller_film[at].reshape(4, -1).mean(axis=1)
        balance = left + run.film_worn[at] + run.film_run_off[at] - run.film_sprayed[at]
        np.testing.assert_allclose(balance, 1.0, rtol=1e-9)
    # a film as prepared takes no spray: it runs off
    assert (run.film_run_off[-1].min() > 0.0) == (spray_1_s > 0.0)


def test_without_a_spray_each_turn_thins_the_film_by_its_share_and_friction_drifts():
    _, run = stop(rig={}, roller_film={"thinning": 0.02, "gain": 0.8})
    turns = np.floor(run.roller_angle / (2.0 * np.pi))
    late = turns[:, 0] > 5
    np.testing.assert_allclose(run.film[late], 0.98 ** turns[late], rtol=0.03)
    np.testing.assert_allclose(
        run.friction_degraded[1:], 0.06 * np.exp(0.8 * (1.0 - run.film[:-1])), rtol=1e-12
    )


def test_a_spray_keeps_the_film_where_supply_and_wear_balance():
    film = {"thinning": 0.05, "spray_1_s": 0.1}
    _, run = stop(20.0, 12.0, rig={}, adhesion={**SOAP, "mu_cd": 0.05}, roller_film=film)
    # at a constant speed a turn wears off what a turn lays: h thinning = flow x time of a turn
    speed_rad_s = run.roller_speed[-3000:].mean()
    expected = 0.1 * 2.0 * np.pi / speed_rad_s / 0.05
    assert run.film[-3000:].mean() == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    "sections", [{"sanders": {"axle": 1}}, {"roller_film": {"thinning": 0.01}}]
)
def test_the_lanes_do_not_accept_stops_with_sanders_or_changing_films(sections):
    assert not layout.fits(Rig(20.0, **sections).params)
    assert layout.fits(Rig(20.0, rig=TRACK, roller_film={"thinning": 0.01}).params)


def test_cells_of_the_rail_also_hold_places_behind_the_first_one():
    assert [surface.cell_at(x) for x in (-0.3, -0.1, 0.0, 0.19, 0.41)] == [-2, -1, 0, 0, 2]
