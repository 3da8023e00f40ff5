"""A rig that finds out by itself: stops, an explanation of them, further stops that part what is left, and again.

The first stops are of mixed speeds; one of them is never fitted, only judged. Each further round runs those stops that
part the causes still possible best, as far as the budget goes.

    OUT/stops/01 and so on    runs as any other; those that are there and of the same rig are used again
    OUT/discover.json         what each round found and why its stops were run
"""

import asyncio
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.processes import children
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.bench import bench, options, scenario
from rollerrig.realtime.datasets import run_dataset, run_sensors
from rollerrig.realtime.discover import fault_signs
from rollerrig.realtime.record import records
from rollerrig.realtime.record.files import replaced, writing
from rollerrig.rig.identify.data import dataset
from rollerrig.rig.identify.decide import decision
from rollerrig.rig.identify.decide.decision import Diagnosis
from rollerrig.rig.identify.next_stops import planning
from rollerrig.rig.identify.next_stops.prototype import LONGEST_S, RELEASED_S, Stop

FIRST_M_S, JUDGED = (
    (38.0, 22.0, 30.0),
    2,
)  # speeds of the first stops, and which of them is never fitted
FULL_PA = 3.8e5
A_ROUND = 2  # further stops a round
QUIET_ROUNDS = 2  # so often nothing may be found before the rig counts as sound
HISTORY = "discover.json"
Say = Callable[[str], None]
Progress = Callable[[str, float], None]


def find_out(
    rig: str, out: Path, most: int, seed: int, say: Say, progress: Progress
) -> tuple[Diagnosis, dict[str, Any]]:
    """The last account of a rig's stops, and the history of the rounds. Raises ConfigError."""
    if most < len(FIRST_M_S) or seed < 0:
        raise ConfigError(
            f"--stops {most}, --seed {seed}: allowed are {len(FIRST_M_S)} stops and more, of which one "
            "is never fitted, and seeds from 0 on"
        )
    given, path = store.load("scenarios", rig)
    plan = scenario.read(given, path)
    mass_kg = float(plan["vehicle"]["mass_kg"])
    history = _begun(out, {"rig": scenario.digest(plan), "seed": seed})
    history.setdefault(
        "stops",
        [_told(Stop(v, FULL_PA, mass_kg, 0), "mixed speeds to begin with") for v in FIRST_M_S],
    )
    while True:
        stops = history["stops"][:most]
        # a search that is gone on with where it had ended is judged again
        rounds = history["rounds"] = [one for one in history["rounds"] if one["stops"] < len(stops)]
        account = _judged(_run(rig, out, stops, seed, say), out, seed, rounds, say, progress)
        further = (
            []
            if _over(rounds, most)
            else _further(account, stops, min(A_ROUND, most - len(stops)), progress)
        )
        history["stops"] = stops + further
        _keep(out, history)
        if not further:
            return account, history
        for stop in further:
            say(f"  next: {stop['title']}: {stop['why']}")


def _begun(out: Path, of: dict[str, Any]) -> dict[str, Any]:
    """The history that a folder holds, or a new one; refused where it is of another rig."""
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    if not (out / HISTORY).is_file():
        return of | {"rounds": []}
    try:
        history: dict[str, Any] = json.loads((out / HISTORY).read_text(encoding="utf-8"))
        if {key: history[key] for key in of} == of:
            return history
        why = f"it is of another rig or seed ({history['seed']})"
    except (ValueError, KeyError) as error:
        why = f"{HISTORY} cannot be read: {error!r}"
    raise ConfigError(f"{out}: {why}; give another folder with --out")


def _keep(out: Path, history: dict[str, Any]) -> None:
    last = history["rounds"][-1]
    told = {"verdict": last["verdict"], "causes": last["causes"], "stops_used": last["stops"]}
    with writing(out), replaced(out / HISTORY) as new:
        new.write_text(json.dumps(history | told, indent=1) + "\n", encoding="utf-8")


def _told(stop: Stop, why: str) -> dict[str, Any]:
    return {**stop._asdict(), "title": stop.title, "why": why}


# --- stops ---


def _run(rig: str, out: Path, stops: Sequence[dict[str, Any]], seed: int, say: Say) -> list[Path]:
    """The folders of all stops; those that are missing are run, one a core."""
    folders = [out / "stops" / f"{k:02d}" for k in range(1, len(stops) + 1)]
    todo = [
        (rig, folder, Stop(*(stop[key] for key in Stop._fields)), seed)
        for folder, stop in zip(folders, stops, strict=True)
        if not _is_there(rig, folder, stop)
    ]
    brake_all(todo, lambda done: say(f"stop {len(stops) - len(todo) + done} of {len(stops)} done"))
    if why := records.not_valid(folders):
        raise ConfigError("; ".join([why[0], *(f"the stops show {one}" for one in shown(folders))]))
    return folders


def brake_all(jobs: Sequence[tuple[str, Path, Stop, int]], done: Callable[[int], None]) -> None:
    """Run stops, one a core; `done` is told how many have been."""
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    with children.pool(max(min(cores, len(jobs)), 1)) as pool:
        for count, _ in enumerate(pool.map(brake, jobs), start=1):
            done(count)


