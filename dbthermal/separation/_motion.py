r"""Cameras that move: the image's motion, told by what it does to a separation, and undone.

The bands' null combination holds no reflection, but the motion s of each band's image, times the
gradient of its mean:

.. math:: r(t) = \sum_b w_b \, s_b(t) \cdot \nabla \bar z_b

where an image is displaced, turned and enlarged as a whole, s(x) = d + A (x - m) about its middle.
Rapid motion is told frame by frame from what smooth functions of time leave of the combination, at
the ratio with which each pixel leaves least: Gauss-Newton steps over windows of the image, with a
prior for s, as cameras on one support move alike. Slow motion the object takes up: the deviations
hold what is expected of it, from the motion in the next octave of time. Where only one band's image
moves slowly, its reflections h move against those of the first band, beside a delay of the clocks:

.. math:: h_b / k_b - h_1 = s_b(t) \cdot \nabla h_1 + \tau(t) \, \partial_t h_1

Noise c that whole frames of a band have in common is the same sum, of c for s times the gradient.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Final, NamedTuple

import numpy as np
import xarray as xr
from scipy.ndimage import binary_erosion

from dbthermal import _smooth as smooth
from dbthermal._arrays import Array, Mask, quotient
from dbthermal._samples import without_gaps
from dbthermal.schema import Status
from dbthermal.separation._apart.equations import smooth_functions
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._misfit import Misfit, Reading, Whole, object_weights
from dbthermal.separation._overlay import (
    PARAMETERS,
    SURE,
    Moved,
    along,
    gradients,
    jackknife,
    moved,
    places_of,
    resampled,
    size_of,
    solved,
    sources_of,
)

# Prior deviations [pixel] of rapid motion that the bands share, or do not; and of slow motion.
_JOINT_STD, _BAND_STD, _TURN = 3.0, 0.1, 1.0
# Square of rapid motion over its variance by a jackknife of windows, median over the frames, from
# which it is undone: at most 2 without any, 4.5 where heat spreads; 9 to 28 of 0.3 pixel, 7 to 10
# of a turn by 0.6 degrees.
_SHAKEN: Final = 6.0
_SLOW: Final = 3  # smooth functions in which the image's gradients change
_THRESHOLD: Final = 0.1  # motion of a band that matters, rms [pixel]: two depths feign 0.06
# Of rapid motion: side of a window, least and most, and what is read around it [pixel]; samples of
# a band at most; number of steps, the longest, and their rms that ends them [pixel].
_SIDES, _MARGIN, _SAMPLES = (8, 32), 6, 2**24
_TURNS, _STEP, _SETTLED = 6, 2.0, 0.02
_SEARCHED, _REPEATS = 2, 2  # turns in which ratios are sought, and rounds of the weights
# Tried ratios of reflectivities; variance, over that of noise, of a pixel that counts half.
_RATIOS: Final = np.exp(np.append(np.linspace(-1.2, -0.15, 4), np.linspace(0.15, 1.5, 9)))
_HALF: Final = 4.0
# Flags that motion brings about, and the share of the pixels that have them, or a remainder: of
# plain scenes up to 0.05 have it.
_DISTURBED: Final = Status.OBJECT_NOT_SMOOTH | Status.OBJECT_JUMP | Status.BANDS_APART
_SHARE: Final = 0.1
# Of slow motion: polynomials of the time, windows along a side of the image, and frames at most. As
# the slower weigh more, a drift of one pixel shows a square of 30 to 138 in six scenes; 108 scenes
# without, of 18 situations, at most 11; 30 of 24x32 pixels up to 93, but of less than 0.06 pixel.
_DEGREES, _WINDOWS, _FRAMES = 6, 4, 128


@dataclass(frozen=True)
class Stabilised(Moved):
    """A capture whose frames lie on one another, and have no noise in common."""

    levels: Array  # of whole frames (band, time) [K]
    wander: Array  # covariance of what is expected of them in smooth functions (band, band) [K^2]

    def detail(self, inputs: Inputs, result: xr.Dataset) -> Array:
        """Deviation (y, x) [K] of the object's signal by the motion and the levels left."""
        weights = object_weights(inputs, result)
        square = np.einsum("ayx,byx,ab->yx", weights, weights, self.wander)
        return np.asarray(np.hypot(super().detail(inputs, result), np.sqrt(square)))

    def sentence(self, *, undone: bool) -> str:
        """Sentence on how far the image of each band moved, and on the frames' levels."""
        texts = list[str]()
        for text, unit, sizes in (
            ("The image moved", "pixel", [size_of(path) for path in self.motion]),
            ("The level of whole frames varied", "K", np.std(self.levels, axis=1)),
        ):
            pairs = zip(self.capture["band"].values, sizes, strict=True)
            values = ", ".join(f"'{band}' {size:.2g}" for band, size in pairs)
            texts += [f"{text}, by {values} {unit} (rms)"] if np.any(sizes) else []
        outcome = "was undone" if undone else "could not be undone: intervals may be too small"
        return f"{'; '.join(texts)}, which {outcome}."


