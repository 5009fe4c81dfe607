"""Rates of false alarms and of misses of every flag of a separation, on simulated scenes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import map_coordinates

from dbthermal import correction, separation, simulation
from dbthermal._arrays import Array, Mask
from dbthermal.schema import Status
from reproduction import disturbances, numbers
from reproduction.experiments import cases, limits
from reproduction.experiments.pictures import Picture, smooth_shift

Film = npt.NDArray[Any]
Change = Callable[[Film, Mask, np.random.Generator], None]

FAR: Final = 5.0  # standard deviations of error from which a value is wrong [1]

PICTURED: Final = frozenset({"bad", "lost", "shift", "still"})
"""Keys of scenes that are pictures: shift of the reflections, at its middle and varying by [pixel];
share at rest; share of the samples lost in every second column; and of bad pixels in a band [1]."""

_SHARES: Final = ("without_it", "without_any", "wrong")
_COUNTED: Final = ("pixels", *_SHARES)
# Shares of the samples that are no numbers, and that lie beyond the detector's limit [1].
_INVALID, _CLIPPED = 0.6, 0.1
# Share of the frames that repeat the one before, in runs of so many frames.
_FROZEN, _RUN = 0.3, 10
_HIGHEST: Final = 313.15  # of a response that was calibrated too little [K]
_FLICKER: Final = 2.0  # of an object, standard deviation [K]
_SHAPE: Final = (36, 48)  # of a picture
_MOVING: Final = 0.3  # least standard deviation of a reflection that moves [K]
_KNOWN: Final = 0.03  # deviation of a shift that is known [pixel]
_ITERATIONS: Final = 20


def rates(
    expected: Mapping[str, Sequence[Mapping[str, Any]]],
    clean: Mapping[str, Mapping[str, Any]],
    base: Mapping[str, Any],
    *,
    pixels: int,
    clock: Sequence[float],
    seed: int,
) -> xr.Dataset:
    """Rates of each flag: of false alarms where nothing is wrong, of misses where it should come.

    The flag, in lower case, is `expected` in scenes: what differs from the `base`, the body that
    warms, see `cases.simulate`, or a picture's (`PICTURED`). Where it should come in some pixels
    alone, the others count as false alarms; damaged samples (`FAULTS`) are in every second one. In
    `clean` scenes, by name, none should come. The clock is the number of frames and their rate
    [Hz].

    Over `flag`: `pixels` and `clean_pixels`, in which it should come, and in which none should;
    shares [1]: `false_alarms` of the latter, and of the former `without_it`, `without_any` flag
    and, without any, `wrong`: an object temperature or emissivity beyond `FAR` deviations. The flag
    "any" has the false alarms of all together. NaN where there is no pixel.
    """
    names = [*Status.bits(), "any"]
    counts = xr.Dataset(
        {name: ("flag", np.zeros(len(names))) for name in (*_COUNTED, "clean_pixels", "alarms")},
        coords={"flag": names},
    )
    for scene in clean.values():
        result = _solved({**base, **scene}, "", pixels, clock, seed)[1]
        _count_alarms(counts, result["status"].values)
    for flag, scenes in expected.items():
        for scene in scenes:
            _count_misses(counts, flag, *_solved({**base, **scene}, flag, pixels, clock, seed))
    shares = {name: counts[name] / counts["pixels"].where(counts["pixels"] > 0) for name in _SHARES}
    shares["false_alarms"] = counts["alarms"] / counts["clean_pixels"]
    judged = counts[["pixels", "clean_pixels"]].assign(shares)
    judged = judged.map(lambda rate: rate.assign_attrs(units="1"))
    return judged.assign_attrs(origin="simulated", seed=seed, far=FAR)


def table(rates: xr.Dataset) -> str:
    """Table in Markdown of the `rates` [%] of the flags that should have come somewhere."""
    heads = ("false alarms", "not flagged by it", "by no flag", "by no flag, and wrong")
    rows: list[tuple[str, ...]] = [("flag", "pixels", *heads)]
    for name in rates["flag"].values:
        row = rates.sel(flag=name)
        if row["pixels"] > 0 or name == "any":
            shown = [100.0 * float(row[column]) for column in ("false_alarms", *_SHARES)]
            cells = ["" if np.isnan(share) else f"{share:.2f} %" for share in shown]
            rows.append((f"`{name}`", str(int(row["pixels"])), *cells))
    return numbers.table(rows) + "\n"


def _solved(
    case: Mapping[str, Any], flag: str, pixels: int, clock: Sequence[float], seed: int
) -> tuple[xr.Dataset, xr.Dataset, Mask]:
    """Truth, separation, and pixels (y, x) in which the flag should come, of one scene."""
    rig, time = simulation.Rig(), np.arange(int(clock[0])) / clock[1]
    if PICTURED & case.keys():
        return _pictured(case, flag, rig, time, seed)
    truth, capture, response = cases.simulate(case, rig, time, pixels, seed)
    rng = np.random.default_rng([seed, pixels])
    holds: Mask = np.ones((1, pixels), dtype=bool)
    if flag in FAULTS:
        holds[:, ::2] = False
        counts = capture["counts"].copy(deep=True)
        FAULTS[flag](counts.values, holds, rng)
        capture = capture.assign(counts=counts)
    elif flag == Status.OBJECT_NOT_SMOOTH.label:
        walk = simulation.Background(kind="random walk", correlation_time=1.0, amplitude=_FLICKER)
        flicker = walk.draw(time, pixels, rng)[:, np.newaxis] - walk.level
        warm = truth["object_temperature"]
        truth = truth.assign(object_temperature=warm.copy(data=warm.values + flicker))
        capture = simulation.observe(truth, response, rng)
    elif flag == Status.OUTSIDE_RESPONSE.label:
        response = replace(rig, highest=_HIGHEST).response()
        holds &= truth["object_temperature"].max("time").values > _HIGHEST + 1.0
    return truth, separation.solve(capture, response), holds


def _pictured(
    case: Mapping[str, Any], flag: str, rig: simulation.Rig, time: Array, seed: int
) -> tuple[xr.Dataset, xr.Dataset, Mask]:
    """As `_solved`, of a picture (`PICTURED`)."""
    rng, response, shift = np.random.default_rng(seed), rig.response(), None
    pair = xr.DataArray(case["emissivity"], dims="band", coords={"band": list(rig.bands)})
    if "shift" in case:
        shift = smooth_shift(_SHAPE, *case["shift"])
    drawn = Picture(shape=_SHAPE, still=case.get("still", 0.0)).draw(time, pair, rng, shift)
    capture = simulation.observe(drawn, response, rng)
    if "lost" in case:
        lost = xr.zeros_like(capture["counts"][0], dtype=bool)
        lost.values[...] = rng.random(lost.shape) < case["lost"]
        lost[:, :, ::2] = False
        capture = capture.assign(counts=capture["counts"].where(~lost))
    if "bad" in case:
        capture = disturbances.spoil_pixels(capture, case["bad"], rng)
        spoiled = np.asarray((capture["spoiled"] > 0).any("band"))
        return drawn, separation.solve(correction.mark_bad(capture), response), spoiled
    if shift is None:
        per_pixel = separation.solve(capture, response)
        labels = xr.zeros_like(per_pixel["status"], dtype=int)
        by_material = flag == Status.COMPLETED_FROM_MATERIAL.label
        labelled = (labels, None, None) if by_material else (None, None, pair)
        whole = separation.complete(per_pixel, capture, response, *labelled)
        missing = per_pixel["object_temperature"].isnull()
        by_frames = flag == Status.COMPLETED_FRAMES.label
        holds = missing.any("time") & ~missing.all("time") if by_frames else missing.all("time")
        return drawn, whole, holds.values
    if flag == Status.BANDS_APART.label:
        moving = drawn["background_temperature"].std("time").max("band") > _MOVING
        return drawn, separation.solve(capture, response), moving.values
    dims, units = ("axis", "y", "x"), {"units": "pixel"}
    coords = {"axis": ["y", "x"], "y": capture["y"], "x": capture["x"]}
    field = xr.Dataset({"shift": (dims, shift, units)}, coords)
    field["shift_std"] = (dims, np.full(shift.shape, _KNOWN), units)
    field["known"] = (dims[1:], np.ones(_SHAPE, dtype=bool), {"units": "1"})
    result = separation.solve(capture, response, reflection_shift=field)
    return drawn, result, _unpaired(shift)


def _unpaired(shift: Array) -> Mask:
    """Pixels r (y, x) whose p, with p + d(p) = r, lies outside the image."""
    grid = np.indices(_SHAPE, dtype=np.float64)
    place = grid.copy()
    for _ in range(_ITERATIONS):
        place = grid - [map_coordinates(move, place, order=1, mode="nearest") for move in shift]
    size = np.reshape(_SHAPE, (2, 1, 1))
    return np.asarray(((place < -0.5) | (place > size - 0.5)).any(axis=0))


def _invalid(counts: Film, pixels: Mask, rng: np.random.Generator) -> None:
    """Most samples of a band no numbers."""
    counts[0][(rng.random(counts.shape[1:]) < _INVALID) & pixels] = np.nan


def _constant(counts: Film, pixels: Mask, rng: np.random.Generator) -> None:
    """The signal of a band, drawn for each pixel, the same in all frames."""
    stuck = _in_one_band(counts, pixels, rng)
    counts[...] = np.where(stuck, counts[:, :1], counts)


def _saturated(counts: Film, pixels: Mask, rng: np.random.Generator) -> None:
    """The highest samples of a band, drawn for each pixel, at one level."""
    limit = np.quantile(counts, 1.0 - _CLIPPED, axis=1, keepdims=True)
    clipped = _in_one_band(counts, pixels, rng)
    counts[...] = np.where(clipped, np.minimum(counts, limit), counts)


def _in_one_band(counts: Film, pixels: Mask, rng: np.random.Generator) -> Mask:
    """Samples (band, 1, y, x) of one band, drawn for each of the pixels."""
    chosen = rng.integers(0, len(counts), pixels.shape)
    bands = np.arange(len(counts))[:, np.newaxis, np.newaxis]
    return np.asarray((chosen == bands) & pixels)[:, np.newaxis]


def _frozen(counts: Film, pixels: Mask, rng: np.random.Generator) -> None:
    """Runs of frames in which all bands repeat the frame before."""
    frames = counts.shape[1]
    for start in rng.choice(frames // _RUN, int(_FROZEN * frames / _RUN), replace=False) * _RUN:
        run = counts[:, start : start + _RUN]
        run[...] = np.where(pixels, run[:, :1], run)


FAULTS: Final[Mapping[str, Change]] = {
    Status.INVALID_SAMPLES.label: _invalid,
    Status.CONSTANT_SIGNAL.label: _constant,
    Status.SATURATED.label: _saturated,
    Status.FROZEN_FRAMES.label: _frozen,
}
"""Flag -> what damages the samples of a capture at some pixels (y, x), so that it should come."""


def _count_alarms(counts: xr.Dataset, status: npt.NDArray[np.uint32]) -> None:
    """Add the flags of pixels in which none should come, in place."""
    bits = np.array(list(Status.bits().values()), dtype=status.dtype)
    alarms = ((status.ravel()[:, np.newaxis] & bits) != 0).sum(axis=0)
    counts["alarms"].values += np.append(alarms, np.count_nonzero(status))
    counts["clean_pixels"].values += status.size


def _count_misses(
    counts: xr.Dataset, flag: str, truth: xr.Dataset, result: xr.Dataset, holds: Mask
) -> None:
    """Add the pixels in which a flag should come, and what became of them, in place."""
    status, place = result["status"].values, list(counts["flag"].values).index(flag)
    apart = ~holds & (status & Status.bits()[flag] != 0)
    counts["alarms"].values[place] += np.count_nonzero(apart)
    counts["clean_pixels"].values[place] += np.count_nonzero(~holds)
    none = holds & (status == 0)
    wrong = none & limits.wrong(truth, result, FAR).values
    missed = holds & ((status & Status.bits()[flag]) == 0)
    for name, mask in zip(_COUNTED, (holds, missed, none, wrong), strict=True):
        counts[name].values[place] += np.count_nonzero(mask)
