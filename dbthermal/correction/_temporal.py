"""Behaviour of the detector in time: lag of its pixels, drift, and references that renew levels."""

from dataclasses import dataclass

import numpy as np
import xarray as xr

from dbthermal import _numbers, _rows, _smooth, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask

_LONGEST = 1.0  # time constant of a pixel [s]; of microbolometers it is some 10 ms
_PATCH = schema.Variable(("y", "x"), "bool", "1", "patch of constant temperature")
_DOUBTED = 5.0  # deviations of a calibration, by default 0.5 K, that no drift explains (20 K: 39)


def undo_lag(corrected: xr.Dataset, time_constant: float | xr.DataArray) -> xr.Dataset:
    r"""Undo the thermal lag of the pixels, bodies with a time constant of their own.

    A pixel follows :math:`\tau \dot I = z - I`. For z held from each frame to the next, exactly,

    .. math:: z_n = \frac{I_n - a_n I_{n-1}}{1 - a_n}, \quad a_n = e^{-(t_n - t_{n-1}) / \tau}

    The first frame becomes NaN, and so does a frame after one that is NaN. White noise is raised by
    :math:`\sqrt{1 + a^2} / (1 - a)` (1.00005 at 10 Hz, 1.25 at 60 Hz for 10 ms), and successive
    frames then have the correlation :math:`-a / (1 + a^2)`: undo a lag that matters, not one that
    does not.

    TypeError or ValueError if there are fewer than two frames, the lag was undone before, the
    counts are whole numbers, or a time constant is not positive, or above 1 s.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, after `mark_shutter`: a repeated frame is no measurement.
    time_constant : float or DataArray
        Time constant of the pixels [s], at most 1 s, of all bands or (band), by name.

    Returns
    -------
    Dataset
        The dataset with other `counts` [count], and the attributes ``lag_time_constant`` [s] and
        ``lag_noise_amplification`` [1], each by band; a known noise must be multiplied by the
        latter.
    """
    counts = schema.check_corrected(corrected)["counts"]
    if "lag_time_constant" in corrected.attrs:
        raise ValueError("Invalid dataset: the lag was undone before. Must be as the pixels lag.")
    if counts.sizes["time"] < 2:
        raise ValueError("Invalid capture of 1 frame. Must have at least 2, for a lag.")
    constants = time_constants(time_constant, counts)
    ratio = np.diff(counts["time"].values.astype(np.float64)) / constants[:, np.newaxis]
    # z_n = I_n + (I_n - I_n-1) a / (1 - a): a correction that is small where the lag is.
    gain = np.exp(-ratio) / -np.expm1(-ratio)
    signal = np.full_like(counts.values, np.nan)
    for band in range(counts.sizes["band"]):
        movie = counts.isel(band=band).values
        movie = np.where(schema.measured(movie), movie, np.nan)
        for frame in range(1, len(movie)):
            change = movie[frame] - movie[frame - 1]
            signal[band, frame] = movie[frame] + change * gain[band, frame - 1]
    # z = (I_n - a I_n-1) / (1 - a), of independent noises: sqrt(1 + a^2) / (1 - a).
    ratio = np.median(ratio, axis=1)
    amplification = np.hypot(1.0, np.exp(-ratio)) / -np.expm1(-ratio)
    return corrected.assign(counts=(counts.dims, signal, counts.attrs)).assign_attrs(
        lag_time_constant=constants.tolist(), lag_noise_amplification=amplification.tolist()
    )


