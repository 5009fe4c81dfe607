"""Filter wheel FW103 of Thorlabs on an APT stepper controller: six slots, named by their band.

`FilterWheel` is the driver, `Settings` the properties of one wheel and its controller. An FW103 is
a bare stepper stage, not to be confused with the FW102C and FW212C, which speak ASCII. It has no
encoder: its position is a count of commanded steps. A controller that stops short of its target, or
never starts, is an error here; steps lost under way are not detected until `FilterWheel.home`.
Tested against public byte vectors and an emulator, not against hardware.
"""

from dbthermal.instruments.filterwheel._controller import (
    NoReplyError,
    NotHomedError,
    StalledWheelError,
    WheelError,
    WheelTimeoutError,
    WrongDeviceError,
)
from dbthermal.instruments.filterwheel._settings import Settings
from dbthermal.instruments.filterwheel._wheel import FilterWheel

__all__ = [
    "FilterWheel",
    "NoReplyError",
    "NotHomedError",
    "Settings",
    "StalledWheelError",
    "WheelError",
    "WheelTimeoutError",
    "WrongDeviceError",
]
__dir__ = __all__.copy
