"""Closed form of the Cramer-Rao bound of two linear bands."""

import numpy as np
import numpy.typing as npt

from dbthermal._arrays import Array
from dbthermal._numbers import POSITIVE, real_numbers


def reflection_ratio(emissivity: npt.ArrayLike) -> Array:
    r"""Ratio :math:`k_2 = (1 - e_2) / (1 - e_1)` [1] of the reflections in two bands.

    Parameters
    ----------
    emissivity : array_like, shape (2, ...)
        Emissivities [1].

    Examples
    --------
    >>> reflection_ratio([0.86, 0.72]).round(3).item()  # plate glass in 8-14 um and 9.5 um
    2.0
    """
    first, second = np.asarray(emissivity, dtype=np.float64)
    return np.asarray((1.0 - second) / (1.0 - first))


def ratio_variance_bound(
    emissivity: tuple[float, float], noise: tuple[float, float], background: Array, functions: Array
) -> Array:
    r"""Cramer-Rao bound of the reflection ratio of two linear bands.

    .. math:: \mathrm{var}(k_2) \ge \frac{s_2^2 + k_2^2 s_1^2}
              {\sum_t [(1 - e_1) P y(t)]^2}

    with P the projection orthogonal to the smooth subspace, in which the object may do anything.

    Parameters
    ----------
    emissivity, noise : tuple of float
        Emissivities [1] of the two bands, and standard deviations of their noise [K]; TypeError or
        ValueError for other than two numbers, in [0, 1] and positive.
    background : ndarray, shape (time, ...)
        Background temperature [K].
    functions : ndarray, shape (time, order)
        Orthonormal functions that span the smooth subspace.

    Examples
    --------
    Plate glass before a background that changes by 3 K every five seconds:

    >>> background = 295.0 + 3.0 * (np.arange(200) // 50 % 2)  # K, 10 frames/s
    >>> functions, _ = np.linalg.qr(np.vander(np.linspace(-1, 1, 200), 5))
    >>> variance = ratio_variance_bound((0.86, 0.72), (0.03, 0.35), background, functions)
    >>> np.sqrt(variance).round(2).item()
    0.15
    """
    ratio = float(reflection_ratio(real_numbers("emissivity", emissivity, (0.0, 1.0), (2,))))
    real_numbers("noise [K]", noise, POSITIVE, (2,))
    background, functions = real_numbers("background", background), real_numbers("basis", functions)
    rapid = background - np.tensordot(functions, functions.T @ background, axes=1)
    energy = (1.0 - emissivity[0]) ** 2 * np.sum(rapid**2, axis=0)
    return np.asarray((noise[1] ** 2 + (ratio * noise[0]) ** 2) / energy)
