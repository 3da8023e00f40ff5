"""Plays a sequence whose scenario is a train: `rollerrig run` as a process, and its record judged.

The demand and the faults are those of the steps (`wsp_interface.sequences.train_script`). In
lockstep one car has a bus with the unit under test. The measures are those of all axles, of the
couplers, and of the train against its first braked car alone.
"""

import json
import re
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.output_files import write_text
from rollerrig.configs.processes import children
from rollerrig.realtime.record import channels, records, run_folder
from rollerrig.realtime.train import plan, record
from rollerrig.realtime.train.plan import Train
from rollerrig.wsp_interface import events, own_bench, unit_choice
from rollerrig.wsp_interface.events import Code
from rollerrig.wsp_interface.harness_client import Event
from rollerrig.wsp_interface.sequences import play, train_script, verdict
from rollerrig.wsp_interface.sequences.play import Outcome
from rollerrig.wsp_interface.sequences.record import Record
from rollerrig.wsp_interface.sequences.sequence import Sequence
from rollerrig.wsp_interface.sequences.verdict import Result

FREE = "free"
# a table of [start.tables] with values of one car
_CAR = re.compile(r"car_\d+")
# the option of `rollerrig run` with the command of a unit, which chooses the unit
_COMMAND = "--unit"
# signals of axles in the record of a train that measures read, with the unit of their columns
_OF_AXLES = {"sliding": "_m_s", "adhesion": "", "valve": ""}


def scenario_of(sequence: Sequence) -> dict[str, Any]:
    """Return the file of the train of a sequence, with the demand of its steps.

    Raises ConfigError.
    """
    tables = {key: value for key, value in sequence.tables.items() if not _CAR.fullmatch(key)}
    data = own_bench.scenario_of(
        name=sequence.scenario,
        initial_speed_m_s=sequence.speed_m_s,
        adhesion=sequence.adhesion,
        tables=tables,
        title=sequence.title,
    )
    return train_script.scenario_of(data, sequence.steps)


def _settings(sequence: Sequence) -> list[str]:
    """Return the tables [start.tables.car_N] of a sequence as settings of these cars."""
    found = []
    for car, content in sequence.tables.items():
        if not _CAR.fullmatch(car):
            continue
        if not isinstance(content, Mapping):
            raise ConfigError(
                f"{sequence.path} [start.tables]: {car} = {content!r}: write [start.tables.{car}]"
            )
        for key, value in content.items():
            single = value if isinstance(value, Mapping) else {"": value}
            for name, one in single.items():
                found.append(f"{'.'.join(filter(None, (car, key, name)))}={json.dumps(one)}")
    return found


def train_of(sequence: Sequence) -> Train:
    """Return the checked train of a sequence, with the faults of its steps. Raises ConfigError."""
    faults = train_script.commands(sequence.steps).faults
    sources = plan.Sources(settings="--set", faults="the fault")
    path = Path(sequence.path.name)
    settings = tuple(_settings(sequence))
    return plan.read(
        scenario_of(sequence), path, settings=settings, sources=sources, faults=tuple(faults)
    )


def play_one(
    sequence: Sequence,
    folder: Path,
    pacing: str,
    car: str,
    seed: int = 0,
    wsp: str = "",
    arguments: tuple[str, ...] = (),
    allowed: unit_choice.AllowList = unit_choice.NOTHING,
) -> Outcome:
    """Run the train of a sequence, and judge it. A failure of the run is in the outcome.

    car: those with buses, as --car of `rollerrig run`; unused in free pacing. The other arguments
    are those of `play.on_own_bench`.
    """
    outcome = Outcome(sequence, folder)
    try:
        has_unit = any(one.has_unit for one in train_of(sequence).cars)
        if not has_unit and _COMMAND not in arguments and not wsp:
            # there is no unit for a bus
            pacing = FREE
        words = ["--pacing", pacing, "--seed", str(seed), *arguments]
        if _COMMAND not in arguments:
            words += ["--wsp", wsp or sequence.allowed_unit(allowed)]
        words += ["--car", car] if pacing != FREE else []
        _run(sequence, folder, words)
        outcome.summary = records.summary(folder)
        own_bench.check_valid(outcome.summary)
        outcome.record = _record(folder, outcome.summary)
        _judge(outcome)
    except (RollerrigError, OSError, KeyError) as error:
        outcome.error = str(error)
    except KeyboardInterrupt:
        outcome.interrupted = True
        outcome.error = "interrupted; play it again"
    return outcome


