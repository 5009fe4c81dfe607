"""What two cameras record of a twin, each at its own pixels, brought onto the first one's grid."""

from typing import Literal

import numpy as np
import xarray as xr

from dbthermal import alignment, simulation

Registration = Literal["perfect", "found"]


def observe(
    scene: xr.Dataset,
    response: xr.Dataset,
    rng: np.random.Generator,
    registration: Registration = "perfect",
) -> xr.Dataset:
    """
    Capture of a twin, the stage `corrected`: noise at each camera's own pixels, then registration.

    A registration is "perfect", by the surface's geometry: each pixel shows the same point of the
    surface in both bands, NaN where the second camera does not see it, or beside the object; or
    "found" from the pictures, by `alignment.register` and `align`. A scene of one place is that of
    `simulation.observe`.
    """
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
    apart = xr.concat(views, "band", combine_attrs="override")
    transform = alignment.register(apart) if registration == "found" else _by_geometry(scene)
    return alignment.align(apart, offset=0.0, transform=transform)


def _by_geometry(scene: xr.Dataset) -> xr.DataArray:
    """Rows and columns (band, axis, y, x) [pixel] of the surface's points in each view."""
    own = xr.zeros_like(scene["place_in_second"]).copy(data=np.indices(scene["on_object"].shape))
    return xr.concat([own, scene["place_in_second"]], scene["band"])
