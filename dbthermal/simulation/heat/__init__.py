r"""Transient heat in thin shells: conduction along a surface, and exchange with its surroundings.

The balance of a shell of thickness d, uniform through it, per area of its surface:

.. math:: \rho c d \, \dot T = \nabla \cdot (k d \, \nabla T) + \sum_i h_i (T_i - T)
          + \sum_j \varepsilon_j \sigma (T_j^4 - T^4) + q

`Shell` is the body, `Convection`, `Radiation` and `Heating` are the terms that follow, `Held` fixes
temperatures, and `simulate` steps through time.
"""

from dbthermal.simulation.heat._exchange import Convection, Exchange, Heating, Held, Radiation
from dbthermal.simulation.heat._shell import (
    ALUMINIUM,
    BOROSILICATE,
    CERAMIC,
    GLASS,
    STEEL,
    Shell,
    Solid,
)
from dbthermal.simulation.heat._transient import TOLERANCE, simulate

__all__ = [
    "ALUMINIUM",
    "BOROSILICATE",
    "CERAMIC",
    "GLASS",
    "STEEL",
    "TOLERANCE",
    "Convection",
    "Exchange",
    "Heating",
    "Held",
    "Radiation",
    "Shell",
    "Solid",
    "simulate",
]


def __dir__() -> list[str]:
    return __all__
