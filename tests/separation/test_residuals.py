"""Statistics of residuals: robust line, autocorrelation, interband delay, sudden steps."""

import numpy as np
import numpy.typing as npt
import pytest

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import reflection_ratio, residuals

Floats = npt.NDArray[np.float64]

TIME = np.arange(300) / 10.0  # s
FUNCTIONS = smooth.subspace(TIME, reflection_ratio.HIGHEST_ORDER)
NOISE = np.array([0.03, 0.35])  # K


def noise(pixels: int, seed: int = 1) -> Floats:
    """White noise of standard deviation 1 (time, pixel)."""
    return np.random.default_rng(seed).standard_normal((TIME.size, pixels))


def test_line_without_outliers_is_least_squares() -> None:
    """On clean points the robust slope is nearly the plain one, and scatters as it states."""
    abscissa = np.repeat((TIME - 15.0)[:, np.newaxis], 2000, axis=1)
    line = residuals.regress(abscissa, 0.8 * abscissa + 0.1 * noise(2000), 0.1)
    plain = 0.1 / np.sqrt(np.sum(abscissa[:, 0] ** 2))
    assert np.mean(line.slope) == pytest.approx(0.8, abs=4.0 * plain / np.sqrt(2000))
    assert np.std(line.slope) == pytest.approx(plain, rel=0.1)  # 95 % efficient
    assert np.sqrt(np.median(line.variance)) == pytest.approx(np.std(line.slope), rel=0.15)


def test_line_is_not_moved_by_outliers_on_one_side() -> None:
    """The slope stays within the noise with one point in four lifted."""
    rng = np.random.default_rng(3)
    abscissa = np.repeat((TIME - 15.0)[:, np.newaxis], 200, axis=1)
    lifted = 3.0 * (rng.random(abscissa.shape) < 0.25)
    line = residuals.regress(abscissa, 0.8 * abscissa + 0.03 * noise(200) + lifted, 0.03)
    np.testing.assert_allclose(line.slope, 0.8, rtol=0, atol=0.003)
    assert np.max(line.weights[lifted > 0]) == 0.0
    assert np.mean(line.weights[lifted == 0]) > 0.8


def test_line_follows_its_units() -> None:
    """Slope and residual scale with the ordinate; its scale is never below the noise."""
    abscissa = np.repeat((TIME - 15.0)[:, np.newaxis], 5, axis=1)
    ordinate = 0.8 * abscissa + 0.1 * noise(5)
    one, ten = (residuals.regress(abscissa, f * ordinate, f * 0.1) for f in (1.0, 10.0))
    np.testing.assert_allclose(ten.slope, 10.0 * one.slope, rtol=1e-5)
    exact = residuals.regress(abscissa, 0.8 * abscissa, 0.1)
    np.testing.assert_allclose(exact.slope, 0.8, rtol=1e-9)
    np.testing.assert_array_equal(exact.scale, 0.1)


def test_correlated_points_count_less() -> None:
    """Noise of lag-one correlation r leaves (1 - r) / (1 + r) of the points independent."""
    rng, rho = np.random.default_rng(2), 0.6
    white = rng.standard_normal((TIME.size, 1000))
    red = np.empty_like(white)
    red[0] = white[0]
    for frame in range(1, TIME.size):
        red[frame] = rho * red[frame - 1] + np.sqrt(1.0 - rho**2) * white[frame]
    abscissa = np.repeat((TIME - 15.0)[:, np.newaxis], 1000, axis=1)
    line = residuals.regress(abscissa, 0.1 * red, 0.1)
    ratio = np.median(line.variance) / (0.01 / np.sum(abscissa[:, 0] ** 2))
    assert ratio == pytest.approx((1.0 + rho) / (1.0 - rho), rel=0.2)


def test_autocorrelation_of_white_noise_is_a_standard_score() -> None:
    """Mean 0 and deviation 1 over many pixels; a delayed copy of itself adds its share."""
    white = noise(4000)
    score = residuals.autocorrelation(white)
    assert np.mean(score) == pytest.approx(0.0, abs=0.1)
    assert np.std(score) == pytest.approx(1.0, abs=0.05)
    mixture = (white[1:] + white[:-1]) / np.sqrt(2.0)  # of correlation 1/2 at lag 1
    expected = 0.5 / residuals.LAGS * np.sqrt(residuals.LAGS * len(mixture))
    assert np.mean(residuals.autocorrelation(mixture)) == pytest.approx(expected, rel=0.05)


def test_autocorrelation_of_nothing_is_zero() -> None:
    """A residual of zeros has an autocorrelation of zero."""
    np.testing.assert_array_equal(residuals.autocorrelation(np.zeros((50, 3))), 0.0)


