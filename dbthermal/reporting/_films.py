"""Films of a report: as video, and as numbers for its viewer."""

import base64
import zlib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, Literal

import matplotlib as mpl
import matplotlib.image
import numpy as np
import numpy.typing as npt

from dbthermal import figures, store
from dbthermal.explorer import View
from dbthermal.explorer._export import Shown, panels, sampled
from dbthermal.explorer._films import FILMS
from dbthermal.explorer._view import COMPLETED

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


def base64_text(content: bytes) -> str:
    """Bytes as a page holds them."""
    return base64.b64encode(content).decode()


def video(
    view: View,
    title: str,
    codec: Literal["vp9", "h264"],
    *,
    celsius: bool,
    number: int = _FILMED,
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
        shown = np.percentile(finite, [1, 99]).tolist() if finite.size else [low, high]
        shown = [0.0 if name in stds else shown[0], max(shown[1], shown[0] + _LEAST)]
        high = high if high > low else low + 1.0
        scaled = np.nan_to_num((values - low) / (high - low)) * (_NO_VALUE - 1)
        codes = np.where(np.isfinite(values), np.rint(scaled), _NO_VALUE).astype("<u2")
        # Changes from frame to frame, low bytes before high ones, which compress well.
        changes = np.diff(codes, axis=0, prepend=np.zeros_like(codes[:1])).astype("<u2")
        planes = changes.view("u1").reshape(-1, 2).T.tobytes()
        quantities.append(
            {
                "name": name,
                "label": pane.label,
                "unit": pane.unit(celsius=celsius)[0],
                "low": float(low),
                "high": float(high),
                "shown": shown,
                "data": base64_text(zlib.compress(planes, 9)),
            }
        )
    colors = np.rint(255 * mpl.colormaps["inferno"](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    # Pixels that are completed (1), or have another flag (2).
    status = view.status[::step, ::step]
    completed = (status & COMPLETED) != 0
    marks = np.where(completed, 1, np.where(status != 0, 2, 0)).astype(np.uint8)
    content = {
        "marks": base64_text(marks.tobytes()),
        "height": -(-view.shape[0] // step),
        "width": -(-view.shape[1] // step),
        "step": step,
        "times": [float(moment) for moment in time],
        "palette": base64_text(colors.tobytes()),
        "quantities": quantities,
    }
    share = f"one row and column of {step}, " if step > 1 else ""
    note = (
        "Click a pixel for its curve. White lines: completed, not measured. Black lines: flagged. "
        f"Shown: {share}{time.size} of {view.time.size} frames."
    )
    return {"content": content, "text": note}
