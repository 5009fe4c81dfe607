"""Pictures that are scaled anew in each frame, as the published videos are: their scale undone."""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import schema
from dbthermal._coordinates import laid_on

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

_FEWEST: Final = 200  # still pixels
# Share of the variance of still surroundings over time that their scale must explain.
_EXPLAINED: Final = 0.9
_ROUNDS: Final = 20
_TINY: Final = np.finfo(np.float64).tiny


def unscaled(signal: xr.DataArray, still: xr.DataArray) -> xr.DataArray:
    r"""Undo the scale of each frame of two pictures, from surroundings that do not change.

    A picture that is scaled anew in each frame shows still surroundings :math:`s(p)` as
    :math:`o(t) + g(t) s(p)`. Offset and gain are fitted robustly, with Cauchy's weights [1]_ by
    each pixel's residual over time. A band where they explain less than 90 % of the weighted
    variance over time stays as it is.

    Parameters
    ----------
    signal : DataArray
        (band, time, y, x), two bands in units of their own.
    still : DataArray of bool
        Pixels (y, x) off the object; a third of them may change after all.

    Returns
    -------
    DataArray
        The signal, in units of its mean over time; the coordinate `gain` (band, time) [1], by which
        the noise was divided, 1 in a band that is not undone. Attributes `scale_undone`, the bands
        that are, and `scale_explained`, each band's explained share.

    Raises
    ------
    ValueError
        If dims or bands are wrong, a value is not finite, or fewer than 200 pixels are still.

    References
    ----------
    .. [1] Holland, Welsch (1977), doi:10.1080/03610927708827533

    Examples
    --------
    A still picture whose contrast is scaled down to a tenth:

    >>> gain, wall = np.linspace(1, 0.1, 50)[:, np.newaxis, np.newaxis], np.ones((20, 40))
    >>> wall[:, :20] = 2.0
    >>> signal = xr.DataArray([gain * wall] * 2, dims=("band", "time", "y", "x"))
    >>> undone = unscaled(signal, xr.ones_like(signal[0, 0], dtype=bool))
    >>> bool(undone.std("time").max() < 1e-9)
    True
    """
    _check_signal(signal)
    chosen = _pixels(still, signal, "the still pixels")
    if chosen.sum() < _FEWEST:
        raise ValueError(
            f"Invalid still pixels: {chosen.sum()} of them. Must be at least {_FEWEST}."
        )
    result = signal.astype(np.promote_types(signal.dtype, np.float32))
    gains, shares, bands = np.ones(signal.shape[:2]), [], []
    for place, picture in enumerate(signal.values):
        offset, gain, explained = _scale(picture.reshape(len(picture), -1)[:, chosen].astype(float))
        shares.append(round(explained, 4))
        if explained >= _EXPLAINED and gain.min() > 0:
            gains[place] = gain
            bands.append(str(signal["band"].values[place]))
            result[place] = ((picture.T - offset) / gain).T
    result = result.assign_coords(gain=(("band", "time"), gains, {"units": "1"}))
    return result.assign_attrs(scale_undone=bands, scale_explained=shares)


def _scale(values: Array) -> tuple[Array, Array, float]:
    """Offset (time), gain (time) and explained share of still pixels (time, pixel)."""
    mean = values.mean(axis=0)
    change = values - mean
    squares = np.einsum("tp,tp->p", change, change)
    weight = np.ones(mean.size)
    for _ in range(_ROUNDS):
        # Exact: o + g s - mean is linear in the mean, as mean = mean(o) + mean(g) s.
        offset, error = _frame_errors(change, mean, weight)
        # sum_t (c - o - e m)^2, from products over time alone
        power = squares - 2.0 * (offset @ change + mean * (error @ change))
        power += offset @ offset + mean * (2.0 * (offset @ error) + mean * (error @ error))
        weight = 1.0 / (1.0 + np.maximum(power, 0.0) / max(np.median(power), _TINY))
    explained = 1.0 - float(weight @ power) / max(float(weight @ squares), _TINY)
    return offset, 1.0 + error, explained


def _frame_errors(change: Array, mean: Array, weight: Array | Mask) -> Array:
    """Offset and gain error (2, time) of frames that are the change (time, pixel) of some."""
    centre = weight @ mean / weight.sum()
    contrast = weight * (mean - centre)
    gain = change @ contrast / max(contrast @ (mean - centre), _TINY)
    return np.stack([change @ weight / weight.sum() - gain * centre, gain])


def _check_signal(signal: xr.DataArray) -> None:
    if signal.dims != ("band", "time", "y", "x") or signal.sizes["band"] != 2:
        raise ValueError(
            f"Invalid signal {dict(signal.sizes)}. Must be (band, time, y, x) of two bands."
        )
    if not np.all(schema.measured(signal.values)):
        raise ValueError(
            f"Invalid signal: NaN or infinite, or beyond {schema.LARGEST:g}. Must be finite."
        )


def _pixels(mask: xr.DataArray, signal: xr.DataArray, label: str) -> Mask:
    """Pixels (pixel) of a map of the signal's."""
    if mask.dims != ("y", "x"):
        raise ValueError(f"Invalid dims {mask.dims} of {label}. Must be ('y', 'x').")
    return np.asarray(laid_on(mask, signal, label, "the signal").values.astype(bool).ravel())
