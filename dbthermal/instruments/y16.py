"""Any camera that gives 16-bit frames (Y16) over Video4Linux2, without command port or telemetry.

Nothing of the camera is known but its frames: no temperature, and no state of its shutter, which
then follows from frozen images alone, see `camera.next_shutter`. Its offsets are corrected when the
camera does so.
"""

from contextlib import AbstractContextManager
from typing import Final

from dbthermal.instruments.camera import CameraKind, FrameSource, Stream

__all__ = ["KIND"]
__dir__ = __all__.copy


def _open_frames(url: str, stream: Stream) -> AbstractContextManager[FrameSource]:
    from dbthermal.instruments import v4l2  # noqa: PLC0415 - Linux only

    return v4l2.open_url(url, stream)


KIND: Final = CameraKind(_open_frames)
"""The kind of camera of a session's ``kind: y16``."""
