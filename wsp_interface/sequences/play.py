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

from rollerrig.configs.errors import RollerrigError, UnitError
from rollerrig.wsp_interface import events, own_bench
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness_client import COLUMNS, Event, Harness, TimeOutError
from rollerrig.wsp_interface.sequences import verdict
from rollerrig.wsp_interface.sequences.conditions import Condition
from rollerrig.wsp_interface.sequences.measures import Record
from rollerrig.wsp_interface.sequences.sequence import Sequence, Step
from rollerrig.wsp_interface.sequences.verdict import Result, Verdict

TRACE = "harness.csv"
SETTLED_S = 0.05
FINALS = (
    "longest_lock",
    "sliding_work",
    "vents",
    "air_consumption",
    "reservoir_least",
    "flat_length",
    "sand_taken",
)
DRY = "stop_distance_over_dry"
STEP_SOURCE, BEFORE = "the sequence", "pre-condition"


@dataclass
class Outcome:
    """What became of a sequence: `result` is the worst of its verdicts, error where `error` is."""

    sequence: Sequence
    folder: Path
    verdicts: list[Verdict] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    finals: dict[str, tuple[float, ...]] = field(default_factory=dict)
    record: Record | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    error: str = ""
    wall_s: float = 0.0

    @property
    def result(self) -> Result:
        """Error wherever something could not be measured, else the worst verdict."""
        return Result.ERROR if self.error else verdict.worst([one.result for one in self.verdicts])


def on_own_bench(
    sequence: Sequence,
    folder: Path,
    pacing: str = "lockstep",
    seed: int = 0,
    dry_m: Callable[[dict[str, Any], tuple[tuple[float, float], ...]], float] | None = None,
    wsp: str = "",
    companions: tuple[own_bench.Companion, ...] = (),
    tell: Callable[[Event], None] = lambda event: None,
    arguments: tuple[str, ...] = (),
) -> Outcome:
    """Start a bench for the sequence, play it, and judge. Never raises for what a run can meet.

    `dry_m(scenario, demands)` gives the distance of the dry stop where a limit asks for it; `tell` gets each event;
    `arguments` are further ones of `rollerrig run`.
    """
    outcome = Outcome(sequence, folder)
    harness: Harness | None = None
    try:
        with own_bench.start(
            folder,
            sequence.scenario,
            wsp=wsp or sequence.wsp,
            pacing=pacing,
            seed=seed,
            initial_speed_m_s=sequence.speed_m_s,
            adhesion=sequence.adhesion,
            tables=sequence.tables,
            companions=companions,
            arguments=arguments,
        ) as harness:
            harness.tell = tell
            play(sequence, harness, outcome)
        outcome.summary = own_bench.summary(folder)
        own_bench.check_valid(outcome.summary)
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    if harness is not None:
        _conclude(outcome, harness, dry_m)
    return outcome


