"""Hostile arrays into the steps beside the separation: clocks, corrections, calibration, tables."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.oracle import Attack, Verdict
from attack.scenes import SLOPE, Array, Scene, blackbody, clock, counts_of, scene
from dbthermal import alignment, calibration, correction, emissivity, limits, metrics

Rng = np.random.Generator
RIGHT: Final = Verdict("right")


def wrong(note: str, *, where: bool = True) -> Verdict:
    """Silent, if it is so."""
    return Verdict("silent", note, 1, 1) if where else RIGHT


def offset(rng: Rng) -> Attack:
    """`time_offset` of bands with lost blocks, jumps of a clock, and offsets beyond the search."""
    delay = float(rng.uniform(-2, 2)) if rng.random() < 0.8 else float(rng.uniform(6, 9))
    made = _two_cameras(rng, delay, int(rng.integers(160, 350)))
    what = str(rng.choice(list(_LOSSES)))
    spoilt, ours = _LOSSES[what](rng, made)
    expected = delay + ours

    def judge(found: float) -> Verdict:
        error = abs(10 * found - expected)
        return wrong(f"{error:.2f} frames off where 0.1 is promised", where=error > 0.25)

    names = ("offset|time|frame|pixel|gap|clock|band",)
    what = f"time_offset of {delay:.1f} frames: {what}"
    return Attack(what, lambda: alignment.time_offset(spoilt), judge, names)


def aligned(rng: Rng) -> Attack:
    """`align` across lost blocks, an hour's pause, jumps of a clock, and foreign arguments."""
    delay = float(rng.uniform(-2, 2))
    made = _two_cameras(rng, delay, int(rng.integers(100, 300)))
    what = str(rng.choice(list(_LOSSES)))
    spoilt, ours = _LOSSES[what](rng, made)
    expected = (delay + ours) / 10
    given = rng.random() < 0.6

    def judge(result: xr.Dataset) -> Verdict:
        if abs(result.attrs["time_offset"][1] - expected) > 0.025:
            return wrong(f"offset {result.attrs['time_offset'][1]:.3f} s, truly {expected:.3f} s")
        return _compare(result, made)

    names = ("offset|time|frame|pixel|gap|clock|band",)
    more: dict[str, Any] = {"offset": expected, "clock": "9.5"} if given else {}
    what = f"align {delay:.1f} frames, {sorted(more)}: {what}"
    return Attack(what, lambda: alignment.align(spoilt, **more), judge, names)


def _two_cameras(rng: Rng, delay: float, frames: int) -> Scene:
    """Scene whose second camera exposes later, by frames of 0.1 s."""
    return scene(rng, shape=(8, 12), time=clock(frames), ratio=3.0, delay=delay / 10)


def _compare(result: xr.Dataset, made: Scene) -> Verdict:
    """Both bands on the second one's clock must show the scene of one moment."""
    clean = []
    for place, band in enumerate(made.bands):
        share = made.emissivity[place]
        x, y = made.warm, made.cold
        clean.append(share * counts_of(band, x) + (1 - share) * counts_of(band, y))
    counts = result["counts"].values
    error = np.full(len(made.bands), 0.0)
    for place, truth in enumerate(clean):
        times = result["time"].values
        at = np.stack([np.interp(times, made.time, one) for one in truth.reshape(len(truth), -1).T])
        inside = (times >= made.time[0]) & (times <= made.time[-1])
        difference = counts[place].reshape(times.size, -1)[inside] - at.T[inside]
        finite = np.abs(difference[np.isfinite(difference)])
        error[place] = np.quantile(finite, 0.99) if finite.size else 0.0
    # The line between two frames misses a moving body's edge by up to a kelvin.
    excess = error > 5 * made.noise + 1.5 * SLOPE
    return wrong(f"counts off by {error}, noise {made.noise}", where=bool(excess.any()))


