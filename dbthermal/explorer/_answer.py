"""Answer of a result in a few sentences: how hot, how sure, how much of it, which materials."""

from typing import Any, Final

import numpy as np
import xarray as xr
from scipy.constants import zero_Celsius

from dbthermal import emissivity, schema
from dbthermal._arrays import Array, Mask
from dbthermal.separation._doubts import hardly_measured

SPREAD: Final = 0.02  # of emissivities of samples of one material
_ALIKE: Final = 3.0  # standard deviations up to which a material of the table is named
_VAGUE: Final = 0.15  # deviation from which most is alike: the demonstration's tape has 0.18
_RANGE: Final = (1.0, 99.0)  # percentiles of the temperatures that are said
_ROWS, _TIMES = 64, 60  # of the image and the film that are looked at, at most
_COMMON: Final = 0.02  # share of the pixels from which a material is listed
# Of a material by band: with its deviation, and with that in steady surroundings.
_EMISSIVITIES: Final = ("emissivity", "emissivity_std", "emissivity_steady_std")
_DOUBTED: Final = 0.05  # share of the pixels from which a flag is listed
_NEAREST: Final = 3  # materials that are named


def answer(result: xr.Dataset, materials: xr.Dataset | None = None) -> tuple[list[str], Any]:
    """Sentences on how hot a result is, how sure, and which materials; their numbers by name."""
    table = emissivity.embedded_table() if materials is None else materials
    height, width = result.sizes["y"], result.sizes["x"]
    status = result["status"].values if "status" in result else np.zeros((height, width), np.uint32)
    measured, completed = status == 0, (status & np.uint32(schema.COMPLETED)) != 0
    numbers: dict[str, Any] = {"measured": float(measured.mean())}
    numbers["completed"] = float(completed.mean())
    # Temperatures of the measured pixels, or of all if none is measured, in some rows and frames:
    # the result may be lazy.
    limits = ((height, _ROWS), (result.sizes["time"], _TIMES))
    rows, times = (slice(0, None, -(-size // most)) for size, most in limits)
    section = result.isel(time=times, y=rows)
    film = section["object_temperature"].values
    valid = np.isfinite(film) & (measured[rows] if measured[rows].any() else True)
    sentences = list[str]()
    if valid.any():
        low, high = (np.percentile(film[valid], _RANGE) - zero_Celsius).tolist()
        deviations = _deviations(section, valid)
        numbers |= {"object_temperature_degC": [low, high], "object_temperature_std_K": deviations}
        bars = " and ".join(f"+- {value:.2g} K ({cause})" for cause, value in deviations.items())
        state = "completed and not measured" if completed.any() else "flagged and not measured"
        name = "Object" if measured.any() else f"Object, {state},"
        typical = f"typically {bars}" if bars else "without a standard deviation"
        span = f"from {low:.1f} to {high:.1f} degC ({np.ptp(_RANGE):g} % of the values)"
        sentences.append(f"{name} {span}, {typical}.")
    else:
        sentences.append("No object temperature at any pixel.")
    if result.attrs.get("surroundings_source") == "capture":
        level = f"Reflected surroundings at {result.attrs['surroundings'] - zero_Celsius:.1f} degC"
        sentences.append(f"{level}; a calibration is wrong if that is far off.")
    # Shares of the pixels.
    remainder = f"completed, not measured: {completed.mean():.0%}"
    black = ", as of a black body" * (result.attrs.get("method") == "apparent")
    sentences.append(f"Measured{black}: {measured.mean():.0%} of the pixels; {remainder}.")
    # Materials, and what to watch out for.
    numbers["materials"] = listed = by_material(result, measured, table)
    for entry in listed:
        columns = (entry[key].values() for key in _EMISSIVITIES)
        values = ", ".join(
            f"{value:.3f} +- {std:.2g} ({band}; +- {steady:.2g} in steady surroundings)"
            for band, value, std, steady in zip(entry["emissivity"], *columns, strict=True)
        )
        name = " or ".join(place["material"] for place in entry["nearest"]) or "many materials"
        sentences.append(f"Emissivity at {entry['pixels']} pixels, like {name}: {values}.")
    doubts = [*result.attrs.get("warnings", []), *hardly_measured(result)]
    flagged = {bit: np.mean((status & np.uint32(bit)) != 0) for bit in schema.Status}
    doubts += [
        f"{share:.0%} of the pixels are flagged {bit.label}: {bit.meaning}."
        for bit, share in sorted(flagged.items(), key=lambda entry: -entry[1])
        if share >= _DOUBTED and not bit & schema.COMPLETED
    ]
    return sentences + [f"Watch out: {doubt}" for doubt in dict.fromkeys(doubts)], numbers


def _deviations(section: xr.Dataset, valid: Mask) -> dict[str, float]:
    """Typical deviation of the object temperature [K]: noise, and calibration if it is known."""
    if "object_temperature_std" not in section:
        return {}
    squares = {"noise": section["object_temperature_std"] ** 2}
    if "uncertainty" in section:  # by cause, of each pixel
        causes = section["uncertainty"] ** 2
        stated = causes["cause"].isin([*schema.CALIBRATION])
        squares = {"noise": causes.where(~stated).sum("cause", min_count=1)}
        squares["calibration"] = causes.where(stated).sum("cause", min_count=1)
    typical = dict[str, float]()
    for name, square in squares.items():
        values = np.broadcast_to(square.values, valid.shape)[valid]
        if np.isfinite(values).any():
            typical[name] = float(np.sqrt(np.nanmedian(values)))
    return typical


def by_material(result: xr.Dataset, measured: Mask, table: xr.Dataset) -> list[dict[str, Any]]:
    """Emissivities of the measured pixels, by the nearest material of a table, commonest first."""
    if not {"emissivity", "emissivity_std"} <= {*result.data_vars}:
        return []
    bands = [str(band) for band in result["band"].values]
    budget = result.get(schema.BUDGETS["emissivity"])
    drift = 0.0 * result["emissivity_std"] if budget is None else budget.sel(cause="drift")
    variables = (result["emissivity"], result["emissivity_std"], drift)
    tables = [it.transpose("band", "y", "x").values[:, measured].T for it in variables]
    finite = np.isfinite(tables[0] + tables[1]).all(axis=1)
    values, stds, drift_stds = (table[finite].astype(np.float64) for table in tables)
    steady_stds = np.sqrt(np.maximum(stds**2 - drift_stds**2, 0.0))
    vague = stds.max(axis=1, initial=0.0) >= _VAGUE
    # Pixels of a label by their median: it tells materials apart that single pixels do not.
    judged, deviations = values.copy(), stds.copy()
    labels = np.full(len(values), -1)
    if "material" in result:
        labels = result["material"].values[measured][finite]
    for label in np.unique(labels[labels >= 0]):
        judged[labels == label] = np.median(values[labels == label], axis=0)
        deviations[labels == label] = 0.0
    # Groups of pixels like the commonest nearest material, then of the remaining pixels.
    groups, free = [vague], ~vague
    if {*bands} <= {*table["band"].values}:
        distances = distance(bands, judged, deviations, table)
        first, free = distances.argmin(axis=1), free & (distances.min(axis=1) < _ALIKE)
        while free.sum() >= max(1, _COMMON * len(values)):
            commonest = np.bincount(first[free]).argmax()
            groups.append(free & (distances[:, commonest] < _ALIKE))
            free = free & ~groups[-1]
    # Medians of each group, and the materials within a deviation; none for the vague group.
    listed = []
    for pixels in (pixels for pixels in groups if pixels.sum() >= max(1, _COMMON * len(values))):
        medians = [np.median(array[pixels], axis=0) for array in (values, stds, steady_stds)]
        # Labels of a group may differ by more than its deviation says.
        if (labelled := pixels & (labels >= 0)).any():
            medians[1:] = [np.hypot(std, judged[labelled].std(axis=0)) for std in medians[1:]]
        entry: dict[str, Any] = {"pixels": int(pixels.sum()), "nearest": []}
        for key, numbers in zip(_EMISSIVITIES, medians, strict=True):
            entry[key] = dict(zip(bands, numbers.tolist(), strict=True))
        if pixels is not groups[0]:
            near = nearest(bands, medians[0], medians[1], table)
            entry["nearest"] = [place for place in near if place["distance"] < 1]
        listed.append(entry)
    return sorted(listed, key=lambda entry: -entry["pixels"])


def nearest(bands: list[str], values: Array, stds: Array, table: xr.Dataset) -> list[Any]:
    """Materials of a table that are nearest to emissivities (band), and how far they are."""
    if not {*bands} <= {*table["band"].values} or not np.isfinite(values + stds).all():
        return []
    far, names = distance(bands, values, stds, table), table["material"].values
    order = np.argsort(far)[:_NEAREST]
    return [{"material": str(names[at]), "distance": float(far[at])} for at in order]


def distance(bands: list[str], values: Array, stds: Array, table: xr.Dataset) -> Array:
    """Distance (..., material) of emissivities (..., band), root mean square in deviations [1]."""
    library = table["emissivity"].sel(band=bands).transpose("material", "band").values
    ratio = (library - values[..., None, :]) / np.hypot(stds, SPREAD)[..., None, :]
    return np.asarray(np.sqrt(np.mean(ratio**2, axis=-1)))
