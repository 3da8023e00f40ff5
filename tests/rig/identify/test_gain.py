"""The interval of a gain holds the true reduction of an error about as often as it states."""

import numpy as np

from rollerrig.rig.identify.decide import gain, thresholds

STEP_S = 0.1
BLOCKS = 60
TRIES = 100
TRUE_REDUCTION = 0.2


def test_the_interval_of_a_gain_holds_the_true_reduction():
    rng = np.random.default_rng(5)
    samples = int(thresholds.BLOCK_S / STEP_S)
    held = 0
    for seed in range(TRIES):
        # the errors of a block are alike, and those before and after do not depend on each other
        deviation = np.repeat(rng.uniform(0.5, 1.5, (2, BLOCKS)), samples, axis=1)
        errors = deviation * rng.normal(size=deviation.shape)
        errors[1] *= 1.0 - TRUE_REDUCTION
        low, high = gain._interval(errors**2, np.array([errors.shape[1]]), STEP_S, seed)
        held += low <= TRUE_REDUCTION <= high
    assert 88 <= held <= 99
