"""Bad pixels: noisy, blinking and stuck ones are marked, edges and shutter events are not."""

import re

import numpy as np
import pytest
import xarray as xr
from captures import still, walkers

from dbthermal import schema, simulation
from dbthermal.correction import mark_bad, mark_shutter

DEAD = schema.Status.DEAD_PIXEL


@pytest.mark.parametrize("seed", range(2))
def test_bad_pixels_are_found(seed: int) -> None:
    """Noisy, blinking and stuck pixels are marked; walkers and edges of materials are not."""
    capture = walkers(seed)
    false = float((mark_bad(capture)["status"] != 0).mean())
    spoiled = simulation.spoil_pixels(capture, 0.005, np.random.default_rng(seed))
    marked = mark_bad(spoiled)["status"].values == DEAD
    kinds = spoiled["spoiled"].max("band").values
    rates = [float(marked[kinds == kind].mean()) for kind in range(len(simulation.SPOILED))]
    print(f"false alarms {false:.1e}; {dict(zip(simulation.SPOILED, rates, strict=True))}")
    assert false < 1e-4
    assert rates[0] < 5e-4
    assert min(rates[1:]) >= 0.95


def test_fast_frames_are_no_bad_pixels() -> None:
    """At 60 Hz the slow edge of a silhouette is not marked as a blinking pixel."""
    false = [float((mark_bad(walkers(n, rate=60.0))["status"] != 0).mean()) for n in (2, 4)]
    print(f"false alarms at 60 Hz {false}")
    assert np.mean(false) < 1e-4


def test_shutter_makes_no_bad_pixel() -> None:
    """New offsets after a known shutter event are not marked as blinking pixels."""
    capture = simulation.fire_shutter(walkers(1), 17.0, np.random.default_rng(4))
    assert float((mark_bad(capture)["status"] != 0).mean()) > 0.01
    marked = mark_bad(mark_shutter(capture))
    assert not marked["status"].any()
    assert marked.attrs["jumping_pixels"] == 0


def test_bad_pixels_are_added_to_the_status() -> None:
    """Bits that were set stay, the counts stay, the input stays, and numbers are written."""
    capture = still()
    capture["counts"].values[1, :, 5, 6] = 16000.0
    before = capture.assign(status=(("y", "x"), np.full((20, 24), 128, dtype=np.uint16)))
    kept = before.copy(deep=True)
    marked = mark_bad(before)
    xr.testing.assert_identical(before, kept)
    xr.testing.assert_identical(marked["counts"], before["counts"])
    np.testing.assert_array_equal(np.argwhere(marked["status"].values != 128), [[5, 6]])
    assert marked["status"].values[5, 6] == 128 | DEAD
    names = ("noisy_pixels", "jumping_pixels", "bad_threshold")
    assert [marked.attrs[name] for name in names] == [1, 0, 6.0]


def test_bad_pixels_refuse_nonsense() -> None:
    """Too few frames and an invalid threshold raise a ValueError."""
    capture = still()
    with pytest.raises(ValueError, match=re.escape("Invalid band '8-14' of 15 frames")):
        mark_bad(capture.isel(time=slice(15)))
    with pytest.raises(ValueError, match="Invalid threshold 0 of bad pixels"):
        mark_bad(capture, threshold=0)
