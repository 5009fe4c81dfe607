"""One scene with everything that a rig of two cameras does to it, and the same scene without."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from dbthermal import correction, simulation
from dbthermal.calibration import fit_response
from dbthermal.response import EXACT
from dbthermal.simulation import Rig
from reproduction import disturbances
from reproduction.experiments.cases import held, rmse
from reproduction.experiments.nuisances import GLASS
from reproduction.experiments.pictures import ROOM, Picture, smooth_shift

# Heating that differs from place to place, by so much [1], over so many pixels: the detail.
_UNEVEN, _DETAIL = 0.05, 3.0
_STEPS: Final = 2  # of the scene's clock in a frame


@dataclass(frozen=True)
class Recording:
    """What was recorded, raw; the same scene by a perfect rig; and the truth."""

    capture: xr.Dataset  # raw counts of the scene
    movies: xr.Dataset  # raw counts of the blackbody
    clean: xr.Dataset  # counts of the stage `corrected`
    scene: xr.Dataset


def record(  # noqa: PLR0913 - all that is done to the scene, by name
    shape: Sequence[int],
    clock: Sequence[float],
    seed: int,
    *,
    shift: Sequence[float],
    view: Sequence[int],
    late: int,
    lost: Sequence[float],
    shutter: Sequence[float],
    steps: int,
    frames: int,
) -> Recording:
    """Record people mirrored in unevenly heated glass, `pictures.Picture`, by two cameras.

    The clock is the number of frames and their rate [Hz]. The cameras stand apart, so that the
    second sees the reflections at a `shift` that varies, see `pictures.smooth_shift` [pixel]; it
    looks by `view` to the right and down [pixel], and is exposed `late` halves of a frame later.
    Both shutters close at `shutter`, shares of the capture; `lost` are the shares of each band's
    frames that are replaced by the one before, and of the pixels that are bad. The blackbody has
    so many `steps` of temperature, of so many `frames` each. The clean capture is of one place and
    one clock, with the same noise. All is simulated.
    """
    rng, rig, (count, rate) = np.random.default_rng(seed), Rig(), (int(clock[0]), clock[1])
    right, down = view
    wide = (shape[0] + abs(down), shape[1] + abs(right))
    time = np.arange(_STEPS * (count - 1) + late + 1) / (_STEPS * rate)
    glass = xr.DataArray(list(GLASS), dims="band", coords={"band": list(rig.bands)})
    picture = Picture(shape=wide, walkers=round(0.3 * time[-1]))
    scene = picture.draw(time, glass, rng, smooth_shift(wide, *shift))
    detail = gaussian_filter(rng.standard_normal(wide), _DETAIL)
    heated = xr.DataArray(1.0 + _UNEVEN * detail / detail.std(), dims=("y", "x"))
    scene["object_temperature"] = ROOM + (scene["object_temperature"] - ROOM) * heated
    response = rig.response()
    seen = disturbances.expose(
        scene, response, rng, every=_STEPS, offsets=(0, late), frames=count
    ).drop_vars("exposure_time")
    # The first view begins at the first whole pixel that the second has, too.
    top, first_column = max(-down, 0), max(-right, 0)

    def cropped(wide: xr.Dataset, y: int, x: int) -> xr.Dataset:
        inner = wide.isel(y=slice(y, y + shape[0]), x=slice(x, x + shape[1]))
        return inner.assign_coords(y=np.arange(shape[0]), x=np.arange(shape[1]))

    first, second = (seen.isel(band=[band]) for band in (0, 1))
    views = cropped(first, top, first_column), cropped(second, top + down, first_column + right)
    seen = xr.concat(views, "band", combine_attrs="override")
    truth = cropped(scene.isel(time=slice(0, _STEPS * count, _STEPS)), top, first_column)
    seen = disturbances.spoil_pixels(seen, lost[1], rng).drop_vars("spoiled")
    last = float(seen["time"][-1])
    seen = disturbances.fire_shutter(seen, last * np.array(shutter), rng)
    seen = disturbances.lose_frames(seen, lost[0], rng).drop_vars("repeated")
    detector = simulation.pattern(rig, (shape[0], shape[1]), rng)
    kelvin = np.linspace(rig.lowest + 10.0, rig.highest - 5.0, steps)
    one_place = truth.assign(background_temperature=truth["background_temperature"].isel(band=0))
    return Recording(
        capture=simulation.capture(seen, detector),
        movies=simulation.blackbody_movies(rig, kelvin, frames, detector, rng),
        clean=simulation.observe(one_place, response, rng),
        scene=one_place,
    )


def registration(view: Sequence[int]) -> xr.DataArray:
    """Transform of the second view, see `record`, as measured on a target with detail."""
    matrices = np.stack([np.eye(3), np.eye(3)])
    matrices[1, :2, 2] = -view[0], -view[1]
    bands = {"band": list(Rig().bands)}
    return xr.DataArray(matrices, dims=("band", "row", "column"), coords=bands)


def calibrate(movies: xr.Dataset) -> tuple[xr.Dataset, xr.Dataset]:
    """Correction and response of the movies of an exact blackbody, of cameras that do not drift."""
    statistics = correction.blackbody_statistics(movies)
    fitted = correction.fit_correction(statistics)
    return fitted, fit_response(fitted["level"], statistics["noise"], **EXACT)


def score(scene: xr.Dataset, result: xr.Dataset) -> dict[str, float]:
    """Errors of a result of a scene, by name with unit.

    Of the pixels that are measured, the median over pixels of
    the object's RMSE and the share of 95 % intervals that hold it; these of all that have a value,
    completed or flagged ones too; and the shares of pixels that are measured, and that have one.
    """
    times = {"time": result["time"].values}
    truth = scene["object_temperature"].interp(times, kwargs={"fill_value": "extrapolate"})
    error = result["object_temperature"] - truth.assign_coords(time=result["time"])
    measured, std = result["status"] == 0, result["object_temperature_std"]
    return {
        "object RMSE, measured [K]": float(rmse(error.where(measured))),
        "object RMSE, all [K]": float(rmse(error)),
        "95 % intervals hold, measured [1]": float(held(error.where(measured), std)),
        "95 % intervals hold, all [1]": float(held(error, std)),
        "pixels measured [1]": float(measured.mean()),
        "pixels with a value [1]": float(error.notnull().any("time").mean()),
    }


def findings(scene: xr.Dataset, result: xr.Dataset, rate: float, late: int) -> dict[str, float]:
    """Errors of the clocks' offset and of the shift of the reflections, by name with unit.

    The second camera is exposed `late` halves of a frame later, at a frame rate [Hz].
    """
    # Shift of the reflections, median over the pixels.
    off = result["reflection_shift"] - scene["shift"]
    shifts = {
        f"shift of the reflections, median error along {axis} [pixel]": off.sel(axis=axis).median()
        for axis in ("x", "y")
    }
    # Offset of the second camera's clock, in frames.
    offset = result.attrs["time_offset"][1] * rate - late / 2
    return {"time offset, error [frame]": offset} | {key: float(it) for key, it in shifts.items()}
