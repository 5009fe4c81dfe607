"""FLIR recordings: counts, clock and camera of golden files and of made-up ones."""

import hashlib
import struct
import sys
import zlib
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
import xarray as xr
from flir_files import CONSTANTS, compressed, jpeg, scene, sequence
from hostile_files import written
from numpy.testing import assert_allclose, assert_array_equal
from refused import assert_refused, refused

from dbthermal import readers, schema

# Of the counts (time, y, x), little-endian. Those of JPEG-LS and PNG are the same by imagecodecs
# 2026.6, whose decoders are CharLS and libpng.
GOLDEN = {
    "SampleSEQ.seq": ((2, 480, 640), "little", "1953f0aa067cac00"),
    "SampleCSQ.csq": ((8, 768, 1024), "none: numbers are coded", "cec34830cbf7df2f"),
    "IR_2412.jpg": ((1, 480, 640), "little", "b85f16186f688e38"),
    "ax8.jpg": ((1, 60, 80), "little", "deb866526985bf7a"),
    "flir_example.jpg": ((1, 320, 240), "little", "02375a5e6c6a6254"),
    "frame_000000.fff": ((1, 512, 640), "little", "0868740d7414ce78"),
    "frame_000000_le.fff": ((1, 240, 320), "little", "88916e0aea22bd46"),
}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Recording that is not yet written."""
    return tmp_path / "a.seq"


def flir(path: Path, content: bytes, clock: float | None = None) -> xr.Dataset:
    """Reading of a file of a content."""
    return readers.flir(written(path, content), clock=clock)


@pytest.mark.data
@pytest.mark.parametrize("name", GOLDEN)
def test_golden_counts(mirror: Path, name: str) -> None:
    """Counts, shape and byte order of real files, by hash."""
    shape, order, digest = GOLDEN[name]
    read = readers.flir(mirror / "recordings" / name)
    assert read.counts.shape == shape
    assert read.counts.dtype == np.uint16
    assert read.attrs["byte_order"] == order
    found = hashlib.sha256(read.counts.values.astype("<u2").tobytes()).hexdigest()
    assert found[:16] == digest


@pytest.mark.data
def test_golden_clocks(mirror: Path) -> None:
    """A sequence has the times of its camera, frame by frame, and no frame is lost."""
    read = readers.flir(mirror / "recordings" / "SampleCSQ.csq")
    assert_allclose(np.diff(read.time), 1 / 30, rtol=0, atol=1e-3)  # [s]
    assert read.attrs["start"] == "2017-05-19T19:45:33.583+00:00"
    assert not read.frame_flags.any()


@pytest.mark.data
def test_golden_metadata(mirror: Path) -> None:
    """The camera's record is as ExifTool prints it."""
    folder = mirror / "recordings"
    read = readers.flir(folder / "frame_000000.fff").attrs
    lines = (folder / "frame_000000.txt").read_text().splitlines()
    printed = {key.strip(): value.strip() for key, _, value in (x.partition(":") for x in lines)}
    for key in ("R1", "R2", "B", "F", "O"):
        assert read[f"file_planck_{key}"] == float(printed[f"Planck {key}"])
    numbers = {"Emissivity": "emissivity", "Object Distance": "object_distance"}
    numbers |= {"IR Window Transmission": "window_transmission", "Frame Rate": "frame_rate"}
    for key, name in numbers.items():
        assert_allclose(read[f"file_{name}"], float(printed[key].split()[0]), rtol=0, atol=0.005)
    kelvin = {
        "Reflected Apparent": "reflected",
        "Atmospheric": "atmospheric",
        "IR Window": "window",
    }
    kelvin = {f"{key} Temperature": f"{name}_temperature" for key, name in kelvin.items()}
    kelvin |= {f"Camera Temperature Range {end}": f"range_{end.lower()}" for end in ("Max", "Min")}
    for key, name in kelvin.items():
        celsius = read[f"file_{name}"] - 273.15
        assert_allclose(celsius, float(printed[key].split()[0]), rtol=0, atol=0.05)  # [K]
    assert read["file_camera_model"] == printed["Camera Model"]
    assert read["file_camera_serial_number"] == printed["Camera Serial Number"]
    assert printed["Date/Time Original"] == "2018:11:05 12:14:43.084+01:00"
    assert read["start"] == "2018-11-05T11:14:43.084+00:00"


