"""The capture file: a recording while it grows, frame by frame and note by note.

Each frame is compared with the frame before, and written with its flags, as `camera.FrameFlag` has
them; the exposure time of a damaged one is NaN. Losses, shutter events and readings of instruments
go into the log. The store explains its contents in words, for a reader may have no more than it.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, Final, Self

import numpy as np

from dbthermal import store
from dbthermal.alignment import fill_times
from dbthermal.instruments import camera, telemetry
from dbthermal.instruments.camera import FfcStatus, Frame, FrameFlag, FrameSource
from dbthermal.schema import EXPOSURE_TIME, FRAME_FLAGS, STAGES, Variable

CHUNK: Final = 30  # frames of a chunk: half a second at 60 Hz, the most that a kill may cost

_AHEAD: Final = 1e-3  # by how much a stamp may be later than the frame's arrival [s]
_STALE: Final = 3.0  # age at which a reading of the serial line says no more of the shutter [s]
_HELD: Final = 1.0  # how long a note may wait for a chunk before it is written without one [s]
_RECORDER: Final = "recorder"  # source of notes on the recording itself
_FILLS: Final = {"frame_flags": int(FrameFlag.PADDED), "sequence": -1, "frame_counter": -1}


class Note(IntEnum):
    """Kinds of notes in the log, each with the meaning of the note's value."""

    meaning: str

    def __new__(cls, value: int, meaning: str) -> Self:
        """Make a kind from its number and its sentence."""
        member = int.__new__(cls, value)
        member._value_, member.meaning = value, meaning
        return member

    READING = 0, "the reading"
    READING_FAILED = 1, "NaN, the instrument gave none"
    FRAMES_LOST = 2, "number of frames missing by the driver's numbers"
    FRAMES_REFUSED = 3, "number of frames that came, but for which the queue was full"
    SEQUENCE_STANDS = 4, "step of the driver's number, 0 or less"
    DAMAGED = 5, "flags of the frame"
    SHUTTER_CLOSED = 6, "driver's number of the first frame with a closed shutter"
    SHUTTER_OPEN = 7, "driver's number of the first frame with an open one"
    CORRECTION = 8, "frame_counter at which the camera renewed its offsets, from telemetry"
    NO_FRAME = 9, "time without a frame [s]"
    SOURCE_LOST = 10, "NaN, the source gives no more frames"
    FOLDER_MOVED = 11, "NaN, the recording's folder was moved or renamed; it went on in it"


def _coded(codes: type[FrameFlag] | type[Note]) -> dict[str, Any]:
    """CF attributes of a variable of codes, and a sentence for each code."""
    sentences = {str(code.name).lower(): code.meaning for code in codes}
    return {
        "flag_masks" if codes is FrameFlag else "flag_values": [int(code) for code in codes],
        "flag_meanings": " ".join(sentences),
        "comment": "; ".join(f"{name}: {text}" for name, text in sentences.items()),
    }


ABOUT: Final = (
    "Raw frames as they came. Frame n of one band and frame n of another are not of one moment: "
    "each has its exposure_time, and the coordinate time is the first band's, without holes. "
    "exposure_time, host_time and log_time count from attribute clock_origin on the host's "
    "monotonic clock, which was attribute started in UTC; device_time is as the device gave it. "
    "exposure_time is NaN if a frame is no measurement; frame_flags has the reason. frames_written "
    "is the number of frames of each band; after them its last one is repeated. Note n of the log "
    "is of log_sources[log_source], and log_kind explains its log_value; log_units has the units "
    "of readings. totals: frames of each band, those lost by the driver's numbers, refused by a "
    "full queue, damaged. ended: reason of the end; complete: ended as planned; closed: false "
    "while it is being written or if it was cut short: then only frames_written and log_written "
    "are valid."
)
"""Explanation for a reader of the store: its attribute ``comment``."""

_LAYOUT: Final = (
    "16-bit words of a Boson; likely, not certain, are the words (of a longer number the high one "
    "first; value = number / steps + zero): "
    + ", ".join(
        f"{name} {field.word} to {field.word + np.dtype(field.dtype).itemsize // 2 - 1}"
        + (f" (steps {field.steps}, zero {field.zero:g})" if field.steps else "")
        for name, field in telemetry.FIELDS.items()
    )
)

_FRAMES, _note = ("band", "time"), partial(Variable, ("log",))
VARIABLES: Final = {
    "counts": STAGES["capture"]["counts"],
    "exposure_time": EXPOSURE_TIME,
    "device_time": Variable(_FRAMES, "float64", "s", "device's stamp of the frame, as it came"),
    "host_time": Variable(_FRAMES, "float64", "s", "arrival at the host, since clock_origin"),
    "sequence": Variable(_FRAMES, "int64", "1", "number of the frame by its driver"),
    "frame_flags": replace(FRAME_FLAGS, more=_coded(FrameFlag)),
    "log_time": _note("float64", "s", "time of the note, since clock_origin"),
    "log_kind": _note("int16", "1", "kind of the note", _coded(Note)),
    "log_source": _note("int16", "1", "source of the note: place in attribute log_sources"),
    "log_value": _note("float64", "1", "value by kind of the note; see attribute log_units"),
}
"""Variables of every recording; `ABOUT` explains them together."""

