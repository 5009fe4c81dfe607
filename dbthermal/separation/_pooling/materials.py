r"""Materials of a capture, found from a first separation, to pool a second one over.

Of one pixel the reflection ratio :math:`k_m = (1-e_m)/(1-e_{ref})` of its material is known to a
few percent only. So the maps propose and the statistics decide:

1. `segmentation` cuts the image into cells, along the edges of the ratio and of the difference of
   the bands' mean signals, in which the object's temperature shows far less than its emissivity.
2. A cell whose ratios scatter more than their deviations allow lies across a border, and is cut.
3. Neighbours whose pooled ratios and emissivities agree are joined, the most alike first
   (`segmentation`), as long as a difference that matters would be seen.
4. A cell whose own ratio is too uncertain, as where nothing moved, joins a neighbour towards which
   the maps have no step.
5. After a first pooling (`joined`), so do regions between which the pixels' own ratios show no
   step: an emissivity may change over a body.

A material is connected: two bodies that do not touch are never pooled, however alike. Wrong
pooling is a bias that no deviation covers, while a body in two parts costs a little noise.
"""

from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import find_objects
from scipy.special import chdtri

from dbthermal import _numbers, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask
from dbthermal.schema import Status, laid_on
from dbthermal.separation._inputs import Labels
from dbthermal.separation._pooling import gradients, segmentation
from dbthermal.separation._pooling.segmentation import Features, Regions
from dbthermal.separation._subspace.reflection_ratio import ratio_variance
from dbthermal.separation._tiles import Material

NONE: Final = -1  # label of pixels that belong to no material: they are pooled with nobody

# Sizes of the cells, and of the cells that a mixed cell is cut into [pixel].
_SPACINGS: Final = (8, 4, 2)
# False-alarm probability of a step [1], not small: a link that is refused in error is made
# elsewhere, but a link that is made in error bleeds.
_STEP_RATE: Final = 0.1
# Probability that two cells without a border are said to hold one [1].
_BORDER_RATE: Final = 0.01
_ERROR_RATE, _RESOLUTION = 0.01, 0.1  # of `materials`, unless others are given
# Step at a border, relative to the change of the reference band's signal, that must be visible
# before its absence counts [1].
_LEAST_STEP: Final = 0.05
# Degree of the smooth function that a step is distinguished from; its coefficients and the step's,
# of which each needs as many pixels; and deviations from which a step is visible.
_CUBIC, _COEFFICIENTS, _PIXELS, _VISIBLE = 3, 11, 3, 3.0
# Standard deviation of the ratio, relative to it, that pooling does not reduce [1]: the parts of
# the object's and the background's curves outside the separator's model.
_TOLERANCE: Final = 0.0025
# Standard deviation of a pixel's ratio, relative to it, beyond which it is left out [1]: neither
# its own distribution nor that of the emissivity is a normal one there.
_VAGUE: Final = 0.3
# Fewest pixels of a material: remainders at a border, which stand out by their errors, have fewer.
_SMALLEST: Final = 16
# Square of the deviations by which a ratio tells two materials apart.
_TELLING: Final = 9.0
_VALUES: Final = ("reflection_ratio", "emissivity", "background_temperature")
_VARIABLES: Final = ("status", *map("".join, product(_VALUES, ("", "_std"))))
_UNUSABLE: Final = Status.INVALID_SAMPLES | Status.CONSTANT_SIGNAL | Status.DEAD_PIXEL


