"""The one entrance to all methods: checks, noise, tiles, threads."""

import operator
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from dbthermal import noise as noise_of
from dbthermal import response as responses
from dbthermal import schema
from dbthermal.curves import Curve
from dbthermal.separation import (
    _inputs as given,
)
from dbthermal.separation import (
    _methods as methods,
)
from dbthermal.separation import (
    _quality as samples,
)
from dbthermal.separation import (
    _tiles as tiles,
)
from dbthermal.separation._pooling import pool as pool_of
from dbthermal.separation._problem import Method, Problem
from dbthermal.separation._separated import Array, Flags, Mask, Separated, Survey

Places = npt.NDArray[np.intp]

_NOISE_PIXELS: Final = 4096
_READ: Final = ("counts", "status", "segment", "mask")


def solve(  # noqa: PLR0913 - the one entrance; all but the first three are by name
    corrected: xr.Dataset,
    response: xr.Dataset,
    method: str = "subspace",
    *,
    settings: Any = None,
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
    module = methods.get_method(method)
    settings = methods.checked(method, settings)
    _check(corrected, method, module, (workers, seed), has_emissivity=emissivity is not None)
    names = [str(name) for name in corrected["band"].values]
    curves = [responses.curve(response, name, response_kind) for name in names]
    if pool is not None and module.survey is None:
        raise ValueError(f"Invalid pool for method '{method}', which does not pool.")
    corrected = given.with_mask(corrected, mask)
    deviations = _noise(corrected, response, curves)
    task = _Task(
        needed=corrected[[name for name in _READ if name in corrected]],
        curves=curves,
        noise=deviations,
        # The quieter band comes first: the regression for the emissivity needs a quiet ordinate.
        bands=[int(band) for band in np.argsort(deviations, kind="stable")],
        known=given.Given(*given.known_emissivity(corrected, emissivity, emissivity_std) or ()),
        method=module,
        settings=settings,
        seed=seed,
    )
    labels = given.labels(corrected, pool)
    result = tiles.allocate(corrected)
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(workers) as threads,
        tqdm(
            total=corrected.sizes["y"] * corrected.sizes["x"] * (1 if labels is None else 2),
            unit="pixel",
            desc=method,
            disable=not progress,
        ) as bar,
    ):
        blocks = list(tiles.blocks(corrected, whole_image=module.whole_image))
        if labels is not None:
            asked = pool_of.asked(labels)
            found = threads.map(lambda rows: task.survey(rows, asked, bar), blocks)
            task = task.pooled(labels, [part for block in found for part in block])
        for _ in threads.map(lambda rows: task.separate(rows, result.isel(y=rows), bar), blocks):
            pass
    counts_per_kelvin = np.array([curve.reference_slope for curve in curves])
    attrs = {"units": "count", "long_name": "noise, as used"}
    result["noise"] = xr.DataArray(deviations * counts_per_kelvin, dims="band", attrs=attrs)
    return result.assign_attrs(
        method=method,
        response_kind=response_kind,
        noise_source="response" if "noise" in response else "capture",
        emissivity_source="capture" if emissivity is None else "given",
        not_estimated=" ".join(_not_estimated(module)),
        reference_band=names[int(np.argmin(deviations))],
        **({} if settings is None else {"settings": repr(settings)}),
    )


