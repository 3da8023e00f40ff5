"""The record of a train's run: its folder, its channels and its summary.

The folder of the train has what concerns all cars; the folders car_1, car_2 ... in it are the
records of the cars, as `rollerrig run` writes them for one vehicle. A quantity of car n has the
prefix car_n_, and axles count through. A `Recorder` writes channels and events while the run goes
on, so a run that is killed keeps them, as that of a vehicle does.
"""

import contextlib
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rollerrig.configs.output_files import make_folder, write_bytes, write_text, writing
from rollerrig.configs.vehicle import MOST_CARS, axle_positions_m
from rollerrig.realtime.bench import free, scenario
from rollerrig.realtime.record import channels, played, records, run_folder, summary
from rollerrig.realtime.telemetry import train_view
from rollerrig.realtime.train import plan
from rollerrig.realtime.train.plan import Car, Train
from rollerrig.realtime.train.stop import Samples, Stop
from rollerrig.wsp_interface import braking
from rollerrig.wsp_interface.events import Event

# channels of a car, and their names behind car_n_
_OF_CAR = {
    "vehicle_speed_m_s": "speed_m_s",
    "position_m": "position_m",
    "vehicle_acceleration_m_s2": "acceleration_m_s2",
    "brake_demand_Pa": "brake_demand_Pa",
    "air_consumption_NL": "air_consumption_NL",
    "reservoir_pressure_Pa": "reservoir_pressure_Pa",
}
# parts of a summary that only the bench of a car on a bus knows
_OF_BENCH = ("ended", "loop", "bus", "modbus", "recorder", "unit_played", "random", "seed")
# signals of axles that the record of the train has; the folders of the cars have all
_OF_AXLES = (
    "wheel_speed",
    "sliding",
    "adhesion",
    "friction_degraded",
    "cylinder_pressure",
    "brake_torque",
    "wheel_load",
    "valve",
    "vents",
)


def folder_of_car(folder: Path, number: int) -> Path:
    """Return the folder of a car, counted from 1, in the folder of a train's run."""
    return folder / f"car_{number}"


def name_of_car(train: Train, number: int) -> str:
    """Return the name of a car in its summary."""
    return f"{train.name} car {number}"


def begin(train: Train, folder: Path) -> None:
    """Make the folder of a run and those of its cars. Raises ConfigError."""
    run_folder.begin(folder)
    with writing(folder):
        _remove_further_cars(folder, len(train.cars))
        write_text(folder / run_folder.SCENARIO, plan.dump(train))
        for number, car in enumerate(train.cars, start=1):
            of_car = folder_of_car(folder, number)
            make_folder(of_car)
            run_folder.begin(of_car)
            write_text(of_car / run_folder.SCENARIO, scenario.dump(car.plan))


def _remove_further_cars(folder: Path, cars: int) -> None:
    """Remove the records of cars that an earlier run in this folder had behind so many cars."""
    for number in range(cars + 1, MOST_CARS + 1):
        of_car = folder_of_car(folder, number)
        if (of_car / run_folder.MARK).is_file():
            run_folder.begin(of_car)
            (of_car / run_folder.MARK).unlink()
            # a folder with files of the user is kept
            with contextlib.suppress(OSError):
                of_car.rmdir()


def train_channels(train: Train, samples: Samples) -> dict[str, np.ndarray]:
    """Return the channels of a train, (n,) each, by their names.

    vehicle_speed_m_s is the speed of the centre of mass, position_m the place of the first car.
    """
    masses = train.mass_kg
    speeds = np.array([one["vehicle_speed_m_s"] for one in samples.cars])
    found = {
        "time_s": samples.cars[0]["time_s"],
        "vehicle_speed_m_s": masses @ speeds / np.sum(masses),
        "position_m": samples.cars[0]["position_m"],
        "train_deceleration_m_s2": samples.deceleration_m_s2,
    }
    for number, one in enumerate(samples.cars, start=1):
        for name, behind in _OF_CAR.items():
            found[f"car_{number}_{behind}"] = one[name]
        if train.brake:
            found[f"car_{number}_brake_pipe_Pa"] = samples.pipe_Pa[:, number - 1]
    for number in range(1, len(train.cars)):
        found[f"coupler_{number}_N"] = samples.force_N[:, number - 1]
        found[f"coupler_{number}_m"] = samples.displacement_m[:, number - 1]
    axles_before = 0
    for car, one in zip(train.cars, samples.cars, strict=True):
        table = car.plan.table
        for name in _OF_AXLES:
            row = table.by_name[name]
            for axle in range(1, car.plan.kind.axles + 1):
                unit = f"_{row.unit}" if row.unit else ""
                found[f"{name}_{axles_before + axle}{unit}"] = one[f"{name}_{axle}{unit}"]
        axles_before += car.plan.kind.axles
    return found


