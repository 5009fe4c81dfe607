"""What accuracy to expect of a recording before it is made, and which filter to make it with."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from dbthermal import mixing, planck, schema
from dbthermal.bands import FILTERS, Band
from dbthermal.limits._deviations import Truth, deviations, orders
from dbthermal.limits._recording import Recording

Array = npt.NDArray[np.float64]

NO_FILTER: Final = "none"
"""The best filter of a material whose temperature none of them tells."""


@dataclass(frozen=True)
class _TopHat:
    """Linearised signal of a band by Planck's law; see `information.Blackbody`."""

    band: Band
    reference: float

    def signal(self, temperature: npt.ArrayLike) -> Array:
        excess = self.band.radiance(temperature) - self.band.radiance(self.reference)
        return np.asarray(self.reference + excess / self.band.slope(self.reference))

    def slope(self, temperature: npt.ArrayLike) -> Array:
        return np.asarray(self.band.slope(temperature) / self.band.slope(self.reference))


def plan(
    table: xr.Dataset,
    noise: xr.DataArray,
    recording: Recording | None = None,
    *,
    beside: str = "8-14",
    together: int = 1,
    filters: Mapping[str, Band] = FILTERS,
    temperature: float = 300.0,
) -> xr.Dataset:
    r"""
    Accuracy to expect of one pixel for each material and filter, and the best filter.

    The Cramer-Rao bound of `bounds` at the film that a `Recording` describes, its response
    Planck's law over each band: the smooth subspace and the frames at rest are known, the
    emissivities, the level and everything else are not. Estimates of a pixel alone come close to
    it; those of n pixels of one material share their ratios and emissivities, whose deviations
    fall as :math:`1 / \sqrt{n}`.

    Parameters
    ----------
    table : Dataset
        Stage `emissivity_table`, of the camera's own band and the filters.
    noise : DataArray
        Noise (band) [K] of every band of the table, such as from `emissivity.filter_noise`.
    recording : Recording, optional
        The film; 35 s of an object that warms by 25 K if not given.
    beside : str
        Name of the band that is always recorded.
    together : int
        Number of filters recorded beside it at once.
    filters : mapping of str to Band
        The bands of the table, by name.
    temperature : float
        Temperature [K] at which the noise is meant; in counts it is the same at all.

    Returns
    -------
    Dataset
        Over (material, filter), the filters of a combination joined by " + ":
        `object_temperature_std` and `background_temperature_std` [K], root mean square over time;
        `condition_number` [1], see `mixing.condition_number`. Over (material, filter, band):
        `emissivity_std` [1], and `reflection_ratio_std` [1] of :math:`(1 - e_m) / (1 - e_1)` with
        band 1 the one that is always recorded; NaN for a band that is not of the combination.
        `best` (material): the filter of the smallest object deviation, "none" where each is above
        that of a guess, a uniform number within the recording's range of temperatures.
        `best_of_all` (): the filter whose median over the materials is smallest, "none" under the
        same rule. `noise` (band) [K], and the recording's numbers as attributes.

    Raises
    ------
    KeyError
        If there is no band of a name in the filters.
    TypeError, ValueError
        If the table is not as `schema` has it, an emissivity lies outside (0, 1), the band
        `beside` or one of the noise is missing, the noise is not finite and positive or of
        another unit, or there are fewer filters than are to be used together.
    """
    recording = Recording() if recording is None else recording
    emissivity = _emissivities(table)
    names = [str(name) for name in table["band"].values]
    sets = _combinations(names, beside, together)
    std = _noise(noise, names)
    bodies = [_TopHat(_band(filters, name), temperature) for name in names]
    parts = [
        _expected(recording.truth(emissivity[chosen]), [bodies[m] for m in chosen], std[chosen])
        for chosen in sets
    ]
    labels = [" + ".join(names[place] for place in chosen[1:]) for chosen in sets]
    result = _dataset(table, labels, parts, sets)
    own = result["object_temperature_std"]
    guess = recording.range / np.sqrt(12.0)
    best = _best(own, guess)
    of_all = _best(own.median("material").expand_dims("material"), guess)[0]
    return result.assign(
        best=("material", best, {"long_name": "filter of the smallest object deviation"}),
        best_of_all=((), of_all, {"long_name": "filter of its smallest median"}),
        noise=("band", std, {"units": "K", "long_name": "noise-equivalent temperature difference"}),
    ).assign_attrs(vars(recording), beside=beside, origin="simulated")


