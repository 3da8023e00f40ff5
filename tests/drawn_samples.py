"""Reads what a recording for Rerun draws."""

from typing import Any, NamedTuple

import numpy as np
from rerun.chunk import RrdReader

from rollerrig.realtime.telemetry import views


class Sample(NamedTuple):
    """A value of a component; Rerun returns each value as a list."""

    time_s: float
    value: Any


def entities(path):
    """Return the samples of each component of each entity in a .rrd file, in the order of time.

    The result is a dict of dicts: path of the entity -> name of the component -> samples. Static
    data have no time and are left out.
    """
    samples_of = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        times_s = np.array(batch[views.TIMELINE].cast("int64").to_pylist()) / 1e9
        components = samples_of.setdefault(str(chunk.entity_path), {})
        for name in batch.schema.names:
            # the names of components have a colon, those of timelines do not
            if ":" not in name:
                continue
            samples = components.setdefault(name, [])
            for time_s, value in zip(times_s, batch[name].to_pylist(), strict=True):
                samples.append(Sample(time_s, value))

    for components in samples_of.values():
        for samples in components.values():
            samples.sort(key=lambda sample: sample.time_s)
    return samples_of
