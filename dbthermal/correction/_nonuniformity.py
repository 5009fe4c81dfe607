"""Correction of the camera's frames: a gain and an offset for each pixel, and its bad pixels.

The correction follows the supplement of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334: a
blackbody fills the view at several temperatures, and each pixel is brought to the frame's mean by
least squares. `blackbody_statistics` reduces the movies of the blackbody, `fit_correction` fits,
`correct` applies. A bad pixel is marked, never filled from its neighbours: a filled pixel looks
like a measurement and is none.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.special import ndtri
from scipy.stats import chi2

from dbthermal import schema

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

DETECTOR_MAXIMUM: Final = 65535
"""Largest count of a 16-bit detector; at this value, and at 0, a sample is saturated [count]."""

OUTLIER: Final = 6.0
"""Robust z-score beyond which a pixel is bad [1]: 1 of 5e8 normal pixels."""

_PARAMETERS = ("blackbody_temperatures", "threshold", "detector_maximum")
_PASSES = 2
# Median absolute deviation -> standard deviation of a normal distribution.
_MAD = 1.0 / float(ndtri(0.75))
# Below this a spread between pixels is rounding, and no pixel is an outlier [count].
_ROUNDING = 0.01


def blackbody_statistics(movies: xr.Dataset) -> xr.Dataset:
    r"""
    Mean frames and temporal noise of movies of a blackbody.

    The noise of a pixel comes from the differences d of successive frames, so that a drift of the
    camera or of the blackbody does not enter:

    .. math:: s^2 = \overline{d^2} / 2

    Its median over pixels and temperatures is divided by that of a chi-square distribution of the
    degrees of freedom that n differences leave, :math:`2 n^2 / (3 n - 1)`: a median of few frames
    is otherwise too low (by 33 % for two frames, 5 % for ten).

    Parameters
    ----------
    movies : Dataset
        Stage `blackbody_movies` of `schema`: `counts` (band, temperature, frame, y, x) [count],
        raw, at least two frames.

    Returns
    -------
    Dataset
        Stage `blackbody_frames`: `counts` (band, temperature, y, x) [count], and `noise` (band)
        [count], the standard deviation of one sample.

    Raises
    ------
    TypeError, ValueError
        If the movies are not as `schema` has them, have fewer than two frames, hold NaN, or do not
        vary from frame to frame.
    """
    counts = schema.check(movies, "blackbody_movies")["counts"]
    frames = counts.sizes["frame"]
    if frames < 2:
        raise ValueError(f"Invalid movies of {frames} frame. Must have at least 2, for the noise.")
    variance = _difference_variance(counts)
    freedom = 2 * (frames - 1) ** 2 / (3 * (frames - 1) - 1)
    noise = np.sqrt(np.median(variance, axis=1) * freedom / chi2.median(freedom))
    for band, value in zip(counts["band"].values, noise, strict=True):
        if not value > 0:
            raise ValueError(
                f"Invalid noise {value} count of the movies in band '{band}'. Must be positive: "
                "the samples must be finite and vary from frame to frame."
            )
    means = counts.mean("frame", dtype=np.float64, skipna=False)
    return xr.Dataset(
        {
            "counts": means.assign_attrs(schema.STAGES["blackbody_frames"]["counts"].attrs),
            "noise": ("band", noise, {"units": "count", "long_name": "noise of one sample"}),
        },
        attrs={"frames": frames},
    )


def fit_correction(
    blackbody: xr.Dataset, *, threshold: float = OUTLIER, maximum: int = DETECTOR_MAXIMUM
) -> xr.Dataset:
    r"""
    Gain, offset and bad pixels from frames of a blackbody that fills the view.

    For each pixel, g and f minimise

    .. math:: \sum_T (g \, I(T) + f - \bar I(T))^2

    with :math:`\bar I` the frame's mean over the good pixels. Bad is a pixel whose mean is not
    finite or at the detector's limits at a temperature, whose counts do not rise with the mean, or
    whose gain, or RMS of residuals, lies more than `threshold` robust standard deviations
    (1.48 times the median absolute deviation) off the median of the others. Mean, fit and outliers
    are found twice, then the fit is made with the pixels that are left.

    Parameters
    ----------
    blackbody : Dataset
        Stage `blackbody_frames` of `schema`: `counts` (band, temperature, y, x) [count] averaged
        over time, at two temperatures or more.
    threshold : float
        Limit of the robust z-score [1].
    maximum : int
        Largest count of the detector [count].

    Returns
    -------
    Dataset
        Stage `correction`: `gain` (band, y, x) [1] and `offset` (band, y, x) [count]; `bad`
        (band, y, x), bool; `residual` (band) [count], RMS over good pixels and temperatures;
        `level` (band, temperature) [count], the means that the pixels are brought to, which is
        what `calibration.fit_response` takes. Bad pixels have gain 1 and offset 0: their counts
        pass unchanged.

    Raises
    ------
    TypeError, ValueError
        If the frames are not as `schema` has them, are of fewer than two temperatures, or the
        threshold is not positive; if in a band no more than half of the pixels are usable, or the
        mean does not rise with the temperature.
    """
    counts = schema.check(blackbody, "blackbody_frames")["counts"]
    if counts.sizes["temperature"] < 2:
        raise ValueError("Invalid blackbody frames of 1 temperature. Must have at least 2.")
    if not threshold > 0:
        raise ValueError(f"Invalid threshold {threshold} of bad pixels. Must be positive.")
    image = (counts.sizes["y"], counts.sizes["x"])
    parts = []
    for here in counts:
        frames = here.values.astype(np.float64).reshape(-1, image[0] * image[1])
        parts.append(_fit_band(frames, str(here["band"].item()), threshold, maximum))
    gain, offset, bad, residual, level = (np.stack(part) for part in zip(*parts, strict=True))
    stage, pixels = schema.STAGES["correction"], (-1, *image)
    maps = {
        "gain": (gain.reshape(pixels), stage["gain"].attrs),
        "offset": (offset.reshape(pixels), stage["offset"].attrs),
        "bad": (bad.reshape(pixels), {"units": "1", "long_name": "bad pixel"}),
    }
    return xr.Dataset(
        {
            **{name: (("band", "y", "x"), *values) for name, values in maps.items()},
            "residual": ("band", residual, {"units": "count", "long_name": "RMS residual"}),
            "level": (
                ("band", "temperature"),
                level,
                {"units": "count", "long_name": "mean over the good pixels"},
            ),
        },
        coords={name: counts.coords[name] for name in counts.dims if name in counts.coords},
        attrs={
            "blackbody_temperatures": counts["temperature"].values.tolist(),
            "threshold": threshold,
            "detector_maximum": maximum,
        },
    )


def correct(
    capture: xr.Dataset, correction: xr.Dataset, *, maximum: int = DETECTOR_MAXIMUM
) -> xr.Dataset:
    """
    Apply gain and offset to a capture, and mark its bad and saturated pixels.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`: `counts` (band, time, y, x) [count], uint16. Other variables
        are handed on.
    correction : Dataset
        From `fit_correction`, of the same pixels; it may hold more bands.
    maximum : int
        Largest count of the detector [count].

    Returns
    -------
    Dataset
        Stage `corrected`: `counts` (band, time, y, x) [count], float32; `status` (y, x), uint32,
        with the bits of `schema.FLAGS` "dead_pixel" (bad in a band) and "saturated" (a sample of a
        band at `maximum` or above, or at 0). The counts of these pixels are kept. Attributes say
        that gain and offset were corrected (``gain_offset_corrected`` = 1), with which parameters
        they were fitted (``gain_offset_...``), and how many pixels are marked. The capture is not
        changed.

    Raises
    ------
    TypeError, ValueError
        If capture or correction is not as `schema` has it, the capture is not uint16 or was
        corrected before, a band is missing in the correction, a gain or offset is not finite, or
        the pixels are not the same.
    """
    counts = _require_raw(capture)
    _require_same_pixels(counts, schema.check(correction, "correction"))
    names = [str(name) for name in counts["band"].values]
    chosen = _select(correction, names)
    corrected = np.empty(counts.shape, dtype=np.float32)
    saturated = np.zeros(counts.shape[2:], dtype=bool)
    for index, name in enumerate(names):
        # One band at a time, written where it stays: no second movie in memory.
        raw, here = counts.isel(band=index).values, chosen.sel(band=name)
        np.multiply(raw, here["gain"].values.astype(np.float32), out=corrected[index])
        corrected[index] += here["offset"].values.astype(np.float32)
        saturated |= (raw.max(axis=0) >= maximum) | (raw.min(axis=0) <= 0)
    bad = chosen["bad"].values.any(axis=0)
    status = bad * schema.FLAGS["dead_pixel"] + saturated * schema.FLAGS["saturated"]
    attrs = schema.STAGES["corrected"]["counts"].attrs
    result = capture.drop_vars("counts").assign(
        counts=(counts.dims, corrected, attrs),
        status=(("y", "x"), status.astype(np.uint32), schema.status_attrs()),
    )
    return schema.check(
        result.assign_attrs(
            gain_offset_corrected=1,
            **{
                f"gain_offset_{name}": correction.attrs[name]
                for name in _PARAMETERS
                if name in correction.attrs
            },
            detector_maximum=maximum,
            dead_pixels=int(bad.sum()),
            saturated_pixels=int(saturated.sum()),
        ),
        "corrected",
    )


def _difference_variance(counts: xr.DataArray) -> Array:
    """Half the mean square of the frames' differences, (band, temperature and pixel)."""
    parts = [
        [
            # Signed before the difference: unsigned counts wrap around.
            np.square(np.diff(movie.values.astype(np.float32), axis=0)).mean(axis=0, dtype=float)
            for movie in band
        ]
        for band in counts
    ]
    return 0.5 * np.asarray(parts, dtype=np.float64).reshape(counts.sizes["band"], -1)


def _fit_band(
    frames: Array, band: str, threshold: float, maximum: int
) -> tuple[Array, Array, Mask, float, Array]:
    """Gain, offset, bad, residual and level of one band, from frames (temperature, pixel)."""
    good = np.all((frames > 0) & (frames < maximum), axis=0)  # false for NaN
    frames = np.where(good, frames, 0.0)  # these take part in nothing
    good &= np.ptp(frames, axis=0) > 0
    for _ in range(_PASSES):
        level = _level(frames, good, band)
        gain, offset, rising = _least_squares(frames, level)
        residual = np.sqrt(np.mean((gain * frames + offset - level[:, np.newaxis]) ** 2, axis=0))
        good &= rising
        spread = float(np.std(level))
        good &= _inliers(gain * spread, good, threshold) & _inliers(residual, good, threshold)
    level = _level(frames, good, band)
    gain, offset, _ = _least_squares(frames, level)
    error = (gain * frames + offset - level[:, np.newaxis])[:, good]
    gain, offset = np.where(good, gain, 1.0), np.where(good, offset, 0.0)
    return gain, offset, ~good, float(np.sqrt(np.mean(error**2))), level


def _level(frames: Array, good: Mask, band: str) -> Array:
    """Mean (temperature) over the good pixels, which must be most of them."""
    if 2 * good.sum() <= good.size:
        raise ValueError(
            f"Invalid blackbody frames in band '{band}': {good.sum()} of {good.size} pixels are "
            "usable. Must be more than half."
        )
    level = frames[:, good].mean(axis=1)
    if np.any(np.diff(level) <= 0):
        raise ValueError(
            f"Invalid levels {level.tolist()} count of the blackbody in band '{band}'. Must rise "
            "with its temperature."
        )
    return np.asarray(level)


def _least_squares(frames: Array, level: Array) -> tuple[Array, Array, Mask]:
    """Gain and offset (pixel) of the regression of the level on a pixel, and where it rises."""
    centre = frames.mean(axis=0)
    deviation = frames - centre
    covariance = (level - level.mean()) @ deviation
    variance = np.sum(deviation**2, axis=0)
    rising = (covariance > 0) & (variance > 0)
    gain = np.divide(covariance, variance, out=np.ones_like(variance), where=rising)
    return gain, level.mean() - gain * centre, rising


def _inliers(values: Array, good: Mask, threshold: float) -> Mask:
    """Values [count] within `threshold` robust standard deviations of the good ones' median."""
    centre = np.median(values[good])
    scale = _MAD * np.median(np.abs(values[good] - centre))
    return np.asarray(np.abs(values - centre) <= threshold * max(scale, _ROUNDING))


def _require_raw(capture: xr.Dataset) -> xr.DataArray:
    """Counts of a capture that is raw."""
    counts = schema.check(capture, "capture")["counts"]
    if capture.attrs.get("gain_offset_corrected"):
        raise ValueError("Invalid capture: gain and offset were corrected before. Must be raw.")
    if counts.dtype != np.uint16:
        raise TypeError(f"Invalid dtype {counts.dtype} of the capture's counts. Must be uint16.")
    return counts


def _require_same_pixels(counts: xr.DataArray, correction: xr.Dataset) -> None:
    """Refuse a correction of another window of the detector."""
    for dim in ("y", "x"):
        sizes = counts.sizes[dim], correction.sizes[dim]
        if sizes[0] != sizes[1]:
            raise ValueError(
                f"Invalid size {sizes[0]} of '{dim}' of the capture. Must be that of the "
                f"correction, {sizes[1]}."
            )
        both = dim in counts.coords and dim in correction.coords
        if both and not np.array_equal(counts[dim], correction[dim]):
            raise ValueError(f"Invalid '{dim}' of the capture. Must be those of the correction.")


def _select(correction: xr.Dataset, names: list[str]) -> xr.Dataset:
    """Bands of a correction by name, with finite coefficients."""
    places = schema.band_positions(correction, names, "the correction")
    if "bad" not in correction or correction["bad"].dims != ("band", "y", "x"):
        raise ValueError("Missing 'bad' (band, y, x) in the correction. Must mark its bad pixels.")
    chosen = correction.isel(band=places).assign_coords(band=names)
    for name in ("gain", "offset"):
        if not np.all(np.isfinite(chosen[name])):
            raise ValueError(f"Invalid {name} of the correction: not finite. Must be finite.")
    return chosen
