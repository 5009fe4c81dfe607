"""A simulated twin judged as the paper judges a scene: at its thermocouples."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import alignment, calibration, emissivity, schema, separation, simulation
from dbthermal import response as responses
from dbthermal.schema import laid_on
from reproduction import methods, twins
from reproduction.experiments.bench import Bench, Sample, bench_series
from reproduction.experiments.cases import held, rmse, scalars
from reproduction.experiments.comparison import EVERY, MOVING, arguments
from reproduction.twins import stage
from reproduction.twins.stage import Capture, Registration

BEAD: Final = 3  # pixels along a side of the square that a thermocouple's bead covers

SHIFTED: Final = ("subspace", "calibrated", "naive", "dbvt")
"""Methods that take the shift of the reflections."""

PIXELWISE: Final = ("apparent", "calibrated", "dbvt", "naive")
"""Methods that get the surroundings of a bead only, which they treat pixel by pixel."""

REACH: Final = 5  # pixels around a bead that it gets: of some shifts, by which it pairs the pixels

RESTING: Final = 0.1  # standard deviation over time [K] below which an object counts as at rest

_STRAY: Final = 0.01


def judge_twin(
    name: str,
    seed: int,
    variants: Mapping[str, Mapping[str, Any]],
    *,
    material: str,
    capture: Capture,
    registrations: Sequence[Registration] = ("perfect",),
    whole: bool = True,
    shown: bool = False,
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Simulate a twin, calibrate its emissivity on the bench, and judge it at its thermocouple.

    One of `twins.TWINS`, of a material of `emissivity.embedded_table`, by two cameras a baseline
    apart, whose views are registered in some ways (`stage.registered`), and by two at the first
    one's place. Of the variants (see `at_thermocouple`), "calibrated" gets the emissivities that
    the bench finds for a piece of the same material, with their deviations.

    The first dataset has, over `cameras`, the registrations (with a baseline) and "one place":
    variables of `at_thermocouple`; over the `way`, "alone" by `solve`, and if it is judged as a
    `whole`, with a baseline, "pooled" and "completed" by `separate`, those of `over_the_image`,
    else NaN; `resting` [1], the share of the pixels whose object changes by less than `RESTING`,
    where two bands leave the emissivity open; `emissivity_difference` (band) [1], mean magnitude of
    the default method's emissivity less the calibrated one over the pixels without a flag. The
    second, if it is to be `shown`, is as of `separate_twin`, of the first registration.
    """
    rng, response = np.random.default_rng(seed), simulation.Rig().response()
    scene = twins.twin(name, capture, rng)
    fit = on_bench(response, material, rng)
    stated = {"emissivity": fit["emissivity"], "emissivity_std": fit["emissivity_std"]}
    informed = {
        label: {**options, **(stated if options["method"] == "calibrated" else {})}
        for label, options in variants.items()
    }
    views = {"one place": simulation.observe(scene, response, rng)}
    if capture.baseline:
        apart = stage.observe(scene, response, rng)
        views = {how: stage.registered(scene, apart, how) for how in registrations} | views
    scores, picture = [], None
    for cameras, corrected in views.items():
        shift = alignment.reflection_shift(corrected, response) if cameras != "one place" else None
        separated = separation.solve(corrected, response, reflection_shift=shift)
        good = (separated["status"] == 0) & scene["on_object"]
        away = abs(separated["emissivity"] - fit["emissivity"]).where(good).mean(("y", "x"))
        seen = (scene, corrected, response, separated)
        read = at_thermocouple(*seen, informed, rng, reflection_shift=shift)
        ways = {"alone": over_the_image(scene, separated)}
        if (whole and cameras != "one place") or (shown and picture is None):
            result = separation.separate(corrected, response, reflection_shift=shift)
            ways["pooled"] = over_the_image(scene, result)
            ways["completed"] = over_the_image(scene, result, completed=True)
            if shown and picture is None:
                picture = _with_truth(result, scene, corrected, response)
        image = xr.concat(ways.values(), xr.DataArray(list(ways), dims="way", name="way"))
        image = image.reindex(way=["alone", "pooled", "completed"])
        # Share of the pixels with a moving background whose object rests.
        moving, still = _moving(scene), scene["object_temperature"].std("time") < RESTING
        resting = ((moving & still).sum() / moving.sum()).assign_attrs(units="1")
        maps = {**image.data_vars, "resting": resting, "emissivity_difference": away}
        scores.append(read.assign_coords(way=image["way"]).assign(maps))
    label = xr.DataArray(list(views), dims="cameras", name="cameras")
    return xr.concat(scores, label, join="outer", combine_attrs="override"), picture


def capture_of(
    material: str, shape: Sequence[int], clock: Sequence[float], baseline: float
) -> Capture:
    """Capture of a twin of a material, in the bands of the default rig.

    Of rows and columns, a number of frames and their rate [Hz], by cameras a baseline apart [m].
    """
    table = emissivity.embedded_table()["emissivity"]
    true = table.sel(material=material, band=list(simulation.Rig().bands), drop=True)
    time = np.arange(int(clock[0])) / clock[1]
    return Capture(true, (shape[0], shape[1]), time, baseline)


