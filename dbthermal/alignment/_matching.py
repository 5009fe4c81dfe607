r"""Displacement between movies of one changing picture, matched by its own texture.

Sought is d with :math:`h_m(p, t) = k_m(p) h_1(p + d(p), t)` beside noise, m = 2, 3, ...: first the
whole pixels that explain most, then Gauss-Newton from coarse images to fine ones. Beside it, how
much later the others show what the first shows.
"""

from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from dbthermal._arrays import Array, Mask
from dbthermal.alignment import _splines as images
from dbthermal.alignment._planes import EVENT
from dbthermal.alignment._splines import Field, Information, Movie, Spline
from dbthermal.noise import MAD

WINDOW: Final = 2.5  # deviation of a window of one ratio and one whole-pixel match [pixel]
BLUR: Final = 1.2  # deviation of the blur of all movies, against aliasing [pixel]

# Pixels at the border that are left out: what the blur mirrors there does not move. Along the
# baseline, simulated shifts there were 0.028 pixel off with none, 0.015 with 1, 0.018 with 2.
_MIRRORED: Final = 1.0
# White noise of values, and of slopes over a pixel, after the blur over that before.
_VALUE_NOISE: Final = 1.0 / (2.0 * np.sqrt(np.pi) * BLUR)
_SLOPE_NOISE: Final = _VALUE_NOISE * np.sqrt(2.0 * (1.0 - np.exp(-0.25 / BLUR**2)))
_ROUNDS, _ROBUST = 12, 4  # rounds of a field, and of robust weights of whole-pixel matches
_CONVERGED: Final = 2e-3  # mean change of the field at its end, of coarser pixels larger [pixel]
# Explained energy, in variances of noise, that chance does not reach at one of many shifts.
_SIGNIFICANT: Final = 40.0
_MATCH_STD: Final = 0.5  # assumed deviation of a whole-pixel match [pixel]
# Parts along a side of the image, for a delay's jackknife; pixels that give a movie's noise.
_BLOCKS, _NOISE_PIXELS = 6, 256
# Share of the changes from which one function of time holds all: before lamps 0.99 to 1, before
# people, hands and fans 0.1 to 0.5, of switched spots up to 0.97.
_LEADING: Final = 0.98
# Power of the misfit by which the weight of an event falls; rounds of weights before the first
# step; weight of whole-pixel matches without a shift, as of an object. Of touches before switched
# spots 8 fields are .14 pixel off without these (median), .024 with, .055 with the power 2 and one
# round; with the weight 1 four of the 8 starts are 1 to 2.5 pixels off.
_EXCLUDED, _WEIGHTED, _UNMOVED = 3, 2, 0.05
# Share of what is reflected that a field may leave in its last rounds: with 0 an object beside a
# still half is .053 K off, with .03 .039; with .1 touches bend five of six fields by .6 to 2 pixel.
_MODEL: Final = 0.03
_RIDGE: Final = 1e-4  # of the largest information on a shift, added for windows without any


