"""Hostile arguments beside a capture: the reflections' shift, and what completes a result."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.arrays import FLOOR, response_of, solving
from attack.damage import ALL, TURNED, Rng, Table, cut, hurt, hurt_one
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import SLOPE, Scene, clock, leaving, pick
from dbthermal import separation
from reproduction.experiments.pictures import Picture, smooth_shift

GLASS: Final = xr.DataArray([0.86, 0.72], {"band": ["8-14", "9.5"]}, "band")
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
    drawn = Picture(shape=shape, walkers=7, still=still).draw(time, GLASS, rng, field)
    warm, cold = (drawn[f"{who}_temperature"].values for who in ("object", "background"))
    seen = zip(bands, GLASS.values, cold, strict=True)
    counts = np.stack([leaving(band, share, warm, part) for band, share, part in seen])
    counts += noise[:, None, None, None] * rng.standard_normal(counts.shape)
    emissivity = np.broadcast_to(GLASS.values[:, None, None], (2, *shape)).copy()
    place = {"y": np.arange(shape[0]) + 3.0, "x": np.arange(shape[1]) + 7.0}
    made = Scene(bands, time, warm, cold[0], emissivity, noise).film(counts, **place)
    pixel = {"units": "pixel"}
    parts = {
        "shift": (("axis", "y", "x"), field.astype(np.float32), pixel),
        "shift_std": (("axis", "y", "x"), np.full(field.shape, 0.03, np.float32), pixel),
        "known": (("y", "x"), np.ones(shape, bool), {"units": "1"}),
    }
    attrs = {"reference_band": "8-14", "bands": ["9.5"]}
    return made, xr.Dataset(parts, {"axis": ["y", "x"], **place}, attrs)


def _patch(_: Rng, field: xr.Dataset, **values: float) -> xr.Dataset:
    """A patch of other values in some variables."""
    field = field.copy(deep=True)
    for name, value in values.items():
        field[name][..., 10:20, 15:30] = value
    return field


_FIELDS: Final[Table] = {
    **ALL,
    "nothing": lambda _, one: one,
    "for other bands": lambda _, one: one.assign_attrs(bands=["10.6"]),
    "of another reference": lambda _, one: one.assign_attrs(reference_band="9.5", bands=["8-14"]),
    "beyond the image": lambda _, one: one.assign(shift=one["shift"] * 40),
    "NaN where known": partial(_patch, shift=np.nan),
    "infinite patch": partial(_patch, shift=np.inf),
    "all NaN": lambda _, one: one.assign(shift=one["shift"] * np.nan),
    "a hole": partial(_patch, known=0, shift=np.nan),
    "noisy": lambda rng, one: one.assign(shift=one["shift"] + rng.normal(0, 3, one["shift"].shape)),
    "a step": partial(_patch, shift=9.0),
    "deviation negative": partial(_patch, shift_std=-1.0),
    "deviation NaN": partial(_patch, shift_std=np.nan),
    "axes turned": cut(axis=TURNED),
    "a number": lambda rng, _: float(rng.normal()),
    "turned round": lambda _, one: one.assign(shift=-one["shift"]),
}


def shifts(rng: Rng) -> Attack:
    """`solve` with a field of the reflections' shift that is damaged in each of its parts."""
    made, field = _picture(int(rng.integers(1, 4)), 2.4, shape=(20, 32))
    what, spoilt = hurt(rng, _FIELDS, field)
    method, response = pick(rng, ["subspace"] * 5 + ["apparent"]), response_of(made)

    names = ("shift|axis|known|band|pixel|reflection_shift|dims|coordinate|'x'",)
    limit = "a wrong shift is not seen everywhere" if what in ("a step", "turned round") else ""
    good, more = what == "nothing" and method == "subspace", {"reflection_shift": spoilt}
    attack = solving(f"shift {what}", made, response, method, *names, good=good, **more)
    return replace(attack, limit=limit)


@cache
def _incomplete(seed: int) -> tuple[Scene, dict[str, Any]]:
    """A scene half at rest, with the arguments that complete its separation."""
    made, _ = _picture(seed, 0.0, 0.5)
    response = response_of(made)
    result = separation.solve(made.capture, response)
    labels = xr.zeros_like(made.capture["counts"][0, 0], dtype=int).drop_vars(["band", "time"])
    given = {"result": result, "corrected": made.capture, "response": response}
    return made, {**given, "materials": labels, "surroundings": 295.15, "prior": GLASS}


def _of(value: Any) -> Callable[[Rng, Any], Any]:
    return lambda _, __: value


_ARGUMENTS: Final[Mapping[str, Table]] = {
    "prior": {
        **ALL,
        "nothing": lambda _, one: one,
        "left out": _of(None),
        "of 1.2": lambda _, one: one + 0.4,
        "without dims": lambda _, one: one[0],
        "of an unknown material": _of("unobtainium"),
    },
    "surroundings": {
        "in degrees Celsius": _of(22.0),
        "NaN": _of(np.nan),
        "infinite": _of(np.inf),
        "in text": _of("room"),
        "over time": _of(xr.DataArray(np.full(5, 295.0), dims="t")),
    },
    "materials": {**ALL, "in float": lambda _, one: one + 0.5},
    "result": {
        **ALL,
        "of other frames": cut(time=slice(20, None)),
        "of another scene": lambda _, one: one.isel(x=TURNED).assign_coords(x=one["x"]),
        "without values": lambda _, one: one.where(False),
    },
    "corrected": {**ALL, "raw": lambda _, one: one.round().astype("uint16")},
    "response": {**ALL, "missing": _of(None)},
}


def completions(rng: Rng) -> Attack:
    """`complete` with one argument damaged: never a completed value that passes as measured."""
    made, given = _incomplete(int(rng.integers(1, 4)))
    what, arguments = hurt_one(rng, _ARGUMENTS, given)

    def check(found: xr.Dataset) -> Verdict:
        before, after = (one["object_temperature"].values for one in (arguments["result"], found))
        had, has = np.isfinite(before), np.isfinite(after)
        marked = (found["status"].values & COMPLETED) != 0
        if np.any((before != after) & had):
            return wrong("a measured value changed")
        # A sample of a pixel that is measured is marked by itself.
        single = found["bridged"].values if "bridged" in found else np.zeros_like(has)
        if np.any((has & ~had & ~single).any(axis=0) & ~marked):
            return wrong("a completed value passes as measured")
        error, std = np.abs(after - made.warm), found["object_temperature_std"].values
        off = (marked & has) & (error > 5 * np.maximum(std, FLOOR["object_temperature"]))
        share = off.sum() / max((marked & has).sum(), 1)
        return wrong(f"{share:.0%} of what is completed off", where=bool(share > 0.01))

    names = "prior|material|label|pool|surroundings|result|corrected|counts|response|band|status|"
    names += "temperature|emissivity|separated|dims|'x'|'y'"
    good = what in ("prior nothing", "prior left out")
    act = lambda: separation.complete(**arguments)  # noqa: E731
    return Attack(f"complete: {what}", act, check, (names,), good)
