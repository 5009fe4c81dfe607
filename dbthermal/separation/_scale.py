"""Scale of a picture's frames: gain and offset of each, and what undoes them."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal._coordinates import laid_on

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

FEWEST: Final = 100
"""Fewest pixels that a statistic is taken from."""

# Share of the surroundings' variance in time that their scale must explain: with less, their own
# changes or the noise would be taken for a scale.
_EXPLAINED: Final = 0.9
_ROUNDS: Final = 20


def check_signal(signal: xr.DataArray) -> None:
    """Refuse all but two finite movies."""
    if signal.dims != ("band", "time", "y", "x") or signal.sizes["band"] != 2:
        raise ValueError(
            f"Invalid signal {dict(signal.sizes)}. Must be (band, time, y, x) of two bands."
        )
    if not np.all(schema.measured(signal.values)):
        raise ValueError(
            f"Invalid signal: NaN or infinite, or beyond {schema.LARGEST:g}. Must be finite."
        )


def pixels_of(mask: xr.DataArray, signal: xr.DataArray, label: str = "the mask") -> Mask:
    """Pixels (pixel) of a map (y, x) of the signal's."""
    if mask.dims != ("y", "x"):
        raise ValueError(f"Invalid dims {mask.dims} of {label}. Must be ('y', 'x').")
    return np.asarray(laid_on(mask, signal, label, "the signal").values.astype(bool).ravel())


def frame_errors(change: Array, mean: Array, pixels: Mask) -> Array:
    """
    Offset and gain error (2, time) of each frame, fitted to pixels whose changes are errors.

    The change (time, pixel) is that from the true curve, the mean (pixel) that over time.
    """
    centre = mean[pixels].mean()
    spread = np.where(pixels, mean - centre, 0.0)
    gain = change @ spread / np.maximum(np.sum(spread**2), np.finfo(np.float64).tiny)
    offset = change @ pixels / pixels.sum() - gain * centre
    return np.stack([offset, gain])


def unscaled(signal: xr.DataArray, still: xr.DataArray) -> xr.DataArray:
    r"""
    Undo the scale of each frame of two pictures, from surroundings that do not change.

    A picture that is scaled anew in each frame, as between its extremes, shows still surroundings
    :math:`s(p)` as :math:`o(t) + g(t) s(p)`. Offset and gain are fitted to that half of the still
    pixels which leaves the smallest residuals (least trimmed squares [1]_), so that up to half of
    them may move after all. A band is undone only where its scale explains 90 % of the variance
    over time of these pixels: where it is nearly constant, or the surroundings change themselves,
    the band stays as it is.

    Parameters
    ----------
    signal : DataArray
        (band, time, y, x), two bands in units of their own.
    still : DataArray of bool
        Pixels (y, x) off the object, which neither change their temperature nor mirror any change.

    Returns
    -------
    DataArray
        The signal, in units of its mean over time; the coordinate `gain` (band, time) [1], by which
        the noise was divided, 1 in a band that is not undone. Attributes `scale_undone`, the names
        of the bands that are, and `scale_explained`, each band's explained share of the variance.

    Raises
    ------
    ValueError
        If dims or bands are wrong, a value is not finite, or fewer than 200 pixels are still.

    References
    ----------
    .. [1] Rousseeuw (1984), doi:10.1080/01621459.1984.10477105

    Examples
    --------
    A wall beside an object that heats up, each frame scaled between its own extremes:

    >>> rng, time = np.random.default_rng(1), np.arange(50)[:, np.newaxis, np.newaxis]
    >>> wall = np.broadcast_to(np.linspace(20, 22, 40), (50, 20, 40))
    >>> scene = np.where(np.arange(40) < 20, wall, wall + time) + rng.normal(0, 0.01, wall.shape)
    >>> low, high = (part(scene, axis=(1, 2), keepdims=True) for part in (np.min, np.max))
    >>> picture = xr.DataArray([(scene - low) / (high - low)] * 2, dims=("band", "time", "y", "x"))
    >>> still = xr.DataArray(np.broadcast_to(np.arange(40) < 20, (20, 40)), dims=("y", "x"))
    >>> undone = unscaled(picture, still)
    >>> heated = (undone[0, :, :, 20:] - undone[0, :, :, :20]).mean(("y", "x"))  # [wall contrasts]
    >>> round(float(heated[-1] - heated[0]) / float(heated[24] - heated[0]), 1)  # 49 K to 24 K
    2.0
    """
    check_signal(signal)
    candidates = pixels_of(still, signal, "the still pixels")
    if candidates.sum() < 2 * FEWEST:
        raise ValueError(
            f"Invalid still pixels: {candidates.sum()} of them. Must be at least {2 * FEWEST}."
        )
    result, gains, shares = signal.copy(), np.ones(signal.shape[:2]), []
    for place, picture in enumerate(signal.values):
        values = picture.reshape(len(picture), -1)[:, candidates].astype(np.float64)
        offset, gain, explained = _scale(values)
        shares.append(round(explained, 4))
        if explained >= _EXPLAINED and gain.min() > 0:
            gains[place] = gain
            undone = (picture - offset[:, np.newaxis, np.newaxis]) / gain[:, np.newaxis, np.newaxis]
            result[place] = undone
    names = signal["band"].values
    bands = [str(name) for name, gain in zip(names, gains, strict=True) if np.any(gain != 1.0)]
    return result.assign_coords(gain=(("band", "time"), gains, {"units": "1"})).assign_attrs(
        scale_undone=bands, scale_explained=shares
    )


def _scale(values: Array) -> tuple[Array, Array, float]:
    """Offset (time), gain (time) and explained share of still pixels (time, pixel)."""
    mean = values.mean(axis=0)
    change = values - mean
    squares = np.einsum("tp,tp->p", change, change)
    kept = np.ones(mean.size, dtype=bool)
    for _ in range(_ROUNDS):
        # Exact: o + g s - mean is linear in the mean, as mean = mean(o) + mean(g) s.
        offset, error = frame_errors(change, mean, kept)
        # sum_t (c - o - e m)^2, from products over time alone.
        power = squares - 2.0 * (offset @ change + mean * (error @ change))
        power += offset @ offset + mean * (2.0 * (offset @ error) + mean * (error @ error))
        before, kept = kept, power <= np.median(power)
        if np.array_equal(before, kept):
            break
    total = float(squares[kept].sum())
    explained = 1.0 - float(power[kept].sum()) / total if total > 0 else 0.0
    return offset, 1.0 + error, explained
