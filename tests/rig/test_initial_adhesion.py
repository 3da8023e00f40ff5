"""An adhesion as tests state it is met on the rail, decides mu_cd, and gives way to a mu_cd that comes later."""

import numpy as np
import pytest
from rolling import TRACK, Rig

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario
from rollerrig.rig.contact import adhesion

LAW = {"initial_at_speed_m_s": 20.0, "initial_at_sliding_m_s": 0.5}


@pytest.mark.parametrize("stated", [0.03, 0.05, 0.065, 0.08, 0.12])
@pytest.mark.parametrize(
    "more", [{}, {"tau_m_J": 0.0}, {"mu_cr": 0.2}], ids=["soap", "no recovery", "poorer"]
)
def test_the_contact_has_the_stated_adhesion_at_its_speed_and_sliding(stated, more):
    rig = Rig(20.0, rig=TRACK, adhesion={"initial_adhesion": stated, **LAW, **more})
    law, patch = rig.params.law, rig.params.patch
    found = adhesion.wheel_adhesion(0.5, 20.0, 0.5 * rig.params.vehicle.static_load_N, patch, law)
    assert found[0] == pytest.approx(stated, rel=1e-9)


def test_a_braked_first_wheel_that_slides_so_far_at_that_speed_has_that_adhesion():
    rig = Rig(
        25.0, rig=TRACK, adhesion={"initial_adhesion": 0.065, **LAW, "initial_at_speed_m_s": 24.0}
    )
    run = rig.roll(5.0)
    begun = np.argmax(run.sliding[:, 0] >= 0.5)
    assert run.vehicle_speed[begun] == pytest.approx(24.0, abs=0.7)
    assert run.adhesion[begun, 0] == pytest.approx(0.065, rel=0.02)


def test_without_a_stated_adhesion_mu_cd_is_what_it_was():
    assert Rig(20.0).params.law.mu_cd == 0.06
    assert Rig(20.0, adhesion={"mu_cd": 0.05, **LAW}).params.law.mu_cd == 0.05


def test_what_comes_later_wins_a_mu_cd_over_a_set_and_a_stated_adhesion_over_a_mu_cd():
    low = scenario.load("velim_a1", settings=("adhesion=low",))
    assert low["adhesion"]["initial_adhesion"] == 0.065
    assert 0.02 < low["adhesion"]["mu_cd"] < 0.04
    later = scenario.load("velim_a1", settings=("adhesion=low", "adhesion.mu_cd=0.05"))
    assert (later["adhesion"]["mu_cd"], later["adhesion"]["initial_adhesion"]) == (0.05, 0.0)
    stated = scenario.load("velim_a1", settings=("adhesion.initial_adhesion=0.065",))
    assert stated["adhesion"]["mu_cd"] < 0.06


def test_a_resolved_scenario_with_a_stated_adhesion_is_that_scenario_again(tmp_path):
    first = scenario.load("velim_a1", settings=("adhesion=very_low",))
    (tmp_path / "scenario.toml").write_text(scenario.dump(first))
    again = scenario.load(str(tmp_path / "scenario.toml"))
    assert again.resolved == first.resolved


def test_an_adhesion_that_no_contaminant_gives_is_refused_with_what_is_allowed():
    with pytest.raises(ConfigError, match=r"initial_adhesion = 0.45.*allowed is .* to 0\.3"):
        Rig(20.0, adhesion={"initial_adhesion": 0.45})
