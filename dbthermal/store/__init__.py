"""Files on disk: results with their provenance, and recordings while they grow.

`save` and `open_dataset` keep datasets as zarr, `save_rows` one that is made row by row, and
`join_parts` one whose rows several processes make; `save_figure`, `save_text` and `save_video` keep
the rest of a result, each with the record from `provenance`. `Recording` grows in chunks and
survives a kill or a power loss; a `HeldFolder` is found wherever it is moved. What is written
appears `whole`, at a place that is `reserved` for one process. No other package writes zarr;
`readers` opens stores of others.
"""

from dbthermal.store._datasets import join_parts, open_dataset, save, save_rows
from dbthermal.store._recording import HeldFolder, Recording
from dbthermal.store._results import checksum, provenance, save_figure, save_text, save_video
from dbthermal.store._whole import reserved, to_disk, whole

__all__ = [
    "HeldFolder",
    "Recording",
    "checksum",
    "join_parts",
    "open_dataset",
    "provenance",
    "reserved",
    "save",
    "save_figure",
    "save_rows",
    "save_text",
    "save_video",
    "to_disk",
    "whole",
]
__dir__ = __all__.copy
