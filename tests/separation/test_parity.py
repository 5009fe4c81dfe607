"""Compiled steps and the same steps on tensors: the same bits and values."""

import sys
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of

from dbthermal import separation, simulation

TIME = np.arange(240) / 10.0  # s
# Largest difference, relative to the deviation of a quantity or, of films in single precision, to
# a few roundings of 300 K.
ROUNDING = 1e-3
CASES: dict[str, dict[str, Any]] = {
    "glass": {},
    "nearly black": {"emissivity": (0.95, 0.88)},
    "metal": {"emissivity": (0.3, 0.15)},
    "three bands": {"emissivity": (0.86, 0.72, 0.8)},
    "five bands": {"emissivity": (0.86, 0.72, 0.8, 0.78, 0.84), "pattern_std": ("band", [4.0] * 5)},
    "shutter event": {"segment": ("time", (TIME > 9.0).astype(int))},
    "pattern": {"pattern_std": ("band", [11.5, 2.3])},
    "linear": {"response_kind": "linear"},
    "material": {"pool": xr.DataArray(np.indices((6, 8))[1] % 2, dims=("y", "x"))},
}


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    """Device of torch; a skip where it has none of the kind."""
    torch = pytest.importorskip("torch")
    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("torch has no CUDA device here: tensors on a GPU are not compared")
    return str(request.param)


@pytest.mark.parametrize("case", CASES)
def test_a_capture_on_a_device(case: str, device: str) -> None:
    """Bad, masked and saturated samples, rapid and constant objects, backgrounds at rest."""
    options = dict(CASES[case])
    emissivity = options.pop("emissivity", (0.86, 0.72))
    names = ("8-14", "9.5", "10.6", "12.1", "8.5")[: len(emissivity)]
    rig, rng = simulation.Rig(bands=names, noise=(0.03, 0.35, 0.15, 0.2, 0.1)[: len(names)]), 5
    known = emissivity_of(*emissivity, bands=names)
    scene = simulation.walkers(TIME, (6, 8), known, np.random.default_rng(rng), crossings=4)
    warm = scene["object_temperature"]
    scene["object_temperature"] = 293.15 + (warm - 293.15) * np.linspace(0.0, 1.0, 8)
    scene["object_temperature"][120:, :, 6] += 3.0
    scene["background_temperature"][:, 0] = 295.0
    capture = simulation.observe(scene, rig.response(), np.random.default_rng(rng))
    counts = capture["counts"].values  # (band, time, y, x)
    counts[0, 40:43, 2, 2] = counts[1, :, 5, 3] = np.nan
    high = np.quantile(counts, 0.9, axis=1, keepdims=True)
    np.minimum(counts, high, out=counts, where=np.arange(8) == 1)
    mask = np.full((TIME.size, 6, 8), True)
    mask[:20], mask[100:140, 3, 4] = False, False
    added = {name: options.pop(name) for name in ("segment", "pattern_std") if name in options}
    capture = capture.assign(added)
    options["mask"] = xr.DataArray(mask, dims=("time", "y", "x"))
    one, other = (
        separation.solve(capture, rig.response(), settings=settings, **options)
        for settings in (None, separation.SubspaceSettings(device=device))
    )
    np.testing.assert_array_equal(other["status"], one["status"])
    assert int(one["object_temperature"].notnull().any("time").sum()) >= 5
    for name in ("object_temperature", "background_temperature", "emissivity", "reflection_ratio"):
        value, expected, std = (
            part.values for part in (other[name], one[name], one[f"{name}_std"])
        )
        np.testing.assert_array_equal(np.isfinite(value), np.isfinite(expected))
        error, film = np.abs(value - expected), name.endswith("temperature")
        assert not np.any(error > ROUNDING * (std + 0.1 * film))


@pytest.mark.parametrize("name", ["cuda:99", "abacus", "meta"])
def test_a_device_that_is_not_there(name: str) -> None:
    """A device that torch does not have is refused with its name."""
    with pytest.raises(ValueError, match=f"Invalid device '{name}' of method 'subspace'. Must be"):
        separation.SubspaceSettings(device=name)


def test_a_device_without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """The error says which extra has the library."""
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ImportError, match=r"Missing library 'torch' for .*dbthermal\[torch\]"):
        separation.SubspaceSettings(device="cuda")
