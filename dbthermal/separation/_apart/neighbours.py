r"""Reflection ratios and emissivities steadied by neighbouring pixels, of cameras side by side.

Paired by the shift of the reflections, the bands differ by what a shift cannot undo: the blur of
lenses and of resampling, which a curved mirror stretches in each camera by another amount, a shift
that changes faster than its field, bodies at several depths. All of it makes the changes of one
band smaller at the edges of what is mirrored, and its reflection ratio with them, by several per
cent, which a pixel's own residual does not show. So the ratios are those of bands that are blurred
alike, in which the edges count little; and as certain as neighbours agree on them.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import convolve, gaussian_filter, map_coordinates, maximum_filter, minimum_filter
from scipy.special import chdtri, stdtrit

from dbthermal._arrays import Array
from dbthermal._samples import neighbour_mean
from dbthermal.schema import Status
from dbthermal.separation._apart import equations as system
from dbthermal.separation._apart.equations import Floats
from dbthermal.separation._apart.planes import TAIL, Planes, Scatters
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._pooling import pool
from dbthermal.separation._pooling.pool import Image
from dbthermal.separation._quality import Bits
from dbthermal.separation._subspace.bars import NORMAL95
from dbthermal.separation._subspace.reflection_ratio import energy_of_variance, principal_ratio
from dbthermal.separation._tiles import BROKEN, LOW, SPANS, Mask, Material, Survey

BLUR: Final = 1.0
"""Deviation of the blur of the bands whose ratios are compared [pixel]."""

SHARING: Final = 4.0 * np.pi * BLUR**2
"""Pixels that share an error of such a ratio: the inverse sum of the blur's squared weights."""

BLURS: Final = (0.0, BLUR, 2.0 * BLUR)
"""Deviations of the blurs of a material, rising [pixel]."""

# Deviation of the neighbourhood in which ratios are compared: that of a field and its data [pixel].
_SPAN: Final = 6.0
# Windows along the image's smaller side, and how many of a material have a jackknife.
_ALONG, _FEWEST = 4, 3
# Chance that a blur changes the ratio of a pixel inside a material so much [1], and how many pixels
# lie so side by side at a border: at 6e-5 half of those there were missed, 0.1 to 0.5 K off.
_MIXED, _CLUSTER = 0.01, 3
# Share of a neighbourhood that tells the ratio of a pixel which does not, at least [1].
_SOME: Final = 0.1
# Deviation of the neighbourhood that tells an emissivity, over the image's smaller side.
_NEIGHBOURHOOD: Final = 0.125


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def ratios(inputs: Inputs, planes: Planes, status: Bits) -> Material:
    """Ratios (band, pixel) of bands blurred alike, as those of each pixel's own material."""
    noise, shape = inputs.noise[inputs.bands], (len(inputs.bands), *status.shape)
    blurred, sharp = planes.scatters(BLUR), planes.scatters(0.0)
    ratio, border = (scatters.ratio.reshape(shape) for scatters in (blurred, sharp))
    variance = blurred.variance(blurred.ratio).reshape(shape)
    of_border = sharp.variance(sharp.ratio).reshape(shape)
    moving = planes.usable & ((status & np.uint32(Status.NO_BACKGROUND_MOTION)) == 0)
    # At a border the blur changes the ratio by more than chance, and than it does around.
    change = ((border - ratio) ** 2 / of_border)[1:].mean(axis=0)
    usual = np.maximum(_median(change, np.isfinite(change) * 1.0) / chdtri(1, 0.5), 1.0)
    mixed = moving & (change > usual * chdtri(1, _MIXED)) & ~sharp.apart.reshape(status.shape)
    mixed &= convolve(mixed * 1, np.ones((3, 3)), mode="constant") >= _CLUSTER
    sound = moving & ~mixed & ~blurred.apart.reshape(status.shape)
    sound &= np.all(np.isfinite(variance), axis=0)
    if inputs.difference is not None:  # else flags of the object say nothing
        sound &= (status & ~np.uint32(Status.CONSTANT_OBJECT)) == 0
    # The median around, the chi-square about it, and the variance.
    weight = np.divide(1.0, variance, out=np.zeros(shape), where=sound & (variance > 0))
    weight[0] = sound
    middle = np.stack([_median(*band) for band in zip(ratio, weight, strict=True)])
    square = (ratio - middle) ** 2
    chi = neighbour_mean((square * weight)[1:].mean(axis=0), sound, _SPAN)
    between = neighbour_mean(square, weight, _SPAN)
    # At a border, where a blur mixes two materials, the sharp bands' ratio; where the model does
    # not hold, the median around, with the variance of the ratios around beside it.
    cases = [mixed, sound, moving & (gaussian_filter(sound * 1.0, _SPAN, mode="constant") > _SOME)]
    ratio = np.select(cases, [border, ratio, middle], np.nan)
    variance = np.select(cases, [of_border * usual, variance * np.maximum(chi, 1.0), between])
    ratio, variance = (values.reshape(len(noise), -1) for values in (ratio, variance))
    return Material.of_ratios(ratio, energy_of_variance(ratio, variance, noise).mean(axis=0))


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def materials(
    inputs: Inputs,
    scatters: dict[float, Scatters],
    per_pixel: xr.Dataset,
    pooled: Callable[..., Material | None],
) -> Material | None:
    """Ratios and emissivity as of `pool.materials`, the ratios of bands that are blurred alike."""
    assert inputs.labels is not None
    noise, shape = inputs.noise[inputs.bands], per_pixel["status"].shape
    labels, material, sharp = inputs.labels.reshape(shape), None, None
    between = np.zeros(inputs.labels.size)
    for blur, scatter in scatters.items():
        size = 1 + 2 * int(np.ceil(TAIL * blur))
        # Pixels that no neighbour's blur reaches.
        inner = minimum_filter(labels, size) == maximum_filter(labels, size)
        selected = pool.select(np.where(inner.ravel() & scatter.usable, inputs.labels, -1))
        places = np.flatnonzero(selected)
        if places.size:  # else all materials are too narrow
            image = Image(inputs.labels, places, shape[1])
            survey = _survey(scatter, per_pixel, noise, places)
            wider = pool.estimate(image, inputs.labels[places], survey, noise)
            variance = image.expand(_between_windows(image, survey, noise, shape))
            between = np.where(np.isfinite(variance), variance, between)
            # What differs between windows has the noise in it.
            wider = replace(wider, inverse_energy=np.maximum(wider.inverse_energy, between))
            sharp = wider if sharp is None else sharp
            material = wider if material is None else _blurred(sharp, material, wider, noise)
    if material is None:
        return None
    # A pixel's own ratio is that of bands blurred differently: it does not make this more certain.
    variance = material.inverse_energy + material.spread
    material = replace(material, inverse_energy=variance, spread=np.zeros_like(variance))
    return pooled(inputs, stated=material)


