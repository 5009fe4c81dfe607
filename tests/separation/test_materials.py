"""Materials from the data: borders are kept, and one material stays one region."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from dbthermal import _smooth as smooth
from dbthermal import separation, simulation
from dbthermal.separation._pooling import feature_maps, region_merging
from dbthermal.separation._pooling.materials import (
    NONE,
    _both,
    materials,
    step,
    without_borders,
)
from dbthermal.separation._pooling.region_merging import Features, Regions
from dbthermal.simulation import Rig

Array = np.ndarray
RIG = Rig()
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
    functions = smooth.polynomial_basis(scene["time"].values, 6)
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


def test_three_bands(small: Inputs) -> None:
    """A third band adds a ratio and a feature map, and the border stays."""
    names = [*RIG.bands, "10.6"]
    three = [part.isel(band=[0, 1, 1]).assign_coords(band=names) for part in small]
    labels = materials(*three)
    share, bleeding = judged(labels.values, where("side by side", SMALL))
    assert share >= 0.99
    assert bleeding == 0


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


def test_error_rate_is_kept() -> None:
    """Images of one material are split no more often than the stated error rate."""
    rng, rate, tries = np.random.default_rng(8), 0.2, 300
    cells = feature_maps.connected(np.add.outer(np.arange(24) // 8 * 3, np.arange(24) // 8) + 1)
    cut = apart = 0
    for _ in range(tries):
        std = rng.uniform(0.02, 0.2, (1, 24, 24))
        values = 2.0 + std * rng.standard_normal(std.shape)
        features = Features(values, std**2, np.array([False]), np.array([0.0]))
        cut += bool(region_merging.mixed(cells, features, rate).any())
        joined = Regions(cells, features, rate)
        joined.join_alike(region_merging.neighbours(cells), resolution=0.5)
        apart += np.unique(joined.roots()[1:]).size > 1
    print(f"at a rate of {rate}: {cut / tries:.3f} cut, {apart / tries:.3f} held apart")
    assert cut / tries == pytest.approx(rate, abs=0.07)  # three standard deviations
    assert apart / tries <= rate


def test_a_cell_across_a_border_is_mixed() -> None:
    """Five pixels of concrete in a cell of glass are detected at a ratio's deviation of 3 %."""
    rng, found = np.random.default_rng(9), 0
    cells = np.ones((8, 8), dtype=np.intp)
    for _ in range(100):
        values = 2.02 + 0.06 * rng.standard_normal((1, 8, 8))
        variances = np.full_like(values, 0.06**2)
        values[0, 0, :5] -= 0.5
        features = Features(values, variances, np.array([False]), np.array([0.0]))
        found += int(region_merging.mixed(cells, features, 0.01 / 400)[1])
    print(f"{found} of 100 cells across a border are seen")
    assert found >= 99


def test_common_errors_do_not_shrink() -> None:
    """Pooling lessens the variance of a ratio, and leaves that of a common error."""
    cells, found = np.repeat([[1, 2]], 10, axis=0), []
    values = np.repeat([[[1.0, 1.1]]], 10, axis=1)
    for common in (False, True):
        spread = np.full_like(values, 0.04)
        features = Features(values, spread, np.array([common]), np.array([0.0]))
        joined = Regions(cells, features, 0.1)
        found.append(joined.compare(np.array([1]), np.array([2])))
    (own, seen), (shared, seen_shared) = found
    np.testing.assert_allclose([own / shared, (seen_shared / seen) ** 2], 10.0, rtol=1e-12)


@given(seed=st.integers(0, 1000), height=st.floats(-2.0, 2.0))
def test_step_is_that_of_a_cubic_field(seed: int, height: float) -> None:
    """A step upon any cubic field is found exactly, as its square over its variance."""
    rng = np.random.default_rng(seed)
    y, x = (part.ravel() for part in np.mgrid[:8, :16])
    order = np.argsort(x >= 8, kind="stable")
    y, x = y[order], x[order]
    terms = np.stack([(x / 8.0) ** i * (y / 8.0) ** j for i in range(4) for j in range(4 - i)])
    field = rng.normal(size=10) @ terms
    one, other = (
        step((y, x), (field + scale * (x >= 8))[np.newaxis], np.array([0.01]), 64, 9.0)
        for scale in (height, 1.0)
    )
    assert one == pytest.approx(height**2 * other, rel=1e-6, abs=1e-9)


def test_step_counts_in_standard_deviations() -> None:
    """Noise alone makes a statistic of mean 1; cells of too few pixels make no statement."""
    rng = np.random.default_rng(10)
    y, x = np.divmod(np.arange(128), 8)
    noise = [
        step((y, x), rng.normal(0, 0.1, (1, 128)), np.array([0.01]), 64, 9.0) for _ in range(1000)
    ]
    print(f"mean of the statistic {np.mean(np.ma.masked_invalid(noise)):.3f}")
    finite = np.isfinite(noise)
    assert np.mean(np.array(noise)[finite]) == pytest.approx(1.0, abs=0.15)
    assert np.mean(~finite) == pytest.approx(0.01, abs=0.01)
    assert step((y[:12], x[:12]), np.zeros((1, 12)), np.array([0.01]), 6, 9.0) == np.inf


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


