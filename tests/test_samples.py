"""Subsample and neighbours, by hand."""

import numpy as np
import pytest

from dbthermal import _arrays
from dbthermal import _samples as samples


@pytest.mark.parametrize(
    ("shape", "number", "step"),
    [((96, 128), 4096, 1), ((512, 640), 4096, 8), ((4, 4), 100, 1), ((64, 64, 64), 4096, 4)],
)
def test_stride_selects_about_the_number(shape: tuple[int, ...], number: int, step: int) -> None:
    """A stride is at least 1, and a whole root is not rounded down."""
    assert _arrays.stride(shape, number) == step


def test_neighbours_without_weight_do_not_count() -> None:
    """A constant keeps its value beside NaN of weight 0; where nothing counts it is NaN."""
    values, weight = np.full((40, 40), 2.0), np.ones((40, 40))
    values[:, 20:], weight[:, 20:] = np.nan, 0.0
    result = samples.neighbour_mean(values, weight, 1.0)
    np.testing.assert_allclose(result[:, :22], 2.0, rtol=0, atol=1e-12)
    assert np.all(np.isnan(result[:, 30:]))
