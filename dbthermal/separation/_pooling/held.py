"""Pooled pixels held to what each tells alone: values replaced, or deviations widened."""

from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, maximum_filter, median_filter, minimum_filter

from dbthermal._arrays import release
from dbthermal.schema import Status
from dbthermal.separation._tiles import Array, Mask

# Pixels on either side of which a resampled one is made; single ones in a material are no border.
_REACH: Final = 2
_SINGLE: Final = 3
# Deviation of a pooled ratio over that of the pixel alone, from which pooling hardly helps [1].
_HARDLY: Final = 0.5
# Share of gray pixels from which their material is [1].
_MOSTLY: Final = 0.5
# Square of the difference in deviations that is no chance, of a pixel and of those around [1].
_MORE: Final = 4.0
_MORE_AROUND: Final = 1.5
# Deviation of the neighbourhood that shares such errors [pixel], and its least weight [1].
_AROUND: Final = 1.5
_SOME: Final = 1e-3
_FRAMES: Final = 64  # about as many tell how much an object differs


def hold(
    alone: xr.Dataset, pooled: xr.Dataset, labels: xr.DataArray, *, apart: bool = True
) -> None:
    """Replace pooled values, or widen their deviations, where they contradict the pixel alone.

    A pixel alone has the ratio that its own changes show, with errors of how the cameras are
    paired, or of what is mixed at an edge, in it; at the ratio of its material they are left in the
    object. Where pooling is right, the two differ by no more than the deviation of the pixel alone.

    One stays alone without a label, where only alone it has no flag, and where most pixels of its
    material are gray, pooled, too: the others are not by chance. Of cameras `apart` also where
    pooling hardly makes its ratio more certain, and at the border of its material. With D the mean
    square of the difference of the objects in deviations of a pixel alone, its own or that around,
    the pooled variance is larger by D times that of the pixel alone, if that is no chance; of one
    that tells nothing alone, by as much as around. At one place this does not hold for a material
    most of whose moving pixels are gray alone: its others are selected by their noise.
    """
    sound, told = (one["status"].values == 0 for one in (alone, pooled))
    stay = sound & (~told | (labels.values < 0))
    if apart:
        ratios = [one["reflection_ratio_std"].values for one in (pooled, alone)]
        stay |= sound & (_border(labels.values) | np.any(ratios[0] > _HARDLY * ratios[1], axis=0))
    gray, gray_alone, still = (
        (one["status"].values & np.uint32(flag)) != 0
        for one, flag in (
            (pooled, Status.GRAY),
            (alone, Status.GRAY),
            (alone, Status.NO_BACKGROUND_MOTION),
        )
    )
    stay |= _share(labels.values, gray) > _MOSTLY
    both, single = sound & told & ~stay, alone["object_temperature_std"].values
    if not apart:
        both &= _share(np.where(still, -1, labels.values), gray_alone) <= _MOSTLY
    films = [one["object_temperature"].values for one in (pooled, alone)]
    square, variance = np.zeros((2, *both.shape))
    every = slice(None, None, max(1, len(single) // _FRAMES))
    for row, here in enumerate(sound & told):
        value, other, std = (film[every, row, here].astype(np.float64) for film in (*films, single))
        square[row, here] = np.nanmean(((value - other) / std) ** 2, axis=0)
        variance[row, here] = np.nanmean(std**2, axis=0)
        release()
    local = np.where(both, _around(square, both), 0.0)
    more = both & ((square > _MORE) | (local > _MORE_AROUND))
    square = np.where(more, np.maximum(square, local), 1.0 * (stay & sound))
    constant = np.where(told & ~sound, _around(square * variance, both | (stay & sound)), 0.0)
    factor, film = square * both, pooled["object_temperature_std"].values
    maps = [(pooled[name].values, part.values) for name, part in alone.items() if "x" in part.dims]
    wider = (factor > 0) | (constant > 0)
    for row in map(int, np.flatnonzero((wider | stay).any(axis=1))):
        here, alike = np.flatnonzero(wider[row]), np.flatnonzero(stay[row])
        added = factor[row, here] * np.nan_to_num(single[:, row, here]) ** 2 + constant[row, here]
        film[:, row, here] = np.sqrt(film[:, row, here] ** 2 + added)
        for target, part in maps:
            target[..., row, alike] = part[..., row, alike]
        release()


def _share(labels: Array, holds: Mask) -> Array:
    """Share (y, x) of the pixels of each one's material for which something holds; 0 without."""
    numbers = np.unique(labels, return_inverse=True)[1].ravel()
    share = np.bincount(numbers, holds.ravel()) / np.bincount(numbers)
    return np.where(labels >= 0, share[numbers].reshape(labels.shape), 0.0)


def _border(labels: Array) -> Mask:
    """Pixels (y, x) at the border of a material."""
    whole, size = median_filter(labels, _SINGLE, mode="nearest"), 1 + 2 * _REACH
    return np.asarray(minimum_filter(whole, size) < maximum_filter(whole, size))


def _around(values: Array, known: Mask) -> Array:
    """Mean (y, x) of the known pixels around."""
    sums = [gaussian_filter(part, _AROUND) for part in (np.where(known, values, 0.0), known * 1.0)]
    return np.asarray(sums[0] / np.maximum(sums[1], _SOME))
