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
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from dbthermal import schema
from dbthermal._arrays import empty, release
from dbthermal._compiled import compiled
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._apart import side_by_side
from dbthermal.separation._inputs import Inputs, Method, check
from dbthermal.separation._pooling import pool as pooling
from dbthermal.separation._tiles import Estimate, Mask, Material, Survey, Whole

if TYPE_CHECKING:
    from _typeshed import DataclassInstance  # settings of a method from outside

    from dbthermal.separation import CalibratedSettings, DbvtSettings, SubspaceSettings

    Settings: TypeAlias = SubspaceSettings | CalibratedSettings | DbvtSettings | DataclassInstance

_MODULES: Final = {
    "subspace": "_subspace.method",
    "calibrated": "_calibrated",
    "dbvt": "_dbvt.method",
    "apparent": "_apparent",
}
_COVARIANCE: Final = "emissivity_covariance"
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
    r"""
    Separate emission and reflection in a capture of two bands or more.

    Of the image formation (`mixing`) with the responses U of `response`, object temperature x,
    background temperature y and emissivities e are estimated:

    .. math:: I_m(t) = e_m U_m(x(t)) + (1 - e_m) U_m(y(t)) + \mathrm{noise}

    Parameters
    ----------
    corrected : Dataset
        `counts` (band, time, y, x) [count], `time` [s], and optionally `status` (y, x) and
        `segment` (time), from `correction.correct_capture`. `pattern_std` (band) [count], an error
        of each pixel that is constant in time, widens the bars of "subspace". Samples that are NaN
        are left out, and frames that repeat the one before in a band. May be lazy: it is read a few
        rows at a time. "subspace" and "calibrated" take two bands or more, and the former at least
        32 frames; the other methods two bands.
    response : Dataset
        From `calibration.fit_response`, with all bands. Its `noise` (band) [count] is used
        where present, times the `noise_factor` (band) that `alignment.align` leaves in the capture,
        unless the capture proves 1.4 times as much or more: then the capture's, with a warning.
        Without `noise` it is estimated from the capture. Attribute `noise_source` says which.
    method : {"subspace", "calibrated", "dbvt", "apparent"} or Method
        This project's separator; known emissivities; the paper's optimiser; the camera's reading;
        or the record of a method that is not of this package, which all the checks here hold for.
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
        Materials (y, x), integer, as from `materials`: the pixels of one label share their
        emissivities, or a polynomial of the place and a spread about it where they differ, which
        makes all of them more certain; a negative one shares nothing. For "subspace" only.
    reflection_shift : Dataset, optional
        From `alignment.reflection_shift`, for two cameras side by side: the reflection that all
        other bands, of the second camera, show at a pixel p is the one that the quietest band shows
        at :math:`p + d(p)`, `shift` (axis, y, x) [pixel]. The result is on the quietest band's
        grid. For "subspace", "calibrated", "dbvt", and a `Method` that works pixel by pixel.
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
        `emissivity_covariance` (band, other_band, y, x) [1]; `status` (y, x), bits of
        `schema.Status`; `noise` (band) [count], as used. Values are NaN where a flag says why, at
        samples that are invalid or masked, and where a method never estimates them (attribute
        `not_estimated`); where the status is 0, all others are finite.

    Raises
    ------
    TypeError
        If an argument is of the wrong type, the counts are whole numbers, which are raw, or the
        settings are those of another method.
    ValueError
        If a dim, unit, band, coordinate, method or emissivity is not as described, the capture is
        too short for the method, or its `time` is that of arrival or of a clock that was set:
        "subspace" finds slow changes smooth over the numbers of the frames and not over the times.
        A bad pixel is not an error but a bit of `status`.

    Notes
    -----
    Two errors of "subspace" carry no flag, for nothing in the bands shows them: an exchange of
    object and background, but for emissivities below a half, which are flagged as a suspicion; and
    a background that drifts along with the object's curve. The temperature holds then, and the
    emissivity's deviation carries the drift that `SubspaceSettings.background_drift` states.

    A `segment` is used by "subspace" alone, and for the object alone: the step that a shutter
    event leaves stays in the background, and in the emissivity's deviation. A step of the object
    during a shutter event is not detected.

    With a `reflection_shift` d the other bands are resampled at the place p of each pixel r,
    p + d(p) = r, and the object of two places enters the bands,

    .. math:: I_1(r) = e_1 U_1(x(r)) + (1 - e_1) U_1(y), \quad
              I_m'(r) = e_m U_m(x(p)) + (1 - e_m) U_m(y)

    Each pixel is solved as if x(p) were x(r). What all reflect, along functions of time and blurred
    alike, then gives ratios as certain as neighbours agree on them; with these all pixels together
    are solved for the object, and each once more with what follows for x(p). A pixel of which the
    second camera does not see the reflection has the bit `no_reflection_pair`.

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal Videography, CVPR;
       doi:10.48550/arXiv.2509.11334

    Examples
    --------
    Plate glass that warms up while people walk by, simulated:

    >>> import numpy as np, xarray as xr
    >>> from dbthermal import simulation
    >>> rig, rng = simulation.Rig(), np.random.default_rng(1)
    >>> glass = xr.DataArray([0.86, 0.72], dims="band", coords={"band": list(rig.bands)})
    >>> scene = simulation.walkers(np.arange(200) / 10, (4, 6), glass, rng)
    >>> result = solve(simulation.observe(scene, rig.response(), rng), rig.response())
    >>> error = result["object_temperature"] - scene["object_temperature"]
    >>> bool(abs(error).where(result["status"] == 0).median() < 0.3)  # K
    True
    """
    require_workers(workers)
    require_seed(seed)
    record = get_method(method)
    inputs = check(
        corrected,
        response,
        record,
        record.name,
        settings=settings,
        seed=seed,
        emissivity=emissivity,
        emissivity_std=emissivity_std,
        emissivity_covariance=emissivity_covariance,
        mask=mask,
        pool=pool,
        reflection_shift=reflection_shift,
        response_kind=response_kind,
    )
    return separated(inputs, workers=workers, progress=progress)[0]


