"""The one entrance to all methods: the inputs are checked, and separated tile by tile."""

import importlib
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
import numpy.typing as npt
import xarray as xr
from tqdm import tqdm

from dbthermal import schema
from dbthermal._arrays import empty, release, without_blas_threads
from dbthermal._compiled import compiled
from dbthermal.separation import _budget as budget
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._apart import side_by_side
from dbthermal.separation._inputs import Inputs, Method, check
from dbthermal.separation._pooling import pool as pooling
from dbthermal.separation._tiles import Array, Estimate, Mask, Material, Survey, Whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance  # settings of a method from outside

    from dbthermal.separation import CalibratedSettings, SubspaceSettings

    Settings: TypeAlias = SubspaceSettings | CalibratedSettings | DataclassInstance

_MODULES: Final = {
    "subspace": "_subspace.method",
    "calibrated": "_calibrated",
    "apparent": "_apparent",
}
_COVARIANCE: Final = "emissivity_covariance"
# Share of pixels in pieces from which these are kept for the next pass: 0.08 where a band is two
# frames late, 0.19 of a rapid object before displaced cameras (outcomes of tests/separation) [1].
_DIVIDED: Final = 0.125
# Films of each pixel alone that pooled ones are written over, of cameras at one place.
_OVERWRITTEN: Final = "background_temperature", "background_temperature_std"
_ASSUMED: Final = {"calibration", "blackbody", "gain_offset_by_camera"}
METHODS: Final = tuple(_MODULES)
"""Names of the methods; the module of each is imported when it is first used."""


