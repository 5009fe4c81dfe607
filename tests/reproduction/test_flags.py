"""Rates of false alarms and of misses of the flags."""

import numpy as np
import pytest
import xarray as xr

from dbthermal import readers, schema
from reproduction import paths
from reproduction.experiments import flags

BASE = {"emissivity": [0.86, 0.72], "start": 20.0, "stop": 45.0}
CLOCK = [350, 10.0]


def rates(expected: dict[str, list[dict[str, object]]]) -> xr.Dataset:
    """Rates over few pixels, with one clean scene."""
    return flags.rates(expected, {"clean": {}}, BASE, pixels=40, clock=CLOCK, seed=3)


@pytest.mark.parametrize("flag", flags.FAULTS)
def test_damaged_samples_are_flagged(flag: str) -> None:
    """Samples damaged in every second pixel get their flag, and no pixel is silently wrong."""
    row = rates({flag: [{}]}).sel(flag=flag)
    assert int(row["pixels"]) == 20
    assert int(row["clean_pixels"]) == 60
    assert float(row["without_it"]) == 0.0
    assert float(row["false_alarms"]) == 0.0


def test_a_flag_that_should_not_come_is_missed_and_not_wrong() -> None:
    """A clean scene named as that of a gray body counts as missed, and as right."""
    found = rates({"gray": [{}]})
    row = found.sel(flag="gray")
    np.testing.assert_allclose([row["without_it"], row["without_any"]], 1.0, rtol=0, atol=0.1)
    assert float(row["wrong"]) == 0.0
    assert bool(found["without_it"].sel(flag="saturated").isnull())


def test_table_has_the_flags_that_were_expected() -> None:
    """One row for each flag with pixels, and one for all false alarms."""
    lines = flags.table(rates({"saturated": [{}], "gray": [{}]})).splitlines()
    assert [line.split("`")[1] for line in lines[2:]] == ["gray", "saturated", "any"]


@pytest.mark.parametrize(
    ("flag", "scene"),
    [("completed_from_prior", {"still": 0.5}), ("no_reflection_pair", {"shift": [6.0, 2.0]})],
)
def test_pictures_have_pixels_with_and_without(flag: str, scene: dict[str, object]) -> None:
    """Where half a picture rests, or a border has no pair, the flag comes there and only there."""
    row = rates({flag: [scene]}).sel(flag=flag)
    assert 100 < int(row["pixels"]) < 1000
    assert float(row["without_it"]) == 0.0
    assert float(row["false_alarms"]) < 0.01


def test_every_flag_has_a_scene() -> None:
    """The full table lacks no flag but that of the optimiser, which the default way never sets."""
    listed = readers.read_yaml(paths.params("10_limits"))["cases"]["flags"]
    assert set(schema.Status.bits()) - set(listed) <= {"not_converged"}
