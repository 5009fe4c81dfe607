"""Figures of the experiments: calibrations, comparisons, errors, scenes."""

from reproduction.figures import calibration, comparison, errors, scenes

__all__ = ["calibration", "comparison", "errors", "scenes"]
