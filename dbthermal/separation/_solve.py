"""The one entrance to all methods: the inputs are checked, and separated tile by tile."""

import importlib
import operator
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import xarray as xr
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from dbthermal.schema import Status
from dbthermal.separation import _inputs as inputs
from dbthermal.separation import _quality as quality
from dbthermal.separation import _tiles as tiles
from dbthermal.separation._inputs import Inputs, Labels
from dbthermal.separation._pooling import pool as pooling
from dbthermal.separation._tiles import (
    PIXELS,
    Array,
    Bits,
    Estimate,
    Mask,
    Material,
    Method,
    Parts,
    Survey,
    Tile,
    Window,
)

if TYPE_CHECKING:
    from dbthermal.separation._baselines.bcp import BcpSettings
    from dbthermal.separation._baselines.naive import NaiveSettings
    from dbthermal.separation._baselines.pyrometry import RatioSettings
    from dbthermal.separation._dbvt import DbvtSettings
    from dbthermal.separation._subspace.method import SubspaceSettings

    Settings = SubspaceSettings | DbvtSettings | NaiveSettings | RatioSettings | BcpSettings

_MODULES: Final = {
    "subspace": ("_subspace.method", "METHOD"),
    "calibrated": ("_baselines.calibrated", "METHOD"),
    "dbvt": ("_dbvt.method", "METHOD"),
    "naive": ("_baselines.naive", "METHOD"),
    "ratio": ("_baselines.pyrometry", "RATIO"),
    "bcp": ("_baselines.bcp", "METHOD"),
    "apparent": ("_baselines.pyrometry", "APPARENT"),
}
METHODS: Final = tuple(_MODULES)
"""Names of the methods; the module of each is imported when it is first used."""


def solve(  # noqa: PLR0913 - the one entrance; all but the first three are by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: str = "subspace",
    *,
    settings: "Settings | None" = None,
    emissivity: xr.DataArray | None = None,
    emissivity_std: xr.DataArray | None = None,
    mask: xr.DataArray | None = None,
    pool: xr.DataArray | None = None,
    response_kind: str = "exact",
    workers: int = 2,
    seed: int = 0,
    progress: bool = False,
) -> xr.Dataset:
    r"""
    Separate emission and reflection in a capture of two bands or more.

    .. math:: I_m(t) = e_m U_m(x(t)) + (1 - e_m) U_m(y(t)) + \mathrm{noise}

    Parameters
    ----------
    corrected : Dataset
        `counts` (band, time, y, x) [count], `time` [s]; optionally `status` (y, x) from
        `frames.correct` and `segment` (time) from `frames.mark_shutter`. Samples that are NaN are
        left out. May be lazy, as from `store.open_dataset`: it is read a few rows at a time, and
        never whole. "subspace" takes two bands or more, the other methods two.
    response : Dataset
        From `calibration.fit_response`, with both bands. Its `noise` (band) [count] is used
        where present, otherwise the noise is estimated from the capture.
    method : {"subspace", "calibrated", "dbvt", "naive", "ratio", "bcp", "apparent"}
        This project's separator; known emissivities; the paper's optimiser; and to compare with,
        least squares, dual-wavelength pyrometry, the blackbody channel prior, and the camera's
        own reading.
    settings : SubspaceSettings, DbvtSettings, NaiveSettings, RatioSettings or BcpSettings, optional
        Options of the method; its defaults if not given.
    emissivity : DataArray, optional
        Known emissivity, (band) or (band, y, x) [1] in (0, 1); for "calibrated" only.
    emissivity_std : DataArray, optional
        Its standard deviation, same dims.
    mask : DataArray, optional
        Which samples to use: (time), (y, x) or (time, y, x), boolean.
    pool : DataArray, optional
        Materials (y, x), integer: the pixels of one label share their emissivities, which makes
        all of them more certain; a negative one shares nothing. Known to the user, or found by
        `materials`. For "subspace" only.
    response_kind : {"exact", "linear"}
        Sakuma-Hattori response, or the paper's linear one.
    workers : int
        Threads.
    seed : int
        Of the random starts; the result depends on it and not on `workers`.
    progress : bool
        Show a bar.

    Returns
    -------
    Dataset
        `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1] and `reflection_ratio` (band, y, x) [1], the reflectivity over that of the
        quietest band (attribute `reference_band`), each with `_std`; `status` (y, x), bits of
        `schema.FLAGS`; `noise` (band) [count], as used. Values are NaN where a flag says that they
        are undefined, at samples that the capture lacks or the mask leaves out, and where a method
        never estimates them (attribute `not_estimated`); where the status is 0, all others are
        finite. A given emissivity without a deviation has deviation 0.

    Raises
    ------
    TypeError
        If an argument is of the wrong type, or the settings are those of another method.
    ValueError
        If a dim, unit, band, coordinate, method or emissivity is not as described, or
        the capture is too short for the method. What is wrong with single pixels is not an
        error but a bit of `status`.

    Notes
    -----
    What no flag of `subspace` tells, because nothing in the bands tells it: that object and
    background have exchanged their roles, but for emissivities below a half, which are flagged as
    a suspicion; and a background that drifts along with the object's curve: the temperature holds,
    and the emissivity's deviation carries a drift that `SubspaceSettings.background_drift` states.

    A `segment` is used by "subspace" alone, and for the object alone: the step that a shutter
    event leaves stays in the background, and makes the emissivity less certain, as its deviation
    says; the object temperature is free of it. An object that jumps just then is not told.

    References
    ----------
    .. [1] Narayanan, Ramanagopal, Narasimhan (2026), Dual Band Thermal Videography, CVPR;
       doi:10.48550/arXiv.2509.11334
    """
    module = get_method(method)
    settings = _checked_settings(module, method, settings)
    if operator.index(workers) < 1:
        raise ValueError(f"Invalid number of workers {workers}. Must be at least 1.")
    if operator.index(seed) < 0:
        raise ValueError(f"Invalid seed {seed}. Must be zero or positive.")
    checked = inputs.check(
        corrected,
        response,
        module,
        method,
        emissivity=emissivity,
        emissivity_std=emissivity_std,
        mask=mask,
        pool=pool,
        response_kind=response_kind,
    )
    run = _Run(checked, module, settings, seed)
    result = tiles.allocate(corrected)
    height, pixels = corrected.sizes["y"], corrected.sizes["y"] * corrected.sizes["x"]
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(workers) as threads,
        tqdm(
            total=pixels if checked.labels is None else 2 * pixels,
            unit="pixel",
            desc=method,
            disable=not progress,
        ) as bar,
    ):
        blocks = list(tiles.blocks(height, whole_image=module.whole_image))
        if checked.labels is not None:
            selected = pooling.select(checked.labels)
            run = run.pooled(threads.map(lambda rows: run.survey(rows, selected, bar), blocks))
        for _ in threads.map(lambda rows: run.separate(rows, result.isel(y=rows), bar), blocks):
            pass
    counts_per_kelvin = np.array([curve.reference_slope for curve in checked.curves])
    attrs = {"units": "count", "long_name": "noise, as used"}
    result["noise"] = xr.DataArray(checked.noise * counts_per_kelvin, dims="band", attrs=attrs)
    ratios = () if module.survey else ("reflection_ratio", "reflection_ratio_std")
    return result.assign_attrs(
        method=method,
        response_kind=response_kind,
        noise_source="response" if "noise" in response else "capture",
        emissivity_source="capture" if emissivity is None else "given",
        not_estimated=" ".join(module.not_estimated + ratios),
        reference_band=str(corrected["band"].values[checked.bands[0]]),
        **({} if settings is None else {"settings": repr(settings)}),
    )