def separate_twin(name: str, seed: int, capture: Capture, **options: Any) -> xr.Dataset:
    """Separate a twin, seen by the default rig, by the default way; options of `twins.twin`.

    Returns the result of `separation.separate`, and in addition `apparent_temperature`
    (band, time, y, x), of the registered views; `true_object_temperature` and
    `true_background_temperature` (time, y, x) [K], of the first camera.
    """
    rng, response = np.random.default_rng(seed), simulation.Rig().response()
    scene = twins.twin(name, capture, rng, **options)
    corrected = stage.registered(scene, stage.observe(scene, response, rng))
    shift = alignment.reflection_shift(corrected, response) if capture.baseline else None
    whole = separation.separate(corrected, response, reflection_shift=shift)
    return _with_truth(whole, scene, corrected, response)


def _with_truth(
    separated: xr.Dataset, scene: xr.Dataset, corrected: xr.Dataset, response: xr.Dataset
) -> xr.Dataset:
    """Result with the inputs and the truth beside it, see `separate_twin`."""
    seen = responses.apparent_temperature(response, corrected["counts"])
    names = ("object_temperature", "background_temperature")
    films = {f"true_{name}": scene[name] for name in names}
    films["apparent_temperature"] = seen.assign_attrs(scene.attrs)
    films = {name: film.astype("float32") for name, film in films.items()}
    return separated.assign(films).assign_attrs(corrected.attrs)


def _moving(scene: xr.Dataset) -> xr.DataArray:
    """Pixels (y, x) of the object in which the background moves."""
    return (scene["background_temperature"].std("time") > MOVING) & scene["on_object"]


def over_the_image(
    scene: xr.Dataset, separated: xr.Dataset, *, completed: bool = False
) -> xr.Dataset:
    """Errors of a separation over the object's pixels in which the background moves.

    `good` [1], the share without a flag, or of those that are completed; of these
    `object_temperature_rmse` [K], root mean square over time, median; and `covered` [1], the share
    of samples whose 95 % interval holds the truth.
    """
    moving, status = _moving(scene), separated["status"]
    good = moving & ((status & int(schema.COMPLETED)) != 0 if completed else status == 0)
    error = (separated["object_temperature"] - scene["object_temperature"]).where(good)
    return scalars(
        good=good.sum() / moving.sum(),
        object_temperature_rmse=rmse(error),
        covered=held(error, separated["object_temperature_std"]),
    )


def on_bench(response: xr.Dataset, material: str, rng: np.random.Generator) -> xr.Dataset:
    """Emissivity of a smooth piece of a material, calibrated on the simulated bench."""
    value = float(emissivity.embedded_table()["emissivity"].sel(material=material, band="8-14"))
    sample, bench = Sample(material, value, material, _STRAY), Bench()
    series = bench_series(response, sample, bench, rng)
    stds = (bench.reading_std, bench.blackbody_std)
    return calibration.fit_emissivity(series, response, stds, bench.bias(sample))


def at_thermocouple(
    scene: xr.Dataset,
    corrected: xr.Dataset,
    response: xr.Dataset,
    separated: xr.Dataset,
    variants: Mapping[str, Mapping[str, Any]],
    rng: np.random.Generator,
    *,
    reflection_shift: xr.Dataset | None = None,
    probes: int = 20,
) -> xr.Dataset:
    """Errors of several methods at the first thermocouple of a twin.

    The estimate is the mean over the pixels that the bead covers. The reading has the errors of a
    probe that was compared with a reference (`stage.thermocouple_readings`), drawn anew for a
    number of probes, so that the result does not depend on one probe's error. Variants are label ->
    `method` of `methods.METHODS` and arguments of `solve`, with the shift of the reflections
    where it takes one; the default method without arguments is what has been separated. A method
    that looks at whole images, each by itself, gets the first of `EVERY` frames.

    `relative_error` (variant) [percent of degrees Celsius], mean over the frames and probes, NaN
    where a pixel of the bead has no value in some frame; `temperature` (variant, time) and
    `reading` (time) of the last probe [K], NaN in frames that a method does not get;
    `highest_reading` [degree Celsius], median over the probes.
    """
    # Rows and columns that the first bead covers.
    reach = BEAD // 2
    centre = {dim: int(scene[f"thermocouple_{dim}"][0]) for dim in ("y", "x")}
    square = {dim: slice(place - reach, place + reach + 1) for dim, place in centre.items()}
    read = partial(stage.thermocouple_readings, scene, rng, bead=BEAD)
    readings = [read().isel(thermocouple=0) for _ in range(probes)]
    seed = int(rng.integers(2**32))  # of random starts: each capture has its own
    bead = separated["object_temperature"].isel(square).mean(("y", "x"), skipna=False)
    estimates = [
        bead
        if variant == {"method": "subspace"}
        else _mean(corrected, response, square, {"seed": seed, **variant}, reflection_shift)
        for variant in variants.values()
    ]
    label = xr.DataArray(list(variants), dims="variant", name="variant")
    errors = []  # mean over the frames and the probes' readings (time)
    for estimate in estimates:
        times = {"time": estimate["time"]}
        off = [relative_error_celsius(estimate, reading.sel(times)) for reading in readings]
        errors.append(xr.concat(off, "probe").mean(("probe", "time"), skipna=False))
    highest = np.median([float(reading.max()) for reading in readings]) - zero_Celsius
    return xr.Dataset(
        {
            "relative_error": xr.concat(errors, label),
            "temperature": xr.concat(estimates, label, join="outer").assign_attrs(units="K"),
            "reading": readings[-1],
            "highest_reading": ((), highest, {"units": "degree_Celsius"}),
        },
        attrs={"origin": "simulated twin", "twin": scene.attrs["twin"]},
    )


