"""Modbus requests: pymodbus decodes and executes them, and this module is strict where it is not.

pymodbus 3.16 differs from the standard in five places:

- It ignores surplus bytes of a request.
- It takes every coil value except 0 for ON.
- It writes up to 2000 coils in one request.
- It answers a single write with the value that it reads back, not with the echo of the request.
- It executes the write of an exchange (23) before it knows whether the read is possible.

Here a refused request changes nothing.
Source: MODBUS Application Protocol Specification V1.1b3, section 6.
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

# the objects that function 43/14 reports; pymodbus has one identity in a process
ModbusControlBlock().Identity.update(
    {
        0: "rollerrig",  # vendor name
        1: "roller rig",  # product code
        2: metadata.version("rollerrig"),  # revision
        4: "rollerrig",  # product name
        5: "roller-rig emulator for wheel slide protection",  # model name
    }
)
_REGULAR_CONFORMITY = 0x82  # basic and regular objects, as a stream and one by one
_LAST_BASIC_OBJECT = 2

# this bit in the function code of an answer marks an exception
EXCEPTION_BIT = 0x80


class RefusedError(Exception):
    """A request that cannot be served; `code` is the exception code that the client receives."""

    def __init__(self, code: ExcCodes) -> None:
        super().__init__(code.name)
        self.code = code


class _Echoed(ModbusPDU):
    """A write whose answer is the request."""

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        values = self.bits or self.registers
        await context.async_setValues(device_id, self.function_code, self.address, values)
        return self


class WriteCoil(_Echoed, bits.WriteSingleCoilRequest):
    """Function 5, which allows two values only."""

    def decode(self, data: bytes) -> None:
        super().decode(data)
        value = int.from_bytes(data[2:], "big")
        if value not in (ModbusStatus.ON, ModbusStatus.OFF):
            raise ValueError(data)


class WriteRegister(_Echoed, words.WriteSingleRegisterRequest):
    """Function 6."""


class WriteCoils(bits.WriteMultipleCoilsRequest):
    """Function 15, with the limit of the standard."""

    MAX_COUNT = 1968


class Exchange(words.ReadWriteMultipleRegistersRequest):
    """Function 23, which writes nothing if the read is not possible."""

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        # a trial read, which raises RefusedError before anything is written
        await context.async_getValues(
            device_id, self.function_code, self.read_address, self.read_count
        )
        return await super().datastore_update(context, device_id)


class Identify(ReadDeviceInformationRequest):
    """Function 43/14, which starts from the first object if the requested one is unknown."""

    def decode(self, data: bytes) -> None:
        super().decode(data)
        basic = DeviceInformation(self.read_code) is DeviceInformation.BASIC
        if basic and self.object_id > _LAST_BASIC_OBJECT:
            self.object_id = 0

    async def datastore_update(self, context: Any, device_id: int) -> ModbusPDU:
        reply: Any = await super().datastore_update(context, device_id)
        reply.conformity = _REGULAR_CONFORMITY
        return reply


_REQUESTS: tuple[type[ModbusPDU], ...] = (
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
FUNCTIONS: dict[int, type[ModbusPDU]] = {request.function_code: request for request in _REQUESTS}
# function codes that read or write bits; all others are for registers
BIT_FUNCTIONS = (1, 2, 5, 15)
WRITE_FUNCTIONS = (5, 6, 15, 16, 22, 23)


class Decoder(DecodePDU):
    """Finds the class of a request, for the framers of pymodbus and for `answer`."""

    def lookupPduClass(self, data: bytes) -> type[ModbusPDU] | None:
        """Return the class of a request, or None if it is not served.

        `data`: unit, function code and the data of the function.
        """
        request = FUNCTIONS.get(data[1])
        if request is Identify and data[2:3] != bytes((Identify.sub_function_code,)):
            # another encapsulated interface
            return None
        return request


DECODER = Decoder(True)


def answer(units: Mapping[int, Any], unit: int, request: bytes) -> bytes:
    """Return the answer of a unit to a request (function code and data, at least one byte).

    A unit has the methods `async_getValues` and `async_setValues` of pymodbus. They never wait, and
    they raise RefusedError. This function never raises: an internal failure becomes exception 04.
    """
    try:
        reply = _execute(units, unit, bytes((unit,)) + request)
        return bytes((reply.function_code,)) + reply.encode()
    except RefusedError as refused:
        code = refused.code
    except Exception:
        # a fault in a reader or a writer must not end the connection, let alone the bench
        code = ExcCodes.DEVICE_FAILURE
    function = request[0]
    return bytes((function | EXCEPTION_BIT,)) + ExceptionResponse(function, code).encode()


def _execute(units: Mapping[int, Any], unit: int, frame: bytes) -> ModbusPDU:
    """Execute a request and return its answer. `frame`: unit, function code and data."""
    if unit not in units:
        raise RefusedError(ExcCodes.GATEWAY_NO_RESPONSE)
    kind = DECODER.lookupPduClass(frame)
    if kind is None:
        raise RefusedError(ExcCodes.ILLEGAL_FUNCTION)

    request = kind()
    try:
        # a frame of RTU is two bytes longer, because of its checksum
        if kind.calculateRtuFrameSize(frame) != len(frame) + 2:
            raise ValueError(frame)
        request.decode(frame[2:])
    except ValueError:
        raise RefusedError(ExcCodes.ILLEGAL_VALUE) from None

    try:
        # a coroutine that never waits returns in its first step
        request.datastore_update(units[unit], unit).send(None)
    except StopIteration as done:
        return done.value
    raise RuntimeError("a unit has waited; its methods must return without waiting")
