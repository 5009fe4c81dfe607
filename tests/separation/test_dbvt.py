"""The paper's optimiser: its losses one by one, its Newton steps, and its minima."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import xarray as xr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from dbthermal import response as responses
from dbthermal import schema, separation, simulation
from dbthermal.separation import DbvtSettings
from dbthermal.separation._dbvt import method as dbvt
from dbthermal.separation._dbvt import newton, objective
from dbthermal.separation._dbvt.objective import Images, Unknowns
from dbthermal.separation._tiles import Tile
from dbthermal.simulation import Background, Rig

TIME = np.arange(350) / 10.0
GLASS = (0.86, 0.72)
QUIET = (0.003, 0.03)
Scene = tuple[xr.Dataset, xr.Dataset, xr.Dataset]


def glass(noise: tuple[float, float], pixels: int, seed: int = 41) -> Scene:
    """Scene, capture and response: glass from 20 to 60 C, someone walking by."""
    rig, rng = Rig(noise=noise), np.random.default_rng(seed)
    emissivity = xr.DataArray(list(GLASS), dims="band", coords={"band": list(rig.bands)})
    scene = simulation.independent_pixels(
        TIME, emissivity, Background(), pixels, rng, start=293.15, stop=333.15
    )
    return scene, simulation.observe(scene, rig.response(), rng), rig.response()


def errors(scene: xr.Dataset, result: xr.Dataset) -> tuple[float, float]:
    """Median error of the worse emissivity [1], and median RMSE of the object [K]."""
    of_emissivity = abs(result["emissivity"] - scene["emissivity"]).max("band")
    of_object = result["object_temperature"] - scene["object_temperature"]
    return float(of_emissivity.median()), float(((of_object**2).mean("time") ** 0.5).median())


def linear(noise: tuple[float, float], pixels: int) -> tuple[Tile, Unknowns]:
    """Glass that satisfies the paper's linear identities, and its true unknowns without noise."""
    scene, _, response = glass(noise, pixels)
    curves = [responses.curve(response, band, "linear") for band in ("8-14", "9.5")]
    names = ("object_temperature", "background_temperature")
    warm, cold = (scene[name].values.reshape(350, -1) - curves[0].reference for name in names)
    rng, rest = np.random.default_rng(5), cold.min(axis=0)
    signals = np.stack([e * warm + (1 - e) * cold for e in GLASS])
    signals += np.array(noise)[:, np.newaxis, np.newaxis] * rng.standard_normal(signals.shape)
    smooth, second = (torch.as_tensor(e * warm + (1 - e) * rest) for e in GLASS)
    emissivity = torch.tensor(GLASS, dtype=torch.float64)[:, None].repeat(1, pixels)
    truth = Unknowns(smooth, second[0], emissivity, torch.zeros(signals.shape, dtype=torch.float64))
    tile = Tile(signals, TIME, (curves[0], curves[1]), noise, (1, pixels), rng)
    return tile, truth


def anywhere(frames: int = 12, columns: int = 3) -> tuple[Unknowns, Images]:
    """A point without symmetry in the unknowns, and signals."""
    rng = np.random.default_rng(2)

    def draw(*shape: int) -> torch.Tensor:
        return torch.as_tensor(rng.standard_normal((*shape, columns)))

    one = torch.ones(columns, dtype=torch.float64)
    emissivity = torch.as_tensor(rng.uniform(0.2, 0.8, (2, columns)))
    unknowns = Unknowns(draw(frames), draw(), emissivity, 0.1 * draw(2, frames))
    sigma = torch.stack([0.3 * one, 0.7 * one])
    signals = 2.0 * draw(2, frames)
    deviation = objective.deviation(signals, unknowns.noise, sigma, 1.0)
    return unknowns, Images(signals, deviation, sigma, 0.1 * one, 0.4 * one)


def test_reconstruction_is_exact_at_the_truth() -> None:
    """At the truth without noise the second band is reconstructed to rounding."""
    tile, truth = linear((1e-9, 1e-9), 6)
    _, _, rest = objective.departures(truth, dbvt.tensors(tile, 6, DbvtSettings()))
    assert_allclose(rest, 0.0, rtol=0, atol=1e-7)  # K; a noise of 1e-9 K was needed


