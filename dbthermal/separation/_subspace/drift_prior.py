r"""What the background's slow part can do to the emissivity, which no method can see.

The emissivity is the slope of the first band's signal against the object's own,
:math:`z_1 = e_1 u_1(x) + (1 - e_1) u_1(y)`. A part of the background that changes as the object
does, :math:`y = \ldots + c \, u_1(x)`, changes the slope by :math:`(1 - e_1) c`, and nothing in the
data tells the two apart. So its size is assumed, in two ways that add:

- a drift: over the capture, the background's change along the object's curve lies anywhere within
  a limit that the user states (`Prior.drift`);
- an extrapolation: the part of the resting background's change that is *not* along the object's
  curve is seen. Its spectrum over the smooth functions is continued to the curve, as that of a
  random walk, whose energy falls with the square of the degree.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import ndtri, stdtrit

from dbthermal import _smooth as smooth
from dbthermal.separation._subspace.regression import Line
from dbthermal.separation._tiles import Array

# Degrees of the polynomials over which a spectrum is averaged: from, and up to, not including;
# and degrees of freedom lost: of the first three, one is along the object's curve.
_OCTAVES: Final = ((1, 4, 1), (4, 8, 0))

# Bounds of a 95 % interval, for an energy from few degrees of freedom and for a known one.
_NORMAL95: Final = float(ndtri(0.975))


@dataclass(frozen=True)
class Prior:
    """
    What is assumed of the background's slow part.

    Attributes
    ----------
    drift : float
        Largest change along the object's curve over the capture, up or down [K]; uniform.
    """

    drift: float


def variance(
    line: Line,
    own: Array,
    reflectivity: Array,
    functions: smooth.Subspace,
    noise: float,
    prior: Prior,
) -> Array:
    r"""
    Variance of the slope from the background's slow part.

    With the largest drift d, unit coefficients :math:`\xi_j` of the object's curve of norm
    :math:`|u|` and range :math:`\Delta`, and the energy A of a random walk in the residual's
    spectrum, the larger of those of two octaves at the upper end of their 95 % interval,

    .. math:: \mathrm{var}(e_1) = \frac{(1 - e_1)^2 d^2}{3 \Delta^2}
              + \frac{A}{|u|^2} \sum_j \frac{\xi_j^2}{j^2}

    Parameters
    ----------
    line : Line
        The regression.
    own : ndarray, shape (time, pixel)
        Its abscissa, the object's own signal [K].
    reflectivity : ndarray, shape (pixel,)
        Reflectivity of the first band [1].
    functions : Subspace
        Smooth functions.
    noise : float
        Noise of the first band [K].
    prior : Prior
        What is assumed.

    Returns
    -------
    ndarray, shape (pixel,)
        Variance [1].
    """
    columns = functions.functions[:, functions.steps + 1 :]
    degree = np.arange(1.0, columns.shape[1] + 1)[:, np.newaxis]
    share = line.weights.mean(axis=0)
    seen = columns.T @ (line.residual * line.weights) / share
    curve = columns.T @ own
    energy = (curve**2).sum(axis=0)
    unit = curve / np.sqrt(energy)
    seen = seen - unit * (unit * seen).sum(axis=0)
    walk = degree**2 * (seen**2 - noise**2 / share)
    octaves = []
    for low, high, lost in _OCTAVES:
        if (freedom := len(walk[low - 1 : high - 1]) - lost) > 0:
            widened = (stdtrit(freedom, 0.975) / _NORMAL95) ** 2
            octaves.append(walk[low - 1 : high - 1].sum(axis=0) / freedom * widened)
    strongest = np.max(octaves, axis=0, initial=0.0)
    extrapolated = strongest * (unit**2 / degree**2).sum(axis=0) / energy
    drift = (reflectivity * prior.drift / np.ptp(own, axis=0)) ** 2 / 3.0
    return np.asarray(drift + extrapolated)
