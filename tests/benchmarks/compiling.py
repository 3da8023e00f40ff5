"""What each trick of rig/compiled buys: processor time with it and without it.

    .venv/bin/python tests/benchmarks/compiling.py                # all tricks, about half an hour
    .venv/bin/python tests/benchmarks/compiling.py --only "lazy cache" --repeats 9
    .venv/bin/python tests/benchmarks/compiling.py --markdown   # docs/compiled_kernels.md

Each measurement runs a command in a new process. For the case without a trick a few lines of Python
switch the trick off before the command begins. Cold starts have an empty cache of kernels. The
figure is user plus system time of the process and its children, because other programs take wall
time away. The two cases alternate, and the smallest time of each counts.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
# a cold start takes half a minute, so it is repeated only once for so many warm ones
COLD_REPEATS = 4


class Task(NamedTuple):
    """What a process does: Python source after the switch, and whether the cache of kernels is
    empty.
    """

    text: str
    source: str
    cold: bool = False


def command(*words: str) -> str:
    """Return the source that runs a command of rollerrig."""
    return f"from rollerrig.realtime import cli\nsys.exit(cli.main({[*words]!r}))\n"


SHORT = ("run", "velim_a1", "--pacing", "free", "--set", "duration_max_s=0.3", "--out", "OUT")
# 30 s of four sliding axles, without the start of the program and without compiling
STOP = """
from rollerrig.realtime.bench import free, scenario
settings = ["adhesion.mu_cd=0.025", "adhesion.mu_cr=0.1", "duration_max_s=SECONDS"]
def stop(seconds):
    plan = scenario.load("velim_a1", settings=[s.replace("SECONDS", seconds) for s in settings])
    begin_s = time.process_time()
    free.simulate(plan, "reference")
    return time.process_time() - begin_s
stop("0.1")
print("seconds", min(stop("30") for _ in range(3)))
"""
# twelve stops in lanes, without the start of the program and without compiling
LANES = """
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign.stops import stops_in_lanes
def stops(count):
    plans = [scenario.load("velim_a1", settings=[f"adhesion.mu_cd={0.04 + 0.002 * k}"]) for k in range(count)]
    begin_s = time.process_time()
    list(stops_in_lanes.together(enumerate(plans)))
    return time.process_time() - begin_s
stops(4)
print("seconds", min(stops(12) for _ in range(3)))
"""
ALONE = """
from rollerrig.realtime.bench import free
from rollerrig.realtime.campaign.stops import stops_in_lanes
stops_in_lanes.fits = lambda plan: False
"""

COLD = Task("first start of a run", command(*SHORT), cold=True)
WARM = Task("start of a run", command(*SHORT))
RUN = Task("30 s of a run", STOP)
EXPLAIN = Task("explain open_none", command("explain", "open_none", "--out", "OUT"))
CAMPAIGN = Task("12 stops of a campaign", LANES)

# kernels without some of their options
WITHOUT_OPTIONS = """
from rollerrig.rig.compiled import part
original = part.KernelDispatcher.__init__
def begin(self, py_func, locals=None, targetoptions=None, **more):
    options = targetoptions or dict()
    kept = dict((name, value) for name, value in options.items() if name not in {names!r})
    original(self, py_func, locals, kept, **more)
part.KernelDispatcher.__init__ = begin
"""
# each kernel is compiled as numba compiles any function
WITHOUT_PARTS = """
from rollerrig.rig.compiled import part
for name in ("get_call_template", "get_overload"):
    delattr(part.KernelDispatcher, name)
for name in ("add_linking_library", "finalize", "_get_module_for_linking"):
    delattr(part._Library, name)
"""
TYPES_OF_CONSTANTS = """
from rollerrig.rig.compiled import part
part.general_type = lambda kind: kind
"""
ALL_STEPS = """
from rollerrig.rig.compiled import part
part._FOR_OTHER_CODE.clear()
"""
# numba's own methods in the place of those that remember
NO_ANSWERS = """
from rollerrig.rig.compiled import known_answers
known_answers._of_types.resolve_function_type = known_answers._resolve_function_type
known_answers._of_code.get_function = known_answers._get_function
known_answers.base._has_loc = known_answers.base._has_loc.__wrapped__
"""
WITH_COLLECTOR = """
import gc
gc.disable = lambda: None
"""
# an empty setting is none
WITH_COLOURS = """
import os
os.environ["NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"] = ""
"""
# imports that fail with the trick succeed without it
WITH_PACKAGES = """
from rollerrig.configs.processes.without import without
original = without.find_spec
without.find_spec = lambda self, *name: None if self.package in {names!r} else original(self, *name)
"""


# numba's cache of each kernel, opened when the kernel is defined
NUMBAS_CACHE = """
from rollerrig.rig.compiled import lazy_cache
from rollerrig.rig.compiled.kernel_files import KernelFiles
lazy_cache.LazyCache = lambda function, counts_references: KernelFiles(function)
"""
PYTHONS_MATH = """
import math
from rollerrig.rig.compiled import vector_math
vector_math.MATH = math
"""
# exp, log and atan of the C library in the place of those that can be vectorised
LIBRARY_FUNCTIONS = """
import math
from rollerrig.rig.compiled import vector_math
from rollerrig.rig.compiled.kernel import inlined_without_cache
def library_exp(x):
    return math.exp(x)
def library_log(x):
    return math.log(x)
def library_atan(x):
    return math.atan(x)
