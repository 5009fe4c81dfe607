"""Scenes with known truth, from Planck's law by a quadrature of their own.

Nothing here imports the package: counts of two to five bands, of a body that warms up while bodies
pass before it, in the image formation e U(x) + (1 - e) U(y).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.interpolate import CubicSpline

Array = npt.NDArray[np.float64]

EDGES: Final = {"8-14": (8.0, 14.0), "9.5": (9.25, 9.75), "10.6": (9.85, 11.35)}
EDGES.update({"8.5": (8.25, 8.75), "12.1": (11.85, 12.35)})
"""Edges of the bands [um]."""

SLOPE: Final = 110.0
"""Counts for each kelvin at 300 K in every band, as behind a lens of its own gain [count/K]."""
BLACK: Final = 6000.0
"""Counts at 0 radiance [count]."""
CALIBRATED: Final = np.linspace(263.15, 373.15, 12)
"""Temperatures of the blackbody [K]."""


@cache
def _spline(band: str) -> CubicSpline:
    """Counts over temperature: Simpson's rule over the band, at every kelvin."""
    low, high = EDGES[band]
    wavelength = np.linspace(low, high, 401) * 1e-6
    weights = np.ones(401)
    weights[1:-1:2], weights[2:-1:2] = 4, 2
    temperature = np.arange(200.0, 460.0)
    exponent = 0.014387768775 / (wavelength[:, None] * temperature)
    radiance = weights @ (1 / (wavelength[:, None] ** 5 * np.expm1(exponent)))
    curve = CubicSpline(temperature, radiance)
    return CubicSpline(temperature, BLACK + radiance * SLOPE / curve(300.0, 1))


def counts_of(band: str, temperature: npt.ArrayLike) -> Array:
    """Counts of a blackbody in a band."""
    return np.asarray(_spline(band)(np.asarray(temperature)))


def leaving(band: str, emissivity: npt.ArrayLike, warm: Array, cold: Array) -> Array:
    """Counts of what leaves an object and is seen in a band."""
    share = np.asarray(emissivity)
    return share * counts_of(band, warm) + (1 - share) * counts_of(band, cold)


def blackbody(bands: tuple[str, ...], temperature: Array = CALIBRATED) -> xr.DataArray:
    """Counts (band, temperature) of a blackbody."""
    return xr.DataArray(
        [counts_of(band, temperature) for band in bands],
        dims=("band", "temperature"),
        coords={"band": list(bands), "temperature": temperature},
        attrs={"units": "count"},
    )


@dataclass
class Scene:
    """Truth of a capture, and the capture."""

    bands: tuple[str, ...]
    time: Array  # of the exposures [s]
    warm: Array  # object temperature (time, y, x) [K]
    cold: Array  # background temperature (time, y, x) [K]
    emissivity: Array  # (band, y, x) [1]
    noise: Array  # (band) [count]
    delay: float = 0.0  # of the exposures of all bands but the first [s]
    capture: xr.Dataset = field(default_factory=xr.Dataset)

    @property
    def known(self) -> xr.DataArray:
        """Emissivity (band, y, x)."""
        dims = ("band", "y", "x")
        return xr.DataArray(self.emissivity, dims=dims, coords={"band": list(self.bands)})

    def counts(self) -> npt.NDArray[Any]:
        """Copy of the counts, to spoil."""
        return np.array(self.capture["counts"].values)

    def with_counts(self, counts: npt.NDArray[Any]) -> xr.Dataset:
        """The capture with spoilt counts."""
        array = self.capture["counts"]
        return self.capture.assign(counts=(array.dims, counts, array.attrs))

    def put(self, place: Any, value: Any) -> xr.Dataset:
        """The capture with values at a place of the counts."""
        counts = self.counts()
        counts[place] = value
        return self.with_counts(counts)

    def clean(self) -> Array:
        """Counts without noise, of exposures at one moment."""
        parts = zip(self.bands, self.emissivity, strict=True)
        return np.stack([leaving(band, e, self.warm, self.cold) for band, e in parts])

    def film(self, counts: npt.NDArray[Any], **coords: Any) -> "Scene":
        """The scene with a capture of some counts."""
        self.capture = xr.Dataset(
            {"counts": (("band", "time", "y", "x"), counts.astype("f4"), {"units": "count"})},
            {"band": list(self.bands), "time": ("time", self.time, {"units": "s"}), **coords},
            {"origin": "simulated"},
        )
        return self