def solve(  # noqa: PLR0913 - the one entrance; all but the first three are by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: str | Method = "subspace",
    *,
    settings: "Settings | None" = None,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    emissivity_covariance: xr.DataArray | None = None,
    mask: xr.DataArray | None = None,
    pool: xr.DataArray | None = None,
    reflection_shift: xr.Dataset | None = None,
    response_kind: str = "exact",
    workers: int = 2,
    seed: int = 0,
    progress: bool = False,
) -> xr.Dataset:
    r"""Separate emission and reflection in a capture of two bands or more.

    Of the image formation (`mixing`) with the responses U of `response`, object temperature x,
    background temperature y and emissivities e are estimated (Narayanan, Ramanagopal, Narasimhan
    2026, Dual Band Thermal Videography, CVPR, doi:10.48550/arXiv.2509.11334):

    .. math:: I_m(t) = e_m U_m(x(t)) + (1 - e_m) U_m(y(t)) + \mathrm{noise}

    TypeError or ValueError if an argument is not as described, the counts are whole numbers, which
    are raw, the settings are those of another method, the capture is too short for the method, or
    its `time` is that of arrival or of a clock that was set: "subspace" finds slow changes smooth
    over the numbers of the frames and not over the times. A bad pixel is a bit of `status`.

    Parameters
    ----------
    corrected : Dataset
        `counts` (band, time, y, x) [count], `time` [s], and optionally `status` (y, x) and
        `segment` (time), from `correction.correct_capture`. `pattern_std` (band) [count], an error
        of each pixel that is constant in time, widens the bars of "subspace". Samples that are NaN,
        and repeated frames, are left out. A lazy one is read a few rows at a time. "subspace" and
        "calibrated" take two bands or more, the former 32 frames or more; other methods two bands.
    response : Dataset
        From `calibration.fit_response`, with all bands. Its `noise` (band) [count] is used, times
        the `noise_factor` (band) of the capture, unless the capture proves 1.1 times as much: then
        the capture's, with a warning. Without `noise` it is estimated from the capture. Attribute
        `noise_source` says which.
    method : {"subspace", "calibrated", "apparent"} or Method
        This project's separator; known emissivities; the camera's reading; or the record of an
        outside method.
    settings : Settings, optional
        Record of the method's options, such as `SubspaceSettings`; its defaults if not given.
        "apparent" has none.
    emissivity : DataArray, optional
        Known emissivity, (band) or (band, y, x) [1] in (0, 1); for "calibrated" only.
    emissivity_std : DataArray, optional
        Its standard deviation, same dims.
    emissivity_covariance : DataArray, optional
        In its place the covariance, (band, other_band) or (band, other_band, y, x), as of a result.
    mask : DataArray, optional
        Samples to use: (time), (y, x) or (time, y, x), boolean.
    pool : DataArray, optional
        Materials (y, x), integer, as from `materials`: the pixels of a label share their
        emissivities, or a polynomial of the place and a variance about it; those of a negative
        label share nothing. For "subspace" only.
    reflection_shift : Dataset, optional
        From `alignment.reflection_shift`, for two cameras side by side: the reflection that all
        other bands, of the second camera, show at a pixel p is the one that the quietest band shows
        at :math:`p + d(p)`, `shift` (axis, y, x) [pixel]. The result is on the quietest band's
        grid. For "subspace", "calibrated", and a `Method` that works pixel by pixel.
    response_kind : {"exact", "linear"}
        Sakuma-Hattori response, or the paper's linear one.
    workers : int
        Number of threads.
    seed : int
        Seed of random starts; the result depends on it and not on `workers`.
    progress : bool
        Show a bar.

    Returns
    -------
    Dataset
        `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1] and `reflection_ratio` (band, y, x) [1], the reflectivity over that of the
        quietest band (attribute `reference_band`), each with `_std`; of "subspace" also
        `emissivity_covariance` (band, other_band, y, x) [1] by noise alone. The deviations contain
        the accuracy that the response states (`response.accuracy`); `uncertainty` (cause, y, x)
        [K], root mean square over time of the object's deviation by cause, splits it, as do
        `background_uncertainty` and `emissivity_uncertainty` (cause, band, y, x) [1], and
        `without_calibration` takes it out. `status` (y, x), bits of
        `schema.Status`; `noise` (band) [count], as used. Values are NaN where a flag says why, at
        invalid or masked samples, and where a method never estimates them (attribute
        `not_estimated`); where the status is 0, all others are finite.


    Notes
    -----
    Two errors of "subspace" cannot be seen in the bands and carry no flag: an exchange of object
    and background with emissivities above a half, and a background that drifts along with the
    object's curve. With a drift the temperature holds, and the emissivity's deviation includes
    `SubspaceSettings.background_drift`.

    Only "subspace" uses a `segment`, and only for the object: the step of a shutter event stays in
    the background. A step of the object during a shutter event is not detected.

    With a `reflection_shift` d the other bands are resampled at the place p of each pixel r,
    p + d(p) = r, and the object of two places enters the bands,

    .. math:: I_1(r) = e_1 U_1(x(r)) + (1 - e_1) U_1(y), \quad
              I_m'(r) = e_m U_m(x(p)) + (1 - e_m) U_m(y)

    Each pixel is solved as if x(p) were x(r). The reflections, along functions of time and blurred
    alike, give ratios as certain as neighbours agree on them; with these the object is solved for
    all pixels together, and each pixel once more with the resulting x(p). A pixel whose reflection
    the second camera does not see has the bit `no_reflection_pair`.
    """
    require_whole("number of workers", workers, 1)
    require_whole("seed", seed, 0)
    options: dict[str, Any] = {"settings": settings, "mask": mask, "pool": pool, "seed": seed}
    options |= {"emissivity": emissivity, "emissivity_std": emissivity_std}
    options |= {"emissivity_covariance": emissivity_covariance, "response_kind": response_kind}
    options["reflection_shift"] = reflection_shift
    inputs = check(corrected, response, get_method(method), **options)
    return budget.added(separated(inputs, workers=workers, progress=progress)[0], inputs)


