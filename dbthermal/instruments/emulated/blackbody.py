"""Frames of a blackbody that fills the view of the emulated cameras."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from dbthermal import response as responses
from dbthermal import simulation
from dbthermal.bands import FILTERS
from dbthermal.instruments.emulated.world import World
from dbthermal.instruments.session import Session

NETD = 0.1  # noise of the emulated cameras near 25 degrees Celsius [K]

Counts = npt.NDArray[np.uint16]


def pictures(session: Session, world: World) -> dict[str, Callable[[float], Counts]]:
    """Raw frames, by band, of the world's blackbody as the cameras of a session see it.

    Counts follow Planck's law in the band at `World.blackbody_temperature`, with noise of `NETD`,
    a fixed pattern (see `dbthermal.simulation.pattern`) and 16 bits. Bands that are not in
    `dbthermal.bands.FILTERS` get no picture.
    """
    names = dict.fromkeys((*session.bands, *session.filters.values()))
    bands = tuple(name for name in names if name in FILTERS)
    if not bands:
        return {}
    rig = simulation.Rig(bands=bands, noise=(NETD,) * len(bands))
    detector = simulation.pattern(rig, session.shape, np.random.default_rng(0))
    response = rig.response()

    def of_band(number: int, band: str) -> Callable[[float], Counts]:
        curve, pattern = responses.curve(response, band), detector.sel(band=band)
        noise = float(response["noise"].sel(band=band))
        rng = np.random.default_rng([0, number])

        def picture(_: float) -> Counts:
            level = float(curve.counts(np.array(world.blackbody_temperature)))
            return simulation.digitise(level + rng.normal(0.0, noise, session.shape), pattern)

        return picture

    return {band: of_band(number, band) for number, band in enumerate(bands)}
