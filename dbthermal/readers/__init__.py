"""Readers of outside formats: thermal spectra, videos drawn in a palette, triangle meshes.

A reader takes a path and returns labelled data in SI units, or raises; it mends nothing.
"""

from dbthermal.readers.meshes import mesh
from dbthermal.readers.spectra import ecostress, slum, ucsb
from dbthermal.readers.videos import masked_palette_video, palette_video

__all__ = ["ecostress", "masked_palette_video", "mesh", "palette_video", "slum", "ucsb"]