@without_blas_threads
def separated(
    inputs: Inputs,
    *,
    alone: xr.Dataset | None = None,
    surveys: Survey | None = None,
    regroup: pooling.Regroup | None = None,
    workers: int = 2,
    progress: bool = False,
) -> tuple[xr.Dataset, Survey | None]:
    """Separate checked inputs; return result, and surveys per pixel of cameras at one place."""
    # Make the result, whose values are written tile by tile.
    capture, names = inputs.capture, [*schema.STAGES["separated"]]
    displaced, pooled = inputs.displacement is not None, inputs.labels is not None
    # Pooling of pixels before displaced cameras needs the result per pixel (`alone`).
    if alone is None and displaced and pooled:
        alone, _ = separated(replace(inputs, labels=None), workers=workers, progress=progress)
    names += [_COVARIANCE, "drift_std"] if inputs.method.pools else []
    films = {} if alone is None or displaced else {it: alone[it].values for it in _OVERWRITTEN}
    result = separated_dataset(capture, {**dict.fromkeys(names), **films})
    # Separate; for displaced cameras and materials, the number of passes is not known beforehand.
    total = None if displaced or pooled else result["status"].size
    with (
        ThreadPoolExecutor(workers) as threads,
        tqdm(total=total, unit="pixel", desc=inputs.method.name, disable=not progress) as bar,
    ):

        def separate_pixels(
            inputs: Inputs, material: Material | None, selection: Mask | None = None
        ) -> Survey:
            """Separate all pixels into the result; or only survey those that are wanted."""
            survey = Survey.empty(len(inputs.bands), result["status"].size)
            into = result if selection is None else None
            separate = partial(_separate, inputs, material, into, survey, selection)
            for pixels in threads.map(separate, inputs.blocks):
                bar.update(pixels)
            # Few pixels in pieces may be caused by a flaw, as a delay: they are searched anew.
            if np.mean(inputs.division.any(axis=0)) < _DIVIDED:
                inputs.division[:] = 0
            return survey

        materials = partial(pooling.materials, survey=separate_pixels, surveys=surveys)
        if alone is not None and displaced:
            side_by_side.pooled(inputs, alone, result, separate_pixels, threads, materials, regroup)
        elif displaced:
            side_by_side.alone(inputs, result, separate_pixels, threads)
        elif pooled:  # materials may be regrouped by their ratios
            separate_pixels(*pooling.regrouped(inputs, materials, regroup))
        else:
            surveys = separate_pixels(inputs, None)
    if inputs.method.pools:
        _withhold(result)
    # Say what was used: noise, method, settings, warnings.
    metadata = inputs.response.attrs | capture.attrs
    notes = [np.atleast_1d(data.attrs.get("warnings", [])) for data in (inputs.response, capture)]
    doubts = dict.fromkeys(str(sentence) for note in notes for sentence in note)
    noise = inputs.noise * [curve.reference_slope for curve in inputs.curves]
    result["noise"] = "band", noise, {"units": "count", "long_name": "noise, as used"}
    ratios = () if inputs.method.pools else ("reflection_ratio", "reflection_ratio_std")
    result = result.assign_attrs(
        method=inputs.method.name,
        pooled=int(pooled),
        response_kind=inputs.response_kind,
        **{key: metadata[key] for key in sorted(_ASSUMED & metadata.keys())},
        **({"warnings": [*doubts]} if doubts else {}),
        noise_source=inputs.response.attrs["noise_source"],
        emissivity_source="capture" if inputs.emissivity is None else "given",
        not_estimated=" ".join(inputs.method.not_estimated + ratios),
        reference_band=str(capture["band"].values[inputs.bands[0]]),
        **({} if inputs.settings is None else {"settings": repr(inputs.settings)}),
    )
    return result, surveys


def separate_again(inputs: Inputs, result: xr.Dataset, workers: int, selection: Mask) -> None:
    """Separate selected pixels (y, x), of cameras at one place, each by itself, into a result."""
    chosen = selection.ravel()
    inputs.division[:, chosen] = 0
    survey, films = Survey.empty(len(inputs.bands), chosen.size), result.drop_vars("noise")
    with ThreadPoolExecutor(workers) as threads:
        list(threads.map(partial(_separate, inputs, None, films, survey, chosen), inputs.blocks))
    _withhold(result)


def _withhold(result: xr.Dataset) -> None:
    """Withhold objects whose emissivity lies outside (0, 1): rapid changes were no reflection's."""
    flags = result["status"].values & np.uint32(schema.Status.NONPHYSICAL_EMISSIVITY)
    impossible = np.flatnonzero(flags)
    for name in ("object_temperature", "object_temperature_std"):
        for frame in result[name].values:
            frame.flat[impossible] = np.nan
        release()


def require_whole(name: str, value: Any, least: int) -> None:
    """Refuse what is not a whole number, or less than the least that it may be."""
    if type(value) is bool or not isinstance(value, int | np.integer) or value < least:
        raise ValueError(f"Invalid {name} {value!r}. Must be a whole number, at least {least}.")


def get_method(name: str | Method) -> Method:
    """Record of a method: its functions, its settings, and its demands on the capture.

    Among its fields are `settings`, the type of its options or None, and `knows_emissivity`.

    Parameters
    ----------
    name : str or Method
        One of `METHODS`, else ValueError; a record of your code is returned as it is.

    Examples
    --------
    >>> get_method("subspace").settings(background_drift=1.0)  # K
    SubspaceSettings(background_drift=1.0)
    """
    if isinstance(name, Method):
        return name
    if name not in METHODS:
        raise ValueError(f"Unknown method '{name}'. Must be one of {list(METHODS)}, or a `Method`.")
    module = importlib.import_module(f"dbthermal.separation.{_MODULES[name]}")
    method: Method = module.METHOD
    return replace(method, name=name)


