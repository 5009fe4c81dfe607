"""Registration of several views of one object, by robust least squares between smooth curves."""

from operator import itemgetter
from typing import Final, Literal

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter, median_filter, spline_filter

from dbthermal import schema
from dbthermal._arrays import Array, Mask
from dbthermal._smooth import polynomial_basis
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._products import sampled
from dbthermal.alignment._views import TRANSFORM, positions
from dbthermal.noise import MAD

# Kinds of transform, of two, six and eight numbers.
_MODELS: Final = ("translation", "affine", "homography")
# Coarse to fine: widths of the blur as a share of the image's height, the last one a pixel or so.
_BLURS: Final = (0.08, 0.04, 0.02)
_FINEST: Final = 0.7
_SMALLEST: Final = 16
# A pixel that differs from the median around it by more than so many standard deviations is bad.
_MEDIAN_WINDOW, _OUTLYING = 3, 6.0
# Frames that are read, about, of a longer capture.
_READ: Final = 200
# Of smooth curves: most frames that they are fitted to, functions, steps of the weights, Tukey's
# constant in standard deviations, and the least weight, which keeps a fit to few frames solvable.
_FRAMES, _ORDER, _ROBUST_STEPS, _TUKEY, _LEAST_WEIGHT = 128, 4, 5, 4.685, 1e-3
# Numbers of a homography that each model changes.
_FREE: Final = {"translation": [2, 5], "affine": [0, 1, 2, 3, 4, 5], "homography": list(range(8))}
# Gauss-Newton: steps, length of the last step and border left out [pixel]; degree of the polynomial
# from view to view, and scales of the residual from which a pixel does not count.
_NEWTON, _CONVERGED, _MARGIN, _DEGREE, _CUT = 40, 1e-4, 4, 2, 3.0
# Deviation of rotation, scale, and perspective over the image, of equal cameras side by side [1].
_RIGID: Final = 0.01
_FLOOR: Final = 1e-3  # of the residuals' mean variance, in every combination of times
_QUARTER: Final = 0.25  # of the texture, whose residual is the scale
# Steps, and relative change of the correlation, at which the maximisation stops.
_STEPS, _TOLERANCE = 200, 1e-7
_LEAST_CORRELATION: Final = 0.5
# Share of the first view that the other must show: the last rows of two views correlate by chance.
_LEAST_OVERLAP: Final = 0.5