def _is_there(rig: str, folder: Path, stop: dict[str, Any]) -> bool:
    found = records.summary(folder)
    return (
        bool(found)
        and not found["invalid_because"]
        and found["config_hash"]
        == scenario.digest(plan_of(rig, Stop(*(stop[key] for key in Stop._fields))))
    )


def plan_of(rig: str, stop: Stop) -> scenario.Scenario:
    """The scenario of one stop of a rig. Raises ConfigError."""
    given, path = store.load("scenarios", rig)
    tables: dict[str, Any] = {
        "vehicle": {"mass_kg": stop.mass_kg},
        "bus": {"socketcand_port": 0},
        "demand": [{"from_s": RELEASED_S, "pressure_Pa": stop.pressure_Pa}],
    }
    head: dict[str, Any] = {"initial_speed_m_s": stop.initial_speed_m_s, "stand_s": 0.0}
    if stop.held_s:
        tables["rig"], head["duration_max_s"] = {"speed": "held"}, RELEASED_S + stop.held_s
    # the others brake later, to bring the vehicle to a stop
    vented = [
        f"vent_magnet_stuck axle={j} for={LONGEST_S:g}"
        for j in range(1, 5)
        if stop.axle and j != stop.axle
    ]
    return scenario.read(given | head, path, tables=tables, faults=tuple(vented))


def brake(job: tuple[str, Path, Stop, int]) -> Path:
    """Run one stop on a bench of its own, in free pacing but where a fault acts over the bus; returns its folder."""
    rig, folder, stop, seed = job
    plan = plan_of(rig, stop)
    pacing = (
        "free" if all(fault.kind.acts == catalogue.TICK for fault in plan.faults) else "lockstep"
    )
    with options.waiting_processes() as processes:
        how = options.Options(pacing=pacing, out=folder, seed=seed, recorder=processes["recorder"])
        asyncio.run(bench.Bench(plan, how, lambda progress: None).run())
    return folder


# --- rounds ---


def _judged(
    folders: Sequence[Path],
    out: Path,
    seed: int,
    rounds: list[dict[str, Any]],
    say: Say,
    progress: Progress,
) -> Diagnosis:
    """What the stops tell, told and put down as a round."""
    judged = [folders[JUDGED]]
    faults = shown(folders)
    try:
        made = run_dataset.from_folders(
            [one for one in folders if one not in judged],
            out / "dataset",
            judged,
            run_sensors.NOISE,
            run_dataset.SLOWEST_M_S,
            LONGEST_S,
        )
        account = decision.explain_braking_runs(
            dataset.load(made)._replace(name=out.name), seed, progress
        )
    except ConfigError as error:
        raise ConfigError(
            f"the stops show {', '.join(faults)}, and cannot be explained: {error}"
            if faults
            else str(error)
        ) from None
    account.notes.extend(f"the stops show a fault: {one}" for one in faults)
    rounds.append(
        {
            "stops": len(folders),
            "verdict": account.verdict,
            "seconds": round(account.elapsed_s, 1),
            "causes": [[named.score_test.name, *named.confusable] for named in account.causes],
        }
    )
    say(_line(len(rounds), rounds[-1]))
    return account


def _over(rounds: Sequence[dict[str, Any]], most: int) -> bool:
    """Whether the budget is used up, or each cause stands alone, or nothing was found again and again."""
    quiet = [one["verdict"] == "consistent" for one in rounds[-QUIET_ROUNDS:]]
    return (
        rounds[-1]["stops"] >= most
        or (all(quiet) and len(quiet) == QUIET_ROUNDS)
        or (
            rounds[-1]["verdict"] == "explained"
            and all(len(names) == 1 for names in rounds[-1]["causes"])
        )
    )


def _line(number: int, found: dict[str, Any]) -> str:
    named = " and ".join(" or ".join(names) for names in found["causes"]) or "no cause named"
    return f"round {number}, {found['stops']} stops: {found['verdict']}: {named} ({found['seconds']:.0f} s)"


def shown(folders: Sequence[Path]) -> list[str]:
    """The faults that more than half of some stops show."""
    found = [one for folder in folders for one in fault_signs.of(records.load(folder))]
    return [one for one in dict.fromkeys(found) if found.count(one) > len(folders) / 2]


def _further(
    account: Diagnosis, stops: Sequence[dict[str, Any]], count: int, progress: Progress
) -> list[dict[str, Any]]:
    """The stops that part the causes still possible best, none of them run before."""
    fitted = planning.FittedData(account.data, account.design, account.final)
    done = {tuple(stop[key] for key in Stop._fields) for stop in stops}
    lib = planning.library(fitted, planning.surviving(account), progress)
    # first those that cannot be told from one another
    unclear = {
        name for n in account.causes if n.confusable for name in (n.score_test.name, *n.confusable)
    }
    new = [
        p
        for p in planning.propose(lib, count + len(stops), tuple(unclear))
        if tuple(p.stop) not in done
    ]
    return [_told(p.stop, p.reason) for p in new[:count]]
