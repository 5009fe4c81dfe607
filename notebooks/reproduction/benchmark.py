"""Time and memory on this machine: tables in results/bench.

First those of the default call, see `default_call`, then the time of every method. Times of one
thread are its processor's, the better of two. What a series would not end within `LONGEST` is left
out of it. All captures are simulated plate glass before which people walk, at `RATE`.
"""

import argparse
import os
import platform
import re
import sys
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import separation, simulation, store
from reproduction import default_call, experiments, paths, verify
from reproduction import methods as outside
from reproduction.default_call import processor_time

RATE: Final = 10.0  # [Hz]
LONGEST: Final = default_call.SHORT  # [s]
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


def solve(movie: xr.Dataset, method: str) -> xr.Dataset:
    """Separate by one thread."""
    names = [str(band) for band in movie["band"].values]
    known = xr.DataArray(list(EMISSIVITY[: len(names)]), dims="band", coords={"band": names})
    record = outside.get_method(method)
    emissivity = known if record.knows_emissivity else None
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
Load average at the start: {busy:.1f}. All captures are simulated.

## The default call

{default_call}

## Every method

Processor time of one thread, {frames} frames, two bands, the largest number of pixels that takes
less than {longest:.0f} s. A sample: of the shortest and of the longest capture, of {few} pixels.
Bands: of {pixels} pixels, over the time of two.

{methods}
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


def table(default: str, times: Times, busy: float) -> str:
    """All that was measured, in Markdown: the default call's figures first."""
    enclosed = f"{MARKS[0]}\n\n{default}\n{MARKS[1]}"
    text = {"machine": machine(), "default_call": enclosed, "methods": methods(times)}
    return HEAD.format(busy=busy, longest=LONGEST, few=FEW, **text, **USUAL)


def methods(times: Times) -> str:
    """Table of the methods' times, by pixel, by sample and by band."""
    heads = ("method", "us a pixel", "over `subspace`", "of pixels", "ns a sample", "of frames")
    lines: list[tuple[str, ...]] = [(*heads, "3, 4 bands over 2")]
    of_pixels = {method: times[method, "pixels"] for method in outside.METHODS}
    cost = {method: found[max(found)] / max(found) for method, found in of_pixels.items()}
    for method, seconds in cost.items():
        frames, bands = times[method, "frames"], times[method, "bands"]
        ends = [min(frames), max(frames)]
        samples = " to ".join(f"{1e9 * frames[n] / n / FEW:.0f}" for n in ends)
        more = ", ".join(f"{bands[n] / bands[2]:.1f}" for n in sorted(bands) if n > 2) or "none"
        size, span = str(max(of_pixels[method])), " to ".join(map(str, ends))
        of_pixel = (f"{1e6 * seconds:.0f}", f"{seconds / cost['subspace']:.2g}", size)
        lines.append((f"`{method}`", *of_pixel, samples, span, more))
    return rows(*lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and write results/bench/benchmarks.md; the page in docs too, if asked."""
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
