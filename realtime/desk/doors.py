"""Sends commands of the desk to a running bench, by two ways ("doors"): Modbus and the CAN bus.

Over Modbus the desk acts as a control room: run, stop, emergency stop, speed, demand, scenario. It
also reads the state of the bench there. On the CAN bus it acts as a test harness (node 127):
faults, friction, notes. It connects to the bus for each command and disconnects afterwards. Any
other program can send the same commands; the desk has no special authority. If the bench refuses a
command, the error contains the reason that the bench gives.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Iterable
from typing import Any

from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException

from rollerrig.configs.errors import BusError
from rollerrig.firmware_sim.modbus.map import BIT, BITS, NO_DEMAND, PLC_UNIT, Register, State, words
from rollerrig.realtime.desk.reader import Bench
from rollerrig.wsp_interface import harness_client, signals
from rollerrig.wsp_interface.events import Code

_FIRST_UNREAD_WORD = 404  # from here on the page shows only the states of further nodes
_REFUSAL_EVENT_S = 1.0  # how long to wait for the event with the reason of a refusal
_POLL_S = 0.1
# Modbus exception code -> what it means on this bench
_EXCEPTION_MEANING = {
    1: "it cannot be done",
    2: "there is no such register, or it cannot be written",
    3: "the value is not allowed",
    6: "the state of the rig does not allow it (speed and scenario: only while it is held; start: "
    "not while the emergency stop is set)",
}


def _blocks(rows: Iterable[Register]) -> list[list[Register]]:
    """Group registers into blocks of adjacent addresses: one request can read one block."""
    blocks: list[list[Register]] = []
    next_address = -1
    for row in rows:
        if row.address == next_address:
            blocks[-1].append(row)
        else:
            blocks.append([row])
        next_address = row.address + row.width
    return blocks


def _is_read(row: Register) -> bool:
    """Whether the page shows a register."""
    return row.address < _FIRST_UNREAD_WORD or row.name.startswith("node_")


class Doors:
    """The Modbus and the CAN connection of the desk to one bench.

    `values` are the Modbus registers by name, as `poll` last read them. They are empty if Modbus
    cannot be used. Then `no_modbus_because` is the reason, else an empty string. `unanswered` is
    true if the reason is a fault: the bench has Modbus, but it does not answer.
    """

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        all_words = words(bench.table)
        self._registers = {row.name: row for row in (*BITS, *all_words)}
        self._blocks = _blocks(BITS) + _blocks(filter(_is_read, all_words))
        self.values: dict[str, float] = {}
        self.no_modbus_because = "the bench has not opened it yet"
        self.unanswered = False
        self._client: AsyncModbusTcpClient | None = None

    @property
    def state(self) -> State | None:
        """The state of the rig; None if Modbus does not report it."""
        if "state" not in self.values:
            return None
        return State(int(self.values["state"]))

    # -- Modbus

    async def poll(self) -> None:
        """Read all registers, and set `values`, `no_modbus_because` and `unanswered`."""
        values: dict[str, float] = {}
        unanswered = False
        reason = self._closed_because()
        if not reason:
            host, port = self.bench.modbus
            try:
                client = await self._connected(host, port)
                for block in self._blocks:
                    values |= await _read(client, block)
            except (ModbusException, OSError) as error:
                values = {}
                unanswered = True
                reason = f"{host}:{port} does not answer: {error}"
        # Set together after the last await: while this function waits, a page may draw the lights,
        # and it must not see some of them new and some old.
        self.values = values
        self.no_modbus_because = reason
        self.unanswered = unanswered

    def _closed_because(self) -> str:
        """The reason why the desk does not connect to Modbus; empty if it can try."""
        if self.bench.ended:
            return "the bench has ended"
        if self.bench.over_tls:
            return "it uses TLS, and the desk has no certificate"
        _, port = self.bench.modbus
        if port:
            return ""
        # the bench opens its server before the first sample
        if not self.bench.points:
            return "the bench has not opened it yet"
        return "this run has no server (only wall pacing has one)"

    async def write(self, name: str, value: float) -> None:
        """Write a register or coil by its name, in its unit. NaN withdraws a demand.

        Raises BusError if there is no Modbus or if the bench refuses.
        """
        row = self._registers[name]
        if self.no_modbus_because:
            raise BusError(f"{name} cannot be written over Modbus: {self.no_modbus_because}")
        raw = NO_DEMAND if math.isnan(value) else round(value / row.scale)

        events_before = len(self.bench.events)
        answer: Any
        try:
            client = await self._connected(*self.bench.modbus)
            if row.kind == BIT:
                answer = await client.write_coil(row.address, bool(raw), device_id=PLC_UNIT)
            else:
                word = raw & 0xFFFF  # two's complement of a negative number
                answer = await client.write_register(row.address, word, device_id=PLC_UNIT)
        except (ModbusException, OSError) as error:
            raise BusError(
                f"{name} = {value:g}: the bench does not answer over Modbus: {error}"
            ) from None

        if answer.isError():
            # an exception code has no details; an event of the bench may have them
            code = answer.exception_code
            refusals = (Code.FAULT_REFUSED, Code.SCENARIO_REFUSED)
            reason = await self._reason(refusals, events_before)
            if not reason:
                reason = _EXCEPTION_MEANING.get(code, "it gives no reason")
            raise BusError(f"the bench refuses {name} = {value:g} (exception {code:02X}): {reason}")

    async def _connected(self, host: str, port: int) -> AsyncModbusTcpClient:
        """Connect if necessary, and return the client. Raises OSError."""
        if self._client is None:
            self._client = AsyncModbusTcpClient(
                host, port=port, timeout=3.0, retries=0, reconnect_delay=0.0
            )
        if not self._client.connected:
            connects = await self._client.connect()
            if not connects:
                raise OSError("no connection")
        return self._client

    def close(self) -> None:
        """Close the connection to the bench."""
        if self._client:
            self._client.close()

    # -- node 127

    async def send_as_harness(self, command: Callable[[harness_client.Harness], None]) -> None:
        """Connect to the bus, call `command` with a harness, and disconnect.

        The harness does not join the run. `command` may call its methods inject, lift, friction,
        brake and note. Raises BusError if there is no bus or if the bench refuses.
        """
        if self.bench.ended:
            raise BusError("there is no bus: the bench has ended")
        if not self.bench.bus:
            raise BusError(
                "there is no bus: free pacing has none, and other pacings have not opened it yet"
            )
        events_before = len(self.bench.events)
        try:
            await asyncio.to_thread(self._send_once, command)
        except BusError as error:
            reason = await self._reason((Code.HARNESS_REFUSED,), events_before)
            raise BusError(f"the bench: {reason or error}") from None

    def _send_once(self, command: Callable[[harness_client.Harness], None]) -> None:
        with contextlib.closing(harness_client.connect(self.bench.bus)) as harness:
            command(harness)

    async def brake(self, pressure_Pa: float) -> None:
        """Command a cylinder pressure. NaN withdraws it: node 17 and the scenario then decide.

        Modbus is used if the bench has it, else the bus, where nothing can be withdrawn. Raises
        BusError.
        """
        if not self.no_modbus_because:
            await self.write("brake_demand_set_point", pressure_Pa)
        elif math.isnan(pressure_Pa):
            raise BusError(f"only Modbus can withdraw a demand, and {self.no_modbus_because}")
        else:
            await self.send_as_harness(lambda harness: harness.brake(pressure_Pa))

    async def _reason(self, refusals: tuple[Code, ...], events_before: int) -> str:
        """The text of the first new event of these codes; empty if none comes in time."""
        for _ in range(round(_REFUSAL_EVENT_S / _POLL_S)):
            for event in self.bench.events[events_before:]:
                if event.code in refusals:
                    return event.text
            await asyncio.sleep(_POLL_S)
        return ""


async def _read(client: AsyncModbusTcpClient, block: list[Register]) -> dict[str, float]:
    """The values of a block of registers by their names. Raises ModbusException."""
    first = block[0].address
    count = block[-1].address + block[-1].width - first
    answer: Any
    if block[0].kind == BIT:
        answer = await client.read_coils(first, count=count, device_id=PLC_UNIT)
    else:
        answer = await client.read_holding_registers(first, count=count, device_id=PLC_UNIT)
    if answer.isError():
        raise ModbusException(str(answer))
    raw: list[int] = answer.bits if block[0].kind == BIT else answer.registers
    return {row.name: _value(row, raw, row.address - first) for row in block}


def _value(row: Register, raw: list[int], at: int) -> float:
    """The value of a register in its unit. Its raw words (or bits) begin at the place `at`."""
    number = int(raw[at])
    if row.width == 2:  # the high word comes first
        number = raw[at] << 16 | raw[at + 1]
    if row.kind in signals.KINDS:
        low, high = signals.KINDS[row.kind]
        if number > high:  # a negative number in two's complement
            values_of_type = high - low + 1
            number -= values_of_type
    return number * row.scale
