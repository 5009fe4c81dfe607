"""Statistics of residuals: robust line, autocorrelation, interband delay, change points."""

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


def test_change_point_is_at_the_step() -> None:
    """A step along the object's direction is found at its frame; noise alone has no gain."""
    step = np.where(np.arange(TIME.size) >= 140, 1.0, 0.0)[:, np.newaxis]
    rng = np.random.default_rng(7)
    moved = np.stack([0.86 * step, 0.72 * step]) * np.ones(20)
    inside = residuals.candidates(TIME)
    for height, sign in ((6.0, 1.0), (0.0, -1.0)):
        signals = height * moved + 0.03 * rng.standard_normal((2, TIME.size, 20))
        # A background beside it, along another direction, is not taken for the step.
        signals += np.array([0.14, 0.28])[:, None, None] * rng.standard_normal((TIME.size, 20))
        frame, gain = residuals.find_jump(signals, TIME, FUNCTIONS, np.array([0.03, 0.03]), inside)
        assert np.all(sign * gain > 0)
        if height:
            np.testing.assert_array_equal(frame, 140)


def test_isolated_change() -> None:
    """One step alone stands out; a pulse, which comes and goes, does not."""
    step = 6.0 * (np.arange(TIME.size) >= 140)
    pulses = 6.0 * ((np.arange(TIME.size) // 40) % 2)
    signal = np.stack([step, pulses], axis=1) + 0.03 * noise(2)
    found = residuals.isolated_change(signal, TIME, FUNCTIONS)
    np.testing.assert_array_equal(found, [True, False])


def test_ramp_takes_a_second() -> None:
    """A jump takes as long as the time that is left out on one side, at any frame rate."""
    for time in (TIME, TIME / 1e3, TIME / 1e10):
        ramp = residuals.ramp(time)
        assert ramp[-1] - ramp[0] == pytest.approx(residuals.AROUND)
        assert ramp.size <= 501  # bounded, however fast the clock


def test_shutter_event_beside_a_jump_leaves_one_side() -> None:
    """With a shutter event at the jump only its longer side is kept."""
    segment = (TIME >= 20.2).astype(np.intp)
    both, longer = (residuals.beside_jump(TIME, 200, part) for part in (None, segment))
    assert both[:190].all()
    assert both[215:].all()
    assert longer[:190].all()
    assert not longer[190:].any()