def separated(
    inputs: Inputs,
    *,
    alone: xr.Dataset | None = None,
    surveys: Survey | None = None,
    regroup: pooling.Regroup | None = None,
    workers: int = 2,
    progress: bool = False,
) -> tuple[xr.Dataset, Survey | None]:
    """
    Separate checked inputs; and the surveys of each pixel alone, of cameras at one place.

    To pool cameras side by side a result of each pixel `alone` is needed; made if not at hand.
    What is told of the materials may `regroup` them.
    """
    variables, capture = schema.STAGES["separated"], inputs.capture
    displaced, pooled = inputs.displacement is not None, inputs.labels is not None
    if alone is None and displaced and pooled:
        alone, _ = separated(replace(inputs, labels=None), workers=workers, progress=progress)
    if inputs.method.pools:
        variables = {**variables, _COVARIANCE: schema.OPTIONAL["separated"][_COVARIANCE]}
    result = _allocate(capture, variables)
    # Cameras apart, and materials, take passes that are not known beforehand.
    total = None if displaced or pooled else result["status"].size
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(workers) as threads,
        tqdm(total=total, unit="pixel", desc=inputs.name, disable=not progress) as bar,
    ):

        def separate_pixels(
            inputs: Inputs, material: Material | None, wanted: Mask | None = None
        ) -> Survey:
            """Separate all pixels into the result; or only survey those that are wanted."""
            survey = Survey.empty(len(inputs.bands), result["status"].size)
            into = result if wanted is None else None
            separate = partial(_separate, inputs, material, into, survey, wanted)
            for pixels in threads.map(separate, inputs.blocks):
                bar.update(pixels)
            return survey

        materials = partial(pooling.materials, survey=separate_pixels, surveys=surveys)
        if alone is not None and displaced:
            side_by_side.pooled(inputs, alone, result, separate_pixels, threads, materials, regroup)
        elif displaced:
            side_by_side.alone(inputs, result, separate_pixels, threads)
        elif pooled:
            separate_pixels(*pooling.regrouped(inputs, materials, regroup))
        else:
            surveys = separate_pixels(inputs, None)
    if inputs.method.pools:
        _withhold(result)
    sources = inputs.response.attrs, capture.attrs
    held = sources[0] | sources[1]
    notes = [np.atleast_1d(attrs.get("warnings", [])) for attrs in sources]
    doubts = dict.fromkeys(str(sentence) for note in notes for sentence in note)
    counts_per_kelvin = np.array([curve.reference_slope for curve in inputs.curves])
    attrs = {"units": "count", "long_name": "noise, as used"}
    result["noise"] = xr.DataArray(inputs.noise * counts_per_kelvin, dims="band", attrs=attrs)
    ratios = () if inputs.method.pools else ("reflection_ratio", "reflection_ratio_std")
    result = result.assign_attrs(
        method=inputs.name,
        pooled=int(pooled),
        response_kind=inputs.response_kind,
        **{key: held[key] for key in sorted(_ASSUMED & held.keys())},
        **({"warnings": [*doubts]} if doubts else {}),
        noise_source=inputs.response.attrs["noise_source"],
        emissivity_source="capture" if inputs.emissivity is None else "given",
        not_estimated=" ".join(inputs.method.not_estimated + ratios),
        reference_band=str(capture["band"].values[inputs.bands[0]]),
        **({} if inputs.settings is None else {"settings": repr(inputs.settings)}),
    )
    return result, surveys


