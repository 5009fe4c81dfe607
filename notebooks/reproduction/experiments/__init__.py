"""Seeded experiments on simulated captures: accuracy, error bars, limits, nuisances."""

from reproduction.experiments import cases, comparison, twins

__all__ = ["cases", "comparison", "twins"]
