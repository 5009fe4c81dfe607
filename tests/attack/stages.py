"""Hostile arrays into the steps beside the separation: clocks, corrections, calibration."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.oracle import Attack, Verdict
from attack.scenes import SLOPE, Array, Scene, blackbody, clock, counts_of, scene
from dbthermal import alignment, calibration, correction
from dbthermal import response as responses

Rng = np.random.Generator
RIGHT: Final = Verdict("right")
_CLOCK: Final = ("offset|time|frame|pixel|gap|clock|band",)


def wrong(note: str, *, where: bool = True) -> Verdict:
    """Silent, if it is so."""
    return Verdict("silent", note, 1, 1) if where else RIGHT


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
        return _compare(result, made)

    more: dict[str, Any] = {"offset": expected, "clock": "9.5"} if given else {}
    what = f"align {delay:.1f} frames, {sorted(more)}: {what}"
    return Attack(what, lambda: alignment.align(spoilt, **more), judge, _CLOCK)


def _cameras(rng: Rng, delay: float, frames: int) -> tuple[str, Scene, xr.Dataset, float]:
    """Loss, scene whose second camera exposes later, its capture with the loss, frames to find."""
    made = scene(rng, shape=(8, 12), time=clock(frames), ratio=3.0, delay=delay / 10)
    what = str(rng.choice(list(_LOSSES)))
    return what, made, _LOSSES[what](rng, made), 0.0 if what == "stamps of that delay" else delay


def _compare(result: xr.Dataset, made: Scene) -> Verdict:
    """Both bands on the second one's clock must show the scene of one moment."""
    counts, times = result["counts"].values, result["time"].values
    inside = (times >= made.time[0]) & (times <= made.time[-1])
    error = np.full(len(made.bands), 0.0)
    for place, band in enumerate(made.bands):
        share = made.emissivity[place]
        truth = share * counts_of(band, made.warm) + (1 - share) * counts_of(band, made.cold)
        at = np.stack([np.interp(times, made.time, one) for one in truth.reshape(len(truth), -1).T])
        difference = counts[place].reshape(times.size, -1)[inside] - at.T[inside]
        finite = np.abs(difference[np.isfinite(difference)])
        error[place] = np.quantile(finite, 0.99) if finite.size else 0.0
    # The line between two frames misses a moving body's edge by up to a kelvin.
    excess = error > 5 * made.noise + 1.5 * SLOPE
    return wrong(f"counts off by {error}, noise {made.noise}", where=bool(excess.any()))


