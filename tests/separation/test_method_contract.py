"""Contract of all methods: properties of `solve` for its names and for records from outside."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import xarray as xr
from attack.arrays import FAST
from captures import FILMS, GLASS, RIG, emissivity_of
from hypothesis import given, settings
from hypothesis import strategies as st
from refused import assert_refused

from dbthermal import response as responses
from dbthermal import schema, separation, simulation
from dbthermal.schema import Status
from dbthermal.simulation import Background, Rig
from reproduction import methods
from reproduction.experiments.cases import independent_pixels

TIME = np.arange(120) / 10.0  # s
Pair = tuple[xr.Dataset, xr.Dataset]
Plain = Callable[[str], xr.Dataset]
every_method = pytest.mark.parametrize("method", methods.METHODS)


def capture_of(
    shape: tuple[int, int], time: np.ndarray = TIME, emissivity: Any = GLASS, rig: Rig = RIG
) -> xr.Dataset:
    """Capture of a surface that warms up by 30 K, each pixel before a background of its own."""
    rng, frames = np.random.default_rng(1), time.size
    flat = independent_pixels(
        time, emissivity, Background(), shape[0] * shape[1], rng, start=293.15, stop=323.15
    )
    warm, cold = (flat[name].values.reshape(frames, *shape) for name in FILMS)
    scene = simulation.scene(time, warm, cold, emissivity)
    return simulation.observe(scene, rig.response(), rng)


@pytest.fixture(scope="module")
def pair() -> Pair:
    """A capture of 4 x 6 pixels, and the response."""
    return capture_of((4, 6)), RIG.response()


def solve(capture: xr.Dataset, response: xr.Dataset, method: str, **options: Any) -> xr.Dataset:
    """Separate with small settings, and with the emissivities if the method must know them."""
    options.setdefault("settings", FAST.get(method))
    if methods.get_method(method).knows_emissivity:
        options.setdefault("emissivity", GLASS)
    return separation.solve(capture, response, methods.get_method(method), **options)


def estimated(result: xr.Dataset) -> set[str]:
    """Names of the values that the method estimates."""
    missing = result.attrs["not_estimated"].split()
    return schema.STAGES["separated"].keys() - {"status", *missing}


@pytest.fixture(scope="module")
def plain(pair: Pair) -> Plain:
    """Result of the pair by a method, made once."""
    return functools.cache(lambda method: solve(*pair, method))


@every_method
def test_result_is_as_the_schema_has_it(pair: Pair, method: str) -> None:
    """As in the glossary, with what has no value named; inputs and their flags stay."""
    status = np.zeros((4, 6), dtype=np.uint32)
    status[0, 0] = Status.SATURATED
    capture = pair[0].assign(status=(("y", "x"), status))
    before = capture.copy(deep=True)
    result = solve(capture, pair[1], method)
    schema.check(result, "separated")
    np.testing.assert_array_equal(result["status"].values & Status.SATURATED, status)
    for name, variable in schema.STAGES["separated"].items():
        assert result[name].dtype == variable.dtype
        if name != "status":
            assert bool(result[name].notnull().any()) == (name in estimated(result)), name
    xr.testing.assert_identical(capture, before)
    assert result.attrs["origin"] == "simulated"


@settings(max_examples=35)
@given(
    seed=st.integers(0, 10_000),
    frames=st.integers(32, 120),
    first=st.floats(0.05, 0.97),
    second=st.floats(0.05, 0.97),
    loudness=st.floats(0.1, 10.0),
    method=st.sampled_from(methods.METHODS),
)
def test_good_means_complete(
    seed: int, frames: int, first: float, second: float, loudness: float, method: str
) -> None:
    """Pixels with a status of 0 are finite in every quantity that the method estimates."""
    rng, rig = np.random.default_rng(seed), Rig(noise=(0.03 * loudness, 0.35 * loudness))
    known = emissivity_of(first, second)
    knows = methods.get_method(method).knows_emissivity
    if knows and first == second:
        return
    scene = independent_pixels(
        np.arange(frames) / 10.0, known, Background(), 40, rng, start=293.15, stop=323.15
    )
    response = rig.response()
    capture = simulation.observe(scene, response, rng)
    result = solve(capture, response, method, **({"emissivity": known} if knows else {}))
    good = result["status"].values == 0
    for name in estimated(result):
        assert np.all(np.isfinite(result[name].values[..., good])), name


@every_method
def test_number_of_threads_changes_nothing(method: str) -> None:
    """One thread or two: the same numbers, of two blocks of rows."""
    capture, response = capture_of((36, 3), TIME[:40]), RIG.response()
    one, two = (solve(capture, response, method, seed=1, workers=count) for count in (1, 2))
    xr.testing.assert_identical(one, two)


@every_method
def test_slightly_uneven_times(method: str) -> None:
    """Intervals that vary by a fifth are accepted by every method."""
    time = TIME + np.random.default_rng(2).uniform(-0.01, 0.01, TIME.size)
    result = solve(capture_of((2, 6), time), RIG.response(), method)
    assert bool(result["object_temperature"].notnull().any())


@every_method
@pytest.mark.parametrize("gap", ["times", "nan"])
def test_lost_frames(pair: Pair, plain: Plain, method: str, gap: str) -> None:
    """Lost frames are NaN and the others solved; methods that need even times say so."""
    capture, response = pair
    kept = np.ones(TIME.size, dtype=bool)
    kept[[7, *range(30, 36)]] = False
    lossy = capture.isel(time=kept) if gap == "times" else capture.copy(deep=True)
    if gap == "nan":
        lossy["counts"].values[1, ~kept] = np.nan
    if method == "dbvt":
        with pytest.raises(ValueError, match=rf"Invalid interval .* method '{method}'. Must be"):
            solve(lossy, response, method)
        return
    result, whole = solve(lossy, response, method), plain(method)
    solved = result["object_temperature"].notnull().any("time").values
    np.testing.assert_array_equal(solved, whole["object_temperature"].notnull().any("time").values)
    if gap == "nan":
        for name in FILMS:
            assert np.all(np.isnan(result[name].values[~kept]))


@every_method
def test_one_lost_sample_costs_its_frame_alone(pair: Pair, plain: Plain, method: str) -> None:
    """A frame that one pixel lacks is NaN there; the pixel's other frames have their values."""
    spoilt = pair[0].copy(deep=True)
    spoilt["counts"].values[0, 30, 0, 2] = np.nan
    found = solve(spoilt, pair[1], method)["object_temperature"].values[:, 0, 2]
    whole = plain(method)["object_temperature"].values[:, 0, 2]
    assert np.isnan(found[30])
    np.testing.assert_array_equal(np.isfinite(np.delete(found, 30)), np.isfinite(whole)[1:])