def undo_drift(
    corrected: xr.Dataset, reference: xr.DataArray, *, order: int = 5, lazy: bool = False
) -> xr.Dataset:
    r"""Subtract from all of a band the drift that a patch of constant temperature shows.

    The patch's mean is smoothed by polynomials in time, in each segment between two shutter events
    by itself, and

    .. math:: I'(t) = I(t) - [c(t) - c(t_0)]

    with c the smooth curve and :math:`t_0` the segment's first frame. The steps between segments
    are left for the separation. Of n pixels of noise s the patch adds an error of about :math:`s K
    / \sqrt{n N}` in N frames with K functions, at the ends: 0.11 counts for 100 pixels of 4 counts
    and 350 frames. A motion in front of the patch, or reflected in it, is taken for drift.

    TypeError or ValueError if the drift was undone before, the reference marks no good pixel,
    `order` is no whole number from 2 to that of the frames, or a part of the patch is NaN in a
    frame.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, after `mark_shutter` if there were shutter events.
    reference : DataArray
        True on the patch, (y, x), bool: a blackbody, a wall. Pixels with a `status` are left out.
    order : int
        Number of polynomials in a segment, the constant included; at most that of the frames, and
        a segment of fewer has as many.
    lazy : bool
        As in `correct_capture`.

    Returns
    -------
    Dataset
        The dataset with other `counts` [count]; `drift` (band, time) [count], which was subtracted;
        and the attributes ``drift_order`` and ``drift_pixels``.
    """
    counts = schema.check_corrected(corrected)["counts"]
    if "drift" in corrected:
        raise ValueError("Invalid dataset: the drift was undone before. Must be as it drifts.")
    order = _numbers.whole_number("order of the drift", order, (2, counts.sizes["time"]))
    schema.check_variable(reference, _PATCH, "the reference")
    rows, columns = np.nonzero(_good(reference, corrected, "the reference"))
    if not rows.size:
        raise ValueError("Invalid reference: it marks no good pixel. Must mark at least one.")
    patch = counts.isel(y=xr.DataArray(rows, dims="p"), x=xr.DataArray(columns, dims="p"))
    level = patch.mean("p", dtype=np.float64, skipna=False)
    torn = np.isnan(level.values) & patch.notnull().any("p").values
    for band, frame in np.argwhere(torn):  # its mean would jump with the pixels that remain
        label = f"Invalid reference: a part of it is NaN in frame {frame} of band"
        rule = "Must be NaN as a whole, or not at all"
        raise ValueError(f"{label} '{patch['band'].values[band]}'. {rule}.")
    # Smooth curve of the patch, segment by segment.
    segment = corrected["segment"].values if "segment" in corrected else np.zeros(level.shape[1])
    time, curves = level["time"].values.astype(np.float64), np.full(level.shape, np.nan)
    for number in np.unique(segment):
        for values, curve in zip(level.values, curves, strict=True):
            frames = (segment == number) & np.isfinite(values)
            if frames.any():
                functions = _smooth.polynomial_basis(time[frames], min(order, int(frames.sum())))
                fitted = functions @ (functions.T @ values[frames])
                curve[frames] = fitted - fitted[0]  # change since the segment's first frame

    drifts = curves[..., np.newaxis, np.newaxis]
    undo = _rows.changed(counts, lambda values: values - drifts, lazy=lazy)
    drift = schema.variables("corrected", {"drift": curves})
    return corrected.assign(counts=undo, **drift).assign_attrs(
        drift_order=order, drift_pixels=len(rows)
    )


def time_constants(time_constant: float | xr.DataArray, counts: xr.DataArray) -> Array:
    """Time constant of each band [s]."""
    names, name = [str(name) for name in counts["band"].values], "time_constant [s]"
    if isinstance(time_constant, xr.DataArray):
        values = schema.band_values(time_constant, names, "the time constants", "s")
    else:
        values = np.full(len(names), _numbers.real_number(name, time_constant))
    longest = _numbers.real_numbers(name, values, _numbers.POSITIVE).max()
    if longest > _LONGEST:
        raise ValueError(f"Invalid {name} {longest}. Must be at most 1: seconds, not milliseconds.")
    return values


def _good(patches: xr.DataArray, corrected: xr.Dataset, label: str) -> Mask:
    """Pixels (..., y, x) of patches, less those with a status."""
    marked = schema.laid_on(patches, corrected, label, "the capture").values
    return np.asarray(marked & (schema.pixel_status(corrected) == 0))


_PATCHES = schema.Variable(("patch", "y", "x"), "bool", "1", "pixels of a patch")


