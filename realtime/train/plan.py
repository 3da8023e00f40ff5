"""The scenario of a train: a scenario with [train], and each car as a scenario of its own.

All cars share rail, rig, bus, loop and demand. A car has its vehicle, its load, and tables that
replace those of the scenario for this car alone. So a car is checked as any other scenario is.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w

from rollerrig.configs import store, table
from rollerrig.configs.errors import ConfigError
from rollerrig.configs.table import choice, flag, integer, number
from rollerrig.configs.vehicle import (
    EQUIPMENT_KEYS,
    MOST_AXLES,
    MOST_CARS,
    TRAIN,
    axle_positions_m,
)
from rollerrig.firmware_sim.faults import catalogue, panel
from rollerrig.realtime.bench import scenario
from rollerrig.realtime.bench.scenario import COMMAND_LINE, Scenario, Sources
from rollerrig.rig.params import TRACK
from rollerrig.rig.train import coupler, pipe

# what lies beyond the first and the last wheelset of a car without length_m, up to the couplers
OVERHANG_M = 2.4
ELECTRO_PNEUMATIC = "electro_pneumatic"
BRAKE_PIPE = "brake_pipe"
REFERENCE = "reference"
NO_UNIT = "none"
# a mask of sanders without one: such a car only meets the sand of others
_NO_AXLE = 1 << MOST_AXLES
# the rig of a train that states none
_RIG = "plain_track"

HEAD = (
    choice(
        "control",
        ELECTRO_PNEUMATIC,
        (ELECTRO_PNEUMATIC, BRAKE_PIPE),
        "how the brake demand reaches the cars",
    ),
    number("delay_s", 0.0, 0.0, 10.0, "electro_pneumatic: delay of the demand at the first car"),
    number("delay_of_car_s", 0.0, 0.0, 5.0, "electro_pneumatic: further delay from car to car"),
    choice("coupler", "screw", (), "configs/couplers: between all cars that name no other one"),
    number(
        "film_recovery_s", 0.0, 0.0, 1e6, "time constant in which the film comes back; 0: never"
    ),
    number("pipe_speed_m_s", 250.0, 50.0, 340.0, "speed of propagation; recollection: UIC 540"),
    number("pipe_time_constant_s", 0.5, 0.001, 60.0, "assumption; lag of the pipe at its valve"),
    number(
        "pipe_time_constant_s_m", 0.005, 0.0, 1.0, "assumption; more lag for each metre of pipe"
    ),
    number("pipe_release_factor", 3.0, 0.1, 100.0, "assumption; lag while the pressure rises"),
    number("pipe_pressure_Pa", 5e5, 1e5, 1e6, "of the charged pipe; recollection: UIC 540"),
    number("pipe_full_reduction_Pa", 1.5e5, 1e4, 5e5, "of full service; recollection: UIC 540"),
    number("pipe_full_demand_Pa", 3.8e5, 1e4, 1e6, "cylinder pressure of full service"),
)
CAR = (
    choice("vehicle_set", "", (), "configs/vehicles; empty: the vehicle of the scenario"),
    integer("count", 1, 1, MOST_CARS, "so many equal cars, one behind the other"),
    number("load_kg", 0.0, 0.0, 2e5, "added to the mass of the vehicle"),
    number("length_m", 0.0, 0.0, 100.0, "over couplers; 0: its wheelsets and 2.4 m at each end"),
    flag("isolated", False, "its brake is isolated and never applies"),
    choice("unit", REFERENCE, (REFERENCE, NO_UNIT), "its WSP unit"),
    choice("wsp_config", "", (), "configs/wsp; empty: that of the scenario"),
    choice("coupler", "", (), "configs/couplers: behind this car; empty: that of the train"),
)
EMERGENCY = (
    number("from_s", 0.0, 0.0, 36000.0, "an emergency valve opens and stays open"),
    integer("car", 1, 1, MOST_CARS, "at this car"),
)
# faults of a car
FAULT = "fault"
# keys of [train] that are lists of tables
LISTS = ("car", "emergency")


@dataclass(frozen=True)
class Car:
    """One car: its values from [[train.car]], and its scenario.

    front_m: distance of its leading end behind that of the train. place_m: distance of its first
    wheelset behind that of the train.
    """

    given: Mapping[str, Any]
    plan: Scenario
    front_m: float
    place_m: float
    length_m: float

    @property
    def has_unit(self) -> bool:
        """Whether a WSP unit controls it."""
        return bool(self.given["unit"] == REFERENCE)


class Brake(NamedTuple):
    """The brake pipe of a train: its form, and what changes its pressure; none: no pipe."""

    form: pipe.Form
    valves: tuple[pipe.Valve, ...]


@dataclass(frozen=True)
class Train:
    """A checked train. `resolved` is the whole as plain data, `name` the file's stem."""

    name: str
    resolved: dict[str, Any]
    cars: tuple[Car, ...]
    couplers: tuple[dict[str, Any], ...]
    brake: Brake | None

    def __getitem__(self, key: str) -> Any:
        return self.resolved[key]

    @property
    def mass_kg(self) -> np.ndarray:
        """The mass of each car, shape (cars,)."""
        return np.array([car.plan["vehicle"]["mass_kg"] for car in self.cars])

    @property
    def first_wheelset_m(self) -> float:
        """The distance of the first wheelset behind the leading end."""
        first = self.cars[0]
        return 0.5 * (first.length_m - axle_positions_m(first.plan["vehicle"])[-1])

    @property
    def length_m(self) -> float:
        """The length over couplers."""
        return self.cars[-1].front_m + self.cars[-1].length_m


