"""Plays a sequence on a bench through a harness, and keeps what was measured whatever happens.

Each step is a check: its `until` was reached in time, its `expect`ations held at its end. A bench
that vanishes, a refused fault, a full disk end in the verdict "error"; the rows up to then are
written beside the run as `harness.csv`, or into the temporary folder where the disk is full.
"""

import csv
import math
import tempfile
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.errors import BusError, RollerrigError, UnitError
from rollerrig.wsp_interface import own_bench
from rollerrig.wsp_interface.harness_client import COLUMNS, Event, Harness, TimeOutError
from rollerrig.wsp_interface.sequences import verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.sequences.measures import Record
from rollerrig.wsp_interface.sequences.sequence import Sequence, Step
from rollerrig.wsp_interface.sequences.verdict import Result, Verdict

TRACE = "harness.csv"
SETTLED_S = 0.05
FINALS = ("longest_lock", "sliding_work", "vents", "air_consumption")
STEP_SOURCE = "the sequence"


@dataclass
class Outcome:
    """What became of a sequence: `result` is the worst of its verdicts, error where `error` is."""

    sequence: Sequence
    folder: Path
    verdicts: list[Verdict] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    record: Record | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    wall_s: float = 0.0

    @property
    def result(self) -> Result:
        """Error wherever something could not be measured, else the worst verdict."""
        if self.error:
            return Result.ERROR
        return verdict.worst([one.result for one in self.verdicts])


def on_own_bench(sequence: Sequence, folder: Path, pacing: str = "lockstep", seed: int = 0,
                 dry_m: Callable[[dict[str, Any], tuple[tuple[float, float], ...]], float] | None = None,
                 wsp: str = "", companions: tuple[own_bench.Companion, ...] = ()) -> Outcome:
    """Start a bench for the sequence, play it, and judge. Never raises for what a run can meet.

    `dry_m(scenario, demands)` gives the distance of the dry stop where a limit asks for it.
    """
    outcome = Outcome(sequence, folder)
    finals: dict[str, tuple[float, ...]] = {}
    harness = None
    try:
        with own_bench.start(folder, sequence.scenario, wsp=wsp or sequence.wsp, pacing=pacing,
                             seed=seed, initial_speed_m_s=sequence.speed_m_s,
                             adhesion=sequence.adhesion, tables=sequence.tables,
                             companions=companions) as bench:
            harness = bench.harness
            play(sequence, harness, outcome, finals)
        outcome.summary = own_bench.summary(folder)
        _check_record(outcome)
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    if harness is not None:
        _conclude(outcome, harness, finals, dry_m)
    return outcome


def on_running_bench(sequence: Sequence, harness: Harness, folder: Path, scenario: dict[str, Any],
                     dry_m: Callable[..., float] | None = None) -> Outcome:
    """Play a sequence on a bench that somebody else has started; `scenario` is the resolved one."""
    outcome = Outcome(sequence, folder)
    finals: dict[str, tuple[float, ...]] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with harness:
            _check_start(sequence, harness)
            play(sequence, harness, outcome, finals)
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    _conclude(outcome, harness, finals, dry_m, scenario)
    outcome.summary = heard(harness)
    return outcome


def heard(harness: Harness) -> dict[str, Any]:
    """What the bus tells of a bench's time: pacing, cycles, and cycles of which no row came.

    Missed ticks and lateness are the bench's own; its summary.json has them, the bus does not.
    """
    at = COLUMNS.index("time_s")
    times_s = np.array([row[at] for row in harness.trace])
    steps_s = np.diff(times_s[np.isfinite(times_s)])
    cycle_s = float(np.median(steps_s)) if steps_s.size else math.nan
    lost = int(np.maximum(np.rint(steps_s / cycle_s) - 1, 0).sum()) if steps_s.size else 0
    return {"pacing": "lockstep" if harness.lockstep else "wall",
            "over_the_bus": {"cycles": len(times_s), "cycle_s": cycle_s, "cycles_lost": lost}}


def _check_start(sequence: Sequence, harness: Harness) -> None:
    """A bench that runs already must be what the sequence wants, as far as the bus tells."""
    wanted, is_now = sequence.speed_m_s, harness.vehicle_speed_m_s
    if wanted is not None and abs(is_now - wanted) > 0.05 * wanted + 0.1:
        raise UnitError(f"pre-condition: the sequence begins at {wanted:.2f} m/s, the bench runs at "
                        f"{is_now:.2f} m/s; start it with initial_speed_m_s={wanted:.3f} and --harness")


def play(sequence: Sequence, harness: Harness, outcome: Outcome,
         finals: dict[str, tuple[float, ...]]) -> None:
    """Play every step. Raises BusError when the bench goes; a failed step ends the play."""
    finals["wheel_load"] = harness.read("wheel_load")
    for text in sequence.notes:
        harness.note(text)
    checks = outcome.verdicts
    checks += [_check("pre-condition", one, harness) for one in sequence.before]
    if all(one.result is Result.PASS for one in checks):
        for number, step in enumerate(sequence.steps, start=1):
            name = step.title or f"step {number}"
            try:
                _play_step(step, harness)
            except TimeOutError:
                text = step.until.text if step.until else ""
                checks.append(_line(name, f"{text} within {step.timeout_s:g} s", Result.FAIL,
                                    f"not reached at {harness.time_s:.2f} s; the sequence ends here"))
                break
            if step.until:
                checks.append(_line(name, step.until.text, Result.PASS, f"at {harness.time_s:.2f} s"))
            checks += [_check(name, one, harness) for one in step.expects]
        else:
            checks += [_check("post-condition", one, harness) for one in sequence.after]
    harness.wait(SETTLED_S)  # the record also gets the last rows
    for quantity in FINALS:
        finals[quantity] = harness.read(quantity)


