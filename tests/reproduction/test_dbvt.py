"""The paper's optimiser: its losses one by one, its Newton steps, and its minima."""

import numpy as np
import pytest
import xarray as xr
from numpy.testing import assert_allclose

from dbthermal import response as responses
from dbthermal import schema, separation, simulation
from dbthermal.separation._tiles import Tile
from dbthermal.simulation import Background, Rig
from reproduction.methods import dbvt_objective as objective
from reproduction.methods.dbvt import METHOD, DbvtSettings
from reproduction.methods.dbvt_objective import Scale, Weights

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


def linear(noise: tuple[float, float], pixels: int) -> tuple[Tile, np.ndarray, np.ndarray]:
    """Glass that satisfies the paper's linear identities; its true films and rest, noiseless."""
    scene, _, response = glass(noise, pixels)
    curves = [responses.curve(response, band, "linear") for band in ("8-14", "9.5")]
    names = ("object_temperature", "background_temperature")
    warm, cold = (scene[name].values.reshape(350, -1) - curves[0].reference for name in names)
    rng, still = np.random.default_rng(5), cold.min(axis=0)
    signals = np.stack([e * warm + (1 - e) * cold for e in GLASS])
    signals += np.array(noise)[:, np.newaxis, np.newaxis] * rng.standard_normal(signals.shape)
    smooth, second = (e * warm + (1 - e) * still for e in GLASS)
    films = np.stack([smooth.T, 0.0 * smooth.T, 0.0 * smooth.T], axis=1)
    rest = np.stack([second[0], *(np.full(pixels, e) for e in GLASS)], axis=1)
    return Tile(signals, TIME, (curves[0], curves[1]), noise, (1, pixels), rng), films, rest


Point = tuple[np.ndarray, np.ndarray, np.ndarray, Scale]


def anywhere(frames: int = 12) -> Point:
    """A point without symmetry: films and rest of the unknowns, signals, and scales."""
    rng = np.random.default_rng(2)
    films = rng.standard_normal((3, frames)) * np.array([[1.0], [0.1], [0.1]])
    rest = np.array([rng.standard_normal(), *rng.uniform(0.2, 0.8, 2)])
    signals, sigma = 2.0 * rng.standard_normal((2, frames)), (0.3, 0.7)
    deviations = [
        objective.deviation(*pair, 1.0) for pair in zip(signals, films[1:], sigma, strict=True)
    ]
    return films, rest, signals, Scale(sigma, (deviations[0], deviations[1]), 0.4)


def weights(**changed: float) -> Weights:
    """Weights of the default settings, some changed, of frames 0.1 s apart."""
    fields = vars(DbvtSettings()) | changed
    values = {name: float(fields[name]) for name in Weights._fields}
    return Weights(**(values | {"curvature": values["curvature"] * 0.1**2}))


def errors_of(films: np.ndarray, rest: np.ndarray, signals: np.ndarray) -> np.ndarray:
    """Errors of the reconstruction of a pixel, frame by frame."""
    return np.array(
        [objective.departures(films, rest, signals, t)[2] for t in range(films.shape[1])]
    )


@pytest.mark.parametrize("shift", [0.0, 7.0])
def test_reconstruction_is_exact_at_the_truth(shift: float) -> None:
    """Without noise band 2 is reconstructed; slip 2: a shift of it moves its smooth signal."""
    tile, films, rest = linear((1e-9, 1e-9), 6)
    for column in range(6):
        signals = tile.signals[..., column] + np.array([[0.0], [shift]])
        found = errors_of(films[column], rest[column] + np.array([shift, 0, 0]), signals)
        assert_allclose(found, 0.0, rtol=0, atol=1e-7)  # K; a noise of 1e-9 K was needed


def test_second_smooth_signal_follows_the_recursion() -> None:
    """Each step of the second smooth signal is k1 times that of the first."""
    films, rest, signals, _ = anywhere()
    departures = [objective.departures(films, rest, signals, t)[1] for t in range(12)]
    second = signals[1] - films[2] - departures
    assert_allclose(second[0], rest[0], rtol=0, atol=1e-14)
    steps = rest[2] / rest[1] * np.diff(films[0])
    assert_allclose(np.diff(second), steps, rtol=0, atol=1e-13)


def test_mean_of_the_noise_is_squared() -> None:
    """Slip 3: a negative mean of the noise costs as much as a positive one."""
    films, *others = anywhere()
    for level in (0.6, -0.6):
        films[1:] = level
        expected = (0.6 / 0.3) ** 2 + (0.6 / 0.7) ** 2
        assert_allclose(objective.losses(films, *others, weights())[4], expected, rtol=1e-12)


