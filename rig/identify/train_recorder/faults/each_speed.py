"""Makes a check of a run from a check of one speed."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from rollerrig.rig.identify.train_recorder import sampling
from rollerrig.rig.identify.train_recorder.findings import Details, Finding
from rollerrig.rig.identify.train_recorder.recording import Channel, Run
from rollerrig.rig.identify.train_recorder.sampling import Stretch


class Hit(NamedTuple):
    """What a check of one channel finds: name, first and last sample, details."""

    name: str
    first: int
    last: int
    details: Details | None


def others(run: Run, channel: Channel) -> np.ndarray:
    """Return the median of the other speeds at the stamps of one channel; NaN without any."""
    others = [
        sampling.at(other, channel.time_s)
        for other in run.of(*sampling.SPEEDS)
        if other.name != channel.name
    ]
    if not others:
        return np.full(channel.time_s.size, np.nan)
    return sampling.median(np.array(others))


def each_speed(
    check: Callable[[Run, Channel], Iterator[Hit]],
) -> Callable[[Run], tuple[Run, list[Finding]]]:
    """Make a check of a run from a check of one channel; it runs on one speed after another."""

    def checked(run: Run) -> tuple[Run, list[Finding]]:
        found = []
        for channel in run.of(*sampling.SPEEDS):
            parts = []
            for hit in check(run, channel):
                part = Stretch(hit.first, hit.last)
                parts.append(part)
                found.append(
                    sampling.lasting(hit.name, channel, (channel.name,), run, part, hit.details)
                )
            run = sampling.replaced(run, [sampling.without(channel, parts)])
        return run, found

    return checked
