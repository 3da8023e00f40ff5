"""Decides what is hidden in which set, and writes the sets and the key.

The stops come from three generators in `tests/generator`, each by another author; the third uses
MuJoCo. They share no code with the rig, and each hides a cause in another form than the rig's table
of causes has. A set is one dataset of stops in which zero, one or two effects are hidden.

    DIR/sets/set_0001/dataset.toml, runs/*.csv   what a tool gets
    DIR/key                                      the truth; encoded, against reading by accident

The key is a table: `generator`, `seed`, and for each set

    kind          what is hidden: "none", "one", "two" or "unknown", see `KINDS`
    effects       size of each hidden effect by its name, in the unit of the generator
    meaning       (parameter, value) by cause, where the rig's table has a parameter of that meaning
    base_error    error of the fitted base model on the stops that were not fitted, by metric
    least_error   the same error where nothing is hidden in the same stops; no model can do better
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

from rollerrig.configs import user_files
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.output_files import write_text, writing
from rollerrig.realtime.record import seal
from sealed import work

# module of `tests/generator` by the name on the command line
GENERATORS = {"first": "braking_stops", "second": "other_stops", "third": "mujoco_stops"}
# nothing is hidden; one cause; two causes at a time; an effect that is not in the rig's table of
# causes
KINDS = ("none", "one", "two", "unknown")
# sets with nothing hidden in one round of the matrix
NOTHING_HIDDEN = 30
# each cause is hidden at these multiples of its smallest visible size
SIZES = (1.0, 2.0)
# seeds of two rounds of the matrix are so far apart
SEEDS_PER_ROUND = 10_000

# names in the exported folder
SETS = "sets"
KEY = "key"
# first line of a key
_FORMAT = "rollerrig sealed benchmark 1\n"


class Case(NamedTuple):
    """A set to be made."""

    kind: str  # one of KINDS
    effects: dict[str, float]  # size by name of the effect, in the unit of the generator
    seed: int


def cases(make: ModuleType, seed: int) -> list[Case]:
    """Return one round of the matrix: all sets of each kind, in random order.

    Each kind is spread evenly over the round, so that the first N sets contain a fair share of each
    kind. The order depends on the seed alone and carries no information on the truth.
    """
    none = [Case("none", {}, seed + 1000 + k) for k in range(NOTHING_HIDDEN)]
    one = []
    for i, multiple in enumerate(SIZES):
        for k, (cause, smallest) in enumerate(make.SMALLEST.items()):
            size = min(multiple * smallest, make.LARGEST.get(cause, np.inf))
            one.append(Case("one", {cause: size}, seed + 2000 + 10 * k + i))
    two = [Case("two", pair, seed + 3000 + k) for k, pair in enumerate(make.PAIRS)]
    unknown = [
        Case("unknown", {name: size}, seed + 4000 + k)
        for k, (name, size) in enumerate(make.UNKNOWN.items())
    ]

    rng = np.random.default_rng((seed, 15))
    placed: list[tuple[float, Case]] = []
    for kind in (none, one, two, unknown):
        order = rng.permutation(len(kind))
        for k, i in enumerate(order):
            place = (k + rng.random()) / len(kind)  # 0 to 1 in the round
            placed.append((place, kind[i]))
    placed.sort(key=lambda pair: pair[0])
    return [case for _, case in placed]


def stream(make: ModuleType, seed: int) -> Iterator[Case]:
    """Yield round after round of the matrix, each with other seeds, without end."""
    for number in count():
        yield from cases(make, seed + SEEDS_PER_ROUND * number)


def generator(name: str) -> ModuleType:
    """Return a generator by its name in `GENERATORS`. Raises ConfigError without MuJoCo."""
    try:
        return importlib.import_module(f"generator.{GENERATORS[name]}")
    except ModuleNotFoundError as error:
        if error.name != "mujoco":
            raise
        raise ConfigError(
            "--generator third needs MuJoCo; install it with: pip install 'rollerrig[mujoco]'"
        ) from None


def export(folder: Path, by: str, sets: int, seed: int, say: Callable[[str], None]) -> None:
    """Write the first sets of a generator, and the key. 0 sets: one round of the matrix.

    A folder that has some of the sets already, after an interruption or from a smaller number, is
    completed. Raises ConfigError for a folder with sets of another generator or seed.
    """
    make = generator(by)
    number = sets or len(cases(make, seed))
    wanted = {
        f"set_{k:04d}": case for k, case in enumerate(islice(stream(make, seed), number), start=1)
    }

    key: dict[str, Any] = {"generator": by, "seed": seed, "sets": {}}
    if (folder / KEY).exists():
        key = read_key(folder)
        if (key["generator"], key["seed"]) != (by, seed):
            raise ConfigError(
                f"{folder} holds sets of the {key['generator']} generator, seed {key['seed']}; "
                f"give another folder, or --generator {key['generator']} --seed {key['seed']} to "
                "complete it"
            )

    missing = [(name, case) for name, case in wanted.items() if name not in key["sets"]]
    made = work.all_of(partial(_make, folder / SETS, by), missing)
    for done, (name, case, truth) in enumerate(made, start=1):
        key["sets"][name] = truth | {"kind": case.kind, "effects": case.effects}
        _write_key(folder, key)
        say(f"{done} of {len(missing)} sets made")


def read_key(folder: Path) -> dict[str, Any]:
    """Return the key of an exported benchmark. Raises ConfigError where there is none."""
    path = folder / KEY
    try:
        text = user_files.read_text(path, user_files.KEY, within=folder)
        if not text.startswith(_FORMAT):
            raise ConfigError("its first line is wrong")
        return seal.decode(text.removeprefix(_FORMAT), "its text")
    except ConfigError as error:
        raise ConfigError(
            f"{path} is no key of a benchmark ({error}); give the folder that "
            "rollerrig bench explain --export wrote"
        ) from None


def _write_key(folder: Path, key: dict[str, Any]) -> None:
    with writing(folder / KEY, "give another folder"):
        write_text(folder / KEY, _FORMAT + seal.encode(key))


def _make(folder: Path, by: str, job: tuple[str, Case]) -> tuple[str, Case, dict[str, Any]]:
    """Make one set. Returns its name, its case, and `meaning` and the errors for the key."""
    name, case = job
    make = generator(by)
    made = make.make(folder / name, case.effects, case.seed)

    base_error: dict[str, float] = {}
    least_error: dict[str, float] = {}
    # only here a gain is judged: nobody knows the possible gain for an effect outside the table
    if case.kind in ("one", "two"):
        # the same stops (same seed) with nothing hidden: no model can remove what is left there
        with tempfile.TemporaryDirectory(prefix="rollerrig-sealed-") as place:
            least_error = _errors(make.make(Path(place, "twin"), {}, case.seed))
        if least_error:
            base_error = _errors(made)

    meaning: dict[str, tuple[str, float]] = {}
    for cause, size in case.effects.items():
        if cause in make.SAME_MEANING:
            parameter, sign = make.SAME_MEANING[cause]
            meaning[cause] = (parameter, sign * size)
    return (
        name,
        case,
        {"meaning": meaning, "base_error": base_error, "least_error": least_error},
    )


def _errors(dataset_folder: Path) -> dict[str, float]:
    """Return the errors of the fitted base on the stops that were not fitted, by metric.

    Empty for data that `explain` refuses.
    """
    from rollerrig.rig.identify.causes import candidates
    from rollerrig.rig.identify.data import dataset, preparation
    from rollerrig.rig.identify.decide import fitting, gain

    try:
        data = dataset.load(dataset_folder)
    except ConfigError:
        return {}
    design = preparation.prepare(data, data.group("tune"))
    held = preparation.prepare(data, data.group("validate"))
    base, *_ = fitting.fit(design, candidates.untuned(design))
    return {metric: gain.error(held, base, metric) for metric in (gain.ADHESION, gain.FREE_RUN)}
