"""Seeded experiments that print what they measure, and go on where an interruption left them."""

from dbthermal.experiments.cases import efficiency, run_case, score, simulate, sweep
from dbthermal.experiments.comparison import compare, judge, medians
from dbthermal.experiments.memory import gridded, remembered
from dbthermal.experiments.twins import at_thermocouple, judge_twin, share

__all__ = [
    "at_thermocouple",
    "compare",
    "efficiency",
    "gridded",
    "judge",
    "judge_twin",
    "medians",
    "remembered",
    "run_case",
    "score",
    "share",
    "simulate",
    "sweep",
]
