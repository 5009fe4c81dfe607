"""Materials from the data: borders are kept, and one material stays one region."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from captures import polynomials
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from dbthermal import separation, simulation
from dbthermal.separation import materials
from dbthermal.simulation import Rig

Array = np.ndarray
RIG = Rig()
NONE = -1
NOISE = (0.03, 0.35)  # [K]
GLASS, CONCRETE = (0.8605, 0.7180), (0.9280, 0.8707)
SMALL = (72, 96)
SHAPES: dict[str, Callable[[Array, Array], Array]] = {
    "one": lambda y, x: x + y > 9,
    "side by side": lambda y, x: x + 0 * y >= 0,
    "oblique": lambda y, x: x + 0.45 * y > 0,
    "disc": lambda y, x: (x - 0.1) ** 2 + (0.75 * y) ** 2 < 0.56**2,
}


def where(name: str, shape: tuple[int, int]) -> Array:
    """Mask of the second material; the image reaches from -1 to 1 in both directions."""
    return SHAPES[name](*np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij"))


def scene_of(second: Array, seed: int, frames: int = 350) -> xr.Dataset:
    """Glass and concrete, heated by a spot across their border, while eight people walk by."""
    values = np.where(second, np.array(CONCRETE)[:, None, None], np.array(GLASS)[:, None, None])
    emissivity = xr.DataArray(
        values, dims=("band", "y", "x"), coords={"band": list(RIG.bands)}, attrs={"units": "1"}
    )
    rng, time = np.random.default_rng(seed), np.arange(frames) / 10.0
    return simulation.walkers(
        time,
        second.shape,
        emissivity,
        rng,
        temperatures=(295.15, 307.15, 333.15),  # room, people, hottest point [K]
        crossings=8,
    )


def ratio_of(scene: xr.Dataset) -> tuple[Array, Array]:
    """True ratio of the second band, and its deviation from the energy of the reflection."""
    first, second = 1.0 - scene["emissivity"].values
    moved = (first * scene["background_temperature"].values).reshape(scene.sizes["time"], -1)
    functions = polynomials(scene["time"].values, 6)
    energy = np.sum((moved - functions @ (functions.T @ moved)) ** 2, axis=0).reshape(first.shape)
    ratio = second / first
    energy = np.where(energy > 60 * NOISE[0] ** 2, energy, np.nan)
    white = scene.sizes["time"] * (NOISE[0] * NOISE[1]) ** 2
    return ratio, np.sqrt((NOISE[1] ** 2 + (ratio * NOISE[0]) ** 2) * energy + white) / energy


def with_ratio(result: xr.Dataset, ratio: Array, std: Array) -> xr.Dataset:
    """Add the ratios of both bands and their deviations to a result."""
    known = np.isfinite(ratio + std)
    parts = {"reflection_ratio": (1.0, ratio), "reflection_ratio_std": (0.0, std)}
    return result.assign(
        {
            name: (("band", "y", "x"), np.where(known, np.stack([first + 0 * part, part]), np.nan))
            for name, (first, part) in parts.items()
        }
    )


def drawn(scene: xr.Dataset, seed: int) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Result, capture and response: a result as `solve` gives it, drawn from its distribution."""
    rng, response = np.random.default_rng(seed), RIG.response()
    ratio, std = ratio_of(scene)
    parts = ["emissivity", "background_temperature"]
    result = with_ratio(scene[parts], ratio + std * rng.standard_normal(std.shape), std)
    spread = np.full_like(scene["emissivity"].values, 0.02)
    errors = spread * rng.standard_normal((2, 1, 1))  # common to all pixels
    return (
        result.assign(
            emissivity=scene["emissivity"] + errors,
            background_temperature_std=0.0 * scene["background_temperature"],
            emissivity_std=(("band", "y", "x"), spread),
            status=(("y", "x"), np.zeros(std.shape, dtype=np.uint16)),
            noise=response["noise"],
        ),
        simulation.observe(scene, response, rng),
        response,
    )


Inputs = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


@pytest.fixture(scope="module")
def small() -> Inputs:
    """Result, capture and response: two materials side by side, 72 by 96 pixels."""
    return drawn(scene_of(where("side by side", SMALL), 2, frames=120), 3)


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
    second, response = where(name, shape), RIG.response()
    scene = scene_of(second, seed)
    capture = simulation.observe(scene, response, np.random.default_rng(seed))
    result = separation.solve(capture, response)
    labels = materials(result, capture, response).values
    share, bleeding = judged(labels, second)
    print(f"{name}: {share:.2%} with the main label, {bleeding} labels bleed, {labels.max() + 1}")
    assert share >= 0.99
    assert bleeding == 0
    assert labels.max() + 1 <= 4
    # What lies at a border that is found within 2 pixels may belong to none.
    inside = ndimage.maximum_filter(second, 7) == ndimage.minimum_filter(second, 7)
    assert np.mean((labels == NONE)[inside]) < 0.02