def _withhold(result: xr.Dataset) -> None:
    """Withhold objects whose emissivity lies outside (0, 1): rapid changes were no reflection's."""
    impossible = (result["status"].values & np.uint32(schema.Status.NONPHYSICAL_EMISSIVITY)) != 0
    for name in ("object_temperature", "object_temperature_std"):
        for frame in result[name].values:
            frame[impossible] = np.nan
        release()


def require_workers(workers: Any) -> None:
    """Refuse a number of threads that is not a whole number from 1 up."""
    if type(workers) is bool or not isinstance(workers, int | np.integer) or workers < 1:
        rule = "Must be a whole number, at least 1"
        raise ValueError(f"Invalid number of workers {workers!r}. {rule}.")


def require_seed(seed: Any) -> None:
    """Refuse a seed that is not a whole number from 0 up."""
    if type(seed) is bool or not isinstance(seed, int | np.integer) or seed < 0:
        raise ValueError(f"Invalid seed {seed!r}. Must be zero or positive, a whole number.")


def get_method(name: str | Method) -> Method:
    """
    Record of a method: its functions, its settings, and its demands on the capture.

    Parameters
    ----------
    name : str or Method
        One of `METHODS`; a record of your code is returned as it is.

    Returns
    -------
    Method
        Among its fields `settings`, the type of its options or None, and `knows_emissivity`.

    Raises
    ------
    ValueError
        If there is no such method.

    Examples
    --------
    >>> get_method("calibrated").knows_emissivity
    True
    >>> get_method("subspace").settings(background_drift=1.0)  # K
    SubspaceSettings(background_drift=1.0, device=None)
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
    wanted: Mask | None,
    rows: slice,
) -> int:
    """Separate a block of rows, or what is wanted of it, into its place; return its pixels."""
    size = 0
    for cut in tiles.cut(inputs, rows, material, wanted):
        estimates = []
        for frames, pixels, tile in cut.parts:
            estimate: Estimate = inputs.apply(inputs.method.separate, tile)
            if estimate.status.size == pixels.size and not pixels.all():
                estimate = estimate.select_pixels(pixels)
            estimates.append((frames, pixels, estimate))
            if estimate.survey is not None:
                # Whitened by one noise for all, not by that of the tile.
                scale = np.array(tile.noise) / inputs.noise[inputs.bands]
                scatter = estimate.survey.scatter * np.multiply.outer(scale, scale)[..., np.newaxis]
                section = replace(estimate.survey, scatter=scatter)
                survey.replace_pixels(cut.places[pixels], section)
        if result is not None:
            _write(result, inputs.bands, cut, estimates)
            _keep(inputs.division, cut.places, estimates)
        release()
        size += cut.status.size
    return size


def _allocate(corrected: xr.Dataset, variables: Mapping[str, schema.Variable]) -> xr.Dataset:
    """Make an empty result of some variables with the coordinates of a capture."""
    sizes = {**corrected.sizes, "other_band": corrected.sizes["band"]}
    kept = {name: value for name, value in corrected.attrs.items() if name in tiles.KEPT_ATTRS}
    arrays = {}
    for name, variable in variables.items():
        attrs = schema.status_attrs() if name == "status" else variable.attrs
        array = empty(tuple(sizes[dim] for dim in variable.dims), variable.dtype)
        arrays[name] = xr.DataArray(array, dims=variable.dims, attrs={**attrs, **kept})
    names = ("band", "time", "y", "x")
    coordinates = {name: corrected[name] for name in names if name in corrected.coords}
    if any("other_band" in variable.dims for variable in variables.values()):
        coordinates["other_band"] = corrected["band"].rename(band="other_band")
    return xr.Dataset(arrays, coords=coordinates, attrs=kept)


def _keep(
    division: npt.NDArray[np.uint8], places: Whole, estimates: list[tuple[Mask, Mask, Estimate]]
) -> None:
    """Keep the divisions of the time of pixels with all frames for the next pass, in place."""
    division[:, places] = 0
    for frames, pixels, estimate in estimates:
        if estimate.division is not None and np.all(frames):
            division[:, places[pixels]] = np.packbits(estimate.division, axis=0)


@np.errstate(over="ignore")  # a deviation beyond single precision is infinite
def _write(
    result: xr.Dataset,
    bands: list[int],
    cut: tiles.Cut,
    estimates: list[tuple[Mask, Mask, Estimate]],
) -> None:
    """Write the estimates of a window into the result, at frames (time) and pixels (pixel).

    The tile's bands have these places in the capture. What has no estimate becomes NaN.
    """
    order, shape = np.argsort(bands), tuple(span.stop - span.start for span in cut.window)
    unestimated = np.ones(cut.status.size, dtype=bool)
    for _, pixels, _ in estimates:
        unestimated &= ~pixels
    for name in map(str, result.data_vars):
        target, dims = result.variables[name].values[..., *cut.window], result.variables[name].dims
        if name == "status":
            target[...] = cut.status.reshape(shape)
        else:
            target[..., unestimated.reshape(shape)] = np.nan
        for frames, pixels, estimate in estimates:
            values, places = getattr(estimate, name), pixels.reshape(shape)
            if values is None:
                target[..., places] = np.nan
            elif name == "status":
                target[places] |= values
            elif "band" in dims:
                target[..., places] = values[np.ix_(*[order] * (values.ndim - 1))]
            elif np.all(frames) and np.all(pixels) and np.all(cut.valid):
                target[...] = values.reshape(target.shape)
            else:
                values, places = np.asarray(values, np.float32), np.flatnonzero(pixels)
                _scatter(values, frames, places, cut.valid, target)


@compiled
def _scatter(
    values: npt.NDArray[np.float32], frames: Mask, places: Whole, valid: Mask, film: Any
) -> None:
    """Write values (time, pixel) at some frames and places of a film (time, y, x), in place.

    NaN at its other frames, and at samples (time, pixel) that are not valid.
    """
    row, width = 0, film.shape[2]
    for t in range(frames.size):
        for p in range(places.size):
            measured = frames[t] and valid[t, places[p]]
            film[t, places[p] // width, places[p] % width] = values[row, p] if measured else np.nan
        row += frames[t]
