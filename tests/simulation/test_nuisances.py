"""Simulated nuisances of one camera: the lag's step response, and refused arguments."""

import re

import numpy as np
import pytest
import xarray as xr
from captures import movie, still

from dbthermal import simulation


def test_lag_is_that_of_a_small_body() -> None:
    """A step is followed as 1 - exp(-t / tau), however the frames are spaced."""
    time = np.array([0.0, 0.004, 0.010, 0.011, 0.030])
    seen = simulation.lag(movie(np.array([0.0, 1.0, 1.0, 1.0, 1.0]), time), 0.010)["counts"]
    np.testing.assert_allclose(seen[0, :, 0, 0], -np.expm1(-time / 0.010), rtol=0, atol=1e-12)


def test_simulated_nuisances_refuse_nonsense() -> None:
    """Shares, times and bands outside their range raise a ValueError."""
    capture, rng = still(), np.random.default_rng(0)
    for step in (simulation.lose_frames, simulation.spoil_pixels):
        with pytest.raises(ValueError, match=re.escape("Invalid share 1.0")):
            step(capture, 1.0, rng)
    with pytest.raises(ValueError, match=re.escape("Invalid time 99.0 s of the shutter")):
        simulation.fire_shutter(capture, 99.0, rng)
    with pytest.raises(ValueError, match=re.escape("Missing band '10.6'")):
        simulation.fire_shutter(capture, 9.0, rng, bands=("10.6",))


@pytest.mark.parametrize("name", ["fire_shutter", "spoil_pixels", "lag"])
def test_whole_numbers_are_refused(name: str) -> None:
    """Integer counts raise an error: a lagging pixel of 1000 counts would wrap to 57,580."""
    counts = np.full((2, 5, 2, 2), 1000, dtype=np.uint16)
    raw = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts)},
        coords={"band": ["8-14", "9.5"], "time": np.arange(5) / 10.0},
    )
    rng = np.random.default_rng(0)
    arguments = {
        "fire_shutter": ([0.2], rng),
        "spoil_pixels": (0.1, rng),
        "lag": (0.05,),
    }
    with pytest.raises(TypeError, match="uint16 of 'counts'"):
        getattr(simulation, name)(raw, *arguments[name])
