"""A stated initial adhesion holds on the rail and decides mu_cd; a later mu_cd replaces it."""

import asyncio

import numpy as np
import pytest
from rolling import TRACK, Rig

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.bench import Bench
from rollerrig.realtime.bench.options import Options
from rollerrig.rig.contact import adhesion

LAW = {"initial_at_speed_m_s": 20.0, "initial_at_sliding_m_s": 0.5}


@pytest.mark.parametrize("stated", [0.03, 0.05, 0.065, 0.08, 0.12])
@pytest.mark.parametrize(
    "more", [{}, {"tau_m_J": 0.0}, {"mu_cr": 0.2}], ids=["soap", "no recovery", "poorer"]
)
def test_the_contact_has_the_stated_adhesion_at_its_speed_and_sliding(stated, more):
    rig = Rig(20.0, rig=TRACK, adhesion={"initial_adhesion": stated, **LAW, **more})
    load_N = 0.5 * rig.params.vehicle.static_load_N
    f, *_ = adhesion.wheel_adhesion(
        LAW["initial_at_sliding_m_s"],
        LAW["initial_at_speed_m_s"],
        load_N,
        rig.params.patch,
        rig.params.law,
    )
    assert f == pytest.approx(stated, rel=1e-9)


def test_the_leading_wheel_of_a_stop_has_the_stated_adhesion_at_that_speed_and_sliding():
    stated = LAW | {"initial_adhesion": 0.065, "initial_at_speed_m_s": 24.0}
    run = Rig(25.0, rig=TRACK, adhesion=stated).roll(5.0)
    begun = np.argmax(run.sliding[:, 0] >= LAW["initial_at_sliding_m_s"])
    assert run.vehicle_speed[begun] == pytest.approx(24.0, abs=0.7)
    assert run.adhesion[begun, 0] == pytest.approx(0.065, rel=0.02)


def test_without_a_stated_adhesion_mu_cd_is_unchanged():
    assert Rig(20.0).params.law.mu_cd == 0.06
    assert Rig(20.0, adhesion={"mu_cd": 0.05, **LAW}).params.law.mu_cd == 0.05


def test_the_later_setting_wins_between_mu_cd_and_a_stated_adhesion():
    low = scenario.load("velim_a1", settings=("adhesion=low",))
    assert low["adhesion"]["initial_adhesion"] == 0.065
    assert 0.02 < low["adhesion"]["mu_cd"] < 0.04

    later = scenario.load("velim_a1", settings=("adhesion=low", "adhesion.mu_cd=0.05"))
    assert later["adhesion"]["mu_cd"] == 0.05
    assert later["adhesion"]["initial_adhesion"] == 0.0

    stated = scenario.load("velim_a1", settings=("adhesion.initial_adhesion=0.065",))
    assert stated["adhesion"]["mu_cd"] < 0.06


def test_an_initial_adhesion_and_another_mu_cd_in_one_layer_are_refused_with_the_value_that_follows(
    tmp_path,
):
    both = ("adhesion.initial_adhesion=0.08", "adhesion.mu_cd=0.03")
    refusal = r"--set \[adhesion\]: initial_adhesion = 0.08 and mu_cd = 0.03 contradict .*remove"
    for settings in (both, both[::-1], ("adhesion=low", *both)):
        with pytest.raises(ConfigError, match=refusal):
            scenario.load("velim_a1", settings=settings)

    file = tmp_path / "both.toml"
    file.write_text("[adhesion]\nmu_cd = 0.05\ninitial_adhesion = 0.08\n")
    with pytest.raises(ConfigError, match=r"both\.toml \[adhesion\]: initial_adhesion = 0.08 and"):
        scenario.load(str(file))
    # a later layer decides between them
    later = scenario.load("velim_a1", settings=("adhesion=low", "adhesion.initial_adhesion=0.08"))
    assert later["adhesion"]["initial_adhesion"] == 0.08

    follows = later["adhesion"]["mu_cd"]
    agreeing = (both[0], f"adhesion.mu_cd={follows:.4g}")
    assert scenario.load("velim_a1", settings=agreeing)["adhesion"]["initial_adhesion"] == 0.08


def test_a_run_reports_an_initial_adhesion_that_a_later_mu_cd_replaces(tmp_path):
    settings = ("adhesion=low", "adhesion.mu_cd=0.04", "initial_speed_m_s=2")
    plan = scenario.load("dry_stop", settings=settings)
    options = Options(out=tmp_path / "run", pacing="free", unit="none")
    printed = []
    report = asyncio.run(
        Bench(plan, options, lambda progress: printed.append(progress.message)).run()
    )
    (event,) = [one for one in report["events"] if one["code"] == "scenario.adhesion_replaced"]
    assert event["fields"]["mu_cd"] == 0.04
    assert event["fields"]["initial_adhesion"] == 0.065
    assert event["fields"]["stated_by"].endswith("low.toml")
    assert any("adhesion.mu_cd = 0.04 (--set) replaces" in message for message in printed)

    # one that is stated later acts
    settings = ("adhesion=low", "adhesion.initial_adhesion=0.05")
    assert scenario.load("dry_stop", settings=settings).replaced is None


def test_a_resolved_scenario_of_another_vehicle_mass_still_loads(tmp_path):
    first = scenario.load("velim_a1", settings=("adhesion=low",))
    path = tmp_path / "scenario.toml"
    path.write_text(scenario.dump(first))
    heavier = scenario.load(str(path), settings=("vehicle.mass_kg=60000",))
    assert heavier["adhesion"]["initial_adhesion"] == 0.065
    assert heavier["adhesion"]["mu_cd"] != first["adhesion"]["mu_cd"]


def test_a_resolved_scenario_with_a_stated_adhesion_loads_as_the_same_scenario(tmp_path):
    first = scenario.load("velim_a1", settings=("adhesion=very_low",))
    (tmp_path / "scenario.toml").write_text(scenario.dump(first))
    loaded = scenario.load(str(tmp_path / "scenario.toml"))
    assert loaded.resolved == first.resolved


def test_an_adhesion_that_no_contaminant_gives_is_refused_with_the_allowed_range():
    with pytest.raises(ConfigError, match=r"initial_adhesion = 0.45.*allowed is .* to 0\.3"):
        Rig(20.0, adhesion={"initial_adhesion": 0.45})
