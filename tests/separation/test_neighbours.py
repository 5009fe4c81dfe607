"""Ratios of bands that are blurred alike: as certain as neighbours agree on them."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from test_displaced import RIG, TIME, field

from dbthermal.schema import Status
from dbthermal.separation import _inputs as inputs
from dbthermal.separation import _quality as quality
from dbthermal.separation._apart import displaced, neighbours
from dbthermal.separation._solve import get_method
from reproduction.experiments.pictures import smooth_shift

SHAPE = (48, 64)


@pytest.fixture(scope="module")
def noise() -> xr.Dataset:
    """Capture of white noise alone, 10 counts in both bands."""
    counts = np.random.default_rng(3).normal(20000.0, 10.0, (2, 300, *SHAPE))
    places = {"band": list(RIG.bands), "time": TIME}
    return xr.Dataset({"counts": (("band", "time", "y", "x"), counts, {"units": "count"})}, places)


def test_noise_of_blurred_bands_is_stated(noise: xr.Dataset) -> None:
    """Resampled, then blurred alike, beside a dead pixel too: the noise is what is said of it."""
    moved = displaced.check(field(smooth_shift(SHAPE, 2.5, 0.5)), noise, 0)
    moved = replace(moved, blur=neighbours.BLUR)
    counts = noise["counts"].copy()
    counts[1, :, 20, 30] = np.nan
    capture = noise.assign(counts=counts)
    rows = slice(16, 28)
    source = moved.source(rows)
    args = (1, quality.grains(capture))
    got, _, status, gain = displaced.read(capture.isel(y=source), moved, rows, source, *args)
    usable = ~quality.unusable(status)
    ratio = got.std(axis=1)[:, usable] / (10.0 * gain[:, usable])
    print(f"noise over what is said: {ratio.mean(axis=1)} +- {ratio.std(axis=1)}")
    assert np.all(gain[:, usable] < 0.45)
    np.testing.assert_allclose(ratio.mean(axis=1), 1.0, rtol=0, atol=0.02)
    assert np.all(ratio.std(axis=1) < 0.06)  # of 300 frames: 0.04
    np.testing.assert_allclose(got[:, :, usable].mean(), 20000.0, rtol=0, atol=0.1)


def test_ratios_are_as_certain_as_neighbours_agree(noise: xr.Dataset) -> None:
    """Scattered by three times what is said: said so. Bands apart: the ratio of those around."""
    rng, said, true = np.random.default_rng(1), 0.02, 2.0
    ratio = np.ones((2, *SHAPE))
    ratio[1] = rng.normal(true, 3.0 * said, SHAPE)
    std = np.stack([np.zeros(SHAPE), np.full(SHAPE, said)])
    status = np.zeros(SHAPE, dtype=np.uint32)
    status[24, 32], ratio[1, 24, 32] = Status.BANDS_APART, 4.0
    status[24, 40], ratio[1, 24, 40] = Status.GRAY, 1.0
    image = ("band", "y", "x")
    result = xr.Dataset(
        {
            "reflection_ratio": (image, ratio),
            "reflection_ratio_std": (image, std),
            "status": (("y", "x"), status),
        }
    )
    options = {"emissivity": None, "emissivity_std": None, "mask": None, "pool": None}
    moved = field(smooth_shift(SHAPE, 2.5, 0.5))
    response = RIG.response()
    checked = inputs.check(
        noise,
        response.assign(noise=response["noise"].copy(data=[10.0, 10.0])),  # [count]
        get_method("subspace"),
        "subspace",
        settings=None,
        seed=0,
        response_kind="exact",
        reflection_shift=moved,
        **options,
    )
    material = neighbours.ratios(checked, result)
    level = checked.noise[checked.bands]
    error = level[1] ** 2 + (material.ratio[1] * level[0]) ** 2
    found = np.sqrt(material.inverse_energy * error).reshape(SHAPE)
    plain = status == 0
    np.testing.assert_array_equal(material.ratio[1].reshape(SHAPE)[plain], ratio[1][plain])
    print(f"deviation {np.median(found[plain]):.4f}, beside bands apart {found[24, 32]:.4f}")
    np.testing.assert_allclose(found[plain], 3.0 * said, rtol=0, atol=0.6 * said)
    np.testing.assert_allclose(found[24, 32], 3.0 * said, rtol=0, atol=0.6 * said)
    np.testing.assert_allclose(material.ratio[1].reshape(SHAPE)[24, 32], true, rtol=0, atol=said)
    assert np.isnan(material.ratio[1].reshape(SHAPE)[24, 40])  # another flag: none
    assert neighbours.blurred(checked) is not None


def test_emissivities_are_as_certain_as_neighbours_agree() -> None:
    """Scattered by three times what is said: said so; what is not known takes those around."""
    rng, said, true = np.random.default_rng(2), 0.002, 0.86
    value, known = rng.normal(true, 3.0 * said, SHAPE[0] * SHAPE[1]), np.ones(SHAPE, dtype=bool)
    known[20, 30] = False
    hidden = ~known.ravel()
    value[hidden] = 0.4
    got, variance = neighbours.shared(value, np.full(value.size, said**2), known.ravel(), SHAPE)
    ratio = np.sqrt(variance[~hidden]) / (3.0 * said)
    print(f"stated over true: {ratio.mean():.3f}, from {ratio.min():.2f} to {ratio.max():.2f}")
    assert abs(ratio.mean() - 1.0) < 0.05
    np.testing.assert_allclose(got[hidden], true, rtol=0, atol=3.0 * said)
    np.testing.assert_allclose(variance[hidden], (3.0 * said) ** 2, rtol=0.3)
    assert got[~hidden].std() < 0.8 * value[~hidden].std()
