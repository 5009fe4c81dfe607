"""Movies that are moved, and their products, against sparse matrices and sums over arrays."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from dbthermal.alignment._products import BORDER, Match, products
from dbthermal.alignment._views import TAPS, interpolation

SHAPE, FRAMES = (9, 12), 40


@pytest.mark.parametrize("matched", [False, True])
def test_products_are_those_of_interpolated_movies(matched: bool) -> None:
    """All 14 sums, also of places near the border, beyond it, and on whole pixels."""
    rng = np.random.default_rng(4)
    larger = (SHAPE[0] + 2 * BORDER, SHAPE[1] + 2 * BORDER, FRAMES)
    padded = rng.standard_normal(larger, dtype=np.float32)
    other = rng.standard_normal((*SHAPE, FRAMES), dtype=np.float32)
    places = np.indices(SHAPE) + rng.uniform(-4.0, 4.0, (2, *SHAPE))
    places[:, 0, 0], places[:, 1, 1], places[:, 2, 2] = (3.0, 5.0), (-30.0, 2.0), (4.0, 90.0)
    match = Match(rng.uniform(0.5, 1.0, SHAPE), rng.uniform(0.5, 2.0, SHAPE)) if matched else None
    ((*sums,),) = products(padded, [other], places, [match])

    def at(down: float, right: float) -> np.ndarray:
        """Movie (y, x, time) beside the places."""
        step = np.array([down, right])[:, np.newaxis, np.newaxis]
        large = np.full((2, *padded.shape[:2]), -99.0)
        large[:, : SHAPE[0], : SHAPE[1]] = places + BORDER + step
        moved = interpolation(large, TAPS) @ padded.reshape(-1, FRAMES)
        return np.asarray(moved.reshape(padded.shape)[: SHAPE[0], : SHAPE[1]])

    four = [at(0, 0), at(0.5, 0) - at(-0.5, 0), at(0, 0.5) - at(0, -0.5), other]
    weight, expected = np.ones_like(other), [np.zeros(SHAPE)] * 3
    if match is not None:
        residual = other - match.ratio[..., np.newaxis] * four[0]
        square = uniform_filter(residual**2, (3, 3, 5))
        weight = 1.0 / (1.0 + (square / (4.0 * match.variance[..., np.newaxis])) ** 2)
        away = weight * np.roll(weight * residual, FRAMES // 2, axis=2)
        expected = [np.median(square, axis=2), *((one * away).sum(axis=2) for one in four[1:3])]
    pairs = [(weight * a * b).sum(axis=2) for i, a in enumerate(four) for b in four[i:]]
    for found, wanted in zip(sums, [*pairs, weight.sum(axis=2), *expected], strict=True):
        np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-4)
    assert not np.any(sums[0][1, 1])
    assert not np.any(sums[0][2, 2])
