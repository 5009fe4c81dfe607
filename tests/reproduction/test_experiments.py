"""Experiments: scores of results with known errors, and one run against the bound."""

import re
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.simulation import Background, Rig
from reproduction import experiments
from reproduction.experiments.cases import simulate

TIME = np.arange(350) / 10.0  # s
GLASS: dict[str, Any] = {"case": "glass", "emissivity": [0.86, 0.72], "start": 20, "stop": 60}


@pytest.fixture
def truth() -> xr.Dataset:
    """A scene of 40 pixels."""
    emissivity = xr.DataArray([0.86, 0.72], dims="band", coords={"band": ["8-14", "9.5"]})
    rng = np.random.default_rng(0)
    return simulation.independent_pixels(
        TIME[:50], emissivity, Background(), 40, rng, start=300.0, stop=320.0
    )


def perfect(truth: xr.Dataset) -> xr.Dataset:
    """The truth as a result, with deviations of 0.1 K and 0.01."""
    return truth.assign(
        object_temperature_std=xr.full_like(truth["object_temperature"], 0.1),
        emissivity_std=xr.full_like(truth["emissivity"], 0.01),
        status=(("y", "x"), np.zeros((1, 40), dtype=np.uint16)),
    )


def test_perfect_result(truth: xr.Dataset) -> None:
    """A perfect result has no error, and full coverage."""
    found = experiments.score(truth, perfect(truth))
    assert float(found["object_temperature_rmse"]) == 0.0
    np.testing.assert_array_equal(found["emissivity_error"], [0.0, 0.0])
    np.testing.assert_array_equal(found["emissivity_coverage"], [1.0, 1.0])
    for name in ("object_coverage", "good", "with_temperature"):
        assert float(found[name]) == 1.0


def test_known_errors(truth: xr.Dataset) -> None:
    """Offsets of 0.2 K and 0.02 are the errors, beyond every error bar."""
    result = perfect(truth)
    result["object_temperature"] = result["object_temperature"] - 0.2
    result["emissivity"] = result["emissivity"] + xr.DataArray([0.02, -0.005], dims="band")
    found = experiments.score(truth, result)
    assert float(found["object_temperature_rmse"]) == pytest.approx(0.2, abs=1e-9)  # K
    np.testing.assert_allclose(found["emissivity_error"], [0.02, 0.005], rtol=0, atol=1e-12)
    assert float(found["object_coverage"]) == 0.0
    np.testing.assert_array_equal(found["emissivity_coverage"], [0.0, 1.0])


def test_pixels_without_a_value(truth: xr.Dataset) -> None:
    """Pixels without a value count in the shares alone."""
    result = perfect(truth)
    result["object_temperature"] = result["object_temperature"].where(result["x"] >= 10)
    result["emissivity"] = result["emissivity"].where(result["x"] >= 20)
    result["status"] = result["status"].where(result["x"] >= 10, 1)
    found = experiments.score(truth, result)
    assert float(found["with_temperature"]) == 0.75
    assert float(found["good"]) == 0.75
    assert float(found["object_temperature_rmse"]) == 0.0
    assert float(found["object_coverage"]) == 1.0
    np.testing.assert_array_equal(found["emissivity_coverage"], [1.0, 1.0])


@pytest.mark.slow
def test_glass_near_the_bound() -> None:
    """On 400 pixels of glass the ratio reaches the Cramer-Rao bound with 68 % coverage."""
    found = experiments.sweep([GLASS], Rig(), TIME, 400, seed=7).isel(case=0)
    assert float(found["efficiency"]) == pytest.approx(1.0, abs=0.2)
    assert float(found["object_coverage"]) == pytest.approx(0.683, abs=0.06)
    assert float(found["object_temperature_rmse"]) < 0.35  # K
    assert float(found["emissivity_error"].max()) < 0.02


def test_sweep_names_its_cases() -> None:
    """Each case is a row under its name, whose numbers are those of a run of its own."""
    other = {"case": "quiet", "emissivity": (0.6, 0.45), "start": 20, "stop": 45}
    other |= {"background": {"amplitude": 6.0}, "noise_known": False, "response_kind": "linear"}
    found = experiments.sweep([GLASS, other], Rig(), TIME[:120], 30, seed=3)
    assert found["case"].values.tolist() == ["glass", "quiet"]
    assert found.attrs == {"origin": "simulated", "pixels": 30, "seed": 3}
    alone = experiments.score(*experiments.run_case(other, Rig(), TIME[:120], 30, 3))
    xr.testing.assert_equal(found.sel(case="quiet", drop=True)[list(alone)], alone)


def test_options_of_a_case() -> None:
    """Background, noise and kind of response of a case are applied."""
    case = GLASS | {"background": {"kind": "still", "level": 290.0}}
    scene, _ = experiments.run_case(case, Rig(), TIME[:60], 5, 1)
    assert (scene["background_temperature"] == 290.0).all()
    np.testing.assert_allclose(scene["object_temperature"][[0, -1], 0, 0], [293.15, 333.15])
    kinds = [
        experiments.run_case(GLASS | {"response_kind": kind}, Rig(), TIME, 60, 1)
        for kind in ("exact", "linear")
    ]
    exact, linear = (float(experiments.score(*one)["object_temperature_rmse"]) for one in kinds)
    assert linear > 1.5 > exact + 1.0  # K: the line is no response of 60 degrees


