r"""Local polynomials in time, over windows as wide as the data allow, for curves of known noise.

The widest window is taken of which the estimate agrees with those of all narrower ones, by the
intersection of their confidence intervals [1]_, frame by frame: what is smooth is averaged over
many frames, what is rapid over few.

.. [1] Goldenshluger, Nemirovski (1997), On spatially adaptive estimation of nonparametric
   regression, Mathematical Methods of Statistics 6, 135
"""

from typing import Final

import numpy as np

from dbthermal.separation._tiles import Array, Mask

# Half-widths grow by this factor; deviations within which estimates agree.
_GROWTH: Final = 1.5
_AGREE: Final = 1.5
# Variance that is stated over that of the noise: the rest is what a window bends [1].
_BENT: Final = 1.35
# Half-width from which the polynomial is a parabola, and a line below [frame].
_PARABOLA: Final = 4


def smooth(values: Array, variance: Array, valid: Mask, time: Array) -> tuple[Array, Array]:
    """
    Smooth curves (time, pixel) of white noise of a variance (time, pixel), at valid samples.

    Returns the curves and the variances that are left; a sample that is not valid is given what the
    narrowest window that holds enough others gives, or NaN.
    """
    frames = len(values)
    level = np.where(valid, values, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    centred = np.where(valid, values - level, 0.0)
    noise = np.where(valid, variance, 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    position = (time - time[0]) / max(time[-1] - time[0], 1e-300) if frames > 1 else np.zeros(1)
    weight = valid.astype(np.float64)
    powers = position[:, np.newaxis] ** np.arange(5)
    sums = [_cumulative(weight * powers[:, [i]]) for i in range(5)]
    values_sums = [_cumulative(centred * powers[:, [i]]) for i in range(3)]
    result = np.where(valid, centred, np.nan)
    left = np.where(valid, variance, np.inf)
    lower, upper = np.full_like(result, -np.inf), np.full_like(result, np.inf)
    going = np.ones_like(valid)
    previous = (result.copy(), left.copy())
    half = 1
    while half < frames:
        estimate, share = _fit(sums, values_sums, position, half)
        deviation = np.sqrt(share * noise)
        known = np.isfinite(estimate)
        lower = np.where(known, np.maximum(lower, estimate - _AGREE * deviation), lower)
        upper = np.where(known, np.minimum(upper, estimate + _AGREE * deviation), upper)
        going &= lower <= upper
        # One window narrower than the widest that agrees: its bias is small beside its noise.
        better = going & np.isfinite(previous[0]) & (previous[1] <= left)
        result, left = np.where(better, previous[0], result), np.where(better, previous[1], left)
        first = known & ~np.isfinite(result)
        result, left = np.where(first, estimate, result), np.where(first, share * noise, left)
        previous = (
            np.where(known, estimate, previous[0]),
            np.where(known, share * noise, previous[1]),
        )
        if not np.any(going):
            break
        half = max(half + 1, int(half * _GROWTH))
    return result + level, np.where(
        np.isfinite(left) & (left < variance), np.minimum(_BENT * left, variance), left
    )


def _cumulative(values: Array) -> Array:
    """Sums of the samples before each place (time + 1, pixel)."""
    return np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values, axis=0)])


def _fit(sums: list[Array], values: list[Array], position: Array, half: int) -> tuple[Array, Array]:
    """Value at the centre of each window, and its variance over the noise's; NaN if not fixed."""
    frames = len(position)
    place = np.arange(frames)
    low, high = np.maximum(place - half, 0), np.minimum(place + half + 1, frames)
    width = position[np.minimum(high, frames - 1)] - position[low]
    scale = (1.0 / np.maximum(width, 1e-300))[:, np.newaxis]
    at = position[:, np.newaxis]
    raw = [part[high] - part[low] for part in sums]
    data = [part[high] - part[low] for part in values]
    # Moments about the window's centre, by the binomial theorem, in units of its width.
    s0 = raw[0]
    s1 = (raw[1] - at * raw[0]) * scale
    s2 = (raw[2] - 2 * at * raw[1] + at**2 * raw[0]) * scale**2
    z0 = data[0]
    z1 = (data[1] - at * data[0]) * scale
    with np.errstate(all="ignore"):
        if half < _PARABOLA:
            determinant = s0 * s2 - s1**2
            value, share = (s2 * z0 - s1 * z1) / determinant, s2 / determinant
            fixed = determinant > 1e-6 * s0**2
        else:
            s3 = (raw[3] - 3 * at * raw[2] + 3 * at**2 * raw[1] - at**3 * raw[0]) * scale**3
            s4 = (
                raw[4] - 4 * at * raw[3] + 6 * at**2 * raw[2] - 4 * at**3 * raw[1] + at**4 * raw[0]
            ) * scale**4
            z2 = (data[2] - 2 * at * data[1] + at**2 * data[0]) * scale**2
            # First row of the inverse of ((s0 s1 s2) (s1 s2 s3) (s2 s3 s4)).
            c0, c1, c2 = s2 * s4 - s3**2, s2 * s3 - s1 * s4, s1 * s3 - s2**2
            determinant = s0 * c0 + s1 * c1 + s2 * c2
            value, share = (c0 * z0 + c1 * z1 + c2 * z2) / determinant, c0 / determinant
            fixed = determinant > 1e-8 * s0**3
    return np.where(fixed, value, np.nan), np.where(fixed, share, np.inf)
