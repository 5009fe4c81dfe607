"""Report on a separated scene: one HTML file that opens anywhere, without a network."""

import base64
import io
import json
import zlib
from collections.abc import Iterator, Mapping
from importlib import resources
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any, Final, Literal

import matplotlib as mpl
import matplotlib.image
import numpy as np
import numpy.typing as npt
import xarray as xr
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from dbthermal import _text, emissivity, figures, schema, store
from dbthermal.explorer import Region, View
from dbthermal.explorer._answer import SPREAD, answer, nearest
from dbthermal.explorer._export import Shown, panels, sampled
from dbthermal.explorer._films import FILMS
from dbthermal.explorer._view import COMPLETED
from dbthermal.figures import drawing
from dbthermal.readers._formats import PNG
from dbthermal.schema import Status
from dbthermal.separation._doubts import against_response, hardly_measured

try:
    from jinja2 import Environment
    from jinja2.utils import htmlsafe_json_dumps
    from markupsafe import Markup
except ImportError as error:
    raise ImportError(_text.missing_library(error.name, "report")) from error

__all__ = ["report"]
__dir__ = __all__.copy

Curves = Mapping[str, Mapping[str, xr.Dataset]]

_LOGO: Final = 2**20  # largest picture beside the title [byte]
_FILMED: Final = 240  # frames of the video, at most; half as many while it is larger than:
_LARGEST: Final = 3_000_000  # [byte]
_FASTEST: Final = 30.0  # Hz
_SAMPLES: Final = 600_000  # of each film in the viewer, at most, in `VIEWED` frames
VIEWED: Final = 80
_NO_VALUE: Final = 65535  # of 16 bits