@dataclass(frozen=True)
class _Task:
    """What every tile needs."""

    needed: xr.Dataset
    curves: list[Curve]
    noise: Array
    bands: list[int]
    known: given.Given
    method: Method
    settings: Any
    seed: int
    materials: pool_of.Materials | None = None

    def separate(self, rows: slice, result: xr.Dataset, bar: "tqdm[Any]") -> None:
        """Separate a block of rows into its place in the result."""
        for tile, status, there, problems in self._problems(rows):
            parts = []
            for frames, pixels, problem in problems:
                found: Separated = self._call(self.method.separate, problem)
                whole = found.status.size == pixels.size
                parts.append((frames, pixels, found.of(pixels) if whole else found))
            tiles.write(result, tile, self.bands, status, there, parts)
            bar.update(status.size)

    def survey(self, rows: slice, asked: Mask, bar: "tqdm[Any]") -> list[tuple[Places, Survey]]:
        """What a block's pixels tell of their materials, and which pixels of the image they are."""
        found = []
        for tile, status, _, problems in self._problems(rows):
            place = self._places(tile, rows)
            for _, pixels, problem in problems:
                chosen = asked[place[pixels]]
                if np.any(chosen):
                    part = problem if np.all(chosen) else problem.of(chosen)
                    tells = self._call(self.method.survey, part)
                    found.append((place[pixels][chosen], tells))
            bar.update(status.size)
        return found

    def pooled(self, labels: Places, found: list[tuple[Places, Survey]]) -> "_Task":
        """The same task with the pixels of one material sharing what they tell."""
        if not found:
            return self
        places = np.concatenate([place for place, _ in found])
        survey = pool_of.joined([part for _, part in found])
        count = int(labels.max()) + 1
        materials = pool_of.combine(labels[places], count, survey, self.noise[self.bands])
        return replace(self, materials=replace(materials, label=labels))

    def _call(self, function: Callable[..., Any] | None, problem: Problem) -> Any:
        assert function is not None
        return function(problem) if self.settings is None else function(problem, self.settings)

    def _places(self, tile: tiles.Tile, rows: slice) -> Places:
        """Numbers of a tile's pixels in the image."""
        down, along = tiles.moved(tile, rows.start)
        width = self.needed.sizes["x"]
        lines = np.arange(down.start, down.stop)[:, np.newaxis] * width
        return (lines + np.arange(along.start, along.stop)).ravel()

    def _problems(
        self, rows: slice
    ) -> Iterator[tuple[tiles.Tile, Flags, Mask, list[tuple[Mask, Mask, Problem]]]]:
        """Tiles of a block, status and samples of their pixels, problems by set of frames."""
        part = self.needed.isel(y=rows).load()
        whole = part.sizes["y"] * part.sizes["x"]
        size = whole if self.method.whole_image else getattr(self.settings, "batch", tiles.PIXELS)
        for tile in tiles.cover(part, size):
            counts, there, status = samples.read(part, tile, self.method.minimum_frames)
            bad, own = samples.unusable(status), there
            counts, there = samples.bridged(counts, there, part["time"].values)
            if self.method.whole_image or self.method.every_frame:
                frames, lacking = samples.common(there, bad, self.method.minimum_frames)
                status[lacking] |= np.uint32(schema.FLAGS["invalid_samples"])
                counts[:, :, lacking] = 0.0
                usable = ~bad & ~lacking
                sets = [(frames, usable)] if np.any(usable) else []
            else:
                sets = list(samples.patterns(there, bad))
            problem = self._problem(part, counts, tile, rows)
            problems = []
            for frames, pixels in sets:
                one = problem if np.all(frames) else problem.at(frames)
                alone = not (self.method.whole_image or np.all(pixels))
                problems.append((frames, pixels, one.of(pixels) if alone else one))
            yield tile, status, own, problems

    def _problem(self, part: xr.Dataset, counts: Array, tile: tiles.Tile, rows: slice) -> Problem:
        """All pixels and frames of a tile."""
        place = tiles.moved(tile, rows.start)
        curves = [self.curves[band] for band in self.bands]
        signals = [
            curve.linearise(counts[band]) - curve.reference
            for band, curve in zip(self.bands, curves, strict=True)
        ]
        shared = None
        if self.materials is not None:
            shared = self.materials.shared(self._places(tile, rows))
        problem = Problem(
            signals=np.stack(signals),
            time=part["time"].values.astype(np.float64),
            curves=tuple(curves),
            noise=tuple(float(self.noise[band]) for band in self.bands),
            shape=tiles.shape_of(tile),
            rng=tiles.generator(self.seed, place),
            segment=part["segment"].values.astype(np.intp) if "segment" in part else None,
            shared=shared,
        )
        return self.known.put_into(problem, place, self.bands)


def _not_estimated(method: Method) -> tuple[str, ...]:
    """Variables of the result that a method leaves NaN everywhere."""
    ratios = ("reflection_ratio", "reflection_ratio_std")
    return method.not_estimated + (() if method.survey else ratios)


def _check(
    corrected: xr.Dataset,
    name: str,
    method: Method,
    whole: tuple[int, int],
    *,
    has_emissivity: bool,
) -> None:
    workers, seed = whole
    schema.check(corrected, "corrected")
    samples.check_status(corrected)
    if operator.index(workers) < 1:
        raise ValueError(f"Invalid number of workers {workers}. Must be at least 1.")
    if operator.index(seed) < 0:
        raise ValueError(f"Invalid seed {seed}. Must be zero or positive.")
    number, names = corrected.sizes["band"], [str(name) for name in corrected["band"].values]
    if number < 2 or (number > 2 and not method.any_bands):
        rule = "two or more" if method.any_bands else "exactly two"
        raise ValueError(f"Invalid bands {names} for method '{name}'. Must be {rule}.")
    frames = corrected.sizes["time"]
    if frames < method.minimum_frames:
        raise ValueError(
            f"Invalid capture of {frames} frames for method '{name}'. "
            f"Must have at least {method.minimum_frames}."
        )
    if has_emissivity and not method.knows_emissivity:
        raise ValueError(f"Invalid emissivity for method '{name}', which estimates it. Omit it.")
    if not has_emissivity and method.knows_emissivity:
        raise ValueError(f"Missing emissivity. Method '{name}' must be given one.")


def _noise(corrected: xr.Dataset, response: xr.Dataset, curves: list[Curve]) -> Array:
    """Standard deviation of the linearised signals (band) [K]: calibrated, or from the capture."""
    if "noise" in response:
        slopes = np.array([curve.reference_slope for curve in curves])
        return np.asarray(responses.noise(response, [curve.band for curve in curves]) / slopes)
    counts, frames = samples.sample(corrected, _NOISE_PIXELS)
    signals = [curve.linearise(part) for curve, part in zip(curves, counts, strict=True)]
    return noise_of.of_bands(signals, corrected["time"].values[frames])
