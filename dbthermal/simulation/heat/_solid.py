"""What a shell is made of: conductivity, density, specific heat."""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np


@dataclass(frozen=True)
class Solid:
    """
    Thermal properties of a solid, constant over the temperatures of a scene.

    Attributes
    ----------
    conductivity : float
        Thermal conductivity k [W m^-1 K^-1].
    density : float
        Density [kg m^-3].
    specific_heat : float
        Specific heat at constant pressure c [J kg^-1 K^-1].

    Raises
    ------
    ValueError
        If a property is not finite and positive.
    """

    conductivity: float
    density: float
    specific_heat: float

    def __post_init__(self) -> None:
        """Refuse properties that no solid has."""
        for field in fields(self):
            value = getattr(self, field.name)
            if not (np.isfinite(value) and value > 0):
                raise ValueError(
                    f"Invalid {field.name} {value} of a solid. Must be finite and positive."
                )

    @property
    def diffusivity(self) -> float:
        r"""Thermal diffusivity :math:`\alpha = k / \rho c` [m^2 s^-1]."""
        return self.conductivity / (self.density * self.specific_heat)


# At 300 K, from tables A.1 (metals) and A.3 (glasses) of Bergman, Lavine, Incropera, DeWitt (2011),
# Fundamentals of Heat and Mass Transfer, 7th edition, Wiley, ISBN 978-0-470-50197-9.

GLASS: Final = Solid(conductivity=1.4, density=2500.0, specific_heat=750.0)
"""Plate glass, soda-lime, at 300 K: table A.3 of Bergman et al. (2011)."""

BOROSILICATE: Final = Solid(conductivity=1.4, density=2225.0, specific_heat=835.0)
"""Pyrex at 300 K: table A.3 of Bergman et al. (2011)."""

ALUMINIUM: Final = Solid(conductivity=237.0, density=2702.0, specific_heat=903.0)
"""Pure aluminium at 300 K: table A.1 of Bergman et al. (2011)."""

STEEL: Final = Solid(conductivity=14.9, density=7900.0, specific_heat=477.0)
"""Stainless steel AISI 304 at 300 K: table A.1 of Bergman et al. (2011)."""

CERAMIC: Final = Solid(conductivity=1.5, density=2400.0, specific_heat=1050.0)
"""Porcelain near room temperature, round values: material-properties.org, page "Porcelain"."""