def names() -> list[str]:
    """Return the names of the packaged trains."""
    return store.names("trains")


def find(name: str) -> Path | None:
    """Return the file of a train by name or path; None where the scenario of a vehicle is meant.

    Raises ConfigError for a file that cannot be read.
    """
    if name in names():
        return store.find("trains", name)
    if Path(name).suffix != ".toml" or not Path(name).is_file():
        return None
    path = Path(name)
    return path if TRAIN in store.parse(path) else None


def check_name(name: str) -> None:
    """Raise ConfigError for a name that is no scenario, but similar to that of a train."""
    meant = table.similar(name, names())
    if meant and name not in store.names("scenarios") and len(Path(name).parts) == 1:
        raise ConfigError(
            f"no scenario or train is called '{name}'{table.nearest(name, names(), 'Trains')}; or give "
            "the path of a TOML file"
        )


def check_options(given: Mapping[str, bool]) -> None:
    """Raise ConfigError for an option of a run that is given and that a train does not have."""
    for option, is_given in given.items():
        if is_given:
            raise ConfigError(
                f"{option}: a train does not have this yet; allowed is --pacing free with the reference "
                "units or without units, or --pacing lockstep or wall with units on the buses of cars; without "
                "--live, --hold, --start, --harness, --fault and --also-without-wsp"
            )


def load(
    name: str,
    model: str = "",
    settings: tuple[str, ...] = (),
    sources: Sources = COMMAND_LINE,
) -> Train:
    """Load a train by name or path; arguments as for `scenario.load`. Raises ConfigError."""
    path = find(name)
    if path is None:
        raise ConfigError(
            f"{name}: no train is called so{table.nearest(name, names())}; or give the path of a TOML "
            "file with a table [train]"
        )
    return read(store.parse(path), path, model, settings, sources)


def read(
    given: Mapping[str, Any],
    path: Path,
    model: str = "",
    settings: tuple[str, ...] = (),
    sources: Sources = COMMAND_LINE,
) -> Train:
    """Return a train from the content of its file. Raises ConfigError."""
    shared = {"rig_set": _RIG} if not {"rig", "rig_set"} & set(given) else {}
    shared |= {key: value for key, value in given.items() if key != TRAIN}
    _refuse(shared, str(path))
    # settings of [train] are read here, all others belong to the cars
    of_train = [one for one in settings if one.startswith(f"{TRAIN}.")]
    of_cars = tuple(one for one in settings if one not in of_train)
    head, rows, emergencies = _checked(given[TRAIN], str(path), of_train)

    loads = _Loads(shared, path, model, of_cars, sources)
    loads.fix_adhesion(loads.plan(*rows[0], 1))
    plans = [loads.plan(row, tables, number) for number, (row, tables) in enumerate(rows, 1)]
    demand = plans[0].resolved["demand"]
    cars = _placed([row for row, _ in rows], plans, head, path)
    brake = _brake(head, demand, emergencies, cars, str(path))
    couplers = _couplers(head, [row for row, _ in rows], path)
    name = path.parent.name if path.name == "scenario.toml" else path.stem
    resolved = _resolved(head, rows, emergencies, plans)
    return Train(name, resolved, tuple(cars), tuple(couplers), brake)