def _run(sequence: Sequence, folder: Path, words: list[str]) -> None:
    """Run the train as a process. Raises RollerrigError with its last words if it fails."""
    for text in train_script.commands(sequence.steps).faults:
        words += ["--fault", text]
    for text in _settings(sequence):
        words += ["--set", text]
    with tempfile.TemporaryDirectory(prefix="rollerrig-") as place:
        path = Path(place) / f"{sequence.name}.toml"
        write_text(path, tomli_w.dumps(scenario_of(sequence)))
        of_run = ("run", str(path), "--out", str(folder), "--json", *words)
        process = subprocess.Popen(
            children.command(*children.module("rollerrig.realtime.cli", *of_run)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            _, messages = process.communicate()
        except KeyboardInterrupt:
            process.terminate()
            process.communicate()
            raise
    if not (folder / run_folder.SUMMARY).is_file():
        last = (messages.strip().splitlines() or ["it has written nothing"])[-1]
        raise RollerrigError(
            f"the run of {sequence.name} has ended with status {process.returncode}; its last words: "
            f"{last}"
        )


def _record(folder: Path, summary: Mapping[str, Any]) -> Record:
    """Return the data for the measures, from the record of a train."""
    found = channels.Columns(folder)
    resolved = store.parse(folder / run_folder.SCENARIO, within=folder)
    columns = {
        name: channels.values(found[name]) for name in ("time_s", "vehicle_speed_m_s", "position_m")
    }
    demands = []
    for number, car in enumerate(summary["cars"], start=1):
        demands.append(channels.values(found[f"car_{number}_brake_demand_Pa"]))
        of_car = record.folder_of_car(folder, number) / run_folder.SCENARIO
        radius_m = store.parse(of_car, within=folder)["vehicle"]["wheel_radius_m"]
        for axle in range(car["axles"][0], car["axles"][1] + 1):
            wheel = channels.values(found[f"wheel_speed_{axle}_rad_s"])
            columns[f"wheel_circumferential_speed_{axle}_m_s"] = radius_m * wheel
            for name, unit in _OF_AXLES.items():
                columns[f"{name}_{axle}{unit}"] = channels.values(found[f"{name}_{axle}{unit}"])
    # the braking begins with the demand at the first car that gets one
    columns["brake_demand_Pa"] = np.max(demands, axis=0)
    for number in range(1, len(summary["couplers"]) + 1):
        columns[f"coupler_{number}_N"] = channels.values(found[f"coupler_{number}_N"])
    return Record(
        columns=columns,
        demands=tuple((step["from_s"], step["pressure_Pa"]) for step in resolved["demand"]),
        finals={
            "longest_lock": tuple(axle["longest_lock_s"] for axle in summary["axles"]),
            "vents": tuple(car["vents"] for car in summary["cars"]),
        },
        scenario=resolved,
        train=summary,
    )


def _judge(outcome: Outcome) -> None:
    """Append the events of the steps, and the verdicts on steps and measures, to the outcome."""
    sequence, found = outcome.sequence, outcome.record
    assert found
    before = [
        train_script.checked(play.BEFORE, condition, found.columns, 0.0)
        for condition in sequence.before
    ]
    unmet = [line.wanted for line in before if line.result is not Result.PASS]
    # without its pre-condition a sequence shows nothing
    lines = [
        line._replace(result=Result.ERROR) if line.wanted in unmet else line for line in before
    ]
    begun, of_steps, end_s = train_script.judged(sequence.steps, found.columns)
    if not unmet:
        lines += of_steps
        if np.isfinite(end_s):
            lines += [
                train_script.checked(play.AFTER, condition, found.columns, end_s)
                for condition in sequence.after
            ]
    outcome.verdicts += [
        play.step_verdict(one.name, one.wanted, one.result, one.text) for one in lines
    ]
    void = f"a pre-condition was not met: {', '.join(unmet)}" if unmet else ""
    outcome.verdicts += verdict.judge(sequence.criteria, found, void)
    outcome.events = _events(begun, outcome.summary)


def _events(begun: list[train_script.Begun], summary: Mapping[str, Any]) -> list[Event]:
    """Return the begins of the steps and the events of the cars, by time."""
    found = [
        Event(step.time_s, "step", step.title, Code.SEQUENCE_STEP, {"title": step.title})
        for step in begun
    ]
    for data in summary.get("events", []):
        event = events.from_json(data)
        who = f"car {data['car']}, {event.level}"
        found.append(Event(event.time_s, who, event.text, event.code, event.fields))
    return sorted(found, key=lambda event: event.time_s)


def digest(sequence: Sequence) -> str:
    """Return a hash of everything that decides the run of a sequence."""
    return record.digest(train_of(sequence))
