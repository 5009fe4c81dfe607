"""Efficiency: errors against the Cramer-Rao bounds."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import polynomials

from dbthermal import limits
from dbthermal.simulation import Rig
from reproduction import experiments

TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
Array = np.ndarray


@pytest.mark.parametrize("scale", [0.3, 1.0, 2.0])
def test_efficiency_at_any_noise(scale: float) -> None:
    """Noise unknown: errors of k2 scatter as the bound, the object is within 15 % of its bound."""
    noise = (0.03 * scale, 0.35 * scale)
    case = {**GLASS, "noise": noise, "noise_known": False}
    scene, result = experiments.run_case(case, Rig(), TIME, 1000, seed=12)
    response = Rig(noise=noise).response()
    strict = limits.bounds(scene, response)
    error = (result["reflection_ratio"] - 2.0).sel(band="9.5").values[0]
    free = spread(error / unknown_background(scene, noise, strict["order"].values[0]))
    rest = spread(error / strict["reflection_ratio_std"].sel(band="9.5").values[0])
    squared = (result["object_temperature"] - scene["object_temperature"]) ** 2
    of_object = [
        float(np.sqrt(squared.mean() / (limit["object_temperature_std"] ** 2).mean()))
        for limit in (limits.bounds(scene, response, resting=False, emissivity_std=0.29), strict)
    ]
    print(
        f"noise x {scale}: error of k2 over its bound {free:.3f}, {rest:.3f} if the frames at rest "
        f"are known; of the object {of_object[0]:.3f}, {of_object[1]:.3f}"
    )
    assert free == pytest.approx(1.0, abs=0.1)
    assert of_object[0] <= 1.15
    assert of_object[1] <= 1.2


def unknown_background(scene: xr.Dataset, noise: tuple[float, float], order: Array) -> Array:
    """Bound of k2 in each pixel with an unknown background in every frame."""
    cold = scene["background_temperature"].values[:, 0]
    result = np.empty(order.size)
    for one in np.unique(order):
        part, functions = order == one, polynomials(TIME, int(one))
        variance = limits.ratio_variance_bound((0.86, 0.72), noise, cold[:, part], functions)
        result[part] = np.sqrt(variance)
    return result


def spread(scores: Array) -> float:
    """Half of the width that holds the middle 68 %."""
    lower, upper = np.nanquantile(scores, [0.1587, 0.8413])
    return float(upper - lower) / 2
