"""Rates of false alarms and of misses of the flags."""

from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import readers, schema
from reproduction import paths
from reproduction.experiments import flags

BASE = {"emissivity": [0.86, 0.72], "start": 20.0, "stop": 45.0}


@pytest.fixture(scope="module")
def rates() -> xr.Dataset:
    """Rates over few pixels, with one clean scene; the "gray" scene is clean as well."""
    pictures: dict[str, dict[str, Any]] = {
        "completed_from_prior": {"still": 0.5},
        "no_reflection_pair": {"shift": [6.0, 2.0]},
    }
    expected: dict[str, dict[str, Any]] = {flag: {} for flag in (*flags.FAULTS, "gray")} | pictures
    scenes = {flag: [scene] for flag, scene in expected.items()}
    return flags.rates(scenes, {"clean": {}}, BASE, pixels=40, clock=[350, 10.0], seed=3)


def test_damaged_samples_are_flagged(rates: xr.Dataset) -> None:
    """Samples damaged in every second pixel get their flag, and no pixel is silently wrong."""
    rows = rates.sel(flag=list(flags.FAULTS))
    np.testing.assert_array_equal(rows["pixels"], 20)
    np.testing.assert_array_equal(rows["clean_pixels"], 60)
    np.testing.assert_array_equal(rows["without_it"], 0.0)
    np.testing.assert_array_equal(rows["false_alarms"], 0.0)


def test_a_flag_that_should_not_come_is_missed_and_not_wrong(rates: xr.Dataset) -> None:
    """A clean scene named as that of a gray body counts as missed, and as right."""
    row = rates.sel(flag="gray")
    np.testing.assert_allclose([row["without_it"], row["without_any"]], 1.0, rtol=0, atol=0.1)
    assert float(row["wrong"]) == 0.0
    assert bool(rates["without_it"].sel(flag="dead_pixel").isnull())


def test_pictures_have_pixels_with_and_without(rates: xr.Dataset) -> None:
    """Where half a picture rests, or a border has no pair, the flag comes there and only there."""
    rows = rates.sel(flag=["completed_from_prior", "no_reflection_pair"])
    assert bool(((rows["pixels"] > 100) & (rows["pixels"] < 1000)).all())
    np.testing.assert_array_equal(rows["without_it"], 0.0)
    assert float(rows["false_alarms"].max()) < 0.01


def test_every_flag_has_a_scene() -> None:
    """The full table lacks no flag but that of the optimiser, which the default way never sets."""
    listed = readers.read_yaml(paths.params("10_limits"))["cases"]["flags"]
    assert set(schema.Status.bits()) - set(listed) <= {"not_converged"}
