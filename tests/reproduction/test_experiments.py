"""Experiments: scenes of a case are as described; limits, nuisances and flags are known."""

from functools import partial
from typing import Any

import numpy as np
import pytest
import xarray as xr
from refused import refused

from dbthermal import readers, schema
from dbthermal import response as responses
from dbthermal.simulation import Background, Rig
from reproduction import paths
from reproduction.experiments import flags, limits, nuisances
from reproduction.experiments.cases import independent_pixels, simulate

TIME = np.arange(350) / 10.0  # s
GLASS: dict[str, Any] = {"case": "glass", "emissivity": [0.86, 0.72], "start": 20, "stop": 60}
OBJECT, BACKGROUND = "object_temperature", "background_temperature"


def drawn(**changes: Any) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    """Scene, capture and response of a case of glass with changes, or without what is None."""
    case = {key: value for key, value in (GLASS | changes).items() if value is not None}
    return simulate(case, Rig(), TIME, 20, seed=4)


@pytest.mark.parametrize(("duration", "partly"), [(0.0, 0), (2.0, 19)])
def test_jump_of_the_object(duration: float, partly: int) -> None:
    """A sudden or gradual jump begins where the case says, and changes nothing else."""
    plain = drawn()[0]
    jump = {"height": 6.0, "between": [12.0, 15.0], "duration": duration}
    scene = drawn(jump=jump)[0]
    added = (scene[OBJECT] - plain[OBJECT]).values[:, 0]
    np.testing.assert_allclose(added[TIME < 12.0], 0.0, rtol=0, atol=1e-9)  # K
    np.testing.assert_allclose(added[TIME > 17.0], 6.0, rtol=0, atol=1e-9)
    between = np.sum((added > 1e-9) & (added < 6.0 - 1e-9), axis=0)
    assert set(between) <= {partly, partly + 1}  # frames
    assert len({*np.argmax(added > 1e-9, axis=0)}) > 10  # of 20 pixels, each at its own time
    xr.testing.assert_identical(scene[BACKGROUND], plain[BACKGROUND])


def test_changes_of_a_case() -> None:
    """A still background, one that follows the object, swapped roles, frames and noise."""
    plain, still = drawn()[0], {"kind": "still", "level": 290.0}
    assert (drawn(background=still)[0][BACKGROUND] == 290.0).all()
    np.testing.assert_allclose(plain[OBJECT][[0, -1], 0, 0], [293.15, 333.15])
    added = drawn(following=0.2)[0][BACKGROUND] - plain[BACKGROUND]
    np.testing.assert_allclose(added, 0.2 * (plain[OBJECT] - plain[OBJECT][0]), rtol=0, atol=1e-9)
    swapped = drawn(swapped=True)[0]
    np.testing.assert_array_equal(swapped[OBJECT], plain[BACKGROUND])
    np.testing.assert_array_equal(swapped[BACKGROUND], plain[OBJECT])
    scene, capture, response = drawn(frames=100, noise=[0.1, 0.2])
    assert scene.sizes["time"] == 100
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
    np.testing.assert_array_equal(first, scene[BACKGROUND][:, 0] > 294.15)
    inside = (np.argmax(first, axis=0) > 5) & first.any(axis=0) & ~first[-5:].any(axis=0)
    later = (np.argmax(second, axis=0) - np.argmax(first, axis=0))[inside]
    assert inside.sum() > 10
    assert set(later) <= {int(np.floor(-offset)), int(np.ceil(-offset))}  # frames


@pytest.mark.parametrize(
    ("moved", "right", "bleeding"), [(0, 1.0, 0), (2, 1.0, 0), (5, 1 - 3 / 36, 1), (None, 0.0, 0)]
)
def test_border_is_judged_beyond_two_pixels(moved: int | None, right: float, bleeding: int) -> None:
    """A border two pixels off is kept; five off, three columns of 36 bleed; without labels 0."""
    columns = xr.DataArray(np.indices((10, 40))[1], dims=("y", "x"))
    labels = columns * 0 - 1 if moved is None else (columns >= 20 + moved).astype(int)
    kept = limits.border_kept(labels, (columns >= 20).astype(int))
    assert float(kept["right"]) == pytest.approx(right, abs=1e-12)
    assert int(kept["bleeding"]) == bleeding


UNEVEN = np.append(TIME[:-1], TIME[-1] + 0.05)
VIEWS: dict[str, Any] = {"shape": [24, 32], "clock": [50, 10.0], "seed": 1}
POOLED: dict[str, Any] = {"pixels": 400, "seed": 1, "ends": [20.0, 45.0], "clock": [350, 10.0]}


