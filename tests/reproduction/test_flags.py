"""Rates of false alarms and of misses of the flags."""

import numpy as np
import pytest
import xarray as xr

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
    assert int(row["clean_pixels"]) == 40
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