@pytest.mark.parametrize("codec", ["", "png", "jpegls"])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("inner", ["<", ">"])
def test_counts_come_back(path: Path, codec: str, order: str, inner: str) -> None:
    """Every codec in every byte order of directory and records; marks in the pixels mislead not."""
    counts = scene()
    counts[1, 3, 4:6] = np.frombuffer(b"FFF\0", "<u2")
    read = flir(path, sequence(counts, codec, order, inner=inner))
    assert_array_equal(read.counts, counts)
    assert_allclose(read.time, [0, 0.1, 0.2], rtol=0, atol=1e-9)
    assert read.attrs["start"] == "2017-07-14T02:40:00.125+00:00"
    assert read.attrs["file_camera_model"] == "Made up 1"
    assert read.attrs["file_emissivity"] == 0.95
    assert read.attrs["implausible"] == ""
    schema.check(read[["counts"]].expand_dims(band=["a"]), "capture")


@pytest.mark.parametrize("codec", ["", "png"])
def test_pictures(tmp_path: Path, codec: str) -> None:
    """Radiometric JPEGs, in many segments, make a recording in the order of their numbers."""
    counts = scene()
    paths = [tmp_path / f"IR_{number}.jpg" for number in (8, 9, 10)]
    for number, path in enumerate(paths):
        one = counts[number : number + 1]
        path.write_bytes(jpeg(sequence(one, codec, seconds=[1.5e9 + number], sums=True)))
    read = readers.flir(paths)
    assert_array_equal(read.counts, counts)
    assert_allclose(read.time, [0, 1, 2])
    assert read.attrs["source"] == "IR_8.jpg to IR_10.jpg"
    with pytest.raises(ValueError, match=r"Unordered files: the numbers of 'IR_8\.jpg' do not"):
        readers.flir(sorted(paths))
    copy = sequence(counts[:1], codec, seconds=[1.5e9 + 1], sums=True)
    paths[1].write_bytes(jpeg(copy))
    with pytest.warns(UserWarning, match=r"Same counts in 'IR_8\.jpg' and 'IR_9\.jpg', 1 in all"):
        readers.flir(paths)


def test_lost_frames_and_clocks(path: Path) -> None:
    """A gap of the clock is a lost frame; a clock that stands gives no time."""
    counts = scene(6)
    read = flir(path, sequence(counts, seconds=[1e9 + k for k in (0, 0.1, 0.2, 0.5, 0.6, 0.6)]))
    lost = schema.has_flag(read.frame_flags, "frames_lost_before")
    assert lost.values.tolist() == [False, False, False, True, False, False]
    stands = schema.has_flag(read.frame_flags, "time_stands")
    assert stands.values.tolist() == [False] * 5 + [True]
    assert np.isnan(read.exposure_time[5])
    assert_allclose(read.time, [0, 0.1, 0.2, 0.5, 0.6, 0.7], rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"Unordered times in 'a\.seq': frame 2 is 0.500 s before"):
        flir(path, sequence(counts[:3], seconds=[1e9, 1e9 + 1, 1e9 + 0.5]))
    with pytest.warns(UserWarning, match=r"times of 'a\.seq': frame 1 at 1 s, by clock= at 0\.02"):
        assert_allclose(readers.flir(path, clock=50.0).time, [0, 0.02, 0.04])
    with pytest.warns(
        UserWarning, match=r"frame 1 at 0\.5 s, by clock= at 0\.04 s.* clock= is used"
    ):
        read = readers.flir(path, clock=50.0, frames=slice(0, 3, 2))
    assert_allclose(read.time, [0, 0.04])
    assert "warnings" not in readers.flir(path, clock=1.01, frames=slice(2)).attrs
    with pytest.raises(ValueError, match=r"Unknown times .* 0 of 6 frames have one. Must be given"):
        flir(path, sequence(counts, seconds=[0.0] * 6))
    assert_refused(r"Invalid clock of shape \(2,\) for 6 frames", readers.flir, path, clock=[0, 1])
    assert_refused(r"Invalid clock 0\.0 of", readers.flir, path, clock=0)


def test_exchanged_images_are_marked(path: Path) -> None:
    """An image that is not of its frame has no time."""
    counts = scene(6)
    content = sequence(counts)
    size = len(content) // 6
    image = content.index(counts[1].tobytes()) - 32
    other, length = image + size, 32 + counts[0].nbytes
    first, second = (content[at : at + length] for at in (image, other))
    between = content[image + length : other]
    read = flir(path, content[:image] + second + between + first + content[other + length :])
    found = schema.has_flag(read.frame_flags, "numbers_differ").values
    assert found.tolist() == [False, True, True, False, False, False]
    assert_array_equal(np.isnan(read.exposure_time), found)


def renumbered(content: bytes, image: int, camera: int | None = None) -> bytes:
    """Sequence of frames whose image, and camera, count from another number, or not at all."""
    size = len(content) // 3
    changed = bytearray(content)
    for number in range(3):
        for record, first in ((2692, image), (216, camera)):  # numbers of image and camera
            place, count = number * size + record, 0 if first is None else first + number
            assert content[place - 24 : place - 22] == b"\2\0"
            changed[place : place + 2] = struct.pack("<H", count % 2**16)
    return bytes(changed)


