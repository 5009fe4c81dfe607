"""Hostile arrays into the separation: samples, clocks, shapes, responses, maps of other windows."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.oracle import Attack, Verdict
from attack.scenes import CALIBRATED, SLOPE, Array, Scene, blackbody, clock, scene
from dbthermal import calibration, separation

Rng = np.random.Generator

FAST: Final[Mapping[str, Any]] = {
    "dbvt": separation.DbvtSettings(stages=2, stage_steps=2, steps=4),
    "bcp": separation.BcpSettings(patch=3, window=5),
}
"""Settings of the methods that take long, or whose windows are larger than the images here."""

DEVIATIONS: Final = 5.0
"""A pixel without a flag is wrong if its RMS error is beyond so many stated ones, and `FLOOR`."""
FLOOR: Final = {"object_temperature": 0.05, "emissivity": 0.01}
"""Errors that are never wrong: of the blackbody curve's form, and the like [K], [1]."""

_RESPONSES: Final[dict[tuple[str, ...], xr.Dataset]] = {}


def response_of(made: Scene, *, noise: bool = True) -> xr.Dataset:
    """Response of a scene's bands."""
    if made.bands not in _RESPONSES:
        _RESPONSES[made.bands] = calibration.fit_response(blackbody(made.bands))
    response = _RESPONSES[made.bands].copy(deep=True)
    return response.assign(noise=("band", made.noise, {"units": "count"})) if noise else response


def separate(made: Scene, response: xr.Dataset, method: str = "subspace", **more: Any) -> Any:
    """Separate with quick settings, and known emissivities where the method needs them."""
    more.setdefault("settings", FAST.get(method))
    if method == "calibrated":
        more.setdefault("emissivity", made.known.isel(y=0, x=0, drop=True))
    return separation.solve(made.capture, response, method, **more)


def judge(made: Scene, result: xr.Dataset) -> Verdict:
    """Compare what has no flag with the truth, in the deviations that the result states."""
    good = result["status"].values == 0
    missing = str(result.attrs["not_estimated"]).split()
    wrong, notes = np.zeros(good.shape, bool), []
    truths = {"object_temperature": made.warm, "emissivity": made.emissivity}
    for name, truth in truths.items():
        if f"{name}_std" in missing or name in missing:
            continue
        values, std = (result[part].values.astype(float) for part in (name, f"{name}_std"))
        error, stated = _rms(values - truth), _rms(std)
        beyond = good & ~(error <= np.maximum(DEVIATIONS * stated, FLOOR[name]))
        if beyond.any():
            worst = np.unravel_index(np.argmax(np.where(beyond, error, -1)), good.shape)
            notes.append(f"{name} off by {error[worst]:.3g}, stated {stated[worst]:.3g}")
        wrong |= beyond
    number, unflagged = int(wrong.sum()), int(good.sum())
    # By chance at the stated rate of 0.1 % less often than once in a thousand inputs.
    if number > 1 + unflagged / 100:
        note = f"{number} of {unflagged} pixels without a flag: {'; '.join(notes)}"
        return Verdict("silent", note, unflagged, number)
    return Verdict("right" if unflagged else "flagged", "", unflagged, number)


def _rms(values: Array) -> Array:
    """RMS over frames or bands of what is finite; NaN if nothing is."""
    finite = np.isfinite(values)
    number = finite.sum(axis=0)
    total = np.where(finite, values, 0.0) ** 2
    return np.asarray(np.where(number, np.sqrt(total.sum(axis=0) / np.maximum(number, 1)), np.nan))


def solving(
    what: str,
    made: Scene,
    response: xr.Dataset | None = None,
    method: str = "subspace",
    *names: str,
    good: bool = False,
    **more: Any,
) -> Attack:
    """Attack by one call of `solve`."""
    used = response_of(made) if response is None else response
    return Attack(
        f"{method}: {what}",
        lambda: separate(made, used, method, **more),
        lambda result: judge(made, result),
        names,
        good,
    )


def any_method(rng: Rng) -> str:
    """Mostly the default method."""
    others = ("calibrated", "naive", "ratio", "bcp", "apparent", "dbvt")
    return str(rng.choice(others)) if rng.random() < 0.4 else "subspace"


