"""Baselines: exact under their own assumptions, and undefined or wrong beyond them."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

from dbthermal import bands, planck, schema, separation, simulation
from dbthermal import response as responses
from dbthermal.separation._baselines import bcp, naive, pyrometry
from dbthermal.separation._tiles import Tile
from dbthermal.simulation import Background, Rig

Floats = NDArray[np.float64]
RIG = Rig()
TIME = np.arange(120) / 4.0
GLASS = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(RIG.bands)})


def tile_of(
    signals: Floats, shape: tuple[int, int], names: tuple[str, str] = ("8-14", "9.5")
) -> Tile:
    """Tile with given signals (2, time, pixel)."""
    response = Rig(bands=names).response()
    first, second = (responses.curve(response, name) for name in names)
    time = np.arange(signals.shape[1]) / 4.0
    rng = np.random.default_rng(5)
    return Tile(signals, time, (first, second), RIG.noise[:2], shape, rng)


def seen(warm: Floats, cold: Floats, emissivity: tuple[float, float]) -> Tile:
    """Tile without noise of an object before a background, both (time, pixel) [K]."""
    empty = tile_of(np.zeros((2, *warm.shape)), (1, warm.shape[1]))
    signals = [
        share * empty.blackbody(band, warm) + (1 - share) * empty.blackbody(band, cold)
        for band, share in enumerate(emissivity)
    ]
    return replace(empty, signals=np.stack(signals))


@pytest.fixture(scope="module")
def temperatures() -> tuple[Floats, Floats]:
    """Object and background (time, pixel) [K]: heated from 20 to 60 C, someone walking by."""
    rng = np.random.default_rng(2)
    scene = simulation.independent_pixels(
        TIME, GLASS, Background(), 30, rng, start=293.15, stop=333.15
    )
    warm, cold = (
        scene[f"{name}_temperature"].values.reshape(TIME.size, -1)
        for name in ("object", "background")
    )
    return warm, cold


@pytest.fixture(scope="module")
def glass(temperatures: tuple[Floats, Floats]) -> Tile:
    """Thirty pixels of glass, without noise."""
    return seen(*temperatures, (0.86, 0.72))


def fresh(tile: Tile) -> Tile:
    """The same with its random numbers at their start."""
    return replace(tile, rng=np.random.default_rng(5))


def error(truth: Floats, estimate: Floats) -> Floats:
    """Root mean square error of the object temperature (pixel) [K]."""
    return np.asarray(np.sqrt(np.mean((estimate - truth) ** 2, axis=0)))


def test_naive_meets_the_images_and_is_wrong(
    glass: Tile, temperatures: tuple[Floats, Floats]
) -> None:
    """Without noise the image error is zero in every pixel, and the answer kelvins off."""
    found = naive.separate(fresh(glass), naive.NaiveSettings())
    rest = [
        signal
        - share * glass.blackbody(band, found.object_temperature)
        - (1 - share) * glass.blackbody(band, found.background_temperature)
        for band, (signal, share) in enumerate(zip(glass.signals, found.emissivity, strict=True))
    ]
    misfit = np.sqrt(np.mean(np.square(rest), axis=(0, 1)))
    off = np.median(error(temperatures[0], found.object_temperature))
    of_emissivity = np.median(np.abs(found.emissivity - [[0.86], [0.72]]), axis=1)
    print(f"misfit {np.median(misfit):.1e} K, object {off:.1f} K, emissivity {of_emissivity}")
    assert misfit.max() < 1e-3  # K
    assert off > 3.0  # K
    assert of_emissivity.max() > 0.1


def test_naive_follows_its_random_numbers(glass: Tile) -> None:
    """The same seed gives the same result, another seed another."""
    first, second = (naive.separate(fresh(glass), naive.NaiveSettings()) for _ in range(2))
    other = naive.separate(replace(glass, rng=np.random.default_rng(6)), naive.NaiveSettings())
    np.testing.assert_array_equal(first.emissivity, second.emissivity)
    assert np.all(first.emissivity != other.emissivity)


def test_naive_says_when_it_stopped_early(glass: Tile) -> None:
    """A pixel is flagged as not converged after one step, and not after a hundred."""
    bit = schema.Status.NOT_CONVERGED
    early = naive.separate(fresh(glass), naive.NaiveSettings(iterations=1))
    late = naive.separate(fresh(glass), naive.NaiveSettings())
    assert np.mean((early.status & bit) > 0) > 0.9
    assert np.mean((late.status & bit) > 0) < 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"starts": 0}, "Invalid starts 0 of method 'naive'. Must be at least 1."),
        ({"iterations": 0}, "Invalid iterations 0 of method 'naive'"),
        ({"shift_std": -1.0}, r"Invalid shift_std \[K\] of method 'naive' -1.0"),
        ({"tolerance": 0.0}, "Invalid tolerance of method 'naive' 0.0"),
    ],
)
def test_naive_refuses_what_is_no_search(options: dict[str, float], message: str) -> None:
    """Settings of the naive search outside their range raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        naive.NaiveSettings(**options)  # type: ignore[arg-type]


