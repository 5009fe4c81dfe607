"""A result that is not as its notebook left it is named with its maker, which then runs again."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

from dbthermal import store
from reproduction import integrity, numbers, verify
from reproduction.run import Run


@pytest.fixture
def folder(project: Path) -> Path:
    """Results of a finished notebook: a dataset, numbers, a picture and a recording."""
    (project / "params/02_reader.yaml").write_text("results: full\n")
    for stem in ("01_calibration", "02_reader"):
        (project / f"notebooks/{stem}.ipynb").touch()
    folder = project / "results/full"
    frames = xr.Dataset({"counts": ("time", np.arange(50))})
    for name in ("01_calibration_response.zarr", "01_calibration/scene.zarr"):
        store.save(frames, folder / name, {})
    numbers.save({"netd_K": 0.03}, folder / "01_calibration.json", {})
    (folder / "01_calibration_scene.png").write_bytes(b"picture")
    integrity.keep_sums("full", "01_calibration")
    (folder / "01_calibration.ipynb").touch()
    return folder


def cut(path: Path) -> None:
    """Cut a file."""
    path.write_bytes(path.read_bytes()[:-3])


def other(path: Path) -> None:
    """Change a byte of a file."""
    content = path.read_bytes()
    path.write_bytes(content[:-3] + bytes([content[-3] ^ 1]) + content[-2:])


def reader() -> Run:
    """Notebook that reads the results."""
    return Run("02_reader", {"results": "full"})


STEM = "01_calibration"
READERS: dict[str, Callable[[Path], Any]] = {
    f"{STEM}_response.zarr/counts/c/0": lambda _: reader().open(STEM, "_response"),
    f"{STEM}/scene.zarr/counts/zarr.json": lambda folder: reader().input("recorded", folder / STEM),
    f"{STEM}.json": lambda _: verify.read_run("full"),
}


@pytest.mark.parametrize("spoil", [cut, other, Path.unlink])
@pytest.mark.parametrize("name", READERS)
def test_a_spoilt_result_names_its_maker(
    folder: Path, name: str, spoil: Callable[[Path], None]
) -> None:
    """The reader names file, notebook and target; the notebook then has no name, for make."""
    read, finished = READERS[name], folder / "01_calibration.ipynb"
    read(folder)
    assert finished.exists()
    spoil(folder / name)
    with pytest.raises(integrity.DamagedError, match="made by notebook '01_calibration'") as caught:
        read(folder)
    assert name in str(caught.value)
    assert "'make results/full/01_calibration.ipynb'" in str(caught.value)
    assert not finished.exists()
    with pytest.raises(RuntimeError, match=r"Unfinished notebook '01_calibration'.*'make results"):
        reader().open("01_calibration", "_response")


@pytest.mark.parametrize("spoil", [cut, other, Path.unlink])
def test_the_check_finds_every_file(
    folder: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], None]
) -> None:
    """Before make looks at what is to be done, each file is compared with its checksum."""
    for path in [one for one in folder.rglob("*") if one.is_file() and one.suffix != ".ipynb"]:
        content = path.read_bytes()
        spoil(path)
        assert integrity.main(["full"]) == 0
        assert "The notebook is run again." in capsys.readouterr().err
        assert not (folder / "01_calibration.ipynb").exists()
        path.write_bytes(content)
        (folder / ".01_calibration.part.ipynb").rename(folder / "01_calibration.ipynb")
    assert integrity.main(["full"]) == 0
    assert (folder / "01_calibration.ipynb").exists()


def test_a_recording_that_is_short_names_its_maker(folder: Path) -> None:
    """What a reader refuses is of the notebook that recorded it, which then runs again."""

    def refuse(path: Path, frames: int) -> None:
        """Refuse a recording."""
        raise ValueError(f"29 good frames in '{path.name}'. Must have {frames}.")

    with pytest.raises(integrity.DamagedError, match=r"'01_calibration': 29 good.*'make results/f"):
        reader().read(refuse, folder / "01_calibration/scene.zarr", frames=50)
    assert not (folder / "01_calibration.ipynb").exists()
    with pytest.raises(ValueError, match="29 good frames"):  # of no notebook
        reader().read(refuse, folder.parent.parent / "elsewhere", frames=50)
