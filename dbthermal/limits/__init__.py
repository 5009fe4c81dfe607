r"""Statistical limits: the best accuracy that a capture allows, and how to plan one.

`bounds` are the Cramer-Rao bounds of a known truth, for the exact response and any number of bands;
`plan` applies them to materials, filters and seconds of video. The image formation is that of
Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import mixing, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask
from dbthermal._numbers import real_number, truth_value, whole_number
from dbthermal.limits._fisher import QUANTITIES, TEMPERATURES, Truth, deviations, smallest_order
from dbthermal.limits._planner import CaptureDesign, plan, plan_durations
from dbthermal.response import Curve, require_range

__all__ = ["CaptureDesign", "bounds", "plan", "plan_durations"]
__dir__ = __all__.copy

_UNIFORM: Final = 1.0 / np.sqrt(12.0)  # standard deviation of a uniform number over its range
_LEAST_STD: Final = 1e-9  # of an emissivity that is not known exactly [1]


def bounds(
    scene: xr.Dataset,
    response: xr.Dataset,
    *,
    order: int | None = None,
    resting: bool = True,
    emissivity_std: float = np.inf,
    response_kind: str = "exact",
) -> xr.Dataset:
    r"""Cramer-Rao bounds of all quantities that can be estimated from one pixel's capture.

    The inverse Fisher information [1]_ of :math:`z_m(t) = e_m u_m(x(t)) + (1 - e_m) u_m(y(t))` +
    white noise :math:`s_m` at the truth. Unknown are every :math:`e_m`; x, in a smooth subspace of
    polynomials of time; y, one number a frame, eliminated by variable projection [2]_, and in the
    frames at rest one number for all. Response and noise are known.

    Parameters
    ----------
    scene : Dataset
        Truth: `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1].
    response : Dataset
        Stage `response` with `noise`, of every band of the scene.
    order : int, optional
        Size of the smooth subspace; for each pixel the smallest that leaves at most 0.1 of the
        noise's variance if not given.
    resting : bool
        The frames are known (the level is not) in which a pixel's background has its most frequent
        temperature, where two or more share it; False assumes nothing about y.
    emissivity_std : float
        Prior standard deviation [1] of each emissivity: 0 if it is known, infinite for no prior. A
        finite one, at least 1e-9, gives the Bayesian bound of van Trees.
    response_kind : {"exact", "linear"}
        See `response.curve`.

    Returns
    -------
    Dataset
        `object_temperature_std`, `background_temperature_std` (time, y, x) [K], `emissivity_std`
        and `reflection_ratio_std` (band, y, x) [1], of :math:`(1 - e_m) / (1 - e_r)` with r the
        quietest band (attribute `reference_band`); infinite without information. `identifiable`
        (quantity, y, x): True if the deviation, root mean square over time and largest of the
        bands, is below that of a uniform number in (0, 1) or in the calibrated range, and for a
        ratio below the ratio itself. `condition_number`, `order` (y, x) [1]; `resting`
        (time, y, x).

    Raises
    ------
    TypeError, ValueError
        If an input is not as described, there is one band only, an emissivity lies outside (0, 1),
        a temperature outside the response's range, or no smooth subspace holds the object.

    Notes
    -----
    For the linear response and two bands, ``resting=False`` gives the reflection ratio its closed
    form, and no emissivity: scaling :math:`1 - e_m` up and :math:`y - x` down alike changes no
    sample. Frames at rest determine the emissivities, and sharpen the ratio; the curvature of the
    exact response determines them without, but hardly, and the bound of the ratio is then loose. An
    `emissivity_std` of 0.29, that of a uniform number in (0, 1), tightens it.

    References
    ----------
    .. [1] Kay (1993), Fundamentals of Statistical Signal Processing: Estimation Theory, chapter 3
    .. [2] Golub, Pereyra (2003), Inverse Problems 19, R1, doi:10.1088/0266-5611/19/2/201

    Examples
    --------
    Plate glass, and a gray body, of which two bands tell nothing:

    >>> from dbthermal import simulation
    >>> rig, rng, bands = simulation.Rig(), np.random.default_rng(1), ["8-14", "9.5"]
    >>> emissivity = xr.DataArray([[0.86, 0.90], [0.72, 0.90]], {"band": bands}, ("band", "x"))
    >>> panels = emissivity.expand_dims(y=3, axis=1)
    >>> scene = simulation.walkers(np.arange(200) / 10, (3, 2), panels, rng).isel(y=[1])
    >>> std = bounds(scene, rig.response())["object_temperature_std"]
    >>> std.mean("time").values.round(2).tolist()  # K
    [[0.04, inf]]
    """
    if real_number("emissivity_std", emissivity_std) != 0 and not emissivity_std >= _LEAST_STD:
        label = f"Invalid emissivity_std {emissivity_std}"
        raise ValueError(f"{label}. Must be 0, or at least {_LEAST_STD}.")
    truth = _truth(scene, resting=truth_value("resting", resting))
    names = [str(name) for name in scene["band"].values]
    curves = responses.curves(response, names, response_kind)
    for name in TEMPERATURES:
        for curve in curves:
            require_range(getattr(truth, name), curve, name)
    # Noise in kelvin, and the smooth subspace of each pixel.
    noise = responses.noise(response, names) / [curve.reference_slope for curve in curves]
    reference = int(np.argmin(noise))
    if order is None:
        orders = smallest_order(truth, truth.sensitivity(curves, noise))
    else:
        order = whole_number("order", order, (1, truth.time.size))
        orders = np.full(truth.object_temperature.shape[1], order)
    # Deviations from the Fisher information at the smooth truth.
    sensitivity = truth.smoothed(orders).sensitivity(curves, noise)
    stds = deviations(sensitivity, truth.time, orders, reference, emissivity_std=emissivity_std)
    maps = {
        "condition_number": mixing.condition_number(truth.emissivity.T),
        "order": orders,
        "resting": truth.resting,
        "identifiable": _identifiable(stds, truth.emissivity, reference, curves[0]),
    }
    result = _dataset(scene, stds, maps)
    return result.assign_attrs(reference_band=names[reference], response_kind=response_kind)


def _truth(scene: xr.Dataset, *, resting: bool) -> Truth:
    """Checked truth of a scene."""
    names = (*TEMPERATURES, "emissivity")
    schema.check(scene, "separated", names, "the scene")
    temperature, background, emissivity = (
        scene[name].values.astype(np.float64).reshape(scene[name].shape[0], -1) for name in names
    )
    for name, values in zip(names[:2], (temperature, background), strict=True):
        if not np.all(schema.measured(values)):
            raise ValueError(f"Invalid {name} of the scene: not finite. Must be in kelvin.")
    if len(emissivity) < 2:
        raise ValueError("Invalid scene of one band. Must have at least two.")
    bad = ~((emissivity > 0) & (emissivity < 1))
    if np.any(bad):
        band = scene["band"].values[np.argmax(bad.any(axis=1))]
        message = f"Invalid emissivity {emissivity[bad][0]} in band '{band}' of the scene"
        raise ValueError(f"{message}. Must lie in (0, 1).")
    from scipy.stats import mode  # noqa: PLC0415 - slow to import, and nothing else here needs it

    # A pixel rests at its most frequent temperature, the lowest of several, if frames share it.
    level, frames = mode(background, axis=0)
    still = (background == level) & (frames > 1) & resting
    time = scene["time"].values.astype(np.float64)
    return Truth(time, temperature, background, emissivity, still)


def _identifiable(stds: dict[str, Array], emissivity: Array, reference: int, curve: Curve) -> Mask:
    """Quantities (quantity, pixel) that the capture determines better than their limits do."""
    limit = _UNIFORM * (curve.highest - curve.lowest)
    ratio = (1.0 - emissivity) / (1.0 - emissivity[reference])
    below = [np.sqrt(np.mean(stds[name] ** 2, axis=0)) < limit for name in TEMPERATURES]
    of_bands = stds["emissivity"] < _UNIFORM, stds["reflection_ratio"] < ratio
    return np.stack([*below, *(np.all(band, axis=0) for band in of_bands)])


def _dataset(scene: xr.Dataset, stds: dict[str, Array], maps: dict[str, Any]) -> xr.Dataset:
    """Bounds and maps on the grid of their scene."""
    image = scene["object_temperature"].shape[1:]
    stage = schema.STAGES["separated"]
    variables: dict[str, Any] = {}
    for name, values in stds.items():
        attrs = {"units": stage[name].units, "long_name": f"bound of {stage[name].long_name}"}
        rows = "time" if "temperature" in name else "band"
        variables[f"{name}_std"] = ((rows, "y", "x"), values.reshape(-1, *image), attrs)
    leading = {"resting": ("time",), "identifiable": ("quantity",)}
    for name, values in maps.items():
        dims = (*leading.get(name, ()), "y", "x")
        variables[name] = (dims, values.reshape(*values.shape[:-1], *image), {"units": "1"})
    coords = {name: scene[name] for name in ("band", "time", "y", "x") if name in scene.coords}
    origin = schema.origin(scene.attrs)
    return xr.Dataset(variables, {**coords, "quantity": list(QUANTITIES)}, origin)
