"""Compiled steps and the same steps on tensors: the same bits and values."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
import tensors
import xarray as xr
from captures import emissivity_of

from dbthermal import separation, simulation
from dbthermal._smooth import Subspace, Whole
from dbthermal.separation._subspace import fused
from dbthermal.separation._subspace.fused import Solution
from dbthermal.separation._tiles import Tile

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


def on_tensors(
    tile: Tile,
    functions: Subspace,
    drift: float,
    divided: Iterable[tuple[Whole, Subspace]] | None = None,
) -> Solution:
    """Steps 1 to 4 on tensors; in pieces of time, pixels of the same pieces together."""
    if divided is None:
        return tensors.solve("cpu", tile, functions, drift)
    groups, every = zip(*divided, strict=True)
    per_pixel = [
        tensors.solve("cpu", tile.select_pixels(places), pieces, drift)
        for places, pieces in zip(groups, every, strict=True)
    ]
    order = np.argsort(np.concatenate(groups))
    fields = zip(*(vars(solution).values() for solution in per_pixel), strict=True)
    return Solution(*(np.concatenate(arrays, axis=-1)[..., order] for arrays in fields))


@pytest.mark.parametrize("case", CASES)
def test_a_capture_on_tensors(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
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
    one = separation.solve(capture, rig.response(), **options)
    monkeypatch.setattr(fused, "solve", on_tensors)
    other = separation.solve(capture, rig.response(), **options)
    np.testing.assert_array_equal(other["status"], one["status"])
    assert int(one["object_temperature"].notnull().any("time").sum()) >= 5
    for name in ("object_temperature", "background_temperature", "emissivity", "reflection_ratio"):
        value, expected, std, width = (
            it[f"{name}{end}"].values for end in ("", "_std") for it in (other, one)
        )
        np.testing.assert_array_equal(np.isfinite(value), np.isfinite(expected))
        error, film = np.abs(value - expected), name.endswith("temperature")
        assert not np.any(error > ROUNDING * (width + 0.1 * film))
        np.testing.assert_allclose(std, width, rtol=ROUNDING)
