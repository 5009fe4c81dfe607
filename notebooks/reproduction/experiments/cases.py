"""Seeded experiments on the separation's accuracy, one simulated case at a time."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.constants import zero_Celsius
from scipy.special import ndtri

from dbthermal import _smooth as smooth
from dbthermal import separation, simulation
from dbthermal._arrays import Array
from dbthermal._numbers import POSITIVE, real_numbers
from dbthermal.simulation import Background, Rig
from reproduction import disturbances
from reproduction.cache import gridded

Case = Mapping[str, Any]

STEPS: Final = 20
"""Steps of the finer clock in a frame, on which bands that are not exposed together are drawn."""

_ORDER: Final = 5  # of the smooth subspace that the efficiency is of
_NEEDED: Final = frozenset({"emissivity", "start", "stop"})
_OPTIONAL: Final = frozenset(
    {"background", "case", "following", "frames", "jump", "noise", "noise_known", "offset"}
    | {"response_kind", "swapped"}
)


def independent_pixels(
    time: Array,
    emissivity: xr.DataArray,
    background: Background,
    pixels: int,
    rng: np.random.Generator,
    *,
    start: float,
    stop: float,
    time_constant: tuple[float, float] = (8.0, 20.0),
) -> xr.Dataset:
    """Scene of one row of pixels of one material, each with its own heating and background.

    Parameters
    ----------
    time, emissivity : ndarray, DataArray
        Times (time,) [s]; emissivity (band) [1].
    background, pixels, rng : Background, int, Generator
        Variation of the background; number of pixels; source of randomness.
    start, stop, time_constant : float, float, tuple of float
        First and last object temperature [K]; range of the heating's time constant [s].
    """
    constants = rng.uniform(*time_constant, pixels)
    warm = simulation.heating(time, start, stop, constants)
    cold = background.draw(time, pixels, rng)
    return simulation.scene(time, warm[:, np.newaxis], cold[:, np.newaxis], emissivity)


@dataclass(frozen=True)
class Jump:
    """Change of the object that is not a smooth curve, as when a palm is laid on a bulb."""

    height: float = 6.0  # permanent change [K]
    between: tuple[float, float] = (10.0, 25.0)  # earliest and latest beginning of a pixel [s]
    duration: float = 0.0  # time in which it is reached, linearly; 0 is sudden [s]

    def __post_init__(self) -> None:
        """Check beginning and duration."""
        if not self.between[0] <= self.between[1]:
            raise ValueError(f"Invalid between {self.between} s of a jump. Must not fall.")
        if not self.duration >= 0:
            raise ValueError(f"Invalid duration {self.duration} s of a jump. Must not be negative.")

    def draw(self, time: Array, pixels: int, rng: np.random.Generator) -> Array:
        """Change (time, pixel) [K] of the object at times [s], one realisation a pixel."""
        elapsed = time[:, np.newaxis] - rng.uniform(*self.between, pixels)
        if self.duration == 0:
            return np.where(elapsed >= 0, self.height, 0.0)
        return np.asarray(self.height * np.interp(elapsed / self.duration, [0.0, 1.0], [0.0, 1.0]))


def scalars(**values: xr.DataArray | float) -> xr.Dataset:
    """Numbers by name, in [1] but for an error of the object temperature [K]."""
    scores = {name: ((), float(value), _unit(name)) for name, value in values.items()}
    return xr.Dataset(scores)


def _unit(name: str) -> dict[str, str]:
    return {"units": "K" if name == "object_temperature_rmse" else "1"}


def score(truth: xr.Dataset, result: xr.Dataset) -> xr.Dataset:
    """Errors of one separation, over the pixels that have a value.

    Of a scene as the truth and a result of `separation.solve`: `object_temperature_rmse` [K], root
    mean square over time, median over pixels; `emissivity_error` (band) [1], median magnitude;
    `object_coverage`, and `emissivity_coverage` (band) [1], share of errors within one standard
    deviation, 0.683 for a calibrated uncertainty; `good` and `with_temperature` [1], share of
    pixels with no flag, and with an object temperature.
    """
    # Errors of the object and of the emissivities, and their intervals of one deviation.
    error = result["object_temperature"] - truth["object_temperature"]
    of_emissivity = abs(result["emissivity"] - truth["emissivity"])
    within = (of_emissivity < result["emissivity_std"]).where(of_emissivity.notnull())
    pixels = ("y", "x")
    scores = {
        "object_temperature_rmse": rmse(error),
        "emissivity_error": of_emissivity.median(pixels),
        "object_coverage": held(error, result["object_temperature_std"], 1.0),
        "emissivity_coverage": within.mean(pixels),
        "good": (result["status"] == 0).mean(),
        "with_temperature": error.notnull().any("time").mean(),
    }
    plain = {name: value.reset_coords(drop=True) for name, value in scores.items()}
    return xr.Dataset({name: value.assign_attrs(_unit(name)) for name, value in plain.items()})


def efficiency(
    truth: xr.Dataset, result: xr.Dataset, noise: tuple[float, float], order: int
) -> float:
    """Scatter of the reflection ratio over its Cramer-Rao bound [1]; 1 is the best possible.

    Robust standard deviation over the pixels of a scene of one material. The noise is that of the
    two bands' signals [K], the order the size of the smooth subspace of
    `ratio_variance_bound`.
    """
    emissivity = truth["emissivity"].values[:, 0, 0]
    background = truth["background_temperature"].values.reshape(truth.sizes["time"], -1)
    functions = smooth.polynomial_basis(truth["time"].values, order)
    pair = (float(emissivity[0]), float(emissivity[1]))
    bound = np.sqrt(ratio_variance_bound(pair, noise, background, functions))
    ratio = reflection_ratio(result["emissivity"].values.reshape(2, -1))
    scaled = (ratio - reflection_ratio(emissivity)) / bound
    scaled = scaled[np.isfinite(scaled)]
    return float(np.diff(np.quantile(scaled, [0.1587, 0.8413]))[0] / 2)


def run_case(
    case: Case, rig: Rig, time: np.ndarray, pixels: int, seed: int
) -> tuple[xr.Dataset, xr.Dataset]:
    """Scene and separation of one case.

    The case as for `simulate`, and `noise_known` (default true) and `response_kind` (default
    "exact") for the separation; times [s].
    """
    scene, capture, response = simulate(case, rig, time, pixels, seed)
    if not case.get("noise_known", True):
        response = response.drop_vars(["noise", "netd"])
    kind = case.get("response_kind", "exact")
    return scene, separation.solve(capture, response, response_kind=kind)


def simulate(
    case: Case, rig: Rig, time: np.ndarray, pixels: int, seed: int
) -> tuple[xr.Dataset, xr.Dataset, xr.Dataset]:
    r"""Scene at the first band's exposures, capture without stamps, and response of one case.

    A case has `emissivity` (one a band [1]), `start` and `stop` of the object [degree Celsius]; and
    optionally: a name `case`; `background`, arguments of `simulation.Background`; `jump` of the
    object, arguments of `Jump`; `following` [1], the c of a background that drifts along with the
    object's own curve, :math:`y(t) + c (x(t) - x(t_0))`; `swapped` (default false): the object then
    moves as the background would, and the other way round; `offset` of the other bands [frame], a
    multiple of 1 / `STEPS`: they are exposed so much later, and the times must be even; `frames`:
    only the first of the times; `noise` of the bands [K], in place of the rig's. ValueError if the
    case has an unknown key, lacks one, or has a value other than described.
    """
    if not case.keys() >= _NEEDED or not case.keys() <= _NEEDED | _OPTIONAL:
        rule = f"Must have {sorted(_NEEDED)}, may have {sorted(_OPTIONAL)}"
        raise ValueError(f"Invalid case with keys {sorted(case)}. {rule}.")
    count, offset = int(case.get("frames", time.size)), case.get("offset", 0.0)
    if not 2 <= count <= time.size:
        raise ValueError(f"Invalid number of frames {count}. Must lie in [2, {time.size}].")
    later = round(offset * STEPS)
    if offset < 0 or abs(later - offset * STEPS) > 1e-9:
        rule = f"Must be zero or positive, a multiple of 1/{STEPS}"
        raise ValueError(f"Invalid offset {offset} frames. {rule}.")
    rng = np.random.default_rng(seed)
    noise = tuple(case.get("noise", rig.noise))
    response = replace(rig, noise=noise).response()
    clock = time = time[:count]
    if later:  # on the finer clock until the last frame of the band that is exposed later
        step = (time[-1] - time[0]) / (time.size - 1) / STEPS
        if not np.allclose(np.diff(time), step * STEPS, rtol=0, atol=1e-6 * step):
            raise ValueError("Invalid times of bands that are exposed apart. Must be even.")
        clock = time[0] + step * np.arange((time.size - 1) * STEPS + later + 1)
    scene = _draw(case, rig.bands, clock, pixels, rng)
    if not later:
        return scene, simulation.observe(scene, response, rng), response
    starts = [0, *[later] * (len(rig.bands) - 1)]
    seen = disturbances.expose(scene, response, rng, every=STEPS, offsets=starts, frames=count)
    first = scene.isel(time=slice(0, (count - 1) * STEPS + 1, STEPS))
    return first, seen.drop_vars("exposure_time"), response


def _draw(
    case: Case, bands: tuple[str, ...], time: Array, pixels: int, rng: np.random.Generator
) -> xr.Dataset:
    """Scene of a case: independent pixels, with the changes of the case."""
    pair = np.asarray(case["emissivity"], dtype=np.float64)
    emissivity = xr.DataArray(pair, dims="band", coords={"band": list(bands)})
    background = Background(**case.get("background", {}))
    ends = {name: case[name] + zero_Celsius for name in ("start", "stop")}
    scene = independent_pixels(time, emissivity, background, pixels, rng, **ends)
    warm, cold = scene["object_temperature"], scene["background_temperature"]
    cold = cold + case.get("following", 0.0) * (warm - warm.isel(time=0))
    if "jump" in case:
        warm = warm + Jump(**case["jump"]).draw(time, pixels, rng)[:, np.newaxis]
    roles = (cold, warm) if case.get("swapped", False) else (warm, cold)
    names = ("object_temperature", "background_temperature")
    films = zip(names, roles, strict=True)
    return scene.assign({name: film.assign_attrs(scene[name].attrs) for name, film in films})


def sweep(cases: Iterable[Case], rig: Rig, time: np.ndarray, pixels: int, seed: int) -> xr.Dataset:
    """Scores (see `score`) and `efficiency` [1] over `case`, all with the same seed."""
    rows, names = [], []
    for case in cases:
        scene, result = run_case(case, rig, time, pixels, seed)
        first, second = case.get("noise", rig.noise)
        scatter = efficiency(scene, result, (first, second), _ORDER)
        rows.append(score(scene, result).assign(efficiency=scatter))
        names.append(str(case["case"]))
    together = gridded(rows, {"case": names})
    return together.assign_attrs(origin="simulated", pixels=pixels, seed=seed)


INTERVAL: Final = float(ndtri(0.975))  # half-width of a 95 % interval, in standard deviations [1]


def rmse(error: xr.DataArray) -> xr.DataArray:
    """Root mean square of an error (time, y, x) over time, median over the pixels with a value."""
    return ((error**2).mean("time") ** 0.5).median()


def held(error: xr.DataArray, std: xr.DataArray, width: float = INTERVAL) -> xr.DataArray:
    """Share of the known errors that lie within so many standard deviations [1]."""
    return (abs(error) < width * std).where(error.notnull()).mean()


def reflection_ratio(emissivity: npt.ArrayLike) -> Array:
    r"""Ratio :math:`k_2 = (1 - e_2) / (1 - e_1)` of the reflections, emissivities (2, ...) [1]."""
    first, second = np.asarray(emissivity, dtype=np.float64)
    return np.asarray((1.0 - second) / (1.0 - first))


def ratio_variance_bound(
    emissivity: tuple[float, float], noise: tuple[float, float], background: Array, functions: Array
) -> Array:
    r"""Cramer-Rao bound of the reflection ratio of two linear bands.

    .. math:: \mathrm{var}(k_2) \ge \frac{s_2^2 + k_2^2 s_1^2}
              {\sum_t [(1 - e_1) P y(t)]^2}

    with P the projection orthogonal to the smooth subspace, spanned by orthonormal functions (time,
    order), in which the object may do anything; emissivities [1] and noise [K] of the two bands,
    background temperature (time, ...) [K]. TypeError or ValueError for other than two numbers, in
    [0, 1] and positive.
    """
    ratio = float(reflection_ratio(real_numbers("emissivity", emissivity, (0.0, 1.0), (2,))))
    real_numbers("noise [K]", noise, POSITIVE, (2,))
    background, functions = real_numbers("background", background), real_numbers("basis", functions)
    rapid = background - np.tensordot(functions, functions.T @ background, axes=1)
    energy = (1.0 - emissivity[0]) ** 2 * np.sum(rapid**2, axis=0)
    return np.asarray((noise[1] ** 2 + (ratio * noise[0]) ** 2) / energy)
