r"""Cramer-Rao bounds of a scene: the exact response, any number of bands, every quantity.

The image formation is that of Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import mixing, schema
from dbthermal import response as responses
from dbthermal.limits._deviations import QUANTITIES, Truth, deviations, orders
from dbthermal.response import Curve, require_range

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Difference [K] below which two background temperatures are one level.
_LEVEL: Final = 1e-6
_LONG_NAMES: Final = {
    "reflection_ratio": "reflection over that of the quieter band",
    "emission_ratio": "emission over that of the quieter band",
}


def bounds(
    scene: xr.Dataset,
    response: xr.Dataset,
    *,
    order: int | None = None,
    resting: npt.ArrayLike | None = None,
    emissivity_std: float = np.inf,
    response_kind: str = "exact",
) -> xr.Dataset:
    r"""
    Smallest standard deviations that an unbiased estimate from one pixel's film can have.

    Of :math:`z_m(t) = e_m u_m(x(t)) + (1 - e_m) u_m(y(t))` + white noise :math:`s_m` the unknowns
    are

    - every :math:`e_m`, from this pixel alone (pixels that share a material do better);
    - x, in a known smooth subspace of so many polynomials; that it is known is assumed;
    - y, one number a frame; in the frames that rest, one number for all of them. Which frames
      rest is assumed to be known, the level is not. ``resting=False`` assumes nothing about y.

    Response and noise are known, nothing has a prior. The bound is the inverse Fisher information
    at the truth; y is eliminated frame by frame by a Schur complement, as an estimate by variable
    projection [2]_ does. Bands may be many.

    For the linear response and two bands, ``resting=False`` gives the reflection ratio the bound
    of `ratio_variance`, and no emissivity: scaling :math:`1 - e_m` up and :math:`y - x` down alike
    changes no sample. Frames at rest tell the emissivities, and sharpen the ratio, too. The exact
    response tells the emissivities without them, by its curvature, but hardly; and as nothing then
    keeps y near the truth, where the bands' slopes have another ratio, the bound of the reflection
    ratio is loose. An `emissivity_std` of 0.29, that of a uniform number in (0, 1), tightens it.

    Parameters
    ----------
    scene : Dataset
        Truth: `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1].
    response : Dataset
        Stage `response` with `noise`, of every band of the scene.
    order : int, optional
        Size of the smooth subspace. If not given, for each pixel the smallest that leaves at most
        0.1 of the noise's variance; see `information.smallest_order`.
    resting : array_like of bool, optional
        Frames at rest, (time) or (time, y, x), or one for all. If not given, those in which a
        pixel's background has its most frequent temperature, where two or more share it.
    emissivity_std : float
        Standard deviation [1] with which each emissivity is known beforehand: 0 if it is known,
        infinite if nothing is. A finite one gives the Bayesian bound of van Trees.
    response_kind : {"exact", "linear"}
        See `response.curve`.

    Returns
    -------
    Dataset
        `object_temperature_std`, `background_temperature_std` (time, y, x) [K];
        `emissivity_std` (band, y, x) [1]; `reflection_ratio_std`, `emission_ratio_std` (band, y,
        x) [1], of :math:`(1 - e_m) / (1 - e_r)` and :math:`e_m / e_r` with r the quieter band, the
        attribute `reference_band`; all infinite where the information along a direction that
        the quantity depends on is nothing but rounding. `identifiable` (quantity, y, x), whether
        the film tells more than what is known without it: whether the deviation, root mean square
        over time and largest of the bands, is below that of a uniform number between the limits,
        which are 0 and 1 for an emissivity and the calibrated range for a temperature, and for a
        ratio below the ratio. `condition_number`, `order` (y, x) [1]; `resting` (time, y, x).

    Raises
    ------
    ValueError
        If a variable is missing or its dims or unit are others, there is one band only, an
        emissivity lies outside (0, 1), a temperature outside the response's range, the response
        lacks a band or the noise, the background differs between frames that are said to rest,
        or no smooth subspace holds the object.

    References
    ----------
    .. [1] Kay (1993), Fundamentals of Statistical Signal Processing: Estimation Theory, chapter 3
    .. [2] Golub, Pereyra (2003), Inverse Problems 19, R1, doi:10.1088/0266-5611/19/2/201
    """
    if not emissivity_std >= 0:
        raise ValueError(f"Invalid emissivity_std {emissivity_std}. Must not be negative.")
    truth = _truth(scene, resting)
    names = [str(name) for name in scene["band"].values]
    curves = [responses.curve(response, name, response_kind) for name in names]
    for what, values in (
        ("object_temperature", truth.warm),
        ("background_temperature", truth.cold),
    ):
        for one in curves:
            require_range(values, one, what)
    noise = responses.noise(response, names) / [one.reference_slope for one in curves]
    seen = truth.film(curves, noise)
    sizes = orders(truth, seen) if order is None else np.full(truth.warm.shape[1], order)
    seen = truth.smooth(sizes).film(curves, noise)
    reference = int(np.argmin(noise))
    found = deviations(seen, truth.time, sizes, reference, emissivity_std=emissivity_std)
    emissivity = truth.emissivity
    ratios = {
        "emissivity": np.ones_like(emissivity),
        "reflection_ratio": (1.0 - emissivity) / (1.0 - emissivity[reference]),
        "emission_ratio": emissivity / emissivity[reference],
    }
    told = _identifiable(found, ratios, curves[0])
    maps = {
        "condition_number": mixing.condition_number(emissivity.T),
        "order": sizes,
        "resting": truth.resting,
    }
    result = _dataset(scene, found, told, maps)
    return result.assign_attrs(reference_band=names[reference], response_kind=response_kind)


def resting_frames(background: Array) -> Mask:
    """
    Frames in which each pixel's background has its most frequent temperature.

    Parameters
    ----------
    background : ndarray, shape (time, pixel)
        Background temperature [K].

    Returns
    -------
    ndarray of bool, shape (time, pixel)
        None of a pixel's frames where no two share a temperature; of several as frequent, the
        lowest.
    """
    ordered = np.sort(background, axis=0)
    place = np.arange(len(ordered))[:, np.newaxis]
    new = np.diff(ordered, axis=0, prepend=-np.inf) > 0
    length = place - np.maximum.accumulate(np.where(new, place, 0), axis=0)
    longest = np.argmax(length, axis=0)[np.newaxis]
    level = np.take_along_axis(ordered, longest, axis=0)
    return np.asarray((background == level) & (length.max(axis=0) > 0))


def _truth(scene: xr.Dataset, resting: npt.ArrayLike | None) -> Truth:
    """What a scene holds, checked."""
    stage = schema.STAGES["separated"]
    names = ("object_temperature", "background_temperature", "emissivity")
    for name in names:
        if name not in scene:
            raise ValueError(f"Missing variable '{name}' in the scene.")
        schema.check_variable(scene[name], stage[name], f"'{name}' of the scene")
    warm, cold, emissivity = (
        scene[name].values.astype(np.float64).reshape(scene[name].shape[0], -1) for name in names
    )
    if len(emissivity) < 2:
        raise ValueError("Invalid scene of one band. Must have at least two.")
    bad = ~((emissivity > 0) & (emissivity < 1))
    if np.any(bad):
        band = scene["band"].values[np.argmax(bad.any(axis=1))]
        raise ValueError(
            f"Invalid emissivity {emissivity[bad][0]} in band '{band}' of the scene. "
            "Must lie in (0, 1)."
        )
    rests = resting_frames(cold) if resting is None else _given(resting, cold, scene)
    return Truth(scene["time"].values.astype(np.float64), warm, cold, emissivity, rests)


def _given(resting: npt.ArrayLike, background: Array, scene: xr.Dataset) -> Mask:
    """Mask (time, pixel) of the frames that are said to rest, in which the background does."""
    given = np.asarray(resting)
    shape = scene["object_temperature"].shape
    if given.dtype != bool or given.shape not in {(), shape[:1], shape}:
        raise ValueError(
            f"Invalid resting {given.shape} of {given.dtype}. Must be bool, one for all or "
            f"{shape[:1]} or {shape}."
        )
    mask = np.broadcast_to(given.reshape(*given.shape, *(1,) * (3 - given.ndim)), shape)
    mask = mask.reshape(background.shape)
    least, most = (
        extreme(background, axis=0, where=mask, initial=start)
        for extreme, start in ((np.min, np.inf), (np.max, -np.inf))
    )
    if np.any(most - least > _LEVEL):
        raise ValueError(
            f"Invalid resting: the background differs by {np.max(most - least)} K between frames "
            "that are said to rest. Must be one level."
        )
    return mask


def _identifiable(
    found: dict[str, Array], of_bands: dict[str, Array], curve: Curve
) -> npt.NDArray[np.bool_]:
    """Whether each quantity (quantity, pixel) is told at all; see `bounds`."""
    span = curve.highest - curve.lowest
    uniform = 1.0 / np.sqrt(12.0)
    limit = {"emissivity": uniform, "reflection_ratio": 1.0, "emission_ratio": 1.0}
    told = []
    for name in QUANTITIES:
        if name in of_bands:
            told.append(np.max(found[name] / of_bands[name], axis=0) < limit[name])
        else:
            told.append(np.sqrt(np.mean(found[name] ** 2, axis=0)) < uniform * span)
    return np.stack(told)


def _dataset(
    scene: xr.Dataset, found: dict[str, Array], told: Mask, maps: dict[str, npt.NDArray[np.generic]]
) -> xr.Dataset:
    """Put the bounds on the grid of their scene."""
    image = scene["object_temperature"].shape[1:]
    stage = schema.STAGES["separated"]
    variables: dict[str, tuple[tuple[str, ...], npt.NDArray[np.generic], dict[str, str]]] = {}
    for name, values in found.items():
        known = stage.get(name)
        meaning = known.long_name if known else _LONG_NAMES[name]
        attrs = {"units": known.units if known else "1", "long_name": f"bound of {meaning}"}
        rows = "time" if "temperature" in name else "band"
        variables[f"{name}_std"] = ((rows, "y", "x"), values.reshape(-1, *image), attrs)
    for name, part in maps.items():
        dims = ("time", "y", "x") if part.ndim > 1 else ("y", "x")
        variables[name] = (dims, part.reshape(*part.shape[:-1], *image), {"units": "1"})
    identifiable = told.reshape(-1, *image)
    variables["identifiable"] = (("quantity", "y", "x"), identifiable, {"units": "1"})
    coords = {name: scene[name] for name in ("band", "time", "y", "x") if name in scene.coords}
    origin = {name: scene.attrs[name] for name in ("origin",) if name in scene.attrs}
    return xr.Dataset(variables, {**coords, "quantity": list(QUANTITIES)}, origin)
