"""The one entrance to all methods: checks, noise, tiles, threads."""

import operator
from concurrent.futures import ThreadPoolExecutor
from types import MappingProxyType
from typing import Final

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits

from dbthermal import noise as noise_of
from dbthermal import response as responses
from dbthermal import schema
from dbthermal.curves import Curve
from dbthermal.separation import calibrated, subspace, tiles
from dbthermal.separation.problem import Array, Problem

METHODS: Final = MappingProxyType(
    {"subspace": subspace.separate, "calibrated": calibrated.separate}
)
"""Method -> function that separates one tile."""

MINIMUM_FRAMES: Final = MappingProxyType({"subspace": 32, "calibrated": 1})
"""Fewest frames for each method."""

_NOISE_PIXELS: Final = 4096


def solve(
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: str = "subspace",
    *,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    response_kind: str = "exact",
    workers: int = 2,
) -> xr.Dataset:
    r"""
    Separate emission and reflection in a two-band capture.

    .. math:: I_m(t) = e_m U_m(x(t)) + (1 - e_m) U_m(y(t)) + \mathrm{noise}

    Parameters
    ----------
    corrected : Dataset
        `counts` (band, time, y, x) [count] of two bands, `time` [s]; optionally `status` (y, x)
        from `frames.correct`. May be lazy, as from `store.open_dataset`: it is read a few rows at
        a time, and never whole.
    response : Dataset
        From `calibration.fit_response`, with both bands. Its `noise` (band) [count] is used
        where present, otherwise the noise is estimated from the capture.
    method : {"subspace", "calibrated"}
        Emissivities unknown, or known.
    emissivity : DataArray, optional
        Known emissivity, (band) or (band, y, x) [1] in (0, 1); for "calibrated" only.
    emissivity_std : DataArray, optional
        Its standard deviation, same dims.
    response_kind : {"exact", "linear"}
        Sakuma-Hattori response, or the paper's linear one.
    workers : int
        Threads.

    Returns
    -------
    Dataset
        `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1], each with `_std`; `status` (y, x), bits of `schema.FLAGS`; `noise`
        (band) [count], as used. Values are NaN where a flag says that they are undefined; where
        the status is 0, all are finite. A given emissivity without a deviation has deviation 0.

    Raises
    ------
    TypeError
        If an argument is of the wrong type.
    ValueError
        If a dim, unit, band, coordinate, method, option or emissivity is not as described, or
        the capture is too short for the method. What is wrong with single pixels is not an
        error but a bit of `status`.

    Notes
    -----
    What no flag of `subspace` tells, because nothing in two bands tells it: an object that jumps
    as fast as a background; a background that drifts along with the object's curve (the
    temperature holds, the emissivity does not); bands that are a frame or more apart in time
    (0.6 K for glass at 60 C and 10 frames/s). With fewer than 100 frames the standard deviations
    are up to twice too small.

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal Videography, CVPR;
       doi:10.48550/arXiv.2509.11334
    """
    _check(corrected, method, workers, has_emissivity=emissivity is not None)
    names = [str(name) for name in corrected["band"].values]
    curves = [responses.curve(response, name, response_kind) for name in names]
    deviations = _noise(corrected, response, curves)
    given = tiles.known_emissivity(corrected, emissivity, emissivity_std)
    result = tiles.allocate(corrected, given)
    # The quieter band comes first: the regression for the emissivity needs a quiet ordinate.
    bands = [int(band) for band in np.argsort(deviations, kind="stable")]
    needed = corrected[[name for name in ("counts", "status") if name in corrected]]

    def work(rows: slice) -> None:
        part, target = needed.isel(y=rows).load(), result.isel(y=rows)
        for tile in tiles.cover(part):
            counts, status = tiles.read(part, tile)
            problem = _problem(counts, part, curves, deviations, bands)
            problem = tiles.with_emissivity(problem, tiles.rows_of(given, rows), tile, bands)
            tiles.write(target, tile, bands, METHODS[method](problem), status)

    with threadpool_limits(limits=1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        for _ in pool.map(work, tiles.blocks(corrected)):
            pass
    slopes = [curve.reference_slope for curve in curves]
    result["noise"] = xr.DataArray(
        deviations * slopes, dims="band", attrs={"units": "count", "long_name": "noise, as used"}
    )
    source = "response" if "noise" in response else "capture"
    return result.assign_attrs(method=method, response_kind=response_kind, noise_source=source)


def _problem(
    counts: Array, corrected: xr.Dataset, curves: list[Curve], deviations: Array, bands: list[int]
) -> Problem:
    """Linearised signals (2, time, pixel), the quieter band first."""
    first, second = bands
    return Problem(
        signals=np.stack(
            [curves[band].linearise(counts[band]) - curves[band].reference for band in bands]
        ),
        time=corrected["time"].values.astype(np.float64),
        curves=(curves[first], curves[second]),
        noise=(float(deviations[first]), float(deviations[second])),
    )


def _check(corrected: xr.Dataset, method: str, workers: int, *, has_emissivity: bool) -> None:
    schema.check(corrected, "corrected")
    tiles.check_status(corrected)
    if method not in METHODS:
        raise ValueError(f"Unknown method '{method}'. Must be one of {list(METHODS)}.")
    if operator.index(workers) < 1:
        raise ValueError(f"Invalid number of workers {workers}. Must be at least 1.")
    if corrected.sizes["band"] != 2:
        names = [str(name) for name in corrected["band"].values]
        raise ValueError(f"Invalid bands {names} of the capture. Must be exactly two.")
    frames = corrected.sizes["time"]
    if frames < MINIMUM_FRAMES[method]:
        raise ValueError(
            f"Invalid capture of {frames} frames for method '{method}'. "
            f"Must have at least {MINIMUM_FRAMES[method]}."
        )
    if has_emissivity and method == "subspace":
        raise ValueError("Invalid emissivity for method 'subspace', which estimates it. Omit it.")
    if not has_emissivity and method == "calibrated":
        raise ValueError("Missing emissivity. Method 'calibrated' must be given one.")


def _noise(corrected: xr.Dataset, response: xr.Dataset, curves: list[Curve]) -> Array:
    """Standard deviation of the linearised signals (band) [K]: calibrated, or from the capture."""
    if "noise" in response:
        slopes = np.array([curve.reference_slope for curve in curves])
        return np.asarray(responses.noise(response, [curve.band for curve in curves]) / slopes)
    counts = tiles.sample(corrected, _NOISE_PIXELS)
    signals = [curve.linearise(part) for curve, part in zip(curves, counts, strict=True)]
    return np.array(noise_of.estimate(signals[0], signals[1], corrected["time"].values))
