"""Published videos without a calibration: scale of each frame, reflections, their displacement.

A picture is scaled anew in each frame; the scale is undone. The videos have no radiometry, and
their noise is the codec's: neither white nor known. So one displacement is found for a whole scene,
from the bands' correlation alone, where `alignment.reflection_shift` needs the noise of each band.
"""

import contextlib
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.fft import next_fast_len
from scipy.ndimage import shift

from dbthermal import _smooth as smooth
from dbthermal import alignment, schema
from dbthermal._arrays import Array, Mask
from dbthermal.schema import laid_on

CORRELATED: Final = 0.5  # correlation of the bands from which a pixel enters the pooled ratio [1]

_FEWEST_STILL: Final = 200  # still pixels
# Magnitude of the correlation below which a pixel shows noise alone, and the fewest such pixels.
_UNCORRELATED, _FEWEST = 0.1, 100
_ORDER: Final = 9  # smooth functions of time
# Share of the variance of still surroundings over time that their scale must explain.
_EXPLAINED: Final = 0.9
_ROUNDS, _TINY = 20, np.finfo(np.float64).tiny


def unscaled(signal: xr.DataArray, still: xr.DataArray) -> xr.DataArray:
    r"""Undo the scale of each frame of two pictures, from surroundings that do not change.

    A picture that is scaled anew in each frame shows still surroundings :math:`s(p)` as
    :math:`o(t) + g(t) s(p)`. Offset and gain are fitted robustly, with Cauchy's weights [1]_ by
    each pixel's residual over time. A band where they explain less than 90 % of the weighted
    variance over time stays as it is.

    The signal (band, time, y, x) has two bands in units of their own; the still pixels (y, x) are
    off the object, and a third of them may change after all. The result is in units of its mean
    over time, with the coordinate `gain` (band, time) [1], by which the noise was divided, 1 in a
    band that is not undone. Attributes `scale_undone`, the bands that are, and `scale_explained`,
    each band's explained share. ValueError if dims or bands are wrong, a value is not finite, or
    fewer than 200 pixels are still.

    References
    ----------
    .. [1] Holland, Welsch (1977), doi:10.1080/03610927708827533
    """
    _check_signal(signal)
    if still.dims != ("y", "x"):
        raise ValueError(f"Invalid dims {still.dims} of the still pixels. Must be ('y', 'x').")
    aligned = laid_on(still, signal, "the still pixels", "the signal")
    chosen = aligned.values.astype(bool).ravel()
    if chosen.sum() < _FEWEST_STILL:
        rule = f"Must be at least {_FEWEST_STILL}"
        raise ValueError(f"Invalid still pixels: {chosen.sum()} of them. {rule}.")
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


