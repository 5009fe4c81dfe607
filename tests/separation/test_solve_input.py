"""Input of `solve`: invalid arguments, bad pixels, and their status."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import response as responses
from dbthermal import schema, separation, simulation
from dbthermal.separation._tiles import Estimate
from dbthermal.simulation import Background, Rig

RIG = Rig()
TIME = np.arange(350) / 10.0


def emissivity_of(*values: float) -> xr.DataArray:
    """Emissivity (band) of the rig's two bands."""
    return xr.DataArray(list(values), dims="band", coords={"band": list(RIG.bands)})


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def test_order_of_bands_and_tiles_does_not_matter(
    glass: Glass,
) -> None:
    """The same pixels give the same values with the bands exchanged, and one by one."""
    _, capture, response = glass
    whole = separation.solve(capture, response)
    exchanged = separation.solve(capture.isel(band=[1, 0]), response).sel(band=list(RIG.bands))
    single = separation.solve(capture.isel(y=[2], x=[3]), response)
    # The prior's spectrum is a small difference: it feels the rounding of single precision.
    for name, rtol in (
        ("object_temperature", 1e-5),
        ("emissivity", 1e-5),
        ("reflection_ratio", 1e-5),
        ("background_temperature_std", 2e-3),
    ):
        np.testing.assert_array_equal(exchanged[name].values, whole[name].values)
        np.testing.assert_allclose(
            single[name].values[..., 0, 0], whole[name].values[..., 2, 3], rtol=rtol
        )


def test_result_is_as_the_schema_has_it(
    glass: Glass,
) -> None:
    """Names, dims, dtypes and units are the glossary's, and the capture is not changed."""
    _, capture, response = glass
    before = capture.copy(deep=True)
    result = separation.solve(capture, response)
    schema.check(result, "separated")
    for name, variable in schema.STAGES["separated"].items():
        assert result[name].dtype == variable.dtype
    xr.testing.assert_identical(capture, before)
    assert result.attrs["origin"] == "simulated"


def spoil_nan(capture: xr.Dataset) -> None:
    """Set a pixel of one band to NaN in the first 210 of its frames."""
    capture["counts"].values[0, :210, 1, 2] = np.nan


def spoil_constant(capture: xr.Dataset) -> None:
    """Set one pixel of one band to a constant."""
    capture["counts"].values[1, :, 1, 2] = 16000.0


@pytest.mark.parametrize(
    ("spoil", "name"), [(spoil_nan, "invalid_samples"), (spoil_constant, "constant_signal")]
)
def test_bad_pixel_is_flagged_and_alone(
    glass: Glass,
    spoil: Callable[[xr.Dataset], None],
    name: str,
) -> None:
    """An unusable pixel is NaN with its flag, and the others do not change."""
    _, capture, response = glass
    spoilt = capture.copy(deep=True)
    spoil(spoilt)
    whole, result = separation.solve(capture, response), separation.solve(spoilt, response)
    assert result["status"].values[1, 2] == schema.Status.bits()[name]
    assert np.all(np.isnan(result["object_temperature"].values[:, 1, 2]))
    others = np.ones((4, 5), dtype=bool)
    others[1, 2] = False
    np.testing.assert_array_equal(
        result["object_temperature"].values[:, others],
        whole["object_temperature"].values[:, others],
    )


def test_status_of_the_correction_is_kept(
    glass: Glass,
) -> None:
    """Saturated and dead pixels keep the flags that the frame correction gave them."""
    _, capture, response = glass
    status = np.zeros((4, 5), dtype=np.uint32)
    status[0, 0], status[3, 4] = schema.Status.SATURATED, schema.Status.DEAD_PIXEL
    result = separation.solve(capture.assign(status=(("y", "x"), status)), response)
    assert result["status"].values[0, 0] & schema.Status.SATURATED
    assert result["status"].values[3, 4] == schema.Status.DEAD_PIXEL
    assert np.all(np.isnan(result["object_temperature"].values[:, 3, 4]))


