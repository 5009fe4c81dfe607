r"""Share of the image in which the bands show rapid changes displaced, in the image or in time.

Windows are matched by Gauss-Newton steps from no displacement (Lucas, Kanade 1981), of what no
smooth object shows; and of what no object shows that heats within seconds, where reflections are as
rapid:

.. math:: z_2 = \kappa_w \, (z_1 + d \cdot \nabla z_1)
"""

from typing import Final

import numpy as np
import xarray as xr
from scipy.special import fdtrc

from dbthermal import _smooth as smooth
from dbthermal import schema
from dbthermal._arrays import Array, stride
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._planes import SMALLEST, Scale, bridged
from dbthermal.alignment._products import Movie, blurred, normal_equations, products, splines

# Frames, windows along either side, and their sides [pixel].
_FRAMES, _ALONG, _SIDES = 400, 8, (8, 16)
_BLUR: Final = 2.0  # before a displacement is looked for [pixel]
# Chance below and pixels or frames from which it is a displacement, of so many windows at least.
_CHANCE, _LEAST, _LEAST_LATE, _FEWEST = 1e-3, 0.3, 0.1, 4
_STRONG: Final = 3.0  # variance of a window's changes over the noise
# Functions of time, of a smooth object at most, and of what changes rapidly; pixels that tell them.
_ORDER, _PLANES, _PIXELS = 14, 32, 100
_COMMON: Final = 0.9  # samples of a pixel over those of others


def share_displaced(corrected: xr.Dataset, scale: Scale) -> float:
    """Share of windows of the image in which the bands show rapid changes apart; 0 if none do.

    Displaced in the image, or in time. Both are seen if one alone is more than that of a poor
    registration, and they are beyond chance by what they change without one window after another
    (Hotelling's T-squared of the jackknife): an object's rapid changes displace a window, and so
    does a border of materials, but not all windows alike.
    """
    if min(corrected.sizes.get(name, 0) for name in ("y", "x")) < SMALLEST:
        return 0.0
    return max(_share(windows) for windows in _equations(corrected, scale))


def _share(windows: Array) -> float:
    """Share of windows whose bands are apart, from normal equations A d = g (window, 4, 3)."""
    number, whole, size = len(windows), windows.sum(axis=0), windows.shape[2]
    # All windows, and those without one after another, have to tell a displacement.
    sums = np.concatenate([whole[np.newaxis], whole - windows])
    if number < _FEWEST or np.linalg.eigvalsh(sums[:, :size]).min() <= 0.0:
        return 0.0
    shift, *without = np.linalg.solve(sums[:, :size], sums[:, size, :, np.newaxis])[..., 0]
    covariance = (number - 1) ** 2 / number * np.cov(np.transpose(without))
    square, free = shift @ np.linalg.solve(covariance, shift), number - size
    chance = fdtrc(size, free, free / (number - 1) / size * square)
    in_image = np.linalg.solve(whole[:2, :2], whole[size, :2])
    in_time = whole[size, 2] / whole[2, 2]
    if chance > _CHANCE or (np.hypot(*in_image) < _LEAST and abs(in_time) < _LEAST_LATE):
        return 0.0
    # Windows whose residual is smaller with it: 2 d g - d A d > 0.
    return float(np.mean((2.0 * windows[:, size] - windows[:, :size] @ shift) @ shift > 0.0))


def _equations(corrected: xr.Dataset, scale: Scale) -> list[Array]:
    """Normal equations A d = g (window, 4, 3) of the displacement of windows with rapid changes.

    Down and right in the image [pixel], and in time [frame]; the ratio of a window is eliminated,
    and what noise adds is subtracted.
    """
    frames = slice(None, None, max(1, corrected.sizes["time"] // _FRAMES))
    noise = scale.noise_of(corrected)
    bands, time = np.argsort(noise, kind="stable")[:2], corrected["time"].values[frames]
    slopes = scale.slopes[bands].astype(np.float32)[:, np.newaxis, np.newaxis, np.newaxis]
    counts, (rows, columns) = corrected["counts"].variable[:, frames], _measured(corrected)

    def films(rows: slice, columns: slice) -> Movie:
        """Films (band, time, y, x) [K] of some rows and columns."""
        film = counts[:, :, rows, columns].values[bands].astype(np.float32)
        film[:, ~schema.measured(film).all(axis=0)] = np.nan  # of both the same samples
        flat = film.reshape(2, time.size, -1)
        (first, share), (second, _) = (bridged(part) for part in flat)
        used = share > _COMMON * share.max()
        whole = np.where(used, np.stack([first, second]), np.float32(0.0))
        return np.asarray(whole.reshape(film.shape) / slopes, np.float32)

    # Functions of time of what changes rapidly in the quietest band.
    height, width = rows.stop - rows.start, columns.stop - columns.start
    step = stride((height, width), _PIXELS)
    grid = slice(rows.start, rows.stop, step), slice(columns.start, columns.stop, step)
    some = films(*grid)[0].reshape(time.size, -1).T.astype(np.float64)
    segment = clocks.segments(corrected)[frames]
    orders = min(_ORDER, time.size // 4), time.size // 4
    curves = [smooth.subspace(time, order, segment=segment).functions for order in orders]
    functions = [smooth.leading(some - some @ part @ part.T, _PLANES) for part in curves]
    rates = [np.gradient(part, axis=0).T @ part for part in functions]

    # Sums over the windows of rows of windows.
    side = int(np.clip(min(height, width) // _ALONG, *_SIDES))
    tops, lefts = (
        span.start + np.linspace(0, size - side, min(_ALONG, size // side)).astype(int)
        for span, size in ((rows, height), (columns, width))
    )
    sums: list[list[Array]] = [[] for _ in functions]
    for top in tops:
        film = films(slice(top, top + side), columns)
        places = np.indices(film.shape[2:]).astype(np.float64)
        for part, function, rate in zip(sums, functions, rates, strict=True):
            planes = np.tensordot(film, function.astype(np.float32), (1, 0))
            first, second = splines(planes[0], _BLUR), blurred(planes[1], _BLUR)
            pairs = products(first, [second], places, rate.astype(np.float32))[0].sum(axis=0)
            within = (slice(left, left + side) for left in lefts - columns.start)
            part.extend(pairs[window].sum(axis=0) for window in within)
    # Noise of variance s^2, blurred by b: s^2 / (4 pi b^2), of a slope 1 / (2 b^2) of that.
    level, slope, result = noise[bands[0]] ** 2 / (4.0 * np.pi * _BLUR**2), 0.5 / _BLUR**2, []
    for windows, rate in zip(sums, rates, strict=True):
        squares = np.array([len(rate), len(rate) * slope, len(rate) * slope, np.sum(rate**2)])
        squares *= side**2 * level
        strong = [window for window in windows if window[0] > (_STRONG + 1.0) * squares[0]]
        result.append(normal_equations(np.reshape(strong, (-1, 15)), squares))
    return result


def _measured(corrected: xr.Dataset) -> tuple[slice, slice]:
    """Rows and columns with samples in some frames, as of an object in a part of the image."""
    every = slice(None, None, max(1, corrected.sizes["time"] // _ALONG))
    seen = schema.measured(corrected["counts"].isel(time=every).values).all(axis=0).any(axis=0)
    seen |= not seen.any()
    rows, columns = (np.flatnonzero(seen.any(axis=axis)) for axis in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
