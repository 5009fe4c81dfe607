"""Comparison of a run with the reference numbers."""

import json
from pathlib import Path

import pytest

from reproduction import numbers, verify

RECORD = {"parameters": {}, "versions": {}, "commit": "unknown", "inputs": {}}


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Project folder with a run of two notebooks, made the reference."""
    (tmp_path / "data_manifest.yaml").touch()
    (tmp_path / "tests").mkdir()
    monkeypatch.chdir(tmp_path)
    results = tmp_path / "results" / "full"
    numbers.save({"netd_K": 0.03, "missed": 0}, results / "01_calibration.json", RECORD)
    numbers.save({"libraries": "embedded"}, results / "02_emissivity.json", RECORD)
    assert verify.main(["--record"]) == 0
    return tmp_path


def test_same_run_agrees(project: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A run agrees with itself, and is known to be one without data."""
    assert verify.main([]) == 0
    assert capsys.readouterr().out.endswith("3 of 3 numbers agree within 1%, without data\n")
    assert list(json.loads(verify.reference_path().read_text())) == ["without data"]
    assert verify.reference_path().is_relative_to(project)


@pytest.mark.parametrize(
    ("measured", "code"),
    [
        ({"netd_K": 0.0302, "missed": 0}, 0),
        ({"netd_K": 0.0306, "missed": 0}, 1),
        ({"netd_K": 0.03, "missed": 1}, 1),
        ({"netd_K": 0.03}, 1),
        ({"netd_K": 0.03, "missed": 0, "new": 1.0}, 1),
    ],
)
def test_difference_is_found(project: Path, measured: dict[str, float], code: int) -> None:
    """Floats agree within 1 %; other, missing and additional numbers do not agree."""
    numbers.save(measured, project / "results/full/01_calibration.json", RECORD)
    assert verify.main([]) == code


def test_other_kind_of_run_has_no_reference(project: Path) -> None:
    """A run with data is not compared with the numbers of one without."""
    numbers.save({"libraries": "slum"}, project / "results/full/02_emissivity.json", RECORD)
    assert verify.main([]) == 1


@pytest.mark.usefixtures("project")
def test_run_without_numbers_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    """A run without numbers is an error, and the command says so."""
    with pytest.raises(FileNotFoundError, match="Missing numbers of run 'smoke'"):
        verify.read_run("smoke")
    assert verify.main(["--run", "smoke"]) == 1
    assert "Missing numbers of run 'smoke'" in capsys.readouterr().err
