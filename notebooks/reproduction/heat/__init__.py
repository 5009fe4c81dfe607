"""Transient heat in thin shells: conduction along a surface, and exchange with its surroundings.

`Shell` is the body, of a thickness and a `Solid`; `Convection`, `Radiation` and `Heating` are its
exchanges; `simulate` states the balance and steps it through time.
"""

from reproduction.heat._exchange import Convection, Exchange, Heating, Radiation
from reproduction.heat._shell import BOROSILICATE, CERAMIC, GLASS, Shell, Solid
from reproduction.heat._transient import TOLERANCE, simulate

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
__dir__ = __all__.copy
