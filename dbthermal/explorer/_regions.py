"""Regions of the image, and the standard deviation of a mean over their pixels."""

import math
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from dbthermal._arrays import Array, Mask

Kind = Literal["rectangle", "ellipse", "polygon"]

_LEAST_PAIRS: Final = 12  # pairs of neighbours that give the share of independent errors
_LARGEST_SHARE: Final = (
    2.0  # of independent errors in the variance, beyond which it is the material
)
_LEAST: Final = {"rectangle": (2, 2), "ellipse": (2, 2), "polygon": (3, 1000)}


@dataclass(frozen=True)
class Region:
    """Part of the image: the pixels whose centres lie inside an outline.

    Attributes
    ----------
    kind : {"rectangle", "ellipse", "polygon"}
        Form of the outline.
    points : tuple of (float, float)
        (row, column) of two opposite corners, of an ellipse those of the rectangle around it, or of
        the corners of a polygon in order [pixel]. Pixel (i, j) covers i to i + 1 and j to j + 1.
        ValueError if they are too few, or not finite.

    Examples
    --------
    >>> Region("rectangle", ((1, 2), (3, 5))).mask((4, 6)).sum()
    np.int64(6)
    """

    kind: Kind
    points: tuple[tuple[float, float], ...]

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(
                f"Unknown kind of region {self.kind!r}. Must be one of {list(_LEAST)}."
            )
        try:
            points = tuple((float(row), float(column)) for row, column in self.points)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Invalid points {self.points!r} of a {self.kind}. Must be pairs (row, column)."
            ) from error
        least, limit = _LEAST[self.kind]
        if not least <= len(points) <= max(least, limit):
            count = least if self.kind != "polygon" else f"{least} to {limit}"
            raise ValueError(f"Invalid {len(points)} points of a {self.kind}. Must be {count}.")
        if not all(math.isfinite(value) for point in points for value in point):
            raise ValueError(f"Invalid points {points} of a {self.kind}. Must be finite.")
        object.__setattr__(self, "points", points)

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Mask (y, x) of the pixels of an image of so many rows and columns."""
        rows, columns = np.ogrid[0.5 : shape[0], 0.5 : shape[1]]
        outline = np.array(self.points)
        if self.kind == "polygon":
            return _inside(outline, rows, columns)
        (top, left), (bottom, right) = outline.min(axis=0), outline.max(axis=0)
        if self.kind == "rectangle":
            within = (top <= rows) & (rows < bottom) & (left <= columns) & (columns < right)
        elif top == bottom or left == right:
            within = np.zeros(shape, dtype=bool)
        else:
            down = (2.0 * rows - top - bottom) / (bottom - top)
            within = down**2 + ((2.0 * columns - left - right) / (right - left)) ** 2 <= 1.0
        return np.asarray(within)


def _inside(corners: Array, rows: Array, columns: Array) -> Mask:
    """Even-odd rule: a ray along the row crosses the outline an odd number of times."""
    odd = np.zeros((rows.size, columns.size), dtype=bool)
    for (row, column), (next_row, next_column) in zip(
        corners, np.roll(corners, -1, 0), strict=True
    ):
        spanned = ((row <= rows) != (next_row <= rows))[:, 0]
        if spanned.any():
            along = (rows[spanned] - row) / (next_row - row)
            odd[spanned] ^= columns < column + along * (next_column - column)
    return odd


def common_gain(emissivity: Array, covariance: Array) -> Array:
    r"""Common deviation of object and background (2, y, x) by emissivities, for 1 K contrast [1].

    Errors :math:`\delta e` of the emissivities (band, y, x) with a covariance (band, band, y, x)
    keep the image formation :math:`e_b x + (1 - e_b) y` if

    .. math:: e_b\,\delta x + (1 - e_b)\,\delta y = -(x - y)\,\delta e_b

    which has, by least squares, the solution :math:`\delta x = -(x - y)\,g\,\delta e` of variance
    v. Neighbours i, j differ by independent errors alone, whose share :math:`\rho` follows from the
    median over the region,

    .. math:: \operatorname{med} (g e_i - g e_j)^2 / (v_i + v_j) = 0.455 \rho

    It is 0 for pooled or stated emissivities, and taken as 0 for few pairs and for a material that
    differs between pixels by more than the deviations. NaN where the emissivities are.
    """
    finite = np.isfinite(emissivity).all(axis=0) & np.isfinite(covariance).all(axis=(0, 1))
    default = np.linspace(0.4, 0.6, len(emissivity))[:, np.newaxis, np.newaxis]
    value = np.where(finite, emissivity, default)
    system = np.moveaxis(np.stack([value, 1.0 - value], axis=-1), 0, 2)  # (y, x, band, 2)
    inverse = np.linalg.pinv(system)  # (y, x, 2, band)
    variance = np.einsum("yxib,bcyx,yxic->iyx", inverse, covariance, inverse)
    variance = np.where(finite, np.maximum(variance, 0.0), np.nan)
    ratios = []
    for axis in (0, 1):
        first, second = np.delete(inverse, -1, axis), np.delete(inverse, 0, axis)
        step = np.einsum("yxib,byx->iyx", first + second, np.diff(value, axis=1 + axis)) / 2.0
        total = np.delete(variance, -1, 1 + axis) + np.delete(variance, 0, 1 + axis)
        ratios.append(np.reshape(step**2 / total, (2, -1)))
    pairs = np.concatenate(ratios, axis=1)
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    residual_share = np.zeros(2)
    if pairs.shape[1] >= _LEAST_PAIRS:
        residual_share = np.median(pairs, axis=1) / chdtri(1, 0.5)
    shared = np.where(residual_share < _LARGEST_SHARE, 1.0 - np.minimum(residual_share, 1.0), 1.0)
    return np.asarray(np.sqrt(shared[:, np.newaxis, np.newaxis] * variance))


def mean_std(std: Array, common: Array) -> Array:
    """Standard deviation (time) of a mean over pixels with a common part, see `View.curve`."""
    shared = np.where(np.isfinite(common), np.minimum(common, std), std)
    number = np.maximum(np.isfinite(std).sum(axis=-1), 1)
    independent = np.nansum(std**2 - shared**2, axis=-1) / number**2
    result = np.sqrt((np.nansum(shared, axis=-1) / number) ** 2 + independent)
    return np.asarray(np.where(np.isfinite(std).any(axis=-1), result, np.nan))


def statistics(values: npt.NDArray[np.floating]) -> dict[str, Array]:
    """Mean, least and greatest value (time), and number of pixels with one, of (time, pixel)."""
    finite = np.isfinite(values)
    number = finite.sum(axis=-1)
    total = np.sum(values, axis=-1, where=finite, dtype=np.float64)
    counted = number > 0
    return {
        "mean": np.divide(total, number, out=np.full(len(values), np.nan), where=counted),
        "minimum": np.where(counted, values.min(axis=-1, initial=np.inf, where=finite), np.nan),
        "maximum": np.where(counted, values.max(axis=-1, initial=-np.inf, where=finite), np.nan),
        "pixels": number,
    }
