"""Counts computed when they are read, and films on disk: the values of those in memory."""

import resource
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import people, transform_of

from dbthermal import _arrays, alignment, correction, simulation
from dbthermal.correction import _pixels
from reproduction import disturbances

SHAPE = (2, 5, 13, 7)
WHOLE = xr.DataArray(
    np.random.default_rng(1).random(SHAPE, dtype=np.float32), dims=("band", "time", "y", "x")
)


@pytest.mark.parametrize(
    "place",
    [
        {"y": slice(2, 9)},
        {"y": slice(None, None, 4), "x": slice(1, 6, 2)},
        {"band": 1, "time": [0, 3], "y": 5},
        {"y": xr.DataArray([1, 9, 12], dims="p"), "x": xr.DataArray([0, 3, 6], dims="p")},
        {"time": np.array([True, False, True, True, False]), "y": slice(None, None, -1)},
    ],
    ids=str,
)
def test_rows_are_read_as_an_array(monkeypatch: pytest.MonkeyPatch, place: dict[str, Any]) -> None:
    """Every way of indexing gives what the array has there, and computes only rows around it."""
    monkeypatch.setattr(_arrays, "_BLOCK", 150)
    computed: list[slice] = []

    def compute(rows: slice) -> np.ndarray:
        computed.append(rows)
        return WHOLE.values[:, :, rows]

    array = _arrays.lazy(compute, WHOLE)
    part = array.isel(place)
    assert not computed
    np.testing.assert_array_equal(part.values, WHOLE.isel(place).values)
    assert max(rows.stop - rows.start for rows in computed) <= 2
    wanted = np.arange(SHAPE[2])[place["y"]]
    assert min(rows.start for rows in computed) >= np.min(wanted)
    assert max(rows.stop for rows in computed) <= np.max(wanted) + 1


def recorded(
    frames: int, seed: int, *, bad: float = 0.0, shutter: Sequence[float] = ()
) -> tuple[xr.Dataset, xr.Dataset]:
    """Raw capture of people before glass, 24 by 28 pixels, and its correction."""
    rng, rig, shape = np.random.default_rng(seed), simulation.Rig(bad_fraction=bad), (24, 28)
    _, seen = people(rng, frames, shape, rig=rig)
    if shutter:
        seen = disturbances.fire_shutter(disturbances.spoil_pixels(seen, bad, rng), shutter, rng)
    detector = simulation.pattern(rig, shape, rng)
    movies = simulation.blackbody_movies(rig, np.array([280.0, 310.0, 340.0]), 16, detector, rng)
    fitted = correction.fit_correction(correction.blackbody_statistics(movies))
    return simulation.capture(seen, detector), fitted


def test_a_capture_corrected_and_aligned_by_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Computed by rows, the counts, status and all else are those computed at once."""
    raw, fitted = recorded(150, 2, bad=0.01, shutter=[7.0])
    patch = xr.DataArray(np.indices((24, 28)).max(axis=0) < 5, dims=("y", "x"))
    transform = transform_of([[1.01, 0.0, 1.5], [0.01, 0.99, -2.25], [0.0, 0.0, 1.0]])

    def process(*, lazy: bool) -> tuple[xr.Dataset, xr.Dataset]:
        corrected = correction.correct_capture(
            raw, fitted, time_constant=0.012, drift_reference=patch, lazy=lazy
        )
        aligned = alignment.align(corrected, offset=0.03, transform=transform, lazy=lazy)
        return corrected, aligned

    at_once = process(lazy=False)
    monkeypatch.setattr(_arrays, "_BLOCK", 40000)
    monkeypatch.setattr(_pixels, "_BLOCK", 150 * 5)  # five pixels of a row
    for whole, by_rows in zip(at_once, process(lazy=True), strict=True):
        # The level's root mean square is that of other samples.
        np.testing.assert_allclose(whole["pattern_std"], by_rows["pattern_std"], rtol=0.02)
        assert "..." in repr(by_rows)  # not computed
        xr.testing.assert_identical(
            whole.drop_vars("pattern_std"), by_rows.load().drop_vars("pattern_std")
        )


@pytest.mark.filterwarnings("ignore:Fixed pattern")
def test_rows_without_a_good_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """A border of one value makes no deviation unknown, and no warning of NumPy, by rows either."""
    raw, fitted = recorded(60, 3)
    raw["counts"].values[:, :, :8] = 0
    whole = correction.correct_capture(raw, fitted)["pattern_std"].values
    monkeypatch.setattr(_arrays, "_BLOCK", 2 * 60 * 28 * 4)  # four rows
    by_rows = correction.correct_capture(raw, fitted, lazy=True)["pattern_std"].values
    assert np.all(whole > 0)
    np.testing.assert_allclose(by_rows, whole, rtol=0.02)


def test_a_film_on_disk_is_an_array_without_a_name(tmp_path: Path) -> None:
    """Values outlive the pages, no file is left to be deleted, and small arrays stay in memory."""
    before = _arrays.empty((3, 512, 1024), np.float32)
    with _arrays.on_disk(tmp_path):
        film = _arrays.empty((3, 512, 1024), np.float32)
        small = _arrays.empty((4, 5), np.float32)
    film[:] = np.arange(3, dtype=np.float32)[:, np.newaxis, np.newaxis]
    _arrays.release()
    np.testing.assert_array_equal(film[:, ::100, 7], np.outer([0, 1, 2], np.ones(6)))
    again = _arrays.copied(film)
    np.testing.assert_array_equal(again, film)
    assert list(tmp_path.iterdir()) == []
    assert film.flags.writeable
    assert not _arrays.made_on_disk()
    assert before.base is None
    assert small.base is None
    assert film.base is not None


def test_pages_are_given_back(tmp_path: Path) -> None:
    """A film of 256 MB that is released part by part takes a fraction of that."""
    with _arrays.on_disk(tmp_path):
        film = _arrays.empty((64, 2**20), np.float32)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for frame in film:
        frame[:] = 1.0
        _arrays.release()
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert taken < film.nbytes / 4
    assert float(film[::9].mean()) == 1.0
