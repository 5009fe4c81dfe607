"""The one entrance to all methods: checks, noise, tiles, threads."""

import operator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from dbthermal import noise as noise_of
from dbthermal import response as responses
from dbthermal import schema
from dbthermal.curves import Curve
from dbthermal.separation import given, methods, tiles
from dbthermal.separation.problem import Array, Method, Problem, Separated

_NOISE_PIXELS: Final = 4096


def solve(  # noqa: PLR0913 - the one entrance; all but the first three are by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: str = "subspace",
    *,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    truth: xr.DataArray | None = None,
    response_kind: str = "exact",
    workers: int = 2,
    seed: int = 0,
    progress: bool = False,
    **options: Any,
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
    method : {"subspace", "calibrated", "dbvt", "naive", "ratio", "bcp", "apparent"}
        This project's separator; known emissivities; the paper's optimiser; and to compare with,
        least squares, dual-wavelength pyrometry, the blackbody channel prior, and the camera's
        own reading.
    emissivity : DataArray, optional
        Known emissivity, (band) or (band, y, x) [1] in (0, 1); for "calibrated" only.
    emissivity_std : DataArray, optional
        Its standard deviation, same dims.
    truth : DataArray, optional
        True object temperature (time, y, x) [K], for an oracle's choice (option of "naive").
    response_kind : {"exact", "linear"}
        Sakuma-Hattori response, or the paper's linear one.
    workers : int
        Threads.
    seed : int
        Of the random starts; the result depends on it and not on `workers`.
    progress : bool
        Show a bar.
    **options
        Options of the method, the fields of its module's `Settings`.

    Returns
    -------
    Dataset
        `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1], each with `_std`; `status` (y, x), bits of `schema.FLAGS`; `noise`
        (band) [count], as used. Values are NaN where a flag says that they are undefined, and
        those that a method never estimates (attribute `not_estimated`); where the status is 0, all
        others are finite. A given emissivity without a deviation has deviation 0.

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
    module, settings = methods.get(method), methods.settings(method, options)
    _check(corrected, method, module, (workers, seed), has_emissivity=emissivity is not None)
    if (truth is not None) != bool(getattr(settings, "oracle", False)):
        raise ValueError(
            f"Invalid truth for method '{method}'. Must be given with the option oracle=True of a "
            "method that has it, and only then."
        )
    names = [str(name) for name in corrected["band"].values]
    curves = [responses.curve(response, name, response_kind) for name in names]
    deviations = _noise(corrected, response, curves)
    known = given.check(corrected, emissivity, emissivity_std, truth)
    result = tiles.allocate(corrected)
    # The quieter band comes first: the regression for the emissivity needs a quiet ordinate.
    bands = [int(band) for band in np.argsort(deviations, kind="stable")]
    needed = corrected[[name for name in ("counts", "status") if name in corrected]]
    separate = module.separate if settings is None else partial(module.separate, settings=settings)
    pixels = corrected.sizes["y"] * corrected.sizes["x"]
    batch = pixels if module.whole_image else getattr(settings, "batch", tiles.PIXELS)

    def work(rows: slice) -> None:
        part, target = needed.isel(y=rows).load(), result.isel(y=rows)
        for tile in tiles.cover(part, batch):
            counts, status = tiles.read(part, tile)
            place = tiles.moved(tile, rows.start)
            problem = Problem(
                signals=_signals(counts, curves, bands),
                time=part["time"].values.astype(np.float64),
                curves=(curves[bands[0]], curves[bands[1]]),
                noise=(float(deviations[bands[0]]), float(deviations[bands[1]])),
                shape=tiles.shape_of(tile),
                rng=tiles.generator(seed, place),
            )
            found: Separated = separate(known.put_into(problem, place, bands))
            tiles.write(target, tile, bands, found, status)
            bar.update(counts.shape[-1])

    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(workers) as pool,
        tqdm(total=pixels, unit="pixel", desc=method, disable=not progress) as bar,
    ):
        for _ in pool.map(work, tiles.blocks(corrected, whole_image=module.whole_image)):
            pass
    counts_per_kelvin = np.array([curve.reference_slope for curve in curves])
    attrs = {"units": "count", "long_name": "noise, as used"}
    result["noise"] = xr.DataArray(deviations * counts_per_kelvin, dims="band", attrs=attrs)
    return result.assign_attrs(
        method=method,
        response_kind=response_kind,
        noise_source="response" if "noise" in response else "capture",
        emissivity_source="capture" if emissivity is None else "given",
        not_estimated=" ".join(module.not_estimated),
        **({} if settings is None else {"settings": repr(settings)}),
    )


def _signals(counts: Array, curves: list[Curve], bands: list[int]) -> Array:
    """Linearised signals less the reference temperature (2, time, pixel) [K], in this order."""
    parts = [curves[band].linearise(counts[band]) - curves[band].reference for band in bands]
    return np.stack(parts)


def _check(
    corrected: xr.Dataset,
    name: str,
    method: Method,
    whole: tuple[int, int],
    *,
    has_emissivity: bool,
) -> None:
    workers, seed = whole
    schema.check(corrected, "corrected")
    tiles.check_status(corrected)
    if operator.index(workers) < 1:
        raise ValueError(f"Invalid number of workers {workers}. Must be at least 1.")
    if operator.index(seed) < 0:
        raise ValueError(f"Invalid seed {seed}. Must be zero or positive.")
    if corrected.sizes["band"] != 2:
        names = [str(name) for name in corrected["band"].values]
        raise ValueError(f"Invalid bands {names} of the capture. Must be exactly two.")
    frames = corrected.sizes["time"]
    if frames < method.minimum_frames:
        raise ValueError(
            f"Invalid capture of {frames} frames for method '{name}'. "
            f"Must have at least {method.minimum_frames}."
        )
    if has_emissivity and not method.knows_emissivity:
        raise ValueError(f"Invalid emissivity for method '{name}', which estimates it. Omit it.")
    if not has_emissivity and method.knows_emissivity:
        raise ValueError(f"Missing emissivity. Method '{name}' must be given one.")


def _noise(corrected: xr.Dataset, response: xr.Dataset, curves: list[Curve]) -> Array:
    """Standard deviation of the linearised signals (band) [K]: calibrated, or from the capture."""
    if "noise" in response:
        slopes = np.array([curve.reference_slope for curve in curves])
        return np.asarray(responses.noise(response, [curve.band for curve in curves]) / slopes)
    counts = tiles.sample(corrected, _NOISE_PIXELS)
    signals = [curve.linearise(part) for curve, part in zip(curves, counts, strict=True)]
    return np.array(noise_of.estimate(signals[0], signals[1], corrected["time"].values))
