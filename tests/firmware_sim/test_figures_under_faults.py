"""A sequence is judged by the true motion, whatever sensors and nodes of the rig show.

One sequence has every fault of the catalogue in turn. Its figures must be those of the recording,
as if no sensor had been faulty.
"""

import json
import math
from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from faulty_run import PLAN

from rollerrig.configs.vehicle import COACH
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import records
from rollerrig.realtime.reports import sequences, stop
from rollerrig.wsp_interface import harness_client, signals
from rollerrig.wsp_interface.sequences import measures, play, sequence

TABLE = signals.table(COACH)
HEAD = """title = "A stop on soap during which every fault of the catalogue occurs"

[start]
speed = "36 km/h"
adhesion = "soap"
[start.tables.sanders]
axle = 1
second_axle = 2
from_s = 0.0

[[measure]]
measure = "sliding_max"
unit = "m/s"
max = 1.0
source = "assumption"

[[measure]]
measure = "sliding_mean"
unit = "m/s"
max = 1.0
source = "assumption"

[[step]]
set = { brake_demand = "1 bar" }
"""
END = """
[[step]]
set = { brake_demand = "3.8 bar" }
until = "vehicle_speed < 0.005 m/s"
timeout = "60 s"
"""


def sequence_text():
    """Return the sequence: each fault of the plan begins at its time and lasts as long as there."""
    text = HEAD
    for begin_s, rows in groupby(sorted(PLAN, key=lambda row: row[1]), key=lambda row: row[1]):
        faults = []
        for kind, _, end_s, values in rows:
            parameters = " ".join(f"{name}={value}" for name, value in values.items())
            faults.append(f"{kind} {parameters} for={end_s - begin_s:.3f}")
        text += f'\n[[step]]\nat = "{begin_s} s"\nfault = {json.dumps(faults)}\n'
    return text + END


class Played:
    """The sequence that was played: its outcome and report, and the recording of its bench."""

    def __init__(self, folder):
        path = folder / "faults.toml"
        path.write_text(sequence_text(), encoding="utf-8")
        self.outcome = play.on_own_bench(sequence.load(path, catalogue.parse), folder / "run")
        assert self.outcome.error == ""
        self.run = records.load(folder / "run")
        self.recorded_s = np.round(self.run.column("time_s"), 6)
        # the last row of the harness may be later than the last recorded sample
        heard_s = np.round(self.outcome.record.columns["time_s"], 6)
        both = heard_s <= self.recorded_s[-1]
        columns = {name: heard[both] for name, heard in self.outcome.record.columns.items()}
        self.record = replace(self.outcome.record, columns=columns)
        sequences.write([self.outcome], folder / "report")
        report = json.loads((folder / "report" / sequences.JSON).read_text(encoding="utf-8"))
        (self.report,) = report["sequences"]

    def true_column(self, name):
        """Return a recorded channel at the times of the harness; sensors measure what is true."""
        heard_s = np.round(self.record.columns["time_s"], 6)
        rows = np.searchsorted(self.recorded_s, heard_s)
        assert np.array_equal(self.recorded_s[rows], heard_s)
        return self.run.column(name.replace("measured_speed", "wheel_speed"))[rows]

    @property
    def true_record(self):
        """The record of a harness that reads the recording."""
        columns = {name: self.true_column(name) for name in self.record.columns}
        finals = {}
        for name, heard in self.record.finals.items():
            # play reads the loads before the first step, and everything else after the last one
            at = 0 if name == "wheel_load" else -1
            names = signals.columns(TABLE.by_name[name])
            assert len(names) == len(heard)
            finals[name] = tuple(self.run.column(column)[at] for column in names)
        return replace(self.record, columns=columns, finals=finals)


@pytest.fixture(scope="module")
def played(tmp_path_factory):
    return Played(tmp_path_factory.mktemp("figures"))


@pytest.mark.parametrize("kind", list(catalogue.of(COACH)))
def test_a_harness_receives_the_true_motion_while_a_fault_acts(played, kind):
    ((begin_s, end_s),) = [row[1:3] for row in PLAN if row[0] == kind]
    time_s = played.record.columns["time_s"]
    acts = (time_s >= begin_s) & (time_s < end_s)
    assert acts.sum() > 10
    for layout in harness_client.reception(TABLE).mapped:
        for name, count in zip(layout.names, layout.scales, strict=True):
            heard = played.record.columns[name][acts]
            true = played.true_column(name)[acts]
            np.testing.assert_allclose(heard, true, rtol=0.0, atol=0.501 * count, err_msg=name)


@pytest.mark.parametrize("name", [one.name for one in measures.of_kind(is_train=False)])
def test_every_figure_of_a_report_is_that_of_the_true_motion(played, name):
    measure = measures.BY_NAME[name]
    true = float(measure.of(played.true_record))
    if math.isfinite(true):
        # to the counts in which the bus carries speeds and the others; a count may pass a limit a
        # cycle later
        counts = {"m/s": 0.003, "kg": 0.006, "s": 0.0101}.get(measure.unit, 1e-4)
        assert played.report["figures"][name] == pytest.approx(true, rel=1e-3, abs=counts)
    else:
        assert name not in played.report["figures"]
    for line in played.report["verdicts"]:
        if line["what"] == name:
            assert line["value"] == played.report["figures"][name]


def test_the_table_of_axles_has_the_true_motion_and_separately_the_measured_one(played):
    head, rows, _ = stop.axles(played.record)
    true_rows = stop.axles(played.true_record)[1]
    assert [row[0] for row in rows] == [str(axle) for axle in TABLE.axles] + [
        f"{axle}, as measured" for axle in TABLE.axles
    ]
    for axle in TABLE.axles:
        for name, shown, true in zip(head, rows[axle - 1], true_rows[axle - 1], strict=True):
            one_digit = 10.0 ** -len(true.partition(".")[2])
            assert float(shown) == pytest.approx(float(true), abs=1.001 * one_digit), name
    # for the sensor of axle 2 the wheelset stood for a while
    largest_m_s = head.index("largest, m/s")
    true, measured = rows[1], rows[COACH.axles + 1]
    assert float(measured[largest_m_s]) > float(true[largest_m_s]) + 1.4


def test_the_report_marks_the_sliding_that_sensors_measured(played):
    measured = played.report["measured"]
    true = played.report["figures"]
    assert set(measured) == {"sliding_max", "sliding_mean"}
    assert measured["sliding_max"] > true["sliding_max"] + 1.0


def test_the_summary_of_the_run_has_the_same_largest_sliding(played):
    of_axles = [axle["sliding_max_m_s"] for axle in played.run.summary["axles"]]
    assert played.report["figures"]["sliding_max"] == pytest.approx(max(of_axles), abs=3e-3)
