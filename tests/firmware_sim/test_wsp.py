"""The reference WSP against a small coach of its own: wheelsets on soap, valves with dead time.

The coach's equations are written here, apart from the project's physics: a saturated creep force
between a degraded and a recovered friction that the energy of sliding mixes, first-order air.
"""

import os
import subprocess
import sys

import numpy as np
import pytest

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.wsp import logic, phases
from rollerrig.firmware_sim.wsp.phases import Event, Phase
from rollerrig.rig.compiled.kernel import kernel, kernel_with_memory

RADIUS_M, INERTIA_KGM2, LOAD_N, MASS_KG = 0.445, 160.0, 105.4e3, 43e3
TORQUE_NM, DEAD_CYCLES, STEPS = 7300.0, 4, 10
CYCLE_S = 0.01
DT_S = CYCLE_S / STEPS
CLEANING_M_J = 1.9e-4

# columns of a stop's log
V, WHEEL, REFERENCE, MAGNETS, PHASE, DISTANCE, PRESSURE, SPEED_RAW = 0, 1, 5, 6, 7, 11, 12, 16
COLUMNS = 20


@kernel
def adhesion(sliding_m_s, v_m_s, mu, tau):
    """Contact force over load, signed as the sliding: sliding energy mixes the two frictions."""
    s = abs(sliding_m_s)
    e = s / max(v_m_s, 4.0)  # floored: explicit steps are unstable on a stiffer contact
    f_d = mu * (1.0 + 1.5 * np.exp(-0.2 * s)) * np.tanh(150.0 * e)
    f_r = max(f_d, (0.28 + 0.42 * np.exp(-0.6 * s)) * np.tanh(150.0 * e))
    k = tau * 0.5 * LOAD_N * e
    f = f_r
    for _ in range(8):
        decay = np.exp(-k * f)
        f -= (f - f_r + (f_r - f_d) * decay) / (1.0 - (f_r - f_d) * k * decay)
    return np.sign(sliding_m_s) * f


@kernel
def brake_coach(magnets, x, demand, mu, tau):
    """One bus cycle of the coach. `x`: v, distance, omega and pressure (0 to 1) of four axles."""
    for _ in range(STEPS):
        pull = 0.0
        for j in range(4):
            bits = (magnets >> (2 * j)) & 3
            if bits == 0:
                x[6 + j] += (demand - x[6 + j]) * DT_S / 0.3
            elif bits == 3:
                x[6 + j] -= x[6 + j] * DT_S / 0.2
            force = LOAD_N * adhesion(x[0] - RADIUS_M * x[2 + j], x[0], mu, tau)
            rate = (RADIUS_M * force - TORQUE_NM * x[6 + j]) / INERTIA_KGM2
            x[2 + j] = max(0.0, x[2 + j] + rate * DT_S)
            pull += force
        x[0] = max(0.0, x[0] - pull / MASS_KG * DT_S)
        x[1] += x[0] * DT_S


@kernel_with_memory
def run_stop(unit, mu, tau, log, protected):
    """Brake from 42 m/s under friction `mu` (one a cycle) until 0.1 m/s; returns rows of `log`."""
    x = np.zeros(10)
    x[0] = 42.0
    x[2:6] = 42.0 / RADIUS_M
    pipe = np.zeros(DEAD_CYCLES, np.int64)
    raw = np.zeros(4, np.int64)
    for i in range(log.shape[0]):
        for j in range(4):
            raw[j] = round(x[2 + j] * 100.0)
        magnets, reference = logic.cycle(unit, raw)
        row = log[i]
        row[V] = x[0]
        row[WHEEL : WHEEL + 4] = RADIUS_M * x[2:6]
        row[REFERENCE] = reference * 0.01
        row[MAGNETS] = magnets
        row[PHASE : PHASE + 4] = unit.state.phase
        row[DISTANCE] = x[1]
        row[PRESSURE : PRESSURE + 4] = x[6:10]
        row[SPEED_RAW : SPEED_RAW + 4] = raw
        if x[0] < 0.1:
            return i
        demand = 1.0 - np.exp(-i * CYCLE_S / 1.3)
        brake_coach(pipe[i % DEAD_CYCLES] if protected else 0, x, demand, mu[i], tau)
        pipe[i % DEAD_CYCLES] = magnets
    return log.shape[0]