def test_second_smooth_signal_follows_the_recursion() -> None:
    """Each step of the second smooth signal is k1 times that of the first."""
    unknowns, _ = anywhere()
    second = objective.second_smooth(unknowns)
    emission = unknowns.emissivity[1] / unknowns.emissivity[0]
    assert_allclose(second[0], unknowns.offset, rtol=0, atol=1e-14)
    steps = emission * torch.diff(unknowns.smooth, dim=0)
    assert_allclose(torch.diff(second, dim=0), steps, rtol=0, atol=1e-13)


def test_reconstruction_starts_from_the_second_band() -> None:
    """Slip 2: a shift of all of the second band moves its smooth signal and leaves no error."""
    tile, truth = linear((1e-9, 1e-9), 2)
    given = dbvt.tensors(tile, 2, DbvtSettings())
    shifted = replace(given, signals=given.signals + torch.tensor([0.0, 7.0])[:, None, None])
    _, _, rest = objective.departures(replace(truth, offset=truth.offset + 7.0), shifted)
    assert_allclose(rest, 0.0, rtol=0, atol=1e-7)


def test_mean_of_the_noise_is_squared() -> None:
    """Slip 3: a negative mean of the noise costs as much as a positive one."""
    unknowns, images = anywhere()
    noise = torch.full_like(unknowns.noise, 0.6)
    for sign in (1.0, -1.0):
        found = objective.losses(replace(unknowns, noise=sign * noise), images, DbvtSettings())
        expected = (0.6 / 0.3) ** 2 + (0.6 / 0.7) ** 2
        assert_allclose(found["noise_mean"], expected, rtol=1e-12)


def test_deviation_is_never_below_the_noise() -> None:
    """Slip 5: a constant pixel is divided by its noise, another by its standard deviation."""
    unknowns, images = anywhere()
    still = torch.zeros_like(images.signals)
    constant = objective.deviation(still, still, images.sigma, 1.0)
    assert_allclose(constant, images.sigma, rtol=0, atol=0)
    moving = objective.deviation(images.signals, unknowns.noise, images.sigma, 1.0)
    assert_allclose(moving, (images.signals - unknowns.noise).std(dim=1), rtol=1e-12)


def test_huber_loss_has_slope_one_beyond_its_threshold() -> None:
    """The normalised loss is a parabola inside, a line of slope 1 outside, smooth between."""
    threshold = torch.tensor(0.5, dtype=torch.float64)
    value = torch.tensor([0.2, 0.5, 1.5, -2.5], dtype=torch.float64)
    found = objective._huber(value, threshold)
    assert_allclose(found, [0.04, 0.25, 1.25, 2.25], rtol=0, atol=1e-12)


def directional(
    unknowns: Unknowns, images: Images, weights: DbvtSettings, way: Unknowns
) -> np.ndarray:
    """Derivative of the objective along a direction, from the forces of the Newton step."""
    emission, _ = objective.ratios(unknowns.emissivity)
    first, second = unknowns.emissivity
    to_first, to_second = way.emissivity
    change = (to_second - emission * to_first) / first
    reflection = (to_first * (1 - second) / (1 - first) - to_second) / (1 - first)
    start = unknowns.smooth[0]
    offset = way.offset - change * start - emission * way.smooth[0]
    system = newton._System(unknowns, torch.ones(3, dtype=torch.float64), images, weights)
    second_step, error = offset + change * unknowns.smooth, reflection * system.first
    # Forces are those of the noise eliminated, which follows the other unknowns.
    still = torch.zeros_like(start)
    moved = system.noise_step(way.smooth, emission * way.smooth + second_step, error)
    apart = way.noise - (moved - system.noise_step(still, still, still))
    total = (torch.stack(system._pull) * apart).sum(dim=0) - system.force * way.smooth
    total = total - system.force_y * second_step - system.force_z * error
    bend, square = newton.bending(unknowns.smooth)
    stiff = weights.smoothness / (weights.curvature * images.interval**2) ** 2
    smooth = (1 + emission**2) * (bend * way.smooth).sum(dim=0) + emission * square * change
    return np.asarray(2 * (total.sum(dim=0) + stiff * smooth) / unknowns.smooth.shape[0])


