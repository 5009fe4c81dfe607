r"""Budget of a result by cause (JCGM 100:2008 [1]_), with what its calibration is taken for.

The bands show noise, and how certain the ratios are. Offset, gain, and a blackbody that is not what
it is taken for they cannot show: these the response states (`response.accuracy`). Errors
:math:`\delta_b` of the signals, in kelvin, move object x and background y by

.. math:: e_b u_b'(x)\,\delta x + (1 - e_b) u_b'(y)\,\delta y = \delta_b

by least squares with the weights of the noise; two bands fulfil it. Relative errors :math:`g_b` of
gains about :math:`T_0` keep that form where the emissivities are found, too:

.. math:: e_b \alpha + (1 - e_b) \beta = g_b, \quad \delta x = \alpha (x - T_0), \quad
          \delta y = \beta (y - T_0), \quad \delta e_b = e_b (1 - e_b) (\beta - \alpha)

An error of the blackbody is one of every temperature. A completed pixel is read in one band.

References
----------
.. [1] JCGM 100:2008, Guide to the expression of uncertainty in measurement,
   doi:10.59161/JCGM100-2008E
"""

from typing import Any, Final, NamedTuple

import numpy as np
import xarray as xr

from dbthermal import response as responses
from dbthermal import schema
from dbthermal._arrays import Array, empty, release
from dbthermal.response import Accuracy
from dbthermal.separation._inputs import Inputs

_FILMS: Final = ("object_temperature", "background_temperature")
_FRAMES: Final = 64  # of a film, at least, that give its mean and scatter over time
_SINGULAR: Final = 1e-9  # determinant, over its terms, of bands that tell no two temperatures
# A pixel that is completed as a whole, and not in some frames.
_WHOLE: Final = np.uint32(schema.COMPLETED & ~schema.Status.COMPLETED_FRAMES)


class Level(NamedTuple):
    """Mean and variance over time of maps (y, x)."""

    mean: Array
    variance: Array

    def about(self, temperature: float) -> Array:
        """Root mean square distance of a temperature [K]."""
        return np.asarray(np.sqrt((self.mean - temperature) ** 2 + self.variance))


def added(result: xr.Dataset, inputs: Inputs) -> xr.Dataset:
    """Result with its budget by cause, whose calibration's part is added to its deviations.

    In place; a result without deviations stays as it is.
    """
    missing = str(result.attrs.get("not_estimated", "")).split()
    if "object_temperature_std" in missing:
        return result
    names = [str(band) for band in result["band"].values]
    accuracy = responses.accuracy(inputs.response, names)
    variables = schema.OPTIONAL["separated"]
    result = result.assign_coords(cause=list(schema.CAUSES))
    for name in schema.BUDGETS.values():
        sizes = [result.sizes[dim] for dim in variables[name].dims]
        values = np.zeros(sizes, np.float32)
        result[name] = (variables[name].dims, values, variables[name].attrs)
    for rows in inputs.blocks:
        _add_rows(result, rows, inputs, accuracy)
        release()
    return result


def without_calibration(result: xr.Dataset) -> xr.Dataset:
    """Result whose deviations hold what its bands tell alone: noise and ratios, no calibration.

    Parameters
    ----------
    result : Dataset
        From `solve`, `separate` or `complete`, which add what the response states of its accuracy.
        It is not changed.

    Returns
    -------
    Dataset
        The same values; without `uncertainty`, `background_uncertainty`, `emissivity_uncertainty`.

    Examples
    --------
    >>> import numpy as np, xarray as xr
    >>> from dbthermal import separation, simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), glass, rng)
    >>> response = rig.response().drop_vars("blackbody_accuracy")  # 0.1 K, if nothing is stated
    >>> result = separation.solve(simulation.observe(scene, response, rng), response)
    >>> alone = without_calibration(result)["object_temperature_std"]
    >>> added = np.sqrt(result["object_temperature_std"] ** 2 - alone**2)
    >>> round(float(added.mean()), 3)  # K
    0.1
    """
    budgets = {name: result[budget] for name, budget in schema.BUDGETS.items() if budget in result}
    result = result.drop_vars([*(budget.name for budget in budgets.values())]).drop_dims(
        "cause", errors="ignore"
    )
    for name, budget in budgets.items():
        variance = (budget.sel(cause=list(schema.CALIBRATION)) ** 2).sum("cause").values
        std = result[f"{name}_std"]
        values = empty(std.shape, std.dtype)
        for place, image in enumerate(std.values):
            of = variance if variance.ndim == 2 else variance[place]
            values[place] = np.sqrt(np.maximum(image**2 - of, 0.0)) if of.any() else image
            release()
        result[f"{name}_std"] = std.copy(data=values)
    return result


