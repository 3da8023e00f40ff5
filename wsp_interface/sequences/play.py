"""Plays a sequence on a bench through a harness, and keeps the measured data whatever happens.

Each step is a check: its `until` was reached in time, and its `expect`ations held at its end. If
the bench exits, a fault is refused or the disk is full, the result is "error". The rows up to then
are written into the folder of the run as `harness.csv`, or into a temporary folder if the disk is
full.
"""

import contextlib
import csv
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs import output_files, store
from rollerrig.configs.errors import BusError, RollerrigError, UnitError
from rollerrig.wsp_interface import braking, events, own_bench, unit_choice
from rollerrig.wsp_interface.bus.sdo_client import RefusedError
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness_client import Event, Harness, TimeOutError
from rollerrig.wsp_interface.sequences import running_bench, verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.sequences.record import Record
from rollerrig.wsp_interface.sequences.sequence import Sequence, Step
from rollerrig.wsp_interface.sequences.verdict import Result, Verdict
from rollerrig.wsp_interface.unit_choice import AllowList

TRACE = "harness.csv"
SCENARIO = "scenario.toml"  # resolved, in the folder of a run
SETTLED_S = 0.05  # after the last step, so that the record also has its last rows
# signals that are read at the end of a sequence
FINALS = (
    "longest_lock",
    "sliding_work",
    "vents",
    "air_consumption",
    "reservoir_least",
    "flat_length",
    "sand_taken",
)
DRY = "stop_distance_over_dry"  # the measure that needs a dry stop
# names in verdicts
STEP_SOURCE = "the sequence"
BEFORE = "pre-condition"
AFTER = "post-condition"

# dry_m(scenario, demands): the distance of the dry stop in m
DryStop = Callable[[dict[str, Any], tuple[tuple[float, float], ...]], float]


@dataclass
class Outcome:
    """The outcome of a sequence.

    folder: of the run.
    finals: signals that were read at the end.
    record: the data for the measures; None if nothing could be measured.
    summary: of the bench.
    error: why the sequence could not be played or judged; "" if it could.
    interrupted: whether a signal has ended it.
    """

    sequence: Sequence
    folder: Path
    verdicts: list[Verdict] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    finals: dict[str, tuple[float, ...]] = field(default_factory=dict)
    record: Record | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    interrupted: bool = False
    wall_s: float = 0.0

    @property
    def result(self) -> Result:
        """An error if the run could not be judged, else the worst verdict."""
        if self.error:
            return Result.ERROR
        return verdict.worst([line.result for line in self.verdicts])


def on_own_bench(
    sequence: Sequence,
    folder: Path,
    pacing: str = "lockstep",
    seed: int = 0,
    dry_m: DryStop | None = None,
    wsp: str = "",
    companions: tuple[own_bench.Companion, ...] = (),
    observer: own_bench.Observer | None = None,
    arguments: tuple[str, ...] = (),
    allowed: AllowList = unit_choice.NOTHING,
) -> Outcome:
    """Start a bench for a sequence, play and judge it. A failure of the run is in the outcome.

    dry_m: called for the distance of the dry stop if a limit needs it.
    wsp: replaces the unit of the sequence.
    companions: programs that run as long as the bench.
    observer: is informed of what the bench does.
    arguments: further options of `rollerrig run`.
    allowed: the FMUs that the sequence may choose as its unit.
    """
    outcome = Outcome(sequence, folder)
    harness: Harness | None = None
    try:
        with own_bench.start(
            folder,
            sequence.scenario,
            wsp=wsp or sequence.allowed_unit(allowed),
            pacing=pacing,
            seed=seed,
            initial_speed_m_s=sequence.speed_m_s,
            adhesion=sequence.adhesion,
            tables=sequence.tables,
            title=sequence.title,
            companions=companions,
            arguments=arguments,
            observer=observer,
        ) as harness:
            play(sequence, harness, outcome)
        outcome.summary = own_bench.summary(folder)
        own_bench.check_valid(outcome.summary)
    except RefusedError as error:
        outcome.error = str(error)
    except BusError as error:
        outcome.error = _why_lost(error, harness, "let the sequence end sooner")
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    except KeyboardInterrupt:
        _interrupt(outcome, harness)
    if harness is not None:
        _conclude(outcome, harness, dry_m)
    return outcome


