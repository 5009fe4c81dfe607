"""TIFF stacks of other programs, refused where they are no counts."""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import xarray as xr
from flir_files import scene
from hostile_files import written
from imagecodecs import png_encode
from numpy.testing import assert_allclose, assert_array_equal
from refused import assert_refused, raising, refused

from dbthermal import readers

FORMS: dict[str, dict[str, Any]] = {
    "plain": {},
    "pages": {"metadata": None},
    "big-endian": {"byteorder": ">"},
    "bigtiff": {"bigtiff": True},
    "axes": {"metadata": {"axes": "TYX"}},
    "ImageJ": {"imagej": True, "metadata": {"axes": "TYX"}},
    "ImageJ's slices": {"imagej": True, "metadata": {"axes": "ZYX"}},
    "ImageJ's signed numbers": {"imagej": True, "metadata": {"axes": "TYX", "c0": -32768.0}},
    "OME": {"ome": True, "metadata": {"axes": "TYX"}},
    "strips": {"rowsperstrip": 5},
    "one page": {"truncate": True},
}
HALF = 0.5 * scene().astype("f4")
HALVES = f"{HALF[0].min():g} to {HALF[0].max():g}"
GDAL = '<GDALMetadata>\n<Item name="{}" sample="0" role="{}">{}</Item>\n</GDALMetadata>'


def write(path: Path, counts: Any, **options: Any) -> Path:
    """TIFF of gray values, unless it is to have colours."""
    tifffile.imwrite(path, counts, **{"photometric": "minisblack", **options})
    return path


def one_a_frame(folder: Path, *names: str) -> list[Path]:
    """Files of one frame each."""
    paths = [folder / f"{name}.tif" for name in names]
    for path, image in zip(paths, scene(len(paths)), strict=True):
        write(path, image)
    return paths


def read(path: Path | list[Path], clock: float | None = 10.0) -> xr.Dataset:
    """Stack of counts, at 10 Hz."""
    return readers.tiff(path, unit="count", clock=clock)


@pytest.mark.parametrize("form", FORMS)
def test_stacks_come_back(tmp_path: Path, form: str) -> None:
    """Counts of every form of TIFF, in the order of bytes that it states."""
    found = read(write(tmp_path / "a.tif", scene(), **FORMS[form]))
    assert_array_equal(found.counts, scene())
    assert_allclose(found.time, [0, 0.1, 0.2])
    assert found.attrs["byte_order"] == ("big" if form == "big-endian" else "little")


def test_frames_appended_one_by_one(tmp_path: Path) -> None:
    """Each has a description of one image."""
    for image in scene():
        write(path := tmp_path / "a.tif", image, append=True)
    assert_array_equal(read(path).counts, scene())


def test_one_file_a_frame(tmp_path: Path) -> None:
    """Files in the order of time; an order of text is noticed."""
    paths = one_a_frame(tmp_path, "frame8", "frame9", "frame10")
    assert_array_equal(read(paths).counts, scene())
    assert_refused(r"numbers of 'frame8\.tif' do not rise", read, sorted(paths))
    with pytest.raises(ValueError, match=r"'b\.tif' are those of the file before, or none"):
        read([tmp_path / "a.tif", tmp_path / "b.tif"])
    write(paths[1], scene()[0, :-1])
    assert_refused(r"page of \(23, 32\) in 'frame9\.tif'\. Must be \(24, 32\)", read, paths)


JITTER = (57.0, 57.102, 57.199, 57.601, 57.7)  # of dates in names [s]


@pytest.mark.parametrize(
    ("names", "places"),
    [
        ([f"run2_{number}" for number in (10, 12, 14, 20, 22)], [0, 1, 2, 5, 6]),
        (["run10", "run11", "run12", "run14", "run15"], [0, 1, 2, 4, 5]),
        ([f"a_20241027_1559{second:06.3f}" for second in JITTER], [0, 1, 2, 6, 7]),
        ([f"2024-10-27T15.59.{second:06.3f}" for second in JITTER], [0, 1, 2, 6, 7]),
        ([f"17300400{second:06.3f}" for second in JITTER], [0, 1, 2, 6, 7]),
        ([f"a17300400{1e3 * second:05.0f}" for second in JITTER], [0, 1, 2, 6, 7]),
    ],
)
def test_what_names_leave_out_is_a_gap_in_time(
    tmp_path: Path, names: list[str], places: list[int]
) -> None:
    """By numbers, of which every second may be there, dates, or seconds since 1970: warned of."""
    paths, missing = one_a_frame(tmp_path, *names), places[-1] - 4
    expected = f"'{names[0]}.tif to {names[-1]}.tif' leave out frames, {missing} in all"
    with pytest.warns(UserWarning, match=expected):
        made = read(paths)
    assert_allclose(made["exposure_time"], np.array(places) / 10.0, atol=1e-9)  # [s]
    assert_array_equal(made["frame_flags"] > 0, [False, False, False, True, False])
    assert_allclose(read(paths[:3])["exposure_time"], [0.0, 0.1, 0.2])


