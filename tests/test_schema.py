"""The glossary: valid datasets of each stage, and the error of each violated rule."""

import re
import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from refused import assert_refused, refused

from dbthermal import schema, store
from dbthermal.schema import Status

SIZES = {"band": 2, "time": 3, "temperature": 4, "wavelength": 5}


def example(stage: str) -> xr.Dataset:
    """Make the smallest dataset that a stage takes, by its own definitions."""
    dataset = xr.Dataset(
        {
            name: (one.dims, np.ones([SIZES.get(n, 2) for n in one.dims], one.dtype), one.attrs)
            for name, one in schema.STAGES[stage].items()
        }
    )
    places = {dim: np.arange(1.0, 1.0 + size) for dim, size in dataset.sizes.items()}
    return dataset.assign_coords(places | ({"band": ["a", "b"]} if "band" in places else {}))


@pytest.mark.parametrize("stage", schema.STAGES)
def test_every_stage_takes_its_own(stage: str) -> None:
    """A dataset made by the definitions passes as it is; a variable less is named."""
    dataset = example(stage)
    before = dataset.copy(deep=True)
    assert schema.check(dataset, stage) is dataset
    xr.testing.assert_identical(dataset, before)
    for name in schema.STAGES[stage]:
        with pytest.raises(ValueError, match=f"Missing variable '{name}' in the {stage}"):
            schema.check(dataset.drop_vars(name), stage)


def test_another_stage_is_named() -> None:
    """A response for a correction is said to be one; a capture may lack its units."""
    capture = example("capture")
    counts = capture["counts"].drop_attrs(deep=False).astype(np.float32)
    changed = capture.assign(counts=counts)
    assert schema.check(changed, "capture") is changed
    with pytest.raises(ValueError, match=r"Missing variable 'gain' .*, as has a response\."):
        schema.check(example("response"), "correction")


Change = Callable[[xr.Dataset], xr.Dataset]


def timed(values: object, units: str = "s") -> Change:
    """Change of the times."""
    return lambda ds: ds.assign_coords(time=("time", values, {"units": units}))


test_bad_capture = refused(
    lambda change: schema.check(change(example("capture")), "capture"),
    [
        (
            lambda ds: ds.transpose("time", "band", "y", "x"),
            "Invalid dims ('time', 'band', 'y', 'x",
        ),
        (lambda ds: ds.isel(time=0), "Invalid dims ('band', 'y', 'x') of 'counts' of the capture"),
        (lambda ds: ds.isel(x=slice(0)), "Empty 'counts' of the capture: sizes {'band': 2"),
        (lambda ds: ds.assign(counts=ds.counts.assign_attrs(units="K")), "units 'K' of 'counts'"),
        (lambda ds: ds.drop_vars("band"), "Missing coordinate 'band' of 'counts'"),
        (lambda ds: ds.assign_coords(band=["a", "a"]), "Repeated band in ['a', 'a']"),
        (lambda ds: ds.drop_vars("time"), "Missing coordinate 'time' of 'counts'"),
        (timed([1, 2, 3], "ms"), "units 'ms' of 'time' of 'counts' of the capture. Must be 's'"),
        (timed([1.0, 2.0, np.nan]), "Invalid 'time' of 'counts' of the capture: not finite"),
        (timed([1.0, 3.0, 2.0]), "Unordered 'time' of 'counts' of the capture: 3.0 s is followed"),
        (timed([1.0, 1.0, 2.0]), "1.0 s is followed by 1.0 s. Must increase strictly"),
        (timed(["0", "1", "2"]), "Invalid dtype <U1 of 'time'"),
        (
            timed(np.arange(3).astype("m8[ms]")),
            "dtype timedelta64[ms] of 'time' of 'counts' of the",
        ),
        (lambda ds: ds.astype(complex), "Invalid dtype complex128 of 'counts'"),
        (lambda ds: ds.astype(bool), "Invalid dtype bool of 'counts'"),
        (lambda ds: ds.astype(str), "Invalid dtype <U5 of 'counts'"),
        (lambda ds: ds["counts"], "Invalid capture of type DataArray. Must be a Dataset"),
    ],
)