def stop(mu, tau=CLEANING_M_J, protected=True, cycles=14000, params=None):
    """The log of a stop; `mu` a number or one for each cycle."""
    log = np.zeros((cycles, COLUMNS))
    unit = logic.new_unit(logic.load() if params is None else params)
    return log[
        : run_stop(
            unit,
            np.broadcast_to(float(mu) if np.isscalar(mu) else mu, cycles).copy(),
            tau,
            log,
            protected,
        )
    ]


def longest_lock_s(log, axle):
    """Longest time for which a wheel stands while the coach runs faster than 3 m/s."""
    locked = (log[:, WHEEL + axle] < 0.05) & (log[:, V] > 3.0)
    longest = run = 0
    for stands in locked:
        run = run + 1 if stands else 0
        longest = max(longest, run)
    return longest * CYCLE_S


def feed(speeds_m_s, cycles, unit=None):
    """Magnet bytes while four axle speeds stay as they are."""
    unit = unit or logic.new_unit(logic.load())
    raw = np.array([round(v / RADIUS_M * 100.0) for v in speeds_m_s], dtype=np.int64)
    return [logic.cycle(unit, raw)[0] for _ in range(cycles)], unit


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.03])
def test_no_axle_locks_on_soap_for_longer_than_0_4_s(mu):
    log = stop(mu)
    assert log[-1, V] < 0.2
    assert max(longest_lock_s(log, axle) for axle in range(4)) <= 0.4


def test_without_protection_the_same_coach_locks_its_wheels():
    log = stop(0.02, tau=0.0, protected=False)
    assert min(longest_lock_s(log, axle) for axle in range(4)) > 10.0


def test_where_sliding_does_not_clean_the_protected_stop_is_shorter_than_with_locked_wheels():
    protected, locked = stop(0.03, tau=0.0), stop(0.03, tau=0.0, protected=False)
    assert max(longest_lock_s(protected, axle) for axle in range(4)) <= 0.4
    assert protected[-1, V] < 0.2
    # the unprotected coach may still be running when the log ends
    assert protected[-1, DISTANCE] < 0.98 * locked[-1, DISTANCE]


def test_wheels_slide_on_purpose_about_as_far_as_in_the_recorded_stops():
    # paper, Table 6: means 4.2 to 5.8 m/s, standard deviations 1.6 to 2.2 m/s
    log = stop(0.02)
    sliding = log[:, V] - log[:, WHEEL]
    assert 4.0 < sliding.mean() < 6.0
    assert 1.4 < sliding.std() < 2.4


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.03])
def test_the_reference_stays_near_the_vehicle_although_all_axles_slide(mu):
    log = stop(mu)
    running = log[log[:, V] > 3.0]
    slides = running[:, V] - running[:, WHEEL : WHEEL + 4].max(axis=1)
    error = running[:, REFERENCE] - running[:, V]
    assert np.percentile(slides, 50) > 2.0  # no axle shows the vehicle's speed most of the time
    assert np.abs(error).max() < 2.5
    assert np.sqrt(np.mean(error**2)) < 0.8


def test_a_dry_stop_never_energises_a_magnet():
    log = stop(0.3)
    assert log[:, V].min() < 0.2
    assert not log[:, MAGNETS].any()


