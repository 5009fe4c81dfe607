"""What two cameras record of a twin, each at its own pixels, brought onto the first one's grid."""

from typing import Literal

import numpy as np
import xarray as xr

from dbthermal import alignment, simulation

Registration = Literal["perfect", "found"]


def observe(scene: xr.Dataset, response: xr.Dataset, rng: np.random.Generator) -> xr.Dataset:
    """Capture of a twin, as `simulation.observe`: each band at the pixels of its own camera."""
    if not scene.attrs["baseline"]:
        return simulation.observe(scene, response, rng)
    second = scene.assign(
        {
            f"{name}_temperature": scene[f"second_{name}_temperature"]
            for name in ("object", "background")
        }
    )
    views = [
        simulation.observe(view, response.isel(band=[band]), rng)
        for band, view in enumerate((scene, second))
    ]
    return xr.concat(views, "band", combine_attrs="override")


def registered(
    scene: xr.Dataset, corrected: xr.Dataset, registration: Registration = "perfect"
) -> xr.Dataset:
    """Capture with all views on the first camera's grid, by `alignment.align`.

    A registration is "perfect", by the surface's geometry: each pixel shows the same point of the
    surface in both bands, NaN where the second camera does not see it, and beside the object; or
    "found" from the pictures, by `alignment.register`. The views of one place stay as they are.
    """
    if not scene.attrs["baseline"]:
        return corrected
    by_geometry = registration == "perfect"
    transform = _by_geometry(scene) if by_geometry else alignment.register(corrected)
    return alignment.align(corrected, offset=0.0, transform=transform)


def _by_geometry(scene: xr.Dataset) -> xr.DataArray:
    """Rows and columns (band, axis, y, x) [pixel] of the surface's points in each view."""
    own = xr.zeros_like(scene["place_in_second"]).copy(data=np.indices(scene["on_object"].shape))
    return xr.concat([own, scene["place_in_second"]], scene["band"])
