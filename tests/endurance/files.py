"""`rollerrig bench files`: each kind of file that rollerrig reads, damaged in a thousand ways.

A damaged file is read, or it is refused with a message of the program. Anything else is a defect:
an exception that is not the program's, a process that dies, and one that takes minutes or much
memory. Each file is read in a process of its own, with limits. What fails is kept in
`reports/bench_files`.
"""

import argparse
import importlib
import json
import os
import random
import re
import resource
import shutil
import signal
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from rich.table import Table

from rollerrig.configs.errors import RollerrigError
from rollerrig.realtime.benchmarks import figures
from rollerrig.realtime.benchmarks.figures import Result, Say, target

ROOT = Path(__file__).parents[2]
FIELD = ROOT / "tests" / "data" / "field"
KEPT = Path("reports") / "bench_files"
# of each kind
FILES = 1000
# limits of a process that reads a file, and requirements for what it takes
_ADDRESS_SPACE_BYTES = 6_000_000_000
_LONGEST_S = 60.0
_LIMIT_S = 20.0
_LIMIT_MB = 900.0
# numbers of a text become one of these
_NUMBERS = (b"-1", b"0", b"nan", b"inf", b"1e999", b"9" * 400, b"''", b"[]", b"true", b"2026-11-31")
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:e[-+]?\d+)?")
READ = "read"
REFUSED = "refused"
FOREIGN = "other exceptions"
DIED = "died"
OUTCOMES = (READ, REFUSED, FOREIGN, DIED)


class Kind(NamedTuple):
    """A kind of file.

    `prepare` writes a folder and returns the files in it that are damaged in turn; `read` reads one
    of them as the program does.
    """

    prepare: Callable[[Path], list[Path]]
    read: Callable[[Path], object]


# what the readers import; a forked process has them already
_MODULES = (
    "asammdf",
    "cantools",
    "fmpy",
    "pyarrow.csv",
    "pyarrow.parquet",
    "rosbags.highlevel",
    "scipy.optimize",
    "rollerrig.firmware_sim.faults.catalogue",
    "rollerrig.firmware_sim.fmu.fmu_file",
    "rollerrig.realtime.bench.scenario",
    "rollerrig.realtime.campaign.campaign",
    "rollerrig.realtime.commands.check",
    "rollerrig.realtime.datasets.imported",
    "rollerrig.realtime.record.records",
    "rollerrig.rig.adhesion_profile",
    "rollerrig.rig.identify.data.dataset",
    "rollerrig.rig.identify.train_recorder.recording",
    "rollerrig.wsp_interface.sequences.programme",
    "rollerrig.wsp_interface.unit_map.mapping",
)


def run(given: argparse.Namespace, say: Say) -> Result:
    """Damage and read `--count` files of each kind."""
    for module in _MODULES:
        importlib.import_module(module)
    count = given.count or FILES
    kinds = {}
    failures = []
    shutil.rmtree(KEPT, ignore_errors=True)
    for name, kind in KINDS.items():
        say(f"{name} ...")
        with tempfile.TemporaryDirectory() as place:
            found = [*judged(name, kind, Path(place), count, random.Random(f"{given.seed} {name}"))]
        failures += [line for line in found if line["outcome"] in (FOREIGN, DIED)]
        kinds[name] = {
            "outcomes": Counter(line["outcome"] for line in found),
            "longest_s": max(line["elapsed_s"] for line in found),
            "memory_MB": max(line["memory_MB"] for line in found),
        }
    by_outcome = {one: sum(kind["outcomes"][one] for kind in kinds.values()) for one in OUTCOMES}
    return {
        "kinds": kinds,
        "failures": failures,
        "targets": [
            target("exceptions that are not of the program", float(by_outcome[FOREIGN]), 0.0),
            target("processes that died", float(by_outcome[DIED]), 0.0),
            target(
                "processor time, the most",
                max(kind["longest_s"] for kind in kinds.values()),
                _LIMIT_S,
                "s",
            ),
            target(
                "memory, the most",
                max(kind["memory_MB"] for kind in kinds.values()),
                _LIMIT_MB,
                "MB",
            ),
        ],
        "notes": [f"{line['kept']}: {line['text']}" for line in failures],
    }


def judged(name: str, kind: Kind, place: Path, count: int, source: random.Random) -> Any:
    """Yield what became of each damaged file of a kind, which is kept if it failed."""
    # forked processes must not inherit threads of libraries: the files are prepared apart, too
    names = apart(lambda: [str(path) for path in kind.prepare(place)])
    if names["outcome"] != READ:
        raise RollerrigError(f"{name}: the files cannot be prepared: {names['text']}")
    whole = {Path(path): Path(path).read_bytes() for path in names["value"]}
    for path in whole:
        sound = apart(lambda path=path: kind.read(path))
        if sound["outcome"] != READ:
            raise RollerrigError(f"{name}: {path.name} is refused undamaged: {sound['text']}")
    for number in range(count):
        path, content = source.choice(list(whole.items()))
        damage = damaged(content, source)
        path.write_bytes(damage)
        line = apart(lambda path=path: kind.read(path))
        path.write_bytes(content)
        if line["outcome"] in (FOREIGN, DIED):
            KEPT.mkdir(parents=True, exist_ok=True)
            kept = KEPT / f"{number}_{path.name}"
            kept.write_bytes(damage)
            line["kept"] = str(kept)
        yield line


