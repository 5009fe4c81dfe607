"""Hostile arrays into the steps beside the separation: clocks, corrections, calibration."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from attack.arrays import gap
from attack.damage import ALL, TURNED, Rng, Table, band_spoilt, cut, hurt, hurt_one
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import SLOPE, Array, Scene, blackbody, clock, counts_of, pick, scene
from dbthermal import alignment, calibration, correction
from dbthermal import response as responses

_CLOCK: Final = ("offset|time|frame|pixel|gap|clock|band",)


def offset(rng: Rng) -> Attack:
    """`time_offset` of bands with lost blocks, jumps of a clock, and offsets beyond the search."""
    delay = float(rng.uniform(-2, 2)) if rng.random() < 0.8 else float(rng.uniform(6, 9))
    what, _, spoilt, expected = _cameras(rng, delay, int(rng.integers(160, 350)))

    def judge(found: float) -> Verdict:
        error = abs(10 * found - expected)
        return wrong(f"{error:.2f} frames off where 0.1 is promised", where=error > 0.25)

    what = f"time_offset of {delay:.1f} frames: {what}"
    return Attack(what, lambda: alignment.time_offset(spoilt), judge, _CLOCK)


def align(rng: Rng) -> Attack:
    """`align` across lost blocks, an hour's pause, jumps of a clock, and foreign arguments."""
    delay = float(rng.uniform(-2, 2))
    what, made, spoilt, frames = _cameras(rng, delay, int(rng.integers(100, 300)))
    expected, given = frames / 10, rng.random() < 0.6

    def judge(result: xr.Dataset) -> Verdict:
        if abs(result.attrs["time_offset"][1] - expected) > 0.025:
            return wrong(f"offset {result.attrs['time_offset'][1]:.3f} s, truly {expected:.3f} s")
        # Both bands on the second one's clock must show the scene of one moment.
        truth = xr.DataArray(made.clean(), {"time": made.time}, ("band", "time", "y", "x"))
        apart = abs(result["counts"].values - truth.interp(time=result["time"].values).values)
        error = [np.quantile(np.append(one[np.isfinite(one)], 0.0), 0.99) for one in apart]
        # The line between two frames misses a moving body's edge by up to a kelvin.
        excess = error > 5 * made.noise + 1.5 * SLOPE
        return wrong(f"counts off by {error}, noise {made.noise}", where=bool(excess.any()))

    more: dict[str, Any] = {"offset": expected, "clock": "9.5"} if given else {}
    what = f"align {delay:.1f} frames, {sorted(more)}: {what}"
    return Attack(what, lambda: alignment.align(spoilt, **more), judge, _CLOCK)


def _cameras(rng: Rng, delay: float, frames: int) -> tuple[str, Scene, xr.Dataset, float]:
    """Loss, scene whose second camera exposes later, its capture with the loss, frames to find."""
    made = scene(rng, shape=(8, 12), time=clock(frames), ratio=3.0, delay=delay / 10)
    what, spoilt = hurt(rng, _LOSSES, made)
    return what, made, spoilt, 0.0 if what == "stamps of that delay" else delay


def _stamped(made: Scene, second: Array) -> xr.Dataset:
    stamps = (("band", "time"), np.stack([made.time, second]), {"units": "s"})
    return made.capture.assign(exposure_time=stamps)


def _lost(rng: Rng, made: Scene, shift: int) -> xr.Dataset:
    """One camera's frames from a moment on come so much earlier, NaN behind, with their stamps."""
    second, counts = made.time.copy(), made.counts()
    place = int(rng.integers(40, second.size - 40))
    for values in (second, counts[1]):
        values[place:] = np.roll(values[place:], -shift, axis=0)
        values[max(place, len(values) - shift) :] = np.nan
    made.capture = made.with_counts(counts)
    return _stamped(made, second)


def _pause(rng: Rng, made: Scene) -> xr.Dataset:
    """Both pause for an hour or a day; the scene waits."""
    made.time = gap(rng, made.time, 600, 3600, 86400)
    return made.capture.assign_coords(time=("time", made.time, {"units": "s"}))


def _foreign(rng: Rng, made: Scene) -> xr.Dataset:
    lost = rng.random(made.time.size) < 0.99
    return _stamped(made, np.where(lost, pick(rng, [np.nan, np.inf]), made.time))


