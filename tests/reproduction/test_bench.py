"""Time and memory, measured on request: `make bench`."""

import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dbthermal import separation, simulation, store
from dbthermal.simulation import Rig
from reproduction import experiments
from reproduction.experiments import whole

ROWS, COLUMNS, FRAMES = 512, 640, 350
UNIT = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss, per MiB


def peak_memory() -> float:
    """Largest resident memory of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / UNIT


@pytest.fixture(scope="module")
def capture() -> xr.Dataset:
    """A full frame of plate glass: one simulated row of pixels, shuffled anew for each row."""
    case = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
    rig, clock = Rig(), np.arange(FRAMES) / 10.0
    scene, _ = experiments.run_case(case, rig, clock, COLUMNS, seed=1)
    row = simulation.observe(scene, rig.response(), np.random.default_rng(1))
    movie = np.empty((2, FRAMES, ROWS, COLUMNS), dtype=np.float32)
    for index in range(ROWS):
        order = np.random.default_rng(index).permutation(COLUMNS)
        movie[:, :, index] = row["counts"].values[:, :, 0, order]
    return xr.Dataset(
        {"counts": (("band", "time", "y", "x"), movie, {"units": "count"})},
        coords={"band": list(rig.bands), "time": clock},
    )


@pytest.mark.bench
def test_full_frame(capture: xr.Dataset) -> None:
    """640 x 512 pixels x 350 frames in under 30 s on two cores, in less than three captures."""
    response = Rig().response().drop_vars(["noise", "netd"])
    before, start = peak_memory(), time.perf_counter()
    result = separation.solve(capture, response, workers=2)
    seconds, added = time.perf_counter() - start, peak_memory() - before
    size = capture["counts"].nbytes / 2**20
    print(
        f"\n{COLUMNS}x{ROWS}x{FRAMES}, noise unknown: {seconds:.1f} s, capture "
        f"{size:.0f} MiB, result {result.nbytes / 2**20:.0f} MiB, peak memory added "
        f"{added:.0f} MiB = {added / size:.2f} captures"
    )
    assert float((result["status"] == 0).mean()) > 0.95
    assert seconds < 30
    assert added < 3 * size


FROM_DISK = """
import re, sys, time
from pathlib import Path
from dbthermal import separation, store
from dbthermal.simulation import Rig
capture, response = store.open_dataset(sys.argv[1]), Rig().response()
start = time.perf_counter()
separation.solve(capture, response, workers=2)
seconds = time.perf_counter() - start
# Not ru_maxrss: a child starts with its parent's.
print(seconds, re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.bench
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from /proc")
def test_full_frame_from_disk(capture: xr.Dataset, tmp_path: Path) -> None:
    """Read from disk block by block, the whole process takes less than three captures."""
    path = tmp_path / "capture.zarr"
    store.save(capture, path, store.provenance({}))
    command = [sys.executable, "-c", FROM_DISK, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, peak = (float(number) for number in done.stdout.split())
    copies = peak / 2**10 / (capture["counts"].nbytes / 2**20)
    print(f"\nfrom disk: {seconds:.1f} s, whole process {copies:.2f} captures")
    assert copies < 3


WHOLE = """
import re, sys, time
from pathlib import Path
import numpy as np, xarray as xr
from dbthermal import scene, store
folder = Path(sys.argv[1])
correction, response = (
    store.open_dataset(folder / f"{name}.zarr").load() for name in ("correction", "response")
)
raw = np.load(folder / "raw.npy", mmap_mode="r")
capture = xr.Dataset(
    {"counts": (("band", "time", "y", "x"), raw)},
    {"band": response["band"], "time": ("time", np.arange(raw.shape[1]) / 60.0)},
)
options = {"registration": None, "aligning": {"offset": 0.0}, "target": folder / "result.zarr"}
start = time.perf_counter()
result = scene.separate_capture(capture, correction, response, **options)
seconds = time.perf_counter() - start
peak = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]
print(seconds, peak, float((result["status"] == 0).mean()))
"""


@pytest.mark.bench
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the peak from /proc")
def test_whole_scene_from_raw_counts(tmp_path: Path) -> None:
    """35 s of 640 x 512 pixels in two bands at 60 Hz, from raw counts, in at most 6 GB."""
    rig, rng, tile, frames = Rig(), np.random.default_rng(1), (64, 80), 2100
    times = (1, 1, ROWS // tile[0], COLUMNS // tile[1])
    glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    scene = simulation.walkers(np.arange(frames) / 60.0, tile, glass, rng)
    detector = simulation.pattern(rig, tile, rng)
    small = simulation.capture(simulation.observe(scene, rig.response(), rng), detector)["counts"]
    shape = (2, frames, ROWS, COLUMNS)
    raw = np.lib.format.open_memmap(tmp_path / "raw.npy", "w+", np.uint16, shape)
    for movie, part in zip(raw, small.values, strict=True):
        movie[...] = np.tile(part, times[1:])
    raw.flush()
    movies = simulation.blackbody_movies(rig, np.linspace(275.0, 345.0, 9), 16, detector, rng)
    correction, response = whole.calibrate(movies)
    maps = ("gain", "offset", "bad")
    tiled = {name: (("band", "y", "x"), np.tile(correction[name], times[1:])) for name in maps}
    store.save(correction.drop_vars(maps).assign(tiled), tmp_path / "correction.zarr", {})
    store.save(response, tmp_path / "response.zarr", {})
    command = [sys.executable, "-c", WHOLE, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    seconds, peak, good = (float(number) for number in done.stdout.split())
    print(f"\nwhole scene: {seconds:.0f} s, {peak / 1e6:.2f} GB at most, {good:.1%} without a flag")
    assert peak < 6e6  # [kB]


@pytest.mark.bench
def test_other_methods() -> None:
    """The other methods' time a pixel and core, 512 pixels of plate glass."""
    case = {"emissivity": [0.86, 0.72], "start": 20, "stop": 60}
    scene, _ = experiments.run_case(case, Rig(), np.arange(FRAMES) / 10.0, 512, seed=1)
    response = Rig().response()
    capture = simulation.observe(scene, response, np.random.default_rng(1))
    print()
    for method in ("subspace", "dbvt", "naive", "ratio", "bcp"):
        seconds = []
        for _ in range(2):  # the first imports what the method needs
            start = time.perf_counter()
            separation.solve(capture, response, method, workers=1)
            seconds.append(time.perf_counter() - start)
        print(f"{method}: {1e3 * seconds[-1] / 512:.3g} ms a pixel")
        assert seconds[-1] < 60
