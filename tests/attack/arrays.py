"""Hostile arrays into the separation: samples, clocks, shapes, responses, maps of other windows."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

import numpy as np
import xarray as xr

from attack import damage
from attack.damage import ALL, Rng, Table, cut, hurt, hurt_one
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import CALIBRATED, SLOPE, Array, Scene, blackbody, clock, pick, scene
from dbthermal import calibration, separation
from dbthermal.response import EXACT
from reproduction import methods
from reproduction.methods.bcp import BcpSettings
from reproduction.methods.dbvt import DbvtSettings

FAST: Final[Mapping[str, Any]] = {
    "dbvt": DbvtSettings(stages=2, stage_steps=2, steps=4),
    "bcp": BcpSettings(patch=3, window=5),
}
"""Settings of the methods that take long, or whose windows are larger than the images here."""

DEVIATIONS: Final = 5.0
"""A pixel without a flag is wrong if its RMS error is beyond so many stated ones, and `FLOOR`."""
FLOOR: Final = {"object_temperature": 0.05, "emissivity": 0.01}
"""Errors that are never wrong: of the blackbody curve's form, and the like [K], [1]."""


@cache
def _response(bands: tuple[str, ...]) -> xr.Dataset:
    return calibration.fit_response(blackbody(bands), None, **EXACT)


def response_of(made: Scene, *, noise: bool = True) -> xr.Dataset:
    """Response of a scene's bands."""
    response = _response(made.bands).copy(deep=True)
    return response.assign(noise=("band", made.noise, {"units": "count"})) if noise else response


def judge(made: Scene, result: xr.Dataset) -> Verdict:
    """Compare what has no flag with the truth, in the deviations that the result states."""
    result = result.sel(band=list(made.bands))
    good, notes = result["status"].values == 0, []
    off, missing = np.zeros(good.shape, bool), str(result.attrs["not_estimated"]).split()
    truths = {"object_temperature": made.warm, "emissivity": made.emissivity}
    for name, truth in truths.items():
        if {name, f"{name}_std"} & {*missing}:
            continue
        error, stated = _rms(result[name].values - truth), _rms(result[f"{name}_std"].values)
        beyond = good & ~(error <= np.maximum(DEVIATIONS * stated, FLOOR[name]))
        off |= beyond
        if beyond.any():
            worst = np.unravel_index(np.argmax(np.where(beyond, error, -1)), good.shape)
            notes.append(f"{name} off by {error[worst]:.3g}, stated {stated[worst]:.3g}")
    number, unflagged = int(off.sum()), int(good.sum())
    # By chance at the stated rate of 0.1 % less often than once in a thousand inputs.
    if number > 1 + unflagged / 100:
        note = f"{number} of {unflagged} pixels without a flag: {'; '.join(notes)}"
        return Verdict("silent", note, unflagged, number)
    return Verdict("right" if unflagged else "flagged", "", unflagged, number)


def _rms(values: Any) -> Array:
    """RMS over frames or bands of what is finite; NaN if nothing is."""
    finite = np.isfinite(values)
    number = finite.sum(axis=0)
    total = (np.where(finite, values, 0.0).astype(float) ** 2).sum(axis=0)
    return np.asarray(np.where(number, np.sqrt(total / np.maximum(number, 1)), np.nan))


def solving(
    what: str,
    made: Scene,
    response: xr.Dataset | None = None,
    method: str = "subspace",
    *names: str,
    good: bool = False,
    **more: Any,
) -> Attack:
    """Attack by one call of `solve`, with quick settings and what the method needs."""
    used = response_of(made) if response is None else response
    more.setdefault("settings", FAST.get(method))
    if method == "calibrated":
        more.setdefault("emissivity", made.known.isel(y=0, x=0, drop=True))
    act = lambda: separation.solve(made.capture, used, methods.get_method(method), **more)  # noqa: E731
    return Attack(f"{method}: {what}", act, lambda found: judge(made, found), names, good)


