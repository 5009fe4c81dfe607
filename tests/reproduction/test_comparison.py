"""Comparisons: every method on the same pixels, in cells that are done once."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import store
from reproduction import experiments
from reproduction.experiments import memory

PLATE: dict[str, Any] = {"frames": 120, "shape": [10, 24], "crossings": 6}
VARIANTS: dict[str, dict[str, Any]] = {
    "subspace": {"method": "subspace"},
    "calibrated": {"method": "calibrated"},
    "prior": {"method": "bcp"},
}
CELL: dict[str, Any] = {
    "emissivity": [0.86, 0.72],
    "noise": [0.03, 0.35],
    "variants": VARIANTS,
    "plate": PLATE,
    "pixels": 20,
    "seed": 2,
}


def counted(folder: str, value: float, seed: int) -> xr.Dataset:
    """Leave a mark for each call, and return something random."""
    (Path(folder) / f"call-{value}-{len(list(Path(folder).iterdir()))}").touch()
    if value < 0:
        raise ValueError("interrupted")
    return xr.Dataset({"drawn": ("n", value + np.random.default_rng(seed).random(3))})


@pytest.fixture
def marks(tmp_path: Path) -> Path:
    """Folder for the marks of `counted`."""
    (tmp_path / "marks").mkdir()
    return tmp_path / "marks"


def test_a_cell_is_done_once(tmp_path: Path, marks: Path) -> None:
    """A second run returns the same and computes nothing; a new cell is computed."""
    cells = [{"folder": str(marks), "value": value, "seed": 1} for value in (1.0, 2.0)]
    first = experiments.remembered(counted, cells, tmp_path / "cells")
    again = experiments.remembered(counted, cells, tmp_path / "cells")
    xr.testing.assert_identical(xr.concat(first, "cell"), xr.concat(again, "cell"))
    assert len(list(marks.iterdir())) == 2
    experiments.remembered(counted, [*cells, {**cells[0], "seed": 2}], tmp_path / "cells")
    assert len(list(marks.iterdir())) == 3


def test_an_interruption_loses_nothing(tmp_path: Path, marks: Path) -> None:
    """What was done before it is kept; what was not leaves nothing."""
    cells = [{"folder": str(marks), "value": value, "seed": 1} for value in (1.0, -1.0, 3.0)]
    with pytest.raises(ValueError, match="interrupted"):
        experiments.remembered(counted, cells, tmp_path / "cells")
    assert len(list((tmp_path / "cells").iterdir())) == 1
    experiments.remembered(counted, [cells[0], cells[2]], tmp_path / "cells")
    assert len(list(marks.iterdir())) == 3


def test_changed_code_starts_anew(
    tmp_path: Path, marks: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cell of other source code is not used."""
    cells = [{"folder": str(marks), "value": 1.0, "seed": 1}]
    experiments.remembered(counted, cells, tmp_path / "cells")
    monkeypatch.setattr("dbthermal.store._provenance.source", lambda *_: "other")
    with pytest.raises(RuntimeError, match=r"Changed source code\. Must be as it was imported"):
        experiments.remembered(counted, cells, tmp_path / "cells")
    monkeypatch.setattr("reproduction.experiments.memory._SOURCE", "other")
    experiments.remembered(counted, cells, tmp_path / "cells")
    assert len(list(marks.iterdir())) == 2


def test_several_processes_find_the_same(tmp_path: Path) -> None:
    """The number of processes changes nothing."""
    cells = [{**CELL, "pixels": 4, "seed": seed} for seed in (1, 2)]
    alone = experiments.remembered(experiments.compare, cells, tmp_path / "a")
    shared = experiments.remembered(experiments.compare, cells, tmp_path / "b", workers=2)
    for first, second in zip(alone, shared, strict=True):
        xr.testing.assert_identical(first.drop_attrs(), second.drop_attrs())


def test_all_methods_see_the_same_pixels() -> None:
    """Each has its errors at each pixel; known emissivities have none."""
    found = experiments.compare(**CELL)
    assert found.attrs["origin"] == "simulated"
    assert dict(found.sizes) == {"variant": 3, "pixel": 20, "band": 2}
    assert float(found["emissivity_error"].sel(variant="calibrated").max()) < 1e-6
    assert np.all(found["object_temperature_rmse"].sel(variant="prior") > 0)


def test_pixels_without_reflection_take_no_part() -> None:
    """More pixels than those in which somebody is reflected are refused, with their number."""
    with pytest.raises(ValueError, match=r"Invalid number of pixels 240\. Must be at most"):
        experiments.compare(**{**CELL, "pixels": 240})


def test_medians_count_what_the_default_solves() -> None:
    """A pixel that the default gives up is left out; one that another loses is its worst."""
    rmse = [[0.1, 0.3, np.nan, 0.2], [1.0, np.nan, 90.0, 2.0]]
    comparison = xr.Dataset(
        {
            "object_temperature_rmse": (("variant", "pixel"), rmse, {"units": "K"}),
            "emissivity_error": (
                ("variant", "band", "pixel"),
                np.full((2, 2, 4), 0.05),
                {"units": "1"},
            ),
            "status": (("variant", "pixel"), [[0, 0, 1, 0], [0, 4, 0, 0]]),
        },
        coords={"variant": ["subspace", "other"]},
    )
    found = experiments.medians(comparison)
    np.testing.assert_allclose(found["object_temperature_rmse"], [0.2, 2.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["solved"], [0.75, 0.75], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found["good"], [0.75, 0.75], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found["wrong"], [0.0, 0.0])
    lost = experiments.medians(comparison.isel(pixel=[1, 2]))
    assert np.isnan(lost["object_temperature_rmse"].sel(variant="other"))


def test_a_failure_begins_no_further_cell(tmp_path: Path, marks: Path) -> None:
    """With several processes too, what waits is not begun."""
    cells = [{"folder": str(marks), "value": value, "seed": 1} for value in (-1.0, *range(1, 40))]
    with pytest.raises(ValueError, match="interrupted"):
        experiments.remembered(counted, cells, tmp_path / "cells", workers=2)
    assert len(list(marks.iterdir())) < 30


def test_another_process_was_first(tmp_path: Path, marks: Path) -> None:
    """A cell that another process has made meanwhile is not made again."""
    cell = {"folder": str(marks), "value": 1.0, "seed": 1}
    (first,) = experiments.remembered(counted, [cell], tmp_path / "cells")
    (path,) = (tmp_path / "cells").iterdir()
    memory._keep(counted, path, cell)
    assert len(list(marks.iterdir())) == 1
    xr.testing.assert_identical(store.open_dataset(path).load(), first)


def test_a_cell_on_disk_says_what_made_it(tmp_path: Path, marks: Path) -> None:
    """Its parameters are in its record."""
    cells = [{"folder": str(marks), "value": 1.0, "seed": 7}]
    experiments.remembered(counted, cells, tmp_path / "cells")
    (path,) = (tmp_path / "cells").iterdir()
    assert store.open_dataset(path).attrs["provenance"]["parameters"]["seed"] == 7