def report(  # noqa: PLR0913 - what is shown beside the result, by name
    data: xr.Dataset | str | Path,
    path: str | Path,
    capture: xr.Dataset | str | Path | None = None,
    response: xr.Dataset | str | Path | None = None,
    *,
    regions: Mapping[str, Region] = MappingProxyType({}),
    materials: xr.Dataset | None = None,
    title: str = "Separated thermal scene",
    author: str = "",
    logo: str | Path | None = None,
    provenance: Mapping[str, Any] | None = None,
    celsius: bool = True,
    codec: Literal["vp9", "h264"] = "h264",
) -> None:
    """Write one HTML file on a separated scene, to hand to someone else; it needs no network.

    It shows the scene as a film, a viewer of frames and of each pixel's curve, the curves of
    regions with their error bars, what can be trusted and why the rest cannot, emissivities beside
    those of a table, what was assumed, parameters and provenance. Its numbers are in it as JSON.

    ImportError without a library of the extra `report`. TypeError or ValueError as `explorer.View`,
    or if there is no object temperature, a region is not one, or the path has another ending.

    Parameters
    ----------
    data : Dataset, str or Path
        Result of `separation` with `object_temperature` (time, y, x) [K], or its store.
    path : str or Path
        File ``*.html``. Its parents are made.
    capture, response : Dataset, str or Path, optional
        As for `explorer.explore`.
    regions : mapping of str to explorer.Region, optional
        Name to region, such as ``{"left": explorer.Region("rectangle", ((10, 5), (40, 30)))}`` of
        two corners (row, column), see `explorer.Region`; the whole image if there is none. Of a
        region the pixels count that are measured, whose status has no flag.
    materials : Dataset, optional
        Stage `emissivity_table`, whose nearest materials are named; `emissivity.embedded_table` if
        not given.
    title, author, logo : str, str, str or Path
        Heading; a name below it; file ``*.png`` of at most 1 MB, shown beside it.
    provenance, celsius : mapping, bool
        From `store.provenance`, by default that of the result; degrees Celsius instead of kelvin.
    codec : {"h264", "vp9"}
        Compression of the film. H.264 plays in every browser; see `store.save_video`.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> import dbthermal
    >>> film = xr.DataArray(np.full((2, 4, 6), 300.0), {"time": [0.0, 0.1]}, ("time", "y", "x"))
    >>> with TemporaryDirectory() as folder:
    ...     page = Path(folder, "scene.html")
    ...     dbthermal.report(film.to_dataset(name="object_temperature"), page, title="Wall")
    ...     "<h1>Wall</h1>" in page.read_text("utf-8")
    True
    """
    if _text.as_path(path).suffix != ".html":
        raise ValueError(f"Invalid path '{path}'. Must end in '.html'.")
    view = View(data, capture, response)
    if "object_temperature" not in view.panes:
        raise ValueError("Missing variable 'object_temperature'. Must be a result of separation.")
    result, chosen = view.data, _chosen(view, regions)
    shot = result if view.capture is None else view.capture
    shown = [name for name in view.panes if name in FILMS or name.startswith("emissivity ")]
    curves = {
        name: {pane: view.curve(pane, region, pixels="measured") for pane in shown}
        for name, region in chosen.items()
    }
    table_ = emissivity.embedded_table() if materials is None else materials
    # Numbers of the scene, which the page holds as JSON.
    (rows, columns), frames, seconds = view.shape, view.time.size, float(np.ptp(view.time))
    numbers: dict[str, Any] = {
        "scene": {"rows": rows, "columns": columns, "frames": frames, "duration_s": seconds},
        "validity": _validity(view),
        "uncertainty": _budget(view),
        "regions": {name: _summary(of, table_) for name, of in curves.items()},
    }
    made_by = result.attrs.get("provenance", {}) if provenance is None else provenance
    # What was found, by whom, and what speaks against it.
    sentences, numbers["answer"] = answer(result, table_)
    about = [str(author), *(str(shot.attrs.get(name, "")) for name in ("source", "start"))]
    doubts = [*result.attrs.get("warnings", []), *hardly_measured(result), *view.doubts]
    if view.capture is not None and view.response is not None:
        doubts += against_response(view.capture, view.response)
    unit, zero = view.panes["object_temperature"].unit(celsius=celsius)
    bands = [name.removeprefix("emissivity ") for name in shown if name not in FILMS]
    page, script = (resources.files(__package__) / name for name in ("page.html", "viewer.js"))
    environment = Environment(autoescape=True, trim_blocks=True)
    text = environment.from_string(page.read_text("utf-8")).render(
        title=title,
        origin=result.attrs.get("origin") or shot.attrs.get("origin", "origin not stated"),
        about=about,
        answer=sentences,
        logo="" if logo is None else base64_text(_picture(logo)),
        numbers=numbers,
        film=video(view, title, codec, celsius=celsius),
        viewer=viewer(view, celsius=celsius),
        outlines=_svg(_outlines(view, chosen, celsius=celsius)),
        curves=_svg(_curves(view, curves, celsius=celsius)),
        unit=unit,
        zero=zero,
        doubts=dict.fromkeys(doubts),
        status=_svg(figures.status(result)) if "status" in view.panes else "",
        meanings={bit.label: bit.meaning for bit in Status},
        percent=drawing.percent,
        causes=schema.CAUSES,
        named=bool(regions),
        bands=[drawing.band_label(band) for band in bands],
        spread=SPREAD,
        result=result,
        events=view.events,
        provenance=json.dumps(made_by, indent=2, sort_keys=True),
        script=Markup(script.read_text("utf-8")),
        json=lambda value: htmlsafe_json_dumps(value, allow_nan=False, sort_keys=True),
    )
    store.save_text(text, path, made_by)


def _chosen(view: View, regions: Mapping[str, Region]) -> dict[str, Region]:
    """Regions that are stated, or the whole image."""
    schema.require(regions, Mapping, "regions")
    rule = 'Must be an explorer.Region("rectangle", ((10, 5), (40, 30))) of (row, column)'
    for name, region in regions.items():
        if not isinstance(region, Region):
            raise TypeError(f"Invalid region {name!r}, {region!r}. {rule}.")
    whole = Region("rectangle", ((0, 0), view.shape))
    return dict(regions) or {"measured pixels of the whole image": whole}


def _picture(logo: str | Path) -> bytes:
    """Bytes of a logo, a PNG."""
    picture = _text.regular_file(logo, _LOGO).read_bytes()
    if not picture.startswith(PNG):
        raise ValueError(f"Invalid logo '{logo}'. Must be a PNG.")
    return picture


def _svg(figure: Figure) -> str:
    """Figure as a picture of vectors, in base64."""
    buffer = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "dbthermal", "svg.fonttype": "path"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None}, dpi=150)
    return base64_text(buffer.getvalue())


