"""Simulation: scenes with closed-form truth, and a rig with its stated errors."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import FILMS, GLASS, movie, still
from hypothesis import given
from hypothesis import strategies as st
from refused import refused

from dbthermal import bands, response, schema, simulation
from dbthermal.simulation import Background, Rig, capture, heating, observe
from reproduction import disturbances

TIME = np.arange(120) / 10.0  # s
SHAPE = (12, 16)


RIG = Rig(bad_fraction=0.02)
KNOWN = RIG.response()


@dataclass(frozen=True)
class Made:
    """A plate in which people are reflected, the fixed pattern of the cameras, random numbers."""

    rng: np.random.Generator
    twin: xr.Dataset
    detector: xr.Dataset

    def seen(self, **changes: Any) -> xr.Dataset:
        """Counts of the plate."""
        return observe(self.twin.assign(changes), KNOWN, self.rng)


@pytest.fixture
def made(rng: np.random.Generator) -> Made:
    """Of one seed."""
    detector = simulation.pattern(RIG, SHAPE, rng)
    return Made(rng, simulation.walkers(TIME, SHAPE, GLASS, rng), detector)


@given(start=st.floats(280.0, 300.0), stop=st.floats(280.0, 340.0), constant=st.floats(1.0, 100.0))
def test_heating_is_newton_s(start: float, stop: float, constant: float) -> None:
    """Heating meets its start and stop; the distance to its limit decays as exp(-t/tau)."""
    curve = heating(TIME, start, stop, constant)
    limit = start + (stop - start) / -np.expm1(-TIME[-1] / constant)
    decay = (limit - start) * np.exp(-TIME / constant)
    np.testing.assert_allclose(limit - curve, decay, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(curve[[0, -1]], [start, stop], rtol=0, atol=1e-11)


def test_still_background_drifts(rng: np.random.Generator) -> None:
    """A still background is its level, and a drift a straight line over the capture."""
    still = Background("still", level=290.0).draw(TIME, 3, rng)
    np.testing.assert_array_equal(still, np.full((120, 3), 290.0))
    drift = Background("still", level=290.0, drift=5.0).draw(TIME, 3, rng)
    expected = 290.0 + 5.0 * TIME / TIME[-1]
    np.testing.assert_allclose(drift.T, [expected] * 3, rtol=0, atol=1e-12)


def test_one_pulse(rng: np.random.Generator) -> None:
    """A pulse of 3 K rises once, lasts one to two seconds, or until the capture ends."""
    change = Background(count=(1, 1), duration=(1.0, 2.0)).draw(TIME, 500, rng) - 295.15
    np.testing.assert_allclose(change, 3.0 * (change > 1), rtol=0, atol=1e-12)
    on = change > 1
    np.testing.assert_array_equal((np.diff(on, axis=0, prepend=False) & on).sum(axis=0), 1)
    length = on.sum(axis=0)[~on[-1]]
    assert 10 <= length.min() <= 11  # frames
    assert 19 <= length.max() <= 20


def test_random_walk(rng: np.random.Generator) -> None:
    """The walk's deviation is its amplitude, and its correlation exp(-lag / correlation_time)."""
    background = Background("random walk", amplitude=2.0, correlation_time=3.0)
    walk = background.draw(TIME, 4000, rng) - 295.15
    np.testing.assert_allclose(walk.std(axis=1), 2.0, rtol=0, atol=0.1)  # K
    for lag in (1, 30):
        found = np.mean(walk[lag:] * walk[:-lag]) / np.mean(walk**2)
        assert found == pytest.approx(np.exp(-lag / 30.0), abs=0.02)


def test_walkers(made: Made) -> None:
    """The room is reflected but where someone walks by; the plate's middle heats up."""
    twin = made.twin
    background = twin["background_temperature"]
    assert set(np.unique(background)) == {295.15, 305.15}
    assert (background.isel(y=0) == 295.15).all()  # above all heads
    assert 0.1 < float((background == 305.15).mean()) < 0.5
    plate = twin["object_temperature"]
    np.testing.assert_allclose(plate.isel(time=0), 295.15, rtol=0, atol=1e-12)
    assert 332.0 < float(plate.isel(time=-1).max()) < 333.15
    assert twin.attrs["origin"] == "simulated"


def test_response_is_planck_s() -> None:
    """The rig's counts are the band's radiance, within 0.05 mK from -10 to 80 C."""
    temperature = np.linspace(263.15, 353.15, 451)
    unit = 115.0 / float(bands.FILTERS["8-14"].slope(300.0))
    for name, netd in zip(RIG.bands, RIG.noise, strict=True):
        counts = 15500.0 + unit * bands.FILTERS[name].radiance(temperature)
        found = response.curve(KNOWN, name).inverse(counts)
        np.testing.assert_allclose(found, temperature, rtol=0, atol=5e-5)  # K
        assert float(KNOWN["netd"].sel(band=name)) == pytest.approx(netd, rel=1e-9)
    assert KNOWN.attrs["origin"] == "simulated"


QUIET = KNOWN.assign(noise=1e-9 * KNOWN["noise"])


