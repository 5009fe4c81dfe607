"""Seeded experiments on simulated captures: accuracy, error bars, limits, nuisances."""

from reproduction.experiments.cases import efficiency, run_case, score, simulate, sweep
from reproduction.experiments.comparison import compare, judge, medians
from reproduction.experiments.twins import (
    at_thermocouple,
    capture_of,
    judge_twin,
    separate_twin,
    share,
)

__all__ = [
    "at_thermocouple",
    "capture_of",
    "compare",
    "efficiency",
    "judge",
    "judge_twin",
    "medians",
    "run_case",
    "score",
    "separate_twin",
    "share",
    "simulate",
    "sweep",
]
