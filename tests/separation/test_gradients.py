"""An emissivity that changes over its material: smoothly, from pixel to pixel, or at a border."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import separation, simulation
from dbthermal.separation._pooling import gradients
from dbthermal.simulation import Rig

RIG = Rig()
TIME = np.arange(300) / 10.0
SHAPE = (32, 40)
Y, X = np.meshgrid(np.linspace(-1, 1, SHAPE[0]), np.linspace(-1, 1, SHAPE[1]), indexing="ij")
PLACES = tuple(part.ravel() for part in np.indices((12, 15)))


def costs(value: np.ndarray, std: np.ndarray, seed: int) -> gradients.Cost:
    """Costs of pixels that tell values with a standard deviation."""
    measured = value + std * np.random.default_rng(seed).standard_normal(value.size)
    return gradients.Cost(std**-2, measured * std**-2, std**-2)


def fitted(value: np.ndarray, std: np.ndarray, seed: int) -> gradients.Gradient:
    """Gradient of values, at all places."""
    rows, columns = PLACES
    return gradients.fit((rows, columns), (rows, columns), costs(value, std, seed))


def test_a_polynomial_is_that_of_least_squares() -> None:
    """Values are those of weighted least squares; deviations are as if of one degree more."""
    rows, columns = (np.asarray(part, dtype=float) for part in PLACES)
    true = 2.0 + 0.02 * rows - 0.001 * columns**2
    std = np.where(columns > 7, 0.01, 0.03)
    scores, degrees = [], []
    for seed in range(40):
        found, cost = fitted(true, std, seed), costs(true, std, seed)
        powers = [
            rows**i * columns**j
            for i in range(found.degree + 1)
            for j in range(found.degree + 1 - i)
        ]
        design, measured = np.stack(powers, axis=1) / std[:, np.newaxis], cost.linear * std
        solution = np.linalg.lstsq(design, measured, rcond=None)[0]
        np.testing.assert_allclose(found.value, np.stack(powers, axis=1) @ solution, rtol=1e-9)
        scores.append((found.value - true) / np.sqrt(found.variance))
        degrees.append(found.degree)
    spread = float(np.sqrt(np.mean(np.square(scores))))
    print(f"scores {spread:.2f}; degrees {np.bincount(degrees)}")
    assert 0.6 < spread < 1.0
    assert np.mean(np.array(degrees) == 2) > 0.8


def test_a_constant_stays_one() -> None:
    """Equal pixels have neither gradient nor spread, but by chance."""
    fits = [fitted(np.full(180, 2.0), np.full(180, 0.03), seed) for seed in range(300)]
    wrong = np.mean([fit.degree > 0 for fit in fits])
    spread = np.mean([gradients.spreads([fit])[0] > 0 for fit in fits])
    print(f"false gradients {wrong:.3f}, false spreads {spread:.3f}")
    assert wrong < 0.02
    assert spread < 0.01
    assert gradients.spreads(fits) == [0.0] * 300


def test_a_spread_is_told_by_all_materials_together() -> None:
    """Of materials of a dozen pixels each, none of which tells it, the spread is found."""
    rng, fits = np.random.default_rng(0), []
    rows, columns = (part[:12] for part in PLACES)
    for seed in range(60):
        value = 2.0 + 0.03 * rng.standard_normal(12)
        cost = costs(value, np.full(12, 0.03), 100 + seed)
        fits.append(gradients.fit((rows, columns), (rows, columns), cost))
    found = np.sqrt(np.mean(gradients.spreads(fits)))
    seen = np.mean([gradients.spreads([fit])[0] > 0 for fit in fits])
    print(f"spread {found:.4f} (0.03); {seen:.0%} of the materials tell it alone")
    assert found == pytest.approx(0.03, rel=0.15)
    assert seen < 0.5


@pytest.mark.parametrize(
    ("border", "expected"), [("none", True), ("step", False), ("both", False), ("vague", False)]
)
def test_a_step_is_told_from_a_slope(border: str, expected: bool) -> None:
    """Regions go on into one another along a slope, not across a step, nor if nothing tells."""
    rows, columns = PLACES
    second = columns > 7
    value = 2.0 + (0.01 * columns if border in ("none", "both") else 0.0)
    value = value + (0.08 * second if border in ("step", "both") else 0.0) + 0.0 * rows
    std = np.full(180, 1.0 if border == "vague" else 0.03)
    right = 0
    for seed in range(50):
        measured = costs(value, std, seed).linear * std**2
        found = gradients.continuous(
            (rows, columns), measured[np.newaxis], std[np.newaxis] ** 2, second, np.array([0.2])
        )
        right += found is expected
    print(f"{border}: right {right} of 50")
    assert right >= 45


EMISSIVITIES: dict[str, Any] = {
    "constant": (0.86 + 0.0 * X, 0.72 + 0.0 * X),
    "slope": (0.9 - 0.05 * (X + 1.0), 0.7 - 0.025 * (Y + 1.0)),
    "bowl": (0.88 - 0.04 * (X**2 + Y**2), 0.74 - 0.06 * (X**2 + Y**2)),
    "two with slopes": (
        np.where(X > 0.1, 0.88 - 0.04 * Y, 0.92 - 0.02 * Y),
        np.where(X > 0.1, 0.74 - 0.06 * X**2, 0.86 - 0.02 * X**2),
    ),
}


@pytest.mark.parametrize("kind", EMISSIVITIES)
@pytest.mark.parametrize("seed", [11, 12])
def test_an_uneven_emissivity_is_pooled_with_true_bars(kind: str, seed: int) -> None:
    """Pooled pixels are better than single ones, and their intervals hold."""
    rng = np.random.default_rng(seed)
    maps = xr.DataArray(
        np.stack(EMISSIVITIES[kind]), {"band": list(RIG.bands)}, dims=("band", "y", "x")
    )
    scene = simulation.walkers(TIME, SHAPE, maps, rng)
    capture = simulation.observe(scene, RIG.response(), rng)
    figures = []
    for separate in (separation.solve, separation.separate):
        result = separate(capture, RIG.response())
        clean = result["status"].values == 0
        error = (result["object_temperature"] - scene["object_temperature"]).values[:, clean]
        held = np.abs(error) < 1.96 * result["object_temperature_std"].values[:, clean]
        figures.append((clean.mean(), held.mean(), np.sqrt(np.mean(error**2))))
    (alone, _, single), (share, held_in, pooled) = figures
    print(
        f"{kind}: {share:.3f} ({alone:.3f}), intervals {held_in:.3f}, {pooled:.4f} K ({single:.4f})"
    )
    assert share > alone
    assert 0.92 <= held_in <= 0.98
    assert pooled < 0.75 * single


def test_an_emissivity_that_differs_in_every_pixel_is_no_more_certain_than_that() -> None:
    """What single pixels scatter is in the deviations, and they keep most of their own ratio."""
    rng = np.random.default_rng(13)
    shape = (2, *SHAPE)
    glass = np.array([0.86, 0.72])[:, np.newaxis, np.newaxis]
    maps = xr.DataArray(
        glass + 0.01 * rng.standard_normal(shape),
        {"band": list(RIG.bands)},
        dims=("band", "y", "x"),
    )
    scene = simulation.walkers(TIME, SHAPE, maps, rng)
    capture, response = simulation.observe(scene, RIG.response(), rng), RIG.response()
    pool = xr.zeros_like(scene["object_temperature"][0], dtype=int)
    moving = separation.solve(capture, response)["status"].values == 0
    result = separation.solve(capture, response, pool=pool)
    ratio = (1.0 - maps[1]) / (1.0 - maps[0])
    scores = ((result["reflection_ratio"][1] - ratio) / result["reflection_ratio_std"][1]).values
    spread = [float(np.sqrt(np.mean(scores[part] ** 2))) for part in (moving, ~moving)]
    print(f"scores of the ratio: {spread[0]:.2f} moving, {spread[1]:.2f} still")
    assert spread == pytest.approx([1.0, 1.0], abs=0.2)


def test_three_bands_with_gradients() -> None:
    """The ratio of every band follows its own gradient."""
    rig = Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))
    rng = np.random.default_rng(14)
    parts = (0.9 - 0.03 * X, 0.74 - 0.02 * Y, 0.83 + 0.02 * X * Y)
    maps = xr.DataArray(np.stack(parts), {"band": list(rig.bands)}, dims=("band", "y", "x"))
    scene = simulation.walkers(TIME, SHAPE, maps, rng)
    capture, response = simulation.observe(scene, rig.response(), rng), rig.response()
    pool = xr.zeros_like(scene["object_temperature"][0], dtype=int)
    result = separation.solve(capture, response, pool=pool)
    moving = separation.solve(capture, response)["status"].values == 0
    ratio = ((1.0 - maps) / (1.0 - maps[0])).values[1:]
    error = abs(result["reflection_ratio"].values[1:] - ratio)
    held = (error < 1.96 * result["reflection_ratio_std"].values[1:]).mean()
    change, largest = np.ptp(ratio[:, moving], axis=1), error[:, moving].max(axis=1)
    print(f"ratios that change by {change} are off by {largest}, intervals {held:.3f}")
    assert held > 0.92
    assert np.all(largest < 0.1 * change)


def test_an_undulation_is_a_spread() -> None:
    """What undulates over some pixels is seen in squares of them, though their noise hides it."""
    rows, columns = np.divmod(np.arange(1600), 40)
    wave = 0.03 * np.sin(rows / 2.5) * np.sin(columns / 2.5)
    found, alone = [], []
    for seed in range(20):
        cost = costs(2.0 + wave, np.full(1600, 0.07), seed)
        fit = gradients.fit((rows, columns), (rows, columns), cost)
        found.append(gradients.spreads([fit])[0])
        alone.append(fit.left[0].excess()[0] > 3.0 * fit.left[0].excess()[1])
    print(
        f"spread {np.sqrt(np.mean(found)):.4f} of {wave.std():.4f}, in pixels {np.mean(alone):.2f}"
    )
    assert 0.7 < np.sqrt(np.mean(found)) / wave.std() < 1.3
    assert np.mean(alone) < 0.5
