"""Live view of a recording: its pictures, its losses, and the state of its cameras.

A `View` is passed to `dbthermal.instruments.recording.record` as `preview`; with a `Separation` it
shows the temperatures of object and background as well. A `Watch` computes the numbers that are
shown, and draws nothing. The queue of the recording bridges the time that an update takes.
"""

import io
import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal._arrays import Array
from dbthermal.instruments import camera
from dbthermal.instruments.camera import FFC_READING, FfcStatus, FrameFlag
from dbthermal.instruments.recording import Preview

if TYPE_CHECKING:  # matplotlib is loaded with the first picture: a `Watch` does without it
    from matplotlib.figure import Figure

    from dbthermal.figures import Panel
    from dbthermal.separation import Stream

__all__ = ["Separation", "Status", "View", "Watch"]
__dir__ = __all__.copy

_WINDOW: Final = 3.0  # time over which a frame rate is measured [s]
_PERIOD: Final = 1.0  # least time from picture to picture [s]; one takes a tenth of it
_PERCENTILES: Final = (1.0, 99.0)  # of the counts that are black and white in the picture [%]
_LEAST_SHARE: Final = 0.01  # of pixels at either end of the range, from which a warning comes [1]
_COMPRESSION: Final = 1  # of zlib's 1 to 9
_FILMS: Final = ("object", "background")
_STRIDE: Final = 4  # every fourth pixel of every fourth row is enough for percentiles
_FFC_STATES: Final = {float(state): state.name.lower().replace("_", " ") for state in FfcStatus}
_IN_PROGRESS: Final = _FFC_STATES[FfcStatus.IN_PROGRESS]


@dataclass(frozen=True)
class Status:
    """Recording state of a band; numbers of its last frame are NaN before it."""

    band: str
    frame_rate: float  # over the last window, by the times of arrival [Hz]; 0 without any
    frames: int
    lost: int
    refused: int
    damaged: int
    fpa_temperature: float = math.nan  # from the reading "fpa <band>", or the telemetry [K]
    ffc: str = "unknown"  # "in progress", by flag of the last frame, or reading "ffc <band>"
    ffc_age: float = math.nan  # since a correction was last seen in this recording [s]
    limits: tuple[float, float] = (math.nan, math.nan)  # 1st and 99th percentile [count]
    lowest: float = math.nan  # [count]
    highest: float = math.nan  # [count]
    dead: float = math.nan  # share of pixels at 0 [1]
    saturated: float = math.nan  # share of pixels at 65535 [1]

    @property
    def text(self) -> str:
        """Two lines: frames, then temperature [degree Celsius] and flat-field correction."""
        rate = "-" if math.isnan(self.frame_rate) else f"{self.frame_rate:.1f}"
        age = f", last {self.ffc_age:.0f} s ago" if self.ffc_age > 0 else ""
        return (
            f"{rate} frames/s, {self.lost} lost, {self.refused} refused, {self.damaged} damaged\n"
            f"FPA {_celsius(self.fpa_temperature)}, FFC {self.ffc}{age}"
        )

    @property
    def warning(self) -> str:
        """A line for each defect that makes the last frames useless; empty without any."""
        dead, saturated = f"{100 * self.dead:.1f}", f"{100 * self.saturated:.1f}"
        warnings = {
            "no frame has come": self.frames == 0,
            "no new frames come": self.frames > 0 and self.frame_rate == 0,
            "shutter closed: FFC in progress": self.ffc == _IN_PROGRESS,
            f"{dead} % of the pixels at 0: dead": self.dead > _LEAST_SHARE,
            f"{saturated} % of the pixels at 65535: saturated": self.saturated > _LEAST_SHARE,
            f"every pixel at {self.lowest:.0f}: nothing is seen": self.lowest == self.highest,
        }
        return "\n".join(line for line, holds in warnings.items() if holds)


