"""What the record of a stop tells of faults in sensors, valves and motors: each by a law that a sound rig keeps.

Only channels are read that the rig's nodes tell: speeds and pressures, energised magnets, torque and angle of the
roller motors, sand. The limits lie between what stops without faults show and what these do (chosen, on a few stops of
each): a single stop may show one that is not there. Where the bus tells of a fault, no law is asked of the motion.

    [I1] a wheel that turns never tells the same speed for long; one that is vented does not stand
    [I2] a wheel speeds up when its own brake gives way, not when another one's does
    [I3] the third differences of all speeds are about as large; those of a gap in the teeth are large now and then
    [I4] no magnet is energised all the time; who vents energises both; a wheel that slides far is vented
    [I5] in a cylinder that neither fills nor vents the pressure stays
    [I6] the torque of a motor has no line in the spectrum over the angle of its roller
    [I7] a sander that strews gives its rate behind the lag of its hose, while its box holds sand
"""

from collections.abc import Iterator

import numpy as np
from scipy.ndimage import gaussian_filter1d

from rollerrig.realtime.discover import bus_signs
from rollerrig.realtime.record import records
from rollerrig.wsp_interface import signals
from rollerrig.wsp_interface.magnets import HOLD_MAGNET, HOLDING, VENT_MAGNET
from rollerrig.wsp_interface.signals import AXLES

HELD_S, VENTED_S, SETTLED_S, KEPT_S, FAR_S = 1.5, 0.5, 0.12, 0.1, 8.0
MOVES_M_S, VENTED_PA, BRAKED_PA, FAR = 5.0, 0.2e5, 0.5e5, 0.15
NOISY, ROUGH_RAD_S, SELDOM, LINE, LEAK_1_S, TOGETHER, APART = 6.0, 0.1, 5.0, 110.0, 0.05, 0.5, 0.3
HIGHEST_ORDER, SETTLED, RISEN, FLAW, BEHIND = 12.0, 10.0, 0.63, 0.1, 3.0


def of(run: records.Run) -> list[str]:
    """The faults of the catalogue that a run shows, as 'NAME axle=2', but those and those axles that it was told of."""
    told = {
        word
        for fault in run.scenario.get("fault", ())
        for word in (fault["kind"], f"axle={fault.get('axle')}")
    }
    return [one for one in bus_signs.of(run) or _signs(run) if told.isdisjoint(one.split())]


def _signs(run: records.Run) -> Iterator[str]:
    at = np.flatnonzero(run.column("vehicle_speed_m_s") > MOVES_M_S)[1:]
    step_s = float(np.median(np.diff(run.column("time_s"))))

    def each(name: str) -> np.ndarray:
        return np.column_stack(
            [run.column(column)[at] for column in signals.columns(signals.BY_NAME[name])]
        )

    wheel, pressure, magnets = (
        each("measured_speed"),
        each("cylinder_pressure"),
        each("magnets").astype(int),
    )
    share = (
        1.0
        - run.scenario["vehicle"]["wheel_radius_m"]
        * wheel
        / run.column("vehicle_speed_m_s")[at, None]
    )
    rough = np.abs(np.diff(wheel, 3, axis=0))
    noisy = rough.mean(axis=0) > NOISY * (np.median(rough.mean(axis=0)) + ROUGH_RAD_S)
    torque, angle = each("motor_torque"), each("roller_angle")
    for j in range(AXLES):
        own, turning, axle = magnets[:, j], wheel[1:, j] > 0.0, f"axle={j + 1}"
        if _longest((np.diff(wheel[:, j]) == 0.0) & turning) * step_s > HELD_S:  # [I1]
            yield f"speed_sensor_stuck {axle}"
        if _longest((wheel[:, j] == 0.0) & (pressure[:, j] < VENTED_PA)) * step_s > VENTED_S:
            yield f"speed_sensor_dropout {axle}"
        if noisy[j]:  # [I3]
            seldom = rough[:, j].mean() > SELDOM * np.median(rough[:, j])
            yield f"{'missing_tooth' if seldom else 'speed_noise_burst'} {axle}"
        if (own & VENT_MAGNET).all():  # [I4]
            yield f"vent_magnet_stuck {axle}"
        elif (own & HOLD_MAGNET).all():
            yield f"hold_magnet_stuck {axle}"
        elif (own == VENT_MAGNET).any():
            yield f"hold_magnet_dead {axle}"
        elif not (own & VENT_MAGNET).any() and _longest(share[:, j] > FAR) * step_s > FAR_S:
            yield f"vent_magnet_dead {axle}"
        rate = np.diff(np.log(np.maximum(pressure[:, j], 1.0))) / step_s
        kept = _settled(own == HOLDING, round(SETTLED_S / step_s))[1:] & (
            pressure[1:, j] > BRAKED_PA
        )
        if kept.sum() * step_s > KEPT_S and np.median(rate[kept]) < -LEAK_1_S:  # [I5]
            yield f"cylinder_leak {axle}"
        if np.ptp(angle[:, j]) > 1.0 and _line(torque[:, j], angle[:, j]) > LINE:  # [I6]
            yield f"torque_ripple {axle}"
    yield from _swapped(wheel, pressure, step_s)
    yield from _sanders(run)


