"""Pooling over the pixels of a material: smaller errors, and no bleeding over borders."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from scenes import held

from dbthermal import separation
from dbthermal.simulation import Rig
from reproduction import experiments

RIG = Rig()
TIME = np.arange(350) / 10.0
GLASS: dict[str, Any] = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
Case = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def labels(*values: int | np.ndarray) -> xr.DataArray:
    """Labels (y, x) of an image one row high."""
    return xr.DataArray(np.hstack([np.atleast_1d(v) for v in values])[np.newaxis], dims=("y", "x"))


def one(pixels: int, label: int = 0) -> np.ndarray:
    """One label for some pixels."""
    return np.full(pixels, label)


def beside(*cases: Case) -> Case:
    """Images one row high, side by side; the response of the first."""
    columns = np.arange(sum(part[0].sizes["x"] for part in cases))
    scene, capture = (
        xr.concat([part[i] for part in cases], "x").assign_coords(x=columns) for i in (0, 1)
    )
    return scene, capture.transpose("band", "time", "y", "x"), cases[0][2]


def case(pixels: int, seed: int, **changes: Any) -> Case:
    """Scene, capture and response."""
    return experiments.simulate({**GLASS, **changes}, RIG, TIME, pixels, seed)


def error_of_ratio(result: xr.Dataset, truth: float = 2.0) -> float:
    """Root mean square error of the second band's reflection ratio."""
    return float(np.sqrt(((result["reflection_ratio"].sel(band="9.5") - truth) ** 2).mean()))


def test_shared_error_bars_are_true() -> None:
    """Errors of materials of ten pixels scatter as their standard deviations state."""
    scene, capture, response = case(1000, 3)
    pool = labels(np.repeat(np.arange(100), 10))
    result = separation.solve(capture, response, pool=pool)
    scores = ((result["reflection_ratio"] - 2.0) / result["reflection_ratio_std"]).sel(band="9.5")
    spread = float(scores.std())
    print(f"ratio: errors over their deviation {spread:.2f}")
    assert spread == pytest.approx(1.0, abs=0.2)
    assert 0.92 <= held(result, scene) <= 0.98
    assert held(result, scene, "emissivity") >= 0.92


@pytest.mark.parametrize("kind", [{"background": {"kind": "still"}}, {"emissivity": [0.8, 0.8]}])
def test_a_material_that_tells_nothing_says_so(kind: dict[str, Any]) -> None:
    """A material without information is NaN with a flag in every pixel."""
    _, capture, response = case(20, 7, **kind)
    shared = separation.solve(capture, response, pool=labels(one(20)))
    assert np.all(shared["status"] != 0)
    assert bool(shared["object_temperature"].isnull().all())


def test_wrong_labels_do_not_pull() -> None:
    """A pixel labelled with another's material keeps its own ratio, and so does the material."""
    loud = {"background": {"amplitude": 9.0}}
    scene, capture, response = beside(
        case(60, 8, **loud), case(3, 9, emissivity=[0.6, 0.45], **loud)
    )
    alone = separation.solve(capture, response)["reflection_ratio"].sel(band="9.5")
    shared = separation.solve(capture, response, pool=labels(one(63)))
    ratio = shared["reflection_ratio"].sel(band="9.5")
    np.testing.assert_allclose(ratio[0, 60:], alone[0, 60:], rtol=1e-5)
    assert abs(float(ratio[0, :60].mean()) - 2.0) < 0.02
    error = (shared["object_temperature"] - scene["object_temperature"]).isel(x=slice(60, None))
    assert float(np.sqrt((error**2).mean())) < 1.0  # [K]; 3 K with the ratio of glass


def test_two_materials_stay_apart() -> None:
    """Each label has its own ratio, whatever its number; pixels without one are alone."""
    parts = [
        case(50, 10 + n, emissivity=list(pair))
        for n, pair in enumerate([(0.86, 0.72), (0.6, 0.45), (0.86, 0.72)])
    ]
    _, capture, response = beside(*parts)
    pool = labels(one(50, 700), one(50, 3), one(50, -2))
    ratio = separation.solve(capture, response, pool=pool)["reflection_ratio"].sel(band="9.5")
    first, second, none = (ratio.values[0, i : i + 50] for i in (0, 50, 100))
    print(f"ratios {first[0]:.3f} (2), {second[0]:.3f} (1.375)")
    for values, truth in ((first, 2.0), (second, 1.375)):
        assert np.ptp(values) == 0
        assert abs(values[0] - truth) < 0.05
    alone = separation.solve(capture, response)["reflection_ratio"].sel(band="9.5")
    np.testing.assert_allclose(none, alone.values[0, 100:], rtol=1e-6)


@pytest.mark.parametrize(
    ("pool", "error", "message"),
    [
        (np.zeros((1, 20), int), TypeError, "Invalid pool of type ndarray"),
        (labels(np.zeros(20)), TypeError, "Invalid dtype float64 of the pool"),
        (labels(one(19)), ValueError, "Invalid size 19 of 'x' of the pool"),
        (labels(one(20)).transpose("x", "y"), ValueError, r"Invalid dims \('x', 'y'\) of the pool"),
    ],
)
def test_bad_labels_are_a_clear_error(pool: Any, error: type[Exception], message: str) -> None:
    """Invalid labels raise an error with the rule."""
    _, capture, response = case(20, 16)
    with pytest.raises(error, match=message):
        separation.solve(capture, response, pool=pool)