@pytest.mark.parametrize("spacing", [2, 4, 8])
def test_cells_cover_what_is_valid(spacing: int) -> None:
    """Each valid pixel, cut off from the markers too, is in a connected cell of about that size."""
    valid = np.ones((32, 48), dtype=bool)
    valid[10], valid[:, 21] = False, False
    cells = feature_maps.superpixels(np.zeros(valid.shape), valid, spacing)
    np.testing.assert_array_equal(cells > 0, valid)
    assert feature_maps.connected(cells).max() == cells.max()
    assert 0.7 < cells.max() * spacing**2 / valid.sum() < 2.0


def test_mean_signals_have_the_variance_of_their_noise(small: Inputs) -> None:
    """Means of 120 frames: noise over the root of 120, and a fixed pattern where there is one."""
    _, capture, response = small
    flat = capture["counts"].isel(x=slice(0, 40)).mean(("y", "x"))
    rng, counts = np.random.default_rng(6), response["noise"].values[:, None, None, None]
    noise = rng.standard_normal((2, 120, 48, 40))
    pattern = 3.0 * rng.standard_normal((2, 1, 48, 40)) * np.array([0.0, 1.0])[:, None, None, None]
    for fixed in (0.0, 1.0):
        values = flat.values[:, :, None, None] + counts * (noise + fixed * pattern)
        still = xr.Dataset(
            {"counts": (("band", "time", "y", "x"), values)},
            coords={"band": capture["band"], "time": capture["time"]},
        )
        means, variances = feature_maps.mean_signals(still, response, [0, 1], np.array(NOISE))
        expected = NOISE[1] ** 2 * (1 / 120 + 9.0 * fixed)
        assert np.median(variances[1]) == pytest.approx(expected, rel=0.15)
        assert means[1].var() == pytest.approx(expected, rel=0.15)
        np.testing.assert_allclose(variances[0], NOISE[0] ** 2 / 120, rtol=1e-12)


def test_edges_count_in_standard_deviations() -> None:
    """White noise makes edges of mean square near 1 in each direction, and a step one at its place.

    The larger of two directions has a mean square of 1 + 2 / pi.
    """
    rng = np.random.default_rng(12)
    picture = rng.normal(0.0, 0.3, (1, 200, 200))
    strength = feature_maps.edges(picture, np.full_like(picture, 0.09))
    print(f"mean square of the edge strength {np.mean(strength**2):.2f}")
    picture[..., 100:] += 3.0
    place = feature_maps.edges(picture, np.full_like(picture, 0.09)).argmax(axis=1)
    assert np.all(np.isin(place, [99, 100]))
    assert not np.any(feature_maps.edges(picture * np.nan, np.ones_like(picture)))


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


@pytest.mark.parametrize("surer", [1.0, 0.1])
def test_a_pixel_beside_another_material_stays_only_if_its_ratio_tells(
    small: Inputs, surer: float
) -> None:
    """Of labels whose border is off by a column, that column goes; what is told apart stays."""
    result, _, response = small
    true = where("side by side", SMALL)
    ratio, std = ratio_of(scene_of(true, 2, frames=120))
    error = surer * std * np.random.default_rng(5).standard_normal(std.shape)
    labels = np.roll(true, 1, axis=1)
    labels[:, 0] = False
    drawn_again = with_ratio(result, ratio + error, surer * std)
    kept = without_borders(xr.DataArray(labels * 1, dims=("y", "x")), drawn_again, response).values
    wrong, column = kept[labels != true], np.flatnonzero(np.any(labels != true, axis=0))[0]
    beside = kept[:, [column - 1, column + 1]]
    shares = [float(np.mean(part >= 0)) for part in (wrong, beside)]
    print(f"labelled: {shares[0]:.1%} of the wrong column, {shares[1]:.1%} of those beside it")
    assert shares[0] < 0.02
    assert (shares[1] > 0.8) == (surer < 1.0)
    far = np.abs(np.arange(SMALL[1]) - column) > 1
    np.testing.assert_array_equal(kept[:, far], labels[:, far])


@pytest.mark.parametrize(
    ("ratio", "alike"), [(2.0, True), (2.2, True), (0.837, True), (0.944, False), (1.4, False)]
)
def test_ratios_beside_a_border(ratio: float, alike: bool) -> None:
    """Glass goes on with its own ratio, or at rest with that of its emissivities, 0.72/0.86."""
    one = np.arange(12) < 6 * np.ones((8, 1))
    ratios = np.where(one, 2.0, ratio)[np.newaxis]
    emissivity = np.where(one, 0.86, np.nan)[np.newaxis]
    small = np.full_like(ratios, 1e-4)
    both = _both(ratios, small, emissivity, small)
    alone = Features(*(part[:1] for part in vars(both).values()))
    assert region_merging.alike(one, ~one, alone, both) == alike
    assert region_merging.alike(~one, one, alone, both) == alike
    nothing = replace(alone, values=np.where(one, alone.values, np.nan))
    assert region_merging.alike(one, ~one, nothing, both)
