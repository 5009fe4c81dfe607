"""Reflections as pictures: the change of the first band that a result explains."""

import numpy as np
import pytest
import xarray as xr
from captures import emissivity_of

from dbthermal import response as responses
from dbthermal import separation, simulation
from dbthermal.simulation import Background, Rig

FILM = np.arange(350) / 10.0  # s


def test_reflected_change() -> None:
    """It is the share of the background's change that the first band sees, for objects that change
    and for those that do not.
    """
    rig, value = Rig(noise=(0.003, 0.035)), emissivity_of(0.86, 0.72)
    for stop in (293.15, 303.15):  # a constant object, and one that warms
        rng = np.random.default_rng(4)
        scene = simulation.independent_pixels(
            FILM, value, Background(), 40, rng, start=293.15, stop=stop
        )
        capture = simulation.observe(scene, rig.response(), rng)
        result = separation.solve(capture, rig.response())
        apparent = responses.apparent_temperature(rig.response(), capture["counts"])
        found = separation.reflected_change(apparent, result)
        true = 0.14 * (
            scene["background_temperature"] - scene["background_temperature"].mean("time")
        )
        assert found.dims == ("time", "y", "x")
        assert float(found.notnull().all("time").mean()) > 0.95
        error = float(np.sqrt(((found - true) ** 2).mean()))
        print(f"object to {stop} K: {error:.3f} K")
        assert error < 0.02  # [K], of changes of 0.4 K


def test_reflected_change_of_another_band() -> None:
    """Bands in another order raise a ValueError."""
    result = xr.Dataset(coords={"band": ["8-14", "9.5"]})
    apparent = xr.DataArray(np.zeros((2, 1, 1, 1)), dims=("band", "time", "y", "x"))
    with pytest.raises(ValueError, match=r"Invalid first band '9\.5'. Must be '8-14'"):
        separation.reflected_change(apparent.assign_coords(band=["9.5", "8-14"]), result)