_LOSSES: Final[Table] = {
    "nothing lost": lambda _, made: made.capture,
    "a block NaN": partial(band_spoilt, what="block NaN"),
    "a block of copies": partial(band_spoilt, what="block held"),
    "scattered NaN": partial(band_spoilt, what="scattered NaN"),
    "one band still": partial(band_spoilt, what="everywhere held"),
    "one camera ends early": lambda rng, made: _lost(rng, made, made.time.size),
    "frames lost": lambda rng, made: _lost(rng, made, pick(rng, [5, 20])),
    "a clock jumps": lambda rng, made: _stamped(made, gap(rng, made.time, -30, 3600)),
    "both pause": _pause,
    "stamps damaged": _foreign,
    "stamps of that delay": lambda _, m: _stamped(m, m.time + m.delay),
}


def register(rng: Rng) -> Attack:
    """`register` of small, NaN, flat and unlike views."""
    rows, columns = rng.choice([8, 24, 40, 48], 2)
    texture = 8 * gaussian_filter(rng.normal(size=(rows + 8, columns + 8)), 2.5)
    shift = rng.integers(0, 3, 2)
    moved = texture[4 - shift[0] :, 4 - shift[1] :][:rows, :columns]
    views = np.stack([texture[4:-4, 4:-4], moved])
    what = pick(rng, ["good", "NaN", "infinite", "flat", "unlike", "huge"])
    if what in ("NaN", "infinite"):
        views[1, rng.integers(rows), rng.integers(columns)] = np.nan if what == "NaN" else np.inf
    if what in ("flat", "unlike"):
        views[1] = rng.normal(size=views[1].shape) * (what == "unlike")
    counts = 20_000 + 100 * views[:, None] * np.ones((1, 4, 1, 1)) * (1e30 if what == "huge" else 1)
    film = {"counts": (("band", "time", "y", "x"), counts)}
    capture = xr.Dataset(film, {"band": ["a", "b"], "time": clock(4)})

    def judge(found: xr.DataArray) -> Verdict:
        matrix = found.values[1] / found.values[1][2, 2]
        middle = matrix @ [columns / 2, rows / 2, 1]
        miss = middle[:2] / middle[2] - [columns / 2, rows / 2] - shift[::-1]
        return wrong(f"{what} view: {miss} pixels off", where=bool(np.abs(miss).max() > 0.5))

    names = ("view|image|pixel|correlation|counts|band",)
    return Attack(f"register {what}", lambda: alignment.register(capture), judge, names)


def correct_capture(rng: Rng) -> Attack:
    """`correct_capture` of captures and corrections damaged in each of their parts."""
    made = scene(rng, shape=(12, 16), time=clock(120))
    gain = 1 + 0.03 * rng.standard_normal(made.emissivity.shape)
    raw = np.clip(made.counts() / gain[:, None], 0, 65535).round().astype(np.uint16)
    parts = {"gain": gain, "offset": 0 * gain, "bad": np.zeros(gain.shape, bool)}
    maps = {n: (("band", "y", "x"), p) for n, p in parts.items()}
    fit = xr.Dataset(maps, {"band": list(made.bands)})
    recorded = replace(made, capture=made.with_counts(raw))
    what, given = hurt_one(rng, _CORRECTIONS, {"capture": recorded, "correction": fit})
    if isinstance(given["capture"], Scene):
        given["capture"] = recorded.capture

    def judge(result: xr.Dataset) -> Verdict:
        good = (result["status"] == 0) & np.isfinite(result["counts"])
        truth = made.capture["counts"].sel(band=result["band"])
        noise = xr.DataArray(made.noise, {"band": list(made.bands)}, "band")
        error = abs(result["counts"] - truth.values).where(good, 0)
        off = (error > noise.sel(band=result["band"]) + 2).values
        note = f"{off.sum()} samples off by up to {float(error.max()):.0f} counts"
        return wrong(note, where=bool(off.mean() > 1e-3))

    names = ("counts|gain|offset|bad|band|correction|capture|pixel|time|flag|shutter|frame",)
    act = lambda: correction.correct_capture(**given)  # noqa: E731
    good = what in ("capture nothing", "correction more bands")
    return Attack(f"correct_capture: {what}", act, judge, names, good)


def _value(rng: Rng, fit: xr.Dataset, value: float) -> xr.Dataset:
    """Another gain or offset of one pixel."""
    fit = fit.copy(deep=True)
    fit[pick(rng, ["gain", "offset"])][int(rng.integers(2)), 2, 3] = value
    return fit


def _flagged(rng: Rng, made: Scene) -> xr.Dataset:
    flags = rng.integers(0, 2, (2, made.time.size)).astype(np.uint16)
    attrs: dict[str, Any] = {"flag_masks": np.array([1], np.uint16), "flag_meanings": "other"}
    return made.capture.assign(frame_flags=(("band", "time"), flags, attrs))


