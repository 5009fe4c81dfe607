"""Bad pixels that only a capture shows: noisy, stuck, clipped, frozen or jumping by themselves.

They turned bad after the calibration, or blink (random telegraph signal) too seldom for it.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import maximum_filter, maximum_filter1d, median_filter

from dbthermal import _arrays, _numbers, _samples, schema
from dbthermal._arrays import Array, Mask, quotient
from dbthermal.correction._nonuniformity import OUTLIER, outlying
from dbthermal.noise import MAD, MINIMUM_FRAMES
from dbthermal.schema import Status

Single = npt.NDArray[np.float32]

_WINDOW = 5  # width of the median that gives the noise around a pixel
_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
# A neighbour with this share of a jump, earlier or later by at most so long, sees it too.
_SHARED, _REACH_SECONDS, _REACH_FRAMES = 0.3, 0.2, 5
_LONGEST_GAP: Final = 2  # samples in a row that may be NaN within a jump
# Least ratio of the pattern over one pixel to that over two, where detail of a blurred scene has
# less; and pattern over the noise of a frame from which a warning is given [1].
_WHITE, _PATTERN = 0.7, 5.0
_SMOOTH: Final = 1.0 + 0.75**2  # variance of a new pattern with its smooth part, over that without
_UNCORRECTED: Final = (
    "Fixed pattern of {} times the noise of a frame: the pixels differ from each other as without "
    "a correction of gain and offset, with an old one, or with files of bands exchanged. Must be "
    "below 5: correct the raw capture with gain and offset of these cameras, as of 'calibrate', "
    "renewed since the shutter's last event; no flag and no error bar has this error"
)
_BLOCK = 8_000_000  # samples of a block


def mark_bad(corrected: xr.Dataset, *, threshold: float = OUTLIER) -> xr.Dataset:
    r"""Mark pixels that are noisy, stuck or jump by themselves, in any band.

    Noise. A pixel's noise s is the mean magnitude of the smaller four fifths of its second
    differences in time, free of object and reflections. With m its median over 5 by 5 pixels, a
    pixel is bad if :math:`\ln (s / m)` lies more than `threshold` robust standard deviations off
    the median of the image, or if it never changes.

    Jumps. A pixel is bad if it changes between two frames by more than `threshold` standard
    deviations of a difference, :math:`\sqrt 2 m`, and no neighbour changes in the same direction by
    0.3 of it within 0.2 s or five frames, the longer. Steps between segments and the same time at
    either end do not count; a jump across up to two NaN samples does. Detail one pixel wide, such
    as a wire, cannot be told from a pixel that blinks, and is marked, too.

    Pattern. What the mean picture has beside planes and edges is the fixed pattern p of gains and
    offsets, by the mask of Immerkaer (1996, doi:10.1006/cviu.1996.0060); 0 where it is less than
    0.7 of the same over two pixels, as of detail behind a lens. More than 5 m in every segment give
    a UserWarning. A pattern that came since the calibration is seen so, beyond `pattern_std` and
    the noise of the mean, in the segment with the least. It is added to `pattern_std`, with a
    smooth part of 0.75 times its size, as of a lens or housing that warmed: no image tells that
    from the scene, it is a prior.

    TypeError or ValueError if the threshold is not positive, or a band has fewer frames that are
    not NaN than 16, or than 0.4 s and three frames more, or no pixel with 16 samples.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, after `mark_shutter`; read in blocks of rows.
    threshold : float
        Limit of the robust z-score of the noise, and of a jump over the noise of a difference [1].

    Returns
    -------
    Dataset
        The dataset with the bit `Status.DEAD_PIXEL` set in `status` (y, x), the counts unchanged;
        `pattern_std` (band) [count]; and the attributes ``noisy_pixels`` and ``jumping_pixels``,
        their numbers, ``unjudged_pixels``, those with fewer than 16 samples that are not NaN in a
        band, which get no bit here, ``bad_threshold``, and ``fixed_pattern`` (band), p / m [1].

    Examples
    --------
    One pixel blinks: it is 80 counts too high for a second.

    >>> import numpy as np, xarray as xr
    >>> counts = np.random.default_rng(1).normal(20000, 4, (1, 60, 12, 12))  # [count]
    >>> counts[0, 30:40, 5, 7] += 80
    >>> axes = {"band": ["8-14"], "time": np.arange(60) / 10.0}
    >>> capture = xr.DataArray(counts, axes, ("band", "time", "y", "x")).to_dataset(name="counts")
    >>> marked = mark_bad(capture)
    >>> np.argwhere(marked.status.values).tolist(), marked.jumping_pixels
    ([[5, 7]], 1)
    """
    counts = schema.check_corrected(corrected)["counts"]
    threshold = _numbers.real_number("threshold of bad pixels", threshold, _numbers.POSITIVE)
    image = (counts.sizes["y"], counts.sizes["x"])
    noisy, jumping, unjudged = np.zeros((3, *image), dtype=bool)
    patterns, stds = list[float](), np.zeros(counts.sizes["band"])
    if "pattern_std" in corrected:
        stds = np.nan_to_num(corrected["pattern_std"].values)
    # Frames within which a neighbour may change as well: 0.2 s or five frames, the longer.
    time, reach = counts["time"].values.astype(np.float64), _REACH_FRAMES
    if time.size >= MINIMUM_FRAMES:
        reach = max(reach, int(np.ceil(_REACH_SECONDS / float(np.median(np.diff(time))))))
    for band in range(counts.sizes["band"]):
        movie = counts.isel(band=band)
        frames = _frames(movie, max(MINIMUM_FRAMES, 2 * reach + 3))
        segment_numbers = schema.segments(corrected)[frames]
        movie, stepped = movie.isel(time=frames), np.diff(segment_numbers) != 0
        segments = np.unique(segment_numbers)
        # Noise and mean picture of each pixel, some at a time.
        level, still = np.empty(image), np.empty((segments.size, *image))
        for window in _arrays.windows(movie.shape, _BLOCK):
            block = _measured(movie, *window)
            level[window] = _samples.noise(block)
            still[:, *window] = [_mean(block[segment_numbers == number]) for number in segments]
        judged = np.isfinite(level)
        if not judged.any():
            label = f"Invalid band '{movie['band'].item()}': no pixel has {MINIMUM_FRAMES} samples"
            raise ValueError(f"{label} that are not NaN. Must have them, to be judged.")
        # Noise around each pixel.
        unjudged |= ~judged
        usual = np.where(judged, level, np.median(level[judged]))
        usual = median_filter(usual, size=_WINDOW, mode="mirror")
        noise = float(np.median(usual))  # 0 of counts without noise
        pattern = list(map(_pattern, still))
        patterns.append(min(pattern) / noise if noise > 0.0 else 0.0)
        # Of a mean of n frames, noise^2 / n is no pattern.
        number = [np.count_nonzero(segment_numbers == segment) for segment in segments]
        excess = min(np.square(pattern) - noise**2 / np.array(number)) - stds[band] ** 2
        stds[band] = np.sqrt(stds[band] ** 2 + _SMOOTH * max(excess, 0.0))
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(level / usual)  # minus infinity where nothing changes
        noisy |= outlying(logarithm, np.isfinite(logarithm), threshold) | (level == 0)
        jumping |= _jumps(movie, threshold * np.sqrt(2.0) * usual, stepped, reach)
    status = schema.pixel_status(corrected) | (noisy | jumping) * np.uint32(Status.DEAD_PIXEL)
    result = corrected.assign(
        status=(("y", "x"), status, Status.cf_attrs(schema.STATUS)),
        pattern_std=("band", stds, schema.PATTERN_STD.attrs),
    )
    # Warn of a strong pattern, and state what was found.
    pairs = zip(corrected["band"].values, patterns, strict=True)
    strong = [f"{std:.3g} in band '{name}'" for name, std in pairs if std > _PATTERN]
    marked = {"noisy_pixels": noisy, "jumping_pixels": jumping, "unjudged_pixels": unjudged}
    numbers = {name: int(mask.sum()) for name, mask in marked.items()}
    fixed = [round(pattern, 3) for pattern in patterns]
    result = schema.warned(result, *([_UNCORRECTED.format(", ".join(strong))] if strong else []))
    return result.assign_attrs(numbers, bad_threshold=threshold, fixed_pattern=fixed)


def _mean(block: Single) -> Array:
    """Mean picture (y, x) of frames (time, y, x); NaN of pixels without a sample."""
    finite = np.isfinite(block)
    total = block.sum(axis=0, dtype=np.float64, where=finite)
    return np.asarray(quotient(total, finite.sum(axis=0), np.nan))


def _pattern(image: Array) -> float:
    """Deviation of the fixed pattern of a picture (y, x) [count]; 0 if it may be detail."""
    scales = []
    for step in (1, 2):
        rows = image[: -2 * step] - 2.0 * image[step:-step] + image[2 * step :]
        mask = rows[:, : -2 * step] - 2.0 * rows[:, step:-step] + rows[:, 2 * step :]
        finite = np.abs(mask[np.isfinite(mask)])
        scales.append(MAD * float(np.median(finite)) / 6.0 if finite.size else 0.0)
    return scales[0] if scales[0] >= _WHITE * scales[1] else 0.0


def mark_repeats(corrected: xr.Dataset, raw: xr.DataArray, *, shutter: bool) -> xr.Dataset:
    """Mark pixels that are clipped below the end of the raw counts, or frozen for a while."""
    saturated, frozen = np.zeros((2, raw.sizes["y"], raw.sizes["x"]), dtype=bool)
    row = corrected["counts"].isel(y=slice(1)).values  # a frame is measured as a whole
    # Raw counts (band, time, y, x) are not rounded yet; frames that are NaN after the correction do
    # not count. Frozen pixels are told only where frames of a closed shutter were taken out.
    for movie, frames in zip(raw, np.isfinite(row).any(axis=(2, 3)), strict=True):
        clipped, still = _repeats(movie, frames)
        saturated |= clipped
        frozen |= still & shutter
    bits = saturated * np.uint32(Status.SATURATED) | frozen * np.uint32(Status.FROZEN_FRAMES)
    status = corrected["status"].values.astype(np.uint32) | bits
    variable = ("y", "x"), status, Status.cf_attrs(schema.STATUS)
    return corrected.assign(status=variable).assign_attrs(
        saturated_pixels=int(np.count_nonzero(status & np.uint32(Status.SATURATED))),
        frozen_pixels=int(frozen.sum()),
    )


def _repeats(movie: xr.DataArray, frames: Mask) -> tuple[Mask, Mask]:
    """Clipped and frozen pixels (y, x) of a band, from raw counts (time, y, x) at `frames`."""
    image = (movie.sizes["y"], movie.sizes["x"])
    step = max(1, image[1] // _samples.PIXELS)
    middle = movie.isel(y=image[0] // 2, x=slice(None, None, step)).values
    grain = _samples.grain(middle, np.ones(middle.shape, dtype=bool))
    (clipped, frozen), ends = np.zeros((2, *image), dtype=bool), np.zeros((2, 3, *image))
    for rows, columns in _arrays.windows(movie.shape, _BLOCK):
        counts = movie.isel(y=rows, x=columns).values.reshape(len(movie), -1)
        shape = (-1, columns.stop - columns.start)
        valid = np.broadcast_to(frames[:, np.newaxis], counts.shape)
        still = _samples.frozen(_samples.repeated(counts, valid), grain.chance)
        frozen[rows, columns] = still.reshape(shape)
        for highest in (False, True):
            end, number = _samples.end_of(counts, valid, highest=highest)
            statistics = (end, number, _samples.near_end(counts, valid, end, grain))
            ends[int(highest), :, rows, columns] = np.reshape(statistics, (3, *shape))
    moving = ends[0, 0] < ends[1, 0]
    for sign, (end, number, near) in zip((-1, 1), ends, strict=True):
        clipped |= moving & _samples.is_heap(number, near, grain)
        # A level at which several pixels have their extremes is the camera's: it clips all of them.
        level = end == sign * np.max(sign * end[moving], initial=-np.inf)
        many, about = (values[level].sum() + 1 - level.sum() for values in (number, near))
        clipped |= level & _samples.is_heap(many, about, grain)  # one sample of each makes its end
    return clipped, frozen & moving


def _frames(movie: xr.DataArray, fewest: int) -> npt.NDArray[np.int64]:
    """Indices of the frames of a band that are not NaN."""
    finite = np.zeros(movie.sizes["time"], dtype=bool)
    for rows, columns in _arrays.windows(movie.shape, _BLOCK):
        finite |= np.isfinite(movie.isel(y=rows, x=columns).values).any(axis=(1, 2))
    if finite.sum() < fewest:
        step = float(np.median(np.diff(movie["time"].values))) if finite.size > 1 else np.nan
        raise ValueError(
            f"Invalid band '{movie['band'].item()}' of {finite.sum()} frames that are not NaN. "
            f"Must have at least {fewest}, to judge a pixel by changes within "
            f"{_REACH_SECONDS} s of a 'time' in steps of {step:.3g} s."
        )
    return np.flatnonzero(finite)


def _measured(movie: xr.DataArray, rows: slice, columns: slice) -> Single:
    """Counts of some rows and columns, NaN where they are no measurement."""
    counts = movie.isel(y=rows, x=columns).values
    return np.where(schema.measured(counts), counts, np.nan).astype(np.float32)


def _jumps(movie: xr.DataArray, limit: Array, stepped: Mask, reach: int) -> Mask:
    """Pixels (y, x) that change by more than their limit [count] while no neighbour does."""
    jumping = np.zeros(limit.shape, dtype=bool)
    for rows, columns in _arrays.windows(movie.shape, _BLOCK):
        # A pixel at the edge of a block needs its neighbours in the next one.
        top, start = max(rows.start - 1, 0), max(columns.start - 1, 0)
        wide = slice(top, rows.stop + 1), slice(start, columns.stop + 1)
        inner = slice(rows.start - top, rows.stop - top), slice(columns.start - start, None)
        changes = _changes(_measured(movie, *wide), stepped)
        for sign in (1.0, -1.0):
            change, total = (np.float32(sign) * difference for difference in changes)
            isolated = _isolated(change, total, limit[wide], reach)[inner]
            jumping[rows, columns] |= isolated[:, : columns.stop - columns.start]
    return jumping


def _changes(signal: Single, stepped: Mask) -> tuple[Single, Single]:
    """Changes from the last valid sample, per frame and in total, 0 where offsets are renewed."""
    valid = np.isfinite(signal)
    if valid.all():
        change = np.diff(signal, axis=0)
        change[stepped] = 0.0
        return change, change
    places = np.arange(len(signal))[:, np.newaxis, np.newaxis]
    previous = np.maximum.accumulate(np.where(valid, places, 0), axis=0)[:-1]
    with np.errstate(invalid="ignore"):
        change = signal[1:] - np.take_along_axis(signal, previous, axis=0)
    segment = np.concatenate([[0], np.cumsum(stepped)])
    change[(segment[places[1:]] != segment[previous]) | ~np.isfinite(change)] = 0.0
    gap = (places[1:] - previous).astype(np.float32)
    return np.where(gap > _LONGEST_GAP + 1, np.float32(0.0), change / gap), change


def _isolated(change: Single, total: Single, limit: Array, reach: int) -> Mask:
    """Pixels (y, x) that jump by more than their limit in a frame in which no neighbour does."""
    nearby = maximum_filter1d(total, 2 * reach + 1, axis=0, mode="constant")
    strongest = maximum_filter(nearby, footprint=_NEIGHBOURS[np.newaxis], mode="constant")
    jumps = (change > limit) & (strongest < _SHARED * change)
    return np.asarray(np.any(jumps[reach:-reach], axis=0))
