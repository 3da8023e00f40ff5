"""A scenario, resolved: names looked up, tables merged, every default written out, all checked.

The order is defaults, vehicle, rig, adhesion, bus, the scenario's own tables, an extended model, and single values from
the command line; what comes later wins. The resolved one is a scenario again, which repeats a run.
"""

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import choice, flag, integer, number
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.record import seal
from rollerrig.rig import params as physics
from rollerrig.wsp_interface.signals import AXLES

HEAD = (
    choice("title", "", (), "a sentence"),
    choice("vehicle_set", "uic_z1", (), "configs/vehicles"),
    choice("rig_set", "full_scale", (), "configs/rigs"),
    choice("adhesion_set", "soap", (), "configs/adhesion"),
    choice("bus_set", "default", (), "configs/buses"),
    choice("pads_set", "constant", (), "configs/pads"),
    choice("wsp_config", "reference", (), "configs/wsp: what the reference unit loads"),
    number("initial_speed_m_s", 42.3, 0.5, 100.0, "Table 5"),
    number("duration_max_s", 180.0, 0.1, 36000.0, "the run ends then, stopped or not"),
    number("stand_s", 0.5, 0.0, 60.0, "recorded after standstill"),
    choice("sealed", "", (), "what acts and is told nowhere: rollerrig hide"),
)
LOOP = (
    integer("tick_hz", 1000, 100, 10000, "rig control and commands"),
    number("step_s", 1e-4, 1e-6, 1e-2, "physics; the paper's"),
    integer("record_hz", 100, 1, 10000, "samples of the recording"),
    integer("priority", 80, 0, 99, "SCHED_FIFO; 0 asks for nothing"),
    integer("cpu", -1, -1, 1023, "core of the real-time thread; -1 asks for none"),
)
BUS = (
    choice("interface", "auto", (), "auto, hub, or python-can's interface:channel"),
    integer("bitrate", 500_000, 10_000, 1_000_000, "assumption: a usual rate of vehicle buses"),
    number("sync_period_s", 0.01, 0.0005, 1.0, "assumption: period of a WSP unit"),
    number("heartbeat_s", 0.1, 0.01, 10.0, "producer time of the rig's nodes"),
    choice("host", "127.0.0.1", (), "address of the hub: loopback unless named otherwise"),
    integer("socketcand_port", 29536, 0, 65535, "0 takes a free one"),
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
FRICTION = (
    number("from_s", -1.0, 0.0, 36000.0, "s"),
    number("from_m", -1.0, -1e3, 1e6, "m"),
    number("mu_cd", -1.0, 1e-4, 1.0, "-"),
    number("mu_cr", -1.0, 1e-4, 1.0, "-"),
)
SECTIONS = {**physics.ROWS, "loop": LOOP, "bus": BUS, "modbus": MODBUS}
# tables that come from files of their own: the table, and the folder of its files
SETS = {
    "vehicle": "vehicles",
    "rig": "rigs",
    "adhesion": "adhesion",
    "bus": "buses",
    "pads": "pads",
}


@dataclass(frozen=True)
class Scenario:
    """A checked scenario. `resolved` is the whole as plain data, `name` the file's stem.

    `rollers` are the parameters of the plant on dry rollers that runs beside a virtual track.
    """

    name: str
    resolved: dict[str, Any]
    params: physics.Params
    rollers: physics.Params | None
    sync_ticks: int
    record_ticks: int
    faults: tuple[catalogue.Fault, ...]

    def __getitem__(self, key: str) -> Any:
        return self.resolved[key]


def load(
    name: str,
    model: str = "",
    settings: tuple[str, ...] = (),
    tables: Mapping[str, Any] | None = None,
    faults: tuple[str, ...] = (),
) -> Scenario:
    """Load a scenario by name or path, with an extended model and `section.key=value` settings.

    `tables` are whole tables that win over the scenario's own, as a rig that is already running has
    them, `faults` come beside the scenario's, as `faults.catalogue.parse` reads them. Raises
    ConfigError saying where, what, what is allowed and how to mend it.
    """
    given, path = store.load("scenarios", name)
    return read(given, path, model, settings, tables, faults)


def read(
    given: dict[str, Any],
    path: Path,
    model: str = "",
    settings: tuple[str, ...] = (),
    tables: Mapping[str, Any] | None = None,
    faults: tuple[str, ...] = (),
) -> Scenario:
    """As `load`, of the content of a scenario's file; `path` names it and is where it looks for others."""
    single = _settings(settings)
    # single keys, among them the names of sets, before the sets are looked up
    heads = {key: value for key, value in single.items() if not isinstance(value, dict)}
    given = {**_aliases(given, path), **_aliases(heads, Path("--set"))}
    layers: list[tuple[str, Mapping[str, Any]]] = []
    defaults = {row.name: row.default for row in HEAD}
    for short, kind in SETS.items():
        key = f"{short}_set"
        content, at = store.load(kind, str(given.get(key, defaults[key])), path)
        layers.append((str(at), content))
    layers.append((str(path), {k: v for k, v in given.items() if k not in defaults}))
    if model:
        at = store.find("models", model)
        layers.append((str(at), store.parse(at)))
    layers += [
        ("--set", {k: v for k, v in single.items() if isinstance(v, dict)}),
        ("the running rig", tables or {}),
        ("--fault", {"fault": [catalogue.plain(catalogue.parse(one)) for one in faults]}),
    ]
    head = table.read(HEAD, {k: v for k, v in given.items() if k in defaults}, str(path))
    return resolve(path.parent.name if path.name == "scenario.toml" else path.stem, head, layers)


def resolve(
    name: str, head: dict[str, Any], layers: list[tuple[str, Mapping[str, Any]]]
) -> Scenario:
    """Merge layers of tables, check them and build the parameters."""
    merged: dict[str, dict[str, Any]] = {section: {} for section in SECTIONS}
    programme: dict[str, Any] = {"demand": [], "friction": []}
    planned: tuple[catalogue.Fault, ...] = ()
    source = layers[0][0]
    for where, layer in layers:
        for key, content in layer.items():
            if key in merged:
                _wanted(isinstance(content, Mapping), where, key, content, f"a table [{key}]")
                table.read(SECTIONS[key], content, f"{where} [{key}]")
                if key == "adhesion" and "mu_cd" in content:
                    merged[key].pop(
                        "initial_adhesion", None
                    )  # what comes later wins over what mu_cd followed from
                merged[key].update(content)
            elif key in programme:
                _wanted(
                    isinstance(content, list) and all(isinstance(c, Mapping) for c in content),
                    where,
                    key,
                    content,
                    f"[[{key}]] with two brackets, one for each step",
                )
                programme[key], source = content, where
            elif key == "fault":
                _wanted(
                    isinstance(content, list), where, key, content, "[[fault]] with two brackets"
                )
                planned += catalogue.all_of(content, where)
            elif key in {row.name for row in HEAD}:
                head |= table.read([r for r in HEAD if r.name == key], {key: content}, where)
            else:
                allowed = [*SECTIONS, *programme, "fault", *(row.name for row in HEAD)]
                raise ConfigError(
                    f"{where}: unknown table or key '{key}'{table.nearest(key, allowed)}"
                )
    checked: dict[str, Any] = dict(physics.check(merged, name))
    if checked["rig"]["speed"] == "held" and (
        checked["rig"]["mode"],
        checked["vehicle"]["model"],
    ) != ("contaminated_rollers", "planar"):
        raise ConfigError(
            f"{name} [rig] speed = 'held': only drives hold a speed, and on the coach in 3D none do; "
            'allowed with rig.mode = "contaminated_rollers" and vehicle.model = "planar"'
        )
    for section in ("loop", "bus", "modbus"):
        checked[section] = table.read(SECTIONS[section], merged[section], f"{name} [{section}]")
    acting, hidden = _with_sealed(checked, head.get("sealed", ""))
    tick_s, substeps, sync, record = _ratios(checked, name)
    steps = [
        table.read(DEMAND, row, f"{source} [[demand]] {i}")
        for i, row in enumerate(programme["demand"], start=1)
    ]
    if (starts := [row["from_s"] for row in steps]) != sorted(starts):
        raise ConfigError(f"{source} [[demand]]: from_s must rise from step to step, not {starts}")
    demand = physics.Demand(np.array(starts), np.array([row["pressure_Pa"] for row in steps]))
    friction, friction_rows = _friction(programme["friction"], checked["adhesion"], source)
    resolved = {
        **head,
        **checked,
        "demand": steps,
        "friction": friction_rows,
        "fault": [catalogue.plain(one) for one in planned],
    }
    virtual = checked["rig"]["mode"] == physics.VIRTUAL_TRACK
    return Scenario(
        name=name,
        resolved=resolved,
        params=physics.build(acting, friction, demand, tick_s, substeps),
        rollers=physics.build_rollers(acting, demand, tick_s, substeps) if virtual else None,
        sync_ticks=sync,
        record_ticks=record,
        faults=planned + hidden,
    )


def _with_sealed(
    checked: dict[str, Any], text: str
) -> tuple[dict[str, Any], tuple[catalogue.Fault, ...]]:
    """The sections as they act, and the faults, where a scenario hides some; `resolved` has them sealed only."""
    if not text:
        return checked, ()
    content = seal.opened(text, "sealed")
    mechanisms = table.read(
        physics.ROWS["mechanisms"], checked["mechanisms"] | content.get("mechanisms", {}), "sealed"
    )
    faults = catalogue.all_of(content.get("fault", []), "sealed")
    return checked | {"mechanisms": mechanisms}, tuple(
        dataclasses.replace(one, told=False) for one in faults
    )


def dump(scenario: Scenario) -> str:
    """The resolved scenario as TOML."""
    return (
        "# resolved by rollerrig: every default written out; run it again to repeat the run\n"
        + tomli_w.dumps(scenario.resolved)
    )


def digest(scenario: Scenario) -> str:
    """A hash of all that decides the result."""
    return hashlib.sha256(tomli_w.dumps(scenario.resolved).encode()).hexdigest()[:16]


def _aliases(given: dict[str, Any], path: Path) -> dict[str, Any]:
    # vehicle = "uic_z1" reads better than vehicle_set, and is it where no table [vehicle] is given
    given = dict(given)
    for short in SETS:
        if isinstance(given.get(short), str):
            if f"{short}_set" in given:
                raise ConfigError(f"{path}: both {short} and {short}_set are given; keep one")
            given[f"{short}_set"] = given.pop(short)
    return given


def _wanted(right: bool, where: str, key: str, content: Any, form: str) -> None:
    if not right:
        raise ConfigError(f"{where}: {key} = {content!r}: write {form}")


def _settings(settings: tuple[str, ...]) -> dict[str, Any]:
    tables: dict[str, Any] = {}
    for setting in settings:
        key, _, text = setting.partition("=")
        section, _, name = key.strip().rpartition(".")
        try:
            value = store.tomllib.loads(f"value = {text}")["value"]
        except store.tomllib.TOMLDecodeError:
            value = text.strip()
        if not name or not text:
            raise ConfigError(
                f"--set {setting}: write section.key=value, as in adhesion.mu_cd=0.05"
            )
        if not section and name in SETS:
            name = f"{name}_set"  # a set by name beside single values of it: both may be given
        (tables.setdefault(section, {}) if section else tables)[name] = value
    return tables


def _ratios(checked: dict[str, Any], name: str) -> tuple[float, int, int, int]:
    loop, bus = checked["loop"], checked["bus"]
    tick_s = 1.0 / loop["tick_hz"]

    def whole(ratio: float, what: str) -> int:
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6 * ratio:
            raise ConfigError(
                f"{name}: {what} is {ratio:.6g}; it must be a whole number, at least 1"
            )
        return round(ratio)

    return (
        tick_s,
        whole(
            tick_s / loop["step_s"],
            f"[loop] a tick of {tick_s:g} s over step_s = {loop['step_s']:g} s",
        ),
        whole(
            bus["sync_period_s"] / tick_s,
            f"[bus] sync_period_s = {bus['sync_period_s']:g} s over a tick of {tick_s:g} s",
        ),
        whole(
            loop["tick_hz"] / loop["record_hz"],
            f"[loop] tick_hz = {loop['tick_hz']} over record_hz = {loop['record_hz']}",
        ),
    )


def _friction(
    rows: list[dict[str, Any]], adhesion: dict[str, float], where: str
) -> tuple[physics.Friction, list[dict[str, Any]]]:
    read, masks = [], []
    for i, row in enumerate(rows):
        at, row = f"{where} [[friction]] {i + 1}", dict(row)
        axles = row.pop("axles", list(range(1, AXLES + 1)))
        if not (
            isinstance(axles, list)
            and axles
            and all(type(axle) is int and 1 <= axle <= AXLES for axle in axles)
        ):
            raise ConfigError(f"{at}: axles = {axles!r}; a list of axle numbers from 1 to {AXLES}")
        if ("from_s" in row) == ("from_m" in row):
            raise ConfigError(f"{at}: give from_s (time) or from_m (place), one of them")
        given = table.read([r for r in FRICTION if r.name in row], row, at)
        if unknown := set(row) - {r.name for r in FRICTION}:
            table.read(FRICTION, {key: row[key] for key in unknown}, at)
        read.append(
            {"mu_cd": adhesion["mu_cd"], "mu_cr": adhesion["mu_cr"], "axles": axles} | given
        )
        physics.check_recovery(adhesion | read[-1], at)
        masks.append(sum(1 << (axle - 1) for axle in set(axles)))
    start = np.array([row.get("from_m", row.get("from_s", 0.0)) for row in read])
    return physics.Friction(
        np.array(["from_m" in row for row in read], dtype=np.bool_),
        start,
        np.array([row["mu_cd"] for row in read]),
        np.array([row["mu_cr"] for row in read]),
        np.array(masks, dtype=np.int64),
    ), read
