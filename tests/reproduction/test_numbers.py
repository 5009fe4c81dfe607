"""Headline numbers come back as they were written, or an error names the file."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import store
from reproduction import numbers

RECORD: dict[str, Any] = {"parameters": {"frames": 3}, "commit": "unknown", "inputs": {}}


def test_numbers_come_back_sorted(tmp_path: Path) -> None:
    """Numbers keep value and kind; NumPy's become Python's."""
    written: dict[str, numbers.Number | np.generic]
    written = {"rmse_K": np.float64(0.1), "frames": 350, "exact": np.True_, "method": "subspace"}
    numbers.save(written, tmp_path / "run" / "a.json", RECORD)
    opened = numbers.read(tmp_path / "run" / "a.json")
    assert list(opened) == sorted(written)
    assert opened == {"rmse_K": 0.1, "frames": 350, "exact": True, "method": "subspace"}
    assert type(opened["exact"]) is bool


@pytest.mark.parametrize("value", [math.nan, math.inf, np.float32("nan"), [1]])
def test_numbers_are_finite(value: Any, tmp_path: Path) -> None:
    """What is no finite number is refused with its name and value, and no file is written."""
    with pytest.raises((TypeError, ValueError), match=r"Invalid 'rmse_K' = .*\. Must be (a|fin)"):
        numbers.save({"rmse_K": value}, tmp_path / "a.json", RECORD)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "content",
    [
        '{"numbers": {"rmse_K": NaN}, "sha256": ""}',
        '{"numbers": {"rmse_K": 1e999}, "sha256": ""}',
        '{"numbers": {"rmse_K": ' + "9" * 5000 + "}}",
        *('{"numbers": {"a": 0.1}}', '{"numbers": {"\x00": 1}}', "{}", "[1]", '{"a": 1,\n'),
        "[" * 100_000,
    ],
)
def test_damaged_numbers_are_refused(content: str, tmp_path: Path) -> None:
    """A truncated, invalid or foreign file of numbers raises an error with its name."""
    (tmp_path / "a.json").write_text(content)
    with pytest.raises(ValueError, match=r"a\.json'?.*Must "):
        numbers.read(tmp_path / "a.json")


def test_no_flipped_bit_passes_as_a_number(tmp_path: Path) -> None:
    """Any bit that flips in a file of numbers is an error that names it, or changes no number."""
    numbers.save({"rmse_K": 0.21, "method": "subspace"}, path := tmp_path / "a.json", RECORD)
    whole, written, refused = path.read_bytes(), numbers.read(path), 0
    for bit in range(0, 8 * len(whole), 13):
        content = bytearray(whole)
        content[bit // 8] ^= 1 << bit % 8
        path.write_bytes(content)
        try:
            assert numbers.read(path) == written, bit
        except ValueError as error:
            assert "a.json" in str(error)  # noqa: PT017
            refused += 1
    assert refused > 0.97 * len(whole) * 8 / 13


def test_numbers_stay_outside_of_stores(tmp_path: Path) -> None:
    """A name without the suffix is refused, and so is a place inside a store."""
    store.save(xr.Dataset(), tmp_path / "a.zarr", RECORD)
    with pytest.raises(ValueError, match=r"Invalid path .*n\.json', inside a store"):
        numbers.save({"a": 1}, tmp_path / "a.zarr" / "n.json", RECORD)
    with pytest.raises(ValueError, match=r"Invalid path '.*a\.txt'. Must end in"):
        numbers.save({"a": 1}, tmp_path / "a.txt", RECORD)
