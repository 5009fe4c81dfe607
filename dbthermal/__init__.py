"""Object temperature, emissivity and reflections from two bands of thermal video.

Begin with `calibration.fit_response`, `correction.correct_capture` and `separation.solve`. The
functions exchange an `xarray.Dataset` in kelvin and SI units, whose variables `schema` names;
`explore` looks around in one. A module is imported when it is first used, so that
``import dbthermal`` is quick and asks for no optional package.
"""

import importlib
from typing import Any, Final

__version__ = "0.2.0.dev0"

__all__ = [
    "alignment",
    "bands",
    "calibration",
    "correction",
    "emissivity",
    "explore",
    "explorer",
    "figures",
    "instruments",
    "limits",
    "mixing",
    "noise",
    "planck",
    "readers",
    "report",
    "reporting",
    "response",
    "scene",
    "schema",
    "separation",
    "simulation",
    "store",
]
__dir__ = __all__.copy

_FUNCTIONS: Final = {"explore": "explorer", "report": "reporting"}  # name to its module


def __getattr__(name: str) -> Any:
    """Import a module of this package, or that of a function, when first used (PEP 562)."""
    if name in _FUNCTIONS:
        return getattr(importlib.import_module(f"{__name__}.{_FUNCTIONS[name]}"), name)
    if name in __all__:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"Unknown name {name!r} in {__name__}. Must be one of {__all__}.")
