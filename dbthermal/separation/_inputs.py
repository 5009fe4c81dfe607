"""Inputs of a separation: the method, a capture and all that is known of it, checked."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from types import NoneType
from typing import Any, Final, get_args

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal import _samples as samples
from dbthermal import noise as noises
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask, stride
from dbthermal.response import Curve
from dbthermal.schema import Status, laid_on, warned
from dbthermal.separation import _quality as quality
from dbthermal.separation._apart import displaced
from dbthermal.separation._apart.displaced import Displacement

Labels = npt.NDArray[np.intp]

BLOCK_ROWS: Final = 32
"""Rows that are read at once: a lazy capture is then decoded about once."""
# Samples of a band in a block of rows, at most: of a long capture it has fewer rows.
_SAMPLES: Final = 2**24

# Pixels from which the noise is estimated, and a clock is judged.
_NOISE_PIXELS, _CLOCK_PIXELS = 4096, 256
_NOISE_SAMPLES: Final = 2**19  # of a band, at most: fewer prove no larger noise than stated
# Deviation from an even clock up to which times are not judged by the signals [mean step].
_NEARLY_EVEN: Final = 1.0
_VARIABLES: Final = ("counts", "status", "segment", "noise_factor", "pattern_std")
_FRAME_PIXELS: Final = 4096  # pixels, about, by which a frame is seen to be measured
_ROUNDING: Final = 1e-6  # negative eigenvalue of a covariance that is rounding [1]


@dataclass(frozen=True)
class Method:
    """A separation method: its functions of a tile, and its demands on the capture.

    Attributes
    ----------
    separate : callable
        A `_tiles.Estimate` of a `_tiles.Tile`, and of the settings where the method has any.
    settings : type, optional
        Frozen dataclass of the method's options; a field `batch` is the pixels of a tile.
    name : str
        Name in errors and in the attribute `method` of a result.
    minimum_frames : int
        Shortest capture.
    knows_emissivity, any_bands, pools : bool
        It needs known emissivities, and estimates none; takes more than two bands; its estimates
        hold a `Survey`, and a covariance of the emissivities.
    whole_image, every_frame : bool
        A tile is the whole image; a pixel that lacks a frame of the others is not solved.
    check_clock : callable, optional
        Refuses times that are not of exposure.
    compiled : bool
        The method is compiled, a pixel at a time.
    not_estimated : tuple of str
        Variables of the result that are NaN everywhere.
    """

    separate: Callable[..., Any]
    settings: type[Any] | None = None
    name: str = "outside"
    minimum_frames: int = 1
    knows_emissivity: bool = False
    whole_image: bool = False
    every_frame: bool = False
    pools: bool = False
    check_clock: Callable[..., None] | None = None
    any_bands: bool = False
    compiled: bool = False
    not_estimated: tuple[str, ...] = ()


@dataclass(frozen=True)
class Inputs:
    """Method, capture, responses, noise and known quantities, in the capture's band order."""

    response: xr.Dataset  # with the noise that is used, for the whole capture and all its parts
    response_kind: str  # "exact" or "linear"
    method: Method
    settings: Any  # of the type that the method has, or None
    seed: int  # of random starts
    capture: xr.Dataset  # counts, where present status and segment, and `mask`; may be lazy
    curves: list[Curve]
    noise: Array  # standard deviation of the linearised signals (band) [K]
    pattern: Array  # deviation of what the correction leaves, constant in time (band) [K]
    bands: list[int]  # places of the bands in the order of their noise
    emissivity: Array | None  # known beforehand (band, y, x) [1]
    emissivity_covariance: Array | None  # (band, band, y, x) [1]
    labels: Labels | None  # material of each pixel, numbered from 0, -1 for none (pixel)
    displacement: Displacement | None  # of the second camera's reflections
    division: npt.NDArray[np.uint8]  # of the time, by the pass before, packed (frame / 8, pixel)
    difference: Callable[[Labels], npt.NDArray[Any]] | None = None  # `joint.Joint`

    @property
    def good(self) -> Mask:
        """Pixels (y, x) of the capture without a flag."""
        return np.asarray(schema.pixel_status(self.capture) == 0)

    @property
    def frames(self) -> Mask:
        """Frames (time) that every band has, seen by some pixels."""
        step = stride(self.capture["counts"].shape[2:], _FRAME_PIXELS)
        measured = schema.measured(self.capture["counts"][:, :, ::step, ::step].values)
        return np.asarray(measured.any(axis=(2, 3)).all(axis=0))

    @property
    def blocks(self) -> list[slice]:
        """Rows that are read at once."""
        height = self.capture.sizes["y"]
        row = self.capture.sizes["time"] * self.capture.sizes["x"]
        fitting = max(1, min(BLOCK_ROWS, _SAMPLES // row))
        rows = height if self.method.whole_image else fitting
        return [slice(top, min(top + rows, height)) for top in range(0, height, rows)]


def check_fields(settings: Any, method: str) -> None:
    """Refuse options of a method that are not of their stated types."""
    for field in fields(settings):
        value, kinds = getattr(settings, field.name), get_args(field.type) or (field.type,)
        integer, real = isinstance(value, int | np.integer), isinstance(value, float | np.floating)
        fits = isinstance(value, kinds) or (value is None and NoneType in kinds)
        if {int, float} & {*kinds} and value is not None:
            fits = (integer or (real and int not in kinds)) and type(value) is not bool
        if not fits:
            names = {int: "a whole number", float: "a number", bool: "a truth value", str: "text"}
            rule = " or ".join(names[kind] for kind in kinds if kind in names)
            raise TypeError(f"Invalid {field.name} {value!r} of method '{method}'. Must be {rule}.")


def check(  # noqa: PLR0913 - all that the user gives, by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: Method,
    *,
    settings: Any = None,
    seed: int = 0,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    emissivity_covariance: xr.DataArray | None = None,
    mask: xr.DataArray | None = None,
    pool: xr.DataArray | None = None,
    reflection_shift: xr.Dataset | None = None,
    response_kind: str = "exact",
) -> Inputs:
    """Check all that the user gives, see `solve`, against the capture and the method's demands."""
    name, settings = method.name, _checked_settings(method, settings)
    schema.check_corrected(corrected)
    _check_flags(corrected)
    bands = [str(band) for band in corrected["band"].values]
    rule = "two or more" if method.any_bands else "exactly two"
    if len(bands) < 2 or (len(bands) > 2 and not method.any_bands):
        raise ValueError(f"Invalid bands {bands} for method '{name}'. Must be {rule}.")
    if (frames := corrected.sizes["time"]) < method.minimum_frames:
        rule = f"Must have at least {method.minimum_frames}."
        raise ValueError(f"Invalid number {frames} of frames for method '{name}'. {rule}")
    if emissivity is not None and not method.knows_emissivity:
        raise ValueError(f"Invalid emissivity for method '{name}', which estimates it. Omit it.")
    if emissivity is None and method.knows_emissivity:
        raise ValueError(f"Missing emissivity= for method '{name}'. Must be stated.")
    curves = responses.curves(response, bands, response_kind)
    if pool is not None and not method.pools:
        raise ValueError(f"Invalid pool for method '{name}', which does not pool.")
    capture = corrected[[variable for variable in _VARIABLES if variable in corrected]]
    if mask is not None:
        dims = ("time",), ("y", "x"), ("time", "y", "x")
        selection = _selection(capture, mask, "mask", "b", *dims)
        capture = capture.assign(mask=selection.drop_vars(list(selection.coords)))
    response, noise = decide_noise(capture, response, curves)
    _check_clock(capture, method, curves, noise)
    stds = emissivity_std, emissivity_covariance
    value, covariance = _known_emissivity(corrected, emissivity, *stds)
    # The quietest camera leads, however resampling or a blur took noise from the others.
    order = np.argsort(noise / schema.noise_factor(capture), kind="stable").tolist()
    return Inputs(
        response=response,
        response_kind=response_kind,
        method=method,
        settings=settings,
        seed=seed,
        capture=capture,
        curves=curves,
        noise=noise,
        pattern=_pattern(capture, curves),
        bands=order,
        emissivity=value,
        emissivity_covariance=covariance,
        labels=None if pool is None else numbered(corrected, pool, "pool"),
        displacement=_displacement(corrected, reflection_shift, method, order[0]),
        division=np.zeros((-(-frames // 8), capture["y"].size * capture["x"].size), np.uint8),
    )


def _checked_settings(method: Method, settings: Any) -> Any:
    """Return the settings of a method, its defaults for None; None for a method without any."""
    kind = method.settings
    if settings is None:
        return None if kind is None else kind()
    if kind is None or type(settings) is not kind:
        rule = "be omitted: it has no settings" if kind is None else f"be {kind.__name__}"
        label = f"Invalid settings of type {type(settings).__name__} for method '{method.name}'"
        raise TypeError(f"{label}. Must {rule}.")
    return settings


def _check_flags(corrected: xr.Dataset) -> None:
    """Check the bits of `status`, and the shutter events before each frame, `segment`."""
    if "status" in corrected:
        unknown = corrected["status"].values.astype(np.int64) & ~sum(Status)
        if np.any(unknown):
            rule = f"Must be of {list(Status.bits())}"
            raise ValueError(f"Unknown bits {int(unknown.max())} in the status. {rule}.")
    if "segment" in corrected:
        segment = corrected["segment"].values.astype(int)
        if np.any(np.diff(segment) < 0):
            raise ValueError("Invalid falling segment. Must be whole numbers that do not fall.")
        events = len(np.unique(segment)) - 1
        if events > segment.size // 4:
            label = f"{events} shutter events in {segment.size} frames"
            raise ValueError(f"Invalid segment: {label}. Must be at most one in four.")


def _selection(
    capture: xr.Dataset, array: xr.DataArray, name: str, kinds: str, *dims: tuple[str, ...]
) -> xr.DataArray:
    """Return a mask or labels of some dims, laid on the capture."""
    schema.require(array, xr.DataArray, name)
    if array.dtype.kind not in kinds:
        rule = "bool" if kinds == "b" else "whole numbers"
        raise TypeError(f"Invalid dtype {array.dtype} of the {name}. Must be {rule}.")
    if array.dims not in dims:
        rule = " or ".join(map(str, dims))
        raise ValueError(f"Invalid dims {array.dims} of the {name}. Must be {rule}.")
    return laid_on(array, capture, f"the {name}", "the capture")


def decide_noise(
    capture: xr.Dataset, response: xr.Dataset, curves: list[Curve]
) -> tuple[xr.Dataset, Array]:
    """Noise (band) [K], and the response with it, for all parts; `noise_source` says of which."""
    names, slopes = [it.band for it in curves], np.array([it.reference_slope for it in curves])
    factor, decided = schema.noise_factor(capture), response.attrs.get("noise_source")
    if "noise_factor" in capture:
        _numbers.real_numbers("noise_factor of the corrected", factor, _numbers.POSITIVE)
    # With a stated noise: that, unless the capture proves more.
    if "noise" in response:
        stated_noise = np.asarray(responses.noise(response, names) / slopes)
        if decided:
            return response, np.asarray(stated_noise * factor)
        pixels = min(_NOISE_PIXELS, _NOISE_SAMPLES // capture.sizes["time"])
        counts = samples.some_pixels(capture["counts"], max(samples.PIXELS, pixels))
        # Counts rounded to steps wider than the noise were rounded after that was measured, or by
        # others: an error of its own, uniform in a step.
        rounding = samples.rounding_std(counts) / slopes
        wide = np.sqrt(12.0) * rounding > stated_noise
        stated = np.asarray(np.hypot(stated_noise, np.where(wide, rounding, 0.0)) * factor)
        valid = schema.measured(counts)
        if not (valid.all(axis=0).any() and capture.get("mask", valid).any()):
            label = f"Invalid samples in all of {counts.shape[2]} pixels, evenly spaced"
            rule = "Must be numbers in all bands, not masked; else flagged invalid_samples"
            response = warned(response, f"{label}. {rule}.")
        signals = np.where(valid, counts, np.nan) / slopes[:, None, None]
        larger = samples.larger_noise(signals, stated)
        if np.isnan(larger).all():
            rounded = "band", stated / factor * slopes, schema.NOISE.attrs
            response = response.sel(band=names).assign(noise=rounded) if wide.any() else response
            return response.assign_attrs(noise_source="response"), stated
        noise = np.where(np.isnan(larger), stated, larger)
        text = " and ".join(
            f"{ratio * level:.3g} K in band '{name}', {ratio:.2g} times the stated {level:.3g} K"
            for name, ratio, level in zip(names, larger / stated, stated, strict=True)
            if ratio > 1.0
        )
        doubt = "is the response of another integration time, or are two bands exchanged?"
        response = warned(response, f"The noise of the capture, which is used, is {text}: {doubt}")
    else:  # estimate it from the capture
        subsample, frames = quality.sample(capture, _NOISE_PIXELS)
        linear = [curve.linearise(band) for curve, band in zip(curves, subsample, strict=True)]
        noise = noises.estimate_bands(linear, capture["time"].values[frames])
    field = "band", noise / factor * slopes, schema.NOISE.attrs
    return response.sel(band=names).assign(noise=field).assign_attrs(noise_source="capture"), noise


def _check_clock(capture: xr.Dataset, method: Method, curves: list[Curve], noise: Array) -> None:
    """Check a clock that is far from even by the signals, for a method that relies on it."""
    time = capture["time"].values.astype(np.float64)
    deviation = np.abs(time - np.linspace(time[0], time[-1], time.size)).max() * (time.size - 1)
    if method.check_clock is None or deviation <= _NEARLY_EVEN * (time[-1] - time[0]):
        return
    counts, frames = quality.sample(capture, _CLOCK_PIXELS)
    if frames.sum() < method.minimum_frames:
        return
    order = np.argsort(noise, kind="stable")
    signals = np.stack([curves[band].linearise(counts[band]) for band in order])
    method.check_clock(signals, time[frames], noise[order], schema.segments(capture)[frames])


def _pattern(capture: xr.Dataset, curves: list[Curve]) -> Array:
    """Deviation (band) [K] of a residual fixed pattern, 0 without a variable `pattern_std`."""
    counts = np.asarray(capture.get("pattern_std", np.zeros(len(curves))), np.float64)
    if not np.all((counts >= 0) & schema.measured(counts)):
        raise ValueError(f"Invalid pattern_std {counts} count. Must be zero or positive, finite.")
    return np.asarray(counts / [curve.reference_slope for curve in curves])


def _known_emissivity(
    corrected: xr.Dataset,
    emissivity: xr.DataArray | None,
    std: xr.DataArray | None,
    covariance: xr.DataArray | None,
) -> tuple[Array, Array] | tuple[None, None]:
    """Emissivity (band, y, x) [1] and its covariance (band, band, y, x), of one pixel or of all."""
    if emissivity is None:
        if std is not None or covariance is not None:
            name = "emissivity_std" if covariance is None else "emissivity_covariance"
            raise ValueError(f"Invalid {name} without an emissivity. Give both.")
        return None, None
    if std is not None and covariance is not None:
        raise ValueError("Invalid emissivity_std beside an emissivity_covariance. Give one.")
    values = _over_image(corrected, emissivity, "emissivity")
    for band, y, x in np.argwhere(~((values > 0) & (values < 1))):
        place = f"in band '{corrected['band'].values[band]}', pixel ({y}, {x})"
        raise ValueError(f"Invalid emissivity {values[band, y, x]} {place}. Must lie in (0, 1).")
    if np.all(values == values[0]):
        rule = "the same in both bands. Must differ; a gray body cannot be separated"
        raise ValueError(f"Invalid emissivities {values[:, 0, 0]}: {rule}.")
    if covariance is not None:
        matrices = _over_image(corrected, covariance, "emissivity_covariance", "other_band")
        least = np.linalg.eigvalsh(np.moveaxis(matrices, (0, 1), (-2, -1))).min()  # of one half
        if not np.all(abs(matrices - matrices.swapaxes(0, 1)) <= _ROUNDING) or least < -_ROUNDING:
            rule = "Must be symmetric and have no negative eigenvalue"
            raise ValueError(f"Invalid emissivity_covariance. {rule}.")
        return values, matrices
    deviations = 0.0 * values if std is None else _over_image(corrected, std, "emissivity_std")
    if not np.all((deviations >= 0) & schema.measured(deviations)):
        raise ValueError("Invalid emissivity_std. Must be zero or positive, and finite.")
    return values, np.eye(len(values))[..., np.newaxis, np.newaxis] * deviations**2


def _over_image(corrected: xr.Dataset, array: xr.DataArray, name: str, *dims: str) -> Array:
    """Values (band, ..., y, x) of an array over the bands, of one pixel or of all."""
    allowed = ("band", *dims), ("band", *dims, "y", "x")
    rule = f"Must be a DataArray of dims {allowed[0]} or {allowed[1]}, such as xr.DataArray("
    rule += f"{[[0.86, 0.04], [0.04, 0.72]] if dims else [0.86, 0.72]}, dims={[*allowed[0]]})"
    if not isinstance(array, xr.DataArray):
        raise TypeError(f"Invalid {name} of type {type(array).__name__}. {rule}.")
    schema.check_numbers(array, name, "1")
    if array.dims not in allowed:
        raise ValueError(f"Invalid dims {array.dims} of {name}. {rule}.")
    array = laid_on(array, corrected, name, "the capture")
    for dim in dims:  # the same bands
        exchanged = array.rename({"band": dim, dim: "band"})
        array = laid_on(exchanged, corrected, name, "the capture")
    values = array.values.astype(np.float64)
    values = values if "y" in array.dims else values[..., np.newaxis, np.newaxis]
    return np.broadcast_to(values, (*values.shape[:-2], *(corrected.sizes[dim] for dim in "yx")))


def _displacement(
    corrected: xr.Dataset, shift: xr.Dataset | None, method: Method, reference: int
) -> Displacement | None:
    """Displacement of the second camera's reflections, for a method that tells them apart."""
    if shift is None:
        return None
    if method.whole_image or "background_temperature" in method.not_estimated:
        label = f"Invalid reflection_shift for method '{method.name}'"
        raise ValueError(f"{label}, which separates no reflection. Omit it.")
    return displaced.check(shift, corrected, reference)


def numbered(corrected: xr.Dataset, pool: xr.DataArray, label: str = "materials") -> Labels:
    """Labels (pixel) of materials, numbered from 0 without gaps, -1 for pixels of none."""
    flat = _selection(corrected, pool, label, "iu", ("y", "x")).values.ravel().astype(np.int64)
    return np.where(flat >= 0, np.searchsorted(np.unique(flat[flat >= 0]), flat), -1)
