"""Bad pixels: noisy, blinking and stuck ones are marked, edges and shutter events are not."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import xarray as xr
from captures import still, walkers

from dbthermal import schema, simulation
from dbthermal.correction import mark_bad, mark_shutter

DEAD = schema.Status.DEAD_PIXEL
THRESHOLDS: tuple[object, ...] = (0, "6", True, [6.0], np.inf)


@pytest.mark.parametrize("seed", range(2))
def test_bad_pixels_are_found(seed: int) -> None:
    """Noisy, blinking and stuck pixels are marked; walkers and edges of materials are not."""
    capture = walkers(seed)
    false = float((mark_bad(capture)["status"] != 0).mean())
    spoiled = simulation.spoil_pixels(capture, 0.005, np.random.default_rng(seed))
    marked = mark_bad(spoiled)["status"].values == DEAD
    kinds = spoiled["spoiled"].max("band").values
    rates = [float(marked[kinds == kind].mean()) for kind in range(len(simulation.SPOILED))]
    print(f"false alarms {false:.1e}; {dict(zip(simulation.SPOILED, rates, strict=True))}")
    assert false < 1e-4
    assert rates[0] < 5e-4
    assert min(rates[1:]) >= 0.95


def test_fast_frames_are_no_bad_pixels() -> None:
    """At 60 Hz the slow edge of a silhouette is not marked as a blinking pixel."""
    false = [float((mark_bad(walkers(n, rate=60.0))["status"] != 0).mean()) for n in (2, 4)]
    print(f"false alarms at 60 Hz {false}")
    assert np.mean(false) < 1e-4


@pytest.mark.filterwarnings("ignore:Fixed pattern")  # of offsets that the shutter renewed
def test_shutter_makes_no_bad_pixel() -> None:
    """New offsets after a known shutter event are not marked as blinking pixels."""
    capture = simulation.fire_shutter(walkers(1), 17.0, np.random.default_rng(4))
    assert float((mark_bad(capture)["status"] != 0).mean()) > 0.01
    marked = mark_bad(mark_shutter(capture))
    assert not marked["status"].any()
    assert marked.attrs["jumping_pixels"] == 0
    assert "warnings" not in marked.attrs  # of offsets that were right until then


def holes(kind: str, seed: int = 3) -> npt.NDArray[np.bool_]:
    """Samples (band, time, y, x) that are no measurement: a share of all, or of a band, or rows."""
    shape = (2, 350, 64, 80)
    if kind.endswith("%"):
        return np.random.default_rng(seed).random(shape) < float(kind[:-1]) / 100.0
    band, frame, row, _ = np.indices(shape, sparse=True)
    places = {
        "rows": (row >= 5) & (row < 8),
        "frames of a band": (band == 0) & (frame >= 40) & (frame < 90),
        "every other frame": (frame % 2 == 0) & (row % 2 == 0),
    }
    return np.broadcast_to(places[kind], shape)


@pytest.mark.parametrize(
    "kind",
    ["10%"]
    + [
        pytest.param(kind, marks=pytest.mark.slow)
        for kind in ("1%", "40%", "rows", "frames of a band", "every other frame")
    ],
)
def test_holes_do_not_hide_bad_pixels(kind: str) -> None:
    """Bad pixels are found, and few others, where up to 40 %, rows or every other frame lack."""
    capture = walkers(0)
    spoiled = simulation.spoil_pixels(capture, 0.005, np.random.default_rng(0))
    valid = ~holes(kind)
    found = [mark_bad(one.assign(counts=one["counts"].where(valid))) for one in (capture, spoiled)]
    judged = valid.sum(axis=1).min(axis=0) >= 16
    assert found[0].attrs["unjudged_pixels"] == np.count_nonzero(~judged)
    false, marked = ((part["status"].values & DEAD != 0)[judged] for part in found)
    bad = spoiled["spoiled"].max("band").values[judged] > 0
    print(f"{kind} NaN: {false.mean():.1e} false alarms, {marked[bad].mean():.3f} found")
    assert false.mean() < 3e-3
    assert marked[bad].mean() > 0.85


def test_bad_pixels_are_added_to_the_status() -> None:
    """Bits that were set stay, the counts stay, the input stays, and numbers are written."""
    capture = still()
    capture["counts"].values[1, :, 5, 6] = 16000.0
    before = capture.assign(status=(("y", "x"), np.full((20, 24), 128, dtype=np.uint16)))
    kept = before.copy(deep=True)
    marked = mark_bad(before)
    xr.testing.assert_identical(before, kept)
    xr.testing.assert_identical(marked["counts"], before["counts"])
    np.testing.assert_array_equal(np.argwhere(marked["status"].values != 128), [[5, 6]])
    assert marked["status"].values[5, 6] == 128 | DEAD
    names = ("noisy_pixels", "jumping_pixels", "bad_threshold")
    assert [marked.attrs[name] for name in names] == [1, 0, 6.0]


SPARSE = still().where(
    xr.DataArray(~holes("90%")[:, :60, :20, :24], dims=("band", "time", "y", "x"))
)


@pytest.mark.parametrize(
    ("capture", "options", "message"),
    [(still(), {"threshold": one}, "Invalid threshold of bad pixels") for one in THRESHOLDS]
    + [
        (still().isel(time=slice(15)), {}, "Invalid band '8-14' of 15 frames"),
        (SPARSE.isel(time=slice(16)), {}, "'8-14': no pixel has 16 samples that are not NaN"),
    ],
)
def test_bad_pixels_refuse_nonsense(
    capture: xr.Dataset, options: dict[str, Any], message: str
) -> None:
    """Too few frames or samples, and a threshold that is no positive number, are named."""
    with pytest.raises((TypeError, ValueError), match=message):
        mark_bad(capture, **options)
