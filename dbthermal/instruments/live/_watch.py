"""The numbers of a recording while it goes on: rates, losses, how the cameras are."""

import math
from collections import deque
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.constants import zero_Celsius

from dbthermal.instruments.camera import Counts, FfcStatus, Frame, FrameFlag, Metadata
from dbthermal.instruments.recording.record import Preview

WINDOW: Final = 3.0
"""Time over which a frame rate is measured [s]."""

PERCENTILES: Final = (1.0, 99.0)
"""Percentiles of the counts that are black and white in the picture [%]."""

LEAST_SHARE: Final = 0.01
"""Share of pixels at either end of the range beyond which a picture is told to be bad [1]."""

FPA: Final = "fpa "
"""What the name of a reading begins with that is a camera's temperature; its band follows."""

FFC: Final = "ffc "
"""What the name of a reading begins with that is a camera's `FfcStatus`; its band follows."""

_RANGE: Final = np.iinfo(np.uint16)
_STEP: Final = 4  # every fourth pixel of every fourth row is enough for percentiles
_FFC_STATES: Final = {float(state): state.name.lower().replace("_", " ") for state in FfcStatus}
_IN_PROGRESS: Final = _FFC_STATES[FfcStatus.IN_PROGRESS]


def celsius(temperature: float) -> str:
    """
    Write a temperature for the eye.

    Parameters
    ----------
    temperature : float
        [K], NaN if it is not known.

    Returns
    -------
    str
        In degrees Celsius, or ``"unknown"``.
    """
    if math.isnan(temperature):
        return "unknown"
    return f"{temperature - zero_Celsius:.1f} \N{DEGREE SIGN}C"


def ffc_state(reading: float) -> str:
    """
    Name what a camera answers of its flat-field correction.

    Parameters
    ----------
    reading : float
        The number of an `FfcStatus` [1], NaN if the camera did not answer.

    Returns
    -------
    str
        Its name, ``"no answer"``, or the number of a state that is not known: to show it must end
        no recording.
    """
    if math.isnan(reading):
        return "no answer"
    return _FFC_STATES.get(reading, f"state {reading:g}")


@dataclass(frozen=True)
class Status:
    """
    How one band is.

    Attributes
    ----------
    band : str
        Its name.
    frame_rate : float
        Frames recorded per second of the last `WINDOW`, by the host's times at which they came
        [Hz]; 0 if none came in it, NaN before there are two.
    frames, lost, refused, damaged : int
        Numbers of frames since the recording began.
    fpa_temperature : float
        Of the focal-plane array: the reading ``fpa <band>``, else the telemetry's [K]; NaN if
        neither is known.
    ffc : str
        State of the flat-field correction (FFC): ``"in progress"`` if the last frame's flag says
        that the shutter is closed, else the name of the reading ``ffc <band>``, ``"no answer"``
        if that failed, ``"unknown"`` if there is none.
    ffc_age : float
        Since a correction was last seen in this recording [s]: 0 in one, NaN if none was.
    limits : tuple of float
        `PERCENTILES` of the last frame [count]; NaN before the first one, as are those below.
    lowest, highest : float
        Least and greatest count of the last frame [count].
    dead, saturated : float
        Shares of its pixels at 0 and at 65535 [1].
    """

    band: str
    frame_rate: float
    frames: int
    lost: int
    refused: int
    damaged: int
    fpa_temperature: float = math.nan
    ffc: str = "unknown"
    ffc_age: float = math.nan
    limits: tuple[float, float] = (math.nan, math.nan)
    lowest: float = math.nan
    highest: float = math.nan
    dead: float = math.nan
    saturated: float = math.nan

    @property
    def text(self) -> str:
        """Two lines: frames, then temperature [degree Celsius] and flat-field correction."""
        rate = "-" if math.isnan(self.frame_rate) else f"{self.frame_rate:.1f}"
        age = f", last {self.ffc_age:.0f} s ago" if self.ffc_age > 0 else ""
        return (
            f"{rate} frames/s, {self.lost} lost, {self.refused} refused, {self.damaged} damaged\n"
            f"FPA {celsius(self.fpa_temperature)}, FFC {self.ffc}{age}"
        )

    @property
    def warning(self) -> str:
        """A line for each thing that makes frames useless just now, none if there is nothing."""
        told = [
            (self.frames == 0, "no frame has come"),
            (self.frames > 0 and self.frame_rate == 0, "no new frames come"),
            (self.ffc == _IN_PROGRESS, "shutter closed: FFC in progress"),
            (self.dead > LEAST_SHARE, _at(self.dead, _RANGE.min, "dead")),
            (self.saturated > LEAST_SHARE, _at(self.saturated, _RANGE.max, "saturated")),
            (self.lowest == self.highest, f"every pixel at {self.lowest:.0f}: nothing is seen"),
        ]
        return "\n".join(line for is_so, line in told if is_so)


