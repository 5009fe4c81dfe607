r"""Statistical limits: the Cramer-Rao bounds that no estimator of one pixel can beat.

For the linear image formation :math:`z_m = e_m x + (1 - e_m) y` + noise of standard deviation
:math:`s_m`, per frame and pixel (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334); the
bounds for the exact response differ by its slopes.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def reflection_ratio(emissivity: npt.ArrayLike) -> Array:
    r"""
    Ratio :math:`k_2 = (1 - e_2) / (1 - e_1)` of the reflections in the two bands.

    Parameters
    ----------
    emissivity : array_like, shape (2, ...)
        Emissivities [1].

    Returns
    -------
    ndarray
        Ratio [1].
    """
    first, second = np.asarray(emissivity, dtype=np.float64)
    return np.asarray((1.0 - second) / (1.0 - first))


def emission_ratio(emissivity: npt.ArrayLike) -> Array:
    r"""
    Ratio :math:`k_1 = e_2 / e_1` of the emissions in the two bands.

    Parameters
    ----------
    emissivity : array_like, shape (2, ...)
        Emissivities [1].

    Returns
    -------
    ndarray
        Ratio [1].
    """
    first, second = np.asarray(emissivity, dtype=np.float64)
    return np.asarray(second / first)


def emissivities(emission: npt.ArrayLike, reflection: npt.ArrayLike) -> Array:
    r"""
    Emissivities from the two ratios.

    .. math:: e_1 = \frac{k_2 - 1}{k_2 - k_1}, \quad e_2 = k_1 e_1

    Parameters
    ----------
    emission, reflection : array_like
        k1 and k2 [1].

    Returns
    -------
    ndarray, shape (2, ...)
        Emissivities [1].
    """
    emission, reflection = np.asarray(emission), np.asarray(reflection)
    first = (reflection - 1.0) / (reflection - emission)
    return np.stack([first, emission * first])


def ratio_variance(
    emissivity: tuple[float, float],
    noise: tuple[float, float],
    background: Array,
    functions: Array,
) -> Array:
    r"""
    Cramer-Rao bound of the reflection ratio, when the object is anything in a smooth subspace.

    .. math:: \mathrm{var}(k_2) \ge \frac{s_2^2 + k_2^2 s_1^2}
              {\sum_t [(1 - e_1) P y(t)]^2}

    with P the projection orthogonal to the subspace.

    Parameters
    ----------
    emissivity : tuple of float
        Emissivities of the two bands [1].
    noise : tuple of float
        Standard deviations of the noise [K].
    background : ndarray, shape (time, ...)
        Background temperature [K].
    functions : ndarray, shape (time, order)
        The smooth subspace, from `smooth.basis`.

    Returns
    -------
    ndarray
        Smallest variance [1] of an unbiased estimate.
    """
    ratio = float(reflection_ratio(emissivity))
    rapid = background - np.tensordot(functions, functions.T @ background, axes=1)
    energy = (1.0 - emissivity[0]) ** 2 * np.sum(rapid**2, axis=0)
    return np.asarray((noise[1] ** 2 + (ratio * noise[0]) ** 2) / energy)


def calibrated_variance(
    mixing: Array,
    noise: tuple[float, float],
    temperatures: Array,
    emissivity_std: Array,
) -> Array:
    r"""
    Variance of object and background of a single frame when the emissivities are given.

    For slopes 1 it is :math:`\mathrm{var}(x) = [(1-e_2)^2 s_1^2 + (1-e_1)^2 s_2^2]/(e_1-e_2)^2`
    and :math:`\mathrm{var}(y) = [e_2^2 s_1^2 + e_1^2 s_2^2] / (e_1-e_2)^2`, the Cramer-Rao bound;
    an uncertain emissivity adds as a noise of :math:`(x - y)` times its standard deviation.

    Parameters
    ----------
    mixing : ndarray, shape (2, 2, ...)
        Derivative of the signal of each band with object and background temperature [1].
    noise : tuple of float
        Standard deviations of the signals' noise [K].
    temperatures : ndarray, shape (2, ...)
        Object and background temperature [K].
    emissivity_std : ndarray, shape (2, ...)
        Standard deviation of the emissivities [1].

    Returns
    -------
    ndarray, shape (2, ...)
        Variance of object and background temperature [K^2].
    """
    ((a, b), (c, d)) = mixing
    contrast = temperatures[0] - temperatures[1]
    first, second = (
        std**2 + (contrast * deviation) ** 2
        for std, deviation in zip(noise, emissivity_std, strict=True)
    )
    determinant = a * d - b * c
    energy = np.stack([d**2 * first + b**2 * second, c**2 * first + a**2 * second])
    return np.asarray(energy / determinant**2)
