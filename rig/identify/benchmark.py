"""Measures `explain` on stops with known hidden causes, from a generator that shares no code with it.

The generator lives in the project's tests (`tests/generator`), so this runs from a clone only.
Rates are printed with their counts: a table from few sets says little.
"""

import importlib.util
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

from rollerrig.configs.errors import ConfigError
from rollerrig.rig.identify import dataset, explain, extension

_GENERATOR = Path(__file__).resolve().parents[2] / "tests" / "generator" / "braking_stops.py"
PAIRS = (("rail_cleaning", "running_resistance"), ("brake_gain", "friction_trend"),
         ("wheel_radius", "adhesion_memory"), ("pad_fade", "rail_cleaning"),
         ("torque_sensor_delay", "contaminated_patch"), ("load_transfer", "running_resistance"))


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("braking_stops", _GENERATOR)
    if spec is None or spec.loader is None or not _GENERATOR.is_file():
        raise ConfigError("bench explain needs the generator of the tests, tests/generator; run it "
                          "from a clone of the project")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _judge(make: ModuleType, effects: dict[str, float], seed: int, folder: Path) -> dict[str, Any]:
    account = explain.braking_runs(
        dataset.load(make.make(folder / f"set_{seed}", effects, seed)), 0, lambda *_: None)
    named = [n.finding.name for n in account.causes]
    sets = set(named) | {other for n in account.causes for other in n.confusable}
    return {"verdict": account.verdict, "named": named, "set": sets, "seconds": account.elapsed_s,
            "claimed": account.gain is not None and account.gain.claimed,
            "values": [extension.parameters(n) for n in account.causes]}


def bench_explain(nothing: int = 20, sizes: tuple[float, ...] = (1.0, 1.5, 2.0), pairs: int = 6,
                  unknown: int = 5) -> list[dict[str, Any]]:
    """Rows (measure, right, of, share) over hidden causes; 90 s a set on two cores.

    Raises ConfigError where the generator of the tests is not there.
    """
    make = _generator()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        clean = [_judge(make, {}, 1000 + k, folder) for k in range(nothing)]
        single = {(cause, size): _judge(make, {cause: size * least}, 2000 + 10 * k + i, folder)
                  for k, (cause, least) in enumerate(make.SMALLEST.items())
                  for i, size in enumerate(sizes)}
        double = [(pair, _judge(make, {c: 2.0 * make.SMALLEST[c] for c in pair}, 3000 + k, folder))
                  for k, pair in enumerate(PAIRS[:pairs])]
        strange = [_judge(make, {name: size}, 4000 + k, folder)
                   for k, (name, size) in enumerate(list(make.UNKNOWN.items())[:unknown])]
    every = [*clean, *single.values(), *(found for _, found in double), *strange]
    detected = {key: found for key, found in single.items() if found["verdict"] != "consistent"}
    return [
        _row("nothing hidden: consistent", [f["verdict"] == "consistent" for f in clean]),
        _row("one cause: detected", [f["verdict"] != "consistent" for f in single.values()]),
        _row("one cause: named first, of detected",
             [f["named"][:1] == [c] for (c, _), f in detected.items()]),
        _row("one cause: in the named set, of detected",
             [c in f["set"] for (c, _), f in detected.items()]),
        _row("one cause: false second cause", [len(f["named"]) > 1 for f in single.values()]),
        _row("two causes: both named",
             [set(pair) <= f["set"] for pair, f in double]),
        _row("cause not in the library: named something", [bool(f["named"]) for f in strange]),
        _row("a set in 90 s", [f["seconds"] <= 90.0 for f in every]),
    ]


def _row(measure: str, hits: list[bool]) -> dict[str, Any]:
    return {"measure": measure, "right": sum(hits), "of": len(hits),
            "share": sum(hits) / len(hits) if hits else None}