class Recorder:
    """Writes the channels and events of a stop into its folder while it goes on.

    The bench writes those of the cars `on_bus`. A train with such cars gets its own channels at the
    end, because they need those of all cars.
    """

    def __init__(self, stop: Stop, folder: Path, on_bus: Sequence[int] = ()) -> None:
        self._stop = stop
        self._folder = folder
        self._on_bus = tuple(on_bus)
        self._rows = 0
        self._cars: dict[int, channels.Channels] = {}
        self._events = dict.fromkeys(range(1, len(stop.cars) + 1), 0)
        samples = stop.samples()
        for number, one in enumerate(samples.cars, start=1):
            if number not in on_bus:
                of_car = folder_of_car(folder, number)
                self._cars[number] = channels.Channels(of_car, list(one))
                write_text(of_car / run_folder.EVENTS, "")
        self._train: channels.Channels | None = None
        if not on_bus:
            names = list(train_channels(stop.train, samples))
            self._train = channels.Channels(folder, names)

    def add(self) -> None:
        """Write what has been recorded since the last call."""
        samples = self._stop.samples()
        new = samples.between(self._rows, len(samples.pipe_Pa))
        self._rows = len(samples.pipe_Pa)
        for number, written in self._cars.items():
            _add(written, new.cars[number - 1])
            written.write_if_due()
            self._add_events(number)
        if self._train:
            _add(self._train, train_channels(self._stop.train, new))
            self._train.write_if_due()

    def _add_events(self, number: int) -> None:
        of_stop = self._stop.cars[number - 1]
        events = of_stop.events if of_stop else []
        if len(events) > self._events[number]:
            lines = [json.dumps(event._asdict()) + "\n" for event in events]
            write_text(folder_of_car(self._folder, number) / run_folder.EVENTS, "".join(lines))
            self._events[number] = len(events)

    def finish(self, counters: Mapping[str, Any]) -> dict[str, Any]:
        """Complete the record of a stop that is done, with run.rrd; return the train's summary.

        `counters` are those of `summary.of`. Raises ConfigError.
        """
        self.add()
        folder, on_bus, train = self._folder, self._on_bus, self._stop.train
        samples = self._stop.samples()
        if on_bus:
            samples = _with_recorded(samples, folder, on_bus)
            # all cars have the ticks of one loop
            loop = records.summary(folder_of_car(folder, on_bus[0]))["loop"]
            counters = {**counters, "loop": loop}
        of_cars = summaries_of_cars(self._stop, samples, counters)
        for number, result in enumerate(of_cars, start=1):
            of_car = folder_of_car(folder, number)
            if number in on_bus:
                of_cars[number - 1] = records.summary(of_car)
                continue
            self._cars[number].finish(played.of_summary(result).texts())
            records.write_summary(of_car, result)
        result = summary_of(self._stop, samples, of_cars, counters, on_bus)
        if self._train is None:
            columns = train_channels(train, samples)
            self._train = channels.Channels(folder, list(columns))
            _add(self._train, columns)
        self._train.finish(played.of_summary(result).texts())
        records.write_summary(folder, result)
        if not len(samples.force_N):
            # a run that failed before its first sample
            return result
        with writing(folder):
            recording = train_view.recording(records.load(folder))
            write_bytes(folder / run_folder.RRD, recording)
        return result


def _add(written: channels.Channels, columns: Mapping[str, np.ndarray]) -> None:
    """Add the rows of columns, (n,) each, in their order."""
    written.add(np.column_stack(list(columns.values())))


