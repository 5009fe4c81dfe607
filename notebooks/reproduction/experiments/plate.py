"""Heated plate of two materials, simulated or recorded by notebook 00; and a trial with sliders."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import ipywidgets
import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from scipy.constants import zero_Celsius

from dbthermal import alignment, correction, emissivity, schema, separation, simulation
from dbthermal import response as responses
from dbthermal.instruments.recording import open_capture
from reproduction import paths
from reproduction.experiments import emulated
from reproduction.experiments.cases import held, independent_pixels, rmse
from reproduction.figures.scenes import truth_and_estimate
from reproduction.run import Run

_WIDTH = 1.96  # half-width of the 95 % intervals, in standard deviations [1]


@dataclass(frozen=True)
class Plate:
    """Counts of two bands, corrected, with the response of the bands; and the truth, if known."""

    corrected: xr.Dataset
    response: xr.Dataset
    truth: xr.Dataset | None = None
    reflection_shift: xr.Dataset | None = None  # of cameras side by side

    @property
    def name(self) -> str:
        """Name of the scene, for a title."""
        return "Recorded scene" if self.truth is None else "Twin, a plate of glass and concrete"


def simulated(
    run: Run,
    materials: Sequence[str],
    shape: Sequence[int],
    clock: Sequence[float],
    seed: int,
    **warmth: Any,
) -> Plate:
    """Simulate people who walk by a heated plate, and the raw counts of it, and correct these.

    The materials are side by side; the clock is the number of frames and their rate [Hz]. Warmth
    are arguments of `simulation.walkers`. Detector, correction and response are those of notebook
    01.
    """
    rig, size, rng = simulation.Rig(), (shape[0], shape[1]), np.random.default_rng(seed)
    table = emissivity.embedded_table()["emissivity"].sel(material=materials, band=list(rig.bands))
    # The scene: object, background and emissivities of every pixel.
    time, share = np.arange(clock[0]) / clock[1], simulation.side_by_side(table, size)
    truth = simulation.walkers(time, size, share, rng, **warmth)
    # What the cameras record of it: mixed signals, noise, fixed pattern, whole numbers.
    detector = run.open("01_calibration", "_detector").sel(band=list(rig.bands))
    capture = simulation.capture(simulation.observe(truth, rig.response(), rng), detector)
    calibration, response = _calibration(run)
    return Plate(correction.correct_capture(capture, calibration), response, truth)


def recorded(
    run: Run,
    folder: str,
    taken: Mapping[str, Any],
    time_constant: float | None,
    patch: Sequence[int],
) -> Plate:
    """Open what notebook 00 recorded, correct it, and bring both bands onto one grid and clock.

    Of the recording `name` every n-th frame is taken; `views` is the transform from the second view
    to the first, "translation", "affine" or "homography", none if empty; cameras that stand `apart`
    see the reflections shifted, which looks like an offset in time, so that their stamps are
    trusted. The time constant of the pixels [s] undoes their lag, a patch of constant temperature
    (first row and row after, first column and column after) the cameras' drift.
    """
    # Correct gain, offset, lag and drift of every pixel.
    path = run.input("recorded", paths.root() / folder / f"{taken['name']}.zarr")
    capture = run.read(open_capture, path).isel(time=slice(None, None, taken["every"]))
    calibration, response = _calibration(run)
    reference = None
    if patch:
        reference = xr.zeros_like(calibration["bad"].isel(band=0, drop=True))
        reference[slice(*patch[:2]), slice(*patch[2:])] = True
    corrected = correction.correct_capture(
        capture, calibration, time_constant=time_constant, drift_reference=reference
    )
    # Bring both bands onto one grid and clock; find where the second sees the reflections.
    model, offset = taken["views"], 0.0 if taken["apart"] else None
    transform = alignment.register(corrected, model=model) if model else None
    corrected = alignment.align(corrected, offset=offset, transform=transform)
    shift = alignment.reflection_shift(corrected, response) if taken["apart"] else None
    # The truth at the times of the frames, of emulated cameras.
    scene = emulated.truth(path.parent).get("scene")  # none of hardware
    truth = None if scene is None else emulated.shown(scene, corrected)
    return Plate(corrected, response, truth, shift)


def _calibration(run: Run) -> tuple[xr.Dataset, xr.Dataset]:
    """Correction and response of notebook 01, in the bands of the rig."""
    stem, bands = "01_calibration", {"band": list(simulation.Rig().bands)}
    return run.open(stem, "_correction").sel(bands), run.open(stem, "_response").sel(bands)


def disagreement(apparent: xr.DataArray, status: xr.DataArray) -> tuple[int, int]:
    """Row and column of the pixel without a flag in which two bands disagree most, in the mean."""
    difference = abs(apparent.isel(band=0) - apparent.isel(band=1)).mean("time")
    place = difference.where(status == 0).argmax(("y", "x"))
    return int(place["y"]), int(place["x"])


def readings(
    films: Mapping[str, xr.DataArray | None], pixel: tuple[int, int], times: Sequence[float]
) -> pd.DataFrame:
    """Temperatures [degC] of films (time, y, x) [K] at a pixel and some times [s]; none of None."""
    # Each film at the pixel and at the nearest of its frames.
    place = {"y": pixel[0], "x": pixel[1]}
    curves = {name: film.isel(place) for name, film in films.items() if film is not None}
    shown = {name: line.sel(time=times, method="nearest") for name, line in curves.items()}
    columns = {name: line.values.astype(np.float64) - zero_Celsius for name, line in shown.items()}
    return pd.DataFrame(columns, pd.Index(times, name="time [s]")).round(2)


def known_emissivity(scene: Plate) -> xr.Dataset | None:
    """Separate frame by frame with the true emissivities; None where these are not known."""
    if scene.truth is None:
        return None
    return separation.solve(
        scene.corrected,
        scene.response,
        "calibrated",
        emissivity=scene.truth["emissivity"],
        reflection_shift=scene.reflection_shift,
        settings=separation.CalibratedSettings(False),
    )


def scores(
    scene: Plate, per_pixel: xr.Dataset, whole: xr.Dataset, calibrated: xr.Dataset | None
) -> dict[str, float]:
    """Headline numbers: shares of pixels, and errors and intervals against the truth, if known.

    Of each pixel by itself, in those without a flag; with known emissivities, in the same pixels;
    and of the whole scene, in all that have samples.
    """
    # Shares of pixels without a flag, and of usable samples that have a value.
    good, name = per_pixel["status"] == 0, "object_temperature"
    usable = ~schema.has_flag(whole["status"], "dead_pixel", "invalid_samples")
    value = whole[name].where(usable)
    sampled = scene.corrected["counts"].notnull().all("band") & usable  # that both cameras have
    finite = value.where(sampled).notnull().sum() / sampled.sum()
    shares = {"good_pixels": good.mean(), "whole_finite": finite}
    if scene.truth is None or calibrated is None:
        return {name: float(share) for name, share in shares.items()}
    # Errors of the object, and intervals by the noise alone.
    noise, noise_of_whole = map(separation.without_calibration, (per_pixel, whole))
    error = (per_pixel[name] - scene.truth[name]).where(good)
    of_known = (calibrated[name] - scene.truth[name]).where(good)
    of_whole = value - scene.truth[name]
    values = shares | {
        "twin_rmse_subspace_K": rmse(error),
        "twin_rmse_calibrated_K": rmse(of_known),
        "twin_rmse_whole_K": rmse(of_whole),
        "twin_coverage": held(error, noise[f"{name}_std"], 1.0),
        "twin_coverage_95": held(error, noise[f"{name}_std"], _WIDTH),
        "twin_coverage_95_whole": held(of_whole, noise_of_whole[f"{name}_std"], _WIDTH),
    }
    # Errors of the emissivities, band by band.
    off = abs(per_pixel["emissivity"] - scene.truth["emissivity"]).where(good)
    within = (off <= noise["emissivity_std"]).where(good).mean(("y", "x"))
    for band in off["band"].values:
        values[f"twin_emissivity_error_{band}"] = off.sel(band=band).median()
        values[f"twin_emissivity_coverage_{band}"] = within.sel(band=band)
    return {name: float(value) for name, value in values.items()}


DIFFERENCE: Final = 0.14  # emissivity of 8-14 um less that of 9.5 um, as of plate glass [1]

NOISE: Final = (0.03, 0.35)  # noise of the two bands at the slider's middle [K]

_PIXELS, _FRAMES, _RATE, _SEED = 12, 350, 10.0, 3


@lru_cache
def trial(emissivity: float, noise: float) -> Figure:
    """Truth, estimate and reading of a pixel of an emissivity [1], with so many times the noise."""
    rig = simulation.Rig(noise=(NOISE[0] * noise, NOISE[1] * noise))
    share = xr.DataArray([emissivity, emissivity - DIFFERENCE], {"band": list(rig.bands)}, "band")
    # Simulate, observe and separate a few pixels, of which one is shown.
    time, rng = np.arange(_FRAMES) / _RATE, np.random.default_rng(_SEED)
    pixels, background = independent_pixels, simulation.Background()
    scene = pixels(time, share, background, _PIXELS, rng, start=293.15, stop=333.15)  # [K]
    capture = simulation.observe(scene, rig.response(), rng)
    result = separation.solve(capture, rig.response(), workers=1)
    figure = truth_and_estimate(scene, result, (0, 0))
    reading = responses.apparent_temperature(rig.response(), capture["counts"])[0, :, 0, 0]
    figure.axes[0].plot(time, reading - zero_Celsius, color="0.6", linewidth=0.6, zorder=0)
    first = result.isel(y=0, x=0)
    flags = [bit.label for bit in schema.Status if int(first["status"]) & bit]
    measured = f"{float(first['emissivity'][0]):.3f} +- {float(first['emissivity_std'][0]):.3f}"
    text = f"emissivity {emissivity:.2f}, estimated {measured}; flags: {', '.join(flags) or 'none'}"
    figure.axes[0].set_title(text, fontsize=8)
    return figure


def sliders() -> ipywidgets.Widget:
    """Sliders of the emissivity and of the noise over a `trial`."""
    emissivity = ipywidgets.FloatSlider(0.86, min=0.2, max=0.96, step=0.02, continuous_update=False)
    noise = ipywidgets.FloatSlider(1.0, min=0.2, max=5.0, step=0.2, continuous_update=False)
    return ipywidgets.interactive(trial, emissivity=emissivity, noise=noise)
