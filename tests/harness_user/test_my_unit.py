"""A test as in the repository of a WSP team: a plain function and a fixture."""

import pytest


@pytest.mark.nightly
def test_no_wheel_locks_when_the_driver_brakes_hard_on_soap(rollerrig_bench):
    rig = rollerrig_bench(initial_speed_km_h=36.0, adhesion="soap", wsp="reference")
    rig.wait(0.5)
    rig.brake(bar=3.8)
    rig.stop(timeout_s=40.0)
    assert rig.longest_lock_s < 0.4
    assert 20.0 < rig.position_m < 200.0
