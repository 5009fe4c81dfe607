"""Separation of emission and reflection: one function, several methods of one signature."""

from dbthermal.separation._methods import METHODS
from dbthermal.separation._pooling.materials import materials
from dbthermal.separation._reflected import reflected_change
from dbthermal.separation._solve import solve
from dbthermal.separation._uncalibrated import reflections

__all__ = ["METHODS", "materials", "reflected_change", "reflections", "solve"]
