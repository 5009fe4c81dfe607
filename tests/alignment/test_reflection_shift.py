"""Shift of the reflections between two cameras side by side, against simulated truth."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import alignment, schema, simulation
from reproduction.experiments.pictures import Picture, smooth_shift

RIG = simulation.Rig()
RESPONSE = RIG.response()
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
TIME = np.arange(300) / 10.0


def drawn(
    seed: int, shift: tuple[float, float], picture: Picture | None = None
) -> tuple[xr.Dataset, np.ndarray]:
    """Capture of people mirrored in glass, and the true shift (2, y, x) [pixel]."""
    picture, rng = picture or Picture(), np.random.default_rng(seed)
    true = smooth_shift(picture.shape, *shift)
    scene = picture.draw(TIME, GLASS, rng, true)
    return simulation.observe(scene, RESPONSE, rng), true


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.4, 1.2)])
def test_finds_a_smooth_field(shift: tuple[float, float]) -> None:
    """Along the baseline the field is right to a few hundredths of a pixel."""
    capture, true = drawn(21, shift)
    field = alignment.reflection_shift(capture, RESPONSE)
    schema.check(field, "reflection_shift")
    error = np.abs(field["shift"].values - true)[1][field["known"].values]
    print(f"shift {shift}: median error {np.median(error):.3f} pixel, {error.size} pixels")
    assert error.size > 0.8 * true[0].size
    assert np.median(error) < 0.03
    assert field.attrs["reference_band"] == "8-14"
    assert field.attrs["bands"] == ["9.5"]
