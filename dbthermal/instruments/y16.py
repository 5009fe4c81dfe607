"""Any camera that gives 16-bit frames (Y16) over Video4Linux2, without command port or telemetry.

Nothing of the camera is known but its frames: no temperature, and no state of its shutter, which
then follows from frozen images alone, see `camera.next_shutter`. Its offsets are corrected when the
camera does so.
"""

from typing import Final

from dbthermal.instruments.camera import CameraKind, over_v4l2

__all__ = ["KIND"]
__dir__ = __all__.copy


KIND: Final = CameraKind(over_v4l2())
"""The kind of camera of a session's ``kind: y16``."""
