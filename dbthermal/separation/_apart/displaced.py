r"""The second camera resampled so that all bands show the same reflection at each pixel.

The second camera shows at p the reflection that the reference band shows at :math:`r = p + d(p)`.
Its bands are resampled at the p of each pixel r: then all bands hold the reflection of r, and only
the object's own signal is that of another place (`joint`). The resampling is one sparse matrix W,
cubic convolution by Keys (1981), doi:10.1109/TASSP.1981.1163711, so that the noise of a resampled
sample is known, :math:`s_m (\sum_j W_{rj}^2)^{1/2}`.
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt
import xarray as xr
from scipy.ndimage import distance_transform_edt, map_coordinates
from scipy.sparse import csr_array

from dbthermal import _samples as samples
from dbthermal import schema
from dbthermal._arrays import Array, Mask
from dbthermal.schema import Status, laid_on
from dbthermal.separation import _quality as quality
from dbthermal.separation._quality import Bits

# Rounds in which p + d(p) = r is solved, and the error that is left [pixel].
_ROUNDS: Final = 100
_SOLVED: Final = 1e-3
_UNSOLVED: Final = 1e-2
# A place so far outside of the image is told by its border: a shift may be off by it [pixel].
_OUTSIDE: Final = 0.2
_LOST_WEIGHT: Final = 0.25  # weight of pixels without a value that good pixels may take over [1]
# Share of the pixels of some rows up to which pixels are read singly: a shift that is as wide as
# an image is high leaves most of them without a weight [1].
_SHARE: Final = 0.5
_ROWS: Final = 2**14  # rows of weights that are changed at once
_NO_WEIGHT: Final = 1e-3  # weight below which a pixel's flags do not count [1]
# Memory of resampled samples that are kept, for a capture is read some nine times [byte].
_CACHE: Final = 2**29
# Weights by powers of the way between two samples (R. Keys 1981, doi:10.1109/TASSP.1981.1163711).
_KEYS: Final = 0.5 * np.array([[0, -1, 2, -1], [2, 0, -5, 3], [0, 1, 4, -3], [0, 0, -1, 1]])

T = TypeVar("T")
Paired: TypeAlias = tuple[Array, Mask, Mask, Bits, Array]
"""Counts, samples valid or bridged, valid samples, status, and noise: see `read`."""


class Resampled(NamedTuple):
    """Samples of the second camera, resampled to the reflections that some rows show."""

    counts: npt.NDArray[np.float32]  # of its bands (band, time, pixel) [count]
    packed: npt.NDArray[np.uint8] | None  # bits of samples that are valid (time, pixel); None: all
    status: Bits  # (pixel)
    gain: Array  # noise over a sample's (first band and second camera, pixel) [1]


@dataclass(frozen=True)
class Displacement:
    """Places at which the second camera sees what the reference band shows at each pixel."""

    shape: tuple[int, int]
    reference: int  # place of the reference band in the capture
    others: list[int]  # of the second camera's bands
    resample: csr_array  # weights at p of the pixels around, p + d(p) = r (r, pixel); 0 without p
    onward: csr_array  # weights at p + d(p) of the pixels around (p, pixel); 0 outside
    std: Array  # standard deviation of the shift (2, pixel) [pixel]
    found: dict[Hashable, Any] = field(default_factory=dict)  # see `once`
    kept: dict[tuple[int, int], Resampled] = field(default_factory=dict)  # see `paired`

    def once(self, key: Hashable, compute: Callable[[], T]) -> T:
        """Return what was computed for a key before: a capture is read many times."""
        if key not in self.found:
            self.found[key] = compute()
        result: T = self.found[key]
        return result

    def source(self, rows: slice) -> slice:
        """Rows of the image that hold some rows, and the second camera's samples for these rows."""
        width = self.shape[1]
        first, last = self.resample.indptr[[rows.start * width, rows.stop * width]]
        lines = self.resample.indices[first:last] // width
        if lines.size == 0:
            return rows
        return slice(min(rows.start, int(lines.min())), max(rows.stop, int(lines.max()) + 1))

    def weights(self, rows: slice, source: slice) -> csr_array:
        """Weights of the source's pixels at the pixels of some rows."""
        width = self.shape[1]
        pixels, sources = (slice(span.start * width, span.stop * width) for span in (rows, source))
        return csr_array(self.resample[pixels, sources])


