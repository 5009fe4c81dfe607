"""Seeded experiments that print what they measure, and go on where an interruption left them."""

from reproduction.experiments.cases import efficiency, run_case, score, simulate, sweep
from reproduction.experiments.comparison import compare, judge, medians
from reproduction.experiments.memory import gridded, remembered
from reproduction.experiments.twins import at_thermocouple, judge_twin, share

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
