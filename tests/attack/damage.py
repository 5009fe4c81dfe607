"""Damage by name: to the samples of counts, and to any labelled array."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import xarray as xr

from attack.scenes import Scene, pick

Rng = np.random.Generator
Table = Mapping[str, Callable[[Rng, Any], Any]]
"""Name of a damage -> the thing damaged so."""


def hurt(rng: Rng, table: Table, thing: Any) -> tuple[str, Any]:
    """Name of one damage of a table, and the thing damaged so."""
    what = pick(rng, [*table])
    with np.errstate(all="ignore"):
        return what, table[what](rng, thing)


def hurt_one(
    rng: Rng, tables: Mapping[str, Table], given: Mapping[str, Any]
) -> tuple[str, dict[str, Any]]:
    """One argument and its damage, and the arguments with it."""
    name = pick(rng, [*tables])
    what, spoilt = hurt(rng, tables[name], given[name])
    return f"{name} {what}", {**given, name: spoilt}


PLACES: Final = ("scattered", "line", "pixels", "block", "patch", "repeated", "everywhere")
VALUES: Final = {"NaN": np.nan, "infinite": np.inf, "zero": 0.0, "full": 65535.0}


def spoil(rng: Rng, counts: npt.NDArray[Any], what: str) -> npt.NDArray[Any]:
    """Counts (..., time, y, x) with a value, or with what was there before, at a place of them."""
    place, value = what.split()
    frames, rows, columns = counts.shape[-3:]
    time = np.arange(frames)[:, None, None]
    since = time - rng.integers(5, frames // 2)
    block = (since >= 0) & (since < rng.choice([1, 5, 10, 30, 60, frames // 3]))
    some = rng.random((rows, columns)) < 0.3
    where = {
        "scattered": rng.random(counts.shape) < rng.choice([0.001, 0.01, 0.1, 0.5]),
        "line": np.arange(columns) == rng.integers(columns),
        "pixels": some,
        "block": block,
        "patch": block & some,
        "repeated": time % rng.choice([2, 3, 5, 10]) == 1,  # as from a driver of twice the rate
        "everywhere": np.True_,
    }[place]
    if value == "held":
        last = np.maximum.accumulate(np.where(where, 0, time + 0 * counts.astype(int)), axis=-3)
        return np.asarray(np.take_along_axis(counts, last, axis=-3))
    return np.where(where, VALUES[value], counts).astype(counts.dtype)


def band_spoilt(rng: Rng, made: Scene, what: str) -> xr.Dataset:
    """The capture of a scene with one band spoilt."""
    band = int(rng.integers(len(made.bands)))
    return made.put(band, spoil(rng, made.counts()[band], what))


def first(one: Any) -> Any:
    """The array, or the first variable of a dataset that has dims."""
    return one if isinstance(one, xr.DataArray) else next(v for v in one.values() if v.dims)


def _each(change: Callable[[xr.DataArray], Any]) -> Callable[[Rng, Any], Any]:
    """Change an array, or the first variable of a dataset that has dims."""

    def damage(_: Rng, one: Any) -> Any:
        if isinstance(one, xr.DataArray):
            return change(one)
        return one.assign({first(one).name: change(first(one)).variable})

    return damage


def _hole(array: xr.DataArray, value: float = np.nan) -> xr.DataArray:
    """Another value in the last row but one of all dims."""
    values = array.values.astype(np.result_type(array.dtype, np.float32))
    values[(-2,) * values.ndim] = value
    return array.copy(data=values)


def _moved(_: Rng, one: Any) -> Any:
    """Pixels of another window."""
    return one.assign_coords({dim: one[dim] + 20 for dim in ("y", "x") if dim in one.coords})


def _renamed(_: Rng, one: Any) -> Any:
    """Other names of the bands."""
    return one.assign_coords(band=[*"abcde"][: one.sizes["band"]]) if "band" in one.dims else one


def cut(**places: Any) -> Callable[[Rng, Any], Any]:
    """A part of the dims that are there."""
    return lambda _, one: one.isel(places, missing_dims="ignore")


_OTHERS: Final = (None, "text", [[1.0]], np.ones((2, 3)))
TURNED: Final = slice(None, None, -1)
VALUED: Final[Table] = {
    "NaN": _each(_hole),
    "infinite": _each(partial(_hole, value=np.inf)),
    "text": _each(lambda one: one.astype(str)),
    "complex": _each(lambda one: one.astype(complex)),
    "times": _each(lambda one: one.astype(int).astype("datetime64[s]")),
}
FORMS: Final[Table] = {
    **VALUED,
    "of another unit": _each(lambda one: one.assign_attrs(units="furlong")),
    "transposed": _each(xr.DataArray.transpose),
    "type": lambda rng, _: pick(rng, _OTHERS),
    "another window": _moved,
    "of other bands": _renamed,
    "bands turned round": cut(band=TURNED),
}
"""Damage that changes what comes of an array, or must be refused."""
ALL: Final[Table] = {
    **FORMS,
    "another size": cut(x=slice(0, 5)),
    "empty": cut(x=slice(0, 0), band=slice(0, 0)),
    "one band": cut(band=[0]),
    "a coordinate less": lambda rng, one: one.drop_vars(pick(rng, [*one.coords])),
    "a variable less": lambda rng, one: one.drop_vars(
        pick(rng, [*getattr(one, "data_vars", one.coords)])
    ),
    "an array alone": lambda _, one: first(one),
    "another dim": lambda rng, one: one.rename({pick(rng, [*one.dims]): "row"}),
    "a dim more": lambda _, one: one.expand_dims("run"),
}
"""Damage to any array, or dataset."""
