"""Bare numbers, and recordings with headers of FLIR (.sfmov) and Telops (.hcc)."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from flir_files import scene
from hostile_files import hcc, sfmov, written
from numpy.testing import assert_array_equal
from refused import assert_refused, refused

from dbthermal import readers


@pytest.mark.parametrize("ending", ["\r\n", "\n", "", f"{' ' * 69}\r\n"], ids=len)
def test_sfmov(tmp_path: Path, ending: str) -> None:
    """Frames lie behind DATA, however its line ends; the rate is that of the .inc, or stated."""
    path = written(tmp_path / "a.sfmov", sfmov(scene(), ending))
    assert_array_equal(readers.sequence(path, clock=10.0).counts, scene())
    assert_refused(r"Missing clock= for 'a\.sfmov'", readers.sequence, path)
    path.with_suffix(".inc").write_text("FRate_0 20.0\r\nITime_0 0.5\r\n")
    movie = readers.sequence(path)
    np.testing.assert_allclose(movie.time, np.arange(len(scene())) / 20.0, atol=1e-9)
    assert movie.attrs["format"] == "sfmov"
    assert_refused("Must agree to half a frame", readers.sequence, path, clock=50.0)


def test_hcc(tmp_path: Path) -> None:
    """Each frame has its time; without times that of the rate, of which one is lost."""
    path = written(tmp_path / "a.hcc", hcc(scene()))
    movie = readers.sequence(path)
    assert_array_equal(movie.counts, scene())
    np.testing.assert_allclose(movie.time, np.arange(len(scene())) / 10.0, atol=1e-6)
    path.write_bytes(hcc(scene(), times=False, rate=20_000))
    np.testing.assert_allclose(readers.sequence(path).time[1], 0.05, atol=1e-9)
    with pytest.raises(ValueError, match=r"Missing clock= for 'a\.hcc'"):
        readers.sequence(written(path, hcc(scene(), times=False, rate=0)))


test_refused_by_rule = refused(
    lambda folder, name, content: readers.sequence(written(folder / name, content), clock=10.0),
    [
        ("a.sfmov", sfmov(scene())[:-5], r"Truncated or damaged: .* with header="),
        ("a.sfmov", sfmov(scene()) + b"1234", r"Truncated or damaged"),
        ("a.sfmov", sfmov(scene(), kind="Flt32"), "Invalid DaType 'Flt32' .* 16-bit counts"),
        ("a.sfmov", b"Camera None\r\n" * 99, "Invalid header .* NumDPs, yPixls, xPixls and DATA"),
        ("a.sfmov", sfmov(scene().byteswap()), "with bytes swapped"),
        ("a.sfmov", b"", "Empty file 'a.sfmov'"),
        ("a.sfmov", hcc(scene()), "Invalid header of 'a.sfmov'"),
        ("a.hcc", b"TC", "Invalid header of 'a.hcc'"),
        ("a.hcc", sfmov(scene()), "Invalid header of 'a.hcc'. Must begin with TC"),
        ("a.hcc", hcc(scene())[:-1], r"Truncated or damaged: .* Must be whole frames"),
        ("a.hcc", hcc(scene(), mode=2), "calibration mode 2 .* temperatures or radiances"),
        ("a.hcc", hcc(scene()).replace(b"TC", b"XX", 2).replace(b"XX", b"TC", 1), "signature of"),
    ],
    "tmp_path",
    ValueError,
)


def bare(path: Path, **options: Any) -> xr.Dataset:
    """Raw counts of 24 x 32 pixels, little-endian, at 10 Hz."""
    stated = {"byte_order": "little", "unit": "count", "clock": 10.0, **options}
    return readers.raw(path, stated.pop("shape", (24, 32)), **stated)


@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", "<i4", ">u4"])
@pytest.mark.parametrize("order", ["little", "big"])
def test_longer_numbers_are_no_counts(tmp_path: Path, kind: str, order: str) -> None:
    """Numbers of 32 or 64 bits, whole or floating-point, are not taken for twice as many counts."""
    values = scene() if kind[1] in "iu" else 20 + (scene() - 17900.0) / 100
    values.astype(kind).tofile(path := tmp_path / "a.raw")
    shape = (24, 32 * np.dtype(kind).itemsize // 2)
    with pytest.raises(ValueError, match=r"no images of 16-bit numbers|rougher"):
        bare(path, shape=shape, byte_order=order)


def test_bytes_of_a_picture_are_no_counts(tmp_path: Path) -> None:
    """Numbers of 8 bits, of which two would make a count, and noise are refused."""
    path, rng = tmp_path / "a.raw", np.random.default_rng(1)
    picture = (np.hypot(*np.mgrid[:24, :64]) * 3 + rng.integers(0, 3, (3, 24, 64))).astype("u1")
    for content in (picture.tobytes(), rng.bytes(picture.size)):
        path.write_bytes(content)
        for order in ("little", "big"):
            assert_refused("no images of 16-bit numbers", bare, path, byte_order=order)


def test_signed_numbers_are_no_counts(tmp_path: Path) -> None:
    """Temperatures about 0 degC, as DJI's program writes them; saturated pixels are none."""
    path, (y, x) = tmp_path / "a.raw", np.mgrid[:48, :64]
    celsius = np.rint(150 + 165 * np.sin(y / 9) + 5 * np.cos(x / 11) + np.arange(3)[:, None, None])
    with pytest.raises(ValueError, match=r"Invalid counts of 'a\.raw': as of signed numbers"):
        bare(written(path, celsius.astype("<i2").tobytes()), shape=(48, 64))
    counts = (20000 + celsius).astype("<u2")
    counts[:, 10:20, 10:20], counts[:, 10:12, 9] = 65535, 0
    assert bare(written(path, counts.tobytes()), shape=(48, 64)).counts.max() == 65535