@dataclass(frozen=True)
class Movies:
    """Rapid changes of one picture (y, x, time) [K], blurred alike."""

    first: Movie  # its splines
    targets: list[Movie]
    valid: Mask  # pixels (y, x) with data in all
    noise: Array  # standard deviation of a sample before the blur, first and targets [K]
    freedom: Movie  # degrees of freedom of a pixel's noise, of each event
    outside: Movie  # degrees of freedom of what a model leaves over these [1]
    lamp: bool  # one function of time holds nearly all changes
    factor: int  # pixels of the capture along a side of a pixel here

    @classmethod
    def blurred(
        cls, movies: list[Movie], valid: Mask, noise: Array, power: Array, factor: int, whole: float
    ) -> "Movies":
        """Movies of coarser pixels; power of white noise in each function of time, and in all."""
        majority = images.binned(valid.astype(np.float64), factor) > 0.5
        step = max(1, np.count_nonzero(majority) // _NOISE_PIXELS)
        sample = tuple(index[::step] for index in np.nonzero(majority))
        if sample[0].size:
            # Interpolated in time, a movie holds less rapid noise than white noise of its size.
            white = np.sqrt(power.mean()) / factor
            levels = [MAD * np.median(np.abs(movie[sample])) for movie in movies]
            noise = np.minimum(noise, np.array(levels) / white)
        splines = images.splines(movies[0], BLUR)
        targets = [images.blurred(movie, BLUR) for movie in movies[1:]]
        # What a model leaves lies all over the frames; but where one function of time holds the
        # changes, as of a lamp, in this one, and a border of materials bends the field.
        energy = np.linalg.eigvalsh(np.tensordot(splines, splines, ((0, 1), (0, 1))))
        energy -= splines[..., 0].size * (noise[0] / factor * _VALUE_NOISE) ** 2
        lamp = bool(energy.max() > _LEADING * np.maximum(energy, 0.0).sum())
        events = power.reshape(-1, max(1, power.size // EVENT)).sum(axis=0).astype(np.float32)
        outside = 1.0 / events if lamp else np.full_like(events, max(whole / power.sum(), 1.0))
        return cls(splines, targets, majority, noise / factor, events, outside, lamp, factor)

    def centres(self) -> list[Array]:
        """Rows and columns, of the capture, of the pixels' centres."""
        return [np.asarray(self.factor * (np.arange(n) + 0.5) - 0.5) for n in self.valid.shape]

    def pairs(self, shift: Array) -> tuple[Array, Mask]:
        """Places (2, y, x) moved by a shift of the capture's pixels; pixels that pair with them."""
        pixels, shape = np.indices(self.valid.shape), np.reshape(self.valid.shape, (2, 1, 1))
        places = pixels + shift / self.factor
        grids = np.stack([pixels, places])
        # Near the border the blur mirrors, and what is mirrored does not move.
        inner = (grids >= _MIRRORED) & (grids <= shape - 1 - _MIRRORED)
        return places, on_valid(places, self.valid) & self.valid & np.all(inner, axis=(0, 1))


def _whole_pixels(
    reference: Movie, movies: list[Movie], freedom: float, reach: tuple[int, int]
) -> tuple[Array, Array]:
    """Whole-pixel shift (2, y, x) that explains most of the movies; weight (y, x), 0 by chance."""
    height, width = reference.shape[:2]
    padded = np.pad(reference, (*((by, by) for by in reach), (0, 0)))
    # Energies in variances of noise: movies are in deviations of noise.
    energies = [np.einsum("yxt,yxt->yx", film, film) for film in (padded, *movies)]
    best, place = np.zeros((height, width)), np.zeros((2, height, width))
    for down in range(2 * reach[0] + 1):  # a row's pairs of pixels at once
        rows = slice(down, down + height)
        gain = np.zeros((height, width, 2 * reach[1] + 1))
        for movie in movies:
            pairs = padded[rows] @ movie.transpose(0, 2, 1)
            cross = np.stack([pairs.diagonal(-right, 1, 2) for right in range(gain.shape[2])], -1)
            gain += np.maximum(images.blurred(cross, WINDOW), 0.0) ** 2
        shifted = [energies[0][rows, right : right + width] for right in range(gain.shape[2])]
        gain /= np.maximum(images.blurred(np.stack(shifted, axis=-1), WINDOW), freedom)
        if down == reach[0]:
            at_rest = gain[..., reach[1]]
        right, highest = gain.argmax(axis=2), gain.max(axis=2)
        better = highest > best
        best[better], place[0][better], place[1][better] = highest[better], down, right[better]
    # Products of two blurred noises are alike over an area of 2 pi BLUR^2.
    chance = _SIGNIFICANT * 2.0 * np.pi * BLUR**2 / (4.0 * np.pi * WINDOW**2)
    unmoved = best - at_rest <= chance
    place[:, unmoved] = np.reshape(reach, (2, 1))
    best = np.where(unmoved, _UNMOVED * at_rest, best - at_rest)
    # Weight: share of the movies' energy in a window that is explained.
    share = best / np.maximum(images.blurred(np.sum(energies[1:], axis=0), WINDOW), 1e-9)
    return place - np.reshape(reach, (2, 1, 1)), np.where(best > chance, share, 0.0)


def on_valid(places: Array, valid: Mask) -> Mask:
    """Places (2, ...) that lie on valid pixels of an image."""
    pixels = np.rint(places)
    result = np.all([(n >= 0) & (n < size) for n, size in zip(pixels, valid.shape, strict=True)], 0)
    row, column = np.where(result, pixels, 0).astype(np.intp)
    return np.asarray(result & valid[row, column])


def _information(
    movies: Movies, shift: Array, misfits: Movie, tolerance: float
) -> tuple[Information, Movie]:
    r"""Information on a step of the field at each pixel, by Gauss-Newton.

    With the moved movie m, its slopes g and a ratio k of a window, the residual of a pixel is

    .. math:: r = k \, g^T d + u m + \sigma^2 g^T \nabla (k + u)

    beside noise. The pixel's ratio differs by u, as beside a border of materials, with a variance
    that the window tells; and a blur of deviation sigma moves what it sees of an uneven ratio. So

    .. math:: q = \frac{\tau^2}{s^2 + \tau^2 \sum m^2}, \quad
              A = k^2 \left[\sum g g^T - q \sum g m \sum m g^T\right], \quad
              b = k \left[\sum g r - q \sum g m \sum m r\right] - A \sigma^2 \nabla (k + u) / k

    over s^2, the noise's variance, less what noise makes of the slopes. Sums are over time, events
    of a misfit weighed less. Second, the misfit of the residual (movie, y, x, event), over noise
    and a tolerated share of what is reflected.
    """
    places, mask = movies.pairs(shift)
    noise = movies.noise[0] * _VALUE_NOISE
    total = np.zeros((*mask.shape, 6))
    window = partial(images.blurred, width=WINDOW)
    numbers = np.maximum(window(mask * np.float32(1.0)), 1e-9)[..., np.newaxis] * movies.freedom
    weights = np.where(mask[..., np.newaxis], misfits**-_EXCLUDED, np.float32(0.0))
    moments, events = images.products(movies.first, movies.targets, places, weights)
    updated = np.empty_like(misfits)
    for place, level in enumerate(movies.noise[1:]):
        mm, my, mx, mh, yy, yx, yh, xx, xh = np.moveaxis(moments[place, ..., :9], 2, 0)
        freedom = weights[place] @ movies.freedom
        auto, terms, number = window(mm), window(mh), window(freedom)
        # Noise of the moved movie makes its energy larger, not its product with another movie.
        auto -= number * noise**2
        ratio = terms / np.maximum(auto, 0.1 * np.maximum(number, 1e-9) * noise**2)
        # Summed over pixels, the noise is that before the blur.
        variance = level**2 + (ratio * movies.noise[0]) ** 2
        white, along = variance * _VALUE_NOISE**2, mh - ratio * mm
        # Before a lamp a step of the shift looks like another ratio: there a window has one.
        free = 0.0 if movies.lamp else 1.0
        uneven = free * np.maximum(window(along**2) - white * window(mm), 0.0)
        uneven /= np.maximum(window(mm**2), np.finfo(np.float64).tiny)
        share = uneven / (white + uneven * mm)
        local, square, scale = np.array([ratio + share * along, ratio**2, white], "f4")[..., None]
        first, product, second = np.moveaxis(events[place], 2, 0)
        excess, reflected = (
            images.blurred(mask[..., np.newaxis] * energy, WINDOW) / scale - numbers
            for energy in (second - 2.0 * local * product + local**2 * first, square * first)
        )
        # What the object does at the same time is in the residual of few events.
        outside = numbers * movies.outside
        expected = outside + tolerance * np.maximum(reflected, 0.0)
        updated[place] = np.maximum((outside + excess) / expected, 1.0)
        # What is tolerated of the events that count makes the window count less.
        unexplained, chance = (np.sum(weights[place] * n, axis=2) for n in (excess, outside))
        usual = np.maximum(1.0 + unexplained / np.maximum(chance, 1e-9), 1.0) if tolerance else 1.0
        yy, yx, xx = yy - share * my**2, yx - share * my * mx, xx - share * mx**2
        # By as much as the blur moves what it sees of an uneven ratio, the shift is not off.
        moved = free * BLUR**2 * np.stack(np.gradient(ratio + share * along))
        steps = (
            yh - ratio * my - share * my * along - yy * moved[0] - yx * moved[1],
            xh - ratio * mx - share * mx * along - yx * moved[0] - xx * moved[1],
        )
        bias = ratio * freedom * (movies.noise[0] * _SLOPE_NOISE) ** 2
        squares = ratio * yy - bias, ratio * yx, ratio * xx - bias
        weight = (mask * ratio / (usual * variance))[..., np.newaxis]
        total += weight * np.stack([*squares, *steps, bias], axis=-1)
    total = np.moveaxis(images.blurred(total, WINDOW), 2, 0)
    tensor, gradient, bias = total[:3], total[3:5], total[5]
    # With noise N in the slopes, var = (A + N) / A^2: as if the information were A^2 / (A + N).
    size = tensor[0] + tensor[2]
    share = np.maximum(size, 0.0) / np.maximum(size + bias, 1e-300)
    tensor, gradient = _positive(tensor) * share, gradient * share
    return Information(tensor / movies.factor**2, gradient / movies.factor), updated


def eigenvalues(tensor: Array) -> tuple[Array, Array]:
    """Larger and smaller eigenvalue (y, x) of tensors (3, y, x)."""
    down, mixed, right = tensor
    middle, root = 0.5 * (down + right), np.hypot(0.5 * (down - right), mixed)
    return middle + root, middle - root


def _positive(tensor: Array) -> Array:
    """Tensors (3, y, x) without their negative eigenvalues."""
    high, low = eigenvalues(tensor)
    share = np.maximum(high, 0.0) / np.maximum(high - low, np.finfo(np.float64).tiny)
    unit = np.array([1.0, 0.0, 1.0])[:, np.newaxis, np.newaxis]
    return np.where(low < 0.0, share * (tensor - low * unit), tensor)


def start(movies: Movies, planes: list[Movie], spline: Spline) -> Field | None:
    """Field of whole-pixel matches of planes, wrong ones taken for outliers; None without any."""
    reach = movies.valid.shape[0] // 3, movies.valid.shape[1] // 3
    levels = (movies.noise * _VALUE_NOISE).astype(np.float32)
    pictures = [images.blurred(x, BLUR) / level for x, level in zip(planes, levels, strict=True)]
    shift, share = _whole_pixels(pictures[0], pictures[1:], float(movies.freedom.sum()), reach)
    share *= movies.valid
    if not share.any():
        return None
    at_end = np.any(np.abs(shift) == np.reshape(reach, (2, 1, 1)), axis=0)
    if np.sum(share * at_end) > 0.5 * np.sum(share):
        raise ValueError(
            f"Invalid shift of the reflections: most match best {reach[0] * movies.factor} rows or "
            f"{reach[1] * movies.factor} columns away, the end of the search. Must be less than a "
            "third of the image."
        )
    target, weight = shift * movies.factor, share / (_MATCH_STD * movies.factor) ** 2
    centres, zero = movies.centres(), np.zeros_like(share)
    field, precision, step = None, weight, target
    for _ in range(1 + _ROBUST):
        data = Information(np.stack([precision, zero, precision]), precision * step)
        field = spline.fitted(data, centres, field)
        step = target - field.on(centres)
        precision = weight / (1.0 + np.sum(step**2, axis=0) / movies.factor**2) ** 2
    return field


def refine(movies: Movies, field: Field, *, rough: bool) -> tuple[Field, Information]:
    """Field after Gauss-Newton, and the information of each pixel on it."""
    field = replace(field, settled=False)
    misfits = misfits_of(movies, field.on(movies.centres()))
    # A rough field first follows the events that it explains, alone.
    for tolerance in (0.0, _MODEL) if rough else (_MODEL,):
        for number in range(_ROUNDS):
            shift = field.on(movies.centres())
            data, misfits = _information(movies, shift, misfits, tolerance)
            field = field.spline.fitted(data, movies.centres(), field)
            change = np.abs(field.on(movies.centres()) - shift)
            # The weights of the first round are those before it.
            if number > 0 and change.mean() < _CONVERGED * movies.factor**2:
                break
    return field, data


def misfits_of(movies: Movies, shift: Array) -> Movie:
    """Misfit (movie, y, x, event) over noise of what a shift (2, y, x) [pixel] explains."""
    result = np.ones((len(movies.targets), *movies.valid.shape, movies.freedom.size), np.float32)
    for _ in range(_WEIGHTED):
        _, result = _information(movies, shift, result, 0.0)
    return result


def delay(movies: Movies, rate: Movie, shift: Array, misfits: Movie) -> tuple[float, float, Array]:
    r"""Time by which the others show what the first movie shows at a shift, and its deviation [s].

    The shift is (2, y, x) [pixel], the rate a matrix that takes planes to their change [1/s], the
    misfits are the variances of events. Motion in one direction looks like a shift or a delay: a
    Newton step solves for both, the shift free in each window. With the slopes g of the moved movie
    :math:`h`, its change :math:`\dot h`, the residual r of the others over their ratio to h, and
    sums over time and a window,

    .. math:: \delta = \sum (\dot h r - c^T A^{-1} \, g r) / \sum (\dot h^2 - c^T A^{-1} c),
              \quad A = g g^T, \; c = g \dot h

    Third, the energy (2, y, x) of the others that the moved movie explains, and all their energy
    beside noise, in variances of noise.
    """
    places, mask = movies.pairs(shift)
    weights = np.where(mask[..., np.newaxis], 1.0 / misfits, np.float32(0.0))
    moments, _ = images.products(movies.first, movies.targets, places, weights, rate)
    totals = np.zeros((4, *movies.valid.shape))
    for array, weight, level in zip(moments, weights, movies.noise[1:], strict=True):
        windows = images.blurred(array, WINDOW)
        freedom = images.blurred(weight @ movies.freedom, WINDOW)
        # Noise of the slopes and of the moved movie.
        bias = freedom[..., np.newaxis] * movies.noise[0] ** 2
        bias = bias * np.square([_VALUE_NOISE, _SLOPE_NOISE, _SLOPE_NOISE, 0.0])
        equations = images.normal_equations(windows, bias)
        # The shift of each window is eliminated.
        tensor, cross = equations[..., :2, :2], equations[..., :2, 2]
        ridge = _RIDGE * np.trace(tensor, axis1=-2, axis2=-1).max()
        share = np.linalg.solve(tensor + ridge * np.eye(2), cross[..., np.newaxis])[..., 0]
        late = equations[..., 3, 2] - np.sum(share * equations[..., 3, :2], axis=-1)
        precision = equations[..., 2, 2] - np.sum(share * cross, axis=-1)
        moved, common, power = (windows[..., place] for place in (0, 4, 14))
        power = power - freedom * (level * _VALUE_NOISE) ** 2
        gain = np.maximum(common, 0.0) ** 2 / np.maximum(moved, np.finfo(np.float64).tiny)
        totals += np.where(mask, np.stack([late, precision, gain, power]), 0.0) / level**2
    gradient, information, *energy = totals
    starts = [np.arange(_BLOCKS) * size // _BLOCKS for size in movies.valid.shape]
    # Jackknife over parts of the image: windows of several depths differ by far more than noise.
    blocks = np.add.reduceat(np.add.reduceat(totals[:2], starts[0], axis=1), starts[1], axis=2)
    with np.errstate(divide="ignore", invalid="ignore"):  # one part may tell all: no deviation
        replicates = (gradient.sum() - blocks[0]) / (information.sum() - blocks[1])
    std = np.sqrt((replicates.size - 1) * np.var(replicates))
    late = float(gradient.sum() / information.sum())
    return late, float(std), np.stack(energy)
