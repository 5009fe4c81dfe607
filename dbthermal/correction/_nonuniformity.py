"""Non-uniformity correction (NUC): gain, offset and bad pixels from views of a blackbody.

By the supplement of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334. A bad pixel is marked,
never filled from its neighbours, which would look like a measurement.
"""

from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.special import chdtri

from dbthermal import _numbers, schema
from dbthermal._arrays import Array, Mask, quotient, stride
from dbthermal.noise import MAD
from dbthermal.schema import Status

DETECTOR_MAXIMUM: Final = 65535
"""Largest count of a 16-bit detector; at this value, and at 0, a sample is saturated [count]."""

OUTLIER: Final = 6.0
"""Robust z-score beyond which a pixel is bad [1]: 1 of 5e8 normal pixels."""

_PARAMETERS = {"blackbody_temperatures", "threshold", "detector_maximum", "by_camera"}
_PARAMETERS |= {"offset_renewed"}
_PATTERN = ("offset_std", "gain_std", "centre")
_PASSES = 2  # fits of the mean, of which the first finds the outliers
_LEVELS = 65536  # samples of a band, about, for the levels of a capture
# Change [standard error] and [K] of the last quarter of a movie's frames against the first from
# which a blackbody is not settled: none of 240 simulated sweeps that are.
_SIGMAS, _UNSETTLED = 5.0, 0.1
_ROUNDING = 0.01  # differences between pixels that are rounding [count], or [1] of logarithms


def blackbody_statistics(movies: xr.Dataset) -> xr.Dataset:
    r"""Mean frames and temporal noise of movies of a blackbody.

    The noise of a pixel, :math:`s^2 = \overline{d^2} / 2`, comes from the differences d of
    successive frames, free of drift. Its median over pixels and temperatures is divided by that of
    a chi-square distribution of the degrees of freedom that n differences leave, :math:`2 n^2 /
    (3 n - 1)`: a median of few frames is else too low (by 33 % for two frames, 5 % for ten). Exact
    copies of the frame before, as of a stream faster than the sensor, do not count.

    Parameters
    ----------
    movies : Dataset
        Stage `blackbody_movies` of `schema`: `counts` (band, temperature, frame, y, x) [count],
        raw, at least two frames.

    Returns
    -------
    Dataset
        Stage `blackbody_frames`: `counts` (band, temperature, y, x) [count], and `noise` (band)
        [count], the standard deviation of one sample; attribute ``frames``, the fewest that are no
        copies. TypeError or ValueError if the movies hold NaN or do not vary; a UserWarning of
        blackbodies that were not settled, by the means of the first and the last quarter.

    Examples
    --------
    Movies of 20 frames at 20 and 60 degrees Celsius, with a noise of 4 counts.

    >>> import numpy as np, xarray as xr
    >>> level = np.array([18000.0, 24000.0]).reshape(1, 2, 1, 1, 1)
    >>> counts = level + np.random.default_rng(1).normal(0, 4, (1, 2, 20, 16, 16))
    >>> films = (("band", "temperature", "frame", "y", "x"), counts.astype(np.uint16))
    >>> axes = {"band": ["8-14"], "temperature": [293.15, 333.15]}
    >>> statistics = blackbody_statistics(xr.Dataset({"counts": films}, axes))
    >>> bool(abs(statistics.noise - 4.0).max() < 0.2)  # [count]
    True
    """
    counts = schema.check(movies, "blackbody_movies")["counts"]
    frames = counts.sizes["frame"]
    if frames < 2:
        raise ValueError(f"Invalid movies of {frames} frame. Must have at least 2, for the noise.")
    # Variance of one sample: half the mean square of the differences, (band, temperature, pixel).
    variance, levels = np.empty((*counts.shape[:2], *counts.shape[3:])), np.empty(counts.shape[:3])
    for place in np.ndindex(*counts.shape[:2]):
        movie = counts[place].values.astype(np.float32)  # signed: unsigned counts wrap around
        levels[place] = movie.mean(axis=(1, 2), dtype=float)
        change = np.diff(movie, axis=0)
        # The differences of a copy are 0 in every pixel.
        number = max(1, int(change.any(axis=(1, 2)).sum()))
        variance[place] = 0.5 * np.square(change).sum(axis=0, dtype=float) / number
        frames = min(frames, number + 1)
    # Median over pixels and temperatures, over that of the chi-square distribution.
    variance = variance.reshape(len(variance), -1)
    freedom = 2 * (frames - 1) ** 2 / (3 * (frames - 1) - 1)
    noise = np.sqrt(np.median(variance, axis=1) * freedom / chdtri(freedom, 0.5))
    for band, value in zip(counts["band"].values, noise, strict=True):
        if not value > 0:
            rule = "Must be positive: the samples must be finite and vary from frame to frame"
            raise ValueError(f"Invalid noise {value} count of the movies in band '{band}'. {rule}.")
    means = counts.mean("frame", dtype=np.float64, skipna=False)
    variables = schema.variables("blackbody_frames", {"counts": means.values, "noise": noise})
    attrs = {"frames": frames, **schema.origin(movies.attrs)}
    return schema.warned(xr.Dataset(variables, means.coords, attrs), *_unsettled(counts, levels))


