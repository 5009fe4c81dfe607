"""Image formation: what reaches the detector, stated once.

Five components: the object's emission, the background it reflects, the emission of the path, of
the optics, and of the camera's inside mirrored by the optics. Radiances may be spectral or
in-band, in any one unit; so may signals (counts) where the equation is linear in them.
The equations are those of section 3 of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Optics:
    """
    Path and optics between the object and the detector, constant over a capture.

    Attributes
    ----------
    path_transmissivity : float
        Transmissivity of the path from object to lens, in [0, 1].
    path_signal : float
        Blackbody signal at the path's temperature [unit of the signals].
    transmissivity, emissivity : float
        Of the optics, each in [0, 1] with a sum of at most 1; the reflectivity is the rest.
    optics_signal, camera_signal : float
        Blackbody signal at the temperature of the optics and of the camera's inside
        [unit of the signals].
    """

    path_transmissivity: float = 1.0
    path_signal: float = 0.0
    transmissivity: float = 1.0
    emissivity: float = 0.0
    optics_signal: float = 0.0
    camera_signal: float = 0.0

    def __post_init__(self) -> None:
        """Refuse fractions outside [0, 1] and optics that emit and pass more than all."""
        for name in ("path_transmissivity", "transmissivity", "emissivity"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise ValueError(f"Invalid {name} {value} of the optics. Must lie in [0, 1].")
        if self.transmissivity + self.emissivity > 1 + 4 * np.finfo(np.float64).eps:
            raise ValueError(
                f"Invalid transmissivity {self.transmissivity} and emissivity {self.emissivity} "
                "of the optics. Their sum must be at most 1."
            )

    @property
    def reflectivity(self) -> float:
        """Reflectivity of the optics, 1 - transmissivity - emissivity (Kirchhoff)."""
        return 1.0 - self.transmissivity - self.emissivity

    @property
    def gain(self) -> float:
        r"""Gain :math:`g = \tau_t \tau_o` on the radiation that leaves the object's surface."""
        return self.path_transmissivity * self.transmissivity

    @property
    def offset(self) -> float:
        r"""
        Offset added to it [unit of the signals].

        :math:`f = \tau_o (1 - \tau_t) \Phi_t + \epsilon_o \Phi_o + r_o \Phi_i`; with a clear path
        (:math:`\tau_t = 1`) the gain and offset that follow equation 7 of the paper.
        """
        path = self.transmissivity * (1.0 - self.path_transmissivity) * self.path_signal
        own = self.emissivity * self.optics_signal + self.reflectivity * self.camera_signal
        return path + own


CLEAR: Final = Optics()
"""No losses: gain 1, offset 0."""


def leaving(emissivity: npt.ArrayLike, emitted: npt.ArrayLike, reflected: npt.ArrayLike) -> Array:
    r"""
    Signal that leaves an opaque surface, :math:`\Phi_A = e \Phi_s + (1 - e) \Phi_b`.

    Parameters
    ----------
    emissivity : array_like
        Emissivity [1].
    emitted, reflected : array_like
        Blackbody signal at the object's and at the background's temperature, in one unit.

    Returns
    -------
    ndarray
        Signal in the same unit, of the broadcast shape.

    Raises
    ------
    ValueError
        If an emissivity lies outside [0, 1] or is NaN.
    """
    emissivity = np.asarray(emissivity, dtype=np.float64)
    bad = ~((emissivity >= 0) & (emissivity <= 1))
    if np.any(bad):
        raise ValueError(f"Invalid emissivity {emissivity[bad].flat[0]}. Must lie in [0, 1].")
    emitted, reflected = np.asarray(emitted), np.asarray(reflected)
    return np.asarray(reflected + emissivity * (emitted - reflected), dtype=np.float64)


def received(leaving_signal: npt.ArrayLike, optics: Optics = CLEAR) -> Array:
    r"""
    Signal at the detector, all five components.

    .. math:: \Phi_C = \tau_o (\tau_t \Phi_A + (1 - \tau_t) \Phi_t) + \epsilon_o \Phi_o
              + r_o \Phi_i = g \Phi_A + f

    Parameters
    ----------
    leaving_signal : array_like
        Signal that leaves the object, from `leaving`.
    optics : Optics
        Path, optics and camera, with signals in the same unit.

    Returns
    -------
    ndarray
        Signal at the detector, same unit and shape.
    """
    return optics.gain * np.asarray(leaving_signal, dtype=np.float64) + optics.offset


def matrix(emissivity: npt.ArrayLike) -> Array:
    r"""
    Mixing matrix E of several bands, rows :math:`(e_m, 1 - e_m)`.

    Parameters
    ----------
    emissivity : array_like, shape (..., band)
        Emissivity a band [1].

    Returns
    -------
    ndarray, shape (..., band, 2)
        Columns: weight of the object, weight of the background (equation 14 of the paper).
    """
    emissivity = np.asarray(emissivity, dtype=np.float64)
    return np.stack([emissivity, 1.0 - emissivity], axis=-1)


def condition_number(emissivity: npt.ArrayLike) -> Array:
    """
    Condition number of the mixing matrix in the 2-norm; infinite for a gray body.

    Parameters
    ----------
    emissivity : array_like, shape (..., band)
        Emissivity a band [1]; at least two bands.

    Returns
    -------
    ndarray, shape (...)
        Ratio of the largest to the smallest singular value, 1 at best.
    """
    singular = np.linalg.svd(matrix(emissivity), compute_uv=False)
    largest, smallest = singular[..., 0], singular[..., -1]
    infinite = np.full_like(largest, np.inf)
    regular = smallest > 4 * np.finfo(np.float64).eps * largest
    np.divide(largest, smallest, out=infinite, where=regular)
    return infinite
