"""Separation: forward against inverse, at the statistical limit, with true error bars."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st

from dbthermal import experiments, mixing, schema, separation, simulation, smooth
from dbthermal import response as responses
from dbthermal.separation import limits
from dbthermal.simulation import Background, Rig

RIG = Rig()
TIME = np.arange(350) / 10.0
# Median RMSE of the object [K] and error of the emissivities [1] of the design's prototype, object
# from 20 C up to 45 and up to 60 C, noise (0.03, 0.35) K, someone walking by; None: not run.
PROTOTYPE = {
    (0.95, 0.85): (0.07, None, 0.008, 0.012),
    (0.86, 0.72): (0.13, 0.29, 0.014, 0.016),
    (0.60, 0.45): (0.33, 0.78, 0.027, 0.025),
    (0.30, 0.50): (0.42, 0.93, 0.019, 0.026),
}


def emissivity_of(*values: float) -> xr.DataArray:
    """Emissivity (band) of the rig's two bands."""
    return xr.DataArray(list(values), dims="band", coords={"band": list(RIG.bands)})


def glass_case(**changes: object) -> dict[str, object]:
    """Plate glass heated from 20 to 60 C."""
    return {"emissivity": [0.86, 0.72], "start": 20, "stop": 60, **changes}


Glass = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


@pytest.fixture(scope="module")
def glass() -> Glass:
    """Scene, capture and response: glass, 20 pixels as an image of 4 by 5."""
    rng = np.random.default_rng(11)
    flat = simulation.independent_pixels(
        TIME, emissivity_of(0.86, 0.72), Background(), 20, rng, start=293.15, stop=333.15
    )
    warm, cold = (
        flat[name].values.reshape(350, 4, 5)
        for name in ("object_temperature", "background_temperature")
    )
    scene = simulation.scene(TIME, warm, cold, emissivity_of(0.86, 0.72))
    response = RIG.response()
    return scene, simulation.observe(scene, response, rng), response


@pytest.mark.parametrize("pair", PROTOTYPE, ids=str)
@pytest.mark.parametrize("stop", [45, 60])
@pytest.mark.parametrize("noise_known", [True, False])
def test_subspace_reaches_the_design(
    pair: tuple[float, float], stop: int, noise_known: bool
) -> None:
    """Object and emissivities are as good as the prototype's, noise known or not."""
    case = glass_case(emissivity=list(pair), stop=stop, noise_known=noise_known)
    scene, result = experiments.run_case(case, RIG, TIME, 400, seed=7)
    score = experiments.score(scene, result)
    to_45, to_60, *of_emissivity = PROTOTYPE[pair]
    rmse = float(score["object_temperature_rmse"])
    errors = score["emissivity_error"].values
    print(f"{pair} to {stop} C: {rmse:.3f} K, emissivity {errors.round(4)}")
    limit = to_45 if stop == 45 else to_60
    assert limit is None or rmse <= limit
    assert np.all(errors <= of_emissivity)
    assert float(score["with_temperature"]) > 0.99


def test_ratio_scatters_as_the_bound_allows() -> None:
    """The reflection ratio's scatter is the Cramer-Rao bound's within 10 %."""
    scene, result = experiments.run_case(glass_case(), RIG, TIME, 1000, seed=3)
    efficiency = experiments.efficiency(scene, result, (0.03, 0.35), order=5)
    print(f"scatter of the ratio over its bound: {efficiency:.3f}")
    assert efficiency == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("pair", [(0.95, 0.85), (0.86, 0.72), (0.3, 0.5)], ids=str)
