"""Methods of separation to compare with: least squares, ratio pyrometry, blackbody channel prior.

`get_method` names these and the methods of `dbthermal.separation` alike; the record that it returns
is the `method` of `separation.solve`.
"""

from typing import Final

from dbthermal import separation
from dbthermal.separation import Method
from reproduction.methods import bcp, naive, ratio

OUTSIDE: Final = {method.name: method for method in (naive.METHOD, ratio.METHOD, bcp.METHOD)}
"""Records of the methods here, by name."""

METHODS: Final = (*separation.METHODS, *OUTSIDE)
"""Names of all methods."""


def get_method(name: str) -> Method:
    """Record of a method, one of `METHODS`."""
    return OUTSIDE[name] if name in OUTSIDE else separation.get_method(name)
