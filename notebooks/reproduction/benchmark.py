"""Time, accuracy and memory on this machine: tables in results/bench.

First those of the default call, `separation.separate`, and of `solve`: people walk by a plate of
glass that is heated, seen by cameras at one place or displaced. Then the time of every method.
Times of one thread are processor times, the better of two. A series leaves out sizes that would
take longer than `SHORT`. All captures are simulated, at `RATE`.
"""

import argparse
import math
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, TypeVar

import numpy as np
import xarray as xr

from dbthermal import alignment, separation, simulation, store
from reproduction import methods as outside
from reproduction import numbers, paths, verify
from reproduction.experiments import cases
from reproduction.experiments.cases import held, rmse
from reproduction.experiments.pictures import Picture, smooth_shift

T = TypeVar("T")

RATE: Final = 10.0  # [Hz]
SHAPE: Final = (96, 128)
SMALL: Final = (28, 40)  # of the first calls, which compile
WHOLE: Final = (512, 640)  # of a camera
FRAMES: Final = 350
RAPID: Final = (2.0, 6.0)  # time of a rapid rise [s]
CAMERAS: Final[Mapping[str, Mapping[str, Any]]] = {
    "one place": {},
    "displaced": {"shift": (2.4, 1.2)},  # its middle and its variation [pixel]
    "one place, rapid heating": {"rise": RAPID},
    "displaced, rapid heating": {"shift": (2.4, 1.2), "rise": RAPID},
}
"""Scenes by the cameras' places and the object's heating."""

WHOLE_SCENES: Final = ("one place", "displaced")
SHORT: Final = 8.0  # time from which a call is measured once, not twice [s]

LONGEST_WHOLE: Final = 900.0  # time of one thread from which a whole frame is left out [s]

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
class Call:
    """A call on a scene; its object where there is no flag."""

    pixel: float  # time of one thread's processor, a pixel [s]
    rmse: float  # median over the pixels [K]
    cover: float  # share of the samples whose 95 % interval holds the truth [1]
    frame_rate: float = np.nan  # of whole frames, by two threads [Hz]
    peak: float = np.nan  # memory of the process, the capture included [byte]


Calls = dict[tuple[str, str], Call]
"""By function and scene."""


def scene(cameras: str, shape: tuple[int, int], frames: int = FRAMES) -> xr.Dataset:
    """Truth, and the `counts` that the cameras see of it."""
    rng, rig, options = np.random.default_rng(3), simulation.Rig(), CAMERAS[cameras]
    shift = smooth_shift(shape, *options["shift"]) if "shift" in options else None
    glass = xr.DataArray(list(EMISSIVITY[:2]), {"band": list(rig.bands)}, "band")
    picture = Picture(shape, walkers=7, rise=options.get("rise"))
    truth = picture.draw(np.arange(frames) / RATE, glass, rng, shift)
    return truth.assign(counts=simulation.observe(truth, rig.response(), rng)["counts"])


def separate(counts: xr.DataArray, workers: int = 1) -> xr.Dataset:
    """Separate by the default call."""
    return separation.separate(counts.to_dataset(), response(), workers=workers)


def solver(counts: xr.DataArray, cameras: str) -> Callable[[], xr.Dataset]:
    """Call of `solve`, for displaced cameras with a reflection shift that was found before."""
    capture, apart = counts.to_dataset(), "shift" in CAMERAS[cameras]
    shift = alignment.reflection_shift(capture, response()) if apart else None
    return partial(separation.solve, capture, response(), reflection_shift=shift, workers=1)


def processor_time(call: Callable[[], T]) -> tuple[float, T]:
    """Processor time of a call [s], the better of two unless it is long, and its result."""
    taken: list[float] = []
    while not taken or (len(taken) < 2 and taken[0] < SHORT):
        start = time.process_time()
        result = call()
        taken.append(time.process_time() - start)
    return min(taken), result


def judged(truth: xr.Dataset, seconds: float, result: xr.Dataset) -> Call:
    """Time and accuracy of a result."""
    name = "object_temperature"
    error = (result[name] - truth[name]).where(result["status"] == 0)
    cover = held(error, result[f"{name}_std"])
    return Call(seconds / result["status"].size, float(rmse(error)), float(cover))