vector_math.exp = inlined_without_cache(library_exp)
vector_math.log = inlined_without_cache(library_log)
vector_math.atan = inlined_without_cache(library_atan)
"""


class Trick(NamedTuple):
    """A trick: its name, the source that switches it off, and the tasks that show what it buys.

    `same_code`: the compiled code does not change, so both cases share a cache of kernels.
    """

    name: str
    switch_off: str
    tasks: tuple[Task, ...]
    same_code: bool = False


TRICKS = (
    # the case without it is a cold start
    Trick("cache on disk", "", (WARM,), same_code=True),
    Trick(
        "numba without yaml and scipy",
        WITH_PACKAGES.format(names=("yaml", "scipy")),
        (WARM,),
        same_code=True,
    ),
    Trick(
        "numba without scipy.linalg",
        WITH_PACKAGES.format(names=("scipy.linalg",)),
        (WARM,),
        same_code=True,
    ),
    Trick("lazy cache", NUMBAS_CACHE, (WARM,), same_code=True),
    Trick("parts", WITHOUT_PARTS, (COLD, RUN)),
    Trick("one part for all constants", TYPES_OF_CONSTANTS, (COLD,)),
    Trick("no steps for other code", ALL_STEPS, (COLD,)),
    Trick("known answers", NO_ANSWERS, (COLD,)),
    Trick("no collector while numba compiles", WITH_COLLECTOR, (COLD,)),
    Trick("no colours in numba's messages", WITH_COLOURS, (COLD,)),
    Trick("no reference counting", WITHOUT_OPTIONS.format(names=("_nrt",)), (COLD, RUN)),
    Trick("no wrapper for C", WITHOUT_OPTIONS.format(names=("no_cfunc_wrapper",)), (COLD,)),
    Trick("inlining", WITHOUT_OPTIONS.format(names=("forceinline",)), (COLD, RUN)),
    Trick("vector mathematics in explain", PYTHONS_MATH, (EXPLAIN,)),
    Trick("vector mathematics in campaigns", LIBRARY_FUNCTIONS, (CAMPAIGN,)),
    Trick("several stops in lanes", ALONE, (CAMPAIGN,), same_code=True),
)


class Figure(NamedTuple):
    """One result: seconds of processor time with the trick and without it."""

    trick: str
    task: str
    with_s: float
    without_s: float


def measure(trick: Trick, task: Task, repeats: int, caches: Path) -> Figure:
    """Return the smallest times of a task, measured alternately with the trick and without it."""
    if trick.name == "cache on disk":
        cases = [("with", "", task), ("with", "", task._replace(cold=True))]
    else:
        other_cache = "with" if trick.same_code else trick.name
        cases = [("with", "", task), (other_cache, trick.switch_off, task)]
    if any(what.cold for _, _, what in cases):
        repeats = max(1, repeats // COLD_REPEATS)
    for cache, switch, what in cases:
        if not what.cold:
            run(switch, what, caches / cache)  # fills the cache; not measured
    times_s: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for case, (cache, switch, what) in enumerate(cases):
            if what.cold:
                with tempfile.TemporaryDirectory() as empty:
                    times_s[case].append(run(switch, what, Path(empty)))
            else:
                times_s[case].append(run(switch, what, caches / cache))
    return Figure(trick.name, task.text, min(times_s[0]), min(times_s[1]))


def run(switch_off: str, task: Task, cache: Path) -> float:
    """Return the processor time in s of a new process: as it prints it, or of the whole
    process.
    """
    with tempfile.TemporaryDirectory() as out:
        source = "import sys, time\n" + switch_off + task.source.replace("OUT", f"{out}/out")
        before_s = children_s()
        done = subprocess.run(
            [sys.executable, "-c", source],
            cwd=ROOT / "tests",
            env=os.environ | {"XDG_CACHE_HOME": str(cache)},
            capture_output=True,
            text=True,
        )
        whole_s = children_s() - before_s
    printed = [line for line in done.stdout.splitlines() if line.startswith("seconds ")]
    if done.returncode not in (0, 1, 4):  # a short run is not valid, a verdict may be negative
        raise SystemExit(f"{task.text}: status {done.returncode}\n{source}\n{done.stderr[-3000:]}")
    return float(printed[0].split()[1]) if printed else whole_s


def children_s() -> float:
    """Return user plus system time in s of all child processes so far."""
    times = os.times()
    return times.children_user + times.children_system


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", help="name of a trick; may be repeated")
    parser.add_argument("--repeats", type=int, default=5, help="of each case (default: 5)")
    parser.add_argument("--caches", type=Path, help="folder of compiled kernels for the next call")
    parser.add_argument("--markdown", action="store_true", help="print a table for the document")
    given = parser.parse_args()
    names = [trick.name for trick in TRICKS]
    if unknown := set(given.only or ()) - set(names):
        parser.error(f"unknown trick: {', '.join(sorted(unknown))}; one of {', '.join(names)}")

    if given.markdown:
        print("| trick | task | with, s | without, s | saved, s |\n| --- | --- | --- | --- | --- |")
    begin_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="rollerrig-compiling-") as folder:
        caches = given.caches or Path(folder)
        for trick in TRICKS:
            if given.only and trick.name not in given.only:
                continue
            for task in trick.tasks:
                figure = measure(trick, task, given.repeats, caches)
                print(row(figure, given.markdown), flush=True)
    print(f"measured in {time.monotonic() - begin_s:.0f} s", file=sys.stderr)
    return 0


def row(figure: Figure, markdown: bool) -> str:
    """Return a figure as a line of the table."""
    times = (figure.with_s, figure.without_s, figure.without_s - figure.with_s)
    cells = [figure.trick, figure.task, *(f"{time_s:.2f}" for time_s in times)]
    if markdown:
        return f"| {' | '.join(cells)} |"
    return "{:33} {:36} with {:>7} s  without {:>7} s  saved {:>7} s".format(*cells)


if __name__ == "__main__":
    sys.exit(main())
