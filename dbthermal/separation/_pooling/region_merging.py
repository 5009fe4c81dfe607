"""Regions that grow: neighbours are joined while what is pooled over each agrees.

The statistics of `materials`, apart from its pictures: pooled features, the test of two regions,
and the order in which they are joined.
"""

import heapq
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

Array = npt.NDArray[np.float64]
Labels = npt.NDArray[np.intp]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Features:
    """
    What is known of every pixel, and how it pools.

    Attributes
    ----------
    values, variances : ndarray, shape (feature, y, x)
        Estimates and their variances, in one unit and its square; NaN where there is none.
    common : ndarray of bool, shape (feature,)
        Features whose errors neighbours share, so that a mean is no surer than one pixel.
    tolerance : ndarray, shape (feature,)
        Standard deviation, relative to the value, that no pooling takes away [1].
    """

    values: Array
    variances: Array
    common: Mask
    tolerance: Array

    def weights(self) -> Array:
        """
        Inverse variances.

        Returns
        -------
        ndarray, shape (feature, y, x)
            Weights; 0 where there is no estimate.
        """
        known = np.isfinite(self.values) & np.isfinite(self.variances) & (self.variances > 0)
        return np.divide(1.0, self.variances, out=np.zeros_like(self.values), where=known)


def sums(cells: Labels, pictures: npt.NDArray[Any]) -> Array:
    """
    Sum pictures over cells.

    Parameters
    ----------
    cells : ndarray of int, shape (y, x)
        Numbers of the cells from 1, 0 for none.
    pictures : ndarray, shape (feature, y, x)
        What to sum, finite; or what to count.

    Returns
    -------
    ndarray, shape (feature, cell + 1)
        Sums, those of no cell first.
    """
    size = int(cells.max()) + 1
    flat = cells.ravel()
    return np.stack([np.bincount(flat, picture.ravel(), minlength=size) for picture in pictures])


def mixed(cells: Labels, features: Features, error_rate: float) -> Mask:
    r"""
    Cells whose pixels do not agree with one another.

    .. math:: \sum_p (f_p - \bar f)^2 / s_p^2 > \chi^2_{n - 1}(1 - \alpha / \mathrm{cells})

    Parameters
    ----------
    cells : ndarray of int, shape (y, x)
        Numbers of the cells from 1, 0 for none.
    features : Features
        Of the pixels.
    error_rate : float
        Probability that any cell of one material is called mixed [1].

    Returns
    -------
    ndarray of bool, shape (cell + 1,)
        True where mixed; False for no cell.
    """
    weight = features.weights()
    values = np.where(weight > 0, features.values, 0.0)
    total, first, second, count = (
        sums(cells, part) for part in (weight, weight * values, weight * values**2, weight > 0)
    )
    misfit = second - np.divide(first**2, total, out=np.zeros_like(total), where=total > 0)
    freedom = np.maximum(count - 1, 1)
    return np.asarray(
        np.any(misfit > chi2.isf(error_rate / max(total.shape[1] - 1, 1), freedom), axis=0)
    )


def neighbours(cells: Labels) -> Labels:
    """
    Pairs of cells that touch along a side of a pixel.

    Parameters
    ----------
    cells : ndarray of int, shape (y, x)
        Numbers of the cells from 1, 0 for none.

    Returns
    -------
    ndarray of int, shape (pair, 2)
        Each pair once, the smaller number first.
    """
    sides = [(cells[1:], cells[:-1]), (cells[:, 1:], cells[:, :-1])]
    both = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in sides])
    both = both[(both[:, 0] != both[:, 1]) & np.all(both > 0, axis=1)]
    return np.asarray(np.unique(np.sort(both, axis=1), axis=0))


