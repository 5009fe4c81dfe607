"""What is kept on disk: results, and recordings while they grow. Nothing else touches zarr."""

from dbthermal.store._recording import Recording, recover
from dbthermal.store._results import (
    CHUNK_BYTES,
    Number,
    chunks,
    open_dataset,
    read_numbers,
    save,
    save_figure,
    save_numbers,
    save_text,
    save_video,
)

__all__ = [
    "CHUNK_BYTES",
    "Number",
    "Recording",
    "chunks",
    "open_dataset",
    "read_numbers",
    "recover",
    "save",
    "save_figure",
    "save_numbers",
    "save_text",
    "save_video",
]
