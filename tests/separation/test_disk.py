"""Captures from disk to disk: the same as in memory, by any process, after any kill."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from captures import GLASS, RIG, people, plain_capture

from dbthermal import correction, separation, simulation, store
from dbthermal.separation import _run
from dbthermal.store import _datasets
from reproduction import benchmark
from reproduction.benchmark import peak_memory
from reproduction.experiments import whole

TIME = np.arange(64) / 10.0  # s
# Nine rows in a block [byte].
MEMORY = _run.BASE + 9 * (_run._READ + _run._SAMPLE + _run._TILE) * 2 * 64 * 24
OPTIONS: dict[str, Any] = {"memory": MEMORY, "provenance": {"run of": "a test"}}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A capture of 41 rows on disk, with lost samples, bad pixels and a shutter event."""
    _, capture = people(1, TIME.size, (41, 24), crossings=3)
    capture["counts"][:, 20] = np.nan
    capture["status"] = (("y", "x"), np.zeros((41, 24), dtype=np.uint32))
    capture["status"][3, 4] = 1 << 10
    capture["segment"] = ("time", (TIME > 3.0).astype(np.int32))
    path = tmp_path_factory.mktemp("run") / "capture.zarr"
    store.save(capture, path, store.provenance({}))
    # Compiles: the process that does may have other last digits than those that load the code.
    separation.solve(capture, RIG.response())
    return path


def files(folder: Path) -> dict[str, bytes]:
    """Content of every file of a store."""
    every = (one for one in folder.rglob("*") if one.is_file())
    return {str(one.relative_to(folder)): one.read_bytes() for one in every}


