"""No warning of NumPy, SciPy, xarray or zarr comes through, whatever the counts are."""

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import (
    alignment,
    calibration,
    correction,
    emissivity,
    limits,
    metrics,
    mixing,
    noise,
    response,
    separation,
    simulation,
)
from reproduction import methods, scales

RIG = simulation.Rig(bad_fraction=0.0)
CAMERA = RIG.response()
BANDS = list(RIG.bands)
GLASS = xr.DataArray([0.86, 0.72], {"band": BANDS}, dims="band")
TIME = np.arange(60) / 10.0
RNG = np.random.default_rng(0)
SCENE = simulation.walkers(TIME, (6, 8), GLASS, RNG)
CAPTURE = simulation.observe(SCENE, CAMERA, RNG, dtype="float64")
Counts = np.ndarray[Any, np.dtype[np.float64]]


def with_(value: float, *places: Any) -> Callable[[Counts], Counts]:
    """Counts with one value at some places."""

    def changed(counts: Counts) -> Counts:
        counts = counts.copy()
        for place in places or (np.s_[:],):
            counts[place] = value
        return counts

    return changed


def scattered(share: float) -> Callable[[Counts], Counts]:
    """Counts of which a share is NaN."""
    rng = np.random.default_rng
    return lambda counts: np.where(rng(1).random(counts.shape) < share, np.nan, counts)


ODD: dict[str, Callable[[Counts], Counts]] = {
    "all NaN": with_(np.nan),
    "a band NaN": with_(np.nan, 1),
    "half a band NaN": with_(np.nan, np.s_[0, :30]),
    "NaN but for two frames": with_(np.nan, np.s_[:, 2:]),
    "alternating NaN": with_(np.nan, np.s_[0, ::2], np.s_[1, 1::2]),
    "10 % NaN": scattered(0.1),
    "60 % NaN": scattered(0.6),
    "98 % NaN": scattered(0.98),
    "an infinite sample": with_(np.inf, np.s_[0, 3, 2, 2]),
    "an infinite row": with_(-np.inf, np.s_[:, :, 1]),
    "all infinite": with_(np.inf),
    "constant": with_(20000.0),
    "a constant band": with_(20000.0, 0),
    "one step": lambda counts: with_(21000.0, np.s_[:, 30:])(with_(20000.0)(counts)),
    "zero": with_(0.0),
    "negative": lambda counts: -counts,
    "tiny": lambda counts: 1e-300 * counts,
    "huge": lambda counts: 1e300 * counts,
    "beyond single precision": lambda counts: 1e36 * counts,
    "one huge sample": with_(1e300, np.s_[0, 30, 3, 3]),
    "one band twice": lambda counts: counts[[0, 0]],
}
QUICK = ("a band NaN", "60 % NaN", "an infinite row", "one huge sample", "tiny")


def blackbody(capture: xr.Dataset) -> xr.DataArray:
    """Six of the frames as those of a blackbody."""
    coordinates = {"band": BANDS, "temperature": np.linspace(285.0, 335.0, 6)}
    counts = capture["counts"].values[:, :6]
    return xr.DataArray(counts, coordinates, dims=("band", "temperature", "y", "x"))


def measured(capture: xr.Dataset) -> xr.Dataset:
    """Some of the counts as those of an emissivity bench."""
    counts, dims = capture["counts"].values, ("band", "measurement")
    parts = {"counts": (dims, counts[:, :3, 0, 0])}
    parts["reflected_counts"] = (dims, counts[:, 5:8, 1, 1])
    kelvin = {"object": [300.0, 320.0, 335.0], "background": [330.0, 310.0, 295.0]}
    rest = {f"{who}_temperature": ("measurement", values) for who, values in kelvin.items()}
    return xr.Dataset({**parts, **rest}, {"band": BANDS})


def solved(method: str, capture: xr.Dataset) -> None:
    """Separate by a method, without a known noise."""
    known = GLASS if method == "calibrated" else None
    separation.solve(
        capture, CAMERA.drop_vars("noise"), method=methods.get_method(method), emissivity=known
    )