def test_uneven_wheels_and_noisy_sensors_are_not_taken_for_sliding():
    # 0.3 % once a turn and three counts of noise on wheels that brake at 1.2 m/s2
    noise = np.random.default_rng(1)
    unit = logic.new_unit(logic.load())
    for i in range(3000):
        omega = (40.0 - 1.2 * i * CYCLE_S) / RADIUS_M
        turn = np.sin(40.0 / RADIUS_M * i * CYCLE_S + np.arange(4.0))
        raw = np.round(100.0 * omega * (1.0 + 0.003 * turn)) + noise.integers(-3, 4, 4)
        assert logic.cycle(unit, raw.astype(np.int64))[0] == 0


def test_the_brakes_are_back_within_three_seconds_when_the_adhesion_returns():
    mu = np.full(14000, 0.02)
    mu[1500:] = 0.3
    log = stop(mu)
    assert log[1400, PRESSURE : PRESSURE + 4].max() < 0.9
    assert log[1800, PRESSURE : PRESSURE + 4].min() > 0.9
    assert not log[1900:, MAGNETS].any()


def test_a_vent_magnet_is_never_energised_without_its_hold_magnet():
    magnets = stop(0.02)[:, MAGNETS].astype(int)
    hold, vent = magnets & 0x55, (magnets >> 1) & 0x55
    assert vent.any()
    assert not (vent & ~hold).any()


def test_below_the_cut_off_speed_all_magnets_are_off():
    log = stop(0.02)
    slow = log[:, REFERENCE] < logic.load().cut_off_m_s
    assert slow.any()
    assert not log[slow, MAGNETS].any()


def test_a_locked_wheel_is_vented_for_ten_seconds_at_most():
    magnets, _ = feed((30.0, 0.0, 30.0, 30.0), 1200)
    vented = [i for i, byte in enumerate(magnets) if byte == 0b11 << 2]
    assert vented[0] < 5
    filled = next(i for i in range(vented[0], 1200) if magnets[i] & 0b1100 == 0)
    assert filled - vented[0] == pytest.approx(1000, abs=2)
    assert not any(byte & 0b1100 for byte in magnets[filled : filled + 49])


def test_holding_ends_after_five_seconds_in_all_without_a_fill():
    # steady just above the band: vent pulses with holding between them
    magnets, _ = feed((30.0, 23.0, 30.0, 30.0), 900)
    held = np.cumsum([byte & 0b1100 == 0b0100 for byte in magnets])
    filled = next(i for i in range(20, 900) if magnets[i] & 0b1100 == 0)
    assert held[filled] == pytest.approx(500, abs=2)


def test_one_blocked_wheel_does_not_touch_the_others():
    magnets, _ = feed((30.0, 0.0, 30.0, 30.0), 100)
    assert all(byte & ~0b1100 == 0 for byte in magnets)


def test_the_direction_of_travel_does_not_matter():
    forward, _ = feed((30.0, 20.0, 30.0, 30.0), 300)
    backward, _ = feed((-30.0, -20.0, -30.0, -30.0), 300)
    assert forward == backward


def test_the_same_integers_give_the_same_bits_inside_a_compiled_loop_and_cycle_by_cycle():
    log = stop(0.02)
    unit = logic.new_unit(logic.load())
    again = [logic.cycle(unit, row[SPEED_RAW : SPEED_RAW + 4].astype(np.int64)) for row in log]
    assert [magnets for magnets, _ in again] == log[:, MAGNETS].astype(int).tolist()
    assert [reference * 0.01 for _, reference in again] == log[:, REFERENCE].tolist()


PLAIN = """
import sys
import numpy as np
from rollerrig.firmware_sim.wsp import logic as wsp
rows = np.load(sys.argv[1])
unit = wsp.new_unit(wsp.load())
print([tuple(int(n) for n in wsp.cycle(unit, row)) for row in rows])
"""