def on_running_bench(
    sequence: Sequence,
    harness: Harness,
    folder: Path,
    wanted: dict[str, Any],
    dry_m: DryStop | None = None,
    observer: own_bench.Observer | None = None,
) -> Outcome:
    """Play and judge a sequence on a bench that already runs.

    `wanted` is the resolved scenario that the sequence starts from. The measures and the report
    have that of the bench. `dry_m` and `observer` are as for `on_own_bench`.
    """
    outcome = Outcome(sequence, folder)
    if observer is not None:
        harness.on_cycle = partial(observer.cycle, harness)
        harness.on_event = observer.event
    configuration: dict[str, Any] = {}
    warnings: list[str] = []
    try:
        output_files.make_folder(folder.parent, folder.name)
        # closes the bus also if the harness never joins
        with contextlib.closing(harness):
            # before the harness joins, because a bench that waits for it begins then
            configuration = harness.configuration()
            scenario = configuration["resolved"]
            output_files.write_text(folder / SCENARIO, own_bench.text_of_running_bench(scenario))
            warnings += running_bench.check_scenario(sequence, wanted, scenario)
            if scenario.get("demand"):
                # the sequence commands the brake, not the programme of the bench
                harness.brake(0.0)
            harness.join()
            warnings += running_bench.check_state(sequence, harness)
            play(sequence, harness, outcome)
        _check_unit(harness)
    except RefusedError as error:
        outcome.error = str(error)
    except BusError as error:
        remedy = "start it with --set stand_s=60, which is the longest time, or let the sequence end sooner"
        outcome.error = _why_lost(error, harness, remedy)
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    except KeyboardInterrupt:
        _interrupt(outcome, harness)
    _conclude(outcome, harness, dry_m, configuration.get("resolved"))
    outcome.summary = observed(harness)
    outcome.summary["warnings"] = warnings
    if configuration:
        outcome.summary |= {
            "config_hash": configuration.get("config_hash"),
            "seed": configuration.get("seed"),
            "wsp": {"unit": configuration.get("unit")},
            "unit_played": configuration.get("unit_played"),
            "scenario": configuration.get("scenario"),
            "vehicle": configuration.get("resolved", {}).get("vehicle_set"),
        }
    return outcome


def missed(harness: Harness, folder: Path, criteria: str) -> str:
    """Return the limits of a profile that the braking so far does not meet, as text; "" if none.

    Each line has the value and the limit. Limits that need a dry stop do not count. `folder` is
    the folder of the run. Raises RollerrigError.
    """
    profile = verdict.load(criteria)
    limits = tuple(limit for limit in profile.limits if limit.measure != DRY)
    finals = {name: harness.read(name) for name in ("wheel_load", *FINALS)}
    record = _record_of(harness, folder, finals, None)
    lines = []
    for line in verdict.judge(replace(profile, limits=limits), record):
        if line.result in (Result.FAIL, Result.ERROR):
            lines.append(f"{line.against_limit}; {line.text}; source: {line.source}")
    if not lines:
        return ""
    return "\n  ".join([f"not within the limits of '{criteria}':", *lines])


def observed(harness: Harness) -> dict[str, Any]:
    """Return what the bus shows of a bench's timing: pacing, cycles, and cycles without a row.

    The bus does not show lateness.
    """
    time_column = harness.columns.index("time_s")
    times_s = np.array([row[time_column] for row in harness.trace])
    steps_s = np.diff(times_s[np.isfinite(times_s)])
    cycle_s = math.nan
    lost = 0
    if steps_s.size:
        cycle_s = float(np.median(steps_s))
        lost = int(np.maximum(np.rint(steps_s / cycle_s) - 1, 0).sum())
    return {
        "pacing": "lockstep" if harness.lockstep else "wall",
        "over_the_bus": {"cycles": len(times_s), "cycle_s": cycle_s, "cycles_lost": lost},
    }


def _why_lost(error: BusError, harness: Harness | None, remedy: str) -> str:
    """Return why a bench was lost, with the `remedy` if it has ended after the stop."""
    if harness is None or not harness.trace:
        return str(error)
    speed_column = harness.columns.index("vehicle_speed_m_s")
    speed_m_s = np.array([row[speed_column] for row in harness.trace])
    time_column = harness.columns.index("time_s")
    time_s = np.array([row[time_column] for row in harness.trace])
    rolls = np.flatnonzero(speed_m_s > braking.STANDS_M_S)
    since = int(rolls[-1]) + 1 if rolls.size else 0
    if since == len(harness.trace):
        return str(error)
    return (
        f"the sequence goes on, but the bench has ended after the coach had stood for "
        f"{time_s[-1] - time_s[since]:.2f} s: a run ends stand_s after its stop; {remedy} ({error})"
    )