WARM = np.linspace(290.0, 340.0, 24)[:, np.newaxis]


@pytest.mark.parametrize("kind", pyrometry.KINDS)
def test_ratio_of_a_blackbody(kind: str) -> None:
    """A blackbody's temperature is exact within 0.01 mK, in either kind of radiance."""
    found = pyrometry.ratio(seen(WARM, WARM, (1.0, 1.0)), pyrometry.RatioSettings(kind, order=None))
    np.testing.assert_allclose(found.object_temperature, WARM, rtol=0, atol=1e-5)  # K
    np.testing.assert_allclose(found.emissivity, 1.0, rtol=0, atol=1e-6)
    assert np.all(np.isnan(found.background_temperature))


def gray_body(kind: str, share: float) -> Tile:
    """A gray body in a room without emission, for either kind of radiance."""
    apparent = []
    for name in ("8-14", "9.5"):
        band = bands.get(name)
        if kind == "wide":
            apparent.append(band.temperature(share * band.radiance(WARM)))
        else:
            radiance = share * planck.spectral_radiance(band.centre, WARM)
            apparent.append(planck.brightness_temperature(band.centre, radiance))
    empty = tile_of(np.zeros((2, *WARM.shape)), (1, 1))
    signals = [empty.blackbody(band, level) for band, level in enumerate(apparent)]
    return replace(empty, signals=np.stack(signals))


@pytest.mark.parametrize("kind", pyrometry.KINDS)
@pytest.mark.parametrize("share", [0.95, 0.6])
def test_ratio_of_a_gray_body(kind: str, share: float) -> None:
    """Without a background a gray body's temperature and emissivity are exact."""
    found = pyrometry.ratio(gray_body(kind, share), pyrometry.RatioSettings(kind, order=None))
    np.testing.assert_allclose(found.object_temperature, WARM, rtol=0, atol=1e-5)  # K
    np.testing.assert_allclose(found.emissivity, share, rtol=0, atol=1e-6)
    assert np.all(found.status == 0)


def test_ratio_against_wien() -> None:
    """Wien's closed form has the same sign and slope, and is 2 to 6 K off at 9.5 and 11 um."""
    first, second = (bands.get(name).centre for name in ("8-14", "9.5"))
    radiances = [planck.spectral_radiance(centre, WARM) for centre in (first, second)]
    excess = np.log(radiances[0] / radiances[1]) - 5 * np.log(second / first)
    wien = planck.SECOND_RADIATION_CONSTANT * (1 / second - 1 / first) / excess
    found = pyrometry.ratio(gray_body("narrow", 0.8), pyrometry.RatioSettings("narrow", order=None))
    difference = wien - found.object_temperature
    print("Wien less Planck", difference.min(), difference.max())
    assert 2.0 < np.abs(difference).min() < np.abs(difference).max() < 6.0  # K


