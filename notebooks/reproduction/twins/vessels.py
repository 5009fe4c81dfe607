"""Vessels being filled with a hot drink, while people walk near: wineglass and coffee pot."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import trimesh

from reproduction import heat
from reproduction.twins import surfaces
from reproduction.twins.rays import Array, Camera
from reproduction.twins.stage import AMBIENT, Capture, Stage, passers_by, since, table


@dataclass(frozen=True)
class Vessel:
    r"""A glass vessel, and how it is filled.

    The wall is a thin shell: below the level of the drink, heat passes from the drink through half
    of the wall to its middle, :math:`1 / h = 1 / h_\mathrm{drink} + d / 2k`; above it from warm,
    moist air; outside it goes to air and by radiation to the room.

    """

    # Temperature of the drink when it is poured [K]; those of the two vessels below are chosen so
    # that the thermocouple peaks where the paper's did: 63.6 and 63.1 degrees Celsius.
    drink: float
    bottom: float  # height of the bottom [m]
    level: float  # height of the drink's surface when all is poured [m]
    thickness: float  # of the wall [m]
    solid: heat.Solid  # of the wall
    probe: tuple[float, float]  # of the thermocouple: height [m], angle from the camera [degrees]
    start: float = -3.0  # of the pouring [s]
    duration: float = 8.0  # of the pouring [s]
    ripple: float = 0.012  # height over which the rising surface laps the wall [m]
    cooling: float = 2000.0  # time constant of the drink [s]; a cup loses some 1 K a minute
    # Coefficients [W m^-2 K^-1], by table 1.1 of Bergman et al. (2011), Fundamentals of Heat and
    # Mass Transfer: free convection in liquids 50 to 1000, in gases 2 to 25.
    wet: float = 400.0  # from the drink to the wall
    moist: float = 10.0  # from the air inside, above the drink
    moist_temperature: float = 308.15  # of that air [K]
    air: float = 6.0  # to still air outside
    emissivity: float = 0.9  # total hemispherical, of glass, for its radiation alone [1]

    def _poured(self, time: float) -> float:
        """Share of the drink that is poured at a time [s]."""
        return float(np.clip((time - self.start) / self.duration, 0.0, 1.0))

    def wetted(self, height: Array, time: float) -> Array:
        """Share of the time that the drink touches the wall at some heights [m], in [0, 1]."""
        lowest = self.bottom - 3.0 * self.ripple
        level = lowest + self._poured(time) * (self.level - lowest)
        return np.asarray(0.5 * (1.0 + np.tanh((level - height) / self.ripple)))

    def exchanges(self, mesh: trimesh.Trimesh) -> list[heat.Exchange]:
        """Exchanges of each vertex of the wall, inside and outside."""
        height = np.asarray(mesh.vertices)[:, 2]
        hollow = height >= self.bottom
        wall = self.thickness / (2.0 * self.solid.conductivity)
        inside = 1.0 / (1.0 / self.wet + wall)

        def wet(time: float) -> Array:
            return inside * hollow * self.wetted(height, time)

        def dry(time: float) -> Array:
            return self.moist * hollow * (1.0 - self.wetted(height, time))

        def drink(time: float) -> float:
            remaining = np.exp(-max(time - self.start, 0.0) / self.cooling)
            return float(AMBIENT + (self.drink - AMBIENT) * remaining)

        def moist(time: float) -> float:
            return AMBIENT + (self.moist_temperature - AMBIENT) * self._poured(time)

        return [
            heat.Convection(wet, drink),
            heat.Convection(dry, moist),
            heat.Convection(self.air, AMBIENT),
            heat.Radiation(self.emissivity, AMBIENT),
        ]


WINEGLASS: Final = Vessel(
    drink=340.09,
    bottom=0.096,
    level=0.175,
    thickness=0.0015,
    solid=heat.GLASS,
    probe=(0.152, -12.0),
)
"""A wineglass with a wall of 1.5 mm."""

COFFEE_POT: Final = Vessel(
    drink=342.11,
    bottom=0.0,
    level=0.110,
    thickness=0.0022,
    solid=heat.BOROSILICATE,
    probe=(0.050, 10.0),
)
"""A coffee pot of borosilicate glass with a wall of 2.2 mm."""


def wineglass(capture: Capture, rng: np.random.Generator, vessel: Vessel = WINEGLASS) -> Stage:
    """Wineglass being filled, with two people walking near."""
    camera = Camera((0.0, -0.55, 0.165), (0.0, 0.0, 0.145), capture.shape)
    return _filled("wineglass", surfaces.wineglass(), vessel, camera, capture, rng)


def coffee_pot(capture: Capture, rng: np.random.Generator, vessel: Vessel = COFFEE_POT) -> Stage:
    """Coffee pot being filled, with two people walking near."""
    camera = Camera((0.0, -0.65, 0.11), (0.0, 0.0, 0.08), capture.shape)
    return _filled("coffee_pot", surfaces.coffee_pot(), vessel, camera, capture, rng)


def _filled(
    name: str,
    mesh: trimesh.Trimesh,
    vessel: Vessel,
    camera: Camera,
    capture: Capture,
    rng: np.random.Generator,
) -> Stage:
    """Stage of a vessel on a table."""
    wall = (vessel.thickness, vessel.solid)
    return Stage(
        name,
        mesh,
        since(vessel.start, mesh, wall, capture.time, vessel.exchanges(mesh)),
        camera,
        [table(), *passers_by(capture.time, rng)],
        [surfaces.on_wall(mesh, *vessel.probe)],
    )
