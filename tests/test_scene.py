"""From raw counts of two cameras to temperatures in one call, in memory and by rows."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import _rows, scene, simulation, store
from dbthermal.scene import separate_capture
from dbthermal.simulation import Rig
from reproduction.experiments import whole

SHAPE, RIG = (32, 40), Rig()


@pytest.fixture(scope="module")
def plate() -> tuple[xr.Dataset, xr.Dataset, xr.Dataset, xr.Dataset]:
    """Truth, raw capture, correction and response: glass that two cameras see from one place."""
    rng = np.random.default_rng(3)
    glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
    truth = simulation.walkers(np.arange(200) / 10.0, SHAPE, glass, rng)
    detector = simulation.pattern(RIG, SHAPE, rng)
    movies = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 6), 16, detector, rng)
    raw = simulation.capture(simulation.observe(truth, RIG.response(), rng), detector)
    return truth, raw, *whole.calibrate(movies)


def test_a_target_has_the_same_result(
    plate: tuple[xr.Dataset, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By rows, from a lazy capture to a store, the result is that of one call in memory."""
    _, raw, fitted, response = plate
    path = tmp_path / "raw.zarr"
    store.save(raw, path, {})
    monkeypatch.setattr(_rows, "_BLOCK", 100_000)
    options: dict[str, Any] = {"registration": None, "aligning": {"offset": 0.0}}
    at_once = separate_capture(raw, fitted, response, **options)
    lazy = separate_capture(
        store.open_dataset(path), fitted, response, **options, target=tmp_path / "all.zarr"
    )
    assert "..." in repr(lazy)  # not read
    for name in at_once.data_vars:
        # The level at which the residual pattern is stated is that of other samples.
        tolerance = 0.01 if str(name).endswith("_std") else 1e-6
        np.testing.assert_allclose(
            lazy[name], at_once[name], rtol=tolerance, atol=1e-5, err_msg=str(name)
        )


def test_blocks_of_rows_make_one_result(
    plate: tuple[xr.Dataset, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Separated by several blocks, every pixel has its value, and the bars hold."""
    truth, raw, fitted, response = plate
    monkeypatch.setattr(scene, "_MEMORY", 10 * scene.SAMPLE * raw["counts"][0, :, 0].size)
    result = separate_capture(
        raw,
        fitted,
        response,
        registration=None,
        aligning={"offset": 0.0},
        target=tmp_path / "all.zarr",
    ).load()
    assert result["object_temperature"].shape == truth["object_temperature"].shape
    error = abs(result["object_temperature"] - truth["object_temperature"])
    dead = result["status"] & np.uint32(1024)
    covered = (error < 1.96 * result["object_temperature_std"]).where(dead == 0)
    print(f"error {float(error.median()):.3f} K, covered {float(covered.mean()):.3f}")
    assert float(error.where(dead == 0).notnull().mean("time").where(dead == 0).mean()) == 1.0
    assert float(error.median()) < 0.1  # [K]
    assert 0.9 <= float(covered.mean()) <= 0.99