def pick(rng: np.random.Generator, options: Sequence[Any]) -> Any:
    """One of some options, of any types."""
    return options[int(rng.integers(len(options)))]


def clock(frames: int, rate: float = 10.0) -> Array:
    """Even times [s]."""
    return np.arange(frames) / rate


def _films(seed: int, time: Array, grid: Array, delay: float = 0.0) -> tuple[Array, Array]:
    """Object and background (time, pixel) [K], the same of one seed, some time later."""
    rng, start = np.random.default_rng(seed), float(time.min())
    length = max(float(np.ptp(time)), 1e-9)
    moved = time - start + delay
    # A body that warms up smoothly, by a little more on one side.
    rate = rng.uniform(0.5, 2.5)
    rise = rng.uniform(10, 35) * -np.expm1(-rate * moved / length) / -np.expm1(-rate)
    warm = rng.uniform(293, 300) + rise[:, None] * (1 + 0.1 * grid)
    # A room through which bodies pass, seen by each pixel at its own moment.
    cold = np.full(warm.shape, rng.uniform(290, 297))
    period = min(4.0, length / 5)
    for place in np.unique((time - start) // period)[:-1] * period:
        begin = place + 0.3 * period + rng.uniform(0, 0.3) * period + 0.15 * period * grid
        end, height = begin + rng.uniform(0.15, 0.35) * period, rng.uniform(3, 9)
        near = (moved > begin[0] - period) & (moved < end[-1] + period)
        seconds, edge = moved[near, None], 0.06 * period
        up = np.tanh((seconds - begin) / edge) - np.tanh((seconds - end) / edge)
        cold[near] += 0.5 * height * up
    return warm, cold


def scene(
    rng: np.random.Generator,
    *,
    bands: int = 2,
    shape: tuple[int, int] = (8, 12),
    time: Array | None = None,
    ratio: float | None = None,
    emissivity: Array | None = None,
    delay: float = 0.0,
) -> Scene:
    """Scene of one material, 160 frames by default, and its capture in float32."""
    names = tuple(EDGES)[:bands]
    time = clock(160) if time is None else time
    if emissivity is None:
        first = rng.uniform(0.6, 0.95)
        emissivity = first - np.append(0.0, rng.uniform(0.08, 0.3, bands - 1))
        emissivity = np.clip(emissivity, 0.3, 0.97)
    ratio = float(np.exp(rng.uniform(0, np.log(30)))) if ratio is None else ratio
    quiet = rng.uniform(0.02, 0.06)
    noise = SLOPE * quiet * np.append(1.0, rng.uniform(1, ratio, bands - 1))
    noise[1] = SLOPE * quiet * ratio
    grid = np.linspace(0, 1, shape[0] * shape[1])
    seed = int(rng.integers(2**31))
    warm, cold = _films(seed, time, grid)
    late = _films(seed, time, grid, delay) if delay else (warm, cold)
    counts = np.empty((bands, *warm.shape))
    for place, band in enumerate(names):
        counts[place] = leaving(band, emissivity[place], *(late if place else (warm, cold)))
        counts[place] += rng.normal(0, noise[place], warm.shape)
    warm, cold = (film.reshape(-1, *shape) for film in (warm, cold))
    maps = np.broadcast_to(emissivity[:, None, None], (bands, *shape)).copy()
    made = Scene(names, time, warm, cold, maps, noise, delay)
    return made.film(counts.reshape(bands, -1, *shape))
