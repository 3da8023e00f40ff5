"""Many runs from one plan: a matrix or a random design over any value of a scenario.

A plan is resolved into numbered runs, cut into chunks; a chunk is one file of the result, written whole when its runs
are done. So a campaign that was killed goes on where it stopped, nothing that is done is computed again, and the result
is the same however the chunks were spread: over the cores of this machine, or over a Dask cluster.
"""

import hashlib
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from concurrent.futures.process import BrokenProcessPool
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.stats import qmc

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError, RollerrigError
from rollerrig.configs.processes import children
from rollerrig.configs.table import choice, integer
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.campaign import four_stops
from rollerrig.realtime.record import figures, summary
from rollerrig.realtime.record.files import replaced, writing

DESIGNS = ("matrix", "sobol", "halton", "latin_hypercube", "random")
ROWS = (
    choice("title", "", (), "a sentence"),
    choice("scenario", "velim_a1", (), "configs/scenarios"),
    choice("unit", "reference", (), "reference, none, or package.module:function"),
    choice("design", "matrix", DESIGNS, "how values are combined"),
    integer("runs", 64, 1, 10_000_000, "of a random design"),
    integer("seed", 0, 0, 2**31 - 1, "of a random design"),
    integer("chunk", 20, 1, 10_000, "runs in one file of the result"),
)
RANGE = (
    table.number("low", None, -1e300, 1e300, "-"),
    table.number("high", None, -1e300, 1e300, "-"),
    table.flag("log", False, "spread evenly in the logarithm"),
)
# how often worker processes of this machine may die before a campaign gives up
DEATHS = 4


