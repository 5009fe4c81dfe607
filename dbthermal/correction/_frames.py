"""Frames that show no scene, and steps of the fixed pattern, which no camera reports.

A shutter that is seen, a black, torn or random frame, another gain: neither the frames before nor
those after predict such an image. All of it is found on a few pixels of corrected counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _samples, schema
from dbthermal._arrays import Array, Mask, stride
from dbthermal.correction._nonuniformity import OUTLIER
from dbthermal.correction._temporal import FEWEST_COPIES
from dbthermal.noise import MAD, MINIMUM_FRAMES

Film = npt.NDArray[np.float32]
Frames = npt.NDArray[np.int64]
Means = list[Array]  # over parts of the image (time, part), of each band

_PIXELS, _ROWS_AT_LEAST = 16384, 24  # of a band that are looked at, about
_SAMPLES: Final = 2**24  # of a band, at most: of a long capture fewer pixels
_PASSES: Final = 4  # bad frames beside bad frames, as of a shutter that moves, are found in turn
# Least share of pixels that change where a run of bad frames begins and ends; that deviate in the
# run; that deviate in a torn row; and of torn rows.
_EDGE, _MOST, _ROW, _ROWS = 0.08, 0.5, 0.9, 0.1
_RETURN: Final = 0.5  # largest change across a run of bad frames, relative to its deviation
_LONGEST, _AT_END = 5.0, 5  # longest run of bad frames [s], at an end of the capture [frame]
_ENDS: Final = 4  # changes of the image after the first that may end a run
_BLOCKS: Final = (6, 8)  # parts of an image whose means are compared
_COMES: Final = 0.4  # least share of a deviation that comes with one frame, and goes with one
_LAGS: Final = 5  # by which the cameras may be apart [frame]
_SHARED: Final = 0.7  # least correlation of a deviation that two bands see
# Largest contrast of a shutter over the scene's; share of frames with less than the scene's.
_UNIFORM, _QUANTILE = 0.3, 0.1
_RANDOM: Final = 20.0  # differences of neighbouring pixels, relative to usual ones, of a random one
_GAIN: Final = float(np.log(1.25))  # least change of a gain that is switched
_CORRELATION: Final = 0.9  # and least correlation of the images before and after
_SIDE: Final = 10  # frames before and after a switched gain whose noise is compared
_WINDOW: Final = 25  # frames before and after a step of the pattern
_FEWEST: Final = 256  # pixels from which a step's variance is known within a sixth
# Least variance of a step of the pattern, over that of noise.
_STEP: Final = 2.5
# Least share of a step that a single frame brings; this and variance in another band, and mean
# product of the signs, from which the scene has stepped.
_AT_ONCE, _ALSO, _BOTH, _SIGNS = 0.7, 0.4, 1.5, 0.15
_SHOWN: Final = 10  # runs of bad frames that are named
_BAD: Final = "Frames of band '{}' are left out, which those around do not predict, {} in all: {}"
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
        sentences, rows = [], zip(bands, self.bad, self.shutter, self.steps, strict=True)
        for band, bad, shutter, steps in rows:
            edges = np.flatnonzero(np.diff(np.pad(bad.astype(np.int8), 1))).reshape(-1, 2)
            runs = [
                f"{first}{f' to {stop - 1}' if stop - first > 1 else ''}"
                f"{', a shutter that is seen' if shutter[first] else ''}"
                for first, stop in edges
            ]
            shown = "; ".join(runs[:_SHOWN] + ["..."] * (len(runs) > _SHOWN))
            if runs:
                sentences.append(_BAD.format(band, bad.sum(), shown))
            sentences += [_CHANGED.format(band, frame) for frame in np.flatnonzero(steps)]
        return sentences


def sampling(counts: xr.DataArray) -> dict[str, slice]:
    """Rows and columns of counts (band, time, y, x) that are looked at."""
    shape = counts.sizes["y"], counts.sizes["x"]
    pixels = min(_PIXELS, _SAMPLES // counts.sizes["time"])
    step = stride(shape, pixels)
    # Whole rows, for the detail from pixel to pixel, but in a capture too long for 24 of them.
    rows = -(-shape[0] * shape[1] // pixels)
    whole = pixels >= _ROWS_AT_LEAST * shape[1] or step == 1
    steps = {"y": rows, "x": 1} if whole else {"y": step, "x": step}
    return {dim: slice(None, None, size) for dim, size in steps.items()}


def unreported(corrected: xr.Dataset, valid: Mask, renewals: Mask) -> Findings:
    """Find bad frames and steps of the pattern among the `valid` frames (band, time) of some rows.

    A short run is bad if its image deviates, in half of the pixels or in whole rows, from the
    frames before and after, which are alike; suddenly so; and if it shows no scene, or no other
    band deviates alike. Of two gains, by which noise and contrast, or the pattern, change at once
    in one band, the rarer is bad. A pattern steps if the means before and after differ from pixel
    to pixel, at once, for longer, and in one band. `renewals` (band, time) are first frames after
    marked events. Of 4e5 good frames of 48 kinds of scenes at 2 to 50 Hz 2e-4 at most are taken so.
    """
    counts = corrected["counts"]
    good = (schema.pixel_status(corrected) & np.uint32(schema.Status.DEAD_PIXEL)) == 0
    # Films without the pixels that are no measurement.
    films = []
    for movie, frames in zip(counts, valid, strict=True):
        film = np.asarray(movie.values, dtype=np.float32)
        usable = good & np.isfinite(film[frames]).all(axis=0)
        films.append(np.where(usable, film, np.float32(0.0)))
    noise = np.array([_noise(film[frames]) for film, frames in zip(films, valid, strict=True)])
    judged = np.flatnonzero((valid.sum(axis=1) >= MINIMUM_FRAMES) & (noise > 0.0)).tolist()
    judged = judged if counts.sizes["x"] > 2 else []  # detail needs neighbours
    time = counts["time"].values.astype(np.float64)
    longest = min(int(_LONGEST / np.median(np.diff(time))), time.size // 4)
    # Runs of bad frames, rarer gains, then steps among the other frames.
    sections, valid, shutter = [_coarse(film) for film in films], valid.copy(), ~valid & False
    before = valid.copy()
    for band in judged:
        _leave_out(band, films[band], sections, valid, shutter[band], noise[band], longest)
    for band in judged:
        valid[band] &= _usual_gain(band, films[band], sections, valid)
    steps = ~valid & False
    if judged:
        steps[judged] = _steps([films[band] for band in judged], valid[judged], renewals[judged])
    return Findings(before & ~valid, shutter, steps)


def _leave_out(
    band: int, film: Film, sections: Means, valid: Mask, shutter: Mask, noise: float, longest: int
) -> None:
    """Make bad frames of a band not valid (band, time), and mark those of a shutter (time)."""
    limit = np.float32(OUTLIER * np.sqrt(2.0) * noise)
    # Frames without a scene: far less contrast than nearly all have, or random from pixel to pixel.
    contrast = sections[band].std(axis=1)
    scene = float(np.quantile(contrast[valid[band]], _QUANTILE))
    grain = noise * np.sqrt(sections[band].shape[1] / film[0].size)
    uniform = (contrast < _UNIFORM * scene) & (scene > OUTLIER * grain)
    rough = np.abs(np.diff(film, axis=2)).mean(axis=(1, 2))
    random = rough > _RANDOM * np.median(rough[valid[band]])
    for _ in range(_PASSES):
        (frames,) = np.nonzero(valid[band])
        for start, stop, places in _runs(film[frames], limit, longest):
            trio, span = frames[places], frames[[start, stop - 1]]
            no_scene = any(kind[trio[0]] > kind[trio[1:]].max() for kind in (uniform, random))
            if not valid[band, frames[start:stop]].all():
                continue
            if no_scene or not _is_shared(sections, valid, band, trio, span):
                valid[band, frames[start:stop]] = False
                if not uniform[trio[0]]:
                    continue
                # In the frames before and after, a shutter moves: a part of the image changes.
                for side, neighbour in ((start - 1, start - 2), (stop, stop + 1)):
                    if 0 <= neighbour < frames.size:
                        change = _changed(film[frames[neighbour]], film[frames[side]], limit)
                        valid[band, frames[side]] &= change <= _EDGE
                closed = frames[max(start - 1, 0) : stop + 1]
                closed = closed[~valid[band, closed]]
                shutter[closed] = closed.size >= FEWEST_COPIES
        if valid[band, frames].all():
            return


def _noise(film: Film) -> float:
    """Noise [count] of a film (time, y, x); NaN of too few frames."""
    flat = film.reshape(len(film), -1)
    level = _samples.noise(flat[:, :: stride((flat.shape[1],), 256)])
    return float(np.median(level[level > 0.0])) if np.any(level > 0.0) else np.nan


def _runs(film: Film, limit: np.float32, longest: int) -> Iterator[tuple[int, int, list[int]]]:
    """Yield start and stop of unpredicted runs, by length, and the frames that prove each."""
    changes = [_changed(before, after, limit) for before, after in pairwise(film)]
    edges = (1 + np.flatnonzero(np.array(changes) > _EDGE)).tolist()
    pairs = [(0, stop) for stop in edges[:_ENDS] if stop <= _AT_END]
    for place, start in enumerate(edges):
        ends = edges[place + 1 : place + 1 + _ENDS]
        pairs += [(start, stop) for stop in ends if stop - start <= longest]
        pairs += [(start, len(film))] if len(film) - start <= _AT_END else []
    for start, stop in sorted(pairs, key=lambda pair: pair[1] - pair[0]):
        # Compare the middle with both sides; at an end of the capture a frame twice as far away
        # stands for the missing side.
        before = start - 1 if start > 0 else 2 * stop
        after = stop if stop < len(film) else 2 * start - stop - 1
        places = [(start + stop - 1) // 2, before, after]
        if max(places) >= len(film):
            continue
        # The frame in the middle deviates from both sides, which are alike.
        middle, *sides = film[places]
        deviation = np.minimum(*(np.abs(middle - side) for side in sides))
        deviant = (deviation > limit) & (np.abs(sides[1] - sides[0]) < _RETURN * deviation)
        torn = deviant.mean(axis=1) > _ROW
        if deviant.mean() > _MOST or torn.mean() > _ROWS:
            yield start, stop, places


def _coarse(film: Film) -> Array:
    """Means (time, part) over parts of the image of a film (time, y, x)."""
    rows, columns = (
        np.unique(np.linspace(0, size, sections, endpoint=False).astype(int))
        for size, sections in zip(film.shape[1:], _BLOCKS, strict=True)
    )
    sums, area = (
        np.add.reduceat(np.add.reduceat(values, rows, axis=-2), columns, axis=-1)
        for values in (film, np.ones(film.shape[1:]))
    )
    return np.asarray(sums / area).reshape(len(film), -1)


def _changed(before: Film, after: Film, limit: np.float32) -> float:
    """Share of the pixels that change between two images."""
    return float(np.mean(np.abs(after - before) > limit))


def _is_shared(sections: Means, valid: Mask, band: int, places: Frames, span: Frames) -> bool:
    """Return whether another band deviates alike, within a few frames, and as suddenly."""
    # Places: a frame, and those that it deviates from. Span: first and last deviant frame, or of a
    # step its frame and the frame before.
    if not _is_sudden(sections[band], places, span, _COMES):
        return True  # the object, or people, who come and go
    deviation = sections[band][places[0]] - sections[band][places[1:]].mean(axis=0)
    for second, section in enumerate(sections):
        for lag in range(-_LAGS, _LAGS + 1) if second != band else ():
            moved = np.append(places, span) + lag
            if moved.min() < 0 or moved.max() >= len(section) or not valid[second, moved].all():
                continue
            partner = section[moved[0]] - section[moved[1:-2]].mean(axis=0)
            energy = np.linalg.norm(deviation) * np.linalg.norm(partner)
            agreement = deviation @ partner > _SHARED * energy
            if agreement and _is_sudden(section, moved[:-2], moved[-2:], 0.5 * _COMES):
                return True
    return False


def _is_sudden(section: Array, places: Frames, span: Frames, share: float) -> bool:
    """Return whether a deviation comes with the first frame and goes with the last one."""
    first, last = span
    deviation = section[places[0]] - section[places[1:]].mean(axis=0)
    energy = deviation @ deviation
    if last < first:  # a step, unlike the changes before and after
        changes = np.diff(section[max(first - 2, 0) : first + 2], axis=0) @ deviation
        return bool(np.delete(changes, min(first - 1, 1)).max(initial=0.0) < _RETURN * energy)
    sides, drift = section[places[1:]], section[places[2]] - section[places[1]]
    comes, goes = section[first] - sides[0], section[last] - sides[1]
    # At an end of the capture both frames lie on one side, where a drift deviates as well.
    ends = (places[1] > places[0]) == (places[2] > places[0])
    drifts = ends and abs(drift @ deviation) > _RETURN * energy
    return bool(min(comes @ deviation, goes @ deviation) > share * energy and not drifts)


def _usual_gain(band: int, film: Film, sections: Means, valid: Mask) -> Mask:
    """Frames (time) of the gain that most have, by noise with contrast, or with the pattern."""
    (frames,) = np.nonzero(valid[band])
    film, means, level = film[frames], sections[band][frames], np.zeros(valid.shape[1])
    change = np.abs(np.diff(means, axis=0)).mean(axis=1)
    large = 1 + np.flatnonzero(change > OUTLIER * np.median(change))
    for place in large[(large >= FEWEST_COPIES) & (large <= len(film) - FEWEST_COPIES)]:
        sides = film[max(place - _SIDE, 0) : place], film[place : place + _SIDE]
        noises = [float(np.median(np.abs(np.diff(side, 2, axis=0)))) for side in sides]
        scenes, pair = means[place - 1 : place + 1], frames[[place, place - 1]]
        if min(*noises, *scenes.std(axis=1)) == 0.0:
            continue
        gain = np.log(noises[1] / noises[0])
        contrast = np.log(scenes[1].std() / scenes[0].std())
        switch = 0.5 * contrast**2 < gain * contrast
        switch &= np.asarray(np.corrcoef(scenes))[0, 1] > _CORRELATION
        jump = float(np.median(np.abs(np.diff(film[place] - film[place - 1], axis=1))))
        switch &= min(abs(gain), abs(contrast)) > _GAIN and abs(gain) < 1.5 * abs(contrast)
        renewed = abs(gain) > _GAIN and jump > OUTLIER * max(noises)
        if (switch or renewed) and not _is_shared(sections, valid, band, pair, pair):
            level[pair[0] :] += gain
    members = np.abs(level[:, np.newaxis] - np.unique(level[valid[band]])) < 0.5 * _GAIN
    return np.asarray(members[:, np.argmax(members[valid[band]].sum(axis=0))])


def _steps(films: list[Film], valid: Mask, renewals: Mask) -> Mask:
    """First frames (band, time) after which the pattern of one band is another, at once."""
    # Detail from pixel to pixel, in which object and reflections are weak.
    details = [film[..., 1:-1] - 0.5 * (film[..., :-2] + film[..., 2:]) for film in films]
    details = [detail.reshape(len(detail), -1) for detail in details]
    scores = np.stack(list(map(_scores, details, valid, renewals)))
    steps, ahead = np.zeros(valid.shape, dtype=bool), scores.copy()
    while ahead.max() > _STEP:
        band, frame = map(int, np.unravel_index(np.argmax(ahead), ahead.shape))
        ahead[band, max(frame - _WINDOW, 0) : frame + _WINDOW] = 0.0
        change, shares, _ = _change(details[band], valid[band], frame)
        first = int(np.argmax(shares))
        change, _, stays = _change(details[band], valid[band], first)
        # A step of the scene: of the same pixels in another band, or at once in its detail, too.
        scene = shares[first] < _AT_ONCE or stays < _AT_ONCE
        for second in np.flatnonzero(scores.any(axis=1) & (np.arange(len(scores)) != band)):
            partner, shared, _ = _change(details[second], valid[second], first)
            at_once = shared[max(first - 1, 0) : first + 2].max() > _ALSO
            scene |= abs(np.mean(np.sign(change) * np.sign(partner))) > _SIGNS
            scene |= at_once and scores[second, first] > _BOTH
        steps[band, first] = not scene
    return steps


def _scores(detail: Film, valid: Mask, renewals: Mask) -> Array:
    """Variance (time) of a step of the pattern at each frame, over that of noise and motion."""
    scores, (frames,) = np.zeros(len(detail)), np.nonzero(valid)
    width = min(_WINDOW, len(frames) // 3)
    flat = detail[frames].astype(np.float64)
    noise = MAD * float(np.median(np.abs(np.diff(flat, axis=0)))) / np.sqrt(2.0)
    if noise > 0.0 and width >= _SIDE and flat.shape[1] >= _FEWEST:
        total = np.cumsum(np.pad(flat, ((1, 0), (0, 0))), axis=0)
        steps = total[2 * width :] - 2.0 * total[width:-width] + total[: -2 * width]
        ratio = (MAD * np.median(np.abs(steps), axis=1)) ** 2 / (2.0 * width * noise**2)
        scores[frames[width : 1 - width]] = ratio / max(1.0, float(np.median(ratio)))
    for place in np.searchsorted(frames, np.flatnonzero(renewals)):  # which have segments
        scores[frames[max(place - width, 0) : place + width]] = 0.0
    return scores


def _change(detail: Film, valid: Mask, frame: int) -> tuple[Film, Array, float]:
    """Change of the detail (pixel) at a frame; shares of it by frame (time), and that stay."""
    before, after = np.flatnonzero(valid[:frame])[::-1], frame + np.flatnonzero(valid[frame:])
    if min(before.size, after.size) == 0:
        return np.zeros(detail.shape[1], dtype=np.float32), np.zeros(len(detail)), 0.0
    # Means of the frames on both sides: of the next ones, and beyond, where the step remains.
    step, remainder = (
        detail[after[section] if after[section].size else after].mean(axis=0)
        - detail[before[section] if before[section].size else before].mean(axis=0)
        for section in (slice(_WINDOW), slice(_WINDOW, 2 * _WINDOW))
    )
    # Shares where the detail changes most.
    strong = np.abs(step) > np.median(np.abs(step))
    frames = np.sort(np.concatenate([before[:_WINDOW], after[:_WINDOW]]))
    shares = np.zeros(len(detail))
    jumps = np.diff(detail[frames][:, strong], axis=0)
    shares[frames[1:]] = np.median(jumps / step[strong], axis=1)
    return step, shares, float(np.median(remainder[strong] / step[strong]))