@pytest.mark.parametrize("name", ["smoothness", "huber", "reconstruction", "noise", "noise_mean"])
@pytest.mark.parametrize("along", ["smooth", "offset", "emissivity", "noise"])
def test_slopes_match_finite_differences(name: str, along: str) -> None:
    """The slope of each loss along each unknown is that of its finite differences."""
    unknowns, images = anywhere()
    nothing: dict[str, Any] = dict.fromkeys(
        ("smoothness", "huber", "reconstruction", "noise_mean"), 0.0
    )
    weights = DbvtSettings(**(nothing | {"noise": 1.0, "curvature": 50.0, name: 1.3}))
    zero = Unknowns(*(torch.zeros_like(value) for value in vars(unknowns).values()))
    direction = torch.as_tensor(
        np.random.default_rng(8).standard_normal(getattr(zero, along).shape)
    )
    way, step = replace(zero, **{along: direction}), 1e-6

    def total(by: float) -> torch.Tensor:
        moved = replace(unknowns, **{along: getattr(unknowns, along) + by * direction})
        return torch.stack(list(objective.losses(moved, images, weights).values())).sum(dim=0)

    expected = (total(step) - total(-step)) / (2 * step)
    found = directional(unknowns, images, weights, way)
    assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


@settings(max_examples=25)
@given(st.integers(4, 30), st.floats(0.0, 1e6), st.integers(0, 10**6))
def test_banded_solution_meets_its_equations(frames: int, stiffness: float, seed: int) -> None:
    """The recursion's solution satisfies the equations, from no stiffness to much."""
    rng = np.random.default_rng(seed)
    diagonal, right = rng.uniform(0.5, 2.0, (frames, 2)), rng.standard_normal((frames, 3, 2))
    stiff = torch.full((2,), stiffness, dtype=torch.float64)
    found = newton.whittaker(torch.as_tensor(diagonal), stiff, torch.as_tensor(right))
    second = np.diff(np.eye(frames), n=2, axis=0)
    for column in (0, 1):
        matrix = np.diag(diagonal[:, column]) + stiffness * second.T @ second
        expected = np.linalg.solve(matrix, right[:, :, column])
        assert_allclose(found[:, :, column], expected, rtol=0, atol=1e-7)


def test_a_step_never_raises_the_objective() -> None:
    """From a point without symmetry the objective falls monotonically, and far."""
    tile, truth = linear(QUIET, 8)
    options = DbvtSettings()
    given = dbvt.tensors(tile, 8, options)
    state = replace(truth, emissivity=truth.emissivity - 0.1)
    search, losses = newton.begin(state, given, options), []
    for _ in range(30):
        losses.append(search.loss)
        state, search = newton.step(state, search, given, options)
    history = torch.stack(losses)
    assert bool((torch.diff(history, dim=0) <= 0).all())
    assert bool((history[-1] < 0.01 * history[0]).all())


def test_it_stays_at_the_truth() -> None:
    """Started at the truth the emissivities move by less than 0.02 (median)."""
    tile, truth = linear(QUIET, 30)
    options = DbvtSettings()
    given = dbvt.tensors(tile, 30, options)
    found = dbvt.homotopy(truth, given, options, 1)
    moved = (found.unknowns.emissivity - truth.emissivity).abs().amax(dim=0)
    print(f"moved from the truth by {float(moved.median()):.4f}")
    assert float(moved.median()) < 0.02


@pytest.mark.parametrize(
    "noise", [QUIET, pytest.param((0.03, 0.05), marks=pytest.mark.slow)], ids=str
)
def test_random_starts_find_the_emissivities(noise: tuple[float, float]) -> None:
    """From random emissivities the median error at low noise is below 0.02, the object's 0.3 K."""
    scene, capture, response = glass(noise, 50)
    result = separation.solve(capture, response, "dbvt", seed=3)
    of_emissivity, of_object = errors(scene, result)
    print(f"{noise}: emissivity {of_emissivity:.4f}, object {of_object:.3f} K")
    assert of_emissivity < 0.02
    assert of_object < 0.3
    assert float((result["status"] == 0).mean()) > 0.9


def test_a_start_at_the_separator_is_as_good_as_random_ones() -> None:
    """Started at the subspace separator it ends no higher, and everywhere with a result."""
    scene, capture, response = glass((0.03, 0.35), 40)
    random = separation.solve(capture, response, "dbvt", seed=3)
    started = separation.solve(
        capture, response, "dbvt", settings=DbvtSettings(start="subspace"), seed=3
    )
    of_random, of_started = errors(scene, random), errors(scene, started)
    print(f"random {of_random}, started {of_started}")
    assert np.all(np.array(of_started) <= 1.1 * np.array(of_random))
    assert bool(started["emissivity"].notnull().all())


