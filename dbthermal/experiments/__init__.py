"""Seeded experiments that print what they measure, and go on where an interruption left them."""

from dbthermal.experiments.cases import efficiency, run_case, score, sweep
from dbthermal.experiments.comparison import compare, judge, medians
from dbthermal.experiments.memory import gridded, remembered

__all__ = [
    "compare",
    "efficiency",
    "gridded",
    "judge",
    "medians",
    "remembered",
    "run_case",
    "score",
    "sweep",
]