def register(
    corrected: xr.Dataset, *, model: Literal["translation", "affine", "homography"] = "homography"
) -> xr.DataArray:
    r"""Estimate the transform from the pixels of the first view to those of the others.

    Compared are smooth curves fitted robustly to each pixel, in which what passes by in the
    reflection hardly counts. Their means are brought together by the translation of the highest
    correlation [1]_, and then, to some hundredths of a pixel, the curves by robust least squares,

    .. math:: \min \sum_p \varrho \left(\sum_t [f(I_1(p, t)) + o(t) - I_2(H p, t)]^2 \right)

    with Tukey's bisquare :math:`\varrho`, so that pixels in which the views mirror different things
    do not count, and a quadratic :math:`f`, for the bands' radiances bend against one another: a
    warm spot would be narrower in the one than in the other. Added is a weak prior of equal cameras
    that look one way: rotation, scale and perspective within 1 % (0.6 degrees), one standard
    deviation, which counts where the texture does not tell them. H takes positions to positions:

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T

    A plane is registered exactly by a homography. Its reflections lie behind it, and are seen by
    side-by-side cameras at different places of the plane: no transform brings object and reflection
    together.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`: views of one object, displaced by at most about a tenth of
        the image. Of a capture with a `segment` the longest is used.
    model : {"translation", "affine", "homography"}
        Kind of transform. Where a smooth object's materials differ from band to band in contrast,
        and nothing else has detail, each is off by up to a pixel: state one from another object.
        An affine one fits cameras that look the same way.

    Returns
    -------
    DataArray
        (band, row, column) [1], for `align`: for each band H, which takes the homogeneous position
        (x, y, 1) of a pixel of the first view to that of the same point in this one. Pixels count
        from 0 at the centre of the first; the identity in the first band. Attribute: `model`.

    Raises
    ------
    ImportError
        If OpenCV, of the extra ``alignment``, is not installed.
    TypeError, ValueError
        If the image is smaller than 16 pixels either way, a mean is not finite, the correlation of
        two views is below 0.5, or they share less than half the image.

    References
    ----------
    .. [1] Evangelidis, Psarakis (2008), IEEE Transactions on Pattern Analysis and Machine
       Intelligence 30, 1858, doi:10.1109/TPAMI.2008.113

    Examples
    --------
    The second view shows the scene three pixels further right and two further down.

    >>> import numpy as np, xarray as xr
    >>> from scipy.ndimage import gaussian_filter
    >>> scene = gaussian_filter(np.random.default_rng(1).normal(20000, 3000, (70, 70)), 4)
    >>> views = np.stack([[scene[3:67, 3:67]] * 2, [scene[1:65, :64]] * 2])  # [count]
    >>> corrected = xr.Dataset(
    ...     {"counts": (("band", "time", "y", "x"), views)},
    ...     {"band": ["8-14", "9.5"], "time": [0.0, 0.1]},
    ... )
    >>> transform = register(corrected, model="translation")
    >>> transform.sel(band="9.5").values[:2, 2].round(1).tolist()  # [pixel]
    [3.0, 2.0]
    """
    if model not in _MODELS:
        raise ValueError(f"Unknown model '{model}'. Must be one of {_MODELS}.")
    counts = schema.check(corrected, "corrected")["counts"]
    if "segment" in corrected:  # the longest: a new pattern would be detail that does not move
        numbers, frames = np.unique(corrected["segment"], return_counts=True)
        longest = corrected["segment"].values == numbers[np.argmax(frames)]
        counts = counts.isel(time=longest)
    counts = counts.isel(time=slice(None, None, max(1, counts.sizes["time"] // _READ)))
    if min(counts.sizes["y"], counts.sizes["x"]) < _SMALLEST:
        raise ValueError(
            f"Invalid image of {counts.sizes['y']} by {counts.sizes['x']} pixels to be registered. "
            f"Must be at least {_SMALLEST} either way."
        )
    bad = corrected["status"].values > 0 if "status" in corrected else np.bool_(False)
    first, *others = [_curves(view, bad) for view in counts]
    matrices = [np.eye(3)]
    for band, other in zip(counts["band"].values[1:], others, strict=True):
        matrices.append(_transform(first, other, model, str(band)))
    return xr.DataArray(
        np.stack(matrices),
        dims=TRANSFORM.dims,
        coords={"band": counts["band"].values},
        attrs={**TRANSFORM.attrs, "model": model},
        name="transform",
    )


def _curves(view: xr.DataArray, bad: Mask | np.bool_) -> Array:
    """Smooth curves at a few times (time, y, x), over their mean and standard deviation."""
    frames = np.asarray(view.values)
    present = np.flatnonzero(~clocks.missing(frames))
    if present.size == 0:
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': all {len(frames)} frames are missing. "
            "Must have one."
        )
    chosen = np.unique(np.linspace(0, present.size - 1, min(present.size, _FRAMES)).astype(int))
    frames = frames[present[chosen]].astype(np.float64)
    if not np.all(np.isfinite(frames)):
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': "
            f"{np.sum(~np.isfinite(frames).all(axis=0))} pixels are not finite. Must be finite in "
            "every frame that is not missing."
        )
    images = np.stack([_smooth(row) for row in frames.swapaxes(0, 1)], axis=1)
    if not images.mean(axis=0).std() > 0:
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': all pixels are alike. Must show an "
            "object."
        )
    for image in images:
        around = median_filter(image, size=_MEDIAN_WINDOW)
        away = abs(image - around)
        # A bad pixel stays where it is in every view: it would pull the transform to the identity.
        wrong = bad | (away > _OUTLYING * MAD * np.median(away))
        image[wrong] = around[wrong]
    return np.asarray((images - images.mean()) / images.std())