def damaged(content: bytes, source: random.Random) -> bytes:
    """Return a content with one to three places changed."""
    changed = bytearray(content)
    for _ in range(source.randint(1, 3)):
        begin = source.randrange(len(changed) + 1)
        end = min(begin + source.choice((1, 2, 8, 64, 1024)), len(changed))
        how = source.choice(("bits", "noise", "lost", "twice", "cut", "number", "number"))
        if how == "number":
            numbers = [*_NUMBER.finditer(changed)]
            if numbers:
                begin, end = source.choice(numbers).span()
                changed[begin:end] = source.choice(_NUMBERS)
        elif how == "bits":
            for place in range(begin, min(begin + 3, end)):
                changed[place] ^= 1 << source.randrange(8)
        elif how == "noise":
            changed[begin:end] = source.randbytes(end - begin)
        elif how == "lost":
            del changed[begin:end]
        elif how == "twice":
            changed[begin:begin] = changed[begin:end]
        elif how == "cut":
            del changed[begin:]
    return bytes(changed)


def apart(work: Callable[[], object]) -> dict[str, Any]:
    """Do some work in a forked process with limits; return its outcome, time and memory.

    `value` is what the work returns, if that is a list.
    """
    readable, writable = os.pipe()
    pid = os.fork()
    if not pid:
        os.close(readable)
        try:
            _limit()
            answer = json.dumps(_outcome(work)).encode()
            with os.fdopen(writable, "wb") as pipe:
                pipe.write(answer)
        finally:
            os._exit(0)
    os.close(writable)
    with os.fdopen(readable, "rb") as pipe:
        answer = pipe.read()
    _, status, used = os.wait4(pid, 0)
    line: dict[str, Any] = {
        "outcome": DIED,
        "text": f"the process ended with status {status}",
        "value": None,
    }
    if answer:
        line = json.loads(answer)
    line["elapsed_s"] = used.ru_utime + used.ru_stime
    line["memory_MB"] = used.ru_maxrss / 1000.0
    return line


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE_BYTES,) * 2)
    signal.alarm(int(_LONGEST_S))
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nowhere, stream)


def _outcome(work: Callable[[], object]) -> dict[str, Any]:
    try:
        value = work()
    except RollerrigError as error:
        return {"outcome": REFUSED, "text": str(error), "value": None}
    except BaseException as error:
        return {"outcome": FOREIGN, "text": f"{type(error).__name__}: {error}", "value": None}
    return {"outcome": READ, "text": "", "value": value if isinstance(value, list) else None}


# --- the kinds ---


def _copies(*files: Path) -> Callable[[Path], list[Path]]:
    def prepare(place: Path) -> list[Path]:
        return [Path(shutil.copy(file, place / file.name)) for file in files]

    return prepare


def _packaged(kind: str) -> Callable[[Path], list[Path]]:
    return _copies(*sorted((ROOT / "configs" / kind).glob("*.toml")))


def _folder(folder: Path, *names: str) -> Callable[[Path], list[Path]]:
    def prepare(place: Path) -> list[Path]:
        shutil.copytree(folder, place, dirs_exist_ok=True)
        return [place / name for name in names]

    return prepare


def _scenario(path: Path) -> None:
    from rollerrig.realtime.bench import scenario

    scenario.load(str(path))


def _sequence(path: Path) -> None:
    from rollerrig.firmware_sim.faults import catalogue
    from rollerrig.wsp_interface.sequences import sequence

    sequence.load(path, catalogue.parse)


def _programme(path: Path) -> None:
    from rollerrig.wsp_interface.sequences import programme

    programme.load(str(path))


def _plan(path: Path) -> None:
    from rollerrig.realtime.campaign import campaign

    campaign.load(str(path))


def _dataset(path: Path) -> None:
    from rollerrig.rig.identify.data import dataset

    dataset.load(path.parent)


def _recording(path: Path) -> None:
    from rollerrig.rig.identify.train_recorder import recording

    recording.load(_root(path))


def _root(path: Path) -> Path:
    """Return the folder of a dataset above one of its files."""
    return path.parent if (path.parent / "dataset.toml").exists() else path.parent.parent


def _logger(path: Path) -> None:
    from rollerrig.realtime.datasets import imported

    imported.read(path, {"separator": "auto", "decimal": "auto"})


def _profile(path: Path) -> None:
    from rollerrig.rig import adhesion_profile

    adhesion_profile.read(path)


