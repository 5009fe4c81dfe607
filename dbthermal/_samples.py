r"""Quality of samples: noise, saturated and frozen samples by their values, subsamples.

A camera that saturates heaps samples on the extreme value of a pixel; one that freezes repeats its
values. Whole counts do both by chance: with noise s and step q a sample takes one value with a
probability of at most

.. math:: c = q / (\sqrt{2 \pi} s)

so that k repeats in a row have a probability of :math:`c^k`, and of the samples within 2 s of an
end, where the density does not grow, at most q / 2 s lie on the last value. With s below 1.25 q
nothing is flagged.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import gaussian_filter1d, uniform_filter
from scipy.special import bdtrc, ndtri

from dbthermal._arrays import Array, Mask, stride
from dbthermal.noise import MINIMUM_FRAMES

_QUIET: Final = 0.8  # smallest share of a pixel's changes, that are noise
# Mean magnitude of that share of a standard normal distribution.
_QUIET_MEAN: Final = 2.0 * (1.0 - np.exp(-0.5 * ndtri(0.9) ** 2)) / np.sqrt(2.0 * np.pi) / _QUIET
_GAP: Final = 1.5  # deviation of the weights that fill a gap [pixel]
PIXELS: Final = 16  # pixels, about, from which noise and step of the counts are estimated
# Width of the mean over pixels of the noise of resampled counts, and steps in time.
_WIDTH, _STEPS = 5, 700
_AT_ONCE: Final = 2**17  # samples that are compared in one pass, to stay in the cache

_STILLEST: Final = 0.1  # share of the groups of frames with the least motion
_FEWEST_STILL: Final = 1000  # of them, for a noise within 3 %
# Ranks of the magnitudes that give the noise, and of the next ones; their mean in a normal
# distribution; and the ratio of both estimates from which it is no noise.
_RANKS: Final = np.array([0.0, 0.7, 0.95])
_DENSITY: Final = np.exp(-0.5 * ndtri(0.5 + 0.5 * _RANKS) ** 2) / np.sqrt(2.0 * np.pi)
_MEANS: Final = -2.0 * np.diff(_DENSITY) / np.diff(_RANKS)
_UNEQUAL: Final = 1.1
_LARGER: Final = 1.1  # ratio that contradicts a stated noise; of right ones 1.04 in 51 scenes
_MOTION_RATIO: Final = 20.0  # largest ratio of a motion between bands

_MARGIN: Final = 1.25  # on the probability of a value, for noise that differs between pixels
_COARSE: Final = 0.4  # probability of a value above which counts are too coarse to be judged
_FALSE_ALARM: Final = 1e-5  # probability that a good pixel or frame is flagged
FEWEST: Final = 3  # samples on one value, or repeats in a row, that are more than chance

_OFF_MULTIPLE: Final = 0.01  # distance from a multiple of the step at which a change is none
_END: Final = 2.0  # width [noise] of the end of a pixel's values


def noise(signal: npt.NDArray[Any]) -> Array:
    """Noise (pixel ...) of signals (time, pixel ...) with NaN; NaN for too few frames."""
    valid = np.isfinite(signal)
    frames = valid.sum(axis=0)
    if not valid.all():  # invalid samples of each pixel go behind the valid ones
        signal = np.take_along_axis(signal, np.argsort(~valid, axis=0, kind="stable"), axis=0)
    differences = np.abs(signal[1:-1] - 0.5 * (signal[:-2] + signal[2:]))
    differences.sort(axis=0)  # NaN last
    # The smaller four fifths of the changes are free of the object and of passing reflections.
    quiet = np.maximum((_QUIET * (frames - 2)).astype(np.intp), 1)
    mask = np.arange(len(differences)).reshape(-1, *(1,) * quiet.ndim) < quiet
    total = differences.sum(axis=0, dtype=np.float64, where=mask)
    return np.where(frames < MINIMUM_FRAMES, np.nan, total / quiet / (_QUIET_MEAN * np.sqrt(1.5)))


def larger_noise(signals: npt.NDArray[Any], stated: Array) -> Array:
    r"""Noise (band) where signals (band, time, pixel) prove more than stated (band), else NaN [K].

    Jumps at every frame are white, but occur in all bands. If the excess over the stated noise were
    motion, at most K times weaker in another band n, then

    .. math:: \overline{d_m d_n} \ge (s_m^2 - \sigma_m^2) / K, \quad K = 20

    A covariance that is smaller by three standard deviations proves noise; one band is enough.
    """
    # Without the frames that are copies; NaN differs from NaN.
    new = np.all([np.any(band[1:] != band[:-1], axis=1) for band in signals], axis=0)
    signals = signals[:, np.append(True, new)]
    bands, groups = len(signals), signals.shape[1] // 3
    if _STILLEST * (groups - 4) * signals.shape[2] < _FEWEST_STILL:
        return np.full(bands, np.nan)
    trios = signals[:, : 3 * groups].reshape(bands, groups, 3, -1)
    statistics = np.empty((3, bands, groups - 4, signals.shape[2]))
    step = max(16, _AT_ONCE // trios[:, 0].size)
    for start in range(0, groups - 4, step):
        stop = min(start + step, groups - 4)
        statistics[:, :, start:stop] = _differences(trios[:, start : stop + 4])
    rapid, change, surroundings = statistics.reshape(3, bands, -1)
    # Select the stillest tenth of the groups by the differences around each group, in all bands:
    # noise within the group keeps its distribution.
    valid = np.all(np.isfinite(rapid) & (surroundings > 0), axis=0)  # NaN is not
    number = int(_STILLEST * np.count_nonzero(valid))
    if number < _FEWEST_STILL:
        return np.full(bands, np.nan)
    motion = surroundings / np.median(surroundings[:, valid], axis=1, keepdims=True)
    stillest = np.argpartition(np.where(valid, motion.sum(axis=0), np.inf), number)[:number]
    still, middle, end = rapid[:, stillest], *(_RANKS[1:] * number).astype(np.intp)
    # Noise from the smaller seven tenths of the magnitudes. It is not proved if it is larger in the
    # next quarter, where rare motion shows first, or in the slopes of neighbouring groups.
    ordered = np.sort(np.abs(still), axis=1)
    noise = ordered[:, :middle].mean(axis=1) / _MEANS[0]
    quarter = ordered[:, middle:end].mean(axis=1) / _MEANS[1]
    slower = np.sort(np.abs(change[:, stillest]), axis=1)[:, :middle].mean(axis=1) / _MEANS[0]
    inner = still[:, np.all(np.abs(still) < ordered[:, end : end + 1], axis=0)]
    # Covariance between the bands below that of motion proves noise.
    shared = np.cov(inner) + 3.0 * np.outer(noise, noise) / np.sqrt(number)
    np.fill_diagonal(shared, np.inf)
    proved = np.any(shared < (noise**2 - stated**2)[:, np.newaxis] / _MOTION_RATIO, axis=1)
    candidates = (np.maximum(quarter, slower) < _UNEQUAL * noise) & (noise > _LARGER * stated)
    return np.where(candidates & np.any(candidates & proved), noise, np.nan)


def _differences(trios: npt.NDArray[Any]) -> tuple[Array, Array, Array]:
    """Second differences of groups (band, group, 3, pixel), of their slopes, and surroundings."""
    inner = trios.shape[1] - 4
    means = trios.mean(axis=2)
    rapid = (trios[:, :, 1] - 0.5 * (trios[:, :, 0] + trios[:, :, 2])) / np.sqrt(1.5)
    slope = (trios[:, :, 2] - trios[:, :, 0]) / np.sqrt(2.0)
    change = (slope[:, 2:-2] - 0.5 * (slope[:, 1:-3] + slope[:, 3:-1])) / np.sqrt(1.5)
    third = means[:, 4:] - means[:, :-4] - 2.0 * (means[:, 3:-1] - means[:, 1:-3])
    # A step raises the third difference of the means. A mean of three has a third of the noise's
    # variance, their third difference 10 times that.
    surroundings = 0.3 * third**2
    for first in (0, 1, 3, 4):
        surroundings += rapid[:, first : first + inner] ** 2
    return rapid[:, 2:-2], change, surroundings


def resampled_noise(
    counts: npt.NDArray[Any], resampled: npt.NDArray[Any], stated: Array, width: int
) -> Array:
    """Noise (pixel) [1] of resampled counts over the stated one, 1 where none is stated."""
    usual = np.mean(_roughness(counts) ** 2, axis=1) ** 0.5
    roughness = (_roughness(resampled) / usual[:, np.newaxis]).mean(axis=0)
    ratio = np.divide(roughness, stated, out=np.zeros_like(stated), where=stated > 0.0)
    ratio = ratio.reshape(-1, width)
    mean, share = (uniform_filter(image, _WIDTH) for image in (ratio, (ratio > 0.0) * 1.0))
    return np.asarray(np.divide(mean, share, out=np.ones_like(mean), where=ratio > 0.0).ravel())


def _roughness(counts: npt.NDArray[Any]) -> Array:
    """Median change (band, pixel) [count] of counts (band, time, pixel) from frame to frame."""
    sampled = slice(None, None, max(1, counts.shape[1] // _STEPS))
    steps = np.abs(counts[:, 1:][:, sampled] - counts[:, :-1][:, sampled])
    return np.asarray(np.median(steps, axis=1, overwrite_input=True))


def some_pixels(counts: xr.DataArray, pixels: int = PIXELS) -> npt.NDArray[Any]:
    """Read counts (band, time, pixel) of a few pixels, evenly spaced, of (band, time, y, x)."""
    step = stride((counts.sizes["y"], counts.sizes["x"]), pixels)
    sample = counts[:, :, ::step, ::step].values  # of a lazy capture no more than these
    return np.asarray(sample.reshape(*sample.shape[:2], -1))


def rounding_std(counts: npt.NDArray[Any]) -> Array:
    """Rounding (band) [count], step / sqrt(12), of counts (band, time, pixel); 0 without a step."""
    if counts.shape[1] < MINIMUM_FRAMES:
        return np.zeros(len(counts))
    size = max(16, _AT_ONCE // counts[:, 0].size)
    spans = [slice(start, start + size + 1) for start in range(0, counts.shape[1] - 1, size)]
    step = np.full((len(counts), counts.shape[2]), np.inf)
    with np.errstate(invalid="ignore"):  # infinite counts are no rounded ones
        for span in spans:
            change = _changes(counts[:, span])
            step = np.minimum(step, np.where(change > 0, change, np.inf).min(axis=1))
        rounded = np.isfinite(step)  # (band, pixel)
        for span in spans:
            if not rounded.any():  # as soon as is known
                break
            change = _changes(counts[:, span]) / step[:, np.newaxis]
            rounded &= ~np.any(np.abs(change - np.rint(change)) > _OFF_MULTIPLE, axis=1)
    return np.asarray(np.median(np.where(rounded, step, 0.0), axis=1) / np.sqrt(12.0))


def _changes(counts: npt.NDArray[Any]) -> Array:
    """Magnitude of the changes between frames of counts (band, time, pixel), which may hold NaN."""
    change = np.diff(counts.astype(np.float64), axis=1)
    return np.abs(change, out=change)


@dataclass(frozen=True)
class Grain:
    """Noise [count] of a band, and the probability that a sample takes some one value."""

    noise: float
    chance: float  # 1 if the counts are too coarse to tell


def grain(counts: npt.NDArray[Any], valid: Mask, stated: float = np.inf) -> Grain:
    """Grain of counts (time, pixel) of a band; a stated noise [count] is an upper limit."""
    sampled = slice(None, None, max(1, counts.shape[1] // PIXELS))
    sample = np.where(valid[:, sampled], counts[:, sampled].astype(np.float64), np.nan)
    changing = np.any(sample[1:] != sample[:-1], axis=1)  # true for NaN
    if sample.shape[1] >= PIXELS:
        sample = sample[np.concatenate([[True], changing])]
    if len(sample) < MINIMUM_FRAMES:
        return Grain(stated, 1.0)
    change = np.abs(np.diff(sample, axis=0))
    step = np.min(change, axis=0, initial=np.inf, where=change > 0)
    for reduced in (np.fmin.reduce(sample, axis=0), np.fmax.reduce(sample, axis=0)):
        at_end = sample == reduced
        sample[at_end & (np.count_nonzero(at_end, axis=0) >= FEWEST)] = np.nan
    level = noise(sample)
    usable = (level > 0) & np.isfinite(step)
    if not usable.any():
        return Grain(stated, 1.0)
    std = min(stated, float(np.median(level[usable])))
    chance = _MARGIN * float(np.median(step[usable])) / (np.sqrt(2.0 * np.pi) * std)
    return Grain(std, chance if chance < _COARSE else 1.0)


def heaped(counts: npt.NDArray[Any], valid: Mask, band: Grain, ends: Any = (None, None)) -> Mask:
    """Clipped pixels of counts (time, pixel): many of their samples have the extreme value."""
    result = np.zeros(counts.shape[1], dtype=bool)
    if band.chance < 1.0:
        for highest in (False, True):
            end, number = end_of(counts, valid, highest=highest, plain=ends[int(highest)])
            (pixels,) = np.nonzero(number >= FEWEST)
            pixels = pixels[number[pixels] < valid[:, pixels].sum(axis=0)]
            trials = near_end(counts[:, pixels], valid[:, pixels], end[pixels], band)
            result[pixels] |= is_heap(number[pixels], trials, band)
    return result


def end_of(
    counts: npt.NDArray[Any], valid: Mask, *, highest: bool, plain: Any = None
) -> tuple[npt.NDArray[Any], npt.NDArray[np.intp]]:
    """Highest or lowest value (pixel) of counts (time, pixel), and the number of samples there."""
    used = True if valid.all() else valid  # numpy's reductions are slower with a mask
    if used is True and plain is not None:
        end = plain
    elif used is True:
        end = counts.max(axis=0) if highest else counts.min(axis=0)
    elif highest:
        end = counts.max(axis=0, where=valid, initial=counts.min(initial=0))
    else:
        end = counts.min(axis=0, where=valid, initial=counts.max(initial=0))
    return end, counted(counts == end if used is True else (counts == end) & valid)


def counted(mask: Mask) -> npt.NDArray[np.intp]:
    """Number (pixel) of samples (time, pixel) that are true."""
    # Bytes, as many as cannot overflow, add up many times faster than truth values.
    longest, total = np.iinfo(np.uint8).max, np.zeros(mask.shape[1], dtype=np.intp)
    for start in range(0, len(mask), longest):
        total += mask[start : start + longest].view(np.uint8).sum(axis=0, dtype=np.uint8)
    return total


def near_end(
    counts: npt.NDArray[Any], valid: Mask, end: npt.NDArray[Any], band: Grain
) -> npt.NDArray[np.intp]:
    """Number (pixel) of samples of counts (time, pixel) about an end, within some noise."""
    distance = np.abs(counts.astype(np.float64) - end)
    return np.asarray(np.count_nonzero((distance < _END * band.noise) & valid, axis=0))


def is_heap(number: npt.ArrayLike, near: npt.ArrayLike, band: Grain) -> Mask:
    """Return where samples at an end, out of those near it, are more than noise puts there."""
    share = min(1.0, np.sqrt(2.0 * np.pi) * band.chance / _END)
    # The first sample makes the end; bdtrc is the tail of the binomial distribution.
    chance = bdtrc(np.asarray(number) - 2, np.asarray(near, dtype=np.intp) - 1, share)
    return np.asarray(chance < _FALSE_ALARM)


def repeated(counts: npt.NDArray[Any], valid: Mask) -> Mask:
    """Samples (time - 1, pixel) of counts (time, pixel) that repeat the one before."""
    equal = counts[1:] == counts[:-1]
    return np.asarray(equal if valid.all() else equal & valid[1:] & valid[:-1])


def frozen(repeats: Mask, chance: float) -> Mask:
    """Pixels (pixel) of which more `repeated` samples follow one another than noise makes."""
    length = _needed(len(repeats) + 1, chance)
    if length > len(repeats):
        return np.zeros(repeats.shape[1], dtype=bool)
    run, reach = repeats, 1
    while reach < length:
        shift = min(reach, length - reach)
        run = run[:-shift] & run[shift:]
        reach += shift
    return np.asarray(run.any(axis=0))


def copies(repeats: Mask, chance: float, valid: Mask) -> Mask:
    """Frames (time) in which all changing pixels repeat, and more of them than noise makes."""
    least = _needed(len(valid), chance)
    # Bytes add up faster than truth values; nearly always the repeats are too few.
    if not np.any(repeats.view(np.uint8).sum(axis=1, dtype=np.uint32) >= least):
        return np.zeros(len(valid), dtype=bool)
    moving = ~repeats.all(axis=0)
    comparable = moving if valid.all() else valid[1:] & valid[:-1] & moving
    copied = np.all(repeats | ~comparable, axis=1) & (comparable.sum(axis=-1) >= least)
    return np.concatenate([[False], copied])


def _needed(frames: int, chance: float) -> int:
    """Fewest repeats together that noise does not make in so many frames."""
    if chance == 1.0:
        return np.iinfo(np.int32).max
    tiny = np.finfo(np.float64).tiny
    return max(FEWEST, int(np.ceil(np.log(_FALSE_ALARM / frames) / np.log(max(chance, tiny)))))


@lru_cache(maxsize=32)
def gaussian(size: int, width: float, mode: str = "reflect") -> Array:
    """Matrix (place, pixel) that blurs a row of pixels by a Gaussian [pixel]."""
    # Of rows of up to 600 pixels, products of matrices are as fast as a filter, or faster.
    return np.asarray(gaussian_filter1d(np.eye(size), width, axis=0, mode=mode))


def neighbour_mean(
    values: npt.NDArray[np.floating], weight: npt.NDArray[np.floating], width: float
) -> Array:
    """Weighted mean (..., y, x) around each pixel by a Gaussian [pixel]; NaN without a weight."""
    weight = np.where(np.isfinite(values), weight, 0.0)
    rows, columns = (gaussian(size, width, "constant") for size in values.shape[-2:])
    weighted = weight * np.nan_to_num(values), weight
    total, weights = (rows @ images @ columns.T for images in weighted)
    empty = np.full(total.shape, np.nan)
    return np.asarray(np.divide(total, weights, out=empty, where=weights > 0))


def without_gaps(image: npt.NDArray[Any], valid: Mask) -> npt.NDArray[Any]:
    """Image (y, x) whose pixels that are not valid are the mean around; zero without any."""
    if valid.all():
        return image
    return np.where(valid, image, np.nan_to_num(neighbour_mean(image, valid * 1.0, _GAP)))
