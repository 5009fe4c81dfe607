"""One hostile argument into each of the other public steps."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
import xarray as xr

from attack.damage import FORMS, VALUED, Rng, first, hurt_one
from attack.oracle import Attack, Verdict, wrong
from attack.scenes import pick
from dbthermal import calibration, correction, emissivity, limits, separation, simulation
from dbthermal import response as responses
from reproduction.experiments.bench import contact_measurements
from reproduction.filters import condition_numbers, rank_filters


@dataclass(frozen=True)
class Step:
    """
    A call, and its arguments.

    Those in `windowed` must lie on the same coordinates as another one; of those in `partly` a
    sample may stay unused.
    """

    call: Callable[..., Any]
    arguments: Mapping[str, Any]
    windowed: str = ""
    partly: tuple[str, ...] = ()


@cache
def _steps() -> Mapping[str, Step]:
    """Steps by name, with arguments that they accept."""
    rng, shape, rig = np.random.default_rng(1), (12, 16), simulation.Rig(bad_fraction=0.0)
    place, curves = {"y": np.arange(12.0) + 3, "x": np.arange(16.0) + 7}, rig.response()
    pair = xr.DataArray([0.86, 0.72], {"band": list(rig.bands)}, "band")
    truth = simulation.walkers(np.arange(80) / 10, shape, pair, rng).assign_coords(place)
    detector = simulation.pattern(rig, shape, rng).assign_coords(place)
    corrected = simulation.observe(truth, curves, rng)
    raw = simulation.capture(corrected, detector)
    levels = np.array([283.0, 303.0, 323.0])
    movies = simulation.blackbody_movies(rig, levels, 20, detector, rng)
    frames = correction.blackbody_statistics(movies)
    fit = correction.fit_correction(frames).assign_coords(place)
    rest = xr.DataArray(np.arange(192).reshape(shape) < 64, place, ("y", "x"))
    warm, cold, std = 300 + 3 * np.arange(8.0), np.full(8, 280.0), (0.1, 0.1)
    bench = contact_measurements(curves, pair, warm, cold, std, rng)
    foil = contact_measurements(curves, 0 * pair, warm, cold, std, rng)["counts"]
    reflector = bench.drop_vars("background_temperature").assign(reflected_counts=foil)
    fixed = {"response": curves, "reading_std": std}
    result = separation.solve(corrected, curves)
    table = emissivity.embedded_table()
    netd = emissivity.filter_noise(0.03, [str(band) for band in table["band"].values])
    wavelength = np.linspace(6e-6, 16e-6, 60)
    values = ("wavelength", 0.8 + 0.15 * np.sin(wavelength * 1e6), {"units": "1"})
    spectrum = xr.Dataset({"emissivity": values}, {"wavelength": wavelength})
    flat = raw["counts"].mean("time").assign_attrs(units="count")
    completed = {"result": result, "corrected": corrected, "response": curves}
    steps = [
        Step(correction.blackbody_statistics, {"movies": movies}),
        Step(correction.fit_correction, {"blackbody": frames}),
        Step(correction.renew_offset, {"correction": fit, "flat": flat}, "flat"),
        Step(correction.correct, {"capture": raw, "correction": fit}, "correction"),
        Step(correction.undo_lag, {"corrected": corrected, "time_constant": 0.01}),
        Step(correction.undo_drift, {"corrected": corrected, "reference": rest}, "reference"),
        Step(calibration.fit_emissivity, {"measured": bench, **fixed}),
        Step(calibration.reflector_emissivity, {"measured": reflector, **fixed}),
        Step(responses.apparent_temperature, {"response": curves, "counts": corrected["counts"]}),
        Step(separation.materials, completed, "result", ("result", "corrected")),
        Step(limits.bounds, {"scene": truth, "response": curves}),
        Step(limits.plan, {"table": table, "noise": netd}),
        Step(condition_numbers, {"table": table}),
        Step(rank_filters, {"table": table, "noise": netd}),
        Step(_band_table, {"spectrum": spectrum}),
    ]
    return {step.call.__name__: step for step in steps}


def _band_table(spectrum: Any) -> xr.Dataset:
    """Band emissivities of one spectrum."""
    return emissivity.band_table({"glass": spectrum}, ["8-14", "9.5"])


_WORDS: Final = (
    "counts|band|gain|offset|bad|dims|units|emissivity|temperature|amplitude|noise|pixel|material|"
    "reference|Dataset|DataArray|type"
)


def steps(rng: Rng) -> Attack:
    """One argument of a step damaged: values, type, unit, dims, bands, coordinates."""
    step = _steps()[pick(rng, sorted(_steps()))]
    arrays = [n for n, one in step.arguments.items() if isinstance(one, xr.Dataset | xr.DataArray)]
    what, spoilt = hurt_one(rng, dict.fromkeys(arrays, FORMS), step.arguments)
    argument, _, what = what.partition(" ")
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
        return wrong("other values", where=what != "another window")

    act = lambda: step.call(**spoilt)  # noqa: E731
    names = (f"{argument}|{_WORDS}",)
    return Attack(f"{step.call.__name__}: {argument} {what}", act, judge, names)


def _demanded(step: Step, argument: str, what: str) -> bool:
    """Whether damage must not pass: it contradicts another argument, or the argument itself."""
    if what == "another window":
        return argument == step.windowed
    if what == "of other bands":
        return sum("band" in getattr(one, "dims", ()) for one in step.arguments.values()) > 1
    if what == "of another unit":
        return "units" in str(first(step.arguments[argument]).attrs)
    return what in VALUED and argument not in step.partly


def _close(found: Any, clean: Any) -> bool:
    """The same values, whatever their coordinates of pixels."""
    if isinstance(found, xr.Dataset):
        return set(found) == set(clean) and all(_close(found[n], clean[n]) for n in found)
    found = found.transpose(*clean.dims) if {*found.dims} == {*clean.dims} else found
    if found.dims != clean.dims or found.shape != clean.shape or found.dtype.kind not in "fiub":
        return bool(found.dims == clean.dims and found.shape == clean.shape)
    return bool(np.allclose(found.values, clean.values, rtol=1e-5, atol=1e-6, equal_nan=True))


def _lost(found: Any) -> int:
    """Number of values that are not finite, or marked."""
    if isinstance(found, xr.Dataset):
        return sum(_lost(found[name]) for name in found)
    marked = found.values if found.dtype == bool else found.isnull() | (abs(found) == np.inf)
    return int(np.sum(marked))
