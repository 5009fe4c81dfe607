r"""Transient heat in thin shells: conduction along a surface, and exchange with its surroundings.

The balance of a shell of thickness d, uniform through it, per area of its surface:

.. math:: \rho c d \, \dot T = \nabla \cdot (k d \, \nabla T) + \sum_i h_i (T_i - T)
          + \sum_j \varepsilon_j \sigma (T_j^4 - T^4) + q

`Shell` is the body, `Convection`, `Radiation` and `Heating` are the terms that follow, and
`simulate` steps through time.
"""

from dbthermal.simulation.heat._exchange import Convection, Exchange, Heating, Radiation
from dbthermal.simulation.heat._shell import (
    BOROSILICATE,
    CERAMIC,
    GLASS,
    Shell,
    Solid,
)
from dbthermal.simulation.heat._transient import TOLERANCE, simulate

__all__ = [
    "BOROSILICATE",
    "CERAMIC",
    "GLASS",
    "TOLERANCE",
    "Convection",
    "Exchange",
    "Heating",
    "Radiation",
    "Shell",
    "Solid",
    "simulate",
]


def __dir__() -> list[str]:
    return __all__
