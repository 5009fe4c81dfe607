"""Recordings with headers of FLIR (.sfmov) and Telops (.hcc), written here by their layouts."""

from pathlib import Path

import numpy as np
import pytest
from flir_files import scene
from hostile_files import hcc, sfmov

from dbthermal import readers
from dbthermal.__main__ import main


def written(path: Path, content: bytes) -> Path:
    """File of a content."""
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("ending", ["\r\n", "\n", "", f"{' ' * 69}\r\n"], ids=len)
def test_sfmov(tmp_path: Path, ending: str) -> None:
    """Frames lie behind DATA, however its line ends; the rate is that of the .inc, or stated."""
    path = written(tmp_path / "a.sfmov", sfmov(scene(), ending))
    np.testing.assert_array_equal(readers.sequence(path, clock=10.0).counts, scene())
    with pytest.raises(ValueError, match=r"Missing clock= for 'a\.sfmov'"):
        readers.sequence(path)
    path.with_suffix(".inc").write_text("FRate_0 20.0\r\nITime_0 0.5\r\n")
    movie = readers.sequence(path)
    np.testing.assert_allclose(movie.time, np.arange(len(scene())) / 20.0, atol=1e-9)
    assert movie.attrs["format"] == "sfmov"
    with pytest.raises(ValueError, match="Must agree to half a frame"):
        readers.sequence(path, clock=50.0)


def test_hcc(tmp_path: Path) -> None:
    """Each frame has its time; without times that of the rate, of which one is lost."""
    path = written(tmp_path / "a.hcc", hcc(scene()))
    movie = readers.sequence(path)
    np.testing.assert_array_equal(movie.counts, scene())
    np.testing.assert_allclose(movie.time, np.arange(len(scene())) / 10.0, atol=1e-6)
    path.write_bytes(hcc(scene(), times=False, rate=20_000))
    np.testing.assert_allclose(readers.sequence(path).time[1], 0.05, atol=1e-9)
    path.write_bytes(hcc(scene(), times=False, rate=0))
    with pytest.raises(ValueError, match=r"Missing clock= for 'a\.hcc'"):
        readers.sequence(path)


@pytest.mark.parametrize(
    ("name", "content", "rule"),
    [
        ("a.sfmov", sfmov(scene())[:-5], r"Truncated or damaged: .* with header="),
        ("a.sfmov", sfmov(scene()) + b"1234", r"Truncated or damaged"),
        ("a.sfmov", sfmov(scene(), kind="Flt32"), "Invalid DaType 'Flt32' .* 16-bit counts"),
        ("a.sfmov", b"Camera None\r\n" * 99, "Invalid header .* NumDPs, yPixls, xPixls and DATA"),
        ("a.sfmov", sfmov(scene().byteswap()), "bytes swapped"),
        ("a.sfmov", b"", "Empty file 'a.sfmov'"),
        ("a.sfmov", hcc(scene()), "Invalid header of 'a.sfmov'"),
        ("a.hcc", b"", "Empty file 'a.hcc'"),
        ("a.hcc", b"TC", "Invalid header of 'a.hcc'"),
        ("a.hcc", sfmov(scene()), "Invalid header of 'a.hcc'. Must begin with TC"),
        ("a.hcc", hcc(scene())[:-1], r"Truncated or damaged: .* Must be whole frames"),
        ("a.hcc", hcc(scene(), mode=2), "calibration mode 2 .* temperatures or radiances"),
        ("a.hcc", hcc(scene()).replace(b"TC", b"XX", 2).replace(b"XX", b"TC", 1), "signature of"),
        ("a.hcc", b"II*\0" * 99, r"Must be read by readers\.tiff"),
    ],
)
def test_refused_by_rule(tmp_path: Path, name: str, content: bytes, rule: str) -> None:
    """Truncated, empty, mixed up, or of other numbers: refused, and never read as counts."""
    with pytest.raises(ValueError, match=rule):
        readers.sequence(written(tmp_path / name, content), clock=10.0)


def test_by_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Commands open both by their suffix, and another reader names this one."""
    a = written(tmp_path / "a.hcc", hcc(scene()))
    b = written(tmp_path / "b.sfmov", sfmov(scene()))
    for path, words in ((a, "frame_rate_Hz: 10.0"), (b, "clock: not in the file")):
        assert main(["info", str(path)]) == 0
        assert words in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"Must be read by readers\.sequence"):
        readers.flir(a)
