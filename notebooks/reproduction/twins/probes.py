"""Virtual thermocouples: where they are, and what they read."""

import numpy as np
import xarray as xr

from dbthermal import schema
from dbthermal.simulation._mesh import Surface
from dbthermal.simulation._rays import Array, Point


def on_wall(surface: Surface, height: float, angle: float) -> Point:
    """
    Point on the wall of a surface of revolution.

    Parameters
    ----------
    surface : Surface
        Turned about the z axis.
    height : float
        Height [m]; the nearest ring of vertices is taken.
    angle : float
        Angle about the axis, from negative y towards positive x [degrees].

    Returns
    -------
    tuple of float
        x, y, z [m], on that ring.
    """
    x, y, ring = surface.vertices[np.argmin(np.abs(surface.vertices[:, 2] - height))]
    radius, turn = float(np.hypot(x, y)), np.radians(angle)
    return radius * float(np.sin(turn)), -radius * float(np.cos(turn)), float(ring)


def thermocouple_readings(
    scene: xr.Dataset,
    rng: np.random.Generator,
    *,
    std: float = 0.05,
    offset_std: float = 0.1,
    bead: int = 3,
) -> xr.DataArray:
    """
    What the virtual thermocouples of a twin read.

    Parameters
    ----------
    scene : Dataset
        From a twin.
    rng : Generator
        Source of the errors.
    std : float
        Standard deviation of a single reading [K].
    offset_std : float
        Standard deviation of a probe's constant error [K]; 0.1 is a probe that was compared with
        a reference, 0.5 one that was not.
    bead : int
        Pixels along a side of the square that a bead covers; odd.

    Returns
    -------
    DataArray
        Readings (thermocouple, time) [K]: the mean over the bead, with both errors.

    Raises
    ------
    ValueError
        If the bead is not odd and positive, or reaches beyond the object.
    """
    if bead < 1 or bead % 2 == 0:
        raise ValueError(f"Invalid bead {bead} pixels. Must be odd and positive.")
    readings = [
        _bead_mean(scene, int(row), int(column), bead // 2)
        for row, column in zip(scene["thermocouple_y"], scene["thermocouple_x"], strict=True)
    ]
    size = (len(readings), scene.sizes["time"])
    error = rng.normal(0.0, offset_std, (len(readings), 1)) + rng.normal(0.0, std, size)
    return xr.DataArray(
        np.reshape(readings, size) + error,
        dims=("thermocouple", "time"),
        coords={"time": scene["time"]},
        attrs=schema.STAGES["separated"]["object_temperature"].attrs,
        name="thermocouple_temperature",
    )


def _bead_mean(scene: xr.Dataset, row: int, column: int, reach: int) -> Array:
    """Mean object temperature (time,) [K] over a square of pixels."""
    square = {
        "y": slice(row - reach, row + reach + 1),
        "x": slice(column - reach, column + reach + 1),
    }
    on = scene["on_object"].isel(square)
    if min(row, column) < reach or on.size < (2 * reach + 1) ** 2 or not on.all():
        raise ValueError(
            f"Invalid thermocouple at row {row}, column {column}: its bead reaches beyond the "
            "object. Must lie on it."
        )
    return np.asarray(scene["object_temperature"].isel(square).mean(("y", "x")).values)
