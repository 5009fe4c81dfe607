"""Completion of a result: a temperature with its deviation at every pixel that both cameras see."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal._arrays import empty, release, without_blas_threads
from dbthermal._compiled import compiled
from dbthermal.schema import Status, laid_on
from dbthermal.separation import _quality as quality
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._budget import added, without_calibration
from dbthermal.separation._completion import posterior
from dbthermal.separation._completion import scene as scenes
from dbthermal.separation._completion.scene import FILMS, MAPS, Scene, Values
from dbthermal.separation._frames import bridge
from dbthermal.separation._inputs import Method, check
from dbthermal.separation._solve import require_whole, solve
from dbthermal.separation._tiles import Array, Mask, Tile, Whole

_BITS: Final = {
    scenes.MATERIAL: Status.COMPLETED_FROM_MATERIAL | Status.COMPLETED_FROM_SURROUNDINGS,
    scenes.PRIOR: Status.COMPLETED_FROM_PRIOR | Status.COMPLETED_FROM_SURROUNDINGS,
}
_SPREAD: Final = (1e-3, 1e3)  # deviation of surroundings that are stated [K]
_METHOD: Final = Method(posterior.moments, name="complete", any_bands=True, pools=True)


def complete(  # noqa: PLR0913 - all that is known beside the capture, by name
    result: xr.Dataset,
    corrected: xr.Dataset,
    response: xr.Dataset,
    materials: xr.DataArray | None = None,
    surroundings: float | xr.DataArray | None = None,
    prior: str | xr.DataArray | xr.Dataset | None = None,
    *,
    surroundings_std: float = 2.0,
    reflection_shift: xr.Dataset | None = None,
    workers: int = 2,
) -> xr.Dataset:
    r"""Complete a result: a temperature with its deviation wherever both cameras have data.

    Where a pixel has no value of its own, the posterior of the image formation (`mixing`) is taken
    with a prior on what the pixel cannot tell: its emissivities e, and the level c of its
    background, about which that fluctuates by f. No prior is set on the object's temperature x
    (Gelman et al. 2013, Bayesian Data Analysis, 3rd edition, doi:10.1201/b16018).

    .. math:: p(x, e, c, f \mid z) \propto p(z \mid x, e, c, f) \, p(e) \, p(c) \, p(f)

    The emissivities are those of the pixel, where measured; else those of its material elsewhere,
    if the pixel does not contradict them by three deviations; else of the `prior`, of which the
    library's lose those that would mirror less of the background's rapid changes than the pixel
    shows. Near black, the result tends to the camera's own reading.

    The deviations hold the uncertainty of the model: noise is averaged over time as far as the
    curve allows, the errors of emissivities and level are not. An error of a prior is shared by all
    pixels that it completes.

    TypeError or ValueError if an argument is not as described, an emissivity of the prior lies
    outside (0, 1), the surroundings are not from 150 to 3000 K, as in degrees Celsius or in counts,
    the result is of another capture, or no library has the bands, without a prior.

    Parameters
    ----------
    result : Dataset
        From `solve` by a method with standard deviations, of the same capture.
    corrected, response : Dataset
        As in `solve`. The capture may be lazy.
    materials : DataArray, optional
        Labels (y, x), as from `materials`: pixels of one label have one material; -1 for none.
    surroundings : float or DataArray, optional
        Temperature of what is reflected [K], () or (y, x). If not given, it is estimated from the
        pixels that show it, beside a room of 295 K that is uncertain by 8 K.
    prior : str, DataArray or Dataset, optional
        Emissivities where no others are known: the name of a material of
        `emissivity.embedded_table`, or emissivities (band) [1] in (0, 1), both with a deviation of
        0.02 between samples of a material, or a Dataset of `emissivity` and `emissivity_std`
        (band) [1]. If not given, `emissivity.library_mixture` of the bands.
    surroundings_std : float
        Standard deviation of the surroundings that are stated [K].
    reflection_shift : Dataset, optional
        As in `solve`, where the result was made with one: the cameras stand apart.
    workers : int
        Number of threads.

    Returns
    -------
    Dataset
        The variables of the result, and its values bit for bit where it has any; `status` has the
        bits ``completed_from_material`` or ``completed_from_prior``, and
        ``completed_from_surroundings``, where others were added, and ``completed_frames`` where
        15 % of a pixel's frames or more were. Values stay NaN at bad pixels and constant signals,
        and in frames of which no pixel has data of all bands (attribute `frames_missing`, their
        number); a sample that a pixel alone lacks is bridged from those around it: `bridged`
        (time, y, x) says which, and leaves no bit (`frames_bridged`, their mean number).
        Attributes `surroundings`, `surroundings_std` [K], `surroundings_source` ("assumed": 22 C).

    Examples
    --------
    A plate of glass that nothing moves before, so that `solve` tells nothing:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import separation, simulation
    >>> rig, rng, time = simulation.Rig(), np.random.default_rng(1), np.arange(100) / 10
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> warm = simulation.heating(time, 293.15, 333.15, 10.0)[:, None, None] * np.ones((4, 6))
    >>> scene = simulation.scene(time, warm, np.full_like(warm, 295.15), glass)
    >>> capture = simulation.observe(scene, rig.response(), rng)
    >>> alone = separation.solve(capture, rig.response())
    >>> whole = complete(alone, capture, rig.response(), prior="plate window glass")
    >>> error = abs(whole["object_temperature"] - scene["object_temperature"])
    >>> int(alone["object_temperature"].count()), bool(error.max() < 2.0)  # K
    (0, True)
    """
    require_whole("number of workers", workers, 1)
    scope = Beside(materials, surroundings, prior, surroundings_std, reflection_shift)
    before = _checked(result, corrected)
    completed = without_calibration(before).copy(deep=True)
    completed = filled(completed, corrected, response, scope, workers)
    for name in FILMS:  # what was measured keeps its bits
        old, new = before[f"{name}_std"].values, completed[f"{name}_std"].values
        np.copyto(new, old, where=np.isfinite(old))
    return completed


@dataclass(frozen=True)
class Beside:
    """All that is known beside the capture, see `complete`."""

    materials: xr.DataArray | None
    surroundings: float | xr.DataArray | None
    prior: str | xr.DataArray | xr.Dataset | None
    surroundings_std: float
    reflection_shift: xr.Dataset | None

    def __post_init__(self) -> None:
        _numbers.real_number("surroundings_std [K]", self.surroundings_std, _SPREAD)


@without_blas_threads
def filled(
    result: xr.Dataset, corrected: xr.Dataset, response: xr.Dataset, context: Beside, workers: int
) -> xr.Dataset:
    """Complete a result in place, see `complete`."""
    shared: dict[str, Any] = {"pool": context.materials}
    shared["reflection_shift"] = context.reflection_shift
    kind = str(result.attrs.get("response_kind", "exact"))
    inputs = check(corrected, response, _METHOD, response_kind=kind, **shared)
    measured = result
    if context.materials is not None and not result.attrs.get("pooled"):
        measured = without_calibration(solve(corrected, response, **shared))
    scene = scenes.gather(inputs, result, measured, context.prior)
    sample = scene.sample()
    if not scene.apart:  # else the result's reflections come from two places
        scenes.require_same_capture(scene, result, sample)
    if context.surroundings is None:
        level = scenes.find_level(scene, sample)
    else:
        level = scenes.stated(scene, context.surroundings, context.surroundings_std)
        estimate = scenes.find_level(replace(scene, level=level), sample)
        level = replace(estimate, signal=level.signal, std=level.std)
    source = "capture" if np.any(level.std != scene.level.std) else "assumed"
    scene = replace(scene, level=level)
    del sample  # before the blocks take memory
    lacking = empty(result[FILMS[0]].shape, np.bool_)  # samples of a result without a film
    with ThreadPoolExecutor(workers) as threads:
        list(threads.map(partial(_complete_rows, scene, result, lacking), inputs.blocks))
        frames = np.array([np.isfinite(frame).any() for frame in result[FILMS[0]].values])
        counts = threads.map(partial(_bridge_rows, result, frames, lacking), inputs.blocks)
        number = np.concatenate(list(counts))
    variable = schema.OPTIONAL["separated"]["bridged"]
    result["bridged"] = (variable.dims, lacking, variable.attrs)
    result["status"].attrs.update(Status.cf_attrs(schema.STATUS))
    curve = inputs.curves[inputs.bands[0]]
    return added(result, inputs).assign_attrs(
        frames_missing=int(np.count_nonzero(~frames)),
        frames_bridged=float(number.sum() / max(1, np.count_nonzero(number))),
        surroundings=float(np.mean(curve.temperature(np.asarray(level.signal) + curve.reference))),
        surroundings_std=float(np.mean(level.std)),
        surroundings_source=source if context.surroundings is None else "stated",
    )


def _checked(result: xr.Dataset, corrected: xr.Dataset) -> xr.Dataset:
    """Result in the capture's order of bands, and of the same frames and pixels."""
    schema.check_corrected(corrected)
    schema.check(result, "separated")
    for name in ("object_temperature_std", "emissivity_std"):
        if name in result.attrs.get("not_estimated", "").split():
            raise ValueError(
                f"Invalid result of method '{result.attrs.get('method')}', which estimates no "
                "standard deviation. Must be of one that does, as 'subspace'."
            )
    for name in (name for name in map(str, result.data_vars) if name.endswith("_std")):
        if np.any(negative := result[name].values < 0.0):
            value = result[name].values[negative][0]
            raise ValueError(f"Invalid '{name}' {value} of the result. Must not be negative.")
    measured = result["emissivity"].where(result["status"] == 0).values
    if np.any(bad := (measured <= 0.0) | (measured >= 1.0)):
        rule = "Must lie in (0, 1) where the status is 0, and not in per cent"
        raise ValueError(f"Invalid emissivity {measured[bad][0]} of the result. {rule}.")
    return laid_on(result, corrected, "the result", "the capture")


