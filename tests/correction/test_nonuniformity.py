"""Frame correction: one mechanism at a time on frames whose gains and offsets are known."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import plain_capture
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from refused import refused

from dbthermal import schema, simulation
from dbthermal.correction import (
    blackbody_statistics,
    correct,
    fit_correction,
    renew_offset,
    undo_lag,
)
from dbthermal.schema import Status

TEMPERATURES = np.array([288.15, 298.15, 308.15, 318.15])
LEVELS = np.array([20000.0, 21200.0, 22500.0, 23900.0])  # counts of an ideal pixel


def blackbody(gain: object, offset: object, levels: object = LEVELS) -> xr.Dataset:
    """Frames (band, temperature, y, x) of pixels that give (level - offset) / gain counts."""
    gain, offset, levels = (np.asarray(values, dtype=float) for values in (gain, offset, levels))
    counts = (levels[:, np.newaxis, np.newaxis] - offset) / gain
    return xr.Dataset(
        {"counts": (("band", "temperature", "y", "x"), counts[np.newaxis])},
        coords={"band": ["8-14"], "temperature": TEMPERATURES[: len(levels)]},
    )


def centred(gain: object, offset: object) -> xr.Dataset:
    """Frames of pixels whose mean is the ideal pixel's, to make gain and offset identifiable."""
    slope = 1.0 / np.asarray(gain, dtype=float)
    shift = -np.asarray(offset, dtype=float) * slope
    return blackbody(slope.mean() / slope, (shift.mean() - shift) / slope)


@pytest.fixture
def ideal(rng: np.random.Generator) -> xr.Dataset:
    """Frames of 12 by 16 good pixels with 3 % of gain, 200 counts of offset and 2 of noise."""
    size = (12, 16)
    made = centred(1.0 + 0.03 * rng.standard_normal(size), 200.0 * rng.standard_normal(size))
    return made + 2.0 * rng.standard_normal(made["counts"].shape)


@pytest.fixture
def capture() -> xr.Dataset:
    """Two bands of three frames, every sample inside the detector's range."""
    counts = 20000 + np.arange(2 * 3 * 2 * 4, dtype=np.uint16).reshape(2, 3, 2, 4)
    return plain_capture(counts, [0.0, 0.1, 0.3]).assign_attrs(camera="simulated")


@pytest.fixture
def correction() -> xr.Dataset:
    """Gains and offsets of three bands, in another order, with one bad pixel."""
    rng = np.random.default_rng(5)
    dims, shape = ("band", "y", "x"), (3, 2, 4)
    bad = np.zeros(shape, dtype=bool)
    bad[2, 1, 3] = True
    return xr.Dataset(
        {
            "gain": (dims, 1.0 + 0.05 * rng.standard_normal(shape)),
            "offset": (dims, 100.0 * rng.standard_normal(shape)),
            "bad": (dims, bad),
        },
        coords={"band": ["9.5", "10.6", "8-14"]},
        attrs={"threshold": 6.0, "origin": "simulated"},
    )