def _survey(
    scatters: Scatters, per_pixel: xr.Dataset, noise: Array, places: npt.NDArray[np.intp]
) -> Survey:
    """Survey of some pixels by their planes, without scatter where the model is not sound."""
    status, scatters = per_pixel["status"].values.ravel()[places], scatters.select_pixels(places)
    emissivity = per_pixel["emissivity"].sel(band=per_pixel.attrs["reference_band"]).values
    value = np.where((status & ~LOW) == 0, emissivity.ravel()[places], np.nan)
    sound = ((status & BROKEN) == 0) & ~scatters.apart
    scale = scatters.noise / noise[:, np.newaxis]  # whitened by the noise of samples
    scatter = np.where(sound, scatters.scatter * scale * scale[:, np.newaxis], 0.0)
    frames = np.where(sound, scatters.freedom, 0.0)
    return Survey(
        scatter=np.stack([scatter] * 3),
        frames=np.stack([frames] * 3),
        ratio=scatters.ratio,
        null_weights=np.zeros((len(noise), places.size)),
        emissivity=value,
        noise_variance=np.ones(places.size),
        drift_variance=np.zeros(places.size),
        influence=np.zeros((SPANS, places.size)),
    )


def _between_windows(image: Image, survey: Survey, noise: Array, shape: tuple[int, ...]) -> Array:
    """Variance (material) [1/K^2] of ratios by the jackknife over windows; NaN of few windows."""
    # A window is wider than the nodes of the shift's field, whose errors its pixels share.
    side = -(-min(shape) // _ALONG)
    row, column = np.divmod(image.surveyed, shape[1])
    labels, windows = image.labels[image.surveyed], row // side * shape[1] + column // side
    result = np.full(int(image.labels.max()) + 1, np.nan)
    for label in np.unique(labels):
        pixels = np.flatnonzero(labels == label)
        cells, number = np.unique(windows[pixels], return_inverse=True)
        if cells.size < _FEWEST:
            continue
        scatters = np.zeros((cells.size, len(noise), len(noise)))
        np.add.at(scatters, number, np.moveaxis(survey.scatter[0][..., pixels], -1, 0))
        ratio = principal_ratio(scatters.sum(axis=0) - scatters, noise)
        variance = (cells.size - 1) * ratio.var(axis=1, keepdims=True)
        # For few windows widened as the interval of 95 % is, by Student's t.
        widened = (stdtrit(cells.size - 1, 0.975) / NORMAL95) ** 2
        inverse = energy_of_variance(ratio.mean(axis=1, keepdims=True), variance, noise)
        result[label] = widened * inverse.max()
    return result


def _blurred(sharp: Material, base: Material, blur: Material, noise: Array) -> Material:
    """Materials with the ratios at more blur, and what the blurs have changed as a variance."""
    wide = np.isfinite(blur.ratio[-1])
    measured = wide & np.isfinite(base.ratio[-1])
    step, total = (np.abs(blur.ratio / before.ratio - 1.0) for before in (base, sharp))
    # The last blur's change, or half of the whole, may be as much again beyond: of two simulated
    # vessels 94 and 95 % of the intervals hold so, 90 and 94 % by the last change alone; by the
    # whole, with 1.2 times the error, 94 and 95 %.
    change = np.fmax(step, 0.5 * total)
    # A material too narrow for a blur has the median change of the others.
    usual = np.median(change[:, measured], axis=1, keepdims=True) if measured.any() else 0.0
    ratio = np.where(wide, blur.ratio, base.ratio)
    off = energy_of_variance(ratio, (np.where(measured, change, usual) * ratio) ** 2, noise)
    inverse = np.where(wide, blur.inverse_energy, base.inverse_energy) + off.max(axis=0)
    spread = np.where(wide, blur.spread, base.spread)
    return replace(base, ratio=ratio, inverse_energy=inverse, spread=spread)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def emissivities(inputs: Inputs, result: xr.Dataset) -> tuple[Floats, Floats]:
    """Emissivities (band, pixel) [1] that lean on neighbours', and the first band's variance."""
    raw, reference = system.first_emissivity(inputs, result), inputs.bands[0]
    variance = result["emissivity_std"].values[reference].ravel().astype(np.float64) ** 2
    sound = (result["status"].values.ravel() == 0) & (variance > 0)
    first, variance = shared(raw[0], variance, sound, result["status"].shape)
    return system.inside(1.0 - system.ratio_of(raw) * (1.0 - first)), variance


def shared(
    value: Floats, variance: Floats, sound: Mask, shape: tuple[int, ...]
) -> tuple[Floats, Floats]:
    """Values (pixel) [1] that lean on their neighbours, more if less certain; and variances."""
    value, variance = (values.reshape(shape) for values in (value, variance))
    sound = sound.reshape(shape)
    weight = np.divide(1.0, variance, out=np.zeros(shape), where=sound)
    square = (value - _median(value, weight)) ** 2 * weight
    # About the median around: a slow change of what is mirrored is no noise.
    chi = np.maximum(_median(square, weight) / chdtri(1, 0.5), 1.0)
    weight, wide = weight / chi, _NEIGHBOURHOOD * min(shape)
    mean = neighbour_mean(value, weight, wide)
    mean = np.where(np.isfinite(mean), mean, value)
    # Normal prior of the neighbourhood's mean and variance. Leaning does not lessen a variance:
    # neighbours share such errors. An unknown value takes the neighbourhood's variance.
    prior = np.nan_to_num(neighbour_mean((value - mean) ** 2, weight, wide))
    variance = np.where(sound, variance * chi, np.where(prior > 0, prior, variance))
    return ((prior * weight * value + mean) / (prior * weight + 1.0)).ravel(), variance.ravel()


def _median(values: Floats, weight: Floats) -> Floats:
    """Median (y, x) of the pixels around; pixels without weight count as the mean around."""
    filled = np.where(weight > 0, values, np.nan_to_num(neighbour_mean(values, weight, _SPAN)))
    reach = round(_SPAN)
    # At every few pixels, then interpolated: it changes as slowly as its window is wide.
    stride = max(1, reach // 2)
    padded = np.pad(filled, reach, mode="edge")
    windows = sliding_window_view(padded, (1 + 2 * reach, 1 + 2 * reach))[::stride, ::stride]
    coarse = np.median(windows.reshape(*windows.shape[:2], -1), axis=2)
    place = np.indices(filled.shape) / stride
    return np.asarray(map_coordinates(coarse, place, order=1, mode="nearest"))
