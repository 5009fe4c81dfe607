"""Refusal of times that are not those of exposure: slow changes are smooth over the frames then."""

from typing import Final

import numpy as np

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace import pieces, reflection_ratio
from dbthermal.separation._tiles import Array, Whole

# Gain of the information criterion by the numbers of the frames, in units of a function's cost:
# in the median over many pixels, and what is added for one by chance.
_GAIN: Final = 0.5
_CHANCE: Final = 6.0
_SIGMAS: Final = 3.0
# Excess of the reduced chi-square over the times, at least so many times that over the numbers.
_EXCESS: Final = 5.0


def check(signals: Array, time: Array, noise: Array, segment: Whole | None) -> None:
    r"""
    Refuse times [s] over which the slow changes are not smooth, but smooth in the frames' numbers.

    So are those at which frames arrived in bursts, and those of a clock that was set. Of signals
    (band, time, pixel) [K], quietest band first, with `noise` (band) [K], the energy E across the
    axis is compared, pixel by pixel, by :math:`N \ln(E_{time} / E_{number})`. Where it is as large
    in both, the object does not change smoothly, or its changes are too small to tell.
    """
    frames, white = time.size, pieces.plane(signals, noise)[0]
    any_axis = np.full((2, white.shape[2]), np.nan)
    order = min(reflection_ratio.HIGHEST_ORDER, frames // 4)
    chi2 = []
    for clock in (time, np.arange(frames, dtype=np.float64)):
        functions = smooth.subspace(clock, order, segment=segment)
        with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
            energy, used = pieces.null_energy(white, functions, any_axis)
            chi2.append(energy / (frames - used))
    good = (chi2[0] > 0) & (chi2[1] > 0)
    if not np.any(good):
        return
    over_times, over_numbers = (float(np.median(part[good])) for part in chi2)
    gain = frames * np.log(chi2[0][good] / chi2[1][good]) / np.log(frames)
    gained = np.median(gain) > _GAIN + _CHANCE / np.sqrt(gain.size)
    # A reduced chi-square of f degrees of freedom has the standard deviation sqrt(2 / f).
    chance = _SIGMAS * np.sqrt(2.0 / (frames * gain.size))
    if gained and over_times - 1.0 > _EXCESS * max(over_numbers - 1.0 - chance, 0.0):
        steps = np.diff(time)
        raise ValueError(
            f"Invalid 'time' of the capture, in steps of {steps.min():.3g} to {steps.max():.3g} s: "
            "slow changes are not smooth over these times (reduced chi-square "
            f"{over_times:.3f}), but over the numbers of the frames ({over_numbers:.3f}). Must be "
            "times of exposure, not of arrival, of a clock that is not set meanwhile."
        )