def any_method(rng: Rng, bands: int = 2) -> str:
    """Mostly the default method, which takes any number of bands."""
    others = ("calibrated", "naive", "ratio", "bcp", "apparent", "dbvt")
    return pick(rng, others) if bands == 2 and rng.random() < 0.4 else "subspace"


def clean(rng: Rng) -> Attack:
    """Good captures: two to five bands, noise 1:1 to 1:30, 32 to 20,000 frames, any number type."""
    bands = int(rng.integers(2, 6))
    frames = int(rng.choice([32, 48, 64, 100, 160, 350, 600]))
    shape = (8, 12)
    if rng.random() < 0.02:
        frames, shape = int(rng.choice([5000, 20_000])), (2, 3)
    made = scene(rng, bands=bands, time=clock(frames, float(rng.choice([5, 10, 30]))), shape=shape)
    method = any_method(rng, bands) if frames < 1000 else "subspace"
    noise = bool(rng.random() < 0.7)
    what = f"{bands} bands, {frames} frames, noise {made.noise / SLOPE} K, known {noise}"
    good = noise or frames >= 100  # of fewer frames the noise may be asked for
    return solving(what, made, response_of(made, noise=noise), method, "noise", good=good)


def gray(rng: Rng) -> Attack:
    """Gray bodies, and bodies nearly gray."""
    bands = int(rng.integers(2, 6))
    near = float(rng.choice([0.0, 0.0, 0.002, 0.005, 0.01, 0.02]))
    emissivity = rng.uniform(0.4, 0.95) + near * rng.uniform(-1, 1, bands)
    made = scene(rng, bands=bands, emissivity=emissivity, time=clock(int(rng.integers(80, 360))))
    what = f"{bands} bands, emissivities {emissivity.round(3)}, noise {made.noise / SLOPE} K"
    return solving(what, made, response_of(made, noise=bool(rng.random() < 0.8)), good=True)


_NUMBERS: Final = ("f4", "f8", ">f4", ">f8")
_OTHERS: Final = ("u1", "u2", ">u2", "i2", "i4", "i8", "f2", "O", "c8", "U8", "M8[s]", "m8[s]")


def dtypes(rng: Rng) -> Attack:
    """Counts of every number type, of either byte order, as objects, complex, text or times."""
    made, kind = scene(rng, shape=(6, 8)), pick(rng, [*_NUMBERS, *_OTHERS])
    counts = made.counts()
    with np.errstate(all="ignore"):
        counts = counts.round().astype(int) if kind.strip(">")[0] in "uiMm" else counts
        counts = counts.astype(kind)
    made.capture, good = made.with_counts(counts), kind in _NUMBERS
    return solving(f"counts of {kind}", made, None, any_method(rng), "counts", good=good)


_SHARES: Final = (0.02, 0.1, 0.25)
_SPOILS: Final[Table] = {
    **{
        f"{place} {value}": partial(damage.spoil, what=f"{place} {value}")
        for place in damage.PLACES
        for value in (*damage.VALUES, "held")
    },
    "high clipped": lambda rng, one: np.minimum(one, np.quantile(one, 1 - rng.choice(_SHARES))),
    "low clipped": lambda rng, one: np.maximum(one, np.quantile(one, rng.choice(_SHARES))),
    "coarse": lambda rng, one: one - one % rng.choice([16, 64, 256]).astype("f4"),
}


def samples(rng: Rng) -> Attack:
    """NaN, infinite, clipped, frozen, repeated and stuck samples in one band or all."""
    bands = int(rng.choice([2, 2, 2, 3]))
    made = scene(rng, bands=bands, time=clock(int(rng.integers(120, 350))))
    band = slice(None) if rng.random() < 0.3 else int(rng.integers(bands))
    what, spoilt = hurt(rng, _SPOILS, made.counts()[band])
    made.capture = made.put(band, spoilt)
    method, what = any_method(rng, bands), f"{what} in band {band}"
    limit = "counts cut to coarse steps look like rounded ones" if "coarse" in what else ""
    return replace(solving(what, made, None, method, "counts|frame|sample|noise"), limit=limit)


