"""Figure and files of explored frames and curves."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from PIL import Image

from dbthermal import figures, store
from dbthermal.explorer._films import Region
from dbthermal.explorer._view import Pixels, View
from dbthermal.figures import FilmPanel, drawing, legend

ANIMATED: Final = (".gif", ".webp")
SUFFIXES: Final = (".csv", ".tiff", ".png", ".nc", *ANIMATED)
_FILMED: Final = 150  # frames of an animated picture, at most
_MOST_COLUMNS: Final = 3


@dataclass(frozen=True)
class Shown:
    """Panes of a view at a frame, as a page shows them."""

    names: Sequence[str]  # of the panes
    index: int  # of the frame
    regions: Mapping[str, Region]
    celsius: bool
    pixels: Pixels = "unflagged"  # that count in the regions' curves
    palette: str = "inferno"
    # Ranges of colour by pane; the view's own if left out.
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)


def figure(view: View, shown: Shown) -> Figure:
    """Figure of the panes side by side, with the outlines of regions."""
    names = shown.names
    columns = 2 if len(names) == 4 else min(len(names), _MOST_COLUMNS)
    rows = -(-len(names) // columns)
    height = 3.6 * view.shape[0] / view.shape[1] + 0.5
    result, axes = drawing.canvas(rows, columns, (4.4 * columns, height * rows + 0.4))
    places: list[Axes] = axes.ravel().tolist()
    # Pictures, then nothing in the places without one.
    for axis in places[len(names) :]:
        axis.set_axis_off()
    for axis, name in zip(places, names, strict=False):
        pane = view.pane(name)
        if pane.kind == "status":
            codes, entries = legend(xr.DataArray(view.status))
            colors = np.array([to_rgb(color) for _, color, _ in entries])
            axis.imshow(colors[codes], interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.set_title("Status: green is without a flag", fontsize=9)
        else:
            units, offset = pane.unit(celsius=shown.celsius)
            low, high = shown.limits.get(name) or view.limits(name)
            image = xr.DataArray(view.frame(name, shown.index) - offset, dims=("y", "x"))
            label = units if units != "1" else ""
            scale = (low - offset, high - offset)
            title = pane.label[0].upper() + pane.label[1:]
            drawing.draw_image(result, axis, image, title, label, cmap=shown.palette, limits=scale)
        # Outlines of the regions, in the colours of their curves.
        for place, region in enumerate(shown.regions.values()):
            color = drawing.COLORS[place % len(drawing.COLORS)]
            patch = axis.add_patch(_outline(region, fill=False, edgecolor=color, linewidth=1.5))
            patch.set_path_effects([withStroke(linewidth=3.5, foreground="white")])
    note = drawing.provenance_note(view.data)
    result.suptitle(f"{view.time[shown.index]:.2f} s{note}", fontsize=10)
    return result


def sampled(
    view: View, name: str, frames: int, samples: float = np.inf, *, celsius: bool
) -> tuple[xr.DataArray, int]:
    """Film of a pane in its shown unit, of some frames and pixels, and the step of the pixels."""
    moments = slice(None, None, -(-view.time.size // frames))
    time, pane = view.time[moments], view.pane(name)
    step = max(1, math.ceil(math.sqrt(math.prod(view.shape) * time.size / samples)))
    values = pane.read(moments, slice(None, None, step), slice(None, None, step))
    zero = np.float32(pane.unit(celsius=celsius)[1])
    return xr.DataArray(values - zero, {"time": time}, ("time", "y", "x")), step


def panels(view: View, shown: Shown, frames: int, samples: float = np.inf) -> list[FilmPanel]:
    """Pictures of a film of the panes that change, of at most so many frames and samples each."""
    made = []
    for pane in (view.pane(name) for name in shown.names if view.pane(name).kind == "film"):
        unit, zero = pane.unit(celsius=shown.celsius)
        low, high = shown.limits.get(pane.name) or view.limits(pane.name)
        film, _ = sampled(view, pane.name, frames, samples, celsius=shown.celsius)
        style: dict[str, Any] = {"limits": (low - zero, high - zero), "palette": shown.palette}
        made.append(FilmPanel(film, pane.label, f"[{unit}]", **style))
    return made


def save_film(view: View, path: Path, shown: Shown) -> None:
    """Save the films among the panes side by side, as an animated picture at their own speed."""
    if not (pictures := panels(view, shown, _FILMED)):
        raise ValueError(f"Invalid film of {list(shown.names)}. Must have a picture that changes.")
    origin = drawing.provenance_note(view.data).strip(" (),") or "film"
    first, *further = map(Image.fromarray, figures.film(pictures, title=origin))
    period = max(20, round(1000.0 * float(np.ptp(view.time)) / max(len(further), 1)))  # [ms]
    first.save(path, save_all=True, append_images=further, duration=period, loop=0)


def _outline(region: Region, **style: Any) -> Patch:
    """Outline of a region on a picture, whose first pixel has its centre at 0."""
    corners = np.array(region.points)[:, ::-1] - 0.5  # (x, y)
    if region.kind == "polygon":
        return Polygon(corners, **style)
    size = corners[1] - corners[0]
    if region.kind == "rectangle":
        return Rectangle(corners[0], *size, **style)
    return Ellipse(corners.mean(axis=0), *size, **style)


def curves(
    view: View, name: str, regions: Mapping[str, Region], pixels: Pixels = "unflagged"
) -> xr.Dataset:
    """Curves of some regions, `View.curve`, over (region, time)."""
    if not regions:
        raise ValueError("Invalid export without a region. Must have one: draw it first.")
    curves_of_regions = [view.curve(name, region, pixels=pixels) for region in regions.values()]
    names = xr.DataArray(list(regions), dims="region", name="region")
    result = xr.concat([curve.drop_attrs(deep=False) for curve in curves_of_regions], dim=names)
    outlines = [curve.attrs["region"] for curve in curves_of_regions]
    return result.assign(outline=("region", outlines)).assign_attrs(pane=name, selection=pixels)


def save(view: View, path: str | Path, shown: Shown) -> None:
    """Save what is seen, by suffix: curves, a picture, a film, or the frames with the curves."""
    path, (name, *_), index = Path(path), shown.names, shown.index
    if path.suffix not in SUFFIXES:
        raise ValueError(f"Invalid path '{path}'. Must end in one of {list(SUFFIXES)}.")
    what = {"pane": name, "frame": index, "sources": view.sources}
    if path.suffix == ".csv":  # curves of the regions in the first pane
        lines = curves(view, name, shown.regions, shown.pixels)
        path.write_text(_table(view, lines, celsius=shown.celsius))
    elif path.suffix in ANIMATED:
        save_film(view, path, shown)
    elif path.suffix == ".png":
        store.save_figure(figure(view, shown), path, store.provenance(what))
    elif path.suffix == ".tiff":
        # The frame of the first pane, 32-bit float in its own units.
        pane = view.pane(name)
        text = f"{pane.label} [{pane.units}] at {view.time[index]:.3f} s"
        tags = {270: text.encode("ascii", "ignore")}  # the description
        Image.fromarray(view.frame(name, index)).save(path, tiffinfo=tags)
    else:  # the frames of all panes, and the curves
        result = xr.Dataset(attrs={"time": float(view.time[index])})
        for pane_name in shown.names:
            units = {"units": view.panes[pane_name].units}
            result[pane_name.replace(" ", "_")] = (("y", "x"), view.frame(pane_name, index), units)
        if shown.regions and view.panes[name].kind != "status":
            lines = curves(view, name, shown.regions, shown.pixels)
            result = result.merge(lines, combine_attrs="no_conflicts")
        result.to_netcdf(path, engine="scipy")


def _table(view: View, lines: xr.Dataset, *, celsius: bool) -> str:
    """Curves as comma-separated values, a row a time, with names and units in the first."""
    units, offset = view.panes[lines.attrs["pane"]].unit(celsius=celsius)
    names = [("mean", offset), ("minimum", offset), ("maximum", offset)]
    names += [("std", 0.0), ("calibration_std", 0.0)]
    columns = {"time [s]": lines["time"].values} if "time" in lines.coords else {}
    for region in map(str, lines["region"].values):
        line = lines.sel(region=region)
        # A deviation of degrees Celsius is in kelvin.
        for name, zero in names:
            of = "K" if name.endswith("std") and zero != offset else units
            columns[f"{region} {name} [{of}]"] = np.atleast_1d(line[name].values - zero)
        columns[f"{region} pixels"] = np.atleast_1d(line["pixels"].values)
    rows = xr.Dataset({name: ("row", values) for name, values in columns.items()}).to_dataframe()
    return str(rows.to_csv(index=False, float_format="%.6g", na_rep="nan"))
