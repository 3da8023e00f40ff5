"""How often `discover` finds out a sealed rig within nine stops: the hidden causes named, each alone, and no other.

Rigs, stops and answers stay in a folder: an interrupted run goes on with the same command, and grows with --sets.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from rich.table import Table

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say
from rollerrig.realtime.benchmarks.sealed import score
from rollerrig.realtime.record import records
from rollerrig.realtime.record.files import replaced, writing
from rollerrig.realtime.studies import discover, fault_signs, sealed_rig
from rollerrig.rig.identify.next.prototype import Stop

RIGS, STOPS, SCENARIO = 40, 9, "velim_a1"
# stops with a fault: speed, and the axle that has it
OF_FAULTS, MASS_KG = ((38.0, 2), (30.0, 3)), 43000.0
TRIED = tuple(kind.name for kind in catalogue.CATALOGUE if kind.acts == catalogue.TICK and "sander" not in kind.name)
WHY_NOT = {"sander": "not tried: the rig has no sanders", "bus": "not tried: it acts over a bus, which free pacing has "
           "not"}


def run(given: argparse.Namespace, say: Say) -> Result:
    """Rows (measure, yes, of, share, its interval, wanted), and a line for each rig that was not found out."""
    if given.sets < 0 or given.seed < 0:
        raise ConfigError(f"--sets {given.sets}, --seed {given.seed}: allowed are 0 and more")
    folder = given.folder or Path("reports", f"bench_discover_{given.seed}")
    if given.faults:
        return _faults(folder, say)
    names = [f"rig_{given.seed + k:04d}" for k in range(given.sets or RIGS)]
    found = [_found_out(folder, name, say) for name in names]
    kinds = [("one hidden effect", [one for one in found if len(one["hidden"]) == 1]),
             ("two hidden effects", [one for one in found if len(one["hidden"]) == 2]), ("all", found)]
    rows = [score.rate(f"{kind}: {what}", wanted if kind == "all" else "", map(right, of)) for kind, of in kinds
            for what, wanted, right in (("found out: named alone, and no other", ">= 0.90", _solved),
                                        ("all named, perhaps among others", "", _among))]
    stops = [float(one["stops"]) for one in found if _solved(one)]
    notes = [f"{one['rig']}: hidden {' and '.join(one['hidden'])}; {one['said']}" for one in found if not _solved(one)]
    return {"rows": rows, "title": f"{len(found)} sealed rigs, at most {STOPS} stops each",
            "stops": figures.quantiles(stops), "notes": [*notes, f"rigs, stops and answers: {folder}"]}


def _found_out(folder: Path, name: str, say: Say) -> Result:
    """What was said of a rig, which is hidden and found out where that has not been done yet."""
    rig, answer = folder / f"{name}.toml", folder / f"{name}.json"
    if not answer.is_file():
        began = time.monotonic()
        sealed_rig.hide(SCENARIO, int(name.removeprefix("rig_")), 0, rig, rig.with_suffix(".key"))
        try:
            account, history = discover.find_out(str(rig), folder / name, STOPS, 0, say, lambda *_: None)
            said, last = account.verdict, history["rounds"][-1]
            content: Result = {"causes": last["causes"], "stops": last["stops"]}
        except ConfigError as error:
            said, content = f"refused: {error}", {"causes": [], "stops": STOPS}
        content |= {"rig": name, "verdict": said, "seconds": round(time.monotonic() - began)}
        with writing(answer), replaced(answer) as new:
            new.write_text(json.dumps(content) + "\n", encoding="utf-8")
    given: Result = json.loads(answer.read_text(encoding="utf-8"))
    given["said"] = " ".join([given["verdict"], " + ".join("/".join(names) for names in given["causes"])])
    given["hidden"] = sorted(sealed_rig.causes(rig))
    say(f"{name}: {given['said']}; {given['stops']} stops, {given['seconds']} s")
    return given


def _faults(folder: Path, say: Say) -> Result:
    """What single stops tell of each fault of the catalogue that acts without a bus."""
    given, _ = store.load("scenarios", SCENARIO)
    stops = {(name, k): folder / "faults" / f"{name}_{k}" for name in ("none", *TRIED) for k in range(len(OF_FAULTS))}
    todo = []
    for (name, k), out in stops.items():
        speed_m_s, axle = OF_FAULTS[k]
        hidden = {"kind": name, "axle": axle} | ({"other": axle + 1} if name == "swapped_axles" else {})
        sealed_rig.write(out.with_suffix(".toml"), given, {"fault": [] if name == "none" else [hidden]})
        if records.not_valid([out]):
            todo.append((str(out.with_suffix(".toml")), out, Stop(speed_m_s, discover.FULL_PA, MASS_KG, 0), 0))
    discover.brake_all(todo, lambda done: say(f"{done} of {len(todo)} stops done"))
    rows = []
    for kind in ("none", *catalogue.BY_NAME):
        told = [fault_signs.of(records.load(stops[kind, k])) for k in range(len(OF_FAULTS)) if (kind, k) in stops]
        right = [any(one.startswith(f"{kind} axle={axle}") for one in signs) and len(signs) == 1 if kind != "none" else
                 not signs for signs, (_, axle) in zip(told, OF_FAULTS, strict=False)]
        rows.append({"fault": kind, "differs_m_s": _differs(stops, kind) if told else None, "found": sum(right),
                     "of": len(told), "told": "; ".join(", ".join(signs) or "nothing" for signs in told) if told else
                     WHY_NOT["sander" if kind.startswith("sander") else "bus"]})
    return {"rows": rows, "title": "faults in the record of a stop, from 38 m/s on axle 2 and from 30 m/s on axle 3",
            "notes": [f"stops: {folder / 'faults'}", "wheel_diameter_mismatch is found by explain, as wheel_radius"]}


def _differs(stops: dict[tuple[str, int], Path], kind: str) -> float:
    """Largest difference in m/s of the vehicle's speed to that of a sound rig at the same time."""
    pairs = [[records.load(stops[name, k]).column("vehicle_speed_m_s") for name in (kind, "none")]
             for k in range(len(OF_FAULTS))]
    return max(float(np.abs(a[:b.size] - b[:a.size]).max()) for a, b in pairs)


def _solved(one: Result) -> bool:
    return one["verdict"] == "explained" and sorted(names[0] for names in one["causes"]) == one["hidden"] and all(
        len(names) == 1 for names in one["causes"])


def _among(one: Result) -> bool:
    return set(one["hidden"]) <= {name for names in one["causes"] for name in names}


def table(result: Result) -> Table:
    """The measures, with counts and 95 % intervals; or what is told of each fault."""
    if "fault" in result["rows"][0]:
        return figures.table(result["title"], ("fault", "vehicle differs by m/s", "found", "of", "told"),
                             [tuple(row.values()) for row in result["rows"]])
    return figures.table(result["title"], score.HEAD, [[row[key] for key in score.HEAD] for row in result["rows"]])
