"""Registration of several views of one object, by the enhanced correlation coefficient."""

from contextlib import suppress
from operator import itemgetter
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import gaussian_filter, map_coordinates, median_filter, spline_filter

from dbthermal import schema
from dbthermal._arrays import Array, Mask
from dbthermal._smooth import polynomial_basis
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._resampling import TRANSFORM, positions
from dbthermal.noise import MAD

# Kinds of transform, of two, six and eight numbers.
_MODELS: Final = ("translation", "affine", "homography")
# Coarse to fine: widths of the blur as a share of the image's height, the last one a pixel or so.
_BLURS: Final = (0.08, 0.04, 0.02)
_FINEST: Final = 0.7
_SMALLEST: Final = 16
# A pixel that differs from the median around it by more than so many standard deviations is bad.
_MEDIAN_WINDOW, _OUTLYING = 3, 6.0
# Of smooth curves: most frames that they are fitted to, functions, steps of the weights, Tukey's
# constant in standard deviations, and the least weight, which keeps a fit to few frames solvable.
_FRAMES, _ORDER, _ROBUST_STEPS, _TUKEY, _LEAST_WEIGHT = 128, 4, 5, 4.685, 1e-3
# Numbers of a homography that each model changes, one matrix each.
_FREE: Final = {
    model: np.eye(9)[places].reshape(-1, 3, 3)
    for model, places in (("translation", [2, 5]), ("affine", range(6)), ("homography", range(8)))
}
# Gauss-Newton: steps, length of a difference and of the last step, border left out [pixel].
_NEWTON, _STEP, _CONVERGED, _MARGIN = 15, 1e-2, 1e-4, 3
# Steps, and relative change of the correlation, at which the maximisation stops.
_STEPS, _TOLERANCE = 200, 1e-7
_LEAST_CORRELATION: Final = 0.5
# Share of the first view that the other must show: the last rows of two views correlate by chance.
_LEAST_OVERLAP: Final = 0.5