def clocks(rng: Rng) -> Attack:
    """Clocks with jitter, bursts, gaps, pauses, repeated, backward and impossible times."""
    even = clock(int(rng.choice([64, 160, 300])))
    what, stamps = hurt(rng, _CLOCKS, even)
    proper = stamps.dtype.kind in "iuf" and bool(np.all(np.isfinite(stamps)))
    told = "host" in what or not proper or bool((np.diff(stamps) <= 0).any())
    made = scene(rng, time=even if told else stamps.astype(float), shape=(6, 8))
    attrs = {"units": "ms" if "unit" in what else "s"}
    made.capture = made.capture.assign_coords(time=("time", stamps, attrs))
    names = "time|clock|interval|frame"
    return solving(f"clock: {what}", made, None, any_method(rng), names)


def _bursts(rng: Rng, time: Array, spread: float = 1e-3) -> Array:
    size, number = int(rng.choice([4, 8, 16, 32])), np.arange(time.size)
    burst = time[number // size * size]
    return np.asarray(burst + spread * rng.uniform(0.1, 1) * (number % size))


def gap(rng: Rng, time: Array, *lengths: float) -> Array:
    """Times with a pause [s]."""
    later = np.arange(time.size) >= rng.integers(10, time.size - 10)
    return np.asarray(time + rng.choice(lengths) * later)


def _changed(rng: Rng, time: Array, *values: float) -> Array:
    """One stamp that is so much before the one ahead of it."""
    before = np.roll(time, 1) - rng.choice(values)
    return np.where(np.arange(time.size) == rng.integers(1, time.size), before, time)


_CLOCKS: Final[Table] = {
    "jitter": lambda rng, time: time + rng.uniform(-0.3, 0.3, time.size) / 10 * rng.random(),
    "wild jitter": lambda rng, time: np.sort(rng.uniform(0, time[-1], time.size)),
    "bursts of the host": _bursts,
    "bursts": _bursts,
    "bursts of ten frames": partial(_bursts, spread=0.03),
    "tiny steps of the host": lambda _, time: np.arange(time.size) * 1e-9,
    "short steps": lambda rng, time: time * 10.0 ** rng.uniform(-6, -2),
    "long steps": lambda rng, time: time * 10.0 ** rng.uniform(1, 5),
    "two bursts an hour apart": lambda rng, time: gap(rng, time * 1e-2, 3600.0),
    "pause": lambda rng, time: gap(rng, time, 0.5, 3, 30, 3600, 3e7),
    "repeated or backward": lambda rng, time: _changed(rng, time, 0.0, 0.05, 5.0),
    "backward": lambda _, time: time[::-1].copy(),
    "not a number": lambda rng, time: _changed(rng, time, np.nan, np.inf, -np.inf),
    "since 1970": lambda _, time: time + 1.7e9,
    "since 1970 in single precision": lambda _, time: (time + 1.7e9).astype(np.float32),
    "single precision": lambda _, time: time.astype(np.float32),
    "datetime": lambda _, time: (time * 1e9).astype("datetime64[ns]"),
    "whole seconds": lambda _, time: np.arange(time.size),
    "of another unit": lambda _, time: time * 1e3,
    "text": lambda _, time: time.astype(str),
    "one lost": lambda rng, time: time + 0.1 * (np.arange(time.size) >= rng.integers(time.size)),
}


def shapes(rng: Rng) -> Attack:
    """Images of one pixel or line, too few frames, other dims, missing coordinates."""
    made = scene(rng, shape=(6, 8), bands=int(rng.integers(2, 4)), time=clock(64))
    what, made.capture = hurt(rng, _SHAPES, made.capture)
    # What is left of the truth, where the capture was cut.
    sizes = getattr(made.capture, "sizes", {})
    time, y, x = (slice(0, max(1, sizes.get(dim, 64))) for dim in ("time", "y", "x"))
    made.warm, made.emissivity = made.warm[time, y, x], made.emissivity[:, y, x]
    method = any_method(rng, len(made.bands))
    names = () if what == "tiny" else ("counts|dims|band|time|frame|Dataset|status|segment|type",)
    return solving(f"shape: {what}", made, None, method, *names, good=what == "tiny")


def _tiny(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    y, x = rng.choice([[1, 1], [1, 8], [6, 1], [2, 2]])
    return capture.isel(y=slice(0, int(y)), x=slice(0, int(x)))


def _with_bits(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    bits = np.full((6, 8), 1 << int(rng.integers(17, 31)), np.uint32)
    return capture.assign(status=(("y", "x"), bits))


_ORDERS: Final = ("time band y x", "y x band time", "band time x y")
_SHAPES: Final[Table] = {
    **ALL,
    "tiny": _tiny,
    "dims in another order": lambda rng, one: one.transpose(*pick(rng, _ORDERS).split()),
    "the same band twice": lambda _, one: one.assign_coords(band=["8-14"] * one.sizes["band"]),
    "few frames": lambda rng, one: one.isel(time=slice(0, int(rng.integers(0, 32)))),
    "unknown bits": _with_bits,
    "status of another shape": lambda _, one: one.assign(status=("x", np.zeros(8, np.uint32))),
    "falling segments": lambda rng, one: one.assign(segment=("time", rng.integers(0, 3, 64))),
}


def responses(rng: Rng) -> Attack:
    """Responses of other bands, of another range, damaged, or with their bands in another order."""
    made = scene(rng, shape=(6, 8), bands=int(rng.integers(2, 4)))
    what, response = hurt(rng, _RESPONSES, response_of(made))
    names = "response|band|noise|coefficient|amplitude|wavelength|shift|offset|temperature|dims"
    return solving(f"response: {what}", made, response, "subspace", names)


def _spoilt_coefficient(rng: Rng, response: xr.Dataset) -> xr.Dataset:
    name = pick(rng, ["amplitude", "effective_wavelength", "wavelength_shift", "offset", "noise"])
    values = response[name].values.copy()
    # Another finite shift or offset may be another camera's.
    worse = [np.nan, np.inf] if name in ("wavelength_shift", "offset") else [np.nan, -1.0, 0.0]
    values[int(rng.integers(values.size))] *= rng.choice(worse)
    return response.assign({name: ("band", values, response[name].attrs)})


def _range(value: float, name: str = "temperature_max", units: str = "K") -> Any:
    return lambda _, one: one.assign({name: ((), value, {"units": units})})


_RESPONSES: Final[Table] = {
    **ALL,
    "a coefficient damaged": _spoilt_coefficient,
    "another range": lambda rng, one: _range(CALIBRATED[rng.integers(4, 8)])(rng, one),
    "range turned round": _range(200.0),
    "in degrees Celsius": _range(25.0, "reference_temperature", "degC"),
}


def windows(rng: Rng) -> Attack:
    """Masks, pools and emissivities of another window, size, type or unit, or of permuted bands."""
    made, place = scene(rng), {"y": np.arange(8.0) + 100, "x": np.arange(12.0) + 40}
    made.capture = made.capture.assign_coords(place)
    known = made.known.assign_coords(place)
    maps = {
        "mask": xr.DataArray(rng.random((8, 12)) < 0.9, place, ("y", "x")),
        "pool": xr.DataArray(np.zeros((8, 12), int), place, ("y", "x")),
        "emissivity": known,
        "emissivity_std": 0 * known + 0.01,
    }
    what, spoilt = hurt_one(rng, dict.fromkeys(maps, _WINDOWS), maps)
    name, _, change = what.partition(" ")
    method = "calibrated" if name.startswith("emissivity") else "subspace"
    more = {"emissivity": made.known} if name == "emissivity_std" else {}
    good, more[name] = change == "the same window", spoilt[name]
    attack = solving(what, made, None, method, name, good=good, **more)
    if change not in ("another window", "mirrored", "another dim's values"):
        return attack
    # Laid on by position it is another map: it must be refused, or put in place by name.
    return replace(attack, judge=lambda _: wrong(f"{what} was laid on by position"))


_WINDOWS: Final[Table] = {
    **ALL,
    "the same window": lambda _, one: one,
    "another dim's values": lambda _, one: one.assign_coords(x=one["x"] * 2),
    "mirrored": cut(x=damage.TURNED),
}