@given(
    arrays(float, (3, 4), elements=st.floats(0.7, 1.4)),
    arrays(float, (3, 4), elements=st.floats(-2000.0, 2000.0)),
)
def test_known_gain_and_offset_come_back(gain: np.ndarray, offset: np.ndarray) -> None:
    """Without noise the fit returns each pixel's own gain and offset, whatever they are."""
    made = centred(gain, offset)
    fitted = fit_correction(made, threshold=1e6)
    corrected = fitted["gain"] * made["counts"] + fitted["offset"]
    expected = np.broadcast_to(LEVELS[:, np.newaxis, np.newaxis], (4, 3, 4))
    assert not fitted["bad"].any()
    np.testing.assert_allclose(fitted["level"][0], LEVELS, rtol=0, atol=1e-8)  # count
    np.testing.assert_allclose(corrected.transpose(..., "y", "x")[0], expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(fitted["residual"], 0.0, rtol=0, atol=1e-6)


def test_least_squares_against_polyfit(ideal: xr.Dataset) -> None:
    """With noise a pixel's line is the one that an independent least squares gives."""
    before = ideal.copy(deep=True)
    fitted = fit_correction(ideal)
    xr.testing.assert_identical(ideal, before)
    pixel = ideal["counts"].values[0, :, 4, 7]
    gain, offset = np.polyfit(pixel - 21000.0, fitted["level"].values[0], 1)
    assert fitted["gain"].values[0, 4, 7] == pytest.approx(gain, abs=1e-10)
    assert fitted["offset"].values[0, 4, 7] == pytest.approx(offset - 21000.0 * gain, abs=1e-5)


def test_residual_is_the_noise(ideal: xr.Dataset) -> None:
    """Two of four degrees of freedom are left: 2 counts of noise leave an RMS of sqrt(2) counts."""
    fitted = fit_correction(ideal)
    assert not fitted["bad"].any()
    assert float(fitted["residual"][0]) == pytest.approx(2.0**0.5, rel=0.06)


@pytest.mark.parametrize(
    "samples",
    [
        np.full(4, 20500.0),  # stuck
        [20500.0, 20501.0, 20499.5, 20500.5],  # dead
        LEVELS[::-1],
        [20000.0, 21200.0, np.nan, 23900.0],
        [20000.0, 21200.0, np.inf, 23900.0],
        [20000.0, 21200.0, 22500.0, 65535.0],  # saturated
        [0.0, 21200.0, 22500.0, 23900.0],
        20000.0 + 0.5 * (LEVELS - 20000.0),  # low gain
        LEVELS + np.array([0.0, 150.0, -150.0, 0.0]),  # bent
    ],
)
def test_bad_pixel_is_found_and_left_out(ideal: xr.Dataset, samples: Any) -> None:
    """Each kind of bad pixel is marked, alone, and does not shift the others' level."""
    spoiled = ideal.copy(deep=True)
    spoiled["counts"][0, :, 5, 6] = samples
    fitted = fit_correction(spoiled)
    assert fitted["bad"].dtype == bool
    np.testing.assert_array_equal(np.argwhere(fitted["bad"].values), [[0, 5, 6]])
    rest = ideal["counts"].values.reshape(4, -1)[:, np.arange(192) != 5 * 16 + 6]
    np.testing.assert_allclose(fitted["level"][0], rest.mean(axis=1), rtol=0, atol=1e-8)
    assert fitted["gain"].values[0, 5, 6] == 1.0
    assert fitted["offset"].values[0, 5, 6] == 0.0


def test_pixels_that_are_alike_are_all_good() -> None:
    """Identical pixels are all good: rounding does not mark an outlier."""
    fitted = fit_correction(blackbody(np.ones((5, 5)), np.zeros((5, 5))))
    assert not fitted["bad"].any()
    np.testing.assert_allclose(fitted["gain"], 1.0, rtol=0, atol=1e-12)


def test_threshold_is_the_caller_s(ideal: xr.Dataset) -> None:
    """A lower threshold marks the pixel of largest gain."""
    gain = fit_correction(ideal)["gain"].values
    marked = fit_correction(ideal, threshold=2.0)["bad"].values
    assert marked.flat[np.argmax(gain)]
    assert 0.0 < marked.mean() < 0.3


HOLED = blackbody(np.ones((2, 2)), [[0.0, 0.0], [0.0, np.nan]])
HOLED["counts"][0, 1, 0, 1] = np.nan


MAXIMA = np.nan, [3], 3j, True, -1, "65535", 65536, 65535.0  # no counts of a 16-bit detector

test_frames_that_tell_no_gain = refused(
    lambda counts, options: fit_correction(counts, **options),
    [
        (blackbody([[1.0]], [[0.0]], LEVELS[:1]), {}, "Invalid blackbody frames of 1 temperature"),
        (HOLED, {}, "band '8-14': 2 of 4 pixels are usable"),
        (blackbody(np.ones((2, 2)), np.zeros((2, 2)), LEVELS[[1, 0, 2]]), {}, "Must rise"),
        (HOLED, {"threshold": 0}, "Invalid threshold of bad pixels 0"),
        *((HOLED, {"maximum": it}, "Invalid maximum of the detector") for it in MAXIMA),
    ],
)


def test_correct_applies_gain_and_offset(capture: xr.Dataset, correction: xr.Dataset) -> None:
    """Each band gets its own maps, by name and not by place."""
    result = correct(capture, correction)
    for band in ("8-14", "9.5"):
        maps, raw = correction.sel(band=band), capture["counts"].sel(band=band).astype(float)
        expected = (maps["gain"] * raw + maps["offset"]).transpose("time", "y", "x")
        difference = result["counts"].sel(band=band) - expected
        np.testing.assert_allclose(difference, 0.0, rtol=0, atol=0.005)  # count, float32
    assert result["counts"].dtype == np.float32
    assert schema.check(result, "corrected") is result


def test_status_tells_dead_from_saturated(capture: xr.Dataset, correction: xr.Dataset) -> None:
    """Dead and saturated pixels of any band get a bit each, and the counts do not change."""
    capture["counts"][1, 2, 0, 1] = 65535
    capture["counts"][0, 1, 1, 3] = 0
    result, high, dead = correct(capture, correction), Status.SATURATED, Status.DEAD_PIXEL
    np.testing.assert_array_equal(result["status"], [[0, high, 0, 0], [0, 0, 0, high | dead]])
    assert result["status"].dtype == np.uint32
    maps = correction.sel(band="9.5").isel(y=0, x=1)
    expected = 65535 * float(maps["gain"]) + float(maps["offset"])
    assert float(result["counts"][1, 2, 0, 1]) == pytest.approx(expected, abs=0.02)
    # A detector of fewer bits saturates at a lower count.
    result = correct(capture, correction, maximum=20047)
    assert result["status"].values[1, 3] & high
    assert not result["status"].values[0, 0] & high


def test_provenance_is_written(capture: xr.Dataset, correction: xr.Dataset) -> None:
    """The result says what was done to it and keeps other variables; the input is not changed."""
    capture["fpa_temperature"] = ("time", [300.0, 300.1, 300.2])
    before = capture.copy(deep=True), correction.copy(deep=True)
    result = correct(capture, correction)
    xr.testing.assert_identical(capture, before[0])
    xr.testing.assert_identical(correction, before[1])
    xr.testing.assert_identical(result["fpa_temperature"], capture["fpa_temperature"])
    assert result.attrs == {
        "camera": "simulated",
        "origin": "simulated",  # of the correction: what it makes is no measurement
        "gain_offset_corrected": 1,
        "gain_offset_threshold": 6.0,
        "detector_maximum": 65535,
        "dead_pixels": 1,
        "saturated_pixels": 0,
    }


def gained(correction: xr.Dataset, gain: float) -> xr.Dataset:
    """The correction with another gain of its good pixels."""
    return correction.assign(gain=correction["gain"].where(correction["bad"], gain))


FLOATING = xr.DataArray(np.zeros((2, 4)), dims=("y", "x"))  # a status of no bits


test_what_does_not_fit_is_refused = refused(
    lambda capture, correction, call: call(capture, correction),
    [
        (lambda c, k: correct(c.astype(float), k), "Invalid dtype float64 of the capture's counts"),
        (lambda c, k: correct(c.isel(time=[0, 2, 1]), k), "Unordered 'time'"),
        (lambda c, k: correct(c, k.isel(band=[1, 2])), "Missing band '9.5' in the correction"),
        (lambda c, k: correct(c, k.isel(x=slice(3))), "Invalid size 3 of 'x' of the correction"),
        (lambda c, k: correct(c, gained(k, np.nan)), "gain of the correction: not finite"),
        (lambda c, k: correct(c, gained(k, -1.0)), "Invalid gain .* a gain positive"),
        (lambda c, k: correct(c, k.drop_vars("bad")), "Missing 'bad'"),
        (lambda c, k: correct(c, k.assign(offset_std=2.0)), "Invalid dims .* of 'offset_std'"),
        (lambda c, k: correct(correct(c, k), k), "corrected before"),
        (
            lambda c, k: correct(c.assign_coords(y=[0, 1]), k.assign_coords(y=[1, 2])),
            "Invalid 'y' of the correction: 1 at position 0",
        ),
        (
            lambda c, k: undo_lag(correct(c, k).assign(status=FLOATING), 0.01),
            "Invalid dtype float64 of 'status' of the corrected",
        ),
        (lambda _, k: renew_offset(k, k["offset"] * np.nan), "flat image, in a good pixel: NaN"),
        (lambda _, k: renew_offset(k, k.gain[..., :3]), "Invalid size 3 of 'x' of the flat image"),
        *(  # as by `correct`
            (
                lambda _, k, gain=gain: renew_offset(gained(k, gain), 0 * k["offset"] + 20000.0),
                "Invalid gain of the correction",
            )
            for gain in (np.nan, np.inf, 0.0, -1.0)
        ),
        *(
            (lambda c, k, it=it: correct(c, k, maximum=it), "Invalid maximum of the detector")
            for it in MAXIMA
        ),
    ],
    "capture correction",
)


def test_a_bad_pixel_s_gain_may_be_anything(capture: xr.Dataset, correction: xr.Dataset) -> None:
    """Also negative, of all pixels."""
    turned = correction.assign(gain=-correction["gain"])
    correct(capture, turned.assign(bad=xr.ones_like(correction["bad"])))


@pytest.fixture
def movies(rng: np.random.Generator) -> xr.Dataset:
    """Movies of 12 frames with 20 counts of noise in one band and 60 in the other."""
    shape = (2, 4, 12, 20, 20)
    noise = np.array([20.0, 60.0]).reshape(2, 1, 1, 1, 1) * rng.standard_normal(shape)
    counts = np.round(LEVELS.reshape(1, 4, 1, 1, 1) + noise).astype(np.uint16)
    return xr.Dataset(
        {"counts": (("band", "temperature", "frame", "y", "x"), counts)},
        coords={"band": ["8-14", "9.5"], "temperature": TEMPERATURES},
    )


@pytest.mark.parametrize(("count", "within"), [(2, 0.05), (3, 0.05), (6, 0.05), (12, 0.02)])
def test_noise_of_movies(movies: xr.Dataset, count: int, within: float) -> None:
    """Mean frames and noise are recovered; the median's bias, 33 % at two frames, is removed."""
    statistics = blackbody_statistics(movies.isel(frame=slice(count)))
    result = schema.check(statistics, "blackbody_frames")
    np.testing.assert_allclose(result["noise"], [20.0, 60.0], rtol=within)
    levels = result["counts"].mean(("y", "x"))
    deviation = 60.0 / np.sqrt(400 * count)  # of a mean frame's mean, in the noisier band [count]
    np.testing.assert_allclose(levels, [LEVELS, LEVELS], rtol=0, atol=4.6 * deviation)
    assert result["noise"].attrs["units"] == "count"


def test_drift_is_no_noise(movies: xr.Dataset) -> None:
    """A drift of 200 counts over the movie is warned of, and does not enter the noise."""
    drift = xr.DataArray(np.linspace(0.0, 200.0, 12).round().astype(np.uint16), dims="frame")
    drifting = movies + drift
    with pytest.warns(UserWarning, match="not settled: band '[89].+' .[0-9.]+ K at") as notes:
        noise = blackbody_statistics(drifting.transpose(*movies["counts"].dims))["noise"]
    assert len(notes) == 2  # of each band
    assert float(noise[1]) == pytest.approx(60.0, rel=0.04)


def test_noise_of_a_repeated_blackbody(movies: xr.Dataset) -> None:
    """Copies make the noise of a sweep neither smaller nor larger."""
    statistics = blackbody_statistics(movies)
    copied = blackbody_statistics(movies.isel(frame=np.repeat(np.arange(12), 3)))
    np.testing.assert_allclose(copied["noise"], statistics["noise"], rtol=0, atol=1e-9)
    assert copied.attrs["frames"] == statistics.attrs["frames"] == 12


test_movies_must_vary = refused(
    lambda movies, change: blackbody_statistics(change(movies)),
    [
        (lambda it: it.isel(frame=[0]), "Invalid movies of 1 frame"),
        (lambda it: it.isel(frame=[0, 0, 0]), "Invalid noise 0.0 count"),
        (lambda it: it.astype(float).where(it["frame"] != 1), "Invalid noise nan count"),
    ],
    "movies",
)


def test_renewed_offset_evens_the_picture() -> None:
    """A picture corrected by itself is uniform, and its mean is the one it had."""
    rng, rig = np.random.default_rng(8), simulation.Rig(bad_fraction=0.01)
    detector = simulation.pattern(rig, (24, 30), rng)
    movies = simulation.blackbody_movies(rig, np.linspace(285.0, 330.0, 4), 60, detector, rng)
    correction = fit_correction(blackbody_statistics(movies))
    flat = detector["gain"] * 17500.0 + detector["offset"] + rng.normal(0.0, 25.0, (2, 24, 30))
    renewed = renew_offset(correction, flat)
    good = ~correction["bad"]
    seen, even = (
        (part["gain"] * flat + part["offset"]).where(good) for part in (correction, renewed)
    )
    assert float(even.std(("y", "x")).max()) < 1e-6
    np.testing.assert_allclose(even.mean(("y", "x")), seen.mean(("y", "x")), rtol=0, atol=1e-6)
    assert renewed.attrs["offset_renewed"] == 1