def test_a_stack_that_is_left_out_is_a_gap_in_time(tmp_path: Path) -> None:
    """So is a whole stack of a recording in parts; one of two bands is not called truncated."""
    paths = [tmp_path / f"rec_{number}.tif" for number in (1, 2, 4)]
    for path, frames in zip(paths, np.split(scene(8), (3, 6)), strict=True):
        write(path, frames)
    with pytest.warns(UserWarning, match=r"'rec_1\.tif to rec_4\.tif' leave out frames, 3 in all"):
        made = read(paths)
    assert_allclose(made["exposure_time"] * 10.0, [0, 1, 2, 3, 4, 5, 9, 10], atol=1e-9)  # [frame]
    with tifffile.TiffWriter(tmp_path / "two.tif") as file:
        for band in (scene(), scene() + np.uint16(1)):
            file.write(band, photometric="minisblack")
    with pytest.raises(ValueError, match=r"Invalid TIFF .* 6 pages\. Must be the 3 .* one band"):
        read(tmp_path / "two.tif")


@pytest.mark.parametrize("fraction", ["", "_{:03}", ".{:03}"])
def test_dates_in_names_that_jump(tmp_path: Path, fraction: str) -> None:
    """In autumn the local hour comes twice: sorted by names, frames are in another order."""
    clock, names = (5.0, []) if fraction else (1.0, list[str]())
    for number in range(20):
        second, part = divmod(number, 5) if fraction else (number, 0)
        hour = "0259" if number < 10 else "0200"
        names.append(
            f"a_20261025_{hour}{second + 50 * (number < 10):02}{fraction.format(200 * part)}"
        )
    paths = one_a_frame(tmp_path, *names)
    with pytest.warns(
        UserWarning, match=r"out frames, \d{4,5} in all, the first before frame 10\."
    ):
        made = read(sorted(paths), clock=clock)
    assert made["time"].values[-1] > 3500.0  # [s]


def test_dates_in_names_contradict_the_clock(tmp_path: Path) -> None:
    """Dates whose rate is not that of the clock are a warning, as of a wrong frame rate."""
    names = [f"a_20241027_1559{second:06.3f}" for second in np.arange(57, 59, 0.1)]
    paths = one_a_frame(tmp_path, *names)
    read(paths)
    with pytest.warns(UserWarning, match=r"dates of 'a_.* are 0\.1 s apart, by clock= 0\.2 s"):
        made = read(paths, clock=5.0)
    assert_allclose(made["exposure_time"][:2], [0.0, 0.2])  # [s]


def test_names_without_gaps(tmp_path: Path) -> None:
    """Full minutes, counters behind dates, and dates that are none; a copy is warned of."""
    whole = [f"20241027_{time}" for time in (155958, 155959, 160000, 160001)]
    counted = [f"20241027_155958_{number:03}" for number in (7, 8, 9)] + ["20241027_155959_010"]
    odd = [f"20249999_15595{second}_{second}" for second in range(4)]
    for names, clock in ((whole, 1.0), (counted, 10.0), (odd, 10.0)):
        paths = one_a_frame(tmp_path, *names)
        assert_allclose(read(paths, clock=clock)["exposure_time"] * clock, range(4))
    write(paths[2], scene()[1])
    with pytest.warns(UserWarning, match=r"Same counts in '.*_1\.tif' and '.*_2\.tif', 1 in all"):
        read(paths)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("predictor", [False, True])