def test_error_bars_are_true(pair: tuple[float, float]) -> None:
    """Errors over standard deviations have a robust spread of 1 within 20 %, in every output."""
    case = glass_case(emissivity=list(pair))
    scene, result = experiments.run_case(case, RIG, TIME, 1000, seed=5)
    for name in ("object_temperature", "background_temperature", "emissivity"):
        scores = (result[name] - scene[name]) / result[f"{name}_std"]
        spread = 1.4826 * float(np.nanmedian(np.abs(scores)))
        print(f"{pair} {name}: spread of errors over their deviation {spread:.2f}")
        assert spread == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    ("background", "limit"),
    [
        ({"kind": "random walk", "memory": 0.3}, 0.11),
        ({"kind": "random walk", "memory": 3.0}, 0.15),
        ({"kind": "random walk", "memory": 30.0}, 0.42),
        ({"drift": 5.0}, 0.19),
    ],
)
def test_temperature_is_robust(background: dict[str, object], limit: float) -> None:
    """A background that never rests or drifts leaves the temperature as good as the prototype's."""
    case = glass_case(stop=45, background=background)
    scene, result = experiments.run_case(case, RIG, TIME, 400, seed=9)
    rmse = float(experiments.score(scene, result)["object_temperature_rmse"])
    print(f"{background}: {rmse:.3f} K")
    assert rmse <= limit


def test_constant_object_keeps_its_temperature() -> None:
    """With a constant object only the temperature is found; the rest is NaN and flagged."""
    case = glass_case(start=40, stop=40)
    scene, result = experiments.run_case(case, RIG, TIME, 200, seed=1)
    assert np.all(result["status"].values & schema.FLAGS["constant_object"])
    assert np.all(np.isnan(result["emissivity"].values))
    assert np.all(np.isnan(result["background_temperature"].values))
    assert float(experiments.score(scene, result)["object_temperature_rmse"]) <= 0.24  # [K]


def test_still_background_is_flagged() -> None:
    """Without motion nothing is claimed: NaN in every pixel, and the flag."""
    case = glass_case(background={"kind": "still"})
    _, result = experiments.run_case(case, RIG, TIME, 200, seed=2)
    flagged = result["status"].values & schema.FLAGS["no_background_motion"] != 0
    assert flagged.mean() > 0.97
    assert np.all(np.isnan(result["object_temperature"].values[:, flagged]))


def test_gray_body_is_flagged() -> None:
    """Equal emissivities are singular: no temperature, and the flag."""
    case = glass_case(emissivity=[0.8, 0.8])
    _, result = experiments.run_case(case, RIG, TIME, 200, seed=2)
    flagged = result["status"].values & schema.FLAGS["gray"] != 0
    assert flagged.mean() > 0.97
    assert np.all(np.isnan(result["emissivity"].values[:, flagged]))


def test_jump_of_the_object_is_flagged(
    glass: Glass,
) -> None:
    """A palm on the glass breaks the smooth prior: no such pixel passes as good."""
    scene, _, response = glass
    jump = 6.0 * (scene["time"] > 17)
    moved = scene.assign(object_temperature=scene["object_temperature"] - 5.0 + jump)
    capture = simulation.observe(moved, response, np.random.default_rng(0))
    assert np.all(separation.solve(capture, response)["status"].values != 0)


def test_fast_object_is_mostly_flagged() -> None:
    """An object that jumps in 0.2-0.4 s is flagged in nine pixels of ten, a slow one in none."""
    shares = []
    for constant in ((0.2, 0.4), (8.0, 20.0)):
        rng = np.random.default_rng(2)
        scene = simulation.independent_pixels(
            TIME,
            emissivity_of(0.86, 0.72),
            Background(),
            300,
            rng,
            start=293.15,
            stop=333.15,
            time_constant=constant,
        )
        status = separation.solve(simulation.observe(scene, RIG.response(), rng), RIG.response())[
            "status"
        ]
        shares.append(float((status != 0).mean()))
    print(f"flagged: fast object {shares[0]:.2f}, slow object {shares[1]:.3f}")
    assert shares[0] > 0.9
    assert shares[1] < 0.01


def test_linear_response_costs_kelvins() -> None:
    """The paper's linear response is offered, and is off by more than a kelvin at 60 C."""
    errors = []
    for kind in ("exact", "linear"):
        scene, result = experiments.run_case(glass_case(response_kind=kind), RIG, TIME, 100, seed=4)
        errors.append(float(experiments.score(scene, result)["object_temperature_rmse"]))
    print(f"exact {errors[0]:.2f} K, linear {errors[1]:.2f} K")
    assert errors[0] < 0.35
    assert errors[1] > 1.0


