"""How often `explain` is right: stops with known hidden effects, from generators of their own.

The generators are those of the project's tests (`tests/generator`), by two authors; they share no
code with the rig and hide each cause in another form than the rig's table writes it. The sets are
dealt out in turns, so that the first N of the matrix are a fair share of all kinds, and each set is
explained on one core, as many at once as there are cores. Rates stand beside their counts, for a
rate from a few sets says little.
"""

import argparse
import importlib
import multiprocessing
import os
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import zip_longest
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say

_FOLDER = Path(__file__).resolve().parents[2] / "tests" / "generator"
GENERATORS = {"first": "braking_stops", "second": "other_stops"}
NOTHING, SIZES = 20, (1.0, 1.5, 2.0)
LONGEST_S = 90.0
# a smaller gain than this share of the error is not worth a quotient
LEAST_POSSIBLE = 0.02


class Case(NamedTuple):
    """One set to be made: its kind, what is hidden at which size, its seed."""

    kind: str  # none, one, two, unknown
    effects: dict[str, float]
    seed: int


class Judged(NamedTuple):
    """What was said of a case."""

    case: Case
    verdict: str
    named: list[str]
    sets: list[set[str]]  # each named cause with those that it is confused with
    covered: bool | None
    reduction: float | None  # gain on runs never fitted, where it is claimed
    possible: float | None  # the same for a model that leaves only what noise leaves
    seconds: float


def cases(make: ModuleType, seed: int) -> list[Case]:
    """The whole matrix, kinds in turn."""
    none = [Case("none", {}, seed + 1000 + k) for k in range(NOTHING)]
    one = [Case("one", {cause: min(size * least, make.LARGEST.get(cause, np.inf))}, seed + 2000 + 10 * k + i)
           for i, size in enumerate(SIZES) for k, (cause, least) in enumerate(make.SMALLEST.items())]
    two = [Case("two", pair, seed + 3000 + k) for k, pair in enumerate(make.PAIRS)]
    unknown = [Case("unknown", {name: size}, seed + 4000 + k)
               for k, (name, size) in enumerate(make.UNKNOWN.items())]
    # three sets with one cause for each of another kind
    one_in_threes = [tuple(one[k:k + 3]) for k in range(0, len(one), 3)]
    dealt = zip_longest(one_in_threes, none, two, unknown)
    found: list[Case] = []
    for threes, *others in dealt:
        found += list(threes or ()) + [case for case in others if case is not None]
    return found


def judge(module: str, folder: Path, case: Case) -> Judged:
    """Make a set with a module of `tests/generator` and have it explained."""
    from rollerrig.rig.identify.data import dataset
    from rollerrig.rig.identify.decide import explain, extension

    make = generator(module)
    data = dataset.load(make.make(folder / f"set_{case.seed}", case.effects, case.seed))
    account = explain.braking_runs(data, 0, lambda *_: None)
    covered = None
    for named in account.causes:
        meant = make.SAME_MEANING.get(named.cause.name)
        if meant and named.cause.name in case.effects:
            low, high = extension.parameters(named)[meant[0]]["ci95"]
            covered = bool(low <= meant[1] * case.effects[named.cause.name] <= high)
    won = account.gain if account.gain is not None and account.gain.claimed else None
    possible = None
    if won is not None:
        floor = _floor(make, case, won.metric, folder)
        possible = 1.0 - floor / won.before
    return Judged(case, account.verdict, [n.finding.name for n in account.causes],
                  [{n.finding.name, *n.confusable} for n in account.causes], covered,
                  None if won is None else won.reduction, possible, account.elapsed_s)


