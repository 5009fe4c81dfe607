"""Agreement of maps with a reference, and reflections as pictures."""

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import schema
from dbthermal._arrays import Array
from dbthermal._coordinates import laid_on

__all__ = ["correlation", "relative_error_celsius"]
__dir__ = __all__.copy


def correlation(
    first: xr.DataArray, second: xr.DataArray, mask: xr.DataArray | None = None
) -> xr.DataArray:
    """Pearson's correlation of two maps, in [-1, 1], over the dims other than y and x.

    Of maps (..., y, x), each in a unit of its own, over the pixels (y, x) of a mask, all by
    default. ValueError if dims or places differ, fewer than two pixels count, one is not finite, or
    a map is constant.

    Examples
    --------
    An emissivity [1] and an apparent temperature [K] that is linear in it.

    >>> import xarray as xr
    >>> emissivity = xr.DataArray([[0.2, 0.4], [0.6, 0.9]], dims=("y", "x"))
    >>> round(float(correlation(emissivity, 290.0 + 10.0 * emissivity)), 6)
    1.0
    """
    # Broadcast both maps to the same coordinates.
    for values, label in ((first, "the first map"), (second, "the second map")):
        if not {"y", "x"} <= {*schema.check_numbers(values, label).dims}:
            raise ValueError(f"Invalid dims {values.dims} of {label}. Must hold y and x.")
    _require_dims(*sorted((second, first), key=lambda maps: maps.ndim))
    first, second = xr.broadcast(first, laid_on(second, first, "the second map", "the first"))
    signal, partner = (_centred(values, mask) for values in (first, second))
    # Correlation over the pixels of the mask.
    norm = np.linalg.norm(signal, axis=-1) * np.linalg.norm(partner, axis=-1)
    if np.any(norm <= 0):
        raise ValueError(f"Constant map in {np.sum(norm <= 0)} of {norm.size} frames. Must vary.")
    result = first.isel(y=0, x=0, drop=True).copy(data=np.sum(signal * partner, axis=-1) / norm)
    attrs = {"long_name": "correlation of the maps", "units": "1"}
    return result.drop_attrs(deep=False).rename("correlation").assign_attrs(attrs)


