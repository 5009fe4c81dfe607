"""The steps stated for arrays: those compiled for two bands, and tensors, repeat them."""

import sys
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import _smooth as smooth
from dbthermal import response, separation, simulation
from dbthermal.separation._subspace import (
    division,
    fused,
    pieces,
    steps,
)
from dbthermal.separation._tiles import Material, Tile

RIG = simulation.Rig()
TIME = np.arange(240) / 10.0  # s
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})
# Largest difference, relative to the deviation of a quantity or, if it has none, to its size.
ROUNDING = 1e-3
SATURATED = np.arange(8) == 1  # (x), at the top tenth of what they show


def tile_of(emissivity: tuple[float, float] = (0.86, 0.72), highest: float = 353.15) -> Tile:
    """Pixels of a scene with walkers, of which some show a constant object or background."""
    rng = np.random.default_rng(3)
    known = GLASS.copy(data=list(emissivity))
    scene = simulation.walkers(TIME, (6, 8), known, rng, crossings=4)
    warm = scene["object_temperature"]
    scene["object_temperature"] = 293.15 + (warm - 293.15) * np.linspace(0.0, 1.0, 8)
    scene["background_temperature"][:, 0] = 295.0
    table = RIG.response()
    counts = simulation.observe(scene, table, rng)["counts"].values.reshape(2, TIME.size, -1)
    curves = [replace(response.curve(table, name), highest=highest) for name in RIG.bands]
    signals = [c.linearise(part) - c.reference for c, part in zip(curves, counts, strict=True)]
    noise = [float(table["noise"][band]) / c.reference_slope for band, c in enumerate(curves)]
    order = np.argsort(noise)
    return Tile(
        signals=np.stack([signals[band] for band in order]),
        time=TIME,
        curves=tuple(curves[band] for band in order),
        noise=tuple(noise[band] for band in order),
        shape=(6, 8),
        rng=rng,
    )


def material() -> Material:
    """Material of half the pixels, close to what they show; its emissivity for a quarter."""
    half = np.arange(48) % 2 == 0
    spread = np.where(np.arange(48) % 8 == 0, 3e-5, 0.0)
    values: dict[str, Any] = {"inverse_energy": 1e-4, "noise_variance": 1e-5}
    values |= {"drift_variance": 2e-5, "spread": spread}
    parts = {name: np.where(half, value, np.nan) for name, value in values.items()}
    ratio = np.where(half, np.array([[1.0], [2.0]]), np.nan)
    return Material(ratio=ratio, emissivity=np.where(np.arange(48) % 4 == 0, 0.86, np.nan), **parts)


CASES = {
    "glass": {},
    "nearly black": {"emissivity": (0.95, 0.88)},
    "metal": {"emissivity": (0.3, 0.15)},
    "beyond the response": {"highest": 298.0},
}


def assert_alike(one: steps.Solution, other: steps.Solution) -> None:
    """Fail if a quantity of a solution differs from that of arrays by more than rounding.

    Where the ratios are those of noise, and the object is not defined, only step 1 is compared.
    """
    sound = np.isfinite(other.inverse_energy) & (other.epsilon_variance < 0.05)
    one, other = one.select_pixels(sound), other.select_pixels(sound)
    assert sound.sum() >= 20
    scales = {
        # Of single precision: a few roundings of 300 K are 1e-4 K.
        "object_temperature": 0.1 + other.object_temperature_std,
        "background_temperature": 0.1 + other.background_temperature_std,
        "emissivity": np.sqrt(np.einsum("bbp->bp", other.emissivity_covariance)),
        "ratio": np.sqrt(other.ratio_variance),
    }
    for field in fields(steps.Solution):
        a, b = (np.asarray(getattr(part, field.name), dtype=float) for part in (one, other))
        known = np.isfinite(b)
        np.testing.assert_array_equal(np.isfinite(a), known, field.name)
        scale = scales.get(field.name, np.abs(b) + 1e-3 * np.abs(b[known]).mean()) + 1e-12
        error = np.abs(a[known] - b[known]) / np.broadcast_to(scale, b.shape)[known]
        assert error.max() < ROUNDING, field.name


def posed(case: str, way: str) -> tuple[Tile, smooth.Subspace]:
    """Tile of a case, and the functions of time that one way of posing it has."""
    tile = tile_of(**CASES[case])  # type: ignore[arg-type]
    segment = (TIME > 9.0).astype(np.intp)
    functions = smooth.subspace(TIME, 14, segment=segment if way == "steps" else None)
    if way == "pieces":
        functions = smooth.piecewise(
            TIME, np.isin(np.arange(TIME.size), [0, 100, 130]), functions.rising
        )
    if way == "material":
        tile = replace(tile, material=material())
    if way == "pattern":
        tile = replace(tile, pattern=(0.1, 0.2))
    if way == "linear":
        table = RIG.response()
        lines = {name: response.curve(table, name, "linear") for name in RIG.bands}
        tile = replace(tile, curves=tuple(lines[curve.band] for curve in tile.curves))
    return tile, functions


