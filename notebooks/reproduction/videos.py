"""The authors' published videos of their scenes, and their own separation to compare with.

They are pictures: 8 bit, compressed, each frame scaled on its own. Nothing here is radiometric,
and every result says so. Source: the project page of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334, listed as `scenes` and `other_scenes` in the data manifest.
"""

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import binary_dilation, gaussian_filter

from dbthermal._arrays import Array
from reproduction import numbers, palettes, uncalibrated

BANDS: Final = {"8-14": 0, "9.5": 1}
"""Band and the number in its video's name; the second is published as 9.25-9.75 um."""

KINDS: Final = ("uncalib", "calib")
"""The authors' results, by estimated and by calibrated emissivities."""

SMOOTHING: Final = 1.0  # standard deviation of the smoothing of a map before it is compared [pixel]

MARGIN: Final = 6  # pixels beyond the object's outline that are not taken as still surroundings

_CHANGE: Final = 2  # frames over which pictures are compared to find out which ones they are


WAYS: Final = {"scale undone": False, "both undone": True}
"""Name of a separation, and whether the reflections' displacement is undone before it, too."""


@dataclass(frozen=True)
class Scene:
    """A published scene: its inputs, and the authors' results for the frames that these show."""

    movie: xr.DataArray  # (band, time, y, x) [1], the frames that the results show
    theirs: Mapping[str, xr.Dataset]  # kind -> `value`, `valid` (time, y, x)
    outline: xr.DataArray  # (y, x): the object, by the results
    first: int  # input frame that is the results' first
    margin: float  # by which that one stands out, in median deviations; infinite if all are shown


def scene(files: Mapping[str, Path], inputs_name: str, results_name: str) -> Scene:
    """Read a scene of `manifest.local`, such as "incan-bulb" with the results' name "incan".

    Where the results have fewer frames than the inputs, their first frame is found by `first_frame`
    on the authors' reflection. The object is what their results draw in more than half of the
    frames. Raises as `inputs`, and a ValueError if results and inputs do not fit together.
    """
    movie = inputs(files, inputs_name)
    width = movie.sizes["x"]
    # The authors' magnitude of the background's change, in units of each frame's own bar; beyond
    # the width of the input video may lie a printed bar.
    names = {kind: f"{results_name}_{kind}_Tbdiff_video.mp4" for kind in KINDS}
    read = partial(palettes.masked_palette_video, palette="turbo", width=width)
    theirs = {kind: read(_file(files, name)) for kind, name in names.items()}
    outline = theirs["uncalib"]["valid"].mean("time") > 0.5
    first, margin = first_frame(movie, theirs["uncalib"]["value"], outline)
    shown = movie.isel(time=slice(first, first + theirs["uncalib"].sizes["time"]))
    return Scene(shown, theirs, outline, first, margin)


def inputs(files: Mapping[str, Path], name: str) -> xr.DataArray:
    """Both bands (band, time, y, x) of a scene, in [0, 1], with `radiometric = 0`.

    Raises a FileNotFoundError without such a video, a ValueError if the two differ in shape.
    """
    names = [f"{name}-{number}-bg.mp4" for number in BANDS.values()]
    movies = [palettes.palette_video(_file(files, name)) for name in names]
    if movies[0].shape != movies[1].shape:
        message = f"Invalid shapes {movies[0].shape}, {movies[1].shape} of scene '{name}'"
        raise ValueError(f"{message}. Must agree.")
    movies[1] = movies[1].assign_coords(time=movies[0]["time"])
    band = xr.DataArray(list(BANDS), dims="band", name="band")
    together = xr.concat(movies, band, combine_attrs="drop_conflicts")
    fits = [movie.attrs["palette_residual"] for movie in movies]
    attrs = {"radiometric": 0, "scene": name, "origin": "published video"}
    return together.assign_attrs(attrs, palette_residual=fits)