def _complete_rows(scene: Scene, completed: xr.Dataset, lacking: Mask, rows: slice) -> None:
    """Complete the pixels of some rows, in place; what was measured is not touched."""
    films = [np.isnan(completed[name].values[:, rows]) for name in FILMS]
    maps = [np.isnan(completed[name].values[:, rows]) for name in MAPS]
    # Samples (time, y, x) that lack one of the films are marked.
    lacking[:, rows] = np.any(films, axis=0)
    pixels = lacking[:, rows].any(axis=0) | np.any(maps, axis=(0, 1))
    if not pixels.any():
        return
    lines = np.flatnonzero(pixels.any(axis=1))
    block = scene.inputs.capture.isel(y=rows).load().isel(y=lines)
    tile, valid = scene.tile(block, pixels[lines].ravel())
    places = np.flatnonzero(pixels) + rows.start * completed.sizes["x"]
    for start in range(0, places.size, tiles.PIXELS):
        batch = np.arange(start, min(start + tiles.PIXELS, places.size))
        section = tile.select_pixels(batch), valid[:, batch], places[batch]
        _complete_pixels(scene, completed, *section)
    release()


def _complete_pixels(
    scene: Scene, completed: xr.Dataset, tile: Tile, valid: Mask, places: Whole
) -> None:
    """Complete pixels by their numbers in the image, in place."""
    y, x = np.divmod(places, completed.sizes["x"])
    # A frame that was lost is no sample to complete: many captures lack some.
    arrays = [completed[name].values[:, y, x] for name in (*FILMS, *MAPS, f"{FILMS[0]}_std")]
    gaps = np.any([(np.isnan(film) & valid).any(axis=0) for film in arrays[:2]], axis=0)
    gaps |= np.any([np.isnan(block).any(axis=0) for block in arrays[2:4]], axis=0)
    gaps &= valid.any(axis=0)
    measured = np.array([arrays[0], arrays[-1]], dtype=np.float64)
    sources = np.where(gaps, scene.source[places], -1)
    for source in (scenes.OWN, scenes.MATERIAL, scenes.PRIOR):
        chosen = sources == source
        if not chosen.any():
            continue
        block = tile.select_pixels(chosen)
        where = source, places[chosen]
        static, variance = scenes.solve_statics(scene, block, valid[:, chosen], *where)
        if source == scenes.MATERIAL:
            agreement = ~scenes.contradicted(scene, static, places[chosen])
            sources[chosen] = np.where(agreement, source, scenes.PRIOR)
            chosen = sources == source
            static, block = static.select_pixels(agreement), block.select_pixels(agreement)
            variance = variance[agreement]
        constants = static, variance, measured[..., chosen]
        values = scenes.solve(scene, block, valid[:, chosen], *constants)
        _fill(scene, completed, places[chosen], values, source)


