r"""Change of a quantity over the place in a material: a coating, a curved surface, a worn one.

A pixel tells a quantity q by the cost :math:`a q^2 - 2 b q`, in which b has the variance v. Over a
material q is a polynomial of the place, :math:`q = \sum_k c_k f_k(x, y)`, of the degree with the
lowest Bayesian information criterion [1]_:

.. math:: c = A^{-1} \sum b f, \quad A = \sum a f f^T, \quad C = A^{-1} (\sum v f f^T) A^{-1}

What the pixels scatter about it beyond v is their spread.

References
----------
.. [1] Schwarz (1978), Annals of Statistics 6, 461, doi:10.1214/aos/1176344136
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from dbthermal._arrays import Array, Mask

Places = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]
"""Rows and columns of pixels."""

# Highest degree, and pixels for each coefficient, at least.
_DEGREE: Final = 4
_ENOUGH: Final = 4
# Deviations of the spread's estimate from which there is one.
_SIGMAS: Final = 3.0
# Condition number of the normal equations from which a degree is not determined.
_SINGULAR: Final = 1e8
# Chance at which what is left of noise alone is taken for more [1].
_CHANCE: Final = 0.01


@dataclass(frozen=True)
class Cost:
    """Coefficients of the cost of each pixel, and the variance of the linear one (pixel,)."""

    square: Array
    linear: Array
    variance: Array


@dataclass(frozen=True)
class Gradient:
    """Polynomial of the place, and what is left."""

    degree: int
    value: Array  # at the places asked for (place,)
    variance: Array  # of it (place,)
    excess: float  # sum over the pixels of the squared residuals of b, less v
    information: float  # sum of a^2, by which a variance of q adds to the excess
    uncertainty: float  # standard deviation of the excess


def fit(known: Places, asked: Places, cost: Cost) -> Gradient:
    """Gradient at some places from pixels at known ones; the constant's value and variance if none.

    The degree is one that the pixels determine, four of them to each coefficient at least.
    """
    scale = [(one.mean(), max(float(np.ptp(one)) / 2.0, 1.0)) for one in known]
    here, there = (
        [(one - middle) / half for one, (middle, half) in zip(places, scale, strict=True)]
        for places in (known, asked)
    )
    highest, chosen = -np.inf, None
    for degree in range(_DEGREE + 1):
        powers = [(i, k - i) for k in range(degree + 1) for i in range(k + 1)]
        if degree > 0 and cost.square.size < _ENOUGH * len(powers):
            break
        functions, at = (
            np.stack([y**i * x**j for i, j in powers], axis=1) for y, x in (here, there)
        )
        normal = functions.T @ (cost.square[:, np.newaxis] * functions)
        if degree > 0 and not np.linalg.cond(normal) < _SINGULAR:
            break
        inverse = np.linalg.inv(normal)
        coefficients = inverse @ (functions.T @ cost.linear)
        covariance = inverse @ (functions.T @ (cost.variance[:, np.newaxis] * functions)) @ inverse
        # Chi-square of all coefficients but the constant, less the criterion's price: once it is
        # no constant, what predicts best [2].
        gain = coefficients[1:] @ np.linalg.solve(covariance[1:, 1:], coefficients[1:])
        price = np.log(cost.square.size) if highest <= 0 else 2.0
        if gain - (len(powers) - 1) * price > max(highest, 0.0) or degree == 0:
            gain -= 2.0 * (len(powers) - 1)
            highest, chosen = gain, (degree, functions, at, coefficients, covariance)
    assert chosen is not None
    degree, functions, at, coefficients, covariance = chosen
    residual = cost.linear - cost.square * (functions @ coefficients)
    return Gradient(
        degree=degree,
        value=at @ coefficients,
        variance=np.einsum("pi,ij,pj->p", at, covariance, at),
        excess=float(np.sum(residual**2 - cost.variance)),
        information=float(np.sum(cost.square**2)),
        uncertainty=float(np.sqrt(2.0 * np.sum(cost.variance**2))),
    )


def spreads(gradients: list[Gradient]) -> Array:
    r"""Variance of single pixels about each gradient, 0 where none is seen.

    Few pixels do not tell it: what all materials tell together, :math:`\tau_0^2`, is taken for the
    mean and the deviation of a normal distribution, and each material's is the posterior mean.
    """
    excess, information, uncertainty = (
        np.array([getattr(one, name) for one in gradients])
        for name in ("excess", "information", "uncertainty")
    )
    own = np.where(excess > _SIGMAS * uncertainty, excess / information, 0.0)
    if excess.sum() < _SIGMAS * np.sqrt(np.sum(uncertainty**2)):
        return own
    usual = excess.sum() / information.sum()
    weight = (information / uncertainty) ** 2
    mean = (weight * excess / information + 1.0 / usual) / (weight + 1.0 / usual**2)
    return np.where(own > 0, own, np.maximum(mean, 0.0))


def continuous(
    places: Places, values: Array, variances: Array, second: Mask, least: Array
) -> bool:
    """Whether values (map, pixel) with variances are a polynomial of the place without a step.

    The step lies between pixels and those of a `second` region (pixel,). Of the polynomials, with
    one and without, the lowest Bayesian information criterion decides, if nothing is left beyond
    noise, and if the least step (map,) would be seen at three standard deviations.
    """
    y, x = ((one - one.mean()) / max(float(np.ptp(one)) / 2.0, 1.0) for one in places)
    roots, found = 1.0 / np.sqrt(variances), (np.inf, True)
    for degree in range(_DEGREE):
        smooth = [y**i * x ** (k - i) for k in range(degree + 1) for i in range(k + 1)]
        design = np.stack([*smooth, second * 1.0], axis=1)
        if second.size < _ENOUGH * design.shape[1]:
            break
        left = np.zeros(2)  # chi-square without the step, and with it
        seen = True
        for value, root, step in zip(values, roots, least, strict=True):
            basis, triangle = np.linalg.qr(root[:, np.newaxis] * design)
            white = root * value
            heights = white @ basis
            left += white @ white - heights @ heights + np.array([heights[-1] ** 2, 0.0])
            seen &= step == 0.0 or abs(triangle[-1, -1]) * step > _SIGMAS
        coefficients = len(values) * (len(smooth) + np.arange(2))
        criterion = left + coefficients * np.log(second.size)
        noise = chi2.isf(_CHANCE, values.size - coefficients)
        for number in range(2):
            if criterion[number] < found[0]:
                broken = number == 1 or not seen or left[number] > noise[number]
                found = float(criterion[number]), broken
    return not found[1]
