"""Knowledge of a scene beside a pixel's own signals, and the completion of pixels with it."""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.special import chdtri

from dbthermal import _numbers, schema
from dbthermal.noise import MAD
from dbthermal.schema import Status, laid_on
from dbthermal.separation import _frames as frames
from dbthermal.separation import _quality as quality
from dbthermal.separation import _windows as windows
from dbthermal.separation._completion import posterior
from dbthermal.separation._completion.posterior import Level, Mixture, Moments
from dbthermal.separation._inputs import Inputs
from dbthermal.separation._tiles import Array, Mask, Tile, Whole, tile_of

FILMS: Final = ("object_temperature", "background_temperature")
MAPS: Final = ("emissivity", "reflection_ratio")
OWN, MATERIAL, PRIOR = range(3)
"""Sources of the emissivities of a pixel."""

# The room, where nobody says how warm it is and no pixel shows it: temperature and deviation [K].
_ROOM: Final = (295.15, 8.0)
# Fluctuation of a background that is not known [K]; least deviations of a level and of it [K].
_FLUCTUATION: Final = 2.0
_FLOORS: Final = (0.2, 0.1)
# Pixels from which the surroundings are estimated, and the residual of a result is judged.
_SAMPLE: Final = 400
_MOST, _FEW = 2**22, 64  # their samples in a band, at most; and fewest pixels of a long capture
# Pixels of a material that tell its emissivity, and how much they differ, at least.
_FEWEST: Final = 4
# Chance by which a pixel tells other emissivities than its material's: of three deviations.
_CHANCE: Final = 0.0027
# Scatter of the logarithms of what pixels face, if all tell it. Gray bodies of 0.7, 0.9 and 0.95
# beside as many measured pixels are completed as 0.66, 0.90 and 0.93 with it, as 0.94 without.
_SCATTER: Final = 0.33
# Residual, in standard deviations of the noise, from which a result is of another capture.
_STRANGE: Final = 8.0
_UNUSABLE: Final = np.uint32(Status.CONSTANT_SIGNAL | Status.DEAD_PIXEL)
# Variance of the median of normal values, relative to that of their mean.
_MEDIAN: Final = np.pi / 2.0
_NOTHING: Final = 1e-9  # precision of a level that a pixel does not show [1/K^2]

Sample = tuple[Tile, Mask, Whole]  # some pixels, their valid samples and their numbers
Values = dict[str, Array]  # completed values of some pixels by their names in the stage `separated`