@pytest.mark.parametrize(("frames", "apart"), [(0, False), (1, True), (-1, True)])
def test_delay_between_the_bands_is_seen(frames: int, apart: bool) -> None:
    """A second band that is a frame late or early scores high, a simultaneous one as noise."""
    rng = np.random.default_rng(5)
    pulses = np.cumsum(rng.standard_normal((TIME.size + 2, 200)) > 1.5, axis=0) % 2
    background = 3.0 * pulses.astype(np.float64)
    first, second = background[1:-1], background[1 - frames : TIME.size + 1 - frames]
    signals = np.stack([0.14 * first, 0.28 * second])
    signals += NOISE[:, None, None] * rng.standard_normal(signals.shape)
    ratios = reflection_ratio.estimate(signals, FUNCTIONS, NOISE)
    residual = residuals.null_residual(signals, FUNCTIONS, ratios)
    score = residuals.interband_delay(residual, signals[0], FUNCTIONS, ratios, NOISE[0])
    print(f"{frames} frames: median score {np.median(score):.1f}")
    assert np.median(score) > 6.0 if apart else np.quantile(score, 0.99) < 4.0


def test_null_residual_is_white_noise_of_the_null_variance() -> None:
    """On the model no background and no object is left in it."""
    rng = np.random.default_rng(6)
    rapid = rng.standard_normal((TIME.size, 500))
    slow = 10.0 * (TIME[:, np.newaxis] / 30.0) ** 2
    signals = np.stack([0.86 * slow + 0.14 * rapid, 0.72 * slow + 0.28 * rapid])
    signals += NOISE[:, None, None] * rng.standard_normal(signals.shape)
    ratios = reflection_ratio.estimate(signals, FUNCTIONS, NOISE)
    residual = residuals.null_residual(signals, FUNCTIONS, ratios)
    freedom = TIME.size - ratios.order - 1  # one more for the ratio
    reduced = (residual**2).sum(axis=0) / freedom / ratios.null_variance
    assert np.mean(reduced) == pytest.approx(1.0, abs=0.03)


def test_a_second_line_is_not_explained() -> None:
    """A background alone is explained; with a rapid object of 2 K beside it most pixels are not."""
    rng = np.random.default_rng(7)
    pulses = 6.0 * ((np.arange(TIME.size) // 20 % 5) == 0)[:, np.newaxis]
    step = np.tanh((TIME - 17.0) / 0.3)[:, np.newaxis]
    shares = []
    for height in (0.0, 2.0):
        signals = NOISE[:, None, None] * rng.standard_normal((2, TIME.size, 2000))
        signals += np.array([0.14, 0.28])[:, None, None] * pulses * rng.uniform(0.5, 1, 2000)
        signals += np.array([0.86, 0.72])[:, None, None] * height * step
        ratios = reflection_ratio.estimate(signals, FUNCTIONS, NOISE)
        residual = residuals.null_residual(signals, FUNCTIONS, ratios)
        rapid = signals[0] - FUNCTIONS.functions @ ratios.coefficients[0]
        common = ratios.null_weights[0] * NOISE[0] ** 2
        found = residuals.unexplained(residual, rapid, ratios.null_variance, common)
        shares.append(float(found.mean()))
    print(f"not explained: {shares[0]:.4f} of the background alone, {shares[1]:.3f} with an object")
    assert shares[0] < 0.002
    assert shares[1] > 0.7


@pytest.mark.parametrize("louder", [1.0, 2.0, 10.0])
def test_a_long_rest_is_explained(louder: float) -> None:
    """A room that rests for all but 60 of 3000 frames leaves white noise, whichever band is louder.

    Held against the first band's own signal, whose noise the residual shares, every pixel of bands
    of like noise was not explained.
    """
    rng, time = np.random.default_rng(8), np.arange(3000) / 10.0
    functions, stds = smooth.subspace(time, 6), np.array([0.03, 0.03 * louder])
    pulse = 6.0 * (np.abs(time - 120.0) < 3.0)[:, np.newaxis]
    signals = stds[:, None, None] * rng.standard_normal((2, time.size, 300))
    signals += np.array([0.14, 0.28])[:, None, None] * pulse
    ratios = reflection_ratio.estimate(signals, functions, stds)
    residual = residuals.null_residual(signals, functions, ratios)
    rapid = signals[0] - functions.functions @ ratios.coefficients[0]
    common = ratios.null_weights[0] * stds[0] ** 2
    share = np.mean(residuals.unexplained(residual, rapid, ratios.null_variance, common))
    print(f"noise 1:{louder:g}: not explained {share:.4f}")
    assert share < 0.01


def test_sudden_steps() -> None:
    """A step between two frames is sudden, one that takes half a second is not, nor is noise."""
    curve = np.stack([TIME >= 14.0, np.clip((TIME - 14.0) / 0.5, 0, 1), 0.0 * TIME], axis=1)
    found = residuals.sudden(6.0 * curve + 0.3 * noise(3), np.full(curve.shape, 0.3), TIME)
    np.testing.assert_array_equal(found, [True, False, False])


def test_a_background_returns_and_a_rise_does_not() -> None:
    """Passers-by leave the signal where it was; a front that has passed does not."""
    time, rng = np.arange(300.0) / 10.0, np.random.default_rng(1)
    passing = np.where((time > 8.0) & (time < 11.0), 0.4, 0.0)
    rise = 20.0 / (1.0 + np.exp(-(time - 14.0) / 0.4))
    signal = np.stack([passing, rise, rise + passing], axis=1)
    signal += rng.normal(0.0, 0.03, signal.shape)
    assert residuals.returning(signal).tolist() == [True, False, False]
