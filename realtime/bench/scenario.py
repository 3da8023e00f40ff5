"""A resolved scenario: names looked up, tables merged, defaults written out, everything checked.

The order of layers is defaults, vehicle, rig, adhesion, bus, the scenario's tables, an extended
model, and single values from the command line; a later layer wins. The resolved scenario is a
scenario again, which repeats a run.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs import store, table, toml_text
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import choice, flag, integer, number
from rollerrig.configs.vehicle import (
    COACH_AXLES,
    DYNAMIC_BRAKE,
    EQUIPMENT_KEYS,
    MAGNETIC_TRACK_BRAKE,
    TRAIN,
    Kind,
    check_axles,
    kind_of,
)
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import seal
from rollerrig.rig import adhesion_profile, dynamic_params
from rollerrig.rig import params as physics
from rollerrig.wsp_interface import signals

# value of bus.socketcand_port where nobody has chosen a port
AUTOMATIC_PORT = -1

# the vehicle of a scenario that states none
COACH = "uic_z1"

HEAD = (
    choice("title", "", (), "a sentence"),
    choice("vehicle_set", COACH, (), "configs/vehicles"),
    choice("rig_set", "full_scale", (), "configs/rigs"),
    choice("adhesion_set", "soap", (), "configs/adhesion"),
    choice("bus_set", "default", (), "configs/buses"),
    choice("pads_set", "constant", (), "configs/pads"),
    choice("wsp_config", "reference", (), "configs/wsp: what the reference unit loads"),
    number("initial_speed_m_s", 42.3, 0.5, 100.0, "Table 5"),
    number("duration_max_s", 180.0, 0.1, 36000.0, "the run ends then, stopped or not"),
    number("stand_s", 0.5, 0.0, 60.0, "recorded after standstill"),
    choice("sealed", "", (), "hidden effects, written by rollerrig hide"),
)
LOOP = (
    integer("tick_hz", 1000, 100, 10000, "rig control and commands"),
    number(
        "step_s",
        1e-4,
        1e-6,
        1e-2,
        "physics; the paper's. While wheels adhere, the recorded forces sum up to the vehicle's change "
        "of momentum within 0.02 % at 1e-4, 0.5 % at 5e-4 and 1.6 % at 1e-3",
    ),
    integer("record_hz", 100, 1, 10000, "samples of the recording"),
    integer("priority", 80, 0, 99, "SCHED_FIFO; 0: none"),
    integer(
        "cpu",
        -1,
        -2,
        1023,
        "core of the real-time thread, which all else leaves; -1: the one with the fewest "
        "interrupts, if there are two or more and the thread has its priority; -2: any",
    ),
    integer("wake_early_us", 50, 0, 500, "on its own core the thread waits awake for the deadline"),
)
BUS = (
    choice("interface", "auto", (), "auto, hub, or python-can's interface:channel"),
    integer("bitrate", 500_000, 10_000, 1_000_000, "assumption: a usual rate of vehicle buses"),
    number("sync_period_s", 0.01, 0.0005, 1.0, "assumption: period of a WSP unit"),
    number("heartbeat_s", 0.1, 0.01, 10.0, "producer time of the rig's nodes"),
    choice("host", "127.0.0.1", (), "address of the hub: loopback unless named otherwise"),
    integer(
        "socketcand_port",
        AUTOMATIC_PORT,
        AUTOMATIC_PORT,
        65535,
        "0: a free one; -1: 29536, or a free one where that is in use and the run waits for no "
        "outside program",
    ),
    *(
        integer(f"{codec}_port", -1, -1, 65535, "another way into the hub; 0: a free one, -1: none")
        for codec in ("virtualcan", "slcan", "cannelloni")
    ),
    choice(
        "store",
        "",
        (),
        "folder in which the nodes keep stored parameters (1010h, LSS); empty: none",
    ),
    flag(
        "arbitration",
        False,
        "frames wait for the wire, lowest identifier first; false: an ideal bus",
    ),
    flag("master", True, "the bench starts the nodes and produces SYNC"),
)
MODBUS = (
    flag("enabled", True, "the supervisory PLC listens, in wall pacing"),
    choice("host", "127.0.0.1", (), "address of the PLC: loopback unless named otherwise"),
    integer("port", 5020, 0, 65535, "0 takes a free one"),
    choice("tls_certificate", "", (), "PEM file; with it the port speaks TLS and nothing else"),
    choice("tls_key", "", (), "PEM file: the certificate's key"),
    choice("tls_client_ca", "", (), "PEM file: who signs the certificates of clients"),
    choice("serial", "", (), "RTU: a serial device, or pty for a new pseudo-terminal"),
    integer("baud_rate", 19200, 300, 115200, "MODBUS over Serial Line: 19200 by default"),
    choice("parity", "even", ("even", "odd", "none"), "MODBUS over Serial Line: even by default"),
    number("emergency_pressure_Pa", 3.8e5, 0.0, 1e6, "assumption: that of full service"),
)
DEMAND = (number("from_s", 0.0, 0.0, 36000.0, "s"), number("pressure_Pa", None, 0.0, 1e6, "Pa"))
TRACTION = (
    number("from_s", 0.0, 0.0, 36000.0, "s"),
    number("share", None, 0.0, 1.0, "of the traction force"),
)
FRICTION = (
    number("from_s", -1.0, 0.0, 36000.0, "s"),
    number("from_m", -1.0, -1e3, 1e6, "m"),
    number("mu_cd", -1.0, 1e-4, 1.0, "-"),
    number("mu_cr", -1.0, 1e-4, 1.0, "-"),
)
SECTIONS = {**physics.ROWS, "loop": LOOP, "bus": BUS, "modbus": MODBUS}
# tables that have separate files: the table, and the folder of its files
SETS = {
    "vehicle": "vehicles",
    "rig": "rigs",
    "adhesion": "adhesion",
    "bus": "buses",
    "pads": "pads",
}


class Sources(NamedTuple):
    """What gave single values and further faults, for messages."""

    settings: str
    faults: str


COMMAND_LINE = Sources(settings="--set", faults=catalogue.OPTION)
PYTHON = Sources(settings="rollerrig.run(...)", faults="rollerrig.run(faults=...)")

# what loads a configuration, as `store.load`
Files = Callable[..., tuple[dict[str, Any], Path]]
# one layer: the file or option that it is from, and its tables and keys
Layer = tuple[str, Mapping[str, Any]]


class ReplacedAdhesion(NamedTuple):
    """A mu_cd that replaces the initial adhesion of an earlier layer, and what gave the two."""

    mu_cd: float
    given_by: str
    initial_adhesion: float
    stated_by: str


@dataclass(frozen=True)
class Scenario:
    """A checked scenario. `resolved` is the whole as plain data, `name` the file's stem.

    `rollers` are the parameters of the plant on dry rollers that runs in parallel to a virtual
    track. `replaced` is an initial adhesion that does not act, for a message.
    """

    name: str
    resolved: dict[str, Any]
    params: physics.Params
    rollers: physics.Params | None
    sync_ticks: int
    record_ticks: int
    faults: tuple[catalogue.Fault, ...]
    replaced: ReplacedAdhesion | None = None

    def __getitem__(self, key: str) -> Any:
        return self.resolved[key]

    @property
    def kind(self) -> Kind:
        """The kind of its vehicle."""
        return kind_of(self.resolved, self.name)

    @property
    def table(self) -> signals.Table:
        """The signals of its vehicle."""
        return signals.table(self.kind)


def load(
    name: str,
    model: str = "",
    settings: tuple[str, ...] = (),
    tables: Mapping[str, Any] | None = None,
    faults: tuple[str, ...] = (),
    sources: Sources = COMMAND_LINE,
    files: Files = store.load,
) -> Scenario:
    """Load a scenario by name or path, with an extended model and `section.key=value` settings.

    `tables` are whole tables that win over those of the scenario, as a rig that is already running
    has them. `faults` are added to those of the scenario, as `faults.catalogue.parse` reads them.
    `sources` are what gave settings and faults, for messages. `files` loads the files; a campaign
    keeps them for its next run. Raises ConfigError, which says where, what, what is allowed and how
    to fix it.
    """
    content, path = files("scenarios", name)
    return read(content, path, model, settings, tables, faults, sources, files)


def names() -> list[str]:
    """Return the names of the packaged scenarios."""
    return store.names("scenarios")


def read(
    given: dict[str, Any],
    path: Path,
    model: str = "",
    settings: tuple[str, ...] = (),
    tables: Mapping[str, Any] | None = None,
    faults: tuple[str, ...] = (),
    sources: Sources = COMMAND_LINE,
    files: Files = store.load,
) -> Scenario:
    """Return a scenario, as `load` does, from the content of its file.

    `path` names the file; other files that it names are searched for in its folder.
    """
    if TRAIN in given:
        raise ConfigError(
            f"{path} has a table [{TRAIN}], and this is for one vehicle; allowed for a train is "
            "'rollerrig run' with --pacing free or lockstep"
        )
    defaults = {row.name: row.default for row in HEAD}
    single = _settings(settings)
    # single keys of the head, among them the names of sets, apply before the sets are looked up
    single_head = {key: value for key, value in single.items() if key in defaults}
    single_rest = {key: value for key, value in single.items() if key not in defaults}
    # lists, such as the faults, replace those of the file; tables are merged with them
    replaced = {key for key, value in single_rest.items() if not isinstance(value, dict)}
    file_keys = {key: value for key, value in _aliases(given, path).items() if key not in replaced}
    given = {**file_keys, **single_head}

    layers: list[Layer] = []
    for short, kind in SETS.items():
        key = f"{short}_set"
        content, at = files(kind, str(given.get(key, defaults[key])), path)
        layers.append((str(at), content))
    own_tables = {key: value for key, value in given.items() if key not in defaults}
    layers.append((str(path), own_tables))
    if model:
        at = store.find("models", model)
        layers.append((str(at), store.parse(at)))
    layers.append((sources.settings, single_rest))
    layers.append(("the running rig", tables or {}))
    vehicle = _kind(layers)
    plain_faults = [
        catalogue.plain(catalogue.parse(text, vehicle, sources.faults)) for text in faults
    ]
    layers.append((sources.faults, {"fault": plain_faults}))

    table.read(_rows_of(single_head), single_head, sources.settings)
    head = table.read(HEAD, {key: given[key] for key in defaults if key in given}, str(path))
    # the resolved scenario in a run's folder is named after the folder
    name = path.parent.name if path.name == "scenario.toml" else path.stem
    return resolve(name, head, layers)


def _rows_of(given: Mapping[str, Any]) -> list[table.Row]:
    """Return the rows of the head that are given."""
    return [row for row in HEAD if row.name in given]


def resolve(name: str, head: dict[str, Any], layers: list[Layer]) -> Scenario:
    """Merge layers of tables, check them, and return the scenario with its parameters."""
    merged = _merge(head, layers)
    checked: dict[str, Any] = dict(physics.check(merged.sections, name))
    _check_held_speed(checked, name)
    for section in ("loop", "bus", "modbus"):
        given = merged.sections[section]
        checked[section] = table.read(SECTIONS[section], given, f"{name} [{section}]")
    acting, hidden_faults = _with_sealed(checked, merged.head.get("sealed", ""), merged.kind)
    ratios = _ratios(checked, name)

    steps, demand = _demand(merged.demand, merged.programme_from)
    traction = _steps(TRACTION, merged.traction, f"{merged.programme_from} [[traction]]")
    friction, friction_rows = _friction(
        _with_profiles(merged.friction, checked, merged.programme_from),
        checked["adhesion"],
        merged.programme_from,
        merged.kind.axles,
    )
    resolved = {
        **merged.head,
        **checked,
        "demand": steps,
        "friction": friction_rows,
        "fault": [catalogue.plain(fault) for fault in merged.faults],
    }
    if traction:
        resolved["traction"] = traction
    for section in EQUIPMENT_KEYS:
        if not merged.sections[section]:
            # no file mentions this equipment: the resolved scenario is as it always was
            del resolved[section]
    params = physics.build(acting, friction, demand, ratios.tick_s, ratios.substeps, traction)
    _check_blending(params, demand, checked)
    rollers = None
    if checked["rig"]["mode"] == physics.VIRTUAL_TRACK:
        rollers = physics.build_rollers(acting, demand, ratios.tick_s, ratios.substeps)
    return Scenario(
        name=name,
        resolved=resolved,
        params=params,
        rollers=rollers,
        sync_ticks=ratios.sync_ticks,
        record_ticks=ratios.record_ticks,
        faults=merged.faults + hidden_faults,
        replaced=merged.replaced,
    )


# --- merging ---


@dataclass
class Merged:
    """Layers on top of one another, not yet checked as a whole.

    `programme_from` is the layer that had the last programme of demand or friction.
    """

    head: dict[str, Any]
    sections: dict[str, dict[str, Any]]
    demand: list[dict[str, Any]]
    friction: list[dict[str, Any]]
    traction: list[dict[str, Any]]
    faults: tuple[catalogue.Fault, ...]
    programme_from: str
    kind: Kind
    # what gave the initial adhesion that acts, and the one that no longer does
    initial_adhesion_from: str = ""
    replaced: ReplacedAdhesion | None = None


def _merge(head: dict[str, Any], layers: list[Layer]) -> Merged:
    """Put layers of tables on top of one another; each key is checked where it is given."""
    merged = Merged(
        head=dict(head),
        sections={section: {} for section in SECTIONS},
        demand=[],
        friction=[],
        traction=[],
        faults=(),
        programme_from=layers[0][0],
        kind=_kind(layers),
    )
    for where, layer in layers:
        for key, content in layer.items():
            _merge_key(merged, where, key, content)
        given = layer.get("adhesion", {})
        if "mu_cd" in given and "initial_adhesion" in given:
            physics.check_initial_adhesion(merged.sections, where)
    return merged


def _kind(layers: list[Layer]) -> Kind:
    """Return the kind of the vehicle, on which the bounds of other keys depend.

    Raises ConfigError.
    """
    axles: Any = COACH_AXLES
    equipped = dict.fromkeys(EQUIPMENT_KEYS, False)
    for where, layer in layers:
        vehicle = layer.get("vehicle")
        if isinstance(vehicle, Mapping) and "axles" in vehicle:
            axles = vehicle["axles"]
            check_axles(axles, f"{where} [vehicle] axles")
        for name, key in EQUIPMENT_KEYS.items():
            section = layer.get(name)
            if isinstance(section, Mapping) and key in section:
                equipped[name] = bool(section[key])
    return Kind(axles, equipped[DYNAMIC_BRAKE], equipped[MAGNETIC_TRACK_BRAKE])


def _merge_key(merged: Merged, where: str, key: str, content: Any) -> None:
    """Put one table or key of a layer on top of what is merged. Raises ConfigError."""
    heads = {row.name: row for row in HEAD}
    if key in merged.sections:
        _require(isinstance(content, Mapping), where, key, content, f"a table [{key}]")
        table.read(SECTIONS[key], content, f"{where} [{key}]")
        if key == "adhesion":
            _replace_adhesion(merged, where, content)
        merged.sections[key].update(content)
    elif key in ("demand", "friction", "traction"):
        is_programme = isinstance(content, list) and all(isinstance(c, Mapping) for c in content)
        form = f"[[{key}]] with two brackets, one for each step"
        _require(is_programme, where, key, content, form)
        setattr(merged, key, content)
        merged.programme_from = where
    elif key == "fault":
        _require(isinstance(content, list), where, key, content, "[[fault]] with two brackets")
        merged.faults += catalogue.all_of(content, merged.kind, where)
    elif key in heads:
        merged.head |= table.read([heads[key]], {key: content}, where)
    else:
        allowed = [*SECTIONS, "demand", "friction", "traction", "fault", *heads]
        # a key of a table was perhaps written without its table
        in_tables = [f"{section}.{row.name}" for section in SECTIONS for row in SECTIONS[section]]
        hint = table.nearest(key, allowed, others=in_tables)
        raise ConfigError(f"{where}: unknown table or key '{key}'{hint}")


def _replace_adhesion(merged: Merged, where: str, content: Mapping[str, Any]) -> None:
    """Let a later mu_cd win over an initial adhesion, and note that."""
    if "mu_cd" in content:
        stated = merged.sections["adhesion"].pop("initial_adhesion", 0.0)
        if stated:
            merged.replaced = ReplacedAdhesion(
                content["mu_cd"], where, stated, merged.initial_adhesion_from
            )
    if "initial_adhesion" in content:
        merged.initial_adhesion_from = where
        merged.replaced = None


def _require(right: bool, where: str, key: str, content: Any, form: str) -> None:
    if not right:
        raise ConfigError(f"{where}: {key} = {content!r}: write {form}")


def _aliases(given: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the content with vehicle = "uic_z1" as vehicle_set, which reads less well, and so on.

    Such a key is the name of a set only where there is no table [vehicle].
    """
    given = dict(given)
    for short in SETS:
        if isinstance(given.get(short), str):
            if f"{short}_set" in given:
                raise ConfigError(f"{path}: both {short} and {short}_set are given; keep one")
            given[f"{short}_set"] = given.pop(short)
    return given


