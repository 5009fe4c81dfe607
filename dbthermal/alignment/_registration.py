"""Registration of several views of one object, by robust least squares between smooth curves."""

from operator import itemgetter
from typing import Final, Literal

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, median_filter, spline_filter

from dbthermal import _text, schema
from dbthermal._arrays import Array, Mask
from dbthermal._smooth import polynomial_basis
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._resampling import TRANSFORM, positions
from dbthermal.alignment._splines import sampled
from dbthermal.noise import MAD

# Entries of a homography that each kind of transform changes.
_FREE: Final = {"translation": [2, 5], "affine": [0, 1, 2, 3, 4, 5], "homography": list(range(8))}
_MODELS: Final = tuple(_FREE)
# Blurs from coarse to fine, as shares of the image's height, and the finest [pixel].
_BLURS, _FINEST = (0.08, 0.04, 0.02), 0.7
_SMALLEST: Final = 16  # rows and columns, at least
# A pixel farther from the median around it is bad: window [pixel], limit [standard deviation].
_MEDIAN_WINDOW, _OUTLYING = 3, 6.0
_SAMPLE: Final = 200  # frames that are read of a longer capture, about
# Smooth curves: most frames, functions, iterations, Tukey's constant [standard deviation], and the
# least weight, which keeps a fit to few frames solvable.
_FRAMES, _ORDER, _ROBUST_STEPS, _TUKEY, _LEAST_WEIGHT = 128, 4, 5, 4.685, 1e-3
# Gauss-Newton: iterations, length of the last step and excluded border [pixel], degree of the
# polynomial between the views, and limit of the residual over its scale.
_NEWTON, _CONVERGED, _MARGIN, _DEGREE, _LIMIT = 40, 1e-4, 4, 2, 3.0
# Prior deviation of rotation, scale, and perspective over the image [1].
_RIGID: Final = 0.01
_FLOOR: Final = 1e-3  # of the residuals' mean variance, in every combination of times
_QUARTER: Final = 0.25  # of the texture, whose residual is the scale
_LEAST_CORRELATION, _LEAST_OVERLAP = 0.5, 0.5  # the last rows of two views correlate by chance