def test_borders_of_drawn_ratios_are_kept(small: Inputs) -> None:
    """With ratios drawn from their distribution the labels are the two materials."""
    result, capture, response = small
    before = [part.copy(deep=True) for part in small]
    labels = materials(result, capture, response)
    share, bleeding = judged(labels.values, where("side by side", SMALL))
    assert share >= 0.99
    assert bleeding == 0
    assert labels.dims == ("y", "x")
    assert labels.dtype == np.int32
    assert labels.attrs["units"] == "1"
    for part, copy in zip(small, before, strict=True):
        xr.testing.assert_identical(part, copy)


def test_order_of_bands_does_not_matter(small: Inputs) -> None:
    """The quieter band is the reference wherever it stands."""
    result, capture, response = small
    exchanged = materials(result.isel(band=[1, 0]), capture.isel(band=[1, 0]), response)
    xr.testing.assert_identical(exchanged, materials(result, capture, response))


def test_pixels_without_a_signal_have_no_material(small: Inputs) -> None:
    """Dead pixels, and those that are NaN in a band, are -1; whole frames of NaN are left out."""
    result, capture, response = small
    capture, status = capture.copy(deep=True), result["status"].copy(deep=True)
    capture["counts"].values[0, 30:40] = np.nan
    capture["counts"].values[1, :, 5, 6] = np.nan
    status.values[20, 9] = 1024
    labels = materials(result.assign(status=status), capture, response).values
    assert labels[5, 6] == labels[20, 9] == NONE
    assert np.mean(labels != NONE) > 0.98


def test_where_nothing_moved_is_no_material(small: Inputs) -> None:
    """Without a reflection ratio every pixel is -1."""
    result, capture, response = small
    nothing = result.assign(reflection_ratio=result["reflection_ratio"] * np.nan)
    assert np.all(materials(nothing, capture, response) == NONE)


def test_silence_is_no_agreement(small: Inputs) -> None:
    """Warm pixels with a still background on the right are not added to the left material."""
    result, capture, response = small
    right = xr.DataArray(where("side by side", SMALL), dims=("y", "x"))
    left = result.assign(reflection_ratio=result["reflection_ratio"].where(~right))
    labels = materials(left, capture, response).values
    print(f"right: {np.mean(labels[:, 50:] == NONE):.1%} without a material")
    assert np.mean(labels[:, :46] == 0) > 0.99
    assert np.all(labels[12:60, 50:] == NONE)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), name=st.sampled_from(list(SHAPES)))
def test_labels_are_connected_and_ordered(seed: int, name: str) -> None:
    """Regions are ordered by size, and each is connected."""
    inputs = drawn(scene_of(where(name, (24, 40)), seed, frames=64), seed)
    labels = materials(*inputs, borders=True).values
    sizes = np.bincount(labels[labels != NONE], minlength=1)
    assert np.all(np.diff(sizes) <= 0)
    for label in np.unique(labels[labels != NONE]):
        assert ndimage.label(labels == label)[1] == 1


BAD: dict[str, tuple[Callable[[Inputs], object], str]] = {
    "rate": (lambda i: materials(*i, error_rate=0.0), r"Invalid error_rate 0\.0\. Must lie in"),
    "resolution": (lambda i: materials(*i, resolution=1.5), r"Invalid resolution 1\.5\. Must"),
    "ratio": (
        lambda i: materials(i[0].drop_vars("reflection_ratio"), *i[1:]),
        "Missing 'reflection_ratio' in the result",
    ),
    "bands": (
        lambda i: materials(i[0].isel(band=[1]), *i[1:]),
        "Missing band '8-14' in the result",
    ),
    "size": (
        lambda i: materials(i[0].isel(x=slice(9)), *i[1:]),
        "Invalid size 9 of 'x' of the result. Must be that of the capture, 96",
    ),
    "capture": (
        lambda i: materials(i[0], i[1].transpose("time", "band", "y", "x"), i[2]),
        "Invalid dims",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_a_clear_error(small: Inputs, what: str) -> None:
    """Each error names the thing, the value and the rule."""
    call, message = BAD[what]
    with pytest.raises(ValueError, match=message):
        call(small)
