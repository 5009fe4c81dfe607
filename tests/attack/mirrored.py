"""Hostile arguments beside a capture: the reflections' shift, and what completes a result."""

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.arrays import FLOOR, Rng, judge, response_of
from attack.oracle import Attack, Verdict
from attack.scenes import SLOPE, Scene, clock, counts_of, pick
from attack.stages import wrong
from dbthermal import separation
from reproduction.experiments.pictures import Picture, smooth_shift

GLASS: Final = np.array([0.86, 0.72])
COMPLETED: Final = sum(1 << bit for bit in (16, 17, 18, 19))
"""Bits of the status that tell completed from measured."""


@cache
def _picture(
    seed: int, shift: float, still: float = 0.0, shape: tuple[int, int] = (36, 48)
) -> tuple[Scene, xr.Dataset]:
    """People mirrored in glass, seen by cameras apart, and the true shift of the reflections."""
    rng, time, bands = np.random.default_rng(seed), clock(110), ("8-14", "9.5")
    noise = SLOPE * np.array([0.03, 0.35])
    field = smooth_shift(shape, shift, 0.2 * shift)
    pair = xr.DataArray(GLASS, dims="band", coords={"band": list(bands)})
    drawn = Picture(shape=shape, walkers=7, still=still).draw(time, pair, rng, field)
    warm, cold = (drawn[f"{who}_temperature"].values for who in ("object", "background"))
    counts = [
        share * counts_of(band, warm) + (1 - share) * counts_of(band, part)
        for band, share, part in zip(bands, GLASS, cold, strict=True)
    ]
    counts += noise[:, None, None, None] * rng.standard_normal((2, *warm.shape))
    emissivity = np.broadcast_to(GLASS[:, None, None], (2, *shape)).copy()
    made = Scene(bands, time, warm, cold[0], emissivity, noise)
    place = {"y": np.arange(shape[0]) + 3.0, "x": np.arange(shape[1]) + 7.0}
    film = (("band", "time", "y", "x"), np.asarray(counts, np.float32), {"units": "count"})
    coordinates = {"band": list(bands), "time": ("time", time, {"units": "s"}), **place}
    made.capture = xr.Dataset({"counts": film}, coordinates, {"origin": "simulated"})
    pixel = {"units": "pixel"}
    parts = {
        "shift": (("axis", "y", "x"), field.astype(np.float32), pixel),
        "shift_std": (("axis", "y", "x"), np.full(field.shape, 0.03, np.float32), pixel),
        "known": (("y", "x"), np.ones(shape, bool), {"units": "1"}),
    }
    attrs = {"reference_band": "8-14", "bands": ["9.5"]}
    return made, xr.Dataset(parts, {"axis": ["y", "x"], **place}, attrs)


def _with(field: xr.Dataset, name: str, change: Callable[[Any], Any]) -> xr.Dataset:
    """The field with the values of a variable changed."""
    values = change(field[name].values.copy())
    return field.assign({name: (field[name].dims, values, field[name].attrs)})


def _patch(value: float) -> Callable[[Any], Any]:
    """A patch of other values."""

    def change(values: Any) -> Any:
        values[..., 10:20, 15:30] = value
        return values

    return change


_FIELDS: Final[Mapping[str, Callable[[Rng, xr.Dataset], Any]]] = {
    "nothing": lambda _, one: one,
    "of another size": lambda _, one: one.isel(x=slice(0, 30)),
    "of another window": lambda _, one: one.assign_coords(x=one["x"] + 2),
    "of other bands": lambda _, one: one.assign_attrs(bands=["10.6"]),
    "of another reference": lambda _, one: one.assign_attrs(reference_band="9.5", bands=["8-14"]),
    "beyond the image": lambda _, one: one.assign(shift=one["shift"] * 40),
    "NaN where known": lambda _, one: _with(one, "shift", _patch(np.nan)),
    "infinite": lambda _, one: _with(one, "shift", _patch(np.inf)),
    "all NaN": lambda _, one: _with(one, "shift", lambda v: v * np.nan),
    "a hole": lambda _, one: _with(_with(one, "shift", _patch(np.nan)), "known", _patch(0)),
    "noisy": lambda rng, one: _with(one, "shift", lambda v: v + rng.normal(0, 3, v.shape)),
    "a step": lambda _, one: _with(one, "shift", _patch(9.0)),
    "without deviation": lambda _, one: one.drop_vars("shift_std"),
    "deviation negative": lambda _, one: _with(one, "shift_std", _patch(-1.0)),
    "deviation NaN": lambda _, one: _with(one, "shift_std", _patch(np.nan)),
    "axes turned": lambda _, one: one.isel(axis=[1, 0]),
    "axes unnamed": lambda _, one: one.drop_vars("axis"),
    "transposed": lambda _, one: one.transpose(),
    "of another unit": lambda _, one: one.assign(shift=one["shift"].assign_attrs(units="m")),
    "text": lambda _, one: one.assign(shift=one["shift"].astype(str)),
    "an array": lambda _, one: one["shift"],
    "a number": lambda rng, _: float(rng.normal()),
    "turned round": lambda _, one: one.assign(shift=-one["shift"]),
}