def register(
    corrected: xr.Dataset, *, model: Literal["translation", "affine", "homography"] = "homography"
) -> xr.DataArray:
    r"""Estimate the transform from the pixels of the first view to those of the others.

    Smooth curves are fitted robustly to each pixel, so that passing reflections hardly count. The
    translation between their means, from coarse to fine images, is refined to some hundredths of a
    pixel by robust least squares of the curves [1]_,

    .. math:: \min \sum_p \varrho \left(\sum_t [f(I_1(p, t)) + o(t) - I_2(H p, t)]^2 \right)

    with Tukey's bisquare :math:`\varrho`, which excludes pixels with different reflections, and a
    quadratic :math:`f`, because the bands' radiances are not proportional. A weak prior of equal
    cameras that look one way (rotation, scale and perspective within 1 %, one standard deviation)
    counts where the texture does not tell them. H takes positions to positions:

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T

    A homography registers a plane exactly. Side-by-side cameras see its reflections at different
    places of the plane: no transform brings object and reflection together.

    TypeError or ValueError if the image is smaller than 16 pixels either way, a mean is not finite,
    the correlation of two views is below 0.5, or they share less than half the image.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`: views of one object, displaced by at most about a tenth of
        the image. Of a capture with a `segment` the longest is used.
    model : {"translation", "affine", "homography"}
        Kind of transform. Where a smooth object's materials differ from band to band in contrast,
        nothing else has detail, and people walk by, each may be off by 12 pixels: take one of
        another object, such as a target. An affine one fits cameras that look the same way.

    Returns
    -------
    DataArray
        (band, row, column) [1], for `align`: for each band H, which takes the homogeneous position
        (x, y, 1) of a pixel of the first view to that of the same point in this one. Pixels count
        from 0 at the centre of the first; the identity in the first band. Attribute: `model`.

    References
    ----------
    .. [1] Baker, Matthews (2004), International Journal of Computer Vision 56, 221,
       doi:10.1023/B:VISI.0000011205.11775.fd

    Examples
    --------
    The second view shows the scene three pixels further right and two further down.

    >>> import numpy as np, xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> scene = gaussian_filter(np.random.default_rng(1).normal(20000, 3000, (70, 70)), 4)
    >>> views = np.stack([[scene[3:67, 3:67]] * 2, [scene[1:65, :64]] * 2])  # [count]
    >>> axes = {"band": ["8-14", "9.5"], "time": [0.0, 0.1]}
    >>> corrected = xr.Dataset({"counts": (("band", "time", "y", "x"), views)}, axes)
    >>> transform = register(corrected, model="translation")
    >>> transform.sel(band="9.5").values[:2, 2].round(1).tolist()  # [pixel]
    [3.0, 2.0]
    """
    _text.check_listed("Unknown model", model, _MODELS)
    counts = schema.check(corrected, "corrected")["counts"]
    # The longest segment: a new pattern would be detail that does not move.
    if "segment" in corrected:
        numbers, frames = np.unique(corrected["segment"], return_counts=True)
        longest = corrected["segment"].values == numbers[np.argmax(frames)]
        counts = counts.isel(time=longest)
    counts = counts.isel(time=slice(None, None, max(1, counts.sizes["time"] // _SAMPLE)))
    if min(counts.sizes["y"], counts.sizes["x"]) < _SMALLEST:
        size = f"{counts.sizes['y']} by {counts.sizes['x']} pixels to be registered"
        raise ValueError(f"Invalid image of {size}. Must be at least {_SMALLEST} either way.")
    bad = schema.pixel_status(corrected) > 0
    curves = [_curves(view, bad) for view in counts]
    matrices = [np.eye(3)]
    for band, curve in zip(counts["band"].values[1:], curves[1:], strict=True):
        matrices.append(_transform(curves[0], curve, model, str(band)))
    return xr.DataArray(
        np.stack(matrices),
        dims=TRANSFORM.dims,
        coords={"band": counts["band"].values},
        attrs={**TRANSFORM.attrs, "model": model},
        name="transform",
    )


def _curves(view: xr.DataArray, bad: Mask) -> Array:
    """Smooth curves at a few times (time, y, x), over their mean and standard deviation."""
    frames, label = np.asarray(view.values), f"Invalid view in band '{view['band'].item()}'"
    present = np.flatnonzero(~clocks.missing(frames))
    if present.size == 0:
        raise ValueError(f"{label}: all {len(frames)} frames are missing. Must have one.")
    chosen = np.unique(np.linspace(0, present.size - 1, min(present.size, _FRAMES)).astype(int))
    frames = frames[present[chosen]].astype(np.float64)
    if not np.all(np.isfinite(frames)):
        count, rule = np.sum(~np.isfinite(frames).all(axis=0)), "in every frame that is not missing"
        raise ValueError(f"{label}: {count} pixels are not finite. Must be finite {rule}.")
    # Smooth curves, bad pixels replaced by the median around them.
    images = np.stack([_smooth(row) for row in frames.swapaxes(0, 1)], axis=1)
    if not images.mean(axis=0).std() > 0:
        raise ValueError(f"{label}: all pixels are alike. Must show an object.")
    for image in images:
        median = median_filter(image, size=_MEDIAN_WINDOW)
        difference = abs(image - median)
        # A bad pixel has the same place in every view and pulls the transform to the identity.
        outlier = bad | (difference > _OUTLYING * MAD * np.median(difference))
        image[outlier] = median[outlier]
    return np.asarray((images - images.mean()) / images.std())


def _smooth(signal: Array) -> Array:
    """Fit smooth curves to signals (time, pixel), by Tukey's bisquare weights, at a few times."""
    order = min(_ORDER, len(signal))
    functions = polynomial_basis(np.arange(len(signal)), order)
    products = np.einsum("ti,tj->tij", functions, functions).reshape(len(signal), -1)
    # A plain mean holds a share of passing reflections, different in each band, which displaces a
    # warm spot without detail by 0.2 pixel.
    weights = np.ones_like(signal)
    for _ in range(_ROBUST_STEPS):
        matrix = (weights.T @ products).reshape(-1, order, order)
        right = (weights * signal).T @ functions
        curve = functions @ np.linalg.solve(matrix, right[..., np.newaxis])[..., 0].T
        residual = abs(signal - curve)
        scale = _TUKEY * MAD * np.median(residual, axis=0) + np.finfo(np.float32).tiny
        weights = (1.0 - np.minimum(residual / scale, 1.0) ** 2) ** 2 + _LEAST_WEIGHT
    return np.asarray(curve[((np.arange(order) + 0.5) * len(signal) / order).astype(int)])


def _transform(first: Array, second: Array, model: str, band: str) -> Array:
    """Homography (3, 3) from images (time, y, x) of the first view to those of the second."""
    starts, failures = [], []
    # Start from the mean or, of a heated object, from the rise: whichever correlates better.
    for weights in (np.ones(len(first)), np.linspace(-1.0, 1.0, len(first))):
        try:
            pair = [np.tensordot(weights, images, axes=1) for images in (first, second)]
            starts.append(_start(pair, band))
        except ValueError as error:
            failures.append(error)
    if not starts:
        raise failures[0]
    matrix, allowed = max(starts, key=itemgetter(0))[1], _MODELS[: _MODELS.index(model) + 1]
    # The coarse images have little perspective.
    for blur, models in ((_BLURS[-1] * first.shape[1], allowed[:2]), (_FINEST, allowed)):
        pair = [gaussian_filter(images, blur, axes=(1, 2)) for images in (first, second)]
        for kind in models:
            matrix = _fitted(pair, matrix, _FREE[kind], blur, band)
    return matrix


def _fitted(pair: list[Array], matrix: Array, free: list[int], blur: float, band: str) -> Array:
    """Match images by Gauss-Newton on splines, with the prior of equal cameras."""
    shape, count = pair[0].shape[1:], len(pair[0])
    splines = np.stack([spline_filter(image) for image in pair[1]], axis=-1)
    span = np.array([*shape[::-1], 1, *shape[::-1], 1, *shape[::-1]], dtype=float)[free]
    unit = span ** -np.array([1, 1, 1, 1, 1, 1, 2, 2])[free]
    rows, columns = np.divmod(free, 3)
    # Residuals are equal over the blur, and at all times: one for each 4 pi blur^2 pixels.
    area = 4.0 * np.pi * blur**2
    weights, variance = np.ones(shape), area * count  # of images without a transform
    white = np.eye(count)  # whitens the residuals over time
    prior = np.where(span > 1.0, (_RIGID * span) ** -2, 0.0)  # [1/pixel^2], none on a translation
    for _ in range(_NEWTON):
        places = positions(matrix, shape)
        overlap = _overlap(places, band)
        reference = pair[0][:, overlap]
        values, *slopes = white @ sampled(splines, places[:, overlap]).swapaxes(1, 2)
        # I_2(H p) + (dH p) grad I_2 = f(I_1) + o, linear in dH and the numbers of f and o.
        motion = _motion(matrix, places, overlap)[rows, columns] * unit[:, np.newaxis, np.newaxis]
        design = np.concatenate(
            [
                -np.einsum("atp,nap->ntp", slopes, motion),
                np.matmul(white, [reference**power for power in range(1, _DEGREE + 1)]),
                np.repeat(white.T[:, :, np.newaxis], reference.shape[1], axis=2),
            ]
        )
        weighted = design * weights[overlap]
        flat = weighted.reshape(len(design), -1)
        normal, right = flat @ design.reshape(len(design), -1).T, flat @ values.ravel()
        displacement = (matrix - np.eye(3)).ravel()[free] / unit  # so far [pixel]
        normal[: len(free), : len(free)] += np.diag(variance * prior)
        right[: len(free)] -= variance * prior * displacement
        solution = np.linalg.pinv(normal, hermitian=True) @ right
        residual = values - np.tensordot(solution, design, axes=1)
        square, texture = np.sum(residual**2, axis=0), np.sum(np.square(slopes), axis=(0, 1))
        # Scale of the residual of the texture's quarter that matches best: an edge is no outlier
        # of what is flat, and much may mirror other things.
        order = np.argsort(square)
        quarter = np.searchsorted(np.cumsum(texture[order]), _QUARTER * texture.sum())
        limit = _LIMIT**2 * square[order[quarter]] + np.finfo(np.float32).tiny
        weights[overlap] = (1.0 - np.minimum(square / limit, 1.0)) ** 2
        variance = area * np.average(square, weights=weights[overlap])
        plain = np.linalg.solve(white, residual)
        covariance = (plain * weights[overlap]) @ plain.T / weights[overlap].sum()
        mean = np.trace(covariance) / count + np.finfo(np.float32).tiny
        white = np.linalg.inv(np.linalg.cholesky(covariance / mean + _FLOOR * np.eye(count)))
        matrix = matrix.copy()
        matrix[rows, columns] += solution[: len(free)] * unit
        matrix /= matrix[2, 2]
        if np.max(np.abs(solution[: len(free)])) < _CONVERGED:
            break
    return matrix


def _motion(matrix: Array, places: Array, overlap: Mask) -> Array:
    """Derivatives (3, 3, axis, pixel) of pixel places by the entries of a transform."""
    row, column = places[:, overlap]
    point = np.stack([*np.indices(places.shape[1:])[::-1, overlap], np.ones_like(row)])
    scale, zero = matrix[2] @ point, np.zeros_like(row)
    of_product = np.stack([[zero, zero + 1.0], [zero + 1.0, zero], [-row, -column]]) / scale
    return np.asarray(of_product[:, np.newaxis] * point[:, np.newaxis])


def _overlap(places: Array, band: str) -> Mask:
    """Pixels of the first view whose places (2, y, x) lie inside the second, without borders."""
    ends = np.reshape(places.shape[1:], (2, 1, 1)) - 1
    shared = np.mean(np.all((places > -0.5) & (places < ends + 0.5), axis=0))
    if not shared >= _LEAST_OVERLAP:
        label = f"it shares {shared:.0%} of the image with the first"
        rule = f"Must be at least {_LEAST_OVERLAP:.0%}, neither mirrored nor turned"
        raise ValueError(f"Invalid view in band '{band}': {label}. {rule}.")
    pixels = np.indices(places.shape[1:])
    lowest, highest = np.minimum(places, pixels), np.maximum(places, pixels)
    return np.asarray(np.all((lowest >= _MARGIN) & (highest <= ends - _MARGIN), axis=0))


def _start(pair: list[Array], band: str) -> tuple[float, Array]:
    """Correlation of two images (y, x), and the translation (3, 3) between them, coarse to fine."""
    matrix, blurred = np.eye(3), pair
    for share in _BLURS:
        blur = share * len(pair[0])
        blurred = [gaussian_filter(image, blur) for image in pair]
        films = [image[np.newaxis] for image in blurred]
        matrix = _fitted(films, matrix, _FREE["translation"], blur, band)
    # The images must be alike where they overlap.
    places = positions(matrix, pair[0].shape)
    overlap = _overlap(places, band)
    values = sampled(spline_filter(blurred[1])[..., np.newaxis], places[:, overlap])[0]
    with np.errstate(invalid="ignore", divide="ignore"):  # of an image without detail
        correlation = float(np.corrcoef(blurred[0][overlap], values.ravel())[0, 1])
    if not correlation >= _LEAST_CORRELATION:
        raise ValueError(
            f"Invalid view in band '{band}': its correlation with the first is {correlation:.2f}. "
            f"Must be at least {_LEAST_CORRELATION}: the same object, neither mirrored nor turned, "
            "displaced by at most a tenth of the image."
        )
    return correlation, matrix
