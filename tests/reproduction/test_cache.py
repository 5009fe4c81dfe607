"""Cache of experiments: a result is computed once, and again if code or file changed."""

import multiprocessing
import os
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from refused import assert_refused

from reproduction import cache


def counted(folder: str, value: float, seed: int) -> xr.Dataset:
    """Leave a mark for each call, and return something random."""
    (Path(folder) / f"call-{len(list(Path(folder).iterdir()))}").touch()
    if value < 0:
        raise ValueError("interrupted")
    return xr.Dataset({"drawn": ("n", value + np.random.default_rng(seed).random(300))})


@pytest.fixture
def marks(tmp_path: Path) -> Path:
    """Folder for the marks of `counted`."""
    (tmp_path / "marks").mkdir()
    return tmp_path / "marks"


def calls(marks: Path) -> int:
    """Number of calls of `counted`."""
    return len(list(marks.iterdir()))


def test_a_result_is_computed_once(tmp_path: Path, marks: Path) -> None:
    """A second call reads it from disk, after a failure too; other arguments are computed."""
    experiment = cache.kept(counted, tmp_path)
    first = experiment(str(marks), 1.0, seed=1)
    for number in (1, 2):  # a failed call leaves none
        assert_refused("interrupted", experiment, str(marks), -1.0, 1)
        assert calls(marks) == 1 + number
    again = cache.kept(counted, tmp_path)(str(marks), value=1.0, seed=1)
    xr.testing.assert_identical(first, again)
    assert calls(marks) == 3
    experiment(str(marks), 1.0, seed=2)
    assert calls(marks) == 4


def met(folder: str) -> xr.Dataset:
    """Something random, once two processes are here."""
    (Path(folder) / f"{os.getpid()}").touch()
    while len(list(Path(folder).iterdir())) < 2:
        time.sleep(0.01)
    return xr.Dataset({"drawn": ("n", np.random.default_rng().random(300))})


def result_of(folder: str) -> xr.Dataset:
    """Result of `met`, kept beside a folder."""
    result: xr.Dataset = cache.kept(met, Path(folder).parent / "kept")(folder)
    return result


def test_two_processes_at_once(tmp_path: Path, marks: Path) -> None:
    """Each has a whole result, and one of them is kept, with nothing beside it."""
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        results = list(pool.map(result_of, [str(marks)] * 2))
    assert not results[0].identical(results[1])
    (kept,) = (path for path in (tmp_path / "kept").rglob("*") if path.is_file())
    assert kept.suffix == ".pkl"
    assert any(result_of(str(marks)).identical(result) for result in results)


DAMAGES = ["truncated", "empty", "flipped", "removed", "no pickle", "of other arguments"]


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_computed_again(
    tmp_path: Path, marks: Path, caplog: pytest.LogCaptureFixture, damage: str
) -> None:
    """A result whose file is cut, empty, flipped, gone or another result's is computed again."""
    experiment = cache.kept(counted, tmp_path / "cells")
    first = experiment(str(marks), 1.0, 1)
    (path,) = (file for file in (tmp_path / "cells").rglob("*") if file.is_file())
    whole, half = path.read_bytes(), path.stat().st_size // 2
    experiment(str(marks), 1.0, 2)
    (other,) = {*path.parent.iterdir()} - {path}
    places = range(0, len(whole), len(whole) // 50) if damage == "flipped" else [half]
    for place in places:
        flipped = whole[:place] + bytes([whole[place] ^ 1 << place % 8]) + whole[place + 1 :]
        contents = {"truncated": whole[:place], "empty": b"", "flipped": flipped, "removed": b""}
        contents["no pickle"] = zlib.compress(b"spoilt")  # whole for zlib
        path.write_bytes(contents.get(damage, other.read_bytes()))
        if damage == "removed":
            path.unlink()
        xr.testing.assert_identical(experiment(str(marks), 1.0, 1), first)
    assert calls(marks) == 2 + len(places)
    said = [record.getMessage() for record in caplog.records]
    again = [f"Damaged result '{path}'. It is computed again."]
    assert said == (damage != "removed") * len(places) * again
    assert {*path.parent.iterdir()} == {path, other}


def test_changed_code_starts_anew(
    tmp_path: Path, marks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A result of other source code is not used, nor is code that changed since its import."""
    cache.kept(counted, tmp_path)(str(marks), 1.0, 1)
    monkeypatch.setattr(cache, "_fingerprint", lambda: "other")
    with pytest.raises(RuntimeError, match=r"Changed source code\. Must be as it was imported"):
        cache.kept(counted, tmp_path)
    monkeypatch.setattr(cache, "_IMPORTED", "other")
    cache.kept(counted, tmp_path)(str(marks), 1.0, 1)
    assert calls(marks) == 2


def test_grid_of_results() -> None:
    """The last coordinate varies fastest; a missing result raises an error."""
    results = [xr.Dataset({"value": ((), float(number))}) for number in range(6)]
    coords: dict[str, list[float]] = {"noise": [0.1, 0.2], "seed": [1, 2, 3]}
    together = cache.gridded(results, coords)
    assert float(together["value"].sel(noise=0.2, seed=1)) == 3.0
    assert_refused(r"Invalid number of results 5\. Must be 6\.", cache.gridded, results[:5], coords)
