"""Parts of the alignment, each against a closed form or a behaviour that is known."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import plain_capture
from scipy.special import expit

from dbthermal import alignment, schema
from dbthermal.alignment import _joint as joint
from dbthermal.alignment._planes import Scale

FRAME = 0.1  # [s]


def clocks_tried(
    monkeypatch: pytest.MonkeyPatch, start: list[float], seen: Callable[[float], tuple[float, int]]
) -> tuple[list[float], list[float], float]:
    """Offsets found, from those that what moves one way tells; those tried; their uncertainty.

    All in frames. By an offset of the other bands a camera is seen late, and one is the reference.
    """
    bands, tried = ["8-14", "9.5", "more"][: len(start)], list[float]()
    together = xr.DataArray(np.zeros(len(bands)), {"band": bands}, "band")
    small = plain_capture(np.zeros((len(bands), 40, 1, 1), np.float32), bands=bands)

    def resample(_: xr.Dataset, offset: xr.DataArray | None = None, **__: Any) -> xr.Dataset:
        own = FRAME * np.array(start) if offset is None else offset.values
        return xr.Dataset(attrs={"time_offset": own.tolist()})

    def shift(aligned: xr.Dataset, _: object) -> xr.Dataset:
        tried.append(float(np.mean(aligned.attrs["time_offset"][1:])) / FRAME)
        late, reference = seen(tried[-1])
        told = {"delay": late * FRAME, "delay_std": 0.0}
        return xr.Dataset(attrs={"reference_band": bands[reference], **told})

    monkeypatch.setattr(joint, "_shift", shift)
    scale = Scale(np.ones(len(bands)), None)
    offset, _, left = joint._clocked(small, scale, together, resample)
    return (offset.values / FRAME).tolist(), tried, left / FRAME


@pytest.mark.parametrize("start", [-3.6, 0.3, 0.549])
@pytest.mark.parametrize("slope", [0.3, 0.8, 3.0])
def test_clocks_are_found_from_a_poor_start(
    monkeypatch: pytest.MonkeyPatch, start: float, slope: float
) -> None:
    """A delay seen too short or too long, with an error, leads to the clock by which it is none.

    No delay is seen at clocks that are set together, for which these have no reason to be.
    """

    def seen(clock: float) -> tuple[float, int]:
        error = 0.02 * math.sin(5.0 * clock)
        return (0.0 if clock == 0.0 else slope * (0.55 - clock) + error), 0

    (_, found), _, left = clocks_tried(monkeypatch, [0.0, start], seen)
    assert abs(found - 0.55) < 0.02 / slope + 0.02
    assert left < 0.1


def test_clocks_of_three_bands_and_of_either_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other bands move together; the band that is interpolated may be the quietest then."""
    found, *_ = clocks_tried(monkeypatch, [0.0, 0.9, -1.0], lambda clock: (0.2 - clock, 0))
    np.testing.assert_allclose(found, [0.0, 1.15, -0.75], atol=0.02)

    def seen(clock: float) -> tuple[float, int]:
        return (0.45 - clock, 0) if abs(clock - round(clock)) > 0.15 else (clock - 0.45, 1)

    (_, late), *_ = clocks_tried(monkeypatch, [0.0, -0.3], seen)
    assert abs(late - 0.45) < 0.02


def test_a_square_without_some_samples_is_still(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pixel that lacks samples does not step the mean; a bad one and a missing frame count."""
    rng, level = np.random.default_rng(2), np.array([20000.0, 21000.0])[:, None, None, None]
    pattern, change = rng.normal(0.0, 500.0, (2, 1, 6, 9)), rng.normal(0.0, 50.0, (2, 40, 1, 1))
    counts = (level + pattern + change).astype(np.float32)
    counts[1, 10:20, 0, 0] = np.nan  # single samples
    counts[0, 30] = np.nan  # a frame
    counts[0, :, 0:3, 3:6] = np.nan  # a square that one band does not see
    status = np.zeros((6, 9), np.uint32)
    status[4, 4], counts[:, :, 4, 4] = schema.Status.DEAD_PIXEL, 7.0
    corrected = plain_capture(counts, status=(("y", "x"), status))
    monkeypatch.setattr(joint, "_PIXELS", 6)
    small = joint._of_squares(corrected)
    values, blind = small["counts"].values, np.zeros((2, 3), dtype=bool)
    blind[0, 1] = True
    np.testing.assert_array_equal(small["status"] != 0, blind)
    assert np.isnan(values[:, :, blind]).all()
    there = np.arange(40) != 30
    assert np.isnan(values[0, 30]).all()
    seen = values[:, there][:, :, ~blind]
    off = seen - seen[:, :1] - (change[:, there, 0] - change[:, :1, 0])
    assert np.abs(off).max() < 10.0
    assert np.abs(off[..., 1:]).max() < 0.02


@pytest.mark.parametrize("clock", ["8-14", "9.5"])
def test_rapid_changes_keep_their_size_between_frames(clock: str) -> None:
    """Half-way, pulses of three frames are as large in the interpolated band as in the other."""
    rng, film = np.random.default_rng(1), np.zeros((2, 300, 1024))
    time = np.arange(300.0)[:, np.newaxis] + [[[0.0]], [[0.5]]]
    for start in rng.uniform(0.0, 300.0, (30, 1024)):
        pulse = expit((time - start) / 0.2) - expit((time - start - 3.0) / 0.2)
        film += rng.uniform(5.0, 15.0, 1024) * pulse * [[[1.0]], [[4.0]]]
    film += rng.standard_normal(film.shape) * [[[2.0]], [[20.0]]]
    capture = plain_capture(film.reshape(2, 300, 32, 32), time[0, :, 0])
    aligned = alignment.align(capture, offset=0.5, clock=clock)
    values, noise = aligned["counts"].values.reshape(2, -1), aligned["noise_factor"] * [2.0, 20.0]
    (first, product), (_, second) = np.cov(values[:, np.isfinite(values).all(axis=0)])
    first, second = np.array([first, second]) - noise.values**2
    ratio = product / first if clock == "9.5" else second / product
    assert ratio == pytest.approx(4.0, rel=0.015)
