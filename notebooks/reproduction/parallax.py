"""Displacement of two published videos: of the still edges, and of what the object mirrors.

The videos have no radiometry, and their noise is the codec's: neither white nor known. So one
displacement is found for a whole scene, from the bands' correlation alone, where
`alignment.reflection_shift` needs the noise of each band for a field.
"""

import contextlib
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.fft import next_fast_len
from scipy.ndimage import shift

from dbthermal import alignment

Array = npt.NDArray[np.float64]
Movie = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

REACH: Final = (6, 48)
"""Largest displacement that is searched for, rows and columns [pixel]."""

_SHARED: Final = 0.4  # share of the object's pixels that still show it when they are displaced
_ORDER: Final = 9  # smooth functions that are left out
_PARTS: Final = 5  # of a capture, in which the still edges are registered


def edges_shift(movie: xr.DataArray) -> xr.DataArray:
    """Displacement (axis) [pixel] of the still edges: the second band shows at p the first's p + d.

    Median of those of five parts of the capture, from `alignment.register` of their mean pictures.
    Parts without edges, as before anything is warm, are left out; NaN if all are.
    """
    parts: list[Array] = []
    for frames in np.array_split(np.arange(movie.sizes["time"]), _PARTS):
        # Register the part as if its values were counts.
        counts = movie.isel(time=frames).drop_vars("gain", errors="ignore").rename("counts")
        capture = counts.astype("float32").assign_attrs(units="count").to_dataset()
        with contextlib.suppress(ValueError):
            found = alignment.register(capture, model="translation").isel(band=1)
            parts.append(-found.values[[1, 0], 2])
    return _displacement(np.median(parts or [np.full(2, np.nan)], axis=0))


def reflections_shift(movie: xr.DataArray, outline: xr.DataArray) -> xr.DataArray:
    """Displacement (axis) [pixel] of the reflections: the second band shows at p the first's p + d.

    That of the largest correlation of the bands' rapid changes over the object, between whole
    pixels by a parabola. Attributes: `correlation` there, and `correlation_at_0`. NaN if it lies at
    the end of the search, `REACH`.
    """
    # Correlate the rapid changes at every whole displacement.
    first, second = _rapid(movie, outline.values)
    scores = _correlations(first, second, outline.values)
    place = np.array(np.unravel_index(np.argmax(scores), scores.shape))
    largest = {"correlation": scores.max(), "correlation_at_0": scores[REACH]}
    attrs = {name: float(value) for name, value in largest.items()}
    # Between whole pixels by a parabola, unless the largest lies at the end of the search.
    if np.any(place == 0) or np.any(place == np.array(scores.shape) - 1):
        return _displacement(np.full(2, np.nan)).assign_attrs(attrs)
    peak = place - REACH + np.array([_parabola(scores, place, axis) for axis in (0, 1)])
    return _displacement(peak).assign_attrs(attrs)


def _displacement(value: Array) -> xr.DataArray:
    return xr.DataArray(value, {"axis": ["y", "x"]}, "axis", attrs={"units": "pixel"})


def _rapid(movie: xr.DataArray, inside: Mask) -> list[Movie]:
    """Weighted changes (time, y, x) of the bands that smooth functions leave; 0 off the object."""
    gain = movie.coords.get("gain", xr.ones_like(movie.isel(y=0, x=0, drop=True)))
    weight = np.sqrt(gain.prod("band").values)[:, np.newaxis]
    place = np.linspace(-1, 1, movie.sizes["time"])
    functions, _ = np.linalg.qr(weight * np.polynomial.legendre.legvander(place, _ORDER - 1))
    result = []
    for band in movie.values:
        values = weight * band[:, inside]
        part = np.zeros(band.shape, dtype=np.float32)
        part[:, inside] = values - functions @ (functions.T @ values)
        result.append(part)
    return result


def _correlations(first: Movie, second: Movie, inside: Mask) -> Array:
    """Correlation of second(p) with first(p + d) over the object, by d within `REACH`."""
    size = [next_fast_len(n + r, real=True) for n, r in zip(inside.shape, REACH, strict=True)]

    def lagged(there: npt.NDArray[np.floating], here: npt.NDArray[np.floating]) -> Array:
        """Sum over p of there(p + d) here(p)."""
        both = np.conj(np.fft.rfft2(here, size)) * np.fft.rfft2(there, size)
        rows, columns = (np.arange(-reach, reach + 1) for reach in REACH)
        return np.asarray(np.fft.irfft2(both, size)[np.ix_(rows, columns)])

    cross = sum(lagged(a, b) for a, b in zip(first, second, strict=True))
    mask = inside.astype(np.float64)
    shared = lagged(mask, mask)
    energy = lagged(np.sum(first**2, axis=0), mask) * lagged(mask, np.sum(second**2, axis=0))
    found = (shared >= _SHARED * mask.sum()) & (energy > 0)
    return np.where(found, cross / np.sqrt(np.where(found, energy, 1.0)), -1.0)


def _parabola(scores: Array, place: npt.NDArray[np.intp], axis: int) -> float:
    """Place of the extreme of the parabola through three neighbours, from the middle one."""
    step = np.eye(2, dtype=int)[axis]
    below, here, above = (scores[tuple(place + k * step)] for k in (-1, 0, 1))
    return float(0.5 * (below - above) / (below - 2 * here + above))


def moved(movie: xr.DataArray, displacement: xr.DataArray) -> xr.DataArray:
    """Movie with the first band taken at p + d, so that both show a reflection at one pixel.

    Raises a ValueError if the displacement is not known.
    """
    if not np.all(np.isfinite(displacement)):
        raise ValueError("Unknown displacement of the reflections. Must be within the search.")
    result, back = movie.copy(), -displacement.values
    for frame in result.values[0]:
        frame[...] = shift(frame, back, order=3, mode="nearest")
    return result


def shared_outline(outline: xr.DataArray, displacement: xr.DataArray) -> xr.DataArray:
    """Pixels (y, x) that show the object in both bands, the first displaced if that is known."""
    back = -np.nan_to_num(displacement.values)
    there = shift(outline.values.astype(float), back, order=1)
    return outline.copy(data=outline.values & (there > 0.99))
