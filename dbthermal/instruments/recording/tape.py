"""Frames and notes on their way into a recording: numbered, flagged, gathered into chunks.

A `Tape` looks at each frame beside the one before: a number that leaps is a loss, one that does not
rise a repetition, a time that does not rise, or cannot be, is none, and an image without a changed
pixel was not taken anew. Nothing is left out:
a damaged frame is written with its flags, and only its exposure time is NaN, so that
`dbthermal.alignment` passes over it. What is no frame goes into the log: losses, shutter events,
readings of other instruments.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from dbthermal import store
from dbthermal.alignment import fill_times
from dbthermal.instruments.camera import (
    DAMAGED,
    GOOD,
    UNTIMED,
    Counts,
    FfcStatus,
    Frame,
    FrameFlag,
    FrameSource,
    Metadata,
    Shutter,
    next_shutter,
)
from dbthermal.instruments.recording.contents import ABOUT, TELEMETRY, VARIABLES, Note

CHUNK: Final = 30
"""Frames of a chunk: half a second at 60 Hz, which is what a kill may cost."""

_AHEAD: Final = 1e-3  # by how much a stamp may be later than the frame was there [s]
_STALE: Final = 3.0  # age at which a reading of the serial line says no more of the shutter [s]
_HELD: Final = 1.0  # how long a note may wait for a chunk before it is written without one [s]
_FILLS: Final = MappingProxyType(
    {"frame_flags": int(FrameFlag.PADDED), "sequence": -1, "frame_counter": -1}
)


@dataclass
class _Band:
    """What is known of one band while it is recorded."""

    block: dict[str, npt.NDArray[Any]]
    filled: int = 0
    image: Counts | None = None
    sequence: int | None = None
    device_time: float = -math.inf
    shutter: Shutter = field(default_factory=Shutter)
    ffc_status: tuple[float, FfcStatus | None] = (-math.inf, None)
    last_correction: int | None = None
    counts: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("frames", "lost", "refused", "damaged"), 0)
    )


class Tape:
    """
    What frames and notes are handed to, in the order in which they come.

    Parameters
    ----------
    path : str or Path
        Recording to make, ``*.zarr``.
    sources : mapping
        Band to its source, all of one shape.
    readings : mapping
        Name of each further instrument's reading to its unit.
    origin : float
        Host's clock at time 0 [s].
    attrs : mapping
        Attributes of the recording, JSON.
    chunk : int
        Frames of a chunk.

    Attributes
    ----------
    recording : Recording
        What is on the disk.
    broken : bool
        Whether writing failed: what was written before is valid, and no more is to be handed over.

    Raises
    ------
    FileExistsError
        If there is something at `path`.
    ValueError
        If the sources differ in shape or telemetry.
    """

    def __init__(
        self,
        path: str | Path,
        sources: Mapping[str, FrameSource],
        *,
        readings: Mapping[str, str],
        origin: float,
        attrs: Mapping[str, Any],
        chunk: int = CHUNK,
    ) -> None:
        (rows, columns), telemetry_rows = _common_format(sources)
        self._variables = {**VARIABLES, **(TELEMETRY if telemetry_rows else {})}
        self._sizes = {"y": rows, "x": columns, "telemetry_row": telemetry_rows}
        self._origin, self._chunk = origin, chunk
        self._names = [*sources, *readings]
        self._notes: list[tuple[float, int, int, float]] = []
        self.broken = False
        self.recording = store.Recording.create(
            path,
            self._variables,
            self._sizes,
            list(sources),
            chunk=chunk,
            attrs={**attrs, **_legend(self._names, readings, origin)},
            fills=_FILLS,
        )
        self._bands = {band: _Band(self._new_block()) for band in sources}

    @property
    def totals(self) -> dict[str, dict[str, int]]:
        """Band to its ``frames``, ``lost``, ``refused`` and ``damaged``, numbers of frames."""
        return {band: dict(state.counts) for band, state in self._bands.items()}

    def frame(self, band: str, frame: Frame, refused: int = 0) -> FrameFlag:
        """
        Take a frame; write the chunk if it is whole.

        Parameters
        ----------
        band : str
            Its band.
        frame : Frame
            As it came from the source.
        refused : int
            Frames of this band that came since the one before and were not taken.

        Returns
        -------
        FrameFlag
            All flags of the frame, those of the driver and of the recorder.
        """
        state = self._bands[band]
        flags = frame.flags | self._compared(band, frame, refused)
        flags |= self._watch_shutter(band, frame, flags)
        if flags & DAMAGED:
            state.counts["damaged"] += 1
            self.note(Note.DAMAGED, band, frame.host_time, int(flags))
        timed = not flags & (UNTIMED | FrameFlag.FOREIGN_CLOCK)
        values: dict[str, Any] = {
            "counts": frame.counts,
            "exposure_time": frame.device_time - self._origin if timed else math.nan,
            "device_time": frame.device_time,
            "host_time": frame.host_time - self._origin,
            "sequence": frame.sequence,
            "frame_flags": int(flags),
            **self._decoded(band, frame),
        }
        for name, value in values.items():
            state.block[name][state.filled] = value
        state.filled += 1
        state.counts["frames"] += 1
        if state.filled == self._chunk:
            self._write(band)
        return flags

    def note(self, kind: Note, source: str, time: float, value: float = math.nan) -> None:
        """
        Put a line into the log.

        Parameters
        ----------
        kind : Note
            What it is.
        source : str
            Band, or name of a reading.
        time : float
            On the host's clock [s].
        value : float
            See `Note`.
        """
        band = source.removeprefix("ffc ")
        if kind is Note.READING and source != band and band in self._bands:
            self._bands[band].ffc_status = time, FfcStatus(int(value))
        row = time - self._origin, int(kind), self._names.index(source), value
        self._notes.append(row)
        if row[0] - self._notes[0][0] > _HELD:
            self._write_notes()

    def refused(self, band: str, number: int, time: float) -> None:
        """
        Count frames that came and were not taken, after the last one that was.

        Parameters
        ----------
        band : str
            Their band.
        number : int
            How many.
        time : float
            On the host's clock [s].
        """
        if number:
            self._bands[band].counts["refused"] += number
            self.note(Note.FRAMES_REFUSED, band, time, number)

    def close(self, *, complete: bool, ended: str) -> None:
        """
        Write what is left, and the coordinate `time`: the first band's exposure times.

        Parameters
        ----------
        complete : bool
            Whether the recording went as planned.
        ended : str
            Why it ended.
        """
        for band in self._bands:
            self._write(band)
        self._write_notes()
        time = self._times(next(iter(self._bands)))
        self.recording.close(complete=complete, time=time, ended=ended, totals=self.totals)

    def _compared(self, band: str, frame: Frame, refused: int) -> FrameFlag:
        """Flags from the frame before, and the notes of what is missing between them."""
        state, flags = self._bands[band], GOOD
        self.refused(band, refused, frame.host_time)
        step = 1 if state.sequence is None else frame.sequence - state.sequence
        lost = step - 1 - refused
        if step < 1:
            flags |= FrameFlag.SEQUENCE_STANDS
            self.note(Note.SEQUENCE_STANDS, band, frame.host_time, step)
        elif lost > 0:
            state.counts["lost"] += lost
            self.note(Note.FRAMES_LOST, band, frame.host_time, lost)
        flags |= FrameFlag.FRAMES_LOST_BEFORE if step > 1 else GOOD
        if state.image is not None and np.array_equal(frame.counts, state.image):
            flags |= FrameFlag.IMAGE_REPEATED
        state.sequence, state.image = frame.sequence, frame.counts
        return flags | self._timed(state, frame)

    def _timed(self, state: _Band, frame: Frame) -> FrameFlag:
        """Flag of a stamp that is none; one of the future must not spoil those that follow."""
        own_clock, time = FrameFlag.FOREIGN_CLOCK in frame.flags, frame.device_time
        if not own_clock and (time < self._origin or time > frame.host_time + _AHEAD):
            return FrameFlag.TIME_WRONG
        if not frame.device_time > state.device_time:  # NaN too
            return FrameFlag.TIME_STANDS
        state.device_time = frame.device_time
        return GOOD

    def _watch_shutter(self, band: str, frame: Frame, flags: FrameFlag) -> FrameFlag:
        """Flag of a closed shutter, from telemetry, serial line and image."""
        state = self._bands[band]
        read_at, status = state.ffc_status
        before, state.shutter = (
            state.shutter,
            next_shutter(
                state.shutter,
                repeated=FrameFlag.IMAGE_REPEATED in flags,
                last_ffc_frame=frame.metadata.last_ffc_frame if frame.metadata else None,
                ffc_status=status if frame.host_time - read_at <= _STALE else None,
            ),
        )
        if state.shutter.closed != before.closed:
            kind = Note.SHUTTER_CLOSED if state.shutter.closed else Note.SHUTTER_OPEN
            self.note(kind, band, frame.host_time, frame.sequence)
        return FrameFlag.SHUTTER_CLOSED if state.shutter.closed else GOOD

    def _decoded(self, band: str, frame: Frame) -> dict[str, Any]:
        """Telemetry as it came, and its values that are stored for each frame."""
        if frame.telemetry is None:
            return {}
        state, fields = self._bands[band], frame.metadata or Metadata()
        if fields.last_ffc_frame is not None:
            if state.last_correction not in {None, fields.last_ffc_frame}:
                self.note(Note.CORRECTION, band, frame.host_time, fields.last_ffc_frame)
            state.last_correction = fields.last_ffc_frame
        return {
            "telemetry": frame.telemetry,
            "fpa_temperature": fields.fpa_temperature,
            "frame_counter": fields.frame_counter,
        }

    def _write(self, band: str) -> None:
        state = self._bands[band]
        if state.filled:
            self.broken = True
            block = {name: values[: state.filled] for name, values in state.block.items()}
            self.recording.append(band, block)
            state.filled = 0
        self._write_notes()

    def _write_notes(self) -> None:
        self.broken = True
        if self._notes:
            names = ("log_time", "log_kind", "log_source", "log_value")
            columns = zip(names, zip(*self._notes, strict=True), strict=True)
            self.recording.append_log(
                {name: np.array(values, self._variables[name].dtype) for name, values in columns}
            )
            self._notes = []
        self.recording.commit(totals=self.totals)
        self.broken = False

    def _new_block(self) -> dict[str, npt.NDArray[Any]]:
        sizes = {**self._sizes, "time": self._chunk}
        return {
            name: np.zeros([sizes[dim] for dim in variable.dims[1:]], variable.dtype)
            for name, variable in self._variables.items()
            if variable.dims[0] == "band"
        }

    def _times(self, band: str) -> npt.NDArray[np.float64] | None:
        """Exposure times without holes; None where there are not two."""
        stamps = self.recording.read("exposure_time", band)
        return fill_times(stamps) if np.isfinite(stamps).sum() > 1 else None


def _common_format(sources: Mapping[str, FrameSource]) -> tuple[tuple[int, int], int]:
    formats = {band: (source.shape, source.telemetry_rows) for band, source in sources.items()}
    if len(set(formats.values())) != 1:
        raise ValueError(f"Invalid formats {formats} of the sources. Must be the same.")
    return next(iter(formats.values()))


def _legend(names: list[str], readings: Mapping[str, str], origin: float) -> dict[str, Any]:
    """Attributes that say what the numbers in times and log mean."""
    return {
        "comment": ABOUT,
        "clock_origin": origin,
        "log_sources": names,
        "log_units": dict(readings),
        "log_kinds": {kind.name.lower(): int(kind) for kind in Note},
    }