def _refuse(shared: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError for what a train does not have yet."""
    for key, remedy in (
        ("fault", "[[train.car.fault]], a fault of one car"),
        ("sealed", "a rig with hidden effects is one vehicle"),
        ("traction", "[[demand]]"),
    ):
        if shared.get(key):
            raise ConfigError(f"{where}: a train has no [[{key}]] yet; allowed is {remedy}")
    for step in shared.get("friction", []):
        if isinstance(step, Mapping) and "axles" in step:
            raise ConfigError(
                f"{where} [[friction]]: axles = {step['axles']!r}: the friction of a train depends on "
                "the place or the time; remove axles"
            )


Row = tuple[dict[str, Any], dict[str, Any]]


def _checked(
    given: Any, where: str, settings: Sequence[str]
) -> tuple[dict[str, Any], list[Row], list[dict[str, Any]]]:
    """Return [train], its cars with their own tables, and its emergency valves, all checked."""
    at = f"{where} [train]"
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where}: train = {given!r}: write a table [train]")
    keys = {row.name for row in HEAD}
    table.known(given, [*keys, *LISTS], lambda key: at)
    head_given = {key: value for key, value in given.items() if key in keys}
    head_given |= scenario.settings_of(settings, TRAIN)
    head = table.read(HEAD, head_given, at)

    lists: dict[str, list[Mapping[str, Any]]] = {}
    for key in LISTS:
        content = given.get(key, [])
        if not isinstance(content, list) or not all(isinstance(one, Mapping) for one in content):
            raise ConfigError(f"{at}: {key} = {content!r}: write [[train.{key}]]")
        lists[key] = content
    rows: list[Row] = []
    car_keys = {row.name for row in CAR}
    for place, in_file in enumerate(lists["car"], start=1):
        here = f"{where} [[train.car]] {place}"
        content = dict(in_file)
        if isinstance(content.get("vehicle"), str):
            # the name of a file, which reads better, as in a scenario
            content["vehicle_set"] = content.pop("vehicle")
        table.known(content, [*car_keys, *scenario.SECTIONS, FAULT], lambda key, here=here: here)
        own = {key: content[key] for key in content if key not in car_keys}
        shared_by_all = [key for key in ("loop", "bus", "modbus", "rig") if key in own]
        if shared_by_all:
            raise ConfigError(
                f"{here}: [{shared_by_all[0]}] is the same for all cars; write it at the top of the file"
            )
        row = table.read(CAR, {key: content[key] for key in content if key in car_keys}, here)
        rows += [({**row, "count": 1}, own) for _ in range(row["count"])]
    if not 1 <= len(rows) <= MOST_CARS:
        raise ConfigError(f"{at} has {len(rows)} cars; allowed are 1 to {MOST_CARS} [[train.car]]")
    emergencies = [
        table.read(EMERGENCY, one, f"{where} [[train.emergency]] {place}")
        for place, one in enumerate(lists["emergency"], start=1)
    ]
    for one in emergencies:
        if one["car"] > len(rows):
            raise ConfigError(f"{at} emergency: car = {one['car']}, but it has {len(rows)} cars")
    return head, rows, emergencies


class _Loads:
    """Loads the scenarios of cars, each kind of car once."""

    def __init__(
        self,
        shared: Mapping[str, Any],
        path: Path,
        model: str,
        settings: tuple[str, ...],
        sources: Sources,
    ) -> None:
        self._shared = shared
        self._path = path
        self._model = model
        self._settings = settings
        self._sources = sources
        self._made: dict[str, Scenario] = {}

    def fix_adhesion(self, first: Scenario) -> None:
        """Give all cars the contaminant that an initial adhesion states for the first car.

        The mu_cd of an initial adhesion depends on the load, and all cars run on the same rail.
        """
        adhesion = first["adhesion"]
        if adhesion["initial_adhesion"] == 0.0:
            return
        stated = {key: value for key, value in adhesion.items() if not key.startswith("initial_")}
        shared = dict(self._shared)
        if isinstance(shared.get("adhesion"), str):
            shared["adhesion_set"] = shared["adhesion"]
        self._shared = {**shared, "adhesion": stated}
        self._settings = tuple(one for one in self._settings if not one.startswith("adhesion."))
        self._made.clear()

    def plan(self, row: Mapping[str, Any], own: Mapping[str, Any], number: int) -> Scenario:
        """Return the scenario of a car without its load. Raises ConfigError."""
        key = repr((row["vehicle_set"], row["wsp_config"], own))
        if key not in self._made:
            given = dict(self._shared)
            if row["vehicle_set"]:
                if isinstance(given.get("vehicle"), str):
                    del given["vehicle"]
                given["vehicle_set"] = row["vehicle_set"]
            if row["wsp_config"]:
                given["wsp_config"] = row["wsp_config"]
            for section, content in own.items():
                if section == FAULT:
                    given[section] = content
                    continue
                earlier = given.get(section, {})
                given[section] = {**(earlier if isinstance(earlier, Mapping) else {}), **content}
                if isinstance(earlier, str):
                    given[f"{section}_set"] = earlier
            plan = scenario.read(
                given, self._path, self._model, self._settings, sources=self._sources
            )
            _check_car(plan, f"{self._path} car {number}")
            self._made[key] = plan
        return self._made[key]


def _check_car(plan: Scenario, where: str) -> None:
    """Raise ConfigError for a car with what a train does not have yet."""
    remedy = "run the car alone in lockstep"
    panel.check_without_bus(plan.faults, f"{where}, a car of a train,", remedy)
    for fault in plan.faults:
        catalogue.check_equipped(fault, plan.resolved, where)
    params = plan.params
    for refused, what, allowed in (
        (params.mode != TRACK, "rig.mode = contaminated_rollers", 'rig = "plain_track"'),
        (plan.rollers is not None, "rig.mode = virtual_track", 'rig = "plain_track"'),
        (params.coach is not None, "vehicle.model = multibody", 'model = "planar"'),
        (params.patch.model is not None, "contact.model", 'contact.model = "degraded"'),
        (plan["rig"]["speed"] == "held", "rig.speed = held", "a speed that the brakes change"),
        (plan["bus"]["arbitration"], "bus.arbitration", "arbitration = false"),
    ):
        if refused:
            raise ConfigError(f"{where}: a train does not have {what} yet; allowed is {allowed}")


def _placed(
    rows: Sequence[Mapping[str, Any]],
    plans: Sequence[Scenario],
    head: Mapping[str, Any],
    path: Path,
) -> list[Car]:
    """Return the cars at their places, with their loads and demands. Raises ConfigError."""
    cars: list[Car] = []
    front_m = 0.0
    first_before_m = 0.0
    for ahead, (row, plan) in enumerate(zip(rows, plans, strict=True)):
        span_m = axle_positions_m(plan["vehicle"])[-1]
        length_m = row["length_m"] or span_m + 2.0 * OVERHANG_M
        if length_m <= span_m:
            raise ConfigError(
                f"{path} car {ahead + 1}: length_m = {length_m:g} is not more than the {span_m:g} m "
                "from its first to its last wheelset"
            )
        delay_s = head["delay_s"] + ahead * head["delay_of_car_s"]
        before_m = 0.5 * (length_m - span_m)
        if not cars:
            first_before_m = before_m
        place_m = front_m + before_m - first_before_m
        acting = _acting(plan, row, head, delay_s, f"{path} car {ahead + 1}")
        cars.append(Car(row, acting, front_m, place_m, length_m))
        front_m += length_m
    return _sanded(cars)


def _sanded(cars: list[Car]) -> list[Car]:
    """Return the cars; where one has sanders, all others meet its sand, too."""
    sanding = [car.plan.params.sanders for car in cars if car.plan.params.sanders.axles != 0]
    if not sanding:
        return cars
    no_sander = sanding[0]._replace(axles=_NO_AXLE)
    found = []
    for car in cars:
        params = car.plan.params
        if params.sanders.axles == 0:
            params = params._replace(sanders=no_sander)
        found.append(dataclasses.replace(car, plan=dataclasses.replace(car.plan, params=params)))
    return found


def _acting(
    plan: Scenario, row: Mapping[str, Any], head: Mapping[str, Any], delay_s: float, where: str
) -> Scenario:
    """Return the scenario of a car with its load, and with the demand as the car receives it."""
    resolved = dict(plan.resolved)
    vehicle = dict(resolved["vehicle"])
    vehicle["mass_kg"] += row["load_kg"]
    resolved["vehicle"] = vehicle
    demand = resolved["demand"]
    if row["isolated"]:
        demand = []
    elif head["control"] == ELECTRO_PNEUMATIC:
        demand = [{**step, "from_s": step["from_s"] + delay_s} for step in demand]
    resolved["demand"] = demand
    if resolved == plan.resolved:
        return plan
    defaults = {row.name for row in scenario.HEAD}
    head_of_car = {key: value for key, value in resolved.items() if key in defaults}
    tables = {key: value for key, value in resolved.items() if key not in defaults}
    return dataclasses.replace(
        scenario.resolve(plan.name, head_of_car, [(where, tables)]), name=plan.name
    )


def _brake(
    head: Mapping[str, Any],
    demand: Sequence[Mapping[str, Any]],
    emergencies: Sequence[Mapping[str, Any]],
    cars: Sequence[Car],
    where: str,
) -> Brake | None:
    """Return the brake pipe and what changes its pressure; None without. Raises ConfigError."""
    if head["control"] != BRAKE_PIPE:
        if emergencies:
            raise ConfigError(
                f"{where} [[train.emergency]]: an emergency valve is on a brake pipe; allowed with "
                f'control = "{BRAKE_PIPE}", or write the demand in [[demand]]'
            )
        return None
    form = pipe.Form(
        speed_m_s=head["pipe_speed_m_s"],
        time_constant_s=head["pipe_time_constant_s"],
        time_constant_s_m=head["pipe_time_constant_s_m"],
        release_factor=head["pipe_release_factor"],
        pressure_Pa=head["pipe_pressure_Pa"],
        full_reduction_Pa=head["pipe_full_reduction_Pa"],
        full_demand_Pa=head["pipe_full_demand_Pa"],
    )
    if form.full_reduction_Pa >= form.pressure_Pa:
        raise ConfigError(
            f"{where} [train]: pipe_full_reduction_Pa = {form.full_reduction_Pa:g} must be below "
            f"pipe_pressure_Pa = {form.pressure_Pa:g}"
        )
    valves = []
    for step in demand:
        share = step["pressure_Pa"] / form.full_demand_Pa
        if share > 1.0:
            raise ConfigError(
                f"{where} [[demand]]: pressure_Pa = {step['pressure_Pa']:g} is more than "
                f"pipe_full_demand_Pa = {form.full_demand_Pa:g}; for an emergency brake write "
                "[[train.emergency]]"
            )
        level_Pa = form.pressure_Pa - share * form.full_reduction_Pa
        valves.append(pipe.Valve(step["from_s"], 0.0, level_Pa, False))
    for one in emergencies:
        car = cars[one["car"] - 1]
        place_m = car.front_m + 0.5 * car.length_m
        valves.append(pipe.Valve(one["from_s"], place_m, 0.0, True))
    return Brake(form, tuple(valves))


def _couplers(
    head: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], path: Path
) -> list[dict[str, Any]]:
    """Return the checked values of the coupler behind each car but the last. Raises ConfigError."""
    found = []
    for row in rows[:-1]:
        name = row["coupler"] or head["coupler"]
        content, file = store.load("couplers", name, path)
        table.known(content, [coupler.SECTION], lambda key, file=file: str(file))
        found.append(coupler.check(content.get(coupler.SECTION, {}), f"{file} [coupler]"))
    return found


def _resolved(
    head: Mapping[str, Any],
    rows: Sequence[Row],
    emergencies: Sequence[Mapping[str, Any]],
    plans: Sequence[Scenario],
) -> dict[str, Any]:
    """Return the whole train as plain data, which reads again as the same train."""
    first = plans[0].resolved
    of_cars = {"vehicle_set", "wsp_config", FAULT, *EQUIPMENT_KEYS}
    common = {
        key: value
        for key, value in first.items()
        if key not in of_cars and all(plan.resolved.get(key) == value for plan in plans)
    }
    common["friction"] = [
        {key: value for key, value in step.items() if key != "axles"} for step in first["friction"]
    ]
    cars = []
    for (row, _), plan in zip(rows, plans, strict=True):
        different = {
            key: value
            for key, value in plan.resolved.items()
            if (key in scenario.SECTIONS and key not in common) or (key == FAULT and value)
        }
        names = {key: plan.resolved[key] for key in ("vehicle_set", "wsp_config")}
        cars.append({**row, **names, **different})
    train = {**head, "car": cars}
    if emergencies:
        train["emergency"] = list(emergencies)
    return {**common, TRAIN: train}


def dump(train: Train) -> str:
    """Return the resolved train as TOML, with a comment on how to repeat the run."""
    head = "# a train, resolved by rollerrig: every default written out\n"
    return head + "# Run it again to repeat the run.\n" + tomli_w.dumps(train.resolved)