def test_observed_counts(made: Made) -> None:
    """Without noise the counts are e U(x) + (1 - e) U(y), whatever the order of the bands."""
    seen = observe(made.twin.isel(band=[1, 0]), QUIET, made.rng, dtype="float64")
    emitted, reflected = (response.counts(KNOWN, made.twin[name]) for name in FILMS)
    expected = GLASS * emitted + (1 - GLASS) * reflected
    np.testing.assert_allclose(seen["counts"], expected, rtol=0, atol=1e-6)  # count
    assert schema.check(seen, "corrected").attrs["origin"] == "simulated"


def test_counts_say_of_what_they_are_a_twin(made: Made) -> None:
    """Observed and raw counts keep the name of their twin; other scenes have none."""
    seen = observe(made.twin.assign_attrs(twin="bulb"), KNOWN, made.rng)
    assert seen.attrs["twin"] == capture(seen, made.detector).attrs["twin"] == "bulb"
    assert "twin" not in made.seen().attrs


def test_noise_of_observed_counts(made: Made) -> None:
    """The noise has the response's deviation within 2 %, no mean, and no autocorrelation."""
    noise = (made.seen() - observe(made.twin, QUIET, made.rng))["counts"]
    pixels = ("time", "y", "x")
    np.testing.assert_allclose(noise.std(pixels) / KNOWN["noise"], 1.0, rtol=0, atol=0.02)
    np.testing.assert_allclose(noise.mean(pixels), 0.0, rtol=0, atol=0.1)  # count
    covariance = (noise.values[:, 1:] * noise.values[:, :-1]).mean(axis=(1, 2, 3))
    np.testing.assert_allclose(covariance / KNOWN["noise"] ** 2, 0.0, rtol=0, atol=0.03)
    assert abs(float(xr.corr(*noise))) < 0.03


def test_pattern() -> None:
    """Over live pixels the gain has mean 1 and the offset 0; the deviations are the rig's."""
    made = simulation.pattern(RIG, (80, 90), np.random.default_rng(5))
    live = made.where(~made["dead"])
    np.testing.assert_allclose(live["gain"].mean(("y", "x")), 1.0, rtol=0, atol=1e-12)
    np.testing.assert_allclose(live["offset"].mean(("y", "x")), 0.0, rtol=0, atol=1e-10)  # count
    assert float(made["dead"].mean()) == pytest.approx(0.02, abs=0.005)
    rough = made[["gain", "offset"]].diff("x").std() / 2**0.5  # the vignette is smooth
    assert float(rough["gain"]) == pytest.approx(RIG.gain_std, rel=0.05)
    assert float(rough["offset"]) == pytest.approx(RIG.offset_std, rel=0.05)


def test_capture(made: Made) -> None:
    """Raw counts are gain times signal and offset, rounded, and 0 where a pixel is dead."""
    seen, detector = made.seen(), made.detector
    raw = capture(seen, detector.isel(band=[1, 0]))  # by name, not by place
    assert raw["counts"].dtype == np.uint16
    assert (raw["counts"].where(detector["dead"], 0) == 0).all()
    exact = detector["gain"] * seen["counts"] + detector["offset"]
    rest = (raw["counts"] - exact).where(~detector["dead"])
    assert 0.49 < float(abs(rest).max()) <= 0.5 + 1e-9  # count
    assert schema.check(raw, "capture").attrs["origin"] == "simulated"


RANGE = r"Invalid counts in band '8-14' .* Must lie in \[0, 65535\]"
HOT, ENDS = Rig(offset=60000.0), np.array([290.0, 330.0])


def one_dead(detector: xr.Dataset) -> xr.Dataset:
    """The detector with dead pixels of one band alone."""
    return detector.drop_vars("dead").assign(dead=detector["dead"].isel(band=slice(0, 1)))


def warmer(made: Made) -> xr.Dataset:
    """Counts of the plate when it is 30 K warmer."""
    return made.seen(object_temperature=made.twin["object_temperature"] + 30)


test_what_is_not_recorded = refused(
    lambda made, call: call(made),
    [
        (warmer, "the response's range"),
        (lambda m: m.seen(emissivity=100 * m.twin["emissivity"]), "Invalid emissivity 86"),
        (lambda m: observe(m.twin.isel(band=[0]), KNOWN, m.rng), "Missing band '9.5' in the scene"),
        (lambda m: observe(m.twin[["emissivity"]], KNOWN, m.rng), "'object_temperature'"),
        (lambda m: observe(m.twin, KELVIN, m.rng), "Invalid units 'K' of 'noise'"),
        (lambda m: capture(m.seen() + 50000.0, m.detector), RANGE),
        (lambda m: capture(m.seen() - 40000.0, m.detector), RANGE),
        (lambda m: capture(m.seen().where(m.twin["time"] > 1), m.detector), RANGE),
        (lambda m: capture(m.seen().rename(band="b"), m.detector), "'counts' of the corrected"),
        (lambda m: capture(m.seen(), m.detector.isel(band=[0])), "band '9.5' in the detector"),
        (lambda m: capture(m.seen(), one_dead(m.detector)), "'dead' of the detector. Must be bool"),
        (lambda m: simulation.blackbody_movies(HOT, ENDS, 2, m.detector, m.rng), RANGE),
    ],
    "made",
)