def _with_recorded(samples: Samples, folder: Path, on_bus: Sequence[int]) -> Samples:
    """Return the samples with those of cars that a recorder has written, as far as all go."""
    cars = list(samples.cars)
    for number in on_bus:
        columns = channels.Columns(folder_of_car(folder, number))
        cars[number - 1] = {name: channels.values(columns[name]) for name in columns}
    return samples._replace(cars=cars).common


def summaries_of_cars(
    stop: Stop, samples: Samples, counters: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Return the summary of each car, with its events; `counters` are those of `summary.of`."""
    found = []
    for number, (car, one) in enumerate(zip(stop.train.cars, samples.cars, strict=True), start=1):
        of_stop = stop.cars[number - 1]
        events = of_stop.events if of_stop else []
        result = _summary_of_car(stop.train, car, number, one, counters, events)
        found.append(result | {"events": [event._asdict() for event in events]})
    return found


def demand_Pa(samples: Samples) -> np.ndarray:
    """Return the largest brake demand of all cars, shape (n,)."""
    return np.asarray(np.max([one["brake_demand_Pa"] for one in samples.cars], axis=0))


def _summary_of_car(
    train: Train,
    car: Car,
    number: int,
    one: Mapping[str, np.ndarray],
    counters: Mapping[str, Any],
    events: list[Event],
) -> dict[str, Any]:
    """Return the summary of a car as that of a run of its own."""
    unit = counters["unit"] if car.has_unit else plan.NO_UNIT
    of_car = {
        **counters,
        "scenario": name_of_car(train, number),
        "unit": unit,
        "unit_played": played.unit_of(unit)._asdict(),
        "config_hash": scenario.digest(car.plan),
    }
    return summary.of(one, of_car, car.plan.resolved, events)


def digest(train: Train) -> str:
    """Return a hash of everything that decides the result."""
    return hashlib.sha256(plan.dump(train).encode()).hexdigest()[:16]


def summary_of(
    stop: Stop,
    samples: Samples,
    of_cars: list[dict[str, Any]],
    counters: Mapping[str, Any],
    on_bus: Sequence[int] = (),
    with_alone: bool = True,
) -> dict[str, Any]:
    """Return the summary of a train: that of the first car, with the axles of all cars.

    In addition it has `train`, `cars`, `couplers` and, unless it is left out, `alone`. The braking
    begins with the demand at any car. Loop, bus, unit and seed are those of the first car on a bus,
    where there is one.
    """
    train = stop.train
    first = {
        **of_cars[0],
        **_braking(samples),
        "events": [{**event, "car": number} for number, event in _events(of_cars)],
        "cars_on_bus": list(on_bus),
        "unit_played": counters["unit_played"],
    }
    if on_bus:
        of_bench = of_cars[on_bus[0] - 1]
        first |= {key: of_bench[key] for key in _OF_BENCH}
    axles = [axle for one in of_cars for axle in one["axles"]]
    invalid = [
        f"car {number}: {reason}"
        for number, one in enumerate(of_cars, start=1)
        for reason in one["invalid_because"]
    ]
    vents = [one["wsp"]["vents"] for one in of_cars]
    least_Pa = [one["reservoir_least_Pa"] for one in of_cars]
    return {
        **first,
        "scenario": train.name,
        "title": train.resolved.get("title") or None,
        "vehicle": ", ".join(dict.fromkeys(car.plan["vehicle_set"] for car in train.cars)),
        "config_hash": digest(train),
        "axles": axles,
        "wsp": {
            "unit": of_cars[on_bus[0] - 1]["wsp"]["unit"] if on_bus else counters["unit"],
            "active_s": max(one["wsp"]["active_s"] for one in of_cars),
            "vents": sum(vents),
        },
        "air_consumption_NL": sum(one["air_consumption_NL"] for one in of_cars),
        "reservoir_least_Pa": min(least_Pa),
        "valid": not invalid,
        "invalid_because": invalid,
        "train": {
            "cars": len(train.cars),
            "mass_kg": float(np.sum(train.mass_kg)),
            "length_m": train.length_m,
            "control": train["train"]["control"],
        },
        "cars": [
            _car(train, number, one, channels_of)
            for number, (one, channels_of) in enumerate(
                zip(of_cars, samples.cars, strict=True), start=1
            )
        ],
        "couplers": _couplers(stop),
        "alone": _alone(train, counters["unit"]) if with_alone else None,
    }


def _braking(samples: Samples) -> dict[str, float | None]:
    """Return time and distance from the first brake demand to the standstill of the first car."""
    first = samples.cars[0]
    begin = braking.begin(demand_Pa(samples))
    end = braking.standstill(first["vehicle_speed_m_s"])
    if begin is None or end is None or begin >= end:
        return {"braking_time_s": None, "braking_distance_m": None}
    time_s, position_m = first["time_s"], first["position_m"]
    return {
        "braking_time_s": float(time_s[end] - time_s[begin]),
        "braking_distance_m": float(position_m[end] - position_m[begin]),
    }


def _events(of_cars: list[dict[str, Any]]) -> list[tuple[int, dict[str, Any]]]:
    """Return the events of all cars in the order of their times, each with its car."""
    found = [
        (number, event)
        for number, one in enumerate(of_cars, start=1)
        for event in one.get("events", [])
    ]
    return sorted(found, key=lambda pair: pair[1]["time_s"])


def _alone(train: Train, unit: str) -> dict[str, Any] | None:
    """Return the stop of the first car with a brake, alone; None where all are isolated."""
    for number, car in enumerate(train.cars, start=1):
        if not car.given["isolated"]:
            of_car = unit if car.has_unit else plan.NO_UNIT
            rows = free.simulate(car.plan, "none" if of_car == plan.NO_UNIT else plan.REFERENCE)
            one = summary.of(free.channels(rows, car.plan.table), {}, car.plan.resolved)
            return {
                "car": number,
                "stopped": one["stopped"],
                "braking_distance_m": one["braking_distance_m"],
            }
    return None


def _car(
    train: Train, number: int, of_car: Mapping[str, Any], one: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """Return what the summary of a train has of a car.

    Its places in m are behind the leading end of the train.
    """
    car = train.cars[number - 1]
    axles = of_car["axles"]
    first = 1 + sum(before.plan.kind.axles for before in train.cars[: number - 1])
    braked = np.flatnonzero(one["brake_demand_Pa"] > 0.0)
    before_m = train.first_wheelset_m
    places_m = axle_positions_m(car.plan["vehicle"])
    return {
        "vehicle": car.plan["vehicle_set"],
        "front_m": car.front_m,
        "length_m": car.length_m,
        "wheelsets_m": [before_m + car.place_m + behind_m for behind_m in places_m],
        "mass_kg": float(train.mass_kg[number - 1]),
        "load_kg": car.given["load_kg"],
        "isolated": car.given["isolated"],
        "unit": of_car["wsp"]["unit"],
        "axles": [first, first + len(axles) - 1],
        "demand_begins_s": float(one["time_s"][braked[0]]) if braked.size else None,
        "sliding_mean_m_s": _mean(axles, "sliding_mean_m_s"),
        "sliding_max_m_s": max(axle["sliding_max_m_s"] for axle in axles),
        "longest_lock_s": max(axle["longest_lock_s"] for axle in axles),
        "dissipated_energy_J": sum(axle["dissipated_energy_J"] for axle in axles),
        "adhesion_mean": _mean(axles, "adhesion_mean"),
        "vents": of_car["wsp"]["vents"],
        "air_consumption_NL": of_car["air_consumption_NL"],
    }


def _mean(axles: list[dict[str, Any]], key: str) -> float:
    return float(np.mean([axle[key] for axle in axles]))


def _couplers(stop: Stop) -> list[dict[str, float]]:
    """Return the extremes of each coupler; in compression force and displacement are negative."""
    return [
        {
            "tension_max_N": float(forces_N[0]),
            "compression_max_N": float(forces_N[1]),
            "stretched_max_m": float(lengths_m[0]),
            "compressed_max_m": float(lengths_m[1]),
            "work_J": float(work_J),
        }
        for forces_N, lengths_m, work_J in zip(
            stop.link.extremes_N, stop.link.extremes_m, stop.link.motion.work_J, strict=True
        )
    ]