def separated(capture: xr.Dataset) -> None:
    """Separate by the default method, and go on with its result."""
    result = separation.solve(capture, CAMERA)
    apparent = response.apparent_temperature(CAMERA, capture["counts"])
    separation.reflected_change(apparent, result)
    metrics.relative_error_celsius(result["object_temperature"], SCENE["object_temperature"])
    separation.materials(result, capture, CAMERA)


def films(capture: xr.Dataset) -> list[Counts]:
    """Signals (time, pixel) of the two bands."""
    return [part.values.reshape(60, -1) for part in capture["counts"]]


METHODS = ("subspace", "calibrated", "naive", "ratio", "bcp", "apparent")
PLACES = xr.DataArray(np.ones((6, 8), bool), dims=("y", "x"))
STD = (0.1, 0.1)
CALLS: dict[str, Callable[[xr.Dataset], Any]] = {
    **{f"solve {method}": partial(solved, method) for method in METHODS},
    "separated": separated,
    "uncalibrated_reflection": lambda it: scales.uncalibrated_reflection(it["counts"]),
    "correlation": lambda it: metrics.correlation(it["counts"][0], it["counts"][1]),
    "noise": lambda it: noise.estimate_bands(films(it), TIME),
    "second_difference": lambda it: noise.second_difference(films(it)[0], TIME),
    "time_offset": alignment.time_offset,
    "align": lambda it: alignment.align(it, offset=0.03),
    "register": lambda it: alignment.register(it, model="affine"),
    "mark_bad": correction.mark_bad,
    "mark_shutter": correction.mark_shutter,
    "undo_lag": lambda it: correction.undo_lag(it, 10.0),
    "undo_drift": lambda it: correction.undo_drift(it, PLACES),
    "fit_correction": lambda it: correction.fit_correction(blackbody(it).to_dataset(name="counts")),
    "fit_response": lambda it: calibration.fit_response(blackbody(it)[..., 0, 0]),
    "fit_emissivity": lambda it: calibration.fit_emissivity(measured(it), CAMERA, STD),
    "reflector_emissivity": lambda it: calibration.reflector_emissivity(measured(it), CAMERA, STD),
}


@pytest.fixture(autouse=True)
def warnings_are_errors() -> Iterator[None]:
    """Make every warning an error, as Python's option ``-W error`` does."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in QUICK else pytest.mark.slow) for name in ODD]
)
def test_odd_counts_warn_of_nothing(name: str, call: str) -> None:
    """Odd counts give a result, with NaN and status where there is none, or a ValueError."""
    counts = CAPTURE["counts"]
    capture = CAPTURE.assign(counts=counts.copy(data=ODD[name](counts.values)))
    message = "Must"
    try:
        CALLS[call](capture)
    except ValueError as error:
        message = str(error)
    assert "Must" in message


def test_odd_emissivities_and_truths_warn_of_nothing() -> None:
    """An unknown emissivity has no condition number; infinite ones and truths raise an error.

    Limits that 16 bits do not hold, and exponents that 64 do not, come without a warning, too.
    """
    half = CAPTURE.assign(counts=CAPTURE["counts"].astype("float16"))
    assert separation.solve(half, CAMERA).sizes["y"] == 6
    short = CAMERA.assign(effective_wavelength=CAMERA["effective_wavelength"] * 1e-3)
    with pytest.raises(ValueError, match=r"Invalid slope 0\.0"):
        separation.solve(CAPTURE, short)
    unknown, glass = mixing.condition_number([[0.86, np.nan], [0.86, 0.72]])
    assert np.isnan(unknown)
    assert glass == mixing.condition_number([0.86, 0.72])
    table = emissivity.embedded_table()
    noises = emissivity.filter_noise(0.03, [str(name) for name in table["band"].values])
    with pytest.raises(ValueError, match="Invalid emissivity of the table inf"):
        emissivity.rank_filters(table.assign(emissivity=table["emissivity"] + np.inf), noises)
    for name in ("object_temperature", "background_temperature"):
        endless = SCENE.assign({name: SCENE[name].where(SCENE["time"] > 1.0, np.inf)})
        with pytest.raises(ValueError, match=f"Invalid {name} of the scene: not finite"):
            limits.bounds(endless, CAMERA)
