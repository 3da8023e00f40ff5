"""Modbus requests, decoded and executed by pymodbus, and strict where pymodbus is not.

pymodbus 3.16 reads over bytes that are too many, takes any coil value but 0 for ON, writes 2000 coils at once, answers
a single write with what is read back and not with its echo, and writes before it knows whether an exchange (23) can be
read. A refused request changes nothing. Source: MODBUS Application Protocol Specification V1.1b3, section 6.
"""

from collections.abc import Mapping
from importlib import metadata
from typing import Any

from pymodbus.constants import DeviceInformation, ExcCodes, ModbusStatus
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu import bit_message as bits
from pymodbus.pdu import register_message as words
from pymodbus.pdu.device import ModbusControlBlock
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest

# what function 43/14 tells; pymodbus knows one identity a process
ModbusControlBlock().Identity.update(
    {
        0: "rollerrig",
        1: "roller rig",
        2: metadata.version("rollerrig"),
        4: "rollerrig",
        5: "roller-rig emulator for wheel slide protection",
    }
)
_REGULAR_CONFORMITY = 0x82  # basic and regular objects, as a stream and one by one
EXCEPTION = 0x80


class RefusedError(Exception):
    """A request that cannot be served; `code` is what the client is told."""

    def __init__(self, code: ExcCodes) -> None:
        super().__init__(code.name)
        self.code = code


class _Echoed(ModbusPDU):
    """A write that is its own answer."""

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        await context.async_setValues(
            device_id, self.function_code, self.address, self.bits or self.registers
        )
        return self


class WriteCoil(_Echoed, bits.WriteSingleCoilRequest):
    """Function 5, with two values only."""

    def decode(self, data: bytes) -> None:
        super().decode(data)
        if int.from_bytes(data[2:], "big") not in (ModbusStatus.ON, ModbusStatus.OFF):
            raise ValueError(data)


class WriteRegister(_Echoed, words.WriteSingleRegisterRequest):
    """Function 6."""


class WriteCoils(bits.WriteMultipleCoilsRequest):
    """Function 15, with the standard's limit."""

    MAX_COUNT = 1968


class Exchange(words.ReadWriteMultipleRegistersRequest):
    """Function 23: where nothing can be read, nothing is written."""

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        await context.async_getValues(
            device_id, self.function_code, self.read_address, self.read_count
        )
        return await super().datastore_update(context, device_id)


class Identify(ReadDeviceInformationRequest):
    """Function 43/14: an unknown first object means the beginning."""

    def decode(self, data: bytes) -> None:
        super().decode(data)
        if DeviceInformation(self.read_code) is DeviceInformation.BASIC and self.object_id > 2:
            self.object_id = 0

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        reply: Any = await super().datastore_update(context, device_id)
        reply.conformity = _REGULAR_CONFORMITY
        return reply


FUNCTIONS: dict[int, type[ModbusPDU]] = {
    kind.function_code: kind
    for kind in (
        bits.ReadCoilsRequest,
        bits.ReadDiscreteInputsRequest,
        words.ReadHoldingRegistersRequest,
        words.ReadInputRegistersRequest,
        WriteCoil,
        WriteRegister,
        WriteCoils,
        words.WriteMultipleRegistersRequest,
        words.MaskWriteRegisterRequest,
        Exchange,
        Identify,
    )
}
BITS, WRITES = (1, 2, 5, 15), (5, 6, 15, 16, 22, 23)


class Decoder(DecodePDU):
    """Tells pymodbus' framers, and `answer`, of which class a request is."""

    def lookupPduClass(self, data: bytes) -> type[ModbusPDU] | None:
        """The class of the request behind a unit; None: it is not served."""
        kind = FUNCTIONS.get(data[1])
        return (
            None if kind is Identify and data[2:3] != bytes((Identify.sub_function_code,)) else kind
        )


DECODER = Decoder(True)


def answer(units: Mapping[int, Any], unit: int, request: bytes) -> bytes:
    """The answer of a unit to a request (function code and data, at least one byte).

    A unit has pymodbus' `async_getValues` and `async_setValues`, which never wait and raise
    RefusedError. Never raises: what fails inside is exception 04.
    """
    try:
        reply = _execute(units, unit, bytes((unit,)) + request)
        return bytes((reply.function_code,)) + reply.encode()
    except RefusedError as refused:
        code = refused.code
    except Exception:
        # a fault in a reader or a writer must not end the connection, let alone the bench
        code = ExcCodes.DEVICE_FAILURE
    return bytes((request[0] | EXCEPTION,)) + ExceptionResponse(request[0], code).encode()


def _execute(units: Mapping[int, Any], unit: int, frame: bytes) -> ModbusPDU:
    if unit not in units:
        raise RefusedError(ExcCodes.GATEWAY_NO_RESPONSE)
    kind = DECODER.lookupPduClass(frame)
    if kind is None:
        raise RefusedError(ExcCodes.ILLEGAL_FUNCTION)
    request = kind()
    try:
        # a frame of RTU has two bytes more
        if kind.calculateRtuFrameSize(frame) != len(frame) + 2:
            raise ValueError(frame)
        request.decode(frame[2:])
    except ValueError:
        raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None
    try:
        # the first step of a coroutine that never waits is its last
        request.datastore_update(units[unit], unit).send(None)
    except StopIteration as done:
        return done.value
    raise RuntimeError("a unit has waited")
