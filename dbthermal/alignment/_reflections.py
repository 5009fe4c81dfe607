"""Shift between the reflections that two cameras side by side see in one surface."""

from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import distance_transform_edt, gaussian_filter

from dbthermal import schema
from dbthermal._arrays import Array, Mask, quotient, without_blas_threads
from dbthermal.alignment import _matching as matching
from dbthermal.alignment import _planes as planes
from dbthermal.alignment._matching import Movies
from dbthermal.alignment._planes import Capture, Scale
from dbthermal.alignment._splines import Field, Information, Movie, Spline, binned

_COARSE: Final = 28  # pixels along the shorter side of the coarsest image, at least
# Periods [frame] of which slower changes are left out. A longer one is taken whose field has so
# many times smaller deviations where the shorter one is known.
_PERIODS: Final = (5.0, 10.0, 20.0, 80.0)
_IMPROVEMENT: Final = 1.25
_PRECISION: Final = 0.2  # largest deviation of a shift by the data of a window alone [pixel]
_WINDOW: Final = 6.0  # deviation of the window in which a field and its data are compared [pixel]
_RIDGE: Final = 1e-6  # of the largest information, added for windows without any
# Shift from which the cameras see reflections apart: in standard deviations, and in pixels.
_SIGMAS, _LEAST_SHIFT = 3.0, 0.1
# Share of what no shift leaves that a shift must explain: seen 0.13 or more; below 0.06 of clouds
# and heat. And share of all: 0.0013 of clouds without texture, 0.0035 to 0.027 of lamps.
_EXPLAINED, _LEAST_GAIN = 0.1, 0.0025
_EXTENT: Final = 0.125  # of the image's smaller side, by which a field is extrapolated


def reflection_shift(corrected: xr.Dataset, response: xr.Dataset) -> xr.Dataset:
    r"""Displacement between the reflections that two cameras side by side see in one surface.

    A registration of the object's surface does not register what that surface mirrors. What the
    other bands show at p, the reference band, the quietest, shows at p + d(p):

    .. math:: h_m(p, t) = k_m(p) h_1(p + d(p), t)

    with h the rapid changes of a band, which are the reflection's, and k a ratio of the material.
    The reflection's own texture tells d, along the baseline mostly: upright bodies have little
    texture along them, and that component is smooth, with a large deviation, and does no harm.
    It is needed where `separation.solve` flags `bands_apart` and there is no offset in time; where
    the cameras see from one place the shift is zero within its deviation.

    TypeError or ValueError if an input is not as described, the image is too small, nothing that
    both bands see changes rapidly, or the shift is beyond a third of the image.

    Parameters
    ----------
    corrected : Dataset
        Stage `corrected` of `schema`, registered on the object's surface, all bands but the
        quietest by cameras at one place. Missing frames and samples are NaN; `status` and `segment`
        are respected. It may be lazy: it is read twice, in blocks of rows.
    response : Dataset
        Stage `response` of `schema`.

    Returns
    -------
    Dataset
        Stage `reflection_shift` of `schema`: `shift` (axis, y, x) [pixel], rows down and columns to
        the right, `shift_std`, and `known` (y, x), where texture tells the shift. It is
        extrapolated near by, and NaN farther off and where p + d(p) leaves the image. Attributes:
        `reference_band`, `bands` (the others); `delay` [s] of these, beside the shift, and
        `delay_std` [s]; `explained`, the share of their changes' energy [1].
    """
    names = [str(name) for name in schema.check_corrected(corrected)["counts"]["band"].values]
    return shift_of(corrected, Scale.of_response(response, names))


@without_blas_threads  # on any number of cores the same field
def shift_of(corrected: xr.Dataset, scale: Scale) -> xr.Dataset:
    """Displacement as `reflection_shift`, from coarse to fine."""
    capture = Capture.of(corrected, scale)
    shape = capture.valid.shape
    spline = Spline((shape[0], shape[1]), max(shape) / 3.0)
    factor = 2 ** max(0, int(np.log2(min(shape) / _COARSE)))
    capture, functions, white, field = _coarse(capture, spline, factor)
    movies, power = capture.planes(functions), np.sum(functions**2, axis=0)

    def level(factor: int) -> Movies:
        """Movies of coarser pixels."""
        pictures = [binned(movie, factor) for movie in movies]
        return Movies.blurred(pictures, capture.valid, capture.noise, power, factor, white)

    # From coarser pixels to those of the capture.
    while factor > 2:
        factor //= 2
        field, _ = matching.refine(level(factor), field, rough=False)
    fine = level(1)
    field, data = matching.refine(fine, field, rough=False)
    spread = _variances(field, fine, data)
    # Matrix that takes planes to those of their rate of change, by least squares.
    times = corrected["time"].values[capture.frames]
    change = np.asarray(np.gradient(np.eye(times.size), times, axis=0)).T @ functions
    rate = np.linalg.lstsq(functions, change)[0].astype(np.float32)
    place = field.on(fine.centres())
    misfits = matching.misfits_of(fine, place)
    late, std, energy = matching.delay(fine, rate, place, misfits)
    # A shift that explains little of what no shift leaves is not that of the reflections.
    still = matching.delay(fine, rate, np.zeros_like(place), misfits)[2]
    sums = np.sum([energy, still], axis=(2, 3), where=energy[1] * still[1] != 0.0)
    moved, unmoved = 1.0 - quotient(sums[:, 0], sums[:, 1], 1.0)
    if not unmoved - max(moved, 0.0) > max(_EXPLAINED * unmoved, _LEAST_GAIN):
        spread = np.maximum(spread, place**2)
    result = _result(corrected, capture, field, data, spread)
    return result.assign_attrs(delay=late, delay_std=std, explained=1.0 - float(moved))


