"""Separation of emission and reflection: one function, several methods of one signature.

Begin with `solve(corrected, response)`; `METHODS` names the methods, and each method that has
options takes them as its frozen record, such as `SubspaceSettings`.
"""

import importlib
from typing import TYPE_CHECKING, Any, Final

from dbthermal.separation._completion.complete import complete
from dbthermal.separation._pooling.materials import materials
from dbthermal.separation._reflection import reflected_change
from dbthermal.separation._run import run
from dbthermal.separation._separate import separate
from dbthermal.separation._solve import METHODS, get_method, solve

if TYPE_CHECKING:
    from dbthermal.separation._baselines.bcp import BcpSettings
    from dbthermal.separation._baselines.calibrated import CalibratedSettings
    from dbthermal.separation._baselines.naive import NaiveSettings
    from dbthermal.separation._baselines.pyrometry import RatioSettings
    from dbthermal.separation._dbvt import DbvtSettings
    from dbthermal.separation._streaming.stream import Stream
    from dbthermal.separation._subspace.method import SubspaceSettings

__all__ = [
    "METHODS",
    "BcpSettings",
    "CalibratedSettings",
    "DbvtSettings",
    "NaiveSettings",
    "RatioSettings",
    "Stream",
    "SubspaceSettings",
    "complete",
    "get_method",
    "materials",
    "reflected_change",
    "run",
    "separate",
    "solve",
]
__dir__ = __all__.copy

# These are imported when they are first used: some compile.
_LATER: Final = {
    "BcpSettings": "_baselines.bcp",
    "CalibratedSettings": "_baselines.calibrated",
    "DbvtSettings": "_dbvt",
    "NaiveSettings": "_baselines.naive",
    "RatioSettings": "_baselines.pyrometry",
    "Stream": "_streaming.stream",
    "SubspaceSettings": "_subspace.method",
}


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
    raise AttributeError(f"Unknown name {name!r} in {__name__}. Must be one of {__all__}.")
