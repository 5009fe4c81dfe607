"""Reflection ratios: total least squares against closed forms and the Cramer-Rao bound."""

import numpy as np
import numpy.typing as npt
import pytest

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import reflection_ratio
from dbthermal.separation._tiles import Material

Floats = npt.NDArray[np.float64]

TIME = np.arange(300) / 10.0  # s
FUNCTIONS = smooth.subspace(TIME, reflection_ratio.HIGHEST_ORDER)
NOISE = np.array([0.03, 0.35])  # K


def changes(ratio: tuple[float, ...], noise: Floats, pixels: int, amplitude: float = 1.0) -> Floats:
    """Signals (band, time, pixel) [K]: a slow curve, and rapid changes along the ratios."""
    rng = np.random.default_rng(4)
    rapid = amplitude * rng.standard_normal((TIME.size, 1))
    slow = 20.0 * (TIME / 30.0)[:, np.newaxis] ** 2
    clean = [0.8 * slow + one * rapid for one in ratio]
    return np.stack(clean) + noise[:, None, None] * rng.standard_normal((2, TIME.size, pixels))


def test_axis_of_a_scatter_without_noise() -> None:
    """A scatter along one direction gives its ratios exactly, in any number of bands."""
    ratio, noise = np.array([1.0, 2.0, -0.5]), np.array([0.03, 0.35, 0.2])
    whitened = ratio / noise
    found = reflection_ratio.principal_ratio(np.outer(whitened, whitened)[np.newaxis], noise)
    np.testing.assert_allclose(found[:, 0], ratio, rtol=0, atol=1e-12)


def test_two_bands_are_deming_regression() -> None:
    """The ratio is the root of Deming's quadratic, at the ratio of the noise variances."""
    signals = changes((1.0, 2.0), NOISE, 20)
    found = reflection_ratio.estimate(signals, FUNCTIONS, NOISE)
    for pixel, order in enumerate(found.order):
        basis = FUNCTIONS.functions[:, :order]
        rapid = signals[..., pixel] - (signals[..., pixel] @ basis) @ basis.T
        (xx, xy), (_, yy) = rapid @ rapid.T
        share = (NOISE[1] / NOISE[0]) ** 2
        root = np.sqrt((yy - share * xx) ** 2 + 4.0 * share * xy**2)
        deming = (yy - share * xx + root) / (2.0 * xy)
        np.testing.assert_allclose(found.ratio[1, pixel], deming, rtol=1e-9)


def test_variance_is_that_of_the_scatter_and_near_the_bound() -> None:
    """Over many pixels the ratios scatter as stated, at most 3 % above the Cramer-Rao bound."""
    signals = changes((1.0, 2.0), NOISE, 3000)
    found = reflection_ratio.estimate(signals, FUNCTIONS, NOISE)
    scatter, stated = np.std(found.ratio[1]), np.sqrt(np.mean(found.variance[1]))
    rapid = changes((1.0, 2.0), 0.0 * NOISE, 1)[0, :, 0] - 0.8 * 20.0 * (TIME / 30.0) ** 2
    basis = FUNCTIONS.functions[:, : int(np.median(found.order))]
    energy = np.sum((rapid - basis @ (basis.T @ rapid)) ** 2)
    bound = np.sqrt((NOISE[1] ** 2 + 4.0 * NOISE[0] ** 2) / energy)
    print(f"ratio: scatter {scatter:.5f}, stated {stated:.5f}, bound {bound:.5f}")
    assert np.mean(found.ratio[1]) == pytest.approx(2.0, abs=5.0 * bound / np.sqrt(3000))
    assert stated == pytest.approx(scatter, rel=0.05)
    assert 0.95 < scatter / bound < 1.03


def test_reduced_chi2_is_one_on_the_model() -> None:
    """On the model the reduced chi-square is 1, and the contrast is the background's."""
    found = reflection_ratio.estimate(changes((1.0, 2.0), NOISE, 400), FUNCTIONS, NOISE)
    assert np.mean(found.reduced_chi2) == pytest.approx(1.0, abs=0.02)
    expected = 1.0 + 1.0 / NOISE[0] ** 2 + (2.0 / NOISE[1]) ** 2
    assert np.median(found.contrast) == pytest.approx(expected, rel=0.2)


def test_null_combination_of_two_bands() -> None:
    """The null combination is (-k, 1) / (1 - k), and its variance follows by propagation."""
    ratio = np.array([[1.0, 1.0], [2.0, 0.4]])
    weights, variance = reflection_ratio.null_combination(ratio, NOISE)
    expected = np.stack([-ratio[1], np.ones(2)]) / (1.0 - ratio[1])
    np.testing.assert_allclose(weights, expected, rtol=1e-12)
    np.testing.assert_allclose(variance, ((expected * NOISE[:, np.newaxis]) ** 2).sum(axis=0))


def test_null_combination_of_three_bands_is_the_best() -> None:
    """The null combination cancels the background and has the lowest variance."""
    ratio, noise = np.array([[1.0], [2.0], [1.4]]), np.array([0.03, 0.35, 0.2])
    weights, variance = reflection_ratio.null_combination(ratio, noise)
    assert weights.sum() == pytest.approx(1.0)
    assert float((weights * ratio).sum()) == pytest.approx(0.0, abs=1e-12)
    free = np.cross(np.ones(3), ratio[:, 0])  # the one direction that the constraints leave
    for step in (-0.01, 0.01):
        other = weights[:, 0] + step * free
        assert np.sum((other * noise) ** 2) > variance[0]


def test_order_grows_with_the_curve() -> None:
    """A polynomial of degree d, well above the noise, needs d + 1 functions, and one more."""
    curve = 40.0 * FUNCTIONS.functions[:, 5:6]
    own = np.array([0.9, 0.7])[:, None, None] * curve
    found = reflection_ratio.estimate(changes((1.0, 2.0), NOISE, 50) + own, FUNCTIONS, NOISE)
    assert np.median(found.order) == 7


def test_inverse_energy() -> None:
    """1 / S + n / (S^2 |v|^2), and infinite where no energy is left."""
    found = reflection_ratio.inverse_energy(np.array([4.0, -1.0]), np.array([2.0, 2.0]), 100.0)
    assert found[0] == pytest.approx(1.0 / 4.0 + 100.0 / (16.0 * 2.0))
    assert found[1] == np.inf


@pytest.mark.parametrize(("ratio", "pooled"), [(2.0, True), (2.5, False), (np.nan, False)])
def test_material_is_used_unless_contradicted(ratio: float, pooled: bool) -> None:
    """A material's ratio is used unless it is NaN or the pixel's own changes contradict it."""
    one = np.ones(5)
    known = Material(np.stack([one, ratio * one]), 1e-4 * one, 0.8 * one, 0 * one, 0 * one, 0 * one)
    signals = changes((1.0, 2.0), NOISE, 5)
    with np.errstate(invalid="ignore"):
        found = reflection_ratio.estimate(signals, FUNCTIONS, NOISE, known)
    assert np.all(found.pooled == pooled)
    np.testing.assert_array_equal(found.ratio[1] == ratio, pooled)
    np.testing.assert_array_equal(found.inverse_energy == 1e-4, pooled)
