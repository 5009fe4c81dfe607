"""One hostile argument into each of the other public steps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.arrays import Rng, response_of
from attack.oracle import Attack, Verdict
from attack.scenes import blackbody, clock, counts_of, pick, scene
from attack.stages import RIGHT, wrong
from dbthermal import calibration, correction, emissivity, limits, metrics, response, separation


@dataclass(frozen=True)
class Step:
    """
    A call, and its arguments.

    Those in `windowed` must lie on the same coordinates as another one; of those in `partly` a
    sample may stay unused.
    """

    call: Callable[..., Any]
    arguments: Mapping[str, Any]
    windowed: tuple[str, ...] = ()
    partly: tuple[str, ...] = ()


_USED: Final = ["background_temperature", "emissivity", "status"]
"""Variables of a result that `reflected_change` looks at."""


@cache
def _steps() -> Mapping[str, Step]:
    """Steps by name, with arguments that they accept."""
    rng = np.random.default_rng(1)
    made = scene(rng, shape=(12, 16), time=clock(80), ratio=4.0)
    place = {"y": np.arange(12.0) + 3, "x": np.arange(16.0) + 7}
    corrected = made.capture.assign_coords(place)
    curves, maps = response_of(made), ("band", "y", "x")
    gain = xr.DataArray(1 + 0.02 * rng.normal(size=(2, 12, 16)), dims=maps, attrs={"units": "1"})
    parts = {"gain": gain, "offset": 0 * gain, "bad": gain < 0}
    fit = xr.Dataset(parts, {"band": list(made.bands), **place})
    fit["offset"].attrs["units"] = "count"
    raw = corrected.assign(counts=corrected["counts"].round().astype(np.uint16))
    flat = corrected["counts"].mean("time").assign_attrs(units="count")
    rest = xr.DataArray(np.zeros((12, 16), bool), place, ("y", "x"))
    rest[:4] = True
    levels = blackbody(made.bands, np.array([283.0, 303.0, 323.0]))
    noise = xr.DataArray(
        rng.normal(0, 4, (2, 3, 20, 12, 16)), dims=(*levels.dims, "frame", "y", "x")
    )
    movies = xr.Dataset({"counts": (levels + noise).assign_attrs(units="count")})
    frames = movies.mean("frame", keep_attrs=True)
    warm, cold = 300 + 3 * np.arange(8.0), np.full(8, 280.0)
    signal = [0.9 * counts_of(b, warm) + 0.1 * counts_of(b, cold) for b in made.bands]
    foil = [counts_of(b, cold) for b in made.bands]
    dims, kelvin = ("band", "measurement"), {"units": "K"}
    contact = {
        "counts": (dims, signal, {"units": "count"}),
        "object_temperature": ("measurement", warm, kelvin),
    }
    names = {"band": list(made.bands)}
    bench = xr.Dataset({**contact, "background_temperature": ("measurement", cold, kelvin)}, names)
    reflector = xr.Dataset({**contact, "reflected_counts": (dims, foil, {"units": "count"})}, names)
    result = separation.solve(corrected, curves)
    apparent = response.apparent_temperature(curves, corrected["counts"])
    table = emissivity.embedded_table()
    netd = emissivity.filter_noise(0.03, [str(band) for band in table["band"].values])
    truth = xr.Dataset(
        {
            "object_temperature": (("time", "y", "x"), made.warm, kelvin),
            "background_temperature": (("time", "y", "x"), made.cold, kelvin),
            "emissivity": (maps, made.emissivity, {"units": "1"}),
        },
        {"band": list(made.bands), "time": made.time},
    )
    std = (0.1, 0.1)
    fixed = {"response": curves, "reading_std": std}
    wavelength = np.linspace(6e-6, 16e-6, 60)
    values = ("wavelength", 0.8 + 0.15 * np.sin(wavelength * 1e6), {"units": "1"})
    spectrum = xr.Dataset({"emissivity": values}, {"wavelength": wavelength})
    map_, other = truth["object_temperature"], truth["object_temperature"] + 0.1
    pair = [one.assign_coords(place).assign_attrs(kelvin) for one in (other, map_)]
    errors = dict(zip(("estimate", "truth"), pair, strict=True))
    maps_of_any_unit = dict(
        zip(("first", "second"), map(xr.DataArray.drop_attrs, pair), strict=True)
    )
    materials = {"result": result, "corrected": corrected, "response": curves}
    calls: list[tuple[Callable[..., Any], dict[str, Any], str]] = [
        (correction.blackbody_statistics, {"movies": movies}, ""),
        (correction.fit_correction, {"blackbody": frames}, ""),
        (correction.renew_offset, {"correction": fit, "flat": flat}, "flat"),
        (correction.correct, {"capture": raw, "correction": fit}, "correction"),
        (correction.undo_lag, {"corrected": corrected, "time_constant": 0.01}, ""),
        (correction.undo_drift, {"corrected": corrected, "reference": rest}, "reference"),
        (calibration.fit_emissivity, {"measured": bench, **fixed}, ""),
        (calibration.reflector_emissivity, {"measured": reflector, **fixed}, ""),
        (response.apparent_temperature, {"response": curves, "counts": corrected["counts"]}, ""),
        (separation.reflected_change, {"apparent": apparent, "result": result[_USED]}, "result"),
        (separation.materials, materials, "result"),
        (limits.bounds, {"scene": truth, "response": curves}, ""),
        (limits.plan, {"table": table, "noise": netd}, ""),
        (emissivity.condition_numbers, {"table": table}, ""),
        (emissivity.rank_filters, {"table": table, "noise": netd}, ""),
        (_band_table, {"spectrum": spectrum}, ""),
        (metrics.correlation, maps_of_any_unit, "first"),
        (metrics.relative_error_celsius, errors, "estimate"),
    ]
    # Used where the object is constant, and where there is no flag.
    partly = {"reflected_change": ("apparent",), "materials": ("result", "corrected")}
    return {
        call.__name__: Step(call, arguments, (*windowed.split(),), partly.get(call.__name__, ()))
        for call, arguments, windowed in calls
    }


def _band_table(spectrum: Any) -> xr.Dataset:
    """Band emissivities of one spectrum."""
    return emissivity.band_table({"glass": spectrum}, ["8-14", "9.5"])


def steps(rng: Rng) -> Attack:
    """One argument of a step damaged: values, type, unit, dims, bands, coordinates."""
    name = pick(rng, sorted(_steps()))
    step = _steps()[name]
    arrays = [n for n, one in step.arguments.items() if isinstance(one, xr.Dataset | xr.DataArray)]
    argument, what = pick(rng, arrays), pick(rng, sorted(_DAMAGES))
    given = step.arguments[argument]
    with np.errstate(all="ignore"):
        spoilt = _DAMAGES[what](rng, given)
    clean = step.call(**step.arguments)

    def judge(found: Any) -> Verdict:
        if what == "bands turned round":
            named = {"band", "filter"} & {*getattr(found, "coords", ())}
            ordered = found.sel({dim: clean[dim].values for dim in named})
            return wrong("other values", where=bool(named) and not _close(ordered, clean))
        if _close(found, clean):
            return wrong(f"{what} made no difference", where=_demanded(step, argument, what))
        if what in ("NaN", "infinite") and _lost(found) > _lost(clean):
            return Verdict("flagged")
        return RIGHT if what in ("another window", "bands turned round") else wrong("other values")

    return Attack(
        f"{name}: {argument} {what}",
        lambda: step.call(**{**step.arguments, argument: spoilt}),
        judge,
        (f"{argument}|{'|'.join(_WORDS)}",),
    )


def _demanded(step: Step, argument: str, what: str) -> bool:
    """Whether damage must not pass: it contradicts another argument, or the argument itself."""
    if what == "another window":
        return argument in step.windowed
    if what == "of other bands":
        return sum("band" in getattr(one, "dims", ()) for one in step.arguments.values()) > 1
    if what in _DIFFERENT and argument in step.partly:
        return False
    if what == "of another unit":
        return "units" in str(_first(step.arguments[argument]).attrs)
    return what in _DIFFERENT


def _first(one: Any) -> Any:
    """The array, or the first variable of a dataset that has dims."""
    return one if isinstance(one, xr.DataArray) else next(v for v in one.values() if v.dims)


def _close(first: Any, second: Any) -> bool:
    """The same values, whatever their coordinates of pixels."""
    if isinstance(first, xr.Dataset):
        return set(first) == set(second) and all(_close(first[n], second[n]) for n in first)
    first = first.transpose(*second.dims) if {*first.dims} == {*second.dims} else first
    same = first.dims == second.dims and first.shape == second.shape
    if not same or first.dtype.kind not in "fiub":
        return bool(same)
    return bool(np.allclose(first.values, second.values, rtol=1e-5, atol=1e-6, equal_nan=True))


def _lost(found: Any) -> int:
    """Number of values that are not finite, or marked."""
    if isinstance(found, xr.Dataset):
        return sum(_lost(found[name]) for name in found)
    if found.dtype.kind == "f":
        return int((~np.isfinite(found.values)).sum())
    return int(found.isnull().sum()) + int((found.values != 0).sum() if found.dtype == bool else 0)


def _each(change: Callable[[xr.DataArray], xr.DataArray]) -> Callable[[Rng, Any], Any]:
    """Change an array, or the first variable of a dataset that has dims."""

    def damage(_: Rng, one: Any) -> Any:
        if isinstance(one, xr.DataArray):
            return change(one)
        array = _first(one)
        return one.assign({array.name: change(array).variable})

    return damage


def _hole(array: xr.DataArray, value: float = np.nan) -> xr.DataArray:
    values = array.values.astype(float)
    values[(1,) * values.ndim] = value
    return array.copy(data=values)


def _moved(_: Rng, one: Any) -> Any:
    return one.assign_coords({dim: one[dim] + 20 for dim in ("y", "x") if dim in one.coords})


def _without_bands(_: Rng, one: Any) -> Any:
    named = "band" in one.coords
    return one.assign_coords(band=["a", "b", "c", "d", "e"][: one.sizes["band"]]) if named else one


def _turned(_: Rng, one: Any) -> Any:
    return one.isel(band=slice(None, None, -1)) if "band" in one.dims else one


_DAMAGES: Final[Mapping[str, Callable[[Rng, Any], Any]]] = {
    "NaN": _each(_hole),
    "infinite": _each(lambda one: _hole(one, np.inf)),
    "text": _each(lambda one: one.astype(str)),
    "complex": _each(lambda one: one.astype(complex)),
    "times": _each(lambda one: one.astype(int).astype("datetime64[s]")),
    "of another unit": _each(lambda one: one.assign_attrs(units="furlong")),
    "transposed": _each(xr.DataArray.transpose),
    "type": lambda rng, _: pick(rng, [None, "text", [[1.0]], np.ones((2, 3)), {}]),
    "another window": _moved,
    "of other bands": _without_bands,
    "bands turned round": _turned,
}
_DIFFERENT: Final = ("NaN", "infinite", "complex", "text", "times")
_WORDS: Final = (
    *("counts", "band", "gain", "offset", "bad", "dims", "units", "emissivity", "temperature"),
    *("amplitude", "noise", "pixel", "material", "reference", "Dataset", "DataArray", "type"),
)
