"""Noise that is stated too small: the capture's is used where it proves more, and said."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, emissivity_of, plain_capture
from scenes import held, painted

from dbthermal import separation, simulation, store
from dbthermal.simulation import Background
from reproduction.experiments.cases import independent_pixels
from reproduction.experiments.pictures import Picture, smooth_shift

TIME = np.arange(300) / 10.0
SHAPE = (24, 32)


def stated(factor: float) -> xr.Dataset:
    """Response whose noise is so many times too small."""
    response = RIG.response()
    noise = (response["noise"] / factor).assign_attrs(response["noise"].attrs)
    return response.assign(noise=noise)


@pytest.fixture(scope="module")
def picture() -> tuple[xr.Dataset, xr.Dataset]:
    """Scene of walkers before glass, and its capture."""
    scene = painted(31, GLASS, Picture(SHAPE), time=TIME)
    return scene.truth, scene.capture


@pytest.mark.parametrize("factor", [1.15, 1.5, 2.0, 4.0])
def test_too_small_a_noise_is_replaced(
    picture: tuple[xr.Dataset, xr.Dataset], factor: float
) -> None:
    """Both numbers are named, and the intervals hold as with the right noise."""
    scene, capture = picture
    with pytest.warns(UserWarning, match=r"The noise of .*in band '8-14', .* K in band '9.5', "):
        result = separation.solve(capture, stated(factor))
    assert result.attrs["noise_source"] == "capture"
    assert len(result.attrs["warnings"]) == 1
    right = RIG.response()["noise"].values
    np.testing.assert_allclose(result["noise"].values, right, rtol=0.05)
    moving = scene["background_temperature"].std("time") > 0.3  # K
    good = moving & (result["status"] == 0)
    assert float(good.sum() / moving.sum()) > 0.8
    assert 0.92 < held(result, scene, where=good) < 0.98


@pytest.mark.parametrize("factor", [1.0, 1 / 1.5])
def test_right_or_larger_noise_is_kept(
    picture: tuple[xr.Dataset, xr.Dataset], factor: float
) -> None:
    """The response's noise is used as it is, without a warning."""
    result = separation.solve(picture[1], stated(factor))
    known = stated(factor)["noise"].values
    np.testing.assert_allclose(result["noise"].values, known, rtol=1e-14)
    assert result.attrs["noise_source"] == "response"
    assert "warnings" not in result.attrs


def test_one_noise_for_all_blocks(picture: tuple[xr.Dataset, xr.Dataset], tmp_path: Path) -> None:
    """On disk the noise is that of the whole capture, as if separated at once."""
    store.save(picture[1], tmp_path / "capture.zarr", store.provenance({}))
    with pytest.warns(UserWarning, match="The noise of the capture"):
        separation.run(tmp_path / "capture.zarr", tmp_path / "result.zarr", stated(2.0))
    with pytest.warns(UserWarning, match="The noise of the capture"):
        whole = separation.solve(picture[1], stated(2.0))
    result = store.open_dataset(tmp_path / "result.zarr").load()
    np.testing.assert_allclose(result["noise"].values, whole["noise"].values, rtol=1e-12)
    assert result.attrs["noise_source"] == "capture"


def test_motion_is_no_noise() -> None:
    """Whatever moves proves nothing: few frames, rapid heating, cameras apart, no rest at all."""
    rng, apart = np.random.default_rng(1), smooth_shift(SHAPE, 6.0, 2.0)
    scenes = [Picture(SHAPE).draw(TIME[:frames], GLASS, rng, apart) for frames in (60, 100, 300)]
    scenes += [Picture(SHAPE, walkers=30, rise=(0.5, 2.0)).draw(TIME, GLASS, rng)]
    scenes += [Picture(SHAPE, walkers=30).draw(TIME[:150] * 5.0, GLASS, rng)]
    for materials in (GLASS, emissivity_of(0.3, 0.5), emissivity_of(0.95, 0.4)):
        for correlation_time in (0.01, 0.1, 0.3, 3.0):
            walk = Background("random walk", correlation_time=correlation_time)
            args = (TIME, materials, walk, 400, rng)
            scenes.append(independent_pixels(*args, start=293.15, stop=323.15))
    for place, scene in enumerate(scenes):
        result = separation.solve(simulation.observe(scene, RIG.response(), rng), RIG.response())
        assert result.attrs["noise_source"] == "response", place


def test_rounded_counts_of_less_noise_than_a_step() -> None:
    """Rounding to steps of 0.2 to 2 deviations of the noise proves no more than is stated."""
    rng, response = np.random.default_rng(5), RIG.response()
    noise = response["noise"].values[:, np.newaxis, np.newaxis]
    level = 20000.0 + noise * np.linspace(0.0, 30.0, 300)[:, np.newaxis] * rng.random(400)
    for step in (0.2, 0.5, 1.0, 2.0):
        exact = level + noise * rng.standard_normal((2, 300, 400))
        counts = (step * noise * np.rint(exact / (step * noise)))[:, :, np.newaxis]
        result = separation.solve(plain_capture(counts, TIME), response)
        assert result.attrs["noise_source"] == "response", step