def _separate(
    inputs: Inputs,
    material: Material | None,
    result: xr.Dataset | None,
    survey: Survey,
    selection: Mask | None,
    rows: slice,
) -> int:
    """Separate a block of rows, or what is wanted of it, into its place; return its pixels."""
    size, options = 0, [] if inputs.settings is None else [inputs.settings]
    for cut in tiles.cut(inputs, rows, material, selection):
        estimates = []
        for frames, pixels, tile in cut.sections:
            estimate: Estimate = inputs.method.separate(tile, *options)
            if estimate.status.size == pixels.size and not pixels.all():
                estimate = estimate.select_pixels(pixels)
            estimates.append((frames, pixels, estimate))
            if estimate.survey is not None:
                # Whitened by the noise common to all pixels, not by the noise of this pixel.
                scale = tile.scaled(tile.noise) / inputs.noise[inputs.bands][:, np.newaxis]
                scatter = estimate.survey.scatter * (scale[:, np.newaxis] * scale)
                section = replace(estimate.survey, scatter=scatter)
                survey.replace_pixels(cut.places[pixels], section)
        if result is not None:
            _write(result, inputs.bands, cut, estimates)
            # The divisions of the time of pixels with all frames are kept for the next pass.
            inputs.division[:, cut.places] = 0
            for frames, pixels, estimate in estimates:
                if estimate.division is not None and np.all(frames):
                    divided = estimate.division.any(axis=0)
                    bits = np.packbits(estimate.division[:, divided], axis=0)
                    inputs.division[:, cut.places[pixels][divided]] = bits
        release()
        size += cut.status.size
    return size


def separated_dataset(
    capture: xr.Dataset, arrays: Mapping[str, npt.NDArray[Any] | None]
) -> xr.Dataset:
    """Stage `separated` of `schema` of some arrays, None for empty ones, on a capture's grid."""
    stage = {**schema.STAGES["separated"], **schema.OPTIONAL["separated"]}
    sizes = {**capture.sizes, "other_band": capture.sizes["band"]}
    metadata = {name: value for name, value in capture.attrs.items() if name in tiles.KEPT_ATTRS}
    variables = {}
    for name, array in arrays.items():
        dims = stage[name].dims
        attrs = schema.Status.cf_attrs(schema.STATUS) if name == "status" else stage[name].attrs
        shape = tuple(sizes[dim] for dim in dims)
        values = empty(shape, stage[name].dtype) if array is None else array
        variables[name] = (dims, values, {**attrs, **metadata})
    names = ("band", "time", "y", "x")
    coordinates = {name: capture[name] for name in names if name in capture.coords}
    if _COVARIANCE in arrays:
        coordinates["other_band"] = capture["band"].rename(band="other_band")
    return xr.Dataset(variables, coordinates, metadata)


@np.errstate(over="ignore")  # a deviation beyond single precision is infinite
def _write(
    result: xr.Dataset,
    bands: list[int],
    cut: tiles.Cut,
    estimates: list[tuple[Mask, Mask, Estimate]],
) -> None:
    """Write the estimates of a cut into the result, at frames (time) and pixels (pixel)."""
    # The tile's bands have the places `bands` in the capture.
    order, shape = np.argsort(bands), tuple(span.stop - span.start for span in cut.window)
    row, column = np.divmod(cut.places, result.sizes["x"])
    whole = any(np.all(frames) and np.all(pixels) for frames, pixels, _ in estimates)
    for name in map(str, result.data_vars):
        array, is_film = result.variables[name].values, "time" in result.variables[name].dims
        if is_film and whole:
            values = getattr(estimates[0][2], name)
        else:  # what has no estimate is NaN
            blank = cut.status if name == "status" else np.nan
            values = np.full((*array.shape[:-2], row.size), blank, array.dtype)
            for frames, pixels, estimate in estimates:
                source = getattr(estimate, name)
                if name == "status":
                    values[pixels] |= source
                elif is_film:
                    _place(values, np.flatnonzero(frames), np.flatnonzero(pixels), source)
                elif source is not None:
                    values[..., pixels] = source[np.ix_(*[order] * (source.ndim - 1))]
        if is_film and not cut.valid.all():
            values = np.where(cut.valid, values, np.nan)
        if row.size == np.prod(shape):
            array[..., *cut.window] = values.reshape(*array.shape[:-2], *shape)
        else:
            array[..., row, column] = values


@compiled
def _place(film: Array, frames: Whole, pixels: Whole, values: Array) -> None:
    """Write values (frame, pixel) at some frames and pixels of a film, in place."""
    for frame in range(frames.size):
        image = film[frames[frame]]
        for pixel in range(pixels.size):
            image[np.uintp(pixels[pixel])] = values[frame, pixel]