def test_rows_of_half_or_twice_the_length(tmp_path: Path) -> None:
    """A smooth image in rows of half or twice the length is refused; unlike even rows are not."""
    path, rng = tmp_path / "a.raw", np.random.default_rng(1)
    y, x = np.mgrid[:48, :64]
    warm = 900 * np.exp(-((y - 20) ** 2 + (x - 40) ** 2) / 300)
    path.write_bytes((20000 + warm + rng.normal(0.0, 3.0, (9, 48, 64))).astype("<u2").tobytes())
    assert not bare(path, shape=(48, 64)).attrs.get("warnings")
    for shape in ((24, 128), (96, 32)):
        assert_refused(r"Invalid shape .*: rougher than \(48, 64\)", bare, path, shape=shape)
    levels = 20000 + 50 * (y % 2) + 0.3 * y + rng.normal(0.0, 3.0, (9, 48, 64))
    assert bare(written(path, levels.astype("<u2").tobytes()), shape=(48, 64)).sizes["x"] == 64


def test_raw(tmp_path: Path) -> None:
    """Bare numbers with and without headers, in both orders; what does not fit is refused."""
    path, counts = tmp_path / "a.raw", scene()
    assert_array_equal(bare(written(path, counts.tobytes())).counts, counts)
    path.write_bytes(b"h" * 100 + b"".join(b"frame" + image.tobytes() for image in counts))
    assert_array_equal(bare(path, header=100, frame_header=5).counts, counts)
    assert_refused(r"4723 bytes of 'a\.raw': 3 frames and 115 bytes", bare, path)
    assert_refused(
        r"4723 bytes of 'a\.raw': 0 frames and 0 bytes.* behind 9999", bare, path, header=9999
    )
    path.write_bytes(counts.astype(">u2").tobytes())
    assert_array_equal(bare(path, byte_order="big").counts, counts)
    assert_refused(r"rougher than with bytes swapped", bare, path)
    with pytest.raises(ValueError, match=r"Invalid shape \(32, 24\) .*: rougher than \(24, 32\)"):
        bare(written(path, counts.tobytes()), shape=(32, 24))
    # So are rows and columns of pixels that differ more than the scene, if the scene changes.
    rng = np.random.default_rng(1)
    pattern, noise = rng.integers(0, 4000, (24, 32)), rng.normal(0.0, 3.0, (20, 24, 32))
    warming = np.einsum("t,y,x->tyx", np.arange(20), np.arange(24), np.linspace(0.0, 1.0, 32))
    for rise, is_told in ((warming, True), (np.zeros(1), False)):
        path.write_bytes((20000 + pattern + rise + noise).astype("<u2").tobytes())
        assert not bare(path).attrs.get("warnings")
        with pytest.warns(UserWarning, match="Numbers repeat after 768, not 640"):
            bare(path, shape=(20, 32))
        for height in (8, 12, 48, 96):  # parts of a frame, and several
            with pytest.warns(UserWarning, match=f"repeat after 24, not {height}"):
                bare(path, shape=(height, 32))
        if not is_told:
            assert bare(path, shape=(32, 24)).sizes["y"] == 32  # of a scene at rest
            continue
        for shape in ((32, 24), (16, 48)):
            assert_refused(r"Invalid shape .*: rougher than \(24, 32\)", bare, path, shape=shape)
    with pytest.raises(ValueError, match=r"Invalid shape \(1000000, .* of less than 2 GB"):
        bare(written(path, counts.astype(">u2").tobytes()), shape=(1_000_000, 1_000_000))
    assert_refused(r"Invalid shape \(0, 32\)", bare, path, shape=(0, 32))
    assert_refused(r"Invalid frame_header of .a.raw. -1", bare, path, frame_header=-1)
    for argument, value in {"header": "0", "frame_header": 1.5, "memory": "1e9"}.items():
        with pytest.raises(TypeError, match=rf"Invalid {argument} .*{value}.*Must be a .*number"):
            bare(path, byte_order="big", **{argument: value})
    for argument, wrong in {"shape": ("24", 32), "unit": ["count"], "byte_order": ["big"]}.items():
        with pytest.raises(ValueError, match=rf"Invalid {argument} .*a\.raw'\. Must be"):
            bare(path, **{"byte_order": "big", argument: wrong})
    assert_refused(r"Must be at most memory=100", bare, path, byte_order="big", memory=100)
