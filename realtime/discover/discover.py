"""Runs stops of a rig, explains them, chooses the next stops, until one explanation is left.

The first stops have different speeds. One of them is held out: it is never fitted, and only judges
the explanation. Each further round runs the stops that best distinguish the causes still possible,
until the budget of stops is used up.

    OUT/stops/01 and so on    the runs; those of the same rig that are already there are used again
    OUT/discover.json         the result of each round, and why its stops were run
"""

import asyncio
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rollerrig.configs import store, user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import check_no_link, make_folder, write_text, writing
from rollerrig.configs.processes import children, cores
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.bench import bench, options, scenario
from rollerrig.realtime.datasets import run_dataset, run_sensors
from rollerrig.realtime.discover import fault_signs
from rollerrig.realtime.record import records
from rollerrig.realtime.reports import proposed_stops
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.data.runs import Dataset
from rollerrig.rig.identify.decide import decision
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.next_stops import planning
from rollerrig.rig.identify.next_stops.prototype import LONGEST_S, RELEASED_S, Stop

FIRST_SPEEDS_M_S = (38.0, 22.0, 30.0)  # initial speeds of the first stops
HELD_OUT = 2  # place of the stop that is never fitted
FULL_PA = 3.8e5  # cylinder pressure of the first stops
STOPS_PER_ROUND = 2  # further stops
QUIET_ROUNDS = 2  # after so many rounds without a cause the rig counts as fault-free
HISTORY = "discover.json"

Row = dict[str, Any]  # one stop or one round, as in discover.json
Log = Callable[[str], None]
Progress = Callable[[str, float], None]
Explain = Callable[[Dataset, int, Progress], Diagnosis]  # of a dataset and a seed


def find_out(
    rig: str,
    out: Path,
    most: int,
    seed: int,
    log: Log,
    progress: Progress,
    explain: Explain = decision.explain_braking_runs,
) -> tuple[Diagnosis, dict[str, Any]]:
    """Return the diagnosis of the last round, and the history of all rounds.

    `most` is the largest number of stops. `explain` returns the diagnosis of the stops of a round.
    A search that was interrupted continues. Raises ConfigError.
    """
    least = len(FIRST_SPEEDS_M_S)
    if most < least or seed < 0:
        raise ConfigError(
            f"--stops {most}, --seed {seed}: the search needs {least} stops or more, of which "
            "one is held out, and a seed of 0 or more"
        )
    content, path = store.load("scenarios", rig)
    plan = scenario.read(content, path)
    history = _open_history(out, {"rig": scenario.digest(plan), "seed": seed})
    if "stops" not in history:
        history["stops"] = _first_stops(float(plan["vehicle"]["mass_kg"]))

    while True:
        stops = history["stops"][:most]
        # a search that continues judges its last round again
        rounds = [row for row in history["rounds"] if row["stops"] < len(stops)]
        history["rounds"] = rounds

        folders = _run_missing(rig, out, stops, seed, log)
        diagnosis = _explain(folders, out, seed, progress, explain)
        rounds.append(_round_row(diagnosis, len(folders)))
        log(_round_line(len(rounds), rounds[-1]))

        further: list[Row] = []
        if not _is_over(rounds, most):
            count = min(STOPS_PER_ROUND, most - len(stops))
            further = _further_stops(diagnosis, stops, count, progress)
        history["stops"] = stops + further
        _write_history(out, history)
        if not further:
            return diagnosis, history
        for row in further:
            log(f"  next: {row['title']}: {row['why']}")


# --- the history ---


def _open_history(out: Path, rig: dict[str, Any]) -> dict[str, Any]:
    """Return the history in a folder, or a new one.

    Raises ConfigError if the history belongs to another rig or seed.
    """
    with writing(out):
        make_folder(out, "stops")
        make_folder(out, "dataset")
    path = out / HISTORY
    if not path.exists():
        return rig | {"rounds": []}
    try:
        history: dict[str, Any] = user_files.read_json(path, within=out)
        if all(history[key] == value for key, value in rig.items()):
            return history
        problem = f"it belongs to another rig or seed ({history['seed']})"
    except (TypeError, KeyError) as error:
        problem = f"{HISTORY} cannot be read: {error!r}"
    raise ConfigError(f"{out}: {problem}; give another folder with --out")


