"""Frames that show no scene, and steps of the fixed pattern, which no camera reports.

A shutter that is seen, a black, torn or random frame, another gain: neither the frames before nor
those after predict such an image. All of it is found on a few pixels of corrected counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _samples as samples
from dbthermal import schema
from dbthermal._arrays import Array, Mask, stride
from dbthermal.correction._nonuniformity import OUTLIER
from dbthermal.correction._shutter import FEWEST_COPIES
from dbthermal.noise import MAD, MINIMUM_FRAMES

Film = npt.NDArray[np.float32]
Frames = npt.NDArray[np.int64]

_PIXELS: Final = 4096  # of a band that are looked at, about
_SAMPLES: Final = 2**24  # of a band, at most: of a long capture fewer pixels
_PASSES: Final = 4  # bad frames beside bad frames, as of a shutter that moves, are found in turn
# Share of the pixels that change where a run of bad frames begins and ends; of those that deviate
# in it; of a torn row; and of the rows that are torn.
_EDGE, _MOST, _ROW, _ROWS = 0.08, 0.5, 0.9, 0.1
_RETURN: Final = 0.5  # largest change across a run of bad frames, relative to its deviation
_LONGEST, _AT_END = 5.0, 5  # longest run of bad frames [s], at an end of the capture [frame]
_ENDS: Final = 4  # changes of the image after the first that may end a run
_BLOCKS: Final = (6, 8)  # parts of an image whose means are compared
_LAGS: Final = 5  # by which the cameras may be apart [frame]
_SHARED: Final = 0.7  # least correlation of a deviation that two bands see
_UNIFORM: Final = 0.3  # largest contrast of a shutter, relative to the scene's
_GAIN: Final = float(np.log(1.25))  # least change of a gain that is switched
_NEAR: Final = 10  # frames before and after it whose noise is compared
_WINDOW: Final = 25  # frames before and after a step of the pattern
# Variance of a step of the pattern over that of noise, from which it is one.
_STEP: Final = 2.5
_BOTH: Final = 1.5  # the same in another band, from which the scene has stepped
_SHOWN: Final = 10  # runs of bad frames that are named
_BAD: Final = (
    "{} frames of band '{}' are left out, which neither the frames before nor those after predict: "
    "{}"
)
_CHANGED: Final = (
    "The fixed pattern of band '{}' changes at frame {}, as by a shutter event that is not marked: "
    "a new segment begins there"
)


@dataclass(frozen=True)
class Findings:
    """Bad frames (band, time), those that show a shutter, and first ones of a changed pattern."""

    bad: Mask
    shutter: Mask
    steps: Mask

    def notes(self, bands: list[str]) -> list[str]:
        """Sentences for a user."""
        said = []
        for band, bad, shutter, steps in zip(
            bands, self.bad, self.shutter, self.steps, strict=True
        ):
            edges = np.flatnonzero(np.diff(np.pad(bad.astype(np.int8), 1))).reshape(-1, 2)
            runs = [
                f"{first}{f' to {stop - 1}' if stop - first > 1 else ''}"
                f"{', a shutter that is seen' if shutter[first] else ''}"
                for first, stop in edges
            ]
            shown = "; ".join(runs[:_SHOWN] + ["..."] * (len(runs) > _SHOWN))
            if runs:
                said.append(_BAD.format(bad.sum(), band, shown))
            said += [_CHANGED.format(band, frame) for frame in np.flatnonzero(steps)]
        return said


def row_step(counts: xr.DataArray) -> int:
    """Step between the rows of counts (band, time, y, x) that are looked at."""
    height, width = counts.sizes["y"], counts.sizes["x"]
    wanted = min(_PIXELS, _SAMPLES // counts.sizes["time"])
    return max(1, min(height // _BLOCKS[0], -(-height * width // wanted)))


def unreported(corrected: xr.Dataset, valid: Mask, renewals: Mask) -> Findings:
    """Find bad frames and steps of the pattern among the `valid` frames (band, time) of some rows.

    A run of at most 5 s is bad if in half of the pixels, or in all pixels of a tenth of the rows,
    its image deviates by more than 6 standard deviations of a difference from the frames before and
    after, which differ by less than half of that; and if no other band sees a like deviation, or it
    shows no contrast. Of two gains, whose contrast and noise differ alike, the rarer is bad. A
    pattern steps if the means of 25 frames before and after differ from pixel to pixel by more than
    noise and usual motion make, in one band. `renewals` (band, time) are first frames after an
    event that is marked already.
    """
    counts = corrected["counts"]
    good = np.ones(counts.shape[2:], dtype=bool)
    if "status" in corrected:
        good &= (corrected["status"].values & int(schema.Status.DEAD_PIXEL)) == 0
    time = counts["time"].values.astype(np.float64)
    longest = min(int(_LONGEST / np.median(np.diff(time))), time.size // 4)
    bad, shutter, steps = (np.zeros(valid.shape, dtype=bool) for _ in range(3))
    # Films without the pixels that are no measurement.
    films = []
    for band, movie in enumerate(counts):
        film = np.asarray(movie.values, dtype=np.float32)
        usable = good & np.isfinite(film[valid[band]]).all(axis=0)
        films.append(np.where(usable, film, np.float32(0.0)))
    noise = np.array([_noise(film[row]) for film, row in zip(films, valid, strict=True)])
    judged = np.flatnonzero((valid.sum(axis=1) >= MINIMUM_FRAMES) & (noise > 0.0))
    # Bad frames, then steps among the others.
    for band in judged:
        for _ in range(_PASSES):
            (frames,) = np.nonzero(valid[band] & ~bad[band])
            runs = list(_runs(films[band][frames], noise[band], longest))
            for start, stop in runs:
                places = frames[[max(start - 1, 0), (start + stop - 1) // 2, stop % frames.size]]
                sides = places[[start > 0, False, stop < frames.size]]
                blank = _is_uniform(films[band], places[1], sides, noise[band])
                if blank or not _is_shared(films, valid & ~bad, band, places[1], sides):
                    bad[band, frames[start:stop]] = True
                    shutter[band, frames[start:stop]] = blank and stop - start >= FEWEST_COPIES
            if not bad[band, frames].any():
                break
        (frames,) = np.nonzero(valid[band] & ~bad[band])
        bad[band, frames[_other_gain(films[band][frames])]] = True
    scores = {
        band: _pattern_scores(films[band], valid[band] & ~bad[band], renewals[band])
        for band in judged
    }
    for band, score in scores.items():
        for frame in _peaks(score):
            near = slice(max(frame - _WINDOW, 0), frame + _WINDOW)
            others = [scores[other][near].max() for other in scores if other != band]
            steps[band, frame] = max(others, default=0.0) < _BOTH
    return Findings(bad, shutter, steps)


def _noise(film: Film) -> float:
    """Noise [count] of a film (time, y, x); NaN of too few frames."""
    flat = film.reshape(len(film), -1)
    level = samples.noise(flat[:, :: stride((flat.shape[1],), 256)])
    return float(np.median(level[level > 0.0])) if np.any(level > 0.0) else np.nan


def _runs(film: Film, noise: float, longest: int) -> Iterator[tuple[int, int]]:
    """Yield first frames, and frames after the last, of runs that neither side predicts."""
    limit = np.float32(OUTLIER * np.sqrt(2.0) * noise)
    edges = np.array(
        [
            1 + place
            for place in range(len(film) - 1)
            if np.mean(np.abs(film[place + 1] - film[place]) > limit) > _EDGE
        ],
        dtype=np.int64,
    )
    pairs = [(0, int(stop)) for stop in edges[:_ENDS] if stop <= _AT_END]
    for place, start in enumerate(edges.tolist()):
        ends = edges[place + 1 : place + 1 + _ENDS].tolist()
        pairs += [(start, stop) for stop in ends if stop - start <= longest]
        pairs += [(start, len(film))] if len(film) - start <= _AT_END else []
    after = 0
    for start, stop in pairs:
        if start >= after and _deviates(film, start, stop, limit):
            yield start, stop
            after = stop


def _deviates(film: Film, start: int, stop: int, limit: np.float32) -> bool:
    """Return whether the middle of a run deviates from both frames beside it, which are alike."""
    sides = [film[place] for place in (start - 1, stop) if 0 <= place < len(film)]
    least = np.min([np.abs(film[(start + stop - 1) // 2] - side) for side in sides], axis=0)
    deviant = (least > limit) & (np.abs(sides[-1] - sides[0]) < _RETURN * least)
    torn = deviant.mean(axis=1) > _ROW
    return bool(deviant.mean() > _MOST or torn.mean() > _ROWS)


def _coarse(image: Film) -> Array:
    """Means over parts of an image."""
    rows, columns = (
        np.linspace(0, size, parts, endpoint=False).astype(int)
        for size, parts in zip(image.shape, _BLOCKS, strict=True)
    )
    sums = np.add.reduceat(np.add.reduceat(image, np.unique(rows), 0), np.unique(columns), 1)
    number = np.ones(image.shape)
    number = np.add.reduceat(np.add.reduceat(number, np.unique(rows), 0), np.unique(columns), 1)
    return np.asarray(sums / number)


def _is_uniform(film: Film, frame: int, sides: Frames, noise: float) -> bool:
    """Return whether a frame shows far less contrast than those beside it."""
    grain = noise / np.sqrt(film[0].size / np.prod(_BLOCKS))
    scene = min(float(_coarse(film[side]).std()) for side in sides)
    return bool(scene > OUTLIER * grain and _coarse(film[frame]).std() < _UNIFORM * scene)


def _is_shared(films: list[Film], valid: Mask, band: int, frame: int, sides: Frames) -> bool:
    """Return whether another band deviates alike, a few frames earlier or later."""

    def deviation(film: Film, lag: int) -> Array:
        beside = np.mean([_coarse(film[side + lag]) for side in sides], axis=0)
        return np.asarray(_coarse(film[frame + lag]) - beside).ravel()

    present = deviation(films[band], 0)
    for other, film in enumerate(films):
        for lag in range(-_LAGS, _LAGS + 1) if other != band else ():
            places = np.append(sides, frame) + lag
            if places.min() < 0 or places.max() >= len(film) or not valid[other, places].all():
                continue
            partner = deviation(film, lag)
            energy = np.linalg.norm(present) * np.linalg.norm(partner)
            if present @ partner > _SHARED * energy:
                return True
    return False


def _other_gain(film: Film) -> Frames:
    """Frames with another gain than most, in which contrast and noise are larger or smaller."""
    flat = film.reshape(len(film), -1)
    level = np.zeros(len(film))  # logarithm of the gain
    change = np.array([np.median(np.abs(flat[i + 1] - flat[i])) for i in range(len(flat) - 1)])
    for place in 1 + np.flatnonzero(change > OUTLIER * np.median(change)):
        before, after = film[max(place - _NEAR, 0) : place], film[place : place + _NEAR]
        if min(len(before), len(after)) < 3:
            continue
        first, second = _coarse(before[-1]).ravel(), _coarse(after[0]).ravel()
        noises = [
            np.median(np.abs(part[1:-1] - 0.5 * (part[:-2] + part[2:]))) for part in (before, after)
        ]
        if first.std() == 0.0 or second.std() == 0.0 or min(noises) == 0.0:
            continue
        gain = float(np.log(second.std() / first.std()))
        like = np.log(noises[1] / noises[0]) / gain if gain else 0.0
        if abs(gain) > _GAIN and 0.5 < like < 1.5 and np.corrcoef(first, second)[0, 1] > 0.9:
            level[place:] += gain
    near = np.abs(level[:, np.newaxis] - np.unique(level)) < 0.5 * _GAIN
    usual = near[:, np.argmax(near.sum(axis=0))]
    return np.flatnonzero(~usual)


def _pattern_scores(film: Film, valid: Mask, renewals: Mask) -> Array:
    """Variance (time) of a step of the pattern at each frame, over that of noise and motion."""
    # Detail from pixel to pixel, in which object and reflections are weak.
    detail = film[..., 1:-1] - 0.5 * (film[..., :-2] + film[..., 2:])
    scores = np.zeros(len(film))
    pieces = np.cumsum(renewals)
    for piece in np.unique(pieces):
        (frames,) = np.nonzero(valid & (pieces == piece))
        width = min(_WINDOW, len(frames) // 3)
        if width < 8:
            continue
        flat = detail[frames].reshape(len(frames), -1).astype(np.float64)
        noise = MAD * np.median(np.abs(np.diff(flat, axis=0))) / np.sqrt(2.0)
        total = np.cumsum(np.pad(flat, ((1, 0), (0, 0))), axis=0)
        places = np.arange(width, len(frames) - width + 1)
        ratio = np.array(
            [
                np.median(np.abs(total[i + width] - 2.0 * total[i] + total[i - width]))
                for i in places
            ]
        )
        ratio = (MAD * ratio) ** 2 / (2.0 * width * noise**2)
        scores[frames[places]] = ratio / max(1.0, float(np.median(ratio)))
    return scores


def _peaks(score: Array) -> Iterator[int]:
    """Yield the frames at which a score (time) is highest, and large, one per window."""
    score = score.copy()
    while score.max() > _STEP:
        frame = int(np.argmax(score))
        yield frame
        score[max(frame - _WINDOW, 0) : frame + _WINDOW] = 0.0
