"""Sentences on what speaks against a result as a whole: its calibration, its share of flags."""

from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import median_filter

from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import stride
from dbthermal.noise import MAD
from dbthermal.schema import Status
from dbthermal.separation._tiles import RANGE_SIGMAS

_FRAMES: Final = 50  # frames and pixels, about, that are judged by the response
_PIXELS: Final = 2_500
_OUTSIDE: Final = 0.01  # share of samples outside the calibration that gives a warning
_HARDLY: Final = 0.2  # share of moving pixels without a flag; below, 50 to 82 % of intervals hold
_FLAGS_NAMED: Final = 3  # flags that are named
_SAMPLES: Final = 2**24  # of a band, in which a step of a camera's level is sought, at most
_FEWEST: Final = 100  # pixels in which such a step is sought, at least
_PAUSE: Final = 1.5  # frame periods, from which two frames do not follow one another
_WINDOW: Final = 9  # frames whose median change is a lasting one of the scene
# Least step in deviations of noise, and of flicker, of which 280 frames have up to 3.7; share of a
# step that another band may show, with so many deviations of its noise.
_CERTAIN, _RARE, _SHARE, _SIGMAS = 16.0, 6.0, 0.15, 4.0
_SKEW: Final = 0.5  # difference of mean and median, relative to a step of all pixels


def against_response(corrected: xr.Dataset, response: xr.Dataset) -> list[str]:
    """Doubts about counts of a capture that do not fit its response."""
    sentences = list[str]()
    counts = schema.check(corrected, "corrected")["counts"]
    if counts.dtype.kind != "f":  # raw counts of pixels that differ
        return []
    step = stride(counts.shape[2:], _PIXELS)
    status = schema.pixel_status(corrected)[::step, ::step]
    good = (status & np.uint32(Status.DEAD_PIXEL)) == 0
    names = [str(name) for name in counts["band"].values]
    noises = responses.noise(response, names) if "noise" in response else np.zeros(len(names))
    patterns = corrected["pattern_std"].values if "pattern_std" in corrected else 0.0
    stds = np.hypot(noises * schema.noise_factor(corrected), patterns)
    curves = responses.curves(response, names)
    ends = [curve.counts([curve.lowest, curve.highest]) for curve in curves]
    fitting = list[str]()  # the band of each, whose range the fewest samples lie outside
    for place, (name, film, std) in enumerate(zip(names, counts, stds, strict=True)):
        samples = film[:: max(1, len(film) // _FRAMES), ::step, ::step].values[:, good]
        limits = [RANGE_SIGMAS * std * np.array([-1, 1]) + end for end in ends]
        number = max(1, np.count_nonzero(~np.isnan(samples)))
        shares = [((samples < low) | (samples > high)).sum() / number for low, high in limits]
        fitting.append(names[int(np.argmin(shares))])
        if shares[place] > _OUTSIDE:
            low, high = ends[place]
            sentences.append(
                f"{shares[place]:.0%} of the samples of band '{name}' lie outside the {low:.0f} to "
                f"{high:.0f} count that its response was calibrated over. Must lie within: "
                "calibrate over the temperatures of the scene; or is it another band's response?"
            )
    if all(name != band for name, band in zip(names, fitting, strict=True)):
        rule = "are files of the bands exchanged, of the scene or of the blackbody?"
        sentences.insert(0, f"Counts of bands {names} fit the response of {fitting} better: {rule}")
    return sentences


def of_one_camera(corrected: xr.Dataset, response: xr.Dataset) -> list[str]:
    """Doubts about a step of one band's level alone, in all pixels: a camera's, not the scene's."""
    counts, time = corrected["counts"], corrected["time"].values
    pixels = min(_PIXELS, max(_FEWEST, _SAMPLES // time.size))
    step = stride(counts.shape[2:], pixels)
    joined = np.diff(time) < _PAUSE * np.median(np.diff(time))
    joined &= np.diff(schema.segments(corrected)) == 0
    films = counts[:, :, ::step, ::step].values.reshape(*counts.shape[:2], -1)
    # Samples that all bands have: on one clock a resampled band lacks samples where much moves.
    valid = schema.measured(films).all(axis=0)
    valid = valid[1:] & valid[:-1]
    number = valid.sum(axis=1)
    frames = joined & (number > max(_FEWEST, 0.5 * valid.shape[1]))
    if not frames.any():  # too few pixels tell it
        return []
    names, sentences = [str(name) for name in counts["band"].values], list[str]()
    slopes = np.array([[curve.reference_slope] for curve in responses.curves(response, names)])
    with np.errstate(invalid="ignore"):
        changes = np.where(valid, np.diff(films, axis=1), np.nan)  # [count]
    # Changes less lasting ones of the scene; a quartile lies 0.67 deviations from the median.
    ordered = np.sort(changes, axis=2)  # NaN last
    ranks = (np.array([0.25, 0.5, 0.75]) * np.maximum(number[:, np.newaxis] - 1, 0)).astype(np.intp)
    quartiles = np.take_along_axis(ordered, ranks[np.newaxis], axis=2)
    low, middle, high = np.moveaxis(quartiles, 2, 0) / slopes
    mean = np.nansum(changes, axis=2, dtype=np.float64) / np.maximum(number, 1) / slopes
    noise = 0.5 * MAD * np.median((high - low)[:, frames], axis=1) / np.sqrt(valid.shape[1])
    mean, median = (
        np.where(frames, film - median_filter(film, (1, _WINDOW)), 0.0)
        for film in (np.where(frames, mean, 0.0), np.where(frames, middle, 0.0))
    )
    flicker = MAD * np.median(np.abs(mean[:, frames]), axis=1)  # of whole frames
    unseen = np.abs(mean) + _SIGMAS * noise[:, np.newaxis]
    for place, size in enumerate(np.abs(mean)):
        jumps = np.all(np.delete(unseen, place, axis=0) < _SHARE * size, axis=0)
        jumps &= size > max(_CERTAIN * noise[place], _RARE * flicker[place])
        # A part of the image that moves changes the mean but not the median; a camera changes both.
        jumps &= np.abs(median[place] - mean[place]) < _SKEW * size
        if jumps.any():
            frame = int(np.argmax(size * jumps))
            sentences.append(
                f"The level of band '{names[place]}' steps by "
                f"{mean[place, frame]:.2g} K at {time[frame + 1]:g} s in all pixels, and no other "
                "band's does: a camera's own, which no error bar holds. Must be steady, or marked "
                "(correction.mark_shutter)."
            )
    return sentences


def hardly_measured(result: xr.Dataset) -> list[str]:
    """Share of the moving pixels without a flag, and the commonest flags, if these are few."""
    if "status" not in result:
        return []
    status = result["status"].values.astype(np.uint32)
    moving = status[(status & np.uint32(Status.NO_BACKGROUND_MOTION)) == 0]
    measured = (moving & ~np.uint32(Status.COMPLETED_FRAMES)) == 0
    share = measured.sum() / max(1, moving.size)
    if share >= _HARDLY:
        return []
    bits = [bit for bit in Status if not bit & schema.COMPLETED]
    shares = {bit.label: float(np.mean((status & np.uint32(bit)) != 0)) for bit in bits}
    reasons = sorted(shares, key=lambda name: -shares[name])[:_FLAGS_NAMED]
    named = ", ".join(f"{name} {shares[name]:.0%}" for name in reasons if shares[name] > 0)
    sentences = f"{share:.0%} of the {moving.size} pixels with moving reflections have no flag"
    rule = "dbthermal.schema.Status says what each flag means"
    return [f"Hardly anything was measured: {sentences}. Of all pixels: {named}. {rule}."]