def settings_of(settings: Sequence[str], section: str) -> dict[str, Any]:
    """Return the values of one table in settings such as adhesion.mu_cd=0.05."""
    found: dict[str, Any] = _settings(tuple(settings)).get(section, {})
    return found


def _settings(settings: tuple[str, ...]) -> dict[str, Any]:
    """Return the tables and single keys of settings such as adhesion.mu_cd=0.05."""
    found: dict[str, Any] = {}
    for setting in settings:
        key, _, text = setting.partition("=")
        section, _, name = key.strip().rpartition(".")
        if not name or not text:
            raise ConfigError(
                f"--set {setting}: write section.key=value, as in adhesion.mu_cd=0.05"
            )
        try:
            value = toml_text.value(text, f"--set {key.strip()}")
        except ValueError:
            value = text.strip()  # a text without quotes
        if section:
            found.setdefault(section, {})[name] = value
        elif name in SETS:
            # so that a set by name and single values of its table can both be given
            found[f"{name}_set"] = value
        else:
            found[name] = value
    return found


# --- checking what belongs to several tables ---


def _check_held_speed(checked: dict[str, Any], name: str) -> None:
    """Refuse a held speed where no drives hold it. Raises ConfigError."""
    if checked["rig"]["speed"] != "held":
        return
    mode, model = checked["rig"]["mode"], checked["vehicle"]["model"]
    if (mode, model) != ("contaminated_rollers", "planar"):
        raise ConfigError(
            f"{name} [rig] speed = 'held': drives hold the speed, and the coach in 3D has none; "
            'allowed with rig.mode = "contaminated_rollers" and vehicle.model = "planar"'
        )