def relative_error_celsius(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    r"""Error in per cent of the true temperature in degrees Celsius, as the paper reports it.

    .. math:: 100 \, |\hat T - T| / (T - 273.15)

    The zero of the Celsius scale is arbitrary, and so is this number; it is here to stand beside
    the published ones (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334) and is labelled. Both
    are temperatures [K] of the same coordinates, the true ones above 273.15 K, or a ValueError. NaN
    where the estimate is.

    Examples
    --------
    Half a kelvin at 25 degrees Celsius:

    >>> import xarray as xr
    >>> truth = xr.DataArray(298.15)
    >>> round(float(relative_error_celsius(truth + 0.5, truth)), 6)  # [percent]
    2.0
    """
    schema.check_numbers(estimate, "the estimate", "K")
    schema.check_numbers(truth, "the truth", "K")
    _require_dims(truth, estimate)
    bad = ~(truth.values > zero_Celsius)
    if np.any(bad):
        rule = f"Must be above {zero_Celsius} K, the zero of degrees Celsius"
        raise ValueError(f"Invalid true temperature {truth.values[bad].flat[0]} K. {rule}.")
    truth = laid_on(truth, estimate, "the truth", "the estimate")
    result = 100.0 * abs(estimate - truth) / (truth - zero_Celsius)
    label = "error relative to the true temperature in degrees Celsius"
    bare: xr.DataArray = result.drop_attrs(deep=False).rename("relative_error")
    return bare.assign_attrs(long_name=label, units="percent")


def _require_dims(reference: xr.DataArray, values: xr.DataArray) -> None:
    """Refuse a reference with a dim that the other array lacks, which would multiply its pixels."""
    if not {*reference.dims} <= {*values.dims}:
        rule = f"Must be among {values.dims}"
        raise ValueError(f"Invalid dims {reference.dims} of the reference. {rule}.")


def _centred(maps: xr.DataArray, mask: xr.DataArray | None) -> Array:
    """Deviations from the mean of each map over the mask, (..., pixel)."""
    maps = maps.transpose(..., "y", "x")
    chosen = maps.values.reshape(*maps.shape[:-2], -1)
    if mask is not None:
        if mask.dtype != bool or {*mask.dims} != {"y", "x"}:
            raise ValueError(f"Invalid mask {mask.dims} of {mask.dtype}. Must be bool, (y, x).")
        mask = laid_on(mask, maps, "the mask", "the map").transpose("y", "x")
        chosen = chosen[..., mask.values.ravel()]
    if chosen.shape[-1] < 2:
        raise ValueError(f"Invalid mask: {chosen.shape[-1]} pixels remain. Must keep at least 2.")
    invalid = int(np.sum(~np.isfinite(chosen)))
    if invalid:
        raise ValueError(
            f"Invalid {maps.name}: {invalid} of {chosen.size} values that count are not finite. "
            "Must be finite; the mask says which count."
        )
    chosen = chosen.astype(np.float64)
    # The correlation has no unit: in that of the largest value no square overflows.
    chosen /= max(float(np.abs(chosen).max()), np.finfo(np.float64).tiny)
    return np.asarray(chosen - chosen.mean(axis=-1, keepdims=True))


def reflected_change(apparent: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    r"""Change of the first band's apparent temperature that the reflection causes.

    .. math:: (1 - e_1) (y - \bar y)

    with the mean over time, in the linear response of small changes, (time, y, x) [K], float32; NaN
    where the reflection is unknown. Of a constant object without a completed background it is the
    change of the apparent temperature. That is of the inputs (band, time, y, x) [K], from
    `response.apparent_temperature`; the result from `solve`, `separate` or `complete`, of the same
    capture. ValueError if a variable is missing, emissivities are in per cent, or the first bands,
    dims, sizes or coordinates differ.

    Examples
    --------
    Plate glass, of reflectivity 0.14, reflects people who are 10 K warmer than the room:

    >>> import numpy as np
    >>> from dbthermal import response, separation, simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], coords={"band": list(rig.bands)}, dims="band")
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), glass, rng)
    >>> capture = simulation.observe(scene, rig.response(), rng)
    >>> apparent = response.apparent_temperature(rig.response(), capture["counts"])
    >>> change = reflected_change(apparent, separation.solve(capture, rig.response()))
    >>> bool(1.2 < (change.max("time") - change.min("time")).median() < 1.8)  # 1.4 K and noise
    True
    """
    schema.check_numbers(apparent, "the apparent temperature", "K")
    schema.require(result, xr.Dataset, "result")
    if apparent.dims != ("band", "time", "y", "x"):
        rule = "Must be ('band', 'time', 'y', 'x')"
        raise ValueError(f"Invalid dims {apparent.dims} of the apparent temperature. {rule}.")
    if str(apparent["band"].values[0]) != str(result["band"].values[0]):
        raise ValueError(
            f"Invalid first band '{apparent['band'].values[0]}'. "
            f"Must be '{result['band'].values[0]}', as in the result."
        )
    needed = ("background_temperature", "emissivity", "status")
    schema.check(result, "separated", needed, "the result")
    if (usual := float(result["emissivity"].median())) > schema.EMISSIVITY_LIMITS[1]:
        message = f"Invalid emissivities of the result, {usual:.3g} in the median"
        raise ValueError(f"{message}. Must be shares of one, not per cent.")
    first = apparent.isel(band=0, drop=True)
    first = laid_on(first, result, "the apparent temperature", "the result")
    background = result["background_temperature"]
    reflectivity = 1.0 - result["emissivity"].isel(band=0, drop=True)
    change = (background - background.mean("time")) * reflectivity
    constant = (result["status"] & int(schema.Status.CONSTANT_OBJECT)) != 0
    without = constant & background.isnull().all("time")
    change = change.where(~without, first - first.mean("time"))
    attrs = {"units": "K", "long_name": "reflection, change of the apparent temperature"}
    return change.astype("float32").rename("reflected_change").assign_attrs(attrs)
