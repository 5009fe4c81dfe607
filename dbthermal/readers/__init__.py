"""Readers of outside formats: recordings, thermal spectra, YAML.

A reader takes a path and returns labelled data in SI units, or raises; it mends nothing. What it
opens was written by others: it must be a regular file of a limited size.
"""

from dbthermal._text import read_yaml
from dbthermal.readers._arrays import array
from dbthermal.readers._flir import flir
from dbthermal.readers._sequences import raw, sequence
from dbthermal.readers._spectra import ecostress
from dbthermal.readers._stacks import tiff
from dbthermal.readers._two_bands import two_bands

__all__ = ["array", "ecostress", "flir", "raw", "read_yaml", "sequence", "tiff", "two_bands"]
__dir__ = __all__.copy