def test_the_lowest_of_several_starts_is_kept() -> None:
    """Columns are start by start, and NaN is no lowest objective."""
    loss = torch.tensor([3.0, np.nan, 1.0, 2.0, 5.0, 4.0])
    assert dbvt._least(loss, 3).tolist() == [3, 4, 2]


def test_same_seed_same_result() -> None:
    """A seed fixes the result; other random starts end at the same minimum."""
    _, capture, response = glass(QUIET, 12)
    capture = capture.isel(time=slice(0, 150))
    first, again, other = (
        separation.solve(capture, response, "dbvt", seed=seed) for seed in (1, 1, 2)
    )
    xr.testing.assert_identical(first, again)
    apart = abs(first["emissivity"] - other["emissivity"])
    assert float(apart.median()) < 1e-4


def test_exact_response_is_taken_out() -> None:
    """Taking out the bend of the exact response at least halves the emissivity's error."""
    scene, capture, response = glass(QUIET, 40)
    bent = errors(
        scene,
        separation.solve(capture, response, "dbvt", settings=DbvtSettings(bend_updates=0)),
    )
    straight = errors(scene, separation.solve(capture, response, "dbvt"))
    print(f"linear identities {bent}, bend taken out {straight}")
    assert straight[0] < 0.5 * bent[0]


def test_too_few_steps_are_flagged() -> None:
    """A pixel that still improves at its last step is flagged as not converged."""
    _, capture, response = glass(QUIET, 8)
    result = separation.solve(capture, response, "dbvt", settings=DbvtSettings(stages=1, steps=2))
    assert np.all(result["status"].values & schema.Status.NOT_CONVERGED)


@pytest.mark.slow
def test_temperatures_may_come_from_the_measured_signals() -> None:
    """Without the estimated noise the object is smoother, and nearer to the truth."""
    scene, capture, response = glass((0.03, 0.35), 30)
    smooth, raw = (
        errors(
            scene,
            separation.solve(
                capture, response, "dbvt", settings=DbvtSettings(temperatures_from=source)
            ),
        )[1]
        for source in ("corrected", "measured")
    )
    print(f"object from corrected signals {smooth:.3f} K, from measured ones {raw:.3f} K")
    assert smooth < raw


@pytest.mark.parametrize("name", ["huber", "reconstruction", "smoothness", "noise", "noise_mean"])
def test_each_loss_can_be_left_out(name: str) -> None:
    """Without one of the losses it still ends with numbers, and with emissivities in (0, 1)."""
    tile, _ = linear((0.03, 0.05), 6)
    tile = tile.select_frames(TIME < 10.0)
    result = dbvt.separate(tile, DbvtSettings(**{name: 0.0}))  # type: ignore[arg-type]
    assert np.all((result.emissivity > 0) & (result.emissivity < 1))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"huber": -1.0}, "Invalid huber -1.0 of method 'dbvt'. Must be at least 0."),
        ({"noise": np.nan}, "Invalid noise nan of method 'dbvt'. Must be at least 0."),
        ({"curvature": 0.0}, "curvature of method 'dbvt'"),
        ({"tolerance": -1.0}, "tolerance of method 'dbvt'"),
        ({"starts": 0}, "Invalid starts 0 of method 'dbvt'. Must be at least 1."),
        ({"steps": 0}, "Invalid steps 0 of method 'dbvt'. Must be at least 1."),
        ({"bend_updates": -1}, "Invalid bend_updates -1 of method 'dbvt'. Must be at least 0."),
        ({"margin": 0.5}, r"Invalid margin 0.5 of method 'dbvt'. Must lie in \(0, 0.5\)."),
        ({"start": "truth"}, "Unknown start 'truth' of method 'dbvt'. Must be one of"),
        ({"precision": "half"}, "Unknown precision 'half' of method 'dbvt'. Must be one of"),
    ],
)
def test_settings_refuse_nonsense(options: dict[str, float], message: str) -> None:
    """Settings outside their range raise a ValueError with the name, the value and the rule."""
    with pytest.raises(ValueError, match=message):
        DbvtSettings(**options)  # type: ignore[arg-type]