def _with_sealed(
    checked: dict[str, Any], text: str, kind: Kind
) -> tuple[dict[str, Any], tuple[catalogue.Fault, ...]]:
    """Return the sections as they act, and the hidden faults, of a scenario that hides effects.

    The resolved scenario has them in sealed form only.
    """
    if not text:
        return checked, ()
    content = seal.decode(text, "sealed")
    mechanisms = table.read(
        physics.ROWS["mechanisms"], checked["mechanisms"] | content.get("mechanisms", {}), "sealed"
    )
    faults = catalogue.all_of(content.get("fault", []), kind, "sealed")
    hidden = tuple(dataclasses.replace(fault, reported=False) for fault in faults)
    return checked | {"mechanisms": mechanisms}, hidden


class Ratios(NamedTuple):
    """How the periods of physics, tick, SYNC and recording relate."""

    tick_s: float
    substeps: int
    sync_ticks: int
    record_ticks: int


def _ratios(checked: dict[str, Any], name: str) -> Ratios:
    """Return the ratios of the periods. Raises ConfigError where one is not a whole number."""
    loop, bus = checked["loop"], checked["bus"]
    tick_s = 1.0 / loop["tick_hz"]

    def whole(ratio: float, of: str) -> int:
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise ConfigError(f"{name}: {of} is {ratio:.6g}; it must be a whole number, at least 1")
        return round(ratio)

    return Ratios(
        tick_s=tick_s,
        substeps=whole(
            tick_s / loop["step_s"],
            f"[loop] a tick of {tick_s:g} s over step_s = {loop['step_s']:g} s",
        ),
        sync_ticks=whole(
            bus["sync_period_s"] / tick_s,
            f"[bus] sync_period_s = {bus['sync_period_s']:g} s over a tick of {tick_s:g} s",
        ),
        record_ticks=whole(
            loop["tick_hz"] / loop["record_hz"],
            f"[loop] tick_hz = {loop['tick_hz']} over record_hz = {loop['record_hz']}",
        ),
    )