def measured(
    folder: Path, shape: tuple[int, int] = SHAPE
) -> Iterator[tuple[tuple[str, str], Call]]:
    """Yield the default call on each scene, then `solve`; whole frames by files in a folder."""
    solved = {}
    for cameras in CAMERAS:
        few = scene(cameras, SMALL)["counts"]
        separate(few)  # imports and compiles
        solver(few, cameras)()
        truth = scene(cameras, shape)
        call = judged(truth, *processor_time(partial(separate, truth["counts"])))
        solved[cameras] = judged(truth, *processor_time(solver(truth["counts"], cameras)))
        if cameras in WHOLE_SCENES and call.pixel * math.prod(WHOLE) < LONGEST_WHOLE:
            seconds, peak = whole_frame(cameras, folder / f"{cameras}.zarr")
            call = replace(call, frame_rate=FRAMES / seconds, peak=peak)
        yield ("separate", cameras), call
    yield from ((("solve", cameras), call) for cameras, call in solved.items())


def whole_frame(cameras: str, path: Path) -> tuple[float, float]:
    """Seconds of the default call on a whole frame, by two threads, and peak of the memory [byte].

    In a process of its own, which holds the capture; another one draws it.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        fresh.submit(_draw, cameras, path).result()
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
        return fresh.submit(_separate, path).result()


def _draw(cameras: str, path: Path) -> None:
    """Draw and save a capture of a whole frame."""
    store.save(scene(cameras, WHOLE)[["counts"]], path, {})


def _separate(path: Path) -> tuple[float, float]:
    """Clock time [s] of the default call on a capture, after a small one, and memory [byte]."""
    counts = store.open_dataset(path)["counts"].load()
    separate(counts.isel(y=slice(SMALL[0]), x=slice(SMALL[1])))
    start = time.perf_counter()
    separate(counts, workers=2)
    return time.perf_counter() - start, peak_memory()


def peak_memory() -> float:
    """Peak of the memory of this process [byte]."""
    line = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    return 1024.0 * float(line[1]) if line else float("nan")


def default_rows(calls: Calls) -> Iterator[tuple[str, ...]]:
    """Yield the head of a table and a row for each call; whole frames only if measured."""
    whole = any(np.isfinite(call.frame_rate) for call in calls.values())
    measured_heads = ("frames/s, measured by wall clock", "peak memory") if whole else ()
    times = ("µs per pixel", "frames/s, computed", *measured_heads)
    yield ("call", "cameras", *times, "error", "95 % intervals that contain the truth")
    for (function, cameras), call in calls.items():
        rate = 2 * FRAMES / (call.pixel * math.prod(WHOLE))
        cells = [f"{call.frame_rate:.2g}", f"{1e-9 * call.peak:.1f} GB"] if whole else []
        if not np.isfinite(call.frame_rate):
            cells = [""] * len(cells)
        errors = (f"{call.rmse:.3f} K", f"{100 * call.cover:.1f} %")
        yield (f"`{function}`", cameras, f"{1e6 * call.pixel:.0f}", f"{rate:.2g}", *cells, *errors)


@lru_cache
def response(names: tuple[str, ...] = BANDS[:2]) -> xr.Dataset:
    """Response of the rig of these bands; its fit is no part of a separation's time."""
    return simulation.Rig(bands=names, noise=NOISE[: len(names)]).response()