@pytest.mark.parametrize(("image", "camera"), [(2862, 0), (65535, 9), (7, None)])
def test_records_that_count_apart(path: Path, image: int, camera: int | None) -> None:
    """Image and camera count from other numbers, or the camera not at all: no flag, all times."""
    read = flir(path, renumbered(sequence(scene()), image, camera))
    assert not read.frame_flags.any()
    assert_allclose(read.exposure_time, [0, 0.1, 0.2], rtol=0, atol=1e-9)


def test_bytes_that_fill_up(tmp_path: Path) -> None:
    """Bytes up to a multiple of 4 are no frame, of a still or a sequence; a cut frame is seen."""
    still, odd = tmp_path / "a.jpg", sequence(scene(1), sums=True)[:-8]
    for filling in (b"\x85", b"c\2", b"x" * 200):
        still.write_bytes(jpeg(odd + filling))
        assert_array_equal(readers.flir(still).counts, scene(1))
    first, second = (sequence(scene()[n : n + 1], seconds=[1.5e9 + n])[:-8] for n in (0, 1))
    path = tmp_path / "a.seq"
    for between in (b"", b"\xff" * (-len(first) % 4), bytes(60)):
        path.write_bytes(first + between + second + b"\xff" * (-len(second) % 4))
        assert_array_equal(readers.flir(path).counts, scene()[:2])
    assert_refused("Invalid header b'FFF", flir, path, first + second[:30])


def test_an_edited_record_of_the_camera(path: Path) -> None:
    """Counts open though texts of the camera were edited: a warning, and its times if all are."""
    frames = [sequence(scene()[n : n + 1], sums=True, seconds=[1.5e9 + n]) for n in range(3)]
    edited = [frame.replace(b"Made up 1", b"XXXX XX X") for frame in frames]
    with pytest.warns(UserWarning, match="Wrong checksum of the camera's record in frame 0"):
        read = flir(path, edited[0])
    assert_array_equal(read.counts, scene(1))
    assert "CRC-32" in read.attrs["implausible"]
    assert read.attrs["start"] == "2017-07-14T02:40:00.000+00:00"
    with pytest.warns(UserWarning, match="in frame 1"):
        read = flir(path, frames[0] + edited[1] + frames[2])
    assert np.isnan(read.exposure_time.values).tolist() == [False, True, False]
    blank = frames[0][:192] + bytes(400) + frames[0][592:]
    assert_refused(r"Damaged record of the camera.* with clock= it is not", flir, path, blank)
    with pytest.warns(UserWarning, match="Wrong checksum"):
        assert_array_equal(readers.flir(path, clock=1.0).counts, scene(1))