def _at(share: float, counts: int, meaning: str) -> str:
    return f"{100 * share:.1f} % of the pixels at {counts}: {meaning}"


class Watch:
    """
    The numbers of a recording that goes on, from its previews.

    Parameters
    ----------
    window : float
        Time over which frame rates are measured [s].

    Raises
    ------
    ValueError
        If `window` is not positive.
    """

    def __init__(self, window: float = WINDOW) -> None:
        if not 0 < window < math.inf:
            raise ValueError(f"Invalid window {window} s. Must be positive.")
        self._window = window
        self._last: Preview | None = None
        self._past: deque[tuple[float, dict[str, tuple[int, float]]]] = deque()
        self._ffc_seen: dict[str, float] = {}

    def note(self, preview: Preview) -> bool:
        """
        Take a preview.

        Parameters
        ----------
        preview : Preview
            The next one.

        Returns
        -------
        bool
            True if it is the first, or the first of another recording: its bands are others, or
            its time or a number of its frames is less than before.
        """
        before, self._last = self._last, preview
        if before is None or _is_other(before, preview):
            before = None
            self._past.clear()
            self._ffc_seen.clear()
        for band in preview.totals:
            if _ffc(band, preview) == _IN_PROGRESS or _corrected(band, before, preview):
                self._ffc_seen[band] = preview.time
        marks = {
            band: (preview.totals[band]["frames"], frame.host_time)
            for band, frame in preview.frames.items()
        }
        self._past.append((preview.time, marks))
        while len(self._past) > 1 and self._past[1][0] <= preview.time - self._window:
            self._past.popleft()
        return before is None

    def status(self) -> dict[str, Status]:
        """
        Say how each band was at the last preview.

        Returns
        -------
        dict
            Band to its `Status`, in the order of the recording; empty before the first preview.
        """
        last = self._last
        if last is None:
            return {}
        return {
            band: Status(
                band,
                frame_rate=self._rate(band),
                frames=totals["frames"],
                lost=totals["lost"],
                refused=totals["refused"],
                damaged=totals["damaged"],
                fpa_temperature=_fpa(band, last),
                ffc=_ffc(band, last),
                ffc_age=last.time - self._ffc_seen.get(band, math.nan),
                **_levels(last.frames.get(band)),
            )
            for band, totals in last.totals.items()
        }

    def _rate(self, band: str) -> float:
        """Rate by the times at which the frames came: they are written in bursts."""
        marks = [marks[band] for _, marks in self._past if band in marks]
        if not marks:
            return math.nan
        (before, start), (now, stop) = marks[0], marks[-1]
        if stop > start:
            return (now - before) / (stop - start)
        is_old = self._past[-1][0] - self._past[0][0] >= self._window
        return 0.0 if is_old else math.nan


def _is_other(before: Preview, now: Preview) -> bool:
    """Whether a preview is of another recording than the one before it."""
    return (
        tuple(before.totals) != tuple(now.totals)
        or now.time < before.time
        or any(now.totals[band]["frames"] < before.totals[band]["frames"] for band in now.totals)
    )


def _metadata(band: str, preview: Preview | None) -> Metadata | None:
    """Metadata of the last frame, from its telemetry."""
    frame = preview.frames.get(band) if preview else None
    return None if frame is None else frame.metadata


def _corrected(band: str, before: Preview | None, now: Preview) -> bool:
    """Whether the telemetry says that the offsets were renewed between two previews."""
    earlier, later = _metadata(band, before), _metadata(band, now)
    if earlier is None or later is None:
        return False
    return earlier.last_ffc_frame != later.last_ffc_frame


def _fpa(band: str, preview: Preview) -> float:
    reading = preview.readings.get(FPA + band, math.nan)
    fields = _metadata(band, preview)
    if math.isfinite(reading) or fields is None:
        return reading
    return fields.fpa_temperature


def _ffc(band: str, preview: Preview) -> str:
    """State of the flat-field correction; a camera that corrects answers late, a flag does not."""
    frame = preview.frames.get(band)
    if frame is not None and FrameFlag.SHUTTER_CLOSED in frame.flags:
        return _IN_PROGRESS
    reading = preview.readings.get(FFC + band)
    return "unknown" if reading is None else ffc_state(reading)


def _levels(frame: Frame | None) -> dict[str, Any]:
    """Range of the counts of a frame, and the shares of its pixels at the ends of the range."""
    if frame is None:
        return {}
    counts = frame.counts
    low, high = np.percentile(counts[::_STEP, ::_STEP], PERCENTILES)
    return {
        "limits": (float(low), float(high)),
        "lowest": float(counts.min()),
        "highest": float(counts.max()),
        "dead": _share(counts, _RANGE.min),
        "saturated": _share(counts, _RANGE.max),
    }


def _share(counts: Counts, value: int) -> float:
    return np.count_nonzero(counts == value) / counts.size
