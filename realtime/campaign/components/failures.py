"""The table [failures] of a plan: which components can have failed at a stop, and what follows.

Each entry is a kind of component. It is in each unit of a kind of unit (`on`), or in some of them
(`places`). A component that fails takes the brake force of its unit (`loses`), is a fault of the
catalogue there (`fault`), or changes values of the scenario (`set`). A common cause is a component
of a larger unit: a cable on each bogie, the compressor of the train. A component that is known to
have failed has the probability 1.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rollerrig.configs import table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import choice, integer, number
from rollerrig.configs.vehicle import AXLES_OF_BOGIE
from rollerrig.firmware_sim.faults import catalogue
from rollerrig.realtime.campaign.components import train as trains
from rollerrig.realtime.campaign.statistics import failing

# without a rule any number of components may have failed
_NO_RULE = 0
# keys of an entry of [failures]; `places` and `set` have no row, and the parameters of a fault come
# in addition
ROWS = (
    choice("on", trains.AXLE, trains.UNITS, "each of these units has one such component"),
    number("probability", None, 0.0, 1.0, "that it has failed at a stop; or the next two"),
    number("rate_1_h", None, 0.0, 1.0, "failures an hour that only an inspection finds"),
    number("inspection_interval_h", None, 1e-3, 1e7, "between two inspections"),
    number("loses", 0.0, 0.0, 1.0, "lost fraction of the brake torque of the unit"),
    choice("fault", "", (), "name in the fault catalogue; its parameters are further keys"),
    integer("most", _NO_RULE, 0, 10_000, "a train with more of them does not run; 0: no rule"),
    choice("source", "", (), "where the probability is from; required"),
)
# the least probability that has a separate stratum: a tenth of that of the rarest level of ETCS
RAREST = number("rarest", 1e-10, 1e-15, 0.1, "least probability with a stratum of its own")
_PLACES = "places"
_SET = "set"
# what a fault aims at, with the units that have it
_AIM_OF_AXLE = "axle"
_AIM_OF_BOGIE = "bogie"


class Effect(NamedTuple):
    """What one failed component does.

    discs: its unit. loses: fraction of the brake torque of these discs.
    faults: texts in the form of `--fault`. values: of scenario keys.
    """

    discs: trains.Discs
    loses: float
    faults: tuple[str, ...]
    values: dict[str, Any]


class Failure(NamedTuple):
    """A kind of component: how probable its failures are, and what each one does.

    effects: by the number of the unit, from 1. law, source: for reports.
    """

    name: str
    kind: failing.Kind
    effects: dict[int, Effect]
    law: str
    source: str

    @property
    def column(self) -> str:
        """The name of its column in the results: the numbers of the failed units, as a text."""
        return f"failures.{self.name}"


def read(given: Any, train: trains.Train, path: Path) -> tuple[tuple[Failure, ...], float]:
    """Return the kinds of components of the table [failures], and `rarest`. Raises ConfigError."""
    where = f"{path} [failures]"
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where} = {given!r}: must be a table with an entry for each component")
    rarest = table.check(RAREST, given.get(RAREST.name, RAREST.default), where)
    found = []
    for name, entry in given.items():
        if name == RAREST.name:
            continue
        at = f"{where} {name}"
        if not isinstance(entry, Mapping):
            raise ConfigError(
                f"{at} = {entry!r}: must be a table, such as [failures.{name}] with on, "
                "probability, source, and one of loses, fault and set"
            )
        found.append(_read_one(name, entry, train, at))
    return tuple(found), rarest


def _read_one(name: str, entry: Mapping[str, Any], train: trains.Train, at: str) -> Failure:
    fault = _fault(entry.get("fault", ""), at)
    aims = {_AIM_OF_AXLE, _AIM_OF_BOGIE}
    parameters = [row for row in fault.parameters if row.name not in aims] if fault else []
    names = [row.name for row in (*ROWS, *parameters)]
    table.known(entry, [*names, _PLACES, _SET], lambda key: at)
    given_rows = [row for row in ROWS if row.name in entry]
    head = {row.name: row.default for row in ROWS}
    head |= table.read(given_rows, {row.name: entry[row.name] for row in given_rows}, at)
    if not head["source"].strip():
        raise ConfigError(
            f"{at}: source is missing; write where this probability is from, or that it is an "
            "assumption"
        )
    values = entry.get(_SET, {})
    if not isinstance(values, Mapping) or not all(
        isinstance(value, str | int | float) for value in values.values()
    ):
        raise ConfigError(
            f"{at}: set = {values!r}: must be a table of scenario keys in quotes, such as "
            '{ "air.supply_pressure_Pa" = 0.0 }'
        )
    if not fault and not head["loses"] and not values:
        raise ConfigError(
            f"{at}: states no effect; give loses (fraction of the brake torque), fault (a name of "
            "'rollerrig list faults'), or set (values of the scenario)"
        )

    units = train.units(head["on"])
    places = _places(entry.get(_PLACES), len(units), head["on"], at)
    given_parameters = {row.name: entry[row.name] for row in parameters if row.name in entry}
    effects = {}
    for place in places:
        discs = units[place - 1]
        faults: tuple[str, ...] = ()
        if fault:
            faults = _fault_texts(fault, given_parameters, head["on"], train.axles_of(discs), at)
        effects[place] = Effect(discs, head["loses"], faults, dict(values))
    probability, law = _probability(head, at)
    most = min(head["most"] or len(places), len(places))
    if probability == 1.0 and most < len(places):
        raise ConfigError(
            f"{at}: probability = 1 and most = {most}: all {len(places)} of them have failed, so no "
            "train runs; remove most, or list fewer places"
        )
    rule = f", at most {most} in a train" if most < len(places) else ""
    kind = failing.Kind(len(places), probability, most)
    text = f"{len(places)} x {head['on']}: {law}{rule}"
    return Failure(name, kind, effects, text, head["source"])


def _fault(name: Any, at: str) -> catalogue.Kind | None:
    """Return a row of the fault catalogue by its name; None without a name."""
    if name == "":
        return None
    if name not in catalogue.BY_NAME:
        raise ConfigError(f"{at}: fault = {name!r}{table.nearest(str(name), catalogue.BY_NAME)}")
    return catalogue.BY_NAME[name]


def _places(given: Any, most: int, kind: str, at: str) -> tuple[int, ...]:
    """Return the numbers of the units that have the component; all without a list."""
    if given is None:
        return tuple(range(1, most + 1))
    is_list = isinstance(given, list) and bool(given) and len(set(map(str, given))) == len(given)
    if not is_list or not all(type(place) is int and 1 <= place <= most for place in given):
        raise ConfigError(
            f"{at}: places = {given!r}: must be different whole numbers from 1 to {most}, the "
            f"number of the {kind} from the leading end"
        )
    return tuple(sorted(given))


def _fault_texts(
    fault: catalogue.Kind, parameters: Mapping[str, Any], kind: str, axles: list[int], at: str
) -> tuple[str, ...]:
    """Return a fault at each axle or bogie of a unit, or that of the whole train."""
    words = [f"{name}={value}" for name, value in parameters.items()]
    names = {row.name for row in fault.parameters}
    if _AIM_OF_AXLE in names:
        if kind == trains.DISC:
            raise ConfigError(
                f'{at}: fault = "{fault.name}" acts on an axle; set on = "axle" or a larger unit'
            )
        aims = [f"axle={axle}" for axle in axles]
    elif _AIM_OF_BOGIE in names:
        if kind in (trains.DISC, trains.AXLE):
            raise ConfigError(
                f'{at}: fault = "{fault.name}" acts on a bogie; set on = "bogie" or a larger unit'
            )
        bogies = sorted({(axle + 1) // AXLES_OF_BOGIE for axle in axles})
        aims = [f"bogie={bogie}" for bogie in bogies]
    else:
        if kind != trains.WHOLE:
            raise ConfigError(
                f'{at}: fault = "{fault.name}" acts on no axle or bogie; set on = "train"'
            )
        aims = [""]
    return tuple(" ".join(filter(None, (fault.name, aim, *words))) for aim in aims)


def _probability(head: Mapping[str, Any], at: str) -> tuple[float, str]:
    """Return the probability at a stop, and how it was given."""
    probability = head["probability"]
    rate_1_h, interval_h = head["rate_1_h"], head["inspection_interval_h"]
    has_rate = rate_1_h is not None
    if (probability is None) != has_rate or has_rate != (interval_h is not None):
        raise ConfigError(
            f"{at}: give probability, or rate_1_h and inspection_interval_h, and not both"
        )
    if probability is not None:
        return float(probability), f"probability {probability:g}"
    found = failing.probability_at_a_stop(rate_1_h, interval_h)
    rate = f"{rate_1_h:g}".replace("e-0", "e-")
    return found, f"probability {found:.3g} ({rate}/h, inspected every {interval_h:g} h)"


def shown(places: tuple[int, ...], failure: Failure) -> str:
    """Return the failed components, places from 0 in the list of `failure`, as in its column."""
    units = list(failure.effects)
    return ", ".join(str(units[place]) for place in places)


def failed(text: str) -> list[int]:
    """Return the numbers of the failed units in a cell of a column."""
    return [int(word) for word in text.split(",") if word.strip()]
