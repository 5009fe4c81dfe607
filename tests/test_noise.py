"""Noise estimated from simulated signals, one disturbance at a time."""

from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from dbthermal import noise

FRAMES, PIXELS = 350, 200
TIME = np.arange(FRAMES) / 10.0
UNEVEN = np.sort(np.random.default_rng(11).uniform(0.0, 34.9, FRAMES))
NOISE = (0.03, 0.35)
REFLECTED = (0.14, 0.28)  # 1 - e of plate glass
# Standard deviation of the median over 200 pixels of 350 frames: 0.5 %; three of them and a bias.
TOLERANCE = 0.03

Array = np.ndarray
Signals = tuple[Array, Array]


@pytest.fixture
def white(rng: np.random.Generator) -> Signals:
    """White noise of 0.03 and 0.35 K."""
    first, second = (std * rng.standard_normal((FRAMES, PIXELS)) for std in NOISE)
    return first, second


def pulses(rng: np.random.Generator, share: float) -> Signals:
    """A background that is 3 K warmer for a second, now and then."""
    starts = rng.random((FRAMES, PIXELS)) < share / 10.0
    return reflected(3.0 * (lfilter(np.ones(10), 1.0, starts, axis=0) > 0.5))


def walk(rng: np.random.Generator, correlation_time: float) -> Signals:
    """A background of 3 K, a random walk of a `correlation_time` [s]."""
    keep = np.exp(-0.1 / correlation_time)
    steps = 3.0 * rng.standard_normal((FRAMES, PIXELS))
    steps[1:] *= np.sqrt(1 - keep**2)
    return reflected(lfilter([1.0], [1.0, -keep], steps, axis=0))


def reflected(background: Array) -> Signals:
    """What glass reflects of a background."""
    return REFLECTED[0] * background, REFLECTED[1] * background


def heating(time: Array) -> Signals:
    """An object that heats by 30 K and cools again."""
    return (30.0 * np.exp(-(((time - 15.0) / 10.0) ** 2))[:, np.newaxis],) * 2


@pytest.mark.parametrize(
    ("time", "signals", "within"),
    [
        (TIME, lambda _: (0.0, 0.0), (TOLERANCE, TOLERANCE)),
        (TIME, lambda _: heating(TIME), (TOLERANCE, TOLERANCE)),
        (UNEVEN, lambda _: heating(UNEVEN), (TOLERANCE, TOLERANCE)),
        # Steps of the background by 3 K are trimmed away.
        (TIME, lambda rng: pulses(rng, 0.02), (0.05, 0.05)),
        (TIME, lambda rng: pulses(rng, 0.1), (0.05, 0.05)),
        # A background that never rests is told by its covariance in the bands. At 0.3 s it makes
        # the quiet band's differences 6.6 times too large; 4 % are left. At 30 s one pixel does
        # not show what the bands share, but all together do.
        (TIME, lambda rng: walk(rng, 0.3), (0.06, TOLERANCE)),
        (TIME, lambda rng: walk(rng, 3.0), (0.06, TOLERANCE)),
        (TIME, lambda rng: walk(rng, 30.0), (0.06, TOLERANCE)),
    ],
    ids=["white", "object", "uneven", "pulses", "pulses", "walk", "walk", "walk"],
)
def test_noise_is_found_beside_signals(
    white: Signals, rng: np.random.Generator, time: Array, signals: Any, within: Signals
) -> None:
    """White noise is estimated within some per cent, whatever object and background do."""
    first, second = (own + moved for own, moved in zip(white, signals(rng), strict=True))
    found = noise.estimate(first, second, time)
    np.testing.assert_array_less(np.abs(np.array(found) / NOISE - 1.0), within)


def test_bands_in_units_of_their_own(white: Signals) -> None:
    """Scaling a band scales its noise and leaves the other's."""
    expected = noise.estimate(*white, TIME)
    scaled = noise.estimate(white[0], 115.0 * white[1], TIME)
    assert scaled == pytest.approx((expected[0], 115.0 * expected[1]), rel=1e-9)


def test_few_frames_are_refused(white: Signals) -> None:
    """Fifteen frames, no pixel, or a signal that does not vary, are not enough; sixteen are."""
    for frames, pixels, still, message in (
        (15, PIXELS, 1.0, "Invalid capture of 15 frames and 200 usable pixels"),
        (FRAMES, 0, 1.0, "and 0 usable pixels"),
        (FRAMES, PIXELS, 0.0, "Must be positive: the signals vary"),
    ):
        first, second = (signal[:frames, :pixels] for signal in white)
        with pytest.raises(ValueError, match=message):
            noise.estimate(still * first, second, TIME[:frames])
    first, second = (signal[:16] for signal in white)
    assert noise.estimate(first, second, TIME[:16]) == pytest.approx(NOISE, rel=0.15)