def _write_history(out: Path, history: dict[str, Any]) -> None:
    """Write the history, with the result of the last round as that of the search."""
    last = history["rounds"][-1]
    result = {"verdict": last["verdict"], "causes": last["causes"], "stops_used": last["stops"]}
    text = json.dumps(history | result, indent=1) + "\n"
    with writing(out):
        write_text(out / HISTORY, text)


def _stop_row(stop: Stop, reason: str) -> Row:
    return {**stop._asdict(), "title": proposed_stops.title(stop), "why": reason}


def _stop_of(row: Row) -> Stop:
    return Stop(*(row[key] for key in Stop._fields))


def _first_stops(mass_kg: float) -> list[Row]:
    return [
        _stop_row(Stop(speed_m_s, FULL_PA, mass_kg, 0), "mixed speeds to begin with")
        for speed_m_s in FIRST_SPEEDS_M_S
    ]


# --- stops ---


def _run_missing(rig: str, out: Path, rows: Sequence[Row], seed: int, log: Log) -> list[Path]:
    """Return the folders of all stops, after those that are missing have been run."""
    folders = [out / "stops" / f"{number:02d}" for number in range(1, len(rows) + 1)]
    jobs = []
    for folder in folders:
        check_no_link(folder)
    for folder, row in zip(folders, rows, strict=True):
        stop = _stop_of(row)
        if not _has_run(rig, folder, stop):
            jobs.append((rig, folder, stop, seed))
    already_there = len(rows) - len(jobs)
    brake_all(jobs, lambda done: log(f"stop {already_there + done} of {len(rows)} done"))

    not_valid = records.not_valid(folders)
    if not_valid:
        shown = [f"the stops show {fault}" for fault in common_faults(folders)]
        raise ConfigError("; ".join([not_valid[0], *shown]))
    return folders


def _has_run(rig: str, folder: Path, stop: Stop) -> bool:
    """Whether a folder holds a valid run of this stop of this rig."""
    summary = records.summary(folder)
    if not summary or summary["invalid_because"]:
        return False
    return bool(summary["config_hash"] == scenario.digest(plan_of(rig, stop)))


def brake_all(jobs: Sequence[tuple[str, Path, Stop, int]], done: Callable[[int], None]) -> None:
    """Run stops in parallel, one per core; `done` receives the number of completed stops."""
    workers = max(min(cores.allowed(), len(jobs)), 1)
    with children.pool(workers) as pool:
        for count, _ in enumerate(pool.map(brake, jobs), start=1):
            done(count)


def brake(job: tuple[str, Path, Stop, int]) -> Path:
    """Run one stop on a separate bench; return its folder.

    The pacing is free, but lockstep if a fault acts over the bus. `job` is (rig, folder, stop,
    seed).
    """
    rig, folder, stop, seed = job
    plan = plan_of(rig, stop)
    needs_no_bus = all(fault.kind.acts == catalogue.TICK for fault in plan.faults)
    pacing = "free" if needs_no_bus else "lockstep"
    with options.waiting_processes() as processes:
        how = options.Options(
            pacing=pacing,
            out=folder,
            seed=seed,
            recorder=processes["recorder"],
        )
        asyncio.run(bench.Bench(plan, how, lambda progress: None).run())
    return folder


def plan_of(rig: str, stop: Stop) -> scenario.Scenario:
    """Return the scenario of one stop of a rig. Raises ConfigError."""
    content, path = store.load("scenarios", rig)
    head: dict[str, Any] = {"initial_speed_m_s": stop.initial_speed_m_s, "stand_s": 0.0}
    tables: dict[str, Any] = {
        "vehicle": {"mass_kg": stop.mass_kg},
        "bus": {"socketcand_port": 0},
        "demand": [{"from_s": RELEASED_S, "pressure_Pa": stop.pressure_Pa}],
    }
    if stop.held_s:
        tables["rig"] = {"speed": "held"}
        head["duration_max_s"] = RELEASED_S + stop.held_s

    faults: list[str] = []
    if stop.axle:
        # the other axles are vented; they brake afterwards, so that the vehicle comes to a stop
        faults = [
            f"vent_magnet_stuck axle={axle} for={LONGEST_S:g}"
            for axle in scenario.read(content, path).table.axles
            if axle != stop.axle
        ]
    return scenario.read(content | head, path, tables=tables, faults=tuple(faults))


