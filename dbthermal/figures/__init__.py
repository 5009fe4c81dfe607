"""Figures that a thermographer expects: a function draws its arguments and returns the figure.

Nothing is computed here beyond units for display, nothing is saved. Temperatures are drawn in
degrees Celsius. Every figure of data that are simulated or not radiometric says so in its title,
from the `origin` and `radiometric` attributes of its data. `drawing` has the parts of a new figure.
For a journal, draw with ``matplotlib.style.context("dbthermal.figures.publication")`` in force,
which is as wide as a page at most, with letters of 7 points, and save as PDF (`store.save_figure`).
"""

from dbthermal.figures import drawing
from dbthermal.figures._maps import REASONS, plan, status
from dbthermal.figures._scenes import (
    FilmPanel,
    Panel,
    film,
    live,
    reflection_shift,
    separated_frames,
    separated_temperatures,
)

__all__ = [
    "REASONS",
    "FilmPanel",
    "Panel",
    "drawing",
    "film",
    "live",
    "plan",
    "reflection_shift",
    "separated_frames",
    "separated_temperatures",
    "status",
]
__dir__ = __all__.copy