@pytest.fixture(scope="module")
def rest(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of the capture by a process of its own."""
    target = tmp_path_factory.mktemp("rest") / "result.zarr"
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as one:
        separation.run(path, target, RIG.response(), executor=one, **OPTIONS)
    return target


def assert_solved(target: Path, capture: xr.Dataset, *arguments: Any, **options: Any) -> None:
    """Assert that a store holds what `solve` gives of a capture."""
    result = store.open_dataset(target).load().drop_attrs()
    expected = separation.solve(capture, *arguments, **options).drop_attrs()
    xr.testing.assert_identical(result, expected)


def test_run_is_solve(path: Path, tmp_path: Path) -> None:
    """Block by block the result is that of the whole capture in memory, and no part is left."""
    response, target = RIG.response().drop_vars(["noise", "netd"]), tmp_path / "result.zarr"
    separation.run(path, target, response, memory=MEMORY)
    assert_solved(target, store.open_dataset(path).load(), response)
    assert store.open_dataset(target).attrs["method"] == "subspace"
    assert [one.name for one in tmp_path.iterdir()] == ["result.zarr"]


def test_maps_are_cut_by_rows(path: Path, tmp_path: Path) -> None:
    """Emissivities and a mask of each pixel are those of its block of rows."""
    rng, response = np.random.default_rng(3), RIG.response()
    known = xr.DataArray(rng.uniform(0.7, 0.87, (41, 24)), dims=("y", "x"))
    known = xr.concat([known + 0.1, known], "band").assign_coords(band=list(RIG.bands))
    mask = xr.DataArray(rng.random((41, 24)) < 0.9, dims=("y", "x"))
    maps: dict[str, Any] = {"emissivity": known, "mask": mask}
    target = tmp_path / "result.zarr"
    separation.run(path, target, response, "calibrated", memory=MEMORY, **maps)
    assert_solved(target, store.open_dataset(path).load(), response, "calibrated", **maps)


def peak(source: Path, target: Path, memory: float) -> float:
    """Separate from disk to disk; the most memory of this process [byte]."""
    separation.run(source, target, RIG.response(), memory=memory)
    return peak_memory()


@pytest.mark.slow
def test_memory_is_the_limit_of_a_process(tmp_path: Path) -> None:
    """Of 200 MB of counts a process that may take 700 MB takes no more, its programs included."""
    flat = benchmark.capture(81920, 300, 2)["counts"].values.reshape(2, 300, 128, 640)
    store.save(plain_capture(flat), tmp_path / "all.zarr", {})
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as fresh:
        found = fresh.submit(peak, tmp_path / "all.zarr", tmp_path / "result.zarr", 7e8).result()
    print(f"{found / 1e6:.0f} MB")
    assert 2e8 < found <= 7e8


def test_processes_give_the_same_bytes(path: Path, rest: Path, tmp_path: Path) -> None:
    """Two processes of an executor write the files that one process writes."""
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as two:
        separation.run(path, tmp_path / "two.zarr", RIG.response(), executor=two, **OPTIONS)
    assert files(tmp_path / "two.zarr") == files(rest)


def test_several_captures_are_one_call(path: Path, tmp_path: Path) -> None:
    """Of three captures one is at fault: it is named, the others are finished, and made once."""
    response, capture = RIG.response(), store.open_dataset(path).load()
    store.save(capture.isel(band=[0]), tmp_path / "broken.zarr", {})
    sources: list[Any] = [path, tmp_path / "broken.zarr", capture.isel(y=slice(9))]
    targets = [tmp_path / f"{name}.zarr" for name in ("first", "second", "third")]
    with pytest.raises(ExceptionGroup, match=r"1 of 3 captures failed, .*second") as caught:
        separation.run(sources, targets, response, memory=MEMORY)
    (error,) = caught.value.exceptions
    assert isinstance(error, ValueError)
    assert "second.zarr" in error.__notes__[0]
    assert_solved(targets[2], capture.isel(y=slice(9)), response)
    result = store.open_dataset(targets[2]).load()
    before = [(target / "zarr.json").stat().st_mtime_ns for target in (targets[0], targets[2])]
    store.save(capture.isel(y=slice(9)), tmp_path / "broken.zarr", {})
    separation.run(sources, targets, response, memory=MEMORY)
    after = [(target / "zarr.json").stat().st_mtime_ns for target in (targets[0], targets[2])]
    assert after == before
    assert store.open_dataset(targets[1]).drop_attrs().equals(result.drop_attrs())
    separation.run(sources[:1], targets[:1], response, memory=MEMORY, seed=1)
    assert (targets[0] / "zarr.json").stat().st_mtime_ns > before[0]  # of another run
    with pytest.raises(ValueError, match="Invalid number of targets 2 for 3 captures"):
        separation.run(sources, targets[:2], response)
    with pytest.raises(ValueError, match=r"Invalid target .* be no capture that is read"):
        separation.run(sources[0], sources[0], response)
    with pytest.raises(ValueError, match=r"Invalid target .*first.* Must .* be named once"):
        separation.run(sources, [*targets[:2], targets[0]], response)


def dask_backed(path: Path) -> xr.Dataset:
    """The capture in dask's arrays, in chunks that are no blocks of a run."""
    pytest.importorskip(
        "dask.array", reason="dask is not installed: pip install dbthermal[cluster]"
    )
    return store.open_dataset(path).chunk({"y": 16, "x": 10})


@pytest.mark.parametrize("kind", ["zarr", pytest.param("dask", marks=pytest.mark.slow)])
def test_a_lazy_dataset_is_a_source(path: Path, rest: Path, tmp_path: Path, kind: str) -> None:
    """Opened lazily, or dask's, and sent to a process by rows, it gives what the folder does."""
    lazy = dask_backed(path) if kind == "dask" else store.open_dataset(path)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as one:
        separation.run(lazy, tmp_path / "lazy.zarr", RIG.response(), executor=one, **OPTIONS)
    xr.testing.assert_equal(*(store.open_dataset(p) for p in (tmp_path / "lazy.zarr", rest)))


@pytest.mark.parametrize("kind", ["folder", "zarr", "dask", "memory"])
def test_a_source_of_other_values_is_another(path: Path, tmp_path: Path, kind: str) -> None:
    """Warmer in a single pixel it is separated anew; the same again is left, for any memory."""
    capture, target = store.open_dataset(path).isel(y=slice(12)).load(), tmp_path / "result.zarr"
    source = tmp_path / "capture.zarr"
    for warmer in (0.0, 500.0):  # count
        capture["counts"][..., 5, 7] += warmer
        store.save(capture, source, {})
        sources: dict[str, Callable[[], Any]] = {
            "folder": lambda: source,
            "zarr": lambda: store.open_dataset(source),
            "dask": lambda: dask_backed(source),
            "memory": lambda: capture,
        }
        opened = sources[kind]
        separation.run(opened(), target, RIG.response(), memory=MEMORY)
        made = (target / "zarr.json").stat().st_mtime_ns
        separation.run(opened(), target, RIG.response())
        assert (target / "zarr.json").stat().st_mtime_ns == made
        assert_solved(target, capture, RIG.response())


@pytest.mark.parametrize("rows", [16, 3, (5, 13, 23)], ids=str)
def test_chunks_of_dask_are_read_once(path: Path, tmp_path: Path, rows: Any) -> None:
    """Whatever their rows, each chunk is read for one part alone; but where they are uneven."""
    dask = pytest.importorskip("dask.array", reason="dask is not installed")
    held, read = store.open_dataset(path).load(), []

    def noted(block: Any, block_info: Any = None) -> Any:
        """A chunk, whose first row is noted."""
        if block_info:
            read.append(block_info[0]["array-location"][2][0])
        return block

    lazy = held.chunk({"y": rows})
    lazy["counts"] = lazy["counts"].copy(data=dask.map_blocks(noted, lazy["counts"].data))
    read.clear()
    most = MEMORY + 4 * _run._READ * 41 * 2 * 64 * 24
    separation.run(lazy, tmp_path / "result.zarr", RIG.response(), memory=most)
    assert_solved(tmp_path / "result.zarr", held, RIG.response())
    times = max(np.unique(read, return_counts=True)[1])
    # Twice more for a few pixels: by which the capture is known again, and to check it.
    assert times <= (4 if isinstance(rows, tuple) else 3)


def test_raw_counts_are_corrected_by_rows(tmp_path: Path) -> None:
    """A raw capture on disk, corrected when it is read, is separated as if corrected before."""
    rng, shape = np.random.default_rng(3), (41, 24)
    scene = simulation.walkers(TIME, shape, GLASS, rng, crossings=3)
    detector = simulation.pattern(RIG, shape, rng)
    movies = simulation.blackbody_movies(RIG, np.linspace(275.0, 345.0, 6), 16, detector, rng)
    fitted, response = whole.calibrate(movies)
    seen = simulation.observe(scene, RIG.response(), rng)
    store.save(simulation.capture(seen, detector), tmp_path / "raw.zarr", {})
    raw = store.open_dataset(tmp_path / "raw.zarr")
    corrected = correction.correct_capture(raw, fitted, lazy=True)
    separation.run(corrected, tmp_path / "result.zarr", response, memory=MEMORY)
    assert_solved(tmp_path / "result.zarr", corrected.load(), response)


@pytest.mark.slow
def test_a_cluster_gives_the_same_bytes(path: Path, rest: Path, tmp_path: Path) -> None:
    """Two workers of dask's scheduler, processes both, write the files that one process does."""
    reason = "dask.distributed is not installed: pip install dbthermal[cluster]"
    distributed = pytest.importorskip("distributed", reason=reason)
    with (
        distributed.LocalCluster(2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
        client.get_executor() as two,
    ):
        separation.run(path, tmp_path / "two.zarr", RIG.response(), executor=two, **OPTIONS)
        workers = len(client.scheduler_info()["workers"])
    assert workers == 2
    assert files(tmp_path / "two.zarr") == files(rest)


def test_a_join_that_is_cut_short_loses_nothing(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The parts stay whole until they are joined: started again, no block is separated anew."""
    separation.run(path, tmp_path / "rest.zarr", RIG.response(), **OPTIONS)
    links = iter(range(20))
    link = _datasets._link

    def cut_short(source: Any, target: Any) -> None:
        """Link twenty files, then fail as on a full disk."""
        if next(links, None) is None:
            raise OSError(28, "No space left on device")
        link(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(_datasets, "_link", cut_short)
        with pytest.raises(OSError, match="No space"):
            separation.run(path, tmp_path / "cut.zarr", RIG.response(), **OPTIONS)
    assert not (tmp_path / "cut.zarr").exists()
    monkeypatch.setattr(_run, "_separate_rows", None)
    separation.run(path, tmp_path / "cut.zarr", RIG.response(), **OPTIONS)
    assert files(tmp_path / "cut.zarr") == files(tmp_path / "rest.zarr")


KILLED = """
import sys
from dbthermal import separation, simulation
if __name__ == "__main__":
    separation.run(sys.argv[1], sys.argv[2], simulation.Rig().response(), memory=float(sys.argv[3]))
"""


@pytest.mark.slow
def test_kill_and_restart(path: Path, tmp_path: Path) -> None:
    """Killed at ten random moments and started again, it ends with the bytes of a run at rest."""
    separation.run(path, tmp_path / "rest.zarr", RIG.response(), memory=MEMORY)
    rng, target = np.random.default_rng(5), tmp_path / "killed.zarr"
    command = [sys.executable, "-c", KILLED, str(path), str(target), str(MEMORY)]
    begin = time.monotonic()
    subprocess.run([*command[:4], str(tmp_path / "timed.zarr"), str(MEMORY)], check=True)
    whole, kills = time.monotonic() - begin, 0
    for _ in range(10):
        process = subprocess.Popen(command)
        time.sleep(whole * rng.uniform(0.4, 0.95))
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.wait()
    subprocess.run(command, check=True)
    print(f"{kills} kills")
    assert kills >= 1
    assert files(target) == files(tmp_path / "rest.zarr")


@pytest.mark.filterwarnings("ignore:Invalid samples in all")
def test_parts_of_another_run_are_refused(path: Path, tmp_path: Path) -> None:
    """What a run of other options has left is not taken for this one's."""
    target = tmp_path / "result.zarr"
    mask = xr.DataArray(np.zeros(64, dtype=bool), dims="time")
    parts = Path(f"{target}.parts")
    parts.mkdir()
    (parts / "plan.json").write_text("{}")
    with pytest.raises(ValueError, match=r"Invalid folder .*result\.zarr\.parts.*another"):
        separation.run(path, target, RIG.response(), memory=MEMORY, mask=mask)