def test_coordinates_of_other_stages() -> None:
    """Unordered temperatures and wavelengths raise an error, as times do."""
    for stage, name in (("blackbody", "temperature"), ("spectrum", "wavelength")):
        turned = example(stage)
        with pytest.raises(ValueError, match=f"Unordered '{name}' of"):
            schema.check(turned.isel({name: slice(None, None, -1)}), stage)
    with pytest.raises(ValueError, match=re.escape("Unknown stage 'raw'. Must be one of ['black")):
        schema.check(example("capture"), "raw")


def test_units_are_si() -> None:
    """Every variable and coordinate has a unit that the glossary allows."""
    allowed = {"K", "count", "1", "m", "s", "m K", "count K-1", "pixel"}
    variables = [one for stage in schema.STAGES.values() for one in stage.values()]
    assert {one.units for one in [*variables, *schema.COORDINATES.values()]} <= allowed


def test_status_bits_are_documented() -> None:
    """Each bit of `status` is one of 32, named and explained once."""
    values = [bit.value for bit in Status]
    assert all(value.bit_count() == 1 for value in values)
    assert len({bit.meaning for bit in Status}) == len(set(values)) == len(values)
    assert all(bit.meaning for bit in Status)
    assert sum(values) <= np.iinfo(np.uint32).max
    assert Status(1024 | 4) == Status.DEAD_PIXEL | Status.GRAY


def test_status_attributes_follow_cf() -> None:
    """One mask a meaning, in the dtype of the status."""
    attrs = Status.cf_attrs(schema.STATUS)
    masks, meanings = attrs["flag_masks"], str(attrs["flag_meanings"]).split()
    assert isinstance(masks, np.ndarray)
    assert masks.dtype == np.dtype(schema.STAGES["separated"]["status"].dtype)
    assert dict(zip(meanings, masks.tolist(), strict=True)) == Status.bits()


def test_status_of_16_bits_still_opens(tmp_path: Path) -> None:
    """A result stored with a 16-bit status passes its stage, and its bits mean the same."""
    older = example("separated")
    older["object_temperature"].values[:] = 300.0  # [K]
    bits = np.array([[0, 1024], [1 << 15, 128 | 4]], dtype=np.uint16)
    first = {name: bit for name, bit in Status.bits().items() if bit < 1 << 16}
    meanings = " ".join(first)
    masks = np.array(list(first.values()), dtype=np.uint16)
    attrs = {"units": "1", "flag_masks": masks, "flag_meanings": meanings}
    store.save(older.assign(status=(("y", "x"), bits, attrs)), tmp_path / "older.zarr", {})
    opened = schema.check(store.open_dataset(tmp_path / "older.zarr"), "separated")["status"]
    assert opened.dtype == np.uint16
    for name, value in first.items():
        np.testing.assert_array_equal(schema.has_flag(opened, name), bits & value != 0)
    assert Status(int(opened[1, 1])) == Status.SATURATED | Status.GRAY


def test_flags_are_read_by_name() -> None:
    """Any of several flags counts; an unknown name raises an error."""
    status = xr.DataArray(np.array([0, 1, 1024]), dims="x", attrs=Status.cf_attrs(schema.STATUS))
    found = schema.has_flag(status, "dead_pixel", "no_background_motion")
    np.testing.assert_array_equal(found, [False, True, True])
    assert found.dtype == bool
    assert_refused("Unknown flag 'closed'", schema.has_flag, status, "closed")
    assert_refused("Unknown flag 'gray'", schema.has_flag, status.drop_attrs(), "gray")


def test_committed_nomenclature_is_the_glossary_s() -> None:
    """docs/nomenclature.md is what docs/nomenclature.py makes of the glossary."""
    page = Path(__file__).parents[1] / "docs" / "nomenclature.md"
    made = runpy.run_path(str(page.with_suffix(".py")))["nomenclature"]()
    assert page.read_text(encoding="utf-8") == made