def _block(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    counts, length = made.counts(), made.time.size
    first, lost = int(rng.integers(5, length // 2)), int(rng.choice([10, 30, length // 3]))
    counts[int(rng.integers(2)), first : first + lost] = np.nan
    return made.with_counts(counts).capture, 0.0


def _copied(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    counts, length = made.counts(), made.time.size
    first, lost = int(rng.integers(5, length // 2)), int(rng.choice([5, 20, 40]))
    counts[1, first : first + lost] = counts[1, first - 1]
    return made.with_counts(counts).capture, 0.0


def _stamped(made: Scene, second: Array, first: Array | None = None) -> xr.Dataset:
    stamps = np.stack([made.time if first is None else first, second])
    return made.capture.assign(exposure_time=(("band", "time"), stamps, {"units": "s"}))


def _half(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    """One camera begins late or ends early, with stamps that say so."""
    second, counts = made.time.copy(), made.counts()
    end = int(rng.integers(40, made.time.size))
    second[end:], counts[1, end:] = np.nan, np.nan
    return _stamped(made.with_counts(counts), second), 0.0


def _jump(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    """One camera loses frames with neither copy nor NaN, starts anew an hour later, or earlier."""
    frames = made.time.size
    place, lost = int(rng.integers(40, frames - 40)), int(rng.choice([5, 20]))
    second, counts = made.time.copy(), made.counts()
    later = float(rng.choice([0, -30, 3600]))
    if later:
        return _stamped(made, second + later * (np.arange(frames) >= place)), 0.0
    second[place : frames - lost] = second[place + lost :]
    counts[1, place : frames - lost] = counts[1, place + lost :]
    second[frames - lost :], counts[1, frames - lost :] = np.nan, np.nan
    return _stamped(made.with_counts(counts), second), 0.0


def _pause(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    """Both pause for an hour or a day; the scene waits."""
    place, length = (
        int(rng.integers(30, made.time.size - 30)),
        float(rng.choice([600, 3600, 86400])),
    )
    later = made.time + length * (np.arange(made.time.size) >= place)
    made.time = later
    return made.capture.assign_coords(time=("time", later, {"units": "s"})), 0.0


def _foreign(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    lost = rng.random(made.time.size) < 0.99
    return _stamped(made, np.where(lost, rng.choice([np.nan, np.inf]), made.time)), 0.0


def _scattered(rng: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    counts = made.counts()
    counts[rng.random(counts.shape) < 0.1] = np.nan
    return made.with_counts(counts).capture, 0.0


def _still(_: Rng, made: Scene) -> tuple[xr.Dataset, float]:
    counts = made.counts()
    counts[1] = counts[1].mean(axis=0)
    return made.with_counts(counts).capture, 0.0


_LOSSES: Final[Mapping[str, Callable[[Rng, Scene], tuple[xr.Dataset, float]]]] = {
    "nothing lost": lambda _, made: (made.capture, 0.0),
    "a block NaN": _block,
    "a block of copies": _copied,
    "one camera ends early": _half,
    "a clock jumps": _jump,
    "both pause": _pause,
    "stamps damaged": _foreign,
    "scattered NaN": _scattered,
    "one band still": _still,
    "stamps of that delay": lambda _, made: (
        _stamped(made, made.time + made.delay),
        -10 * made.delay,
    ),
}


def registered(rng: Rng) -> Attack:
    """`register` of small, NaN, flat and unlike views, and foreign transforms into `align`."""
    rows, columns = (int(rng.choice([8, 24, 40, 48])) for _ in range(2))
    x, y = np.meshgrid(np.arange(columns + 8), np.arange(rows + 8))
    texture = np.zeros(x.shape)
    for _ in range(12):
        texture += rng.normal() * np.sin(x * rng.uniform(0.05, 0.5) + y * rng.uniform(0.05, 0.5))
    shift = rng.integers(0, 3, 2)
    views = np.stack(
        [texture[4:-4, 4:-4], texture[4 - shift[0] :, 4 - shift[1] :][:rows, :columns]]
    )
    what = str(rng.choice(["good", "NaN", "infinite", "flat", "unlike", "huge"]))
    if what in ("NaN", "infinite"):
        views[1, rng.integers(rows), rng.integers(columns)] = np.nan if what == "NaN" else np.inf
    if what in ("flat", "unlike"):
        views[1] = rng.normal(size=views[1].shape) * (what == "unlike")
    counts = 20_000 + 100 * views[:, None] * np.ones((1, 4, 1, 1)) * (1e30 if what == "huge" else 1)
    capture = xr.Dataset(
        {"counts": (("band", "time", "y", "x"), counts)}, {"band": ["a", "b"], "time": clock(4)}
    )

    def judge(found: xr.DataArray) -> Verdict:
        matrix = found.values[1] / found.values[1][2, 2]
        middle = matrix @ [columns / 2, rows / 2, 1]
        miss = middle[:2] / middle[2] - [columns / 2, rows / 2] - shift[::-1]
        return wrong(f"{what} view: {miss} pixels off", where=bool(np.abs(miss).max() > 0.5))

    names = ("view|image|pixel|correlation|counts|band",)
    return Attack(f"register {what}", lambda: alignment.register(capture), judge, names)


def corrected(rng: Rng) -> Attack:
    """`correct_capture` of captures and corrections damaged in each of their parts."""
    made = scene(rng, shape=(12, 16), time=clock(120))
    gain = 1 + 0.03 * rng.standard_normal(made.emissivity.shape)
    raw = np.clip(made.counts() / gain[:, None], 0, 65535).round().astype(np.uint16)
    capture = made.with_counts(raw).capture
    maps = ("band", "y", "x")
    parts = {"gain": gain, "offset": 0 * gain, "bad": np.zeros(gain.shape, bool)}
    fit = xr.Dataset({n: (maps, p) for n, p in parts.items()}, {"band": list(made.bands)})
    what = str(rng.choice(list(_CORRECTIONS)))
    capture, fit = _CORRECTIONS[what](rng, capture, fit)

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


def _raw(rng: Rng, capture: xr.Dataset, spoil: str) -> xr.Dataset:
    counts = np.array(capture["counts"].values)
    frames = slice(int(rng.integers(10, 60)), int(rng.integers(62, 90)))
    band = int(rng.integers(2))
    if spoil == "saturated":
        counts[band] = np.where(rng.random(counts[band].shape) < 0.2, 65535, counts[band])
    elif spoil == "frozen":
        counts[band, frames] = counts[band, frames.start]
    elif spoil == "stuck":
        counts[band, :, 3, 4] = 65535
    elif spoil == "zero":
        counts[band, frames] = 0
    return capture.assign(counts=(capture["counts"].dims, counts, {"units": "count"}))


def _map_with(rng: Rng, fit: xr.Dataset, value: float) -> xr.Dataset:
    name = str(rng.choice(["gain", "offset"]))
    values = fit[name].values.copy()
    values[int(rng.integers(2)), 2, 3] = value
    return fit.assign({name: (fit[name].dims, values)})


def _flagged(rng: Rng, capture: xr.Dataset) -> xr.Dataset:
    flags = rng.integers(0, 2, (2, capture.sizes["time"])).astype(np.uint16)
    attrs: dict[str, Any] = {"flag_masks": np.array([1], np.uint16), "flag_meanings": "other"}
    return capture.assign(frame_flags=(("band", "time"), flags, attrs))


_CORRECTIONS: Final[Mapping[str, Callable[[Rng, xr.Dataset, xr.Dataset], Pair]]] = {
    "nothing": lambda _, one, fit: (one, fit),
    "saturated": lambda rng, one, fit: (_raw(rng, one, "saturated"), fit),
    "frozen": lambda rng, one, fit: (_raw(rng, one, "frozen"), fit),
    "a stuck pixel": lambda rng, one, fit: (_raw(rng, one, "stuck"), fit),
    "frames of zeros": lambda rng, one, fit: (_raw(rng, one, "zero"), fit),
    "gain NaN": lambda rng, one, fit: (one, _map_with(rng, fit, np.nan)),
    "gain infinite": lambda rng, one, fit: (one, _map_with(rng, fit, np.inf)),
    "of another size": lambda _, one, fit: (one, fit.isel(x=slice(0, 9))),
    "of other bands": lambda _, one, fit: (one, fit.assign_coords(band=["a", "b"])),
    "bands turned round": lambda _, one, fit: (one, fit.isel(band=[1, 0])),
    "more bands": lambda _, one, fit: (
        one,
        xr.concat([fit, fit.isel(band=[0]).assign_coords(band=["c"])], "band"),
    ),
    "of another window": lambda _, one, fit: (
        one.assign_coords(x=np.arange(16.0)),
        fit.assign_coords(x=np.arange(16.0) + 5),
    ),
    "counts in float": lambda _, one, fit: (one.assign(counts=one["counts"].astype(float)), fit),
    "no counts": lambda _, one, fit: (one.drop_vars("counts"), fit),
    "no bad": lambda _, one, fit: (one, fit.drop_vars("bad")),
    "strange flags": lambda rng, one, fit: (_flagged(rng, one), fit),
    "few frames": lambda rng, one, fit: (one.isel(time=slice(0, int(rng.integers(0, 3)))), fit),
}


def pixels(rng: Rng) -> Attack:
    """`mark_bad` and `find_shutter` of captures with scattered NaN, and with events to be found."""
    made = scene(rng, shape=(12, 16), time=clock(200))
    counts, blinking = made.counts(), (int(rng.integers(2, 10)), int(rng.integers(2, 14)))
    share, late = float(rng.choice([0, 0.01, 0.1, 0.3, 0.6])), int(rng.integers(90, 150))
    if rng.random() < 0.5:
        steps = rng.choice([0, 40], (200, 1)) * made.noise[0] * rng.choice([-1, 1], (200, 1))
        counts[0, :, blinking[0], blinking[1]] += steps[:, 0]
        counts[rng.random(counts.shape) < share] = np.nan
        spoilt = made.with_counts(counts).capture
        return Attack(
            f"mark_bad with {share:.0%} scattered NaN",
            lambda: correction.mark_bad(spoilt),
            lambda found: wrong(
                "a pixel that jumps is not marked", where=not int(found["status"][blinking])
            ),
            ("counts|frame|NaN|band",),
        )
    length = int(rng.integers(3, 12))
    counts[1, late : late + length] = counts[1, late - 1]
    if share:
        counts[rng.random(counts.shape) < share] = np.nan
    spoilt = made.with_counts(counts).capture

    def judge(events: xr.Dataset) -> Verdict:
        if share:  # copies that NaN breaks are no copies, and marked as missing
            return RIGHT
        found = (events["first_frame"].values.tolist(), events["frames"].values.tolist())
        return wrong(f"events {found}", where=found != ([late], [length]))

    what = f"find_shutter with {share:.0%} scattered NaN"
    return Attack(what, lambda: correction.find_shutter(spoilt), judge, ("counts|pixel|band",))


def response_fits(rng: Rng) -> Attack:
    """`fit_response` of counts that saturate, are swapped, of another unit, or follow no curve."""
    bands = ("8-14", "9.5")
    number = int(rng.choice([5, 8, 12]))
    temperature = np.linspace(273.15, 343.15, number)
    noise = float(rng.uniform(2, 6))
    counts = blackbody(bands, temperature)
    counts = counts + xr.DataArray(rng.normal(0, noise / 10, counts.shape), dims=counts.dims)
    counts.attrs["units"] = "count"
    what = str(rng.choice(list(_FITS)))
    spoilt = _FITS[what](rng, counts)
    given = xr.DataArray([noise, noise], dims="band", coords={"band": list(bands)})

    def judge(fitted: xr.Dataset) -> Verdict:
        from dbthermal import response  # noqa: PLC0415 - the room, where a name would hide it

        off = 0.0
        for band in bands:
            truth = counts_of(band, temperature)
            found = response.curve(fitted, band).inverse(truth)
            off = max(off, float(np.max(np.abs(np.nan_to_num(found - temperature, nan=99)))))
        return wrong(f"{off:.2f} K off", where=off > 0.1 + 5 * noise / SLOPE / 10)

    names = ("counts|temperature|band|residual|wavelength|noise|units|dims",)
    more: dict[str, Any] = {"noise": given} if rng.random() < 0.7 else {}
    act = lambda: calibration.fit_response(spoilt, **more)  # noqa: E731
    return Attack(f"fit_response: {what}, {sorted(more)}", act, judge, names, what == "good")


def _bent(rng: Rng, counts: xr.DataArray, spoil: str) -> xr.DataArray:
    values = counts.values.copy()
    number, band = values.shape[1], int(rng.integers(2))
    place = int(rng.integers(number))
    span = np.ptp(values[band])
    if spoil == "saturates":
        knee = np.quantile(values[band], 0.7)
        values[band] = np.where(
            values[band] > knee, knee + (values[band] - knee) * 0.05, values[band]
        )
    elif spoil == "outlier":
        values[band, place] += rng.choice([-1, 1]) * rng.uniform(0.02, 0.05) * span
    elif spoil == "swapped":
        other = (place + 1) % number
        values[band, [place, other]] = values[band, [other, place]]
    elif spoil == "no curve":
        share = (values[band] - values[band, 0]) / span
        values[band] = values[band, 0] + span * share ** float(rng.choice([0.5, 3, 6]))
    elif spoil == "wave":
        values[band] += 0.02 * span * np.sin(np.arange(number) * 2)
    return counts.copy(data=values)


_FITS: Final[Mapping[str, Callable[[Rng, xr.DataArray], Any]]] = {
    "good": lambda _, one: one,
    **{
        name: partial(_bent, spoil=name)
        for name in ("saturates", "outlier", "swapped", "no curve", "wave")
    },
    "in degrees Celsius": lambda _, one: one.assign_coords(
        temperature=one["temperature"].values - 273.15
    ),
    "kelvin off by one degree Celsius": lambda _, one: one.assign_coords(
        temperature=("temperature", one["temperature"].values, {"units": "degC"})
    ),
    "a value NaN": lambda rng, one: one.where(rng.random(one.shape) > 0.1),
    "falling": lambda _, one: one.isel(temperature=slice(None, None, -1)),
    "three temperatures": lambda _, one: one.isel(temperature=slice(0, 3)),
    "a temperature twice": lambda _, one: one.isel(temperature=[0, 1, 1, 2, 3, 4]),
    "text": lambda _, one: one.astype(str),
    "transposed": lambda _, one: one.transpose(),
    "no array": lambda _, one: one.values,
    "another unit": lambda _, one: one.assign_attrs(units="W"),
}


def tables(rng: Rng) -> Attack:
    """`emissivity.band_table` of damaged spectra, and `limits.plan` of damaged tables and noise."""
    wavelength = np.linspace(6e-6, 16e-6, 60)
    values = np.clip(0.8 + 0.15 * np.sin(wavelength * 1e6 * rng.uniform(0.3, 2)), 0.05, 0.99)
    what = str(rng.choice(list(_SPECTRA)))
    x, y = _SPECTRA[what](rng, wavelength, values)
    spectrum = xr.Dataset(
        {"emissivity": ("wavelength", y, {"units": "1"})}, {"wavelength": ("wavelength", x)}
    )

    def judge(table: xr.Dataset) -> Verdict:
        found = table["emissivity"].values[0]
        low, high = float(np.nanmin(y)), float(np.nanmax(y))
        inside = np.all((found >= low - 1e-9) & (found <= high + 1e-9)) and what in (
            "good",
            "coarse",
        )
        return wrong(f"accepted: {found}", where=not inside)

    names = ("glass|emissivity|wavelength|coverage|covers",)
    act = lambda: emissivity.band_table({"glass": spectrum}, ["8-14", "9.5"])  # noqa: E731
    return Attack(f"band_table: {what}", act, judge, names, what == "good")


_SPECTRA: Final[Mapping[str, Callable[[Rng, Array, Array], tuple[Any, Any]]]] = {
    "good": lambda _, x, y: (x, y),
    "coarse": lambda _, x, y: (x[::6], y[::6]),
    "in micrometres": lambda _, x, y: (x * 1e6, y),
    "in percent": lambda _, x, y: (x, y * 100),
    "short": lambda _, x, y: (x[:30], y[:30]),
    "falling": lambda _, x, y: (x[::-1], y[::-1]),
    "wavelength NaN": lambda rng, x, y: (np.where(rng.random(60) < 0.1, np.nan, x), y),
    "emissivity NaN": lambda rng, x, y: (x, np.where(np.arange(60) == rng.integers(60), np.nan, y)),
    "infinite": lambda rng, x, y: (x, np.where(np.arange(60) == rng.integers(60), np.inf, y)),
    "negative": lambda _, x, y: (x, -y),
    "text": lambda _, x, y: (x, y.astype(str)),
    "empty": lambda _, x, y: (x[:0], y[:0]),
}


def plans(rng: Rng) -> Attack:
    """`limits.plan` of damaged tables, noise and designs."""
    table = emissivity.embedded_table().isel(material=slice(0, 4))
    bands = [str(band) for band in table["band"].values]
    noise = xr.DataArray(
        rng.uniform(0.03, 0.4, len(bands)),
        dims="band",
        coords={"band": bands},
        attrs={"units": "K"},
    )
    kind = str(
        rng.choice(["NaN", "infinite", "zero", "negative", "unit", "bands", "order", "text"])
    )
    if kind in ("NaN", "infinite", "zero", "negative"):
        value = {"NaN": np.nan, "infinite": np.inf, "zero": 0.0, "negative": -0.1}[kind]
        if rng.random() < 0.5:
            noise[int(rng.integers(len(bands)))] = value
        else:
            table["emissivity"][1, int(rng.integers(len(bands)))] = value
    elif kind == "unit":
        noise.attrs["units"] = "count"
    elif kind == "bands":
        noise = noise.isel(band=slice(0, -1))
    elif kind == "text":
        noise = noise.astype(str)
    else:
        noise = noise.isel(band=slice(None, None, -1))
    names = ("noise|emissivity|band|table",)
    return Attack(
        f"plan: {kind}",
        lambda: limits.plan(table, noise),
        lambda _: wrong(f"{kind} accepted", where=kind != "order"),
        names,
        kind == "order",
    )


def measures(rng: Rng) -> Attack:
    """`metrics` of maps of other windows, types and with NaN."""
    dims, shape = ("time", "y", "x"), (3, 6, 8)
    coords = {"time": clock(3), "y": np.arange(6.0), "x": np.arange(8.0)}
    truth = xr.DataArray(rng.normal(300, 5, shape), coords, dims, attrs={"units": "K"})
    other = truth + rng.normal(0, 0.1, shape)
    other.attrs["units"] = "K"
    kind = str(rng.choice(["good", "window", "size", "dims", "text", "unit", "type", "constant"]))
    changes: dict[str, Callable[[], Any]] = {
        "window": lambda: other.assign_coords(x=other["x"] + 3),
        "size": lambda: other.isel(x=slice(0, 5)),
        "dims": lambda: other.rename(x="column"),
        "text": lambda: other.astype(str),
        "unit": lambda: other.assign_attrs(units="degC"),
        "type": lambda: other.values,
        "constant": lambda: 0 * other + 300,
    }
    changed = changes.get(kind, lambda: other)()
    first = rng.random() < 0.5
    function = metrics.correlation if first else metrics.relative_error_celsius
    # The one takes maps of any unit, the other dims of any name.
    fine = kind in ("good", "constant", "unit" if first else "dims")
    return Attack(
        f"{function.__name__}: {kind}",
        lambda: function(changed, truth),
        lambda _: wrong(f"{kind} accepted", where=not fine),
        ("dims|sizes|coordinate|'x'|unit|type|dtype|map|temperature|estimate|shape",),
        kind == "good",
    )
