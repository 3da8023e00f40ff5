"""Finds faults of sensors, valves, motors and sanders in the record of a stop.

Each fault has a law that a fault-free rig keeps. Only channels are read that the nodes of the rig
report: speeds and pressures, energised magnets, torques and roller angles of the motors, sand. The
limits lie between stops without faults and stops with one (chosen, on a few stops of each), so a
single stop may show a fault that is not there. If the bus shows a fault, no law of the motion is
tested.

    [I1] the reported speed of a turning wheel does not stay constant for long; a vented wheel turns
    [I2] a wheel speeds up when its brake releases, not when the brake of another wheel does
    [I3] the third differences of all speeds have about the same size; a gap in the teeth makes a
         few of them large
    [I4] no magnet is energised all the time; both are energised to vent; a wheel that slides for
         long is vented
    [I5] the pressure of a cylinder that neither fills nor vents stays constant
    [I6] the torque of a motor has no line in its spectrum over the angle of its roller
    [I7] an active sander gives its rate after the lag of its hose, while its box holds sand
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.realtime.discover import bus_signs
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, HOLDING, VENT_MAGNET

# samples of a slower vehicle are not used
MOVES_M_S = 5.0

# [I1] the longest time of one and the same speed, and of standstill with a vented brake
CONSTANT_S = 1.5
STANDS_S = 0.5
VENTED_PA = 0.2e5  # below this pressure a brake counts as vented

# [I3] a speed is rough if its mean third difference is above ROUGH_FACTOR times the sum of the
# median of the axles and ROUGH_RAD_S
ROUGH_FACTOR = 6.0
ROUGH_RAD_S = 0.1
# a mean above so many medians comes from a few large values: a gap in the teeth
GAP_FACTOR = 5.0

# [I4] a wheel that slides by more than this share of the speed for this time must be vented
SLIDES_SHARE = 0.15
SLIDES_S = 8.0

# [I5] a leak: the pressure falls by a larger share per second, while the valve holds
LEAK_1_S = 0.05
SETTLED_S = 0.12  # the valve must have held for this time
HELD_S = 0.1  # least time of such samples
BRAKED_PA = 0.5e5  # samples of lower pressures are not used

# [I6] a line of the spectrum: so many times the level around it
LINE_FACTOR = 110.0
HIGHEST_ORDER = 12.0  # of the resampled torque, in periods per turn of the roller
LEAST_ANGLE_RAD = 1.0  # a roller that turns less gives no spectrum

# [I2] correlation of a wheel with the brake of another one: the least, and its lead over the others
TOGETHER = 0.5
APART = 0.3
QUICK_S = 1.0  # slower changes are removed before the correlation
SMOOTHING_S = 0.05  # of the wheel speeds

# [I7] the sander must act for so many delays of its hose
SETTLED_DELAYS = 10.0
RISEN_SHARE = 0.63  # the lag lasts until the rate has reached this share of its last value
LATE_DELAYS = 3.0  # a longer lag, in delays of the hose, is late
RATE_ERROR = 0.1  # largest relative error of the rate, and least share of a sander that gives sand


class _Motion(NamedTuple):
    """The samples of a stop while the vehicle moves, shape (samples, axles) each."""

    step_s: float
    wheel_rad_s: np.ndarray  # as the speed sensors measure it
    sliding_share: np.ndarray  # of the vehicle's speed
    pressure_Pa: np.ndarray  # of the cylinders
    magnets: np.ndarray  # pairs of bits, as in wsp_interface.magnets
    torque_Nm: np.ndarray  # of the motors
    angle_rad: np.ndarray  # of the rollers


def of(run: records.Run) -> list[str]:
    """Return the faults of the catalogue that a run shows, as 'NAME axle=2'.

    The kinds and the axles of the faults in the run's scenario are left out.
    """
    known: set[str] = set()
    for fault in run.scenario.get("fault", ()):
        known.add(fault["kind"])
        known.add(f"axle={fault.get('axle')}")
    # a fault on the bus changes the motion too
    signs = bus_signs.of(run) or _signs(run)
    return [sign for sign in signs if known.isdisjoint(sign.split())]


def _signs(run: records.Run) -> list[str]:
    """Return the faults that motion, valves, motors and sanders show."""
    motion = _motion(run)
    # mean size of the third differences of each wheel speed [I3]
    third_differences = np.abs(np.diff(motion.wheel_rad_s, 3, axis=0))
    roughness = third_differences.mean(axis=0)
    is_rough = roughness > ROUGH_FACTOR * (np.median(roughness) + ROUGH_RAD_S)

    found: list[str] = []
    axles = motion.wheel_rad_s.shape[1]
    for j in range(axles):
        kinds = [*_stuck_sensor(motion, j)]
        if is_rough[j]:
            kinds.append(_rough_sensor(third_differences[:, j]))
        kinds += [*_valve(motion, j), *_leak(motion, j), *_ripple(motion, j)]
        found += [f"{kind} axle={j + 1}" for kind in kinds]
    found += _swapped(motion)
    found += _sanders(run)
    return found


def _motion(run: records.Run) -> _Motion:
    """Return the samples of a run while the vehicle moves, without the first one."""
    speed_m_s = run.column("vehicle_speed_m_s")
    moves = np.flatnonzero(speed_m_s > MOVES_M_S)[1:]

    def of_all_axles(name: str) -> np.ndarray:
        columns = signals.columns(run.signal_table.by_name[name])
        return np.column_stack([run.column(column)[moves] for column in columns])

    wheel_rad_s = of_all_axles("measured_speed")
    radius_m = run.scenario["vehicle"]["wheel_radius_m"]
    return _Motion(
        step_s=float(np.median(np.diff(run.column("time_s")))),
        wheel_rad_s=wheel_rad_s,
        sliding_share=1.0 - radius_m * wheel_rad_s / speed_m_s[moves, None],
        pressure_Pa=of_all_axles("cylinder_pressure"),
        magnets=of_all_axles("magnets").astype(int),
        torque_Nm=of_all_axles("motor_torque"),
        angle_rad=of_all_axles("roller_angle"),
    )


# --- one axle; j is its place ---


def _stuck_sensor(motion: _Motion, j: int) -> Iterator[str]:
    """Yield the fault of a speed that stays constant or is zero [I1]."""
    wheel_rad_s = motion.wheel_rad_s[:, j]
    constant = (np.diff(wheel_rad_s) == 0.0) & (wheel_rad_s[1:] > 0.0)
    if _longest(constant) * motion.step_s > CONSTANT_S:
        yield "speed_sensor_stuck"
    stands_vented = (wheel_rad_s == 0.0) & (motion.pressure_Pa[:, j] < VENTED_PA)
    if _longest(stands_vented) * motion.step_s > STANDS_S:
        yield "speed_sensor_dropout"


def _rough_sensor(third_differences: np.ndarray) -> str:
    """Return the fault of a rough speed, from the sizes of its third differences [I3]."""
    if third_differences.mean() > GAP_FACTOR * np.median(third_differences):
        return "missing_tooth"
    return "speed_noise_burst"


def _valve(motion: _Motion, j: int) -> Iterator[str]:
    """Yield the fault of a magnet [I4]."""
    magnets = motion.magnets[:, j]
    if (magnets & VENT_MAGNET).all():
        yield "vent_magnet_stuck"
    elif (magnets & HOLD_MAGNET).all():
        yield "hold_magnet_stuck"
    elif (magnets == VENT_MAGNET).any():
        yield "hold_magnet_dead"
    elif not (magnets & VENT_MAGNET).any():
        slides = motion.sliding_share[:, j] > SLIDES_SHARE
        if _longest(slides) * motion.step_s > SLIDES_S:
            yield "vent_magnet_dead"


def _leak(motion: _Motion, j: int) -> Iterator[str]:
    """Yield the fault of a cylinder whose pressure falls while its valve holds [I5]."""
    pressure_Pa = motion.pressure_Pa[:, j]
    rate_1_s = np.diff(np.log(np.maximum(pressure_Pa, 1.0))) / motion.step_s
    settled = _settled(motion.magnets[:, j] == HOLDING, round(SETTLED_S / motion.step_s))
    held = settled[1:] & (pressure_Pa[1:] > BRAKED_PA)
    if held.sum() * motion.step_s > HELD_S and np.median(rate_1_s[held]) < -LEAK_1_S:
        yield "cylinder_leak"


def _ripple(motion: _Motion, j: int) -> Iterator[str]:
    """Yield the fault of a motor whose torque has a line in its spectrum [I6]."""
    angle_rad = motion.angle_rad[:, j]
    if np.ptp(angle_rad) <= LEAST_ANGLE_RAD:
        return
    if _highest_line(motion.torque_Nm[:, j], angle_rad) > LINE_FACTOR:
        yield "torque_ripple"


def _longest(true: np.ndarray) -> int:
    """Return the number of samples in the longest stretch that is true."""
    # a stretch lies between two samples that are false; both ends count as false
    false_at = np.flatnonzero(np.concatenate([[True], ~true, [True]]))
    return int(np.diff(false_at).max()) - 1


def _settled(true: np.ndarray, samples: int) -> np.ndarray:
    """Return where the values have been true for a number of samples, bool (n,)."""
    true_among_last = np.convolve(true, np.ones(samples))[: true.size]
    return true_among_last > samples - 0.5


def _highest_line(torque_Nm: np.ndarray, angle_rad: np.ndarray) -> float:
    """Return the highest line of the spectrum of a torque over the angle, in levels around it."""
    even_rad = np.arange(angle_rad[0], angle_rad[-1], np.pi / HIGHEST_ORDER)
    torque_even_Nm = np.interp(even_rad, angle_rad, torque_Nm)
    amplitudes = np.abs(np.fft.rfft(np.hanning(even_rad.size) * torque_even_Nm))
    # the lowest twentieth of the spectrum holds the course of the stop
    amplitudes = amplitudes[(even_rad.size // 2 + 1) // 20 :]
    # the level leaves out the five highest values: the line with its neighbours
    level = gaussian_filter1d(np.sort(amplitudes)[:-5], 20.0).mean()
    return float(np.max(amplitudes / np.maximum(level, 1e-9), initial=0.0))


# --- pairs of axles, and sanders ---


def _swapped(motion: _Motion) -> Iterator[str]:
    """Yield the fault of an axle whose speed follows the brake of another axle [I2]."""
    step_s = motion.step_s
    smooth_rad_s = gaussian_filter1d(motion.wheel_rad_s, SMOOTHING_S / step_s, axis=0)
    acceleration = np.gradient(smooth_rad_s, step_s, axis=0)
    # both without their slow changes
    quick = acceleration - gaussian_filter1d(acceleration, QUICK_S / step_s, axis=0)
    pressure_Pa = motion.pressure_Pa
    releases = gaussian_filter1d(pressure_Pa, QUICK_S / step_s, axis=0) - pressure_Pa
    # a constant channel has no correlation
    if np.any(quick.std(axis=0) < 1e-9) or np.any(releases.std(axis=0) < 1e-9):
        return
    # a row for each wheel, a column for each brake
    axles = quick.shape[1]
    together = np.corrcoef(quick.T, releases.T)[:axles, axles:]
    for j, k in enumerate(together.argmax(axis=1)):
        least = max(TOGETHER, together[j, j] + APART, together[k, k] + APART)
        if together[j, k] > least:
            yield f"swapped_axles axle={min(j, k) + 1} other={max(j, k) + 1}"


def _sanders(run: records.Run) -> Iterator[str]:
    """Yield the faults of scheduled sanders that give no sand, a wrong rate, or late sand [I7]."""
    settings = run.scenario["sanders"]
    time_s = run.column("time_s")
    active = (
        (time_s >= settings["from_s"])
        & (time_s <= settings["until_s"])
        & (run.column("vehicle_speed_m_s") > MOVES_M_S)
    )
    # a dose by the speed has no constant rate
    if not active.any() or settings["dose_kg_m"]:
        return
    active_s = time_s[active]
    delay_s = settings["hose_delay_s"]
    if not np.ptp(active_s) > SETTLED_DELAYS * delay_s:
        return

    # 0 means no sander
    axles = {int(settings["axle"]), int(settings["second_axle"])} - {0}
    for axle in sorted(axles):
        box_kg = run.column(f"sand_box_{axle}_kg")[active]
        rate_kg_s = run.column(f"sand_rate_{axle}_kg_s")[active]
        share = rate_kg_s[-1] / settings["rate_kg_s"]
        risen = np.argmax(rate_kg_s > RISEN_SHARE * rate_kg_s[-1])
        lag_s = active_s[risen] - active_s[0]
        if share < RATE_ERROR:
            kind = "sander_blocked" if box_kg[-1] else "sander_empty"
        elif lag_s > LATE_DELAYS * delay_s:
            kind = "sander_late"
        elif abs(share - 1.0) > RATE_ERROR:
            kind = "sander_wrong_orifice"
        else:
            continue
        # a box that became empty during the stop is no fault
        if bool(box_kg[1]) == bool(box_kg[-1]):
            yield f"{kind} axle={axle}"