def _unsettled(counts: xr.DataArray, levels: Array) -> list[str]:
    """Sentences on views whose level (band, temperature, frame) changes by more than by chance."""
    kelvin, quarter = counts["temperature"].values, levels.shape[2] // 4
    if quarter == 0 or np.ptp(kelvin) == 0:
        return []
    change = levels[..., -quarter:].mean(axis=2) - levels[..., :quarter].mean(axis=2)
    error = np.sqrt(np.mean(np.diff(levels, axis=2) ** 2, axis=2) / quarter)
    rate = np.ptp(levels.mean(axis=2), axis=1, keepdims=True) / np.ptp(kelvin)  # [count/K]
    drift = np.where(abs(change) > _SIGMAS * error, quotient(change, rate, 0.0), 0.0)
    sentences = []
    for band, steps in zip(counts["band"].values, drift, strict=True):
        places = np.flatnonzero(abs(steps) > _UNSETTLED)
        if changes := ", ".join(f"{steps[it]:+.2f} K at {kelvin[it]:g} K" for it in places):
            rule = "Leave out the first frames, or state the `blackbody_accuracy`"
            sentences.append(f"A blackbody was not settled: band '{band}' {changes}. {rule}.")
    return sentences


def fit_correction(
    blackbody: xr.Dataset, *, threshold: float = OUTLIER, maximum: int = DETECTOR_MAXIMUM
) -> xr.Dataset:
    r"""Fit gain and offset of each pixel to frames of a blackbody that fills the view.

    For each pixel, g and f minimise

    .. math:: \sum_T (g \, I(T) + f - \bar I(T))^2

    with :math:`\bar I` the frame's mean over the good pixels. Bad is a pixel whose mean is not
    finite or at the detector's limits at a temperature, whose counts do not rise with the mean, or
    whose gain, or RMS of residuals, lies more than `threshold` robust standard deviations (1.48
    times the median absolute deviation) off the median of the others. Mean, fit and outliers are
    determined twice, then the fit is made with the remaining pixels.

    The noise of the means leaves at a level L, from pixel to pixel, the same in every frame of a
    capture, an error of the variance

    .. math:: \sigma_f^2 + \sigma_g^2 (L - c)^2, \quad \sigma_f^2 = \frac{v}{n}, \quad
       \sigma_g^2 = \frac{v}{\sum_T (\bar I - c)^2}

    with c the mean level and v the variance of a mean about the fit: over n - 2 degrees of freedom
    of n temperatures, or, of two temperatures, that of the noise over the number of frames.

    TypeError or ValueError if there are fewer than two temperatures, threshold or `maximum` are out
    of range, half of the pixels of a band or more are unusable, or the mean does not rise.

    Parameters
    ----------
    blackbody : Dataset
        Stage `blackbody_frames` of `schema`: `counts` (band, temperature, y, x) [count] averaged
        over time, at two temperatures or more; optionally `noise` (band) [count] and the attribute
        ``frames``, as from `blackbody_statistics`.
    threshold, maximum : float, int
        Limit of the robust z-score [1]; largest count of the detector [count].

    Returns
    -------
    Dataset
        Stage `correction`: `gain` (band, y, x) [1] and `offset` (band, y, x) [count]; `bad` (band,
        y, x), bool; `residual` (band) [count], RMS over good pixels and temperatures; `level`
        (band, temperature) [count], the means that the pixels are brought to, for
        `calibration.fit_response`; `offset_std` [count], `gain_std` [1] and `centre` [count]
        (band), the deviations above and c, but not of two temperatures without noise. Bad pixels
        have gain 1 and offset 0: their counts pass unchanged.

    Examples
    --------
    Pixels whose sensitivities differ by 2 %, one of them dead.

    >>> import numpy as np, xarray as xr
    >>> sensitivity = np.random.default_rng(1).normal(1, 0.02, (8, 8))
    >>> sensitivity[3, 4] = 0.0
    >>> level = np.array([18000.0, 24000.0]).reshape(1, 2, 1, 1)  # [count]
    >>> counts = (("band", "temperature", "y", "x"), level * sensitivity)
    >>> axes = {"band": ["8-14"], "temperature": [293.15, 333.15]}
    >>> correction = fit_correction(xr.Dataset({"counts": counts}, axes))
    >>> np.argwhere(correction.bad.values[0]).tolist(), bool(correction.residual < 1e-6)
    ([[3, 4]], True)
    """
    counts = schema.check(blackbody, "blackbody_frames")["counts"]
    if counts.sizes["temperature"] < 2:
        raise ValueError("Invalid blackbody frames of 1 temperature. Must have at least 2.")
    _numbers.real_numbers("temperature [K]", counts["temperature"].values, _numbers.KELVIN)
    threshold = _numbers.real_number("threshold of bad pixels", threshold, _numbers.POSITIVE)
    _numbers.whole_number("maximum of the detector", maximum, (1, DETECTOR_MAXIMUM))
    image = counts.shape[2:]
    # Fit each band by itself.
    pairs = zip(map(str, counts["band"].values), counts.values.astype(np.float64), strict=True)
    fits = [_fit_band(it.reshape(len(it), -1), name, threshold, maximum) for name, it in pairs]
    gain, offset, bad, residual, level = (np.stack(values) for values in zip(*fits, strict=True))
    maps = {"gain": gain, "offset": offset, "bad": bad}
    values = {name: values.reshape(-1, *image) for name, values in maps.items()}
    values |= {"residual": residual, "level": level} | _residual_pattern(residual, level, blackbody)
    coords = {name: counts.coords[name] for name in counts.dims if name in counts.coords}
    attrs: dict[str, Any] = {"threshold": threshold, "detector_maximum": maximum}
    attrs["blackbody_temperatures"] = counts["temperature"].values.tolist()
    attrs |= schema.origin(blackbody.attrs)
    return xr.Dataset(schema.variables("correction", values), coords, attrs)


