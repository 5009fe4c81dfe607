"""Inputs of a separation: the user's arguments as checked arrays."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import separation
from dbthermal.separation import _inputs
from dbthermal.simulation import Rig

RIG = Rig()
SHAPE = (2, 40, 3, 4)  # band, time, y, x


def capture() -> xr.Dataset:
    """Counts of noise about 20000."""
    counts = 20000.0 + np.random.default_rng(1).standard_normal(SHAPE)
    coordinates = {"band": list(RIG.bands), "time": np.arange(40) / 10.0}
    dims = ("band", "time", "y", "x")
    return xr.Dataset({"counts": (dims, counts, {"units": "count"})}, coords=coordinates)


def checked(method: str = "subspace", **known: object) -> _inputs.Inputs:
    """Inputs of a method."""
    omitted = ("settings", "emissivity", "emissivity_std", "mask", "pool", "reflection_shift")
    none = dict.fromkeys(omitted)
    given: dict[str, object] = {**none, "seed": 0, "response_kind": "exact", **known}
    record = separation.get_method(method)
    return _inputs.check(capture(), RIG.response(), record, method, **given)  # type: ignore[arg-type]


def test_noise_is_that_of_the_response() -> None:
    """Counts over the slope at the reference, and the bands in its order."""
    inputs = checked()
    np.testing.assert_allclose(inputs.noise, RIG.noise[:2], rtol=1e-12)
    assert inputs.bands == [0, 1]
    assert inputs.settings == separation.SubspaceSettings()


@pytest.mark.parametrize("dims", [("band",), ("band", "y", "x")])
def test_emissivity_is_spread_over_the_image(dims: tuple[str, ...]) -> None:
    """Emissivities are matched by band name; without a deviation it is zero."""
    values = np.array([0.7, 0.8]).reshape(2, *(1,) * (len(dims) - 1))
    shape = tuple(SHAPE[("band", "time", "y", "x").index(dim)] for dim in dims)
    names = {"band": list(RIG.bands)[::-1]}
    given = xr.DataArray(np.broadcast_to(values, shape), dims=dims, coords=names)
    inputs = checked("calibrated", emissivity=given)
    assert inputs.emissivity is not None
    assert inputs.emissivity.shape == (2, 3, 4)
    np.testing.assert_array_equal(inputs.emissivity[:, 0, 0], [0.8, 0.7])
    np.testing.assert_array_equal(inputs.emissivity_covariance, 0.0)


def test_labels_are_numbered_without_gaps() -> None:
    """Any whole numbers name materials; pixels with a negative one are not pooled."""
    pool = np.array([[7, 7, 100, -5], [7, 100, 100, -1], [40, 40, 40, 40]])
    inputs = checked(pool=xr.DataArray(pool, dims=("y", "x")))
    np.testing.assert_array_equal(inputs.labels, [0, 0, 2, -1, 0, 2, 2, -1, 1, 1, 1, 1])


def test_mask_is_kept_beside_the_counts() -> None:
    """A mask of frames is kept in the capture, and unused variables are dropped."""
    inputs = checked(mask=xr.DataArray(np.arange(40) > 3, dims="time"))
    assert set(map(str, inputs.capture)) == {"counts", "mask"}
    assert int(inputs.capture["mask"].sum()) == 36
