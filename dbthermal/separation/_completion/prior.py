"""Priors on the emissivities: mixtures of normal distributions, of each pixel or of all."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import emissivity, schema
from dbthermal.separation._tiles import Array, Whole

SAMPLE_STD: Final = 0.02
"""Deviation of the emissivity of one sample of a material from that of the table [1]."""

# Grid of the first emissivity for a wide prior, finer towards 1; points and reach of a narrow one.
_GRID: Final = np.concatenate(
    [np.linspace(0.03, 0.78, 16), np.linspace(0.8, 0.97, 18), np.linspace(0.975, 0.9975, 7)]
)
_POINTS: Final = 17
_SIGMAS: Final = 4.0
_LIMITS: Final = (0.005, 0.9995)


@dataclass(frozen=True)
class Mixture:
    """Normal distributions of the emissivities; of more than one component the same everywhere."""

    weight: Array  # (component,)
    mean: Array  # (component, band, pixel) [1]
    covariance: Array  # (component, band, band, pixel) [1]

    def grid(self) -> Array:
        """Grid (grid, pixel) of the first emissivity."""
        pixels = self.mean.shape[-1]
        if len(self.weight) > 1:
            return np.repeat(_GRID[:, np.newaxis], pixels, axis=1)
        std = np.sqrt(self.covariance[0, 0, 0])
        low = np.maximum(self.mean[0, 0] - _SIGMAS * std, _LIMITS[0])
        high = np.minimum(self.mean[0, 0] + _SIGMAS * std, _LIMITS[1])
        return np.asarray(low + np.linspace(0.0, 1.0, _POINTS)[:, np.newaxis] * (high - low))

    def at(self, places: Whole | int) -> "Mixture":
        """Return the mixture of some pixels, or of labels (pixel,)."""
        return Mixture(self.weight, self.mean[..., places], self.covariance[..., places])


def stated(prior: str | xr.DataArray | xr.Dataset | None, bands: list[str]) -> Mixture:
    """Prior of the libraries, of a material of the table, or of the user; see `complete`."""
    if prior is None:
        table = emissivity.library_mixture(bands)
        parts = (table[name].values[..., np.newaxis] for name in ("mean", "covariance"))
        return Mixture(table["weight"].values, *parts)
    if isinstance(prior, str):
        known = emissivity.embedded_table()["emissivity"]
        if prior not in known["material"]:
            names = known["material"].values.tolist()
            raise ValueError(f"Unknown prior '{prior}'. Must be one of {names}.")
        prior = known.sel(material=prior)
    stds = np.full(len(bands), SAMPLE_STD)
    if isinstance(prior, xr.Dataset):
        if missing := {"emissivity", "emissivity_std"} - set(prior):
            raise ValueError(f"Missing variable '{min(missing)}' in the prior. Has {list(prior)}.")
        prior, std = prior["emissivity"], prior["emissivity_std"]
        stds = schema.band_values(std, bands, "emissivity_std of the prior", "1")
    values = schema.band_values(prior, bands, "prior", "1")
    for name, part in (("emissivities", values), ("emissivity_std", stds)):
        if not np.all((part > 0) & (part < 1)):
            raise ValueError(f"Invalid {name} {part.tolist()} of the prior. Must lie in (0, 1).")
    return Mixture(np.ones(1), values[None, :, None], np.diag(stds**2)[None, ..., None])
