"""Time and memory on this machine: a table and a figure in results/bench.

First those of the default call, see `default_call`, then those of every method, and those of a run
from disk to disk. Times of one thread are its processor's, the better of two; those of processes
and of the disk are the clock's. What a series would not end within `LONGEST` is left out of it. All
captures are simulated plate glass before which people walk, at `RATE`.
"""

import argparse
import os
import platform
import re
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from dbthermal import separation, simulation, store
from dbthermal.figures import drawing
from reproduction import default_call, experiments, paths, verify
from reproduction import methods as outside
from reproduction.default_call import processor_time

RATE: Final = 10.0  # [Hz]
LONGEST: Final = default_call.SHORT  # [s]
FRAME: Final = 640 * 512  # pixels of a camera
USUAL: Final = {"pixels": 512, "frames": 350, "bands": 2}
SERIES: Final = {
    "pixels": (128, 512, 2048, 8192, 32768, 131072),
    "frames": (100, 300, 1000, 3000, 10000, 30000),
    "bands": (2, 3, 4),
}
# Pixels of the series over frames: a long capture of many would take too long.
FEW: Final = 128
BANDS: Final = ("8-14", "9.5", "10.6", "12.1")
NOISE: Final = (0.03, 0.35, 0.15, 0.4)  # [K]
EMISSIVITY: Final = (0.86, 0.72, 0.88, 0.95)

Times = dict[tuple[str, str], dict[int, float]]
"""By method and size that is varied: seconds of one thread at each size."""


@dataclass(frozen=True)
class Disk:
    """A capture on disk through `separation.run`."""

    samples: int  # pixels times frames
    read_write: float  # reading the capture and writing its result, by one process [s]
    seconds: dict[int, float]  # of so many processes [s]
    peak: float  # memory of a process, of `allowed` [byte]
    allowed: float


@lru_cache
def response(names: tuple[str, ...]) -> xr.Dataset:
    """Response of the rig of these bands; its fit is no part of a separation's time."""
    return simulation.Rig(bands=names, noise=NOISE[: len(names)]).response()


