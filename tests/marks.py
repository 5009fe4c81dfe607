"""Rows of the arguments of a test, of which some take long."""

from typing import Any

import pytest


def slow(*rows: Any, mark: pytest.MarkDecorator = pytest.mark.slow) -> list[Any]:
    """Rows for the slow tests, each a tuple of arguments, or the only argument."""
    every = (row if isinstance(row, tuple) else (row,) for row in rows)
    return [pytest.param(*row, marks=mark) for row in every]


def long(*rows: Any) -> list[Any]:
    """Rows for the tests that nobody waits for."""
    return slow(*rows, mark=pytest.mark.long)