def clean(rng: Rng) -> Attack:
    """Good captures: two to five bands, noise 1:1 to 1:30, 32 to 20,000 frames, any number type."""
    bands = int(rng.integers(2, 6))
    frames = int(rng.choice([32, 48, 64, 100, 160, 350, 600]))
    shape = (8, 12)
    if rng.random() < 0.02:
        frames, shape = int(rng.choice([5000, 20_000])), (2, 3)
    made = scene(rng, bands=bands, time=clock(frames, float(rng.choice([5, 10, 30]))), shape=shape)
    method = any_method(rng) if bands == 2 and frames < 1000 else "subspace"
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
_OTHERS: Final = [
    "u1",
    "u2",
    ">u2",
    "i2",
    "i4",
    "i8",
    "f2",
    "O",
    "c8",
    "U8",
    "M8[s]",
    "m8[s]",
    "b1",
]


def dtypes(rng: Rng) -> Attack:
    """Counts of every number type, of either byte order, as objects, complex, text or times."""
    made = scene(rng, shape=(6, 8))
    kind = str(rng.choice([*_NUMBERS, *_OTHERS]))
    with np.errstate(all="ignore"):
        counts = made.counts()
        whole = counts.round().astype(int)
        counts = (whole if kind.strip(">")[0] in "uiMm" else counts).astype(kind)
    spoilt, good = made.with_counts(counts), kind in _NUMBERS
    return solving(f"counts of {kind}", spoilt, None, any_method(rng), "counts", good=good)


def samples(rng: Rng) -> Attack:
    """NaN, infinite, clipped, frozen, repeated and stuck samples in one band or all."""
    bands = int(rng.choice([2, 2, 2, 3]))
    made = scene(rng, bands=bands, time=clock(int(rng.integers(120, 350))))
    counts = made.counts()
    place = slice(None) if rng.random() < 0.3 else int(rng.integers(bands))
    what = str(rng.choice(list(_SPOILS)))
    part = counts[place]
    _SPOILS[what](rng, part)
    counts[place] = part
    method = any_method(rng) if bands == 2 else "subspace"
    what, spoilt = f"{what} in band {place}", made.with_counts(counts)
    return solving(what, spoilt, None, method, "counts|frame|sample")


def _held(rng: Rng, part: Any, *lengths: int, share: float = 1.0) -> None:
    """Frames, or a share of their pixels, keep their value for a while."""
    first, length = int(rng.integers(5, 60)), int(rng.choice(lengths))
    where = rng.random(part.shape[-2:]) < share
    part[..., first : first + length, where] = part[..., first : first + 1, where]


def _clip(rng: Rng, part: Any, *, above: bool) -> None:
    share = rng.choice([0.02, 0.1, 0.25])
    bound = np.quantile(part, 1 - share if above else share)
    part[...] = np.minimum(part, bound) if above else np.maximum(part, bound)


def _scattered(rng: Rng, part: Any, value: float) -> None:
    part[rng.random(part.shape) < rng.choice([0.001, 0.01, 0.1, 0.5])] = value


def _lines(rng: Rng, part: Any) -> None:
    part[..., int(rng.integers(part.shape[-1]))] = rng.choice([np.nan, 0.0, 65535.0])


def _frames_nan(rng: Rng, part: Any) -> None:
    first = int(rng.integers(60))
    part[..., first : first + int(rng.choice([1, 10, 60, 300])), :, :] = np.nan


def _every_other(rng: Rng, part: Any) -> None:
    part[..., int(rng.integers(2)) :: 2, :, :] = np.nan


def _copies(rng: Rng, part: Any) -> None:
    """Every second frame a copy of the one before, as from a driver of twice the rate."""
    frames = part.shape[-3] // 2 * 2
    some = rng.random() < 0.5
    step = slice(1, frames, 2 if some else int(rng.choice([3, 5, 10])))
    before, length = slice(0, frames - 1, step.step), len(range(*step.indices(frames)))
    part[..., step, :, :] = part[..., before, :, :][..., :length, :, :]


