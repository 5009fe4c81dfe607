"""The objects of the paper's emissivity bench, and their emissivity in every band."""

from dataclasses import dataclass
from typing import Final

import xarray as xr

from dbthermal.emissivity import embedded_table

_CAMERA_BAND: Final = "8-14"


@dataclass(frozen=True)
class Sample:
    """
    An object on the bench.

    Attributes
    ----------
    name : str
        Name.
    emissivity : float
        In the band 8-14 um [1].
    kin : str
        Material of `emissivity.embedded_table` after which the other bands are scaled.
    stray : float
        Largest share of its reflection that is not mirror-like but comes from the whole room [1].
    """

    name: str
    emissivity: float
    kin: str
    stray: float

    def __post_init__(self) -> None:
        """Refuse shares outside [0, 1]."""
        if not 0 < self.emissivity < 1:
            raise ValueError(
                f"Invalid emissivity {self.emissivity} of '{self.name}'. Must lie in (0, 1)."
            )
        if not 0 <= self.stray <= 1:
            raise ValueError(f"Invalid stray {self.stray} of '{self.name}'. Must lie in [0, 1].")


OBJECTS: Final = (
    Sample("chrome ball", 0.10, "brass plate", 0.02),
    Sample("aluminium cup", 0.05, "aluminium, weathered", 0.04),
    Sample("blue paint", 0.87, "black gloss paint", 0.20),
    Sample("glass jar", 0.95, "plate window glass", 0.01),
    Sample("wineglass", 0.95, "plate window glass", 0.01),
)
"""The five objects of the paper (its table of emissivities, doi:10.48550/arXiv.2509.11334), with
its reference values for 8-14 um; the rest is this project's choice."""


def band_emissivity(sample: Sample, names: list[str]) -> xr.DataArray:
    """
    True emissivity of an object in several bands.

    The object's own value for 8-14 um, and the ratio of its kin's: of the emissivities where the
    object's is below 0.5 as a metal's, of the reflectances above as a dielectric's, so that the
    result stays between 0 and 1.

    Parameters
    ----------
    sample : Sample
        The object.
    names : list of str
        Bands of `bands.FILTERS`.

    Returns
    -------
    DataArray
        (band) [1].
    """
    kin = embedded_table()["emissivity"].sel(material=sample.kin, drop=True)
    if sample.emissivity < 0.5:
        value = sample.emissivity * kin.sel(band=names) / float(kin.sel(band=_CAMERA_BAND))
    else:
        ratio = (1.0 - kin.sel(band=names)) / (1.0 - float(kin.sel(band=_CAMERA_BAND)))
        value = 1.0 - (1.0 - sample.emissivity) * ratio
    return value.assign_attrs(units="1")
