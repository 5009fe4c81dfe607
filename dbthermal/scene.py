"""Temperatures of a scene from the raw counts of two cameras, in one call.

`separate_capture` calls the steps of `correction`, `alignment` and `separation` in order. With a
target on disk its films are there, too, and it works in the memory of some rows.
"""

from collections.abc import Callable, Mapping
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import xarray as xr

from dbthermal import _arrays, _text, schema, store
from dbthermal import response as responses
from dbthermal._arrays import made_on_disk, on_disk
from dbthermal.alignment import _joint, align, register
from dbthermal.alignment._planes import Scale
from dbthermal.alignment._resampling import on_one_clock, registered
from dbthermal.correction import correct_capture
from dbthermal.separation import separate
from dbthermal.separation._inputs import decide_noise
from dbthermal.separation._separate import check_options
from dbthermal.store._whole import check_place

__all__ = ["separate_capture"]
__dir__ = __all__.copy

_STEPS: Final[tuple[Callable[..., Any], ...]] = (correct_capture, align, separate)
SAMPLE: Final = 220  # most memory of a sample of a pixel that is separated in memory [byte]
ROW: Final = 65  # memory of a sample of a row in separation by rows, in two threads [byte]


def separate_capture(  # noqa: PLR0913 - the options of each step, by name
    capture: xr.Dataset,
    correction: xr.Dataset,
    response: xr.Dataset,
    *,
    registration: Literal["translation", "affine", "homography"] | None = "homography",
    correcting: Mapping[str, Any] = MappingProxyType({}),
    aligning: Mapping[str, Any] = MappingProxyType({}),
    separating: Mapping[str, Any] = MappingProxyType({}),
    target: str | Path | None = None,
    provenance: Mapping[str, Any] = MappingProxyType({}),
) -> xr.Dataset:
    """Separate a raw capture of two cameras: correct, align and separate, in this order.

    1. `correction.correct_capture`.
    2. `alignment.register`, `align` and `reflection_shift`. Clocks of displaced cameras are
       compared where both see the same reflection, whose shift is then estimated anew.
    3. `separation.separate`.

    Clocks and shift of a large capture are estimated from means over some pixels and frames.
    Errors and warnings as the steps.

    Parameters
    ----------
    capture : Dataset
        Stage `capture` of `schema`, raw. With a `target` it may be lazy, as from
        `store.open_dataset`; it is then read by rows, several times.
    correction, response : Dataset
        From `correction.fit_correction`, and `calibration.fit_response` with its `noise`.
    registration : {"translation", "affine", "homography"}, optional
        Kind of transform between the views, see `alignment.register`; None if they share a grid. A
        `transform` in `aligning` takes its place.
    correcting, aligning, separating : mapping, optional
        Options by name of `correction.correct_capture`, `alignment.align` and
        `separation.separate`, such as ``{"offset": 0.0}`` [s] for cameras with one clock.
    target : str or Path, optional
        Folder ``*.zarr`` for the result. Intermediate films are in files beside it, which vanish
        with the process: some 64 bytes for each pixel and frame, and for up to 2048 pixels of each
        material as much again.
    provenance : mapping, optional
        For the `target`, see `store.save`.

    Returns
    -------
    Dataset
        As from `separation.separate`, on the first band's grid, and `reflection_shift`
        (axis, y, x) [pixel] where the cameras see reflections apart. Attributes of the alignment:
        `clock`, `time_offset` and `time_offset_std` [s], `frames_lost`, `transform`. From a
        `target` it is lazy.

    Examples
    --------
    A plate of glass, simulated, from raw counts; both cameras look through one window:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import calibration, correction, simulation
    >>> rig, rng, shape = simulation.Rig(), np.random.default_rng(1), (24, 24)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(150) / 10, shape, glass, rng)
    >>> detector = simulation.pattern(rig, shape, rng)
    >>> movies = simulation.blackbody_movies(rig, np.linspace(275, 345, 6), 16, detector, rng)
    >>> raw = simulation.capture(simulation.observe(scene, rig.response(), rng), detector)
    >>> statistics = correction.blackbody_statistics(movies)
    >>> fitted = correction.fit_correction(statistics)
    >>> response = calibration.fit_response(fitted["level"], statistics["noise"])
    >>> options = {"registration": None, "aligning": {"offset": 0.0}}
    >>> result = separate_capture(raw, fitted, response, **options)
    >>> error = result["object_temperature"] - scene["object_temperature"]
    >>> bool(abs(error).median() < 0.3)  # K
    True
    """
    options: dict[str, Any] = {"correcting": correcting, "aligning": aligning}
    options["separating"] = separating
    for step, values in zip(_STEPS, options.values(), strict=True):
        _check_options(step, values)
    # With a target: the same call with its films on disk, saved row by row.
    if target is not None:
        place = check_place(target, ".zarr").absolute().parent
        place.mkdir(parents=True, exist_ok=True)
        with on_disk(place):
            result = separate_capture(
                capture, correction, response, registration=registration, **options
            )
            slabs = _arrays.slabs(result, _arrays.blocks(result["object_temperature"].shape))
            store.save_rows(slabs, target, provenance or store.provenance({}))
        return store.open_dataset(target)
    # Correct each camera, register the views, and synchronise the bands.
    lazy = made_on_disk()
    names = [str(name) for name in schema.check(capture, "capture")["band"].values]
    check_options(names, **separating)
    corrected = correct_capture(capture, correction, lazy=lazy, **correcting)
    if registration is not None and "transform" not in aligning:
        aligning = {**aligning, "transform": register(corrected, model=registration)}
    # All steps take one noise, and with it one reference band.
    response, _ = decide_noise(corrected, response, responses.curves(response, names))
    aligned, field = _aligned(corrected, response, {**aligning, "lazy": lazy})
    del corrected
    result = separate(aligned, response, **{"reflection_shift": field, **separating})
    kept = ("clock", "time_offset", "time_offset_std", "frames_lost", "transform")
    attrs = {name: aligned.attrs[name] for name in kept if name in aligned.attrs}
    maps = {} if field is None else {"reflection_shift": field["shift"]}
    return result.assign(maps).assign_attrs(attrs)


def _check_options(step: Callable[..., Any], options: Any) -> None:
    """Refuse options that are no mapping, or that a step does not take by name."""
    name = step.__name__
    schema.require(options, Mapping, f"options of '{name}'")
    hidden = {"lazy", "reflection_shift"} if step is align else {"lazy"}
    by_name = [it for it in signature(step).parameters.values() if it.kind is it.KEYWORD_ONLY]
    names = [it.name for it in by_name if it.name not in hidden]
    for option in options:
        _text.check_listed(f"Unknown option of '{name}'", option, names, TypeError)


def _aligned(
    corrected: xr.Dataset, response: xr.Dataset, options: Mapping[str, Any]
) -> tuple[xr.Dataset, xr.Dataset | None]:
    """Synchronise the bands; return the capture, and the reflection shift or None."""
    options = {name: value for name, value in options.items() if value is not None}
    if "transform" in options:
        corrected = registered(corrected, options.pop("transform"), lazy=bool(options.get("lazy")))
    scale = Scale.of_response(response, corrected["band"].values.tolist())
    # Stated clocks: the shift alone is estimated.
    if "offset" in options:
        return on_one_clock(corrected, **options), _joint.apart(corrected, scale, **options)
    # Clocks and shift from the images.
    comparison = _joint.compare(corrected, scale, **options)
    aligned = on_one_clock(corrected, **{**options, "offset": comparison.offset})
    return comparison.noted(aligned), comparison.field
