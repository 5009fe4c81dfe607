"""Pictures: simulated scenes of an object that mirrors people who walk by, with known truth.

What is mirrored is a function of place and time without steps, sharper than no lens would draw it,
so that it may be seen from two places: nothing aliases.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import simulation
from dbthermal._arrays import Array

ROOM: Final = 295.15  # temperature of the room [K]
_RISE: Final = 2.0 * np.log(9.0)  # logistic steps from 10 to 90 % take so many of their scales


@dataclass(frozen=True)
class Picture:
    """What is drawn."""

    shape: tuple[int, int] = (72, 96)  # rows and columns
    walkers: int = 9  # who walk by; each of a size, height, speed and temperature of its own
    warmer: tuple[float, float] = (3.0, 8.0)  # than the room are they, from and to [K]
    sharpness: float = 0.7  # width of a silhouette's edge, a logistic step's scale [pixel]
    hottest: float = 333.15  # object at its hottest [K]
    # Times from 10 to 90 % of the heating by a front that climbs from the lowest row to the
    # highest, drawn for each column [s]; if not given, the object is heated smoothly.
    rise: tuple[float, float] | None = None
    still: float = 0.0  # share of the columns, from the left, without motion in the reflection [1]

    def draw(
        self,
        time: Array,
        emissivity: xr.DataArray,
        rng: np.random.Generator,
        shift: Array | None = None,
    ) -> xr.Dataset:
        """Scene, see `simulation.scene`; its background is (band, time, y, x) with a shift.

        The shift (2, y, x) [pixel] is where the first band shows what the others show here: rows
        down and columns to the right, :math:`y_2(p) = y_1(p + d(p))`.
        """
        rows, columns = np.indices(self.shape, dtype=np.float64)
        warm = self._object(time, rng)
        mirror = self._mirror(time, rng)
        cold = mirror(rows, columns)
        scene = simulation.scene(time, warm, cold, emissivity)
        if shift is None:
            return scene
        moved = mirror(rows + shift[0], columns + shift[1])
        views = [cold] + [moved] * (emissivity.sizes["band"] - 1)
        background = scene["background_temperature"]
        variable = (("band", *background.dims), np.stack(views), background.attrs)
        scene["background_temperature"] = variable
        units = {"units": "pixel", "long_name": "where the first band shows the reflection"}
        scene["shift"] = (("axis", "y", "x"), shift, units)
        return scene.assign_coords(axis=["y", "x"])

    def _object(self, time: Array, rng: np.random.Generator) -> Array:
        """Object temperature (time, y, x) [K]."""
        rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in self.shape), indexing="ij")
        if self.rise is None:
            middle = rng.uniform(-0.4, 0.4, 2)
            spot = np.exp(-((rows - middle[0]) ** 2 + (columns - middle[1]) ** 2) / 0.7)
            curve = simulation.heating(time, 0.0, 1.0, rng.uniform(8.0, 20.0))
            return np.asarray(ROOM + (self.hottest - ROOM) * curve[:, None, None] * spot)
        # The front leaves the lowest row after a tenth of the time, and is up at nine tenths.
        span, place = time[-1] - time[0], np.linspace(0.9, 0.1, self.shape[0])[:, np.newaxis]
        wave = 0.05 * np.sin(2.0 * np.pi * (columns[:1] + rng.random()))
        arrival = time[0] + span * (place + wave)
        scale = np.interp(columns[0], np.linspace(-1, 1, 7), rng.uniform(*self.rise, 7)) / _RISE
        level = (self.hottest - ROOM) * (0.8 + 0.2 * np.cos(2.0 * columns + 1.3 * rows))
        step = 0.5 * (1.0 + np.tanh(0.5 * (time[:, None, None] - arrival) / scale))
        return np.asarray(ROOM + level * step)

    def _mirror(self, time: Array, rng: np.random.Generator) -> Callable[[Array, Array], Array]:
        """Function of rows and columns (y, x) [pixel] to what they mirror (time, y, x) [K]."""
        height, width = self.shape
        span = time[-1] - time[0]
        places = np.arange(self.walkers) + rng.random(self.walkers)
        starts = time[0] + span * places / self.walkers
        people = []
        for start in starts:
            direction, crossing = rng.choice([-1.0, 1.0]), rng.uniform(1.5, 5.0)  # [s]
            half = width * rng.uniform(0.06, 0.2)
            reach = width / 2.0 + 2.0 * half
            x = width / 2.0 + direction * reach * (2.0 * (time - start) / crossing)
            steps = np.sin(2.0 * np.pi * (time - start) / 0.5)
            y = height * rng.uniform(0.35, 0.75) + 0.03 * height * steps
            people.append((x, y, half, height * rng.uniform(0.25, 0.6), rng.uniform(*self.warmer)))
        edge = self.still * width

        def mirrored(rows: Array, columns: Array) -> Array:
            result = np.full((time.size, *rows.shape), ROOM)
            for x, y, half, tall, warmer in people:
                # Frames in which it is near enough to be more than rounding.
                away = np.maximum(columns.min() - x, x - columns.max()) / half - 1.0
                seen = np.flatnonzero(away * min(half, tall) < 50.0 * self.sharpness)
                u = (columns - x[seen, None, None]) / half
                v = (rows - y[seen, None, None]) / tall
                # Distance from the outline of an ellipse, to first order [pixel].
                radius = np.hypot(u, v) + 1e-9
                slope = np.hypot(u / half, v / tall) / radius
                outside = (radius - 1.0) / slope
                share = 1.0 / (1.0 + np.exp(np.clip(outside / self.sharpness, -50.0, 50.0)))
                warmth = warmer * (1.0 + 0.3 * np.sin(3.0 * u + 1.0) * np.cos(4.0 * v))
                result[seen] += (warmth + ROOM - result[seen]) * share
            if edge:
                result = ROOM + (result - ROOM) / (1.0 + np.exp((edge - columns) / 0.7))
            return result

        return mirrored


def smooth_shift(shape: tuple[int, int], shift: float, varying: float) -> Array:
    """Shift (2, y, x) [pixel] to the right, which varies by so much from the middle to the side."""
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    along = shift + varying * (columns**2 - 0.5 + 0.3 * rows * columns)
    across = 0.15 * varying * (rows - 0.5 * columns)
    return np.stack([across, along])
