r"""Statistical limits: the best accuracy that a capture allows, and how to plan one.

`bounds` are the Cramer-Rao bounds of a known truth, for the exact response and any number of bands;
`plan` applies them to materials, filters and seconds of video. The image formation is that of
Narayanan et al. (2026), doi:10.48550/arXiv.2509.11334.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any, Final

import numpy as np
import xarray as xr

from dbthermal import _numbers, bands, mixing, schema
from dbthermal import response as responses
from dbthermal._arrays import Array, Mask
from dbthermal.limits import _fisher
from dbthermal.response import Curve, require_range

__all__ = ["CaptureDesign", "bounds", "plan", "plan_durations"]
__dir__ = __all__.copy

_UNIFORM: Final = 1.0 / np.sqrt(12.0)  # standard deviation of a uniform number over its range
_LEAST_STD: Final = 1e-9  # of an emissivity that is not known exactly [1]
_TIME_CONSTANT: Final = 1.0 / 3.0  # of the object's warming, as a share of the capture
SKY_LEVEL: Final = 273.15  # of what is mirrored outdoors, at rest [K]
SKY: Final = {"8-14": 1.0, "8.5": 1.22, "9.5": 1.47, "10.6": 1.34, "12.1": 0.64}
"""Changes of a band over those in 8-14 um as clouds pass, of spectra from the interferometer of the
Atmospheric Radiation Measurement user facility (radiances, notebook 15)."""
_MOST_FRAMES: Final = 100_000  # they take some seconds a material
# Frames computed at least, and share of pulses or rest that moves at most, if frames are left out:
# the deviations of 12 designs at 60 to 1000 Hz then agree within 0.3 % with those of all frames.
_RESOLVED: Final = 1000
_MOVED: Final = 0.02


def bounds(
    scene: xr.Dataset,
    response: xr.Dataset,
    *,
    order: int | None = None,
    resting: bool = True,
    emissivity_std: float = np.inf,
    response_kind: str = "exact",
) -> xr.Dataset:
    r"""Cramer-Rao bounds of all quantities that can be estimated from one pixel's capture.

    The inverse Fisher information (Kay 1993, Fundamentals of Statistical Signal Processing:
    Estimation Theory, chapter 3) of :math:`z_m(t) = e_m u_m(x(t)) + (1 - e_m) u_m(y(t))` + white
    noise :math:`s_m` at the truth. Unknown are every :math:`e_m`; x, in a smooth subspace of
    polynomials of time; y, one number a frame, eliminated by variable projection (Golub, Pereyra
    2003, doi:10.1088/0266-5611/19/2/201), and in the frames at rest one number for all. Response
    and noise are known.

    For the linear response and two bands, ``resting=False`` gives the reflection ratio its closed
    form, and no emissivity: scaling :math:`1 - e_m` up and :math:`y - x` down alike changes no
    sample. Frames at rest determine the emissivities, and sharpen the ratio; the curvature of the
    exact response determines them without, but hardly, and the bound of the ratio is then loose. An
    `emissivity_std` of 0.29, that of a uniform number in (0, 1), tightens it.

    Parameters
    ----------
    scene : Dataset
        Truth: `object_temperature`, `background_temperature` (time, y, x) [K], `emissivity`
        (band, y, x) [1].
    response : Dataset
        Stage `response` with `noise`, of every band of the scene.
    order : int, optional
        Size of the smooth subspace; for each pixel the smallest that leaves at most 0.1 of the
        noise's variance if not given.
    resting : bool
        The frames are known (the level is not) in which a pixel's background has its most frequent
        temperature, where two or more share it; False assumes nothing about y.
    emissivity_std : float
        Prior standard deviation [1] of each emissivity: 0 if it is known, infinite for no prior. A
        finite one, at least 1e-9, gives the Bayesian bound of van Trees.
    response_kind : {"exact", "linear"}
        See `response.curve`.

    Returns
    -------
    Dataset
        `object_temperature_std`, `background_temperature_std` (time, y, x) [K], `emissivity_std`
        and `reflection_ratio_std` (band, y, x) [1], of :math:`(1 - e_m) / (1 - e_r)` with r the
        quietest band (attribute `reference_band`); infinite without information. `identifiable`
        (quantity, y, x): True if the deviation, root mean square over time and largest of the
        bands, is below that of a uniform number in (0, 1) or in the calibrated range, and for a
        ratio below the ratio itself. `condition_number`, `order` (y, x) [1]; `resting`
        (time, y, x).

        TypeError or ValueError if an input is not as described, there is one band only, an
        emissivity lies outside (0, 1), a temperature outside the response's range, or no smooth
        subspace holds the object.

    Examples
    --------
    Plate glass, and a gray body, of which two bands tell nothing:

    >>> from dbthermal import simulation
    >>> rig, rng, bands = simulation.Rig(), np.random.default_rng(1), ["8-14", "9.5"]
    >>> emissivity = xr.DataArray([[0.86, 0.90], [0.72, 0.90]], {"band": bands}, ("band", "x"))
    >>> panels = emissivity.expand_dims(y=3, axis=1)
    >>> scene = simulation.walkers(np.arange(200) / 10, (3, 2), panels, rng).isel(y=[1])
    >>> std = bounds(scene, rig.response())["object_temperature_std"]
    >>> std.mean("time").values.round(2).tolist()  # K
    [[0.04, inf]]
    """
    std = _numbers.real_number("emissivity_std", emissivity_std)
    if std != 0 and not std >= _LEAST_STD:
        raise ValueError(f"Invalid emissivity_std {std}. Must be 0, or at least {_LEAST_STD}.")
    truth = _truth(scene, resting=_numbers.truth_value("resting", resting))
    names = [str(name) for name in scene["band"].values]
    curves = responses.curves(response, names, response_kind)
    for name, curve in product(_fisher.TEMPERATURES, curves):
        require_range(getattr(truth, name), curve, name)
    # Noise in kelvin, and the smooth subspace of each pixel.
    noise = responses.noise(response, names) / [curve.reference_slope for curve in curves]
    reference = int(np.argmin(noise))
    if order is None:
        orders = _fisher.smallest_order(truth, truth.sensitivity(curves, noise))
    else:
        order = _numbers.whole_number("order", order, (1, truth.time.size))
        orders = np.full(truth.object_temperature.shape[1], order)
    # Deviations from the Fisher information at the smooth truth.
    sensitivity = truth.smoothed(orders).sensitivity(curves, noise)
    stds = _fisher.deviations(sensitivity, truth.time, orders, reference, emissivity_std)
    maps = {
        "condition_number": mixing.condition_number(truth.emissivity.T),
        "order": orders,
        "resting": truth.resting,
        "identifiable": _identifiable(stds, truth.emissivity, reference, curves[0]),
    }
    result = _dataset(scene, stds, maps)
    return result.assign_attrs(reference_band=names[reference], response_kind=response_kind)


def _truth(scene: xr.Dataset, *, resting: bool) -> _fisher.Truth:
    """Checked truth of a scene."""
    names = (*_fisher.TEMPERATURES, "emissivity")
    schema.check(scene, "separated", names, "the scene")
    temperature, background, emissivity = (
        scene[name].values.astype(np.float64).reshape(scene[name].shape[0], -1) for name in names
    )
    if len(emissivity) < 2:
        raise ValueError("Invalid scene of one band. Must have at least two.")
    _require_fractions(scene["emissivity"])
    from scipy.stats import mode  # noqa: PLC0415 - slow to import, and nothing else here needs it

    # A pixel rests at its most frequent temperature, the lowest of several, if frames share it.
    level, frames = mode(background, axis=0)
    still = (background == level) & (frames > 1) & resting
    time = scene["time"].values.astype(np.float64)
    return _fisher.Truth(time, temperature, background, emissivity, still)


def _identifiable(stds: dict[str, Array], emissivity: Array, reference: int, curve: Curve) -> Mask:
    """Quantities (quantity, pixel) that the capture determines better than their limits do."""
    limit = _UNIFORM * (curve.highest - curve.lowest)
    ratio = (1.0 - emissivity) / (1.0 - emissivity[reference])
    below = [np.sqrt(np.mean(stds[name] ** 2, axis=0)) < limit for name in _fisher.TEMPERATURES]
    of_bands = stds["emissivity"] < _UNIFORM, stds["reflection_ratio"] < ratio
    return np.stack([*below, *(np.all(band, axis=0) for band in of_bands)])


def _dataset(scene: xr.Dataset, stds: dict[str, Array], maps: dict[str, Any]) -> xr.Dataset:
    """Bounds and maps on the grid of their scene."""
    image = scene["object_temperature"].shape[1:]
    stage = schema.STAGES["separated"]
    variables: dict[str, Any] = {}
    for name, values in stds.items():
        attrs = {"units": stage[name].units, "long_name": f"bound of {stage[name].long_name}"}
        rows = "time" if "temperature" in name else "band"
        variables[f"{name}_std"] = ((rows, "y", "x"), values.reshape(-1, *image), attrs)
    leading = {"resting": ("time",), "identifiable": ("quantity",)}
    for name, values in maps.items():
        dims = (*leading.get(name, ()), "y", "x")
        variables[name] = (dims, values.reshape(*values.shape[:-1], *image), {"units": "1"})
    coords = {name: scene[name] for name in ("band", "time", "y", "x") if name in scene.coords}
    origin = schema.origin(scene.attrs)
    return xr.Dataset(variables, {**coords, "quantity": list(_fisher.QUANTITIES)}, origin)


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
        _numbers.real_number("duration [s] within the period", self.duration, (0.0, self.period))
        if not 1.5 <= self.seconds * self.rate <= _MOST_FRAMES:
            rule = f"Must have two to {_MOST_FRAMES} frames: change its length, or its rate"
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
        KeyError, TypeError or ValueError if table or noise are not as `schema` has them, a band is
        unknown, an emissivity lies outside (0, 1), or the band `beside` or as many others as used
        together are missing.

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
    schema.require(design, CaptureDesign, "design")
    beside = beside or ("10.6" if outdoors else "8-14")
    for of_material in schema.check(table, "emissivity_table")["emissivity"]:
        _require_fractions(of_material, f" of '{of_material['material'].item()}'")
    emissivity = table["emissivity"].values.T.astype(np.float64)
    names = [str(name) for name in table["band"].values]
    if beside not in names or len(names) < 2:
        raise ValueError(f"Missing band '{beside}', or a second one, of {names}. Must be there.")
    # Combinations of filters beside the band that is always recorded.
    filters = [place for place, name in enumerate(names) if name != beside]
    together = _numbers.whole_number("together", together, (1, len(filters)))
    sets = [[names.index(beside), *chosen] for chosen in combinations(filters, together)]
    std = schema.band_values(noise, names, "the noise", "K")
    for name, value in zip(names, std, strict=True):  # that of a filter may be any
        within = _numbers.NETD if name == beside else _numbers.POSITIVE
        _numbers.real_number(f"noise [K] in band '{name}'", value, within)
    bodies = [_fisher.TopHat(bands.get(name), temperature) for name in names]
    # Deviations of each combination: temperatures (material), other quantities (band, material).
    cases = []
    for chosen in sets:
        truth, stride = _designed(design, emissivity[chosen])
        behind, noises = [bodies[band] for band in chosen], std[chosen] / np.sqrt(stride)
        order = _fisher.smallest_order(truth, truth.sensitivity(behind, noises))
        sensitivity = truth.smoothed(order).sensitivity(behind, noises)
        stds = _fisher.deviations(sensitivity, truth.time, order, reference=0)
        # One number for all frames: the root of their mean square. A free background is measured
        # by its frame alone.
        of_frames = 0.0 * sensitivity.free, (stride - 1.0) * sensitivity.free
        for name, variance in zip(_fisher.TEMPERATURES, of_frames, strict=True):
            stds[name] = np.sqrt(np.mean(stds[name] ** 2 + variance, axis=0))
        stds["condition_number"] = mixing.condition_number(truth.emissivity.T)
        cases.append(stds)
    labels = [" + ".join(names[place] for place in chosen[1:]) for chosen in sets]
    result = _expected(table, labels, cases, sets)
    # Best filter of each material, if its deviation is below that of a uniform temperature.
    uniform = _UNIFORM * np.ptp([truth.object_temperature, truth.background_temperature])
    total = result["object_temperature_std"].values
    if outdoors:
        contrast = np.sqrt(np.mean((truth.object_temperature - truth.background_temperature) ** 2))
        errors = [contrast * _sky(emissivity[it], std[it], [names[b] for b in it]) for it in sets]
        attrs = {"units": "K", "long_name": "error by a sky that is taken for gray"}
        result["sky_error"] = ("material", "filter"), np.stack(errors, axis=1), attrs
        total = np.hypot(total, result["sky_error"].values)
    best = [labels[int(np.argmin(row))] if np.min(row) < uniform else "none" for row in total]
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
    lengths = schema.rising_numbers(seconds, "lengths", "s", least=1)
    plans = [plan(table, noise, replace(design, seconds=float(length))) for length in lengths]
    coordinate = xr.DataArray(lengths, dims="seconds", name="seconds", attrs={"units": "s"})
    result = xr.concat(plans, dim=coordinate, data_vars="all", combine_attrs="drop_conflicts")
    return result.assign(noise=plans[0]["noise"])


def _designed(design: CaptureDesign, emissivity: Array) -> tuple[_fisher.Truth, float]:
    """One pixel of each material (band, material); frames of which one is computed."""
    frames = round(design.seconds * design.rate)
    time = np.arange(frames) / design.rate
    rise = np.expm1(-time / (_TIME_CONSTANT * time[-1])) / np.expm1(-1.0 / _TIME_CONSTANT)
    # Half a frame later than its stamp, so that rounding decides on no frame.
    phase = np.mod(time + 0.5 / design.rate, design.period)
    pulse = phase > design.period - design.duration
    # Information is a sum over frames, smooth in time but for the start and end of pulses: every
    # k-th frame, of noise s / sqrt(k), has the same, if no change, moved by k / 2, matters.
    changes, rarer = np.count_nonzero(np.diff(pulse)), min(np.bincount(pulse, minlength=2))
    longest = int(2 * _MOVED * rarer / changes) if changes else frames
    step = max(1, min(frames // _RESOLVED, longest))
    every = slice(step // 2, None, step)
    films = design.start + design.span * rise, design.level + design.amplitude * pulse, ~pulse
    x, y, resting = (np.tile(film[every, np.newaxis], emissivity.shape[1]) for film in films)
    return _fisher.Truth(time[every], x, y, emissivity, resting), frames / time[every].size


def _sky(emissivity: Array, noise: Array, names: list[str]) -> Array:
    """Error of the object (material) by the sky's colour in some bands, for a contrast of 1 K."""
    if lacking := [name for name in names if name not in SKY]:
        raise ValueError(f"Missing band '{lacking[0]}' in the sky. Must be one of {[*SKY]}.")
    colour = np.array([SKY[name] / SKY[names[0]] for name in names]) - 1.0
    # Weights (material, band) of the bands in the object, by least squares.
    mixed = np.stack([emissivity, 1.0 - emissivity], axis=-1).swapaxes(0, 1)
    weights = np.linalg.pinv(mixed / noise[:, np.newaxis])[:, 0]
    return np.asarray(np.abs(weights / noise * mixed[..., 1] @ colour))


def _require_fractions(emissivity: xr.DataArray, of: str = "") -> None:
    """Refuse an emissivity (band, ...) outside (0, 1)."""
    for name, values in zip(emissivity["band"].values, emissivity.values, strict=True):
        _numbers.real_numbers(f"emissivity{of} in band '{name}'", values, _numbers.FRACTION)


def _expected(
    table: xr.Dataset, labels: list[str], cases: list[dict[str, Array]], sets: list[list[int]]
) -> xr.Dataset:
    """Deviations of all combinations, side by side."""
    size = (table.sizes["material"], len(labels))
    variables = {}
    for quantity in cases[0]:
        name = quantity if quantity == "condition_number" else f"{quantity}_std"
        units = "K" if quantity in _fisher.TEMPERATURES else "1"
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
