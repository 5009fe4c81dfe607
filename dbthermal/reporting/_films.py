"""Films of a report: as video, and as numbers for its viewer."""

import base64
import math
import zlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final, Literal

import matplotlib as mpl
import matplotlib.image
import numpy as np
import numpy.typing as npt
import xarray as xr
from markupsafe import Markup

from dbthermal import figures, store
from dbthermal.explorer import View
from dbthermal.explorer._view import COMPLETED
from dbthermal.reporting._page import film_tag, viewer_tag

FILMS: Final = ("object_temperature", "background_temperature")
_FILMED: Final = 240  # frames of the video, at most; half as many while it is larger than:
_LARGEST: Final = 3_000_000  # [byte]
_FASTEST: Final = 30.0  # Hz
_SAMPLES: Final = 600_000  # of each film in the viewer, at most, and of these frames:
VIEWED: Final = 80
_NO_VALUE: Final = 65535  # of 16 bits
_LEAST: Final = 0.01  # between both ends of the colours [K]


def _films(view: View) -> list[str]:
    """Names of the panes that are shown as films: object and reflected temperature, inputs."""
    inputs = [name for name in view.panes if name.startswith("input ")]
    return [*(name for name in FILMS if name in view.panes), *inputs]


def sampled(view: View, name: str, frames: int, samples: int) -> tuple[xr.DataArray, int]:
    """Film of a pane, of some of its frames and pixels, and the step between the pixels."""
    moments = slice(None, None, -(-view.time.size // frames))
    time = view.time[moments]
    step = max(1, math.ceil(math.sqrt(np.prod(view.shape) * time.size / samples)))
    pixels = slice(None, None, step)
    values = view.pane(name).read(moments, pixels, pixels)
    return xr.DataArray(values, {"time": time}, ("time", "y", "x")), step


def video(
    view: View,
    title: str,
    codec: Literal["vp9", "h264"],
    *,
    celsius: bool,
    number: int = _FILMED,
) -> Markup:
    """Film of the object, what it reflects, and the inputs."""
    panels = []
    for name in _films(view):
        pane = view.panes[name]
        values, _ = sampled(view, name, number, number * 100_000)
        unit, zero = pane.unit(celsius=celsius)
        panels.append(figures.FilmPanel(values - zero, pane.label, f"[{unit}]"))
    span = float(view.time[-1] - view.time[0])
    rate = min(_FASTEST, max(1.0, (panels[0].values.sizes["time"] - 1) / span)) if span else 1.0
    middle: list[npt.NDArray[np.uint8]] = []

    def frames() -> Iterator[npt.NDArray[np.uint8]]:
        """Frames of the film, of which the middle one is kept."""
        half = panels[0].values.sizes["time"] // 2
        for index, frame in enumerate(figures.film(panels, title=title)):
            if index == half:
                middle.append(frame)
            yield frame

    with TemporaryDirectory() as folder:
        path, poster = Path(folder) / "film.mp4", Path(folder) / "middle.png"
        store.save_video(frames(), path, {}, rate=rate, codec=codec)
        if path.stat().st_size > _LARGEST and number > 2:
            return video(view, title, codec, celsius=celsius, number=number // 2)
        mpl.image.imsave(poster, middle[0])
        return film_tag(path, "The scene. Gray: no value.", poster)


def _changes(codes: npt.NDArray[np.uint16]) -> bytes:
    """Changes of codes (time, y, x) from frame to frame, low bytes before high ones."""
    changes = np.diff(codes, axis=0, prepend=np.zeros_like(codes[:1]))
    return changes.astype("<u2").view("u1").reshape(-1, 2).T.tobytes()


def viewer(view: View, *, celsius: bool) -> Markup:
    """Viewer of some frames and pixels of the films, and of the curve of each pixel."""
    quantities, step, time = [], 1, view.time
    stds = [f"{name}_std" for name in FILMS]
    for name in [*_films(view), *(name for name in stds if name in view.panes)]:
        pane = view.panes[name]
        film, step = sampled(view, name, VIEWED, _SAMPLES)
        unit, zero = pane.unit(celsius=celsius)
        values, time = film.values.astype(np.float64) - zero, film["time"].values
        finite = values[np.isfinite(values)]
        low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
        shown = np.percentile(finite, [1, 99]).tolist() if finite.size else [low, high]
        shown = [0.0 if name in stds else shown[0], max(shown[1], shown[0] + _LEAST)]
        high = high if high > low else low + 1.0
        scaled = np.nan_to_num((values - low) / (high - low)) * (_NO_VALUE - 1)
        codes = np.where(np.isfinite(values), np.rint(scaled), _NO_VALUE).astype("<u2")
        quantities.append(
            {
                "name": name,
                "label": pane.label,
                "unit": unit,
                "low": float(low),
                "high": float(high),
                "shown": shown,
                "data": base64.b64encode(zlib.compress(_changes(codes), 9)).decode(),
            }
        )
    colors = np.rint(255 * mpl.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    # Pixels that are completed (1), or have another flag (2).
    status = view.status[::step, ::step]
    completed = (status & COMPLETED) != 0
    marks = np.where(completed, 1, np.where(status != 0, 2, 0)).astype(np.uint8)
    content = {
        "marks": base64.b64encode(marks.tobytes()).decode(),
        "height": -(-view.shape[0] // step),
        "width": -(-view.shape[1] // step),
        "step": step,
        "times": [float(moment) for moment in time],
        "palette": base64.b64encode(colors.tobytes()).decode(),
        "quantities": quantities,
    }
    share = f"one row and column of {step}, " if step > 1 else ""
    note = (
        "Click a pixel for its curve. White lines: completed, not measured. Black lines: flagged. "
        f"Shown: {share}{time.size} of {view.time.size} frames."
    )
    return viewer_tag(content, note)