def stabilise(
    corrected: xr.Dataset,
    inputs: Inputs,
    result: xr.Dataset,
    misfit: Misfit,
    before: Stabilised | None = None,
) -> Stabilised | None:
    """Move each frame back by the cameras' motion, less its level; None if there is neither."""
    shape, status = corrected["counts"].shape, result["status"].values
    steps, slow = np.zeros((*shape[:2], PARAMETERS)), np.zeros(PARAMETERS)
    disturbed = np.mean((status & np.uint32(_DISTURBED)) != 0) > _SHARE
    remainder = ((misfit.leak > 0.0) | (misfit.change > 0.0)) & (status == 0)
    if before is None and (disturbed or remainder.sum() > _SHARE * np.count_nonzero(status == 0)):
        steps = _rapid(corrected, inputs)
        # In the smooth functions as much motion is expected as in the next octave of time.
        time = inputs.capture["time"].values.astype(np.float64)
        order = min(smooth.HIGHEST_ORDER, time.size // 4)
        octave = smooth.polynomial_basis(time, 2 * order)[:, order:]
        slow = np.sqrt(np.sum((octave.T @ steps.mean(axis=0)) ** 2, axis=0) / time.size)
    steps[..., :2] += _slow(inputs, misfit)
    levels, wander = _levels(inputs, misfit)
    motion = steps if before is None else steps + before.motion
    if not np.any(steps) or max(map(size_of, motion)) < _THRESHOLD:
        motion, slow = motion - steps, 0.0 * slow
        if not levels.any():
            return None
    levels += 0.0 if before is None else before.levels
    capture = moved(corrected, inputs, motion) if motion.any() else corrected
    slopes = np.array([curve.reference_slope for curve in inputs.curves])
    offsets = (levels * slopes[:, np.newaxis])[..., np.newaxis, np.newaxis].astype(np.float32)
    counts = np.subtract(capture["counts"].values, offsets, dtype=np.float32)
    capture = capture.assign(counts=capture["counts"].copy(data=counts))
    return Stabilised(capture, motion, slow, levels, wander)


def _levels(inputs: Inputs, misfit: Misfit) -> tuple[Array, Array]:
    """Levels (band, time) [K] of whole frames, zero without any; covariance of slow ones."""
    time, bands = inputs.capture["time"].values.astype(np.float64), inputs.bands
    form, force = misfit.levels
    shape, prior = np.diag(inputs.noise[bands]), np.eye(len(bands))
    shape = shape @ np.linalg.eigh(shape @ form.sum(axis=0) @ shape)[1]
    form, force = (shape.T @ form @ shape)[:, np.newaxis], np.swapaxes(force, 1, 2) @ shape
    # Functions of time above the smooth ones tell levels along directions of the bands' noise.
    functions, first = smooth.rapid(time)
    steps, variance = jackknife(form, functions.T @ force, prior, np.zeros((1, len(bands))))
    score = np.median(quotient(steps**2, variance, 0.0)[:first], axis=0)
    shape = shape * (score > SURE)
    levels, wander = (
        np.zeros((len(inputs.noise), size)) for size in (time.size, len(inputs.noise))
    )
    levels[bands] = shape @ solved(form.sum(axis=0) + prior, force.sum(axis=0)).T
    wander[np.ix_(bands, bands)] = (
        shape * smooth.energy_below(steps**2, first) / time.size @ shape.T
    )
    return levels, wander


class _Window(NamedTuple):
    """A window of the image, with what lies around it."""

    films: Array  # signals (band, frame, y, x) [K]
    used: Mask  # pixels of the window itself, without a flag (y, x)
    places: Array  # of `_places` (axis, y, x)


class _Changes(NamedTuple):
    """What smooth functions of time leave in the pixels of a window, and their gradients."""

    rapid: Array  # (band, frame, pixel) [K]
    slopes: Array  # of the slow image (band, parameter, function, pixel) [K / pixel]


def _rapid(corrected: xr.Dataset, inputs: Inputs) -> Array:
    """Motion (band, time, parameter) [pixel] of images that move rapidly; zero without any."""
    films, bands = corrected["counts"], inputs.bands
    motion = np.zeros((*films.shape[:2], PARAMETERS))
    frames = inputs.frames
    if np.count_nonzero(frames) < inputs.method.minimum_frames:
        return motion
    windows = list(_windows(films, inputs, frames))
    basis = smooth_functions(inputs.capture, frames).functions
    prior = _JOINT_STD**2 * np.ones((len(bands), len(bands))) + _BAND_STD**2 * np.eye(len(bands))
    precision = np.kron(np.linalg.inv(prior), np.eye(PARAMETERS))
    path = np.zeros((len(bands), len(basis), PARAMETERS))
    for turn in range(_TURNS):
        changes = [_changes(window, path, basis) for window in windows]
        if turn < _SEARCHED:  # motion hides the ratios until most of it is undone
            ratios = [_ratios(inputs, changes, place, basis) for place in range(1, len(bands))]
        pairs = [
            _equations(inputs, changes, ratio, place, basis, _REPEATS)
            for place, ratio in enumerate(ratios, 1)
        ]
        form, force = (np.sum([pair[index] for pair in pairs], axis=0) for index in (0, 1))
        # Is there motion? A growth is no evidence: spreading heat feigns growth, with up to 76.
        before = np.swapaxes(path, 0, 1).reshape(len(basis), -1)
        steps, variance = jackknife(form, force, precision, before)
        score = np.median(quotient(steps**2, variance, 0.0), axis=0).reshape(len(bands), -1)
        if turn == 0 and not np.any(score[:, :-1] > _SHAKEN):
            return motion
        steps = np.swapaxes(steps.reshape(-1, len(bands), PARAMETERS), 0, 1)
        path += np.clip(steps, -_STEP, _STEP)
        if np.sqrt(np.mean(steps**2)) < _SETTLED:
            break
    # The motion of lost frames is interpolated between the frames before and after.
    numbers, places = np.arange(frames.size), np.flatnonzero(frames)
    motion[bands] = np.apply_along_axis(lambda course: np.interp(numbers, places, course), 1, path)
    return motion


def _windows(films: xr.DataArray, inputs: Inputs, frames: Mask) -> Iterator[_Window]:
    """Yield windows of the image, of some frames (time), without gaps."""
    good, sides = inputs.good, []
    places = places_of(good.shape)
    longest = np.sqrt(_SAMPLES / np.count_nonzero(frames)) / _WINDOWS - 2 * _MARGIN
    for size in good.shape:
        side = max(1, min(int(np.clip(longest, *_SIDES)), size // _WINDOWS))
        starts = np.linspace(0, size - side, min(_WINDOWS, size)).astype(int)
        sides.append([slice(start, start + side) for start in starts])
    for y, x in product(*sides):
        margin = tuple(slice(max(0, span.start - _MARGIN), span.stop + _MARGIN) for span in (y, x))
        mask = np.zeros(good.shape, dtype=bool)
        mask[y, x] = good[y, x]
        counts = films.values[..., margin[0], margin[1]][inputs.bands][:, frames]
        signals = np.empty(counts.shape)
        for signal, film, band in zip(signals, counts, inputs.bands, strict=True):
            for frame, image in zip(signal, inputs.curves[band].linearise(film), strict=True):
                valid = good[margin] & np.isfinite(image)
                frame[:] = without_gaps(image - inputs.curves[band].reference, valid)
        yield _Window(signals, mask[margin], places[:, *margin])


def _changes(window: _Window, path: Array, basis: Array) -> _Changes:
    """Rapid changes of a window whose frames are moved by a path (band, frame, ...) [pixel]."""
    films = window.films
    if path.any():
        films = np.empty_like(films)
        for place in np.ndindex(path.shape[:2]):
            sources = sources_of(path[place], window.places)
            films[place] = resampled(window.films[place], sources)
    maps = np.einsum("tj,btyx->bjyx", basis[:, :_SLOW], films)
    signals = films[:, :, window.used]
    slopes = along(gradients(maps)[..., window.used], window.places[:, window.used])
    slopes = np.swapaxes(slopes, 0, 1)
    return _Changes(signals - basis @ (basis.T @ signals), slopes)


def _ratios(inputs: Inputs, changes: list[_Changes], place: int, basis: Array) -> list[Array]:
    """Ratio (pixel) of each window with which a pixel leaves least, of a band and the first one."""
    trials = []
    for ratio in _RATIOS:
        same = [np.full(change.rapid.shape[2], ratio) for change in changes]
        trials.append(_equations(inputs, changes, same, place, basis, 1)[2])
    return [_RATIOS[np.argmin(energies, axis=0)] for energies in zip(*trials, strict=True)]


def _equations(
    inputs: Inputs,
    changes: list[_Changes],
    ratios: list[Array],
    place: int,
    basis: Array,
    repeats: int,
) -> tuple[Array, Array, list[Array]]:
    """Normal equations (window, frame, ...) of the motion between a band and the first one."""
    noise, course = inputs.noise[inputs.bands], basis[:, :_SLOW]
    combinations = []
    for (rapid, slopes), ratio in zip(changes, ratios, strict=True):
        weights = np.zeros((len(noise), ratio.size))
        weights[0], weights[place] = -1.0, 1.0 / ratio
        null = rapid[place] / ratio - rapid[0]
        deviation = np.sqrt((noise[place] / ratio) ** 2 + noise[0] ** 2)
        slope = slopes * (weights / deviation)[:, np.newaxis, np.newaxis]
        combinations.append((null / deviation, slope.reshape(-1, _SLOW, slope.shape[-1])))
    # Energy (pixel) that the motion leaves, over that of noise, by which a pixel weighs less.
    energies = [np.mean(null**2, axis=0) for null, _ in combinations]
    for _ in range(repeats):
        forms, forces = list[Array](), list[Array]()
        for (null, slope), energy in zip(combinations, energies, strict=True):
            weighted = slope / (1.0 + energy / _HALF)
            form = np.tensordot(weighted, slope, (2, 2))
            forms.append(np.einsum("tj,tk,ajbk->tab", course, course, form, optimize=True))
            pull = np.tensordot(weighted, null, (2, 1))
            pull -= pull @ basis @ basis.T
            forces.append(np.einsum("tj,ajt->ta", course, pull))
        form, force = np.array(forms), np.array(forces)
        steps = solved(form.sum(axis=0) + np.eye(form.shape[-1]) / _JOINT_STD**2, force.sum(axis=0))
        moved = np.einsum("ta,tj->taj", steps, course).reshape(len(steps), -1)
        energies = []
        for null, slope in combinations:
            explained = moved @ slope.reshape(moved.shape[1], -1)
            remainder = null - explained + basis @ (basis.T @ explained)
            energies.append(np.mean(remainder**2, axis=0))
    return form, force, energies


def _slow(inputs: Inputs, misfit: Misfit) -> Array:
    """Motion (band, time, axis) [pixel] of the bands against the first one; zero without any."""
    time = inputs.capture["time"].values.astype(np.float64)
    motion, windows = np.zeros((len(inputs.bands), time.size, 2)), misfit.answers[drift]
    # A delay, which feigns motion of what walks by, is that of clocks: it hardly changes.
    terms = np.ones((_DEGREES + 1, 3), dtype=bool)
    terms[2:, 2] = False
    for place, band in enumerate(inputs.bands[1:]) if windows else ():
        form, force = (np.concatenate([sums[place][index] for sums in windows]) for index in (0, 1))
        form, force = form[:, terms.ravel()][..., terms.ravel()], force[:, terms.ravel()]
        steps, variance = jackknife(
            form, force, np.eye(form.shape[1]) / _TURN**2, np.zeros(form.shape[1])
        )
        # What does not change in time is no motion.
        score, path = np.zeros((2, *terms.shape))
        score[terms], path[terms] = quotient(steps**2, variance, 0.0), steps
        slowness = 1.0 / np.arange(1, _DEGREES + 1)
        if np.any(np.average(score[1:, :2], axis=0, weights=slowness) > SURE):
            motion[band] = _course(time)[:, 1:] @ path[1:, :2]
    return motion


def _course(time: Array) -> Array:
    """Polynomials (time, degree) of slow motion."""
    return np.asarray(smooth.polynomial_basis(time, _DEGREES + 1) * np.sqrt(time.size))


def drift(inputs: Inputs, result: xr.Dataset, reading: Reading) -> list[tuple[Array, Array]] | None:
    """Normal equations (window, ...) of other bands' motion and delay along functions of time."""
    blocks = [rows for rows in inputs.blocks if rows.stop - rows.start > 1]
    blocks = blocks[:: max(1, len(blocks) // _WINDOWS)]
    # Before cameras apart, parallax changes as people come and go, which looks like motion.
    small = min(result["status"].shape) < 2 * _WINDOWS
    if inputs.displacement is not None or small or reading.rows not in blocks:
        return None
    ratios = result["reflection_ratio"].values[inputs.bands, reading.rows].astype(np.float64)
    pixels = reading.pixels.reshape(ratios.shape[1:])
    # Only rapid changes have a part in the equations.
    basis = smooth_functions(inputs.capture, reading.frames).functions
    # Rapid changes in some frames, and in those before and after them.
    at = np.arange(1, len(basis) - 1, -(-len(basis) // _FRAMES))
    course = _course(inputs.capture["time"].values.astype(np.float64))[reading.frames][at]
    smoothed = basis.T @ reading.reflections

    def rapid(place: int, at: Whole) -> Array:
        film = reading.reflections[place][at] - basis[at] @ smoothed[place]
        return np.asarray(film.reshape(-1, *pixels.shape))

    first, noise = rapid(0, at), inputs.noise[inputs.bands] ** 2
    in_time = 0.5 * (rapid(0, at + 1) - rapid(0, at - 1))
    slopes = np.stack([*np.gradient(first, axis=(1, 2)), in_time])
    equations = []
    for place, ratio in enumerate(ratios[1:], 1):
        mask = binary_erosion(pixels & (ratio > 0.0), border_value=1)
        kappa, forms, forces = np.where(mask, ratio, 1.0), list[Array](), list[Array]()
        weighted = slopes * (mask / (noise[0] + noise[place] / kappa**2))
        terms = weighted, slopes, rapid(place, at) / kappa - first
        for group in zip(*(np.array_split(term, _WINDOWS, axis=-1) for term in terms), strict=True):
            pull, slope, remainder = (term.reshape(*term.shape[:-2], -1) for term in group)
            form = pull.swapaxes(0, 1) @ slope.transpose(1, 2, 0)
            force = np.einsum("atp,tp->ta", pull, remainder)
            forms.append(np.einsum("tj,tk,tab->jakb", course, course, form, optimize=True))
            forces.append(np.einsum("tj,ta->ja", course, force))
        size = course.shape[1] * 3
        equations.append((np.reshape(forms, (-1, size, size)), np.reshape(forces, (-1, size))))
    return equations