def _wider(_: Rng, fit: xr.Dataset) -> xr.Dataset:
    return xr.concat([fit, fit.isel(band=[0]).assign_coords(band=["c"])], "band")


def _of_capture(damage: Callable[[Rng, Any], Any]) -> Callable[[Rng, Scene], Any]:
    return lambda rng, made: damage(rng, made.capture)


_RAW: Final = ("scattered full", "pixels full", "block held", "block zero", "everywhere held")
_CORRECTIONS: Final[Mapping[str, Table]] = {
    "capture": {
        "nothing": lambda _, made: made.capture,
        **{what: partial(band_spoilt, what=what) for what in _RAW},
        **{name: _of_capture(damage) for name, damage in ALL.items()},
        "counts in float": lambda _, made: made.capture.astype(float),
        "strange flags": _flagged,
        "few frames": lambda rng, made: made.capture.isel(time=slice(0, int(rng.integers(0, 3)))),
    },
    "correction": {
        **ALL,
        "gain NaN": partial(_value, value=np.nan),
        "gain infinite": partial(_value, value=np.inf),
        "more bands": _wider,
    },
}


def fit_response(rng: Rng) -> Attack:
    """`fit_response` of counts that saturate, are swapped, of another unit, or follow no curve."""
    bands, number = ("8-14", "9.5"), int(rng.choice([5, 8, 12]))
    temperature, noise = np.linspace(273.15, 343.15, number), float(rng.uniform(2, 6))
    counts = blackbody(bands, temperature)
    counts = counts + xr.DataArray(rng.normal(0, noise / 10, counts.shape), dims=counts.dims)
    counts.attrs["units"] = "count"
    what, spoilt = hurt(rng, _FITS, counts)
    given = xr.DataArray([noise, noise], dims="band", coords={"band": list(bands)})

    def judge(fitted: xr.Dataset) -> Verdict:
        off = 0.0
        for band in {*bands} & {*fitted["band"].values.tolist()}:
            found = responses.curve(fitted, band).inverse(counts_of(band, temperature))
            off = max(off, float(np.max(np.abs(np.nan_to_num(found - temperature, nan=99)))))
        return wrong(f"{off:.2f} K off", where=off > 0.1 + 5 * noise / SLOPE / 10)

    names = ("counts|temperature|band|residual|wavelength|noise|units|dims",)
    more: dict[str, Any] = {"noise": given} if rng.random() < 0.7 else {}
    act = lambda: calibration.fit_response(spoilt, **more)  # noqa: E731
    return Attack(f"fit_response: {what}, {sorted(more)}", act, judge, names, what == "good")


def _bent(rng: Rng, counts: xr.DataArray, bend: Callable[[Rng, Array, float], Any]) -> xr.DataArray:
    """Sweep of one band that follows no blackbody."""
    values, band = counts.values.copy(), int(rng.integers(2))
    values[band] = bend(rng, values[band], float(np.ptp(values[band])))
    return counts.copy(data=values)


def _swapped(rng: Rng, part: Array, _: float) -> Array:
    number = np.arange(part.size)
    order = np.argsort(number + 1.5 * (number == rng.integers(part.size - 1)))
    return np.asarray(part[order])


def _outlier(rng: Rng, part: Array, span: float) -> Array:
    size = pick(rng, [-1, 1]) * rng.uniform(0.02, 0.05) * span
    return np.asarray(part + size * (np.arange(part.size) == rng.integers(part.size)))


_BENT: Final[dict[str, Callable[[Rng, Array, float], Any]]] = {
    "saturates": lambda _, part, __: part - 0.95 * np.maximum(part - np.quantile(part, 0.7), 0),
    "outlier": _outlier,
    "swapped": _swapped,
    "no curve": lambda rng, p, span: p[0] + span * ((p - p[0]) / span) ** pick(rng, [0.5, 3, 6]),
    "wave": lambda _, part, span: part + 0.02 * span * np.sin(np.arange(part.size) * 2),
}
_FITS: Final[Table] = {
    **ALL,
    "good": lambda _, one: one,
    **{name: partial(_bent, bend=bend) for name, bend in _BENT.items()},
    "in degrees Celsius": lambda _, one: one.assign_coords(temperature=one["temperature"] - 273.15),
    "said to be Celsius": lambda _, one: one.assign_coords(
        temperature=one["temperature"].assign_attrs(units="degC")
    ),
    "some NaN": lambda rng, one: one.where(rng.random(one.shape) > 0.1),
    "falling": cut(temperature=TURNED),
    "three temperatures": cut(temperature=slice(0, 3)),
    "a temperature twice": cut(temperature=[0, 1, 1, 2, 3, 4]),
}