# --- rounds ---


def _explain(
    folders: Sequence[Path], out: Path, seed: int, progress: Progress, explain: Explain
) -> Diagnosis:
    """Return the diagnosis of the stops; its notes name the faults that the stops show.

    Raises ConfigError, with these faults, if the stops cannot be explained.
    """
    held_out = [folders[HELD_OUT]]
    fitted = [folder for folder in folders if folder not in held_out]
    faults = common_faults(folders)
    try:
        written = run_dataset.from_folders(
            fitted,
            out / "dataset",
            held_out,
            run_sensors.NOISE,
            run_dataset.SLOWEST_M_S,
            LONGEST_S,
        )
        data = dataset.load(written)._replace(name=out.name)
        diagnosis = explain(data, seed, progress)
    except ConfigError as error:
        message = str(error)
        if faults:
            message = f"the stops show {', '.join(faults)}, and cannot be explained: {error}"
        raise ConfigError(message) from None
    # the report repeats the warnings of the data among its notes
    diagnosis.data.warnings.extend(f"the stops show a fault: {fault}" for fault in faults)
    return diagnosis


def common_faults(folders: Sequence[Path]) -> list[str]:
    """Return the faults that more than half of the stops show."""
    signs: list[str] = []
    for folder in folders:
        signs += fault_signs.of(records.load(folder))
    return [sign for sign in dict.fromkeys(signs) if signs.count(sign) > len(folders) / 2]


def _round_row(diagnosis: Diagnosis, stops: int) -> Row:
    """Return a round as in discover.json; each cause is followed by its confusable ones."""
    return {
        "stops": stops,
        "verdict": diagnosis.verdict,
        "seconds": round(diagnosis.elapsed_s, 1),
        "causes": [[cause.score_test.name, *cause.confusable] for cause in diagnosis.causes],
    }


def _round_line(number: int, row: Row) -> str:
    causes = " and ".join(" or ".join(names) for names in row["causes"]) or "no cause identified"
    return (
        f"round {number}, {row['stops']} stops: {row['verdict']}: {causes} ({row['seconds']:.0f} s)"
    )


def _is_over(rounds: Sequence[Row], most: int) -> bool:
    """Whether the budget is used up, all causes are unique, or the last rounds found nothing."""
    last = rounds[-1]
    if last["stops"] >= most:
        return True
    quiet = [row["verdict"] == "consistent" for row in rounds[-QUIET_ROUNDS:]]
    if len(quiet) == QUIET_ROUNDS and all(quiet):
        return True
    unique = all(len(names) == 1 for names in last["causes"])
    return last["verdict"] == "explained" and unique


def _further_stops(
    diagnosis: Diagnosis, rows: Sequence[Row], count: int, progress: Progress
) -> list[Row]:
    """Return the new stops that best distinguish the causes still possible."""
    fitted = planning.FittedData(diagnosis.data, diagnosis.design, diagnosis.final)
    library = planning.library(fitted, planning.surviving(diagnosis), progress)
    # causes that are confusable with each other come before all others
    confusable: set[str] = set()
    for cause in diagnosis.causes:
        if cause.confusable:
            confusable.update((cause.score_test.name, *cause.confusable))

    done = {_stop_of(row) for row in rows}
    # as many proposals more as there are stops: any of them may have been run already
    proposals = planning.propose(library, count + len(rows), tuple(confusable))
    new = [proposal for proposal in proposals if proposal.stop not in done]
    return [_stop_row(proposal.stop, proposed_stops.reason(proposal)) for proposal in new[:count]]