@every_method
def test_pixel_that_lacks_frames(pair: Pair, method: str) -> None:
    """A pixel with missing frames is solved, or flagged by methods that need common frames."""
    record, spoilt = methods.get_method(method), pair[0].copy(deep=True)
    spoilt["counts"].values[1, 7:10, 0, 2] = np.nan  # longer than what is bridged
    result = solve(spoilt, pair[1], method)
    lacking = result["status"].values & Status.INVALID_SAMPLES != 0
    expected = np.zeros((4, 6), dtype=bool)
    expected[0, 2] = record.whole_image or record.every_frame
    np.testing.assert_array_equal(lacking, expected)
    assert np.all(np.isnan(result["object_temperature"].values[:, lacking]))


def spoilt(capture: xr.Dataset, bit: Status) -> xr.Dataset:
    """Make a pixel dead by the status, lacking three frames in five, or constant in a band."""
    capture = capture.copy(deep=True)
    counts, status = capture["counts"].values[..., 1, 2], np.zeros((4, 6), dtype=np.uint32)
    if bit == Status.DEAD_PIXEL:
        counts[:] = 60000.0
        status[1, 2] = bit
    elif bit == Status.INVALID_SAMPLES:
        counts[0, :72] = np.nan
    else:
        counts[1] = 16000.0
    return capture.assign(status=(("y", "x"), status))


