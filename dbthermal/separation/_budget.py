r"""Budget of a result by cause, with what its calibration is taken for.

The bands show noise, and how certain the ratios are. A background that drifts along with the object
they do not show: it is a prior's (`SubspaceSettings.background_drift`), and moves the emissivities
of given ratios, :math:`\delta e_b = \kappa_b \, \delta e_1`, and with them the background,
:math:`\delta y = (y - x) \, \delta e_1 / (1 - e_1)`, but no object. Nor do they show wrong offsets,
gains or blackbodies: these the response states (`response.accuracy`). Errors :math:`\delta_b` of
the bands [K] move object and background by a least-squares solution of the first equation; relative
errors :math:`g_b` of gains about :math:`T_0` keep the image formation if, with the emissivities
that are found with them,

.. math::
    e_b\,\delta x + (1 - e_b)\,\delta y &= \delta_b, \qquad
    e_b \alpha + (1 - e_b) \beta = g_b \\
    \delta x = \alpha (x - T_0), \quad \delta y &= \beta (y - T_0), \quad
    \delta e_b = e_b (1 - e_b) (\beta - \alpha)

An error of the blackbody is one of all temperatures; what it mirrors is one of all gains; coloured
reflections are errors of the ratios. Causes are combined as by JCGM 100:2008, Guide to the
expression of uncertainty in measurement, doi:10.59161/JCGM100-2008E.
"""

from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, empty, quotient, release
from dbthermal.emissivity import Colour
from dbthermal.response import Accuracy
from dbthermal.schema import BUDGETS, CALIBRATION, CAUSES
from dbthermal.separation._inputs import Inputs

_FILMS: Final = tuple(BUDGETS)[:2]
_FRAMES: Final = 16  # of a film, at least, that give its root mean square
# Mean of a reflection [K] below which it is the sky's, whose changes in bands from 8.5 to 12.1 um
# are 0.62 to 1.48 times those in 8-14 um, by measured spectra (Atmospheric Radiation Measurement).
_COLD, SKY = 278.15, 0.4
_SINGULAR: Final = 1e-9  # determinant, over its terms, of bands that tell no two temperatures
_COMPLETION: Final = np.uint32(schema.COMPLETED & ~schema.Status.COMPLETED_FRAMES)


def added(result: xr.Dataset, inputs: Inputs) -> xr.Dataset:
    """Result with its budgets, and with the calibration's part in its deviations, in place."""
    if "object_temperature_std" in str(result.attrs.get("not_estimated", "")).split():
        return result
    names = [str(band) for band in result["band"].values]
    reference = inputs.capture.attrs.get("level_reference")
    accuracy = responses.accuracy(inputs.response, names, reference)
    result = result.assign_coords(cause=[*CAUSES])
    for name in BUDGETS.values():
        variable = schema.OPTIONAL["separated"][name]
        values = np.zeros([result.sizes[dim] for dim in variable.dims], np.float32)
        result[name] = (variable.dims, values, variable.attrs)
    stated = inputs.capture.attrs.get("background_colour")
    for rows in inputs.blocks:
        _add(result.isel(y=rows), inputs.noise, inputs.bands[0], accuracy, stated)
        release()
    return result


