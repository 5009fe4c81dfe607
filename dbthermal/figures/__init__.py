"""Figures that a thermographer expects: a function draws its arguments and returns the figure.

Nothing is computed here beyond units for display, nothing is saved. Temperatures are drawn in
degrees Celsius. Every figure of data that are simulated or not radiometric says so in its title,
from the `origin` and `radiometric` attributes of its data. `drawing` has the parts of a new figure.
For a journal, draw with ``matplotlib.style.context("dbthermal.figures.publication")`` in force,
which is as wide as a page at most, with letters of 7 points, and save as PDF (`store.save_figure`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from textwrap import fill
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from scipy.constants import zero_Celsius

from dbthermal import _text, schema
from dbthermal.figures import drawing
from dbthermal.figures.drawing import band_label, canvas, draw_image, limits_of
from dbthermal.schema import laid_on

__all__ = [
    "REASONS",
    "FilmPanel",
    "Panel",
    "drawing",
    "film",
    "live",
    "plan",
    "reflection_shift",
    "separated_frames",
    "separated_temperatures",
    "status",
]
__dir__ = __all__.copy

_WIDTH, _DPI = 3.2, 100  # of a picture of a film [inch], and dots of an inch
_LIVE_WIDTH: Final = 4.8  # of a picture of a recording [inch]
_TEXT_HEIGHT: Final = 1.15  # of title, lines and foot [inch]
_BAR: Final = 0.76  # of its width that a picture takes, beside the colour bar
_LETTERS: Final = 75  # of a line of the foot, per picture
_TICKS: Final = 4  # intervals of the colour bar at most: every number costs a millisecond
_ALARM: Final = "#b3001b"
_SCALE: Final = (0.1, 10.0)  # std at the ends of the colours [K]: as good, as bad as can be
_MICRO: Final = "\N{MICRO SIGN}m"
_BOX: Final = {"facecolor": "white", "edgecolor": _ALARM, "alpha": 0.85, "pad": 3.0}


def separated_frames(
    inputs: xr.DataArray,
    emission: xr.DataArray,
    reflection: xr.DataArray,
    *,
    title: str,
    labels: tuple[str, str, str],
) -> Figure:
    """Inputs, emission and mean-subtracted reflection of a scene, one row per time.

    Parameters
    ----------
    inputs : DataArray
        (band, time, y, x), any unit.
    emission, reflection : DataArray
        (time, y, x); pixels without a value are gray.
    title, labels : str, tuple of str
        Name of the scene; labels with units of inputs, emission and reflection.
    """
    if inputs.dims != (dims := schema.STAGES["corrected"]["counts"].dims):
        raise ValueError(f"Invalid dims {inputs.dims} of the inputs. Must be {dims}.")
    emission = laid_on(emission, inputs, "the emission", "the inputs")
    reflection = laid_on(reflection, inputs, "the reflection", "the inputs")
    bands, frames = inputs["band"].values, inputs.sizes["time"]
    aspect = inputs.sizes["y"] / inputs.sizes["x"]
    columns = len(bands) + 2
    figure, axes = canvas(frames, columns, (3.3 * columns, (2.6 * aspect + 0.45) * frames))
    # One range of colour for all times.
    scales = [limits_of(inputs.sel(band=band)) for band in bands]
    warm, change = limits_of(emission), limits_of(reflection, symmetric=True)
    for index, row in enumerate(axes):
        moment = f"{float(inputs['time'][index]):.1f} s"
        for axis, band, scale in zip(row, bands, scales, strict=False):
            image, name = inputs.sel(band=band).isel(time=index), f"input {band_label(band)}"
            draw_image(figure, axis, image, f"{name}, {moment}", labels[0], limits=scale)
        image = emission.isel(time=index)
        draw_image(figure, row[-2], image, f"emission, {moment}", labels[1], limits=warm)
        image = reflection.isel(time=index)
        title_here = f"reflection less its mean, {moment}"
        draw_image(figure, row[-1], image, title_here, labels[2], cmap="RdBu_r", limits=change)
    figure.suptitle(title + drawing.provenance_note(inputs))
    return figure


def separated_temperatures(
    apparent: xr.DataArray,
    emission: xr.DataArray,
    change: xr.DataArray,
    *,
    title: str,
    label: str = "background change [K]",
) -> Figure:
    """`separated_frames` of temperatures, in degrees Celsius.

    Parameters
    ----------
    apparent, emission : DataArray
        Temperature of the inputs (band, time, y, x), and of the object (time, y, x) [K].
    change : DataArray
        Background temperature less its mean over time, or what it changes (time, y, x) [K].
    title, label : str
        Name of the scene; label of the change, with its unit.

    Examples
    --------
    >>> from dbthermal import figures
    >>> movie = xr.DataArray(np.full((1, 4, 6), 300.0), {"time": [0.0]}, ("time", "y", "x"))
    >>> apparent = movie.expand_dims(band=["8-14", "9.5"])  # K
    >>> figure = figures.separated_temperatures(apparent, movie, movie - 300.0, title="plate")
    >>> [axis.get_title() for axis in figure.axes[2:4]]
    ['emission, 0.0 s', 'reflection less its mean, 0.0 s']
    """
    labels = ("apparent [\N{DEGREE SIGN}C]", "object [\N{DEGREE SIGN}C]", label)
    names = {"the inputs": apparent, "the emission": emission, "the reflection": change}
    for name, temperature in names.items():
        schema.check_numbers(temperature, name, "K")
    inputs = (apparent - zero_Celsius).assign_attrs(apparent.attrs)
    return separated_frames(inputs, emission - zero_Celsius, change, title=title, labels=labels)


def reflection_shift(field: xr.Dataset) -> Figure:
    """Shift of the reflections between two cameras: its components and their standard deviations.

    Rows down above, columns to the right below. Extrapolated pixels are hatched, such without a
    value gray.

    Parameters
    ----------
    field : Dataset
        From `alignment.reflection_shift`, (axis, y, x) [pixel].
    """
    schema.check(field, "reflection_shift", label="the field")
    figure, axes = canvas(2, 2, (7.4, 5.6))
    extrapolated = field["shift"].isel(axis=0).notnull() & ~field["known"]
    for row, axis, side in zip(axes, field["axis"].values, ("down", "right"), strict=True):
        titles = {"shift": f"shift {side}", "shift_std": "standard deviation"}
        for place, (name, title) in zip(row, titles.items(), strict=True):
            image = field[name].sel(axis=axis)
            scale = limits_of(image) if name == "shift" else (0.0, limits_of(image)[1])
            label = f"{title} [pixel]"
            draw_image(figure, place, image, title, label, cmap="viridis", limits=scale)
            if extrapolated.any():
                place.contourf(extrapolated.values, [0.5, 1.5], colors="none", hatches=["///"])
    bands = ", ".join(band_label(name) for name in np.atleast_1d(field.attrs["bands"]))
    reference = band_label(field.attrs["reference_band"])
    heading = f"Reflection of {bands} in the picture of {reference}"
    figure.suptitle(heading + drawing.provenance_note(field))
    return figure


@dataclass(frozen=True)
class FilmPanel:
    """Picture of a film.

    Attributes
    ----------
    values : DataArray
        (time, y, x); pixels without a value are gray.
    title, unit : str
        Title, and unit of the colour bar.
    symmetric, limits, palette : bool, (float, float) or None, str
        Zero in the middle of the range of colour; that range, in place of the values' own; colours,
        by their name in matplotlib.
    """

    values: xr.DataArray
    title: str
    unit: str = "[\N{DEGREE SIGN}C]"
    symmetric: bool = False
    limits: tuple[float, float] | None = None
    palette: str = "inferno"


def film(panels: Sequence[FilmPanel], *, title: str) -> Iterator[npt.NDArray[np.uint8]]:
    """Frames of a film: pictures side by side, each with one range of colour for all times.

    Parameters
    ----------
    panels, title : sequence of FilmPanel, str
        Of the same times and pixels; heading, which the time follows.

    Yields
    ------
    ndarray of uint8, shape (rows, columns, 3)
        Colours; both sizes even, as video codecs want them.
    """
    first = panels[0].values
    aspect = first.sizes["y"] / first.sizes["x"]
    size = (_WIDTH * len(panels), round((0.8 * _WIDTH * aspect + 1.0) * _DPI / 2) * 2 / _DPI)
    figure, axes = canvas(1, len(panels), size)
    figure.set_dpi(_DPI)
    for axis, panel in zip(axes[0], panels, strict=True):
        scale = panel.limits or limits_of(panel.values, symmetric=panel.symmetric)
        cmap = "RdBu_r" if panel.symmetric else panel.palette
        image = panel.values.isel(time=0)
        draw_image(figure, axis, image, panel.title, panel.unit, cmap=cmap, limits=scale)
    heading = figure.suptitle(f"{title}, {' ' * 7}")
    # Draw the axes and labels once, and over them the images of each time.
    sheet: Any = FigureCanvasAgg(figure)  # whose methods have no types
    images = [axis.images[0] for axis in axes[0]]
    for artist in (*images, heading):
        artist.set_animated(True)
    sheet.draw()
    still = sheet.copy_from_bbox(figure.bbox)
    for index, moment in enumerate(panels[0].values["time"].values):
        sheet.restore_region(still)
        heading.set_text(f"{title}, {moment:.1f} s")
        for image, panel in zip(images, panels, strict=True):
            image.set_data(panel.values.values[index])
            image.axes.draw_artist(image)
        figure.draw_artist(heading)
        yield np.asarray(sheet.buffer_rgba())[..., :3].copy()


@dataclass(frozen=True, eq=False)
class Panel:
    """Picture and texts of one band, or of one temperature.

    Attributes
    ----------
    image, is_temperature : array, bool
        Raw signal (y, x) [count] of a band, or a temperature [degree Celsius]; NaN is gray.
    limits, text, warning : tuple of float, str, str
        Values at both ends of the colours; texts below and across the picture.
    """

    image: npt.NDArray[Any]
    limits: tuple[float, float]
    text: str
    warning: str = ""
    is_temperature: bool = False


def live(panels: Mapping[str, Panel], *, title: str, foot: str = "") -> Figure:
    """Figure of the last frames of a recording, side by side.

    Parameters
    ----------
    panels : mapping of str to Panel
        Band, or name of a temperature, to its picture; all of one shape.
    title, foot : str
        Texts above and below, which belong to no picture.

    Examples
    --------
    >>> import numpy as np
    >>> figure = live({"9.5": Panel(np.zeros((24, 32)), (0, 1), "no frame yet")}, title="pot")
    >>> figure.axes[0].get_xlabel()
    'no frame yet'
    """
    rows, columns = next(iter(panels.values())).image.shape
    height = _BAR * _LIVE_WIDTH * rows / columns + _TEXT_HEIGHT
    figure, axes = canvas(1, len(panels), (_LIVE_WIDTH * len(panels), height))
    for axis, (name, panel) in zip(axes[0], panels.items(), strict=True):
        # The picture, with few whole numbers at its colour bar.
        shown = name, "temperature [\N{DEGREE SIGN}C]", "inferno"
        if not panel.is_temperature:
            shown = band_label(name), "raw signal [count]", "gray"
        image, (heading, label, cmap) = xr.DataArray(panel.image, dims=("y", "x")), shown
        draw_image(figure, axis, image, heading, label, cmap=cmap, limits=panel.limits)
        bar = axis.images[0].colorbar
        bar.locator, bar.formatter = MaxNLocator(_TICKS, integer=True), ScalarFormatter()
        axis.set_xlabel(panel.text, loc="left", fontsize=9)
        if panel.warning:
            place: dict[str, Any] = {"transform": axis.transAxes, "va": "top", "fontsize": 9}
            axis.text(0.02, 0.97, panel.warning, color=_ALARM, bbox=_BOX, **place)
    figure.suptitle(title)
    figure.supxlabel(fill(foot, _LETTERS * len(panels)), fontsize=9)
    return figure


def plan(expected: xr.Dataset, durations: xr.Dataset, materials: Sequence[str]) -> Figure:
    """Expected accuracy of the object temperature by filter, and by length of the film.

    Left, a map with its numbers, the best filter of each material framed; right, lines over the
    length.

    Parameters
    ----------
    expected : Dataset
        From `limits.plan`: `object_temperature_std` (material, filter) [K], `best` (material),
        the attribute `beside`.
    durations : Dataset
        From `limits.plan_durations`: `object_temperature_std` (seconds, material, filter) [K].
    materials : sequence of str
        Materials of the lines, with the best filter of each, if any; ValueError for an unknown one.
    """
    for material in materials:
        _text.check_listed("Unknown material", material, expected["material"].values.tolist())
    std = expected["object_temperature_std"]
    size = (7.8 + 0.75 * std.sizes["filter"], max(4.2, 0.24 * std.sizes["material"] + 1.9))
    figure, ((map_axis, bar_axis),) = canvas(1, 2, size)
    values, names = std.where(np.isfinite(std)).values, std["filter"].values.tolist()
    drawn = map_axis.imshow(values, cmap="viridis_r", norm=LogNorm(*_SCALE), aspect="auto")
    map_axis.set_facecolor("0.8")
    # Number of each cell, the best of a row framed.
    for row, column in np.ndindex(*values.shape):
        value, framed = values[row, column], expected["best"].values[row] == names[column]
        text = f"{value:.2g}" if np.isfinite(value) else "\N{EM DASH}"
        color = "white" if value > np.sqrt(_SCALE[0] * _SCALE[1]) else "black"
        frame = {"boxstyle": "round,pad=0.2", "fill": False, "edgecolor": color}
        style: dict[str, Any] = {"color": color, "fontsize": 8, "ha": "center", "va": "center"}
        map_axis.text(column, row, text, bbox=frame if framed else None, **style)
    map_axis.set_xticks(range(len(names)), names, fontsize=8)
    map_axis.set_yticks(range(len(values)), std["material"].values.tolist(), fontsize=8)
    bar = figure.colorbar(drawn, ax=map_axis, label="expected std [K]", shrink=0.8, extend="both")
    drawing.plain_decades(bar.ax)
    map_axis.set_xlabel(f"filter beside {expected.attrs['beside']} [{_MICRO}]")
    # Lines of the materials over the length.
    best = expected["best"].sel(material=list(materials))
    filtered = best[np.isin(best.values, std["filter"].values)]
    for index, name in enumerate(filtered["material"].values):
        chosen = str(filtered.sel(material=name).item())
        stds = durations["object_temperature_std"].sel(material=name, filter=chosen)
        line = {**drawing.marked_line(index), "label": f"{name}, {chosen} {_MICRO}"}
        bar_axis.loglog(durations["seconds"], stds, **line)
    drawing.plain_ticks(bar_axis, durations["seconds"])
    drawing.plain_decades(bar_axis)
    bar_axis.set(xlabel="length of the film [s]", ylabel="expected std [K]")
    if filtered.size:
        bar_axis.legend(frameon=False, fontsize=8, loc="upper right")
    title = "Object temperature of one pixel, expected standard deviation"
    figure.suptitle(title + drawing.provenance_note(expected))
    return figure


REASONS: Final = MappingProxyType(
    {
        "completed_from_prior": ("completed, by a library's or stated emissivity", "#8e4585"),
        "completed_from_material": ("completed, by the same material elsewhere", "#d6619b"),
        "completed_from_surroundings": ("completed, by the surroundings", "#e78ac3"),
        "completed_frames": ("many frames completed", "#f7cfe2"),
        "dead_pixel": ("dead pixel", "#000000"),
        "saturated": ("saturated", "#4d4d4d"),
        "invalid_samples": ("no samples, as outside a view", "#737373"),
        "constant_signal": ("signal never changes", "#969696"),
        "frozen_frames": ("frozen frames, as by a shutter", "#bdbdbd"),
        "no_reflection_pair": ("reflection not seen by the second camera", "#d9d9d9"),
        "object_jump": ("object jumps", "#7f3b08"),
        "bands_apart": ("bands see the reflection at different times", "#b35806"),
        "object_not_smooth": ("object changes too fast, or noise is too high", "#e08214"),
        "roles_may_be_swapped": ("object and reflection may be swapped", "#fdb863"),
        "no_background_motion": ("no motion reflected: nothing can be told", "#08306b"),
        "gray": ("same emissivity in all bands: nothing can be told", "#00868b"),
        "constant_object": ("object constant: emissivity unknown", "#6baed6"),
        "nonphysical_emissivity": ("emissivity outside 0 to 1", "#6a51a3"),
        "outside_response": ("outside the calibrated temperatures", "#9e9ac8"),
        "not_converged": ("not converged", "#dadaeb"),
        "background_never_rests": ("reflection never rests: emissivity doubtful", "#c7b299"),
    }
)
"""Words and colour of each flag, causes before consequences: a pixel with several is drawn as its
first. A completed pixel is drawn as completed, whatever the reason that it is not measured."""

_GOOD: Final = ("no flag", "#a8d5b0")


def status(result: xr.Dataset) -> Figure:
    """Map of the pixels without a flag, and of the most decisive flag of the others, in words.

    A colour for each flag that is the first of a pixel's, in the order of `REASONS`, and its share.

    Parameters
    ----------
    result : Dataset
        From `separation.solve` or `complete`: `status` (y, x), bits of `schema.Status`; ValueError
        for another bit.

    Examples
    --------
    >>> from dbthermal import figures, schema
    >>> bits = np.array([[0, 0, 0, int(schema.Status.DEAD_PIXEL)]], dtype=np.uint32)
    >>> figure = figures.status(xr.Dataset({"status": (("y", "x"), bits)}))
    >>> [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    ['75.0 %  no flag', '25.0 %  dead pixel']
    """
    schema.check(result, "separated", ["status"], "the result")
    codes, shown = legend(result["status"])  # the first flag of each pixel
    image = np.array([to_rgb(color) for _, color, _ in shown])[codes]
    height = 5.2 * codes.shape[0] / codes.shape[1]
    figure, ((map_axis, legend_axis),) = canvas(1, 2, (9.6, max(height, 0.25 * len(shown)) + 0.6))
    map_axis.get_gridspec().set_width_ratios([1.3, 1.0])
    map_axis.imshow(image, interpolation="nearest")
    map_axis.set(xticks=[], yticks=[])
    legend_axis.set_axis_off()
    # Legend with shares.
    patches = [
        Patch(facecolor=color, edgecolor="0.5", label=f"{drawing.percent(share)}  {words}")
        for words, color, share in shown
    ]
    legend_axis.legend(
        handles=patches, loc="upper left", borderaxespad=0.0, frameon=False, fontsize=9
    )
    shares = {words: share for words, _, share in shown}
    completed = sum(share for words, share in shares.items() if "completed" in words)
    good = f"{drawing.percent(shares.get(_GOOD[0], 0.0))} of the pixels have no flag"
    good += f", {drawing.percent(completed)} are completed" if completed else ""
    figure.suptitle(f"Status: {good}{drawing.provenance_note(result)}", fontsize="medium")
    return figure


def legend(flags: xr.DataArray) -> tuple[npt.NDArray[np.uint8], list[tuple[str, str, float]]]:
    """Place in the legend of each pixel of a `status`, and the legend: words, colour, share."""
    first, texts = first_reason(flags), {"": _GOOD, **REASONS}
    names = [name for name in texts if np.any(first == name)]
    codes = np.select([first == name for name in names], range(len(names))).astype(np.uint8)
    return codes, [(*texts[name], float(np.mean(first == name))) for name in names]


def first_reason(flags: xr.DataArray) -> npt.NDArray[np.str_]:
    """Name of the most decisive flag of each pixel of a `status`; empty without a flag."""
    bits = flags.values.astype(np.uint32)  # of older results they are of 16 bit
    if unknown := int(np.bitwise_or.reduce(bits, axis=None)) & ~sum(schema.Status):
        raise ValueError(f"Unknown bits {unknown} of a status. Must be of {schema.Status.bits()}.")
    masks = [(bits & schema.Status.bits()[name]) != 0 for name in REASONS]
    return np.select(masks, [np.array(name) for name in REASONS], default=np.array(""))