def test_ratio_smooths_before_it_divides() -> None:
    """Five polynomials in 120 frames: the noise falls by about the square root of 24."""
    warm = np.repeat(np.linspace(300.0, 325.0, 120)[:, np.newaxis], 40, axis=1)
    tile = seen(warm, warm, (1.0, 1.0))
    noise = np.random.default_rng(1).standard_normal(tile.signals.shape)
    noisy = replace(tile, signals=tile.signals + noise * [[[0.03]], [[0.35]]])
    plain, smooth = (
        np.sqrt(np.nanmean((pyrometry.ratio(noisy, setting).object_temperature - warm) ** 2))
        for setting in (pyrometry.RatioSettings(order=None), pyrometry.RatioSettings())
    )
    assert plain / smooth == pytest.approx(24**0.5, rel=0.2)


def test_ratio_refuses_a_stationary_pair() -> None:
    """10.6 against 8-14 um turns near 33 C: no temperature follows from its ratio."""
    tile = tile_of(np.zeros((2, 8, 1)), (1, 1), ("8-14", "10.6"))
    with pytest.raises(ValueError, match=r"'8-14', '10.6' .* stationary near 30\d\.\d K"):
        pyrometry.ratio(tile, pyrometry.RatioSettings())


def test_ratio_out_of_range_is_undefined() -> None:
    """A radiance ratio outside the response's range gives NaN and a flag."""
    tile = seen(WARM + 20.0, np.full_like(WARM, 290.0), (0.9, 0.4))
    found = pyrometry.ratio(tile, pyrometry.RatioSettings(order=None))
    assert np.isnan(found.object_temperature).any()
    assert np.all(found.status & schema.Status.OUTSIDE_RESPONSE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "wien"}, "Unknown kind 'wien' of method 'ratio'. Must be one of"),
        ({"order": 0}, "Invalid order 0 of method 'ratio'. Must be at least 1."),
    ],
)
def test_ratio_refuses_other_settings(options: dict[str, object], message: str) -> None:
    """Unknown kinds of radiance and invalid orders of the smoothing raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        pyrometry.RatioSettings(**options)  # type: ignore[arg-type]


HOT, ROOM = 320.0, 295.0
EXACT = bcp.BcpSettings(
    window=1, reflected_temperature=ROOM
)  # a window of one pixel smooths nothing


def half_black() -> Tile:
    """An image of 20 x 40 at 320 K in a room of 295 K: black left of the middle, else 0.5."""
    share = np.where(np.arange(40) < 20, 1.0, 0.5)
    empty = tile_of(np.zeros((2, 3, 800)), (20, 40))
    hot, room = (
        np.array([float(empty.blackbody(band, np.array(level))) for band in (0, 1)])
        for level in (HOT, ROOM)
    )
    row = room[:, np.newaxis] + share * (hot - room)[:, np.newaxis]
    image = np.broadcast_to(row[:, np.newaxis, np.newaxis, :], (2, 3, 20, 40))
    return replace(empty, signals=image.reshape(2, 3, 800).copy())


def test_bcp_by_hand() -> None:
    """Seven columns beside the blackbody take its temperature and t = 0.5; beyond, t = 1."""
    tile = half_black()
    found = bcp.separate(tile, EXACT)
    warm = found.object_temperature.reshape(3, 20, 40)
    share = found.emissivity.reshape(2, 20, 40)
    apparent = tile.temperature(0, tile.signals[0]).reshape(3, 20, 40)
    np.testing.assert_allclose(warm[..., :27], HOT, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(warm[..., 27:], apparent[..., 27:], rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(share[..., :20], 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(share[..., 20:27], 0.5, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.background_temperature, ROOM, rtol=0, atol=1e-9)  # K


def test_bcp_of_one_value() -> None:
    """A blackbody that fills the view keeps its temperature, which is the darkest level, too."""
    found = bcp.separate(seen(*2 * (np.full((3, 50), HOT),), (1.0, 1.0)), bcp.BcpSettings())
    np.testing.assert_allclose(found.object_temperature, HOT, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(found.background_temperature, HOT, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(found.emissivity, 1.0, rtol=0, atol=0)


def test_bcp_divides_by_no_less_than_its_limit() -> None:
    """With a limit of 0.8 a pixel of t = 0.5 is divided by 0.8."""
    tile = half_black()
    found = bcp.separate(tile, replace(EXACT, least_transmission=0.8))
    room = float(tile.blackbody(0, np.array(ROOM)))
    signal = tile.signals[0, 0, 20]
    expected = tile.temperature(0, np.array((signal - room) / 0.8 + room))
    assert found.object_temperature[0, 20] == pytest.approx(float(expected), abs=1e-9)  # K


def test_bcp_passes_over_dead_pixels() -> None:
    """A pixel without counts has no temperature, and its neighbours keep theirs."""
    tile = half_black()
    signals = tile.signals.copy()
    signals[:, :, 400 + 10] = -1e6
    found = bcp.separate(replace(tile, signals=signals), EXACT)
    assert np.all(np.isnan(found.object_temperature[:, 410]))
    others = np.delete(found.object_temperature.reshape(3, 20, 40)[..., :27], 10, axis=2)
    np.testing.assert_allclose(others, HOT, rtol=0, atol=1e-9)  # K


def test_guided_filter_follows_its_guide() -> None:
    """A linear function of the guide passes; variations that the guide lacks are averaged."""
    rng = np.random.default_rng(0)
    guide = rng.standard_normal((30, 40))
    kept = bcp.guided_filter(guide, 3.0 * guide - 1.0, 9, 1e-12)
    np.testing.assert_allclose(kept, 3.0 * guide - 1.0, rtol=0, atol=1e-8)
    flat = bcp.guided_filter(np.zeros((30, 40)), guide, 9, 1e-3)
    assert flat.std() < 0.2 * guide.std()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"patch": 4}, "Invalid patch 4 of method 'bcp'. Must be odd."),
        ({"window": 0}, "Invalid window 0 of method 'bcp'. Must be odd."),
        ({"percentile": 101.0}, "Invalid percentile 101.0 of method 'bcp'"),
        ({"least_transmission": 0.0}, "Invalid least_transmission 0.0 of method 'bcp'"),
        ({"regularisation": 0.0}, "Invalid regularisation of method 'bcp' 0.0"),
    ],
)
def test_bcp_refuses_other_settings(options: dict[str, float], message: str) -> None:
    """Even window sizes and fractions outside their range raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        bcp.BcpSettings(**options)  # type: ignore[arg-type]


