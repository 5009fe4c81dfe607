"""The paper's optimiser: its losses and gradient beside torch's, and its minima."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import schema, separation, simulation
from dbthermal.simulation import Background, Rig
from reproduction.experiments import optimisers
from reproduction.methods.dbvt import METHOD, DbvtSettings

TIME = np.arange(350) / 10.0
GLASS = (0.86, 0.72)
QUIET = (0.003, 0.03)
Scene = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def glass(noise: tuple[float, float], pixels: int, seed: int = 41) -> Scene:
    """Scene, capture and response: glass from 20 to 60 C, someone walking by."""
    rig, rng = Rig(noise=noise), np.random.default_rng(seed)
    emissivity = xr.DataArray(list(GLASS), dims="band", coords={"band": list(rig.bands)})
    scene = simulation.independent_pixels(
        TIME, emissivity, Background(), pixels, rng, start=293.15, stop=333.15
    )
    return scene, simulation.observe(scene, rig.response(), rng), rig.response()


def errors(scene: xr.Dataset, result: xr.Dataset) -> tuple[float, float]:
    """Median error of the worse emissivity [1], and median RMSE of the object [K]."""
    of_emissivity = abs(result["emissivity"] - scene["emissivity"]).max("band")
    of_object = result["object_temperature"] - scene["object_temperature"]
    return float(of_emissivity.median()), float(((of_object**2).mean("time") ** 0.5).median())


def test_losses_and_gradient_are_torch_s() -> None:
    """The five compiled losses and their slopes are those of the paper's equations in torch."""
    start, _ = optimisers.plate(GLASS, (0.03, 0.35), 60, 6, seed=2)
    apart = optimisers.disagreements(start, np.random.default_rng(3))
    np.testing.assert_allclose(apart, 0.0, rtol=0, atol=1e-9)  # [1]


@pytest.mark.parametrize(
    ("noise", "pixels"), [(QUIET, 20), pytest.param((0.03, 0.05), 50, marks=pytest.mark.slow)]
)
def test_random_starts_find_the_emissivities(noise: tuple[float, float], pixels: int) -> None:
    """From random emissivities the median error at low noise is below 0.02, the object's 0.3 K."""
    scene, capture, response = glass(noise, pixels)
    result = separation.solve(capture, response, METHOD, seed=3)
    of_emissivity, of_object = errors(scene, result)
    assert of_emissivity < 0.02
    assert of_object < 0.3
    assert float((result["status"] == 0).mean()) > 0.9


@pytest.mark.slow
def test_a_start_at_the_separator_is_as_good_as_random_ones() -> None:
    """Started at the subspace separator it ends no higher, and everywhere with a result."""
    scene, capture, response = glass((0.03, 0.35), 40)
    random = separation.solve(capture, response, METHOD, seed=3)
    start = DbvtSettings(start="subspace")
    started = separation.solve(capture, response, METHOD, settings=start, seed=3)
    of_random, of_started = errors(scene, random), errors(scene, started)
    assert np.all(np.array(of_started) <= 1.1 * np.array(of_random))
    assert bool(started["emissivity"].notnull().all())


def test_exact_response_is_taken_out() -> None:
    """Taking out the bend of the exact response at least halves the emissivity's error."""
    scene, capture, response = glass(QUIET, 15)
    bent, straight = (
        errors(scene, separation.solve(capture, response, METHOD, settings=settings))
        for settings in (DbvtSettings(bend_updates=0), None)
    )
    assert straight[0] < 0.5 * bent[0]


def test_too_few_steps_are_flagged() -> None:
    """A pixel that still improves at its last step is flagged as not converged."""
    _, capture, response = glass(QUIET, 8)
    result = separation.solve(capture, response, METHOD, settings=DbvtSettings(stages=1, steps=2))
    assert np.all(result["status"].values & schema.Status.NOT_CONVERGED)