def _coarse(rng: Rng, part: Any) -> None:
    step = float(rng.choice([16, 64, 256]))
    part[...] = np.round(part / step) * step


_SCATTERED: Final = {"NaN": np.nan, "infinite": np.inf, "zeros": 0.0, "at the limit": 65535.0}
_SPOILS: Final[Mapping[str, Callable[[Rng, Any], None]]] = {
    "frozen frames": lambda rng, part: _held(rng, part, 3, 5, 10, 25, 60),
    "clipped from above": partial(_clip, above=True),
    "clipped from below": partial(_clip, above=False),
    **{f"scattered {name}": partial(_scattered, value=v) for name, v in _SCATTERED.items()},
    "a line lost": _lines,
    "frames NaN": _frames_nan,
    "every other frame NaN": _every_other,
    "copied frames": _copies,
    "pixels frozen": lambda rng, part: _held(rng, part, 5, 10, 40, share=0.3),
    "coarse counts": _coarse,
    "all one value": lambda _, part: part.fill(20_000.0),
    "all NaN": lambda _, part: part.fill(np.nan),
}


def clocks(rng: Rng) -> Attack:
    """Clocks with jitter, bursts, gaps, pauses, repeated, backward and impossible times."""
    what = str(rng.choice(list(_CLOCKS)))
    frames = int(rng.choice([64, 160, 300]))
    stamps = np.asarray(_CLOCKS[what](rng, clock(frames)))
    proper = stamps.dtype.kind in "iuf" and bool(np.all(np.isfinite(stamps)))
    told = "host" in what or not proper or bool((np.diff(stamps) <= 0).any())
    true = clock(frames) if told else stamps.astype(float)
    made = scene(rng, time=true, shape=(6, 8))
    attrs = {"units": "ms" if "unit" in what else "s"}
    made.capture = made.capture.assign_coords(time=("time", stamps, attrs))
    names = "time|clock|interval|frame"
    return solving(f"clock: {what}", made, None, any_method(rng), names)