def on_running_bench(
    sequence: Sequence,
    harness: Harness,
    folder: Path,
    scenario: dict[str, Any],
    dry_m: Callable[..., float] | None = None,
) -> Outcome:
    """Play a sequence on a bench that somebody else has started; `scenario` is the resolved one."""
    outcome = Outcome(sequence, folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with harness:
            _check_start(sequence, harness)
            play(sequence, harness, outcome)
    except (RollerrigError, OSError) as error:
        outcome.error = str(error)
    _conclude(outcome, harness, dry_m, scenario)
    outcome.summary = heard(harness)
    return outcome


def missed(harness: Harness, folder: Path, criteria: str) -> str:
    """Which limits of a profile a braking has not kept to so far, each figure against its limit; empty where none.

    Limits that want a dry stop are left out. `folder` is that of the run. Raises RollerrigError.
    """
    profile = verdict.load(criteria)
    finals = {name: harness.read(name) for name in ("wheel_load", *FINALS)}
    limits = tuple(one for one in profile.limits if one.measure != DRY)
    verdicts = verdict.judge(
        replace(profile, limits=limits), _record_of(harness, folder, finals, None)
    )
    wrong = [
        f"{one.told}; {one.text}; source: {one.source}"
        for one in verdicts
        if one.result in (Result.FAIL, Result.ERROR)
    ]
    return "\n  ".join([f"not within the limits of '{criteria}':", *wrong]) if wrong else ""


def heard(harness: Harness) -> dict[str, Any]:
    """What the bus tells of a bench's time: pacing, cycles, and cycles of which no row came; lateness it does not."""
    at = COLUMNS.index("time_s")
    times_s = np.array([row[at] for row in harness.trace])
    steps_s = np.diff(times_s[np.isfinite(times_s)])
    cycle_s = float(np.median(steps_s)) if steps_s.size else math.nan
    lost = int(np.maximum(np.rint(steps_s / cycle_s) - 1, 0).sum()) if steps_s.size else 0
    return {
        "pacing": "lockstep" if harness.lockstep else "wall",
        "over_the_bus": {"cycles": len(times_s), "cycle_s": cycle_s, "cycles_lost": lost},
    }


def _check_start(sequence: Sequence, harness: Harness) -> None:
    """A bench that runs already must be what the sequence wants, as far as the bus tells."""
    wanted, is_now = sequence.speed_m_s, harness.vehicle_speed_m_s
    if wanted is not None and abs(is_now - wanted) > 0.05 * wanted + 0.1:
        raise UnitError(
            f"pre-condition: the sequence begins at {wanted:.2f} m/s, the bench runs at "
            f"{is_now:.2f} m/s; start it with initial_speed_m_s={wanted:.3f} and --harness"
        )


def play(sequence: Sequence, harness: Harness, outcome: Outcome) -> None:
    """Play every step. Raises BusError when the bench goes; a failed step ends the play."""
    outcome.finals["wheel_load"] = harness.read("wheel_load")
    for text in sequence.notes:
        harness.note(text)
    checks = outcome.verdicts
    checks += [
        replace(one, result=Result.ERROR) if one.result is Result.FAIL else one
        for one in (_check(BEFORE, before, harness) for before in sequence.before)
    ]
    if all(one.result is Result.PASS for one in checks):
        for number, step in enumerate(sequence.steps, start=1):
            name = step.title or f"step {number}"
            try:
                _play_step(step, harness)
            except TimeOutError:
                text = step.until.text if step.until else ""
                checks.append(
                    _line(
                        name,
                        f"{text} within {step.timeout_s:g} s",
                        Result.FAIL,
                        f"not reached at {harness.time_s:.2f} s; the sequence ends here",
                    )
                )
                break
            if step.until:
                checks.append(
                    _line(name, step.until.text, Result.PASS, f"at {harness.time_s:.2f} s")
                )
            checks += [_check(name, one, harness) for one in step.expects]
        else:
            checks += [_check("post-condition", one, harness) for one in sequence.after]
    harness.wait(SETTLED_S)  # the record also gets the last rows
    for quantity in FINALS:
        outcome.finals[quantity] = harness.read(quantity)


def _play_step(step: Step, harness: Harness) -> None:
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
    assert step.ramp
    from_Pa = harness.demands[-1][1] if harness.demands else 0.0
    begin_s, to_Pa = harness.time_s, step.ramp.to_Pa
    harness.record("harness", Code.TEST_BRAKE_RAMP, pressure_Pa=to_Pa, ramp_s=step.ramp.in_s)
    while (share := (harness.time_s - begin_s) / step.ramp.in_s) < 1.0:
        harness.brake(from_Pa + share * (to_Pa - from_Pa))
        harness.step()
    harness.brake(to_Pa)


def _check(name: str, condition: Condition, harness: Harness) -> Verdict:
    met = condition.holds(harness.values)
    return _line(
        name,
        condition.text,
        Result.PASS if met else Result.FAIL,
        f"at {harness.time_s:.2f} s: {condition.readings(harness.values)}",
    )


def _line(name: str, wanted: str, result: Result, text: str) -> Verdict:
    return Verdict(name, "", math.nan, wanted, math.nan, result, STEP_SOURCE, text)


def _conclude(
    outcome: Outcome,
    harness: Harness,
    dry_m: Callable[..., float] | None,
    scenario: dict[str, Any] | None = None,
) -> None:
    reported = []
    for one in outcome.summary.get("events", []):
        event = events.from_json(one)
        who = f"bench, {event.level}"
        reported.append(Event(event.time_s, who, event.text, event.code, event.fields))
    outcome.events = sorted([*harness.events, *reported], key=lambda event: event.time_s)
    try:
        _keep(outcome.folder, harness)
    except OSError as error:
        outcome.error = outcome.error or f"{outcome.folder}: cannot be written: {error.strerror}"
    if outcome.error or not harness.trace:
        return
    try:
        outcome.record = _record_of(harness, outcome.folder, outcome.finals, scenario)
        asks = any(one.measure == DRY for one in outcome.sequence.criteria.limits)
        if asks and dry_m:
            found = dry_m(dict(outcome.record.scenario), outcome.record.demands)
            outcome.record = replace(outcome.record, dry_m=found)
        unmet = [
            one.limit
            for one in outcome.verdicts
            if one.what == BEFORE and one.result is not Result.PASS
        ]
        outcome.verdicts += verdict.judge(
            outcome.sequence.criteria,
            outcome.record,
            f"a pre-condition was not met: {', '.join(unmet)}" if unmet else "",
        )
    except (RollerrigError, OSError, KeyError) as error:
        outcome.error = f"the run cannot be judged: {error}"


def _record_of(
    harness: Harness,
    folder: Path,
    finals: dict[str, tuple[float, ...]],
    scenario: dict[str, Any] | None,
) -> Record:
    if scenario is None:
        scenario = tomllib.loads((folder / "scenario.toml").read_text(encoding="utf-8"))
    faults = [
        event.time_s
        for event in harness.events
        if event.code in (Code.TEST_FAULT, Code.TEST_FAULT_LIFTED)
    ]
    return Record(
        dict(zip(COLUMNS, np.array(harness.trace).T, strict=True)),
        tuple(harness.demands),
        finals,
        scenario,
        fault_s=faults[0] if faults else math.nan,
    )


def _keep(folder: Path, harness: Harness) -> None:
    """Write the rows that the harness saw; into the temporary folder where the disk is full."""
    try:
        _write(folder, harness)
    except OSError:
        spare = Path(tempfile.mkdtemp(prefix=f"rollerrig-{folder.name}-"))
        _write(spare, harness)
        harness.record(
            "harness", Code.SEQUENCE_ROWS_SAVED, folder=str(folder), file=str(spare / TRACE)
        )
        raise


def _write(folder: Path, harness: Harness) -> None:
    with (folder / TRACE).open("w", newline="", encoding="utf-8") as file:
        out = csv.writer(file)
        out.writerow(COLUMNS)
        out.writerows([f"{value:.9g}" for value in row] for row in harness.trace)
