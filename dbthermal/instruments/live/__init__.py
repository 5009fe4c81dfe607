"""A recording while it goes on: its pictures, its losses, and how its cameras are.

A `View` is handed to `instruments.recording.record.record` as `preview`, and shows one picture of
each band, in place, in a notebook or nowhere::

    from IPython.display import DisplayHandle

    view = live.View(DisplayHandle(), title=session.name, is_simulated=session.simulated)
    record(session, devices.sources, path, readings=devices.readings(), preview=view)

A `Watch` finds the numbers that are shown, and draws nothing: matplotlib is loaded with the first
picture. The preview is called between two frames that are written: what an update costs, the
recording's queue has to bridge.
"""

from dbthermal.instruments.live._view import Display, Picture, View
from dbthermal.instruments.live._watch import Status, Watch

__all__ = ["Display", "Picture", "Status", "View", "Watch"]
