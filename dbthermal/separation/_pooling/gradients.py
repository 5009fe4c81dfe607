r"""Change of a quantity over the place in a material: a coating, a curved surface, wear.

A pixel tells a quantity q by a cost :math:`a q^2 - 2 b q`, in which b has the variance v. Over the
material q is a polynomial of the place, :math:`q = \sum_k c_k f_k(x, y)`:

.. math:: c = A^{-1} \sum b f, \quad A = \sum a f f^T, \quad C = A^{-1} (\sum v f f^T) A^{-1}

It is a constant unless the Bayesian information criterion [1]_ says otherwise, and then of the
degree that predicts best [2]_. What pixels scatter about it beyond v is their spread.

References
----------
.. [1] Schwarz (1978), Annals of Statistics 6, 461, doi:10.1214/aos/1176344136
.. [2] Akaike (1974), IEEE Transactions on Automatic Control 19, 716, doi:10.1109/TAC.1974.1100705
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
# Condition number of the normal equations from which a degree is not determined.
_SINGULAR: Final = 1e8
# Highest degree beside a step at a border.
_SMOOTH: Final = 3
# Deviations from which there is a spread, and at which a step must be visible.
_SIGMAS: Final = 3.0
# Chance at which what is left of noise alone is taken for more [1].
_CHANCE: Final = 0.01


@dataclass(frozen=True)
class Cost:
    """Cost of a quantity in each pixel (pixel,), and the variance of its linear coefficient."""

    square: Array  # a
    linear: Array  # b
    variance: Array  # v


@dataclass(frozen=True)
class Gradient:
    """Polynomial of the place, and what the pixels show beyond it."""

    degree: int
    value: Array  # at the places asked for (place,)
    variance: Array  # of it (place,)
    excess: float  # sum over the pixels of the squared residuals of b, less v
    information: float  # sum of a^2, by which a variance of q adds to the excess
    uncertainty: float  # standard deviation of the excess


def fit(known: Places, asked: Places, cost: Cost) -> Gradient:
    """Gradient at some places from the costs of pixels at known ones.

    Of a degree for which there are four pixels to a coefficient at least.
    """
    scale = [(one.mean(), max(float(np.ptp(one)) / 2.0, 1.0)) for one in known]
    pixels, highest, chosen = cost.square.size, 0.0, None
    for degree in range(_DEGREE + 1):
        functions, at = (_powers(places, scale, degree) for places in (known, asked))
        others = functions.shape[1] - 1
        normal = functions.T @ (cost.square[:, np.newaxis] * functions)
        few = others > 0 and pixels < _ENOUGH * (others + 1)
        if few or not np.linalg.cond(np.nan_to_num(normal)) < _SINGULAR:
            break
        inverse = np.linalg.inv(normal)
        coefficients = inverse @ (functions.T @ cost.linear)
        covariance = inverse @ (functions.T @ (cost.variance[:, np.newaxis] * functions)) @ inverse
        # Chi-square of all coefficients but the constant.
        gain = coefficients[1:] @ np.linalg.solve(covariance[1:, 1:], coefficients[1:])
        price = np.log(pixels) if highest == 0.0 else 2.0
        if degree == 0 or gain - others * price > highest:
            highest = max(float(gain) - 2.0 * others, 0.0)
            chosen = degree, functions, at, coefficients, covariance
    if chosen is None:  # no pixel tells anything
        nothing = np.full(asked[0].size, np.nan)
        return Gradient(0, nothing, nothing, 0.0, 1.0, 1.0)
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


def spreads(fits: list[Gradient]) -> Array:
    """Variance of single pixels about each gradient (gradient,), 0 where none is seen.

    Few pixels do not tell it. What all materials tell together is taken for the mean, and for the
    deviation, of a normal distribution; that of a material is the mean of its posterior.
    """
    excess, information, uncertainty = (
        np.array([getattr(one, name) for one in fits])
        for name in ("excess", "information", "uncertainty")
    )
    own = np.where(excess > _SIGMAS * uncertainty, excess / information, 0.0)
    if not excess.sum() > _SIGMAS * np.sqrt(np.sum(uncertainty**2)):
        return own
    usual = excess.sum() / information.sum()
    weight = (usual * information / uncertainty) ** 2
    mean = (weight * excess / information + usual) / (weight + 1.0)
    return np.where(own > 0, own, np.maximum(mean, 0.0))


def continuous(places: Places, values: Array, variances: Array, second: Mask, least: Array) -> bool:
    """Say that values (map, pixel) with variances go on from one region into a `second` (pixel,).

    Of polynomials of the place, with a step at the border and without, the lowest Bayesian
    information criterion decides. It must leave no more than noise, and the least step (map,) must
    be one that would be seen at three standard deviations.
    """
    scale = [(one.mean(), max(float(np.ptp(one)) / 2.0, 1.0)) for one in places]
    roots, lowest, result = 1.0 / np.sqrt(variances), np.inf, False
    for degree in range(_SMOOTH + 1):
        design = np.append(_powers(places, scale, degree), second[:, np.newaxis], axis=1)
        if second.size < _ENOUGH * design.shape[1]:
            break
        left, seen = np.zeros(2), True  # chi-square without a step, and with one
        for value, root, step in zip(values, roots, least, strict=True):
            basis, triangle = np.linalg.qr(root[:, np.newaxis] * design)
            heights = (root * value) @ basis
            with_step = np.sum((root * value) ** 2) - np.sum(heights**2)
            left += with_step + np.array([heights[-1] ** 2, 0.0])
            seen &= step == 0.0 or abs(triangle[-1, -1]) * step > _SIGMAS
        coefficients = len(values) * (design.shape[1] - 1 + np.arange(2))
        criteria = left + coefficients * np.log(second.size)
        if criteria.min() < lowest:
            lowest, noise = criteria.min(), chi2.isf(_CHANCE, values.size - coefficients[0])
            result = bool(seen and criteria[0] <= criteria[1] and left[0] < noise)
    return result


def _powers(places: Places, scale: list[tuple[float, float]], degree: int) -> Array:
    """Products of powers (place, function) of rows and columns, shifted and scaled."""
    y, x = ((one - middle) / half for one, (middle, half) in zip(places, scale, strict=True))
    return np.stack([y**i * x ** (k - i) for k in range(degree + 1) for i in range(k + 1)], axis=1)