def plan_durations(
    table: xr.Dataset,
    noise: xr.DataArray,
    seconds: Sequence[float],
    recording: Recording | None = None,
    **options: Any,
) -> xr.Dataset:
    """
    Accuracy to expect of recordings of several lengths.

    Parameters
    ----------
    table, noise
        See `plan`.
    seconds : sequence of float
        Lengths [s], strictly increasing. The object's rise and the pulses are the same in all.
    recording : Recording, optional
        Everything but the length.
    **options
        Of `plan`.

    Returns
    -------
    Dataset
        That of `plan` with `seconds` [s] as the first dimension; `noise` is the same in all.

    Raises
    ------
    KeyError, TypeError, ValueError
        As `plan`, or if the lengths do not increase.
    """
    recording = Recording() if recording is None else recording
    lengths = np.asarray(seconds, dtype=np.float64)
    if lengths.size == 0 or np.any(np.diff(lengths) <= 0):
        raise ValueError(f"Invalid seconds {lengths.tolist()}. Must increase strictly.")
    films = [replace(recording, seconds=float(length)) for length in lengths]
    plans = [plan(table, noise, film, **options) for film in films]
    coordinate = xr.DataArray(lengths, dims="seconds", name="seconds", attrs={"units": "s"})
    of_films = [one.drop_vars("noise") for one in plans]
    result = xr.concat(of_films, dim=coordinate, combine_attrs="drop_conflicts")
    return result.assign(noise=plans[0]["noise"])


def _emissivities(table: xr.Dataset) -> Array:
    """Emissivity (band, material) of a table, in (0, 1)."""
    values = schema.check(table, "emissivity_table")["emissivity"]
    bad = np.argwhere(~((values.values > 0) & (values.values < 1)))
    if bad.size:
        row, column = bad[0]
        raise ValueError(
            f"Invalid emissivity {values.values[row, column]} of "
            f"'{values['material'].values[row]}' in band '{values['band'].values[column]}'. "
            "Must lie in (0, 1)."
        )
    return np.asarray(values.values.T, dtype=np.float64)


def _combinations(names: list[str], beside: str, together: int) -> list[list[int]]:
    """Places of the bands of each combination, the one always recorded first."""
    if beside not in names:
        raise ValueError(f"Missing band '{beside}' in the table. Has {names}.")
    others = [place for place, name in enumerate(names) if name != beside]
    if not 1 <= together <= len(others):
        raise ValueError(
            f"Invalid together {together}. Must lie in [1, {len(others)}], the number of filters."
        )
    return [[names.index(beside), *chosen] for chosen in combinations(others, together)]


def _noise(noise: xr.DataArray, names: list[str]) -> Array:
    """Noise [K] of the named bands."""
    schema.check_variable(noise, replace(schema.NOISE, units="K"), "the noise")
    places = schema.band_positions(noise, names, "the noise")
    return planck.require_positive("noise [K]", noise.values[places])


def _band(filters: Mapping[str, Band], name: str) -> Band:
    """Band of a name."""
    if name not in filters:
        raise KeyError(f"Unknown band '{name}'. Must be one of {sorted(filters)}.")
    return filters[name]


def _expected(truth: Truth, bodies: Sequence[_TopHat], noise: Array) -> dict[str, Array]:
    """Deviations of one combination: temperatures (material), the others (band, material)."""
    order = orders(truth, truth.film(bodies, noise))
    seen = truth.smooth(order).film(bodies, noise)
    found = deviations(seen, truth.time, order, reference=0)
    for name in ("object_temperature", "background_temperature"):
        found[name] = np.sqrt(np.mean(found[name] ** 2, axis=0))
    found["condition_number"] = mixing.condition_number(truth.emissivity.T)
    return found


def _dataset(
    table: xr.Dataset, labels: list[str], parts: list[dict[str, Array]], sets: list[list[int]]
) -> xr.Dataset:
    """Deviations of all combinations, side by side."""
    size = (table.sizes["material"], len(labels))
    units = {"object_temperature": "K", "background_temperature": "K"}
    variables: dict[str, tuple[tuple[str, ...], Array, dict[str, str]]] = {}
    for name in ("object_temperature", "background_temperature", "condition_number"):
        values = np.stack([part[name] for part in parts], axis=1)
        label = name if name == "condition_number" else f"{name}_std"
        attrs = {"units": units.get(name, "1"), "long_name": f"expected {label.replace('_', ' ')}"}
        variables[label] = (("material", "filter"), values, attrs)
    for name in ("emissivity", "reflection_ratio"):
        values = np.full((*size, table.sizes["band"]), np.nan)
        for place, (part, chosen) in enumerate(zip(parts, sets, strict=True)):
            values[:, place, chosen] = part[name].T
        attrs = {"units": "1", "long_name": f"expected {name.replace('_', ' ')} std"}
        variables[f"{name}_std"] = (("material", "filter", "band"), values, attrs)
    coords = {"material": table["material"].values, "filter": labels, "band": table["band"].values}
    return xr.Dataset(variables, coords)


def _best(std: xr.DataArray, guess: float) -> list[str]:
    """Filter of the smallest deviation for each material, if that is below a guess's."""
    names = std["filter"].values
    return [
        str(names[int(np.argmin(row))]) if np.min(row) < guess else NO_FILTER for row in std.values
    ]