class Watch:
    """Numbers of a recording, from its previews."""

    def __init__(self) -> None:
        self._past: deque[Preview] = deque()  # of the last window, some 20 MB
        self._ffc_times: dict[str, float] = {}

    def note(self, preview: Preview) -> bool:
        """Take the next preview; return True if it is the first preview of a recording."""
        before = self._past[-1] if self._past else None
        # Of another recording: other bands, or a time or a number of frames that falls.
        if before is None or not (
            tuple(before.totals) == tuple(preview.totals)
            and before.time <= preview.time
            and all(before.totals[b]["frames"] <= t["frames"] for b, t in preview.totals.items())
        ):
            before = None
            self._past.clear()
            self._ffc_times.clear()
        for band in preview.totals:
            # The offsets were renewed between two previews, by the telemetry.
            frames = {_metadata(band, shown).last_ffc_frame for shown in (before, preview)}
            if _ffc(band, preview) == _IN_PROGRESS or (None not in frames and len(frames) > 1):
                self._ffc_times[band] = preview.time
        self._past.append(preview)
        while len(self._past) > 1 and self._past[1].time <= preview.time - _WINDOW:
            self._past.popleft()
        return before is None

    def status(self) -> dict[str, Status]:
        """Band to its `Status` at the last preview; empty before the first one."""
        statuses = dict[str, Status]()
        last = self._past[-1] if self._past else Preview(0.0, {}, {}, {})
        for band, totals in last.totals.items():
            values: dict[str, Any] = {**totals, "ffc": _ffc(band, last)}
            # The temperature by its reading, else by the telemetry.
            reading = last.readings.get(camera.FPA_READING + band, math.nan)
            by_telemetry = _metadata(band, last).fpa_temperature
            values["fpa_temperature"] = reading if math.isfinite(reading) else by_telemetry
            values["ffc_age"] = last.time - self._ffc_times.get(band, math.nan)
            # Range of the counts, and the shares of the pixels at the ends of the range.
            if (frame := last.frames.get(band)) is not None:
                counts = frame.counts
                low, high = np.percentile(counts[::_STRIDE, ::_STRIDE], _PERCENTILES)
                values["limits"] = float(low), float(high)
                values |= {"lowest": float(counts.min()), "highest": float(counts.max())}
                values["dead"] = np.count_nonzero(counts == 0) / counts.size
                values["saturated"] = np.count_nonzero(counts == 65535) / counts.size
            statuses[band] = Status(band, self._rate(band), **values)
        return statuses

    def _rate(self, band: str) -> float:
        """Rate by the times at which the frames came: they are written in bursts."""
        past = [preview for preview in self._past if band in preview.frames]
        if not past:
            return math.nan
        first, last = past[0], past[-1]
        seconds = last.frames[band].host_time - first.frames[band].host_time
        if seconds > 0:
            return (last.totals[band]["frames"] - first.totals[band]["frames"]) / seconds
        is_old = self._past[-1].time - self._past[0].time >= _WINDOW
        return 0.0 if is_old else math.nan


def _metadata(band: str, preview: Preview | None) -> camera.Metadata:
    """Metadata of a band's last frame, empty without any."""
    frame = preview.frames.get(band) if preview else None
    return (frame and frame.metadata) or camera.Metadata()


def _ffc(band: str, preview: Preview) -> str:
    """State of the flat-field correction; a camera that corrects answers late, a flag does not."""
    frame = preview.frames.get(band)
    if frame is not None and FrameFlag.SHUTTER_CLOSED in frame.flags:
        return _IN_PROGRESS
    reading = preview.readings.get(FFC_READING + band)
    return "unknown" if reading is None else _ffc_state(reading)


class Separation:
    """Live separation of the pairs of frames that a view is shown, for its `separation`.

    `stream` is a `separation.Stream` at the rate of the previews, ``Limits.preview_period``, and
    `correction` from `correction.fit_correction` has its bands.
    """

    def __init__(self, stream: "Stream", correction: xr.Dataset) -> None:
        maps = correction[["gain", "offset"]].sel(band=list(stream.bands)).astype(np.float32)
        self._stream, self._bands = stream, stream.bands
        self._gain, self._offset = maps["gain"].values, maps["offset"].values
        self._shown = dict.fromkeys(self._bands, -math.inf)

    def __call__(self, preview: Preview) -> xr.Dataset | None:
        """Take the last frames; return the temperatures by now, None before the first."""
        frames = [preview.frames[band] for band in self._bands if band in preview.frames]
        times = {band: frame.host_time for band, frame in preview.frames.items()}
        # Left out are frames of a closed shutter, and pairs of which a frame was shown before.
        fresh = all(times.get(band, -math.inf) > shown for band, shown in self._shown.items())
        if fresh and not any(FrameFlag.SHUTTER_CLOSED in frame.flags for frame in frames):
            self._shown = {band: times[band] for band in self._bands}
            counts = self._gain * np.stack([frame.counts for frame in frames]) + self._offset
            self._stream.update(float(np.mean([frame.host_time for frame in frames])), counts)
        return self._stream.result() if self._stream.is_ready else None