class Regions:
    r"""
    Cells of an image, and how they are joined.

    The statistic of two regions a and b, with pooled features :math:`\bar f`,

    .. math:: T = \sum_f \frac{(\bar f_a - \bar f_b)^2}
        {\mathrm{var}(\bar f_a) + \mathrm{var}(\bar f_b) + (\epsilon_f \bar f)^2}

    is chi-square over the features that both have, if they are of one material. Its limit is passed
    with a probability of the error rate over three times the number of cells, than which a map has
    fewer borders.

    Parameters
    ----------
    cells : ndarray of int, shape (y, x)
        Numbers of the cells from 1, 0 for none.
    features : Features
        Of the pixels; the first is the one whose differences must be resolved.
    error_rate : float
        Probability that cells of one material are held apart, in the whole image [1].
    """

    def __init__(self, cells: Labels, features: Features, error_rate: float) -> None:
        weight = features.weights()
        values = np.where(weight > 0, features.values, 0.0)
        self._total = sums(cells, weight)
        self._first = sums(cells, weight * values)
        self._count = sums(cells, weight > 0)
        self._common = features.common[:, np.newaxis, np.newaxis]
        self._tolerance = features.tolerance[:, np.newaxis]
        freedom = np.arange(features.common.size + 1)
        borders = 3 * self._total.shape[1]
        self._limits = chi2.isf(error_rate / borders, np.maximum(freedom, 1))
        self._parent = np.arange(self._total.shape[1])

    def root(self, cell: int) -> int:
        """
        Region that a cell belongs to.

        Parameters
        ----------
        cell : int
            Number of a cell.

        Returns
        -------
        int
            Number of one of its cells, the same for all.
        """
        parent = self._parent
        while parent[cell] != cell:
            parent[cell] = parent[parent[cell]]
            cell = int(parent[cell])
        return cell

    def roots(self) -> Labels:
        """
        Region of every cell, those of no cell first.

        Returns
        -------
        ndarray of int, shape (cell + 1,)
            As `root`.
        """
        return np.array([self.root(cell) for cell in range(self._parent.size)])

    def known(self) -> Mask:
        """
        Regions whose first feature is known.

        Returns
        -------
        ndarray of bool, shape (cell + 1,)
            True at the root of such a region.
        """
        return np.asarray(self._total[0] > 0)

    def compare(self, first: Labels, second: Labels) -> tuple[Array, Array]:
        """
        Compare pairs of regions.

        Parameters
        ----------
        first, second : ndarray of int, shape (pair,)
            Their roots.

        Returns
        -------
        tuple of ndarray, shape (pair,)
            The statistic over its limit, 0 where nothing can be compared; and the relative
            difference of the first feature that would reach the limit, infinite where it is
            unknown.
        """
        pair = np.stack([first, second])
        mean, variance, known = self._pooled(pair)  # (feature, 2, pair)
        both = np.all(known, axis=1)
        spread = variance.sum(axis=1) + (self._tolerance * mean.mean(axis=1)) ** 2
        apart = np.where(both, mean[:, 1] - mean[:, 0], 0.0)
        statistic = np.sum(apart**2 / np.where(both, spread, 1.0), axis=0)
        seen = np.sqrt(self._limits[1] * spread[0])
        size = np.where(both[0], np.abs(mean[0].mean(axis=0)), 0.0)
        resolved = np.divide(seen, size, out=np.full_like(seen, np.inf), where=size > 0)
        return statistic / self._limits[both.sum(axis=0)], resolved

    def join_alike(self, pairs: Labels, resolution: float) -> None:
        """
        Join neighbours that agree, the most alike first, until none are left.

        Parameters
        ----------
        pairs : ndarray of int, shape (pair, 2)
            Cells that touch.
        resolution : float
            Largest relative difference of the first feature that may go unseen [1].
        """
        joined = True
        while joined:
            joined = False
            statistic, seen = self.compare(*self.roots()[pairs].T)
            alike = np.flatnonzero((statistic <= 1.0) & (seen <= resolution))
            queue = [(float(statistic[i]), int(pairs[i, 0]), int(pairs[i, 1])) for i in alike]
            heapq.heapify(queue)
            while queue:
                before, one, other = heapq.heappop(queue)
                first, second = self.root(one), self.root(other)
                if first == second:
                    continue
                now, seen_now = self._compare_one(first, second)
                if now > 1.0 or seen_now > resolution:
                    continue
                # Grown since it was queued, and less alike: later.
                if now > before:
                    heapq.heappush(queue, (now, first, second))
                    continue
                self._merge(first, second)
                joined = True

    def join_in_order(self, pairs: Labels, order: Array) -> None:
        """
        Join neighbours in a given order, unless their features disagree.

        Parameters
        ----------
        pairs : ndarray of int, shape (pair, 2)
            Cells that touch.
        order : ndarray, shape (pair,)
            The smallest comes first.
        """
        for index in np.argsort(order, kind="stable"):
            first, second = (self.root(int(cell)) for cell in pairs[index])
            if first != second and self._compare_one(first, second)[0] <= 1.0:
                self._merge(first, second)

    def _pooled(self, regions: Labels) -> tuple[Array, Array, Mask]:
        """Means, their variances and where there are any: (feature, *shape of regions)."""
        total = self._total[:, regions]
        known = total > 0
        safe = np.where(known, total, 1.0)
        pooled = np.where(self._common, self._count[:, regions], 1.0)
        return self._first[:, regions] / safe, pooled / safe, known

    def _compare_one(self, first: int, second: int) -> tuple[float, float]:
        statistic, resolved = self.compare(np.array([first]), np.array([second]))
        return float(statistic[0]), float(resolved[0])

    def _merge(self, first: int, second: int) -> None:
        self._parent[second] = first
        for part in (self._total, self._first, self._count):
            part[:, first] += part[:, second]
            part[:, second] = 0.0
