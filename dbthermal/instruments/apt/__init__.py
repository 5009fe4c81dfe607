"""Thorlabs APT, the binary protocol of stepper controllers: bytes to messages, and back.

Pure functions and one `Decoder`, without input or output; `dbthermal.instruments.filterwheel`
speaks it. A message is a header of six bytes, ``id, id, param1, param2, destination, source``, or
``id, id, length, length, destination | 0x80, source`` followed by data; all little-endian, without
checksum or start byte. A receiver therefore drops bytes until identifier, length and both addresses
are possible.

Of the protocol this holds what a filter wheel needs, and the messages that a controller may send
by itself. Tested against public byte vectors, against the release 29.0.0 of thorlabs-apt-protocol
and against an emulator, not against hardware.

References
----------
Facts alone were taken, no code: yaq-project/thorlabs-apt-protocol 29.0.0, moonshot-nagayama-pj/PnPQ
(messages), Thorlabs/Motion_Control_Examples (commit bbdeca5, start of the line), pylablib 1.4.5
(scale of the FW103 wheel), thorlabs_apt_device 0.3.8 (addresses of racks).
"""

from dbthermal.instruments.apt._framing import (
    ADDRESSES,
    BAY_1,
    CONTROLLERS,
    HOST,
    NO,
    RACK,
    UNIT,
    YES,
    Decoder,
    Id,
    Message,
    command,
    encode,
)
from dbthermal.instruments.apt._records import (
    HomeParameters,
    Info,
    Notice,
    Position,
    Status,
    StatusBits,
    VelocityParameters,
    is_enabled,
)

__all__ = [
    "ADDRESSES",
    "BAY_1",
    "CONTROLLERS",
    "HOST",
    "NO",
    "RACK",
    "UNIT",
    "YES",
    "Decoder",
    "HomeParameters",
    "Id",
    "Info",
    "Message",
    "Notice",
    "Position",
    "Status",
    "StatusBits",
    "VelocityParameters",
    "command",
    "encode",
    "is_enabled",
]
__dir__ = __all__.copy
