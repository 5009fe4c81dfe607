r"""Image formation, stated once: an opaque surface emits its own radiation and reflects the rest.

.. math:: \Phi = e \, \Phi_x + (1 - e) \, \Phi_y

The signals may be spectral or in-band radiances, counts, or linearised signals, in any one unit.
The simulator runs it forward, and every separation method inverts it, by the functions below. A
path or optics that absorb only add a gain and an offset, which the calibration takes in: section 3
of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

from dbthermal import _numbers
from dbthermal._arrays import Array

__all__ = ["background", "condition_number", "leaving", "matrix", "mixed"]
__dir__ = __all__.copy


def mixed(emissivity: Any, emitted: Any, reflected: Any) -> Any:
    r"""Signal of a surface, :math:`e \Phi_x + (1 - e) \Phi_y`, without a check of the values.

    Parameters
    ----------
    emissivity, emitted, reflected : array or tensor
        Emissivity e [1]; blackbody signals at object's and background's temperature, in one unit.

    Examples
    --------
    >>> mixed(0.9, 60.0, 20.0)
    56.0
    """
    return reflected + emissivity * (emitted - reflected)


def background(emissivity: Any, signal: Any, emitted: Any) -> Any:
    r"""Blackbody signal of the background, :math:`\Phi_y = (\Phi - e \Phi_x) / (1 - e)`.

    Parameters
    ----------
    emissivity : array or tensor
        Emissivity e [1], not 1.
    signal, emitted : array or tensor
        Signal of the surface, and blackbody signal at the object's temperature, in one unit.
    """
    return (signal - emissivity * emitted) / (1.0 - emissivity)


def leaving(emissivity: npt.ArrayLike, emitted: npt.ArrayLike, reflected: npt.ArrayLike) -> Array:
    """Signal that leaves a surface: as `mixed`, but refuses emissivities outside [0, 1].

    Parameters
    ----------
    emissivity, emitted, reflected : array_like
        As for `mixed`; ValueError if an emissivity lies outside [0, 1] or is NaN.

    Examples
    --------
    Black paint and polished metal of signal 60, before a background of 20:

    >>> leaving([0.9, 0.2], 60.0, 20.0).tolist()
    [56.0, 28.0]
    """
    emissivity = _numbers.real_numbers("emissivity", emissivity, (0.0, 1.0))
    return np.asarray(mixed(emissivity, np.asarray(emitted), np.asarray(reflected)), np.float64)


def matrix(emissivity: npt.ArrayLike) -> Array:
    r"""Mixing matrix (..., band, 2) of several bands, rows :math:`(e_m, 1 - e_m)`: equation 14.

    Parameters
    ----------
    emissivity : array_like, shape (..., band)
        Emissivity a band [1], or NaN; ValueError for one outside [0, 1].
    """
    emissivity = _numbers.real_numbers("emissivity", emissivity)
    _numbers.real_numbers("emissivity", emissivity[~np.isnan(emissivity)], (0.0, 1.0))
    return np.stack([emissivity, 1.0 - emissivity], axis=-1)


def condition_number(emissivity: npt.ArrayLike) -> Array:
    """Condition number (...) of the mixing matrix in the 2-norm, 1 at best.

    Infinite for a gray body, NaN of an unknown emissivity.

    Parameters
    ----------
    emissivity : array_like, shape (..., band)
        Emissivity a band [1], or NaN; ValueError for one outside [0, 1], or of one band.

    Examples
    --------
    Plate glass in two bands, and a gray body, which no two bands separate:

    >>> condition_number([[0.86, 0.72], [0.90, 0.90]]).round(1).tolist()
    [9.6, inf]
    """
    rows = matrix(emissivity)
    if rows.ndim < 2 or rows.shape[-2] < 2:
        raise ValueError(f"Invalid shape {rows.shape[:-1]} of emissivities. Must have two bands.")
    finite = np.all(np.isfinite(rows), axis=(-2, -1))
    singular = np.linalg.svd(np.where(finite[..., None, None], rows, 0.5), compute_uv=False)
    largest, smallest = singular[..., 0], singular[..., -1]
    infinite = np.full_like(largest, np.inf)
    regular = smallest > 4 * np.finfo(np.float64).eps * largest
    np.divide(largest, smallest, out=infinite, where=regular)
    return np.where(finite, infinite, np.nan)