def check(field: xr.Dataset, corrected: xr.Dataset, reference: int) -> Displacement:
    """Check a field of the reflections' shift, see `solve`, against the capture, and invert it."""
    label = "the reflection shift"
    schema.check(field, "reflection_shift")
    names = [str(name) for name in corrected["band"].values]
    _check_bands(field, names, names[reference])
    field = laid_on(field, corrected, label, "the capture")
    if [str(name) for name in field["axis"].values] != ["y", "x"]:
        raise ValueError(f"Invalid axis {field['axis'].values.tolist()} of {label}. Must be y, x.")
    shift, std = (field[name].values.astype(np.float64) for name in ("shift", "shift_std"))
    size = np.array(shift.shape[1:])
    finite = np.all(schema.measured(shift), axis=0)
    if not np.any(finite):
        raise ValueError(f"Invalid {label[4:]} without a number. Must be finite somewhere.")
    if np.any(field["known"].values & ~finite):
        raise ValueError(f"Invalid {label[4:]}: no number where it is known. Must be finite there.")
    if np.any(~(std[:, finite] >= 0) | ~schema.measured(std[:, finite])):
        raise ValueError(f"Invalid shift_std of {label}. Must be zero or positive, and finite.")
    largest = np.abs(shift[:, finite]).max(axis=1)
    if np.any(largest >= size):
        rule = f"Must be less than the image, {size[0]} rows and {size[1]} columns"
        raise ValueError(f"Invalid {label[4:]} of {largest.max():g} pixel. {rule}.")
    # Beyond where it is known the nearest shift leads on; p is where d(p) itself is known.
    nearest = distance_transform_edt(~finite, return_distances=False, return_indices=True)
    shift = shift[:, nearest[0], nearest[1]]
    pixels = np.indices(finite.shape, dtype=np.float64)
    place, solved = _inverse(shift, pixels)
    solved &= map_coordinates(finite.astype(np.float64), place, order=0, mode="nearest") > 0
    return Displacement(
        shape=(shift.shape[1], shift.shape[2]),
        reference=reference,
        others=[band for band in range(len(names)) if band != reference],
        resample=_interpolation(place, solved),
        onward=_interpolation(pixels + shift, finite),
        std=np.nan_to_num(std).reshape(2, -1),
    )


def _check_bands(field: xr.Dataset, names: list[str], reference: str) -> None:
    """Check the bands that the field says it is of, where it does."""
    bands = [name for name in names if name != reference]
    for key, rule in (("reference_band", [reference]), ("bands", bands)):
        stated = [str(name) for name in np.atleast_1d(field.attrs.get(key, rule))]
        if sorted(stated) != sorted(rule):
            raise ValueError(
                f"Invalid {key} {stated} of the reflection shift. Must be {rule}: the quietest "
                "of the capture is the reference, all others are of the second camera."
            )


def _inverse(shift: Array, pixels: Array) -> tuple[Array, Mask]:
    """Places p (2, y, x) with p + d(p) = r, by iteration, and where it has come to an end."""
    place = pixels - shift
    for _ in range(_ROUNDS):
        at = [map_coordinates(component, place, order=1, mode="nearest") for component in shift]
        step = np.abs(pixels - at - place).max(axis=0)
        place = pixels - at
        if step.max() < _SOLVED:
            break
    return place, step < _UNSOLVED


def _interpolation(place: Array, mask: Mask) -> csr_array:
    """Weights (pixel, pixel) of an image at its places (2, y, x) [pixel] that are used; else 0."""
    (height, width), (last, end) = mask.shape, np.array(mask.shape) - 1 + _OUTSIDE
    mask = mask & np.all(place >= -_OUTSIDE, axis=0) & (place[0] <= last) & (place[1] <= end)
    (row, down), (column, right) = _keys(place[0][mask], height), _keys(place[1][mask], width)
    index = (row[:, np.newaxis] * width + column).reshape(16, -1).T
    weight = (down[:, np.newaxis] * right).reshape(16, -1).T
    start = np.concatenate([[0], np.cumsum(16 * mask.ravel())])
    result = csr_array((weight.ravel(), index.ravel(), start), shape=(mask.size, mask.size))
    result.sum_duplicates()
    result.eliminate_zeros()
    return result