def renew_offset(correction: xr.Dataset, flat: xr.DataArray) -> xr.Dataset:
    r"""One-point correction: new offsets from one image of a uniform view, the gains kept.

    .. math:: f' = f - [(g F + f) - \overline{g F + f}]

    with F the image and the mean over the good pixels, so that the band's level stays: a single
    image of unknown temperature says nothing of it (`undo_drift` does). `offset_std` becomes that
    of an image as noisy as one of the calibration's. The attribute ``offset_renewed`` is 1.

    TypeError or ValueError if bands or pixels differ, or a good pixel lacks numbers or gain > 0.

    Parameters
    ----------
    correction : Dataset
        From `fit_correction`.
    flat : DataArray
        Mean of raw frames of a uniform view, (band, y, x) [count], such as a lens cap or the
        camera's shutter, of the bands of the correction.
    """
    _require_usable(correction)
    schema.check_numbers(flat, "the flat image", "count")
    if flat.dims != ("band", "y", "x") or "band" not in flat.coords:
        rule = "Must be (band, y, x), bands by name"
        raise ValueError(f"Invalid dims {flat.dims} of the flat image. {rule}.")
    flat = schema.laid_on(flat, correction, "the flat image", "the correction")
    good = ~correction["bad"].values
    schema.require_measured(flat.values[good], "flat image, in a good pixel")
    gain, offset = correction["gain"].values, correction["offset"].values
    corrected = gain * flat.values.astype(np.float64) + offset
    # Offsets that bring every good pixel to the mean.
    level = np.mean(corrected, axis=(1, 2), where=good, keepdims=True)
    offset = np.where(good, offset - (corrected - level), 0.0)
    renewed = {"offset": correction["offset"].copy(data=offset)}
    if correction.keys() >= {*_PATTERN} and "level" in correction:
        # The offset has the image's error, v, instead of that of n images, v / n.
        images = correction.sizes["temperature"]
        renewed["offset_std"] = correction["offset_std"] * np.sqrt(images)
        renewed["centre"] = correction["centre"].copy(data=level[:, 0, 0])
    return correction.assign(renewed).assign_attrs(offset_renewed=1)


