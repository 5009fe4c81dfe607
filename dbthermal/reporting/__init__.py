"""Report on a separated scene: one HTML file that opens anywhere, without a network."""

from dbthermal.reporting._scene import report

__all__ = ["report"]
__dir__ = __all__.copy
