"""Simulated nuisances of one camera: the lag's step response, and refused arguments."""

from typing import Any

import numpy as np
import pytest
from captures import movie, still

from dbthermal import simulation


def test_lag_is_that_of_a_small_body() -> None:
    """A step is followed as 1 - exp(-t / tau), however the frames are spaced."""
    time = np.array([0.0, 0.004, 0.010, 0.011, 0.030])
    seen = simulation.lag(movie(np.array([0.0, 1.0, 1.0, 1.0, 1.0]), time), 0.010)["counts"]
    np.testing.assert_allclose(seen[0, :, 0, 0], -np.expm1(-time / 0.010), rtol=0, atol=1e-12)


RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    ("name", "arguments", "options", "message"),
    [
        ("lose_frames", (1.0, RNG), {}, "Invalid share 1.0"),
        ("spoil_pixels", (1.0, RNG), {}, "Invalid share 1.0"),
        ("fire_shutter", (99.0, RNG), {}, "Invalid time 99.0 s of the shutter"),
        ("fire_shutter", (9.0, RNG), {"bands": ("10.6",)}, "Missing band '10.6'"),
    ],
)
def test_simulated_nuisances_refuse_nonsense(
    name: str, arguments: Any, options: Any, message: str
) -> None:
    """Shares, times and bands outside their range raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        getattr(simulation, name)(still(), *arguments, **options)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [("fire_shutter", ([0.2], RNG)), ("spoil_pixels", (0.1, RNG)), ("lag", (0.05,))],
)
def test_whole_numbers_are_refused(name: str, arguments: Any) -> None:
    """Integer counts raise an error: a lagging pixel of 1000 counts would wrap to 57,580."""
    with pytest.raises(TypeError, match="uint16 of 'counts'"):
        getattr(simulation, name)(still().astype(np.uint16), *arguments)