def without_calibration(result: xr.Dataset, *, drift: bool = True) -> xr.Dataset:
    """Result whose deviations hold noise, ratio and drift alone, not what its calibration states.

    The values are the same; the variables of `schema.BUDGETS` are left out.

    Parameters
    ----------
    result : Dataset
        From `solve`, `separate` or `complete`; it is not changed.
    drift : bool
        Keep the part by a background that may have drifted along with the object.
    """
    schema.check(result, "separated")
    output = result.drop_vars(["cause", *BUDGETS.values()], errors="ignore")
    by_drift = np.zeros(1) if _numbers.truth_value("drift", drift) else _drift(result)
    for name in (name for name, budget in BUDGETS.items() if budget in result):
        # Of the background the drift's part goes with the contrast of each frame, see below.
        causes = [*CALIBRATION, *(["drift"] if not drift and name == "emissivity" else [])]
        deviations = result[BUDGETS[name]].sel(cause=causes).values
        variance, std = (deviations.astype(np.float64) ** 2).sum(axis=0), result[f"{name}_std"]
        values = empty(std.shape, std.dtype)
        for place, image in enumerate(std.values):
            budget = variance if variance.ndim == 2 else variance[place]
            if by_drift.any() and name == "background_temperature":
                warm, cold = (result[film].values[place] for film in _FILMS)
                budget = budget + (by_drift * (warm - cold)) ** 2
            square = image.astype(np.float64) ** 2
            values[place] = np.sqrt(np.maximum(square - budget, 0.0)) if budget.any() else image
            release()
        output[f"{name}_std"] = std.copy(data=values)
    return output


def _drift(result: xr.Dataset) -> Array:
    """Deviation (y, x) of the background by its drift, for a contrast of 1 K to the object."""
    if "drift_std" not in result:
        return np.zeros(result["status"].shape)
    places = schema.band_positions(result, [str(result.attrs.get("reference_band"))], "the result")
    reflectivity = 1.0 - result["emissivity"].values[places[0]]
    return np.asarray(quotient(np.nan_to_num(result["drift_std"].values), reflectivity, 0.0), float)


def _add(
    cut: xr.Dataset, noise: Array, reference: int, accuracy: Accuracy, stated: Colour | None
) -> None:
    """Add the budgets of some rows, whose values are views, in place."""
    # Where only ratios are known: any emissivities of these ratios move the object alike.
    ratio = cut["reflection_ratio"].values.astype(np.float64)
    assumed = 1.0 - 0.5 * ratio / np.max(np.nan_to_num(ratio, nan=1.0), axis=0, initial=1.0)
    value = cut["emissivity"].values.astype(np.float64)
    value = np.where(np.isfinite(value), value, assumed)
    # What is completed as a whole is read in one band.
    single = ((cut["status"].values & _COMPLETION) != 0) | ~np.isfinite(value).all(axis=0)
    weights = _weights(np.where(np.isfinite(value), value, 1.0), noise, single, reference)
    films = [cut[name].values for name in _FILMS]
    ratio_std = cut["reflection_ratio_std"].values
    contrast = np.where(single, 0.0, (1.0 - value[reference]) * _rms(films[0], films[1]))
    by_ratio = contrast * _combined(weights, np.where(np.isfinite(ratio_std), ratio_std, 0.0))
    # Coloured reflections are taken for another ratio; those colder than a room are of the sky.
    cold = _mean(films[1]) < _COLD
    colour = np.where(cold & (accuracy.colour > 0.0), SKY, accuracy.colour)
    colour = np.nan_to_num(ratio) * (colour if stated is None else stated.std[:, None, None])
    colour[reference] = 0.0
    by_colour = contrast * _combined(weights, colour)
    if stated is not None:
        difference = np.where(single, 0.0, _rms(films[0], films[1]))
        scaled = stated.deviations(value, cut["emissivity_std"].values, difference)
        by_colour = np.hypot(by_colour, _combined(weights, scaled))
    drift = np.where(single, 0.0, _drift(cut))
    by_drift = np.zeros_like(drift), drift * _rms(films[0], films[1])
    for place, (name, film) in enumerate(zip(_FILMS, films, strict=True)):
        deviations = {
            "ratio": by_ratio[place],
            "drift": by_drift[place],
            "pattern": _combined(weights, accuracy.pattern)[place],
            "offset": _combined(weights, accuracy.offset)[place],
            "gain": _combined(weights, accuracy.gain)[place] * _rms(film, accuracy.centre),
            "blackbody": np.full(single.shape, accuracy.blackbody),
            "room": accuracy.reflected * _rms(film, accuracy.room),
            "colour": by_colour[place],
        }
        std = cut[f"{name}_std"].values
        _enter(cut[BUDGETS[name]].values, deviations, std, _rms(std))
    slope = np.where(single, 0.0, _combined(weights[1] - weights[0], accuracy.gain))
    stds = cut["emissivity_std"].values
    deviations = {"drift": np.abs(1.0 - value) * drift}
    deviations |= {"gain": np.abs(value * (1.0 - value)) * slope}
    deviations["colour"] = value * (1.0 - value[reference]) * _combined(weights[0], colour)
    _enter(cut[BUDGETS["emissivity"]].values, deviations, stds[np.newaxis], stds.astype(np.float64))


