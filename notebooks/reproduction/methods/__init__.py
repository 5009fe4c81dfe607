"""Methods to compare with: the paper's optimiser, least squares, pyrometry, channel prior.

`get_method` names these and the methods of `dbthermal.separation` alike; the record that it returns
is the `method` of `separation.solve`.
"""

from typing import Final

from dbthermal import separation
from dbthermal.separation import Method
from reproduction.methods import bcp, dbvt, naive, ratio

OUTSIDE: Final = {module.METHOD.name: module.METHOD for module in (dbvt, naive, ratio, bcp)}
"""Records of the methods here, by name."""

METHODS: Final = (*separation.METHODS, *OUTSIDE)  # names of all methods


def get_method(name: str) -> Method:
    """Record of a method, one of `METHODS`."""
    return OUTSIDE[name] if name in OUTSIDE else separation.get_method(name)
