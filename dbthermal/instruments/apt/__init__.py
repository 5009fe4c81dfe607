"""Thorlabs APT, the binary protocol of stepper controllers: bytes to messages, and back.

Pure functions and one `Decoder`: nothing here reads or writes a line; `dbthermal.instruments.apt`
is what `dbthermal.instruments.filterwheel` speaks, and its emulator. `codec` frames messages,
`requests` has a function for each message that a host sends, `replies` a record for each payload
that a controller sends. Tested against public byte vectors, against the release 29.0.0 of
thorlabs-apt-protocol and against an emulator, not against hardware.

References
----------
Facts alone were taken, no code: yaq-project/thorlabs-apt-protocol 29.0.0, moonshot-nagayama-pj/PnPQ
(messages), Thorlabs/Motion_Control_Examples (commit bbdeca5, start of the line), pylablib 1.4.5
(scale of the FW103 wheel), thorlabs_apt_device 0.3.8 (addresses of racks).
"""

from dbthermal.instruments.apt.codec import (
    ADDRESSES,
    BAY_1,
    CONTROLLERS,
    HOST,
    RACK,
    UNIT,
    Decoder,
    Id,
    Message,
    encode,
)
from dbthermal.instruments.apt.replies import (
    HomeParameters,
    Info,
    Notice,
    Position,
    Status,
    StatusBits,
    VelocityParameters,
    is_enabled,
    is_occupied,
    status_bits,
)
from dbthermal.instruments.apt.requests import (
    acknowledge_status,
    disconnect,
    home,
    identify,
    move_absolute,
    move_relative,
    no_flash_programming,
    request_bay_used,
    request_channel_enabled,
    request_dc_status,
    request_home_parameters,
    request_info,
    request_position,
    request_status,
    request_status_bits,
    request_velocity_parameters,
    resume_end_of_move,
    set_channel_enabled,
    set_home_parameters,
    set_position,
    set_velocity_parameters,
    start_updates,
    stop,
    stop_updates,
    suspend_end_of_move,
)

__all__ = [
    "ADDRESSES",
    "BAY_1",
    "CONTROLLERS",
    "HOST",
    "RACK",
    "UNIT",
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
    "acknowledge_status",
    "disconnect",
    "encode",
    "home",
    "identify",
    "is_enabled",
    "is_occupied",
    "move_absolute",
    "move_relative",
    "no_flash_programming",
    "request_bay_used",
    "request_channel_enabled",
    "request_dc_status",
    "request_home_parameters",
    "request_info",
    "request_position",
    "request_status",
    "request_status_bits",
    "request_velocity_parameters",
    "resume_end_of_move",
    "set_channel_enabled",
    "set_home_parameters",
    "set_position",
    "set_velocity_parameters",
    "start_updates",
    "status_bits",
    "stop",
    "stop_updates",
    "suspend_end_of_move",
]