def _keys(place: Array, size: int) -> tuple[npt.NDArray[np.intp], Array]:
    """Indices and weights (4, place) of cubic convolution along a line."""
    first = np.clip(np.floor(place), 0.0, max(size - 2.0, 0.0))
    powers = (place - first) ** np.arange(4)[:, np.newaxis]
    index, weight = first.astype(np.intp) + np.arange(-1, 3)[:, np.newaxis], _KEYS @ powers
    # Beyond an end a parabola through three samples goes on, of which a slope of them is no error.
    for outer, inner in ((0, [1, 2, 3]), (3, [2, 1, 0])) if size > 2 else ():
        outside = (index[outer] < 0) | (index[outer] >= size)
        weight[inner] += np.outer([3.0, -3.0, 1.0], weight[outer] * outside)
        weight[outer, outside] = 0.0
    return np.clip(index, 0, size - 1), weight


def paired(
    capture: xr.Dataset,
    load: Callable[[], tuple[xr.Dataset, list[samples.Grain]]],
    displacement: Displacement,
    rows: slice,
    source: slice,
    selected: slice | npt.NDArray[np.intp],
    fewest: int,
) -> Paired:
    """Read some pixels of some rows as `read` does, their short gaps bridged."""
    # Samples of the second camera are kept, in single precision: they are not resampled again.
    cache, place, bands = displacement.kept, (rows.start, rows.stop), capture.sizes["band"]
    if (resampled := cache.get(place)) is None:
        block, grains = load()
        counts, valid, status, gain = read(block, displacement, rows, source, fewest, grains)
        packed = None if valid.all() else np.packbits(valid, axis=0)
        second = counts[displacement.others].astype(np.float32)
        resampled = Resampled(second, packed, status, gain)
        if sum(film.counts.nbytes for film in (resampled, *cache.values())) <= _CACHE:
            cache[place] = resampled
    # Gaps are bridged in frames that most pixels of the rows have: then all pixels are read.
    pixels = selected if resampled.packed is None else slice(None)
    first = capture["counts"].isel(band=displacement.reference, y=rows).values
    first, second = first.reshape(len(first), -1)[:, pixels], resampled.counts[..., pixels]
    valid, counts = np.ones(first.shape, dtype=bool), np.empty((bands, *first.shape), first.dtype)
    counts[displacement.reference], counts[displacement.others] = first, second
    counts[..., quality.unusable(resampled.status[pixels])] = 0.0
    if resampled.packed is not None:
        valid = np.unpackbits(resampled.packed, axis=0, count=len(first)).view(bool)
        counts[:, ~valid] = 0.0
    counts, usable = quality.bridge(counts, valid, capture["time"].values.astype(np.float64))
    if resampled.packed is not None:
        counts, usable, valid = counts[..., selected], usable[:, selected], valid[:, selected]
    status, gain = resampled.status[selected].copy(), resampled.gain[:, selected]
    return counts, usable, valid, status, gain