def _mean(
    corrected: xr.Dataset,
    response: xr.Dataset,
    square: Mapping[str, slice],
    variant: Mapping[str, Any],
    shift: xr.Dataset | None,
) -> xr.DataArray:
    """Object temperature (time) [K] of one method, mean over the bead's pixels.

    It is NaN where the shift of the reflections is known nowhere around the bead.
    """
    options = arguments(variant)
    if shift is not None and variant["method"] in SHIFTED:
        options["reflection_shift"] = shift
    seen = corrected
    if variant["method"] in PIXELWISE:
        reach = REACH if "reflection_shift" in options else 0
        window = {
            dim: slice(max(0, places.start - reach), places.stop + reach)
            for dim, places in square.items()
        }
        seen = corrected.isel(window)
        if reach:
            nearby = options["reflection_shift"] = options["reflection_shift"].isel(window)
            if not bool(nearby["shift"].notnull().any()):
                return (corrected["time"].astype(np.float64) * np.nan).assign_attrs(units="K")
    if methods.get_method(variant["method"]).whole_image:
        seen = seen.isel(time=slice(None, None, EVERY))
    estimates = separation.solve(seen, response, **options)["object_temperature"]
    bead = {dim: corrected[dim][places] for dim, places in square.items()}
    return estimates.sel(bead).mean(("y", "x"), skipna=False)


def share(estimate: xr.DataArray, cause: xr.DataArray) -> float:
    r"""Share of a change that another one holds: the slope of a regression through their means [1].

    .. math:: \sum a b / \sum b^2

    with a the first (time, y, x) and b its cause, each less its mean over time, over all samples in
    which the first is known, in one unit. Raises a ValueError if the cause does not change there.
    """
    a, b = (film - film.where(estimate.notnull()).mean("time") for film in (estimate, cause))
    power = float((b**2).where(estimate.notnull()).sum())
    if not power > 0:
        raise ValueError("Invalid cause without change where anything was estimated. Must change.")
    return float((a * b).sum()) / power


def relative_error_celsius(estimate: xr.DataArray, truth: xr.DataArray) -> xr.DataArray:
    r"""Error in per cent of the true temperature in degrees Celsius, as the paper reports it.

    .. math:: 100 \, |\hat T - T| / (T - 273.15)

    The zero of the Celsius scale is arbitrary, and so is this number; it is here to stand beside
    the published ones (Narayanan et al. 2026, doi:10.48550/arXiv.2509.11334) and is labelled. Both
    are temperatures [K] of the same coordinates.
    """
    result = 100.0 * abs(estimate - truth) / (truth - zero_Celsius)
    label = "error relative to the true temperature in degrees Celsius"
    bare: xr.DataArray = result.drop_attrs(deep=False).rename("relative_error")
    return bare.assign_attrs(long_name=label, units="percent")


def reflected_change(apparent: xr.DataArray, result: xr.Dataset) -> xr.DataArray:
    r"""Change of the first band's apparent temperature that the reflection causes.

    .. math:: (1 - e_1) (y - \bar y)

    with the mean over time, in the linear response of small changes, (time, y, x) [K], float32; NaN
    where the reflection is unknown. Of a constant object without a completed background it is the
    change of the apparent temperature. That is of the inputs (band, time, y, x) [K], from
    `response.apparent_temperature`; the result from `solve`, `separate` or `complete`, of the same
    capture. ValueError if the first bands, sizes or coordinates differ.
    """
    if str(apparent["band"].values[0]) != str(result["band"].values[0]):
        raise ValueError(
            f"Invalid first band '{apparent['band'].values[0]}'. "
            f"Must be '{result['band'].values[0]}', as in the result."
        )
    first = apparent.isel(band=0, drop=True)
    first = laid_on(first, result, "the apparent temperature", "the result")
    background = result["background_temperature"]
    reflectivity = 1.0 - result["emissivity"].isel(band=0, drop=True)
    change = (background - background.mean("time")) * reflectivity
    constant = (result["status"] & int(schema.Status.CONSTANT_OBJECT)) != 0
    without = constant & background.isnull().all("time")
    change = change.where(~without, first - first.mean("time"))
    attrs = {"units": "K", "long_name": "reflection, change of the apparent temperature"}
    return change.astype("float32").rename("reflected_change").assign_attrs(attrs)
