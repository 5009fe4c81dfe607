"""The authors' published videos of two scenes, and their own separation to compare with.

They are pictures: 8 bit, compressed, each frame scaled on its own. Nothing here is radiometric,
and every result says so. Source: the project page of Narayanan et al. (2026),
doi:10.48550/arXiv.2509.11334, listed as `scenes` in the data manifest.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from dbthermal import metrics, readers

BANDS: Final = {"8-14": 0, "9.5": 1}
"""Band and the number in its video's name; the second is published as 9.25-9.75 um."""

SMOOTHING: Final = 1.0
"""Standard deviation of the smoothing of a map before it is compared [pixel]."""


def inputs(files: Mapping[str, Path], name: str, first: int, last: int) -> xr.DataArray:
    """
    Both bands (band, time, y, x) of a scene, in [0, 1], with `radiometric = 0`.

    Of the files of `manifest.local("scenes")`, the scene "coffeepot" or "glass-plate", from the
    first frame to the one before the last. Raises a FileNotFoundError without such a video, a
    ValueError if the two videos differ in shape or are too short.
    """
    movies = []
    for number in BANDS.values():
        movie = readers.palette_video(_file(files, f"{name}-{number}-bg.mp4"))
        if not 0 <= first < last <= movie.sizes["time"]:
            raise ValueError(
                f"Invalid frames {first} to {last} of scene '{name}'. "
                f"Must lie in [0, {movie.sizes['time']}], first before last."
            )
        movies.append(movie.isel(time=slice(first, last)))
    if movies[0].shape != movies[1].shape:
        raise ValueError(
            f"Invalid shapes {movies[0].shape}, {movies[1].shape} of scene '{name}'. Must agree."
        )
    movies[1] = movies[1].assign_coords(time=movies[0]["time"])
    band = xr.DataArray(list(BANDS), dims="band", name="band")
    together = xr.concat(movies, band, combine_attrs="drop_conflicts")
    return together.assign_attrs(radiometric=0, scene=name, origin="published video")


def authors_reflection(files: Mapping[str, Path], name: str, kind: str, width: int) -> xr.Dataset:
    """
    Magnitude of the background's change as published by the authors.

    `kind` is "uncalib" or "calib", by estimated or calibrated emissivities; beyond the width of the
    input video [pixel] lies a printed bar. `value` (time, y, x) in [0, 1], in units of the frame's
    own bar, and `valid`.
    """
    path = _file(files, f"{name}_{kind}_Tbdiff_video.mp4")
    return readers.masked_palette_video(path, "turbo", width)


def agreement(reflection: xr.DataArray, theirs: xr.Dataset, strongest: int) -> xr.DataArray:
    """
    Correlation (time) [1] of our reflection's magnitude with the authors', where it is strongest.

    Our reflection (time, y, x), smoothed by `SMOOTHING`, is compared over the pixels that the
    authors' map covers in all of the frames in which its mean square on the object is strongest.
    Raises a ValueError if the frames differ in number or size.
    """
    if theirs["value"].shape != reflection.shape:
        raise ValueError(
            f"Invalid shape {theirs['value'].shape} of the authors' map. "
            f"Must be {reflection.shape}."
        )
    theirs = theirs.assign_coords({dim: reflection[dim] for dim in ("time", "y", "x")})
    # Smoothed within the object alone: its surroundings neither enter nor dim its edge.
    inside, width = theirs["valid"].values.astype(np.float64), (0.0, SMOOTHING, SMOOTHING)
    smoothed = gaussian_filter(reflection.values * inside, width)
    weight = gaussian_filter(inside, width)
    ours = reflection.copy(data=np.abs(np.divide(smoothed, weight, where=inside > 0, out=inside)))
    power = (reflection**2).where(theirs["valid"]).mean(("y", "x"))
    chosen = np.sort(np.argsort(power.values)[-strongest:])
    ours, theirs = ours.isel(time=chosen), theirs.isel(time=chosen)
    return metrics.correlation(ours, theirs["value"], theirs["valid"].all("time"))


def _file(files: Mapping[str, Path], name: str) -> Path:
    if name not in files:
        raise FileNotFoundError(f"Missing video '{name}'. Must be one of {sorted(files)}.")
    return files[name]
