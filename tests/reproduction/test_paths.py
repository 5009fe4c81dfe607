"""The project's folders are located from inside the project, or through the package."""

from pathlib import Path

import pytest

from reproduction import paths


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Empty project, with the current folder inside its notebooks."""
    (tmp_path / "data_manifest.yaml").touch()
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path / "notebooks")
    return tmp_path.resolve()


def test_root_is_found_upwards(project: Path) -> None:
    """The folder that holds the manifest is the root, from below as from itself."""
    assert paths.root() == project


def test_root_is_found_through_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, project: Path
) -> None:
    """Outside any project the package's own folder leads to the root."""
    monkeypatch.setattr(paths, "__file__", str(project / "dbthermal" / "paths.py"))
    monkeypatch.chdir(tmp_path.parent)
    assert paths.root() == project


def test_missing_root_names_both_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a manifest anywhere the error says where it was sought."""
    monkeypatch.setattr(paths, "__file__", str(tmp_path / "package" / "paths.py"))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=f"'{tmp_path}', nor '{tmp_path / 'package'}'"):
        paths.root()


def test_one_stem_names_all(project: Path) -> None:
    """Parameters, results and cached experiments share their stem."""
    assert paths.params("03_simulation") == project / "params" / "03_simulation.yaml"
    assert paths.result("full", "03_simulation", "_scene.png") == (
        project / "results" / "full" / "03_simulation_scene.png"
    )
    assert paths.cells("03_simulation") == project / "results" / "cells" / "03_simulation"


def test_fixed_places(project: Path) -> None:
    """The manifest and the fetched files lie at the root."""
    assert paths.manifest() == project / "data_manifest.yaml"
    assert paths.data() == project / "data"
    assert paths.session("scene") == project / "params" / "sessions" / "scene.yaml"
    with pytest.raises(ValueError, match="Invalid session 'a/b'"):
        paths.session("a/b")


def test_what_was_measured_lies_apart(project: Path) -> None:
    """Recordings of hardware lie apart from the results that tasks remove."""
    assert paths.recordings("lab") == project / "recordings" / "lab"
    made = paths.emulated("full", "00_acquisition")
    assert made == project / "results" / "full" / "00_acquisition"
    for run in ("..", "a/b"):
        with pytest.raises(ValueError, match="Invalid run"):
            paths.recordings(run)


@pytest.mark.usefixtures("project")
@pytest.mark.parametrize("run", ["", "..", "a/b", "Full"])
def test_run_is_one_folder_name(run: str) -> None:
    """A run's name with a path in it raises an error."""
    with pytest.raises(ValueError, match=f"Invalid run '{run}'. Must be"):
        paths.results(run)


@pytest.mark.parametrize("stem", ["", "simulation", "3_simulation", "03_a/b", "03_simulation.zarr"])
def test_stem_is_numbered(stem: str) -> None:
    """A stem starts with the notebook's number and holds no folder or suffix."""
    with pytest.raises(ValueError, match=f"Invalid stem '{stem}'. Must be two digits"):
        paths.params(stem)


@pytest.mark.parametrize("ending", ["", "zarr", "/../a.json", "_scene"])
def test_ending_has_a_suffix(ending: str) -> None:
    """A result's ending has a suffix and no folder."""
    with pytest.raises(ValueError, match=f"Invalid ending '{ending}'. Must be"):
        paths.result("full", "03_simulation", ending)