def _block(rng: Rng, made: Scene) -> xr.Dataset:
    length = made.time.size
    first, lost = int(rng.integers(5, length // 2)), int(rng.choice([10, 30, length // 3]))
    return made.put((int(rng.integers(2)), slice(first, first + lost)), np.nan)


def _copied(rng: Rng, made: Scene) -> xr.Dataset:
    first, lost = int(rng.integers(5, made.time.size // 2)), int(rng.choice([5, 20, 40]))
    return made.put((1, slice(first, first + lost)), lambda counts: counts[1, first - 1])


def _stamped(capture: xr.Dataset, made: Scene, second: Array) -> xr.Dataset:
    stamps = (("band", "time"), np.stack([made.time, second]), {"units": "s"})
    return capture.assign(exposure_time=stamps)


def _half(rng: Rng, made: Scene) -> xr.Dataset:
    """One camera begins late or ends early, with stamps that say so."""
    end = int(rng.integers(40, made.time.size))
    second = np.where(np.arange(made.time.size) < end, made.time, np.nan)
    return _stamped(made.put((1, slice(end, None)), np.nan), made, second)


def _jump(rng: Rng, made: Scene) -> xr.Dataset:
    """One camera loses frames with neither copy nor NaN, starts anew an hour later, or earlier."""
    frames = made.time.size
    place, lost = int(rng.integers(40, frames - 40)), int(rng.choice([5, 20]))
    second, counts = made.time.copy(), made.counts()
    later = float(rng.choice([0, -30, 3600]))
    if later:
        return _stamped(made.capture, made, second + later * (np.arange(frames) >= place))
    for values in (second, counts[1]):
        values[place : frames - lost] = values[place + lost :]
        values[frames - lost :] = np.nan
    return _stamped(made.with_counts(counts).capture, made, second)


def _pause(rng: Rng, made: Scene) -> xr.Dataset:
    """Both pause for an hour or a day; the scene waits."""
    place = int(rng.integers(30, made.time.size - 30))
    length = float(rng.choice([600, 3600, 86400]))
    made.time = made.time + length * (np.arange(made.time.size) >= place)
    return made.capture.assign_coords(time=("time", made.time, {"units": "s"}))


def _foreign(rng: Rng, made: Scene) -> xr.Dataset:
    lost = rng.random(made.time.size) < 0.99
    return _stamped(made.capture, made, np.where(lost, rng.choice([np.nan, np.inf]), made.time))


_LOSSES: Final[Mapping[str, Callable[[Rng, Scene], xr.Dataset]]] = {
    "nothing lost": lambda _, made: made.capture,
    "a block NaN": _block,
    "a block of copies": _copied,
    "one camera ends early": _half,
    "a clock jumps": _jump,
    "both pause": _pause,
    "stamps damaged": _foreign,
    "scattered NaN": lambda rng, made: made.put(rng.random(made.counts().shape) < 0.1, np.nan),
    "one band still": lambda _, made: made.put(1, lambda counts: counts[1].mean(axis=0)),
    "stamps of that delay": lambda _, m: _stamped(m.capture, m, m.time + m.delay),
}


def register(rng: Rng) -> Attack:
    """`register` of small, NaN, flat and unlike views, and foreign transforms into `align`."""
    rows, columns = (int(rng.choice([8, 24, 40, 48])) for _ in range(2))
    x, y = np.meshgrid(np.arange(columns + 8), np.arange(rows + 8))
    texture = np.zeros(x.shape)
    for _ in range(12):
        texture += rng.normal() * np.sin(x * rng.uniform(0.05, 0.5) + y * rng.uniform(0.05, 0.5))
    shift = rng.integers(0, 3, 2)
    moved = texture[4 - shift[0] :, 4 - shift[1] :][:rows, :columns]
    views = np.stack([texture[4:-4, 4:-4], moved])
    what = str(rng.choice(["good", "NaN", "infinite", "flat", "unlike", "huge"]))
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
    what = str(rng.choice(list(_CORRECTIONS)))
    capture, fit = _CORRECTIONS[what](rng, made.with_counts(raw), fit)

    def judge(result: xr.Dataset) -> Verdict:
        good = (result["status"].values == 0)[None, None] & np.isfinite(result["counts"].values)
        error = np.abs(np.where(good, result["counts"].values - made.counts(), 0))
        off = error > made.noise[:, None, None, None] + 2
        note = f"{off.sum()} samples off by up to {error.max():.0f} counts"
        return wrong(note, where=bool(off.mean() > 1e-3))

    names = ("counts|gain|offset|bad|band|correction|capture|pixel|time|flag|shutter|frame",)
    act = lambda: correction.correct_capture(capture, fit)  # noqa: E731
    return Attack(f"correct_capture: {what}", act, judge, names, what in ("nothing", "more bands"))


Pair = tuple[xr.Dataset, xr.Dataset]


def _raw(rng: Rng, made: Scene, fit: xr.Dataset, *, spoil: str) -> Pair:
    """Counts of one band spoilt."""
    first, end, band = (int(rng.integers(*ends)) for ends in ((10, 60), (62, 90), (0, 2)))
    if spoil == "saturated":
        return made.put((band, rng.random(made.counts()[band].shape) < 0.2), 65535), fit
    if spoil == "stuck":
        return made.put((band, slice(None), 3, 4), 65535), fit
    value = 0 if spoil == "zero" else lambda counts: counts[band, first]
    return made.put((band, slice(first, end)), value), fit


def _map_with(rng: Rng, made: Scene, fit: xr.Dataset, *, value: float) -> Pair:
    name = str(rng.choice(["gain", "offset"]))
    values = fit[name].values.copy()
    values[int(rng.integers(2)), 2, 3] = value
    return made.capture, fit.assign({name: (fit[name].dims, values)})


def _flagged(rng: Rng, made: Scene, fit: xr.Dataset) -> Pair:
    flags = rng.integers(0, 2, (2, made.time.size)).astype(np.uint16)
    attrs: dict[str, Any] = {"flag_masks": np.array([1], np.uint16), "flag_meanings": "other"}
    return made.capture.assign(frame_flags=(("band", "time"), flags, attrs)), fit


def _wider(_: Rng, made: Scene, fit: xr.Dataset) -> Pair:
    other = fit.isel(band=[0]).assign_coords(band=["c"])
    return made.capture, xr.concat([fit, other], "band")


def _elsewhere(_: Rng, made: Scene, fit: xr.Dataset) -> Pair:
    columns = np.arange(16.0)
    return made.capture.assign_coords(x=columns), fit.assign_coords(x=columns + 5)


_CORRECTIONS: Final[Mapping[str, Callable[[Rng, Scene, xr.Dataset], Pair]]] = {
    "nothing": lambda _, made, fit: (made.capture, fit),
    "saturated": partial(_raw, spoil="saturated"),
    "frozen": partial(_raw, spoil="frozen"),
    "a stuck pixel": partial(_raw, spoil="stuck"),
    "frames of zeros": partial(_raw, spoil="zero"),
    "gain NaN": partial(_map_with, value=np.nan),
    "gain infinite": partial(_map_with, value=np.inf),
    "of another size": lambda _, made, fit: (made.capture, fit.isel(x=slice(0, 9))),
    "of other bands": lambda _, made, fit: (made.capture, fit.assign_coords(band=["a", "b"])),
    "bands turned round": lambda _, made, fit: (made.capture, fit.isel(band=[1, 0])),
    "more bands": _wider,
    "of another window": _elsewhere,
    "counts in float": lambda _, made, fit: (made.capture.astype(float), fit),
    "no counts": lambda _, made, fit: (made.capture.drop_vars("counts"), fit),
    "no bad": lambda _, made, fit: (made.capture, fit.drop_vars("bad")),
    "strange flags": _flagged,
    "few frames": lambda rng, m, fit: (m.capture.isel(time=slice(0, int(rng.integers(0, 3)))), fit),
}


def fit_response(rng: Rng) -> Attack:
    """`fit_response` of counts that saturate, are swapped, of another unit, or follow no curve."""
    bands, number = ("8-14", "9.5"), int(rng.choice([5, 8, 12]))
    temperature, noise = np.linspace(273.15, 343.15, number), float(rng.uniform(2, 6))
    counts = blackbody(bands, temperature)
    counts = counts + xr.DataArray(rng.normal(0, noise / 10, counts.shape), dims=counts.dims)
    counts.attrs["units"] = "count"
    what = str(rng.choice(list(_FITS)))
    spoilt = _FITS[what](rng, counts)
    given = xr.DataArray([noise, noise], dims="band", coords={"band": list(bands)})

    def judge(fitted: xr.Dataset) -> Verdict:
        off = 0.0
        for band in bands:
            found = responses.curve(fitted, band).inverse(counts_of(band, temperature))
            off = max(off, float(np.max(np.abs(np.nan_to_num(found - temperature, nan=99)))))
        return wrong(f"{off:.2f} K off", where=off > 0.1 + 5 * noise / SLOPE / 10)

    names = ("counts|temperature|band|residual|wavelength|noise|units|dims",)
    more: dict[str, Any] = {"noise": given} if rng.random() < 0.7 else {}
    act = lambda: calibration.fit_response(spoilt, **more)  # noqa: E731
    return Attack(f"fit_response: {what}, {sorted(more)}", act, judge, names, what == "good")


def _bent(rng: Rng, counts: xr.DataArray, spoil: str) -> xr.DataArray:
    """Sweep of one band that follows no blackbody."""
    values = counts.values.copy()
    number, part = values.shape[1], values[int(rng.integers(2))]
    place, span = int(rng.integers(number)), np.ptp(part)
    if spoil == "saturates":
        knee = np.quantile(part, 0.7)
        part[:] = np.where(part > knee, knee + (part - knee) * 0.05, part)
    elif spoil == "outlier":
        part[place] += rng.choice([-1, 1]) * rng.uniform(0.02, 0.05) * span
    elif spoil == "swapped":
        part[[place, (place + 1) % number]] = part[[(place + 1) % number, place]]
    elif spoil == "no curve":
        part[:] = part[0] + span * ((part - part[0]) / span) ** float(rng.choice([0.5, 3, 6]))
    elif spoil == "wave":
        part += 0.02 * span * np.sin(np.arange(number) * 2)
    return counts.copy(data=values)


def _celsius(_: Rng, counts: xr.DataArray, zero: float = 0.0) -> xr.DataArray:
    kelvin = counts["temperature"].values
    attrs = {} if zero else {"units": "degC"}
    return counts.assign_coords(temperature=("temperature", kelvin - zero, attrs))


_BENT: Final = ("saturates", "outlier", "swapped", "no curve", "wave")
_FITS: Final[Mapping[str, Callable[[Rng, xr.DataArray], Any]]] = {
    "good": lambda _, one: one,
    **{name: partial(_bent, spoil=name) for name in _BENT},
    "in degrees Celsius": partial(_celsius, zero=273.15),
    "kelvin off by one degree Celsius": _celsius,
    "a value NaN": lambda rng, one: one.where(rng.random(one.shape) > 0.1),
    "falling": lambda _, one: one.isel(temperature=slice(None, None, -1)),
    "three temperatures": lambda _, one: one.isel(temperature=slice(0, 3)),
    "a temperature twice": lambda _, one: one.isel(temperature=[0, 1, 1, 2, 3, 4]),
    "text": lambda _, one: one.astype(str),
    "transposed": lambda _, one: one.transpose(),
    "no array": lambda _, one: one.values,
    "another unit": lambda _, one: one.assign_attrs(units="W"),
}