def _longest(true: np.ndarray) -> int:
    """Samples of the longest stretch that is true."""
    return int(np.diff(np.flatnonzero(np.concatenate([[True], ~true, [True]]))).max()) - 1


def _settled(true: np.ndarray, samples: int) -> np.ndarray:
    """Where something has been true for so many samples."""
    return np.convolve(true, np.ones(samples))[: true.size] > samples - 0.5


def _line(torque: np.ndarray, angle: np.ndarray) -> float:
    """Highest line of the spectrum of a motor's torque over the angle of its roller, over its neighbourhood."""
    even = np.arange(angle[0], angle[-1], np.pi / HIGHEST_ORDER)
    power = np.abs(np.fft.rfft(np.hanning(even.size) * np.interp(even, angle, torque)))[
        (even.size // 2 + 1) // 20 :
    ]
    return float(
        np.max(
            power / np.maximum(gaussian_filter1d(np.sort(power)[:-5], 20.0).mean(), 1e-9),
            initial=0.0,
        )
    )


def _swapped(wheel: np.ndarray, pressure: np.ndarray, step_s: float) -> Iterator[str]:
    """Axles of which one tells how the other's brake gives way, and that one not its own's [I2]."""
    speeds_up = np.gradient(gaussian_filter1d(wheel, 0.05 / step_s, axis=0), step_s, axis=0)
    gives_way = gaussian_filter1d(pressure, 1.0 / step_s, axis=0) - pressure
    quick = speeds_up - gaussian_filter1d(speeds_up, 1.0 / step_s, axis=0)
    if np.any(quick.std(axis=0) < 1e-9) or np.any(gives_way.std(axis=0) < 1e-9):
        return
    together = np.corrcoef(quick.T, gives_way.T)[:AXLES, AXLES:]
    for j, k in enumerate(together.argmax(axis=1)):
        if together[j, k] > max(TOGETHER, together[j, j] + APART, together[k, k] + APART):
            yield f"swapped_axles axle={min(j, k) + 1} other={max(j, k) + 1}"


def _sanders(run: records.Run) -> Iterator[str]:
    """Sanders that strew by the schedule and give no sand, another rate, or late [I7]."""
    given, time_s = run.scenario["sanders"], run.column("time_s")
    at = (
        (time_s >= given["from_s"])
        & (time_s <= given["until_s"])
        & (run.column("vehicle_speed_m_s") > MOVES_M_S)
    )
    long = (
        np.ptp(time_s[at]) > SETTLED * given["hose_delay_s"]
        if at.any() and not given["dose_kg_m"]
        else False
    )
    for axle in {int(given["axle"]), int(given["second_axle"])} - {0} if long else ():
        box, rate = run.column(f"sand_box_{axle}_kg")[at], run.column(f"sand_rate_{axle}_kg_s")[at]
        share = rate[-1] / given["rate_kg_s"]
        late_s = time_s[at][np.argmax(rate > RISEN * rate[-1])] - time_s[at][0]
        what = (
            ("blocked" if box[-1] else "empty")
            if share < FLAW
            else "late"
            if (late_s > BEHIND * given["hose_delay_s"])
            else "wrong_orifice"
            if abs(share - 1.0) > FLAW
            else ""
        )
        if what and bool(box[1]) == bool(box[-1]):  # else it has run out on the way
            yield f"sander_{what} axle={axle}"
