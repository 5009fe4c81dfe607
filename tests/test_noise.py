"""Noise estimated from simulated signals, one disturbance at a time."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from dbthermal import noise
from dbthermal.simulation import Background

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


def reflected(rng: np.random.Generator, **how: Any) -> Signals:
    """What glass reflects of a background."""
    background = Background(**how).draw(TIME, PIXELS, rng)
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
        (TIME, partial(reflected, count=(0, 2), duration=(1.0, 1.1)), (0.05, 0.05)),
        (TIME, partial(reflected, count=(3, 5), duration=(1.0, 1.1)), (0.05, 0.05)),
        # A background that never rests is told by its covariance in the bands. At 0.3 s it makes
        # the quiet band's differences 6.6 times too large; 4 % are left. At 30 s one pixel does
        # not show what the bands share, but all together do.
        *(
            (TIME, partial(reflected, kind="random walk", correlation_time=time), (0.06, TOLERANCE))
            for time in (0.3, 3.0, 30.0)
        ),
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