@every_method
@pytest.mark.parametrize("bit", [Status.DEAD_PIXEL, Status.INVALID_SAMPLES, Status.CONSTANT_SIGNAL])
def test_bad_pixel_is_flagged_and_alone(pair: Pair, plain: Plain, method: str, bit: Status) -> None:
    """It is NaN with its flag; others keep their values, but beside whole-image methods."""
    whole, result = plain(method), solve(spoilt(pair[0], bit), pair[1], method)
    assert result["status"].values[1, 2] & bit
    for name in schema.STAGES["separated"].keys() - {"status"}:
        assert np.all(np.isnan(result[name].values[..., 1, 2]))
    others = np.ones((4, 6), dtype=bool)
    others[1, 2] = False
    assert not np.any(result["status"].values[others] & bit)
    found, expected = (each["object_temperature"].values[:, others] for each in (result, whole))
    assert np.isfinite(found).any()
    record = methods.get_method(method)
    if not (record.whole_image or hasattr(record.settings, "starts")):
        np.testing.assert_array_equal(found, expected)


@every_method
@pytest.mark.filterwarnings("ignore:Invalid samples in all")
@pytest.mark.parametrize("value", [0.0, -1e6, 1e9, np.inf, np.nan])
def test_hostile_counts_are_no_error(pair: Pair, method: str, value: float) -> None:
    """Impossible counts, in one pixel or in all, give a flag and no exception."""
    capture, response = pair
    one, whole = capture.copy(deep=True), capture.copy(deep=True)
    one["counts"].values[:, :80, 1, 2] = value
    whole["counts"].values[:] = value
    assert solve(one, response, method)["status"].values[1, 2]
    assert np.all(solve(whole, response, method)["status"])


@every_method
@pytest.mark.parametrize("factor", [1.4, 0.6])
def test_temperature_outside_the_response_is_flagged(
    pair: Pair, method: str, factor: float
) -> None:
    """A temperature beyond the calibrated range, by five deviations, is flagged or NaN."""
    capture, response = pair
    curve = responses.curve(response, RIG.bands[0])
    counts = (capture["counts"] * factor).assign_attrs(units="count")
    result = solve(capture.assign(counts=counts), response, method)
    flagged = result["status"].values & Status.OUTSIDE_RESPONSE != 0
    for name in FILMS:
        value, margin = result[name].values, 5 * result[f"{name}_std"].fillna(0.0).values
        beyond = (value < curve.lowest - margin) | (value > curve.highest + margin)
        assert np.all(flagged[np.any(beyond, axis=0)]), name
    assert np.all(result["status"])


@every_method
def test_third_band_is_taken_or_refused(method: str) -> None:
    """A third band is solved, or raises a ValueError in a method for two bands."""
    rig = Rig(bands=("8-14", "9.5", "10.6"), noise=(0.03, 0.35, 0.15))
    emissivity = emissivity_of(0.86, 0.72, 0.88, bands=rig.bands)
    capture, response = capture_of((4, 6), TIME, emissivity, rig), rig.response()
    record = methods.get_method(method)
    if record.any_bands:
        known = emissivity if record.knows_emissivity else None
        result = separation.solve(capture, response, methods.get_method(method), emissivity=known)
        assert bool(result["object_temperature"].notnull().any())
        return
    message = rf"Invalid bands \['8-14', '9.5', '10.6'\] for method '{method}'. Must be exactly two"
    assert_refused(message, solve, capture, response, method)


@every_method
def test_demands_are_said(pair: Pair, method: str) -> None:
    """Unmet demands of a method raise an error that names them."""
    record = methods.get_method(method)
    if record.minimum_frames > 1:
        frames = record.minimum_frames - 1
        message = f"Invalid number {frames} of frames for method '{method}'. Must have at least"
        assert_refused(message, solve, pair[0].isel(time=slice(0, frames)), pair[1], method)
    wrong, message = (None, "Missing") if record.knows_emissivity else (GLASS, "Invalid")
    assert_refused(f"{message} emissivity", solve, *pair, method, emissivity=wrong)
    if not record.pools:
        pool = xr.zeros_like(pair[0]["counts"][0, 0], dtype=int)
        assert_refused(f"Invalid pool for method '{method}'", solve, *pair, method, pool=pool)
    rule = "be omitted" if record.settings is None else f"be {record.settings.__name__}"
    with pytest.raises(TypeError, match=rf"type dict for method '{method}'. Must {rule}"):
        solve(*pair, method, settings={"starts": 3})
