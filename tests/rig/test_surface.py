"""Sand on the rail and contaminant on rollers: closed balances, and effects on friction."""

import numpy as np
import pytest
from rolling import LOGGED, SOAP, TRACK, VENT, Rig

from rollerrig.rig import surface
from rollerrig.rig.mechanisms import friction

# two sanders that give sand for 3.5 s
SANDING = {"axle": 1, "second_axle": 3, "from_s": 0.5, "until_s": 4.0}
RATE_KG_S = 0.067  # of a sander
MU_SOAP = 0.06
MU_CLEAN = 0.28
# slots that change with the place of the vehicle, even without sand and film
SLOTS_OF_THE_PLACE = ("rail_cell", "rail_front", "rail_sand", "film_sector")


def stop(speed_m_s=20.0, seconds=6.0, rig=TRACK, adhesion=SOAP, **sections):
    """Return a rig and its history after a stretch in which all valves vent."""
    plant = Rig(speed_m_s, rig=rig, adhesion=adhesion, **sections)
    return plant, plant.roll(seconds, VENT)


@pytest.mark.parametrize(
    "more", [{}, {"dose_kg_m": 0.015}, {"box_kg": 0.05}, {"hose_delay_s": 0.0}]
)
def test_the_balance_of_sand_closes(more):
    rig, run = stop(sanders={**SANDING, **more})
    full_boxes_kg = 2.0 * rig.params.sanders.box_kg
    for tick in (700, 2500, -1):
        found_kg = (
            run.sand_hose[tick].sum()
            + run.rail_sand[tick].sum()
            + run.sand_blown[tick]
            + run.sand_used[tick].sum()
            + run.sand_left[tick]
        )
        taken_kg = full_boxes_kg - run.sand_box[tick].sum()
        assert taken_kg > 0.0
        assert found_kg == pytest.approx(taken_kg, rel=1e-9)
        assert run.sand_taken[tick].sum() == pytest.approx(taken_kg, rel=1e-9)
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
    settled_kg_m = run.sand_dose[4000:].mean(axis=0)
    # a fifth is blown off the rail; each wheel leaves 70 % to the next one
    met_kg_m = 0.8 * 0.010 * 0.7 ** np.arange(4)
    np.testing.assert_allclose(settled_kg_m, met_kg_m, rtol=2e-2)


def test_the_hose_holds_sand_back_and_lets_it_out_after_the_sander_is_off():
    _, run = stop(sanders={**SANDING, "second_axle": 0, "hose_delay_s": 0.4})
    rate_kg_s = run.sand_rate[:, 0]
    # before sanding, one delay after its begin, at its end, and one delay after its end
    assert rate_kg_s[499] == 0.0
    assert rate_kg_s[900] == pytest.approx(RATE_KG_S * (1.0 - np.exp(-1.0)), rel=2e-2)
    assert rate_kg_s[3999] == pytest.approx(RATE_KG_S, rel=1e-3)
    assert rate_kg_s[4400] == pytest.approx(RATE_KG_S * np.exp(-1.0), rel=2e-2)


def test_sand_raises_friction_only_where_wheels_meet_it_and_not_beyond_the_clean_limit():
    _, run = stop(sanders={"axle": 3, "from_s": 0.0, "gain": 5.0})
    before_the_sander = run.friction_degraded[:, :2]
    behind_the_sander = run.friction_degraded[:, 2:]
    assert (before_the_sander == MU_SOAP).all()
    assert (behind_the_sander[2000:] > MU_SOAP).all()
    assert run.friction_degraded.max() <= MU_CLEAN + 1e-12
    assert (run.friction_recovered == MU_CLEAN).all()


def test_faults_change_rate_and_lag_of_one_sander():
    rig = Rig(20.0, rig=TRACK, sanders=SANDING | {"from_s": 0.0})
    rig.state.sand_rate_fault[0] = -0.7
    rig.state.sand_delay_fault[2] = 2.0
    run = rig.roll(2.0, VENT)
    assert run.sand_rate[-1, 0] == pytest.approx(0.3 * RATE_KG_S, rel=2e-2)
    assert run.sand_rate[-1, 2] < 0.6 * RATE_KG_S


def test_sanders_without_a_command_change_no_bit():
    plain = Rig(25.0, adhesion=SOAP).roll(4.0)
    fitted = Rig(25.0, adhesion=SOAP, sanders={"axle": 2}).roll(4.0)
    for name in LOGGED:
        if name not in (*SLOTS_OF_THE_PLACE, "sand_box"):
            assert np.array_equal(getattr(plain, name), getattr(fitted, name), equal_nan=True), name
    assert friction.dose_share(0.0, 0.004) == 0.0


def test_a_film_that_nothing_thins_changes_no_bit():
    plain = Rig(25.0, rig=TRACK, adhesion=SOAP).roll(2.0)
    with_film = Rig(25.0, rig=TRACK, adhesion=SOAP, roller_film={"thinning": 0.01}).roll(2.0)
    assert np.array_equal(plain.log, with_film.log, equal_nan=True)
    assert friction.film_share(1.0) == 0.0


@pytest.mark.parametrize("spray_1_s", [0.0, 0.05, 5.0])
def test_the_balance_of_a_rollers_film_closes(spray_1_s):
    _, run = stop(rig={}, roller_film={"thinning": 0.02, "spray_1_s": spray_1_s})
    assert run.change("roller_angle").min() > 60.0
    for tick in (1000, -1):
        left = run.roller_film[tick].reshape(4, -1).mean(axis=1)
        gone = run.film_worn[tick] + run.film_run_off[tick]
        np.testing.assert_allclose(left + gone - run.film_sprayed[tick], 1.0, rtol=1e-9)
    # a film as prepared takes no spray: it runs off
    assert (run.film_run_off[-1].min() > 0.0) == (spray_1_s > 0.0)


def test_without_a_spray_each_turn_thins_the_film_by_its_share_and_friction_drifts():
    _, run = stop(rig={}, roller_film={"thinning": 0.02, "gain": 0.8})
    turns = np.floor(run.roller_angle / (2.0 * np.pi))
    late = turns[:, 0] > 5
    np.testing.assert_allclose(run.film[late], 0.98 ** turns[late], rtol=0.03)
    # friction follows the film of the tick before
    expected = MU_SOAP * np.exp(0.8 * (1.0 - run.film[:-1]))
    np.testing.assert_allclose(run.friction_degraded[1:], expected, rtol=1e-12)


def test_a_spray_keeps_the_film_where_supply_and_wear_balance():
    film = {"thinning": 0.05, "spray_1_s": 0.1}
    _, run = stop(20.0, 12.0, rig={}, adhesion={**SOAP, "mu_cd": 0.05}, roller_film=film)
    # at a constant speed a turn wears off what a turn lays: h thinning = flow x time of a turn
    settled = slice(-3000, None)
    turn_s = 2.0 * np.pi / run.roller_speed[settled].mean()
    expected = film["spray_1_s"] * turn_s / film["thinning"]
    assert run.film[settled].mean() == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(
    ("place_m", "cell"), [(-0.3, -2), (-0.1, -1), (0.0, 0), (0.19, 0), (0.41, 2)]
)
def test_cells_of_the_rail_also_hold_places_behind_the_first_one(place_m, cell):
    assert surface.cell_at(place_m) == cell
