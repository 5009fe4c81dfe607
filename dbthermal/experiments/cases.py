"""Seeded experiments that print what they measure: the separation's accuracy case by case."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import separation, simulation, smooth
from dbthermal.separation import limits
from dbthermal.simulation import Background, Rig


def score(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    """
    Errors of one separation, over the pixels that have a value.

    Parameters
    ----------
    truth : Dataset
        A scene of `simulation`.
    result : Dataset
        From `separation.solve`.

    Returns
    -------
    Dataset
        `object_temperature_rmse` [K]: root mean square over time, median over pixels;
        `emissivity_error` (band) [1]: median magnitude; `object_coverage`, and
        `emissivity_coverage` (band) [1]: share of errors within one standard deviation, 0.683 if
        the error bars are true; `good` and `with_temperature` [1]: share of pixels with no flag,
        and with an object temperature.
    """
    error = result["object_temperature"] - truth["object_temperature"]
    of_emissivity = abs(result["emissivity"] - truth["emissivity"])
    known, covered = error.notnull(), abs(error) < result["object_temperature_std"]
    within = (of_emissivity < result["emissivity_std"]).where(of_emissivity.notnull())
    pixels = ("y", "x")
    found = {
        "object_temperature_rmse": ((error**2).mean("time") ** 0.5).median(pixels),
        "emissivity_error": of_emissivity.median(pixels),
        "object_coverage": covered.where(known).mean(),
        "emissivity_coverage": within.mean(pixels),
        "good": (result["status"] == 0).mean(),
        "with_temperature": known.any("time").mean(),
    }
    units = {"object_temperature_rmse": "K"}
    return xr.Dataset(
        {
            name: value.reset_coords(drop=True).assign_attrs(units=units.get(name, "1"))
            for name, value in found.items()
        }
    )


def efficiency(
    truth: xr.Dataset, result: xr.Dataset, noise: tuple[float, float], order: int
) -> float:
    """
    Scatter of the reflection ratio over its Cramer-Rao bound.

    Parameters
    ----------
    truth : Dataset
        A scene of one material.
    result : Dataset
        From `separation.solve`.
    noise : tuple of float
        Standard deviation of the two bands' signals [K].
    order : int
        Size of the smooth subspace for the bound, see `limits.ratio_variance`.

    Returns
    -------
    float
        Robust standard deviation of error over bound [1]; 1 is the best possible.
    """
    emissivity = truth["emissivity"].values[:, 0, 0]
    background = truth["background_temperature"].values.reshape(truth.sizes["time"], -1)
    functions = smooth.basis(truth["time"].values, order)
    pair = (float(emissivity[0]), float(emissivity[1]))
    bound = np.sqrt(limits.ratio_variance(pair, noise, background, functions))
    found = limits.reflection_ratio(result["emissivity"].values.reshape(2, -1))
    scaled = (found - limits.reflection_ratio(emissivity)) / bound
    scaled = scaled[np.isfinite(scaled)]
    return float(np.diff(np.quantile(scaled, [0.1587, 0.8413]))[0] / 2)


def run_case(
    case: Mapping[str, Any], rig: Rig, time: np.ndarray, pixels: int, seed: int
) -> tuple[xr.Dataset, xr.Dataset]:
    """
    Simulate and separate one case.

    Parameters
    ----------
    case : mapping
        `emissivity` (two numbers), `start` and `stop` of the object [degree Celsius];
        optionally `background` (arguments of `simulation.Background`), `noise_known` (default
        true) and `response_kind` (default "exact").
    rig : Rig
        The rig.
    time : ndarray
        Times [s].
    pixels : int
        Number of pixels.
    seed : int
        Of the random numbers.

    Returns
    -------
    tuple of Dataset
        The scene, and the result.

    Raises
    ------
    ValueError
        If the case has a key that is not listed here, or lacks one.
    """
    needed, optional = {"emissivity", "start", "stop"}, {"background", "noise_known"}
    optional |= {"response_kind", "case"}
    if not needed <= case.keys() <= needed | optional:
        raise ValueError(
            f"Invalid case with keys {sorted(case)}. Must have {sorted(needed)}, "
            f"may have {sorted(optional)}."
        )
    rng = np.random.default_rng(seed)
    response = rig.response()
    pair = np.asarray(case["emissivity"], dtype=np.float64)
    emissivity = xr.DataArray(pair, dims="band", coords={"band": list(rig.bands)})
    scene = simulation.independent_pixels(
        time,
        emissivity,
        Background(**case.get("background", {})),
        pixels,
        rng,
        start=case["start"] + zero_Celsius,
        stop=case["stop"] + zero_Celsius,
    )
    capture = simulation.observe(scene, response, rng)
    if not case.get("noise_known", True):
        response = response.drop_vars(["noise", "netd"])
    kind = case.get("response_kind", "exact")
    return scene, separation.solve(capture, response, response_kind=kind)


def sweep(
    cases: Iterable[Mapping[str, Any]],
    rig: Rig,
    time: np.ndarray,
    pixels: int,
    seed: int,
    *,
    order: int = 5,
) -> xr.Dataset:
    """
    Run and score many cases, all with the same seed.

    Parameters
    ----------
    cases : iterable of mapping
        See `run_case`; each with a name `case`.
    rig, time, pixels, seed
        See `run_case`.
    order : int
        See `efficiency`.

    Returns
    -------
    Dataset
        Variables of `score`, and `efficiency` [1], over `case`.
    """
    rows, names = [], []
    for case in cases:
        scene, result = run_case(case, rig, time, pixels, seed)
        noise = (rig.noise[0], rig.noise[1])
        rows.append(score(scene, result).assign(efficiency=efficiency(scene, result, noise, order)))
        names.append(str(case["case"]))
    together = xr.concat(rows, dim=xr.DataArray(names, dims="case", name="case"))
    return together.assign_attrs(origin="simulated", pixels=pixels, seed=seed)