def _add_rows(result: xr.Dataset, rows: slice, inputs: Inputs, accuracy: Accuracy) -> None:
    """Add the budget of some rows, in place."""
    cut = result.isel(y=rows)  # views of the values
    levels = [_level(cut[name].values) for name in _FILMS]
    contrast = _level(cut[_FILMS[0]].values, cut[_FILMS[1]].values)
    value, single = _emissivity(cut)
    slopes = np.ones((2, *value.shape))
    for place, level in enumerate(levels):
        for band, curve in enumerate(inputs.curves):
            known = np.where(np.isfinite(level.mean), level.mean, curve.reference)
            slopes[place, band] = curve.slope(np.clip(known, curve.lowest, curve.highest))
    weights, relative = (
        _weights(value * slope[0], (1.0 - value) * slope[1], inputs.noise, single, inputs.bands[0])
        for slope in (slopes, np.ones_like(slopes))
    )
    ratios = cut["reflection_ratio_std"].values
    ratios = np.where(np.isfinite(ratios), ratios, 0.0)
    # Object and background, then the emissivities.
    for place, (name, level) in enumerate(zip(_FILMS, levels, strict=True)):
        gain = _combined(relative[place], accuracy.gain) * level.about(accuracy.centre)
        parts = {
            "pattern": _combined(weights[place], accuracy.pattern),
            "offset": _combined(weights[place], accuracy.offset),
            "gain": gain,
            "blackbody": np.full(gain.shape, accuracy.blackbody),
            "room": accuracy.reflected * level.about(accuracy.room),
        }
        film = cut[f"{name}_std"].values
        mirrored = np.where(single, 0.0, 1.0 - value[inputs.bands[0]]) * contrast.about(0.0)
        parts["ratio"] = mirrored * _combined(weights[place], ratios)
        _enter(cut[schema.BUDGETS[name]].values, parts, film, _level(film).about(0.0))
    difference = np.where(single, 0.0, _combined(relative[1] - relative[0], accuracy.gain))
    stds = cut["emissivity_std"].values
    gains = {"gain": np.abs(value * (1.0 - value)) * difference}
    _enter(
        cut[schema.BUDGETS["emissivity"]].values, gains, stds[np.newaxis], stds.astype(np.float64)
    )


def _enter(budget: Array, parts: dict[str, Array], stds: Array, total: Array) -> None:
    """Enter parts (y, x) into a budget (cause, y, x), and the calibration's into the deviations.

    Of the statistical deviation, whose root mean square is `total`, what no ratio explains is
    noise. In place; a part without a value is left out, as where there is no temperature.
    """
    values = dict.fromkeys(schema.CAUSES, np.zeros(total.shape)) | {
        name: np.where(np.isfinite(part), part, 0.0) for name, part in parts.items()
    }
    values["ratio"] = np.minimum(values["ratio"], np.where(np.isfinite(total), total, 0.0))
    values["noise"] = np.sqrt(total**2 - values["ratio"] ** 2)
    budget[:] = np.stack([values[name] for name in schema.CAUSES])
    common = np.sqrt(sum(values[name] ** 2 for name in schema.CALIBRATION))
    for frame in stds if np.any(common) else ():
        np.hypot(frame, common, out=frame, casting="same_kind")


def _emissivity(cut: xr.Dataset) -> tuple[Array, Any]:
    """Emissivities (band, y, x), and where (y, x) an object is read in one band.

    Where only the ratios are known: any emissivities of these ratios move the object alike.
    """
    value = cut["emissivity"].values.astype(np.float64)
    ratio = cut["reflection_ratio"].values.astype(np.float64)
    least = 0.5 / np.max(np.nan_to_num(ratio, nan=1.0), axis=0, initial=1.0)
    value = np.where(np.isfinite(value), value, 1.0 - least * ratio)
    single = ((cut["status"].values & _WHOLE) != 0) | ~np.isfinite(value).all(axis=0)
    return np.where(np.isfinite(value), value, 1.0), single


def _weights(warm: Array, cold: Array, noise: Array, single: Any, reference: int) -> Array:
    """Weights (2, band, y, x) of the bands' errors in object and background.

    Of coefficients (band, y, x) of both, by least squares; where `single`, and where the bands do
    not tell two temperatures, of the reading in the reference band.
    """
    inverse = 1.0 / noise[:, np.newaxis, np.newaxis] ** 2
    xx, xy, yy = (
        (inverse * a * b).sum(axis=0) for a, b in ((warm, warm), (warm, cold), (cold, cold))
    )
    determinant = xx * yy - xy**2
    single = single | ~(determinant > _SINGULAR * xx * yy)
    divisor = np.where(single, 1.0, determinant)
    result = np.stack([warm * yy - cold * xy, cold * xx - warm * xy]) * inverse / divisor
    alone = np.zeros_like(warm)
    alone[reference] = 1.0
    reading = alone / np.where(warm[reference] > 0.0, warm[reference], 1.0)
    return np.where(single, np.stack([reading, alone]), result)


def _combined(weights: Array, stds: Array) -> Array:
    """Deviation (y, x) of independent errors of the bands, (band) or (band, y, x), by weights."""
    stds = np.reshape(stds, (len(stds), *(np.shape(stds)[1:] or (1, 1))))
    return np.asarray(np.sqrt(((weights * stds) ** 2).sum(axis=0)))


def _level(film: Array, less: Array | None = None) -> Level:
    """Mean and variance over time of a film (time, y, x), or of a difference; NaN without any."""
    frames = slice(None, None, max(1, len(film) // _FRAMES))
    values = film[frames].astype(np.float64)
    if less is not None:
        values -= less[frames]
    finite = np.isfinite(values)
    number = finite.sum(axis=0)
    count = np.where(number > 0, number, np.nan)
    mean = np.sum(values, axis=0, where=finite) / count
    variance = np.sum((values - mean) ** 2, axis=0, where=finite) / count
    return Level(mean, variance)
