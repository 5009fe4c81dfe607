"""Pooled pixels of cameras side by side, held to what each of them tells alone."""

import numpy as np
import xarray as xr

from dbthermal.schema import Status
from dbthermal.separation._pooling.held import hold

SHAPE, FRAMES = (40, 48), 30
SINGLE, TOGETHER = 0.2, 0.03
"""Deviations of the object of a pixel alone, and pooled [K]."""
PATCH = (slice(8, 12), slice(12, 16))
"""Pixels whose object is wrong when it is pooled."""
OFF = 1.0
TO_95 = 1.96


def result(error: np.ndarray, std: float, ratio_std: float) -> xr.Dataset:
    """Result whose object has some errors (y, x) [K], all of one deviation."""
    film, image = ("time", "y", "x"), ("band", "y", "x")
    ratios = np.stack([np.zeros(SHAPE), np.full(SHAPE, ratio_std)])
    return xr.Dataset(
        {
            "object_temperature": (film, np.float32(300.0 + error + np.zeros((FRAMES, 1, 1)))),
            "object_temperature_std": (film, np.full((FRAMES, *SHAPE), std, np.float32)),
            "reflection_ratio_std": (image, ratios.astype(np.float32)),
            "status": (("y", "x"), np.zeros(SHAPE, np.uint32)),
        }
    )


def drawn() -> tuple[xr.Dataset, xr.Dataset, xr.DataArray]:
    """Pixels alone, pooled ones of which a patch is wrong, and labels of one material."""
    rng = np.random.default_rng(5)
    single = result(rng.normal(0.0, SINGLE, SHAPE), SINGLE, 0.1)
    error = rng.normal(0.0, TOGETHER, SHAPE)
    error[PATCH] += OFF
    labels = xr.DataArray(np.ones(SHAPE, np.int32), dims=("y", "x"))
    return single, result(error, TOGETHER, 0.01), labels


def test_what_pooling_leaves_in_the_object_is_in_its_deviation() -> None:
    """Five deviations of a pixel alone off: the bar holds it; elsewhere it stays what it was."""
    single, pooled, labels = drawn()
    single["status"].values[9, 13] = int(Status.GRAY)  # tells nothing alone
    single["object_temperature"].values[:, 9, 13] = np.nan
    hold(single, pooled, labels)
    error = abs(pooled["object_temperature"] - 300.0).values
    std = pooled["object_temperature_std"].values
    assert (error < TO_95 * std)[:, *PATCH].all()
    far = np.ones(SHAPE, dtype=bool)
    far[4:16, 8:20] = False
    grown = std[0][far] > 1.01 * TOGETHER
    print(f"in the patch {std[0][PATCH].mean():.2f} K, grown elsewhere {grown.mean():.3f}")
    assert grown.mean() < 0.1  # of chance: 4.6 % by a pixel itself, 3 % by those around
    np.testing.assert_allclose(std[0][far][~grown], TOGETHER, rtol=1e-4)


def test_pixels_that_pooling_does_not_help_stay_alone() -> None:
    """Without a label, flagged, hardly more certain, or at a border: bit for bit as alone."""
    single, pooled, labels = drawn()
    before = pooled.copy(deep=True)
    labels[20, 20] = -1
    labels[:, 40:] = 2
    pooled["status"].values[24, 20] = int(Status.GRAY)
    pooled["reflection_ratio_std"].values[1, 28, 20] = 0.08
    pooled["status"].values[32, 20] = single["status"].values[32, 20] = int(Status.GRAY)
    hold(single, pooled, labels)
    stay = np.zeros(SHAPE, dtype=bool)
    stay[[20, 24, 28], 20] = True
    stay[:, 38:42] = True
    for name in ("object_temperature", "object_temperature_std", "status"):
        np.testing.assert_array_equal(
            pooled[name].values[..., stay], single[name].values[..., stay]
        )
    assert pooled["status"].values[32, 20] == int(Status.GRAY)  # neither way
    kept = ~stay
    for name in ("object_temperature", "reflection_ratio_std"):
        others = pooled[name].values[..., kept], before[name].values[..., kept]
        assert np.mean(np.equal(*others)) > 0.99