@dataclass(frozen=True)
class Reference:
    """Patches in view, nearly black, whose temperature is known, for `correct_capture`.

    TypeError or ValueError if an attribute is not as described.

    Attributes
    ----------
    response, patches : Dataset, DataArray
        Stage `response` of `schema`: the counts that a patch should have; True at the pixels of
        each patch, (patch, y, x), bool.
    temperatures, temperature_std : tuple of float, float
        Of each patch, mean over the capture [K]; two or more differ. Deviation that they share [K].
    """

    response: xr.Dataset
    patches: xr.DataArray
    temperatures: tuple[float, ...]
    temperature_std: float = 0.1

    def __post_init__(self) -> None:
        schema.check(self.response, "response")
        schema.check_variable(self.patches, _PATCHES, "the patches")
        kelvin, shape = _numbers.KELVIN, (self.patches.sizes["patch"],)
        values = _numbers.real_numbers("temperatures [K]", self.temperatures, kelvin, shape)
        if len(values) > 1 and not np.ptp(values) > 0.0:
            raise ValueError(f"Invalid temperatures {values.tolist()} K of patches. Must differ.")
        _numbers.real_number("temperature_std [K]", self.temperature_std, _numbers.POSITIVE)


def refer(corrected: xr.Dataset, reference: Reference, *, lazy: bool) -> xr.Dataset:
    """Counts (band, time, y, x) with the level, and by several patches the gain, of a reference."""
    counts, names = corrected["counts"], [str(name) for name in corrected["band"].values]
    masks = _good(reference.patches, corrected, "the patches")
    if np.any(few := masks.sum(axis=(1, 2)) < 2):
        raise ValueError(f"Invalid patch {int(np.argmax(few))}. Must have two good pixels or more.")
    # Mean of the patches over time, and how it scatters over their pixels.
    means, stds = [], []
    for mask in masks:
        rows, columns = (xr.DataArray(places, dims="pixel") for places in np.nonzero(mask))
        pixels = counts.isel(y=rows, x=columns).mean("time", dtype=np.float64)
        means.append(pixels.mean("pixel").values)
        stds.append(pixels.std("pixel", ddof=1).values / np.sqrt(rows.size))
    # Line from the measured to the expected counts of each band.
    temperatures = np.asarray(reference.temperatures, dtype=np.float64)
    remaining, lines, notes = {}, np.empty((2, len(names), 1, 1, 1)), list[str]()
    stated, std = responses.accuracy(reference.response, names), reference.temperature_std
    for band, curve in enumerate(responses.curves(reference.response, names)):
        seen = np.array([mean[band] for mean in means])
        wanted = curve.counts(temperatures)
        gain = np.polyfit(seen, wanted, 1)[0] if len(seen) > 1 else 1.0
        lines[:, band, 0, 0, 0] = gain, np.mean(wanted - gain * seen)
        # What remains unknown of the level and the gain.
        errors = np.array([std[band] for std in stds]) / curve.count_slope(temperatures)
        remaining[names[band]] = {"offset_std": float(np.sqrt(np.mean(errors**2) / len(errors)))}
        if len(errors) > 1:
            scatter = np.sum((temperatures - temperatures.mean()) ** 2)
            remaining[names[band]]["gain_std"] = float(np.sqrt(np.mean(errors**2) / scatter))
        # Patches that contradict the calibration.
        off = (seen - wanted) / curve.count_slope(temperatures)
        times = np.abs(off) / np.hypot(stated.reading(band, temperatures), std)
        for patch in np.flatnonzero(times > _DOUBTED):
            label = f"Patch {patch} of {temperatures[patch]:.6g} K reads about {off[patch]:+.2g} K"
            label += f" off in band '{names[band]}', {times[patch]:.0f} deviations of its response"
            notes.append(f"{label}. Must be black, and right: all levels follow it.")
    film = _rows.changed(counts, lambda values: lines[0] * values + lines[1], lazy=lazy)
    level = {"temperature": float(temperatures.mean()), "std": std, "bands": remaining}
    return schema.warned(corrected.assign(counts=film).assign_attrs(level_reference=level), *notes)
