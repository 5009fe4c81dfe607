"""Materials from the data: borders are kept, and one material stays one region."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scenes import PAIR, Scene, Shelf, mosaic, observed
from scipy import ndimage
from worlds import RESPONSE, World, seen

from dbthermal import separation, simulation
from dbthermal.separation import materials

Array = np.ndarray
NONE = -1
TIME = np.arange(350) / 10.0
SHAPES: dict[str, Callable[[Array, Array], Array]] = {
    "one": lambda y, x: x + y > 9,
    "side by side": lambda y, x: x + 0 * y >= 0,
    "oblique": lambda y, x: x + 0.45 * y > 0,
    "disc": lambda y, x: (x - 0.1) ** 2 + (0.75 * y) ** 2 < 0.56**2,
}
Inputs = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def where(name: str, shape: tuple[int, int]) -> Array:
    """Mask of the second material; the image reaches from -1 to 1 in both directions."""
    return SHAPES[name](*np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"))


def scene_of(second: Array, seed: int, time: Array = TIME) -> Scene:
    """Glass and concrete, heated by a spot across their border, while eight people walk by."""
    rng, warmth = np.random.default_rng(seed), (295.15, 307.15, 333.15)  # room, people, hottest [K]
    options: dict[str, Any] = {"temperatures": warmth, "crossings": 8}
    pairs = mosaic(*PAIR, of=second.astype(int))
    return observed(simulation.walkers(time, second.shape, pairs, rng, **options), rng)


@pytest.fixture(scope="module")
def small(shelf: Shelf) -> Inputs:
    """Result, capture and response: two materials side by side, 48 by 64 pixels."""

    def solved() -> Inputs:
        scene = scene_of(where("side by side", (48, 64)), 2, TIME[:200])
        return separation.solve(scene.capture, scene.response), scene.capture, scene.response

    return shelf.kept("side by side", solved)


def judged(labels: Array, second: Array) -> tuple[float, int]:
    """Share of the pixels farther than 2 pixels from the border that carry their material's main
    label, and the number of labels that are on both sides there.
    """
    sides = [side for side in (second, ~second) if side.any()]
    apart = ndimage.distance_transform_edt(second) + ndimage.distance_transform_edt(~second)
    far = [side & ((apart > 2) | side.all()) for side in sides]
    main = [np.bincount(labels[side & (labels != NONE)]).argmax() for side in far]
    right = sum(int(np.sum(labels[side] == label)) for side, label in zip(far, main, strict=True))
    found = [set(np.unique(labels[side])) - {NONE} for side in far]
    bleeding = len(found[0] & found[1]) if len(found) == 2 else 0
    return right / sum(int(side.sum()) for side in far), bleeding


@pytest.mark.parametrize(
    ("name", "shape", "seed"),
    [
        ("side by side", (96, 128), 4),
        pytest.param("oblique", (144, 192), 5, marks=pytest.mark.slow),
        pytest.param("disc", (144, 192), 6, marks=pytest.mark.slow),
        pytest.param("one", (96, 128), 7, marks=pytest.mark.slow),
    ],
)
def test_borders_are_kept(name: str, shape: tuple[int, int], seed: int) -> None:
    """From a separation of the twin, 99 % of what is 2 pixels from a border has its material."""
    second = where(name, shape)
    scene = scene_of(second, seed)
    result = separation.solve(scene.capture, scene.response)
    labels = materials(result, scene.capture, scene.response).values
    share, bleeding = judged(labels, second)
    print(f"{name}: {share:.2%} with the main label, {bleeding} labels bleed, {labels.max() + 1}")
    assert share >= 0.99
    assert bleeding == 0
    assert labels.max() + 1 <= 4
    # What lies at a border that is found within 2 pixels may belong to none.
    inside = ndimage.maximum_filter(second, 7) == ndimage.minimum_filter(second, 7)
    assert np.mean((labels == NONE)[inside]) < 0.02


def test_labels_are_an_image_and_hang_on_no_order(small: Inputs) -> None:
    """Labels are ordered by size; inputs stay as they are; the quieter band is the reference."""
    before = [part.copy(deep=True) for part in small]
    labels = materials(*small)
    assert labels.dims == ("y", "x")
    assert labels.dtype == np.int32
    assert labels.attrs["units"] == "1"
    sizes = np.bincount(labels.values[labels.values != NONE], minlength=1)
    assert np.all(np.diff(sizes) <= 0)
    for part, copy in zip(small, before, strict=True):
        xr.testing.assert_identical(part, copy)
    result, capture, response = small
    exchanged = materials(result.isel(band=[1, 0]), capture.isel(band=[1, 0]), response)
    xr.testing.assert_identical(exchanged, labels)
    regions = materials(*small, borders=True).values  # each in one piece
    assert all(ndimage.label(regions == one)[1] == 1 for one in np.unique(regions[regions != NONE]))


def test_pixels_without_a_signal_have_no_material(small: Inputs) -> None:
    """Dead pixels, and those that are NaN in a band, are -1; whole frames of NaN are left out."""
    result, capture, response = small
    capture, status = capture.copy(deep=True), result["status"].copy(deep=True)
    capture["counts"].values[0, 30:40] = np.nan
    capture["counts"].values[1, :, 5, 6] = np.nan
    status.values[20, 9] = 1024
    labels = materials(result.assign(status=status), capture, response).values
    assert labels[5, 6] == labels[20, 9] == NONE
    plain = materials(*small).values
    assert np.mean(labels != NONE) > np.mean(plain != NONE) - 0.01


def test_silence_is_no_agreement(small: Inputs) -> None:
    """Pixels with a still background are not added to the material beside; of none all are -1."""
    result, capture, response = small
    right = xr.DataArray(where("side by side", (48, 64)), dims=("y", "x"))
    for silent in (right, xr.ones_like(right)):
        left = result.assign(reflection_ratio=result["reflection_ratio"].where(~silent))
        labels = materials(left, capture, response).values
        assert np.all(labels[:, 44:] == NONE)  # farther from the border than a cell is wide
        assert np.all(labels == NONE) == bool(silent.all())


def test_ratio_of_a_material_hangs_on_no_reference() -> None:
    """The temperature about which responses are linearised changes it by less than its error."""
    capture, _ = seen(World(), 2)
    results = []
    for kelvin in (263.0, 318.0):
        about = {"reference_temperature": xr.full_like(RESPONSE["reference_temperature"], kelvin)}
        results.append(separation.separate(capture, RESPONSE.assign(about)))
    ratios = [result["reflection_ratio"].values for result in results]
    std = results[0]["reflection_ratio_std"].values
    off = np.abs(ratios[1] - ratios[0])[1] / std[1]
    print(f"{np.nanquantile(off, (0.5, 0.9))} deviations apart")
    assert np.nanquantile(off, 0.9) < 1.0


def test_pixels_of_no_material_keep_what_they_tell_alone(small: Inputs) -> None:
    """At one place they are separated again, with the same films and maps to the last bit."""
    per_pixel, capture, response = small
    labels = xr.DataArray(np.where(where("disc", (48, 64)), 0, NONE), dims=("y", "x"))
    pooled = separation.separate(capture, response, materials=labels)
    kept = (labels == NONE).values & (per_pixel["status"] == 0).values
    assert kept.mean() > 0.3
    for name in ("object_temperature", "background_temperature", "emissivity", "reflection_ratio"):
        assert np.array_equal(pooled[name].values[:, kept], per_pixel[name].values[:, kept])
    labelled = ~kept & (pooled["status"] == 0).values
    shared, single = (result["emissivity"].values[:, labelled] for result in (pooled, per_pixel))
    assert not np.array_equal(shared, single)