def test_temperature_outside_the_response_is_flagged(
    glass: Glass,
) -> None:
    """An object beyond the calibrated range is extrapolated and flagged, never clipped."""
    scene, capture, response = glass
    narrow = response.assign(temperature_max=xr.DataArray(323.15, attrs={"units": "K"}))
    result = separation.solve(capture, narrow)
    assert np.all(result["status"].values & schema.Status.OUTSIDE_RESPONSE)
    error = result["object_temperature"] - scene["object_temperature"]
    assert float(np.sqrt((error**2).mean())) < 0.5  # [K]


BAD: dict[str, tuple[Callable[[xr.Dataset, xr.Dataset], object], str]] = {
    "unknown method": (
        lambda c, r: separation.solve(c, r, "magic"),
        r"Unknown method 'magic'. Must be one of \['subspace', 'calibrated', 'dbvt'",
    ),
    "unknown kind": (
        lambda c, r: separation.solve(c, r, response_kind="cubic"),
        "Unknown kind of response 'cubic'",
    ),
    "one band": (lambda c, r: separation.solve(c.isel(band=[0]), r), "Must be two or more"),
    "missing band": (
        lambda c, r: separation.solve(c, r.isel(band=[0])),
        "Missing band '9.5' in the response",
    ),
    "dims": (
        lambda c, r: separation.solve(c.transpose("time", "band", "y", "x"), r),
        r"Invalid dims \('time', 'band', 'y', 'x'\) of 'counts'",
    ),
    "units": (
        lambda c, r: separation.solve(c.assign(counts=c["counts"].assign_attrs(units="K")), r),
        "Invalid units 'K' of 'counts' of the corrected. Must be 'count'",
    ),
    "time": (
        lambda c, r: separation.solve(c.isel(time=[*range(40), 39, *range(40, 80)]), r),
        "Unordered 'time' of 'counts' of the corrected: 3.9 s is followed by 3.9 s",
    ),
    "short": (
        lambda c, r: separation.solve(c.isel(time=slice(0, 20)), r),
        "Invalid capture of 20 frames for method 'subspace'. Must have at least 32",
    ),
    "workers": (lambda c, r: separation.solve(c, r, workers=0), "Invalid number of workers 0"),
    "no emissivity": (lambda c, r: separation.solve(c, r, "calibrated"), "Missing emissivity"),
    "needless emissivity": (
        lambda c, r: separation.solve(c, r, emissivity=emissivity_of(0.8, 0.7)),
        "Invalid emissivity for method 'subspace'",
    ),
    "emissivity 1.2": (
        lambda c, r: separation.solve(c, r, "calibrated", emissivity=emissivity_of(0.8, 1.2)),
        r"Invalid emissivity 1.2 in band '9.5', pixel \(0, 0\). Must lie in \(0, 1\)",
    ),
    "gray": (
        lambda c, r: separation.solve(c, r, "calibrated", emissivity=emissivity_of(0.8, 0.8)),
        "the same in both bands. Must differ",
    ),
    "noise in kelvin": (
        lambda c, r: separation.solve(c, r.assign(noise=r["noise"].assign_attrs(units="K"))),
        "Invalid units 'K' of 'noise' of the response. Must be 'count'",
    ),
    "noise without bands": (
        lambda c, r: separation.solve(c, r.assign(noise=3.0)),
        "Invalid dims .. of 'noise' of the response",
    ),
    "status dims": (
        lambda c, r: separation.solve(
            c.assign(status=(("x", "y"), np.zeros((5, 4), np.uint16))), r
        ),
        "Invalid status .'x', 'y'. of uint16",
    ),
    "status bits": (
        lambda c, r: separation.solve(
            c.assign(status=(("y", "x"), np.full((4, 5), 2**16, np.uint32))), r
        ),
        "Unknown bits 65536 in the status",
    ),
    "noise": (
        lambda c, r: separation.solve(c, r.assign(noise=("band", [1.0, -1.0]))),
        "Invalid noise .count. -1.0 in band '9.5'. Must be finite and positive",
    ),
    "coefficient": (
        lambda c, r: separation.solve(c, r.assign(offset=("band", [np.nan, 0.0]))),
        "Invalid offset of the response in band '8-14'. Must be finite",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_a_clear_error(glass: Glass, what: str) -> None:
    """Invalid input raises an error with the name, the value and the rule."""
    call, message = BAD[what]
    _, capture, response = glass
    with pytest.raises(ValueError, match=message):
        call(capture, response)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    frames=st.integers(32, 120),
    first=st.floats(0.05, 0.97),
    second=st.floats(0.05, 0.97),
    loudness=st.floats(0.1, 10.0),
    method=st.sampled_from([name for name in separation.METHODS if name != "dbvt"]),
)
def test_good_means_complete(
    seed: int, frames: int, first: float, second: float, loudness: float, method: str
) -> None:
    """Pixels with a status of 0 are finite in every quantity."""
    rng, rig = np.random.default_rng(seed), Rig(noise=(0.03 * loudness, 0.35 * loudness))
    known = emissivity_of(first, second)
    scene = simulation.independent_pixels(
        TIME[:frames], known, Background(), 40, rng, start=293.15, stop=323.15
    )
    capture = simulation.observe(scene, rig.response(), rng)
    given_emissivity = known if method == "calibrated" else None
    if method == "calibrated" and first == second:
        return
    result = separation.solve(capture, rig.response(), method, emissivity=given_emissivity)
    complete = np.ones((1, 40), dtype=bool)
    for name in schema.STAGES["separated"].keys() - result.attrs["not_estimated"].split():
        values = result[name].values.reshape(-1, 1, 40)
        complete &= np.all(np.isfinite(values), axis=0)
    assert np.all(complete[result["status"].values == 0])


def test_saturated_counts_are_flagged(glass: Glass) -> None:
    """Whole-number counts at the end of their type are flagged where they occur, and only there."""
    _, capture, response = glass
    counts = np.rint(capture["counts"].values).astype(np.uint16)
    counts[0, 100:110, 1, 1] = 65535
    result = separation.solve(capture.assign(counts=(capture["counts"].dims, counts)), response)
    flagged = result["status"].values & schema.Status.SATURATED != 0
    assert flagged[1, 1]
    assert flagged.sum() == 1


def test_masked_samples_do_not_saturate_a_pixel(glass: Glass) -> None:
    """Frames at the detector's limit that the mask leaves out leave no flag."""
    _, capture, response = glass
    counts = np.rint(capture["counts"].values).astype(np.uint16)
    counts[:, 100:110] = 65535
    used = xr.DataArray((TIME < 10.0) | (TIME >= 11.0), dims="time")
    whole = capture.assign(counts=(capture["counts"].dims, counts, capture["counts"].attrs))
    result = separation.solve(whole, response, mask=used)
    assert not np.any(result["status"].values & schema.Status.SATURATED)
    assert np.all(separation.solve(whole, response)["status"] & schema.Status.SATURATED)


def test_frozen_frames_are_flagged(glass: Glass) -> None:
    """Frames that repeat while a shutter is closed are flagged in every pixel."""
    _, capture, response = glass
    frozen = capture.copy(deep=True)
    frozen["counts"].values[:, 201:206] = frozen["counts"].values[:, [200]]
    assert np.all(separation.solve(frozen, response)["status"] & schema.Status.FROZEN_FRAMES)
    assert not np.any(separation.solve(capture, response)["status"])


@pytest.mark.parametrize("name", ["gray", None])
def test_a_quantity_that_is_nan_in_all_frames_has_a_flag(name: str | None) -> None:
    """A quantity that is NaN in all frames is flagged as outside the response, or by its cause."""
    before = np.full(1, 0 if name is None else schema.Status.bits()[name], dtype=np.uint32)
    warm, none, share = np.full((9, 1), 300.0), np.full((9, 1), np.nan), np.full((2, 1), 0.5)
    found = Estimate(warm, 0.1 * np.ones((9, 1)), none, none, share, 0.1 * share, before)
    status = found.check_range(responses.curve(RIG.response(), RIG.bands[0])).status
    assert status[0] == before[0] or name is None
    assert status[0] != 0