@settings(max_examples=25, deadline=None)
@given(
    first=st.floats(0.05, 0.95),
    second=st.floats(0.05, 0.95),
    warm=st.floats(275.0, 345.0),
    cold=st.floats(275.0, 345.0),
)
def test_calibrated_inverts_the_image_formation(
    first: float, second: float, warm: float, cold: float
) -> None:
    """Without noise the calibrated method returns the temperatures that went in."""
    if abs(first - second) < 0.05:
        return
    response = RIG.response()
    curves = [responses.curve(response, name) for name in RIG.bands]
    counts = [
        mixing.leaving(e, curve.counts(warm), curve.counts(cold))
        for e, curve in zip((first, second), curves, strict=True)
    ]
    # Two frames, one an hair warmer: a signal that never changes is flagged, not solved.
    movie = np.array(counts)[:, None, None, None] * np.array([1.0, 1.0 + 1e-9])[None, :, None, None]
    capture = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), movie)},
        coords={"band": list(RIG.bands), "time": [0.0, 0.1]},
    )
    result = separation.solve(
        capture, response, "calibrated", emissivity=emissivity_of(first, second)
    )
    for name, value in (("object_temperature", warm), ("background_temperature", cold)):
        np.testing.assert_allclose(result[name].values[0], value, rtol=0, atol=2e-3)  # [K]


def test_calibrated_noise_is_the_bound(glass: Glass) -> None:
    """Known emissivities: errors are those of the closed form, 0.35 K and 2.1 K for glass."""
    scene, capture, response = glass
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(capture, response, "calibrated", emissivity=known)
    for name in ("object_temperature", "background_temperature"):
        scores = (result[name] - scene[name]) / result[f"{name}_std"]
        assert float(scores.std()) == pytest.approx(1.0, abs=0.05)
    assert not result["status"].any()


def test_linear_variances_are_the_closed_form() -> None:
    """The design's figures for glass with noise (0.04, 0.4) K: 0.40 K and 2.4 K a frame."""
    mixed = mixing.matrix([0.86, 0.72])
    none = np.zeros(2)
    variance = limits.calibrated_variance(mixed, (0.04, 0.4), np.array([300.0, 300.0]), none)
    np.testing.assert_allclose(np.sqrt(variance), [0.40, 2.4], rtol=0, atol=0.07)  # [K]


@given(first=st.floats(0.02, 0.98), second=st.floats(0.02, 0.98))
def test_ratios_and_emissivities_are_inverse(first: float, second: float) -> None:
    """Emissivities follow from the two ratios, unless the body is gray."""
    if abs(first - second) < 1e-3:
        return
    pair = (first, second)
    found = limits.emissivities(limits.emission_ratio(pair), limits.reflection_ratio(pair))
    np.testing.assert_allclose(found, pair, rtol=0, atol=1e-9)


