"""Efficiency against the maximum likelihood of the exact model and the Cramer-Rao bounds."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.optimize import least_squares

from dbthermal import _smooth as smooth
from dbthermal import limits, separation
from dbthermal import response as responses
from dbthermal.response import Curve
from dbthermal.separation._subspace import reflection_ratio as direction
from dbthermal.simulation import Rig
from reproduction import experiments

TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
Array = np.ndarray


def orders_found(signals: Array, noise: Array) -> Array:
    """Size of the smooth subspace that the separator chooses for each pixel."""
    functions = smooth.subspace(TIME, direction.HIGHEST_ORDER)
    return direction.estimate(signals, functions, noise).order


def most_likely(
    signals: Array, curves: list[Curve], noise: Array, first: float, functions: Array, start: float
) -> tuple[float, Array]:
    """Ratio k2 and object [K] of the exact model; the background is eliminated frame by frame."""
    reference = curves[0].reference

    def left(unknown: Array) -> Array:
        reflectivity = (1.0 - first) * np.array([1.0, unknown[0]])[:, np.newaxis]
        warm = curves[1].temperature(functions @ unknown[1:] + reference)
        own = np.array([curve.signal(warm) - reference for curve in curves])
        reflected = (signals - (1.0 - reflectivity) * own) / reflectivity
        cold = curves[0].temperature(reflected[0] + reference)
        for _ in range(4):  # Gauss-Newton on the one background temperature of each frame
            slopes = reflectivity / noise * np.array([curve.slope(cold) for curve in curves])
            seen = np.array([curve.signal(cold) - reference for curve in curves])
            apart = reflectivity / noise * (reflected - seen)
            cold = cold + (slopes * apart).sum(axis=0) / (slopes**2).sum(axis=0)
        seen = np.array([curve.signal(cold) - reference for curve in curves])
        return np.asarray((reflectivity / noise * (reflected - seen)).ravel())

    smoothed = functions.T @ (signals[1] - start * signals[0]) / (1.0 - start)
    found = least_squares(left, [start, *smoothed], x_scale="jac", xtol=1e-12, ftol=1e-12).x
    return float(found[0]), curves[1].temperature(functions @ found[1:] + reference)


@pytest.mark.parametrize("amplitude", [3.0, 12.0])
def test_closed_form_is_the_maximum_of_likelihood(amplitude: float) -> None:
    """On the exact model a numerical search finds the same ratio and the same object."""
    case = {**GLASS, "background": {"amplitude": amplitude}}
    rig = Rig(highest=370.0)
    scene, capture, response = experiments.simulate(case, rig, TIME, 10, seed=8)
    result = separation.solve(capture, response)
    curves = [responses.curve(response, name) for name in rig.bands]
    counts = capture["counts"].values[:, :, 0].astype(float)
    signals = np.stack(
        [c.linearise(part) - c.reference for c, part in zip(curves, counts, strict=True)]
    )
    noise = responses.noise(response, list(rig.bands)) / [c.reference_slope for c in curves]
    ratio, std = (
        result[name].values[1, 0] for name in ("reflection_ratio", "reflection_ratio_std")
    )
    truth, closed = (data["object_temperature"].values[:, 0] for data in (scene, result))
    apart, errors = [], []
    for pixel, order in enumerate(orders_found(signals, noise)):
        found, warm = most_likely(
            signals[..., pixel],
            curves,
            noise[:, np.newaxis],
            float(result["emissivity"].values[0, 0, pixel]),
            smooth.polynomial_basis(TIME, int(order)),
            float(ratio[pixel]),
        )
        apart.append((found - ratio[pixel]) / std[pixel])
        errors.append([np.mean((w - truth[:, pixel]) ** 2) for w in (closed[:, pixel], warm)])
    of_closed, of_likely = np.sqrt(np.mean(errors, axis=0))
    print(
        f"{amplitude:.0f} K: k2 within {np.max(np.abs(apart)):.3f} deviations, object RMSE "
        f"{of_closed:.4f} K, most likely {of_likely:.4f} K"
    )
    assert np.max(np.abs(apart)) < 0.15
    assert of_closed < 1.03 * of_likely


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
        part, functions = order == one, smooth.polynomial_basis(TIME, int(one))
        variance = limits.ratio_variance_bound((0.86, 0.72), noise, cold[:, part], functions)
        result[part] = np.sqrt(variance)
    return result


def spread(scores: Array) -> float:
    """Half of the width that holds the middle 68 %."""
    lower, upper = np.nanquantile(scores, [0.1587, 0.8413])
    return float(upper - lower) / 2