WAYS = ["plain", "steps", "pieces", "material", "pattern", "linear"]


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("least", [0.0, 0.2])
@pytest.mark.parametrize("way", WAYS)
def test_compiled_steps_are_those_of_arrays(case: str, least: float, way: str) -> None:
    """Every quantity of every kind of pixel is the same in both forms, within rounding."""
    tile, functions = posed(case, way)
    with np.errstate(all="ignore"):
        one = fused.solve(tile, functions, 3.0, least)
        other = steps.solve(tile, functions, 3.0, least)
    assert_alike(one, other)


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> str:
    """Device of torch; a skip where it has none of the kind."""
    if request.param == "cuda" and not pytest.importorskip("torch").cuda.is_available():
        pytest.skip("torch has no CUDA device here: tensors on a GPU are not compared")
    return str(request.param)


@pytest.mark.parametrize("names", [("8-14", "9.5"), ("8-14", "9.5", "10.6")])
def test_a_capture_on_a_device(
    names: tuple[str, ...], device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bad, masked and saturated samples, rapid objects: the same bits; values within rounding."""
    rig = simulation.Rig(bands=names, noise=(0.03, 0.35, 0.15)[: len(names)])
    known = xr.DataArray([0.86, 0.72, 0.8][: len(names)], {"band": list(names)}, "band")
    scene = simulation.walkers(TIME, (6, 8), known, np.random.default_rng(5), crossings=4)
    scene["object_temperature"][120:, :, 6] += 3.0
    capture = simulation.observe(scene, rig.response(), np.random.default_rng(5))
    counts = capture["counts"].values  # (band, time, y, x)
    counts[0, 40:43, 2, 2] = counts[1, :, 5, 3] = np.nan
    np.minimum(counts, np.quantile(counts, 0.9, axis=1, keepdims=True), out=counts, where=SATURATED)
    mask = xr.DataArray(np.full((TIME.size, 6, 8), True), dims=("time", "y", "x"))
    mask[:20], mask[100:140, 3, 4] = False, False
    settings = separation.SubspaceSettings(device=device)
    one = separation.solve(capture, rig.response(), mask=mask)
    monkeypatch.setattr(fused, "solve", None)
    other = separation.solve(capture, rig.response(), mask=mask, settings=settings)
    np.testing.assert_array_equal(other["status"], one["status"])
    assert (one["status"] == 0).sum() >= 20
    for name in ("object_temperature", "background_temperature", "emissivity", "reflection_ratio"):
        value, expected, std = (
            part.values for part in (other[name], one[name], one[f"{name}_std"])
        )
        np.testing.assert_array_equal(np.isfinite(value), np.isfinite(expected))
        error, films = np.abs(value - expected), name.endswith("temperature")
        print(f"{name}: {np.nanmax(error):.1e}")
        # Films are of single precision: a few roundings of 300 K are 1e-4 K.
        assert not np.any(error > ROUNDING * (std + 0.1 * films))


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


@pytest.mark.parametrize("way", ["plain", "uneven", "steps", "known", "short", "long"])
def test_compiled_divisions_are_those_of_arrays(way: str) -> None:
    """Objects that change rapidly, beside walkers: the same pieces, and costs but for rounding."""
    tile, rng = tile_of(), np.random.default_rng(4)
    frames = {"short": 60, "long": 3000}.get(way, TIME.size)
    time = np.arange(frames) / 10.0
    if way == "uneven":
        time = np.sort(rng.choice(4 * frames, frames, False)) / 40
    signals = np.resize(tile.signals.swapaxes(0, 1), (frames, 2, 48)).swapaxes(0, 1).copy()
    if way == "long":  # pieces of more frames than are summed up together
        noise = np.array(tile.noise)[:, np.newaxis, np.newaxis]
        signals = signals.mean(axis=1, keepdims=True) + noise * rng.normal(size=signals.shape)
    for pixel in range(48):
        at = rng.integers(5, frames - 5)
        rise = 1.0 - np.exp(-np.arange(frames - at) / rng.uniform(1.0, 40.0))
        signals[:, at:, pixel] += np.outer([0.86, 0.72], rng.normal() * 5.0 * rise)
    segment = None
    if way == "steps":
        segment = np.cumsum(np.isin(np.arange(frames), [90, 97, 200])).astype(np.intp)
    known = np.stack([np.ones(48), np.where(np.arange(48) % 2, 2.0, np.nan)])
    args = signals, time, np.array(tile.noise), segment, known if way == "known" else None
    finite = 0
    with np.errstate(all="ignore"):
        pairs = zip(division.divide(*args), pieces.divide(*args), strict=True)
    for one, other in pairs:
        some = np.isfinite(other.cost)
        np.testing.assert_array_equal(np.isfinite(one.cost), some)
        np.testing.assert_allclose(one.cost[some], other.cost[some], rtol=1e-8)
        np.testing.assert_array_equal(one.first[:, some], other.first[:, some])
        finite += int((other.first[:, some].sum(axis=0) > 1).sum())
    assert finite > 20


def test_compiled_once() -> None:
    """Signals of any layout, steps, pieces and materials are of one compiled kind."""
    tile = tile_of()
    turned = replace(tile, signals=np.asfortranarray(tile.signals), material=material())
    for one in (tile, turned, tile.select_pixels(np.arange(48) > 9)):
        fused.solve(one, smooth.subspace(TIME, 14, segment=(TIME > 9.0).astype(int)), 3, 0)
    assert len(getattr(fused._separate, "signatures")) == 1  # noqa: B009