def uncalibrated_reflection(signal: xr.DataArray) -> xr.Dataset:
    r"""Separate rapid, correlated changes from slow ones in two bands of any unit.

    Without a response there are no temperatures, but rapid changes are still the background's.
    Smooth functions of time, which hold the object's change, are projected out of both bands. Gain
    and offset errors of each frame, rapid and small, are fitted to the uncorrelated pixels
    (correlation below 0.1) and subtracted; where large or slow ones were undone before, a `gain`
    weights the frames by their noise. With :math:`\lambda` the noise variance of the second band
    over that of the first there, the ratio k of a pixel is that of Deming's regression [2]_, the
    pooled ratio is its median over the correlated pixels, and the reflection in the first band's
    unit is the best linear estimate

    .. math:: r(t) = \frac{r_1(t) + (k / \lambda) \, r_2(t)}{1 + k^2 / \lambda}

    The signal (band, time, y, x) has two bands in units of their own and `time` [s]; its coordinate
    `gain` (band, time) [1], if it has one, is what the noise of each frame was divided by.

    The result has `ratio`, `correlation` (y, x) [1]; `reflection` (time, y, x) and `emission`
    (time, y, x), the first band less the reflection, in the first band's unit; attributes
    `pooled_ratio`, `noise_ratio`, `correlated_pixels`, `order`, and those of the signal. ValueError
    if dims or bands are wrong, a value is not finite, or fewer than 100 pixels are uncorrelated
    (correlation below 0.1) or correlated (above 0.5).

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), doi:10.48550/arXiv.2509.11334, equation 22
    .. [2] Fuller (1987), Measurement Error Models, doi:10.1002/9780470316665
    """
    _check_signal(signal)
    # Project the smooth functions of time out of both bands.
    frames, image = signal.sizes["time"], signal.shape[2:]
    values = signal.values.reshape(2, frames, -1).astype(np.float64)
    weight = _frame_weight(signal)
    rapid = _rapid(signal, weight, values)
    # Subtract each frame's offset and gain error, as the uncorrelated pixels show it.
    quiet = np.abs(_correlation(rapid)) < _UNCORRELATED
    _require(quiet, f"correlation below {_UNCORRELATED} in magnitude")
    for band, mean in enumerate(values.mean(axis=1)):
        offset, gain = _frame_errors(rapid[band], mean, quiet)
        rapid[band] -= offset[:, np.newaxis] + gain[:, np.newaxis] * mean
    # Divide the pixels by the correlation of what is left.
    correlation = _correlation(rapid)
    quiet, moving = np.abs(correlation) < _UNCORRELATED, correlation > CORRELATED
    _require(moving, f"correlation above {CORRELATED}")
    # lambda = s_2^2 / s_1^2
    power = np.einsum("btp,btp->bp", rapid, rapid)
    noise_ratio = float(power[1, quiet].mean() / power[0, quiet].mean())
    # Principal axis of the scatter S whitened by the noise: k = sqrt(lambda) tan(phi),
    # tan(2 phi) = 2 sqrt(lambda) S_12 / (lambda S_11 - S_22).
    cross = 2.0 * np.einsum("tp,tp->p", *rapid) * np.sqrt(noise_ratio)
    angle = 0.5 * np.arctan2(cross, noise_ratio * power[0] - power[1])
    ratio = np.sqrt(noise_ratio) * np.tan(angle)
    pooled = float(np.median(ratio[moving]))
    # r = (r_1 / s_1^2 + k r_2 / s_2^2) / (1 / s_1^2 + k^2 / s_2^2)
    reflection = rapid[0] + pooled / noise_ratio * rapid[1]
    reflection /= weight * (1.0 + pooled**2 / noise_ratio)
    units = {"units": signal.attrs["units"]} if "units" in signal.attrs else {}
    attrs = signal.attrs | {"pooled_ratio": pooled, "noise_ratio": noise_ratio}
    attrs |= {"correlated_pixels": int(moving.sum()), "order": _ORDER}
    coords = {name: signal[name] for name in ("time", "y", "x") if name in signal.coords}
    result = xr.Dataset(coords=coords, attrs=attrs)
    for name, film in (("ratio", ratio), ("correlation", correlation)):
        result[name] = ("y", "x"), film.reshape(image), {"units": "1"}
    for name, film in (("reflection", reflection), ("emission", values[0] - reflection)):
        result[name] = ("time", "y", "x"), film.reshape(frames, *image).astype(np.float32), units
    return result


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
        rule = "Must be (band, time, y, x) of two bands"
        raise ValueError(f"Invalid signal {dict(signal.sizes)}. {rule}.")
    schema.require_measured(signal.values, "signal")


def _frame_weight(signal: xr.DataArray) -> Array:
    """Weight (time, 1) of frames, inverse to the geometric mean of the bands' noise; mean 1."""
    if "gain" not in signal.coords:
        return np.ones((signal.sizes["time"], 1))
    gain = schema.check_numbers(signal["gain"], "the gain", "1").transpose("band", "time").values
    if not np.all(schema.measured(gain) & (gain > 0)):
        raise ValueError(f"Invalid gain {np.min(gain)} of a frame. Must be finite and > 0.")
    weight = np.exp(np.log(gain).mean(axis=0))
    return np.asarray(weight / weight.mean())[:, np.newaxis]


def _require(pixels: Mask, rule: str) -> None:
    if pixels.sum() < _FEWEST:
        message = f"Invalid signal: {pixels.sum()} pixels have a {rule}"
        raise ValueError(f"{message}. Must be at least {_FEWEST}.")


def _correlation(rapid: Array) -> Array:
    """Correlation (pixel) of the two bands; 0 where a band does not change."""
    cross = np.einsum("tp,tp->p", rapid[0], rapid[1])
    size = np.sqrt(np.prod(np.einsum("btp,btp->bp", rapid, rapid), axis=0))
    return np.asarray(np.divide(cross, size, out=np.zeros_like(cross), where=size > 0))


Movie = npt.NDArray[np.float32]

REACH: Final = (6, 48)  # largest displacement that is searched for, rows and columns [pixel]

_SHARED: Final = 0.4  # share of the object's pixels that still show it when they are displaced
_PARTS: Final = 5  # of a capture, in which the still edges are registered