_ROWS = ("band", "time", "telemetry_row", "x")
TELEMETRY: Final = {
    "telemetry": Variable(
        _ROWS, "uint16", "1", "telemetry rows as they came", {"comment": _LAYOUT}
    ),
    "fpa_temperature": Variable(_FRAMES, "float32", "K", "temperature of the focal-plane array"),
    "frame_counter": Variable(_FRAMES, "int64", "1", "camera's own number of the frame, or -1"),
}
"""Variables of a recording of cameras that give telemetry. Where `frame_counter` leaps and
`sequence` does not, frames were lost before the driver saw them; its usual step is not documented
for all rates, so that the recorder draws no conclusion."""


class _Band:
    """Recording state of one band."""

    def __init__(self) -> None:
        self.block: list[dict[str, Any]] = []  # frames that are not written yet
        self.last: Frame | None = None
        self.device_time = -math.inf  # latest valid stamp
        self.shutter = camera.Shutter()
        self.ffc_status: tuple[float, FfcStatus | None] = (-math.inf, None)
        self.totals = dict.fromkeys(("frames", "lost", "refused", "damaged"), 0)


class CaptureFile:
    """A new recording that takes frames and notes in the order in which they come.

    FileExistsError if its path exists; ValueError if the sources differ in shape or telemetry.
    """

    def __init__(
        self,
        path: str | Path,
        sources: Mapping[str, FrameSource],
        readings: Mapping[str, str],  # name to unit
        attrs: Mapping[str, Any],
        chunk: int,  # frames that are written together
    ) -> None:
        formats = {band: (source.shape, source.telemetry_rows) for band, source in sources.items()}
        if len(set(formats.values())) != 1:
            raise ValueError(f"Invalid formats {formats} of the sources. Must be the same.")
        (rows, columns), telemetry_rows = next(iter(formats.values()))
        self._variables = {**VARIABLES, **(TELEMETRY if telemetry_rows else {})}
        self._sizes = {"y": rows, "x": columns, "telemetry_row": telemetry_rows}
        self._clock, self._chunk = next(iter(sources.values())).clock, chunk
        self.begin()
        self._names = [*sources, *readings, _RECORDER]
        self._notes: list[tuple[float, ...]] = []  # rows of the log that are not written yet
        self.broken = False  # True after a failed write: nothing more may be written
        # The store, explained by its attributes.
        attrs = {**attrs, **self._start, "comment": ABOUT, "log_sources": self._names}
        attrs["log_units"] = dict(readings)
        attrs["log_kinds"] = {kind.name.lower(): int(kind) for kind in Note}
        layout = path, self._variables, self._sizes, list(sources)
        self.recording = store.Recording(*layout, chunk=chunk, attrs=attrs, fills=_FILLS)
        self._place = self.recording.place()
        self._bands = {band: _Band() for band in sources}

    @property
    def totals(self) -> dict[str, dict[str, int]]:
        """Band to its ``frames``, ``lost``, ``refused`` and ``damaged``, numbers of frames."""
        return {band: dict(state.totals) for band, state in self._bands.items()}

    def begin(self) -> float:
        """Let the recording begin now, at the time on the host's clock [s] that is returned."""
        self._origin, started = self._clock(), self._clock.utc().isoformat(timespec="milliseconds")
        self._start = {"clock_origin": self._origin, "started": started}
        return self._origin

    def frame(self, band: str, frame: Frame, refused: int = 0) -> FrameFlag:
        """Take a frame, after so many that were refused; return all flags of the frame."""
        state, shape = self._bands[band], (self._sizes["y"], self._sizes["x"])
        if frame.counts.shape != shape:
            raise ValueError(f"Invalid frame of {frame.counts.shape} in '{band}'. Must be {shape}.")
        # Flags, from the frame before and from the shutter.
        flags = frame.flags | self._compared(band, frame, refused)
        flags |= self._watch_shutter(band, frame, flags)
        if flags & camera.DAMAGED:
            state.totals["damaged"] += 1
            self.note(Note.DAMAGED, band, frame.host_time, int(flags))
        # Values of the frame, into the chunk.
        timed = not flags & (camera.UNTIMED | FrameFlag.FOREIGN_CLOCK)
        values: dict[str, Any] = {
            "counts": frame.counts,
            "exposure_time": frame.device_time - self._origin if timed else math.nan,
            "device_time": frame.device_time,
            "host_time": frame.host_time - self._origin,
            "sequence": frame.sequence,
            "frame_flags": int(flags),
        }
        if self._sizes["telemetry_row"]:  # zeros if a frame came without
            decoded = frame.metadata or camera.Metadata()
            rows = np.zeros((self._sizes["telemetry_row"], self._sizes["x"]), np.uint16)
            values["telemetry"] = rows if frame.telemetry is None else frame.telemetry
            values["fpa_temperature"] = decoded.fpa_temperature
            values["frame_counter"] = decoded.frame_counter
        state.block.append(values)
        state.totals["frames"] += 1
        # A full chunk is written.
        if len(state.block) == self._chunk:
            self._write(band)
        return flags

    def note(self, kind: Note, source: str, time: float, value: float = math.nan) -> None:
        """Put a line into the log: a kind, a band or the name of a reading, time [s], value."""
        band = source.removeprefix(camera.FFC_READING)
        if kind is Note.READING and source != band and band in self._bands:
            status = FfcStatus(int(value)) if value in set(FfcStatus) else None
            self._bands[band].ffc_status = time, status
        self._notes.append((time - self._origin, int(kind), self._names.index(source), value))
        if self._notes[-1][0] - self._notes[0][0] > _HELD:
            self._write_notes()

    def refused(self, band: str, number: int, time: float) -> None:
        """Count frames of a band that came and were not taken, and note it."""
        if number:
            self._bands[band].totals["refused"] += number
            self.note(Note.FRAMES_REFUSED, band, time, number)

    def close(self, *, complete: bool, ended: str) -> None:
        """Write the rest, and the coordinate `time`: the first band's exposure times."""
        for band in self._bands:
            self._write(band)
        self._write_notes()
        stamps = self.recording.read("exposure_time", next(iter(self._bands)))
        time = fill_times(stamps) if np.isfinite(stamps).sum() > 1 else None
        self.recording.close(complete=complete, time=time, ended=ended, totals=self.totals)

    def _compared(self, band: str, frame: Frame, refused: int) -> FrameFlag:
        """Flags from the frame before, with notes of the frames that are missing between them."""
        state, flags = self._bands[band], camera.GOOD
        self.refused(band, refused, frame.host_time)
        # The number.
        step = 1 if state.last is None else frame.sequence - state.last.sequence
        lost = step - 1 - refused
        if step < 1:
            flags |= FrameFlag.SEQUENCE_STANDS
            self.note(Note.SEQUENCE_STANDS, band, frame.host_time, step)
        elif lost > 0:
            state.totals["lost"] += lost
            self.note(Note.FRAMES_LOST, band, frame.host_time, lost)
        flags |= FrameFlag.FRAMES_LOST_BEFORE if step > 1 else camera.GOOD
        # The image.
        if state.last is not None and np.array_equal(frame.counts, state.last.counts):
            flags |= FrameFlag.IMAGE_REPEATED
        state.last = frame
        # The stamp, of which one of the future must not spoil those that follow.
        has_own_clock, time = FrameFlag.FOREIGN_CLOCK in frame.flags, frame.device_time
        if not has_own_clock and (time < self._origin or time > frame.host_time + _AHEAD):
            return flags | FrameFlag.TIME_WRONG
        if not time > state.device_time:  # NaN too
            return flags | FrameFlag.TIME_STANDS
        state.device_time = time
        return flags

    def _watch_shutter(self, band: str, frame: Frame, flags: FrameFlag) -> FrameFlag:
        """Flag of a closed shutter, from telemetry, serial line and image."""
        state = self._bands[band]
        (read_at, status), before = state.ffc_status, state.shutter
        state.shutter = camera.next_shutter(
            before,
            repeated=FrameFlag.IMAGE_REPEATED in flags,
            last_ffc_frame=frame.metadata.last_ffc_frame if frame.metadata else None,
            ffc_status=status if frame.host_time - read_at <= _STALE else None,
        )
        closed, renewed = state.shutter.closed, state.shutter.last_ffc_frame
        if closed != before.closed:
            kind = Note.SHUTTER_CLOSED if closed else Note.SHUTTER_OPEN
            self.note(kind, band, frame.host_time, frame.sequence)
        if renewed is not None and before.last_ffc_frame not in {None, renewed}:
            self.note(Note.CORRECTION, band, frame.host_time, renewed)
        return FrameFlag.SHUTTER_CLOSED if closed else camera.GOOD

    def _write(self, band: str) -> None:
        state = self._bands[band]
        if state.block:
            self.broken = True
            # The frames of the chunk, variable by variable.
            columns = {name: [values[name] for values in state.block] for name in state.block[0]}
            dtypes = {name: self._variables[name].dtype for name in columns}
            block = {name: np.array(column, dtypes[name]) for name, column in columns.items()}
            self.recording.append(band, block)
            state.block = []
        self._write_notes()

    def _write_notes(self) -> None:
        self.broken = True
        if (place := self.recording.place()) != self._place:
            self._place = place
            self.note(Note.FOLDER_MOVED, _RECORDER, self._clock())
        if self._notes:
            names = ("log_time", "log_kind", "log_source", "log_value")
            columns = zip(names, zip(*self._notes, strict=True), strict=True)
            self.recording.append_log(
                {name: np.array(values, self._variables[name].dtype) for name, values in columns}
            )
            self._notes = []
        self.recording.commit(totals=self.totals, **self._start)
        self.broken = False