def _demand(rows: list[dict[str, Any]], where: str) -> tuple[list[dict[str, Any]], physics.Demand]:
    """Return the steps of the brake demand, as plain data and for the plant. Raises ConfigError."""
    steps = _steps(DEMAND, rows, f"{where} [[demand]]")
    starts = [step["from_s"] for step in steps]
    pressures = [step["pressure_Pa"] for step in steps]
    return steps, physics.Demand(np.array(starts), np.array(pressures))


def _steps(
    keys: Sequence[table.Row], rows: list[dict[str, Any]], where: str
) -> list[dict[str, Any]]:
    """Return the checked steps of a programme, each with `from_s`. Raises ConfigError."""
    steps = [table.read(keys, row, f"{where} {place}") for place, row in enumerate(rows, start=1)]
    starts = [step["from_s"] for step in steps]
    if starts != sorted(starts):
        raise ConfigError(f"{where}: from_s must rise from step to step, not {starts}")
    return steps


def _check_blending(
    params: physics.Params, demand: physics.Demand, checked: dict[str, Any]
) -> None:
    """Raise ConfigError where the demand requests more than both brakes of a vehicle have."""
    pressures = [*demand.pressure_Pa, checked["modbus"]["emergency_pressure_Pa"]]
    dynamic_params.check_blending(
        params.dynamic,
        largest_Pa=max(pressures) * params.brake.weighed_share,
        limit_Pa=checked["dynamic_brake"]["friction_pressure_Pa"],
    )


