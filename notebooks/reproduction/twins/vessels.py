"""Vessels being filled with something hot, while people walk near: wineglass and coffee pot."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from dbthermal.simulation import heat
from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array, Camera
from dbthermal.simulation._surroundings import Room
from reproduction.twins import surfaces
from reproduction.twins.probes import on_wall
from reproduction.twins.stage import AMBIENT, Capture, Stage, passers_by, since, table


@dataclass(frozen=True)
class Vessel:
    r"""
    A glass vessel, and how it is filled.

    The wall is a thin shell: below the level of the drink, heat passes from the drink through half
    of the wall to its middle, :math:`1 / h = 1 / h_\mathrm{drink} + d / 2k`; above it from warm,
    moist air; outside it goes to air and by radiation to the room.

    Attributes
    ----------
    drink : float
        Temperature of the drink when it is poured [K]. Those of the two vessels below are chosen
        so that the thermocouple peaks where the paper's did: 63.6 and 63.1 degrees Celsius.
    cooling : float
        Time constant of the drink's cooling towards the room [s]; a cup loses some 1 K a minute.
    start, duration : float
        When the pouring begins, and how long it lasts [s].
    bottom, level : float
        Heights of the bottom and of the drink's surface when all is poured [m].
    ripple : float
        Height over which the rising surface laps the wall [m].
    thickness : float
        Of the wall [m].
    solid : heat.Solid
        What the wall is made of.
    wet : float
        Coefficient from the drink to the wall [W m^-2 K^-1]; 50 to 1000 for free convection in
        liquids, table 1.1 of Bergman et al. (2011), Fundamentals of Heat and Mass Transfer.
    moist, moist_temperature : float
        Coefficient [W m^-2 K^-1] and temperature [K] of the air inside, above the drink.
    air : float
        Coefficient to still air outside [W m^-2 K^-1]; 2 to 25 for free convection in gases, same
        table.
    emissivity : float
        Total hemispherical emissivity of glass [1], for its radiation alone: about 0.9.
    probe : tuple of float
        Height [m] of the thermocouple, and its angle about the axis from the camera [degrees].
    """

    drink: float
    bottom: float
    level: float
    thickness: float
    solid: heat.Solid
    probe: tuple[float, float]
    start: float = -3.0
    duration: float = 8.0
    ripple: float = 0.012
    cooling: float = 2000.0
    wet: float = 400.0
    moist: float = 10.0
    moist_temperature: float = 308.15
    air: float = 6.0
    emissivity: float = 0.9

    def __post_init__(self) -> None:
        """Refuse a vessel that cannot be filled."""
        if not self.bottom < self.level:
            raise ValueError(f"Invalid level {self.level} m. Must be above {self.bottom} m.")
        if not self.duration > 0:
            raise ValueError(f"Invalid duration {self.duration} s of pouring. Must be positive.")

    def wetted(self, height: Array, time: float) -> Array:
        """Share of the time that the drink touches the wall at some heights [m], in [0, 1]."""
        poured = np.clip((time - self.start) / self.duration, 0.0, 1.0)
        level = (
            self.bottom
            - 3.0 * self.ripple
            + poured * (self.level - self.bottom + 3.0 * self.ripple)
        )
        return np.asarray(0.5 * (1.0 + np.tanh((level - height) / self.ripple)))

    def exchanges(self, surface: Surface) -> list[heat.Exchange]:
        """What each vertex of the wall exchanges, inside and outside."""
        height, hollow = surface.vertices[:, 2], surface.vertices[:, 2] >= self.bottom
        wall = self.thickness / (2.0 * self.solid.conductivity)
        inside = 1.0 / (1.0 / self.wet + wall)

        def wet(time: float) -> Array:
            return inside * hollow * self.wetted(height, time)

        def dry(time: float) -> Array:
            return self.moist * hollow * (1.0 - self.wetted(height, time))

        def drink(time: float) -> float:
            left = np.exp(-max(time - self.start, 0.0) / self.cooling)
            return float(AMBIENT + (self.drink - AMBIENT) * left)

        def moist(time: float) -> float:
            poured = np.clip((time - self.start) / self.duration, 0.0, 1.0)
            return float(AMBIENT + (self.moist_temperature - AMBIENT) * poured)

        return [
            heat.Convection(wet, drink),
            heat.Convection(dry, moist),
            heat.Convection(self.air, AMBIENT),
            heat.Radiation(self.emissivity, AMBIENT),
        ]


WINEGLASS: Final = Vessel(
    drink=340.09,
    bottom=surfaces.WINEGLASS_CAVITY[0],
    level=0.175,
    thickness=0.0015,
    solid=heat.GLASS,
    probe=(0.152, -12.0),
)
"""A wineglass with a wall of 1.5 mm."""

COFFEE_POT: Final = Vessel(
    drink=342.11,
    bottom=surfaces.COFFEE_POT_CAVITY[0],
    level=0.110,
    thickness=0.0022,
    solid=heat.BOROSILICATE,
    probe=(0.050, 10.0),
)
"""A coffee pot of borosilicate glass with a wall of 2.2 mm."""


def wineglass(capture: Capture, rng: np.random.Generator, vessel: Vessel = WINEGLASS) -> Stage:
    """
    A wineglass being filled, with two people walking near.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the people's ways.
    vessel : Vessel
        The glass, and how it is filled.

    Returns
    -------
    Stage
        For `take`.
    """
    camera = Camera((0.0, -0.55, 0.165), (0.0, 0.0, 0.145), capture.shape)
    return _filled("wineglass", surfaces.wineglass(), vessel, camera, capture, rng)


def coffee_pot(capture: Capture, rng: np.random.Generator, vessel: Vessel = COFFEE_POT) -> Stage:
    """
    A coffee pot being filled, with two people walking near.

    Parameters
    ----------
    capture : Capture
        How it is recorded.
    rng : Generator
        Source of the people's ways.
    vessel : Vessel
        The pot, and how it is filled.

    Returns
    -------
    Stage
        For `take`.
    """
    camera = Camera((0.0, -0.65, 0.11), (0.0, 0.0, 0.08), capture.shape)
    return _filled("coffee_pot", surfaces.coffee_pot(), vessel, camera, capture, rng)


def _filled(
    name: str,
    surface: Surface,
    vessel: Vessel,
    camera: Camera,
    capture: Capture,
    rng: np.random.Generator,
) -> Stage:
    """Stage of a vessel on a table."""
    shell = heat.Shell(surface.vertices, surface.faces, vessel.thickness, vessel.solid)
    return Stage(
        name,
        surface,
        since(vessel.start, shell, capture.time, vessel.exchanges(surface)),
        camera,
        [table(), *passers_by(capture.time, rng)],
        Room(AMBIENT),
        [on_wall(surface, *vessel.probe)],
    )