def first_frame(
    movie: xr.DataArray, theirs: xr.DataArray, outline: xr.DataArray
) -> tuple[int, float]:
    """First frame of the inputs (band, time, y, x) that the results show, and how it stands out.

    Changes of both over two frames, of pictures without their own scale, are correlated over the
    object, in magnitude, for theirs have no sign; the median over time is largest where the frames
    are the same ones, in the band of the larger one: the other band shows what moves displaced, and
    so at another time. It stands out by that less the median over all first frames, in the scaled
    median deviations of these. Raises a ValueError if the results have more frames or other sizes.
    """
    extra = movie.sizes["time"] - theirs.sizes["time"]
    if extra < 0 or movie.shape[2:] != theirs.shape[1:]:
        rule = f"Must be at most the inputs' {movie.shape[1:]}"
        raise ValueError(f"Invalid results of {theirs.shape} frames, rows and columns. {rule}.")
    results = _changes(theirs.values, outline.values)
    scores = np.empty((len(movie), extra + 1))
    for place, band in enumerate(movie.values):
        ours = _changes(band, outline.values)
        for first in range(extra + 1):
            window = ours[first : first + len(results)]
            scores[place, first] = np.median(np.abs(np.einsum("tp,tp->t", results, window)))
    best = scores[np.argmax(scores.max(axis=1))]
    above = best - np.median(best)
    deviation = 1.4826 * float(np.median(np.abs(above)))
    return int(np.argmax(best)), float(above.max()) / deviation if extra else np.inf


def _changes(movie: npt.NDArray[np.floating], mask: npt.NDArray[np.bool_]) -> Array:
    """Changes (time, pixel) over two frames of pictures without gain and offset, of norm 1."""
    smoothed = gaussian_filter(movie.astype(np.float64), (0, SMOOTHING, SMOOTHING))[:, mask]
    frames = _normalised(smoothed)
    return _normalised(frames[_CHANGE:] - frames[:-_CHANGE])


def _normalised(rows: Array) -> Array:
    """Rows less their means, of norm 1, or 0 where a row is constant."""
    rows = rows - rows.mean(axis=1, keepdims=True)
    norm = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0))


def still(outline: xr.DataArray) -> xr.DataArray:
    """Surroundings (y, x): pixels more than `MARGIN` off the object."""
    return outline.copy(data=~binary_dilation(outline.values, iterations=MARGIN))


def agreement(
    reflection: xr.DataArray, theirs: xr.Dataset, frames: npt.NDArray[np.intp], pixels: xr.DataArray
) -> xr.DataArray:
    """Correlation (time) [1] of our reflection's magnitude with the authors', in some frames.

    Our reflection (time, y, x), smoothed by `SMOOTHING`, is compared over those of the pixels that
    the authors' map covers in all of these frames. Raises a ValueError if the frames differ in
    number or size, or a map is constant or unknown where it is compared.
    """
    if theirs["value"].shape != reflection.shape:
        rule = f"Must be {reflection.shape}"
        raise ValueError(f"Invalid shape {theirs['value'].shape} of the authors' map. {rule}.")
    theirs = theirs.assign_coords({dim: reflection[dim] for dim in ("time", "y", "x")})
    ours, theirs = reflection.isel(time=frames), theirs.isel(time=frames)
    # Smoothed within the object alone: its surroundings neither enter nor dim its edge.
    covering, width = theirs["valid"].values.astype(np.float64), (0.0, SMOOTHING, SMOOTHING)
    smoothed = gaussian_filter(ours.values * covering, width)
    weight = gaussian_filter(covering, width)
    ours = ours.copy(data=np.abs(np.divide(smoothed, weight, where=covering > 0, out=covering)))
    covered = (theirs["valid"].all("time") & pixels).values
    pairs = zip(ours.values[:, covered], theirs["value"].values[:, covered], strict=True)
    with np.errstate(invalid="ignore"):
        scores = np.array([np.corrcoef(*pair)[0, 1] for pair in pairs])
    if not np.all(np.isfinite(scores)):
        raise ValueError("Constant or unknown map where it is compared. Must be known, and vary.")
    return ours["time"].copy(data=scores)


def strongest(reflection: xr.DataArray, outline: xr.DataArray, number: int) -> npt.NDArray[np.intp]:
    """Frames, in their order, in which a reflection's mean square on the object is largest."""
    power = (reflection**2).where(outline).mean(("y", "x"))
    return np.asarray(np.sort(np.argsort(power.values)[-number:]))


@dataclass(frozen=True)
class Comparison:
    """A scene separated in several ways, each beside the authors' maps."""

    undone: xr.DataArray  # inputs (band, time, y, x) without the frames' scale, where it allows
    separated: xr.Dataset  # from `uncalibrated.uncalibrated_reflection` of that
    scores: xr.DataArray  # its agreement (time) [1] with the authors' first map
    edges: xr.DataArray  # from `uncalibrated.edges_shift`
    reflections: xr.DataArray  # from `uncalibrated.reflections_shift`
    table: xr.DataArray  # median agreement (way, map, pixels) [1], NaN where left out
    left_out: Mapping[str, str]  # way -> why