def _interrupt(outcome: Outcome, harness: Harness | None) -> None:
    """Note that a signal has ended the sequence; `harness` is None before it has joined."""
    outcome.interrupted = True
    if harness is None:
        outcome.error = "interrupted before its bench had started"
    else:
        outcome.error = f"interrupted at {harness.time_s:.2f} s of simulated time"


def _check_unit(harness: Harness) -> None:
    """Raise UnitError if the unit has reported that it has failed."""
    for event in harness.events:
        if event.code == Code.UNIT_FAILED:
            raise UnitError(f"{event.text}, at {event.time_s:.2f} s; the run is not valid")


def play(sequence: Sequence, harness: Harness, outcome: Outcome) -> None:
    """Play every step and append its verdicts to the outcome. A step that fails ends the sequence.

    Raises BusError when the bench exits.
    """
    outcome.finals["wheel_load"] = harness.read("wheel_load")
    for text in sequence.notes:
        harness.note(text)

    may_begin = True
    for condition in sequence.before:
        line = _check(BEFORE, condition, harness)
        if line.result is Result.FAIL:
            # without its pre-condition a sequence shows nothing
            line = replace(line, result=Result.ERROR)
            may_begin = False
        outcome.verdicts.append(line)
    if may_begin and _play_steps(sequence, harness, outcome.verdicts):
        for condition in sequence.after:
            outcome.verdicts.append(_check(AFTER, condition, harness))

    harness.wait(SETTLED_S)
    for quantity in FINALS:
        outcome.finals[quantity] = harness.read(quantity)


def _play_steps(sequence: Sequence, harness: Harness, verdicts: list[Verdict]) -> bool:
    """Play the steps; return False when the condition of a step has not come true in time."""
    for number, step in enumerate(sequence.steps, start=1):
        name = step.title or f"step {number}"
        try:
            _play_step(step, harness)
        except TimeOutError:
            text = step.until.text if step.until else ""
            wanted = f"{text} within {step.timeout_s:g} s"
            values = step.until.readings(harness.values) if step.until else "-"
            why = f"not reached at {harness.time_s:.2f} s, last values {values}; the sequence ends here"
            verdicts.append(step_verdict(name, wanted, Result.FAIL, why))
            return False
        if step.until:
            at = f"at {harness.time_s:.2f} s"
            verdicts.append(step_verdict(name, step.until.text, Result.PASS, at))
        for condition in step.expects:
            verdicts.append(_check(name, condition, harness))
    return True


def _play_step(step: Step, harness: Harness) -> None:
    """Give the commands of a step and wait until it is done. Raises TimeOutError."""
    if step.at_s is not None:
        harness.wait(step.at_s - harness.time_s)
    if step.title:
        harness.record("step", Code.SEQUENCE_STEP, title=step.title)
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
        harness.record("harness", Code.TEST_BRAKE, pressure_Pa=step.brake_Pa)
    if step.sand is not None:
        harness.sand(step.sand)
    begin_s = harness.time_s
    if step.ramp:
        _ramp(step, harness)
    if step.for_s is not None:
        harness.wait(begin_s + step.for_s - harness.time_s)
    if step.until:
        until = step.until
        harness.until(lambda: until.holds(harness.values), step.timeout_s, step.hold_s)


def _ramp(step: Step, harness: Harness) -> None:
    """Move the brake demand linearly to the pressure of a ramp, a step each bus cycle."""
    assert step.ramp
    from_Pa = harness.demands[-1][1] if harness.demands else 0.0
    to_Pa = step.ramp.to_Pa
    begin_s = harness.time_s
    harness.record("harness", Code.TEST_BRAKE_RAMP, pressure_Pa=to_Pa, ramp_s=step.ramp.in_s)
    while True:
        share = (harness.time_s - begin_s) / step.ramp.in_s
        if share >= 1.0:
            break
        harness.brake(from_Pa + share * (to_Pa - from_Pa))
        harness.step()
    harness.brake(to_Pa)


def _check(name: str, condition: Condition, harness: Harness) -> Verdict:
    """Return the verdict on a condition, by the newest values."""
    result = Result.PASS if condition.holds(harness.values) else Result.FAIL
    text = f"at {harness.time_s:.2f} s: {condition.readings(harness.values)}"
    return step_verdict(name, condition.text, result, text)