class Plan(NamedTuple):
    """A campaign: `axes` names the varied values, `points` holds a row of them for each run."""

    head: dict[str, Any]
    axes: tuple[str, ...]
    points: tuple[tuple[Any, ...], ...]
    first: int = 0  # number of the first run in `points`

    @property
    def chunks(self) -> range:
        return range(-(-len(self.points) // self.head["chunk"]))


def load(name: str, **heads: Any) -> Plan:
    """A plan by name or path, with other head values. Raises ConfigError.

    The first and the last run are resolved to find bad values early.
    """
    given, path = store.load("campaigns", name)
    given = given | heads
    vary = given.pop("vary", {})
    head = table.read(ROWS, given, str(path))
    if not isinstance(vary, dict) or not vary:
        raise ConfigError(
            f'{path}: [vary] names nothing; write, as in "adhesion.mu_cd" = [0.03, 0.06] or '
            "{ low = 0.03, high = 0.1 }"
        )
    scene = head["scenario"]
    if scene.endswith(".toml"):
        head["scenario"] = str(store.find("scenarios", scene, path).resolve())
    points = _matrix(vary, path) if head["design"] == "matrix" else _random(vary, head, path)
    plan = Plan(head, tuple(vary), tuple(points))
    _unit(head["unit"])
    resolve(plan, 0)
    resolve(plan, len(plan.points) - 1)
    return plan


def _matrix(vary: Mapping[str, Any], path: Path) -> list[tuple[Any, ...]]:
    for key, values in vary.items():
        if not isinstance(values, list) or not values:
            raise ConfigError(
                f"{path} [vary] {key} = {values!r}: a matrix wants a list of values; for a range set "
                'design = "sobol"'
            )
    return list(itertools.product(*vary.values()))


def _random(vary: Mapping[str, Any], head: dict[str, Any], path: Path) -> list[tuple[Any, ...]]:
    bounds = []
    for key, span in vary.items():
        if not isinstance(span, dict):
            raise ConfigError(
                f"{path} [vary] {key} = {span!r}: a {head['design']} design wants "
                '{ low = ..., high = ... }; for a list set design = "matrix"'
            )
        span = table.read(RANGE, span, f"{path} [vary] {key}")
        if not span["low"] < span["high"] or (span["log"] and span["low"] <= 0.0):
            raise ConfigError(
                f"{path} [vary] {key}: low = {span['low']:g} and high = {span['high']:g} "
                "must rise, and be above 0 where log = true"
            )
        bounds.append(span)
    design, runs, seed = head["design"], head["runs"], head["seed"]
    if design == "random":
        sample = np.random.default_rng(seed).random((runs, len(bounds)))
    elif design == "sobol":
        # a Sobol sequence is balanced only in powers of two; take the first of enough
        sample = qmc.Sobol(len(bounds), rng=seed).random_base2(max(runs - 1, 1).bit_length())[:runs]
    else:
        kind = qmc.Halton if design == "halton" else qmc.LatinHypercube
        sample = kind(len(bounds), rng=seed).random(runs)
    return [
        tuple(
            span["low"] * (span["high"] / span["low"]) ** share
            if span["log"]
            else span["low"] + (span["high"] - span["low"]) * share
            for share, span in zip(row, bounds, strict=True)
        )
        for row in sample.tolist()
    ]


def _unit(name: str) -> str | free.UnitCall:
    if name in ("reference", "none"):
        return name
    module, _, function = name.partition(":")
    try:
        return getattr(import_module(module), function)()
    except (ImportError, AttributeError, ValueError) as error:
        raise ConfigError(
            f'unit = "{name}": {error}; write reference, none, or package.module:function, '
            "a function that returns a unit: a call from 8 integers to a byte"
        ) from None


def resolve(plan: Plan, number: int) -> scenario.Scenario:
    """The scenario of run `number`."""
    return scenario.load(plan.head["scenario"], "", settings(plan, number))


def settings(plan: Plan, number: int) -> tuple[str, ...]:
    """What run `number` changes, as `--set` takes it."""
    values = plan.points[number - plan.first]
    return tuple(f"{key}={json.dumps(value)}" for key, value in zip(plan.axes, values, strict=True))


def command(plan: Plan, number: int) -> str:
    """The command line that replays a run with its record."""
    sets = " ".join(f"--set {setting}" for setting in settings(plan, number))
    unit = plan.head["unit"] if plan.head["unit"] in ("reference", "none") else "external"
    pacing = "lockstep" if unit == "external" else "free"
    return f"rollerrig run {plan.head['scenario']} --pacing {pacing} --wsp {unit} {sets}"


def _piece(plan: Plan, chunk: int) -> Plan:
    """The plan with the runs of one chunk, which is all that a worker needs."""
    size = plan.head["chunk"]
    begin = chunk * size - plan.first
    return plan._replace(points=plan.points[begin : begin + size], first=chunk * size)


def run_chunk(plan: Plan, chunk: int) -> list[dict[str, Any]]:
    """Run one chunk; a row a run. One that fails has its error, one that is not valid its reasons, and no figures."""
    piece, nothing = (
        _piece(plan, chunk),
        dict.fromkeys(
            ("stopped", "valid", "invalid_because", *figures.BY_NAME, "config_hash", "error")
        ),
    )
    rows: dict[int, dict[str, Any]] = {
        number: {"run": number, **dict(zip(plan.axes, point, strict=True)), **nothing}
        for number, point in enumerate(piece.points, start=piece.first)
    }

    def resolved() -> Iterator[tuple[int, scenario.Scenario]]:
        for number, row in rows.items():
            try:
                yield number, resolve(plan, number)
            except RollerrigError as error:
                row["error"] = str(error)

    for number, one, channels in four_stops.together(resolved(), _unit(plan.head["unit"])):
        found = summarize(one, channels, plan.head["unit"])
        rows[number] |= {figure.name: figure.of(found) for figure in figures.FIGURES}
        rows[number] |= {key: found[key] for key in ("stopped", "valid", "config_hash")}
        rows[number]["invalid_because"] = "; ".join(found["invalid_because"]) or None
    return list(rows.values())


def summarize(
    plan: scenario.Scenario, channels: dict[str, np.ndarray], unit: str
) -> dict[str, Any]:
    """The summary of a run in memory, as a recorded run in free pacing has it."""
    ticks = round(float(channels["time_s"][-1]) * plan["loop"]["tick_hz"])
    return summary.of(
        channels,
        {
            "pacing": "free",
            "seed": 0,
            "unit": unit,
            "config_hash": scenario.digest(plan),
            "scenario": plan.name,
            "loop": {"ticks": ticks, "missed": 0},
        },
        plan.resolved,
    )


# --- the result ---


def open_result(plan: Plan, out: Path) -> list[int]:
    """Make or reopen a result folder; the chunks that are still to be done. Raises ConfigError."""
    mark, text = (
        out / "plan.json",
        json.dumps([plan.head, plan.axes, plan.points, "valid"], sort_keys=True),
    )
    found = hashlib.sha256(text.encode()).hexdigest()[:16]  # what the folder belongs to
    if mark.is_file() and json.loads(mark.read_text())["fingerprint"] != found:
        raise ConfigError(
            f"{out} holds the results of another plan or version; give a new folder with --out, or "
            "remove it"
        )
    with writing(out):
        (out / "results").mkdir(parents=True, exist_ok=True)
        mark.write_text(
            json.dumps(
                {
                    "fingerprint": found,
                    "head": plan.head,
                    "axes": plan.axes,
                    "runs": len(plan.points),
                },
                indent=1,
            )
        )
    return [chunk for chunk in plan.chunks if not part(out, chunk).is_file()]


def part(out: Path, chunk: int) -> Path:
    """The file of one chunk."""
    return out / "results" / f"part-{chunk:06d}.parquet"


def write_chunk(out: Path, chunk: int, rows: list[dict[str, Any]]) -> None:
    """Put the rows of a chunk into its file, in one step. Raises RollerrigError where it cannot."""
    fixed = {
        "run": pa.int64(),
        "stopped": pa.bool_(),
        "valid": pa.bool_(),
        "vents": pa.int64(),
        **dict.fromkeys(("invalid_because", "config_hash", "error"), pa.string()),
    }
    schema = pa.schema(
        [
            (key, fixed.get(key, pa.string() if isinstance(value, str) else pa.float64()))
            for key, value in rows[0].items()
        ]
    )
    try:
        with replaced(part(out, chunk)) as new:
            pq.write_table(pa.Table.from_pylist(rows, schema=schema), new)
    except OSError as error:
        raise RollerrigError(
            f"{part(out, chunk)}: cannot be written: {error}; what is done is kept: "
            "make room, and the same command goes on"
        ) from None


def result(out: Path) -> pa.Table:
    """All rows of a result folder, by run. Raises ConfigError if there is none."""
    parts = sorted((out / "results").glob("part-*.parquet"))
    if not parts:
        raise ConfigError(f"{out}: no results; run 'rollerrig campaign PLAN --out {out}'")
    return pa.concat_tables([pq.read_table(path) for path in parts]).sort_by("run")


# --- spreading ---


def spread_local(
    plan: Plan, chunks: Sequence[int], workers: int
) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Run chunks in processes, as they are done, anew those that a dead one took along. Raises RollerrigError."""
    left = dict.fromkeys(chunks)
    for _ in range(DEATHS):
        with children.pool(workers) as pool:
            futures = {pool.submit(run_chunk, _piece(plan, chunk), chunk): chunk for chunk in left}
            try:
                for future in as_completed(futures):
                    rows = future.result()
                    del left[futures[future]]
                    yield futures[future], rows
                return
            except BrokenProcessPool:
                continue
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    raise RollerrigError(
        f"worker processes died {DEATHS} times (killed, or out of memory?): {len(left)} chunks are "
        "left, what is done is kept; give --workers fewer, and the same command goes on"
    )


def spread_dask(
    plan: Plan, chunks: Sequence[int], address: str
) -> Iterator[tuple[int, list[dict[str, Any]]]]:
    """Run chunks on a Dask cluster, as they are done; work of a worker that dies is given to another."""
    try:
        from distributed import CancelledError, Client, KilledWorker
        from distributed import as_completed as completed
        from distributed.comm import CommClosedError
    except ImportError:
        raise ConfigError("--scheduler needs Dask: pip install 'rollerrig[cluster]'") from None
    try:
        client = Client(address, timeout=10)
    except OSError as error:
        raise ConfigError(
            f"--scheduler {address}: no Dask scheduler answers ({error}); start one with "
            "'dask scheduler --host 127.0.0.1' and workers with 'dask worker ADDRESS'"
        ) from None
    with client:
        # nothing is scattered: data that only a lost worker had would take the work with it
        futures = {
            client.submit(run_chunk, _piece(plan, chunk), chunk, pure=False, retries=3): chunk
            for chunk in chunks
        }
        try:
            for future, rows in completed(futures, with_results=True):
                yield futures[future], rows
                future.release()
        except (KilledWorker, CommClosedError, CancelledError, OSError) as error:
            raise RollerrigError(
                f"--scheduler {address}: the cluster gave up ({error}); what is done is kept, and the "
                "same command goes on"
            ) from None
