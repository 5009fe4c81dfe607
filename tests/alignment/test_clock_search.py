"""Search of the clocks of several bands, by delays that are stated."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal.alignment import _joint as joint
from dbthermal.alignment._reflections import Scale

FRAME = 0.1  # [s]


def clocks_tried(
    monkeypatch: pytest.MonkeyPatch, start: list[float], seen: Callable[[float], tuple[float, int]]
) -> tuple[list[float], list[float], float]:
    """Offsets found, from those that what moves one way tells; those tried; their uncertainty.

    All in frames. By an offset of the other bands a camera is seen late, and one is the reference.
    """
    bands, tried = ["8-14", "9.5", "more"][: len(start)], list[float]()
    together = xr.DataArray(np.zeros(len(bands)), {"band": bands}, "band")
    counts = ("band", "time", "y", "x"), np.zeros((len(bands), 40, 1, 1), np.float32)
    small = xr.Dataset({"counts": counts}, {"band": bands, "time": FRAME * np.arange(40)})

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


def test_clocks_of_three_bands_and_of_either_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Other bands move together; the band that is interpolated may be the quietest then."""
    found, *_ = clocks_tried(monkeypatch, [0.0, 0.9, -1.0], lambda clock: (0.2 - clock, 0))
    np.testing.assert_allclose(found, [0.0, 1.15, -0.75], atol=0.02)

    def seen(clock: float) -> tuple[float, int]:
        return (0.45 - clock, 0) if abs(clock - round(clock)) > 0.15 else (clock - 0.45, 1)

    (_, late), *_ = clocks_tried(monkeypatch, [0.0, -0.3], seen)
    assert abs(late - 0.45) < 0.02
