"""Time, accuracy and memory of the default call, `separation.separate`, and of `solve` beside it.

People walk by a plate of glass that is heated, before cameras at one place or apart; simulated.
"""

import math
import re
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
import xarray as xr

from dbthermal import alignment, separation, simulation, store
from reproduction.experiments.pictures import Picture, smooth_shift
from reproduction.experiments.scores import held, rmse

T = TypeVar("T")

SHAPE: Final = (96, 128)
SMALL: Final = (28, 40)  # of the first calls, which compile
WHOLE: Final = (512, 640)  # of a camera
FRAMES: Final = 350
RATE: Final = 10.0  # [Hz]
EMISSIVITY: Final = (0.86, 0.72)
RAPID: Final = (2.0, 6.0)  # time of a rapid rise [s]
CAMERAS: Final[Mapping[str, Mapping[str, Any]]] = {
    "one place": {},
    "apart": {"shift": (2.4, 1.2)},  # its middle and its variation [pixel]
    "one place, rapid heating": {"rise": RAPID},
    "apart, rapid heating": {"shift": (2.4, 1.2), "rise": RAPID},
}
"""Scenes by the cameras' places and the object's heating."""

WHOLE_SCENES: Final = ("one place", "apart")
SHORT: Final = 8.0
"""Time from which a call is measured once, not twice [s]."""

LONGEST: Final = 900.0
"""Time of one thread from which a whole frame is left out [s]."""


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
    glass = xr.DataArray(list(EMISSIVITY), {"band": list(rig.bands)}, "band")
    picture = Picture(shape, walkers=7, rise=options.get("rise"))
    truth = picture.draw(np.arange(frames) / RATE, glass, rng, shift)
    return truth.assign(counts=simulation.observe(truth, rig.response(), rng)["counts"])


def separate(counts: xr.DataArray, workers: int = 1) -> xr.Dataset:
    """Separate by the default call."""
    return separation.separate(counts.to_dataset(), simulation.Rig().response(), workers=workers)


def solver(counts: xr.DataArray, cameras: str) -> Callable[[], xr.Dataset]:
    """Call of `solve`, before cameras apart with the shift of the reflections found beforehand."""
    capture, response = counts.to_dataset(), simulation.Rig().response()
    apart = "shift" in CAMERAS[cameras]
    shift = alignment.reflection_shift(capture, response) if apart else None
    return partial(separation.solve, capture, response, reflection_shift=shift, workers=1)


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
        if cameras in WHOLE_SCENES and call.pixel * math.prod(WHOLE) < LONGEST:
            seconds, peak = whole_frame(cameras, folder / f"{cameras}.zarr")
            call = replace(call, frame_rate=FRAMES / seconds, peak=peak)
        yield ("separate", cameras), call
    yield from ((("solve", cameras), call) for cameras, call in solved.items())


def whole_frame(cameras: str, path: Path) -> tuple[float, float]:
    """Seconds of the default call on a whole frame, by two threads, and peak of the memory [byte].

    In a process of its own, which holds the capture; another one draws it.
    """
    found = (0.0, 0.0)
    for step in (partial(_draw, cameras, path), partial(_separate, path)):
        with ProcessPoolExecutor(1, get_context("spawn")) as fresh:
            found = fresh.submit(step).result()
    return found


def _draw(cameras: str, path: Path) -> tuple[float, float]:
    """Draw and save a capture of a whole frame."""
    store.save(scene(cameras, WHOLE)[["counts"]], path, {})
    return (0.0, 0.0)


def _separate(path: Path) -> tuple[float, float]:
    """Clock time [s] of the default call on a capture, after a small one, and memory [byte]."""
    counts = store.open_dataset(path)["counts"].load()
    separate(counts.isel(y=slice(SMALL[0]), x=slice(SMALL[1])))
    start = time.perf_counter()
    separate(counts, workers=2)
    return time.perf_counter() - start, peak_memory()


def peak_memory() -> float:
    """Peak of the memory of this process [byte]."""
    found = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    return 1024.0 * float(found[1]) if found else float("nan")


def rows(calls: Calls) -> Iterator[tuple[str, ...]]:
    """Yield the head of a table and a row for each call."""
    yield (
        "call",
        "cameras",
        "us a pixel",
        "frames/s of 640x512, two cores, from it",
        "measured",
        "peak memory",
        "error",
        "95 % intervals",
    )
    for (function, cameras), call in calls.items():
        rate = 2 * FRAMES / (call.pixel * math.prod(WHOLE))
        whole = np.isfinite(call.frame_rate)
        yield (
            f"`{function}`",
            cameras,
            f"{1e6 * call.pixel:.0f}",
            f"{rate:.2g}",
            f"{call.frame_rate:.2g}" if whole else "",
            f"{1e-9 * call.peak:.1f} GB" if whole else "",
            f"{call.rmse:.3f} K",
            f"{100 * call.cover:.1f} %",
        )
