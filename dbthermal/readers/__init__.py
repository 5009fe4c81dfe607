"""Readers of outside formats: thermal spectra, videos drawn in a palette.

A reader takes a path and returns labelled data in SI units, or raises; it mends nothing.
"""

from dbthermal.readers._spectra import ecostress, slum, ucsb
from dbthermal.readers._videos import masked_palette_video, palette_video

__all__ = ["ecostress", "masked_palette_video", "palette_video", "slum", "ucsb"]


def __dir__() -> list[str]:
    return __all__