def _unit_map(path: Path) -> None:
    from rollerrig.configs.vehicle import COACH
    from rollerrig.wsp_interface import signals
    from rollerrig.wsp_interface.unit_map import mapping

    mapping.load(path.with_name("map.toml"), signals.table(COACH))


def _fmu(path: Path) -> None:
    from rollerrig.realtime.commands import check

    check.check_fmu(path, None, 0.01, 4)


def _run_folder(path: Path) -> None:
    from rollerrig.realtime.record import records

    run_of = records.load(path.parent)
    records.frames(path.parent)
    assert run_of.table is not None


def _write_parquet(place: Path) -> list[Path]:
    from pyarrow import csv, parquet

    shutil.copytree(FIELD / "min_unit_row", place, dirs_exist_ok=True)
    text = (place / "run.csv").read_text()
    # its second line has the units
    head, _, rest = text.split("\n", 2)
    (place / "run.csv").write_text(f"{head}\n{rest}")
    parquet.write_table(csv.read_csv(place / "run.csv"), place / "run.parquet")
    return [place / "run.parquet"]


def _command(*words: str) -> None:
    """Run a command of rollerrig. Raises RollerrigError if it fails; a short run is not valid."""
    from rollerrig.realtime import cli
    from rollerrig.realtime.commands import output

    status = cli.main([*words])
    if status not in (output.PASS, output.INVALID):
        raise RollerrigError(f"rollerrig {' '.join(words)}: exit status {status}")


def _write_mdf(place: Path) -> list[Path]:
    _write_run(place / "run")
    _command("export", str(place / "run"), "--format", "mdf4", "--out", str(place / "out.mf4"))
    return [place / "out.mf4"]


def _write_run(place: Path) -> list[Path]:
    words = ["run", "velim_a1", "--pacing", "free", "--set", "duration_max_s=0.5"]
    _command(*words, "--out", str(place))
    names = ("channels.parquet", "events.jsonl", "summary.json", "scenario.toml")
    return [place / name for name in names]


def _write_bag(storage: str) -> Callable[[Path], list[Path]]:
    def prepare(place: Path) -> list[Path]:
        import recorded_bag

        plugin = getattr(recorded_bag.PLUGINS, storage)
        recorded_bag.write(place, plugin=plugin)
        (place / "dataset.toml").write_text(recorded_bag.DATASET.replace("RUN", "run"))
        return sorted((place / "run").iterdir())

    return prepare


def _write_description(place: Path) -> list[Path]:
    import zipfile

    with zipfile.ZipFile(FIELD / "fmu_units" / "Hz.fmu") as archive:
        return [Path(archive.extract("modelDescription.xml", place))]


def _description(path: Path) -> None:
    import zipfile

    unit = path.with_suffix(".fmu")
    with zipfile.ZipFile(unit, "w") as archive:
        archive.write(path, "modelDescription.xml")
    _fmu(unit)


DATASETS = ROOT / "configs" / "datasets"
KINDS = {
    "scenario, TOML": Kind(_packaged("scenarios"), _scenario),
    "sequence, TOML": Kind(_packaged("sequences"), _sequence),
    "programme, TOML": Kind(_packaged("programmes"), _programme),
    "plan of a campaign, TOML": Kind(_packaged("campaigns"), _plan),
    "creep curve, TOML and CSV": Kind(
        _folder(DATASETS / "eurosprinter_127001", "dataset.toml", "curve.csv"), _dataset
    ),
    "braking runs, CSV": Kind(
        _folder(FIELD / "braking_latin1", "dataset.toml", "run.csv"), _dataset
    ),
    "recorder, CSV": Kind(_folder(FIELD / "min_unit_row", "dataset.toml", "run.csv"), _recording),
    "logger, CSV": Kind(_folder(ROOT / "docs" / "examples" / "import", "fahrt_1.csv"), _logger),
    "logger, Parquet": Kind(_write_parquet, _logger),
    "logger, MDF4": Kind(_write_mdf, _logger),
    "recorder, rosbag2": Kind(_write_bag("SQLITE3"), _recording),
    "recorder, MCAP": Kind(_write_bag("MCAP"), _recording),
    "map of a unit, TOML and DBC": Kind(
        _folder(FIELD / "unit_map", "map.toml", "unit.dbc"), _unit_map
    ),
    "FMU": Kind(_copies(FIELD / "fmu_units" / "Hz.fmu"), _fmu),
    "description of an FMU, XML": Kind(_write_description, _description),
    "recorded run, Parquet, JSON and TOML": Kind(_write_run, _run_folder),
}


def table(result: Result) -> Table:
    """Return what became of the files of each kind."""
    rows = [
        (
            name,
            sum(kind["outcomes"].values()),
            *(kind["outcomes"][outcome] for outcome in OUTCOMES),
            kind["longest_s"],
            kind["memory_MB"],
        )
        for name, kind in result["kinds"].items()
    ]
    heads = ("kind", "files", *OUTCOMES, "longest, s", "memory, MB")
    return figures.table("damaged files", heads, rows)