def _fill(scene: Scene, completed: xr.Dataset, places: Whole, values: Values, source: int) -> None:
    """Fill in missing values, and set the bits that say so."""
    y, x = np.divmod(places, completed.sizes["x"])
    filled, beyond = np.zeros(places.size, dtype=bool), np.zeros(places.size, dtype=bool)
    curve = scene.inputs.curves[scene.inputs.bands[0]]
    order = np.argsort(scene.inputs.bands)  # the capture's
    for name in (*FILMS, *MAPS):
        names = (name, f"{name}_std")
        value, std = (completed[key].values for key in names)
        new, new_std = (values[key][order] if name in MAPS else values[key] for key in names)
        free = np.isnan(value[:, y, x]) & np.isfinite(new) & np.isfinite(new_std)
        t, p = np.nonzero(free)
        value[t, y[p], x[p]], std[t, y[p], x[p]] = new[free], new_std[free]
        filled |= free.any(axis=0)
        # Outside the calibrated range by several deviations.
        margin = tiles.RANGE_SIGMAS * new_std if name == FILMS[0] else np.inf
        outside = (new < curve.lowest - margin) | (new > curve.highest + margin)
        beyond |= (free & outside).any(axis=0)
    if (name := "emissivity_covariance") in completed:
        before, after = completed[name].values[:, :, y, x], values[name][np.ix_(order, order)]
        completed[name].values[:, :, y, x] = np.where(np.isnan(before), after, before)
    if "drift_std" in completed:  # in the deviation of a completed emissivity as a whole
        drift = completed["drift_std"].values
        drift[y, x] = np.nan_to_num(drift[y, x])
    if source in _BITS:
        completed["status"].values[y, x] |= filled * np.uint32(_BITS[source])
    completed["status"].values[y, x] |= beyond * np.uint32(Status.OUTSIDE_RESPONSE)


