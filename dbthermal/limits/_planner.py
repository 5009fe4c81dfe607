"""Accuracy to expect of a capture before it is recorded, and the filter to record it with."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, bands, mixing, planck, schema
from dbthermal._arrays import Array
from dbthermal.limits._fisher import TEMPERATURES, TopHat, Truth, deviations, smallest_order

_NO_FILTER: Final = "none"  # entry of a material whose temperature no filter determines
_TIME_CONSTANT: Final = 1.0 / 3.0  # of the object's warming, as a share of the capture
SKY_LEVEL: Final = 273.15  # of what is mirrored outdoors, at rest [K]
SKY: Final = {"8-14": 1.0, "8.5": 1.22, "9.5": 1.47, "10.6": 1.34, "12.1": 0.64}
"""Changes of a band over those in 8-14 um as clouds pass, of spectra from the interferometer of the
Atmospheric Radiation Measurement user facility (radiances, notebook 15)."""
_MOST_FRAMES: Final = 100_000  # they take some seconds a material


@dataclass(frozen=True)
class CaptureDesign:
    """Capture conditions: a warming object before a background of regular pulses.

    The object's time constant is a third of the capture. The background rests, and is warmer at the
    end of each period.

    TypeError or ValueError if one is not finite, or not positive (all but `span` and `amplitude`),
    a pulse is longer than the period, or there are fewer than two frames or more than 100 000.

    Attributes
    ----------
    seconds, rate : float
        Length [s], and frame rate [1/s].
    start, span : float
        First temperature of the object, and its rise until the last frame [K].
    level, amplitude : float
        Temperature of the background at rest, and height of a pulse [K].
    period, duration : float
        From pulse to pulse, and of one pulse [s].
    """

    seconds: float = 35.0
    rate: float = 10.0
    start: float = 293.15
    span: float = 25.0
    level: float = 295.15
    amplitude: float = 3.0
    period: float = 5.0
    duration: float = 2.0

    def __post_init__(self) -> None:
        limits = dict.fromkeys(("start", "level"), _numbers.KELVIN)
        limits |= dict.fromkeys(("span", "amplitude"), _numbers.FINITE)
        for name, value in vars(self).items():
            _numbers.real_number(name, value, limits.get(name, _numbers.POSITIVE))
        if self.duration > self.period:
            rule = f"Must be at most the period, {self.period} s"
            raise ValueError(f"Invalid duration {self.duration} s of a pulse. {rule}.")
        if not 1.5 <= self.seconds * self.rate <= _MOST_FRAMES:
            rule = f"Must have two frames to {_MOST_FRAMES}: plan a shorter one, or a lower rate"
            raise ValueError(f"Invalid capture of {self.seconds} s at {self.rate} 1/s. {rule}.")


def plan(
    table: xr.Dataset,
    noise: xr.DataArray,
    design: CaptureDesign | None = None,
    *,
    beside: str | None = None,
    together: int = 1,
    temperature: float = 300.0,
    outdoors: bool = False,
) -> xr.Dataset:
    r"""Expected accuracy of one pixel for each material and filter, and the best filter.

    The Cramer-Rao bound of `bounds` for a designed capture, with Planck's law over each band. The
    emissivity errors of n pixels of one material fall as :math:`1 / \sqrt{n}`.

    Parameters
    ----------
    table, noise : Dataset, DataArray
        Stage `emissivity_table`, of bands of `bands.FILTERS`: the camera's own and filters; noise
        (band) [K] of every band of it, such as from `emissivity.filter_noise`.
    design : CaptureDesign, optional
        Capture conditions; 35 s of an object that warms by 25 K if not given, outdoors below a sky
        of 273 K.
    beside, together : str, int, optional
        Name of the band that is always recorded ("8-14", outdoors "10.6" as in the air's window),
        and number of filters recorded beside it at once.
    temperature, outdoors : float, bool
        Temperature [K] at which the noise is stated (in counts it is the same at all); True if the
        sky is mirrored, whose changes in the bands are not alike (`SKY`).

    Returns
    -------
    Dataset
        Over (material, filter), combinations joined by " + ": `object_temperature_std`,
        `background_temperature_std` [K], root mean square over time, and `condition_number` [1].
        Over (material, filter, band): `emissivity_std`, and `reflection_ratio_std` over the band
        `beside` [1]; NaN for a band outside the combination. `best` (material): the filter of the
        smallest object deviation, "none" if all are above that of a uniform number within the
        capture's temperatures. `noise` (band) [K], and the design's numbers as attributes.
        Outdoors also `sky_error` (material, filter) [K], of an object before a sky that is taken
        for gray, :math:`|x - y| \sum_m w_m (1 - e_m) (g_m / g_1 - 1)` with the weights w of the
        bands in the object; the best filter has the smallest root of both squares.

    Raises
    ------
    KeyError, TypeError, ValueError
        If table or noise are not as `schema` has them, a band is unknown, an emissivity lies
        outside (0, 1), or the band `beside` or as many others as used together are missing.

    Examples
    --------
    >>> from dbthermal import emissivity, limits
    >>> table = emissivity.embedded_table().sel(material=["plate window glass", "brass plate"])
    >>> noise = emissivity.filter_noise(0.03, table["band"].values.tolist())
    >>> limits.plan(table, noise)["best"].values.tolist()
    ['9.5', 'none']
    """
    outdoors = _numbers.truth_value("outdoors", outdoors)
    if design is None:
        design = CaptureDesign(level=SKY_LEVEL) if outdoors else CaptureDesign()
    if not isinstance(design, CaptureDesign):
        raise TypeError(f"Invalid design {design!r}. Must be a CaptureDesign.")
    beside = beside or ("10.6" if outdoors else "8-14")
    emissivity = _emissivities(table)
    names = [str(name) for name in table["band"].values]
    if beside not in names or len(names) < 2:
        raise ValueError(f"Missing band '{beside}', or a second one, of {names}. Must be there.")
    # Combinations of filters beside the band that is always recorded.
    filters = [place for place, name in enumerate(names) if name != beside]
    together = _numbers.whole_number("together", together, (1, len(filters)))
    sets = [[names.index(beside), *chosen] for chosen in combinations(filters, together)]
    std = planck.require_positive("noise [K]", schema.band_values(noise, names, "the noise", "K"))
    bodies = [TopHat(bands.get(name), temperature) for name in names]
    # Deviations of each combination for every material.
    truths = [_truth(design, emissivity[chosen]) for chosen in sets]
    cases = []  # temperatures (material), other quantities (band, material)
    for truth, chosen in zip(truths, sets, strict=True):
        behind, noises = [bodies[band] for band in chosen], std[chosen]
        order = smallest_order(truth, truth.sensitivity(behind, noises))
        sensitivity = truth.smoothed(order).sensitivity(behind, noises)
        stds = deviations(sensitivity, truth.time, order, reference=0)
        for name in TEMPERATURES:
            # One number for all frames: the root of their mean square.
            stds[name] = np.sqrt(np.mean(stds[name] ** 2, axis=0))
        stds["condition_number"] = mixing.condition_number(truth.emissivity.T)
        cases.append(stds)
    labels = [" + ".join(names[place] for place in chosen[1:]) for chosen in sets]
    result = _dataset(table, labels, cases, sets)
    temperatures = [truths[0].object_temperature, truths[0].background_temperature]
    # Best filter of each material, if its deviation is below that of a uniform temperature.
    uniform = float(np.ptp(temperatures)) / np.sqrt(12.0)
    total = result["object_temperature_std"].values
    if outdoors:
        contrast = np.sqrt(np.mean((temperatures[0] - temperatures[1]) ** 2))
        errors = [contrast * _sky(emissivity[it], std[it], [names[b] for b in it]) for it in sets]
        attrs = {"units": "K", "long_name": "error by a sky that is taken for gray"}
        result["sky_error"] = ("material", "filter"), np.stack(errors, axis=1), attrs
        total = np.hypot(total, result["sky_error"].values)
    best = [labels[int(np.argmin(row))] if np.min(row) < uniform else _NO_FILTER for row in total]
    return result.assign(
        best=("material", best, {"long_name": "filter of the smallest object deviation"}),
        noise=("band", std, {"units": "K", "long_name": "noise-equivalent temperature difference"}),
    ).assign_attrs(vars(design), beside=beside, origin="simulated")


def plan_durations(
    table: xr.Dataset,
    noise: xr.DataArray,
    seconds: Sequence[float],
    design: CaptureDesign | None = None,
) -> xr.Dataset:
    """Expected accuracy of captures of several lengths, of one filter at a time.

    Parameters
    ----------
    table, noise
        See `plan`.
    seconds, design : sequence of float, CaptureDesign
        Lengths [s], which must increase; all other conditions, the same for all lengths.

    Returns
    -------
    Dataset
        As from `plan`, with `seconds` [s] as the first dimension; `noise` is the same in all.

    Examples
    --------
    Plate glass, recorded for 10 s and for 40 s:

    >>> from dbthermal import emissivity, limits
    >>> table = emissivity.embedded_table()
    >>> glass = table.sel(material=["plate window glass"], band=["8-14", "9.5"])
    >>> noise = emissivity.filter_noise(0.03, ["8-14", "9.5"])
    >>> expected = limits.plan_durations(glass, noise, [10.0, 40.0])
    >>> expected["object_temperature_std"].squeeze().values.round(1).tolist()  # K
    [0.4, 0.2]
    """
    design = CaptureDesign() if design is None else design
    lengths = _numbers.real_numbers("seconds", seconds)
    if lengths.ndim != 1 or lengths.size == 0 or np.any(np.diff(lengths) <= 0):
        raise ValueError(f"Invalid seconds {lengths.tolist()}. Must increase strictly.")
    plans = [plan(table, noise, replace(design, seconds=float(length))) for length in lengths]
    coordinate = xr.DataArray(lengths, dims="seconds", name="seconds", attrs={"units": "s"})
    without_noise = [expected.drop_vars("noise") for expected in plans]
    result = xr.concat(without_noise, dim=coordinate, combine_attrs="drop_conflicts")
    return result.assign(noise=plans[0]["noise"])


def _truth(design: CaptureDesign, emissivity: Array) -> Truth:
    """One pixel of each material (band, material); the background rests between the pulses."""
    time = np.arange(round(design.seconds * design.rate)) / design.rate
    rise = np.expm1(-time / (_TIME_CONSTANT * time[-1])) / np.expm1(-1.0 / _TIME_CONSTANT)
    # Half a frame later than its stamp, so that rounding decides on no frame.
    phase = np.mod(time + 0.5 / design.rate, design.period)
    pulse = phase > design.period - design.duration
    materials = np.ones(emissivity.shape[1])
    temperature = np.outer(design.start + design.span * rise, materials)
    background = np.outer(design.level + design.amplitude * pulse, materials)
    resting = np.outer(~pulse, materials.astype(bool))
    return Truth(time, temperature, background, emissivity, resting)


def _sky(emissivity: Array, noise: Array, names: list[str]) -> Array:
    """Error of the object (material) by the sky's colour in some bands, for a contrast of 1 K."""
    if lacking := [name for name in names if name not in SKY]:
        raise ValueError(f"Missing band '{lacking[0]}' in the sky. Must be one of {[*SKY]}.")
    colour = np.array([SKY[name] / SKY[names[0]] for name in names]) - 1.0
    errors = []
    for value in emissivity.T:  # weights of the bands in the object, by least squares
        weights = np.linalg.pinv(np.stack([value, 1.0 - value], axis=1) / noise[:, np.newaxis])[0]
        errors.append(abs(np.sum(weights / noise * (1.0 - value) * colour)))
    return np.array(errors)


def _emissivities(table: xr.Dataset) -> Array:
    """Emissivity (band, material) of a table, in (0, 1)."""
    values = schema.check(table, "emissivity_table")["emissivity"]
    for row, column in np.argwhere(~((values.values > 0) & (values.values < 1))):
        material, band = values["material"].values[row], values["band"].values[column]
        label = f"Invalid emissivity {values.values[row, column]} of '{material}' in band '{band}'"
        raise ValueError(f"{label}. Must lie in (0, 1).")
    return np.asarray(values.values.T, dtype=np.float64)


def _dataset(
    table: xr.Dataset, labels: list[str], cases: list[dict[str, Array]], sets: list[list[int]]
) -> xr.Dataset:
    """Deviations of all combinations, side by side."""
    size = (table.sizes["material"], len(labels))
    variables = {}
    for quantity in cases[0]:
        name = quantity if quantity == "condition_number" else f"{quantity}_std"
        units = "K" if quantity in TEMPERATURES else "1"
        attrs = {"units": units, "long_name": f"expected {name.replace('_', ' ')}"}
        dims = ["material", "filter"]
        if cases[0][quantity].ndim == 1:
            values = np.stack([case[quantity] for case in cases], axis=1)
        else:
            dims, values = [*dims, "band"], np.full((*size, table.sizes["band"]), np.nan)
            for place, (case, chosen) in enumerate(zip(cases, sets, strict=True)):
                values[:, place, chosen] = case[quantity].T
        variables[name] = (dims, values, attrs)
    coords = {"material": table["material"].values, "filter": labels, "band": table["band"].values}
    return xr.Dataset(variables, coords)