def _play_step(step: Step, harness: Harness) -> None:
    if step.at_s is not None:
        harness.wait(step.at_s - harness.time_s)
    if step.title:
        harness.log("step", step.title)
    for text in step.notes:
        harness.note(text)
    if step.friction:
        harness.friction(step.friction.mu, step.friction.axles)
    for text in step.lifts:
        harness.lift(text)
    for text in step.faults:
        harness.inject(text)
    if step.brake_Pa is not None:
        harness.brake(step.brake_Pa)
        harness.log("harness", f"brake demand {step.brake_Pa / 1e5:g} bar")
    begin_s = harness.time_s
    if step.ramp:
        _ramp(step, harness)
    if step.for_s is not None:
        harness.wait(begin_s + step.for_s - harness.time_s)
    if step.until:
        until = step.until
        harness.until(lambda: until.holds(harness.values), step.timeout_s, step.hold_s)


def _ramp(step: Step, harness: Harness) -> None:
    """Move the demand evenly, one value a bus cycle."""
    assert step.ramp
    from_Pa = harness.demands[-1][1] if harness.demands else 0.0
    begin_s, to_Pa = harness.time_s, step.ramp.to_Pa
    harness.log("harness", f"brake demand to {to_Pa / 1e5:g} bar within {step.ramp.in_s:g} s")
    while (share := (harness.time_s - begin_s) / step.ramp.in_s) < 1.0:
        harness.brake(from_Pa + share * (to_Pa - from_Pa))
        harness.step()
    harness.brake(to_Pa)


def _check(name: str, condition: Condition, harness: Harness) -> Verdict:
    met = condition.holds(harness.values)
    return _line(name, condition.text, Result.PASS if met else Result.FAIL,
                 f"at {harness.time_s:.2f} s: {condition.readings(harness.values)}")


def _line(name: str, wanted: str, result: Result, text: str) -> Verdict:
    return Verdict(name, "", math.nan, wanted, math.nan, result, STEP_SOURCE, text)


# -- the end

def _check_record(outcome: Outcome) -> None:
    """A run whose record is not whole cannot be judged."""
    summary = outcome.summary
    lost = summary.get("recorder", {}).get("lost", 0)
    broken = [event["text"] for event in summary.get("events", [])
              if event["level"] == "error" and "recorder" in event["text"]]
    if summary.get("ended") not in ("finished", None):
        broken.append(f"the bench's run is {summary['ended']}")
    if lost or broken:
        raise BusError("; ".join([*broken, *([f"{lost} samples of the record are lost"] if lost else [])]))


def _conclude(outcome: Outcome, harness: Harness, finals: dict[str, tuple[float, ...]],
              dry_m: Callable[..., float] | None, scenario: dict[str, Any] | None = None) -> None:
    outcome.events = merged(harness.events, outcome.summary)
    try:
        keep(outcome.folder, harness)
    except OSError as error:
        outcome.error = outcome.error or f"{outcome.folder}: cannot be written: {error.strerror}"
    if outcome.error or not harness.trace:
        return
    try:
        outcome.record = record_of(outcome, harness, finals, scenario)
        asks = any(one.measure == "stop_distance_over_dry" for one in outcome.sequence.criteria.limits)
        if asks and dry_m:
            found = dry_m(dict(outcome.record.scenario), outcome.record.demands)
            outcome.record = replace(outcome.record, dry_m=found)
        outcome.verdicts += verdict.judge(outcome.sequence.criteria, outcome.record)
    except (RollerrigError, OSError, KeyError) as error:
        outcome.error = f"the run cannot be judged: {error}"


def record_of(outcome: Outcome, harness: Harness, finals: dict[str, tuple[float, ...]],
              scenario: dict[str, Any] | None = None) -> Record:
    """What the measures are computed from."""
    if scenario is None:
        scenario = tomllib.loads((outcome.folder / "scenario.toml").read_text(encoding="utf-8"))
    table = np.array(harness.trace)
    faults = [event.time_s for event in harness.events
              if event.who == "harness" and event.text.startswith("fault ")]
    return Record({name: table[:, at] for at, name in enumerate(COLUMNS)}, tuple(harness.demands),
                  finals, scenario, fault_s=faults[0] if faults else math.nan)


def keep(folder: Path, harness: Harness) -> Path:
    """Write the rows that the harness saw; into the temporary folder where the disk is full."""
    try:
        return _write(folder, harness)
    except OSError:
        spare = Path(tempfile.mkdtemp(prefix=f"rollerrig-{folder.name}-"))
        kept = _write(spare, harness)
        harness.log("harness", f"{folder} could not be written; the rows are kept in {kept}")
        raise


def _write(folder: Path, harness: Harness) -> Path:
    path = folder / TRACE
    with path.open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(COLUMNS)
        out.writerows([f"{value:.9g}" for value in row] for row in harness.trace)
    return path


def merged(seen: list[Event], summary: dict[str, Any]) -> list[Event]:
    """Events of the harness and of the bench, in the order of time."""
    reported = [Event(float(one["time_s"]), f"bench, {one['level']}", str(one["text"]))
                for one in summary.get("events", [])]
    return sorted([*seen, *reported], key=lambda event: event.time_s)
