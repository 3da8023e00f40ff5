"""The reference WSP protects a small separate coach: wheelsets on soap, valves with dead time.

The equations of the coach are in this file and do not use the project's physics. The creep force
saturates. Its friction lies between a degraded and a recovered value, and the energy of sliding
decides where. Cylinders fill and vent with first-order lags.
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

# the coach
RADIUS_M = 0.445  # of a wheel
INERTIA_KGM2 = 160.0  # of a wheelset
LOAD_N = 105.4e3  # of a wheelset on the rails
MASS_KG = 43e3
TORQUE_NM = 7300.0  # brake torque of a wheelset at full pressure
CLEANING_M_J = 1.9e-4  # how strongly the energy of sliding recovers friction

# time
CYCLE_S = 0.01  # of the bus
STEPS = 10  # of the integration in a cycle
DT_S = CYCLE_S / STEPS
DEAD_CYCLES = 4  # from a command to the valve

# places in the state of the coach; four axles each from OMEGA and from AIR
SPEED = 0
TRAVELLED = 1
OMEGA = 2
AIR = 6  # cylinder pressure over full pressure
STATES = 10

# columns of a stop's log; four axles each from WHEEL, PHASE, PRESSURE and SPEED_RAW
V = 0  # m/s
WHEEL = 1  # m/s
REFERENCE = 5  # m/s
MAGNETS = 6
PHASE = 7
DISTANCE = 11  # m
PRESSURE = 12  # of full pressure
SPEED_RAW = 16  # 0.01 rad/s
COLUMNS = 20

# two bits an axle in the byte of magnets
AXLE_2 = 0b1100
AXLE_2_HOLDS = 0b0100
AXLE_2_VENTS = 0b1100


@kernel
def adhesion(sliding_m_s, v_m_s, mu, tau):
    """Return contact force over load, with the sign of the sliding.

    `mu` is the degraded friction and `tau` the cleaning factor in m/J.
    """
    s = abs(sliding_m_s)
    e = s / max(v_m_s, 4.0)  # floored: explicit steps are unstable on a stiffer contact
    f_d = mu * (1.0 + 1.5 * np.exp(-0.2 * s)) * np.tanh(150.0 * e)
    f_r = max(f_d, (0.28 + 0.42 * np.exp(-0.6 * s)) * np.tanh(150.0 * e))

    # The energy of sliding depends on the force itself, so Newton's method finds the force.
    k = tau * 0.5 * LOAD_N * e
    f = f_r
    for _ in range(8):
        decay = np.exp(-k * f)
        f -= (f - f_r + (f_r - f_d) * decay) / (1.0 - (f_r - f_d) * k * decay)
    return np.sign(sliding_m_s) * f


@kernel
def brake_coach(magnets, x, demand, mu, tau):
    """Advance the state `x` of the coach by one bus cycle in place."""
    for _ in range(STEPS):
        pull = 0.0
        for j in range(4):
            bits = (magnets >> (2 * j)) & 3
            if bits == 0:  # fill
                x[AIR + j] += (demand - x[AIR + j]) * DT_S / 0.3
            elif bits == 3:  # vent
                x[AIR + j] -= x[AIR + j] * DT_S / 0.2

            sliding_m_s = x[SPEED] - RADIUS_M * x[OMEGA + j]
            force = LOAD_N * adhesion(sliding_m_s, x[SPEED], mu, tau)
            rate = (RADIUS_M * force - TORQUE_NM * x[AIR + j]) / INERTIA_KGM2
            x[OMEGA + j] = max(0.0, x[OMEGA + j] + rate * DT_S)
            pull += force

        x[SPEED] = max(0.0, x[SPEED] - pull / MASS_KG * DT_S)
        x[TRAVELLED] += x[SPEED] * DT_S


@kernel_with_memory
def run_stop(unit, mu, tau, log, protected, stuck_from):
    """Brake from 42 m/s to 0.1 m/s; return the number of complete rows of `log`.

    `mu` holds the friction of each cycle. Without protection the valves ignore the magnets. The
    sensor of axle 2 is stuck from a cycle on.
    """
    x = np.zeros(STATES)
    x[SPEED] = 42.0
    x[OMEGA : OMEGA + 4] = 42.0 / RADIUS_M
    # commands that have not reached the valves yet
    pipe = np.zeros(DEAD_CYCLES, np.int64)
    raw = np.zeros(4, np.int64)

    for i in range(log.shape[0]):
        for j in range(4):
            if j != 1 or i < stuck_from:
                raw[j] = round(x[OMEGA + j] * 100.0)
        magnets, reference = logic.cycle(unit, raw)

        row = log[i]
        row[V] = x[SPEED]
        row[WHEEL : WHEEL + 4] = RADIUS_M * x[OMEGA : OMEGA + 4]
        row[REFERENCE] = reference * 0.01
        row[MAGNETS] = magnets
        row[PHASE : PHASE + 4] = unit.state.phase
        row[DISTANCE] = x[TRAVELLED]
        row[PRESSURE : PRESSURE + 4] = x[AIR : AIR + 4]
        row[SPEED_RAW : SPEED_RAW + 4] = raw
        if x[SPEED] < 0.1:
            return i

        valves = 0
        if protected:
            valves = pipe[i % DEAD_CYCLES]
        demand = 1.0 - np.exp(-i * CYCLE_S / 1.3)
        brake_coach(valves, x, demand, mu[i], tau)
        pipe[i % DEAD_CYCLES] = magnets
    return log.shape[0]


def new_unit(params=None):
    """Return a reference unit with these parameters, or with the default parameters."""
    if params is None:
        params = logic.load()
    return logic.new_unit(params)


def stop(mu, tau=CLEANING_M_J, protected=True, cycles=14000, params=None, stuck_from=14000):
    """Return the log of a stop, shape (rows, COLUMNS). `mu`: one number, or one a cycle."""
    log = np.zeros((cycles, COLUMNS))
    mu_by_cycle = np.broadcast_to(np.asarray(mu, dtype=float), cycles).copy()
    rows = run_stop(new_unit(params), mu_by_cycle, tau, log, protected, stuck_from)
    return log[:rows]


def longest_lock_s(log, axle):
    """Return the longest time for which a wheel is locked while the coach is above 3 m/s."""
    locked = (log[:, WHEEL + axle] < 0.05) & (log[:, V] > 3.0)
    longest = 0
    current = 0
    for is_locked in locked:
        if is_locked:
            current += 1
        else:
            current = 0
        longest = max(longest, current)
    return longest * CYCLE_S


def longest_lock_of_all_s(log):
    """Return the longest lock of the four wheels."""
    return max(longest_lock_s(log, axle) for axle in range(4))


def feed(speeds_m_s, cycles, params=None):
    """Return the byte of magnets of each cycle while the four speeds stay constant."""
    return feed_rows([speeds_m_s] * cycles, params)


def feed_rows(speeds_m_s, params=None):
    """Return the byte of magnets of each cycle for its row of four speeds."""
    unit = new_unit(params)
    rows = np.rint(np.asarray(speeds_m_s) / RADIUS_M * 100.0).astype(np.int64)
    return [logic.cycle(unit, row)[0] for row in rows]


def raw_speeds(log):
    """Return the speeds that the unit received in 0.01 rad/s, integers of shape (rows, 4)."""
    return log[:, SPEED_RAW : SPEED_RAW + 4].astype(np.int64)


def first_fill(magnets, start):
    """Return the first cycle from `start` in which the valve of axle 2 fills."""
    return next(i for i in range(start, len(magnets)) if magnets[i] & AXLE_2 == 0)


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.03])
def test_no_axle_locks_on_soap_for_longer_than_0_4_s(mu):
    log = stop(mu)
    assert log[-1, V] < 0.2
    assert longest_lock_of_all_s(log) <= 0.4


def test_without_protection_the_same_coach_locks_its_wheels():
    log = stop(0.02, tau=0.0, protected=False)
    assert min(longest_lock_s(log, axle) for axle in range(4)) > 10.0


def test_where_sliding_does_not_clean_the_protected_stop_is_shorter_than_with_locked_wheels():
    protected = stop(0.03, tau=0.0)
    locked = stop(0.03, tau=0.0, protected=False)
    assert longest_lock_of_all_s(protected) <= 0.4
    assert protected[-1, V] < 0.2
    # the unprotected coach may still be running when the log ends
    assert protected[-1, DISTANCE] < 0.98 * locked[-1, DISTANCE]


def test_wheels_slide_on_purpose_within_the_slip_band():
    unit = logic.load()
    log = stop(0.02)
    running = log[log[:, V] > 5.0]
    for axle in range(4):
        creepage = 1.0 - running[:, WHEEL + axle] / running[:, V]
        # half of the time the wheel slides near the band, also in spite of the run-ups
        assert np.median(creepage) == pytest.approx(unit.band_low_fraction, abs=0.06)


def test_wheels_slide_on_purpose_about_as_far_as_in_the_recorded_stops():
    # paper, Table 6: means 4.2 to 5.8 m/s
    log = stop(0.02)
    sliding = log[:, V] - log[:, WHEEL]
    assert 4.0 < sliding.mean() < 6.0


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.03])
def test_the_reference_stays_near_the_vehicle_although_all_axles_slide(mu):
    log = stop(mu)
    running = log[log[:, V] > 3.0]
    slides = running[:, V] - running[:, WHEEL : WHEEL + 4].max(axis=1)
    error = running[:, REFERENCE] - running[:, V]
    # for most of the time no axle shows the speed of the vehicle
    assert np.percentile(slides, 50) > 1.0
    assert np.abs(error).max() < 3.0
    assert np.sqrt(np.mean(error**2)) < 0.8


def test_a_dry_stop_never_energises_a_magnet():
    log = stop(0.3)
    assert log[:, V].min() < 0.2
    assert not log[:, MAGNETS].any()


def test_uneven_wheels_and_noisy_sensors_are_not_taken_for_sliding():
    # 0.3 % once a turn and three counts of noise on wheels that brake at 1.2 m/s2
    noise = np.random.default_rng(1)
    unit = new_unit()
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
    hold = magnets & 0x55
    vent = (magnets >> 1) & 0x55
    assert vent.any()
    assert not (vent & ~hold).any()


def test_below_the_cut_off_speed_all_magnets_are_off():
    log = stop(0.02)
    slow = log[:, REFERENCE] < logic.load().cut_off_m_s
    assert slow.any()
    assert not log[slow, MAGNETS].any()


def test_a_wheel_that_hardly_runs_up_is_vented_for_ten_seconds_at_most():
    # axle 2 slides deeply and gains 0.8 m/s2, so its sensor is plausible
    rows = [(30.0, 5.0 + 0.8 * CYCLE_S * cycle, 30.0, 30.0) for cycle in range(1200)]
    magnets = feed_rows(rows, logic.load()._replace(run_up_done_m_s2=0.5))
    vented = magnets.index(AXLE_2_VENTS)
    assert vented < 5

    filled = first_fill(magnets, vented)
    assert filled - vented == pytest.approx(1000, abs=2)
    assert not any(byte & AXLE_2 for byte in magnets[filled : filled + 49])


def test_holding_ends_after_five_seconds_in_all_without_a_fill():
    # The sliding is just above the band, so the unit holds between vent pulses.
    magnets = feed((30.0, 19.5, 30.0, 30.0), 900, logic.load()._replace(narrow_share=1.0))
    held = np.cumsum([byte & AXLE_2 == AXLE_2_HOLDS for byte in magnets])
    filled = first_fill(magnets, 20)
    assert held[filled] == pytest.approx(500, abs=2)


def test_one_blocked_wheel_does_not_touch_the_others():
    magnets = feed((30.0, 0.0, 30.0, 30.0), 100)
    assert all(byte & ~AXLE_2 == 0 for byte in magnets)


def test_the_direction_of_travel_does_not_matter():
    forward = feed((30.0, 20.0, 30.0, 30.0), 300)
    backward = feed((-30.0, -20.0, -30.0, -30.0), 300)
    assert forward == backward


def test_the_same_integers_give_the_same_bits_inside_a_compiled_loop_and_cycle_by_cycle():
    log = stop(0.02)
    unit = new_unit()
    magnets = []
    references_m_s = []
    for raw in raw_speeds(log):
        byte, reference = logic.cycle(unit, raw)
        magnets.append(byte)
        references_m_s.append(reference * 0.01)
    assert magnets == log[:, MAGNETS].astype(int).tolist()
    assert references_m_s == log[:, REFERENCE].tolist()


# runs the cycle without compilation and prints its results
PLAIN = """
import sys
import numpy as np
from rollerrig.firmware_sim.wsp import logic as wsp
rows = np.load(sys.argv[1])
unit = wsp.new_unit(wsp.load())
print([tuple(int(n) for n in wsp.cycle(unit, row)) for row in rows])
"""


def test_the_cycle_is_ordinary_python_too(tmp_path):
    raw = raw_speeds(stop(0.02)[:1500])
    np.save(tmp_path / "raw.npy", raw)
    plain = subprocess.run(
        [sys.executable, "-c", PLAIN, tmp_path / "raw.npy"],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    ).stdout

    unit = new_unit()
    compiled = []
    for row in raw:
        magnets, reference = logic.cycle(unit, row)
        compiled.append((int(magnets), int(reference)))
    assert plain.strip() == str(compiled)


def test_the_tables_cover_every_phase_event_and_class():
    assert phases.NEXT.shape == phases.INTERRUPTS.shape == (len(Phase), len(Event))
    assert phases.WISHES.shape == (5, 5)
    assert phases.MAGNETS.shape == (len(Phase), 2)
    assert set(phases.NEXT.ravel()) == {int(phase) for phase in Phase}
    # deeper or faster falling never requests more brake
    assert (np.diff(phases.WISHES[:, ::-1], axis=1) >= 0).all()
    assert (np.diff(phases.WISHES, axis=0) >= 0).all()


@pytest.mark.parametrize("name", store.names("wsp"))
def test_every_packaged_configuration_loads(name):
    assert logic.load(name)._fields == tuple(row.name for row in logic.ROWS)


def test_the_reference_configuration_writes_out_the_defaults():
    written = store.load("wsp", "reference")[0]
    # TOML has lists where the defaults are tuples
    values = {}
    for name, value in written.items():
        values[name] = tuple(value) if isinstance(value, list) else value
    assert values == {row.name: row.default for row in logic.ROWS}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("cut_of_m_s = 2.0", "did you mean 'cut_off_m_s'"),
        ("cut_off_m_s = 20.0", "allowed 0.3 to 10"),
        ("wheel_diameter_m = [0.89]", "must have 4"),
    ],
)
def test_a_wrong_configuration_is_refused_by_name(tmp_path, line, message):
    path = tmp_path / "mine.toml"
    path.write_text(line)
    with pytest.raises(ConfigError, match=message) as raised:
        logic.load(str(path))
    assert str(path) in str(raised.value)


def params_without_watch():
    """Return parameters with which no sensor is found stuck within the tests."""
    return logic.load()._replace(stuck_s=60.0)


@pytest.mark.parametrize("mu", [0.01, 0.02, 0.05, 0.3])
def test_the_watch_for_stuck_sensors_changes_no_bit_of_an_ordinary_stop(mu):
    with_watch = stop(mu)
    without_watch = stop(mu, params=params_without_watch())
    assert np.array_equal(with_watch, without_watch)


def test_a_stuck_sensor_does_not_hold_the_reference_up():
    log = stop(0.03, stuck_from=300)
    later = log[700:]
    assert np.abs(later[:, REFERENCE] - later[:, V]).max() < 3.0
    assert longest_lock_s(log, 0) <= 0.4
    assert log[-1, V] < 0.2

    # without any comparison of sensors the train takes longer, or does not stop
    trusting = params_without_watch()._replace(free_s=60.0)
    held = stop(0.03, stuck_from=300, params=trusting)
    assert np.abs(held[700:, REFERENCE] - held[700:, V]).max() > 10.0


def test_a_sensor_that_moves_again_is_trusted_again_after_a_time():
    unit = new_unit()
    found = 10 + round(logic.load().stuck_s / CYCLE_S)
    again = 150 + round(logic.load().trust_again_s / CYCLE_S)
    for cycle in range(again + 50):
        row = np.array([8000 - 3 * cycle] * 4)
        if 10 <= cycle < 150:
            row[2] = 7970
        logic.cycle(unit, row)

        expected = 0b0000
        if found <= cycle < again:
            expected = 0b0100
        # it may be a cycle early or late
        if min(abs(cycle - found), abs(cycle - again)) > 1:
            assert logic.stuck(unit) == expected, cycle


def rejected_after(change, cycles=400, begin=50):
    """Return the axles that are rejected, as bits, after a fault of the sensor of axle 3.

    The train brakes at 1.3 m/s2 without sliding. `change(counts, cycle)` returns the faulty counts
    of a cycle that many cycles after the beginning of the fault.
    """
    unit = new_unit()
    for cycle in range(cycles):
        row = np.array([8000 - 3 * cycle] * 4)
        if cycle >= begin:
            row[2] = change(row[2], cycle - begin)
        logic.cycle(unit, row)
    return logic.stuck(unit)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda counts, cycle: 0, id="lost"),
        pytest.param(lambda counts, cycle: 7850, id="frozen"),
        pytest.param(lambda counts, cycle: round(1.3 * counts), id="jump up"),
        pytest.param(lambda counts, cycle: round(0.7 * counts), id="jump down"),
        pytest.param(lambda counts, cycle: counts + 300 * (-1) ** cycle, id="noise"),
    ],
)
def test_an_impossible_reading_is_rejected_and_releases_no_brake(change):
    assert rejected_after(change) == 0b0100


def test_readings_that_a_wheel_can_give_are_not_rejected():
    assert rejected_after(lambda counts, cycle: round(0.97 * counts)) == 0
    # it locks at 20 m/s2 and turns again at 30 m/s2
    locks = lambda counts, cycle: max(0, counts - 45 * cycle)  # noqa: E731
    assert rejected_after(locks, cycles=120) == 0


def test_the_brakes_apply_when_no_sensor_is_trusted():
    unit = new_unit()
    for cycle in range(300):
        row = np.array([8000 - 3 * cycle] * 4)
        if cycle > 100:
            row[:] = 0
        magnets, _ = logic.cycle(unit, row)
    assert logic.stuck(unit) == 0b1111
    assert magnets == 0


def test_a_locked_wheel_is_not_taken_for_a_lost_sensor_while_it_can_still_run_up():
    unit = new_unit()
    cycles = round(logic.load().free_s / CYCLE_S)
    for cycle in range(cycles):
        raw = 8000 - 3 * cycle
        logic.cycle(unit, np.array([raw, max(0, raw - 90 * cycle), raw, raw]))
    assert logic.stuck(unit) == 0
