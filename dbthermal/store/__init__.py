"""Files on disk: results with their provenance, and recordings while they grow.

`save` and `open_dataset` keep datasets as zarr, `save_rows` one that is made row by row,
`save_part` and `join_parts` one whose rows several processes make;
`save_numbers`, `save_figure`, `save_text` and `save_video` keep the rest of a result, each with the
record from `provenance`. `Recording` grows in chunks and survives a kill or a power loss; a
`HeldFolder` is found wherever it is moved. No other package opens or writes zarr.
"""

from dbthermal.store._durable import HeldFolder, to_disk
from dbthermal.store._parts import join_parts, save_part
from dbthermal.store._provenance import checksum, provenance
from dbthermal.store._recording import Recording
from dbthermal.store._results import (
    Number,
    open_dataset,
    read_numbers,
    save,
    save_figure,
    save_numbers,
    save_rows,
    save_text,
    save_video,
    whole,
)

__all__ = [
    "HeldFolder",
    "Number",
    "Recording",
    "checksum",
    "join_parts",
    "open_dataset",
    "provenance",
    "read_numbers",
    "save",
    "save_figure",
    "save_numbers",
    "save_part",
    "save_rows",
    "save_text",
    "save_video",
    "to_disk",
    "whole",
]
__dir__ = __all__.copy
