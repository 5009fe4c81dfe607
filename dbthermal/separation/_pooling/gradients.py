r"""Change of a quantity over the place in a material: a coating, a curved surface, wear.

A pixel tells a quantity q by a cost :math:`a q^2 - 2 b q`, in which b has the variance v. Over the
material q is a polynomial of the place, :math:`q = \sum_k c_k f_k(x, y)`:

.. math:: c = A^{-1} \sum b f, \quad A = \sum a f f^T, \quad C = A^{-1} (\sum v f f^T) A^{-1}

It is a constant unless the Bayesian information criterion says otherwise (Schwarz 1978, Annals of
Statistics 6, 461, doi:10.1214/aos/1176344136), and then of the degree that predicts best (Akaike
1974, IEEE Transactions on Automatic Control 19, 716, doi:10.1109/TAC.1974.1100705). What pixels,
and squares of some, scatter about it beyond v is their spread: one that undulates is seen in sums
over neighbours long before it is in single pixels.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from numpy.polynomial.polynomial import polyvander
from scipy.special import chdtri, ndtr

from dbthermal._arrays import Array, Mask

Places = tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]
"""Rows and columns of pixels."""

_DEGREE: Final = 4  # highest one
_PIXELS: Final = 4  # pixels for each coefficient, at least
_SQUARE: Final = 16  # pixels in a square, about, of which the sum is looked at
# Condition number of the normal equations from which a degree is not determined.
_SINGULAR: Final = 1e8
_SMOOTH: Final = 3  # highest degree beside a step at a border
_SIGMAS: Final = 3.0  # deviations from which there is a spread, and at which a step must be visible
# Chance at which what is left of noise alone is taken for more [1].
_CHANCE: Final = 0.01
_TINY: Final = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Cost:
    """Cost of a quantity in pixels, or in squares of some, and the variance of its linear part."""

    square: Array  # a (pixel)
    linear: Array  # b, or what a polynomial leaves of it
    variance: Array  # v of b

    def excess(self, spread: float = 0.0) -> tuple[float, float]:
        """Variance of q that residuals show beyond v, and its deviation at some spread."""
        deviation = np.sqrt(2.0 * np.sum((self.variance + spread * self.square**2) ** 2))
        total = float(np.sum(self.square**2))
        return float(np.sum(self.linear**2 - self.variance)) / total, float(deviation) / total

    def over_squares(self, places: Places, side: int) -> "Cost":
        """Sums over squares of the image with so many pixels along a side."""
        rows, columns = (place // side for place in places)
        group = np.unique(rows * (1 + columns.max()) + columns, return_inverse=True)[1]
        arrays = self.square, self.linear, self.variance
        return Cost(*(np.bincount(group, array).astype(np.float64) for array in arrays))


@dataclass(frozen=True)
class Gradient:
    """Polynomial of the place, and what the pixels show beyond it."""

    degree: int
    value: Array  # at the places asked for (place,)
    variance: Array  # of it, without a spread (place,)
    remainders: tuple[Cost, ...]  # in single pixels, and in squares of some


def fit(measured: Places, asked: Places, cost: Cost, degrees: int = _DEGREE) -> Gradient:
    """Gradient at some places from the costs of pixels at known ones, up to a degree."""
    fits, pixels = [], cost.square.size
    for degree in range(degrees + 2):
        functions = powers(measured, measured, degree)
        normal = functions.T @ (cost.square[:, np.newaxis] * functions)
        # A degree has at least four pixels to a coefficient.
        scarce = degree > 0 and pixels < _PIXELS * functions.shape[1]
        if scarce or not np.linalg.cond(np.nan_to_num(normal)) < _SINGULAR:
            break
        inverse = np.asarray(np.linalg.inv(normal), dtype=np.float64)
        coefficients = inverse @ (functions.T @ cost.linear)
        residual = cost.linear - cost.square * (functions @ coefficients)
        fits.append((functions, inverse, coefficients, residual))
    if not fits:  # no pixel tells anything
        nothing, zero = np.full(asked[0].size, np.nan), np.zeros(pixels)
        return Gradient(0, nothing, nothing, (replace(cost, linear=zero),) * 2)
    # Scatter of pixels beyond the highest degree is no gradient.
    beyond = np.sum(fits[-1][-1] ** 2 - cost.variance) / np.sum(cost.square**2)
    variance = cost.variance + max(float(beyond), 0.0) * cost.square**2
    chosen, highest = 0, 0.0
    for degree, (functions, inverse, coefficients, _) in enumerate(fits[1 : degrees + 1], 1):
        # Chi-square of all coefficients but the constant, less the criterion's price.
        covariance = _covariance(functions, inverse, variance)[1:, 1:]
        terms = coefficients[1:].size
        gain = float(coefficients[1:] @ np.linalg.solve(covariance, coefficients[1:]))
        if gain - terms * (np.log(pixels) if chosen == 0 else 2.0) > highest:
            chosen, highest = degree, gain - 2.0 * terms
    _, _, coefficients, residual = fits[chosen]
    value = powers(asked, measured, chosen) @ coefficients
    # A degree more may be there, unseen: beyond the pixels that tell something it matters.
    order = min(chosen + 1, len(fits) - 1) if chosen else 0
    functions, inverse, _, _ = fits[order]
    covariance = _covariance(functions, inverse, variance if chosen else cost.variance)
    at = powers(asked, measured, order)
    remainder = replace(cost, linear=residual)
    side = max(1, round(np.sqrt(_SQUARE * asked[0].size / pixels)))
    remainders = remainder, remainder.over_squares(measured, side)
    return Gradient(chosen, value, np.einsum("pi,ij,pj->p", at, covariance, at), remainders)


def spreads(fits: list[Gradient]) -> list[float]:
    """Variance of single pixels, or of squares of pixels, about each gradient; 0 where not seen."""
    scales = [_spreads([fit.remainders[scale] for fit in fits]) for scale in range(2)]
    return [max(pair) for pair in zip(*scales, strict=True)]


def _spreads(fits: list[Cost]) -> list[float]:
    excesses, sizes = [fit.excess() for fit in fits], [fit.linear.size for fit in fits]
    weights = np.array([1.0 / max(deviation, _TINY) ** 2 for _, deviation in excesses])
    usual = float(weights @ [value for value, _ in excesses]) / max(weights.sum(), _TINY)
    if not usual * np.sqrt(weights.sum()) > _seen(sum(sizes)):
        pairs = zip(excesses, sizes, strict=True)
        return [value if value > _seen(size) * std else 0.0 for (value, std), size in pairs]
    result = []
    # Few pixels do not tell a spread: it is the posterior's mean, of a normal prior with the mean
    # and deviation that all materials tell together.
    for fit in fits:
        value, deviation = fit.excess(usual)
        share = usual**2 / (usual**2 + deviation**2)
        result.append(max(usual + share * (value - usual), 0.0))
    return result


def _seen(freedom: int) -> float:
    """Deviations from which an excess is no chance: a chi-square of little freedom is skew."""
    return float((chdtri(freedom, ndtr(-_SIGMAS)) - freedom) / np.sqrt(2.0 * freedom))


def step(
    places: Places, values: Array, variances: Array, second: Mask, degree: int
) -> tuple[Array, Array, Array]:
    r"""Step of values (map, pixel) at the `second` region's border, beside a polynomial.

    By least squares of :math:`f(x, y) = \sum c_{ij} x^i y^j + h [p \in \mathrm{second}]`: of each
    map the chi-square that is left, :math:`h^2 / \mathrm{var}(h)`, and :math:`1 / \mathrm{std}(h)`.
    """
    design = np.append(powers(places, places, degree), second[:, np.newaxis], axis=1)
    result = []
    for value, root in zip(values, 1.0 / np.sqrt(variances), strict=True):
        # design = Q R: h = q^T f / r with q, r the last column and corner, var(h) = 1 / r^2.
        basis, triangle = np.linalg.qr(root[:, np.newaxis] * design)
        heights = (root * value) @ basis
        chi2 = np.sum((root * value) ** 2) - np.sum(heights**2)
        result.append((chi2, heights[-1] ** 2, abs(triangle[-1, -1])))
    chi2, square, sharpness = np.array(result).T
    return chi2, square, sharpness


def continuous(places: Places, values: Array, variances: Array, second: Mask, least: Array) -> bool:
    """Say that values (map, pixel) have no step at the border to the `second` region (pixel,)."""
    lowest, result = np.inf, False
    for degree in range(_SMOOTH + 1):
        functions = (degree + 1) * (degree + 2) // 2
        if second.size < _PIXELS * (functions + 1):
            break
        remainder, square, sharpness = step(places, values, variances, second, degree)
        # The least step (map,) must be one that would be seen at three standard deviations.
        seen = np.all((least == 0.0) | (sharpness * least > _SIGMAS))
        chi2 = remainder.sum() + np.array([square.sum(), 0.0])  # without a step, and with one
        coefficients = len(values) * (functions + np.arange(2))
        criteria = chi2 + coefficients * np.log(second.size)
        # The lowest Bayesian information criterion decides, if it leaves no more than noise.
        if criteria.min() < lowest:
            lowest, noise = criteria.min(), chdtri(values.size - coefficients[0], _CHANCE)
            result = bool(seen and criteria[0] <= criteria[1] and chi2[0] < noise)
    return result


def _covariance(functions: Array, inverse: Array, variance: Array) -> Array:
    """C of coefficients, from A^-1."""
    return inverse @ (functions.T @ (variance[:, np.newaxis] * functions)) @ inverse


def powers(places: Places, measured: Places, degree: int) -> Array:
    """Products of powers (place, function) of rows and columns, from -1 to 1 at the known ones."""
    # Far from the origin, in pixels, high powers would be alike but for rounding.
    y, x = (
        polyvander((coordinate - nodes.mean()) / max(float(np.ptp(nodes)) / 2.0, 1.0), degree).T
        for coordinate, nodes in zip(places, measured, strict=True)
    )
    return np.stack([y[i] * x[k - i] for k in range(degree + 1) for i in range(k + 1)], axis=1)
