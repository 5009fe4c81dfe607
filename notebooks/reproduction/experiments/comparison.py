"""Comparison of all methods on the same simulated pixels, over materials and noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import separation, simulation
from dbthermal.simulation import Rig
from reproduction import methods

MOVING: Final = 0.5  # standard deviation of the background from which a pixel takes part [K]

WRONG: Final = 0.1  # error of an emissivity from which it is called wrong [1]

EVERY: Final = 20
"""A method that looks at whole images, each by itself, gets the first of so many frames."""

Options = Mapping[str, Any]


@dataclass(frozen=True)
class Plate:
    """Size of the scene of `compare`.

    Frames, their rate [Hz], rows and columns, number of people who walk by, names of the two bands.
    """

    frames: int = 350
    rate: float = 10.0
    shape: Sequence[int] = (36, 48)
    crossings: int = 8
    bands: tuple[str, str] = ("8-14", "9.5")


def compare(
    emissivity: Sequence[float],
    noise: Sequence[float],
    variants: Mapping[str, Options],
    *,
    plate: Options,
    pixels: int,
    seed: int,
) -> xr.Dataset:
    """Errors of several methods on one simulated scene: a heated plate, people walking by.

    The scene, of the fields of `Plate`, is an image, for methods that use a pixel's neighbours. All
    variants (label -> `method`, of `methods.METHODS`, and fields of its settings) are scored on the
    same number of pixels, drawn from those in which the reflection varies by more than `MOVING`;
    methods that treat each pixel alone get these only, the others all pixels of some frames
    (`EVERY`), with noise of their own. The noise of the two bands [K] is known to all, the
    emissivities [1] to "calibrated" alone.
    Variables of `judge` over (variant, ...).
    """
    rng, settings = np.random.default_rng(seed), Plate(**plate)
    rig = Rig(bands=settings.bands, noise=tuple(noise))
    response = rig.response()
    value = xr.DataArray(list(emissivity), dims="band", coords={"band": list(rig.bands)})
    time = np.arange(settings.frames) / settings.rate
    shape = (settings.shape[0], settings.shape[1])
    scene = simulation.walkers(time, shape, value, rng, crossings=settings.crossings)
    chosen = _choose(scene, pixels, rng)
    truth = _strip(scene, chosen)
    frames = scene.isel(time=slice(None, None, EVERY))
    imaging = [methods.get_method(variant["method"]).whole_image for variant in variants.values()]
    strip = simulation.observe(truth, response, rng)
    images = simulation.observe(frames, response, rng) if any(imaging) else strip
    rows = []
    for options, whole in zip(variants.values(), imaging, strict=True):
        truth_seen, seen = (frames, images) if whole else (truth, strip)
        stated = arguments(options)
        if stated["method"].knows_emissivity:
            stated["emissivity"] = truth_seen["emissivity"]
        result = separation.solve(seen, response, seed=seed, **stated)
        rows.append(judge(truth, _strip(result, chosen) if whole else result))
    label = xr.DataArray(list(variants), dims="variant", name="variant")
    together = xr.concat(rows, dim=label, coords="minimal", compat="override")
    return together.assign_attrs(origin="simulated", seed=seed)


def judge(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    """Errors of one separation, pixel by pixel, of a truth one row high.

    `object_temperature_rmse` (pixel) [K], NaN where a frame has no value; `emissivity_error`
    (band, pixel) [1], a magnitude; `status` (pixel).
    """
    squared = (result["object_temperature"] - truth["object_temperature"]) ** 2
    of_emissivity = abs(result["emissivity"] - truth["emissivity"])
    rmse = squared.mean("time", skipna=False) ** 0.5
    errors = {
        "object_temperature_rmse": rmse.assign_attrs(units="K"),
        "emissivity_error": of_emissivity.assign_attrs(units="1"),
        "status": result["status"],
    }
    flat = xr.Dataset(errors).isel(y=0).rename(x="pixel")
    return flat.drop_vars(["y", "pixel"], errors="ignore")


def medians(comparison: xr.Dataset, default: str = "subspace") -> xr.Dataset:
    """Median errors over pixels, of every variant over the pixels that the default can solve.

    A pixel that a variant loses there counts as its worst. Over `seed` too the median is taken.
    `object_temperature_rmse` [K] and `emissivity_error` (band) [1]: medians, NaN where the default
    has no pixel or the variant loses half of them; `wrong` [1]: share of these pixels with an
    emissivity error above `WRONG`, or lost; `solved` [1]: share of all pixels with an object
    temperature.
    """
    over = [dim for dim in ("pixel", "seed") if dim in comparison.dims]
    solved = comparison["object_temperature_rmse"].notnull()
    counted = solved.sel(variant=default)
    variables = {}
    for name in ("object_temperature_rmse", "emissivity_error"):
        worst = comparison[name].fillna(np.inf).where(counted)
        median = worst.median(over)
        variables[name] = median.where(np.isfinite(median)).assign_attrs(comparison[name].attrs)
    off = ~(comparison["emissivity_error"].max("band", skipna=False) <= WRONG)
    shares = {"wrong": off.where(counted).mean(over), "solved": solved.mean(over)}
    variables |= {name: share.assign_attrs(units="1") for name, share in shares.items()}
    return xr.Dataset(variables, attrs=comparison.attrs)


def _choose(scene: xr.Dataset, pixels: int, rng: np.random.Generator) -> np.ndarray:
    """Flat indices of pixels in which the background moves, drawn without replacement."""
    moving = scene["background_temperature"].std("time").values.ravel() > MOVING
    candidates = np.flatnonzero(moving)
    if candidates.size < pixels:
        raise ValueError(
            f"Invalid number of pixels {pixels}. Must be at most {candidates.size}, those in which "
            f"the background moves by {MOVING} K."
        )
    return np.sort(rng.choice(candidates, pixels, replace=False))


def _strip(dataset: xr.Dataset, chosen: np.ndarray) -> xr.Dataset:
    """Some pixels of an image, as an image one row high."""
    rows, columns = np.divmod(chosen, dataset.sizes["x"])
    listed = dataset.isel(y=xr.DataArray(rows, dims="pixel"), x=xr.DataArray(columns, dims="pixel"))
    row = listed.drop_vars(["y", "x"]).rename(pixel="x").expand_dims(y=[0])
    return row.transpose(..., "y", "x").assign_coords(x=np.arange(chosen.size))


def arguments(variant: Options) -> dict[str, Any]:
    """Arguments of `separation.solve` for a variant, with the settings' fields in their record.

    The variant has the name of its `method`, fields of its settings, and other arguments of
    `solve`, side by side.
    """
    method = methods.get_method(variant["method"])
    kind = method.settings
    names = set() if kind is None else {field.name for field in fields(kind)} & variant.keys()
    further = {name: value for name, value in variant.items() if name not in names}
    further["method"] = method
    if kind is not None and names:
        further["settings"] = kind(**{name: variant[name] for name in names})
    return further