def seen_apart(field: xr.Dataset) -> bool:
    """Say that the cameras stand apart: along an axis their shift is more than its deviation."""
    sizes = abs(field[["shift", "shift_std"]]).where(field["known"]).median(("y", "x"))
    return bool(np.any(sizes["shift"] > np.maximum(_SIGMAS * sizes["shift_std"], _LEAST_SHIFT)))


def _coarse(capture: Capture, spline: Spline, factor: int) -> tuple[Capture, Movie, float, Field]:
    """Capture with its valid pixels, functions of the best period, noise in them, rough field."""
    signals, valid = capture.binned(factor)
    frames, refusal, result = capture.frames.size, None, None
    # Of the field that was taken: the pixels that its data resolve, and its deviations.
    earlier, sizes = np.zeros((1, 1), bool), np.zeros((1, 1))
    for period in _PERIODS:
        if frames < 2 * period and result is not None:
            break
        functions = capture.functions(signals[0], period)
        white, power = planes.white(frames, period), np.sum(functions**2, axis=0)
        pictures = [signal @ functions for signal in signals]
        level = Movies.blurred(pictures, valid, capture.noise, power, factor, white)
        begin = None if result is None else result[-1]
        if begin is None:
            try:
                begin = matching.start(level, pictures, spline)
            except ValueError as error:  # slower changes may tell more
                refusal = error
        if begin is None:
            continue
        field, data = matching.refine(level, begin, rough=True)
        resolved = _resolved(data, factor)
        size = 0.25 * np.log(_variances(field, level, data)).sum(axis=0)
        gain = np.inf if result is None else np.mean((sizes - size)[earlier])
        if resolved.any() and gain > np.log(_IMPROVEMENT):
            earlier, sizes = resolved, size
            result = (replace(capture, valid=valid), functions, white, field)
    if result is None:
        raise refusal or ValueError(
            "Missing texture in the reflections: no rapid change that the bands share. "
            "Must be seen in both to find their shift; let somebody walk by."
        )
    return result


def _resolved(data: Information, factor: int = 1) -> Mask:
    """Pixels (y, x) where the data of a window alone tell the shift in one direction."""
    area = 4.0 * np.pi * (matching.WINDOW * factor) ** 2
    return np.asarray(area * matching.eigenvalues(data.tensor)[0] > 1.0 / _PRECISION**2)


def _variances(field: Field, level: Movies, data: Information) -> Array:
    """Variance (2, y, x) [pixel^2] of a field, larger where windows ask for steps beyond noise."""
    # Squares of the steps that windows ask for, over their variances.
    area = 4.0 * np.pi * (matching.WINDOW * level.factor) ** 2
    tensor = np.moveaxis(area * data.tensor[[[0, 1], [1, 2]]], (0, 1), (-2, -1))
    inverse = np.linalg.inv(tensor + _RIDGE * max(tensor.max(), 1.0) * np.eye(2))
    steps = np.einsum("yxij,jyx->iyx", inverse, area * data.gradient)
    squares = steps**2 / np.moveaxis(np.diagonal(inverse, axis1=2, axis2=3), 2, 0)
    # Their mean around each pixel, where windows resolve the shift.
    resolved = _resolved(data, level.factor)
    blur = partial(gaussian_filter, sigma=_WINDOW / level.factor, axes=(-2, -1))
    # Reduced chi-square, above 1 where the field is smoother than the reflection.
    chi = np.maximum(blur(squares * resolved) / np.maximum(blur(resolved * 1.0), 1e-9), 1.0)
    return np.asarray(chi * field.variances(level.centres()))


def _result(
    corrected: xr.Dataset, capture: Capture, field: Field, data: Information, variance: Array
) -> xr.Dataset:
    """Field as a dataset, NaN far from where it is known."""
    shape = capture.valid.shape
    centres = [np.arange(size, dtype=np.float64) for size in shape]
    shift = field.on(centres)
    reached = matching.on_valid(np.indices(shape) + shift, np.ones(shape, dtype=bool))
    measured = _resolved(data) & reached
    distance = np.asarray(distance_transform_edt(~measured))
    region = (distance <= _EXTENT * min(shape)) & reached & measured.any()
    # Away from known pixels the field may change as much as it does in known pixels.
    slopes = np.square(np.gradient(shift, axis=(1, 2))).sum(axis=0)[:, measured]
    growth = np.multiply.outer(slopes.sum(axis=1) / max(1, measured.sum()), distance**2)
    std = np.sqrt(np.maximum(variance, 0.0) + growth)
    names = [str(name) for name in corrected["band"].values[capture.bands]]
    values = {
        "shift": np.where(region, shift, np.nan).astype(np.float32),
        "shift_std": np.where(region, std, np.nan).astype(np.float32),
        "known": measured,
    }
    places = {name: corrected[name] for name in ("y", "x") if name in corrected.coords}
    result = xr.Dataset(
        schema.variables("reflection_shift", values),
        coords={"axis": ["y", "x"], **places},
        attrs={**corrected.attrs, "reference_band": names[0], "bands": names[1:]},
    )
    return schema.check(result, "reflection_shift")
