"""Memory of a whole scene, measured on request: `pytest -m bench`."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from dbthermal import simulation, store
from dbthermal.simulation import Rig
from reproduction.experiments import whole

ROWS, COLUMNS = 512, 640


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