def read(
    block: xr.Dataset,
    displacement: Displacement,
    rows: slice,
    source: slice,
    fewest: int,
    grains: list[samples.Grain],
) -> tuple[Array, Mask, Bits, Array]:
    """Read rows of both cameras with the same reflections, and their noise over a sample's [1]."""
    # The block has the rows of the `source`, which hold those of `displacement.source(rows)`.
    reference, second_bands = displacement.reference, displacement.others
    needed = displacement.source(rows)
    inner = slice(rows.start - source.start, rows.stop - source.start)
    first = block.isel(band=[reference], y=inner)
    weights = displacement.weights(rows, needed)
    pixels, place = _used(weights, slice(needed.start - source.start, needed.stop - source.start))
    counts, valid, status = quality.read(first, fewest, [grains[reference]])
    second = block.isel(band=second_bands, **place)
    signals, measured, flags = quality.read(second, fewest, [grains[band] for band in second_bands])
    signals, usable = quality.bridge(signals, measured, block["time"].values.astype(np.float64))
    bad = np.zeros(weights.shape[1], dtype=bool)
    bad[pixels] = quality.unusable(flags)
    weights = without(weights, bad, displacement.shape[1])[:, pixels]
    counts = np.stack([counts[0]] * (len(second_bands) + 1))
    for band, signal in zip(second_bands, signals, strict=True):
        counts[band] = (weights @ signal.T).T
    share = abs(weights)
    if not measured.all():  # a sample that was bridged does not count where its weight is small
        valid = valid & ((share @ ~usable.T).T <= 0.0)
        valid &= (share @ ~measured.T).T <= _LOST_WEIGHT
    unpaired = np.diff(weights.indptr) == 0
    status |= quality.status_bits(
        {
            Status.NO_REFLECTION_PAIR: unpaired,
            Status.INVALID_SAMPLES: quality.too_few(valid, fewest) & ~unpaired,
        }
    )
    for bit in Status:
        holds = (flags & np.uint32(bit)) != 0
        if np.any(holds):
            status[share @ holds > _NO_WEIGHT] |= np.uint32(bit)
    counts[:, :, quality.unusable(status)] = 0.0
    gain = np.sqrt(np.asarray((weights**2).sum(axis=1)).ravel())
    good = ~quality.unusable(flags)
    if "noise_factor" in block and np.any(block["noise_factor"][second_bands] < 1.0) and good.any():
        # Neighbours that a registration has interpolated share noise: measured, not computed.
        key, films = (rows.start, rows.stop, source.start, source.stop), counts[second_bands]
        measure = partial(samples.resampled_noise, stated=gain, width=displacement.shape[1])
        gain *= displacement.once(key, lambda: measure(signals[:, :, good], films))
    return counts, valid, status, np.stack([np.ones_like(gain), gain])


def _used(weights: csr_array, rows: slice) -> tuple[Any, dict[str, Any]]:
    """Pixels of some rows that have a weight, if few; and the places of the pixels to read."""
    sources, pixels = np.unique(weights.indices), weights.shape[1]
    if sources.size > _SHARE * pixels:
        return slice(None), {"y": rows}
    y, x = np.divmod(sources, pixels // (rows.stop - rows.start))
    places = {"y": y + rows.start, "x": x}
    return sources, {name: xr.DataArray(index, dims="pixel") for name, index in places.items()}


def without(weights: csr_array, bad: Mask, width: int) -> csr_array:
    """Weights of the good pixels, which take over the bad pixels' part; a plane stays a plane."""
    lost = abs(weights) @ bad
    # Where the part of bad pixels is large the weights stay as they are.
    rows = np.flatnonzero((lost > 0) & (lost <= _LOST_WEIGHT))
    if rows.size == 0:
        return weights
    weights = weights.copy()
    for group in np.array_split(rows, -(-rows.size // _ROWS)):
        # The entries of these rows, side by side.
        start, count = weights.indptr[group, np.newaxis], np.diff(weights.indptr)[group, np.newaxis]
        place = np.arange(count.max())
        mask = place < count
        entries = start + np.where(mask, place, 0)
        pixels, values = weights.indices[entries], weights.data[entries] * mask
        off = bad[pixels]
        # A plane about their middle.
        plane, size = np.stack([np.ones(pixels.shape), *np.divmod(pixels, width)]), np.abs(values)
        plane[1:] -= ((plane[1:] * size).sum(axis=-1) / size.sum(axis=-1))[..., np.newaxis]
        # The smallest change of the good pixels' weights with the same sums over the plane.
        good, missing = plane * (mask & ~off), (plane * (values * off)).sum(axis=-1)
        change = np.linalg.pinv(np.moveaxis(good, 0, 1)) @ missing.T[..., np.newaxis]
        values = np.where(off, 0.0, values + change[..., 0])
        weights.data[entries[mask]] = values[mask]
    return weights
