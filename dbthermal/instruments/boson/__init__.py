"""FLIR Boson: the driver of the camera's command port.

`Boson` is the camera, `commands` says what can be read, set and done, and `link` exchanges requests
and replies. Tested against public byte vectors and an emulator, not against hardware.
"""

from dbthermal.instruments.boson.camera import Boson, Identity
from dbthermal.instruments.boson.link import (
    BosonError,
    BosonReplyError,
    BosonStatusError,
    BosonTimeoutError,
    Statistics,
)

__all__ = [
    "Boson",
    "BosonError",
    "BosonReplyError",
    "BosonStatusError",
    "BosonTimeoutError",
    "Identity",
    "Statistics",
]