def compare(scene: Scene, number: int) -> Comparison:
    """Separate a scene in all `WAYS`, and compare each with the authors' maps.

    All are compared in the same frames, the `number` in which the reflection is strongest, and at
    the same pixels: all that show the object in both bands, and those of them where the bands
    change together (correlation above 0.5), by the separation with the scale undone. A way in which
    the scene cannot be separated is left out, and said why; a ValueError if it is all of them.
    """
    # Undo the frames' scale; find the displacement, and the pixels that both bands show.
    undone = uncalibrated.unscaled(scene.movie, still(scene.outline))
    reflections = uncalibrated.reflections_shift(undone, scene.outline)
    shared = uncalibrated.shared_outline(scene.outline, reflections)
    # Separate in each way.
    separated: dict[str, xr.Dataset] = {}
    left_out = {}
    for way, of_reflections in WAYS.items():
        try:
            movie = uncalibrated.moved(undone, reflections) if of_reflections else undone
            separation = uncalibrated.uncalibrated_reflection(movie)
        except ValueError as error:
            left_out[way] = str(error)
        else:
            separated[way] = separation.drop_vars("emission") if separated else separation
    if not separated:
        raise ValueError(f"Inseparable scene: {left_out}. Must be separable in one way.")
    # Choose pixels and frames by the first separation.
    first = separated[next(iter(separated))]
    pixels = {"object": shared, "moving": shared & (first["correlation"] > uncalibrated.CORRELATED)}
    frames = strongest(first["reflection"], shared, number)
    # Correlate each reflection with each of the authors' maps.
    coords = {"way": list(WAYS), "map": list(KINDS), "pixels": list(pixels)}
    table = xr.DataArray(np.full((len(WAYS), 2, 2), np.nan), coords, attrs={"units": "1"})
    for way, kind, where in itertools.product(separated, KINDS, pixels):
        reflection = separated[way]["reflection"]
        score = agreement(reflection, scene.theirs[kind], frames, pixels[where]).median()
        table.loc[{"way": way, "map": kind, "pixels": where}] = score
    scores = agreement(first["reflection"], scene.theirs[KINDS[0]], frames, shared)
    edges = uncalibrated.edges_shift(undone)
    return Comparison(undone, first, scores, edges, reflections, table, left_out)


def compare_all(
    scenes: Mapping[str, Scene], number: int
) -> tuple[dict[str, Comparison], dict[str, str]]:
    """Compare all scenes, see `compare`; and why those that cannot be separated are left out."""
    compared, left_out = {}, {}
    for name, scene in scenes.items():
        try:
            compared[name] = compare(scene, number)
        except ValueError as error:
            left_out[name] = str(error)
    return compared, left_out


def report(compared: Mapping[str, Comparison]) -> str:
    """Tables in Markdown of the displacements and of the agreement, a row a scene and way."""
    columns = [f"{kind}, {where}" for kind in KINDS for where in ("object", "moving")]
    heads = ("scene", "still edges [pixel]", "reflections [pixel]", "their correlation, at 0")
    shifts, rows, notes = [heads], [("scene", "way", *columns)], []
    for name, comparison in compared.items():
        edges, reflections = comparison.edges, comparison.reflections
        still, moving = (f"{float(shift.sel(axis='x')):.2f}" for shift in (edges, reflections))
        peak, at_0 = (reflections.attrs[key] for key in ("correlation", "correlation_at_0"))
        shifts.append((name, still, moving, f"{peak:.2f}, {at_0:.2f}"))
        for way in WAYS:
            scores = comparison.table.sel(way=way).values.ravel()
            rows.append((name, way, *(f"{score:.3f}" for score in scores)))
        undone = comparison.undone.attrs["scale_undone"] or "no band"
        shares = ", ".join(f"{share:.2f}" for share in comparison.undone.attrs["scale_explained"])
        note = f"{name}: scale undone in {undone}; it explains {shares} of the surroundings' change"
        reasons = "".join(f"; {way} left out: {why}" for way, why in comparison.left_out.items())
        notes.append(f"- {note}{reasons}")
    blocks = (
        "Published videos, not radiometric. The second band shows at p the first's p + d, [pixel].",
        numbers.table(shifts),
        "Correlation of the reflection's map with the authors', median of the frames.",
        numbers.table(rows),
        "\n".join(notes),
    )
    return "\n\n".join(blocks) + "\n"


def _file(files: Mapping[str, Path], name: str) -> Path:
    if name not in files:
        raise FileNotFoundError(f"Missing video '{name}'. Must be one of {sorted(files)}.")
    return files[name]