def _enter(budget: Array, deviations: dict[str, Array], stds: Array, total: Array) -> None:
    """Enter deviations into a budget (cause, ...), and add the calibration's to stds, in place."""
    # A part without a value, as where there is no temperature, counts as zero.
    values = dict.fromkeys(CAUSES, np.zeros(total.shape)) | {
        name: np.where(np.isfinite(deviation), deviation, 0.0)
        for name, deviation in deviations.items()
    }
    # Noise is what ratio and drift do not explain of the statistical deviation, `total`.
    square = total**2
    for name in ("drift", "ratio"):
        values[name] = np.sqrt(np.fmin(values[name] ** 2, np.nan_to_num(square)))
        square = np.maximum(square - values[name] ** 2, 0.0)
    values["noise"] = np.sqrt(square)
    budget[:] = np.stack([values[name] for name in CAUSES])
    variance = np.sum([values[name] ** 2 for name in CALIBRATION], axis=0, dtype=np.float32)
    with np.errstate(over="ignore"):  # a deviation beyond single precision is infinite
        for frame in stds if np.any(variance) else ():
            np.sqrt(frame * frame + variance, out=frame)


def _weights(value: Array, noise: Array, single: Any, reference: int) -> Array:
    """Weights (2, band, y, x) of the bands' errors in object and background, by emissivities."""
    inverse, cold = 1.0 / noise[:, np.newaxis, np.newaxis] ** 2, 1.0 - value
    pairs = ((value, value), (value, cold), (cold, cold))
    xx, xy, yy = ((inverse * a * b).sum(axis=0) for a, b in pairs)
    single = single | ~(xx * yy - xy**2 > _SINGULAR * xx * yy)
    # Least squares of the bands; of a single band, or bands alike, the reading of the reference.
    divisor = np.where(single, 1.0, xx * yy - xy**2)
    solution = np.stack([value * yy - cold * xy, cold * xx - value * xy]) * inverse / divisor
    reading = np.zeros_like(solution)
    reading[0, reference] = 1.0 / np.where(value[reference] > 0.0, value[reference], 1.0)
    reading[1, reference] = 1.0
    return np.where(single, reading, solution)


def _combined(weights: Array, stds: Array) -> Array:
    """Deviation of independent errors of bands, (band) or (band, y, x), by weights (band, y, x)."""
    stds = stds if stds.ndim > 1 else stds[:, np.newaxis, np.newaxis]
    return np.asarray(np.sqrt(((weights * stds) ** 2).sum(axis=-3)))


def _mean(film: Array) -> Array:
    """Mean (y, x) over time of a film, at some frames; NaN without any."""
    values = film[:: max(1, len(film) // _FRAMES)]
    finite = np.isfinite(values)
    number = np.where(finite.any(axis=0), finite.sum(axis=0), np.nan)
    return np.asarray(np.sum(values, axis=0, where=finite, dtype=np.float64) / number)


def _rms(film: Array, zero: Array | float = 0.0) -> Array:
    """Root mean square (y, x) over time of a film, about a number or another; NaN without any."""
    frames = slice(None, None, max(1, len(film) // _FRAMES))
    values = film[frames] - (zero[frames] if isinstance(zero, np.ndarray) else zero)
    return np.asarray(np.sqrt(_mean(values.astype(np.float64) ** 2)))
