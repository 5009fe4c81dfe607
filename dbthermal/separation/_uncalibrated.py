r"""Reflections in two-band video without a calibration, such as published pictures.

Without a response there are no temperatures, but the rapid changes are still the background's, and
their ratio between the bands still tells pixel from pixel. What comes out is in the movies' own
units. The cue is that of `subspace`; the noise is found from pixels in which the bands do not move
together.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _smooth as smooth

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

ORDER: Final = 9
"""Smooth functions of time that hold the object's change."""

CORRELATED: Final = 0.5
"""Correlation of the bands' rapid changes from which a pixel counts as reflecting."""

UNCORRELATED: Final = 0.1
"""Magnitude of the correlation below which a pixel shows noise alone."""

_FEWEST: Final = 100


def reflections(
    signal: xr.DataArray,
    *,
    mask: xr.DataArray | None = None,
    order: int = ORDER,
    correlated: float = CORRELATED,
) -> xr.Dataset:
    r"""
    Separate rapid, correlated changes from slow ones in two bands of any unit.

    The smooth functions are projected out of both bands. Frame by frame, a gain and an offset
    that the picture's own scaling left are then fitted to the uncorrelated pixels and taken out.
    With :math:`\lambda` the noise variance of the second band over that of the first there, the
    ratio k of a pixel is that of Deming's regression, the pooled ratio is its median over the
    correlated pixels, and the reflection in the first band's unit is the best linear estimate

    .. math:: r(t) = \frac{r_1(t) + (k / \lambda) \, r_2(t)}{1 + k^2 / \lambda}

    Parameters
    ----------
    signal : DataArray
        (band, time, y, x), two bands in units of their own, `time` [s].
    mask : DataArray, optional
        (y, x), where the object is; everywhere if not given.
    order : int
        Number of smooth functions.
    correlated : float
        Correlation from which a pixel enters the pooled ratio.

    Returns
    -------
    Dataset
        `ratio`, `correlation` (y, x) [1]; `reflection` (time, y, x) and `emission` (time, y, x),
        the first band less the reflection, in the first band's unit; attributes `pooled_ratio`,
        `noise_ratio`, `correlated_pixels`, and those of the signal.

    Raises
    ------
    ValueError
        If dims are wrong, a value is not finite, there are not two bands, the correlation is not
        in (0, 1), or fewer than 100 pixels are uncorrelated or correlated.

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), doi:10.48550/arXiv.2509.11334, equation 22
    .. [2] Fuller (1987), Measurement Error Models, doi:10.1002/9780470316665
    """
    inside = _check(signal, mask, correlated)
    frames = signal.sizes["time"]
    values = signal.values.reshape(2, frames, -1).astype(np.float64)
    functions = smooth.polynomial_basis(signal["time"].values, order)
    rapid = np.stack([part - functions @ (functions.T @ part) for part in values])
    quiet = inside & (np.abs(_correlation(rapid)) < UNCORRELATED)
    _require(quiet, f"correlation below {UNCORRELATED} in magnitude")
    rapid -= [_scaling(*parts, quiet) for parts in zip(rapid, values.mean(axis=1), strict=True)]
    correlation = _correlation(rapid)
    quiet = inside & (np.abs(correlation) < UNCORRELATED)
    moving = inside & (correlation > correlated)
    _require(moving, f"correlation above {correlated}")
    power = np.einsum("btp,btp->bp", rapid, rapid)
    noise_ratio = float(power[1, quiet].mean() / power[0, quiet].mean())
    ratio = _deming(rapid, power, noise_ratio)
    pooled = float(np.median(ratio[moving]))
    reflection = rapid[0] + pooled / noise_ratio * rapid[1]
    reflection /= 1.0 + pooled**2 / noise_ratio
    shape = signal.shape[1:]
    movie_dims, image_dims = ("time", "y", "x"), ("y", "x")
    own = {"units": signal.attrs["units"]} if "units" in signal.attrs else {}
    return xr.Dataset(
        {
            "ratio": (image_dims, ratio.reshape(shape[1:]), {"units": "1"}),
            "correlation": (image_dims, correlation.reshape(shape[1:]), {"units": "1"}),
            "reflection": (movie_dims, reflection.reshape(shape).astype(np.float32), own),
            "emission": (
                movie_dims,
                (values[0] - reflection).reshape(shape).astype(np.float32),
                own,
            ),
        },
        coords={name: signal[name] for name in movie_dims if name in signal.coords},
        attrs={
            **signal.attrs,
            "pooled_ratio": pooled,
            "noise_ratio": noise_ratio,
            "correlated_pixels": int(moving.sum()),
            "order": order,
        },
    )


def _check(signal: xr.DataArray, mask: xr.DataArray | None, correlated: float) -> Mask:
    """Refuse what is not two movies; return the pixels (pixel) to take the statistics from."""
    if signal.dims != ("band", "time", "y", "x") or signal.sizes["band"] != 2:
        raise ValueError(
            f"Invalid signal {dict(signal.sizes)}. Must be (band, time, y, x) of two bands."
        )
    if not 0 < correlated < 1:
        raise ValueError(f"Invalid correlation {correlated}. Must lie in (0, 1).")
    if not np.all(np.isfinite(signal.values)):
        raise ValueError("Invalid signal: NaN or infinite. Must be finite.")
    image = (signal.sizes["y"], signal.sizes["x"])
    if mask is None:
        return np.ones(image[0] * image[1], dtype=bool)
    if mask.dims != ("y", "x") or mask.shape != image:
        raise ValueError(f"Invalid mask {dict(mask.sizes)}. Must be (y, x) of {image}.")
    return np.asarray(mask.values.astype(bool).ravel())


def _require(pixels: Mask, what: str) -> None:
    if pixels.sum() < _FEWEST:
        raise ValueError(
            f"Invalid signal: {pixels.sum()} pixels have a {what}. Must be at least {_FEWEST}."
        )


def _correlation(rapid: Array) -> Array:
    """Correlation (pixel) of the two bands; 0 where a band does not change."""
    cross = np.einsum("tp,tp->p", rapid[0], rapid[1])
    size = np.sqrt(np.prod(np.einsum("btp,btp->bp", rapid, rapid), axis=0))
    return np.asarray(np.divide(cross, size, out=np.zeros_like(cross), where=size > 0))


def _scaling(rapid: Array, mean: Array, quiet: Mask) -> Array:
    """Each frame's gain and offset errors (time, pixel), fitted to the quiet pixels."""
    design = np.stack([np.ones_like(mean), mean], axis=1)
    errors, *_ = np.linalg.lstsq(design[quiet], rapid[:, quiet].T, rcond=None)
    return np.asarray((design @ errors).T)


def _deming(rapid: Array, power: Array, noise_ratio: float) -> Array:
    """Slope (pixel) of Deming's regression of the second band on the first."""
    cross = np.einsum("tp,tp->p", rapid[0], rapid[1])
    angle = 0.5 * np.arctan2(2.0 * cross * np.sqrt(noise_ratio), noise_ratio * power[0] - power[1])
    return np.asarray(np.sqrt(noise_ratio) * np.tan(angle))
