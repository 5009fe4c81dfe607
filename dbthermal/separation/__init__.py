"""Separation of emission and reflection: one function, several methods of one signature.

Begin with `solve(corrected, response)`; `METHODS` names the methods, and each method that has
options takes them as its frozen record, such as `SubspaceSettings`. A `Method` of your code, a
function of a `_tiles.Tile` that returns a `_tiles.Estimate`, is passed to `solve` like a name.
"""

import importlib
from typing import TYPE_CHECKING, Any, Final

from dbthermal.separation._budget import without_calibration
from dbthermal.separation._completion.complete import complete
from dbthermal.separation._inputs import Method
from dbthermal.separation._pooling.materials import materials
from dbthermal.separation._run import run
from dbthermal.separation._separate import separate
from dbthermal.separation._solve import METHODS, get_method, solve

if TYPE_CHECKING:
    from dbthermal.separation._calibrated import CalibratedSettings
    from dbthermal.separation._stream import Stream
    from dbthermal.separation._subspace.method import SubspaceSettings

__all__ = [
    "METHODS",
    "CalibratedSettings",
    "Method",
    "Stream",
    "SubspaceSettings",
    "complete",
    "get_method",
    "materials",
    "run",
    "separate",
    "solve",
    "without_calibration",
]
__dir__ = __all__.copy

# These are imported when they are first used: some compile.
_LATER: Final = {
    "CalibratedSettings": "_calibrated",
    "Stream": "_stream",
    "SubspaceSettings": "_subspace.method",
}


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    raise AttributeError(f"Unknown name {name!r} in {__name__}. Must be one of {__all__}.")
