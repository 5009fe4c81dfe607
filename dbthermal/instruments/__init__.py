"""Recording with the rig: two cameras, a filter wheel and thermocouples, real or emulated.

Begin with a `session`, a YAML file of the recording and its devices' addresses; `devices` opens
them, `protocols` records a scene or a blackbody sweep, `live` shows it meanwhile, and `recording`
opens it again. `inventory` lists what is on the USB bus. The drivers are `boson` with `telemetry`,
`filterwheel` over `_apt`, `tc08`, and `v4l2` for frames; `camera` is the interface of any camera,
`transport` has addresses, serial lines and the clock. `emulated` has emulated devices, below the
same drivers.

All drivers were written from public descriptions and tested against public byte vectors, stand-ins
for the system's calls and emulators, **never against hardware**. They need the packages of
``dbthermal[instruments]``.
"""

import importlib
from types import ModuleType

__all__ = [
    "boson",
    "camera",
    "devices",
    "filterwheel",
    "inventory",
    "live",
    "protocols",
    "recording",
    "session",
    "tc08",
]
__dir__ = __all__.copy


def __getattr__(name: str) -> ModuleType:
    """Import the module `name` of this package when it is first used (PEP 562)."""
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"Unknown module {name!r} in {__name__}. Must be one of {__all__}.")