def test_a_codec_gets_the_pixels_alone(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Texts and profiles in a PNG, which may unpack to any size, do not reach the codec."""
    image = compressed(scene(1)[0], "png")
    text = b"zTXta\0\0" + zlib.compress(bytes(10**6))
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    content = sequence(scene(1), "png", packed=image[:33] + chunk + image[33:])
    path.write_bytes(content)
    seen = list[bytes]()
    decode = imagecodecs.png_decode

    def seen_decode(content: bytes) -> object:
        seen.append(content)
        return decode(content)

    monkeypatch.setattr(imagecodecs, "png_decode", seen_decode)
    assert_array_equal(readers.flir(path).counts, scene(1))
    assert b"zTXt" in content
    assert b"zTXt" not in seen[0]
    with pytest.raises(ValueError, match=r"Damaged PNG in frame 0 .* Must fit its checksum"):
        flir(path, content.replace(b"IDAT", b"IDAt"))


def test_implausible_values_are_named(path: Path) -> None:
    """Kelvin entered for Celsius, a date before the format: named, shown, and not applied."""
    values = {0x28: 571.15, 0x20: float("nan")}
    read = flir(path, sequence(scene(1), seconds=[946706066.0], values=values))
    assert "reflected_temperature 571.15 K (298.0 degrees Celsius)" in read.attrs["implausible"]
    assert "emissivity nan" in read.attrs["implausible"]
    assert "date 2000-01-01" in read.attrs["implausible"]
    assert read.attrs["file_reflected_temperature"] == 571.15
    assert "file_emissivity" not in read.attrs


def test_range_must_not_change(path: Path) -> None:
    """Frames of two ranges of the camera are no recording."""
    parts = [sequence(scene(1)), sequence(scene(1), seconds=[1.6e9], values={0x58: 16000.0})]
    assert_refused(r"R1 16000 of frame 1 of 'a\.seq', 21106\.8 before", flir, path, b"".join(parts))
    assert readers.flir(path, frames=slice(1, None)).attrs["file_planck_R1"] == 16000
    assert CONSTANTS[0x58] == readers.flir(path, frames=slice(1)).attrs["file_planck_R1"]


def test_byte_order(path: Path) -> None:
    """A header that contradicts its image, and an image that does not tell, ask the user."""
    counts = scene(2)
    with pytest.raises(ValueError, match=r"Unclear byte order in 'a\.seq'.* byte_order='little'"):
        flir(path, sequence(counts.byteswap()))
    read = readers.flir(path, byte_order="big")
    assert_array_equal(read.counts, counts)
    assert (read.attrs["byte_order"], read.attrs["byte_order_by"]) == ("big", "caller")
    with pytest.raises(ValueError, match="Unclear byte order"):
        flir(path, sequence(np.full((1, 8, 8), 17999, dtype=np.uint16), "png"))
    assert readers.flir(path, byte_order="little").counts[0, 0, 0] == 17999
    assert_refused("Invalid byte_order 'middle'", readers.flir, path, byte_order="middle")


@pytest.mark.parametrize("form", ["raw", "png"])
def test_the_wrong_byte_order_is_refused(path: Path, form: str) -> None:
    """Images that are clearly smoother in the other order contradict what is stated."""
    counts = scene(2)
    found = flir(path, sequence(counts, "png") if form == "png" else sequence(counts))
    right, wrong = ("little", "big")[:: 1 if found.attrs["byte_order"] == "little" else -1]
    stated = readers.flir(path, byte_order=right)
    assert_array_equal(stated.counts, found.counts)
    assert stated.attrs["byte_order_by"] == "caller"
    with pytest.raises(ValueError, match=f"Invalid byte_order '{wrong}'.*Must be the other one"):
        readers.flir(path, byte_order=wrong)


def test_parts_of_a_recording(path: Path) -> None:
    """Some frames of a recording whose end is cut off; how many can be read is said."""
    content = sequence(counts := scene(4))
    with pytest.raises(ValueError, match=r"frame 3 of .* Those before it: frames=slice\(0, 3\)"):
        flir(path, content[:-500])
    assert_array_equal(readers.flir(path, frames=slice(0, 3, 2)).counts, counts[:3:2])
    assert_refused(r"Invalid frames=slice\(2, 2, None\)", readers.flir, path, frames=slice(2, 2))
    with pytest.raises(ValueError, match=r"Invalid frames slice\(-1, None, None\)"):
        readers.flir(path, frames=slice(-1, None))


FLIPPED = bytearray(sequence(scene(1), sums=True))  # a bit of the image, against its checksum
FLIPPED[-200] ^= 1
# A small file that states a huge image, in its codec and in its record.
IMAGE, SIZE = compressed(scene(1)[0], "png"), struct.pack("<HH", 32, 24)
HUGE = IMAGE[:16] + struct.pack(">II", 60000, 60000) + IMAGE[24:]
HUGE = sequence(scene(1), "png").replace(IMAGE, HUGE)
HUGE = HUGE.replace(SIZE, struct.pack("<HH", 60000, 60000))
# Constant images, which pack a thousandfold, take no more memory than a camera's could.
CONSTANT = sequence(np.full((1, 1024, 1024), 17000, dtype=np.uint16), "jpegls") * 40


test_refused_with_what_to_do = refused(
    lambda folder, name, *content: flir(folder / name, *content),
    [
        ("a.ats", b"ATS", "readers.tiff"),
        ("a.mp4", b"\0\0\0\x18ftypmp42", "film: most have 8 bits that are drawn.*gray16le"),
        ("a.seq", b"BM" * 40, "picture: most have 8 bits"),
        ("a.seq", b"", "Empty file"),
        ("a.seq", sequence(scene(1) // np.uint16(256)), "they have 8 bits, alone or spread"),
        ("a.seq", b"RIFF" * 40, r"Invalid header b'RIFF'.*no recording of FLIR\? Then export"),
        ("a.jpg", b"\xff\xd8\xff\xda\0\2", "No thermal data of FLIR .* of another maker"),
        ("a.jpg", b"\xff\xd8\xff\xe1\xff\xff", "Damaged JPEG"),
        ("a.seq", FLIPPED, r"Damaged image in frame 0 of 'a\.seq': CRC-32 .* Must"),
        ("a.seq", HUGE, "1 frames of 60000 x 60000 pixels take 2.88e+10 bytes"),
        ("a.seq", CONSTANT, 10.0, "40 frames .* Must be at most 64 times the .* bytes"),
    ],
    "tmp_path",
    ValueError,
)


def test_missing_library(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without imagecodecs the extra is named."""
    path.write_bytes(sequence(scene(1), "jpegls"))
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    with pytest.raises(ImportError, match=r"Missing library 'imagecodecs'.*'\.\[recordings\]'"):
        readers.flir(path)