def _with_profiles(
    rows: list[dict[str, Any]], checked: Mapping[str, Any], where: str
) -> list[dict[str, Any]]:
    """Return steps of friction in which each profile has become its steps. Raises ConfigError."""
    result: list[dict[str, Any]] = []
    for place, row in enumerate(rows, start=1):
        if "profile" not in row:
            result.append(row)
            continue
        at = f"{where} [[friction]] {place}"
        given = dict(row)
        profile = given.pop("profile")
        axles = {"axles": given.pop("axles")} if "axles" in given else {}
        table.known(given, ["from_m"], lambda key, at=at: f"{at}: beside profile")
        start = [key for key in FRICTION if key.name in given]
        start_m = table.read(start, given, at).get("from_m", 0.0)
        for step in adhesion_profile.steps(profile, start_m, checked, at, where):
            result.append({**step, **axles})
    return result


def _friction(
    rows: list[dict[str, Any]], adhesion: dict[str, float], where: str, axles_of_vehicle: int
) -> tuple[physics.Friction, list[dict[str, Any]]]:
    """Return the programme of friction, for the plant and as plain data. Raises ConfigError."""
    steps: list[dict[str, Any]] = []
    masks: list[int] = []
    for place, row in enumerate(rows, start=1):
        at = f"{where} [[friction]] {place}"
        given = dict(row)
        axles = given.pop("axles", list(range(1, axles_of_vehicle + 1)))
        _check_axles(axles, at, axles_of_vehicle)
        if ("from_s" in given) == ("from_m" in given):
            raise ConfigError(f"{at}: give from_s (time) or from_m (place), one of them")
        table.known(given, [row.name for row in FRICTION], lambda key, at=at: at)
        # only what is given: a step begins at a time or at a place
        known = [row for row in FRICTION if row.name in given]
        step = {
            "mu_cd": adhesion["mu_cd"],
            "mu_cr": adhesion["mu_cr"],
            "axles": axles,
            **table.read(known, given, at),
        }
        physics.check_recovery(adhesion | step, at)
        steps.append(step)
        masks.append(sum(1 << (axle - 1) for axle in set(axles)))
    by_place = ["from_m" in step for step in steps]
    starts = [step.get("from_m", step.get("from_s", 0.0)) for step in steps]
    friction = physics.Friction(
        np.array(by_place, dtype=np.bool_),
        np.array(starts),
        np.array([step["mu_cd"] for step in steps]),
        np.array([step["mu_cr"] for step in steps]),
        np.array(masks, dtype=np.int64),
    )
    return friction, steps


def _check_axles(axles: Any, at: str, most: int) -> None:
    """Raise ConfigError unless this is a list of numbers of axles."""
    is_list = isinstance(axles, list) and len(axles) > 0
    if not is_list or not all(type(axle) is int and 1 <= axle <= most for axle in axles):
        raise ConfigError(f"{at}: axles = {axles!r}; a list of axle numbers from 1 to {most}")


# --- writing ---


def dump(scenario: Scenario, of_harness: bool = False) -> str:
    """Return the resolved scenario as TOML, with a comment on how to repeat the run.

    `of_harness`: a test harness, such as a sequence, commands the run over the bus.
    """
    if of_harness:
        remedy = (
            "# A test commanded this run over the bus: its brake, friction and faults are not in this "
            "file.\n# Play the sequence or the test again to repeat the run.\n"
        )
    else:
        remedy = "# Run it again to repeat the run, unless a PLC, a harness or a person commanded the run.\n"
    head = "# resolved by rollerrig: every default written out\n"
    return head + remedy + tomli_w.dumps(scenario.resolved)


def digest(scenario: Scenario) -> str:
    """Return a hash of everything that decides the result."""
    return hashlib.sha256(tomli_w.dumps(scenario.resolved).encode()).hexdigest()[:16]