def _smooth(signal: Array) -> Array:
    """Smooth curves through signals (time, pixel), by Tukey's bisquare weights, at a few times.

    What passes by in the reflection is an outlier: a plain mean holds some of it, in each band
    another share, and a warm spot without detail then seems displaced by 0.2 pixel.
    """
    order = min(_ORDER, len(signal))
    functions = polynomial_basis(np.arange(len(signal)), order)
    products = np.einsum("ti,tj->tij", functions, functions).reshape(len(signal), -1)
    weights = np.ones_like(signal)
    for _ in range(_ROBUST_STEPS):
        matrix = (weights.T @ products).reshape(-1, order, order)
        right = (weights * signal).T @ functions
        curve = functions @ np.linalg.solve(matrix, right[..., np.newaxis])[..., 0].T
        residual = abs(signal - curve)
        scale = _TUKEY * MAD * np.median(residual, axis=0) + np.finfo(np.float32).tiny
        weights = (1.0 - np.minimum(residual / scale, 1.0) ** 2) ** 2 + _LEAST_WEIGHT
    return np.asarray(curve[((np.arange(order) + 0.5) * len(signal) / order).astype(int)])


def _transform(first: Array, other: Array, model: str, band: str) -> Array:
    """Homography (3, 3) from the first images (time, y, x) to others."""
    found, failures = [], []
    # What rises steadily, as only a heated object does, tells the start where it correlates better.
    for weights in (np.ones(len(first)), np.linspace(-1.0, 1.0, len(first))):
        try:
            pair = [np.tensordot(weights, images, axes=1) for images in (first, other)]
            found.append(_start(pair, band))
        except ValueError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    matrix, kinds = max(found, key=itemgetter(0))[1], _MODELS[: _MODELS.index(model) + 1]
    # The coarse images have little perspective.
    for blur, some in ((_BLURS[-1] * first.shape[1], kinds[:2]), (_FINEST, kinds)):
        pair = [gaussian_filter(images, blur, axes=(1, 2)) for images in (first, other)]
        for kind in some:
            matrix = _fitted(pair, matrix, _FREE[kind], blur, band)
    return matrix


def _fitted(pair: list[Array], matrix: Array, free: list[int], blur: float, band: str) -> Array:
    """Transform that matches images best, beside the prior of equal cameras that look one way.

    By Gauss-Newton steps, of splines: the enhanced correlation interpolates by lines, and is off by
    some hundredths of a pixel.
    """
    shape, count = pair[0].shape[1:], len(pair[0])
    splines = np.stack([spline_filter(image) for image in pair[1]], axis=-1)
    span = np.array([*shape[::-1], 1, *shape[::-1], 1, *shape[::-1]], dtype=float)[free]
    unit = span ** -np.array([1, 1, 1, 1, 1, 1, 2, 2])[free]
    rows, columns = np.divmod(free, 3)
    # Residuals are alike over the blur, and at all times: one for each 4 pi blur^2 pixels.
    alike = 4.0 * np.pi * blur**2
    weights, variance = np.ones(shape), alike * count  # at first of images without a transform
    # Of residuals over time: a pattern that a shutter event left rests, and spoils the mean alone.
    white = np.eye(count)
    prior = np.where(span > 1.0, (_RIGID * span) ** -2, 0.0)  # [1/pixel^2], none on a translation
    for _ in range(_NEWTON):
        places = positions(matrix, shape)
        inside = _inside(places, band)
        first = pair[0][:, inside]
        values, *slopes = white @ sampled(splines, places[:, inside]).swapaxes(1, 2)
        # I_2(H p) + (dH p) grad I_2 = f(I_1) + o, linear in dH and the numbers of f and o.
        motion = _motion(matrix, places, inside)[rows, columns] * unit[:, np.newaxis, np.newaxis]
        design = np.concatenate(
            [
                -np.einsum("atp,nap->ntp", slopes, motion),
                np.matmul(white, [first**power for power in range(1, _DEGREE + 1)]),
                np.repeat(white.T[:, :, np.newaxis], first.shape[1], axis=2),
            ]
        )
        weighted = design * weights[inside]
        flat = weighted.reshape(len(design), -1)
        normal, right = flat @ design.reshape(len(design), -1).T, flat @ values.ravel()
        moved = (matrix - np.eye(3)).ravel()[free] / unit  # so far [pixel]
        normal[: len(free), : len(free)] += np.diag(variance * prior)
        right[: len(free)] -= variance * prior * moved
        found = np.linalg.pinv(normal, hermitian=True) @ right
        residual = values - np.tensordot(found, design, axes=1)
        square, texture = np.sum(residual**2, axis=0), np.sum(np.square(slopes), axis=(0, 1))
        # Scale of the residual of the texture's quarter that matches best: an edge is no outlier
        # of what is flat, and much may mirror other things.
        order = np.argsort(square)
        quarter = np.searchsorted(np.cumsum(texture[order]), _QUARTER * texture.sum())
        limit = _CUT**2 * square[order[quarter]] + np.finfo(np.float32).tiny
        weights[inside] = (1.0 - np.minimum(square / limit, 1.0)) ** 2
        variance = alike * np.average(square, weights=weights[inside])
        apart = np.linalg.solve(white, residual)
        covariance = (apart * weights[inside]) @ apart.T / weights[inside].sum()
        mean = np.trace(covariance) / count + np.finfo(np.float32).tiny
        white = np.linalg.inv(np.linalg.cholesky(covariance / mean + _FLOOR * np.eye(count)))
        matrix = matrix.copy()
        matrix[rows, columns] += found[: len(free)] * unit
        matrix /= matrix[2, 2]
        if np.max(np.abs(found[: len(free)])) < _CONVERGED:
            break
    return matrix


