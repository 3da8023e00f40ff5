"""What is hidden in which set, and the sets themselves: datasets without truth, and the key beside them.

The generators are those of the project's tests (`tests/generator`), by three authors, the third with MuJoCo; they share
no code with the rig and hide each cause in another form than the rig's table writes it.

    DIR/sets/set_0001/dataset.toml, runs/*.csv  what a tool is given
    DIR/key                                     what was hidden; encoded, so that nobody reads it by accident
"""

import importlib
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, islice
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.errors import ConfigError
from rollerrig.realtime.record import seal
from rollerrig.realtime.record.files import writing
from sealed import work

GENERATORS = {"first": "braking_stops", "second": "other_stops", "third": "mujoco_stops"}
KINDS = ("none", "one", "two", "unknown")
NOTHING, SIZES = 30, (1.0, 2.0)
SETS, KEY = "sets", "key"
_FORMAT = "rollerrig sealed benchmark 1\n"


class Case(NamedTuple):
    """One set to be made: its kind, what is hidden at which size, its seed."""

    kind: str  # one of KINDS
    effects: dict[str, float]
    seed: int


def cases(make: ModuleType, seed: int) -> list[Case]:
    """One turn of the matrix."""
    none = [Case("none", {}, seed + 1000 + k) for k in range(NOTHING)]
    one = [
        Case(
            "one",
            {cause: min(size * least, make.LARGEST.get(cause, np.inf))},
            seed + 2000 + 10 * k + i,
        )
        for i, size in enumerate(SIZES)
        for k, (cause, least) in enumerate(make.SMALLEST.items())
    ]
    two = [Case("two", pair, seed + 3000 + k) for k, pair in enumerate(make.PAIRS)]
    unknown = [
        Case("unknown", {name: size}, seed + 4000 + k)
        for k, (name, size) in enumerate(make.UNKNOWN.items())
    ]
    # each kind spread evenly, in an order that tells nothing: the first N sets are a fair share of all
    rng = np.random.default_rng((seed, 15))
    placed = [
        ((k + rng.random()) / len(kind), kind[i])
        for kind in (none, one, two, unknown)
        for k, i in enumerate(rng.permutation(len(kind)))
    ]
    return [case for _, case in sorted(placed, key=lambda pair: pair[0])]


def stream(make: ModuleType, seed: int) -> Iterator[Case]:
    """The matrix again and again, each time with other seeds."""
    for turn in count():
        yield from cases(make, seed + 10_000 * turn)


def generator(module: str) -> ModuleType:
    """A module of `tests/generator`. Raises ConfigError where there is not what it needs."""
    try:
        return importlib.import_module(f"generator.{module}")
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise ConfigError(
            "--generator third needs MuJoCo: pip install 'rollerrig[mujoco]'"
        ) from None


def export(folder: Path, by: str, sets: int, seed: int, say: Callable[[str], None]) -> None:
    """Write the first sets (0: one turn of the matrix) of a generator, and the key. Raises ConfigError.

    A folder that has some of them already, as after an interruption or to grow, is completed; one of another generator
    or seed is refused.
    """
    make = generator(GENERATORS[by])
    wanted = {
        f"set_{k:04d}": case
        for k, case in enumerate(
            islice(stream(make, seed), sets or len(cases(make, seed))), start=1
        )
    }
    about: dict[str, Any] = {"generator": by, "seed": seed}
    key = read_key(folder) if (folder / KEY).exists() else about | {"sets": {}}
    if {name: key[name] for name in about} != about:
        raise ConfigError(
            f"{folder} holds sets of the {key['generator']} generator, seed {key['seed']}; give another "
            f"folder, or --generator {key['generator']} --seed {key['seed']} to complete it"
        )
    missing = [(name, case) for name, case in wanted.items() if name not in key["sets"]]
    for done, (name, case, truth) in enumerate(
        work.all_of(partial(_make, folder / SETS, by), missing), start=1
    ):
        key["sets"][name] = truth | {"kind": case.kind, "effects": case.effects}
        _write_key(folder, key)
        say(f"{done} of {len(missing)} sets made")


def read_key(folder: Path) -> dict[str, Any]:
    """The key of an exported benchmark. Raises ConfigError where there is none."""
    try:
        text = (folder / KEY).read_text(encoding="ascii")
        if not text.startswith(_FORMAT):
            raise ConfigError("its first line is another one")
        return seal.opened(text.removeprefix(_FORMAT), "its text")
    except (OSError, ValueError, ConfigError) as error:
        raise ConfigError(
            f"{folder / KEY} is no key of a benchmark ({error}); give the folder that "
            "rollerrig bench explain --export wrote"
        ) from None


def _write_key(folder: Path, key: dict[str, Any]) -> None:
    part = folder / f"{KEY}.part"
    with writing(folder / KEY, "give another folder"):
        part.write_text(_FORMAT + seal.shut(key), encoding="ascii")
        part.replace(folder / KEY)


def _make(folder: Path, by: str, job: tuple[str, Case]) -> tuple[str, Case, dict[str, Any]]:
    """Make one set; what its coefficients mean, and the errors of the base with and without what is hidden."""
    name, case = job
    make = generator(GENERATORS[by])
    made, errors, clean = (
        make.make(folder / name, case.effects, case.seed),
        dict[str, float](),
        dict[str, float](),
    )
    if case.kind in ("one", "two"):  # a gain can be won; of unknown effects nobody knows how much
        # the same stops, same seed, with nothing hidden: what is left there no model can take away
        with tempfile.TemporaryDirectory(prefix="rollerrig-sealed-") as place:
            clean = _errors(make.make(Path(place, "twin"), {}, case.seed))
        errors = _errors(made)
    meaning = {
        cause: (*make.SAME_MEANING[cause][:1], make.SAME_MEANING[cause][1] * size)
        for cause, size in case.effects.items()
        if cause in make.SAME_MEANING
    }
    return (
        name,
        case,
        {"meaning": meaning, "base_error": errors if clean else {}, "least_error": clean},
    )


def _errors(dataset_folder: Path) -> dict[str, float]:
    """Errors of the fitted base on stops that were not fitted, by metric; none of data that `explain` refuses."""
    from rollerrig.rig.identify.causes import candidates
    from rollerrig.rig.identify.data import dataset, preparation
    from rollerrig.rig.identify.decide import fitting, gain

    try:
        data = dataset.load(dataset_folder)
    except ConfigError:
        return {}
    design, held = (preparation.prepare(data, data.group(g)) for g in ("tune", "validate"))
    base, *_ = fitting.fit(design, candidates.start(design))
    return {metric: gain.error(held, base, metric) for metric in (gain.ADHESION, gain.FREE_RUN)}
