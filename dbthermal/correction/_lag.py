"""Lag of the pixels: a microbolometer is a small body with a thermal time constant of its own."""

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import planck, schema

Array = npt.NDArray[np.float64]


def noise_amplification(interval: npt.ArrayLike, time_constant: npt.ArrayLike) -> Array:
    r"""
    Factor by which undoing the lag raises white noise.

    .. math:: \sqrt{1 + a^2} / (1 - a), \quad a = e^{-\Delta t / \tau}

    For 10 ms it is 1.00005 at 10 Hz, 1.25 at 60 Hz and 1.7 at 100 Hz.

    Parameters
    ----------
    interval : array_like
        Time between two frames [s].
    time_constant : array_like
        Time constant of the pixels [s].

    Returns
    -------
    ndarray
        Standard deviation after over before [1].

    Raises
    ------
    ValueError
        If an interval or a time constant is not finite and positive.
    """
    interval = planck.require_positive("interval [s]", interval)
    ratio = interval / planck.require_positive("time_constant [s]", time_constant)
    return np.asarray(np.hypot(1.0, np.exp(-ratio)) / -np.expm1(-ratio))


def undo_lag(corrected: xr.Dataset, time_constant: float | xr.DataArray) -> xr.Dataset:
    r"""
    Signal that pixels of first-order lag would have shown without it.

    A pixel follows :math:`\tau \dot I = z - I`. For z held from each frame to the next, exactly,

    .. math:: I_n = a_n I_{n-1} + (1 - a_n) z_n, \quad
              z_n = \frac{I_n - a_n I_{n-1}}{1 - a_n}, \quad a_n = e^{-(t_n - t_{n-1}) / \tau}

    The first frame becomes NaN, for what came before it is not known; so does a frame after one
    that is NaN. White noise is raised by `noise_amplification`, and is then not white: successive
    frames have the correlation :math:`-a / (1 + a^2)`. Undo a lag that matters, not one that does
    not: at 10 Hz a pixel of 10 ms has forgotten all but 5e-5 of the frame before.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, after `mark_shutter`: a repeated frame is no measurement.
    time_constant : float or DataArray
        Time constant of the pixels [s], of all bands or (band), by name.

    Returns
    -------
    Dataset
        The dataset with other `counts` [count], and the attributes ``lag_time_constant`` [s] and
        ``lag_noise_amplification`` [1], each by band, the latter at the median interval. A known
        noise must be multiplied by it.

    Raises
    ------
    TypeError, ValueError
        If the dataset is not as `schema` has it, has fewer than two frames, was undone before or
        holds whole numbers, or a time constant is not finite and positive or a band has none.
    """
    counts = schema.check(corrected, "corrected")["counts"]
    _require_lagging(corrected)
    constants = time_constants(time_constant, counts)
    interval = np.diff(counts["time"].values.astype(np.float64))
    signal = np.full_like(counts.values, np.nan)
    for band, constant in enumerate(constants):
        kept, new = memory(interval, constant)
        movie = counts.isel(band=band).values
        for frame in range(1, movie.shape[0]):
            # Added to the frame, a correction that is small where the lag is.
            change = (movie[frame] - movie[frame - 1]) * (kept[frame - 1] / new[frame - 1])
            signal[band, frame] = movie[frame] + change
    factor = noise_amplification(float(np.median(interval)), constants)
    return corrected.assign(counts=(counts.dims, signal, counts.attrs)).assign_attrs(
        lag_time_constant=constants.tolist(), lag_noise_amplification=factor.tolist()
    )


def memory(interval: Array, time_constant: float) -> tuple[Array, Array]:
    r"""
    What a pixel keeps of the frame before, and takes of the new one.

    Parameters
    ----------
    interval : ndarray, shape (frame,)
        Times between frames [s].
    time_constant : float
        Time constant [s].

    Returns
    -------
    tuple of ndarray
        :math:`a = e^{-\Delta t / \tau}` and :math:`1 - a` [1], both to full precision.
    """
    ratio = interval / time_constant
    return np.exp(-ratio), -np.expm1(-ratio)


def time_constants(time_constant: float | xr.DataArray, counts: xr.DataArray) -> Array:
    """
    Time constant of each band of a movie.

    Parameters
    ----------
    time_constant : float or DataArray
        Of all bands, or (band), by name [s].
    counts : DataArray
        With a dimension `band`.

    Returns
    -------
    ndarray, shape (band,)
        Time constants [s].

    Raises
    ------
    ValueError
        If one is not finite and positive, or a band has none.
    """
    names = [str(name) for name in counts["band"].values]
    if isinstance(time_constant, xr.DataArray):
        places = schema.band_positions(time_constant, names, "the time constants")
        return planck.require_positive("time_constant [s]", time_constant.values[places])
    value = planck.require_positive("time_constant [s]", time_constant)
    return np.full(len(names), float(value))


def _require_lagging(corrected: xr.Dataset) -> None:
    """Refuse what cannot be undone, or was."""
    counts = corrected["counts"]
    if "lag_time_constant" in corrected.attrs:
        raise ValueError("Invalid dataset: the lag was undone before. Must be as the pixels lag.")
    if counts.sizes["time"] < 2:
        raise ValueError("Invalid capture of 1 frame. Must have at least 2, for a lag.")
    if counts.dtype.kind != "f":
        raise TypeError(f"Invalid dtype {counts.dtype} of the counts. Must be floating, for NaN.")