def register(
    corrected: xr.Dataset, *, model: Literal["translation", "affine", "homography"] = "homography"
) -> xr.DataArray:
    r"""Estimate the transform from the pixels of the first view to those of the others.

    Compared are means over time of smooth curves fitted robustly to each pixel, in which what
    passes by in the reflection hardly counts; and by how much each pixel rises steadily, as only a
    heated object does. What correlates better is used. The transform maximises their correlation,
    which neither gain nor offset of a view changes [1]_, at blurs from coarse to fine, and then
    minimises their difference by splines, to some hundredths of a pixel.

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
        Kind of transform. An affine one fits cameras that look the same way.

    Returns
    -------
    DataArray
        (band, row, column) [1], for `align`: for each band H, which takes the homogeneous position
        (x, y, 1) of a pixel of the first view to that of the same point in this one. Pixels count
        from 0 at the centre of the first; the identity in the first band.

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
    if min(counts.sizes["y"], counts.sizes["x"]) < _SMALLEST:
        raise ValueError(
            f"Invalid image of {counts.sizes['y']} by {counts.sizes['x']} pixels to be registered. "
            f"Must be at least {_SMALLEST} either way."
        )
    bad = corrected["status"].values > 0 if "status" in corrected else np.bool_(False)
    (mean, rise), *others = [_object_images(view, bad) for view in counts]
    matrices = [np.eye(3)]
    for view, images in zip(counts[1:], others, strict=True):
        found = [_transform(mean, images[0], model, str(view["band"].item()))]
        with suppress(ValueError):  # where the object is constant
            found.append(_transform(rise, images[1], model, str(view["band"].item())))
        matrices.append(max(found, key=itemgetter(0))[1])
    return xr.DataArray(
        np.stack(matrices),
        dims=TRANSFORM.dims,
        coords={"band": counts["band"].values},
        attrs={**TRANSFORM.attrs, "model": model},
        name="transform",
    )


def _object_images(view: xr.DataArray, bad: Mask | np.bool_) -> list[Array]:
    """Mean over time of what changes smoothly, and its rise (y, x), see `_scaled`."""
    frames = np.asarray(view.values)
    present = np.flatnonzero(~clocks.missing(frames))
    chosen = np.unique(np.linspace(0, present.size - 1, min(present.size, _FRAMES)).astype(int))
    frames = frames[present[chosen]].astype(np.float64)
    if not np.all(np.isfinite(frames)):
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': "
            f"{np.sum(~np.isfinite(frames).all(axis=0))} pixels are not finite. Must be finite in "
            "every frame that is not missing."
        )
    mean = np.stack([_smooth_mean(row) for row in frames.swapaxes(0, 1)])
    line = polynomial_basis(np.arange(len(frames)), min(2, len(frames)))[:, -1]
    rise = np.tensordot(line, frames, axes=1)
    if not mean.std() > 0:
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': all pixels are alike. Must show an "
            "object."
        )
    return [_scaled(mean, bad), _scaled(rise, bad)]


def _scaled(image: Array, bad: Mask | np.bool_) -> Array:
    """Image (y, x) of mean 0 and standard deviation 1, bad pixels as those around them."""
    around = median_filter(image, size=_MEDIAN_WINDOW)
    away = abs(image - around)
    # A bad pixel stays where it is in every view, and would pull the transform to the identity.
    image = np.where(bad | (away > _OUTLYING * MAD * np.median(away)), around, image)
    return np.asarray((image - image.mean()) / (image.std() or 1.0))


def _smooth_mean(signal: Array) -> Array:
    """Mean (pixel,) of smooth curves through signals (time, pixel), with Tukey's bisquare weights.

    What passes by in the reflection is an outlier: a plain mean holds some of it, in each band
    another share, and a warm spot without detail then seems displaced by 0.2 pixel.
    """
    functions = polynomial_basis(np.arange(len(signal)), min(_ORDER, len(signal)))
    products = np.einsum("ti,tj->tij", functions, functions).reshape(len(signal), -1)
    weights = np.ones_like(signal)
    for _ in range(_ROBUST_STEPS):
        matrix = (weights.T @ products).reshape(-1, functions.shape[1], functions.shape[1])
        right = (weights * signal).T @ functions
        curve = functions @ np.linalg.solve(matrix, right[..., np.newaxis])[..., 0].T
        residual = abs(signal - curve)
        scale = _TUKEY * MAD * np.median(residual, axis=0) + np.finfo(np.float32).tiny
        weights = (1.0 - np.minimum(residual / scale, 1.0) ** 2) ** 2 + _LEAST_WEIGHT
    return np.asarray(curve.mean(axis=0))


def _transform(first: Array, other: Array, model: str, band: str) -> tuple[float, Array]:
    """Correlation of two images (y, x), by the homography (3, 3) from the first to the other."""
    matrix, correlation = np.eye(3), 0.0
    stages = [(share * first.shape[0], "affine") for share in _BLURS]
    stages[0] = (stages[0][0], "translation")
    for blur, kind in [*stages, (_FINEST, model)]:
        simpler = _MODELS[min(_MODELS.index(kind), _MODELS.index(model))]
        pair = [gaussian_filter(image, blur).astype(np.float32) for image in (first, other)]
        matrix, correlation = _maximise(pair, matrix, simpler, band)
    if not correlation >= _LEAST_CORRELATION:
        raise ValueError(
            f"Invalid view in band '{band}': its correlation with the first is {correlation:.2f}. "
            f"Must be at least {_LEAST_CORRELATION}; they do not show the same, or lie too far "
            "apart."
        )
    y, x = positions(matrix, first.shape)
    rows, columns = first.shape
    shared = np.mean((y > -0.5) & (y < rows - 0.5) & (x > -0.5) & (x < columns - 0.5))
    if not shared >= _LEAST_OVERLAP:
        raise ValueError(
            f"Invalid view in band '{band}': it shares {shared:.0%} of the image with the first. "
            f"Must be at least {_LEAST_OVERLAP:.0%}."
        )
    pair = [gaussian_filter(image, _FINEST) for image in (first, other)]
    return correlation, _refined(pair, matrix, model)


def _refined(pair: list[Array], matrix: Array, model: str) -> Array:
    r"""Transform that minimises :math:`\sum (g I_1(p) + o - I_2(H p))^2`, by Gauss-Newton steps.

    Of :math:`I_2` over the mean and deviation of what is compared, for else places where it varies
    little would be the best: the correlation is largest there, which :math:`g` and :math:`o` leave.
    The enhanced correlation interpolates by lines, and is off by some hundredths of a pixel.
    """
    (rows, columns), spline = pair[0].shape, spline_filter(pair[1])
    unit = np.array([1 / columns, 1 / rows, 1] * 2 + [columns**-2, rows**-2, 0]).reshape(3, 3)
    for _ in range(_NEWTON):
        places = positions(matrix, pair[0].shape)
        inside = np.zeros(pair[0].shape, dtype=bool)
        inside[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = True
        inside &= np.all(places >= _MARGIN, axis=0)
        inside &= (places[0] < rows - _MARGIN) & (places[1] < columns - _MARGIN)

        def other(change: Array, inside: Mask = inside, start: Array = matrix) -> Array:
            where = positions(start + change, pair[0].shape)[:, inside]
            values = map_coordinates(spline, where, prefilter=False)
            return np.asarray((values - values.mean()) / values.std())

        steps = [place * unit * _STEP for place in _FREE[model]]
        slopes = [(other(-step) - other(step)) / (2 * _STEP) for step in steps]
        first = pair[0][inside]
        design = np.stack([*slopes, first, np.ones_like(first)], axis=1)
        found = np.linalg.lstsq(design, other(np.zeros((3, 3))), rcond=None)[0]
        change = sum(part * place * unit for part, place in zip(found, _FREE[model], strict=False))
        matrix = (matrix + change) / (matrix + change)[2, 2]
        if np.max(np.abs(found[: len(slopes)])) < _CONVERGED:
            break
    return np.asarray(matrix)


def _maximise(
    pair: list[npt.NDArray[np.float32]], start: Array, kind: str, band: str
) -> tuple[Array, float]:
    """Transform of the highest correlation near a start, and that correlation."""
    import cv2  # noqa: PLC0415  (optional: only registration needs it)

    rows = 3 if kind == "homography" else 2
    motion = getattr(cv2, f"MOTION_{kind.upper()}")
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, _STEPS, _TOLERANCE)
    everywhere = np.ones(pair[1].shape, dtype=np.uint8)
    try:
        correlation, estimate = cv2.findTransformECC(
            pair[0], pair[1], start[:rows].astype(np.float32), motion, stop, everywhere, 1
        )
    except cv2.error as error:
        raise ValueError(
            f"Invalid view in band '{band}': no transform to the first is found ({error.err}). "
            "Must show the same object, displaced by at most a tenth of the image."
        ) from error
    matrix = np.eye(3)
    matrix[:rows] = estimate
    return matrix / matrix[2, 2], float(correlation)