def _bursts(rng: Rng, time: Array, *, spread: float = 1e-3) -> Array:
    size, number = int(rng.choice([4, 8, 16, 32])), np.arange(time.size)
    return time[number // size * size] + spread * rng.uniform(0.1, 1) * (number % size)


def _gap(rng: Rng, time: Array, length: float) -> Array:
    return time + length * (np.arange(time.size) >= rng.integers(10, time.size - 10))


def _changed(rng: Rng, time: Array, *values: float) -> Array:
    """One stamp that is another value, or so much before the one ahead of it."""
    time, place = time.copy(), int(rng.integers(1, time.size))
    value = rng.choice(values)
    time[place] = time[place - 1] - value if np.isfinite(value) else value
    return time


def _one_lost(rng: Rng, time: Array) -> Array:
    return np.delete(np.append(time, time[-1] + 0.1), int(rng.integers(time.size)))


_CLOCKS: Final[Mapping[str, Callable[[Rng, Array], Any]]] = {
    "jitter": lambda rng, time: time + rng.uniform(-0.3, 0.3, time.size) / 10 * rng.random(),
    "wild jitter": lambda rng, time: np.sort(rng.uniform(0, time[-1], time.size)),
    "bursts of the host": _bursts,
    "bursts": _bursts,
    "bursts of ten frames": lambda rng, time: _bursts(rng, time, spread=0.03),
    "tiny steps of the host": lambda _, time: np.arange(time.size) * 1e-9,
    "short steps": lambda rng, time: time * 10.0 ** rng.uniform(-6, -2),
    "long steps": lambda rng, time: time * 10.0 ** rng.uniform(1, 5),
    "two bursts an hour apart": lambda rng, time: _gap(rng, time * 1e-2, 3600.0),
    "hour's pause": lambda rng, time: _gap(rng, time, 3600.0),
    "gap": lambda rng, time: _gap(rng, time, float(rng.choice([0.5, 3, 30]))),
    "year's pause": lambda rng, time: _gap(rng, time, 3e7),
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
    "sixtieths with one lost": _one_lost,
}


def shapes(rng: Rng) -> Attack:
    """Images of one pixel or line, too few frames, other dims, missing coordinates."""
    made = scene(rng, shape=(6, 8), bands=int(rng.integers(2, 4)), time=clock(64))
    what = str(rng.choice(list(_SHAPES)))
    made.capture = _SHAPES[what](rng, made.capture)
    names = () if what == "tiny" else ("counts|dims|band|time|frame|Dataset|status|segment",)
    # What is left of the truth, where the capture was cut.
    sizes = made.capture.sizes
    time, y, x = (slice(0, max(1, sizes.get(dim, 64))) for dim in ("time", "y", "x"))
    made.warm, made.emissivity = made.warm[time, y, x], made.emissivity[:, y, x]
    method = any_method(rng) if len(made.bands) == 2 else "subspace"
    return solving(f"shape: {what}", made, None, method, *names, good=what == "tiny")


def _tiny(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    y, x = rng.choice([[1, 1], [1, 8], [6, 1], [2, 2]])
    return capture.isel(y=slice(0, int(y)), x=slice(0, int(x)))


def _with_unit(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    units = str(rng.choice(["K", "W m-2", "counts", ""]))
    return capture.assign(counts=capture["counts"].assign_attrs(units=units))


def _with_bits(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    bits = np.full((6, 8), 1 << int(rng.integers(17, 31)), np.uint32)
    return capture.assign(status=(("y", "x"), bits))


def _segments(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    return capture.assign(segment=("time", rng.integers(0, 3, 64)))


_ORDERS: Final = ("time band y x", "y x band time", "band time x y")
_SHAPES: Final[Mapping[str, Callable[[Rng, xr.Dataset], Any]]] = {
    "tiny": _tiny,
    "dims in another order": lambda rng, one: one.transpose(*str(rng.choice(_ORDERS)).split()),
    "no coordinate time": lambda _, one: one.drop_vars("time"),
    "no coordinate band": lambda _, one: one.drop_vars("band"),
    "no counts": lambda _, one: one.rename(counts="signal"),
    "another unit": _with_unit,
    "the same band twice": lambda _, one: one.assign_coords(band=["8-14"] * one.sizes["band"]),
    "one band": lambda _, one: one.isel(band=slice(0, 1)),
    "few frames": lambda rng, one: one.isel(time=slice(0, int(rng.integers(1, 32)))),
    "no frames": lambda _, one: one.isel(time=slice(0, 0)),
    "no pixels": lambda _, one: one.isel(x=slice(0, 0)),
    "another dim": lambda _, one: one.rename(y="row"),
    "a dim more": lambda _, one: one.expand_dims("run"),
    "no dataset": lambda _, one: one["counts"],
    "unknown bits": _with_bits,
    "status of another shape": lambda _, one: one.assign(status=("x", np.zeros(8, np.uint32))),
    "falling segments": _segments,
}


def responses(rng: Rng) -> Attack:
    """Responses of other bands, of another range, damaged, or with their bands in another order."""
    made = scene(rng, shape=(6, 8), bands=int(rng.integers(2, 4)))
    what = str(rng.choice(list(_RESPONSE_SPOILS)))
    response = _RESPONSE_SPOILS[what](rng, response_of(made))
    names = "response|band|noise|coefficient|amplitude|wavelength|shift|offset|temperature"
    return solving(f"response: {what}", made, response, "subspace", names)


def _spoilt_coefficient(rng: Rng, response: xr.Dataset) -> xr.Dataset:
    name = str(rng.choice(["amplitude", "effective_wavelength", "wavelength_shift", "offset"]))
    values = response[name].values.copy()
    # Another finite shift or offset may be another camera's.
    worse = [np.nan, np.inf] if name in ("wavelength_shift", "offset") else [np.nan, -1.0, 0.0]
    values[int(rng.integers(values.size))] *= rng.choice(worse)
    return response.assign({name: ("band", values, response[name].attrs)})


def _spoilt_noise(rng: Rng, response: xr.Dataset) -> xr.Dataset:
    worse = rng.choice([np.nan, np.inf, 0.0, -1.0], response.sizes["band"])
    return response.assign(noise=("band", response["noise"].values * worse, {"units": "count"}))


def _with_kelvin(name: str, value: float, units: str = "K") -> Callable[[Rng, xr.Dataset], Any]:
    return lambda _, one: one.assign({name: ((), value, {"units": units})})


def _narrow(rng: Rng, response: xr.Dataset) -> xr.Dataset:
    high = CALIBRATED[int(rng.integers(4, 8))]
    return response.assign(temperature_max=((), high, {"units": "K"}))


_RESPONSE_SPOILS: Final[Mapping[str, Callable[[Rng, xr.Dataset], Any]]] = {
    "bands in another order": lambda _, one: one.isel(band=slice(None, None, -1)),
    "of other bands": lambda _, one: one.assign_coords(band=["a", "b", "c"][: one.sizes["band"]]),
    "of one band": lambda _, one: one.isel(band=slice(0, 1)),
    "a coefficient damaged": _spoilt_coefficient,
    "a noise damaged": _spoilt_noise,
    "another range": _narrow,
    "no range": lambda _, one: one.drop_vars("temperature_min"),
    "range turned round": _with_kelvin("temperature_max", 200.0),
    "in degrees Celsius": _with_kelvin("reference_temperature", 25.0, "degC"),
    "no bands named": lambda _, one: one.drop_vars("band"),
    "no dataset": lambda _, one: one["amplitude"],
    "empty": lambda _, one: one.isel(band=slice(0, 0)),
}


def windows(rng: Rng) -> Attack:
    """Masks, pools and emissivities of another window, size, type or unit, or of permuted bands."""
    made = scene(rng, shape=(8, 12))
    edge, left = np.arange(8.0) + 100, np.arange(12.0) + 40
    made.capture = made.capture.assign_coords(y=edge, x=left)
    maps = {
        "mask": xr.DataArray(rng.random((8, 12)) < 0.9, dims=("y", "x")),
        "pool": xr.DataArray(np.zeros((8, 12), int), dims=("y", "x")),
        "emissivity": made.known,
        "emissivity_std": 0 * made.known + 0.01,
    }
    name = str(rng.choice(list(maps)))
    array = maps[name].assign_coords(y=edge, x=left)
    what = str(rng.choice(list(_WINDOWS)))
    array = _WINDOWS[what](rng, array)
    method = "calibrated" if name.startswith("emissivity") else "subspace"
    more: dict[str, Any] = {name: array}
    if name == "emissivity_std":
        more["emissivity"] = made.known
    good = what == "the same window"
    if what in ("another window", "turned round", "another dim's values"):
        # Laid on by position it is another map: it must be refused, or put in place by name.
        return Attack(
            f"{method}: {name} of {what}",
            lambda: separate(made, response_of(made), method, **more),
            lambda _: Verdict("silent", f"{name} of {what} was laid on by position", 1, 1),
            (name,),
        )
    return solving(f"{name} of {what}", made, None, method, name, good=good, **more)


_WINDOWS: Final[Mapping[str, Callable[[Rng, xr.DataArray], Any]]] = {
    "the same window": lambda _, one: one,
    "no coordinates": lambda _, one: one.drop_vars(["y", "x"]),
    "another window": lambda rng, one: one.assign_coords(y=one["y"] + int(rng.integers(1, 50))),
    "another dim's values": lambda _, one: one.assign_coords(x=one["x"] * 2),
    "turned round": lambda _, one: one.isel(x=slice(None, None, -1)),
    "another size": lambda rng, one: one.isel(x=slice(0, int(rng.integers(0, 11)))),
    "other dims": lambda _, one: one.rename(y="row"),
    "transposed": lambda _, one: one.transpose(),
    "bands turned round": lambda _, one: one.isel(
        band=slice(None, None, -1), missing_dims="ignore"
    ),
    "text": lambda _, one: one.astype(str),
    "another type": lambda _, one: one.values,
    "NaN": lambda _, one: one.astype(float).where(one["x"] > 45),
    "complex": lambda _, one: one.astype(complex),
}