def _curves(view: View, curves: Curves, *, celsius: bool) -> Figure:
    """Curves of the regions, with two standard deviations."""
    names = [name for name in FILMS if name in view.panes]
    figure, axes = drawing.canvas(len(names), 1, (9.0, 2.9 * len(names)))
    unit, zero = view.panes["object_temperature"].unit(celsius=celsius)
    for axis, name in zip(axes[:, 0], names, strict=True):
        for region, color in zip(curves, cycle(drawing.COLORS), strict=False):
            mean, std = (curves[region][name][key].values for key in ("mean", "std"))
            low, high = mean - zero - 2 * std, mean - zero + 2 * std
            axis.plot(view.time, mean - zero, color=color, label=region, linewidth=1.2)
            axis.fill_between(view.time, low, high, color=color, alpha=0.25, linewidth=0)
        axis.set(title=view.panes[name].label, ylabel=f"[{unit}]")
        axis.legend(frameon=False, fontsize=8)
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def _budget(view: View) -> dict[str, float]:
    """Median deviation [K] of the object temperature of the measured pixels, by cause."""
    if "uncertainty" not in view.data:
        return {}
    medians = view.data["uncertainty"].where(view.counted("measured")).median(("y", "x"))
    return {str(cause): float(std) for cause, std in medians.to_series().dropna().items()}


def _outlines(view: View, chosen: Mapping[str, Region], *, celsius: bool) -> Figure:
    """Mean picture of the object with the regions on it."""
    pane = view.panes["object_temperature"]
    film, step = sampled(view, pane.name, VIEWED, VIEWED * 200_000, celsius=celsius)
    image, (unit, _) = film.mean("time"), pane.unit(celsius=celsius)
    aspect = view.shape[0] / view.shape[1]
    figure, axes = drawing.canvas(1, 1, (5.6, 4.6 * aspect + 0.5))
    limits = drawing.limits_of(image)
    drawing.draw_image(figure, axes[0, 0], image, pane.label, f"[{unit}]", limits=limits)
    for (name, region), color in zip(chosen.items(), cycle(drawing.COLORS), strict=False):
        mask = region.mask(view.shape)[::step, ::step]
        if mask.all():
            continue
        lines = axes[0, 0].contour(mask, [0.5], colors=[color], linewidths=1.5)
        lines.set_path_effects([withStroke(linewidth=3.5, foreground="white")])
        row, column = (float(places.min()) for places in np.nonzero(mask))
        across, above = column < mask.shape[1] / 2, row > mask.shape[0] / 10
        side: Any = {"ha": "left" if across else "center", "va": "bottom" if above else "top"}
        label = axes[0, 0].text(column, row - 1.0, name, color="white", fontsize=8, **side)
        label.set_path_effects([withStroke(linewidth=2.5, foreground="black")])
    return figure


def _validity(view: View) -> dict[str, float]:
    """Share of the pixels that are measured, completed, without a value, and with each flag."""
    completed = (view.status & int(schema.COMPLETED)) != 0
    film, _ = sampled(view, "object_temperature", VIEWED, VIEWED * 200_000, celsius=False)
    shares = {
        "no_flag": float(np.mean(view.status == 0)),
        "completed": float(completed.mean()),
        "without_value": float(film.isnull().all("time").mean()),
    }
    flags = {bit.label: float(np.mean((view.status & bit) != 0)) for bit in Status}
    return shares | {name: share for name, share in flags.items() if share}


def _summary(curves: Mapping[str, xr.Dataset], materials: xr.Dataset) -> dict[str, Any]:
    """Numbers of a region: temperatures, emissivities, and the nearest materials."""
    summary: dict[str, Any] = {"pixels": int(curves["object_temperature"]["pixels"].max())}
    for name in (name for name in FILMS if name in curves):
        curve = curves[name]
        means = {key: curve[key].mean() for key in ("mean", "std", "calibration_std")}
        ends = {"minimum": curve["mean"].min(), "maximum": curve["mean"].max()}
        summary[name] = {key: _plain(value) for key, value in {**means, **ends}.items()}
    bands = [name.removeprefix("emissivity ") for name in curves if name.startswith("emissivity ")]
    if bands:
        tables = [curves[f"emissivity {band}"] for band in bands]
        values, stds = (np.array([float(it[key]) for it in tables]) for key in ("mean", "std"))
        summary["emissivity"] = dict(zip(bands, map(_plain, values), strict=True))
        summary["emissivity_std"] = dict(zip(bands, map(_plain, stds), strict=True))
        summary["nearest"] = nearest(bands, values, stds, materials)
    return summary