def test_bound_of_the_ratio_is_that_of_a_linear_model() -> None:
    """The bound equals the inverse Fisher information of the model with all its unknowns."""
    rng = np.random.default_rng(0)
    time, noise, pair = np.arange(40.0), (0.05, 0.3), (0.86, 0.72)
    background, functions = rng.normal(0, 3, 40), smooth.basis(time, 4)
    ratio = float(limits.reflection_ratio(pair))
    # Unknowns: the ratio, four coefficients of each band's smooth part, one reflection a frame.
    reflection = (1 - pair[0]) * background
    identity, zero = np.eye(40), np.zeros((40, 4))
    first = np.hstack([np.zeros((40, 1)), functions, zero, identity]) / noise[0]
    second = np.hstack([reflection[:, None], zero, functions, ratio * identity]) / noise[1]
    jacobian = np.vstack([first, second])
    # One combination of smooth part and reflection is shared: the pseudoinverse leaves it out.
    expected = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-10)[0, 0]
    found = limits.ratio_variance(pair, noise, background, functions)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_order_of_bands_and_tiles_does_not_matter(
    glass: Glass,
) -> None:
    """The same pixels give the same values with the bands exchanged, and one by one."""
    _, capture, response = glass
    whole = separation.solve(capture, response)
    exchanged = separation.solve(capture.isel(band=[1, 0]), response).sel(band=list(RIG.bands))
    single = separation.solve(capture.isel(y=[2], x=[3]), response)
    for name in ("object_temperature", "emissivity", "background_temperature_std"):
        np.testing.assert_array_equal(exchanged[name].values, whole[name].values)
        np.testing.assert_allclose(
            single[name].values[..., 0, 0], whole[name].values[..., 2, 3], rtol=1e-5
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
    """One sample is not a number."""
    capture["counts"].values[0, 7, 1, 2] = np.nan


def spoil_constant(capture: xr.Dataset) -> None:
    """One pixel of one band never changes."""
    capture["counts"].values[1, :, 1, 2] = 16000.0


@pytest.mark.parametrize(
    ("spoil", "name"), [(spoil_nan, "invalid_samples"), (spoil_constant, "constant_signal")]
)
def test_bad_pixel_is_flagged_and_alone(
    glass: Glass,
    spoil: Callable[[xr.Dataset], None],
    name: str,
) -> None:
    """A pixel that nothing can be computed of is NaN with its flag; the others do not change."""
    _, capture, response = glass
    spoilt = capture.copy(deep=True)
    spoil(spoilt)
    whole, result = separation.solve(capture, response), separation.solve(spoilt, response)
    assert result["status"].values[1, 2] == schema.FLAGS[name]
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
    status = np.zeros((4, 5), dtype=np.uint16)
    status[0, 0], status[3, 4] = schema.FLAGS["saturated"], schema.FLAGS["dead_pixel"]
    result = separation.solve(capture.assign(status=(("y", "x"), status)), response)
    assert result["status"].values[0, 0] & schema.FLAGS["saturated"]
    assert result["status"].values[3, 4] == schema.FLAGS["dead_pixel"]
    assert np.all(np.isnan(result["object_temperature"].values[:, 3, 4]))


def test_temperature_outside_the_response_is_flagged(
    glass: Glass,
) -> None:
    """An object beyond the calibrated range is extrapolated and flagged, never clipped."""
    scene, capture, response = glass
    narrow = response.assign(temperature_max=xr.DataArray(323.15, attrs={"units": "K"}))
    result = separation.solve(capture, narrow)
    assert np.all(result["status"].values & schema.FLAGS["outside_response"])
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
    "one band": (lambda c, r: separation.solve(c.isel(band=[0]), r), "Must be exactly two"),
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
            c.assign(status=(("y", "x"), np.full((4, 5), 2**14, np.uint16))), r
        ),
        "Unknown bits 16384 in the status",
    ),
    "noise": (
        lambda c, r: separation.solve(c, r.assign(noise=("band", [1.0, -1.0]))),
        "Invalid noise .count. -1.0. Must be finite and positive",
    ),
    "coefficient": (
        lambda c, r: separation.solve(c, r.assign(offset=("band", [np.nan, 0.0]))),
        "Invalid offset of the response in band '8-14'. Must be finite",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_input_is_a_clear_error(glass: Glass, what: str) -> None:
    """Each error names the thing, the value and the rule."""
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
    """Where the status is 0, everything is finite."""
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


def test_large_changes_of_the_background_do_not_bias() -> None:
    """Pulses of 12 K bend the responses apart; that is taken out: no bias, true error bars."""
    case = glass_case(background={"amplitude": 12.0})
    scene, result = experiments.run_case(case, Rig(highest=370.0), TIME, 400, seed=5)
    for name in ("object_temperature", "emissivity"):
        scores = (result[name] - scene[name]) / result[f"{name}_std"]
        bias, spread = (
            float(np.nanmedian(scores)),
            1.4826 * float(np.nanmedian(np.abs(scores))),
        )
        print(f"12 K pulses, {name}: bias {bias:.2f}, spread {spread:.2f} standard deviations")
        assert abs(bias) < 0.2
        assert spread == pytest.approx(1.0, abs=0.2)


def test_saturated_counts_are_flagged(glass: Glass) -> None:
    """Whole-number counts at the end of their type are flagged where they occur, and only there."""
    _, capture, response = glass
    counts = np.rint(capture["counts"].values).astype(np.uint16)
    counts[0, 100:110, 1, 1] = 65535
    result = separation.solve(capture.assign(counts=(capture["counts"].dims, counts)), response)
    flagged = result["status"].values & schema.FLAGS["saturated"] != 0
    assert flagged[1, 1]
    assert flagged.sum() == 1


def test_frozen_frames_are_flagged(glass: Glass) -> None:
    """Frames that repeat while a shutter is closed are flagged in every pixel."""
    _, capture, response = glass
    frozen = capture.copy(deep=True)
    frozen["counts"].values[:, 201:206] = frozen["counts"].values[:, [200]]
    assert np.all(separation.solve(frozen, response)["status"] & schema.FLAGS["frozen_frames"])
    assert not np.any(separation.solve(capture, response)["status"])


def test_unlabelled_emissivity_goes_by_position(glass: Glass) -> None:
    """An emissivity without band names is taken in the capture's order, as xarray aligns it."""
    _, capture, response = glass
    named = emissivity_of(0.86, 0.72)
    results = [
        separation.solve(capture.isel(time=[7]), response, "calibrated", emissivity=emissivity)
        for emissivity in (named, named.drop_vars("band"))
    ]
    xr.testing.assert_identical(*results)


def test_one_frame_can_be_calibrated(glass: Glass) -> None:
    """A single frame is enough with known emissivities, and is no constant signal."""
    scene, capture, response = glass
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(capture.isel(time=[7]), response, "calibrated", emissivity=known)
    assert not np.any(result["status"])
    error = result["object_temperature"] - scene["object_temperature"].isel(time=[7])
    assert float(abs(error).max()) < 5 * 0.4  # five standard deviations [K]


def test_nonsense_in_one_pixel_stays_there(glass: Glass) -> None:
    """Counts that no two temperatures give are flagged, not cast into infinity."""
    _, capture, response = glass
    wild = capture.copy(deep=True)
    wild["counts"].values[1, :, 0, 0] = wild["counts"].values[0, :, 0, 0]
    known = emissivity_of(0.86, 0.72)
    result = separation.solve(wild, response, "calibrated", emissivity=known)
    assert result["status"].values[0, 0] & schema.FLAGS["outside_response"]
    assert not np.any(result["status"].values[1:])


def test_reflected_change() -> None:
    """It is the share of the background's change that the first band sees, for objects that change
    and for those that do not.
    """
    rig, value = Rig(noise=(0.003, 0.035)), emissivity_of(0.86, 0.72)
    for stop in (293.15, 303.15):  # a constant object, and one that warms
        rng = np.random.default_rng(4)
        scene = simulation.independent_pixels(
            TIME, value, Background(), 40, rng, start=293.15, stop=stop
        )
        capture = simulation.observe(scene, rig.response(), rng)
        result = separation.solve(capture, rig.response())
        apparent = responses.apparent_temperature(rig.response(), capture["counts"])
        found = separation.reflected_change(apparent, result)
        true = 0.14 * (
            scene["background_temperature"] - scene["background_temperature"].mean("time")
        )
        assert found.dims == ("time", "y", "x")
        assert float(found.notnull().all("time").mean()) > 0.95
        error = float(np.sqrt(((found - true) ** 2).mean()))
        print(f"object to {stop} K: {error:.3f} K")
        assert error < 0.02  # [K], of changes of 0.4 K


def test_reflected_change_of_another_band() -> None:
    """Bands in another order are refused."""
    result = xr.Dataset(coords={"band": ["8-14", "9.5"]})
    apparent = xr.DataArray(np.zeros((2, 1, 1, 1)), dims=("band", "time", "y", "x"))
    with pytest.raises(ValueError, match=r"Invalid first band '9\.5'. Must be '8-14'"):
        separation.reflected_change(apparent.assign_coords(band=["9.5", "8-14"]), result)