def test_the_cycle_is_ordinary_python_too(tmp_path):
    raw = stop(0.02)[:1500, SPEED_RAW : SPEED_RAW + 4].astype(np.int64)
    np.save(tmp_path / "raw.npy", raw)
    plain = subprocess.run(
        [sys.executable, "-c", PLAIN, tmp_path / "raw.npy"],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    ).stdout
    unit = logic.new_unit(logic.load())
    assert plain.strip() == str([tuple(int(n) for n in logic.cycle(unit, row)) for row in raw])


def test_the_tables_cover_every_phase_event_and_class():
    assert phases.NEXT.shape == phases.INTERRUPTS.shape == (len(Phase), len(Event))
    assert phases.WISHES.shape == (5, 5)
    assert phases.MAGNETS.shape == (len(Phase), 2)
    assert set(phases.NEXT.ravel()) == {int(phase) for phase in Phase}
    # deeper or faster falling never asks for more brake
    assert (np.diff(phases.WISHES[:, ::-1], axis=1) >= 0).all()
    assert (np.diff(phases.WISHES, axis=0) >= 0).all()


@pytest.mark.parametrize("name", store.names("wsp"))
def test_every_packaged_configuration_loads(name):
    assert logic.load(name)._fields == tuple(row.name for row in logic.ROWS)


def test_the_reference_configuration_writes_out_the_defaults():
    written = store.load("wsp", "reference")[0]
    assert {
        name: tuple(value) if isinstance(value, list) else value for name, value in written.items()
    } == {row.name: row.default for row in logic.ROWS}


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("cut_of_m_s = 2.0", "did you mean 'cut_off_m_s'"),
        ("cut_off_m_s = 20.0", "allowed 0.3 to 10"),
        ("wheel_diameter_m = [0.89]", "must have 4"),
    ],
)
def test_a_wrong_configuration_is_refused_by_name(tmp_path, line, told):
    path = tmp_path / "mine.toml"
    path.write_text(line)
    with pytest.raises(ConfigError, match=told) as raised:
        logic.load(str(path))
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.05, 0.3])
def test_the_watch_for_stuck_sensors_changes_no_bit_of_an_ordinary_stop(mu):
    watched, blind = stop(mu), stop(mu, params=logic.load()._replace(stuck_s=60.0))
    assert np.array_equal(watched, blind)


def with_sensor_stuck_after(second, params=None):
    """Count of an ordinary stop, axle 2 stuck from then on, and the references told."""
    raw = stop(0.03)[:, SPEED_RAW : SPEED_RAW + 4].astype(np.int64)
    at = round(second / CYCLE_S)
    raw[at:, 1] = raw[at, 1]
    unit = logic.new_unit(logic.load() if params is None else params)
    told = [logic.cycle(unit, row)[1] * 0.01 for row in raw]
    return at, np.array(told), logic.stuck(unit)


def test_a_stuck_sensor_does_not_hold_the_reference_up():
    at, told, stuck = with_sensor_stuck_after(3.0)
    speed = stop(0.03)[:, V]
    later = slice(at + 400, None)
    assert stuck == 0b0010
    assert np.abs(told - speed)[later].max() < 3.0
    _, blind, _ = with_sensor_stuck_after(3.0, logic.load()._replace(stuck_s=60.0))
    assert np.abs(blind - speed)[later].max() > 10.0


def test_a_sensor_that_goes_on_is_trusted_again():
    unit = logic.new_unit(logic.load())
    for cycle in range(200):
        row = np.array([8000 - 3 * cycle] * 4)
        row[2] = 7970 if 10 <= cycle < 150 else row[2]
        logic.cycle(unit, row)
        assert logic.stuck(unit) == (0b0100 if 60 <= cycle < 150 else 0), cycle


def test_a_locked_wheel_is_not_taken_for_a_stuck_sensor():
    unit = logic.new_unit(logic.load())
    for cycle in range(200):
        logic.cycle(unit, np.array([8000 - 3 * cycle, 0, 8000 - 3 * cycle, 8000 - 3 * cycle]))
    assert logic.stuck(unit) == 0
