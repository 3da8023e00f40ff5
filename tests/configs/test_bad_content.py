"""For any content of a file, a loader returns a result or raises ConfigError."""

import contextlib
import copy
import datetime
import string
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rollerrig.configs import store
from rollerrig.configs.errors import ConfigError
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.campaign import campaign
from rollerrig.rig.identify.data import dataset
from rollerrig.wsp_interface.sequences import sequence, verdict

# values that may replace a value of a file
NUMBERS = st.sampled_from(
    [0, 1, -1, 5, 1.5, -0.0, 1e308, -1e308, float("nan"), float("inf"), 2**63 - 1]
)
TEXTS = st.one_of(
    st.sampled_from(
        [
            "",
            " ",
            "x" * 300,
            "nan",
            "3.8 bar",
            "vehicle_speed < 1 km/h",
            "../..",
            "/",
            "a/b.toml",
            "\0",
            "speed_sensor_stuck axle=2 at=1",
            "uic_z1",
            "none",
            "=",
            "1e999 s",
        ]
    ),
    st.text(string.printable + "\u20ac\u00e9", max_size=12),
)
LEAVES = st.one_of(NUMBERS, TEXTS, st.booleans(), st.just(datetime.date(2026, 1, 1)))
PACKAGED_DATASET = store.ROOT / "datasets" / "open_none"

ANYTHING = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=5,
)


def places(content, at=()):
    """Yield the path of each table, list and value of a file: a tuple of keys and positions."""
    yield at
    inner = ()
    if isinstance(content, dict):
        inner = content.items()
    elif isinstance(content, list):
        inner = enumerate(content)
    for key, value in inner:
        yield from places(value, (*at, key))


def put(content, at, value):
    """Return the content with another value at one path."""
    if not at:
        # a file is always a table
        return value if isinstance(value, dict) else {"x": value}
    content = copy.deepcopy(content)
    target = content
    for key in at[:-1]:
        target = target[key]
    target[at[-1]] = value
    return content


def load_scenario(path):
    return scenario.load(str(path))


def load_model(path):
    return scenario.load("dry_stop", model=str(path))


def load_sequence(path):
    return sequence.load(path, catalogue.parse)


def load_criteria(path):
    return verdict.load(str(path))


def load_campaign(path):
    return campaign.load(str(path))


def load_wsp(path):
    return logic.load(str(path))


def load_dataset(path):
    # a dataset is a folder: its data are the first seconds of the packaged data files
    folder = path.parent
    runs = folder / "runs"
    if not runs.exists():
        runs.mkdir()
        for file in (PACKAGED_DATASET / "runs").iterdir():
            lines = file.read_text().splitlines(keepends=True)
            (runs / file.name).write_text("".join(lines[:301]))
    (folder / "dataset.toml").write_bytes(path.read_bytes())
    return dataset.load(folder)


def packaged(folder, name):
    """Return the content of a packaged file."""
    content, _ = store.load(folder, name)
    return content


class FileKind(NamedTuple):
    """A kind of file: its loader, which takes a path, and a content that is right.

    `folder`: the folder of the packaged files whose keys are tried.
    """

    load: Callable[[Path], Any]
    content: dict[str, Any]
    folder: str


EXTENDED_MODEL = {
    "adhesion": {"tau_m_J": 1e-4},
    "mechanisms": {"brake_gain_gain": 0.01, "brake_gain_axle": 2.0},
}
KINDS = {
    "scenarios": FileKind(load_scenario, packaged("scenarios", "step_adhesion"), "scenarios"),
    "sequences": FileKind(load_sequence, packaged("sequences", "patches_one_side"), "sequences"),
    "sequences with a fault": FileKind(
        load_sequence, packaged("sequences", "fault_swapped_axles"), "sequences"
    ),
    "criteria": FileKind(load_criteria, packaged("criteria", "stop"), "criteria"),
    "campaigns": FileKind(load_campaign, packaged("campaigns", "low_adhesion"), "campaigns"),
    "wsp": FileKind(load_wsp, packaged("wsp", "reference"), "wsp"),
    "models": FileKind(load_model, EXTENDED_MODEL, "models"),
    "datasets": FileKind(load_dataset, store.parse(PACKAGED_DATASET / "dataset.toml"), "datasets"),
}


def known_keys(folder):
    """Return all keys of the packaged files in a folder, and keys that only the loaders know."""
    known = {"fault", "friction", "demand", "mechanisms", "adhesion"}
    read = dataset.parse if folder == "datasets" else store.parse
    for path in (store.ROOT / folder).rglob("*.toml"):
        for at in places(read(path)):
            known |= {key for key in at if isinstance(key, str)}
    if folder == "sequences":
        known |= {*sequence.HEAD, *sequence.START, *sequence.STEP}
    return known


@pytest.mark.parametrize("examples", [25, pytest.param(600, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_loader_returns_a_result_or_raises_config_error(kind, examples, tmp_path):
    load, right, folder = KINDS[kind]
    path = tmp_path / "changed.toml"
    keys = st.one_of(st.none(), TEXTS, st.sampled_from(sorted(known_keys(folder))))

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(list(places(right))), ANYTHING, keys)
    def check(at, value, key):
        # a key replaces the last one of the path: the value is then in the same table
        if key is not None:
            in_a_table = at and isinstance(at[-1], str)
            at = (*at[:-1], key) if in_a_table else (key,)
        try:
            write(path, put(right, at, value))
        except (TypeError, ValueError):
            return  # TOML cannot express it
        with contextlib.suppress(ConfigError):
            load(path)

    write(path, right)
    load(path)
    check()


def write(path, content):
    path.write_text(tomli_w.dumps(content), encoding="utf-8")
