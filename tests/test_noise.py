"""Noise estimated from simulated signals, one disturbance at a time."""

import numpy as np
import pytest

from dbthermal import noise

FRAMES, PIXELS = 350, 200
TIME = np.arange(FRAMES) / 10.0
NOISE = (0.03, 0.35)
REFLECTED = (0.14, 0.28)  # 1 - e of plate glass
# Standard deviation of the median over 200 pixels of 350 frames: 0.5 %; three of them and a bias.
TOLERANCE = 0.03

Array = np.ndarray
Signals = tuple[Array, Array]


@pytest.fixture
def rng() -> np.random.Generator:
    """Seeded random numbers."""
    return np.random.default_rng(11)


@pytest.fixture
def white(rng: np.random.Generator) -> Signals:
    """White noise of 0.03 and 0.35 K."""
    first, second = (std * rng.standard_normal((FRAMES, PIXELS)) for std in NOISE)
    return first, second


def curve() -> Array:
    """Object temperature (time, 1) [K], a heating and cooling by 30 K."""
    return 30.0 * np.exp(-(((TIME - 15.0) / 10.0) ** 2))[:, np.newaxis]


def pulses(rng: np.random.Generator, share: float) -> Array:
    """Background (time, pixel) [K] that is 3 K warmer for a second, now and then."""
    starts = rng.random((FRAMES, PIXELS)) < share / 10.0
    kernel = np.ones(10)
    return np.apply_along_axis(lambda s: 3.0 * (np.convolve(s, kernel)[:FRAMES] > 0), 0, starts)


def walk(rng: np.random.Generator, correlation_time: float) -> Array:
    """Background (time, pixel) [K] of 3 K, a random walk of a `correlation_time` [s]."""
    keep = np.exp(-0.1 / correlation_time)
    steps = 3.0 * rng.standard_normal((FRAMES, PIXELS))
    values = np.empty_like(steps)
    values[0] = steps[0]
    for frame in range(1, FRAMES):
        values[frame] = keep * values[frame - 1] + np.sqrt(1 - keep**2) * steps[frame]
    return values


def reflect(signals: Signals, background: Array) -> Signals:
    """Add what glass reflects of a background."""
    first, second = (
        signal + share * background for signal, share in zip(signals, REFLECTED, strict=True)
    )
    return first, second


def test_second_difference_keeps_the_variance(rng: np.random.Generator) -> None:
    """White noise keeps its variance, a straight line is removed."""
    sample = rng.standard_normal((20_000, 2))
    assert noise.second_difference(sample, np.arange(sample.shape[0])).std() == pytest.approx(
        1.0, abs=0.01
    )
    line = np.linspace(0.0, 5.0, 50)[:, np.newaxis]
    np.testing.assert_allclose(
        noise.second_difference(line, np.arange(line.shape[0])), 0.0, rtol=0, atol=1e-14
    )


def test_white_noise(white: Signals) -> None:
    """White noise is estimated within three per cent."""
    assert noise.estimate(*white, TIME) == pytest.approx(NOISE, rel=TOLERANCE)


def test_object_does_not_enter(white: Signals) -> None:
    """An object that heats by 30 K and cools again does not enter the noise."""
    first, second = (signal + curve() for signal in white)
    assert noise.estimate(first, second, TIME) == pytest.approx(NOISE, rel=TOLERANCE)


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_pulses_do_not_enter(white: Signals, rng: np.random.Generator, share: float) -> None:
    """Steps of the background by 3 K are trimmed away."""
    moved = reflect(white, pulses(rng, share))
    assert noise.estimate(*moved, TIME) == pytest.approx(NOISE, rel=0.05)


@pytest.mark.parametrize(
    ("correlation_time", "tolerance"), [(0.3, 0.06), (3.0, 0.06), (30.0, 0.06)]
)
def test_restless_background(
    white: Signals, rng: np.random.Generator, correlation_time: float, tolerance: float
) -> None:
    """A background that never rests is separated from the noise by its covariance in the bands.

    At 0.3 s it makes the quiet band's differences 6.6 times too large; 4 % are left. At 30 s
    one pixel does not show what the bands share, but all together do.
    """
    first, second = noise.estimate(*reflect(white, walk(rng, correlation_time)), TIME)
    assert first == pytest.approx(NOISE[0], rel=tolerance)
    assert second == pytest.approx(NOISE[1], rel=TOLERANCE)


def test_bands_in_units_of_their_own(white: Signals) -> None:
    """Scaling a band scales its noise and leaves the other's."""
    expected = noise.estimate(*white, TIME)
    scaled = noise.estimate(white[0], 115.0 * white[1], TIME)
    assert scaled == pytest.approx((expected[0], 115.0 * expected[1]), rel=1e-9)


def test_few_frames_are_refused(white: Signals) -> None:
    """Fifteen frames, or no pixel, are not enough; sixteen are."""
    with pytest.raises(ValueError, match="Invalid capture of 15 frames and 200 usable pixels"):
        noise.estimate(white[0][:15], white[1][:15], TIME[:15])
    with pytest.raises(ValueError, match="and 0 usable pixels"):
        noise.estimate(white[0][:, :0], white[1][:, :0], TIME)
    first, second = (signal[:16] for signal in white)
    assert noise.estimate(first, second, TIME[:16]) == pytest.approx(NOISE, rel=0.15)


def test_frozen_signal_has_no_noise(white: Signals) -> None:
    """A constant signal raises an error instead of a noise of zero."""
    with pytest.raises(ValueError, match="Must be positive: the signals vary"):
        noise.estimate(np.zeros_like(white[0]), white[1], TIME)


def test_uneven_time_stamps(white: Signals, rng: np.random.Generator) -> None:
    """A curved signal on uneven time stamps leaves the noise as it is."""
    time = np.sort(rng.uniform(TIME[0], TIME[-1], TIME.size))
    curved = 30.0 * (1.0 - np.exp(-time / 8.0))[:, np.newaxis]
    found = noise.estimate(white[0] + curved, white[1] + curved, time)
    assert found == pytest.approx(NOISE, rel=0.03)
