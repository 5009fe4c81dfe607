"""A filter wheel FW103 of Thorlabs on an APT stepper controller: six places, called by their band.

`FilterWheel` is the driver, `Settings` all that depends on one wheel and its controller. An FW103
is a bare stepper stage, not to be confused with the FW102C and FW212C, which speak ASCII.

The wheel has no encoder: its position is a count of commanded steps. A controller that stops short
of its target, or never starts, is an error here; steps that are lost under way are seen by nobody
until `FilterWheel.home` finds the switch again.

Tested against public byte vectors and an emulator, not against hardware.
"""

from dbthermal.instruments.filterwheel.link import (
    ControllerError,
    Link,
    NoReplyError,
    NotHomedError,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.filterwheel.settings import BSC10X, BSC20X, MODELS, Scale, Settings
from dbthermal.instruments.filterwheel.wheel import FilterWheel, Identity

__all__ = [
    "BSC10X",
    "BSC20X",
    "MODELS",
    "ControllerError",
    "FilterWheel",
    "Identity",
    "Link",
    "NoReplyError",
    "NotHomedError",
    "Scale",
    "Settings",
    "StalledWheelError",
    "WheelError",
    "WheelTimeoutError",
    "WrongDeviceError",
]