def materials(
    result: xr.Dataset,
    corrected: xr.Dataset,
    response: xr.Dataset,
    *,
    error_rate: float = _ERROR_RATE,
    resolution: float = _RESOLUTION,
    borders: bool = False,
) -> xr.DataArray:
    r"""Label the pixels by material, for `solve(..., pool=labels)`.

    ImportError without scikit-image (extra "materials"), ValueError if a rate is not in (0, 1), a
    variable is missing, or bands, sizes or coordinates differ.

    Two regions are compared by the pooled ratio of each band, an inverse-variance mean, and by the
    emissivity of the reference band. The error of an emissivity is one that neighbours share (the
    background's slow part), so its mean is taken to be no surer than that of one pixel. The
    deviations of the ratios of several bands are taken as independent, and those of pixels, but as
    many as an attribute `pixels` of their deviation says, which share one.

    Borders are found within 2 pixels. A pixel beside another material stays with its own if its own
    ratio tells the two apart, by three standard deviations; else, and where nothing moved and the
    object hardly changed, it belongs to none.

    Parameters
    ----------
    result : Dataset
        From `solve` without labels, of the same capture, by a method with reflection ratios. Pixels
        whose ratio is NaN are labelled by the maps alone.
    corrected, response : Dataset
        As in `solve`. The capture may be lazy; only means over time are kept, of one with a
        `segment` those of the longest.
    error_rate : float
        Probability, in the whole image, that cells of one material are cut or held apart by
        chance [1].
    resolution : float
        Relative difference of the ratio that must be seen before two regions are joined by their
        ratios [1]; materials closer than this may be joined.
    borders : bool
        Keep the pixels beside another material, whatever their own ratio.

    Returns
    -------
    DataArray
        `material` (y, x), int32: connected regions from 0, the largest first, less what at their
        borders may be of the neighbour; -1 for that, for pixels without a signal, for regions in
        which no pixel has a ratio and that no neighbour takes in, or of less than 16 pixels.

    Examples
    --------
    A plate of glass before people who walk by:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import separation, simulation
    >>> rig, rng, time = simulation.Rig(), np.random.default_rng(0), np.arange(100) / 10.0
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(time, (24, 24), glass, rng)
    >>> capture, response = simulation.observe(scene, rig.response(), rng), rig.response()
    >>> alone = separation.solve(capture, response)
    >>> labels = separation.materials(alone, capture, response)
    >>> int(labels.max())
    0
    >>> pooled = separation.solve(capture, response, pool=labels)
    """
    result = _checked(result, corrected, error_rate, resolution)
    if "segment" in corrected:  # means across a shutter event would show the pattern's step
        _, start, count = np.unique(corrected["segment"], return_index=True, return_counts=True)
        frames = slice(start[count.argmax()], (start + count)[count.argmax()])  # it only rises
        corrected, result = corrected.isel(time=frames), result.isel(time=frames)
    bands, noise = _bands(result, response)
    means, variances, change = segmentation.mean_signals(corrected, response, bands, noise)
    (ratios, features), share = _features(result, bands), _sharing(result)
    valid = np.all(np.isfinite(means), axis=0) & (result["status"].values & int(_UNUSABLE) == 0)
    cells = _cells(ratios, means, variances, valid, error_rate)
    regions = Regions(cells, features, error_rate, share)
    pairs = segmentation.neighbours(cells)
    regions.join_alike(pairs, resolution)
    # Pairs whose ratios could not show a difference are compared by what they emit.
    roots = regions.roots()[pairs]
    vague = (roots[:, 0] != roots[:, 1]) & (regions.compare(*roots.T)[1] > resolution)
    mask = np.isin(cells, pairs[vague])
    reflected, reflected_variance = segmentation.reflected_difference(result, bands, mask)
    emitted = means[1:] - means[0] - reflected
    variance = variances[1:] + variances[0] + reflected_variance
    linked, steps = _links(cells, pairs[vague], emitted, variance, change)
    regions.join_in_order(linked, steps)
    regions.join_alike(pairs, resolution)
    labels = _labelled(cells, regions, result)
    return labels if borders else without_borders(labels, result, response)


def without_borders(labels: xr.DataArray, result: xr.Dataset, response: xr.Dataset) -> xr.DataArray:
    """Labels (y, x) without the pixels at a border that may be of the neighbour, or of both."""
    ratios, _ = _features(result, _bands(result, response)[0])
    cells = np.asarray(labels.values + 1, dtype=np.intp)
    numbers = np.arange(cells.max() + 1)[np.newaxis]
    pooled = Regions(cells, ratios, _ERROR_RATE, _sharing(result)).pooled(numbers)
    means, variances, stated = (array[:, 0] for array in pooled)

    def distance(regions: Labels) -> Array:
        """Squares of deviations (y, x) by which pixels' ratios differ from the cells' ratios."""
        total = ratios.variances + variances[:, regions]
        square = np.sum((ratios.values - means[:, regions]) ** 2 / total, axis=0)
        return np.where(np.all(stated[:, regions], axis=0), square, np.nan)

    # Lenses and resampling mix materials within a pixel or two of a border. A pixel stays if its
    # own ratio is its region's, and no neighbour's, by three deviations.
    to_region, stays, padded = (distance(cells), np.ones(cells.shape, dtype=bool), np.pad(cells, 1))
    height, width = cells.shape
    for y, x in product(range(3), repeat=2):
        neighbour = padded[y : y + height, x : x + width]
        differs = (distance(neighbour) > to_region + _TELLING) | ~stated[0, neighbour]
        stays &= (neighbour == cells) | (neighbour == 0) | ((to_region < _TELLING) & differs)
    return labels.where(stays, NONE)