def shifts(rng: Rng) -> Attack:
    """`solve` with a field of the reflections' shift that is damaged in each of its parts."""
    made, field = _picture(int(rng.integers(1, 4)), 2.4, shape=(20, 32))
    what = pick(rng, sorted(_FIELDS))
    spoilt, response = _FIELDS[what](rng, field), response_of(made)
    method = pick(rng, ["subspace"] * 5 + ["apparent"])

    def act() -> Any:
        return separation.solve(made.capture, response, method, reflection_shift=spoilt)

    names = ("shift|axis|known|band|pixel|reflection_shift|dims|coordinate|'x'",)
    limit = "a wrong shift is not seen everywhere" if what in ("a step", "turned round") else ""
    good = what == "nothing" and method == "subspace"
    return Attack(f"shift {what}", act, lambda found: judge(made, found), names, good, limit)


@cache
def _incomplete(seed: int) -> tuple[Scene, dict[str, Any]]:
    """A scene half at rest, with the arguments that complete its separation."""
    made, _ = _picture(seed, 0.0, 0.5)
    response = response_of(made)
    result = separation.solve(made.capture, response)
    labels = xr.zeros_like(made.capture["counts"][0, 0], dtype=int).drop_vars(["band", "time"])
    pair = xr.DataArray(GLASS, dims="band", coords={"band": list(made.bands)})
    given = {"result": result, "corrected": made.capture, "response": response}
    return made, {**given, "materials": labels, "surroundings": 295.15, "prior": pair}


def _mirrored(result: xr.Dataset) -> xr.Dataset:
    return result.isel(x=slice(None, None, -1)).assign_coords(x=result["x"])


_ARGUMENTS: Final[Mapping[str, tuple[str, Callable[[Any], Any]]]] = {
    "nothing": ("prior", lambda one: one),
    "no prior": ("prior", lambda _: None),
    "a prior of 1.2": ("prior", lambda one: one + 0.4),
    "a prior NaN": ("prior", lambda one: one.where(one > 0.8)),
    "a prior of other bands": ("prior", lambda one: one.assign_coords(band=["a", "b"])),
    "an unknown material": ("prior", lambda _: "unobtainium"),
    "a prior without dims": ("prior", lambda one: one[0]),
    "a prior that is text": ("prior", lambda one: one.astype(str)),
    "degrees Celsius": ("surroundings", lambda _: 22.0),
    "surroundings NaN": ("surroundings", lambda _: np.nan),
    "surroundings infinite": ("surroundings", lambda _: np.inf),
    "surroundings in text": ("surroundings", lambda _: "room"),
    "surroundings over time": ("surroundings", lambda _: xr.DataArray(np.full(5, 295.0), dims="t")),
    "labels of another shape": ("materials", lambda one: one.isel(x=slice(0, 9))),
    "labels of another window": ("materials", lambda one: one.assign_coords(x=one["x"] + 4)),
    "labels in float": ("materials", lambda one: one + 0.5),
    "a result of another window": ("result", lambda one: one.assign_coords(y=one["y"] + 4)),
    "a result of another size": ("result", lambda one: one.isel(y=slice(0, 9))),
    "a result of other frames": ("result", lambda one: one.isel(time=slice(20, None))),
    "a result of other bands": ("result", lambda one: one.assign_coords(band=["a", "b"])),
    "a result of another scene": ("result", _mirrored),
    "a result without values": ("result", lambda one: one.where(False)),
    "a result without status": ("result", lambda one: one.drop_vars("status")),
    "raw counts": ("corrected", lambda one: one.round().astype("uint16")),
    "another response": ("response", lambda one: one.isel(band=[0])),
    "no response": ("response", lambda _: None),
}


def completions(rng: Rng) -> Attack:
    """`complete` with one argument damaged: never a completed value that passes as measured."""
    made, given = _incomplete(int(rng.integers(1, 4)))
    what = pick(rng, sorted(_ARGUMENTS))
    name, change = _ARGUMENTS[what]
    arguments = {**given, name: change(given[name])}
    result = arguments["result"]

    def check(found: xr.Dataset) -> Verdict:
        before, after = (one["object_temperature"].values for one in (result, found))
        had, has = np.isfinite(before), np.isfinite(after)
        marked = (found["status"].values & COMPLETED) != 0
        if np.any((before != after) & had):
            return wrong("a measured value changed")
        if np.any((has & ~had).any(axis=0) & ~marked):
            return wrong("a completed value passes as measured")
        error, std = np.abs(after - made.warm), found["object_temperature_std"].values
        off = (marked & has) & (error > 5 * np.maximum(std, FLOOR["object_temperature"]))
        share = off.sum() / max((marked & has).sum(), 1)
        return wrong(f"{share:.0%} of what is completed off", where=bool(share > 0.01))

    names = "prior|material|label|pool|surroundings|result|counts|response|band|status|dims|'x'|'y'"
    act, good = lambda: separation.complete(**arguments), what in ("nothing", "no prior")
    return Attack(f"complete: {what}", act, check, (names,), good)
