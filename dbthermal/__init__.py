"""Separate emission from reflection in two bands of thermal video.

The package has no classes to build and no state: a stage is a module, a step is a function, and
what passes between them is an `xarray.Dataset` in kelvin and SI units. A module is imported when it
is first used, ``dbthermal.calibration`` for one, so that ``import dbthermal`` is quick and asks
only for the modules that a program needs.
"""

import importlib
import pkgutil
from types import ModuleType

__version__ = "0.1.0"

_MODULES = frozenset(module.name for module in pkgutil.iter_modules(__path__))


def __getattr__(name: str) -> ModuleType:
    """Import the module `name` of this package when it is first asked for (PEP 562)."""
    if name in _MODULES:
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(
        f"Unknown module {name!r} in {__name__}. Must be one of {sorted(_MODULES)}."
    )


def __dir__() -> list[str]:
    """List the modules beside the names that are loaded already."""
    return sorted({*globals(), *_MODULES})
