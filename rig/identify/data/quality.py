"""Checks measured runs: refuses data that allows no conclusion, warns of data that allows few.

The checks concern units, signs, sample times, gaps, excitation and copies. Each message names the
file, the value with its unit, what is allowed, and how to correct the data.
"""

from collections.abc import Mapping
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify.data import units
from rollerrig.rig.identify.data.runs import Dataset, Run

# samples of a stop: 2 s at 100 Hz. Fewer hold no slide and its recovery.
LEAST_SAMPLES = 200
# A stop in which no wheelset slides by more than LEAST_SLIDING_M_S, as a mean over LEAST_SLIDING_S
# of its strongest sliding, has no information about adhesion. The rest of the run does not count.
LEAST_SLIDING_M_S = 0.15
LEAST_SLIDING_S = 2.0
LONGEST_HELD_S = 1.0  # a wheel speed that stays the same for longer is that of a stuck sensor

# sample times, as shares of sample_time_s
LARGEST_STEP_ERROR = 0.1  # of the typical step
LARGEST_STEP = 1.5  # a longer step is a gap
LARGEST_UNEVENNESS = 0.15  # of a step against the typical one
MOST_UNEVEN_STEPS = 0.01  # share of the samples
LARGEST_DRIFT = 0.003  # of the mean step
# Largest shift of the earliest stamps of a stretch of so many samples, as a share of sample_time_s
STAMPS_PER_STRETCH = 100
LARGEST_SHIFT = 0.5

SPEEDS_M_S = (1.0, 150.0)  # the largest speed of a run must lie between these
MOST_REPEATED_SAMPLES = 0.4  # share of a wheel speed's samples that equal the one before
LEAST_SPEED_LOSS_M_S = 2.0
COPIED_SAMPLES = 50  # length of the piece that is compared between two runs


def check_run(run: Run, path: Path, dataset: Dataset, initial_speed_m_s: float) -> None:
    """Check one run; add warnings to the dataset. Raises ConfigError."""
    vehicle = dataset.sections["vehicle"]
    _check_time(run, path, dataset.sample_time_s)
    _check_constant(run, path)
    _check_forwards(run, path)
    units.check_rolling(run, path, vehicle["wheel_radius_m"])
    _check_speed(run, path, initial_speed_m_s)
    _check_signs(run, path)
    units.check(run, path, vehicle, dataset.warnings)
    _check_sliding(run, path, vehicle, dataset.warnings)
    _check_held(run, path, dataset.warnings)