KELVIN: xr.Dataset = KNOWN.assign(noise=KNOWN["netd"])


def test_same_seed_same_data() -> None:
    """The same seed gives the same data, and another seed gives others."""

    def record(seed: int) -> xr.Dataset:
        rng = np.random.default_rng(seed)
        detector = simulation.pattern(RIG, SHAPE, rng)
        scene = simulation.walkers(TIME, SHAPE, GLASS, rng)
        return capture(observe(scene, KNOWN, rng), detector)

    xr.testing.assert_identical(record(1), record(1))
    assert float((record(1)["counts"] != record(2)["counts"]).mean()) > 0.9
    scene: Any = simulation.walkers(TIME.tolist(), [*SHAPE], GLASS, 1)  # type: ignore[arg-type]
    detector = simulation.pattern(RIG, SHAPE, 1)
    films: Any = scene["object_temperature"], scene["background_temperature"]  # with their labels
    xr.testing.assert_identical(simulation.scene(TIME, films[0], films[1], GLASS), scene)
    movies = simulation.blackbody_movies(RIG, np.array([290.0, 300.0]), 2, detector, 1)
    for name, made, *arguments in (  # a seed serves as its generator
        ("walkers", scene, TIME, SHAPE, GLASS),
        ("pattern", detector, RIG, SHAPE),
        ("observe", observe(scene, KNOWN, 1), scene, KNOWN),
        ("blackbody_movies", movies, RIG, np.array([290.0, 300.0]), 2, detector),
    ):
        again = getattr(simulation, name)(*arguments, np.random.default_rng(1))
        xr.testing.assert_identical(again, made)


def test_lag_is_that_of_a_small_body() -> None:
    """A step is followed as 1 - exp(-t / tau), however the frames are spaced."""
    time = np.array([0.0, 0.004, 0.010, 0.011, 0.030])
    seen = disturbances.lag(movie(np.array([0.0, 1.0, 1.0, 1.0, 1.0]), time), 0.010)["counts"]
    np.testing.assert_allclose(seen[0, :, 0, 0], -np.expm1(-time / 0.010), rtol=0, atol=1e-12)


RNG, DRAW = np.random.default_rng(0), Background("still").draw
BAD_TIMES: list[Any] = [[0.0], [0.0, 0.0], [0.0, np.nan, 2.0], [[0.0, 1.0]]]
INCREASE = "Must (be 2 or more|be finite|increase)"
SCENE, PLAIN = partial(simulation.scene, np.arange(4.0)), np.full((4, 1, 1), 300.0)
WHOLE = still().astype(np.uint16)  # of which a lagging pixel of 1000 would wrap to 57,580
TEXT: Any = "40"
NARROW = partial(disturbances.fire_shutter, bands=("10.6",))


test_what_is_refused = refused(
    lambda call, *arguments: call(*arguments),
    [
        *((heating, TIME, 300.0, 320.0, it, r"_constant \[s\]") for it in (0.0, -1.0, np.nan)),
        *((heating, np.array(it), 300.0, 320.0, 5.0, INCREASE) for it in BAD_TIMES),
        *((DRAW, np.array(it), 3, RNG, INCREASE) for it in BAD_TIMES),
        (partial(Rig, bands=("8-14", "9.6")), "Unknown band '9.6'"),
        (partial(Rig, noise=(0.03,)), "Invalid noise [K] (0.03,) of shape (1,). Must have (2,)"),
        (partial(Rig, noise=(0.03, 0.0)), "Invalid noise [K] 0.0. Must be finite and positive"),
        (partial(Rig, bad_fraction=1.0), "Invalid bad_fraction 1.0. Must lie in [0, 1)"),
        (partial(Rig, gain_std=np.nan), "Invalid gain_std nan"),
        (partial(Rig, offset_std=TEXT), "Invalid offset_std '40'"),
        (SCENE, -PLAIN, PLAIN, GLASS, "Invalid object_temperature [K] -300"),
        (SCENE, PLAIN, np.nan * PLAIN, GLASS, "Invalid background_temperature [K] nan"),
        (SCENE, PLAIN, PLAIN, 100.0 * GLASS, "Invalid emissivity 86"),
        (simulation.side_by_side, GLASS, SHAPE, "{'material'} do not exist"),
        (disturbances.lose_frames, still(), 1.0, RNG, "Invalid share 1.0"),
        (disturbances.spoil_pixels, still(), 1.0, RNG, "Invalid share 1.0"),
        (disturbances.fire_shutter, still(), 99.0, RNG, "Invalid time 99.0 s of the shutter"),
        (NARROW, still(), 9.0, RNG, "Missing band '10.6'"),
        (disturbances.fire_shutter, WHOLE, [0.2], RNG, "dtype uint16 of 'counts'"),
        (disturbances.spoil_pixels, WHOLE, 0.1, RNG, "dtype uint16 of 'counts'"),
        (disturbances.lag, WHOLE, 0.05, "dtype uint16 of 'counts'"),
    ],
)