@dataclass(frozen=True)
class Scene:
    """All that is known of a scene; bands in the order of their noise, pixels of the image flat."""

    inputs: Inputs
    source: Whole  # of the emissivities (pixel)
    emissivity: Array  # measured, in the pixel or in its material (band, pixel) [1]
    covariance: Array  # (band, band, pixel) [1]
    general: Mixture  # prior on the emissivities of any pixel
    offset: Array  # deviation of a pixel's offset against other pixels, of the other bands [K]
    level: Level
    apart: bool  # the cameras do not see the same reflection in a pixel
    measured: Mask  # pixels without a flag (pixel)

    def mixture(self, source: int, places: Whole) -> Mixture:
        """Prior on the emissivities of pixels of one source."""
        if source == PRIOR:
            return self.general.at(np.zeros_like(places))
        value, covariance = self.emissivity[:, places], self.covariance[..., places]
        return Mixture(np.ones(1), value[np.newaxis], covariance[np.newaxis])

    def tile(self, block: xr.Dataset, selected: Mask | slice = slice(None)) -> tuple[Tile, Mask]:
        """Tile of the selected pixels of a part of the capture, and valid samples (time, pixel)."""
        counts, valid, status = quality.read(block, most_missing=1.0)
        valid = (valid & ((status & _UNUSABLE) == 0))[:, selected]
        row = slice(0, 1), slice(0, valid.shape[1])
        tile = tile_of(self.inputs, counts[..., selected], row, slice(None))
        tile.signals[:, ~valid] = 0.0
        return tile, valid

    def sample(self) -> Sample:
        """Tile of evenly spaced pixels, their valid samples, and their numbers in the image."""
        capture = self.inputs.capture
        numbers = np.arange(self.source.size).reshape(capture.sizes["y"], capture.sizes["x"])
        number = min(_SAMPLE, max(_FEW, _MOST // capture.sizes["time"]))
        grid = slice(None, None, max(1, int(np.sqrt(self.source.size / number))))
        return *self.tile(capture.isel(y=grid, x=grid).load()), numbers[grid, grid].ravel()


def gather(inputs: Inputs, result: xr.Dataset, pooled: xr.Dataset, prior: Any) -> Scene:
    """Gather what is known of the emissivities; the background is a room of any temperature."""
    bands = inputs.bands
    value, shared = (_flat(variable["emissivity"])[bands] for variable in (result, pooled))
    covariance, shared_covariance = (_covariance(variable, bands) for variable in (result, pooled))
    sound = np.all((value > 0) & (value < 1) & np.isfinite(covariance).all(axis=0), axis=0)
    source = np.where(sound, OWN, PRIOR)
    labels = np.full(source.size, -1) if inputs.labels is None else inputs.labels
    measured = (pooled["status"].values.ravel() == 0) & np.all((shared > 0) & (shared < 1), axis=0)
    for label in np.unique(labels[measured & (labels >= 0)]):
        places, targets = measured & (labels == label), ~sound & (labels == label)
        if places.sum() < _FEWEST:
            continue
        value[:, targets] = np.median(shared[:, places], axis=-1)[..., np.newaxis]
        # Those of the label that were not pooled tell how much its pixels differ.
        spread = np.median(shared_covariance[..., places], axis=-1) + np.cov(shared[:, places])
        covariance[..., targets] = spread[..., np.newaxis]
        source[targets] = MATERIAL
    names = [str(result["band"].values[band]) for band in bands]
    pattern = inputs.pattern[bands]
    curve = inputs.curves[bands[0]]
    return Scene(
        inputs=inputs,
        source=source,
        emissivity=value,
        covariance=covariance,
        general=Mixture.of_prior(prior, names),
        offset=np.hypot(pattern[1:], pattern[0]),
        level=Level(float(curve.signal(_ROOM[0])) - curve.reference, _ROOM[1], _FLUCTUATION),
        apart=inputs.displacement is not None,
        measured=result["status"].values.ravel() == 0,
    )


def _flat(array: xr.DataArray) -> Array:
    """Values (..., pixel) of maps."""
    return array.values.astype(np.float64).reshape(*array.shape[:-2], -1)


def _covariance(result: xr.Dataset, bands: list[int]) -> Array:
    """Covariance of the emissivities (band, band, pixel), in the order of the bands."""
    if "emissivity_covariance" in result:
        return _flat(result["emissivity_covariance"])[np.ix_(bands, bands)]
    variance = _flat(result["emissivity_std"])[bands] ** 2
    return variance * np.eye(len(bands))[..., np.newaxis]


def require_same_capture(scene: Scene, result: xr.Dataset, sample: Sample) -> None:
    """Refuse a result whose values do not give the capture's signals back, in some pixels."""
    tile, valid, places = sample
    films = [result[name].values.reshape(len(valid), -1)[:, places] for name in FILMS]
    with np.errstate(all="ignore"):
        mixed = tile.mixed(scene.emissivity[:, places], np.array(films, dtype=np.float64))
        score = np.abs(tile.signals - mixed) / np.array(tile.noise)[:, np.newaxis, np.newaxis]
    sound = (result["status"].values.ravel()[places] == 0) & (scene.source[places] == OWN)
    score = score[:, valid & sound & np.isfinite(score).all(axis=0)]
    if score.size and np.median(score) > _STRANGE:
        raise ValueError(
            f"Invalid result: its values are {np.median(score):.0f} times the noise off the "
            "signals of the capture. Must be of the same capture."
        )


def stated(scene: Scene, surroundings: float | xr.DataArray, std: float) -> Level:
    """Level of stated surroundings, of all pixels or of each."""
    prior = schema.check_numbers(xr.DataArray(surroundings), "surroundings", "K")
    if prior.dims not in ((), ("y", "x")):
        raise ValueError(f"Invalid dims {prior.dims} of surroundings. Must be () or ('y', 'x').")
    prior = laid_on(prior, scene.inputs.capture, "surroundings", "the capture")
    values = prior.values.astype(np.float64)
    values = values.ravel() if prior.dims else values
    _numbers.real_numbers("surroundings [K]", values, _numbers.KELVIN)
    curve = scene.inputs.curves[scene.inputs.bands[0]]
    signal = curve.signal(values) - curve.reference
    return Level(signal, std * curve.slope(values), _FLUCTUATION)


def solve_statics(
    scene: Scene, tile: Tile, valid: Mask, source: int, places: Whole
) -> tuple[Moments, Array]:
    """Posterior of what is constant in pixels of one source, and background variance [K^2]."""
    with np.errstate(all="ignore"):
        level = scene.level.at(places)
        means = posterior.bins(tile, valid)
        prior = scene.mixture(source, places)
        # Of cameras apart, what the first band shows of its own background is no emission.
        stray = (1.0 - prior.weight @ prior.mean[:, 0]) * level.fluctuation * scene.apart
        # A change f of it alone bends the others by (1 - e_m) f; at one place by (1 - e_m / e_1) f.
        factor = 1.0 if scene.apart else prior.mean[:, :1]
        bend = np.sqrt(np.tensordot(prior.weight, (1.0 - prior.mean[:, 1:] / factor) ** 2, 1))
        bend = bend * level.fluctuation
        data = posterior.curve(tile, means, scene.offset, stray**2, bend)
        static = posterior.moments(tile, data, prior, level, means.rapid(tile.noise[0]))
        variance = posterior.fluctuation(tile, static, means, level.fluctuation)
    return static, np.maximum(variance, _FLOORS[1] ** 2)


def solve(
    scene: Scene, tile: Tile, valid: Mask, static: Moments, variance: Array, measured: Array
) -> Values:
    """Complete the pixels of a tile, given what is constant in them."""
    with np.errstate(all="ignore"):
        constants = static.point, static.level, variance, static.covariance
        statics = frames.solve(tile, *constants, apart=scene.apart)
        signal, remainder = windows.smooth(statics.signal, statics.white, valid, tile.time)
        background, spread = statics.background, statics.background_variance
        # Measured objects, with their deviations (2, time, pixel) [K], tell the background.
        if (selected := np.isfinite(measured[0]).any(axis=0)).any():
            moments, block = static.select_pixels(selected), tile.select_pixels(selected)
            constants = moments.emissivity, moments.level, variance[selected], moments.covariance
            samples = measured[..., selected], valid[:, selected]
            estimates = frames.background(block, *samples, *constants)
            mask = np.isfinite(estimates).all(axis=0)
            for film, estimate in zip((background, spread), estimates, strict=True):
                film[:, selected] = np.where(mask, estimate, film[:, selected])
        values: Values = {}
        films = (signal, remainder + statics.shared), (background, spread)
        for name, (mean, deviation) in zip(FILMS, films, strict=True):
            pair = frames.temperatures(tile, np.where(valid, mean, np.nan), deviation)
            values[name], values[f"{name}_std"] = pair
        pairs = ((static.emissivity, static.emissivity_covariance), static.reflection_ratio())
        values["emissivity_covariance"] = static.emissivity_covariance
        for name, (mean, covariance) in zip(MAPS, pairs, strict=True):
            values[name] = mean
            values[f"{name}_std"] = np.sqrt(np.einsum("bbp->bp", covariance))
    return values


def contradicted(scene: Scene, static: Moments, places: Whole) -> Mask:
    """Completed pixels that tell other emissivities than their material has, by chi-square."""
    difference = (static.emissivity - scene.emissivity[:, places]).T[..., np.newaxis]
    bands = difference.shape[1]
    covariance = np.moveaxis(scene.covariance[..., places], -1, 0) + _NOTHING * np.eye(bands)
    square = (difference * np.linalg.solve(covariance, difference)).sum(axis=(1, 2))
    return np.asarray(square > chdtri(bands, _CHANCE))


def find_level(scene: Scene, sample: Sample) -> Level:
    """Level of the background over some pixels, from those that show it, beside what is known."""
    tile, valid, places = sample
    sources = np.where(valid.any(axis=0), scene.source[places], -1)
    estimates, counted = [], []
    for source in np.unique(sources[sources >= 0]):
        of_source = sources == source
        # Pixels whose emissivities come from one prior, or from other pixels, share its error:
        # together they count as one pixel.
        counted.append(np.full(of_source.sum(), 1.0 if source == OWN else 1.0 / of_source.sum()))
        block, numbers = (tile.select_pixels(of_source), valid[:, of_source]), places[of_source]
        static, fluctuation = solve_statics(scene, *block, int(source), numbers)
        before = np.square(scene.level.at(numbers).std)
        estimates.append([static.level, static.covariance[-1, -1], before, fluctuation])
        if source != OWN:
            continue
        # Rapid changes that measured pixels mirror: few such pixels say little of other pixels.
        std = posterior.bins(*block).rapid(tile.noise[0]) / (1.0 - scene.emissivity[0, numbers])
        if (std := std[scene.measured[numbers] & np.isfinite(std)]).size:
            scatter = _SCATTER / float(np.sqrt(scene.measured.mean()))
            level = replace(scene.level, rapid=float(np.median(std)), scatter=scatter)
            scene = replace(scene, level=level)
    if not estimates:
        return scene.level
    mean, after, before, fluctuation = np.concatenate(estimates, axis=1)
    # The mean: a completed pixel may face any fluctuation; most of a scene may be at rest.
    level = replace(scene.level, fluctuation=max(float(np.sqrt(np.mean(fluctuation))), _FLOORS[1]))
    # A posterior of precision 1 / after holds the prior's 1 / before.
    variance = 1.0 / np.maximum(1.0 / after - 1.0 / before, _NOTHING)
    room, wide = float(np.mean(scene.level.signal)), float(np.mean(np.square(scene.level.std)))
    with np.errstate(over="ignore"):  # of pixels that tell nothing
        value = room + (mean - room) * variance / after
    mask = np.isfinite(value) & (variance < before)
    if not np.any(mask):
        return level
    value, variance, pixels = value[mask], variance[mask], np.concatenate(counted)[mask]
    # Weighted median, and the scatter that variances do not explain: how much pixels differ.
    weight = pixels / (variance + np.median(variance))
    middle = float(np.quantile(value, 0.5, weights=weight, method="inverted_cdf"))
    scatter = (MAD * float(np.median(np.abs(value - middle)))) ** 2
    between = max(scatter - float(np.median(variance)), 0.0)
    levels = between + _MEDIAN / float(np.sum(pixels / variance)) + _FLOORS[0] ** 2
    signal = (middle * wide + room * levels) / (wide + levels)
    return replace(level, signal=signal, std=float(np.sqrt(levels * wide / (levels + wide))))
