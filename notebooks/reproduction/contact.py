"""Simulated readings of an emissivity bench: thermocouple, reflected blackbody and counts."""

import numpy as np
import xarray as xr

from dbthermal import mixing, schema
from dbthermal import response as responses


def contact_measurements(
    response: xr.Dataset,
    emissivity: xr.DataArray,
    object_temperature: np.ndarray,
    background_temperature: np.ndarray,
    stds: tuple[float, float],
    rng: np.random.Generator,
) -> xr.Dataset:
    """Readings for the calibration of an emissivity: thermocouple, blackbody and counts.

    ValueError if a temperature lies outside the response, or the emissivity lacks a band.

    Parameters
    ----------
    response : Dataset
        With `noise`.
    emissivity : DataArray
        True emissivity (band) [1].
    object_temperature, background_temperature : ndarray, shape (measurement,)
        True temperatures [K].
    stds : tuple of float
        Standard deviation of a reading of thermocouple and blackbody [K].
    rng : Generator
        Source of the errors.

    Returns
    -------
    Dataset
        `counts` (band, measurement) [count]; `object_temperature`, `background_temperature`
        (measurement) [K], as read.
    """
    names = [str(name) for name in response["band"].values]
    places = schema.band_positions(emissivity, names, "the emissivity")
    true = {
        "object_temperature": object_temperature,
        "background_temperature": background_temperature,
    }
    emitted, reflected = (
        responses.counts(response, xr.DataArray(level, dims="measurement")).values
        for level in true.values()
    )
    clean = mixing.leaving(emissivity.values[places][:, np.newaxis], emitted, reflected)
    noise = responses.noise(response, names)[:, np.newaxis] * rng.standard_normal(clean.shape)
    read = {
        name: ("measurement", level + rng.normal(0, std, len(level)), {"units": "K"})
        for (name, level), std in zip(true.items(), stds, strict=True)
    }
    counts = (("band", "measurement"), clean + noise, {"units": "count"})
    return xr.Dataset({"counts": counts, **read}, {"band": names}, {"origin": "simulated"})