def directional(point: Point, chosen: Weights, way: tuple[np.ndarray, np.ndarray]) -> float:
    """Derivative of the objective along a direction, from the forces of the Newton step."""
    films, rest, _, scale = point
    along, (to_offset, to_first, to_second) = way
    (_, one, other), smooth, frames = rest, films[0], films.shape[1]
    emission = other / one
    change = (to_second - emission * to_first) / one
    reflection = (to_first * (1 - other) / (1 - one) - to_second) / (1 - one)
    offset = to_offset - change * smooth[0] - emission * along[0, 0]
    _, forces, blocks = objective.system(*point, chosen, 1.0)
    second_step, error = offset + change * smooth, reflection * blocks[:, 4]
    # Forces are those of the noise eliminated, which follows the other unknowns.
    moves = np.stack([along[0], emission * along[0] + second_step, error])
    moved, still = (
        objective.noise_step(blocks, part, rest, scale, chosen)[1:] for part in (moves, 0.0 * moves)
    )
    total = (blocks[:, :2].T * (along[1:] - (moved - still))).sum(axis=0)
    total -= (forces * np.stack([along[0], second_step, error], axis=1)).sum(axis=1)
    bend, square = objective.bending(smooth)
    stiff = chosen.smoothness / chosen.curvature**2
    bent = (1 + emission**2) * (bend * along[0]).sum() + emission * square * change
    return float(2 * (total.sum() + stiff * bent) / frames)


@pytest.mark.parametrize("name", ["smoothness", "huber", "reconstruction", "noise", "noise_mean"])
@pytest.mark.parametrize("along", ["smooth", "offset", "emissivity", "noise"])
def test_slopes_match_finite_differences(name: str, along: str) -> None:
    """The slope of each loss along each unknown is that of its finite differences."""
    films, rest, *given = point = anywhere()
    nothing = dict.fromkeys(("smoothness", "huber", "reconstruction", "noise_mean"), 0.0)
    chosen = weights(**(nothing | {"noise": 1.0, "curvature": 50.0, name: 1.3}))
    rng, step = np.random.default_rng(8), 1e-6
    way = (rng.standard_normal(films.shape), rng.standard_normal(rest.shape))
    way[0][1:] *= along == "noise"
    way[0][0] *= along == "smooth"
    way[1][:] *= [along == "offset", *(along == "emissivity",) * 2]

    def total(by: float) -> float:
        moved = films + by * way[0], rest + by * way[1]
        return float(objective.losses(*moved, *given, chosen).sum())

    expected = (total(step) - total(-step)) / (2 * step)
    assert_allclose(directional(point, chosen, way), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("noise", "pixels"), [(QUIET, 20), pytest.param((0.03, 0.05), 50, marks=pytest.mark.slow)]
)
def test_random_starts_find_the_emissivities(noise: tuple[float, float], pixels: int) -> None:
    """From random emissivities the median error at low noise is below 0.02, the object's 0.3 K."""
    scene, capture, response = glass(noise, pixels)
    result = separation.solve(capture, response, METHOD, seed=3)
    of_emissivity, of_object = errors(scene, result)
    print(f"{noise}: emissivity {of_emissivity:.4f}, object {of_object:.3f} K")
    assert of_emissivity < 0.02
    assert of_object < 0.3
    assert float((result["status"] == 0).mean()) > 0.9


@pytest.mark.slow
def test_a_start_at_the_separator_is_as_good_as_random_ones() -> None:
    """Started at the subspace separator it ends no higher, and everywhere with a result."""
    scene, capture, response = glass((0.03, 0.35), 40)
    random = separation.solve(capture, response, METHOD, seed=3)
    start = DbvtSettings(start="subspace")
    started = separation.solve(capture, response, METHOD, settings=start, seed=3)
    of_random, of_started = errors(scene, random), errors(scene, started)
    print(f"random {of_random}, started {of_started}")
    assert np.all(np.array(of_started) <= 1.1 * np.array(of_random))
    assert bool(started["emissivity"].notnull().all())


def test_exact_response_is_taken_out() -> None:
    """Taking out the bend of the exact response at least halves the emissivity's error."""
    scene, capture, response = glass(QUIET, 15)
    bent, straight = (
        errors(scene, separation.solve(capture, response, METHOD, settings=settings))
        for settings in (DbvtSettings(bend_updates=0), None)
    )
    assert straight[0] < 0.5 * bent[0]


def test_too_few_steps_are_flagged() -> None:
    """A pixel that still improves at its last step is flagged as not converged."""
    _, capture, response = glass(QUIET, 8)
    result = separation.solve(capture, response, METHOD, settings=DbvtSettings(stages=1, steps=2))
    assert np.all(result["status"].values & schema.Status.NOT_CONVERGED)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"huber": -1.0}, "Invalid huber -1.0 of method 'dbvt'. Must be at least 0."),
        ({"curvature": 0.0}, "curvature of method 'dbvt'"),
        ({"starts": 0}, "Invalid starts 0 of method 'dbvt'. Must be at least 1."),
        ({"margin": 0.5}, r"Invalid margin 0.5 of method 'dbvt'. Must lie in \(0, 0.5\)."),
        ({"start": "truth"}, "Unknown start 'truth' of method 'dbvt'. Must be one of"),
    ],
)
def test_settings_refuse_nonsense(options: dict[str, float], message: str) -> None:
    """Settings outside their range raise a ValueError with the name, the value and the rule."""
    with pytest.raises(ValueError, match=message):
        DbvtSettings(**options)  # type: ignore[arg-type]