def correct(
    capture: xr.Dataset, correction: xr.Dataset, *, maximum: int = DETECTOR_MAXIMUM
) -> xr.Dataset:
    """Apply gain and offset to a capture, and mark its bad and saturated pixels.

    TypeError or ValueError if the capture is not uint16 or was corrected before, `maximum` is out
    of range, or the correction lacks a band, is not finite, or is of other pixels.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`, raw uint16. Other variables are handed on.
    correction, maximum : Dataset, int
        From `fit_correction`, of the same pixels (it may hold more bands); largest count [count].

    Returns
    -------
    Dataset
        Stage `corrected`: `counts` (band, time, y, x) [count], float32; `status` (y, x), with the
        bits DEAD_PIXEL (bad in a band) and SATURATED (a sample at `maximum` or above, or at 0, in a
        frame that has an exposure time) of `schema.Status`, whose counts are kept; `pattern_std`
        (band) [count] where the correction has its deviations, root mean square over the levels of
        the capture. Attributes: ``gain_offset_corrected`` = 1, or 0 where the camera does it, the
        parameters of the fit (``gain_offset_...``), and the numbers of marked pixels.
    """
    counts = schema.check(capture, "capture")["counts"]
    if capture.attrs.get("gain_offset_corrected"):
        raise ValueError("Invalid capture: gain and offset were corrected before. Must be raw.")
    if (counts.dtype.kind, counts.dtype.itemsize) != ("u", 2):  # of either byte order
        raise TypeError(f"Invalid dtype {counts.dtype} of the capture's counts. Must be uint16.")
    _numbers.whole_number("maximum of the detector", maximum, (1, DETECTOR_MAXIMUM))
    maps = schema.laid_on(correction, counts, "the correction", "the capture")
    _require_usable(maps)
    corrected = np.empty(counts.shape, dtype=np.float32)
    saturated = np.zeros(counts.shape[2:], dtype=bool)
    for band in range(len(counts)):
        # Gain and offset of one band, written where it stays: no second movie in memory.
        raw = counts.isel(band=band).values
        gain, offset = maps["gain"].values[band], maps["offset"].values[band]
        np.multiply(raw, gain.astype(np.float32), out=corrected[band])
        corrected[band] += offset.astype(np.float32)
        if "exposure_time" in capture:  # a damaged frame saturates no pixel
            stamped = capture["exposure_time"].values[band] == capture["exposure_time"].values[band]
            raw = raw if stamped.all() else raw[stamped]
        saturated |= raw.max(axis=0, initial=0) >= maximum
        saturated |= raw.min(axis=0, initial=DETECTOR_MAXIMUM) <= 0
    # Flags, pattern and attributes.
    bad = maps["bad"].values.any(axis=0)
    status = bad * np.uint32(Status.DEAD_PIXEL) | saturated * np.uint32(Status.SATURATED)
    result = capture.drop_vars("counts").assign(
        counts=(counts.dims, corrected, schema.STAGES["corrected"]["counts"].attrs),
        status=(("y", "x"), status, Status.cf_attrs(schema.STATUS)),
    )
    if correction.keys() >= {*_PATTERN}:
        result["pattern_std"] = _pattern_std(correction, result["counts"], status == 0)
    attrs = {f"gain_offset_{key}": it for key, it in correction.attrs.items() if key in _PARAMETERS}
    attrs |= {"gain_offset_corrected": 1 - correction.attrs.get("by_camera", 0)}
    attrs |= {"dead_pixels": int(bad.sum()), "saturated_pixels": int(saturated.sum())}
    attrs |= {"detector_maximum": maximum} | schema.origin(capture.attrs, correction.attrs)
    return schema.check(result.assign_attrs(attrs), "corrected")


def _residual_pattern(residual: Array, level: Array, blackbody: xr.Dataset) -> dict[str, Array]:
    """Deviations of offset and gain about the centre of the levels, see `fit_correction`."""
    number, centre = level.shape[1], level.mean(axis=1)
    if number > 2:
        variance = residual**2 * number / (number - 2)
    elif "noise" in blackbody and "frames" in blackbody.attrs:
        variance = blackbody["noise"].values ** 2 / blackbody.attrs["frames"]
    else:
        return {}
    energy = np.square(level - centre[:, np.newaxis]).sum(axis=1)
    offset_std, gain_std = np.sqrt(variance / number), np.sqrt(variance / energy)
    return {"offset_std": offset_std, "gain_std": gain_std, "centre": centre}