def drawn(**changes: Any) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene, capture and response of a case of glass with changes."""
    return simulate(GLASS | changes, Rig(), TIME, 20, seed=4)


def test_jump_of_the_object() -> None:
    """A sudden or gradual jump begins where the case says, and changes nothing else."""
    plain = drawn()[0]
    for duration, partly in ((0.0, 0), (2.0, 19)):
        jump = {"height": 6.0, "between": [12.0, 15.0], "duration": duration}
        scene = drawn(jump=jump)[0]
        added = (scene["object_temperature"] - plain["object_temperature"]).values[:, 0]
        np.testing.assert_allclose(added[TIME < 12.0], 0.0, rtol=0, atol=1e-9)  # K
        np.testing.assert_allclose(added[TIME > 17.0], 6.0, rtol=0, atol=1e-9)
        between = np.sum((added > 1e-9) & (added < 6.0 - 1e-9), axis=0)
        assert set(between) <= {partly, partly + 1}  # frames
        assert len({*np.argmax(added > 1e-9, axis=0)}) > 10  # of 20 pixels, each at its own time
        name = "background_temperature"
        xr.testing.assert_identical(scene[name], plain[name])


def test_background_that_follows() -> None:
    """The background drifts by a share of the object's change."""
    plain, scene = drawn()[0], drawn(following=0.2)[0]
    added = scene["background_temperature"] - plain["background_temperature"]
    rise = plain["object_temperature"] - plain["object_temperature"][0]
    np.testing.assert_allclose(added, 0.2 * rise, rtol=0, atol=1e-9)  # K
    assert scene["background_temperature"].attrs == plain["background_temperature"].attrs


def test_swapped_roles() -> None:
    """Object and background exchange their temperatures."""
    plain, scene = drawn()[0], drawn(swapped=True)[0]
    names = ("object_temperature", "background_temperature")
    for here, there in zip(names, reversed(names), strict=True):
        np.testing.assert_array_equal(scene[here], plain[there])


def test_fewer_frames_and_another_noise() -> None:
    """A case may have fewer frames and another noise than the rig's."""
    scene, capture, response = drawn(frames=100, noise=[0.1, 0.2])
    assert scene.sizes["time"] == capture.sizes["time"] == 100
    np.testing.assert_array_equal(capture["time"], TIME[:100])
    np.testing.assert_allclose(response["netd"], [0.1, 0.2], rtol=0, atol=0.002)  # K


@pytest.mark.parametrize("offset", [0.5, 1.0, 2.0])
def test_bands_apart(offset: float) -> None:
    """The second band, exposed so much later, sees each pulse begin so many frames sooner."""
    quiet = {"noise": [1e-4, 1e-4], "start": 20, "stop": 20}
    pulses = {"level": 293.15, "count": [1, 1]}
    scene, capture, response = drawn(offset=offset, background=pulses, **quiet)
    np.testing.assert_allclose(capture["time"], TIME, rtol=0, atol=1e-9)  # s
    assert "exposure_time" not in capture
    seen = responses.apparent_temperature(response, capture["counts"]) - 293.15
    first, second = (seen.isel(band=place).values[:, 0] > 0.2 for place in (0, 1))
    np.testing.assert_array_equal(first, scene["background_temperature"][:, 0] > 294.15)
    inside = (np.argmax(first, axis=0) > 5) & first.any(axis=0) & ~first[-5:].any(axis=0)
    later = (np.argmax(second, axis=0) - np.argmax(first, axis=0))[inside]
    assert inside.sum() > 10
    assert set(later) <= {int(np.floor(-offset)), int(np.ceil(-offset))}  # frames


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"offset": 0.33}, r"Invalid offset 0.33 frames. Must be zero or positive, a multiple"),
        ({"offset": -1.0}, r"Invalid offset -1.0 frames. Must be zero or positive"),
        ({"frames": 351}, r"Invalid number of frames 351. Must lie in \[2, 350\]"),
        ({"jump": {"between": [5.0, 4.0]}}, r"Invalid between \[5.0, 4.0\] s of a jump"),
        ({"jump": {"duration": -1.0}}, r"Invalid duration -1.0 s of a jump"),
    ],
)
def test_values_of_a_case(change: dict[str, Any], message: str) -> None:
    """Invalid values of a case raise a ValueError."""
    with pytest.raises(ValueError, match=message):
        drawn(**change)


def test_uneven_times_have_no_finer_clock() -> None:
    """Bands exposed apart on uneven times raise a ValueError."""
    uneven = np.append(TIME[:-1], TIME[-1] + 0.05)
    with pytest.raises(ValueError, match="Invalid times of bands that are exposed apart"):
        simulate(GLASS | {"offset": 1.0}, Rig(), uneven, 5, 0)


@pytest.mark.parametrize("change", [{"emisivity": [0.9, 0.8]}, {"method": "naive"}])
def test_unknown_key(change: dict[str, Any]) -> None:
    """An unknown key of a case raises an error."""
    keys = re.escape(str(sorted(GLASS | change)))
    with pytest.raises(ValueError, match=f"Invalid case with keys {keys}. Must have"):
        experiments.run_case(GLASS | change, Rig(), TIME, 5, 0)


@pytest.mark.parametrize("name", ["emissivity", "start", "stop"])
def test_missing_key(name: str) -> None:
    """A case without emissivity, start or stop raises an error."""
    case = {key: value for key, value in GLASS.items() if key != name}
    with pytest.raises(ValueError, match=r"Must have \['emissivity', 'start', 'stop'\]"):
        experiments.run_case(case, Rig(), TIME, 5, 0)