def step_verdict(name: str, wanted: str, result: Result, text: str) -> Verdict:
    """Return the verdict on a step; it has no value."""
    return Verdict(
        what=name,
        unit="",
        value=math.nan,
        limit=wanted,
        margin=math.nan,
        result=result,
        source=STEP_SOURCE,
        text=text,
    )


def _conclude(
    outcome: Outcome,
    harness: Harness,
    dry_m: DryStop | None,
    scenario: dict[str, Any] | None = None,
) -> None:
    """Collect the events, write the rows of the harness, and judge the measures."""
    outcome.events = _all_events(outcome, harness)
    try:
        _save_trace(outcome.folder, harness)
    except OSError as error:
        outcome.error = outcome.error or f"{outcome.folder}: cannot be written: {error.strerror}"
    if outcome.error or not harness.trace:
        return
    try:
        _judge(outcome, harness, dry_m, scenario)
    except (RollerrigError, OSError, KeyError) as error:
        outcome.error = f"the run cannot be judged: {error}"


def _all_events(outcome: Outcome, harness: Harness) -> list[Event]:
    """Return the events of the harness and of the bench, by time."""
    of_bench = []
    for data in outcome.summary.get("events", []):
        event = events.from_json(data)
        who = f"bench, {event.level}"
        of_bench.append(Event(event.time_s, who, event.text, event.code, event.fields))
    return sorted([*harness.events, *of_bench], key=lambda event: event.time_s)


def _judge(
    outcome: Outcome,
    harness: Harness,
    dry_m: DryStop | None,
    scenario: dict[str, Any] | None,
) -> None:
    """Append the verdicts on the measures to the outcome."""
    criteria = outcome.sequence.criteria
    outcome.record = _record_of(harness, outcome.folder, outcome.finals, scenario)
    if dry_m and any(limit.measure == DRY for limit in criteria.limits):
        distance_m = dry_m(dict(outcome.record.scenario), outcome.record.demands)
        outcome.record = replace(outcome.record, dry_m=distance_m)

    unmet = []
    for line in outcome.verdicts:
        if line.what == BEFORE and line.result is not Result.PASS:
            unmet.append(line.limit)
    void = f"a pre-condition was not met: {', '.join(unmet)}" if unmet else ""
    outcome.verdicts += verdict.judge(criteria, outcome.record, void)


def _record_of(
    harness: Harness,
    folder: Path,
    finals: dict[str, tuple[float, ...]],
    scenario: dict[str, Any] | None,
) -> Record:
    """Return the data for the measures. Without a scenario, that of the run's folder counts."""
    if scenario is None:
        scenario = store.parse(folder / SCENARIO, within=folder)
    faults_s = [
        _acts_s(event)
        for event in harness.events
        if event.code in (Code.TEST_FAULT, Code.TEST_FAULT_LIFTED)
    ]
    values = np.array(harness.trace).T
    return Record(
        columns=dict(zip(harness.columns, values, strict=True)),
        demands=tuple(harness.demands),
        finals=finals,
        scenario=scenario,
        fault_s=min(faults_s, default=math.nan),
    )


def _acts_s(event: Event) -> float:
    """Return when a fault that the harness has commanded begins or is lifted."""
    for word in event.fields["fault"].split():
        key, _, value = word.partition("=")
        if key in ("at", "at_s"):
            return max(event.time_s, float(value))
    return event.time_s


def _save_trace(folder: Path, harness: Harness) -> None:
    """Write the rows of the harness; if that fails, into a temporary folder, and raise OSError."""
    try:
        _write_trace(folder, harness)
    except OSError:
        spare = Path(tempfile.mkdtemp(prefix=f"rollerrig-{folder.name}-"))
        _write_trace(spare, harness)
        harness.record(
            "harness",
            Code.SEQUENCE_ROWS_SAVED,
            folder=str(folder),
            file=str(spare / TRACE),
        )
        raise


def _write_trace(folder: Path, harness: Harness) -> None:
    with (
        output_files.replaced(folder / TRACE) as new,
        new.open("w", newline="", encoding="utf-8") as file,
    ):
        out = csv.writer(file)
        out.writerow(harness.columns)
        out.writerows([f"{value:.9g}" for value in row] for row in harness.trace)