def others(labels: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    """Materials (y, x), and connected pixels without a material as further labels."""
    telling = int(_UNUSABLE | Status.NO_BACKGROUND_MOTION)  # else it would agree with any
    free = (labels.values < 0) & ((result["status"].values & telling) == 0)
    regions = segmentation.connected(free.astype(np.intp)) * free
    regions[np.bincount(regions.ravel())[regions] < _SMALLEST] = 0
    numbers = np.unique(regions, return_inverse=True)[1].reshape(regions.shape)
    return labels.copy(data=np.where(numbers > 0, labels.values.max() + numbers, labels))


def joined(
    labels: xr.DataArray, per_pixel: xr.Dataset, pooled: Material | None, response: xr.Dataset
) -> xr.DataArray:
    """Regions (y, x) joined with regions that they touch, if what was pooled over each agrees."""
    if pooled is None:
        return labels
    cells = np.asarray(labels.values + 1, dtype=np.intp)
    bands, noise = _bands(per_pixel, response)
    variance = ratio_variance(pooled.ratio, pooled.inverse_energy + pooled.spread, noise)
    emissivity = pooled.emissivity, pooled.noise_variance + pooled.drift_variance
    arrays = pooled.ratio[1:], variance[1:], *emissivity
    features = _joint(*(array.reshape(-1, *cells.shape) for array in arrays))
    merged = Regions(cells, replace(features, common=np.ones_like(features.common)), _ERROR_RATE)
    pairs = segmentation.neighbours(cells)
    # A material is cut where ratios of single pixels are biased by what their order leaves of the
    # object; pooled ratios are not.
    merged.join_alike(pairs, _RESOLUTION)
    # A gray or resting region has a ratio, but no emissivity.
    maps, boxes, grown = _features(per_pixel, bands), find_objects(cells), True
    reach = _SPACINGS[0]
    while grown:
        grown = False
        for pair in pairs:
            first, second = (merged.root(cell) for cell in pair)
            if first == second:
                continue
            # Around where the two cells touch.
            sides = zip(*(boxes[cell - 1] for cell in pair), strict=True)
            ends = [(max(a.start, b.start), min(a.stop, b.stop)) for a, b in sides]
            window = tuple(slice(max(0, low - reach), high + reach) for low, high in ends)
            roots = merged.roots()[cells[window]]
            regions = roots == first, roots == second
            ratios, estimates = (array.window(window) for array in maps)
            # Regions without a step are joined too, as where an emissivity changes over a body.
            same = segmentation.alike(*regions, ratios, estimates)
            if same and segmentation.continuous(*regions, estimates, _RESOLUTION, reach):
                merged.join(first, second)
                grown = True
    return _labelled(cells, merged, per_pixel)


def _checked(
    result: xr.Dataset, corrected: xr.Dataset, error_rate: float, resolution: float
) -> xr.Dataset:
    """Result in the capture's order of bands."""
    schema.check_corrected(corrected)
    for name, value in (("error_rate", error_rate), ("resolution", resolution)):
        _numbers.real_number(name, value, _numbers.FRACTION)
    names = [name for name in schema.STAGES["separated"] if name in _VARIABLES or name in result]
    schema.check(result, "separated", names, "the result")
    if "reflection_ratio" in result.attrs.get("not_estimated", "").split():
        label = f"method '{result.attrs.get('method')}', which estimates no reflection ratio"
        raise ValueError(f"Invalid result of {label}. Must be of one that does, as 'subspace'.")
    return laid_on(result, corrected, "the result", "the capture")


def _bands(result: xr.Dataset, response: xr.Dataset) -> tuple[list[int], Array]:
    """Numbers of the bands from the quietest, which is the reference, and their noise [K]."""
    names = [str(name) for name in result["band"].values]
    slopes = [curve.reference_slope for curve in responses.curves(response, names)]
    noise = result["noise"].values / slopes
    bands = [int(band) for band in np.argsort(noise, kind="stable")]
    return bands, noise[bands]


def _sharing(result: xr.Dataset) -> float:
    """Number of pixels that share an error of their ratios, as ratios of blurred bands do."""
    return float(result["reflection_ratio_std"].attrs.get("pixels", 1.0))


def _features(result: xr.Dataset, bands: list[int]) -> tuple[Features, Features]:
    """Ratios of all bands but the reference, without and with the reference's emissivity."""
    ratio, ratio_std, emissivity, emissivity_std = (
        result[name].values[bands].astype(np.float64) for name in _VARIABLES[1:5]
    )
    features = _joint(ratio[1:], ratio_std[1:] ** 2, emissivity[:1], emissivity_std[:1] ** 2)
    return Features(*(array[:-1] for array in vars(features).values())), features


def _joint(ratio: Array, variance: Array, emissivity: Array, of_emissivity: Array) -> Features:
    """Ratios (band, y, x) of all bands but the reference, and its emissivity (1, y, x); if told."""
    vague = ~(variance < (_VAGUE * ratio) ** 2)
    return Features(
        np.where([*vague, np.any(vague, axis=0)], np.nan, np.concatenate([ratio, emissivity])),
        np.concatenate([variance, of_emissivity]),
        np.arange(len(ratio) + 1) == len(ratio),
        np.append(np.full(len(ratio), _TOLERANCE), 0.0),
    )


def _cells(
    ratios: Features, means: Array, variances: Array, valid: Mask, error_rate: float
) -> Labels:
    """Cells (y, x) that are not seen to lie across a border, or are of the smallest size."""
    strength = segmentation.edges(
        np.concatenate([ratios.values, means[1:] - means[0]]),
        np.concatenate([ratios.variances, variances[1:] + variances[0]]),
    )
    cells = segmentation.superpixels(strength, valid, _SPACINGS[0])
    for spacing in _SPACINGS[1:]:
        mixed = segmentation.mixed(cells, ratios, error_rate)[cells]
        finer = cells.max() + segmentation.superpixels(strength, valid, spacing)
        cells = segmentation.connected(np.where(mixed, finer, cells))
    return cells


def _links(
    cells: Labels, pairs: Labels, emitted: Array, variances: Array, change: Array
) -> tuple[Labels, Array]:
    """Pairs of cells without a step between them in the emitted maps, and steps' significances."""
    order = np.argsort(cells, axis=None, kind="stable")
    places = np.split(order, np.cumsum(np.bincount(cells.ravel()))[:-1])  # pixels of each cell
    shape = (len(emitted), -1)
    values, noise = emitted.reshape(shape), variances.reshape(shape)
    steps = np.full(len(pairs), np.inf)
    for index, pair in enumerate(pairs):
        first, second = (places[cell] for cell in pair)
        pixels = np.concatenate([first, second])
        if pixels.size < _PIXELS * _COEFFICIENTS:
            continue
        # A border shows in proportion to the object's change: no step is no proof without a change,
        # nor where more than noise is left: there the border lies elsewhere than between the cells.
        least = _LEAST_STEP * np.abs(np.mean(change.ravel()[pixels]))
        where, second = np.divmod(pixels, cells.shape[1]), np.arange(pixels.size) >= first.size
        variance = np.repeat(noise[:, pixels].mean(axis=1)[:, np.newaxis], pixels.size, axis=1)
        chi2, square, sharpness = gradients.step(where, values[:, pixels], variance, second, _CUBIC)
        smooth = chi2 <= chdtri(pixels.size - _COEFFICIENTS, _BORDER_RATE)
        if np.all(smooth & (least * sharpness >= _VISIBLE)):
            steps[index] = square.sum()
    unbroken = steps < chdtri(len(emitted), _STEP_RATE)
    return pairs[unbroken], steps[unbroken]


def _labelled(cells: Labels, regions: Regions, result: xr.Dataset) -> xr.DataArray:
    """Regions with a ratio, numbered by size."""
    roots = regions.roots()[cells]
    roots[(cells == 0) | ~regions.known()[roots]] = 0
    sizes = np.bincount(roots.ravel())
    sizes[0] = 0
    sizes[sizes < _SMALLEST] = 0
    number = np.full(sizes.size, NONE)
    largest = np.argsort(-sizes, kind="stable")[: np.count_nonzero(sizes)]
    number[largest] = np.arange(largest.size)
    return xr.DataArray(
        number[roots].astype(np.int32),
        dims=("y", "x"),
        coords={dim: result[dim] for dim in ("y", "x") if dim in result.coords},
        name="material",
        attrs={"units": "1", "long_name": "material, -1 for none"},
    )