def _motion(matrix: Array, places: Array, inside: Mask) -> Array:
    """Derivatives (3, 3, axis, pixel) of the places of some pixels by the numbers of a transform.

    The row and column of H p = (a, b, c), c the scale, are b / c and a / c.
    """
    row, column = places[:, inside]
    point = np.stack([*np.indices(places.shape[1:])[::-1, inside], np.ones_like(row)])
    scale, none = matrix[2] @ point, np.zeros_like(row)
    of_product = np.stack([[none, none + 1.0], [none + 1.0, none], [-row, -column]]) / scale
    return np.asarray(of_product[:, np.newaxis] * point[:, np.newaxis])


def _inside(places: Array, band: str) -> Mask:
    """Pixels of the first view, not at the border, whose places (2, y, x) in the other are not."""
    ends = np.reshape(places.shape[1:], (2, 1, 1)) - 1
    shared = np.mean(np.all((places > -0.5) & (places < ends + 0.5), axis=0))
    if not shared >= _LEAST_OVERLAP:
        raise ValueError(
            f"Invalid view in band '{band}': it shares {shared:.0%} of the image with the first. "
            f"Must be at least {_LEAST_OVERLAP:.0%}."
        )
    own = np.indices(places.shape[1:])
    lowest, highest = np.minimum(places, own), np.maximum(places, own)
    return np.asarray(np.all((lowest >= _MARGIN) & (highest <= ends - _MARGIN), axis=0))


def _start(pair: list[Array], band: str) -> tuple[float, Array]:
    """Translation (3, 3) of the highest correlation of two images (y, x), and that before it."""
    import cv2  # noqa: PLC0415  (optional: only registration needs it)

    matrix, correlation = np.eye(3), 0.0
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _STEPS, _TOLERANCE)
    everywhere = np.ones(pair[0].shape, dtype=np.uint8)
    for share in _BLURS:
        one, two = (gaussian_filter(it, share * it.shape[0]).astype(np.float32) for it in pair)
        start = matrix[:2].astype(np.float32)
        try:
            correlation, matrix[:2] = cv2.findTransformECC(
                one, two, start, cv2.MOTION_TRANSLATION, stop, everywhere, 1
            )
        except cv2.error as error:
            raise ValueError(
                f"Invalid view in band '{band}': no transform to the first is found ({error.err})."
                " Must show the same object, displaced by at most a tenth of the image."
            ) from error
    if not correlation >= _LEAST_CORRELATION:
        raise ValueError(
            f"Invalid view in band '{band}': its correlation with the first is {correlation:.2f}. "
            f"Must be at least {_LEAST_CORRELATION}; they do not show the same, or lie too far "
            "apart."
        )
    return float(correlation), matrix