@lru_cache(maxsize=2)
def capture(pixels: int, frames: int, bands: int) -> xr.Dataset:
    """Simulated plate glass of so many pixels; beyond 128 those are repeated in another order."""
    few, rig = min(pixels, 128), simulation.Rig(bands=BANDS[:bands], noise=NOISE[:bands])
    glass: dict[str, Any] = {"emissivity": list(EMISSIVITY[:bands]), "start": 20, "stop": 60}
    row = cases.simulate(glass, rig, np.arange(frames) / RATE, few, seed=1)[1]
    rng, counts = np.random.default_rng(1), row["counts"].values.reshape(bands, frames, few)
    # Frames as a store gives them: an index of NumPy would leave pixels the slowest axis.
    copies = [counts.take(rng.permutation(few), axis=2) for _ in range(pixels // few)]
    movie = np.stack(copies, axis=2)
    films = {"counts": (("band", "time", "y", "x"), movie, row["counts"].attrs)}
    return xr.Dataset(films, coords={"band": row["band"], "time": row["time"]})


def solve(movie: xr.Dataset, method: str) -> xr.Dataset:
    """Separate by one thread."""
    names = [str(band) for band in movie["band"].values]
    emissivities = xr.DataArray(list(EMISSIVITY[: len(names)]), dims="band", coords={"band": names})
    record = outside.get_method(method)
    emissivity = emissivities if record.knows_emissivity else None
    return separation.solve(movie, response(tuple(names)), record, emissivity=emissivity, workers=1)


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
        if last[0] and last[1] * size / last[0] > SHORT:
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

DEFAULT_CALL: Final = """The scene is a plate of glass that is heated while people walk by:
{rows}x{columns} pixels, {frames} frames, two bands. `separation.separate` is the default call;
`solve` separates pixel by pixel. For "displaced" cameras, which see a reflection in different
pixels, `solve` couples neighbouring pixels, which takes time and reduces the error; its time does
not include the search for the reflection shift.

The first call, which compiles, is not counted. Time per pixel is processor time of one thread.
Frames per second are computed from this time, for two cores and 640x512 pixels. "Error" is that of
the object temperature (RMSE of a pixel, median over the unflagged pixels). The last column is the
share of the 95 % intervals that contain the true temperature. Load average at the start:
{busy:.1f}.

{table}
"""

HEAD: Final = """# Benchmarks

Processor time and accuracy, measured by `make bench` on simulated captures. The computer:
{machine}.

## The default call

{default_call}

## Every method

Processor time of one thread, for {frames} frames of two bands. Column "pixels": as many as the
method separates in less than {longest:.0f} s. `subspace` is the method of `solve`. Its time per
pixel falls with the number of pixels, and is longer in the table above ({scene} pixels). Times
for 3 and for 4 bands are multiples of the time for two bands, with {pixels} pixels; "none": the
method takes two bands only. Load average at the start: {busy:.1f}.

{methods}
"""


def default_figures(calls: Calls, busy: float) -> str:
    """Figures of the default call, in Markdown."""
    height, width = SHAPE
    size = {"rows": height, "columns": width, "frames": FRAMES}
    rows = numbers.table(default_rows(calls))
    return DEFAULT_CALL.format(**size, busy=busy, table=rows)


def table(default: str, times: Times, busy: float) -> str:
    """All that was measured, in Markdown: the default call's figures first."""
    enclosed = f"{MARKS[0]}\n\n{default}\n{MARKS[1]}"
    text = {"machine": machine(), "default_call": enclosed, "methods": methods(times)}
    return HEAD.format(busy=busy, longest=SHORT, scene=math.prod(SHAPE), **text, **USUAL)


def methods(times: Times) -> str:
    """Table of the methods' times by pixel and by band, and a line by the number of frames."""
    head = ("method", "µs per pixel", "relative to `subspace`", "pixels", "3, 4 bands")
    lines: list[tuple[str, ...]] = [head]
    of_pixels = {method: times[method, "pixels"] for method in outside.METHODS}
    cost = {method: taken[max(taken)] / max(taken) for method, taken in of_pixels.items()}
    for method, seconds in cost.items():
        bands, size = times[method, "bands"], str(max(of_pixels[method]))
        more = ", ".join(f"{bands[n] / bands[2]:.1f}" for n in sorted(bands) if n > 2) or "none"
        relative = format(float(f"{seconds / cost['subspace']:.2g}"), "g")
        lines.append((f"`{method}`", f"{1e6 * seconds:.0f}", relative, size, more))
    samples = times["subspace", "frames"].items()
    return (
        f"{numbers.table(lines)}\n\nProcessor time of `subspace` in ns per sample (both bands of a "
        f"pixel in a frame), for {FEW} pixels, by the number of frames: "
        + ", ".join(f"{n}: {1e9 * seconds / n / FEW:.0f}" for n, seconds in samples)
        + "."
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and write results/bench/benchmarks.md; the page in docs too, if asked."""
    parser = argparse.ArgumentParser(prog="reproduction.benchmark", description=__doc__)
    parser.add_argument("--default-call", action="store_true", help="measure nothing else")
    parser.add_argument("--write", action="store_true", help="write docs/benchmarks.md, too")
    chosen = parser.parse_args(arguments)
    page = paths.root() / "docs" / "benchmarks.md"
    if chosen.default_call and chosen.write and machine() not in page.read_text(encoding="utf-8"):
        parser.error("The page is of another computer or version. Must be measured as a whole.")
    busy, folder, record = os.getloadavg()[0], paths.results("bench"), store.provenance({})
    folder.mkdir(parents=True, exist_ok=True)
    calls: Calls = {}
    with TemporaryDirectory(dir=folder) as place:
        for name, call in measured(Path(place)):
            calls[name] = call
            print(*name, call, flush=True)
    text = default = default_figures(calls, busy)
    if not chosen.default_call:
        text = table(default, all_series(), busy)
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
