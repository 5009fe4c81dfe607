"""Results of a notebook bear its stem and provenance; folders are found from anywhere."""

import json
from collections.abc import Callable
from pathlib import Path

import joblib
import numpy as np
import pytest
import xarray as xr
from refused import assert_raises, assert_refused

from dbthermal import figures, store
from reproduction import manifest, paths
from reproduction.run import Run


@pytest.fixture
def run(project: Path) -> Run:
    """Run of a notebook with two parameters, in a project of its own."""
    (project / "params" / "03_simulation.yaml").write_text("results: full\nseed: 1\n")
    return Run("03_simulation", {"results": "smoke", "seed": 2, "other": object()})


DATASET = xr.Dataset({"value": ("n", np.arange(3.0))})


def doubled(value: float) -> xr.Dataset:
    """Example of an experiment."""
    return xr.Dataset({"value": 2 * value})


def test_parameters_of_the_run(run: Run) -> None:
    """The provenance holds the values that the notebook has, of the names in the YAML file."""
    assert run.provenance["parameters"] == {"results": "smoke", "seed": 2}
    with pytest.raises(KeyError, match="Missing parameter 'seed' of '03_simulation'"):
        Run("03_simulation", {"results": "smoke"})


def test_results_lie_under_the_stem(run: Run, tmp_path: Path) -> None:
    """All is saved; figures and numbers are handed back; labels must say their unit."""
    figure, axes = figures.drawing.canvas(1, 1, (2.0, 2.0))
    run.save(DATASET)
    run.text("# Table", "_table")
    assert run.figure(figure, "_scene") is figure
    assert run.finish({"rmse_K": 0.2}) == {"rmse_K": 0.2}
    endings = sorted(path.name for path in (tmp_path / "results" / "smoke").iterdir())
    suffixes = (".json", ".zarr", "_scene.png", "_table.md")
    assert endings == [f"03_simulation{suffix}" for suffix in suffixes]
    saved = json.loads((tmp_path / "results/smoke/03_simulation.json").read_text())
    assert saved["provenance"] == run.provenance
    axes[0, 0].set(xlabel="time [s]", ylabel="error")
    with pytest.raises(ValueError, match=r"Invalid label 'error' of a figure\. Must have a unit"):
        run.figure(figure, "_scene")


def test_inputs_are_noted(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A result of another notebook by its checksum; a collection that is not available is none."""
    path = tmp_path / "results" / "smoke" / "01_calibration_response.zarr"
    store.save(DATASET, path, {})
    assert run.open("01_calibration", "_response").equals(DATASET)
    monkeypatch.setattr(manifest, "available", lambda _: False)
    assert run.data("scenes") == {}
    assert run.provenance["inputs"] == {"01_calibration_response": store.checksum(path)}


def test_experiment_is_cached(run: Run, tmp_path: Path) -> None:
    """Results of an experiment are cached in the notebook's own folder."""
    twice = run.cached(doubled)
    assert [float(part["value"]) for part in joblib.Parallel(1)([twice(3.0)])] == [6.0]
    assert len(list((tmp_path / "results" / "cells" / "03_simulation").rglob("*.pkl"))) == 1


@pytest.mark.usefixtures("run")
def test_root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The manifest's folder, from below or the package's; without one the error says where."""
    project = tmp_path.resolve()
    monkeypatch.chdir(tmp_path / "params")
    assert paths.root() == project
    monkeypatch.setattr(paths, "__file__", str(project / "dbthermal" / "paths.py"))
    monkeypatch.chdir(tmp_path.parent)
    assert paths.root() == project
    (project / "data_manifest.yaml").unlink()
    sought = f"'{tmp_path.parent}', nor '{project / 'dbthermal'}'"
    assert_raises(FileNotFoundError, sought, paths.root)


@pytest.mark.usefixtures("run")
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
            assert_refused(f"Invalid {kind} '{name}'. Must be", place, name)
