"""Registration of several views of one object, by the enhanced correlation coefficient."""

from typing import Final

import cv2
import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import gaussian_filter, median_filter

from dbthermal import schema
from dbthermal.alignment import _clocks as clocks
from dbthermal.alignment._resampling import TRANSFORM

Array = npt.NDArray[np.float64]

MODELS: Final = ("translation", "affine", "homography")
"""Kinds of transform, of two, six and eight numbers."""

_MOTIONS: Final = {
    "translation": cv2.MOTION_TRANSLATION,
    "affine": cv2.MOTION_AFFINE,
    "homography": cv2.MOTION_HOMOGRAPHY,
}
# Coarse to fine: widths of the blur as a share of the image's height, the last one a pixel or so.
_BLURS: Final = (0.08, 0.04, 0.02)
_FINEST: Final = 0.7
_SMALLEST: Final = 16
# A bad pixel stays where it is in every view, and would pull the transform towards none.
_WITHOUT_BAD_PIXELS: Final = 3
_STOP: Final = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-7)
_LIKENESS: Final = 0.5


def register(corrected: xr.Dataset, *, model: str = "homography") -> xr.DataArray:
    r"""
    Find where each pixel of the first view is in the others.

    Pictures of the object are compared: the means over time, in which the background is blurred.
    The transform maximises their correlation, which neither gain nor offset of a view changes
    [1]_, at blurs from coarse to fine.

    .. math:: (x', y', 1)^T \propto H (x, y, 1)^T

    A plane is registered exactly by a homography. What it reflects lies behind it, and is seen by
    side-by-side cameras at different places of the plane: no transform brings object and
    reflection together.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`: views of one object, not farther apart than a tenth of the
        image or so.
    model : {"translation", "affine", "homography"}
        Kind of transform. An affine one fits cameras that look the same way.

    Returns
    -------
    DataArray
        (band, row, column) [1], for `align`: for each band H, which takes the homogeneous
        position (x, y, 1) of a pixel of the first view to that of the same point in this one.
        Pixels count from 0 at the centre of the first; the identity in the first band.

    Raises
    ------
    TypeError, ValueError
        If the capture is not as `schema` has it, the model is unknown, the image is smaller than
        16 pixels either way, a mean is not finite, or two views do not resemble one another (a
        correlation below 0.5).

    References
    ----------
    .. [1] Evangelidis, Psarakis (2008), IEEE Transactions on Pattern Analysis and Machine
       Intelligence 30, 1858, doi:10.1109/TPAMI.2008.113
    """
    if model not in MODELS:
        raise ValueError(f"Unknown model '{model}'. Must be one of {MODELS}.")
    counts = schema.check(corrected, "corrected")["counts"]
    if min(counts.sizes["y"], counts.sizes["x"]) < _SMALLEST:
        raise ValueError(
            f"Invalid image of {counts.sizes['y']} by {counts.sizes['x']} pixels to be registered. "
            f"Must be at least {_SMALLEST} either way."
        )
    pictures = [_picture(view) for view in counts]
    matrices = [np.eye(3)]
    for view, picture in zip(counts[1:], pictures[1:], strict=True):
        matrices.append(_transform(pictures[0], picture, model, str(view["band"].item())))
    return xr.DataArray(
        np.stack(matrices),
        dims=TRANSFORM.dims,
        coords={"band": counts["band"].values},
        attrs={**TRANSFORM.attrs, "model": model},
        name="transform",
    )


def _picture(view: xr.DataArray) -> Array:
    """Mean over time of a view (y, x), without single bad pixels; mean 0, standard deviation 1."""
    frames = np.asarray(view.values)
    mean = frames[~clocks.missing(frames)].mean(axis=0, dtype=np.float64)
    if not np.all(np.isfinite(mean)):
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': {np.sum(~np.isfinite(mean))} pixels "
            "are not finite. Must be finite in every frame that is not missing."
        )
    mean = median_filter(mean, size=_WITHOUT_BAD_PIXELS)
    spread = mean.std()
    if not spread > 0:
        raise ValueError(
            f"Invalid view in band '{view['band'].item()}': all pixels are alike. Must show an "
            "object."
        )
    return np.asarray((mean - mean.mean()) / spread)


def _transform(first: Array, other: Array, model: str, band: str) -> Array:
    """Homography (3, 3) that takes pixels of the first picture to the other's."""
    matrix, likeness = np.eye(3), 0.0
    steps = [(share * first.shape[0], "affine") for share in _BLURS]
    steps[0] = (steps[0][0], "translation")
    for blur, kind in [*steps, (_FINEST, model)]:
        simpler = MODELS[min(MODELS.index(kind), MODELS.index(model))]
        pair = [gaussian_filter(picture, blur).astype(np.float32) for picture in (first, other)]
        matrix, likeness = _maximise(pair, matrix, simpler, band)
    if not likeness >= _LIKENESS:
        raise ValueError(
            f"Invalid view in band '{band}': its correlation with the first is {likeness:.2f}. "
            f"Must be at least {_LIKENESS}; they do not show the same, or lie too far apart."
        )
    return matrix


def _maximise(
    pair: list[npt.NDArray[np.float32]], start: Array, kind: str, band: str
) -> tuple[Array, float]:
    """Transform of the highest correlation near a start, and that correlation."""
    rows = 3 if kind == "homography" else 2
    given = start[:rows].astype(np.float32)
    everywhere = np.ones(pair[1].shape, dtype=np.uint8)
    try:
        likeness, found = cv2.findTransformECC(
            pair[0], pair[1], given, _MOTIONS[kind], _STOP, everywhere, 1
        )
    except cv2.error as error:
        raise ValueError(
            f"Invalid view in band '{band}': no transform to the first is found ({error.err}). "
            "Must show the same object, not farther apart than a tenth of the image."
        ) from error
    matrix = np.eye(3)
    matrix[:rows] = found
    return matrix / matrix[2, 2], float(likeness)