def _pattern_std(correction: xr.Dataset, counts: xr.DataArray, good: Mask) -> xr.DataArray:
    """Deviation (band) [count] of the pattern at the levels of good pixels; NaN of none."""
    names = [str(name) for name in counts["band"].values]
    places = schema.band_positions(correction, names, "the correction")
    offset, gain, centre = (correction[name].values[places] for name in _PATTERN)
    step, level = stride(counts.shape[1:], _LEVELS), np.full(len(names), np.nan)
    sample = counts[:, ::step, ::step, ::step].values[:, :, good[::step, ::step]].astype(np.float64)
    if sample.size:
        level = np.square(sample - centre.reshape(-1, 1, 1)).mean(axis=(1, 2))
    std = np.sqrt(offset**2 + gain**2 * level)
    return xr.DataArray(std, dims="band", attrs=schema.PATTERN_STD.attrs)


def _fit_band(
    frames: Array, band: str, threshold: float, maximum: int
) -> tuple[Array, Array, Mask, float, Array]:
    """Fit gain, offset, bad pixels, residual, level of a band to frames (temperature, pixel)."""
    # Saturated and dead pixels enter neither mean nor fit; NaN is saturated.
    good = np.all((frames > 0) & (frames < maximum), axis=0)
    frames = np.where(good, frames, 0.0)
    good &= np.ptp(frames, axis=0) > 0
    for _ in range(_PASSES):
        level = _level(frames, good, band)
        gain, offset, rising = _least_squares(frames, level)
        residual = np.sqrt(np.mean((gain * frames + offset - level[:, np.newaxis]) ** 2, axis=0))
        good &= rising
        # A gain that is off by dg is off by dg std(level) in counts, as the residuals are.
        scale = float(np.std(level))
        good &= ~(outlying(gain * scale, good, threshold) | outlying(residual, good, threshold))
    level = _level(frames, good, band)
    gain, offset, _ = _least_squares(frames, level)
    error = (gain * frames + offset - level[:, np.newaxis])[:, good]
    gain, offset = np.where(good, gain, 1.0), np.where(good, offset, 0.0)
    return gain, offset, ~good, float(np.sqrt(np.mean(error**2))), level


def _level(frames: Array, good: Mask, band: str) -> Array:
    """Mean (temperature) over the good pixels, which must be most of them."""
    if 2 * good.sum() <= good.size:
        label = f"Invalid blackbody frames in band '{band}': {good.sum()} of {good.size} pixels"
        raise ValueError(f"{label} are usable. Must be more than half.")
    level = frames[:, good].mean(axis=1)
    if np.any(np.diff(level) <= 0):
        label = f"Invalid levels {level.round(1).tolist()} count of the blackbody in band '{band}'"
        raise ValueError(f"{label}. Must rise with its temperature.")
    return np.asarray(level)


def _least_squares(frames: Array, level: Array) -> tuple[Array, Array, Mask]:
    """Regress the mean level on each pixel: gain, offset, and where the gain is positive."""
    centre = frames.mean(axis=0)
    deviation = frames - centre
    covariance = (level - level.mean()) @ deviation
    variance = np.sum(deviation**2, axis=0)
    rising = (covariance > 0) & (variance > 0)
    gain = np.divide(covariance, variance, out=np.ones_like(variance), where=rising)
    return gain, level.mean() - gain * centre, rising


def outlying(values: Array, good: Mask, threshold: float) -> Mask:
    """Values farther than `threshold` robust standard deviations off the good pixels' median."""
    if not good.any():
        return good
    centre = np.median(values[good])
    scale = MAD * np.median(np.abs(values[good] - centre))
    return np.asarray(np.abs(values - centre) > threshold * max(scale, _ROUNDING))


def _require_usable(correction: xr.Dataset) -> None:
    """Refuse gains and offsets without bad pixels, not finite, or, of good pixels, not positive."""
    schema.check(correction, "correction")
    if "bad" not in correction:
        raise ValueError("Missing 'bad' (band, y, x) in the correction. Must mark its bad pixels.")
    positive = (correction["gain"] > 0) | correction["bad"]
    for name, holds in {"gain": positive, "offset": True}.items():
        if not np.all(schema.measured(correction[name]) & holds):
            label = f"Invalid {name} of the correction: not finite, or not positive"
            raise ValueError(f"{label}. Must be finite, and a gain positive.")
