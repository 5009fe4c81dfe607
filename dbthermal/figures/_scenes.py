"""Figures of separated scenes: frames, comparison with a published separation, status."""

import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal.figures._canvas import (
    COLORS,
    band_label,
    canvas,
    draw_image,
    limits_of,
    provenance_note,
)


def separated_frames(
    inputs: xr.DataArray,
    emission: xr.DataArray,
    reflection: xr.DataArray,
    *,
    title: str,
    labels: tuple[str, str, str],
) -> Figure:
    """
    For a scene: the two inputs, the emission and the mean-subtracted reflection, a row a time.

    Parameters
    ----------
    inputs : DataArray
        (band, time, y, x), any unit.
    emission, reflection : DataArray
        (time, y, x); pixels without a value are gray.
    title : str
        What the scene is.
    labels : tuple of str
        Labels with units of inputs, emission and reflection.

    Returns
    -------
    Figure
        As many rows as there are times.
    """
    bands, frames = inputs["band"].values, inputs.sizes["time"]
    aspect = inputs.sizes["y"] / inputs.sizes["x"]
    columns = len(bands) + 2
    figure, axes = canvas(frames, columns, (3.3 * columns, (2.6 * aspect + 0.45) * frames))
    scales = [limits_of(inputs.sel(band=band)) for band in bands]
    warm, change = limits_of(emission), limits_of(reflection, symmetric=True)
    for index, row in enumerate(axes):
        moment = f"{float(inputs['time'][index]):.1f} s"
        for axis, band, scale in zip(row, bands, scales, strict=False):
            image = inputs.sel(band=band).isel(time=index)
            draw_image(
                figure, axis, image, f"input {band_label(band)}, {moment}", labels[0], limits=scale
            )
        image = emission.isel(time=index)
        draw_image(figure, row[-2], image, f"emission, {moment}", labels[1], limits=warm)
        image = reflection.isel(time=index)
        title_here = f"reflection less its mean, {moment}"
        draw_image(figure, row[-1], image, title_here, labels[2], cmap="RdBu_r", limits=change)
    figure.suptitle(title + provenance_note(inputs))
    return figure


def separated_temperatures(
    apparent: xr.DataArray,
    emission: xr.DataArray,
    change: xr.DataArray,
    *,
    title: str,
    label: str = "background change [K]",
) -> Figure:
    """
    `separated_frames` of temperatures, in degrees Celsius.

    Parameters
    ----------
    apparent : DataArray
        Apparent temperature of the inputs (band, time, y, x) [K].
    emission : DataArray
        Object temperature (time, y, x) [K].
    change : DataArray
        Background temperature less its mean over time, or `separation.reflected_change`
        (time, y, x) [K].
    title : str
        What the scene is.
    label : str
        What the change is, with its unit.

    Returns
    -------
    Figure
        As many rows as there are times.
    """
    labels = ("apparent [\N{DEGREE SIGN}C]", "object [\N{DEGREE SIGN}C]", label)
    inputs = (apparent - zero_Celsius).assign_attrs(apparent.attrs)
    return separated_frames(inputs, emission - zero_Celsius, change, title=title, labels=labels)


def compared_reflections(ours: xr.DataArray, theirs: xr.DataArray, scores: xr.DataArray) -> Figure:
    """
    Our reflection beside the authors' published one, and their correlation frame by frame.

    Parameters
    ----------
    ours, theirs : DataArray
        Magnitude of the reflection at a few times (time, y, x), in units of their own.
    scores : DataArray
        Correlation of the two maps (time) [1], of the frames that were compared.

    Returns
    -------
    Figure
        Two maps a chosen time, and the correlations with their median.
    """
    columns = ours.sizes["time"]
    figure, axes = canvas(3, columns, (3.2 * columns, 8.0))
    for index in range(columns):
        moment = f"{float(ours['time'][index]):.1f} s"
        for axis, movie, name in (
            (axes[0, index], ours, "ours"),
            (axes[1, index], theirs, "published"),
        ):
            image = movie.isel(time=index)
            draw_image(
                figure,
                axis,
                image,
                f"{name}, {moment}",
                "own unit",
                cmap="magma",
                limits=limits_of(image),
            )
    grid = axes[2, 0].get_gridspec()
    for axis in axes[2]:
        axis.remove()
    bottom = figure.add_subplot(grid[2, :])
    bottom.plot(scores["time"], scores, "o", color=COLORS[0], markersize=4)
    bottom.axhline(float(scores.median()), color="0.5", linewidth=1)
    bottom.set(xlabel="time [s]", ylabel="correlation [1]", ylim=(min(0.0, float(scores.min())), 1))
    bottom.set_title(f"{scores.size} frames, median {float(scores.median()):.2f}", fontsize=9)
    figure.suptitle("Magnitude of the reflection" + provenance_note(ours))
    return figure
