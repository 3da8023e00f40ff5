"""Whatever stands in a file, a loader gives a result or a ConfigError, never another exception."""

import contextlib
import copy
import datetime
import string

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
ANYTHING = st.recursive(
    LEAVES,
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(TEXTS, inner, max_size=3)),
    max_leaves=5,
)


def places(content, at=()):
    """Paths of all tables, lists and values of a file."""
    inner = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    yield at
    for key, value in inner:
        yield from places(value, (*at, key))


def put(content, at, value):
    """The content with another value at one path."""
    if not at:
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
    # a dataset is a folder; the packaged one lends the first seconds of its data files
    folder = path.parent
    if not (folder / "runs").exists():
        (folder / "runs").mkdir()
        for file in (store.ROOT / "datasets" / "open_none" / "runs").iterdir():
            (folder / "runs" / file.name).write_text(
                "".join(file.read_text().splitlines(keepends=True)[:301])
            )
    (folder / "dataset.toml").write_bytes(path.read_bytes())
    return dataset.load(folder)


EXTENDED = {
    "adhesion": {"tau_m_J": 1e-4},
    "mechanisms": {"brake_gain_gain": 0.01, "brake_gain_axle": 2.0},
}
LOADERS = {
    "scenarios": (load_scenario, lambda: store.load("scenarios", "step_adhesion")[0]),
    "sequences": (load_sequence, lambda: store.load("sequences", "patches_one_side")[0]),
    "sequences with a fault": (
        load_sequence,
        lambda: store.load("sequences", "fault_swapped_axles")[0],
    ),
    "criteria": (load_criteria, lambda: store.load("criteria", "stop")[0]),
    "campaigns": (load_campaign, lambda: store.load("campaigns", "low_adhesion")[0]),
    "wsp": (load_wsp, lambda: store.load("wsp", "reference")[0]),
    "models": (load_model, lambda: EXTENDED),
    "datasets": (
        load_dataset,
        lambda: store.parse(store.ROOT / "datasets" / "open_none" / "dataset.toml"),
    ),
}


def known_keys(kind):
    """All keys that the packaged files of a kind use, and those that a loader names itself."""
    folder, found = (
        kind.partition(" ")[0],
        {"fault", "friction", "demand", "mechanisms", "adhesion"},
    )
    read = dataset.parse if folder == "datasets" else store.parse
    for path in (store.ROOT / folder).rglob("*.toml"):
        found |= {key for at in places(read(path)) for key in at if isinstance(key, str)}
    if folder == "sequences":
        found |= {*sequence.HEAD, *sequence.START, *sequence.STEP}
    return found


@pytest.mark.parametrize("kind", LOADERS)
def test_a_loader_gives_a_result_or_a_config_error(kind, tmp_path):
    load, sound = LOADERS[kind][0], LOADERS[kind][1]()
    path = tmp_path / "given.toml"
    keys = st.one_of(st.none(), TEXTS, st.sampled_from(sorted(known_keys(kind))))

    @settings(
        max_examples=300,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(list(places(sound))), ANYTHING, keys)
    def check(at, value, key):
        beside = (*at[:-1], key) if at and isinstance(at[-1], str) else (key,)
        content = put(sound, at if key is None else beside, value)
        try:
            path.write_text(tomli_w.dumps(content), encoding="utf-8")
        except (TypeError, ValueError):
            return  # not TOML: nobody can write it into a file
        with contextlib.suppress(ConfigError):
            load(path)

    load(_written(path, sound))
    check()


def _written(path, content):
    path.write_text(tomli_w.dumps(content), encoding="utf-8")
    return path