def lateness_s(time_s: np.ndarray, sample_time_s: float) -> float | None:
    """Return by how much stamps of even samples are late at most, s; None if rows are missing.

    Stamps of a computer are late by what it takes to read a sample, and never early. A row that is
    missing shifts the earliest stamps of all later stretches by a whole sample.
    """
    late_s = time_s - sample_time_s * np.arange(time_s.size)
    stretches = np.array_split(late_s, max(time_s.size // STAMPS_PER_STRETCH, 2))
    earliest_s = np.array([part.min() for part in stretches])
    if np.ptp(earliest_s) > LARGEST_SHIFT * sample_time_s:
        return None
    return float(np.max(late_s - earliest_s.min()))


def even_stamps(time_s: np.ndarray, path: Path, sample_time_s: float) -> np.ndarray:
    """Return the stamps of even samples whose recorded stamps are late.

    Raises ConfigError if rows are missing.
    """
    if lateness_s(time_s, sample_time_s) is None:
        raise ConfigError(
            f'{path}: stamps = "even", but rows are missing: {time_s.size} rows last '
            f"{time_s[-1] - time_s[0]:.4g} s, and sample_time_s = {sample_time_s:g}; split the run where "
            "rows are missing, or correct sample_time_s"
        )
    late_s = time_s - sample_time_s * np.arange(time_s.size)
    return float(late_s.min()) + sample_time_s * np.arange(time_s.size)


def _check_late(run: Run, path: Path, sample_time_s: float) -> None:
    """Raise ConfigError if the stamps are late and the samples are even."""
    late_s = lateness_s(run.time_s, sample_time_s)
    if late_s is not None:
        n = run.time_s.size
        raise ConfigError(
            f"{path}: time_s is not even: stamps are up to {late_s:.2g} s late, but no row is missing, "
            f"since {n} rows of {sample_time_s:g} s are the duration. If the samples were taken by an even "
            'clock, write stamps = "even" at the top of dataset.toml, and do not resample them; if they '
            "were taken at these stamps, resample with a low-pass filter, not by straight lines"
        )


def _check_time(run: Run, path: Path, sample_time_s: float) -> None:
    """Raise ConfigError unless the samples are those of one even clock of `sample_time_s`."""
    n = run.time_s.size
    if n < LEAST_SAMPLES:
        raise ConfigError(
            f"{path}: {n} samples; a stop needs at least {LEAST_SAMPLES}; give a longer recording"
        )
    steps_s = np.diff(run.time_s)

    if np.any(steps_s <= 0.0):
        at = int(np.argmax(steps_s <= 0.0))
        how = "stands still" if steps_s[at] == 0.0 else "goes back"
        # row 1 of the file is its header, and the step leads to the sample after `at`
        raise ConfigError(
            f"{path}: time_s {how} at row {at + 3} ({run.time_s[at]:g} s, then "
            f"{run.time_s[at + 1]:g} s); sort the rows and remove repeated ones"
        )

    typical_s = float(np.median(steps_s))
    if abs(typical_s - sample_time_s) > LARGEST_STEP_ERROR * sample_time_s:
        remedy = "correct one of them"
        if abs(typical_s / sample_time_s / 1000.0 - 1.0) < 0.1:
            remedy = "time_s is in milliseconds: divide it by 1000"
        raise ConfigError(
            f"{path}: samples are {typical_s:.6g} s apart, but dataset.toml has "
            f"sample_time_s = {sample_time_s:g}; {remedy}"
        )

    gaps = np.flatnonzero(steps_s > LARGEST_STEP * sample_time_s)
    uneven = np.flatnonzero(np.abs(steps_s - typical_s) > LARGEST_UNEVENNESS * sample_time_s)
    if gaps.size or uneven.size > MOST_UNEVEN_STEPS * n:
        _check_late(run, path, sample_time_s)
    if gaps.size:
        raise ConfigError(
            f"{path}: {gaps.size} gaps, the first of {steps_s[gaps[0]]:.4g} s after "
            f"t = {run.time_s[gaps[0]]:.4g} s; split the run there into two, and do not fill the gap"
        )

    if uneven.size > MOST_UNEVEN_STEPS * n:
        raise ConfigError(
            f"{path}: time_s is not even: steps are {steps_s.min():.4g} to {steps_s.max():.4g} s, but "
            f"sample_time_s = {sample_time_s:g}; the samples must be those of one clock: resample "
            "with a low-pass filter, not by straight lines"
        )

    duration_s = run.time_s[-1] - run.time_s[0]
    mean_s = float(duration_s) / (n - 1)
    if abs(mean_s - sample_time_s) > LARGEST_DRIFT * sample_time_s:
        raise ConfigError(
            f"{path}: {n} samples last {duration_s:.6g} s, which is {mean_s:.6g} s each, but "
            f"dataset.toml has sample_time_s = {sample_time_s:g}: the clock drifts; correct time_s "
            "or sample_time_s"
        )


def _check_constant(run: Run, path: Path) -> None:
    """Raise ConfigError where a channel never changes."""
    for name, values in (
        ("vehicle_speed_m_s", run.speed_m_s[:, None]),
        ("wheel_speed_rad_s", run.wheel_speed_rad_s),
        ("brake_torque_Nm", run.torque_Nm),
    ):
        for j in range(values.shape[1]):
            if np.ptp(values[:, j]) < 1e-9:
                raise ConfigError(
                    f"{path}: {name} of channel {j + 1} is constant ({values[0, j]:g}); a channel "
                    "that never changes cannot be used: give measured values"
                )


def _check_speed(run: Run, path: Path, initial_m_s: float) -> None:
    """Raise ConfigError where the vehicle's speed is not in m/s."""
    top_m_s = float(np.max(run.speed_m_s))
    low_m_s, high_m_s = SPEEDS_M_S
    if not low_m_s < top_m_s < high_m_s:
        raise ConfigError(
            f"{path}: vehicle_speed_m_s reaches {top_m_s:.4g}; {low_m_s:g} to {high_m_s:g} m/s are "
            "allowed: is it in another unit?"
        )
    first_m_s = np.median(run.speed_m_s[:20])
    if initial_m_s > 0 and abs(first_m_s - initial_m_s) > max(2.0, 0.1 * initial_m_s):
        raise ConfigError(
            f"{path}: starts at {first_m_s:.4g} m/s, but dataset.toml has "
            f"initial_speed_m_s = {initial_m_s:g}; is vehicle_speed_m_s in km/h?"
        )


def _check_signs(run: Run, path: Path) -> None:
    """Raise ConfigError where a brake torque has the wrong sign."""
    mean_Nm = np.mean(run.torque_Nm)
    if mean_Nm < 0.0:
        raise ConfigError(
            f"{path}: the mean brake torque is {mean_Nm:.4g} N m; braking torque is positive: change "
            "its sign"
        )
    largest_Nm = np.max(np.abs(run.torque_Nm))
    for j in range(run.torque_Nm.shape[1]):
        if np.mean(run.torque_Nm[:, j]) < -0.1 * largest_Nm:
            raise ConfigError(
                f"{path}: the mean of brake_torque_{j + 1}_Nm is negative, those of the other "
                "wheelsets are not: change its sign"
            )


def _check_forwards(run: Run, path: Path) -> None:
    """Raise ConfigError where a wheel turns backwards at the start."""
    for j in range(run.wheel_speed_rad_s.shape[1]):
        if np.median(run.wheel_speed_rad_s[:50, j]) < 0.0:
            raise ConfigError(
                f"{path}: wheel_speed_{j + 1}_rad_s is negative; wheels that turn forwards have "
                "positive speed: change its sign"
            )


def _check_sliding(run: Run, path: Path, vehicle: Mapping[str, Any], warnings: list[str]) -> None:
    """Raise ConfigError where wheels turn faster than the vehicle; warns where little slides."""
    sliding_m_s = run.speed_m_s[:, None] - vehicle["wheel_radius_m"] * run.wheel_speed_rad_s
    mean_m_s = np.mean(sliding_m_s)
    if mean_m_s < -0.2:
        raise ConfigError(
            f"{path}: the mean sliding is {mean_m_s:.3g} m/s; speed - radius x wheel speed is "
            "positive in braking: check radius and channels"
        )

    still = np.flatnonzero(_strongest_sliding_m_s(run, vehicle) < LEAST_SLIDING_M_S) + 1
    if still.size:
        warnings.append(
            f"{path.name}: wheelset {', '.join(map(str, still))} hardly slides; this run has little information "
            "about its friction"
        )

    lost_m_s = float(run.speed_m_s[0] - run.speed_m_s[-1])
    if lost_m_s < LEAST_SPEED_LOSS_M_S and np.isfinite(run.mass_kg):
        warnings.append(f"{path.name}: the speed decreases by only {lost_m_s:.3g} m/s")


def _strongest_sliding_m_s(run: Run, vehicle: Mapping[str, Any]) -> np.ndarray:
    """Return the mean sliding of each wheelset over the LEAST_SLIDING_S of its strongest sliding.

    m/s, shape (axles,). These samples need not follow one another. Running means over a tenth of
    this time keep noise out.
    """
    sliding_m_s = run.speed_m_s[:, None] - vehicle["wheel_radius_m"] * run.wheel_speed_rad_s
    step_s = float(np.median(np.diff(run.time_s)))
    samples = min(max(round(LEAST_SLIDING_S / step_s), 1), run.time_s.size)
    window = max(samples // 10, 1)
    kernel = np.full(window, 1.0 / window)
    strongest = []
    for of_wheelset in sliding_m_s.T:
        smooth = np.abs(np.convolve(of_wheelset, kernel, "same"))
        strongest.append(float(np.sort(smooth)[-samples:].mean()))
    return np.array(strongest)


def _check_held(run: Run, path: Path, warnings: list[str]) -> None:
    """Check for wheel speeds that repeat their samples: a stuck sensor, or a lower sample rate.

    Raises ConfigError for a stuck sensor and warns of a lower sample rate.
    """
    moves = (run.speed_m_s > 5.0)[1:]
    if not np.any(moves):
        return
    step_s = float(run.time_s[1] - run.time_s[0])
    for j in range(run.wheel_speed_rad_s.shape[1]):
        wheel_rad_s = run.wheel_speed_rad_s[:, j]
        repeated = (np.diff(wheel_rad_s) == 0.0) & (wheel_rad_s[1:] > 0.0) & moves

        longest_s = _longest_held_s(run, j, repeated, step_s)
        if longest_s > LONGEST_HELD_S:
            raise ConfigError(
                f"{path}: wheel_speed_{j + 1}_rad_s stays the same for {longest_s:.3g} s while the "
                f"vehicle runs; {LONGEST_HELD_S:g} s are allowed: the sensor was stuck: split the run "
                "there"
            )
        share = np.mean(repeated[moves])
        if share > MOST_REPEATED_SAMPLES:
            warnings.append(
                f"{path.name}: {100 * share:.0f} % of the samples of wheel_speed_{j + 1}_rad_s repeat "
                "the one before: its sample rate is lower than that of the file, or it is rounded; "
                "delays cannot be judged"
            )


def _longest_held_s(run: Run, axle: int, repeated: np.ndarray, step_s: float) -> float:
    """Return the longest time for which a wheel speed stays the same although the vehicle slows.

    `repeated` (n - 1,) is where a sample repeats the one before. Counted pulses stay the same as
    long as the speed changes by less than their quantum, so such a stretch does not count.
    """
    wheel_rad_s = run.wheel_speed_rad_s[:, axle]
    values = np.unique(wheel_rad_s)
    quantum_rad_s = float(np.min(np.diff(values))) if values.size > 1 else 0.0

    changes = np.concatenate([[-1], np.flatnonzero(~repeated), [repeated.size]])
    longest_s = 0.0
    for before, after in pairwise(changes.tolist()):
        # the samples from first to last are the same
        first, last = before + 1, after
        held_s = (last - first) * step_s
        if held_s <= longest_s:
            continue
        change_m_s = abs(run.speed_m_s[first] - run.speed_m_s[last])
        change_rad_s = change_m_s / run.speed_m_s[first] * wheel_rad_s[first]
        if change_rad_s >= quantum_rad_s:
            longest_s = held_s
    return longest_s


def check(dataset: Dataset, where: str) -> None:
    """Check a dataset as a whole; add warnings to it. Raises ConfigError."""
    if not dataset.runs:
        raise ConfigError(f"{where}: no [[run]]; name at least two files")
    tune = dataset.group("tune")
    if not tune:
        raise ConfigError(
            f'{where}: no run has group = "tune", so nothing can be fitted; mark the runs to fit'
        )
    units.check_clocks(dataset.runs, where, dataset.sections["vehicle"])

    for first, second in combinations(dataset.runs, 2):
        if _has_piece_of(first, second):
            raise ConfigError(
                f"{where}: runs '{first.name}' and '{second.name}' have the same samples; a copy has "
                "no new information and cannot validate: remove one"
            )

    vehicle = dataset.sections["vehicle"]
    largest_m_s = max(float(_strongest_sliding_m_s(run, vehicle).max()) for run in tune)
    if largest_m_s < LEAST_SLIDING_M_S:
        raise ConfigError(
            f"{where}: the wheels hardly slide (mean {largest_m_s:.3g} m/s over the "
            f"{LEAST_SLIDING_S:g} s of strongest sliding of the best wheelset, "
            f"{LEAST_SLIDING_M_S} m/s are needed): adhesion was never exhausted, so it cannot be "
            "judged; brake harder or on a slippery rail"
        )

    if len(tune) < 2:
        dataset.warnings.append(
            "only one run is fitted: a cause that is seen in a single run is not reported"
        )
    if not dataset.group("validate"):
        dataset.warnings.append('no run has group = "validate": no gain can be claimed')


def _has_piece_of(first: Run, second: Run) -> bool:
    """Return whether a piece from the middle of one run is in another run.

    The piece is compared by the speed of the first wheelset and by that of the vehicle.
    """
    middle = first.time_s.size // 2
    for values, others in (
        (first.wheel_speed_rad_s[:, 0], second.wheel_speed_rad_s[:, 0]),
        (first.speed_m_s, second.speed_m_s),
    ):
        piece = values[middle : middle + COPIED_SAMPLES]
        last_start = max(others.size - COPIED_SAMPLES, 0)
        starts = np.flatnonzero(others[:last_start] == piece[0])
        if any(np.array_equal(others[at : at + COPIED_SAMPLES], piece) for at in starts):
            return True
    return False