def _floor(make: ModuleType, case: Case, metric: str, folder: Path) -> float:
    """What the base leaves of the same stops, same seed, when nothing is hidden in them."""
    from rollerrig.rig.identify.causes import candidates
    from rollerrig.rig.identify.data import dataset, preparation
    from rollerrig.rig.identify.decide import gain, tuning

    data = dataset.load(make.make(folder / f"twin_{case.seed}", {}, case.seed))
    design, held = (preparation.prepare(data, data.group(g)) for g in ("tune", "validate"))
    base, *_ = tuning.fit(design, candidates.start(design))
    return gain.error(held, base, metric)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Rows (measure, right, of, share, wanted) over the first `--sets` of the matrix."""
    module = GENERATORS[given.generator]
    chosen = cases(generator(module), given.seed)[: given.sets or None]
    found: list[Judged] = []
    notes = ["the possible gain leaves what the base leaves of the same stops without the cause",
             "each set is explained on one core"]
    context = multiprocessing.get_context("spawn")
    own = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [-1]
    cores = context.Queue()
    for core in own:
        cores.put(core)
    with tempfile.TemporaryDirectory() as place, ProcessPoolExecutor(
            len(own), context, initializer=_keep_to, initargs=(cores,)) as pool:
        try:
            for last in pool.map(partial(judge, module, Path(place)), chosen):
                found.append(last)
                say(f"{len(found)} of {len(chosen)}: hidden {last.case.effects or 'nothing'}; {last.verdict} "
                    f"{' + '.join('/'.join(sorted(s)) for s in last.sets)} ({last.seconds:.0f} s)")
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            notes.append(f"stopped after {len(found)} of {len(chosen)} sets")
    measures, seconds = rows(found), figures.quantiles([f.seconds for f in found])
    for row in measures:
        if row.get("quartiles"):
            notes.append("quartiles of the gain's share: {:.2f} and {:.2f}".format(*row["quartiles"]))
    if seconds:
        notes.append(f"seconds a set: median {seconds['p50']:.0f}, longest {seconds['max']:.0f}")
    return {"sets": len(found), "generator": given.generator, "rows": measures, "seconds": seconds,
            "each": [_plain(f) for f in found], "notes": notes}


def rows(found: list[Judged]) -> list[Result]:
    """What is counted, and the share that is wanted."""
    kinds: dict[str, list[Judged]] = {kind: [f for f in found if f.case.kind == kind]
                                      for kind in ("none", "one", "two", "unknown")}
    seen = [f for f in kinds["one"] if f.verdict != "consistent"]
    return [
        _row("nothing hidden: consistent", ">= 0.98", (f.verdict == "consistent" for f in kinds["none"])),
        _row("one cause: detected", "", (f.verdict != "consistent" for f in kinds["one"])),
        _row("one cause: named first or in a set of two, of detected", ">= 0.97",
             (_first(f) for f in seen)),
        _row("one cause: in the named set, of detected", ">= 0.99",
             (any(_truth(f) <= s for s in f.sets) for f in seen)),
        _row("one cause: a false second cause", "<= 0.05", (len(f.named) > 1 for f in kinds["one"])),
        _row("two causes: both named", ">= 0.85",
             (_truth(f) <= set().union(*f.sets) and len(f.named) == 2 for f in kinds["two"])),
        _row("cause not in the library: given a name", "<= 0.05", (bool(f.named) for f in kinds["unknown"])),
        _row("95 % intervals hold the truth", "0.88 to 0.99",
             (f.covered for f in found if f.covered is not None)),
        _gain_row(found),
        _row(f"within {LONGEST_S:g} s", "all", (f.seconds <= LONGEST_S for f in found)),
    ]


def table(result: Result) -> Table:
    """The measures, with counts."""
    return figures.table(
        f"explain on {result['sets']} sets with known hidden effects, {result['generator']} generator",
        ("measure", "yes", "of", "share", "wanted"),
        [[row["measure"], row["yes"], row["of"], row["share"], row["wanted"]]
         for row in result["rows"]])


def _keep_to(cores: Any) -> None:
    """Keep this process to one core, so that `explain` starts no others."""
    core = cores.get()
    if core >= 0:
        os.sched_setaffinity(0, {core})


def _truth(f: Judged) -> set[str]:
    return set(f.case.effects)


def _first(f: Judged) -> bool:
    if not f.sets:
        return False
    return f.named[0] in f.case.effects or (len(f.sets[0]) == 2 and _truth(f) <= f.sets[0])


def _row(measure: str, wanted: str, hits: Iterable[bool]) -> Result:
    seen = list(hits)
    return {"measure": measure, "yes": sum(seen), "of": len(seen), "wanted": wanted,
            "share": sum(seen) / len(seen) if seen else None}


def _gain_row(found: list[Judged]) -> Result:
    """Median share of the possible gain over the sets where a gain is claimed and possible."""
    shares = [f.reduction / f.possible for f in found
              if f.reduction is not None and f.possible is not None and f.possible > LEAST_POSSIBLE]
    return {"measure": "gain on runs never fitted, share of the possible: median",
            "yes": None, "of": len(shares), "wanted": ">= 0.90",
            "share": float(np.median(shares)) if shares else None,
            "quartiles": [float(q) for q in np.quantile(shares, [0.25, 0.75])] if shares else None}


def _plain(f: Judged) -> dict[str, Any]:
    return {"hidden": f.case.effects, "verdict": f.verdict, "named": f.named,
            "sets": [sorted(s) for s in f.sets], "covered": f.covered, "gain": f.reduction,
            "possible_gain": f.possible,
            "seconds": f.seconds}


def generator(module: str) -> ModuleType:
    """A module of `tests/generator`. Raises ConfigError where there is none."""
    if not (_FOLDER / f"{module}.py").is_file():
        raise ConfigError("bench explain needs tests/generator, which only a clone of the project "
                          "has; run it there")
    # by the name that it has in the tests: its compiled functions are kept under that name
    if str(_FOLDER.parent) not in sys.path:
        sys.path.insert(0, str(_FOLDER.parent))
    return importlib.import_module(f"{_FOLDER.name}.{module}")
