"""What a file is, by its first bytes: for commands and for readers, whatever its name."""

from pathlib import Path
from typing import Any

import hostile_files as hostile
import imagecodecs
import numpy as np
import pytest
import xarray as xr
import zarr
from flir_files import scene
from numpy.testing import assert_array_equal
from refused import assert_refused

from dbthermal import readers
from dbthermal.__main__ import main

PACKED = {"\x1f\x8b\x08": "gzip", "BZh": "bzip2", "\xfd7zXZ": "xz", "7z\xbc": "7z", "Rar!": "rar"}
STATED = ["--unit", "count", "--clock", "10"]


def info(capsys: pytest.CaptureFixture[str], *words: Any) -> tuple[int, str]:
    """Exit status of `info`, and all that it prints."""
    status = main(["info", *map(str, words)])
    return int(status or 0), "".join(capsys.readouterr())


def test_commands_read_by_first_bytes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """HDF5, TIFF, PNG, FLIR, Telops and zarr of any name open by one command, with their times."""
    forms = {"a.hdf": "h5", "a.dat": "tif", "b.bin": "seq", "b.hcc": "hcc", "b.sfmov": "sfmov"}
    for name, form in forms.items():
        hostile.write(tmp_path / name, form)
    (tmp_path / "a1.bin").write_bytes(imagecodecs.png_encode(scene()[0]))
    zarr.create_array(tmp_path / "a.zarr", data=scene())
    film = xr.DataArray(scene(), dims=("time", "y", "x"), name="frames")
    moments = np.datetime64("2026-01-01", "ns") + np.arange(3) * np.timedelta64(100, "ms")
    film = film.assign_coords(time=moments)
    film.to_dataset().to_zarr(tmp_path / "b.zarr", zarr_format=3, consolidated=False)
    for name, stated, words in (
        ("a.hdf", STATED, "stage: recording"),
        ("a.dat", STATED, "stage: recording"),
        ("a1.bin", STATED, "stage: recording"),
        ("b.bin", (), "stage: recording"),
        ("b.hcc", (), "frame_rate_Hz: 10.0"),
        ("b.sfmov", (), "clock: not in the file"),
        ("a.zarr", (), "clock: not in the file"),
        ("b.zarr", (), "frame_rate_Hz: 10.0"),
    ):
        status, text = info(capsys, tmp_path / name, *stated)
        assert status == 0, text
        assert words in text


@pytest.mark.parametrize("name", ["a.raw", "a.bin", "a", "a.dat"])
def test_bare_numbers_ask_for_their_form(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    """A file of unknown first bytes is no FLIR recording: its form must be stated."""
    scene().tofile(path := tmp_path / name)
    status, text = info(capsys, path, *STATED)
    assert status == 1
    assert "bare numbers need --shape and --byte-order" in text
    assert "FLIR" not in text
    form = ["--shape", "24", "32", "--byte-order", "little"]
    assert info(capsys, path, *STATED, *form)[0] == 0


def test_foreign_formats_are_named(tmp_path: Path) -> None:
    """Formats without a reader are called by their names, with a way on, by every reader."""
    starts = {
        "RIFFxxxxAVI ": "film: .* gray16le",
        "\x1aE\xdf\xa3": "film: .* gray16le",
        "GIF89a": "film: .* 8 bits",
        "RIFFxxxxWEBP": "picture: .* 8 bits",
        "\x0e\x03\x13\x01": "HDF4: convert it",
        "SIMPLE  =    T": "FITS: save its array",
        **{mark: f"{name}: unpack it" for mark, name in PACKED.items()},
        "P5\n24 32": "PGM: save it as PNG",
        "\x80\x04\x95": "pickle: save its array",
    }
    path, stated = tmp_path / "a.dat", {"unit": "count", "clock": 10.0}
    options: dict[Any, Any] = {readers.flir: {}, readers.tiff: stated, readers.array: stated}
    for start, expected in starts.items():
        path.write_bytes(start.encode("latin-1") + bytes(100))
        for read, form in options.items():
            assert_refused(rf"Refused 'a\.dat', a {expected}", read, path, **form)
    ways = {
        "ravi": "export its counts as 16-bit TIFF",
        "irb": "export its counts",
        "xlsx": "a table: export 16",
    }
    for suffix, way in ways.items():
        (tmp_path / f"a.{suffix}").write_bytes(b"something else")
        assert_refused(rf"Refused 'a\.{suffix}': {way}", readers.flir, tmp_path / f"a.{suffix}")


@pytest.mark.parametrize("name", ["a.csv", "a.tif", "a.npy", "a"])
def test_texts_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    """A table, a page of a server or a pointer to a file is a text, whatever its name."""
    for content in ("21,5;21,6\n" * 9, "<!DOCTYPE html><html>", "version https://git-lfs\n"):
        for encoding in ("utf-8", "utf-8-sig", "utf-16"):
            (tmp_path / name).write_text(content, encoding=encoding)
            status, text = info(capsys, tmp_path / name)
            assert (status, f"Refused '{name}', a text" in text) == (1, True)


def test_another_reader_is_named(tmp_path: Path) -> None:
    """A file of a format that another reader opens says which; a folder is named by its files."""
    with pytest.raises(ValueError, match=r"Invalid folder .* Must be files: .*/\*\.tif"):
        readers.tiff(tmp_path, unit="count", clock=10.0)
    for form in ("npy", "seq", "hcc", "tif"):
        hostile.write(tmp_path / f"a.{form}", form)
    for name, wrong, right in (
        ("a.npy", readers.tiff, "array"),
        ("a.seq", readers.array, "flir"),
        ("a.tif", readers.array, "tiff"),
    ):
        with pytest.raises(ValueError, match=rf"Must be read by readers\.{right}"):
            wrong(tmp_path / name, unit="count", clock=10.0)
    assert_refused(r"Must be read by readers\.sequence", readers.flir, tmp_path / "a.hcc")


@pytest.mark.parametrize("form", [*hostile.FLIR, *hostile.TIFF])
def test_rows_take_no_more_memory(tmp_path: Path, form: str) -> None:
    """Selected rows are those of the whole image, within a memory that the image exceeds."""
    path = hostile.write(tmp_path / f"a.{form}", form)
    whole = hostile.read(path, form)["counts"].values
    frames, height, width = whole.shape
    memory = 2 * (2 * frames + 3 * height) * width
    rows = hostile.read(path, form, rows=slice(3, 5), memory=memory)
    assert_array_equal(rows["counts"], whole[:, 3:5])
    with pytest.raises(ValueError, match=r"Invalid size of 'a\..* Must be at most memory="):
        hostile.read(path, form, rows=slice(3, 6), memory=memory)
    with pytest.raises(ValueError, match=rf"Invalid rows slice.* Must be some of its {height}"):
        hostile.read(path, form, rows=slice(height, None))