@pytest.mark.parametrize("codec", ["lzw", "zlib", "packbits", "zstd", "lzma"])
def test_compressed_without_loss(tmp_path: Path, codec: str, predictor: bool, order: str) -> None:
    """Strips of the usual codecs, also as differences; one that unpacks to another size is not."""
    options: dict[str, Any] = {"compression": codec, "predictor": predictor, "rowsperstrip": 10}
    write(path := tmp_path / "a.tif", scene(), byteorder=order, **options)
    assert_array_equal(read(path).counts, scene())
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[1]
        place, number = page.tags[279].valueoffset, len(page.databytecounts)
        kind = f"{order}{'I' if page.tags[279].dtype == 4 else 'H'}"
    assert number == 3
    content = bytearray(path.read_bytes())
    (length,) = struct.unpack_from(kind, content, place)
    struct.pack_into(kind, content, place, length // 2)
    assert_refused("Damaged TIFF", read, written(path, content))


def test_a_strip_unpacks_no_farther_than_its_page(tmp_path: Path) -> None:
    """Pages of few bytes that state, or unpack to, a large picture are refused for their size."""
    large = np.full((1, 6000, 6000), 17000, dtype=np.uint16)
    with pytest.raises(ValueError, match=r"Must be at most 64 times the .* bytes of the file"):
        read(write(path := tmp_path / "a.tif", large, compression="zlib"))
    content = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        page: Any = file.pages[0]
        for tag in (256, 257, 278):  # width, length, and rows of a strip
            struct.pack_into("<H", content, page.tags[tag].valueoffset, 90)
    assert_refused("TIFF", read, written(path, content))


def test_png_of_16_bits(tmp_path: Path) -> None:
    """A PNG a frame, of 16 bits and gray; its form decides, not its name."""
    paths = [written(tmp_path / f"a{n}.tif", png_encode(image)) for n, image in enumerate(scene())]
    found = read(paths)
    assert_array_equal(found.counts, scene())
    assert found.attrs["format"] == "PNG"
    assert_refused(r"Invalid 'a0.tif' .* read by readers\.tiff", readers.flir, paths[0])
    gray = scene()[0]
    for counts, message in (
        (gray.astype("u1"), "24 x 32 pixels of 8 bits, .* Must be of 16 bits and gray: counts"),
        (np.stack([gray] * 3, axis=-1), "colours 2, .*Must be of 16 bits and gray"),
    ):
        assert_refused(message, read, written(tmp_path / "b.png", png_encode(counts)))
    written(paths[1], paths[1].read_bytes()[:-40])
    assert_refused(r"Damaged PNG in 'a1\.tif'", read, paths)


@pytest.mark.parametrize(
    ("form", "interval", "agrees"),
    [
        ("imagej", {"finterval": 0.1}, True),
        ("imagej", {"finterval": 100, "tunit": "ms"}, True),
        ("imagej", {"finterval": 0.2}, False),
        ("ome", {"TimeIncrement": 0.1}, True),
        ("ome", {"TimeIncrement": 0.3}, False),
        ("ome", {"Plane": {"DeltaT": [5.0, 5.1, 5.2]}}, True),
        ("ome", {"Plane": {"DeltaT": [5.0, 5.5, 6.0]}}, False),
    ],
)
def test_intervals_of_a_description(
    tmp_path: Path, form: str, interval: dict[str, Any], agrees: bool
) -> None:
    """An interval or times of ImageJ and OME that the clock contradicts are refused."""
    options = {form: True, "metadata": {"axes": "TYX", **interval}}
    write(path := tmp_path / "a.tif", scene(), **options)
    with raising(None if agrees else r"Invalid times of .* Must agree to half a frame"):
        assert_array_equal(read(path).counts, scene())
        assert_allclose(read(path, clock=None)["exposure_time"], [0.0, 0.1, 0.2])  # [s]


def test_times_of_pages(tmp_path: Path) -> None:
    """Those by Micro-Manager and dates with fractions are a clock; with dates it is compared."""

    def pages(code: int, form: str, *times: object) -> Path:
        with tifffile.TiffWriter(tmp_path / "a.tif") as file:
            for image, time in zip(scene(), times, strict=True):
                tag: Any = (code, "s", 0, form.format(time), True)
                file.write(image, photometric="minisblack", metadata=None, extratags=[tag])
        return tmp_path / "a.tif"

    for path in (
        pages(51123, '{{"ElapsedTime-ms": {}}}', 7.5, 107.5, 218),
        pages(306, "2024:10:27 15:59:{}", "07.4", "07.5", "07.6105"),
    ):
        assert_allclose(read(path, clock=None)["time"], [0.0, 0.1, 0.2105], atol=1e-6)  # [s]
        assert_array_equal(read(path)["time"], np.arange(3) / 10)
        assert_refused(r"Invalid times of .* Must agree to half a frame", read, path, clock=30.0)
    path = pages(306, "2024:10:27 15:59:{}", "07", "08", "09")
    assert_array_equal(read(path, clock=1.0)["time"], np.arange(3))
    with pytest.warns(UserWarning, match=r"dates of 'a\.tif' span 2 s, by clock= 0\.2 s"):
        read(path)


def test_frame_rate_of_a_description(tmp_path: Path) -> None:
    """A frame rate may be that of playing: another one than the clock's is a warning."""
    for text, warned in (("fps=10.0", False), ("fps=30", True), ('{"frame_rate": 5}', True)):
        write(path := tmp_path / "a.tif", scene(), description=text)
        if not warned:
            read(path)
            continue
        with pytest.warns(UserWarning, match=r"frames a second, and clock= .*of playing"):
            assert_array_equal(read(path).counts, scene())


FILM = scene()
FOUR = scene(4).reshape(2, 2, 24, 32)
BANDS: dict[str, Any] = {"imagej": True, "metadata": {"axes": "TCYX"}, "photometric": None}
OME = {"ome": True, "metadata": {"axes": "CTYX"}}
SCALED = {"imagej": True, "metadata": {"axes": "TYX", "c0": -273.15, "c1": 0.04}}
SCALE, OFFSET = GDAL.format("SCALE", "scale", 0.01), GDAL.format("OFFSET", "offset", 9)


def tagged(code: int, kind: int, value: Any) -> dict[str, Any]:
    """One tag more."""
    return {"extratags": [(code, kind, 0 if kind == 2 else 1, value, False)]}


test_refused = refused(
    lambda folder, counts, options: read(write(folder / "a.tif", counts, **options)),
    [
        (FILM, {"compression": "jpeg2000"}, "Invalid compression .* one without loss: LZW, de"),
        (HALF, {}, f"Invalid TIFF 'a.tif': .* of page 0, float32 from {HALVES}"),
        (FILM.astype("f2") / 9, {}, "Invalid values of page 0, float16 from"),
        (FILM.astype("i2"), {}, "Invalid sample format 2 of page 0"),
        (FILM.astype("u1"), {}, "Invalid bits of a pixel 8 of page 0"),
        (scene(3), {"photometric": "rgb", "planarconfig": "separate"}, "values of a pixel 3"),
        (scene(1)[0], {"tile": (1024, 1024)}, "Invalid 1 tiles of 1024 x 1024 of page 0. Must"),
        (scene(1)[0], {"subfiletype": 1}, "Invalid preview True of page 0"),
        (FILM // np.uint16(256), {}, "they have 8 bits, alone or spread over two bytes"),
        (FILM // np.uint16(256) * np.uint16(257), {}, "they have 8 bits"),
        (0 * FILM, {}, "Invalid counts of 'a.tif': all are 0. Must be 16-bit counts"),
        (FILM // np.uint16(256) * np.uint16(256) + np.uint16(9), {}, "they have 8 bits"),
        (FOUR, {}, r"Invalid axes YX of \[2, 2\] images. Must be TYX, time"),
        (FOUR, {"description": "my lab"}, r"Invalid axes YX of \[2, 2\] images"),
        (FOUR, BANDS, r"Invalid axes \w+ of \[2, 2\] images"),
        (FOUR, OME, r"Invalid axes \w+ of \[1, 2, 2\] images"),
        *(
            (FILM, {"metadata": {"axes": it}}, f"Invalid axes {it} .*Must be TYX, time, rows")
            for it in ("CYX", "XYT", "SYX", "TXY", "EYX")
        ),
        (FILM, {"imagej": True}, "Invalid axes CYX of .* images"),
        (FILM, SCALED, "Invalid c0 -273.15 of page 0, by GDAL or ImageJ. Must be 0: counts as"),
        (FILM.byteswap(), {}, "Invalid counts of 'a.tif': rougher than with bytes swapped"),
        (FILM, {"ome": True}, "Invalid axes CYX of .* images"),
        (FILM, {"photometric": "miniswhite"}, "Invalid photometric interpretation 0 of page 0"),
        (FILM, tagged(274, 3, 6), "Invalid orientation 6 of page 0. Must be 1: rows from the top"),
        (FILM, tagged(42112, 2, SCALE), "Invalid scale 0.01 of page 0, by GDAL"),
        (FILM, tagged(42112, 2, OFFSET), "Invalid offset 9 .*Must be 0"),
        (FILM, tagged(42113, 2, str(FILM[1, 2, 3])), "Missing counts in 'a.tif'.* Must all be"),
    ],
    "tmp_path",
    ValueError,
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"byteorder": ">"},
        {"bigtiff": True, "compression": "lzw"},
        {"compression": "zlib", "predictor": True},
        {"ome": True, "metadata": {"axes": "TYX"}},
    ],
)
@pytest.mark.parametrize("tile", [(16, 16), (32, 16), (16, 48), (64, 64)])
def test_tiles(tmp_path: Path, options: dict[str, Any], tile: tuple[int, int]) -> None:
    """Tiles, which may reach beyond the image, hold its counts; a page that lost one is refused."""
    write(path := tmp_path / "a.tif", scene(3, (40, 50)), tile=tile, **options)
    assert_array_equal(read(path).counts, scene(3, (40, 50)))
    with tifffile.TiffFile(path, mode="r+") as file:
        file.pages.first.tags["TileByteCounts"].overwrite(2)
    assert_refused(r"(Damaged|Truncated|Invalid).* TIFF|strips or tiles", read, path)


def test_unit_must_be_stated(tmp_path: Path) -> None:
    """Temperatures are refused with what to do; tags that change nothing are not."""
    texts = {42112: GDAL.format("SCALE", "scale", "1.0"), 42113: "0"}
    tags = [(274, 3, 1, 1, False), *((code, 2, 0, text, False) for code, text in texts.items())]
    write(path := tmp_path / "a.tif", scene(), extratags=tags)
    assert_array_equal(read(path).counts, scene())
    with pytest.raises(ValueError, match=r"Invalid unit 'K' of 'a\.tif'.*Record or export raw"):
        readers.tiff(path, unit="K", clock=10)
    assert_refused(r"Damaged TIFF 'a\.tif'", read, written(path, b"II*\0" + bytes(20)))


@pytest.mark.parametrize(
    "unit", ["C", "degF", "\N{DEGREE SIGN}C", "Celsius", "K", "mK", "cK", "0.01 K", "centikelvin"]
)
def test_unit_of_the_description(tmp_path: Path, unit: str) -> None:
    """A description whose values are temperatures is refused, as of ImageJ or JSON; others not."""
    image_j = f"ImageJ=1.54f\nunit=micron\nvunit={unit}\n"
    for form in (image_j, f'{{"units": "{unit}"}}', f"unit: {unit}"):
        with pytest.raises(ValueError, match=r"Invalid unit .* of 'a\.tif'\. Must be 'count'"):
            read(write(tmp_path / "a.tif", scene(), description=form.encode()))
    for form in ("unit=micron", "units: counts", "sensor temperature 30 C", "unit=cm"):
        read(write(tmp_path / "a.tif", scene(), description=form))


def test_missing_pages(tmp_path: Path) -> None:
    """A stack that states more images than it holds is refused; so is a chain without an end."""
    write(path := tmp_path / "a.tif", scene())
    whole = path.read_bytes()
    with pytest.raises(ValueError, match=r"3 pages\. Must be the 4 that its description states"):
        read(written(path, whole.replace(b'{"shape": [3,', b'{"shape": [4,')))
    write(path, scene(), truncate=True)
    whole = path.read_bytes()
    with pytest.raises(ValueError, match=r"Truncated TIFF .* 9 images"):
        read(written(path, whole.replace(b'{"shape": [3,', b'{"shape": [9,')))


def test_pages_share_no_description(tmp_path: Path) -> None:
    """Pages whose tags lie at one place, which takes hours to read, are refused at the second."""
    image, text = scene()[0].tobytes(), b"x" * 20000
    tags = {256: 32, 257: 24, 258: 16, 259: 1, 262: 1, 273: 8, 277: 1, 278: 24, 279: len(image)}
    content = b"II*\0" + struct.pack("<I", 8 + len(image) + len(text)) + image + text
    for _ in range(3):
        content += struct.pack("<H", len(tags) + 1)
        for tag in sorted([*tags, 270]):
            kind, number = (2, len(text)) if tag == 270 else (4, 1)
            content += struct.pack("<HHII", tag, kind, number, tags.get(tag, 8 + len(image)))
        content += struct.pack("<I", len(content) + 4)
    with pytest.raises(ValueError, match=r"bytes of pixels, tags\. Must fit into its"):
        read(written(tmp_path / "a.tif", content))
