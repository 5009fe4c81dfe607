"""The project's folders are located from inside the project, or through the package."""

from collections.abc import Callable
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


def test_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, project: Path) -> None:
    """The folder of the manifest is the root, from below, or from the package's own folder.

    Without a manifest anywhere the error says where it was sought.
    """
    assert paths.root() == project
    monkeypatch.setattr(paths, "__file__", str(project / "dbthermal" / "paths.py"))
    monkeypatch.chdir(tmp_path.parent)
    assert paths.root() == project
    (project / "data_manifest.yaml").unlink()
    sought = f"'{tmp_path.parent}', nor '{project / 'dbthermal'}'"
    with pytest.raises(FileNotFoundError, match=sought):
        paths.root()


@pytest.mark.usefixtures("project")
def test_names_are_no_paths() -> None:
    """A run is one folder's name, a stem begins with two digits, an ending has a suffix."""
    table: list[tuple[str, Callable[[str], Path], tuple[str, ...]]] = [
        ("run", paths.results, ("", "..", "a/b", "Full")),
        ("run", paths.recordings, ("..", "a/b")),
        ("session", paths.session, ("a/b",)),
        ("stem", paths.params, ("", "simulation", "3_simulation", "03_a/b", "03_simulation.zarr")),
        (
            "ending",
            lambda name: paths.result("full", "03_simulation", name),
            ("", "zarr", "/../a.json", "_scene"),
        ),
    ]
    for kind, place, names in table:
        for name in names:
            with pytest.raises(ValueError, match=f"Invalid {kind} '{name}'. Must be"):
                place(name)
