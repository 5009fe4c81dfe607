"""Shutter events and lost frames, for which a camera repeats an image.

Every few minutes a microbolometer closes a shutter and renews its offsets (flat-field correction,
FFC). Its driver repeats the last image meanwhile, and then each pixel has a new offset. A lost
frame is repeated once, and the offsets stay.
"""

from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _rows, schema
from dbthermal._arrays import Mask, stride

Integers = npt.NDArray[np.int64]

_MINIMUM_PIXELS: Final = 16  # changing pixels without which an unchanged image is no copy
# Copies in a row from which the shutter was closed; fewer are lost frames. A missed event biases
# the separation; lost frames counted as an event cost one degree of freedom a band.
FEWEST_COPIES: Final = 3
_SAMPLE = 4096  # pixels on an even grid that are compared first
_BLOCK = 4_000_000  # samples of a block of rows
_EVENT = ("band", "first_frame", "frames", "renewed")


def find_shutter(corrected: xr.Dataset, *, closed: xr.DataArray | None = None) -> xr.Dataset:
    """Find the runs of frames in which a band repeats its image.

    A frame is a copy if no pixel differs from the frame before: some thousands of pixels first,
    then the whole image in blocks of rows. The search is exact only before anything is interpolated
    in time.

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
    without a frame between, are one step. An event before the first or after the last valid frame
    makes none.

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
    kept = xr.DataArray(~marked, dims=("band", "time"), coords={"band": counts["band"]})
    result = corrected.assign(
        counts=counts.where(kept).assign_attrs(counts.attrs),
        segment=("time", segment, schema.SEGMENT.attrs),
    )
    number, taken = int(renewed.sum()), marked.sum(axis=1).tolist()
    return result.assign_attrs(
        shutter_events=number, repeated_frames=renewed.size - number, frames_taken_out=taken
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
    least = np.maximum(1, np.rint(numbers[slowest] / shown[slowest]))
    least = np.repeat(least, numbers[slowest]) * shown[slowest]
    kept = np.flatnonzero((place % shown[slowest] == 0) & (place < least))
    first, result = first[:, kept], capture.isel(time=kept)
    # Remaining copies (band, time). Frames of other bands exposed earlier get an `exposure_time`.
    duplicate = np.diff(first, axis=1, prepend=-1) == 0
    if np.any((first != kept) & ~duplicate):
        even = capture["time"].astype(np.float64).expand_dims(band=counts["band"])
        stamps = np.take_along_axis(capture.get("exposure_time", even).values, first, axis=1)
        stamps = np.where(duplicate, np.nan, stamps)
        result = result.assign(exposure_time=(("band", "time"), stamps, schema.EXPOSURE_TIME.attrs))
    pairs = zip(counts["band"].values, shown, strict=True)
    label = ", ".join(f"{number} times in band '{band}'" for band, number in pairs if number > 1)
    said = f"Each frame is repeated, {label}: a stream faster than its sensor. One of each is kept"
    return schema.warned(result, said), duplicate


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
        needed = np.union1d(candidates, candidates - 1)
        after, before = (np.searchsorted(needed, frame) for frame in (candidates, candidates - 1))
        for rows in _rows.blocks((needed.size, *counts.shape[1:]), _BLOCK):
            block = counts.isel(time=needed, y=rows).values
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