def edges_shift(movie: xr.DataArray) -> xr.DataArray:
    """Displacement (axis) [pixel] of the still edges: the second band shows at p the first's p + d.

    Median of those of five parts of the capture, from `alignment.register` of their mean pictures.
    Parts without edges, as before anything is warm, are left out; NaN if all are.
    """
    shifts: list[Array] = []
    for frames in np.array_split(np.arange(movie.sizes["time"]), _PARTS):
        # Register the part as if its values were counts.
        counts = movie.isel(time=frames).drop_vars("gain", errors="ignore").rename("counts")
        capture = counts.astype("float32").assign_attrs(units="count").to_dataset()
        with contextlib.suppress(ValueError):
            transform = alignment.register(capture, model="translation").isel(band=1)
            shifts.append(-transform.values[[1, 0], 2])
    return _displacement(np.median(shifts or [np.full(2, np.nan)], axis=0))


def reflections_shift(movie: xr.DataArray, outline: xr.DataArray) -> xr.DataArray:
    """Displacement (axis) [pixel] of the reflections: the second band shows at p the first's p + d.

    That of the largest correlation of the bands' rapid changes over the object, between whole
    pixels by a parabola. Attributes: `correlation` there, and `correlation_at_0`. NaN if it lies at
    the end of the search, `REACH`.
    """
    # Correlate the rapid changes at every whole displacement.
    values = movie.values[..., outline.values].astype(np.float64)
    rapid = np.zeros(movie.shape, dtype=np.float32)
    rapid[..., outline.values] = _rapid(movie, _frame_weight(movie), values)
    scores = _correlations(rapid[0], rapid[1], outline.values)
    place = np.array(np.unravel_index(np.argmax(scores), scores.shape))
    largest = {"correlation": scores.max(), "correlation_at_0": scores[REACH]}
    attrs = {name: float(value) for name, value in largest.items()}
    # Between whole pixels by a parabola, unless the largest lies at the end of the search.
    if np.any(place == 0) or np.any(place == np.array(scores.shape) - 1):
        return _displacement(np.full(2, np.nan)).assign_attrs(attrs)
    peak = (place - REACH).astype(np.float64)
    for axis, step in enumerate(np.eye(2, dtype=int)):
        below, middle, above = (scores[tuple(place + k * step)] for k in (-1, 0, 1))
        peak[axis] += 0.5 * (below - above) / (below - 2 * middle + above)
    return _displacement(peak).assign_attrs(attrs)


def _displacement(value: Array) -> xr.DataArray:
    return xr.DataArray(value, {"axis": ["y", "x"]}, "axis", attrs={"units": "pixel"})


def _rapid(signal: xr.DataArray, weight: Array, values: Array) -> Array:
    """Weighted changes (band, time, pixel) of a signal's values that smooth functions leave."""
    functions, _ = np.linalg.qr(weight * smooth.polynomial_basis(signal["time"].values, _ORDER))
    rapid = weight * values
    return np.asarray(rapid - [functions @ (functions.T @ band) for band in rapid])


def _correlations(first: Movie, second: Movie, outline: Mask) -> Array:
    """Correlation of second(p) with first(p + d) over the object, by d within `REACH`."""
    size = [next_fast_len(n + r, real=True) for n, r in zip(outline.shape, REACH, strict=True)]

    def lagged(ahead: npt.NDArray[np.floating], behind: npt.NDArray[np.floating]) -> Array:
        """Sum over p of ahead(p + d) behind(p)."""
        spectrum = np.conj(np.fft.rfft2(behind, size)) * np.fft.rfft2(ahead, size)
        rows, columns = (np.arange(-reach, reach + 1) for reach in REACH)
        return np.asarray(np.fft.irfft2(spectrum, size)[np.ix_(rows, columns)])

    cross = sum(lagged(a, b) for a, b in zip(first, second, strict=True))
    mask = outline.astype(np.float64)
    shared = lagged(mask, mask)
    energy = lagged(np.sum(first**2, axis=0), mask) * lagged(mask, np.sum(second**2, axis=0))
    defined = (shared >= _SHARED * mask.sum()) & (energy > 0)
    return np.where(defined, cross / np.sqrt(np.where(defined, energy, 1.0)), -1.0)


def moved(movie: xr.DataArray, displacement: xr.DataArray) -> xr.DataArray:
    """Movie with the first band taken at p + d, so that both show a reflection at one pixel.

    Raises a ValueError if the displacement is not known.
    """
    if not np.all(np.isfinite(displacement)):
        raise ValueError("Unknown displacement of the reflections. Must be within the search.")
    result, back = movie.copy(), -displacement.values
    for frame in result.values[0]:
        frame[...] = shift(frame, back, order=3, mode="nearest")
    return result


def shared_outline(outline: xr.DataArray, displacement: xr.DataArray) -> xr.DataArray:
    """Pixels (y, x) that show the object in both bands, the first displaced if that is known."""
    back = -np.nan_to_num(displacement.values)
    displaced = shift(outline.values.astype(float), back, order=1)
    return outline.copy(data=outline.values & (displaced > 0.99))