def _bridge_rows(completed: xr.Dataset, frames: Mask, lacking: Mask, rows: slice) -> Whole:
    """Bridge gaps of single pixels of some rows by lines, in place; return their number (y, x)."""
    # Only in the frames (time) that some pixel has.
    time = completed["time"].values[frames].astype(np.float64)
    number = np.zeros(completed["status"].values[rows].shape, dtype=np.intp)
    for name in FILMS:
        films = [completed[variable].values for variable in (name, f"{name}_std")]
        gaps = np.isnan(films[0][frames, rows]).sum(axis=0)
        y, x = np.nonzero((gaps > 0) & (gaps < time.size))
        place = (np.flatnonzero(frames)[:, np.newaxis], rows.start + y, x)
        curves, stds = (np.ascontiguousarray(film[place].T, dtype=np.float64) for film in films)
        variances = stds**2
        _bridge(curves, variances, time)
        films[0][place], films[1][place] = curves.T, np.sqrt(variances).T
        number[y, x] = np.maximum(number[y, x], gaps[y, x])
        release()
    # Lacking samples stay marked where a measured pixel now has a bridged value.
    bridged, status = lacking[:, rows], completed["status"].values[rows]
    bridged &= np.isfinite(completed[FILMS[0]].values[:, rows])
    bridged &= (status & np.uint32(schema.COMPLETED & ~Status.COMPLETED_FRAMES)) == 0
    # A pixel that lacked too many frames gets a bit of the status, too.
    mostly = bridged.mean(axis=0) >= quality.MOST_BRIDGED
    status |= mostly * np.uint32(Status.COMPLETED_FRAMES)
    if "bridged" in completed:
        bridged |= completed["bridged"].values[:, rows]
    release()
    return number


@compiled
def _bridge(values: Array, variances: Array, time: Array) -> None:
    """Bridge the gaps of curves (curve, time) with a number somewhere, in place."""
    for p in range(len(values)):
        bridge(values[p], variances[p], time)