def get_method(name: str) -> Method:
    """
    Record of a method: its functions, its settings, and its demands on the capture.

    Parameters
    ----------
    name : str
        One of `METHODS`.

    Returns
    -------
    Method
        Among its fields `settings`, the type of its options or None, and `knows_emissivity`.

    Raises
    ------
    ValueError
        If there is no such method.
    """
    if name not in METHODS:
        raise ValueError(f"Unknown method '{name}'. Must be one of {list(METHODS)}.")
    module, record = _MODULES[name]
    method: Method = getattr(importlib.import_module(f"dbthermal.separation.{module}"), record)
    return method


def _checked_settings(method: Method, name: str, settings: Any) -> Any:
    """Return the settings of a method, its defaults for None; None for a method without any."""
    kind = method.settings
    if settings is None:
        return None if kind is None else kind()
    if kind is None or type(settings) is not kind:
        rule = "be omitted: it has no settings" if kind is None else f"be {kind.__name__}"
        raise TypeError(
            f"Invalid settings of type {type(settings).__name__} for method '{name}'. Must {rule}."
        )
    for field in fields(kind):
        value = getattr(settings, field.name)
        if type(field.default) is int and type(value) is not int:
            raise TypeError(
                f"Invalid {field.name} {value!r} of method '{name}'. Must be a whole number."
            )
    return settings