def _plain(value: Any) -> float | None:
    """Number for JSON; None if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _films(view: View) -> list[str]:
    """Names of the panes that are shown as films: object and reflected temperature, inputs."""
    inputs = [name for name in view.panes if name.startswith("input ")]
    return [*(name for name in FILMS if name in view.panes), *inputs]


def base64_text(content: bytes) -> str:
    """Bytes as a page holds them."""
    return base64.b64encode(content).decode()


def video(
    view: View, title: str, codec: Literal["vp9", "h264"], *, celsius: bool, number: int = _FILMED
) -> dict[str, str]:
    """Film of the object, what it reflects, and the inputs, with its middle frame."""
    shown = Shown(_films(view), 0, {}, celsius)
    pictures = panels(view, shown, number, number * 100_000)
    span, count = float(np.ptp(view.time)), pictures[0].values.sizes["time"]
    rate = min(_FASTEST, max(1.0, (count - 1) / span)) if span else 1.0
    middle: list[npt.NDArray[np.uint8]] = []

    def frames() -> Iterator[npt.NDArray[np.uint8]]:
        """Frames of the film, of which the middle one is kept."""
        for index, frame in enumerate(figures.film(pictures, title=title)):
            if index == count // 2:
                middle.append(frame)
            yield frame

    with TemporaryDirectory() as folder:
        path, poster = Path(folder) / "film.mp4", Path(folder) / "middle.png"
        store.save_video(frames(), path, {}, rate=rate, codec=codec)
        # A film that is too large for a letter has half as many frames.
        if path.stat().st_size > _LARGEST and number > 2:
            return video(view, title, codec, celsius=celsius, number=number // 2)
        mpl.image.imsave(poster, middle[0])
        film, still = (base64_text(file.read_bytes()) for file in (path, poster))
    return {"film": film, "still": still}


def viewer(view: View, *, celsius: bool) -> dict[str, Any]:
    """Viewer of some frames and pixels of the films, and of the curve of each pixel."""
    quantities, step, time = [], 1, view.time
    stds = [f"{name}_std" for name in FILMS]
    for name in [*_films(view), *(name for name in stds if name in view.panes)]:
        pane = view.panes[name]
        film, step = sampled(view, name, VIEWED, _SAMPLES, celsius=celsius)
        values, time = film.values.astype(np.float64), film["time"].values
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        high = high if high > low else low + 1.0
        # Values as whole numbers of 16 bits, the largest of which has none.
        scaled = np.nan_to_num((values - low) / (high - low)) * (_NO_VALUE - 1)
        codes = np.where(np.isfinite(values), np.rint(scaled), _NO_VALUE).astype("<u2")
        # Changes from frame to frame, low bytes before high ones, which compress well.
        changes = np.diff(codes, axis=0, prepend=np.zeros_like(codes[:1])).astype("<u2")
        planes = changes.view("u1").reshape(-1, 2).T.tobytes()
        unit, zero = pane.unit(celsius=celsius)
        quantity: Any = {"name": name, "label": pane.label, "unit": unit, "low": float(low)}
        quantity |= {"high": float(high), "shown": [end - zero for end in view.limits(name)]}
        quantities.append({**quantity, "data": base64_text(zlib.compress(planes, 9))})
    colors = np.rint(255 * mpl.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    # Pixels that are completed (1), or have another flag (2).
    status = view.status[::step, ::step]
    marks = np.where((status & COMPLETED) != 0, 1, np.where(status != 0, 2, 0)).astype(np.uint8)
    return {
        "marks": base64_text(marks.tobytes()),
        "height": -(-view.shape[0] // step),
        "width": -(-view.shape[1] // step),
        "step": step,
        "times": [float(moment) for moment in time],
        "palette": base64_text(colors.tobytes()),
        "quantities": quantities,
    }
