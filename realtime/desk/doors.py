"""What a running bench may be asked, by the doors that it has for everybody: Modbus, and node 127 on its bus.

A program outside could send each of these commands just as well; the desk has no authority of its own. Modbus carries
what a control room asks (run, stop, emergency stop, speed, demand, scenario) and how the bench is; node 127 what a
harness asks (faults, friction, notes), each on a short connection. What a bench refuses is raised with its own words.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus.map import BIT, BITS, NO_DEMAND, PLC_UNIT, WORDS, Register, State
from rollerrig.realtime.desk.reader import Bench
from rollerrig.wsp_interface import harness_client, signals
from rollerrig.wsp_interface.events import Code

_ROWS = {row.name: row for row in (*BITS, *WORDS)}
_LAST_WORD = 404
_WORDS_S = 1.0  # how long the event with a refusal's reason may be on its way
_WHY = {
    1: "it cannot be done",
    2: "there is no such register, or it cannot be written",
    3: "the value is not allowed",
    6: "not in this state of the rig (speed and scenario: only while it is held; start: not while the emergency "
    "stop is set)",
}


def _blocks(rows: tuple[Register, ...]) -> list[list[Register]]:
    """Rows that follow one another without a gap: a gap cannot be read."""
    found: list[list[Register]] = []
    for row in rows:
        if found and found[-1][-1].at + found[-1][-1].width == row.at:
            found[-1].append(row)
        else:
            found.append([row])
    return found


_READ = _blocks(BITS) + _blocks(tuple(row for row in WORDS if row.at < _LAST_WORD))


class Doors:
    """The ways into one bench. `values` are its registers by name, `why` says why there are none."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.values: dict[str, float] = {}
        self.why = "the bench has not opened it yet"
        self._client: AsyncModbusTcpClient | None = None

    @property
    def state(self) -> State | None:
        """What the rig does; None where no Modbus tells."""
        return State(int(self.values["state"])) if "state" in self.values else None

    # -- Modbus

    async def poll(self) -> None:
        """Read all registers, or learn why that cannot be."""
        host, port = self.bench.modbus
        if self.bench.ended or not port or self.bench.over_tls:
            self.values = {}
            self.why = (
                "the bench has ended"
                if self.bench.ended
                else "it speaks TLS, and the desk has no certificate"
                if self.bench.over_tls
                else "the bench has not opened it yet"
                if not self.bench.points
                else "this run has none (only wall pacing has)"
            )
            return
        try:
            client = await self._connected(host, port)
            found: dict[str, float] = {}
            for rows in _READ:
                found |= await _read(client, rows)
            self.values, self.why = found, ""
        except (ModbusException, OSError) as error:
            self.values, self.why = {}, f"{host}:{port} does not answer: {error}"

    async def write(self, name: str, value: float) -> None:
        """Write a register or coil by its name, in its unit; NaN takes a demand back. Raises BusError."""
        row = _ROWS[name]
        if self.why:
            raise BusError(f"{name} cannot be asked for over Modbus: {self.why}")
        raw = NO_DEMAND if value != value else round(value / row.scale)
        before = len(self.bench.events)
        try:
            client = await self._connected(*self.bench.modbus)
            answer: Any = (
                await client.write_coil(row.at, bool(raw), device_id=PLC_UNIT)
                if row.kind == BIT
                else await client.write_register(row.at, raw & 0xFFFF, device_id=PLC_UNIT)
            )
        except (ModbusException, OSError) as error:
            raise BusError(
                f"{name} = {value:g}: the bench does not answer over Modbus: {error}"
            ) from None
        if answer.isError():
            code = answer.exception_code
            words = await self._words((Code.FAULT_REFUSED, Code.SCENARIO_REFUSED), before)
            raise BusError(
                f"the bench refuses {name} = {value:g} (exception {code:02X}): "
                f"{words or _WHY.get(code, 'it says no more')}"
            )

    async def _connected(self, host: str, port: int) -> AsyncModbusTcpClient:
        if self._client is None:
            self._client = AsyncModbusTcpClient(
                host, port=port, timeout=3.0, retries=0, reconnect_delay=0.0
            )
        if not self._client.connected and not await self._client.connect():
            raise OSError("no connection")
        return self._client

    def close(self) -> None:
        """Leave the bench."""
        if self._client:
            self._client.close()

    # -- node 127

    async def ask(self, what: Callable[[harness_client.Harness], None]) -> None:
        """Call a harness that has not joined: inject, lift, friction, brake, note. Raises BusError."""
        if self.bench.ended or not self.bench.bus:
            raise BusError(
                "there is no bus to ask on: "
                + (
                    "the bench has ended"
                    if self.bench.ended
                    else "free pacing has none, and another has not opened it yet"
                )
            )
        before = len(self.bench.events)
        try:
            await asyncio.to_thread(self._ask, what)
        except BusError as error:
            words = await self._words((Code.HARNESS_REFUSED,), before)
            raise BusError(f"the bench: {words or error}") from None

    def _ask(self, what: Callable[[harness_client.Harness], None]) -> None:
        with contextlib.closing(harness_client.connect(self.bench.bus)) as harness:
            what(harness)

    async def brake(self, pressure_Pa: float) -> None:
        """Ask for a cylinder pressure; NaN leaves it to node 17 and the scenario. Raises BusError."""
        if not self.why:
            await self.write("brake_demand_set_point", pressure_Pa)
        elif pressure_Pa == pressure_Pa:
            await self.ask(lambda harness: harness.brake(pressure_Pa))
        else:
            raise BusError(f"a demand is taken back over Modbus alone, and {self.why}")

    async def _words(self, refusals: tuple[Code, ...], before: int) -> str:
        """Return the text of the first new event of these codes; empty if none comes in time."""
        for _ in range(round(_WORDS_S / 0.1)):
            for event in self.bench.events[before:]:
                if event.code in refusals:
                    return event.text
            await asyncio.sleep(0.1)
        return ""


async def _read(client: AsyncModbusTcpClient, rows: list[Register]) -> dict[str, float]:
    first, count = rows[0].at, rows[-1].at + rows[-1].width - rows[0].at
    answer: Any = await (
        client.read_coils if rows[0].kind == BIT else client.read_holding_registers
    )(first, count=count, device_id=PLC_UNIT)
    if answer.isError():
        raise ModbusException(str(answer))
    raw: list[int] = answer.bits if rows[0].kind == BIT else answer.registers
    return dict(_values(rows, raw))


def _values(rows: list[Register], raw: list[int]) -> Iterator[tuple[str, float]]:
    for row in rows:
        at = row.at - rows[0].at
        count = int(raw[at]) if row.width == 1 else raw[at] << 16 | raw[at + 1]
        if row.kind in signals.KINDS:
            low, high = signals.KINDS[row.kind]
            count = count - (high - low + 1) if count > high else count
        yield row.name, count * row.scale
