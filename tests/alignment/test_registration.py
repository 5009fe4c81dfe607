"""Registration of views onto one grid, and the cost of a reflection that does not register."""

from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, people, plain_capture, transform_of
from refused import assert_refused

from dbthermal import alignment, schema, simulation
from dbthermal.correction import correct_capture
from reproduction import disturbances
from reproduction.experiments import whole

SHAPE = (96, 128)


def picture(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Ten warm or cold ellipses with soft edges, at any position [K]."""
    rng, result = np.random.default_rng(seed), np.full(x.shape, 295.0)
    for _ in range(10):
        middle, axes = rng.uniform((0, 0), SHAPE[::-1]), rng.uniform(6, 23, 2)
        angle, height = rng.uniform(0, 3), rng.uniform(-6, 12)
        u, v = x - middle[0], y - middle[1]
        along, across = u * np.cos(angle) + v * np.sin(angle), v * np.cos(angle) - u * np.sin(angle)
        distance = np.hypot(along / axes[0], across / axes[1])
        result += height / (1 + np.exp((distance - 1) * axes[0] / 0.7))
    return result


def positions(matrix: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Row and column (2, y, x) [pixel] at which a transform shows each pixel."""
    rows, columns = np.indices(shape)
    column, row, scale = np.einsum("ij,jyx->iyx", matrix, np.stack([columns, rows, 0 * rows + 1]))
    return np.asarray(np.stack([row, column]) / scale)


def homography(shift: tuple[float, float], degrees: float, scale: float) -> np.ndarray:
    """Rotation and scaling about the image's middle, then a shift [pixel]."""
    angle = np.deg2rad(degrees)
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    turned = np.array([[cosine, -sine], [sine, cosine]])
    middle, matrix = np.array([64.0, 48.0]), np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = turned, shift + middle - turned @ middle
    return matrix


def views(matrix: np.ndarray, seed: int = 0, frames: int = 3) -> xr.Dataset:
    """Two views of one plane, the second of other gain, offset and noise, with bad pixels."""
    rng = np.random.default_rng(seed)
    (y, x), (row, column) = np.indices(SHAPE), positions(np.linalg.inv(matrix), SHAPE)
    first, second = 100.0 * picture(x, y, seed), 3000.0 + 8.0 * picture(column, row, seed)
    counts = np.stack([np.stack([first] * frames), np.stack([second] * frames)])
    counts += rng.normal(0, [[[[1.0]]], [[[0.3]]]], counts.shape)
    counts[1, :, 20, 30], counts[1, :, 50, 77] = 0.0, 60000.0
    status = np.zeros(SHAPE, dtype=np.uint16)
    status[20, 30] = status[50, 77] = schema.Status.DEAD_PIXEL
    bad = ("y", "x"), status, schema.Status.cf_attrs(schema.STATUS)
    return plain_capture(counts.astype(np.float32), status=bad)


@pytest.mark.parametrize("model", ["affine", "homography"])
@pytest.mark.parametrize(
    ("truth", "seed"),
    [(((2.3, -1.6), 0, 1), 0), (((3.3, -4.6), 1, 1.01), 1), (((9.7, 3.2), -1.5, 1.02), 2)],
)
def test_object_registers(
    truth: tuple[tuple[float, float], float, float], seed: int, model: Any
) -> None:
    """The second view is found within 0.03 pixel root mean square, every pixel within 0.05."""
    matrix = homography(*truth)
    found = alignment.register(views(matrix, seed), model=model)
    errors = np.hypot(*(positions(found.values[1], SHAPE) - positions(matrix, SHAPE)))
    assert np.sqrt(np.mean(errors**2)) < 0.03
    assert errors.max() < 0.05
    np.testing.assert_array_equal(found.values[0], np.eye(3))


@pytest.mark.parametrize("shape", [(24, 32), (48, 64)])
def test_a_warm_spot_tells_the_translation_alone(shape: tuple[int, int]) -> None:
    """Where texture tells neither rotation nor scale, they are those of equal cameras."""
    errors, noise = [], RIG.response()["noise"].values.reshape(2, 1, 1, 1)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        _, capture = people(rng, 200, shape)
        # A blackbody of four steps of 16 frames leaves an eighth of the noise of a frame.
        pattern = rng.normal(0, 0.125, (2, 1, *shape)) * noise
        capture["counts"] = capture["counts"] + pattern.astype(np.float32)
        found = alignment.register(capture).values[1]
        errors.append(np.hypot(*(positions(found, shape) - np.indices(shape))).max())
    assert np.median(errors) < 0.15  # [pixel]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_pattern_that_rests_does_not_pull(seed: int) -> None:
    """After a shutter event each camera has a pattern of its own; the object's detail changes."""
    (y, x), rng = np.indices(SHAPE), np.random.default_rng(seed)
    detail = np.stack([picture(x, y, seed), picture(x + 3.0, y - 2.0, seed)])[:, np.newaxis] - 295.0
    rise = np.linspace(0.2, 1.0, 40)[:, np.newaxis, np.newaxis]
    noise = rng.normal(0.0, 0.3, (2, 40, *SHAPE)) + rng.normal(0.0, 3.0, (2, 1, *SHAPE))
    capture = views(np.eye(3), frames=40).drop_vars("status")
    capture["counts"].values[...] = 1000.0 + 10.0 * (rise * detail + noise)
    found = alignment.register(capture).values[1]
    apart = positions(found, SHAPE) - positions(homography((-3.0, 2.0), 0.0, 1.0), SHAPE)
    error = float(np.sqrt(np.mean(np.hypot(*apart) ** 2)))
    assert error < 0.1  # [pixel]; with all residuals alike 0.4 to 0.6


def test_views_are_warped() -> None:
    """After `align` the second view shows the object where the first does; outside it is NaN."""
    capture = views(homography((3.3, -4.6), 1, 1.01))
    aligned = alignment.align(capture, offset=0.0, transform=alignment.register(capture))
    good = (aligned["status"] == 0) & aligned["counts"].notnull().all(("band", "time"))
    first, second = aligned["counts"].mean("time").where(good)
    error = (second - 3000.0) / 8.0 - first / 100.0
    assert float(error.std()) < 0.15  # [K], of edges of up to 12 K over a few pixels
    assert float(good.mean()) > 0.9
    assert np.isnan(aligned["counts"].values[1, :, 0]).all()
    assert len(aligned.attrs["transform"]) == 18


def test_places_behind_the_camera_are_nan() -> None:
    """Pixels that a homography sends behind the camera have no place; an array is no transform."""
    capture, horizon = views(np.eye(3)), np.eye(3)
    horizon[2, 0] = -1.0 / 64.0
    warped = [
        alignment.align(capture, offset=0.0, transform=transform_of(sign * horizon))[
            "counts"
        ].values[1]
        for sign in (1, -1)
    ]
    assert np.isfinite(warped[0][:, :48, :32]).any()
    assert np.isnan(warped[0][:, :, 64:]).all()
    np.testing.assert_array_equal(*warped)
    with pytest.raises(TypeError, match="Invalid transform of type ndarray"):
        alignment.align(capture, transform=np.eye(3))  # type: ignore[arg-type]


def test_a_shift_by_whole_pixels_moves_samples() -> None:
    """A transform by whole pixels changes no sample, and moves the bad pixels' flags along."""
    capture, moves = views(np.eye(3)), np.array([[1, 0, 2], [0, 1, 1], [0, 0, 1.0]])
    aligned = alignment.align(capture, offset=0.0, transform=transform_of(moves))
    moved = aligned["counts"].values[1, :, :-1, :-2]
    np.testing.assert_array_equal(moved, capture["counts"].values[1, :, 1:, 2:])
    assert np.isnan(aligned["counts"].values[1, :, -1]).all()
    flagged = np.argwhere(aligned["status"].values)
    assert flagged.tolist() == [[19, 28], [20, 30], [49, 75], [50, 77]]


@pytest.mark.parametrize(
    ("second", "model", "message"),
    [
        (None, "thin plate", "Unknown model 'thin plate'"),
        (np.random.default_rng(5).normal(0, 1, SHAPE), "homography", "band '9.5'"),
        (5.0, "homography", "all pixels are alike"),
        (np.nan, "homography", r"Invalid view in band '9.5': all \d+ frames are missing"),
    ],
)
def test_views_that_do_not_match(second: Any, model: Any, message: str) -> None:
    """Views of different scenes and an unknown model raise a ValueError."""
    capture = views(np.eye(3))
    if second is not None:
        capture["counts"].values[1] = second
    capture["counts"].values[1, 1:] += np.array([[[1.0]], [[2.0]]], dtype=np.float32)
    assert_refused(message, alignment.register, capture, model=model)


def test_views_that_share_little_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The edges of two views correlate by chance: what keeps only these is no transform."""
    apart = np.eye(3)
    apart[0, 2] = 0.6 * SHAPE[1]
    monkeypatch.setattr("dbthermal.alignment._registration._start", lambda *_: (0.99, apart))
    assert_refused(r"band '9\.5': it shares 40% of the image", alignment.register, views(np.eye(3)))


def test_the_offset_is_that_of_registered_views() -> None:
    """The offset of views 3 pixels and 4/3 frames apart is found after their registration."""
    fine, rng, response = np.arange(606) / 30.0, np.random.default_rng(3), RIG.response()
    wide = simulation.walkers(fine, (32, 40), GLASS, rng)
    seen = [wide.isel(y=slice(4, 28), x=slice(4, 36)), wide.isel(y=slice(2, 26), x=slice(7, 39))]
    parts = [
        disturbances.expose(
            view.drop_vars(["y", "x"], errors="ignore"),
            response.isel(band=[band]),
            rng,
            every=3,
            offsets=[4 * band],
            frames=200,
        ).drop_vars("exposure_time")
        for band, view in enumerate(seen)
    ]
    time = parts[0]["time"]
    capture = xr.concat(
        [one.assign_coords(time=time) for one in parts], "band", combine_attrs="override"
    )
    transform = alignment.register(capture, model="translation")
    aligned = alignment.align(capture, transform=transform)
    offsets = [alignment.time_offset(capture), aligned.attrs["time_offset"][1]]
    errors = 10.0 * np.array(offsets) - 4.0 / 3.0
    assert abs(errors[1]) < 0.05  # [frame]
    assert abs(errors[0]) > 0.2  # [frame]: else the scene would not tell


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "clock", "rig"),
    [
        # At 50 Hz what moves by the cameras' shift is seen as a delay of many frames.
        ((48, 62), (419, 50.0), {"shift": (-4.0, 0.8), "view": (-1, 4), "late": 2}),
        # A large image is compared by means over squares of its pixels.
        ((144, 160), (300, 10.0), {"shift": (4.8, 2.4), "view": (0, 0), "late": 1}),
    ],
)
def test_clocks_are_found(
    shape: tuple[int, int], clock: tuple[int, float], rig: dict[str, Any]
) -> None:
    """The offset of cameras apart is right within a tenth of a frame, beside bad samples."""
    others: dict[str, Any] = {"shutter": (0.76,), "lost": (0.01, 0.01), "steps": 4, "frames": 16}
    recording = whole.record(shape, clock, 1, **rig, **others)
    fitted, _ = whole.calibrate(recording.movies)
    corrected = correct_capture(recording.capture, fitted)
    aligned = alignment.align(corrected, transform=whole.registration(rig["view"]))
    frames = clock[1] * aligned.attrs["time_offset"][1]
    assert abs(frames - 0.5 * rig["late"]) < 0.1
