"""Headline numbers come back as written, or an error names the file; a run meets the reference."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from refused import assert_raises, assert_refused

from dbthermal import store
from reproduction import numbers, verify

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
    assert_refused(r"a\.json'?.*Must ", numbers.read, tmp_path / "a.json")


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


@pytest.fixture
def project(project: Path) -> Path:
    """Project folder with a run of two notebooks, made the reference."""
    results = project / "results" / "full"
    numbers.save({"netd_K": 0.03, "missed": 0}, results / "01_calibration.json", RECORD)
    numbers.save({"libraries": "embedded"}, results / "02_emissivity.json", RECORD)
    assert verify.main(["--record"]) == 0
    return project


def test_same_run_agrees(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run agrees with itself, as one without data; one without numbers is an error."""
    assert verify.main([]) == 0
    assert capsys.readouterr().out.endswith("3 of 3 numbers agree within 1%, without data\n")
    assert list(json.loads(verify.reference_path().read_text())) == ["without data"]
    assert verify.reference_path().is_relative_to(project)
    assert_raises(FileNotFoundError, "Missing numbers of run 'smoke'", verify.read_run, "smoke")
    assert verify.main(["--run", "smoke"]) == 1
    assert "Missing numbers of run 'smoke'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stem", "measured", "code"),
    [
        ("01_calibration", {"netd_K": 0.0302, "missed": 0}, 0),
        ("01_calibration", {"netd_K": 0.0306, "missed": 0}, 1),
        ("01_calibration", {"netd_K": 0.03, "missed": 1}, 1),
        ("01_calibration", {"netd_K": 0.03}, 1),
        ("01_calibration", {"netd_K": 0.03, "missed": 0, "new": 1.0}, 1),
        ("02_emissivity", {"libraries": "slum"}, 1),
    ],
)
def test_difference_is_found(project: Path, stem: str, measured: dict[str, Any], code: int) -> None:
    """Floats agree within 1 %; other, missing, further and outside data's numbers do not."""
    numbers.save(measured, project / f"results/full/{stem}.json", RECORD)
    assert verify.main([]) == code