def test_bcp_refuses_a_room_beyond_the_response() -> None:
    """A reflected temperature outside the response's range raises a ValueError."""
    with pytest.raises(ValueError, match=r"Invalid reflected_temperature 500\.0 K"):
        bcp.separate(half_black(), bcp.BcpSettings(reflected_temperature=500.0))


@pytest.fixture(scope="module")
def twin() -> tuple[xr.Dataset, xr.Dataset]:
    """A capture of 24 x 40 pixels, more than a tile, and its response."""
    rng, response = np.random.default_rng(3), RIG.response()
    scene = simulation.walkers(TIME[:40], (24, 40), GLASS, rng)
    return simulation.observe(scene, response, rng), response


def test_ratio_behind_solve_may_leave_out_the_smoothing(
    twin: tuple[xr.Dataset, xr.Dataset],
) -> None:
    """An order of None switches the smoothing off, and leaves the noise of single frames."""
    plain = separation.solve(*twin, "ratio", settings=separation.RatioSettings(order=None))
    smooth = separation.solve(*twin, "ratio")
    assert float(plain["object_temperature"].std()) > float(smooth["object_temperature"].std())


def test_bcp_sees_the_whole_image(twin: tuple[xr.Dataset, xr.Dataset]) -> None:
    """Behind solve the image is one tile: the result is that of the whole tile."""
    capture, response = twin
    first, second = (responses.curve(response, name) for name in RIG.bands)
    signals = np.stack(
        [
            curve.linearise(counts).reshape(40, -1) - curve.reference
            for curve, counts in zip((first, second), capture["counts"].values, strict=True)
        ]
    )
    whole = bcp.separate(tile_of(signals, (24, 40)), bcp.BcpSettings())
    found = separation.solve(capture, response, "bcp", workers=1)["object_temperature"]
    np.testing.assert_allclose(
        found.values.reshape(40, -1), whole.object_temperature, rtol=0, atol=1e-3
    )  # K, single precision