class View:
    """Live view: an instance is the `preview` of a recording, or of several.

    It is shown on a `display`, such as IPython's ``DisplayHandle``, first by its ``display``, then
    by its ``update``, as a PNG and in words for a terminal; without one the last `figure` is only
    kept. An update, once a second at most, of two bands of 640 x 512 takes a fifth of a second of
    one core.

    Examples
    --------
    >>> view = View(is_simulated=True, title="pot")
    >>> view.status
    {}
    """

    def __init__(
        self,
        display: Any = None,
        *,
        is_simulated: bool,
        title: str = "recording",
        separation: Separation | None = None,
    ) -> None:
        self._display, self._separation, self._watch = display, separation, Watch()
        self._title = f"{title} (emulated)" if is_simulated else title
        self._separated: xr.Dataset | None = None
        self.figure: Figure | None = None
        self._is_shown, self._time = False, -math.inf

    @property
    def status(self) -> dict[str, Status]:
        """Band to its `Status` at the last preview, whether it was drawn or not."""
        return self._watch.status()

    def __call__(self, preview: Preview) -> None:
        """Take a preview; show it if the last picture is old enough, or of another recording."""
        if self._watch.note(preview):
            self._time = -math.inf
        if self._separation is not None:
            self._separated = self._separation(preview)
        # Nothing is drawn before the first frame: only a frame knows the size of a picture.
        if preview.frames and preview.time - self._time >= _PERIOD:
            self._time = preview.time
            self._show(preview)

    def _show(self, preview: Preview) -> None:
        from dbthermal.figures import Panel, live  # noqa: PLC0415 - see the module's imports

        statuses, frames = self._watch.status(), preview.frames
        empty = np.full(next(iter(frames.values())).counts.shape, np.nan)
        # A panel for each band, and for each temperature.
        panels = {}
        for band, status in statuses.items():
            image, (low, high) = frames[band].counts if band in frames else empty, status.limits
            # Black and white are distinct even in a uniform picture.
            limits = (low, max(high, low + 1.0)) if band in frames else (0.0, 1.0)
            panels[band] = Panel(image, limits, status.text, status.warning)
        if self._separation:
            panels |= {name: _temperature(name, self._separated, empty) for name in _FILMS}
        title, foot = f"{self._title}, {preview.time:.1f} s", _foot(preview)
        self.figure = live(panels, title=title, foot=foot)
        if self._display is not None:
            lines = [
                f"{band}: {status.text}\n{status.warning}" for band, status in statuses.items()
            ]
            png, fast = io.BytesIO(), {"compress_level": _COMPRESSION}  # rather than small
            self.figure.savefig(png, format="png", pil_kwargs=fast)
            words = "\n".join((title, *lines, foot))
            formats = {"image/png": png.getvalue(), "text/plain": words}
            (self._display.update if self._is_shown else self._display.display)(formats, raw=True)
            self._is_shown = True


def _temperature(name: str, separated: xr.Dataset | None, empty: Array) -> "Panel":
    """Panel of the last temperatures of a separation."""
    from dbthermal.figures import Panel, drawing  # noqa: PLC0415 - loads matplotlib

    if separated is None:
        return Panel(empty, (0.0, 1.0), "not known yet", is_temperature=True)
    image = separated[f"{name}_temperature"][-1] - zero_Celsius
    good = 100 * float((separated["status"] == 0).mean())
    low, high = drawing.limits_of(image)
    limits, text = (low, max(high, low + 0.1)), f"{good:.0f} % of the pixels without a flag"
    return Panel(image.values, limits, text, is_temperature=True)


def _foot(preview: Preview) -> str:
    """Readings that are not of a shown band: of thermocouples, of the blackbody."""
    texts = []
    for name, value in preview.readings.items():
        if name.removeprefix(camera.FPA_READING).removeprefix(FFC_READING) in preview.totals:
            continue
        unit = preview.units.get(name, "K")
        if math.isnan(value) or name.startswith(FFC_READING):
            texts.append(f"{name} {_ffc_state(value)}")
        elif unit == "K":
            texts.append(f"{name} {_celsius(value)}")
        else:
            texts.append(f"{name} {value:g}" + (f" {unit}" if unit != "1" else ""))
    return ", ".join(texts)


def _celsius(temperature: float) -> str:
    """A temperature [K] in degrees Celsius, or ``"unknown"``."""
    if math.isnan(temperature):
        return "unknown"
    return f"{temperature - zero_Celsius:.1f} \N{DEGREE SIGN}C"


def _ffc_state(reading: float) -> str:
    """Name of an `FfcStatus` reading, ``"no answer"`` for NaN, or the number if unknown."""
    if math.isnan(reading):
        return "no answer"
    return _FFC_STATES.get(reading, f"state {reading:g}")
