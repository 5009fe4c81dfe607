"""Behaviour of the detector in time: shutter events, lost frames, lag, drift, renewed levels.

Every few minutes a microbolometer closes a shutter and renews its offsets (flat-field correction,
FFC). Its driver repeats the last image meanwhile, and then each pixel has a new offset. A lost
frame is repeated once, and the offsets stay.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _arrays, _numbers, _smooth, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask, stride

Integers = npt.NDArray[np.int64]

_MINIMUM_PIXELS: Final = 16  # changing pixels without which an unchanged image is no copy
# Copies in a row from which the shutter was closed; fewer are lost frames. A missed event biases
# the separation; lost frames counted as an event cost one degree of freedom a band.
FEWEST_COPIES: Final = 3
_SAMPLE = 4096  # pixels on an even grid that are compared first
_BLOCK = 4_000_000  # samples of a block of rows
_EVENT = ("band", "first_frame", "frames", "renewed")
_LONGEST = 1.0  # time constant of a pixel [s]; of microbolometers it is some 10 ms
_DOUBTED = 5.0  # deviations of a calibration, by default 0.5 K, that no drift explains (20 K: 39)
_PATCH = schema.Variable(("y", "x"), "bool", "1", "patch of constant temperature")
_PATCHES = schema.Variable(("patch", "y", "x"), "bool", "1", "pixels of a patch")


def find_shutter(corrected: xr.Dataset, *, closed: xr.DataArray | None = None) -> xr.Dataset:
    """Find the runs of frames in which a band repeats its image.

    A frame is a copy if no pixel differs from the frame before: some thousands of pixels first,
    then the whole image by rows. The search is exact only before an interpolation in time.

    TypeError or ValueError if `closed` is no boolean of the frames, or in a band fewer than 16 of
    the pixels compared ever change.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, or a raw `capture`: `counts` (band, time, y, x) [count].
    closed : DataArray, optional
        True in frames in which the shutter is known to be closed, (time) or (band, time), bool:
        from the camera, or because they show the shutter itself. A run of copies that includes or
        touches one is part of its event.

    Returns
    -------
    Dataset
        One row for each run, (event): `band`; `first_frame` and `frames`, position of the first
        copy and their number; `start` and `stop`, times of the first and last copy [s]; `renewed`,
        true after a closed shutter, whose offsets are new, false for a lost frame.

    Examples
    --------
    The camera repeats an image five times while its shutter is closed.

    >>> import numpy as np, xarray as xr
    >>> counts = np.random.default_rng(1).normal(20000, 4, (1, 40, 8, 8)).round()  # [count]
    >>> counts[0, 21:26] = counts[0, 20]
    >>> axes = {"band": ["8-14"], "time": np.arange(40) / 10.0}
    >>> capture = xr.DataArray(counts, axes, ("band", "time", "y", "x")).to_dataset(name="counts")
    >>> events = find_shutter(capture)
    >>> [events[name].item() for name in ("first_frame", "frames", "start", "stop", "renewed")]
    [21, 5, 2.1, 2.5, True]
    """
    counts = schema.check(corrected, "corrected")["counts"]
    return events_of(counts, copies(counts), closed)


def events_of(
    counts: xr.DataArray, repeats: Mask, closed: xr.DataArray | None, steps: Mask | None = None
) -> xr.Dataset:
    """Events, as of `find_shutter`, of frames (band, time) that repeat, are `closed` or `steps`."""
    shut = np.zeros((counts.sizes["band"], counts.sizes["time"]), dtype=bool)
    if closed is not None:
        closed = schema.laid_on(closed, counts, "the closed frames", "the capture")
        if closed.dtype != bool:
            raise TypeError(f"Invalid dtype {closed.dtype} of the closed frames. Must be bool.")
        if closed.dims not in {("time",), ("band", "time")}:
            rule = "Must be (time) or (band, time)"
            raise ValueError(f"Invalid dims {closed.dims} of the closed frames. {rule}.")
        shut |= closed.values
    # The place of a step of the pattern is uncertain by a frame: an event of two.
    places = () if steps is None else np.argwhere(steps)
    runs = [(str(counts["band"].values[band]), frame - 1, 2, True) for band, frame in places]
    for index, name in enumerate(counts["band"].values):
        marked = np.pad((shut[index] | repeats[index]).astype(np.int8), 1)
        for first, after in np.flatnonzero(np.diff(marked)).reshape(-1, 2):
            renewed = bool(shut[index, first:after].any()) or after - first >= FEWEST_COPIES
            runs.append((str(name), first, after - first, renewed))
    # Rows of `find_shutter`, in the order of their starts.
    runs, time = sorted(runs, key=lambda run: run[1]), counts["time"].values.astype(np.float64)
    bands, first, number, renewals = zip(*runs, strict=True) if runs else ([], [], [], [])
    start, frames = (np.array(column, dtype=np.int64) for column in (first, number))
    rows: dict[str, Any] = {"band": ("event", np.array(bands, dtype=str))}
    rows |= {"first_frame": ("event", start), "frames": ("event", frames)}
    rows["start"] = ("event", time[start], {"units": "s"})
    rows["stop"] = ("event", time[start + frames - 1], {"units": "s"})
    return xr.Dataset({**rows, "renewed": ("event", np.array(renewals, dtype=bool))})


def mark_shutter(corrected: xr.Dataset, events: xr.Dataset | None = None) -> xr.Dataset:
    """Set frames of a closed shutter or a repeated image to NaN, and number the segments.

    A `segment` is the time between two renewals of the offsets, at which every pixel of the band
    steps by tens of counts, which no camera reports. The step stays in the counts:
    `separation.solve` fits it in each pixel and band. Events of two bands that overlap, or follow
    without a frame between, are one step; those before or after all valid frames are none.

    An event costs accuracy: beside five functions over 35 s, one step in the middle raises the
    standard deviation of the smooth part by 1.9, two, at 11 and 24 s, by 2.7.

    TypeError or ValueError if the counts are whole numbers, which have no NaN, the dataset was
    marked before, or an event lacks a variable, is of no band or of frames outside the dataset.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, not yet marked, before `alignment.align`. `counts` may be
        lazy.
    events : Dataset, optional
        From `find_shutter`, or rows of it; by default `find_shutter(corrected)`.

    Returns
    -------
    Dataset
        The dataset with NaN in place of these samples, and `segment` (time), int32 [1]: number of
        renewals of the offsets before the frame. Attributes: ``shutter_events``,
        ``repeated_frames`` (runs that renew nothing) and ``frames_taken_out`` (by band).
    """
    counts = schema.check_corrected(corrected)["counts"]
    if "segment" in corrected:
        raise ValueError("Invalid dataset: shutter events were marked before. Must be unmarked.")
    events = find_shutter(corrected) if events is None else events
    first, after, bands = _positions(events, counts)
    frames = counts.sizes["time"]
    marked = np.zeros((counts.sizes["band"], frames), dtype=bool)
    for band, start, stop in zip(bands, first, after, strict=True):
        marked[band, start:stop] = True
    # Segments begin with the first frame after each renewal.
    renewed = events["renewed"].values.astype(bool)
    within = renewed & (first > 0) & (after < frames)
    changes = _changes(first[within], after[within])
    segment = np.searchsorted(changes, np.arange(frames), side="right").astype(np.int32)
    mask = xr.DataArray(~marked, dims=("band", "time"), coords={"band": counts["band"]})
    result = corrected.assign(
        counts=counts.where(mask).assign_attrs(counts.attrs),
        segment=("time", segment, schema.SEGMENT.attrs),
    )
    number, losses = int(renewed.sum()), marked.sum(axis=1).tolist()
    return result.assign_attrs(
        shutter_events=number, repeated_frames=renewed.size - number, frames_taken_out=losses
    )


def distinct(capture: xr.Dataset) -> tuple[xr.Dataset, Mask]:
    """Capture without the repetitions of a stream faster than its sensor, and remaining copies."""
    counts = schema.check(capture, "capture")["counts"]
    repeats, frames = copies(counts), np.arange(counts.sizes["time"])
    first = np.maximum.accumulate(np.where(repeats, 0, frames), axis=1)  # showing of each frame
    numbers = [np.unique(row, return_counts=True)[1] for row in first]
    shown = [int(np.median(number)) for number in numbers]
    slowest = int(np.argmax(shown))
    # A stream repeats if half of its frames are shown twice or more.
    if shown[slowest] < 2:
        return capture, repeats
    # Of m showings of a frame keep every r-th, m / r and at least one, with r the median: an image
    # that the sensor itself repeats, as behind a closed shutter, stays repeated.
    place = frames - first[slowest]
    quota = np.maximum(1, np.rint(numbers[slowest] / shown[slowest]))
    quota = np.repeat(quota, numbers[slowest]) * shown[slowest]
    selection = np.flatnonzero((place % shown[slowest] == 0) & (place < quota))
    first, result = first[:, selection], capture.isel(time=selection)
    # Remaining copies (band, time). Frames of other bands exposed earlier get an `exposure_time`.
    duplicate = np.diff(first, axis=1, prepend=-1) == 0
    if np.any((first != selection) & ~duplicate):
        clock = capture["time"].astype(np.float64).expand_dims(band=counts["band"])
        stamps = np.take_along_axis(capture.get("exposure_time", clock).values, first, axis=1)
        stamps = np.where(duplicate, np.nan, stamps)
        result = result.assign(exposure_time=(("band", "time"), stamps, schema.EXPOSURE_TIME.attrs))
    pairs = zip(counts["band"].values, shown, strict=True)
    label = ", ".join(f"{number} times in band '{band}'" for band, number in pairs if number > 1)
    note = f"Each frame is repeated, {label}: a stream faster than its sensor. One of each is kept"
    return schema.warned(result, note), duplicate


def copies(counts: xr.DataArray) -> Mask:
    """Frames (band, time) of counts (band, time, y, x) that repeat the frame before."""
    if "band" in counts.dims:
        return np.stack([copies(band) for band in counts])
    step = stride((counts.sizes["y"], counts.sizes["x"]), _SAMPLE)
    sample = counts.isel(y=slice(None, None, step), x=slice(None, None, step)).values
    changed, valid = _changed(sample[:-1], sample[1:])
    moving = changed.any(axis=0)
    if moving.sum() < _MINIMUM_PIXELS:
        label = f"Invalid counts of band '{counts['band'].item()}': {moving.sum()} of the"
        rule = f"Must be at least {_MINIMUM_PIXELS}"
        raise ValueError(f"{label} {moving.size} pixels change in {len(sample)} frames. {rule}.")
    repeats = np.zeros(counts.sizes["time"], dtype=bool)
    # Compare the whole image where the sample of pixels repeats.
    candidates = 1 + np.flatnonzero(valid.any(axis=(1, 2)) & ~changed.any(axis=(1, 2)))
    if candidates.size:
        repeats[candidates] = True
        frames = np.union1d(candidates, candidates - 1)
        after, before = (np.searchsorted(frames, frame) for frame in (candidates, candidates - 1))
        for rows in _arrays.blocks((frames.size, *counts.shape[1:]), _BLOCK):
            block = counts.isel(time=frames, y=rows).values
            repeats[candidates] &= ~_changed(block[before], block[after])[0].any(axis=(1, 2))
    return repeats


def _changed(before: npt.NDArray[Any], after: npt.NDArray[Any]) -> tuple[Mask, Mask]:
    """Samples that differ between two frames, and those that are finite in both."""
    valid = np.isfinite(before) & np.isfinite(after)
    return (before != after) & valid, valid


def _positions(events: xr.Dataset, counts: xr.DataArray) -> tuple[Integers, Integers, list[int]]:
    """First frame, frame after the last, and position of the band of each event."""
    missing = [name for name in _EVENT if name not in events]
    if missing:
        raise ValueError(f"Missing '{missing[0]}' of the events. Must have {list(_EVENT)}.")
    bands = schema.band_positions(counts, [str(name) for name in events["band"].values], "counts")
    first = events["first_frame"].values.astype(np.int64)
    after = first + events["frames"].values.astype(np.int64)
    wrong = np.flatnonzero((first < 0) | (after <= first) | (after > counts.sizes["time"]))
    if wrong.size:
        message = f"Invalid event of frames {first[wrong[0]]} to {after[wrong[0]] - 1}"
        raise ValueError(f"{message}. Must lie in [0, {counts.sizes['time'] - 1}], not fall.")
    if "start" in events:
        starts = events["start"].rename(event="time").assign_coords(time=events["start"].values)
        schema.laid_on(starts, counts.isel(time=first), "the events", "the capture")
    return first, after, bands


def _changes(first: Integers, after: Integers) -> Integers:
    """Fewest frames that mark all events, each in its event or at its first frame after it."""
    chosen: list[int] = []
    for place in np.argsort(after, kind="stable"):
        if not chosen or first[place] > chosen[-1]:
            chosen.append(int(after[place]))
    return np.array(chosen, dtype=np.int64)


def undo_lag(corrected: xr.Dataset, time_constant: float | xr.DataArray) -> xr.Dataset:
    r"""Undo the thermal lag of the pixels, bodies with a time constant of their own.

    A pixel follows :math:`\tau \dot I = z - I`. For z held from each frame to the next, exactly,

    .. math:: z_n = \frac{I_n - a_n I_{n-1}}{1 - a_n}, \quad a_n = e^{-(t_n - t_{n-1}) / \tau}

    The first frame becomes NaN, and so does a frame after one that is NaN. White noise is raised by
    :math:`\sqrt{1 + a^2} / (1 - a)` (1.00005 at 10 Hz, 1.25 at 60 Hz for 10 ms), and successive
    frames then have the correlation :math:`-a / (1 + a^2)`: undo only a lag that matters.

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
        ``lag_noise_amplification`` [1], each by band; multiply a known noise by it.
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
    `order` is no whole number from 2 to that of the frames, or a part of the patch is NaN.

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
    undo = _arrays.changed(counts, lambda values: values - drifts, lazy=lazy)
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
        levels = np.array([mean[band] for mean in means])
        targets = curve.counts(temperatures)
        gain = np.polyfit(levels, targets, 1)[0] if len(levels) > 1 else 1.0
        lines[:, band, 0, 0, 0] = gain, np.mean(targets - gain * levels)
        # What remains unknown of the level and the gain.
        errors = np.array([std[band] for std in stds]) / curve.count_slope(temperatures)
        remaining[names[band]] = {"offset_std": float(np.sqrt(np.mean(errors**2) / len(errors)))}
        if len(errors) > 1:
            scatter = np.sum((temperatures - temperatures.mean()) ** 2)
            remaining[names[band]]["gain_std"] = float(np.sqrt(np.mean(errors**2) / scatter))
        # Patches that contradict the calibration.
        bias = (levels - targets) / curve.count_slope(temperatures)
        times = np.abs(bias) / np.hypot(stated.reading(band, temperatures), std)
        for patch in np.flatnonzero(times > _DOUBTED):
            label = f"Patch {patch} of {temperatures[patch]:.6g} K reads about {bias[patch]:+.2g} K"
            label += f" off in band '{names[band]}', {times[patch]:.0f} deviations of its response"
            notes.append(f"{label}. Must be black, and right: all levels follow it.")
    film = _arrays.changed(counts, lambda values: lines[0] * values + lines[1], lazy=lazy)
    level = {"temperature": float(temperatures.mean()), "std": std, "bands": remaining}
    return schema.warned(corrected.assign(counts=film).assign_attrs(level_reference=level), *notes)
