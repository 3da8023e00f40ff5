"""A recording of braking alone cannot show a wheel radius; no delay is reported instead."""

import numpy as np
import pytest
from tiers import first_of

from rollerrig.rig.identify.train_recorder import recording, verdict

RATE_HZ = 10.0
DECELERATION_M_S2 = 0.65
FASTEST_M_S = 40.0
NOISE_M_S = 0.02


def explained(folder, factor=1.0, delay_s=0.0):
    """Return the explanation of a stop whose third wheel shows a factor of its speed, late."""
    time_s = np.arange(0.0, FASTEST_M_S / DECELERATION_M_S2, 1.0 / RATE_HZ)

    def speed_m_s(late_s):
        braked_s = np.maximum(time_s - late_s, 0.0)
        return np.maximum(FASTEST_M_S - DECELERATION_M_S2 * braked_s, 0.0)

    rng = np.random.default_rng(3)
    columns = [time_s]
    for axle in range(1, 5):
        is_third = axle == 3
        shown = speed_m_s(delay_s if is_third else 0.0) * (factor if is_third else 1.0)
        columns.append(shown + NOISE_M_S * rng.standard_normal(time_s.size))
    np.savetxt(
        folder / "stop.csv",
        np.column_stack(columns),
        delimiter=",",
        fmt="%.4f",
        header=",".join(["time_s", *(f"wheel_speed_{axle}_m_s" for axle in range(1, 5))]),
        comments="",
    )
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "stop.csv"\n')
    return verdict.explain(recording.load(folder))


def test_a_stop_without_faults_is_consistent(tmp_path):
    assert explained(tmp_path).verdict == "consistent"


@pytest.mark.parametrize("factor", first_of([1.03, 0.97]))
def test_a_radius_in_braking_alone_is_unknown_and_no_delay(tmp_path, factor):
    account = explained(tmp_path, factor=factor)
    assert "speed_sensor_delay" not in [finding.name for finding in account.findings]
    factors = [one for one in account.unknown if one.unit == "%"]
    assert [one.channels for one in factors] == [("axle 3",)]
    assert factors[0].low <= 100.0 * (factor - 1.0) <= factors[0].high


def test_a_delay_in_braking_at_one_rate_is_unknown_because_an_offset_looks_alike(tmp_path):
    account = explained(tmp_path, delay_s=0.8)
    assert account.verdict == "unexplained"
    (late,) = account.unknown
    assert late.channels == ("axle 3",)
    assert late.low <= 0.8 <= late.high
    assert late.details.offset_m_s == pytest.approx(0.8 * DECELERATION_M_S2, rel=0.1)