test_experiments_that_cannot_be_made = refused(
    lambda call: call(),
    [
        (partial(drawn, start=None), "Must have ['emissivity', 'start', 'stop']"),
        (partial(drawn, offset=0.33), "offset 0.33 frames. Must be zero or positive, a multiple"),
        (partial(drawn, offset=-1.0), "Invalid offset -1.0 frames. Must be zero or positive"),
        (partial(drawn, frames=351), "Invalid number of frames 351. Must lie in [2, 350]"),
        (partial(drawn, jump={"between": [5.0, 4.0]}), "Invalid between [5.0, 4.0] s of a jump"),
        (partial(drawn, jump={"duration": -1.0}), "Invalid duration -1.0 s of a jump"),
        (partial(drawn, emisivity=[0.9, 0.8]), "with keys ['case', 'emisivity', 'emissivity',"),
        (lambda: simulate(GLASS | {"offset": 1.0}, Rig(), UNEVEN, 5, 0), "are exposed apart"),
        (lambda: limits.pooled([3], [0.86, 0.72], **POOLED), "Invalid size 3 of a group. Must div"),
        (lambda: nuisances.disturbed("rain", pixels={}, nuisance={}, seed=1), "nuisance 'rain'"),
        (lambda: nuisances.parallax(0.1, shift=[0.0, 0.0], **VIEWS), "multiples of 1/4 along x"),
        (lambda: nuisances.parallax(1.0, shift=[12.0, 0.0], **VIEWS), "within 12 together"),
    ],
    error=ValueError,
)


BASE = {"emissivity": [0.86, 0.72], "start": 20.0, "stop": 45.0}


@pytest.fixture(scope="module")
def rates() -> xr.Dataset:
    """Rates over few pixels, with one clean scene; the "gray" scene is clean as well."""
    pictures: dict[str, dict[str, Any]] = {
        "completed_from_prior": {"still": 0.5},
        "no_reflection_pair": {"shift": [6.0, 2.0]},
    }
    expected: dict[str, dict[str, Any]] = {flag: {} for flag in (*flags.FAULTS, "gray")} | pictures
    scenes = {flag: [scene] for flag, scene in expected.items()}
    return flags.rates(scenes, {"clean": {}}, BASE, pixels=40, clock=[350, 10.0], seed=3)


def test_damaged_samples_are_flagged(rates: xr.Dataset) -> None:
    """Damaged samples get their flag, none is silently wrong; a clean "gray" one is missed."""
    rows = rates.sel(flag=list(flags.FAULTS))
    np.testing.assert_array_equal(rows["pixels"], 20)
    np.testing.assert_array_equal(rows["clean_pixels"], 60)
    np.testing.assert_array_equal(rows["without_it"], 0.0)
    np.testing.assert_array_equal(rows["false_alarms"], 0.0)
    row = rates.sel(flag="gray")
    np.testing.assert_allclose([row["without_it"], row["without_any"]], 1.0, rtol=0, atol=0.1)
    assert float(row["wrong"]) == 0.0
    assert bool(rates["without_it"].sel(flag="dead_pixel").isnull())


def test_pictures_have_pixels_with_and_without(rates: xr.Dataset) -> None:
    """Where half a picture rests, or a border has no pair, the flag comes there and only there."""
    rows = rates.sel(flag=["completed_from_prior", "no_reflection_pair"])
    assert bool(((rows["pixels"] > 100) & (rows["pixels"] < 1000)).all())
    np.testing.assert_array_equal(rows["without_it"], 0.0)
    assert float(rows["false_alarms"].max()) < 0.01


def test_every_flag_has_a_scene() -> None:
    """The full table lacks no flag but that of the optimiser, which the default way never sets."""
    listed = readers.read_yaml(paths.params("10_limits"))["cases"]["flags"]
    assert set(schema.Status.bits()) - set(listed) <= {"not_converged"}


def test_independent_pixels(rng: np.random.Generator) -> None:
    """Each pixel has its own curve and background, all from start to stop, with the same glass."""
    glass = xr.DataArray(GLASS["emissivity"], dims="band", coords={"band": ["8-14", "9.5"]})
    span: Any = {"start": 293.15, "stop": 333.15}
    made = independent_pixels(TIME, glass, Background(), 50, rng, **span)
    assert dict(made["object_temperature"].sizes) == {"time": TIME.size, "y": 1, "x": 50}
    ends = made["object_temperature"].isel(time=[0, -1], y=0)
    np.testing.assert_allclose(ends.T, [[293.15, 333.15]] * 50, rtol=0, atol=1e-10)
    assert np.unique(made["object_temperature"].isel(time=60)).size == 50
    np.testing.assert_array_equal(made["emissivity"].isel(y=0, x=7), glass)