@lru_cache(maxsize=2)
def capture(pixels: int, frames: int, bands: int) -> xr.Dataset:
    """Simulated plate glass of so many pixels; beyond 128 those are repeated in another order."""
    few, rig = min(pixels, 128), simulation.Rig(bands=BANDS[:bands], noise=NOISE[:bands])
    glass: dict[str, Any] = {"emissivity": list(EMISSIVITY[:bands]), "start": 20, "stop": 60}
    row = experiments.simulate(glass, rig, np.arange(frames) / RATE, few, seed=1)[1]
    rng, counts = np.random.default_rng(1), row["counts"].values.reshape(bands, frames, few)
    # Frames as a store gives them: an index of NumPy would leave pixels the slowest axis.
    some = [counts.take(rng.permutation(few), axis=2) for _ in range(pixels // few)]
    movie = np.stack(some, axis=2)
    films = {"counts": (("band", "time", "y", "x"), movie, row["counts"].attrs)}
    return xr.Dataset(films, coords={"band": row["band"], "time": row["time"]})


def solve(movie: xr.Dataset, method: str, settings: Any = None) -> xr.Dataset:
    """Separate by one thread."""
    names = [str(band) for band in movie["band"].values]
    known = xr.DataArray(list(EMISSIVITY[: len(names)]), dims="band", coords={"band": names})
    record = outside.get_method(method)
    emissivity = known if record.knows_emissivity else None
    options: dict[str, Any] = {"emissivity": emissivity, "settings": settings, "workers": 1}
    return separation.solve(movie, response(tuple(names)), record, **options)


def seconds_of(method: str, sizes: dict[str, int]) -> float:
    """Processor time [s] of a separation; the better of two, for the first one may compile."""
    return processor_time(partial(solve, capture(**sizes), method))[0]


def series(method: str, name: str) -> Iterator[tuple[int, float]]:
    """Yield each size and its seconds, as long as the next one is expected to be short."""
    usual = USUAL | ({"pixels": FEW} if name == "frames" else {})
    last = (0, 0.0)
    if name == "bands" and not outside.get_method(method).any_bands:
        return
    for size in SERIES[name]:
        if last[0] and last[1] * size / last[0] > LONGEST:
            return
        last = (size, seconds_of(method, usual | {name: size}))
        yield last


def all_series() -> Times:
    """Seconds of every method over pixels, frames and bands."""
    times: Times = {}
    for method in outside.METHODS:
        solve(capture(**(USUAL | {"pixels": FEW})), method)  # imports and compiles
        for name in SERIES:
            times[method, name] = dict(series(method, name))
            print(method, name, times[method, name], flush=True)
    return times


def a_pixel(times: dict[int, float]) -> float:
    """Seconds a pixel, of the most pixels that were measured."""
    return times[max(times)] / max(times)


def exponent(times: dict[int, float]) -> str:
    """Exponents of power laws through the times of the last two decades of sizes; 1 is linear."""
    found = []
    for decade in (10, 100):
        last = {size: seconds for size, seconds in times.items() if decade * size >= max(times)}
        if len(last) > 1:
            power = np.polyfit(np.log(list(last)), np.log(list(last.values())), 1)[0]
            found.append(f"{power:.2f} ({min(last)} to {max(last)})")
    return ", ".join(dict.fromkeys(found)) or "one size only"


def _ready(_: int) -> None:
    """Import and compile in a process, before its time is taken."""
    solve(capture(**(USUAL | {"pixels": FEW})), "subspace")
    time.sleep(1.0)  # the others are to take one, too


def _run(source: Path, target: Path, processes: int) -> float:
    """Seconds of a run by so many processes that have been started before."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        list(pool.map(_ready, range(processes)))
        start = time.perf_counter()
        separation.run(source, target, simulation.Rig().response(), executor=pool, memory=1e9)
        return time.perf_counter() - start


def _peak(source: Path, target: Path, memory: float) -> float:
    """Peak of the memory [byte] of this process, which separates by two threads."""
    separation.run(source, target, simulation.Rig().response(), memory=memory)
    return default_call.peak_memory()


def full_frame() -> xr.Dataset:
    """Simulated capture of 640x512 pixels, in which a small one is repeated."""
    movie = capture(FRAME, USUAL["frames"], 2)
    films = movie["counts"].values.reshape(2, USUAL["frames"], 512, 640)
    counts = (movie["counts"].dims, films, movie["counts"].attrs)
    return xr.Dataset({"counts": counts}, coords={"band": movie["band"], "time": movie["time"]})


def from_disk(folder: Path) -> Disk:
    """Measure runs from disk to disk: against the disk alone, by processes, and their memory."""
    movie, source = full_frame(), folder / "all.zarr"
    store.save(movie, source, {})
    target, seconds = folder / "result.zarr", {}
    for number in sorted({1, os.cpu_count() or 1}):
        seconds[number] = _run(source, target, number)
        result = store.open_dataset(target).load()
        shutil.rmtree(target)
        print("processes", number, seconds[number], flush=True)
    start = time.perf_counter()
    store.open_dataset(source).load()
    store.save(result, folder / "again.zarr", {})
    read_write = time.perf_counter() - start
    del result
    allowed, samples = 1e9, movie["counts"][0].size
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        peak = fresh.submit(_peak, source, target, allowed).result()
    return Disk(samples, read_write, seconds, peak, allowed)


def machine() -> str:
    """Processor, memory and versions of this machine."""
    model = platform.processor() or platform.machine()
    if (info := Path("/proc/cpuinfo")).exists():
        model = (re.search(r"model name\s*: (.*)", info.read_text()) or [model, model])[1]
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "zarr"))
    return (
        f"{model}, {os.cpu_count()} processors, {memory:.0f} GB; Python "
        f"{platform.python_version()}, {packages}"
    )


MARKS: Final = ("<!-- the default call, by make bench -->", "<!-- end of the default call -->")
"""Marks around the default call's figures in docs/benchmarks.md."""

DEFAULT_CALL: Final = """A simulated plate of glass is heated while people walk by: {rows}x{columns}
pixels, {frames} frames, two bands. `separation.separate` is the default call; `solve` works pixel
by pixel, and for displaced cameras its time does not include the shift of the reflections. Times
are processor times of one thread, after a first call that compiles; errors are medians over the
unflagged pixels. Frames of 640x512 are one capture, timed by the clock, with two threads.

{machine}.
Load average at the start: {busy:.1f}; on a loaded computer, times by the clock are too long.

{table}
"""

HEAD: Final = """# Benchmarks

Made by `make bench` on {machine}.
Load average at the start: {busy:.1f}; on a loaded computer, times by the clock are too long. All
captures are simulated.

## The default call

{default_call}

## Every method

{ratios}

Processor time of one thread, {frames} frames, two bands, the largest number of pixels. Exponents
are those of a power law over the sizes in brackets; small sizes contain a constant part. Series
over frames have {few} pixels, series over bands {pixels}.

{methods}

`subspace`, processor time of a sample of both bands [ns] by the number of frames: {samples}.
"""


def rows(*cells: Sequence[str]) -> str:
    """Table in Markdown of a head and rows."""
    head, *rest = [f"| {' | '.join(row)} |" for row in cells]
    return "\n".join([head, "|---" * len(cells[0]) + "|", *rest])


def default_figures(calls: default_call.Calls, busy: float) -> str:
    """Figures of the default call, in Markdown."""
    height, width = default_call.SHAPE
    size = {"rows": height, "columns": width, "frames": default_call.FRAMES}
    table = rows(*default_call.rows(calls))
    return DEFAULT_CALL.format(**size, machine=machine(), busy=busy, table=table)


def table(default: str, times: Times, disk: Disk, busy: float) -> str:
    """All that was measured, in Markdown: the default call's figures, then ratios first."""
    frames = times["subspace", "frames"]
    return HEAD.format(
        machine=machine(),
        busy=busy,
        default_call=f"{MARKS[0]}\n\n{default}\n{MARKS[1]}",
        few=FEW,
        ratios=rows(("ratio", ""), *ratios(times, disk)),
        methods=methods(times),
        samples=", ".join(f"{n}: {1e9 * s / FEW / n:.0f}" for n, s in frames.items()),
        **USUAL,
    )


def ratios(times: Times, disk: Disk) -> Iterator[tuple[str, str]]:
    """Yield each ratio with its name."""
    one, most = disk.seconds[1], max(disk.seconds)
    speed = disk.samples / disk.seconds[most] / FRAME / 60
    dbvt, subspace = (times[method, "pixels"] for method in ("dbvt", "subspace"))
    sizes = f"{max(dbvt)} over {max(subspace)} pixels"
    yield f"`dbvt` over `subspace`, a pixel, {sizes}", f"{a_pixel(dbvt) / a_pixel(subspace):.0f}"
    disk_to_disk = f"`subspace` from disk to disk, {most} processes, over reading and writing alone"
    yield disk_to_disk, f"{disk.seconds[most] / disk.read_write:.1f}"
    yield "frames of 640x512 from disk to disk over a camera's 60 a second", f"{speed:.2f}"
    yield f"peak memory over `memory={disk.allowed:g}`", f"{disk.peak / disk.allowed:.2f}"
    yield f"rate of {most} processes over one", f"{one / disk.seconds[most]:.2f}"


def methods(times: Times) -> str:
    """Table of the methods' times and exponents."""
    usual = {method: a_pixel(times[method, "pixels"]) for method in outside.METHODS}
    lines = [("method", "us a pixel", "over `subspace`", "pixels", "frames", "3, 4 bands over 2")]
    for method, seconds in usual.items():
        bands = times[method, "bands"]
        pixels, frames = (
            exponent(found) for found in (times[method, "pixels"], times[method, "frames"])
        )
        more = ", ".join(f"{bands[n] / bands[2]:.1f}" for n in sorted(bands) if n > 2) or "none"
        cost, ratio = f"{1e6 * seconds:.0f}", f"{seconds / usual['subspace']:.2g}"
        lines.append((f"`{method}`", cost, ratio, pixels, frames, more))
    return rows(*lines)


def figure(times: Times) -> Figure:
    """Processor time of one thread over pixels and over frames, a line a method."""
    drawn, axes = drawing.canvas(1, 2, (9.0, 3.8))
    for axis, name in zip(axes[0], ("pixels", "frames"), strict=True):
        for number, method in enumerate(outside.METHODS):
            found = times[method, name]
            line = drawing.marked_line(number)
            axis.loglog(list(found), list(found.values()), label=method, **line)
        axis.set_xlabel(f"number of {name}")
        axis.set_ylabel("processor time [s]")
    handles, labels = axes[0, 1].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside right center", frameon=False, fontsize=8)
    drawn.suptitle(f"One thread: {USUAL['frames']} frames, left; {FEW} pixels, right (simulated)")
    return drawn


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and write results/bench/benchmarks.md and .png; the page in docs too, if asked."""
    parser = argparse.ArgumentParser(prog="reproduction.benchmark", description=__doc__)
    parser.add_argument("--default-call", action="store_true", help="measure nothing else")
    parser.add_argument("--write", action="store_true", help="write docs/benchmarks.md, too")
    chosen = parser.parse_args(arguments)
    busy, folder, record = os.getloadavg()[0], paths.results("bench"), store.provenance({})
    folder.mkdir(parents=True, exist_ok=True)
    calls: default_call.Calls = {}
    with TemporaryDirectory(dir=folder) as place:
        for name, call in default_call.measured(Path(place)):
            calls[name] = call
            print(*name, call, flush=True)
    text = default = default_figures(calls, busy)
    page = paths.root() / "docs" / "benchmarks.md"
    if not chosen.default_call:
        times = all_series()
        with TemporaryDirectory(dir=folder) as place:
            disk = from_disk(Path(place))
        text = table(default, times, disk, busy)
        store.save_figure(figure(times), folder / "benchmarks.png", record)
        if chosen.write:
            page.write_text(text, encoding="utf-8")
    store.save_text(text, folder / "benchmarks.md", record)
    if chosen.write:
        old = page.read_text(encoding="utf-8")
        page.write_text(verify.enclosed(old, MARKS, default, page.name), encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
