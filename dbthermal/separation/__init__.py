"""Separation of emission and reflection: one function, several methods of one signature."""

from dbthermal.separation.materials import materials
from dbthermal.separation.methods import METHODS
from dbthermal.separation.reflected import reflected_change
from dbthermal.separation.relative import reflections
from dbthermal.separation.solver import solve

__all__ = ["METHODS", "materials", "reflected_change", "reflections", "solve"]