@dataclass(frozen=True)
class _Run:
    """One run of a method over a capture, a block of rows at a time."""

    inputs: Inputs
    method: Method
    settings: Any
    seed: int
    materials: Material | None = None

    def separate(self, rows: slice, result: xr.Dataset, bar: "tqdm[Any]") -> None:
        """Separate a block of rows into its place in the result."""
        for window, status, valid, parts in self._tiles(rows):
            estimates = []
            for frames, pixels, tile in parts:
                estimate: Estimate = self._call(self.method.separate, tile)
                whole = estimate.status.size == pixels.size
                estimate = estimate.select_pixels(pixels) if whole else estimate
                estimates.append((frames, pixels, estimate))
            tiles.write(result, window, self.inputs.bands, status, valid, estimates)
            bar.update(status.size)

    def survey(self, rows: slice, selected: Mask, bar: "tqdm[Any]") -> list[tuple[Labels, Survey]]:
        """Survey the selected pixels of a block; with their numbers in the image."""
        surveys = []
        for window, status, _, parts in self._tiles(rows):
            numbers = self._numbers(window, rows)
            for _, pixels, tile in parts:
                wanted = selected[numbers[pixels]]
                if np.any(wanted):
                    part = tile if np.all(wanted) else tile.select_pixels(wanted)
                    survey: Survey = self._call(self.method.survey, part)
                    surveys.append((numbers[pixels][wanted], survey))
            bar.update(status.size)
        return surveys

    def pooled(self, blocks: Iterable[list[tuple[Labels, Survey]]]) -> "_Run":
        """Return the run in which the pixels of one material share their ratios and emissivity."""
        labels = self.inputs.labels
        surveys = [part for block in blocks for part in block]
        if not surveys or labels is None:
            return self
        numbers = np.concatenate([number for number, _ in surveys])
        survey = pooling.join([part for _, part in surveys])
        noise = self.inputs.noise[self.inputs.bands]
        materials = pooling.estimate(labels[numbers], int(labels.max()) + 1, survey, noise)
        return replace(self, materials=materials)

    def _call(self, function: Callable[..., Any] | None, tile: Tile) -> Any:
        assert function is not None
        return function(tile) if self.settings is None else function(tile, self.settings)

    def _numbers(self, window: Window, rows: slice) -> Labels:
        """Numbers (pixel) of a window's pixels in the image."""
        lines = np.arange(window[0].start, window[0].stop)[:, np.newaxis] + rows.start
        columns = np.arange(window[1].start, window[1].stop)
        return np.asarray((lines * self.inputs.capture.sizes["x"] + columns).ravel())

    def _tiles(self, rows: slice) -> Iterator[tuple[Window, Bits, Mask, Parts[Tile]]]:
        """Yield the windows of a block, status and valid samples, and a tile by set of frames."""
        block = self.inputs.capture.isel(y=rows).load()
        height, width, time = block.sizes["y"], block.sizes["x"], block["time"].values
        method = self.method
        size = height * width if method.whole_image else getattr(self.settings, "batch", PIXELS)
        for window in tiles.windows(height, width, size):
            part = block.isel(y=window[0], x=window[1])
            counts, valid, status = quality.read(part, method.minimum_frames)
            excluded, used = quality.unusable(status), valid
            counts, valid = quality.bridge(counts, valid, time)
            if method.whole_image or method.every_frame:
                fewest = method.minimum_frames
                frames, lacking = quality.common_frames(valid, excluded, fewest)
                status[lacking] |= np.uint32(Status.INVALID_SAMPLES)
                counts[:, :, lacking] = 0.0
                usable = ~excluded & ~lacking
                sets = [(frames, usable)] if np.any(usable) else []
            else:
                sets = list(quality.frame_sets(valid, excluded))
            tile = self._tile(part, counts, window, rows)
            parts = []
            for frames, pixels in sets:
                one = tile if np.all(frames) else tile.select_frames(frames)
                alone = not (method.whole_image or np.all(pixels))
                parts.append((frames, pixels, one.select_pixels(pixels) if alone else one))
            yield window, status, used, parts

    def _tile(self, part: xr.Dataset, counts: Array, window: Window, rows: slice) -> Tile:
        """Make the tile of all pixels and frames of a window."""
        known, bands = self.inputs, self.inputs.bands
        place = (slice(window[0].start + rows.start, window[0].stop + rows.start), window[1])
        curves = tuple(known.curves[band] for band in bands)
        signals = [
            curve.linearise(counts[band]) - curve.reference
            for band, curve in zip(bands, curves, strict=True)
        ]
        emissivity, std = (
            None if array is None else array[(slice(None), *place)].reshape(len(bands), -1)[bands]
            for array in (known.emissivity, known.emissivity_std)
        )
        material = None
        if self.materials is not None and known.labels is not None:
            material = pooling.expand(self.materials, known.labels[self._numbers(window, rows)])
        return Tile(
            signals=np.stack(signals),
            time=part["time"].values.astype(np.float64),
            curves=curves,
            noise=tuple(float(known.noise[band]) for band in bands),
            shape=(part.sizes["y"], part.sizes["x"]),
            rng=tiles.generator(self.seed, place),
            segment=part["segment"].values.astype(np.intp) if "segment" in part else None,
            material=material,
            emissivity=emissivity,
            emissivity_std=std,
        )
