"""A stop of a train in memory: its cars on their places, run to the end or some ticks at a time."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from rollerrig.configs.vehicle import MOST_AXLES
from rollerrig.firmware_sim import pole_wheel
from rollerrig.firmware_sim.wsp import logic
from rollerrig.realtime.bench import free, tick_data
from rollerrig.realtime.bench.options import Progress
from rollerrig.realtime.bench.scenario import Scenario
from rollerrig.realtime.campaign.stops import ticks_in_lanes
from rollerrig.realtime.loop import tick
from rollerrig.realtime.loop.ring import WRITTEN, Memory
from rollerrig.realtime.loop.tick import DONE, STOP, TICK, TickData, Units
from rollerrig.realtime.train import ticks
from rollerrig.realtime.train.plan import Train
from rollerrig.rig import plant
from rollerrig.rig.compiled import record_type
from rollerrig.rig.state import size_of
from rollerrig.rig.train import coupler, motion, pipe, rail

_MOST_TICKS = 1 << 20
# with no fault to come, ticks are run for at most this time
_LONGEST_S = 3600.0
_HEADER = 16
# the form of a pipe that a train without one has: it demands nothing
_NO_PIPE = pipe.Form(250.0, 1.0, 0.0, 1.0, 5e5, 1.5e5, 0.0)


class Samples(NamedTuple):
    """What a train has recorded.

    cars: for each car its channels (n,) by the names of the table of signals. The other arrays have
    the shapes (n, couplers) and (n, cars); that of the train (n,).
    """

    cars: list[dict[str, np.ndarray]]
    force_N: np.ndarray
    displacement_m: np.ndarray
    pipe_Pa: np.ndarray
    deceleration_m_s2: np.ndarray


class Stop:
    """One stop of a train.

    `unit`: "reference" (each car that has a unit gets a reference unit) or "none". `on_bus` has the
    data that a bench has built for a unit on the bus of a car, by the number of the car from 1.
    """

    def __init__(
        self,
        train: Train,
        unit: str = "reference",
        seed: int = 0,
        on_bus: Mapping[int, TickData] = MappingProxyType({}),
    ) -> None:
        self.train = train
        self._seed = seed
        axles = [car.plan.params.axles for car in train.cars]
        self.groups = motion.groups(axles, {number - 1 for number in on_bus})
        self.data: list[TickData] = []
        self._memories: list[Memory] = []
        for first, count in self.groups.tolist():
            buffer = np.zeros(size_of(count))
            for seat in range(count):
                number = first + seat
                car = train.cars[number]
                memory = Memory(free.most_samples(car.plan), car.plan.table)
                self._memories.append(memory)
                if number + 1 in on_bus:
                    made = on_bus[number + 1]
                else:
                    made = tick_data.build(
                        car.plan, memory, seed=seed + number, seat=(buffer, seat)
                    )
                    made = made._replace(command=made.commands.values)
                _place(made, car.place_m)
                self.data.append(made)
        self.bodies = [motion.Car(one.state, one.params) for one in self.data]
        self.couplers = coupler.build(train.couplers)
        self.link = self._link()
        self.cars = [
            _stop_of(made, car.plan, unit if car.has_unit else "none", number in on_bus)
            for number, (made, car) in enumerate(zip(self.data, train.cars, strict=True), start=1)
        ]
        self._cars = record_type.table(
            [
                _as_ticks_need(made, car.plan, one)
                for made, car, one in zip(self.data, train.cars, self.cars, strict=True)
            ]
        )
        self._bodies = record_type.table(self.bodies)
        self._trains = record_type.table([self.link])

    def _speed_m_s(self) -> float:
        speeds = [float(body.state.vehicle_speed[0]) for body in self.bodies]
        return float(np.average(speeds, weights=self.train.mass_kg))

    def _link(self) -> ticks.Train:
        """Return what belongs to the train."""
        cars = self.train.cars
        count = len(cars)
        brake = self.train.brake
        tick_s = cars[0].plan.params.tick_s
        plans = [car.plan for car in cars]
        acts = any(plan["mechanisms"]["rail_cleaning_gain"] != 0.0 for plan in plans)
        width = 2 * (count - 1) + count + 1
        return ticks.Train(
            groups=self.groups,
            couplers=self.couplers,
            motion=motion.begin(count),
            rail=rail.build(self.bodies, acts, self.train["train"]["film_recovery_s"]),
            has_pipe=brake is not None,
            pipe=pipe.build(
                brake.form if brake else _NO_PIPE,
                [car.front_m + 0.5 * car.length_m for car in cars],
                brake.valves if brake else (),
                [bool(car.given["isolated"]) for car in cars],
                tick_s,
            ),
            extremes_N=np.zeros((count - 1, 2)),
            extremes_m=np.zeros((count - 1, 2)),
            header=np.zeros(_HEADER, dtype=np.int64),
            rows=np.empty((free.most_samples(plans[0]), width)),
            row=np.zeros(width),
            deceleration_m_s2=np.zeros(1),
            before_m_s=np.array([self._speed_m_s()]),
        )

    @property
    def is_done(self) -> bool:
        """Whether the train has stood long enough, or its time is up."""
        return any(data.control[DONE] or data.control[STOP] for data in self.data)

    @property
    def ticks(self) -> int:
        """The ticks so far."""
        return int(self.data[0].control[TICK])

    def run(self, most: int = _MOST_TICKS) -> int:
        """Run some ticks, fewer if the train is done; return how many were run."""
        ran = 0
        while ran < most and not self.is_done:
            count = min(most - ran, self._poll_faults())
            now = int(ticks.run(self._cars, self._bodies, self._trains, count))
            if now == 0:
                break
            ran += now
        return ran

    def wall(self, _data: TickData, *given: Any) -> None:
        """Run all ticks on their deadlines; arguments as for `loop.wall`."""
        ticks.wall(self._cars, self._bodies, self._trains, *given)

    def _poll_faults(self) -> int:
        """Let the faults of this tick begin and end; return the ticks until the next change."""
        tick_hz = self.train["loop"]["tick_hz"]
        now_s = self.ticks / tick_hz
        until_s = _LONGEST_S
        for one in self.cars:
            if one is not None and one.plan.faults:
                one.faults.poll(now_s)
                until_s = min(until_s, one.faults.next_change_s() - now_s)
        return max(1, round(until_s * tick_hz))

    def end(self) -> None:
        """Record the faults that have not begun, when the train is done."""
        for one in self.cars:
            if one is not None:
                one.faults.report_waiting()

    def run_to_end(self) -> None:
        """Run until the train is done."""
        while not self.is_done:
            self.run()
        self.end()

    @property
    def is_random(self) -> bool:
        """Whether a sensor of a car has drawn a random number, so that the seed matters."""
        return any(
            not np.array_equal(
                one.pulses[pole_wheel.RANDOM],
                pole_wheel.memory(self._seed + number, one.params.axles)[pole_wheel.RANDOM],
            )
            for number, one in enumerate(self.data)
        )

    def progress(self) -> Progress:
        """Return what the progress line shows."""
        states = [body.state for body in self.bodies]
        return Progress(
            time_s=float(states[0].time[0]),
            speed_m_s=float(states[0].vehicle_speed[0]),
            sliding_m_s=max(float(np.max(state.sliding)) for state in states),
            missed=0,
        )

    def samples(self) -> Samples:
        """Return what was recorded so far."""
        couplers = len(self.train.cars) - 1
        rows = self.link.rows[: int(self.link.header[WRITTEN])]
        cars = []
        for car, memory in zip(self.train.cars, self._memories, strict=True):
            columns = car.plan.table.columns
            cars.append(dict(zip(columns, memory.recorded.T, strict=True)))
        return Samples(
            cars=cars,
            force_N=rows[:, :couplers],
            displacement_m=rows[:, couplers : 2 * couplers],
            pipe_Pa=rows[:, 2 * couplers : -1],
            deceleration_m_s2=rows[:, -1],
        )


def simulate(train: Train, unit: str = "reference", seed: int = 0) -> Stop:
    """Run a train to its end in memory, and return the stop."""
    stop = Stop(train, unit, seed)
    stop.run_to_end()
    return stop


def _place(data: TickData, behind_m: float) -> None:
    """Put a car that has not begun so far behind the front of its train."""
    state = data.state
    state.position[0] = -behind_m
    plant.start(state, data.params, float(state.vehicle_speed[0]))
    tick.publish(data)


def _stop_of(data: TickData, plan: Scenario, unit: str, is_on_bus: bool) -> free.Stop | None:
    """Return the stop of a car, with its units and faults; None where a bench has them."""
    return None if is_on_bus else free.Stop(plan, data, unit)


def _as_ticks_need(data: TickData, plan: Scenario, stop: free.Stop | None) -> ticks.Car:
    """Return a car as the ticks need it; `stop` None: it is on the bus."""
    units = stop.reference_units if stop is not None else None
    no_units = Units(np.zeros((0, logic.SIZE)), logic.load())
    return ticks.Car(
        m=data,
        units=units or no_units,
        inputs=np.zeros(2 * MOST_AXLES, dtype=np.int64),
        sync_ticks=plan.sync_ticks if units else 0,
        is_observed=bool(plan.faults) or ticks_in_lanes.is_observed(data),
        is_on_bus=stop is None,
    )


def moving(channels: Mapping[str, np.ndarray], slowest_m_s: float = 0.0) -> slice:
    """Return the samples of a car up to standstill, or up to a speed in m/s."""
    still = np.flatnonzero(channels["vehicle_speed_m_s"] <= slowest_m_s)
    return slice(0, int(still[0]) + 1) if still.size else slice(None)


def momentum_kg_m_s(train: Train, cars: Sequence[Mapping[str, np.ndarray]]) -> np.ndarray:
    """Return the momentum of all cars together, shape (n,)."""
    speeds = np.array([channels["vehicle_speed_m_s"] for channels in cars])
    return np.asarray(train.mass_kg @ speeds)
