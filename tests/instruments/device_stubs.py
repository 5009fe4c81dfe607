"""Minimal stand-ins for each device, independent of the codecs and the emulators."""

import re
import struct
from binascii import crc_hqx
from collections.abc import MutableSequence
from typing import Any

import numpy as np
from device_benches import Clock

from dbthermal.instruments.transport import Closing, TransportError

Numbers = MutableSequence[Any]

SERIAL, FFC_MODE, RUN_FFC, FRAME_COUNT, LAST_FFC = 0x50002, 0x50013, 0x50007, 0x20002, 0x5005D
NUMBERS = {SERIAL: 0x8E9EAE, 0x50006: 7, LAST_FFC: 0, FFC_MODE: 1, 0x50054: 3, 0x50015: 0}
HELLO, HELLO_BACK, MOVE, MOVE_HOME, HOMED = 0x005, 0x006, 0x453, 0x443, 0x444
STATUS, ENABLED, SETTERS = 0x480, 0x211, (0x413, 0x440)
HANDLE, JUNCTION, TIP = 7, 293.15, 298.15  # the last two in kelvin


class _Stub(Closing):
    """A line to a stub, whose answers are available at once."""

    is_simulated = True

    def __init__(self, clock: Clock) -> None:
        self.clock, self._said, self._closed = clock, b"", False

    def read(self, size: int, timeout: float) -> bytes:  # noqa: ARG002 - no time goes by
        """Give the pending answer."""
        self._must_be_open()
        piece, self._said = self._said[:size], self._said[size:]
        return piece

    def close(self) -> None:
        """End."""
        self._closed = True

    def _must_be_open(self) -> None:
        if self._closed:
            raise TransportError("Lost the stub. It must stay open.")


class StubCamera(_Stub):
    """Answers a Boson's commands from a table."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._values = {
            **{code: struct.pack(">i", value) for code, value in NUMBERS.items()},
            0x50004: b"EMULATED-STUB".ljust(20, b"\0"),
            0x50022: struct.pack(">III", 1, 2, 3),
            0x50030: struct.pack(">h", -123),
            0x50031: struct.pack(">H", 2609),
            0x5000C: struct.pack(">h", 0),
        }

    def write(self, data: bytes) -> None:
        """Take one request, and answer."""
        self._must_be_open()
        body = re.sub(rb"(?s)\x9e(.)", lambda pair: bytes([pair[1][0] + 13]), data[1:-1])
        _, sequence, command, _ = struct.unpack_from(">BIII", body)
        self._values[FRAME_COUNT] = struct.pack(">I", int(60 * self.clock()))
        if command == RUN_FFC:
            self._values[LAST_FFC] = self._values[FRAME_COUNT]
        elif command == FFC_MODE - 1:
            self._values[FFC_MODE] = body[13:-2]
        reply = struct.pack(">BIII", 0, sequence, command, 0) + self._values.get(command, b"")
        reply += crc_hqx(reply, 0x1D0F).to_bytes(2)
        escaped = re.sub(rb"[\x8e\x9e\xae]", lambda byte: bytes([0x9E, byte[0][0] - 13]), reply)
        self._said += b"\x8e" + escaped + b"\xae"


class StubController(_Stub):
    """Answers as an APT controller whose wheel takes no time."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self._position, self._homed = 123, 0
        self._kept = {0x415: bytes(14), 0x442: struct.pack("<HHHii", 1, 2, 1, 0, 0)}

    def write(self, data: bytes) -> None:
        """Take whole messages, and answer those that ask for it."""
        self._must_be_open()
        while data:
            message, param1, param2, destination, _ = struct.unpack_from("<HBBBB", data)
            size = 6 + (param1 + 256 * param2 if destination & 0x80 else 0)
            payload, data = data[6:size], data[size:]
            if destination & 0x7F == 0x50:
                self._obey(message, payload)

    def _obey(self, message: int, payload: bytes) -> None:
        if message in SETTERS:
            self._kept[message + 2] = payload
        elif message - 1 in SETTERS:
            self._say(message + 1, self._kept[message + 1])
        elif message == HELLO:
            self._say(
                HELLO_BACK, struct.pack("<I8sH4B60s3H", 7, b"BSC101", 45, *4 * [1], b"", 0, 0, 1)
            )
        elif message == ENABLED:
            self._said += struct.pack("<HBBBB", ENABLED + 1, 1, 1, 0x01, 0x50)
        elif message == STATUS:
            bits = 0x80000100 | self._homed
            self._say(STATUS + 1, struct.pack("<HiiI", 1, self._position, 0, bits))
        elif message == MOVE:
            self._position = struct.unpack("<Hi", payload)[1]
        elif message == MOVE_HOME:
            self._position, self._homed = 0, 0x400
            self._said += struct.pack("<HBBBB", HOMED, 1, 0, 0x01, 0x50)

    def _say(self, message: int, payload: bytes) -> None:
        self._said += struct.pack("<HHBB", message, len(payload), 0x81, 0x50) + payload


class StubLibrary:
    """Has the functions of the TC-08's library, and one unit with one thermocouple in socket 1."""

    is_simulated = True

    def __init__(self) -> None:
        self._is_open, self._kinds = False, {}  # type: bool, dict[int, str]

    def usb_tc08_open_unit_async(self) -> int:
        """Begin."""
        return 1

    def usb_tc08_open_unit_progress(self, handle: Numbers, percent: Numbers) -> int:
        """Give the handle of the unit, or 0 if it is open already."""
        handle[0], percent[0] = 0 if self._is_open else HANDLE, 100
        self._is_open = True
        return 1

    def usb_tc08_close_unit(self, handle: int) -> int:
        """End."""
        self._is_open = False
        return int(handle == HANDLE)

    def usb_tc08_get_last_error(self, handle: int) -> int:
        """Nothing failed."""
        return 0 * handle

    def usb_tc08_get_unit_info(self, handle: int, info: Numbers) -> int:
        """Say that it is a stub."""
        info[0].serial, info[0].driver, info[0].calibration_date = b"STUB", b"stub", b"01Jan00"
        return int(handle == HANDLE)

    def usb_tc08_set_channel(self, handle: int, channel: int, kind: int) -> int:
        """Keep the letter."""
        self._kinds[channel] = chr(kind)
        return int(handle == HANDLE)

    def usb_tc08_get_single(self, handle: int, values: Numbers, overflow: Numbers, _: int) -> int:
        """Give 25 degrees Celsius beside terminals of 20."""
        known = {"T": TIP, "C": JUNCTION}
        values[:] = [known.get(self._kinds.get(channel, " "), np.nan) for channel in range(9)]
        overflow[0] = 0
        return int(handle == HANDLE)
