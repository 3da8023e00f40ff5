"""One of four wheels has an offset, and low speed occurs once, in a curve.

The wheels follow the geometry of a car whose front wheels are steered.
"""

import numpy as np
import pytest
from tiers import first_of

from rollerrig.realtime.reports import recorder as report
from rollerrig.rig.identify.train_recorder import recording, verdict

WHEELBASE_M = 2.7
HALF_TRACK_M = 0.77

# s and m/s: the car leaves a roundabout, then drives at nearly one speed
PROFILE = [(0, 7.0), (9, 8.0), (16, 17.0), (40, 18.5), (60, 16.5), (90, 19.0)]

# orders of the wheels: front left, front right, rear left, rear right
BY_AXLE = (0, 1, 2, 3)
BY_SIDE = (0, 2, 1, 3)


def car(seed):
    """Return stamps (n,), s, the speeds of the wheels (n, 4) and of the middle (n,), m/s."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 90.0, 0.05)
    points_s, speeds_m_s = np.transpose(PROFILE)
    middle = np.interp(time_s, points_s, speeds_m_s)
    # curvature of the rear axle's path, 1/m: a roundabout, and gentle bends
    curvature = np.where(time_s < 9.0, 1.0 / 15.0, 0.002 * np.sin(time_s / 7.0))
    left = 1.0 - HALF_TRACK_M * curvature
    right = 1.0 + HALF_TRACK_M * curvature
    along = WHEELBASE_M * curvature
    shares = [np.hypot(left, along), np.hypot(right, along), left, right]
    radii = 1.0 + 0.001 * rng.standard_normal(4)
    wheels = np.column_stack(shares) * radii * middle[:, None]
    return time_s, wheels + 0.03 * rng.standard_normal(wheels.shape), middle


def explained(folder, time_s, wheels, middle, order):
    rng = np.random.default_rng(5)
    reference = middle + 0.05 * rng.standard_normal(middle.size)
    names = [f"wheel_speed_{axle}_m_s" for axle in range(1, 5)]
    np.savetxt(
        folder / "a.csv",
        np.column_stack([time_s, wheels[:, order], reference]),
        delimiter=",",
        fmt="%.3f",
        header=",".join(["time_s", *names, "reference_speed_m_s"]),
        comments="",
    )
    (folder / "dataset.toml").write_text('kind = "recorder"\n[[run]]\nfile = "a.csv"\n')
    return verdict.explain(recording.load(folder))


def offsets(account):
    return [finding for finding in account.findings if finding.name == "speed_offset"]


@pytest.mark.parametrize(
    ("order", "wheel", "offset_m_s"),
    [
        (BY_AXLE, 0, 0.3),
        (BY_SIDE, 3, -0.3),
        pytest.param(BY_SIDE, 0, 0.3, marks=pytest.mark.nightly),
        pytest.param(BY_AXLE, 1, -0.35, marks=pytest.mark.nightly),
        pytest.param(BY_SIDE, 1, -0.35, marks=pytest.mark.nightly),
        pytest.param(BY_AXLE, 2, 0.4, marks=pytest.mark.nightly),
        pytest.param(BY_SIDE, 2, 0.4, marks=pytest.mark.nightly),
        pytest.param(BY_AXLE, 3, -0.3, marks=pytest.mark.nightly),
    ],
)
def test_the_other_wheels_show_the_offset_of_one_although_low_speed_occurs_once(
    tmp_path, order, wheel, offset_m_s
):
    time_s, wheels, middle = car(seed=20 + wheel)
    wheels[:, wheel] += offset_m_s
    account = explained(tmp_path, time_s, wheels, middle, order)
    (offset,) = offsets(account)
    assert offset.channels == (f"axle {order.index(wheel) + 1}",)
    assert offset.low <= offset_m_s <= offset.high
    assert not account.unknown, report.story(account)


@pytest.mark.parametrize("order", first_of([BY_AXLE, BY_SIDE]))
@pytest.mark.parametrize("seed", first_of(range(30, 36)))
def test_a_roundabout_at_the_only_low_speed_is_no_offset(tmp_path, order, seed):
    account = explained(tmp_path, *car(seed), order)
    assert not offsets(account), report.story(account)


@pytest.mark.parametrize("seed", first_of(range(40, 43)))
def test_another_radius_or_a_delay_of_one_wheel_is_no_offset(tmp_path, seed):
    time_s, wheels, middle = car(seed)
    wheels[:, 1] *= 0.985
    wheels[:, 2] = np.interp(time_s - 0.6, time_s, wheels[:, 2])
    account = explained(tmp_path, time_s, wheels, middle, BY_AXLE)
    assert not offsets(account), report.story(account)
